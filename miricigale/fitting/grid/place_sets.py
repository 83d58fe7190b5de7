"""Sets of places of a sampler: those that results rest on, their weights, and those that parts are fitted to."""

import numpy as np

from miricigale.utils.values import value_class

#: Smallest number of places that parts are fitted to.
_MIN_FITTED_PLACES = 20


@value_class
class WeightedPlaces:
    """
    Some of the places of a sampler with their weights, and what is wanted of them.

    Parameters
    ----------
    rows : slice
        Which places.
    weight : `~numpy.ndarray`, shape (n,)
        Weights, the largest of which is 1.
    log_mean : float
        Ln of the mean of the posterior over the density of the proposal.
    effective : float
        Effective number of the weights.
    enough : bool
        Whether it is, in all and in each label, peak and component that counts.
    wanted : `~numpy.ndarray`, shape (n_labels * n_peaks,)
        Numbers of places wanted in labels and peaks.
    """

    rows: slice
    weight: np.ndarray
    log_mean: float
    effective: float
    enough: bool
    wanted: np.ndarray


class Collection:
    """
    Places that results rest on.

    Parameters
    ----------
    parts : `~miricigale.fitting.grid.proposals.FittedParts`
        What they are drawn from.
    missing : `~numpy.ndarray`, shape (n_labels * n_peaks,)
        How many are still wanted in labels and peaks, or shares.
    sampler : `AdaptiveSampler`
        Whose further places they are.
    """

    def __init__(self, parts, missing, sampler):
        self.parts = parts
        self.missing = missing
        self.first = sampler.n
        #: How many were drawn from each label and peak.
        self.total = np.zeros(sampler.n_groups)
        #: Densities of the parts of each peak at all places of the sampler.
        self.density = np.zeros((len(sampler.peaks), len(sampler.label)))
        #: `WeightedPlaces` of all of them.
        self.sample = None
        #: Whether they are as many as are wanted.
        self.is_enough = False


def fitted_groups(is_wanted, number):
    """
    Select the groups of places, such as labels in peaks, that parts are fitted to.

    Parameters
    ----------
    is_wanted : `~numpy.ndarray` of bool, shape (n_groups,)
        Groups that have weight, or that are pursued whatever their weight.
    number : `~numpy.ndarray` of int, shape (n_groups,)
        Number of places of each.

    Returns
    -------
    groups : `~numpy.ndarray` of int
        Those that are wanted and have places enough to show a shape. If there are none, the wanted ones with any
        place, whose parts have the shape of all places, and the others that show one.
    """
    has_shape = number >= _MIN_FITTED_PLACES
    if np.any(is_wanted & has_shape):
        return np.flatnonzero(is_wanted & has_shape)
    return np.flatnonzero((is_wanted | has_shape) & (number > 0))
