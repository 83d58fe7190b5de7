"""Errors of point and extended sources that an exposure and its mosaic allow."""

import astropy.units as u
import numpy as np
import scipy.fft
from scipy.ndimage import gaussian_filter

from miricigale.instrument import (
    background_level,
    miri_detector,
    photmjsr,
)
from miricigale.photometry.error_curves import Analytic
from miricigale.photometry.limits import noise_power, pattern_amplitude, ramp_variance
from miricigale.psf import MIRI_PIXEL_SCALE, miri_psf, psf_image
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import ANGLE, SURFACE_BRIGHTNESS, to_array

__all__ = ["exposure_curve", "extraction_map"]

#: Samples of a pixel's side, and pixels of the detector on which sources are weighed.
_SAMPLES, _SIZE = 4, 91


def extraction_map(share, boxes):
    """
    Weight of the detector's pixels in the flux that is fitted on a mosaic.

    A template fitted with equal weights to a mosaic that is the exposures smeared with K counts each
    detector pixel with P * K * K, where P is the PSF; without K that is the optimal extraction.

    Parameters
    ----------
    share : `~numpy.ndarray`, shape (n, n)
        Light of a detector's pixel whose middle is there, sampled ``_SAMPLES`` times a side.
    boxes : sequence of float
        Widths in detector pixels of the squares that K is the convolution of.

    Returns
    -------
    weight : `~numpy.ndarray`, shape (n, n)
        Such that every lattice of pixels finds unit flux in the mean.
    """
    n = share.shape[0]
    period = scipy.fft.next_fast_len(n + 8 * _SAMPLES, True)
    fy, fx = np.fft.fftfreq(period)[:, None], np.fft.rfftfreq(period)
    smear = np.ones(1)
    for box in boxes:
        width = box * _SAMPLES
        smear = smear * np.sinc(fy * width) * np.sinc(fx * width)
    weight = scipy.fft.irfft2(
        scipy.fft.rfft2(share, s=(period, period)) * smear**2, s=(period,) * 2
    )
    weight = weight[:n, :n]
    return weight * _SAMPLES**2 / np.sum(weight * share)


def exposure_curve(
    filter,
    time,
    *,
    background,
    size,
    psf,
    n_integrations,
    frame_time,
    fractional,
    n_dithers,
    residual,
    mosaic,
):
    """Noise of an exposure; parameters are those of `ErrorModel.from_exposure`."""
    seconds = float(to_array(time, u.s, "time"))
    if not seconds > 0:
        raise argument_error("time", "positive", time)
    for name, value in (("n_integrations", n_integrations), ("n_dithers", n_dithers)):
        if int(value) != value or value < 1:
            raise argument_error(name, "an integer of at least 1", value)
    step = float(to_array(frame_time, u.s, "frame_time"))
    level = background_level(filter) if background is None else background
    level = float(to_array(level, SURFACE_BRIGHTNESS, "background"))
    detector = miri_detector()
    n_frames = int(seconds / n_integrations / step * (1 + 1e-9))
    if n_frames < 2:
        raise argument_error("time", f"at least two frames of {step} s in each integration", time)
    share = _share(filter, psf, size)
    boxes = () if mosaic is None else (1.0, _pixels(mosaic, "mosaic"))
    weight = extraction_map(share, boxes)

    # electrons per second of a brightness, and uJy of a brightness in a pixel
    per_level = detector.gain / photmjsr(filter, gain=detector.gain)
    electrons = per_level / (MIRI_PIXEL_SCALE.to_value(u.rad) ** 2 * 1e12)
    rate = level * per_level + detector.dark_current
    ramp = {
        "n_groups": n_frames,
        "group_time": step,
        "read_noise": detector.read_noise * detector.gain,
    }
    used = seconds / (n_frames * step * n_integrations)
    variance = ramp_variance(rate, **ramp) / (n_integrations * used)
    brighter = ramp_variance(1.01 * rate + 1e-3, **ramp) / (n_integrations * used)
    growth = (brighter - variance) / (0.01 * rate + 1e-3)
    power = np.sum(weight**2) / _SAMPLES**2
    sky = variance * power / electrons**2
    amplitude = pattern_amplitude(residual, filter)
    if amplitude:
        # the pattern is that of whole pixels, wherever the source falls
        phases = [
            weight[y::_SAMPLES, x::_SAMPLES] for y in range(_SAMPLES) for x in range(_SAMPLES)
        ]
        pattern = np.mean([noise_power(one, 1.0) for one in phases])
        sky += (amplitude * level * per_level / electrons) ** 2 * pattern / n_dithers
    photon = growth * np.sum(weight**2 * share) / _SAMPLES**2 / electrons
    return Analytic(float(np.sqrt(sky)), float(fractional), float(photon))


def _pixels(angle, name):
    value = float(to_array(angle, ANGLE, name)) / u.Quantity(MIRI_PIXEL_SCALE, ANGLE).value
    if not 0 < value < 5:
        raise argument_error(name, "positive and below 0.5 arcsec", angle)
    return value


def _share(filter, psf, size):
    """Light of a source in a pixel, by the place of the pixel's middle."""
    pixel = u.Quantity(MIRI_PIXEL_SCALE, ANGLE) / _SAMPLES
    n = _SIZE * _SAMPLES
    psf = miri_psf(filter) if psf is None else psf
    share = psf_image(psf, pixel_scale=pixel, shape=n + 1 - n % 2) * _SAMPLES**2
    width = float(to_array(size, ANGLE, "size"))
    if not width >= 0:
        raise argument_error("size", "at least 0", size)
    width = width / np.sqrt(8 * np.log(2)) / pixel.value
    return gaussian_filter(share, width) if width > 0 else share
