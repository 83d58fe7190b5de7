"""Which galaxies of a field have an AGN, by published luminosity and mass functions."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from scipy.special import ndtr

from miricigale.sed import stern2015_6um
from miricigale.utils.arrays import middles, nans, quiet_division
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts, declared
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import described_columns, require_columns, unique_ids
from miricigale.utils.units import LUMINOSITY, MASS, positive, to_array

_DENSITY = u.Mpc**-3 / u.dex

_TABLES = declared("miricigale.evaluation", "population.toml")
#: Luminosity function of Ueda et al. 2014.
_LDDE = _TABLES["ldde"]
#: Obscured fraction of Ueda et al. 2014: at 10^43.75 erg/s and z = 0, evolution, slope, limits, z.
_PSI = {"at": 0.43, "evolution": 0.48, "slope": 0.24, "low": 0.2, "high": 2.7 / 4.7, "until": 2.0}

#: Edges of redshift, and pairs of Schechter functions between them, of Davidzon et al. 2017.
_SMF_EDGES = np.array(_TABLES["schechter"]["edges"])
_SMF = np.array(_TABLES["schechter"]["rows"])

#: Aird et al. 2013: slopes of the probability in specific accretion rate below and above the Eddington
#: limit, and scatter of the black hole's mass in dex.
_SLOPES = (-0.65, -2.1)
_SCATTER = 0.38
#: L_X in erg/s for each solar mass of stars at the Eddington limit: 1.3e38 erg/s, a black hole of 0.002
#: of the stars, bolometric luminosity 25 times that of 2-10 keV (Aird et al. 2018, from memory).
_EDDINGTON = np.log10(1.3e38 * 0.002 / 25.0)

_LOG_MASS = np.arange(9.0, 12.6, 0.05)
_LOG_L_MAX = 46.5
_STEP = 0.05
_ROWS = 4096  # computed together


def xray_luminosity_function(l_x, redshift):
    """
    Return the luminosity function of Compton-thin AGN.

    Parameters
    ----------
    l_x : `~astropy.units.Quantity`
        Rest-frame 2-10 keV luminosity, corrected for absorption.
    redshift : float or `~numpy.ndarray`
        Redshifts; broadcast with ``l_x``.

    Returns
    -------
    density : `~astropy.units.Quantity`
        Comoving number density in 1 / Mpc3 / dex (log N_H < 24 alone).

    Raises
    ------
    `~astropy.units.UnitsError`
        If ``l_x`` is no luminosity.

    References
    ----------
    Ueda et al. 2014, ApJ 786, 104, section 6 and table 4: luminosity-dependent density evolution,
    for redshifts to 5.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import xray_luminosity_function
    >>> print(f"{xray_luminosity_function(1e43 * u.erg / u.s, 1.0):.2e}")
    1.25e-04 1 / (dex Mpc3)
    """
    return _xlf(_log_luminosity(l_x), _redshift(redshift)) * _DENSITY


def xray_obscured_fraction(l_x, redshift):
    """
    Share of obscured (log N_H > 22) among Compton-thin AGN.

    Parameters
    ----------
    l_x, redshift
        As for `xray_luminosity_function`.

    Returns
    -------
    fraction : float or `~numpy.ndarray`
        From 0.2 to 0.57. There are as many Compton-thick AGN (log N_H 24 to 26) as obscured
        Compton-thin ones.

    References
    ----------
    Ueda et al. 2014, ApJ 786, 104, section 3.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import xray_obscured_fraction
    >>> print(xray_obscured_fraction([1e42, 1e44, 1e45] * u.erg / u.s, 1.0).round(2))
    [0.57 0.54 0.3 ]
    """
    return _psi(_log_luminosity(l_x), _redshift(redshift))


def galaxy_mass_function(stellar_mass, redshift):
    """
    Return the stellar mass function of all galaxies.

    Parameters
    ----------
    stellar_mass : `~astropy.units.Quantity`
        Stellar mass (Chabrier IMF).
    redshift : float or `~numpy.ndarray`
        Redshifts; broadcast with ``stellar_mass``.

    Returns
    -------
    density : `~astropy.units.Quantity`
        Comoving number density in 1 / Mpc3 / dex: the logarithm is interpolated between the
        middles of the redshift bins, and constant below z = 0.35 and above 5.

    References
    ----------
    Davidzon et al. 2017, A&A 605, A70, table 1.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import galaxy_mass_function
    >>> print(f"{galaxy_mass_function(1e10 * u.Msun, 1.0):.2e}")
    4.10e-03 1 / (dex Mpc3)
    """
    log_mass = np.log10(to_array(stellar_mass, MASS, "stellar_mass"))
    z = _redshift(redshift)
    density = _smf(log_mass, np.where(np.isnan(z), 1.0, z))
    return np.where(np.isnan(z), np.nan, density)[()] * _DENSITY


def agn_fraction(l_6um, reference):
    """
    Return the AGN fraction that gives an AGN a luminosity at 6 um.

    The AGN's power goes as f / (1 - f), in either definition of ``frac_agn``.

    Parameters
    ----------
    l_6um : `~astropy.units.Quantity`
        nu L_nu at 6 um that the AGN shall have.
    reference : `~astropy.units.Quantity`
        ``l_6um`` of the same row by `~miricigale.sed.SEDModel.fluxes` with ``frac_agn`` 0.5.

    Returns
    -------
    frac_agn : `~numpy.ndarray`
        From 0; NaN where ``reference`` is not positive (no dust luminosity to refer to) and the
        AGN shall have a luminosity.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import agn_fraction
    >>> agn_fraction([0, 1, 3] * u.Lsun, 1 * u.Lsun).tolist()
    [0.0, 0.5, 0.75]
    """
    wanted = to_array(l_6um, LUMINOSITY, "l_6um")
    half = to_array(reference, LUMINOSITY, "reference")
    with quiet_division():
        fraction = np.where(half > 0, wanted / (wanted + half), np.nan)
    return np.where(wanted == 0, 0.0, fraction)


@dataclass(frozen=True)
class AGNPopulation:
    """
    Which galaxies have an AGN, and of what luminosity.

    The luminosity function of Ueda et al. 2014 is shared out among the galaxies of the mass function
    of Davidzon et al. 2017: at a given luminosity, a galaxy's chance goes as the probability of its
    specific accretion rate, a power law that breaks at the Eddington limit, with scatter in the black
    hole's mass (Aird et al. 2013). Summed over the mass function the AGN are those of the luminosity
    function. The chance depends on mass and redshift, not on star formation.

    Parameters
    ----------
    min_luminosity : `~astropy.units.Quantity`, optional
        Least 2-10 keV luminosity of an AGN.
    compton_thick : float, optional
        Compton-thick AGN for each obscured Compton-thin one; 1 in Ueda et al. 2014, 0 leaves them
        out.

    Raises
    ------
    ValueError
        If the luminosity is outside 1e41 to 1e46 erg/s, or the ratio negative.

    Notes
    -----
    All hosts have 10^9 solar masses or more, an assumption: galaxies below have no AGN. Above
    z = 5 the functions are extrapolated.

    References
    ----------
    Ueda et al. 2014, ApJ 786, 104; Davidzon et al. 2017, A&A 605, A70; Aird et al. 2013, ApJ
    775, 41.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import AGNPopulation
    >>> chance = AGNPopulation().probability([1e9, 1e10, 1e11] * u.Msun, 1.0)
    >>> print(chance.round(3))
    [0.008 0.043 0.194]
    """

    min_luminosity: u.Quantity = 1e42 * u.erg / u.s
    compton_thick: float = 1.0

    def __post_init__(self):
        min_luminosity = positive(self.min_luminosity, u.erg / u.s, "min_luminosity")
        wanted = "from 1e41 to 1e46 erg/s"
        check_that(1e41 <= min_luminosity <= 1e46, "min_luminosity", wanted, self.min_luminosity)
        check_that(self.compton_thick >= 0, "compton_thick", ">= 0", self.compton_thick)

    @property
    def _log_l(self):
        """Logarithms of luminosities, from the least."""
        log_minimum = np.log10(self.min_luminosity.to_value(u.erg / u.s))
        return np.linspace(
            log_minimum, _LOG_L_MAX, int(np.ceil((_LOG_L_MAX - log_minimum) / _STEP)) + 1
        )

    def density(self, stellar_mass, redshift, l_x):
        """
        Return the probability in log luminosity that a galaxy has an AGN.

        Parameters
        ----------
        stellar_mass : `~astropy.units.Quantity`, shape (n,)
            Stellar masses; not a number and below 10^9 solar masses is 0.
        redshift : float or `~numpy.ndarray`, shape (n,)
            Redshifts.
        l_x : `~astropy.units.Quantity`, shape (m,)
            2-10 keV luminosities.

        Returns
        -------
        density : `~numpy.ndarray`, shape (n, m)
            Per dex.
        """
        log_mass, redshift = _galaxies(stellar_mass, redshift)
        return self._density(log_mass, redshift, np.atleast_1d(_log_luminosity(l_x)))

    def _density(self, log_mass, redshift, log_l):
        agn = _xlf(log_l, redshift[:, None])
        agn *= 1.0 + self.compton_thick * _psi(log_l, redshift[:, None])
        hosts = _smf(_LOG_MASS, redshift[:, None])
        weights = np.full(_LOG_MASS.size, _LOG_MASS[1] - _LOG_MASS[0])
        weights[[0, -1]] /= 2.0
        density = hosts @ (weights[:, None] * _accretion(log_l - _LOG_MASS[:, None]))
        out = agn / density * _accretion(log_l - log_mass[:, None])
        out[~(log_mass >= _LOG_MASS[0])] = 0.0
        return out

    def _cumulative(self, log_mass, redshift):
        """Return the probabilities of an AGN of at least each luminosity of the grid; 1 at most."""
        log_l = self._log_l
        density = self._density(log_mass, redshift, log_l)
        parts = 0.5 * (density[:, 1:] + density[:, :-1]) * np.diff(log_l)
        above = np.zeros_like(density)
        above[:, :-1] = np.cumsum(parts[:, ::-1], axis=1)[:, ::-1]
        return np.minimum(above, 1.0)

    def probability(self, stellar_mass, redshift):
        """
        Return the probability that a galaxy has an AGN of at least the least luminosity.

        Parameters
        ----------
        stellar_mass : `~astropy.units.Quantity`, shape (n,)
            Stellar masses.
        redshift : float or `~numpy.ndarray`, shape (n,)
            Redshifts.

        Returns
        -------
        probability : `~numpy.ndarray`, shape (n,)
        """
        return self._cumulative(*_galaxies(stellar_mass, redshift))[:, 0]

    def draw(self, table, *, seed):
        """
        Draw the AGN of the galaxies of a table.

        Parameters
        ----------
        table : `~astropy.table.Table`
            With ``id``, ``redshift`` and ``stellar_mass``; rows whose mass or redshift is no
            positive number (stars) have no AGN.
        seed : int, `~numpy.random.Generator` or None
            Each source has its own stream by its id: the AGN of a source depends neither on the other
            rows, nor, above its luminosity, on the least one.

        Returns
        -------
        agn : `~astropy.table.QTable`
            A row for each of ``table``: ``id``; ``probability``; ``has_agn``; ``l_2_10kev`` and
            ``l_6um`` (Stern 2015) in W, 0 without an AGN; ``obscured`` (log N_H > 22) and
            ``compton_thick``.

        Raises
        ------
        ValueError, `~astropy.units.UnitsError`
            If a column is missing or has a wrong unit, or an id is there twice.
        """
        names = ("id", "redshift", "stellar_mass")
        require_columns(table, names, "table", units={"stellar_mass": MASS})
        ids = unique_ids(table["id"], "table")
        log_mass, redshift = _galaxies(table["stellar_mass"], table["redshift"])
        seed = check_seed(seed)
        drawn = [stream(seed, "agn", str(key)).uniform(size=2) for key in ids]
        drawn = np.reshape(drawn, (len(ids), 2))
        probability = np.zeros(len(ids))
        log_l = nans(len(ids))
        grid = self._log_l
        for first in range(0, len(ids), _ROWS):
            part = slice(first, first + _ROWS)
            above = self._cumulative(log_mass[part], redshift[part])
            probability[part] = above[:, 0]
            for row in np.flatnonzero(drawn[part, 0] < above[:, 0]):
                log_l[first + row] = np.interp(drawn[first + row, 0], above[row, ::-1], grid[::-1])
        has_agn = np.isfinite(log_l)
        psi = _psi(np.where(has_agn, log_l, 44.0), redshift)
        thick = self.compton_thick * psi / (1.0 + self.compton_thick * psi)
        hidden = thick + psi / (1.0 + self.compton_thick * psi)
        l_x = np.where(has_agn, 10.0 ** np.where(has_agn, log_l, 0.0), 0.0) * u.erg / u.s
        columns = {
            "id": ids,
            "probability": probability,
            "has_agn": has_agn,
            "l_2_10kev": l_x.to(LUMINOSITY),
            "l_6um": stern2015_6um(l_x),
            "obscured": has_agn & (drawn[:, 1] < hidden),
            "compton_thick": has_agn & (drawn[:, 1] < thick),
        }
        return described_columns(columns, column_texts("miricigale.evaluation", "agn"))


def _log_luminosity(l_x):
    with quiet_division():
        return np.log10(to_array(l_x, u.erg / u.s, "l_x"))


def _redshift(redshift):
    return to_array(redshift, u.dimensionless_unscaled, "redshift")


def _galaxies(stellar_mass, redshift):
    """Log masses, NaN for what is no galaxy, and redshifts, 0 there: arrays of one shape (n,)."""
    mass = np.ma.filled(to_array(stellar_mass, MASS, "stellar_mass"), np.nan)
    mass, redshift = np.broadcast_arrays(np.atleast_1d(mass), np.atleast_1d(_redshift(redshift)))
    good = (mass > 0) & np.isfinite(mass) & (redshift > 0) & np.isfinite(redshift)
    log_mass = np.where(good, np.log10(np.where(good, mass, 1.0)), np.nan)
    return log_mass, np.where(good, redshift, 0.0)


def _xlf(log_l, z):
    """Return the luminosity function in Mpc^-3 dex^-1."""
    c = _LDDE
    z1 = c["z1"] * 10.0 ** (c["alpha1"] * np.minimum(log_l - c["la1"], 0.0))
    z2 = c["z2"] * 10.0 ** (c["alpha2"] * np.minimum(log_l - c["la2"], 0.0))
    p1 = c["p1"] + c["beta1"] * (log_l - c["pivot"])
    # (1 + z)^p1 to z1, then ^p2 to z2, then ^p3
    evolution = (1.0 + np.minimum(z, z1)) ** p1
    evolution *= (np.clip(1.0 + z, 1.0 + z1, 1.0 + z2) / (1.0 + z1)) ** c["p2"]
    evolution *= np.maximum((1.0 + z) / (1.0 + z2), 1.0) ** c["p3"]
    x = log_l - c["break"]
    return c["A"] / (10.0 ** (c["gamma1"] * x) + 10.0 ** (c["gamma2"] * x)) * evolution


def _psi(log_l, z):
    """Return the obscured share of Compton-thin AGN."""
    c = _PSI
    middle = c["at"] * (1.0 + np.minimum(z, c["until"])) ** c["evolution"]
    return np.clip(middle - c["slope"] * (log_l - 43.75), c["low"], c["high"])


def _smf(log_mass, z):
    """Return the mass function in Mpc^-3 dex^-1."""
    redshifts = middles(_SMF_EDGES)
    place = np.interp(z, redshifts, np.arange(redshifts.size))
    low = np.minimum(place.astype(int), redshifts.size - 2)
    part = place - low
    low_density = _log_schechter(log_mass, low)
    high_density = _log_schechter(log_mass, low + 1)
    return np.exp((1.0 - part) * low_density + part * high_density)


def _log_schechter(log_mass, row):
    """Return the natural log of the mass function of a redshift bin."""
    star, slope1, phi1, slope2, phi2 = np.moveaxis(_SMF[row], -1, 0)
    x = 10.0 ** (log_mass - star)
    return np.log(np.log(10.0) * 1e-3 * x * (phi1 * x**slope1 + phi2 * x**slope2)) - x


def _accretion(log_l_over_mass):
    """
    Return the probability of a specific accretion rate, on an arbitrary scale.

    A power law with a break at the Eddington limit, and a Gaussian in the log of the black hole's
    mass, integrated in closed form.
    """
    x = log_l_over_mass - _EDDINGTON
    out = 0.0
    for slope, side in zip(_SLOPES, (-1.0, 1.0), strict=True):
        shift = slope * np.log(10.0) * _SCATTER**2
        scale = np.exp(0.5 * (slope * np.log(10.0) * _SCATTER) ** 2)
        out = out + scale * 10.0 ** (slope * x) * ndtr(side * (x + shift) / _SCATTER)
    return out
