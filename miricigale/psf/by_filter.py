"""The PSF that a filter should have: models by name, and checks of other PSFs against them."""

import logging
import math

import astropy.units as u
import numpy as np

from miricigale.filters.band_names import known_filter
from miricigale.psf import _core
from miricigale.psf.any_psf import UNIT_SUM
from miricigale.psf.hst import WFC3_FILTERS, hst_psf
from miricigale.psf.miri import MIRI_FILTERS, miri_psf
from miricigale.psf.model import instrument_psf
from miricigale.psf.nircam import NIRCAM_FILTERS, nircam_psf
from miricigale.psf.resample import psf_image, psf_mosaic, rotate_psf
from miricigale.utils.exceptions import PSFWarning, warn
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE

_log = logging.getLogger(__name__)

#: Filters that `filter_psf` knows.
MODEL_FILTERS = MIRI_FILTERS + NIRCAM_FILTERS + WFC3_FILTERS

#: Factor in FWHM beyond which a PSF is not that of the filter; parts from which on a narrower and a
#: wider one gets a warning (real mosaics are some percent wider than the models).
_OTHER_WIDTH = 1.5
_NARROWER = 0.05
_WIDER = 0.15
#: How far a sum may be from the fraction of light that the model's grid holds to be taken for it.
_NEAR_SUM = 0.05
#: Least strength of the spikes in the detector's axes, in units of the model's, and by how much and how
#: many standard deviations it must exceed that of spikes turned to the sky.
_STRENGTH = 0.4
_BETTER = 0.3
_SIGNIFICANT = 5.0


@takes_other_keywords
def filter_psf(filter, *, pixel_scale, pa=None, grid_angle=0.0 * u.deg, resampling="drizzle"):
    """
    Return the model PSF of an image in a filter: MIRI, NIRCam's wide filters, WFC3/IR.

    Parameters
    ----------
    filter : str
        One of those of `miri_psf`, `nircam_psf` and `hst_psf`.
    pixel_scale : `~astropy.units.Quantity`
        Pixel of the image.
    pa : `~astropy.units.Quantity`, optional
        Position angle of the detector's +y (PA_APER), several are averaged; needed for MIRI and
        NIRCam. That of WFC3/IR is north up.
    grid_angle : `~astropy.units.Quantity`, optional
        Position angle of the image's +y.
    resampling : {"drizzle", None}, optional
        None for a single exposure. WFC3/IR is always drizzled.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        In the sky frame.

    Raises
    ------
    KeyError
        If there is no model for the filter.
    ValueError
        If the position angle is missing.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import filter_psf
    >>> psf = filter_psf("F1500W", pixel_scale=0.11 * u.arcsec, pa=35 * u.deg)
    >>> print(f"{psf.fwhm:.3f}, frame {psf.frame!r}")
    0.521 arcsec, frame 'sky'
    """
    filter = known_filter(filter, MODEL_FILTERS, "model PSF for the filter")
    if filter in WFC3_FILTERS:
        return rotate_psf(hst_psf(filter, pixel_scale=pixel_scale), grid_angle=grid_angle)
    return psf_mosaic(
        exposure_psf(filter), pixel_scale, pa, grid_angle=grid_angle, resampling=resampling
    )


def exposure_psf(filter, scale=None):
    """Return the model of a single exposure, in the detector's axes; WFC3/IR is drizzled to ``scale``."""
    filter = known_filter(filter, MODEL_FILTERS, "model PSF for the filter")
    if filter in WFC3_FILTERS:
        if scale is None:
            return hst_psf(filter)
        return hst_psf(filter, pixel_scale=scale)
    if filter in MIRI_FILTERS:
        return miri_psf(filter)
    return nircam_psf(filter)


@takes_other_keywords
def checked_psf(
    psf, filter, *, pixel_scale=None, pa=None, resampling="drizzle", smoothed=False, argument="psf"
):
    """
    Compare a PSF with the model of its filter, and take the light beyond its grid from that.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF`
        With the meta of `make_psf`.
    filter, resampling
        As for `filter_psf`.
    pixel_scale, pa : `~astropy.units.Quantity`, optional
        Pixel of the image that the PSF is for, and position angle of the detector's +y there; the
        pixel is that of the PSF by default, and without the angle none is compared.
    smoothed : bool, optional
        Whether a PSF of any larger width is taken as it is, with a warning: that of an image which
        was brought to another resolution.
    argument : str, optional
        What to call the PSF in messages.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        The same, or with data of another sum: unless it is ``total_known``, a PSF whose sum is not within 0.05 of
        what the model has on this grid, or is 0.995 or more, is taken to hold what the model does.

    Raises
    ------
    KeyError
        If there is no model for the filter.
    ValueError
        If the PSF is more than 1.5 times wider or narrower than the model (its pixel is another),
        or its spikes stand as in the detector's axes although its frame is the sky.

    Warns
    -----
    `~miricigale.utils.exceptions.PSFWarning`
        If the light was scaled by more than 0.01, the PSF is narrower by more than 5 % or
        wider by more than 15 %, or the image seems to be smoothed.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import checked_psf, gaussian_psf
    >>> psf = gaussian_psf(1.2 * u.arcsec, pixel_scale=0.11 * u.arcsec, fov=4 * u.arcsec)
    >>> checked_psf(psf, "F1500W")
    Traceback (most recent call last):
    ...
    ValueError: 'psf' must be a PSF of F1500W, about 0.521 arcsec wide (FWHM), got one of 1.2 arcsec...
    """
    psf = instrument_psf(psf, argument)
    scale = pixel_scale
    if pixel_scale is None:
        scale = psf.pixel_scale
    angle = psf.angle
    form = {"pixel_scale": scale, "grid_angle": angle, "resampling": resampling}
    if psf.frame == "detector":
        model = exposure_psf(filter, scale)
    else:
        model = filter_psf(filter, pa=angle if pa is None else pa, **form)
    x, y, _ = _core.core_moments(psf.data)
    if not np.isfinite(x + y):
        # too few pixels in the core
        x, y = psf.origin
    ny, nx = psf.data.shape
    place = {"pixel_scale": psf.cell * ANGLE, "shape": (ny, nx)}
    place["offset"] = (x - (nx - 1) / 2, y - (ny - 1) / 2)
    stamp = psf_image(model, **place)
    # both as these cells show them, which may be coarse
    width = _core.half_maximum_width(psf.data, x, y) * psf.cell
    usual = _core.half_maximum_width(stamp, x, y) * psf.cell
    ratio = width / usual
    if smoothed and ratio > _OTHER_WIDTH:
        warn(
            f"'{argument}' is {ratio:.2g} times as wide (FWHM {width:.3g} arcsec) as the model of "
            f"{filter}, with which it is not compared: was the image brought to this resolution?",
            PSFWarning,
        )
        return psf
    wanted = f"a PSF of {filter}, about {usual:.3g} arcsec wide (FWHM)"
    got = f"one of {width:.3g} arcsec with pixels of {psf.cell:.4g} arcsec: is that its pixel?"
    check_that(1 / _OTHER_WIDTH < ratio < _OTHER_WIDTH, argument, wanted, got)
    if pa is not None and psf.frame == "sky" and filter not in WFC3_FILTERS:
        unturned = filter_psf(filter, pa=angle, **form)
        unturned = psf_image(unturned, **place)
        _check_turn(psf, (x, y), (stamp, unturned), (width, filter, pa), argument)
    if not 1 - _NARROWER < ratio < 1 + _WIDER:
        word = "narrower"
        if ratio > 1:
            word = "wider"
        warn(
            f"'{argument}' is {abs(ratio - 1):.0%} {word} (FWHM {width:.3g} arcsec) than the model of "
            f"{filter}: does it hold the pixel, the drizzling and no more?",
            PSFWarning,
        )
    return _scaled(psf, float(stamp.sum()), filter, argument)


def _check_turn(psf, center, stamps, model_facts, argument):
    """Refuse a PSF whose spikes stand where those of the detector's axes are."""
    width, filter_, pa = model_facts
    y, x = np.indices(psf.data.shape)
    radius = np.hypot(x - center[0], y - center[1])
    ring = np.rint(radius).astype(int)
    # spikes are beyond the core, and in distant wings lost in the noise
    in_ring = (radius * psf.cell > width) & (radius * psf.cell < min(3.0, 0.95 * psf.half_width))
    if np.count_nonzero(in_ring) < 100:
        return

    def spikes(image):
        count = np.maximum(np.bincount(ring[in_ring]), 1)
        mean = np.bincount(ring[in_ring], image[in_ring]) / count
        # wings fall steeply: each ring has the same weight
        return (image[in_ring] - mean[ring[in_ring]]) * radius[in_ring]

    measured, sky_spikes, detector_spikes = map(spikes, (psf.data, *stamps))
    measured = measured * (stamps[0].sum() / psf.data.sum())
    on_sky = float(measured @ sky_spikes) / float(sky_spikes @ sky_spikes)
    on_detector = float(measured @ detector_spikes) / float(detector_spikes @ detector_spikes)
    noise = np.std(measured - on_detector * detector_spikes) / math.sqrt(
        detector_spikes @ detector_spikes
    )
    _log.info(
        "'%s': spikes as strong as %.3g (turned) and %.3g (detector) +- %.2g times the model's",
        argument, on_sky, on_detector, noise,
    )  # fmt: skip
    better = max(_BETTER, _SIGNIFICANT * math.sqrt(2) * noise)
    wanted = f"turned to the image, as the model of {filter_} at PA_APER {pa:.4g} is"
    got = (
        f"one whose spikes stand as in the detector's axes ({on_detector:.2f} times those of the "
        f"model, turned {on_sky:.2f}): state the angle of its +y"
    )
    check_that(not on_detector > max(_STRENGTH, on_sky + better), argument, wanted, got)


def _scaled(psf, expected, filter_, argument):
    """Return the PSF with the fraction of the light that it holds: its own or the model's."""
    if psf.total_known:
        return psf
    held = psf.enclosed
    enclosed = expected
    if held < UNIT_SUM and abs(held - expected) < _NEAR_SUM:
        enclosed = held
    width = 2 * psf.half_width
    msg = (
        f"'{argument}' sums to {held:.4g} and is taken to hold {enclosed:.3f} of the light on its "
        f"{width:.3g} arcsec, as the model of {filter_} does ({expected:.3f})"
    )
    if abs(enclosed - held) > 0.01:
        msg += f": fluxes are {held / enclosed:.3f} times those of a PSF that holds {held:.3g}"
        warn(msg, PSFWarning)
    else:
        _log.info(msg)
    return psf.replace(psf.data * (enclosed / held), total_known=True)
