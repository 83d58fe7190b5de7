"""The image that is exposed: its light, checked against the exposure."""

import astropy.units as u
import numpy as np
from astropy.nddata import NDData
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_area

from miricigale.instrument import Exposure, ImageFacts
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that, check_type
from miricigale.utils.units import SURFACE_BRIGHTNESS, to_array

# pixels by which the image may lie off the exposure
_PLACE = 0.1


def checked_light(image, exposure):
    """
    Light that is exposed: surface brightness of an image or a scene in MJy/sr, exposure, what the PSF includes.

    The brightness, (ny, nx), is nowhere negative; without an exposure that of the scene is taken.

    Raises
    ------
    TypeError
        If the image has no unit.
    `~astropy.units.UnitsError`
        If that is none of surface brightness.
    ValueError
        If the exposure has no filter or pointing, or the image another shape, filter or place on the
        sky than the exposure, masked pixels, or values that are not finite or that are negative.
    """
    if exposure is None:
        exposure = getattr(image, "exposure", None)
    check_type(exposure, "exposure", Exposure, "an Exposure")
    exposure.check_sky()
    if hasattr(image, "render"):
        image = image.render()
    if isinstance(image, u.Quantity):
        image = NDData(image)
    if not isinstance(image, NDData) or image.unit is None:
        wanted = f"a Scene or a CCDData in {SURFACE_BRIGHTNESS}"
        msg = f"'image' must be {wanted}, got {type(image).__name__}"
        raise TypeError(msg)
    masked = np.count_nonzero(image.mask)
    wanted = "without masked pixels, as each of them collects light"
    check_that(not masked, "image", wanted, f"{masked} of them")
    wanted = f"of the exposure's shape {exposure.shape}"
    check_that(image.data.shape == exposure.shape, "image", wanted, image.data.shape)
    facts = ImageFacts.of(image)
    wanted = f"one of the filter {exposure.filter}"
    check_that(facts.band in (None, exposure.filter[5:]), "image", wanted, f"one of {facts.filter}")
    _check_place(image, exposure)
    light = to_array(image.data * image.unit, SURFACE_BRIGHTNESS, "image", ndim=2, finite=True)
    lowest = light.min()
    # a PSF between its samples undershoots by up to 2e-5 of the brightest pixel
    if lowest < -1e-4 * np.abs(light).max():
        raise argument_error("image", "surface brightness that is nowhere negative", lowest)
    return np.maximum(light, 0.0), exposure, facts.psf_includes


def _check_place(image, exposure):
    """An image with a WCS must lie where the exposure points: each dither has its own."""
    wcs = image.wcs
    if not isinstance(wcs, WCS) or not wcs.has_celestial:
        return
    ny, nx = exposure.shape
    x = np.array([0.0, nx - 1.0, (nx - 1) / 2])
    y = np.array([0.0, ny - 1.0, (ny - 1) / 2])
    wanted = exposure.wcs.pixel_to_world(x, y)
    have = wcs.pixel_to_world(x, y)
    side = np.sqrt(proj_plane_pixel_area(exposure.wcs.celestial))
    off = float(np.max(wanted.separation(have).deg)) / side
    wanted = "where the exposure points (each dither needs a scene on its own wcs)"
    check_that(off <= _PLACE, "image", wanted, f"one {off:.4g} pixels off")
