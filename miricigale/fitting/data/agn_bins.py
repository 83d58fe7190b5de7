"""Joint posteriors of redshift, AGN fraction and AGN luminosity, in bins."""

import itertools
from dataclasses import dataclass

import numpy as np

from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.units import LUMINOSITY, is_ascending

#: Log10 of luminosities in erg/s that edges may have: from below that of the Sun to above that of all galaxies.
_LOG_LUMINOSITY = (30.0, 60.0)
#: erg/s in the unit of luminosities.
_ERG_PER_S = LUMINOSITY.to("erg / s")


@dataclass(frozen=True)
class AGNBins:
    """
    Bins of redshift, AGN fraction and AGN luminosity, for ``agn_bins`` of `GridSettings`.

    Parameters
    ----------
    redshift : tuple of float
        Ascending edges of bins of redshift, n_z of them. What lies outside all bins has another one, the last.
    log_luminosity : tuple of float
        Ascending edges: log10 of the luminosity in erg/s. The first bin is that of AGN below the first edge, and
        the last one has no upper end: as many bins as edges, and one.
    frac_agn : tuple of float, optional
        Ascending edges of bins of the AGN fraction, from 0 to 1. Besides, the first bin is that of no AGN.
    quantity : str, optional
        Derived quantity of the models that is the luminosity: by default that of the accretion disk over all
        directions, which does not depend on the angle at which the AGN is seen.

    Raises
    ------
    ValueError
        If edges do not ascend, a redshift is negative, an edge of luminosity is no logarithm of one in erg/s (30
        to 60), or those of the fraction do not reach from 0 to 1.

    Examples
    --------
    >>> from miricigale.fitting import AGNBins
    >>> AGNBins(redshift=(0.0, 1.0, 2.0), log_luminosity=(43.0, 44.0, 45.0)).shape
    (3, 7, 4)
    """

    redshift: tuple
    log_luminosity: tuple
    frac_agn: tuple = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
    quantity: str = "accretion_power"

    def __post_init__(self):
        min_edges = {"redshift": 2, "log_luminosity": 1, "frac_agn": 2}
        for name, n_least in min_edges.items():
            wanted = f"{n_least} or more ascending edges"
            value = getattr(self, name)
            try:
                edges = floats(value)
            except (TypeError, ValueError):
                raise argument_error(name, wanted, repr(value)) from None
            check_that(is_ascending(edges, n_least), name, wanted, value)
            check_that(np.all(np.isfinite(edges)), name, "finite edges", value)
            object.__setattr__(self, name, tuple(edges.tolist()))
        check_that(self.redshift[0] >= 0, "redshift", "edges of 0 or more", self.redshift)
        low, high = _LOG_LUMINOSITY
        if self.log_luminosity[0] < low or self.log_luminosity[-1] > high:
            wanted = f"log10 of luminosities in erg/s, from {low:g} to {high:g}"
            raise argument_error("log_luminosity", wanted, f"{self.log_luminosity}")
        good = self.frac_agn[0] == 0 and self.frac_agn[-1] == 1
        check_that(good, "frac_agn", "edges from 0 to 1", self.frac_agn)

    @property
    def shape(self):
        """Numbers of bins of redshift, AGN fraction and luminosity."""
        return len(self.redshift), len(self.frac_agn), len(self.log_luminosity) + 1

    def place(self, redshift, frac_agn, luminosity):
        """
        Find the bins of models.

        Parameters
        ----------
        redshift, frac_agn, luminosity : `~numpy.ndarray`, shape (n,)
            Their values; the luminosity in erg/s.

        Returns
        -------
        place : tuple of `~numpy.ndarray` of int, shape (n,)
            Bin of each axis. Without an AGN the luminosity is in the first.
        """
        redshift = floats(redshift)
        frac_agn = floats(frac_agn)
        luminosity = floats(luminosity)
        n_z = len(self.redshift) - 1
        z_bin = np.searchsorted(self.redshift, redshift, side="right") - 1
        z_bin = np.where((z_bin < 0) | (z_bin >= n_z), n_z, z_bin)
        frac_bin = np.searchsorted(self.frac_agn[1:-1], frac_agn, side="right") + 1
        frac_bin = np.where(frac_agn > 0, frac_bin, 0)
        with quiet_division():
            log_l = np.log10(luminosity)
        l_bin = np.searchsorted(self.log_luminosity, log_l, side="right")
        l_bin = np.where(np.isfinite(log_l) & (frac_bin > 0), l_bin, 0)
        return z_bin, frac_bin, l_bin

    def __call__(self, posterior):
        """Sum the weights of a `~miricigale.fitting.grid.continuation.BetweenPosterior` in bins, of `shape`."""
        # models without AGN have no such quantity
        none = np.zeros(posterior.weight.size)
        luminosity = posterior.derived.get(self.quantity, none)
        values = posterior.values
        place = self.place(values["redshift"], values["frac_agn"], luminosity * _ERG_PER_S)
        flat = np.ravel_multi_index(place, self.shape)
        return np.bincount(flat, posterior.weight, np.prod(self.shape)).reshape(self.shape)

    def prior(self, axis):
        """
        Compute the prior of the bins of the AGN fraction.

        Parameters
        ----------
        axis : `~miricigale.fitting.posterior.priors.GridAxis`
            AGN fractions of a fit between nodes, with their prior: flat within each cell.

        Returns
        -------
        weights : `~numpy.ndarray`, shape (n_fractions,)
            They sum to 1.
        """
        low, high = np.clip(axis.cells(), axis.values[0], axis.values[-1])
        weights = np.zeros(len(self.frac_agn))
        for first, last, weight in zip(low, high, axis.weights, strict=True):
            if last == first:
                weights[0 if first == 0 else self.place([0.0], first, [1.0])[1]] += weight
                continue
            for j, (begin, end) in enumerate(itertools.pairwise(self.frac_agn), start=1):
                inside = max(min(end, last) - max(begin, first), 0.0)
                weights[j] += weight * inside / (last - first)
        return weights
