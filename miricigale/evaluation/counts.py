"""Published relations that simulated samples are held against."""

import astropy.units as u
import numpy as np

from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import FNU, to_array

__all__ = [
    "PUBLISHED_LIGHT",
    "integrated_light",
    "main_sequence_sfr",
    "number_counts",
    "sfr_to_infrared_luminosity",
]

#: Light of galaxies together in nW / m2 / sr: band, wavelength (um), least flux (uJy), value,
#: errors down and up, reference.
PUBLISHED_LIGHT = (
    ("miri.f1500w", 15.0, 50.0, 2.4, 0.5, 0.5, "Elbaz et al. 2002, A&A 384, 848"),
    ("miri.f2100w", 24.0, 60.0, 1.9, 0.6, 0.6, "Papovich et al. 2004, ApJS 154, 70"),
    ("miri.f2100w", 24.0, 0.0, 2.7, 0.7, 1.1, "Papovich et al. 2004, extrapolated"),
)


def main_sequence_sfr(stellar_mass, age_of_universe):
    """
    Star-formation rate of the main sequence.

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
    """
    log_mass = np.log10(to_array(stellar_mass, u.Msun, "stellar_mass"))
    age = to_array(age_of_universe, u.Gyr, "age_of_universe")
    return 10 ** ((0.84 - 0.026 * age) * log_mass - (6.51 - 0.11 * age)) * u.Msun / u.yr


def sfr_to_infrared_luminosity(sfr):
    """
    Infrared (8-1000 um) luminosity of a dusty galaxy of given star-formation rate.

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
    """
    return (to_array(sfr, u.Msun / u.yr, "sfr") / 4.5e-44 * u.erg / u.s).to(u.Lsun)


def number_counts(flux, area, edges):
    """
    Differential number counts in bins of magnitude.

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
    """
    edges = np.asarray(edges, float)
    if edges.ndim != 1 or np.any(np.diff(edges) <= 0):
        raise argument_error("edges", "ascending magnitudes", edges)
    flux = to_array(flux, FNU, "flux", ndim=1)
    mag = 23.9 - 2.5 * np.log10(flux[flux > 0])
    n, _ = np.histogram(mag, edges)
    unit = 1 / (np.diff(edges) * _solid_angle(area)) / u.deg**2
    return n * unit, np.sqrt(n) * unit


def integrated_light(flux, area, wavelength):
    """
    Surface brightness of all sources together.

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
    """
    flux = to_array(flux, FNU, "flux", ndim=1, finite=True) * FNU
    area = _solid_angle(area) * u.deg**2
    nu = to_array(wavelength, u.Hz, "wavelength", ndim=0, equivalencies=u.spectral()) * u.Hz
    unit = u.nW / u.m**2 / u.sr
    return (
        (nu * flux.sum() / area).to(unit),
        (nu * np.sqrt((flux**2).sum()) / area).to(unit),
    )


def _solid_angle(area):
    """Check an area: a positive number of square degrees."""
    value = float(to_array(area, u.deg**2, "area", ndim=0))
    if not (np.isfinite(value) and value > 0):
        raise argument_error("area", "finite and positive", area)
    return value
