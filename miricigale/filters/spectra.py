"""Spectra of other packages as arrays."""

import astropy.units as u
import numpy as np
from astropy.table import Table

from miricigale.utils.curve_columns import FLUX_NAME, curve_columns
from miricigale.utils.exceptions import ModelWarning, argument_error, units_error, warn
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.units import FNU, WAVE, is_ascending, own_unit, to_array


def check_wave(wave):
    """Return the wavelengths of a spectrum as an array in um."""
    if hasattr(wave, "unit"):
        wave = to_array(wave, WAVE, "wave")
    else:
        wave = floats(wave)
    check_that(
        is_ascending(wave, min_size=2), "wave", "two or more strictly ascending wavelengths", wave
    )
    return wave


def are_spectra(sed):
    """Whether it is a list of spectra (of this package, specutils or synphot), not one as a pair of arrays."""
    if not isinstance(sed, (list, tuple)) or not len(sed):
        return False
    return all(_is_spectrum(item) for item in sed)


def _is_spectrum(item):
    return any(hasattr(item, name) for name in ("fnu", "spectral_axis", "waveset"))


def spectrum_arrays(sed, bands):
    """
    Return the wavelengths (um) and F_nu (uJy) of a spectrum.

    Parameters
    ----------
    sed : object
        With ``wave`` and ``fnu``; a pair of wavelengths and flux densities, or a table of them; a spectrum of
        specutils (``spectral_axis`` and ``flux``) or synphot; or a function of wavelengths that gives flux
        densities, as astropy's models are.
    bands : iterable of `~miricigale.filters.Filter`
        Where a function is evaluated.

    Returns
    -------
    wave, fnu : `~numpy.ndarray`, shape (n,)
        Without samples that are masked (by the flux or the mask of a spectrum of specutils) or NaN.

    Warns
    -----
    `~miricigale.utils.exceptions.ModelWarning`
        If samples are left out, with the longest gap.

    Raises
    ------
    ValueError
        If it is no spectrum, or fewer than two samples are left.
    `~astropy.units.UnitsError`
        If it has other units than a flux density's.
    """
    wave, flux = _wave_and_flux(sed, bands)
    if not hasattr(wave, "unit"):
        raise u.UnitsError("'sed' must have wavelengths with a unit, got bare numbers")
    order = slice(None, None, -1 if wave[-1] < wave[0] else 1)
    wave = check_wave(wave[order])
    flux = flux[order]
    unit = own_unit(flux)
    if unit is not None and (unit * u.sr).is_equivalent(FNU, u.spectral_density(1 * WAVE)):
        wanted = (
            "a flux density; lambda wave: model(wave) * 1e-20 * u.sr multiplies by a solid angle"
        )
        raise units_error("sed", wanted, unit)
    spectral = []
    if unit != FNU:
        spectral = u.spectral_density(wave * WAVE)
    fnu = to_array(flux, FNU, "sed.fnu", ndim=1, equivalencies=spectral)
    got = f"{fnu.size} for {wave.size} wavelengths"
    check_that(wave.shape == fnu.shape, "sed.fnu", "as many values as sed.wave", got)
    missing = np.isnan(fnu)
    if getattr(sed, "mask", None) is not None:
        missing = missing | np.broadcast_to(np.asarray(sed.mask, dtype=bool), fnu.shape)[order]
    return _without_missing(wave, fnu, missing)


def _wave_and_flux(sed, bands):
    """Return the wavelengths and flux densities of a spectrum as it has them: see `spectrum_arrays`."""
    if hasattr(sed, "wave") and hasattr(sed, "fnu"):
        return sed.wave, sed.fnu
    if isinstance(sed, (tuple, list)) and len(sed) == 2:
        return sed
    if isinstance(sed, Table):
        wave_name, flux_name = curve_columns(sed, FLUX_NAME, "'sed'")
        return sed[wave_name], sed[flux_name]
    if hasattr(sed, "spectral_axis") and hasattr(sed, "flux"):
        return sed.spectral_axis.to(WAVE, u.spectral()), sed.flux
    if hasattr(sed, "waveset"):
        wave = sed.waveset
        if wave is None:
            wave = _inside(bands)
        return wave, sed(wave, flux_unit=u.Jy)
    if callable(sed):
        wave = _inside(bands)
        return wave, sed(wave)
    wanted = "a spectrum: an SED, (wavelengths, flux densities), or one of specutils or synphot"
    raise argument_error("sed", wanted, type(sed).__name__)


def _without_missing(wave, fnu, missing):
    """Return the samples of a spectrum that are not masked or NaN, with a warning about the others."""
    if not missing.any():
        return wave, fnu
    n_good = int(np.count_nonzero(~missing))
    check_that(n_good >= 2, "sed.fnu", "two or more values that are not masked or NaN", n_good)
    good = np.flatnonzero(~missing)
    gap = good[np.argmax(np.diff(wave[good]) * missing[good[:-1] + 1]) :][:2]
    text = f"{missing.size - n_good} of {missing.size} samples of the spectrum are masked or NaN and left out"
    if missing[gap[0] + 1]:
        text += f"; straight lines bridge them, the longest from {wave[gap[0]]:.5g} to {wave[gap[1]]:.5g} um"
    warn(text, ModelWarning)
    return wave[good], fnu[good]


def _inside(bands):
    """Return the wavelengths of the curves of bands, refined."""
    return np.unique(np.concatenate([band._fine[0] for band in bands])) * WAVE
