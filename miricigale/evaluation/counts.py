"""Published relations that simulated samples are held against."""

import astropy.units as u
import numpy as np

from miricigale.utils.exceptions import argument_error

__all__ = ["main_sequence_sfr", "number_counts", "sfr_to_infrared_luminosity"]


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
    log_mass = np.log10(stellar_mass.to_value(u.Msun))
    age = age_of_universe.to_value(u.Gyr)
    return 10 ** ((0.84 - 0.026 * age) * log_mass - (6.51 - 0.11 * age)) * u.Msun / u.yr


def sfr_to_infrared_luminosity(sfr):
    """
    Infrared (8-1000 um) luminosity of a dusty galaxy of given star-formation rate.

    Parameters
    ----------
    sfr : `~astropy.units.Quantity`
        Star-formation rate (Salpeter IMF, as in the paper's second axis).

    Returns
    -------
    luminosity : `~astropy.units.Quantity`
        In Lsun.

    References
    ----------
    Kennicutt 1998, ARA&A 36, 189, equation 4: SFR = 4.5e-44 L_IR [erg/s].
    """
    return (sfr.to_value(u.Msun / u.yr) / 4.5e-44 * u.erg / u.s).to(u.Lsun)


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
    flux = flux.to_value(u.uJy)
    mag = 23.9 - 2.5 * np.log10(flux[flux > 0])
    n, _ = np.histogram(mag, edges)
    unit = 1 / (np.diff(edges) * area.to_value(u.deg**2)) / u.deg**2
    return n * unit, np.sqrt(n) * unit
