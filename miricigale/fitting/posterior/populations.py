"""Priors of what galaxies are like: black holes that grow, numbers by mass and redshift, rates given mass."""

from dataclasses import dataclass
from functools import partial

import astropy.units as u
import numpy as np

from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.fitting.posterior.quantities import column_values
from miricigale.sed.cosmology import COSMOLOGY
from miricigale.utils.arrays import middles
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.units import MASS, are_not_negative, is_ascending, is_number, to_array
from miricigale.utils.values import value_class

#: Part of the galaxies whose specific accretion rate lambda is above 0.01.
_ACTIVE_PART = 0.1
#: Solar luminosities of dust for each solar mass of stars.
_DUST_PER_MASS = 10.0
#: Solar luminosities at the Eddington limit for each solar mass of a black hole.
_EDDINGTON_PER_MASS = 3.3e4
#: Solar masses of stars for each solar mass of a black hole.
_STARS_PER_HOLE = 500.0
#: Median redshift of little red dots.
_RED_DOT_REDSHIFT = 5.5
#: Width of their distribution in ln(1 + z).
_RED_DOT_WIDTH = 0.25


def agn_fraction_prior(frac_agn):
    """
    Compute a prior of AGN fractions from how fast black holes grow, for ``priors`` of `BayesFitter`.

    The specific accretion rate lambda (L_bol over 1.26e38 erg/s for each 500 solar masses of stars) is taken to
    exceed 0.01 in a tenth of the galaxies, with a number for each dex that falls as lambda^-0.5, and
    exponentially above 1: simplified from what Aird et al. 2018 (MNRAS 474, 1225) find in X-rays for
    star-forming galaxies of 10^10 to 10^11 solar masses. Half of the light is taken up by dust, beside 10 solar
    luminosities of dust for each solar mass of stars, those of star formation in 1 Gyr. What is fainter has the
    fraction 0.

    Parameters
    ----------
    frac_agn : array_like, shape (n,)
        Ascending fractions of a grid, the first 0.

    Returns
    -------
    weights : `~numpy.ndarray`, shape (n,)
        Prior weight of the cell of each fraction; they sum to 1.

    Examples
    --------
    >>> from miricigale.fitting import agn_fraction_prior
    >>> agn_fraction_prior([0.0, 0.1, 0.3, 0.6, 0.9]).round(4)
    array([0.9247, 0.0497, 0.017 , 0.0073, 0.0013])
    """
    frac = floats(frac_agn)
    good = is_ascending(frac, min_size=2) and frac[0] == 0
    check_that(good, "frac_agn", "ascending values from 0", frac_agn)
    edges = cell_edges(frac, (0.0, 1.0))[1:-1]
    log = np.linspace(-2.0, 2.0, 4001)
    # number for each dex of lambda, and the part of it above each lambda
    number = 10.0 ** (-0.5 * log) * np.exp(-(10.0**log))
    steps = middles(number)
    above = 1.0 - np.concatenate([[0.0], np.cumsum(steps)]) / np.sum(steps)
    # lambda at which half of the AGN's light over that plus the dust of stars is the fraction of each edge
    rate = edges / (1.0 - edges) * _DUST_PER_MASS / (0.5 * _EDDINGTON_PER_MASS / _STARS_PER_HOLE)
    exceeding = _ACTIVE_PART * np.interp(np.log10(rate), log, above)
    return -np.diff(np.concatenate([[1.0], exceeding, [0.0]]))


def red_dot_prior(redshift):
    """
    Compute a prior of the redshifts of little red dots, for ``priors`` of `BayesFitter`.

    Log-normal in 1 + z about z = 5.5 with a width of 0.25: 16 and 84 % lie below 4.1 and 7.3. Surveys find few of
    them at z < 4 and at z > 8. Of 260 selected by photometry (Kokorev et al. 2024, arXiv:2401.09981) 16, 50 and
    84 % have photometric redshifts below 4.6, 5.6 and 7.1; of 116 with spectra (de Graaff et al. 2025,
    arXiv:2511.21820) spectroscopic ones below 3.7, 5.0 and 6.7. Three or four bands with signal leave much of the
    range open, and then the prior counts.

    Parameters
    ----------
    redshift : array_like, shape (n,)
        Ascending redshifts of a grid.

    Returns
    -------
    weights : `~numpy.ndarray`, shape (n,)
        Prior weight of the cell of each redshift; they sum to 1.

    Raises
    ------
    ValueError
        If there are fewer than two, or they do not ascend from 0 or more.

    Examples
    --------
    >>> from miricigale.fitting import red_dot_prior
    >>> red_dot_prior([2.0, 4.0, 6.0, 8.0, 10.0]).round(2)
    array([0.01, 0.38, 0.43, 0.15, 0.03])
    """
    z = floats(redshift)
    good = is_ascending(z, min_size=2) and z[0] >= 0
    check_that(good, "redshift", "two or more, ascending from 0 or more", redshift)
    deviation = (np.log1p(z) - np.log1p(_RED_DOT_REDSHIFT)) / _RED_DOT_WIDTH
    # density in ln(1 + z) times the widths of the cells
    weights = np.exp(-0.5 * deviation**2) * np.diff(cell_edges(np.log1p(z)))
    return weights / weights.sum()


@dataclass(frozen=True)
class MassFunction:
    """
    Number density of galaxies by stellar mass and redshift, for ``mass_function`` of `GridSettings`.

    (M / M*)^(alpha + 1) exp(-M / M*) (1 + z)^evolution for each dex of mass and comoving volume (Schechter 1976,
    ApJ 203, 297), with any factor. The defaults are of a prior that is flat in log mass below M*; M* and the power
    of (1 + z) are those of fewest outliers among a few that were tried on CEERS sources.

    Parameters
    ----------
    log_mass : float, optional
        log10 of M* in solar masses.
    alpha : float, optional
        Slope at low mass.
    evolution : float, optional
        Power of (1 + z) of the density.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.fitting import MassFunction
    >>> MassFunction()([1e9, 1e11] * u.Msun, 1.0).round(3)
    array([0.492, 0.102])
    """

    log_mass: float = 10.8
    alpha: float = -1.0
    evolution: float = -1.0

    def __call__(self, mass, redshift):
        """Evaluate the density at masses (`~astropy.units.Quantity`) and redshifts, which broadcast."""
        x = to_array(mass, MASS, "mass") / 10.0**self.log_mass
        return x ** (self.alpha + 1.0) * np.exp(-x) * (1.0 + np.asarray(redshift)) ** self.evolution


@value_class
class MassPrior:
    """Prior of mass and redshift as the kernels take it: see `~miricigale.fitting._core.weigh_masses`."""

    #: Values of the table for a factor of ten in mass.
    per_dex = 100.0
    #: log10 of the largest mass of the table, in solar masses.
    last = 16.0

    mass_function: object
    table: np.ndarray
    log_stars: np.ndarray

    @classmethod
    def of_grid(cls, mass_function, grid):
        """Tabulate ln of a density times the comoving volume in the cell of each redshift; None without one."""
        if mass_function is None:
            return None
        wanted = "a function of stellar mass and redshift, such as MassFunction()"
        check_that(callable(mass_function), "mass_function", wanted, repr(mass_function))
        redshift = grid.redshift
        stars = column_values(grid.galaxy_properties["stellar_mass"])
        mass = 10.0 ** (np.arange(cls.last * cls.per_dex + 1) / cls.per_dex)
        density = mass_function(mass * MASS, redshift[:, None])
        density = to_array(density, u.dimensionless_unscaled, "mass_function")
        wanted = "densities of 0 or more and finite"
        check_that(are_not_negative(density), "mass_function", wanted, "others")
        if redshift.size > 1:
            cells = np.diff(cell_edges(redshift, (0.0, np.inf)))
        else:
            cells = np.ones(1)
        volume = COSMOLOGY.differential_comoving_volume(redshift).value * cells
        # ln of the number in each cell, for each dex of mass
        table = np.log(np.maximum(density, 1e-300)) + np.log(volume)[:, None]
        return cls(mass_function, np.ascontiguousarray(table), np.log10(np.maximum(stars, 1e-290)))


def sfr_log_prior(sfr_prior, grid):
    """
    Make the prior of star-formation rates given mass and redshift of `~miricigale.fitting.grid.grid.GridEngine`.

    ``sfr_prior`` is that of `~miricigale.fitting.GridSettings`: a relation and its scatter, or None. Anything
    else is a `ValueError`.
    """
    if sfr_prior is None:
        return None
    pair = isinstance(sfr_prior, tuple) and len(sfr_prior) == 2
    relation = None
    scatter = None
    if pair:
        relation, scatter = sfr_prior
    wanted = "a function of stellar mass and redshift, and a scatter in dex above 0"
    good = callable(relation) and is_number(scatter) and scatter > 0
    check_that(good, "sfr_prior", wanted, repr(sfr_prior))
    rate = grid.galaxy_properties["sfr_100myr"].to_value(u.Msun / u.yr / MASS)
    stars = column_values(grid.galaxy_properties["stellar_mass"])
    return partial(_log_normal_sfr, relation, float(scatter), grid.redshift[:, None], stars, rate)


def expected_sfr(relation, mass, redshift):
    """Evaluate a relation: rates in Msun/yr; a `ValueError` where they are not positive and finite."""
    rate = to_array(relation(mass, redshift), u.Msun / u.yr, "sfr_prior")
    bad = ~((rate > 0) & np.isfinite(rate))
    if np.any(bad):
        # a rate of 0 would give all galaxies a prior of 0
        arrays = np.broadcast_arrays(rate, mass.to_value(MASS), redshift)
        value, mass, z = (array[bad][0] for array in arrays)
        got = f"{value:g} Msun/yr at {mass:.3g} Msun and redshift {z:g}"
        raise argument_error("sfr_prior", "a relation to rates above 0 and finite", got)
    return rate


def _log_normal_sfr(relation, scatter, redshift, stars, rate, formed, rows):
    expected = expected_sfr(relation, formed * stars * MASS, redshift[rows])
    with np.errstate(divide="ignore"):
        log_ratio = np.log10(formed * rate / expected)
    # log-normal about the relation, scatter in dex
    return -0.5 * np.square(log_ratio / scatter)
