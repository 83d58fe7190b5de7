"""Photometric conversion, backgrounds and image quality of the imaging filters."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.instrument.detector import miri_detector
from miricigale.instrument.published_tables import filter_row, table
from miricigale.refdata import locate
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_least, check_names, check_positive
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import SURFACE_BRIGHTNESS, WAVE, to_array

#: Factor on the low zodiacal light for each name that ``zodi`` may have.
_ZODI = {"none": 0.0, "low": 1.0}


@takes_other_keywords
def photmjsr(filter, *, gain=None):
    """
    Return the surface brightness per count rate.

    Parameters
    ----------
    filter : str
        One of `imager_filters`.
    gain : float, optional
        Electrons per DN; the detector's (`miri_detector`) if not given. The conversion
        is proportional to it.

    Returns
    -------
    photmjsr : float
        MJy/sr per DN/s.

    Notes
    -----
    The bundled values are those at 3.1 e-/DN; they equal, to their three digits, the
    electron rate 1e-20 A Omega integral(T dlambda / lambda) / h (SI, per MJy/sr) for the
    collecting area 25.4 m2, the mean pixel and the measured photon conversion efficiency T.

    Examples
    --------
    >>> from miricigale.instrument import photmjsr
    >>> round(photmjsr("miri.f770w", gain=3.1), 3)
    0.272
    """
    if gain is None:
        gain = miri_detector().gain
    else:
        gain = float(gain)
    check_positive(gain, "gain")
    return filter_row(filter)["photmjsr"] * gain / table()["sensitivity"]["photmjsr_gain"]


def _zodi_factor(zodi):
    if isinstance(zodi, str):
        check_names([zodi], "zodiacal background", _ZODI)
        return _ZODI[zodi]
    check_least(zodi, "zodi", 0)
    return float(zodi)


@takes_other_keywords
def background_level(filter, *, zodi="low"):
    """
    Return the sky and telescope background of a filter.

    Parameters
    ----------
    filter : str
        One of `imager_filters`.
    zodi : str or float, optional
        Zodiacal light: ``"low"``, ``"none"``, or a factor on the low one.

    Returns
    -------
    level : `~astropy.units.Quantity`
        Photon-weighted mean over the band, MJy/sr.

    References
    ----------
    Rigby et al. 2023, PASP, 135, 048002; jwst_backgrounds, thermal curve v4.0.

    Examples
    --------
    >>> from miricigale.instrument import background_level
    >>> (
    ...     background_level("miri.f770w").round(2),
    ...     background_level("miri.f770w", zodi=2.0).round(2),
    ... )
    (<Quantity 4.93 MJy / sr>, <Quantity 8.54 MJy / sr>)
    """
    row = filter_row(filter)
    return (row["thermal"] + _zodi_factor(zodi) * row["zodi"]) * SURFACE_BRIGHTNESS


@cached
def _thermal():
    curve = QTable.read(locate("instrument.thermal"), format="ascii.ecsv")
    return np.log(curve["wave"].to_value(WAVE)), np.log(curve["level"].to_value(SURFACE_BRIGHTNESS))


def chosen_level(filter, background):
    """Return a surface brightness: the low background of a filter for None, one of its levels for a text."""
    if background is None:
        return background_level(filter)
    if isinstance(background, str):
        return background_level(filter, zodi=background)
    return background


def background_spectrum(wave, *, zodi="low"):
    """
    Return the spectrum of the background.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`
        Wavelengths between 2 and 31 um.
    zodi : str or float, optional
        As in `background_level`.

    Returns
    -------
    level : `~astropy.units.Quantity`
        In MJy/sr.

    Raises
    ------
    ValueError
        If a wavelength lies outside the thermal curve.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.instrument import background_spectrum
    >>> background_spectrum([8, 15, 25] * u.um).round(1)
    <Quantity [  5.9,  38.4, 852. ] MJy / sr>
    """
    from astropy.modeling.physical_models import BlackBody

    lam = to_array(wave, WAVE, "wave", finite=True)
    log_wave, log_level = _thermal()
    low, high = np.exp(log_wave[[0, -1]])
    if np.any((lam < low * (1 - 1e-9)) | (lam > high * (1 + 1e-9))):
        raise argument_error("wave", f"between {low:.3g} and {high:.3g} um", wave)
    level = np.exp(np.interp(np.log(lam), log_wave, log_level)) * SURFACE_BRIGHTNESS
    zodiacal = table()["zodi"]
    for dilution, kelvin in zip(zodiacal["dilution"], zodiacal["temperature"], strict=True):
        body = BlackBody(temperature=kelvin * u.K)(lam * WAVE)
        level = level + _zodi_factor(zodi) * dilution * body.to(SURFACE_BRIGHTNESS)
    return level


@takes_other_keywords
def psf_fwhm(filter):
    """
    Return the full width at half maximum of the point-spread function in flight.

    Parameters
    ----------
    filter : str
        One of `imager_filters`.

    Returns
    -------
    fwhm : `~astropy.units.Quantity`
        In arcsec (JWST program 1028).

    Examples
    --------
    >>> from miricigale.instrument import psf_fwhm
    >>> psf_fwhm("miri.f770w")
    <Quantity 0.269 arcsec>
    """
    return filter_row(filter)["fwhm"] * u.arcsec


def electrons_per_brightness(filter, detector=None, *, subarray="FULL"):
    """
    Return the electrons per second and pixel of 1 MJy/sr, where the flat field is 1.

    Parameters
    ----------
    filter : str
        One of `imager_filters`.
    detector : `DetectorProperties`, optional
        `miri_detector` if not given.
    subarray : str, optional
        One of `subarrays`; its response counts if that of the detector does.

    Returns
    -------
    electrons : float

    Examples
    --------
    >>> from miricigale.instrument import electrons_per_brightness
    >>> print(f"{electrons_per_brightness('miri.f770w'):.2f}")
    11.40
    """
    if detector is None:
        detector = miri_detector()
    response = detector.relative_response(filter, subarray)
    return response * detector.gain / photmjsr(filter, gain=detector.gain)


@takes_other_keywords
def electron_rate(filter, background=None, *, detector=None, subarray="FULL"):
    """
    Return the charge that a pixel of the sky collects.

    Parameters
    ----------
    filter : str
        One of `imager_filters`.
    background : `~astropy.units.Quantity` or str, optional
        Surface brightness, or a level of `background_level`; its low one if not given.
    detector, subarray : optional
        As for `electrons_per_brightness`.

    Returns
    -------
    rate : float or `~numpy.ndarray`
        Electrons per second, dark current included.

    Examples
    --------
    >>> from miricigale.instrument import electron_rate
    >>> print(f"{electron_rate('miri.f770w'):.1f} electrons per second")
    56.4 electrons per second
    """
    if detector is None:
        detector = miri_detector()
    level = to_array(chosen_level(filter, background), SURFACE_BRIGHTNESS, "background")
    electrons = electrons_per_brightness(filter, detector, subarray=subarray)
    return level * electrons + detector.dark_current
