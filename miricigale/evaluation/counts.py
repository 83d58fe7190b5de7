"""Published relations to compare simulated samples with."""

import astropy.units as u
import numpy as np

from miricigale.sed import COSMOLOGY
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import convert_values
from miricigale.utils.options import check_names, check_that
from miricigale.utils.package_tables import column_texts, declared
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import described_columns, require_columns, unique_ids
from miricigale.utils.units import (
    FNU,
    LUMINOSITY,
    MASS,
    ab_magnitude,
    is_ascending,
    positive,
    to_array,
)

_TABLES = declared("miricigale.evaluation", "population.toml")
#: Light of galaxies together in nW / m2 / sr: band, wavelength (um), least flux (uJy), value,
#: errors down and up, reference.
PUBLISHED_LIGHT = tuple(map(tuple, _TABLES["light"]["rows"]))
#: Dust of galaxies of CEERS by dust component: log10 of its luminosity over the stellar mass (solar units) at
#: 10^10.3 Msun and 10^-9.3 / yr, slope per dex of mass between 10^8.5 and 10^10.3 Msun, slope per dex of specific
#: star-formation rate (100 Myr) between 10^-12 and 10^-8 / yr, scatter in dex; of quiescent galaxies mean and
#: scatter of log10 of ``dust_excess``; strength of the 3.3 um feature; sources. By benchmarks/dust_colors.py.
CEERS_DUST = convert_values(tuple, _TABLES["ceers_dust"])


def main_sequence_sfr(stellar_mass, age_of_universe):
    """
    Return the star-formation rate of the main sequence.

    Parameters
    ----------
    stellar_mass : `~astropy.units.Quantity`
        Stellar mass (Kroupa IMF).
    age_of_universe : `~astropy.units.Quantity`
        Age of the universe at the galaxy's redshift.

    Returns
    -------
    sfr : `~astropy.units.Quantity`
        In Msun / yr; the intrinsic scatter of the relation is 0.2 dex.

    References
    ----------
    Speagle et al. 2014, ApJS 214, 15, equation 28.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import main_sequence_sfr
    >>> print(f"{main_sequence_sfr(3e10 * u.Msun, 5.9 * u.Gyr):.0f}")
    22 solMass / yr
    """
    log_mass = np.log10(to_array(stellar_mass, u.Msun, "stellar_mass"))
    age = to_array(age_of_universe, u.Gyr, "age_of_universe")
    return 10 ** ((0.84 - 0.026 * age) * log_mass - (6.51 - 0.11 * age)) * u.Msun / u.yr


def sfr_to_infrared_luminosity(sfr):
    """
    Return the infrared (8-1000 um) luminosity of a dusty galaxy of given star-formation rate.

    Parameters
    ----------
    sfr : `~astropy.units.Quantity`
        Star-formation rate (Salpeter IMF).

    Returns
    -------
    luminosity : `~astropy.units.Quantity`
        In Lsun.

    References
    ----------
    Kennicutt 1998, ARA&A 36, 189, equation 4: SFR = 4.5e-44 L_IR [erg/s].

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import sfr_to_infrared_luminosity
    >>> print(f"{sfr_to_infrared_luminosity(10 * u.Msun / u.yr):.2e}")
    5.81e+10 solLum
    """
    return (to_array(sfr, u.Msun / u.yr, "sfr") / 4.5e-44 * u.erg / u.s).to(u.Lsun)


def dust_obscured_fraction(stellar_mass):
    """
    Share of star formation that is seen in the infrared only.

    Parameters
    ----------
    stellar_mass : `~astropy.units.Quantity`
        Stellar mass (Chabrier IMF).

    Returns
    -------
    fraction : float or `~numpy.ndarray`
        SFR (IR) over SFR (UV + IR), at redshifts to 2.5.

    References
    ----------
    Whitaker et al. 2017, ApJ 850, 208, equation 1.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import dust_obscured_fraction
    >>> print(dust_obscured_fraction([1e9, 1e10, 1e11] * u.Msun).round(2))
    [0.29 0.8  0.97]
    """
    log_mass = np.log10(to_array(stellar_mass, MASS, "stellar_mass"))
    return 1.0 / (1.0 + 1.96e9 * np.exp(-2.277 * log_mass))


def uvj_quiescent(u_v, v_j, redshift):
    """
    Tell whether galaxies are quiescent by their rest-frame colors.

    Parameters
    ----------
    u_v, v_j : `~astropy.units.Quantity`
        Colors U - V and V - J, AB.
    redshift : float or `~numpy.ndarray`
        Redshifts.

    Returns
    -------
    quiescent : bool or `~numpy.ndarray`
        False where a color is not finite.

    References
    ----------
    Whitaker et al. 2011, ApJ 735, 86, equation 15; used to z = 3.5 there, its last bin beyond.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import uvj_quiescent
    >>> uvj_quiescent([1.0, 1.9] * u.mag, [1.0, 1.0] * u.mag, 1.0).tolist()
    [False, True]
    """
    u_v = to_array(u_v, u.mag, "u_v")
    v_j = to_array(v_j, u.mag, "v_j")
    z = to_array(redshift, u.dimensionless_unscaled, "redshift")
    red = u_v > np.where(z < 2.0, 1.3, 1.2)
    old = v_j < np.select([z < 1.5, z < 2.0], [1.6, 1.5], 1.4)
    return red & old & (u_v > 0.88 * v_j + np.where(z < 0.5, 0.69, 0.59))


def main_sequence_dust(table, *, seed, scatter=0.2):
    """
    Return the dust luminosities of star-forming galaxies that lie on the main sequence.

    The star-formation rate of Speagle et al. 2014 for the galaxy's mass and redshift, its share that
    dust hides (`dust_obscured_fraction`) and the luminosity of that (Kennicutt & Evans 2012, log L
    [erg/s] = log SFR + 43.41), but at least that of ``table``: dust emits what the fitted attenuation
    took. Quiescent galaxies (`uvj_quiescent`) keep their dust luminosity.

    Parameters
    ----------
    table : `~astropy.table.Table`
        ``id``, ``redshift``, ``stellar_mass``, ``dust_luminosity``, ``u_v`` and ``v_j``, as from
        `~miricigale.sed.SEDModel.fluxes`. Rows without a positive mass, redshift and dust
        luminosity (stars) are left as they are.
    seed : int, `~numpy.random.Generator` or None
        Each source has its own stream by its id.
    scatter : float, optional
        Standard deviation in dex about the sequence; 0.2 is that of Speagle et al. 2014.

    Returns
    -------
    dust : `~astropy.table.QTable`
        A row for each of ``table``: ``id``, ``quiescent``, ``dust_luminosity`` in W and
        ``dust_excess``, its ratio to that of ``table``: the parameter of that name of
        `~miricigale.sed.SEDModel`.

    Raises
    ------
    ValueError, `~astropy.units.UnitsError`
        If a column is missing or has a wrong unit, an id is there twice, or ``scatter`` is negative.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import main_sequence_dust
    >>> table = QTable({"id": [1, 2], "redshift": [1.0, 1.0]})
    >>> table["stellar_mass"] = [3e10, 3e10] * u.Msun
    >>> table["dust_luminosity"] = [1e10, 1e10] * u.Lsun
    >>> table["u_v"], table["v_j"] = [1.0, 1.9] * u.mag, [1.0, 1.0] * u.mag
    >>> dust = main_sequence_dust(table, seed=1)
    >>> dust["dust_excess"] = dust["dust_excess"].round(1)
    >>> print(dust["id", "quiescent", "dust_excess"])
     id quiescent dust_excess
    --- --------- -----------
      1     False         9.4
      2      True         1.0
    """
    check_that(np.isfinite(scatter) and scatter >= 0, "scatter", "finite and >= 0", scatter)
    ids, z, mass, dust, galaxy, quiescent = _dusty_galaxies(table)
    seed = check_seed(seed)
    rows = np.flatnonzero(galaxy & ~quiescent)
    hidden = mass[rows] * u.Msun
    sfr = main_sequence_sfr(hidden, COSMOLOGY.age(z[rows])).value * dust_obscured_fraction(hidden)
    offset = [stream(seed, "main sequence", str(ids[row])).normal() for row in rows]
    infrared = 10.0 ** (np.log10(sfr) + 43.41 + scatter * np.array(offset)) * u.erg / u.s
    excess = np.ones(len(ids))
    excess[rows] = np.maximum(infrared.to_value(LUMINOSITY) / dust[rows], 1.0)
    return _dust_table(ids, quiescent, dust, excess)


def ceers_dust(table, component, *, seed):
    """
    Return the dust luminosities of galaxies that have the dust colors of CEERS.

    Drawn from the distribution in ``CEERS_DUST``: log10 of the luminosity over the mass is normal about a mean
    that rises with the mass and the specific star-formation rate, whatever the fitted attenuation took; of
    galaxies that are quiescent by their colors (`uvj_quiescent`) log10 of ``dust_excess`` is normal.

    Parameters
    ----------
    table : `~astropy.table.Table`
        As for `main_sequence_dust`, and ``sfr_100myr``.
    component : {"dl07_alpha", "dale2014"}
        Dust component of the model.
    seed : int, `~numpy.random.Generator` or None
        Each source has its own stream by its id.

    Returns
    -------
    dust : `~astropy.table.QTable`
        As of `main_sequence_dust`.

    Raises
    ------
    KeyError
        If nothing is known of ``component``.
    ValueError, `~astropy.units.UnitsError`
        If a column is missing or has a wrong unit, or an id is there twice.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import ceers_dust
    >>> table = QTable({"id": [1, 2], "redshift": [1.0, 1.0]})
    >>> table["stellar_mass"] = [3e10, 3e10] * u.Msun
    >>> table["dust_luminosity"] = [1e11, 1e10] * u.Lsun
    >>> table["sfr_100myr"] = [15.0, 0.1] * u.Msun / u.yr
    >>> table["u_v"], table["v_j"] = [1.0, 1.9] * u.mag, [1.0, 1.0] * u.mag
    >>> print(ceers_dust(table, "dl07_alpha", seed=1)["dust_excess"].round(2))
    [3.42 0.38]
    """
    check_names([component], "dust component", CEERS_DUST)
    ids, _, mass, dust, galaxy, quiescent = _dusty_galaxies(table)
    require_columns(table, ["sfr_100myr"], "table", units={"sfr_100myr": u.Msun / u.yr})
    at, by_mass, by_rate, scatter, low, wide = CEERS_DUST[component][:6]
    seed = check_seed(seed)
    rows = np.flatnonzero(galaxy)
    excess = np.ones(len(ids))
    offset = [stream(seed, "dust", str(ids[row])).normal() for row in rows]
    passive = quiescent[rows]
    mass = np.log10(mass[rows])
    balance = dust[rows] * LUMINOSITY
    sfr = to_array(table["sfr_100myr"], u.Msun / u.yr, "sfr_100myr")[rows]
    rate = np.clip(np.log10(np.maximum(sfr, 1e-9)) - mass, -12.0, -8.0)
    forming = at + mass + by_mass * (np.clip(mass, 8.5, 10.3) - 10.3) + by_rate * (rate + 9.3)
    mean = np.where(passive, low, forming - np.log10(balance.to_value(u.Lsun)))
    excess[rows] = 10.0 ** (mean + np.where(passive, wide, scatter) * np.array(offset))
    return _dust_table(ids, quiescent, dust, excess)


def _dusty_galaxies(table):
    """Ids, redshifts, masses in Msun and dust luminosities in W of a table; which are galaxies, and quiescent."""
    units = {"stellar_mass": MASS, "dust_luminosity": LUMINOSITY, "u_v": u.mag, "v_j": u.mag}
    require_columns(table, ("id", "redshift", *units), "table", units=units)
    mass = to_array(table["stellar_mass"], MASS, "stellar_mass")
    dust = to_array(table["dust_luminosity"], LUMINOSITY, "dust_luminosity")
    z = floats(table["redshift"])
    galaxy = (mass > 0) & (z > 0) & (dust > 0) & np.isfinite(mass * z * dust)
    quiescent = galaxy & uvj_quiescent(table["u_v"], table["v_j"], z)
    return unique_ids(table["id"], "table"), z, mass, dust, galaxy, quiescent


def _dust_table(ids, quiescent, dust, excess):
    columns = {
        "id": ids,
        "quiescent": quiescent,
        "dust_luminosity": dust * excess * LUMINOSITY,
        "dust_excess": excess,
    }
    return described_columns(columns, column_texts("miricigale.evaluation", "dust"))


def number_counts(flux, area, edges):
    """
    Return the differential number counts in bins of magnitude.

    Parameters
    ----------
    flux : `~astropy.units.Quantity`, shape (n,)
        Fluxes; those not positive fall in no bin.
    area : `~astropy.units.Quantity`
        Solid angle surveyed.
    edges : array-like, shape (m + 1,)
        AB magnitudes, ascending.

    Returns
    -------
    counts, counts_err : `~astropy.units.Quantity`, shape (m,)
        Sources per square degree and magnitude, and the Poisson error (sqrt n).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import number_counts
    >>> flux = [1, 2, 2, 5, 40] * u.uJy
    >>> counts, errors = number_counts(flux, 2 * u.arcmin**2, [22, 23, 24])
    >>> print(counts.round(0))
    [1800. 5400.] 1 / deg2
    """
    edges = floats(edges)
    check_that(is_ascending(edges), "edges", "ascending", edges)
    flux = to_array(flux, FNU, "flux", ndim=1)
    mag = ab_magnitude(flux[flux > 0] * FNU)
    n, _ = np.histogram(mag, edges)
    unit = 1 / (np.diff(edges) * positive(area, u.deg**2, "area")) / u.deg**2
    return n * unit, np.sqrt(n) * unit


def integrated_light(flux, area, wavelength):
    """
    Return the surface brightness of all sources together.

    Parameters
    ----------
    flux : `~astropy.units.Quantity`, shape (n,)
        Fluxes; NaN is an error.
    area : `~astropy.units.Quantity`
        Solid angle that they fill.
    wavelength : `~astropy.units.Quantity`
        Wavelength (pivot) of the band.

    Returns
    -------
    light, light_err : `~astropy.units.Quantity`
        nu I_nu in nW / m2 / sr, and the Poisson error of the sources' number, weighted by
        flux (cosmic variance is not in it).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import integrated_light
    >>> light, error = integrated_light([50, 120, 400] * u.uJy, 2 * u.arcmin**2, 15 * u.um)
    >>> print(f"{light:.2f} +- {error.value:.2f}")
    0.67 nW / (sr m2) +- 0.50
    """
    flux = to_array(flux, FNU, "flux", ndim=1, finite=True) * FNU
    area = positive(area, u.deg**2, "area") * u.deg**2
    nu = to_array(wavelength, u.Hz, "wavelength", ndim=0, equivalencies=u.spectral()) * u.Hz
    unit = u.nW / u.m**2 / u.sr
    return ((nu * flux.sum() / area).to(unit), (nu * np.sqrt((flux**2).sum()) / area).to(unit))
