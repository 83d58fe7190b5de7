"""Moves of many places to a posterior, for objects whose weights stay too unequal."""

import numpy as np

#: Largest number of sweeps over all places, in each of which half of them are moved, then the other half.
N_SWEEPS = 100
#: Number of sweeps over which the mean of ln(posterior) is taken: they end when it is no larger than before.
_N_MEAN = 20
#: Smallest step, a part of the difference of two places, over the one that is best for normal distributions.
_MIN_PART = 0.4
#: Share of steps by the whole difference, from one peak to another.
_WHOLE_SHARE = 0.1
#: Standard deviation of what is added to each step.
_JITTER = 1e-4
#: Number of places, over that of their axes, below which a group is not moved.
_MIN_PLACES_PER_AXIS = 4


def move_places(evaluate, group, active, score, evaluated, place, seed):
    """
    Move places to the posterior in their labels by differential evolution.

    A place is tried at itself plus a difference of two others of its group, and moved there by the rule of
    Metropolis (ter Braak 2006, Statistics and Computing 16, 239); half of the places are moved at once by
    differences of the other half (Goodman & Weare 2010, CAMCoS 5, 65). Sweeps end when the mean of ln(posterior)
    over the places rises no more.

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
    seed : int
        Seed of the moves.
    """
    rng = np.random.default_rng(seed)
    n = len(group)
    n_active = active.sum(axis=1)
    # step of the highest efficiency for normal distributions (ter Braak 2006)
    best = 2.38 / np.sqrt(2.0 * np.maximum(n_active, 1))
    size = np.bincount(group)
    movable = size[group] >= _MIN_PLACES_PER_AXIS * (n_active + 1)
    mean_log = np.empty(N_SWEEPS)
    for sweep in range(N_SWEEPS):
        order = np.lexsort([rng.random(n), group])
        order = order[movable[order]]
        for parity in (0, 1):
            rows = order[parity::2]
            partners = order[1 - parity :: 2]
            first = _partners_of_group(group, rows, partners, rng)
            second = _partners_of_group(group, rows, partners, rng)
            factor = best[rows] * (_MIN_PART + (1.0 - _MIN_PART) * rng.random(rows.size))
            factor[rng.random(rows.size) < _WHOLE_SHARE] = 1.0
            change = factor[:, None] * (score[first] - score[second])
            change += _JITTER * rng.standard_normal(change.shape)
            new = score[rows] + np.where(active[rows], change, 0.0)
            evaluated_new, place_new = evaluate(rows, new)
            accepted = np.log(rng.random(rows.size)) < evaluated_new[:, 0] - evaluated[rows, 0]
            rows = rows[accepted]
            score[rows] = new[accepted]
            evaluated[rows] = evaluated_new[accepted]
            place[rows] = place_new[accepted]
        # it rises until places that began too wide have the distribution, and then goes up and down
        mean_log[sweep] = evaluated[:, 0].mean()
        n_done = sweep + 1
        if n_done >= 2 * _N_MEAN:
            last = mean_log[n_done - _N_MEAN : n_done].mean()
            before = mean_log[n_done - 2 * _N_MEAN : n_done - _N_MEAN].mean()
            if last <= before:
                break


def _partners_of_group(group, rows, partners, rng):
    """Choose one of ``partners``, which are sorted by group, of the same group for each of the rows."""
    start = np.searchsorted(group[partners], group[rows], "left")
    end = np.searchsorted(group[partners], group[rows], "right")
    return partners[start + (rng.random(rows.size) * (end - start)).astype(int)]


def systematic(weight, n):
    """Choose n places in proportion to weights (systematic resampling): their indices."""
    upto = np.cumsum(weight)
    return np.searchsorted(upto, (np.arange(n) + 0.5) * upto[-1] / n)
