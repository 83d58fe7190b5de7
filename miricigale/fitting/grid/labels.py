"""Labels of posteriors between the nodes of a grid: which components are present, and values of libraries."""

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from miricigale.fitting import _core
from miricigale.utils.caching import cached
from miricigale.utils.values import value_class


@value_class
class LabelTable:
    """
    What posteriors between nodes tell apart: components that are absent or present, and values that are labels.

    Parameters
    ----------
    kernel : `_core.Labels`
        Ranges of cells and active axes of each.
    of_range : `~numpy.ndarray` of int, shape (n_ranges_1, n_ranges_2, ...)
        Label of each combination of the ranges of the axes; -1 where there is no prior weight.
    range_of : list of `~numpy.ndarray` of int
        Range of each cell, by axis.
    """

    kernel: tuple
    of_range: np.ndarray
    range_of: list

    @classmethod
    def of_axes(cls, axes, without_effect):
        """Make the table of `GridAxis`, and which have no effect where others are absent; see `Continuation`."""
        n_axes = len(axes)
        largest = max(axis.values.size for axis in axes)
        ranges = [axis.ranges for axis in axes]
        share_below = np.zeros((n_axes, largest + 1))
        log_share = np.zeros((n_axes, largest))
        for i, axis in enumerate(axes):
            n = axis.values.size
            # the prior of redshift comes with each object
            if axis.kind == "redshift":
                weight = np.full(n, 1.0 / n)
            else:
                weight = axis.weights
            share_below[i, 1 : n + 1] = np.cumsum(weight)
            share_below[i, n + 1 :] = share_below[i, n]
            log_share[i, :n] = log_weights(weight)
        of_range = np.full([len(axis_ranges) for axis_ranges in ranges], -1)
        label_of_key = {}
        rows = []
        for index in np.ndindex(of_range.shape):
            # components that the label does not have leave others without effect
            absent = [axes[i].absent_at_zero and index[i] == 0 for i in range(n_axes)]
            inert = without_effect[np.array(absent, bool)].any(axis=0)
            cells = []
            for i in range(n_axes):
                if inert[i]:
                    cells.append((0, axes[i].values.size))
                else:
                    cells.append(ranges[i][index[i]])
            # combinations that differ only in axes without effect are one label
            key = tuple(cells)
            if key not in label_of_key:
                first, count = np.array(cells).T
                share = prior_shares(share_below, first, count)
                # a label without prior weight does not exist
                if np.all(share > 0):
                    label_of_key[key] = len(rows)
                else:
                    label_of_key[key] = -1
                if label_of_key[key] >= 0:
                    rows.append((first, count, inert | (count == 1)))
            of_range[index] = label_of_key[key]
        first = np.array([row[0] for row in rows])
        count = np.array([row[1] for row in rows])
        still = np.array([row[2] for row in rows])
        kernel = _labels(first, count, still, share_below, log_share)
        range_of = [
            np.repeat(np.arange(len(axis_ranges)), [n for _, n in axis_ranges])
            for axis_ranges in ranges
        ]
        return cls(kernel, of_range, range_of)

    def without_first_axis(self):
        """Return a table whose first axis has one cell."""
        labels = self.kernel
        first = labels.first.copy()
        count = labels.count.copy()
        share_below = labels.below.copy()
        log_share = labels.log_share.copy()
        first[:, 0] = 0
        count[:, 0] = 1
        share_below[0] = 1.0
        log_share[0] = 0.0
        share_below[0, 0] = 0.0
        still = ~active_axes(labels)
        still[:, 0] = True
        kernel = _labels(first, count, still, share_below, log_share)
        return LabelTable(kernel, self.of_range, self.range_of)

    def of_nodes(self, node):
        """
        Draw places anywhere in the cells of nodes: their labels and scores.

        Parameters
        ----------
        node : `~numpy.ndarray` of int, shape (n, n_axes)
            Nodes of the axes.

        Returns
        -------
        label : `~numpy.ndarray` of int, shape (n,)
            Their labels.
        score : `~numpy.ndarray`, shape (n, n_axes)
            Quasi-random scores, the same for the same nodes; standard normal in axes without effect.
        """
        n, n_axes = node.shape
        index = tuple(self.range_of[i][node[:, i]] for i in range(n_axes))
        label = self.of_range[index]
        all_axes = np.arange(n_axes)
        uniform = places_in_cells(n_axes, n)
        labels = self.kernel
        share_below = self.kernel.below
        first = labels.first[label]
        count = labels.count[label]
        # a node of an axis without effect may lie outside of the range of the label
        inside = (node >= first) & (node < first + count)
        cell = np.where(inside, node, first)
        start = share_below[all_axes, first]
        range_share = share_below[all_axes, first + count] - start
        place = share_below[all_axes, cell] + uniform * (
            share_below[all_axes, cell + 1] - share_below[all_axes, cell]
        )
        score = ndtri(np.clip((place - start) / range_share, 1e-6, 1.0 - 1e-6))
        active = active_axes(labels)[label]
        return label, np.where(active, score, ndtri(np.clip(uniform, 1e-6, 1.0 - 1e-6)))


@cached(maxsize=8)
def places_in_cells(n_axes, n):
    """
    Make quasi-random places in cells, the same for all objects.

    Parameters
    ----------
    n_axes, n : int
        Axes of the space, and number of places.

    Returns
    -------
    place : `~numpy.ndarray`, shape (n, n_axes)
        From 0 to 1.
    """
    return qmc.Sobol(n_axes, seed=2).random(n)


def labels_of_ranges(labels):
    """
    List the labels in which a component is absent or present, or a parameter has a value.

    Parameters
    ----------
    labels : `~miricigale.fitting._core.Labels`
        Labels.

    Returns
    -------
    members : list of `~numpy.ndarray` of int
        Labels of each range of each axis that has several.
    """
    members = []
    # labels of one axis differ in the cells that they have there
    for first, count in zip(labels.first.T, labels.count.T, strict=True):
        # one number for each range, in the order of the first cells
        code = first * (count.max() + 1) + count
        codes = np.unique(code)
        if len(codes) < 2:
            continue
        for range_code in codes:
            members.append(np.flatnonzero(code == range_code))
    return members


def prior_shares(share_below, first, count):
    """Return the prior's share in ranges of cells of each axis: shape of ``first``, (n_axes,) or (n, n_axes)."""
    axes = np.arange(len(share_below))
    return share_below[axes, first + count] - share_below[axes, first]


def active_axes(labels):
    """Tell which axes have an effect in each label, shape (n_labels, n_axes)."""
    active = np.zeros(labels.first.shape, bool)
    for i, n in enumerate(labels.n_active):
        active[i, labels.axes[i, :n]] = True
    return active


def _labels(first, count, still, share_below, log_share):
    """Make `_core.Labels` of ranges, of which some axes have no effect."""
    axes = np.zeros(first.shape, np.int64)
    n_active = (~still).sum(axis=1)
    # active axes come first in each row
    for i, row in enumerate(~still):
        axes[i, : n_active[i]] = np.flatnonzero(row)
    first = first.astype(np.int64)
    count = count.astype(np.int64)
    return _core.Labels(first, count, axes, n_active.astype(np.int64), share_below, log_share)


def log_weights(weights):
    """Compute logarithms of weights, `_core.NEVER` of 0."""
    return np.log(weights, where=weights > 0, out=np.full(np.shape(weights), _core.NEVER))
