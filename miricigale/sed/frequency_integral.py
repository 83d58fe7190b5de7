"""Integrals of spectra over frequency."""

import numpy as np
from astropy.constants import c

from miricigale.utils.options import check_that
from miricigale.utils.units import FNU, WAVE, to_array


def integral_at_rest(sed, low, high):
    """Integrate F_nu of a spectrum over the frequencies between two rest wavelengths: a quantity."""
    check_that(low is not None, "low", "given with 'high'", low)
    first = to_array(low, WAVE, "low") * (1.0 + sed.redshift)
    last = to_array(high, WAVE, "high") * (1.0 + sed.redshift)
    wave = sed.wave.value
    is_inside = wave[0] <= first < last <= wave[-1]
    span = f"{sed.rest_wavelength[0]:.4g} and {sed.rest_wavelength[-1]:.4g}"
    check_that(is_inside, "low, high", f"in order, and within {span}", f"{low}, {high}")
    return frequency_integral(wave, sed.fnu.value, first, last) * FNU * c / WAVE


def frequency_integral(wave, fnu, first, last):
    """
    Integrate a flux density over frequency, exactly for straight lines in wavelength between the samples.

    By nu = c / x, the integral of F_nu dnu from nu(last) to nu(first) is c times that of F_nu / x^2 dx from
    first to last; F_nu = a + b x between two samples gives a (1/x_0 - 1/x_1) + b ln(x_1 / x_0).

    Parameters
    ----------
    wave, fnu : `~numpy.ndarray`, shape (n,)
        Wavelengths, ascending, and flux densities.
    first, last : float
        Wavelengths between which to integrate, within those of the samples.

    Returns
    -------
    integral : float
        In units of flux density over wavelength, to be multiplied by the speed of light.
    """
    is_between = (wave > first) & (wave < last)
    x = np.concatenate([[first], wave[is_between], [last]])
    y = np.interp(x, wave, fnu)
    slope = np.diff(y) / np.diff(x)
    constant = y[:-1] - slope * x[:-1]
    parts = constant * (1 / x[:-1] - 1 / x[1:]) + slope * np.log(x[1:] / x[:-1])
    return np.sum(parts)
