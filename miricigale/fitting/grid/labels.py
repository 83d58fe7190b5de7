"""What posteriors between the nodes of a grid tell apart."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from miricigale.fitting import _core


@dataclass(frozen=True, eq=False)
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
        """Of `GridAxis`, and which have no effect where others are absent; see `Continuation`."""
        n_axes = len(axes)
        largest = max(axis.values.size for axis in axes)
        ranges = [axis.ranges for axis in axes]
        below, log_share = np.zeros((n_axes, largest + 1)), np.zeros((n_axes, largest))
        for i, axis in enumerate(axes):
            n = axis.values.size
            # what is known of redshift comes with each object
            weight = np.full(n, 1.0 / n) if axis.kind == "redshift" else axis.weights
            below[i, 1 : n + 1] = np.cumsum(weight)
            below[i, n + 1 :] = below[i, n]
            log_share[i, :n] = log_weights(weight)
        of_range = np.full([len(r) for r in ranges], -1)
        known, rows = {}, []
        for index in np.ndindex(of_range.shape):
            absent = [axes[i].absent_at_zero and index[i] == 0 for i in range(n_axes)]
            inert = without_effect[np.array(absent, bool)].any(axis=0)
            cells = []
            for i in range(n_axes):
                cells.append((0, axes[i].values.size) if inert[i] else ranges[i][index[i]])
            key = tuple(cells)
            if key not in known:
                first, count = np.array(cells).T
                share = below[np.arange(n_axes), first + count] - below[np.arange(n_axes), first]
                known[key] = len(rows) if np.all(share > 0) else -1
                if known[key] >= 0:
                    rows.append((first, count, inert | (count == 1)))
            of_range[index] = known[key]
        first, count, still = (np.array(column) for column in zip(*rows, strict=True))
        kernel = _labels(first, count, still, below, log_share)
        range_of = [np.repeat(np.arange(len(r)), [n for _, n in r]) for r in ranges]
        return cls(kernel, of_range, range_of)

    def without_first_axis(self):
        """The same, but for the first axis, which has one cell."""
        own = self.kernel
        first, count = own.first.copy(), own.count.copy()
        below, log_share = own.below.copy(), own.log_share.copy()
        first[:, 0], count[:, 0] = 0, 1
        below[0], log_share[0] = 1.0, 0.0
        below[0, 0] = 0.0
        still = np.ones(first.shape, bool)
        for i, n in enumerate(own.n_active):
            still[i, own.axes[i, :n]] = False
        still[:, 0] = True
        kernel = _labels(first, count, still, below, log_share)
        return LabelTable(kernel, self.of_range, self.range_of)

    def of_nodes(self, node):
        """
        Labels and scores of places anywhere in the cells of nodes.

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
        label, every = self.of_range[index], np.arange(n_axes)
        uniform = qmc.Sobol(n_axes, seed=2).random(n)
        own, below = self.kernel, self.kernel.below
        first, count = own.first[label], own.count[label]
        inside = (node >= first) & (node < first + count)
        cell = np.where(inside, node, first)
        start = below[every, first]
        whole = below[every, first + count] - start
        place = below[every, cell] + uniform * (below[every, cell + 1] - below[every, cell])
        score = ndtri(np.clip((place - start) / whole, 1e-6, 1.0 - 1e-6))
        active = np.zeros(own.first.shape, bool)
        for i, k in enumerate(own.n_active):
            active[i, own.axes[i, :k]] = True
        return label, np.where(active[label], score, ndtri(np.clip(uniform, 1e-6, 1.0 - 1e-6)))


def labels_of_ranges(labels):
    """
    Labels in which a component is absent or present, or a parameter has a value.

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
    for first, count in zip(labels.first.T, labels.count.T, strict=True):
        ranges = np.unique(np.stack([first, count], axis=1), axis=0)
        if len(ranges) < 2:
            continue
        for start, size in ranges:
            members.append(np.flatnonzero((first == start) & (count == size)))
    return members


def _labels(first, count, still, below, log_share):
    """`_core.Labels` of ranges, of which some axes have no effect."""
    axes, n_active = np.zeros(first.shape, np.int64), (~still).sum(axis=1)
    for i, row in enumerate(~still):
        axes[i, : n_active[i]] = np.flatnonzero(row)
    first, count = first.astype(np.int64), count.astype(np.int64)
    return _core.Labels(first, count, axes, n_active.astype(np.int64), below, log_share)


def log_weights(weights):
    """Logarithms of weights; of 0 a number that is none."""
    return np.log(weights, where=weights > 0, out=np.full(np.shape(weights), _core.NEVER))
