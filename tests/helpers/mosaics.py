"""Mosaics of Gaussian sources, whose images are known in closed form at any resolution."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from helpers.light import gaussian, gaussian_image
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import ErrorSettings, ForcedPhotometer
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


def places(east, north=0.0):
    """Positions some arcsec east and north of the center."""
    east, north = np.broadcast_arrays(east, north)
    return CENTER.spherical_offsets_by(east * u.arcsec, north * u.arcsec)


def lattice(rng, side, spacing, jitter):
    """East and north (arcsec) of ``side`` x ``side`` places, each moved by up to ``jitter``."""
    at = (np.arange(side) - (side - 1) / 2) * spacing
    return [a.ravel() + rng.uniform(-jitter, jitter, side**2) for a in np.meshgrid(at, at)]


def picture(sky, flux, shape, *, scale=0.11, width=LO, sigma=0.01, rng=None):
    """An image of Gaussians that is north up, with noise if there is a generator to draw it."""
    wcs = north_up_wcs(CENTER, scale * u.arcsec, shape)
    light = render(sky, flux, width, wcs, shape)
    noise = 0.0 if rng is None else rng.normal(0, sigma, shape)
    return as_ccd(light + noise, wcs, sigma)


def measured(image, catalog, **options):
    """Forced photometry of points, of a catalog or of positions."""
    catalog = QTable({"sky": catalog}) if isinstance(catalog, SkyCoord) else catalog
    photometer = ForcedPhotometer(kernel, template="psf", **options)
    return photometer.measure(image, catalog=catalog)


#: Errors of white noise as it is stated.
WHITE = ErrorSettings(correlated_noise=False)


def stamps_of(bank, shape):
    """The stamps of a bank of templates on whole images, in the order of its rows."""
    found = np.zeros((len(bank.order), *shape))
    for block in bank.blocks():
        for k, (y, x, h, w) in enumerate(block.box):
            stamp = block.values[block.start[k] : block.start[k + 1]].reshape(h, w)
            found[block.first + k, y : y + h, x : x + w] = stamp
    return found


def disks(sky, wcs, shape, radius, labels=None):
    """Segments that are disks of a radius (pixels) about positions, with labels from 1 by default."""
    found, (y, x) = np.zeros(shape, np.int32), np.indices(shape)
    labels = np.arange(1, len(sky) + 1) if labels is None else labels
    for label, a, b in zip(labels, *wcs.world_to_pixel(sky), strict=True):
        found[np.hypot(x - a, y - b) < radius] = label
    return found


def pair(sky, flux, size, shapes, sigmas, rng):
    """A prior and an image, with noise, of Gaussian galaxies of some widths (rms, arcsec)."""
    forms = zip((FINE, 0.11), (HI, LO), shapes, sigmas, strict=True)
    return [
        picture(sky, flux, (n, n), scale=scale, width=np.hypot(psf, size), sigma=sigma, rng=rng)
        for scale, psf, n, sigma in forms
    ]


def flagged(flags, flag):
    """Which sources have a flag."""
    return (np.asarray(flags) & int(flag)) != 0
