"""Sets of places of a sampler: those that results rest on, their weights, and those that parts are fitted to."""

import numpy as np

from miricigale.utils.values import value_class

#: Smallest number of places that parts are fitted to.
_MIN_FITTED_PLACES = 20
#: Places with an effective number of 1 that are added to those of a mixture for its efficiency.
_N_EXPECTED = 20.0


@value_class
class WeightedPlaces:
    """
    Some of the places of a sampler with their weights, and what is wanted of them.

    Parameters
    ----------
    rows : slice
        Which places.
    weight : `~numpy.ndarray`, shape (n,)
        Weights.
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
    Places that results rest on, drawn from one mixture after the other.

    Places of each mixture are weighed by the posterior over its density alone, and mixtures in each label and peak
    by their effective numbers, so that none is drawn in vain. (Weights over the mean density of all mixtures would
    be more equal, but biased: parts are put at the places of large weight that were met, and take their weight
    away.)

    Parameters
    ----------
    parts : `~miricigale.fitting.grid.proposals.FittedParts`
        What the first ones are drawn from.
    missing : `~numpy.ndarray`, shape (n_labels * n_peaks,)
        How many are still wanted in labels and peaks, or shares.
    sampler : `AdaptiveSampler`
        Whose further places they are.
    """

    def __init__(self, parts, missing, sampler):
        self.missing = missing
        self.first = sampler.n
        self._n_groups = sampler.n_groups
        self._n_peaks = len(sampler.peaks)
        #: Densities of the parts of each peak at all places of the sampler.
        self.density = np.zeros((self._n_peaks, len(sampler.label)))
        #: Weights over numbers of the places of mixtures, ln of their units, groups, and what each group is worth.
        self._mixtures = []
        #: `WeightedPlaces` of all of them.
        self.sample = None
        #: Whether they are as many as are wanted.
        self.is_enough = False
        self.begin(parts, sampler.n)

    def begin(self, parts, first):
        """Draw further places, from number ``first`` on, from other parts."""
        #: `FittedParts` that further places are drawn from, and the first of these.
        self.parts = parts
        self.first_own = first
        self._number = np.zeros(self._n_groups)
        self._mixtures.append(None)

    def add(self, number, n):
        """Add places, of which ``number`` are of each label and peak; there is memory for ``n`` in all."""
        self._number += number
        self.density = _with_columns(self.density, n)

    @property
    def column(self):
        """Peak of each part of the mixture."""
        return self.parts.group % self._n_peaks

    @property
    def shares(self):
        """Shares of the places of the mixture that labels have in peaks: shape (n_labels, n_peaks)."""
        return (self._number / self._number.sum()).reshape(-1, self._n_peaks)

    def weigh(self, weight, log_unit, group):
        """
        Put the weights of the places of the last mixture beside those of earlier ones.

        In each label and peak mixtures count by the effective numbers that their efficiency lets expect.

        Parameters
        ----------
        weight : `~numpy.ndarray`, shape (n,)
            Weights, all 0 if none is possible.
        log_unit : float
            Ln of the posterior over the density of the mixture where the weight is 1.
        group : `~numpy.ndarray` of int, shape (n,)
            Index of label and peak of each.

        Returns
        -------
        weight : `~numpy.ndarray`, shape (n_all,)
            Weights of all places, which sum to the mean of the posterior over the density.
        log_unit : float
            Ln of their unit.
        """
        n = len(weight)
        sums = np.bincount(group, weight, minlength=self._n_groups)
        squares = np.bincount(group, weight * weight, minlength=self._n_groups)
        number = np.bincount(group, minlength=self._n_groups)
        effective = np.square(sums) / np.maximum(squares, 1e-300)
        worth = number * (effective + 1.0) / (number + _N_EXPECTED)
        self._mixtures[-1] = (weight / n, log_unit, group, worth)
        if len(self._mixtures) == 1:
            return weight / n, log_unit
        worth = np.array([mixture[3] for mixture in self._mixtures])
        worth /= np.maximum(worth.sum(axis=0), 1e-300)
        highest = max(mixture[1] for mixture in self._mixtures)
        weights = []
        for mixture, mixture_worth in zip(self._mixtures, worth, strict=True):
            own, own_unit, own_group, _ = mixture
            weights.append(own * mixture_worth[own_group] * np.exp(max(own_unit - highest, -700.0)))
        return np.concatenate(weights), highest


def _with_columns(table, n):
    """Return a table with n columns, of which those that it does not have are 0."""
    n_rows, n_columns = table.shape
    if n_columns >= n:
        return table
    larger = np.zeros((n_rows, n))
    larger[:, :n_columns] = table
    return larger


def fitted_peaks(number):
    """
    Select the peaks that parts are fitted to.

    Parameters
    ----------
    number : `~numpy.ndarray` of int, shape (n_peaks,)
        Number of places of each.

    Returns
    -------
    peaks : `~numpy.ndarray` of int
        Those that have places enough to show a shape. If there are none, those with any place, whose parts have
        the shape of all places.
    """
    peaks = np.flatnonzero(number >= _MIN_FITTED_PLACES)
    if peaks.size:
        return peaks
    return np.flatnonzero(number)
