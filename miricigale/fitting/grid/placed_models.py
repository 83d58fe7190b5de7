"""Models between the nodes of a grid with the weights of a posterior."""

import numpy as np

from miricigale.utils.values import value_class


@value_class
class PlacedModels:
    """
    Models between nodes with the weights of a posterior.

    Parameters
    ----------
    place : `~numpy.ndarray`, shape (n, n_axes)
        Places in the unit intervals of `~miricigale.fitting._core.Space`.
    weight : `~numpy.ndarray`, shape (n,)
        Weights; they sum to 1.
    scale, variance, power : `~numpy.ndarray`, shape (n,)
        Best scales and their variances, and AGN power for each solar mass formed.
    flux : `~numpy.ndarray`, shape (n, nb)
        Fluxes in uJy for one solar mass formed.
    log_likelihood : `~numpy.ndarray`, shape (n,)
        Ln of the likelihoods, but for a constant.
    uniform : `~numpy.ndarray`, shape (n,)
        Quasi-random numbers for the scales' own errors.
    log_evidence : float
        Ln of the mean likelihood over the priors, but for the constant of the likelihoods.
    converged : bool
        Whether the effective number is what was asked for.
    lineage : `~numpy.ndarray` of int or None, shape (n,)
        Models of the same number come from one place; None if each has a place of its own.
    """

    place: np.ndarray
    weight: np.ndarray
    scale: np.ndarray
    variance: np.ndarray
    power: np.ndarray
    flux: np.ndarray
    log_likelihood: np.ndarray
    uniform: np.ndarray
    log_evidence: float
    converged: bool
    lineage: np.ndarray | None = None


def thinned(index, weight, always, most):
    """
    Keep some of many weights, with the sums that they had.

    Weights above a level are kept. Of the others so many are taken, evenly in their order and in proportion to
    them, that those left have this level for a weight (Fearnhead & Clifford 2003, J. R. Stat. Soc. B 65, 887).

    Parameters
    ----------
    index : `~numpy.ndarray` of int, shape (n,)
        What the weights are of; neighbors should be alike.
    weight : `~numpy.ndarray`, shape (n,)
        Weights above 0.
    always : `~numpy.ndarray` of bool, shape (n,)
        Those that are kept with their own weight in any case.
    most : int
        Number to keep of the others.

    Returns
    -------
    index, weight : `~numpy.ndarray`
        Those kept; all if there are not more than ``most``.
    """
    if len(weight) <= most:
        return index, weight
    descending = np.sort(weight)[::-1]
    # the level if the k largest are kept
    below = np.cumsum(descending[::-1])[::-1]
    level = below[:most] / (most - np.arange(most))
    n_kept = int(np.argmax(descending[:most] <= level))
    level = level[n_kept]
    large = (weight > level) | always
    upto = np.cumsum(np.where(large, 0.0, weight)) / level
    steps = np.floor(upto + 0.5)
    is_taken = np.diff(steps, prepend=0.0) > 0
    chosen = large | is_taken
    return index[chosen], np.where(large, weight, level)[chosen]


def places_to_values(space, axis, place):
    """Convert places in the unit interval of an axis to cells and values: two arrays, shape (n,)."""
    n = space.size[axis]
    y = place * n
    cell = np.minimum(y.astype(np.int64), n - 1)
    low = space.low[axis, cell]
    high = space.high[axis, cell]
    return cell, low + (y - cell) * (high - low)
