"""Mosaics of Gaussian sources, whose images are known in closed form at any resolution."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty

from helpers.light import gaussian, gaussian_image
from miricigale.instrument import pixel_area_map
from miricigale.psf import MatchingKernel

CENTER = SkyCoord(53.1, -27.8, unit="deg")
SR = (1 * u.arcsec**2).to_value(u.sr)
FINE, HI, LO = 0.06, 0.09, 0.25  # pixel and widths (rms) of the two PSFs, arcsec


def offsets(sky, wcs, y, x):
    """Offsets (arcsec) of pixels from a position in the tangent plane."""
    at = wcs.pixel_to_world(x, y)
    dx, dy = sky.spherical_offsets_to(at)
    return dx.to_value(u.arcsec), dy.to_value(u.arcsec)


def render(sky, flux, sigma, wcs, shape, reach=8.0):
    """Image (MJy/sr) of Gaussians of total ``flux`` (uJy) and rms ``sigma`` (arcsec), at pixel centres."""
    image = np.zeros(shape)
    x, y = wcs.world_to_pixel(sky)
    scale = np.sqrt(np.median(pixel_area_map(wcs, shape)) / SR)
    for k, width in enumerate(np.broadcast_to(sigma, len(sky))):
        half = int(reach * width / scale) + 2
        y0, y1 = np.clip([int(y[k]) - half, int(y[k]) + half], 0, shape[0])
        x0, x1 = np.clip([int(x[k]) - half, int(x[k]) + half], 0, shape[1])
        if y1 > y0 and x1 > x0:
            yy, xx = np.mgrid[y0:y1, x0:x1]
            dx, dy = offsets(sky[k], wcs, yy, xx)
            image[y0:y1, x0:x1] += flux[k] * 1e-12 / SR * gaussian(dx, dy, width)
    return image


def as_ccd(image, wcs, sigma, **kwargs):
    noise = StdDevUncertainty(np.full(image.shape, float(sigma)))
    return CCDData(image, unit="MJy/sr", wcs=wcs, uncertainty=noise, **kwargs)


def positions(rng, n, half):
    """Positions in a square of half side ``half`` arcsec."""
    dx, dy = rng.uniform(-half, half, (2, n)) * u.arcsec
    return CENTER.spherical_offsets_by(dx, dy)


#: From the PSF of the prior to that of the mosaics.
kernel = MatchingKernel.from_psfs(
    gaussian_image(67, HI / FINE), gaussian_image(67, LO / FINE), pixel_scale=FINE * u.arcsec
)
