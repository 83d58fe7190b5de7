"""Moves of many places by differences of others, and choices among them by weight."""

import numpy as np

#: Smallest step, a part of the difference of two places, over the one that is best for normal distributions.
_MIN_PART = 0.4
#: Share of steps by the whole difference, from one peak to another.
_WHOLE_SHARE = 0.1
#: Standard deviation of what is added to each step.
_JITTER = 1e-4
#: Number of places, over that of their axes, below which a group is not moved.
_MIN_PLACES_PER_AXIS = 4


class Moves:
    """
    Moves of places to a posterior in their groups by differential evolution.

    A place is tried at itself plus a difference of two others of its group, and moved there by the rule of
    Metropolis (ter Braak 2006, Statistics and Computing 16, 239); half of the places are moved at once by
    differences of the other half (Goodman & Weare 2010, CAMCoS 5, 65).

    Parameters
    ----------
    evaluate : callable
        Of rows, shape (m,), and scores, shape (m, n_axes): what `_core.evaluate_places` says of them, shape
        (m, 5), and places in unit intervals, shape (m, n_axes).
    group : `~numpy.ndarray` of int, shape (n,)
        Groups of the places, of one label each.
    active : `~numpy.ndarray` of bool, shape (n, n_axes)
        Axes that have an effect.
    score, evaluated, place : `~numpy.ndarray`, shapes (n, n_axes), (n, 5) and (n, n_axes)
        Scores, what `_core.evaluate_places` says of them, and places in unit intervals; they change.
    power : float, optional
        Power of the likelihood in the posterior.
    """

    def __init__(self, evaluate, group, active, score, evaluated, place, power=1.0):
        self.evaluate = evaluate
        self.group = group
        self.active = active
        self.score = score
        self.evaluated = evaluated
        self.place = place
        self.power = power
        n_active = active.sum(axis=1)
        # step of the highest efficiency for normal distributions (ter Braak 2006)
        self._best_part = 2.38 / np.sqrt(2.0 * np.maximum(n_active, 1))
        size = np.bincount(group)
        self._is_movable = size[group] >= _MIN_PLACES_PER_AXIS * (n_active + 1)

    def log_target(self, evaluated):
        """Compute ln of the posterior with the power of the likelihood, (m,)."""
        return evaluated[:, 0] - (1.0 - self.power) * evaluated[:, 4]

    def sweep(self, rng):
        """Try to move half of all places, and then the other half, by random numbers of a generator."""
        group = self.group
        order = np.lexsort([rng.random(len(group)), group])
        order = order[self._is_movable[order]]
        for parity in (0, 1):
            self._move(order[parity::2], order[1 - parity :: 2], rng)

    def _move(self, rows, partners, rng):
        """Try to move places by differences of ``partners``, which are sorted by group."""
        first = _partners_of_group(self.group, rows, partners, rng)
        second = _partners_of_group(self.group, rows, partners, rng)
        part = self._best_part[rows] * (_MIN_PART + (1.0 - _MIN_PART) * rng.random(rows.size))
        part[rng.random(rows.size) < _WHOLE_SHARE] = 1.0
        change = part[:, None] * (self.score[first] - self.score[second])
        change += _JITTER * rng.standard_normal(change.shape)
        score = self.score[rows] + np.where(self.active[rows], change, 0.0)
        evaluated, place = self.evaluate(rows, score)
        gain = self.log_target(evaluated) - self.log_target(self.evaluated[rows])
        accepted = np.log(rng.random(rows.size)) < gain
        rows = rows[accepted]
        self.score[rows] = score[accepted]
        self.evaluated[rows] = evaluated[accepted]
        self.place[rows] = place[accepted]


def _partners_of_group(group, rows, partners, rng):
    """Choose one of ``partners``, which are sorted by group, of the same group for each of the rows."""
    start = np.searchsorted(group[partners], group[rows], "left")
    end = np.searchsorted(group[partners], group[rows], "right")
    return partners[start + (rng.random(rows.size) * (end - start)).astype(int)]


def systematic(weight, n):
    """Choose n places in proportion to weights (systematic resampling): their indices."""
    upto = np.cumsum(weight)
    return np.searchsorted(upto, (np.arange(n) + 0.5) * upto[-1] / n)
