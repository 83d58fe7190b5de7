"""Mixtures of t distributions that places between the nodes of a grid are drawn from, fitted to places before."""

from typing import NamedTuple

import numpy as np

from miricigale.fitting import _core
from miricigale.utils.values import value_class

#: Weight, over that of its peak, below which no part is fitted.
MIN_WEIGHT = 1e-3
#: Effective number of points for each part that is fitted.
_POINTS_EACH = 50
#: Largest number of parts of a group.
_MAX_PARTS = 5
#: Rounds of the fit.
_FIT_ROUNDS = 4
#: Share of wide parts in all labels.
_WIDE_SHARE = 0.2
#: Their covariance over that of all places of a peak.
_WIDE_SQUARE = 1.4
#: Factor by which widths of fitted parts are enlarged.
_WIDER = 1.1
#: Share of narrow parts where weights are large.
_LOCAL_SHARE = 0.5
#: Smallest weight of the groups that have narrow parts.
_MIN_LOCAL_WEIGHT = 0.03
#: Number of places that a narrow part is fitted to.
_N_NEAR = 120
#: Weight over the mean of a group, below which places have no part in narrow ones if enough others are left.
_LEAST_LOCAL = 0.01


@value_class
class Places:
    """
    Places of a posterior that a mixture is fitted to.

    Parameters
    ----------
    label, peak : `~numpy.ndarray` of int, shape (n,)
        Labels, and peaks of redshift.
    score : `~numpy.ndarray`, shape (n, n_axes)
        Scores.
    flat : `~numpy.ndarray`, shape (n,)
        Weights for the fit, flatter than the posterior.
    weight, log_target : `~numpy.ndarray` or None, shape (n,)
        Weights of the posterior, and its ln; None if these are not known.
    """

    label: np.ndarray
    score: np.ndarray
    peak: np.ndarray
    flat: np.ndarray
    weight: np.ndarray | None = None
    log_target: np.ndarray | None = None


@value_class
class FittedParts:
    """
    Parts of a mixture, whose shares are those within their label and peak.

    Parameters
    ----------
    kernel : `~miricigale.fitting._core.Parts`
        The parts.
    group : `~numpy.ndarray` of int, shape (n,)
        Index of label and peak of each.
    """

    kernel: tuple
    group: np.ndarray

    def possible(self, share):
        """Normalize the shares of the labels and peaks that have parts."""
        has_parts = np.bincount(self.group, minlength=len(share)) > 0
        share = np.where(has_parts, share, 0.0)
        return share / share.sum()

    def shared(self, share):
        """Make the mixture in which labels and peaks have shares: `~miricigale.fitting._core.Parts`."""
        part_share = self.kernel.share * share[self.group]
        return self.kernel._replace(share=part_share / part_share.sum())


class _Group(NamedTuple):
    """
    Places of one label in one peak: their rows, and its parts, which are fitted, wide and narrow.

    The first part is ``first``, the wide one ``wide``; ``last`` is the one after its own.
    """

    label: int
    peak: int
    rows: np.ndarray
    first: int
    n_fitted: int
    n_local: int
    wide: int
    last: int


def fit_mixture(labels, n_peaks, places, n_local):
    """
    Fit a mixture to places.

    Each label with weight in a peak has parts of its own, and each label has a wide one in each peak.

    Parameters
    ----------
    labels : `~miricigale.fitting._core.Labels`
        Labels.
    n_peaks : int
        Number of peaks of redshift.
    places : `Places`
        The places.
    n_local : int
        Number of narrow parts for each label and peak that counts, which needs weights.

    Returns
    -------
    parts : `FittedParts`
    """
    groups = _groups(labels, n_peaks, places, n_local)
    n_labels = len(labels.n_active)
    n_axes = places.score.shape[1]
    label = np.array([group.label for group in groups])
    peak = np.array([group.peak for group in groups])
    n_parts = np.array([group.last - group.first for group in groups])
    start = np.zeros(n_labels + 1, np.int64)
    start[1:] = np.cumsum(np.bincount(label, n_parts, minlength=n_labels).astype(np.int64))
    index = np.repeat(label * n_peaks + peak, n_parts)
    n = len(index)
    parts = _core.Parts(
        start=start,
        label=np.empty(n, np.int64),
        share=np.ones(n),
        top=np.empty(n),
        mean=np.empty((n, n_axes)),
        root=np.empty((n, n_axes, n_axes)),
        inverse=np.empty((n, n_axes, n_axes)),
    )
    moments = _moments_of_peaks(places)
    scratch = np.empty((n_axes, n_axes))
    all_wide = np.array([group.wide for group in groups])
    for each_peak, (mean, cov) in moments.items():
        wide = all_wide[peak == each_peak]
        _core.add_widest(labels, parts, wide, mean, _WIDE_SQUARE * cov, scratch)
    _fit_groups(labels, parts, groups, places, moments)
    for group in groups:
        if group.n_local:
            _add_local_parts(labels, parts, group, places)
    return FittedParts(parts, index)


def _groups(labels, n_peaks, places, n_local):
    """List the labels in peaks that places have weight in: `_Group`, by label."""
    n_labels = len(labels.n_active)
    index = places.label * n_peaks + places.peak
    n_groups = n_labels * n_peaks
    flat = np.bincount(index, places.flat, minlength=n_groups).reshape(n_labels, n_peaks)
    square = np.bincount(index, np.square(places.flat), minlength=n_groups)
    effective = (np.square(flat.ravel()) / np.maximum(square, 1e-300)).tolist()
    share = np.zeros(flat.shape)
    if n_local:
        share = np.bincount(index, places.weight, minlength=n_groups).reshape(flat.shape)
        share = share / share.sum()
    of_peak = flat.sum(axis=0)
    peaks = np.flatnonzero(of_peak > 0)
    # whole numbers of few bits are sorted by counting them
    order = np.argsort(index.astype(np.min_scalar_type(n_groups)), kind="stable")
    number = np.bincount(index, minlength=n_groups)
    ends = np.concatenate([[0], np.cumsum(number)]).tolist()
    is_fitted = (flat > MIN_WEIGHT * of_peak).ravel().tolist()
    has_local = (share.ravel() >= _MIN_LOCAL_WEIGHT) & (number >= _N_NEAR)
    has_local = (has_local & (n_local > 0)).tolist()
    groups = []
    first = 0
    for label in range(n_labels):
        for peak in peaks.tolist():
            k = label * n_peaks + peak
            rows = order[ends[k] : ends[k + 1]]
            n_fitted = 0
            if is_fitted[k]:
                n_fitted = int(min(max(effective[k] / _POINTS_EACH, 1), _MAX_PARTS))
            n_narrow = 0
            if has_local[k]:
                n_narrow = n_local
            wide = first + n_fitted
            last = wide + 1 + n_narrow
            groups.append(_Group(label, peak, rows, first, n_fitted, n_narrow, wide, last))
            first = last
    return groups


def _moments_of_peaks(places):
    """Compute mean and covariance of the places of each peak, by peak; of axes without effect too."""
    n_axes = places.score.shape[1]
    global_mean, global_cov = _mean_and_cov(places.score, places.flat)
    moments = {}
    peaks = np.flatnonzero(np.bincount(places.peak, places.flat))
    if peaks.size == 1:
        return {peaks[0]: (global_mean, global_cov)}
    for peak in peaks:
        rows = np.flatnonzero((places.peak == peak) & (places.flat > 0))
        flat = places.flat[rows]
        mean, cov = _mean_and_cov(places.score[rows], flat)
        # few places say little of a covariance: it is drawn to that of all peaks
        shrinkage = n_axes / (n_axes + effective_number(flat))
        moments[peak] = (mean, (1.0 - shrinkage) * cov + shrinkage * global_cov)
    return moments


def _fit_groups(labels, parts, groups, places, moments):
    """Fit parts to the places of groups, and let their wide ones have a share."""
    fitted = [group for group in groups if group.n_fitted]
    order = np.concatenate([group.rows for group in fitted])
    ends = np.cumsum([group.rows.size for group in fitted])
    table = np.empty((len(fitted), 5), np.int64)
    table[:, 0] = [group.label for group in fitted]
    table[:, 1] = ends - [group.rows.size for group in fitted]
    table[:, 2] = ends
    table[:, 3] = [group.first for group in fitted]
    table[:, 4] = [group.n_fitted for group in fitted]
    prior_mean = np.array([moments[group.peak][0] for group in fitted])
    prior_cov = np.array([moments[group.peak][1] for group in fitted])
    n = len(order)
    n_axes = places.score.shape[1]
    scratch = (
        np.empty((n_axes + 2, n)),
        np.empty((_MAX_PARTS + 1, n)),
        np.empty((n_axes, n_axes)),
        np.empty(_MAX_PARTS),
        np.empty((n, n_axes)),
        np.empty(n),
    )
    shape = (_FIT_ROUNDS, _WIDER, _WIDE_SHARE)
    points = (places.score, places.flat, prior_mean, prior_cov)
    _core.fit_groups(labels, parts, table, order, *shape, *points, scratch)


def _add_local_parts(labels, parts, group, places):
    """Add narrow parts where the others of a group would leave large weights."""
    n_axes = places.score.shape[1]
    rows = group.rows
    weight = places.weight[rows]
    # places without weight say nothing of where the posterior is
    has_weight = weight > _LEAST_LOCAL * weight.mean()
    if np.count_nonzero(has_weight) >= 2 * _N_NEAR:
        rows = rows[has_weight]
        weight = weight[has_weight]
    log = places.log_target[rows]
    target = np.exp(np.maximum(log - log.max(), -700.0))
    scratch = (
        np.empty((n_axes + 2, rows.size)),
        np.empty((4, rows.size)),
        np.empty((n_axes, rows.size)),
        np.empty((n_axes, n_axes)),
        np.empty((n_axes, n_axes)),
    )
    points = (places.score[rows], weight / weight.sum(), target)
    counts = (group.first, group.n_fitted + 1, group.n_local)
    _core.add_local_parts(labels, parts, *counts, _LOCAL_SHARE, _N_NEAR, _WIDER, points, scratch)


def _mean_and_cov(score, weight):
    """Compute mean and covariance of places with weights."""
    n_axes = score.shape[1]
    mean = np.empty(n_axes)
    cov = np.empty((n_axes, n_axes))
    _core.mean_and_cov(score, weight, mean, cov)
    return mean, cov + 1e-6 * np.eye(n_axes)


def effective_number(weight):
    """Compute the effective number of weights (Kish 1965)."""
    return weight.sum() ** 2 / np.sum(weight * weight)
