"""Photometric conversion, backgrounds and published limits of the imaging filters."""

import functools

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.instrument.detector import miri_detector
from miricigale.instrument.figures import filter_row, imager_filters, table
from miricigale.refdata import locate
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.units import SURFACE_BRIGHTNESS, WAVE, to_array

__all__ = [
    "background_level",
    "background_spectrum",
    "etc_limit",
    "photmjsr",
    "proposal_limit",
    "psf_fwhm",
    "saturation_forecast",
    "saturation_time",
    "scaled_limit",
]

#: Factor on the low zodiacal light for each name that ``zodi`` may have.
_ZODI = {"none": 0.0, "low": 1.0}


def photmjsr(filter, *, gain=None):
    """
    Surface brightness per count rate.

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
    """
    gain = miri_detector().gain if gain is None else float(gain)
    if not gain > 0:
        raise argument_error("gain", "positive", gain)
    return filter_row(filter)["photmjsr"] * gain / table()["sensitivity"]["photmjsr_gain"]


def _zodi_factor(zodi):
    if isinstance(zodi, str):
        try:
            return _ZODI[zodi]
        except KeyError:
            raise unknown_name("zodiacal background", zodi, _ZODI) from None
    if not float(zodi) >= 0:
        raise argument_error("zodi", "a name or a factor of at least 0", zodi)
    return float(zodi)


def background_level(filter, *, zodi="low"):
    """
    Sky and telescope background of a filter.

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
    """
    row = filter_row(filter)
    return (row["thermal"] + _zodi_factor(zodi) * row["zodi"]) * SURFACE_BRIGHTNESS


@functools.cache
def _thermal():
    curve = QTable.read(locate("instrument.thermal"), format="ascii.ecsv")
    return np.log(curve["wave"].to_value(WAVE)), np.log(curve["level"].to_value(SURFACE_BRIGHTNESS))


def background_spectrum(wave, *, zodi="low"):
    """
    Spectrum of the background.

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


def etc_limit(filter, version="4.0"):
    """
    Point-source limit of the exposure time calculator: 10 sigma in 10 ks.

    Parameters
    ----------
    filter : str
        One of `imager_filters`.
    version : str, optional
        ``"4.0"`` or ``"2.0"``.

    Returns
    -------
    limit : `~astropy.units.Quantity`
        In uJy.
    """
    versions = {"4.0": "etc_40", "2.0": "etc_20"}
    if str(version) not in versions:
        raise unknown_name("version of the exposure time calculator", version, versions)
    return filter_row(filter)[versions[str(version)]] * u.uJy


def scaled_limit(filter, time, *, n_sigma=5.0, version="4.0"):
    """
    The calculator's limit scaled to another exposure, as the root of the time.

    Parameters
    ----------
    filter : str
        One of `imager_filters`.
    time : `~astropy.units.Quantity`
        Total exposure time.
    n_sigma : float, optional
        Significance.
    version : str, optional
        As in `etc_limit`.

    Returns
    -------
    limit : `~astropy.units.Quantity`
        In uJy.
    """
    seconds = to_array(time, u.s, "time")
    if not np.all(seconds > 0):
        raise argument_error("time", "positive", time)
    return etc_limit(filter, version) * (n_sigma / 10) * np.sqrt(1e4 / seconds)


def proposal_limit(filter):
    """
    The 5-sigma limit that the CEERS proposal quotes for its exposures.

    Parameters
    ----------
    filter : str
        One of the six bands of the survey.

    Returns
    -------
    limit : `~astropy.units.Magnitude`
        AB.

    Raises
    ------
    KeyError
        If the survey has no such band.
    """
    row = filter_row(filter)
    if "proposal" not in row:
        known = [name for name in imager_filters() if "proposal" in filter_row(name)]
        raise unknown_name("band of the survey", filter, known)
    return row["proposal"] * u.ABmag


def psf_fwhm(filter):
    """
    Full width at half maximum of the point-spread function in flight.

    Parameters
    ----------
    filter : str
        One of `imager_filters`.

    Returns
    -------
    fwhm : `~astropy.units.Quantity`
        In arcsec (JWST programme 1028).
    """
    return filter_row(filter)["fwhm"] * u.arcsec


def _electron_rate(filter, background, detector):
    level = background_level(filter) if background is None else background
    level = to_array(level, SURFACE_BRIGHTNESS, "background")
    return level / photmjsr(filter, gain=detector.gain) * detector.gain + detector.dark_current


def saturation_forecast(exposure, *, background=None, detector=None):
    """
    How full the sky and the dark current make the wells by the end of an integration.

    Parameters
    ----------
    exposure : `~miricigale.instrument.Exposure`
        What is exposed.
    background : `~astropy.units.Quantity`, optional
        Surface brightness; the low background of the filter if not given. An array (an
        image of sources and sky, say) gives an array.
    detector : `DetectorProperties`, optional
        `miri_detector` if not given.

    Returns
    -------
    fraction : float or `~numpy.ndarray`
        Of the full well; above 0.6 little room is left for sources.
    """
    detector = miri_detector() if detector is None else detector
    rate = _electron_rate(exposure.filter, background, detector)
    fraction = rate * exposure.integration_time.to_value(u.s) / detector.full_well
    return float(fraction) if np.ndim(fraction) == 0 else fraction


def saturation_time(filter, *, background=None, detector=None):
    """
    Time in which the sky and the dark current fill the well.

    Parameters are those of `saturation_forecast`, with the filter for the exposure.

    Returns
    -------
    time : `~astropy.units.Quantity`
        In s.
    """
    detector = miri_detector() if detector is None else detector
    return detector.full_well / _electron_rate(filter, background, detector) * u.s
