"""
Places of narrow posteriors, from broad ones whose likelihood has a power that rises to 1.

Where errors are small, a posterior is a small part of that with larger errors, in which it has several peaks, and
places that are drawn at random miss most of these. Places are therefore drawn where the likelihood has a small
power, as with larger errors, and follow it as the power rises: each time they are chosen by their weights, and
moved (sequential Monte Carlo: Neal 2001, Statistics and Computing 11, 125; Del Moral, Doucet & Jasra 2006, J. R.
Stat. Soc. B 68, 411).
"""

import numpy as np
from scipy.special import gammaln

from miricigale.fitting import _core
from miricigale.fitting.grid.labels import prior_shares
from miricigale.fitting.grid.moves import Moves, systematic
from miricigale.fitting.grid.proposals import effective_number
from miricigale.utils.values import value_class

#: Number of places for each of the effective number that is wanted, and the smallest number.
_PLACES_EACH = 3.4
MIN_PLACES = 512
#: Effective number, as a part of the places, to which a step of the power takes their weights.
_LEAST_EFFECTIVE = 0.5
#: Sweeps of moves after each step.
_N_SWEEPS = 10
#: Sweeps after the last one.
_N_LAST_SWEEPS = 20
#: Halvings of the interval in which a power is looked for, each in ln and then in the power itself.
_N_HALVINGS = 40
#: Ratio of the ends of this interval above which its middle is that of ln(power).
_WIDE = 4.0
#: Smallest step of the power.
_LEAST_STEP = 1e-12
#: Ln of the posterior below which there is no model.
_NO_MODEL = 0.5 * _core.NEVER


@value_class
class TemperedPlaces:
    """
    Places of equal weight of a posterior.

    Parameters
    ----------
    label : `~numpy.ndarray` of int, shape (n,)
        Labels.
    score, evaluated, place : `~numpy.ndarray`, shapes (n, n_axes), (n, 5) and (n, n_axes)
        Scores, what `_core.evaluate_places` says of them, and places in unit intervals.
    lineage : `~numpy.ndarray` of int, shape (n,)
        Index of the place that each comes from, of those to begin with.
    log_evidence : float
        Ln of the sum of the posterior.
    """

    label: np.ndarray
    score: np.ndarray
    evaluated: np.ndarray
    place: np.ndarray
    lineage: np.ndarray
    log_evidence: float

    def chosen(self, indices, log_evidence):
        """Take some of the places, with another evidence."""
        return TemperedPlaces(
            self.label[indices],
            self.score[indices],
            self.evaluated[indices],
            self.place[indices],
            self.lineage[indices],
            log_evidence,
        )


def prior_mixture(labels):
    """
    Make a mixture as wide as the prior, with one part for each label.

    Parameters
    ----------
    labels : `~miricigale.fitting._core.Labels`
        Labels.

    Returns
    -------
    mixture : `~miricigale.fitting._core.Parts`
    """
    n_labels, n_axes = labels.first.shape
    share = prior_shares(labels.below, labels.first, labels.count).prod(axis=1)
    # largest density of a t distribution
    half = 0.5 * labels.n_active
    log_top = gammaln(0.5 * _core.FREEDOM + half) - gammaln(0.5 * _core.FREEDOM)
    log_top -= half * np.log(_core.FREEDOM * np.pi)
    unit = np.tile(np.eye(n_axes), (n_labels, 1, 1))
    return _core.Parts(
        start=np.arange(n_labels + 1),
        label=np.arange(n_labels),
        share=share / share.sum(),
        top=np.exp(log_top),
        mean=np.zeros((n_labels, n_axes)),
        root=unit,
        inverse=unit.copy(),
    )


def n_tempered(wanted):
    """Return the number of places whose likelihood rises, where an effective number is wanted."""
    return max(int(_PLACES_EACH * wanted), MIN_PLACES)


def temper(evaluate, places, log_density, active, rng, n):
    """
    Raise the power of the likelihood to 1.

    Parameters
    ----------
    evaluate : callable
        Of labels, shape (m,), and scores, shape (m, n_axes): what `_core.evaluate_places` says of them, shape
        (m, 5), and places in unit intervals, shape (m, n_axes).
    places : `TemperedPlaces`
        Places to begin with, of which at least one is possible.
    log_density : `~numpy.ndarray`, shape (n,)
        Ln of the density that they are drawn from.
    active : `~numpy.ndarray` of bool, shape (n_labels, n_axes)
        Axes that have an effect.
    rng : `~numpy.random.Generator`
        Random numbers of the moves.
    n : int
        Number of places of the result.

    Returns
    -------
    places : `TemperedPlaces`
        Of the posterior, n of them.
    broader : `TemperedPlaces`
        Those of the last power below 1; those to begin with if there is none.
    """
    possible = np.flatnonzero(places.evaluated[:, 0] > _NO_MODEL)
    log_share = np.log(possible.size / len(log_density))
    places = places.chosen(possible, places.log_evidence + log_share)
    log_prior = places.evaluated[:, 0] - places.evaluated[:, 4] - log_density[possible]
    power = 0.0
    while True:
        log_like = places.evaluated[:, 4]
        step = _next_step(log_prior, log_like, 1.0 - power, _LEAST_EFFECTIVE * n)
        log_weight = log_prior + step * log_like
        highest = log_weight.max()
        broader = places
        weight = np.exp(log_weight - highest)
        log_evidence = places.log_evidence + highest + np.log(weight.mean())
        places = places.chosen(systematic(weight, n), log_evidence)
        log_prior = np.zeros(n)
        power += step
        is_last = 1.0 - power <= _LEAST_STEP
        n_sweeps = _N_SWEEPS
        if is_last:
            power = 1.0
            n_sweeps = _N_LAST_SWEEPS
        _move(evaluate, places, active, power, n_sweeps, rng)
        if is_last:
            return places, broader


def _move(evaluate, places, active, power, n_sweeps, rng):
    """Move places to the posterior with a power of the likelihood, in their labels."""
    label = places.label

    def evaluate_rows(rows, score):
        return evaluate(label[rows], score)

    moves = Moves(
        evaluate_rows,
        label,
        active[label],
        places.score,
        places.evaluated,
        places.place,
        power,
    )
    for _ in range(n_sweeps):
        moves.sweep(rng)


def _next_step(log_prior, log_like, most, goal):
    """
    Find the step of the power, at most ``most``, at which weights have the effective number ``goal``.

    The weights, (n,), are the exponentials of ``log_prior`` plus the step times ``log_like``.
    """
    if _effective_number(log_prior + most * log_like) >= goal:
        return most
    low = _LEAST_STEP
    high = most
    for _ in range(_N_HALVINGS):
        if high > _WIDE * low:
            middle = np.sqrt(low * high)
        else:
            middle = 0.5 * (low + high)
        if _effective_number(log_prior + middle * log_like) >= goal:
            low = middle
        else:
            high = middle
    return low


def _effective_number(log_weight):
    """Compute the effective number of weights whose logarithms are known."""
    return effective_number(np.exp(log_weight - log_weight.max()))
