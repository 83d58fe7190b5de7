"""Peaks of posteriors between the nodes of a grid, to which draws of the posterior on the nodes are moved."""

from dataclasses import dataclass, fields

import numpy as np

from miricigale.fitting import _core

#: Weight of a node's redshift, over the largest, below which there is a gap between peaks.
_GAP = 2e-3
#: Number of draws of a label in a peak of redshift for each place that is moved.
_DRAWS_EACH = 4
#: Largest number of places that are moved, in each.
_MAX_STARTS = 4
#: Largest number of steps.
_MAX_STEPS = 8
#: Ln of the weight of a peak below the largest one, down to which peaks count.
_MIN_LOG_WEIGHT = -12.0


def redshift_peaks(redshift, posterior):
    """
    Find the peaks of a posterior on nodes of redshift, which nodes of hardly any weight separate.

    Parameters
    ----------
    redshift, posterior : `~numpy.ndarray`, shape (nz,)
        Nodes and their weights, which sum to 1.

    Returns
    -------
    borders : `~numpy.ndarray`, shape (n_peaks - 1,)
        Redshifts between them.
    weights : `~numpy.ndarray`, shape (n_peaks,)
        Their weights.
    """
    high = posterior > _GAP * posterior.max()
    # a peak reaches to the next nodes
    high = np.convolve(high, [1, 1, 1], "same") > 0
    change = np.diff(high.astype(int), prepend=0, append=0)
    first = np.flatnonzero(change == 1)
    last = np.flatnonzero(change == -1) - 1
    borders = 0.5 * (redshift[last[:-1]] + redshift[first[1:]])
    weights = np.bincount(np.searchsorted(borders, redshift), posterior, minlength=first.size)
    return borders, weights


@dataclass(frozen=True, eq=False)
class NormalPeaks:
    """
    Peaks of a posterior, and the normal distributions that it is there.

    Parameters
    ----------
    label, peak : `~numpy.ndarray` of int, shape (n,)
        Labels, and peaks of redshift of the draws that they were reached from.
    score : `~numpy.ndarray`, shape (n, n_axes)
        Scores.
    cov : `~numpy.ndarray`, shape (n, n_axes, n_axes)
        Covariances in the active axes, lower triangles.
    log_weight : `~numpy.ndarray`, shape (n,)
        Ln of the integrals of the normal distributions.
    """

    label: np.ndarray
    peak: np.ndarray
    score: np.ndarray
    cov: np.ndarray
    log_weight: np.ndarray

    def of_rows(self, rows):
        """Select some."""
        return NormalPeaks(*[getattr(self, field.name)[rows] for field in fields(self)])

    def weights(self, rows):
        """Compute the integrals of some peaks over their sum."""
        if not rows.size:
            return np.zeros(0)
        weight = np.exp(self.log_weight[rows] - self.log_weight[rows].max())
        return weight / weight.sum()

    def shares(self, n_groups, n_peaks):
        """Compute what labels and peaks of redshift have of the integrals: shape (n_groups,); they sum to 1."""
        if not self.label.size:
            return np.zeros(n_groups)
        weight = np.exp(self.log_weight - self.log_weight.max())
        share = np.bincount(self.label * n_peaks + self.peak, weight, minlength=n_groups)
        return share / share.sum()


def find_peaks(space, labels, target, work, draws, n_peaks):
    """
    Move draws to the peaks of a posterior.

    Parameters
    ----------
    space, labels : `~miricigale.fitting._core.Space`, `~miricigale.fitting._core.Labels`
        What places are in.
    target : `~miricigale.fitting._core.Object`
        The object.
    work : `~miricigale.fitting._core.interpolation.Work`
        Scratch of the models.
    draws : tuple of `~numpy.ndarray`, shapes (n,), (n, n_axes) and (n,)
        Labels, scores, and peaks of redshift of draws.
    n_peaks : int
        Number of peaks of redshift.

    Returns
    -------
    peaks : `NormalPeaks`
        Each once.
    """
    label, score, peak = draws
    rows = _starts(label * n_peaks + peak)
    starts = (label[rows], score[rows], peak[rows])
    of_object = (space, labels, target, work)
    of_draws = _climbed(*of_object, *starts)
    others = _starts_of_others(of_draws, len(labels.n_active), n_peaks)
    of_others = _climbed(*of_object, *others)
    columns = []
    for field in fields(NormalPeaks):
        pair = (getattr(of_draws, field.name), getattr(of_others, field.name))
        columns.append(np.concatenate(pair))
    peaks = NormalPeaks(*columns)
    top = peaks.log_weight.max(initial=_core.NEVER)
    return peaks.of_rows(peaks.log_weight > top + _MIN_LOG_WEIGHT)


def _climbed(space, labels, target, work, label, score, peak):
    """Move places to peaks: `NormalPeaks`, each once."""
    n, n_axes = score.shape
    y = score.copy()
    value = np.empty(n)
    log_weight = np.empty(n)
    cov = np.empty((n, n_axes, n_axes))
    climb = _core.make_climb_work(n_axes, target.target.flux.size)
    starts = (label, y, _MAX_STEPS, value, log_weight, cov)
    _core.climb_places(space, labels, target, *starts, work, climb)
    peaks = NormalPeaks(label, peak, y, cov, log_weight)
    return peaks.of_rows(log_weight > 0.5 * _core.NEVER)


def _starts_of_others(peaks, n_labels, n_peaks):
    """Start from the highest peak of each peak of redshift in all labels that have none there."""
    label = []
    score = [np.empty((0, peaks.score.shape[1]))]
    peak = []
    for j in range(n_peaks):
        rows = np.flatnonzero(peaks.peak == j)
        if not rows.size:
            continue
        best = rows[np.argmax(peaks.log_weight[rows])]
        missing = np.setdiff1d(np.arange(n_labels), peaks.label[rows])
        label.append(missing)
        peak.append(np.full(missing.size, j))
        score.append(np.tile(peaks.score[best], (missing.size, 1)))
    empty = np.empty(0, np.int64)
    return np.concatenate([empty, *label]), np.concatenate(score), np.concatenate([empty, *peak])


def _starts(group):
    """Select some draws of each group, evenly in their order: their rows, by group."""
    order = np.argsort(group, kind="stable")
    count = np.bincount(group)
    first = np.cumsum(count) - count
    rows = []
    for j in np.flatnonzero(count):
        n = min(-(-count[j] // _DRAWS_EACH), _MAX_STARTS)
        places = first[j] + (count[j] * (2 * np.arange(n) + 1)) // (2 * n)
        rows.append(order[places])
    return np.concatenate(rows)
