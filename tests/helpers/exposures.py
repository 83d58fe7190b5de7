"""Exposures of one field, their skies, and images as a reduction makes them."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty

from miricigale.instrument import Exposure, imager_wcs

FIELD = SkyCoord(53.1344, -27.8344, unit="deg")


def exposure_of(band="miri.f1000w", **options):
    """An exposure of the field, of SUB256 unless ``options`` say otherwise."""
    options = {"subarray": "SUB256", "pointing": FIELD, "roll": 30 * u.deg, **options}
    return Exposure(band, **options)


def imager_part(pointing, origin, shape, angle=30.0):
    """Coordinates of a part of the distorted imager."""
    wcs = imager_wcs(pointing, angle * u.deg)
    wcs.wcs.crpix = wcs.wcs.crpix - origin
    wcs.sip = type(wcs.sip)(wcs.sip.a, wcs.sip.b, wcs.sip.ap, wcs.sip.bp, wcs.wcs.crpix)
    wcs.pixel_shape = shape[::-1]
    wcs.wcs.set()
    return wcs


def sky_of(exposure, light, **meta):
    """Noiseless surface brightness on the pixels of an exposure."""
    light = np.broadcast_to(np.asarray(light, float), exposure.shape).copy()
    return CCDData(light, unit="MJy/sr", meta=meta)


def image_of(data, wcs=None, *, error=1.0, mask=None, **meta):
    """A calibrated image with errors, of one value or one for each pixel."""
    error = np.broadcast_to(np.float32(error), data.shape).copy()
    return CCDData(
        data, unit="MJy/sr", uncertainty=StdDevUncertainty(error), mask=mask, wcs=wcs, meta=meta
    )


def gaussians(shape, x, y, peaks, width):
    """Sum of round Gaussians at places in pixels, by their peaks and widths (rms)."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    out = np.zeros(shape)
    for x0, y0, peak, sigma in zip(x, y, *np.broadcast_arrays(peaks, width), strict=True):
        out += peak * np.exp(-0.5 * ((columns - x0) ** 2 + (rows - y0) ** 2) / sigma**2)
    return out
