"""Drizzled mosaics: their rims, and errors whose scale is not that of their pixels."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import ForcedFlags, ForcedPhotometer
from miricigale.photometry.fit.diagnostics import rim_pixels
from miricigale.psf import gaussian_psf
from miricigale.reduction import drizzle_images

CENTER = SkyCoord(53.0, -27.0, unit="deg")
PIXEL, FINE = 0.11, 0.05
WIDTH, SHARP = 0.30, 0.10


def points(wcs, shape, sky, width, flux, sigma, rng):
    """Gaussians of a width (arcsec) and flux (uJy), with white noise of each pixel (uJy)."""
    scale = np.sqrt(np.abs(np.linalg.det(wcs.pixel_scale_matrix))) * 3600 * 2.3548 / width
    y, x = np.indices(shape)
    data = rng.normal(0, sigma, shape)
    for px, py in zip(*wcs.world_to_pixel(sky), strict=True):
        data += (
            flux
            * scale**2
            / (2 * np.pi)
            * np.exp(-0.5 * scale**2 * ((x - px) ** 2 + (y - py) ** 2))
        )
    # uJy to MJy / sr
    area = pixel_area_map(wcs, shape) * 1e12
    error = StdDevUncertainty(np.full(shape, sigma) / area)
    meta = {"filter": "miri.f770w"}
    return CCDData(data / area, unit="MJy/sr", uncertainty=error, wcs=wcs, meta=meta)


def field(sky, scale, n=60, flux=3.0, sigma=0.02):
    """A drizzled exposure of stars, a prior of them, segments and sources."""
    rng = np.random.default_rng(3)
    # the pixels of the exposure stand at 20 deg on the mosaic
    wcs = north_up_wcs(CENTER, PIXEL * u.arcsec, (n, n))
    turn = np.radians(20.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    wcs.wcs.pc = rotation
    exposure = points(wcs, (n, n), sky, WIDTH, flux, sigma, rng)
    size = int(1.4 * n * PIXEL / scale)
    mosaic = drizzle_images([exposure], north_up_wcs(CENTER, scale * u.arcsec, (size, size))).image
    size = int(1.3 * n * PIXEL / FINE)
    grid = north_up_wcs(CENTER, FINE * u.arcsec, (size, size))
    prior = points(grid, (size, size), sky, SHARP, flux, 1e-4, rng)
    segments = np.zeros((size, size), int)
    for number, (x, y) in enumerate(zip(*grid.world_to_pixel(sky), strict=True), 1):
        segments[int(y) - 7 : int(y) + 8, int(x) - 7 : int(x) + 8] = number
    index = np.arange(1, len(sky) + 1)
    return mosaic, prior, segments, QTable({"id": index, "sky": sky, "label": index}), wcs


def photometer(scale):
    drops = 2.3548 * np.hypot(PIXEL, scale) / np.sqrt(12)
    form = {"pixel_scale": FINE * u.arcsec, "fov": 3 * u.arcsec}
    wide = gaussian_psf(np.hypot(WIDTH, drops) * u.arcsec, **form)
    return ForcedPhotometer(psf=wide, highres_psf=gaussian_psf(SHARP * u.arcsec, **form))


def test_errors_are_those_of_the_scatter_whatever_the_map_of_errors_says():
    """An _i2d on pixels of half the size has an ERR of 2.6 times the scatter of its pixels."""
    offsets = np.array(np.meshgrid([-2, 0, 2], [-2, 0, 2])).reshape(2, -1) * u.arcsec
    sky = CENTER.spherical_offsets_by(*offsets)
    mosaic, *others, _ = field(sky, PIXEL / 2)
    results = []
    for factor in (1.0, 2.6):
        error = StdDevUncertainty(mosaic.uncertainty.array * factor)
        image = CCDData(
            mosaic.data, unit=mosaic.unit, uncertainty=error, wcs=mosaic.wcs, mask=mosaic.mask
        )
        results.append(photometer(PIXEL / 2).measure(image, *others))
    plain, large = (result.flux_err.value for result in results)
    np.testing.assert_allclose(large, plain, rtol=5e-3)
    # a fit with the PSF's squares on the exposure itself: sigma sqrt(4 pi) FWHM / 2.3548 / pixel
    expected = 0.02 * np.sqrt(4 * np.pi) * WIDTH / 2.3548 / PIXEL
    assert np.median(plain) == pytest.approx(expected, rel=0.25)


def test_stars_at_the_rim_of_a_mosaic_are_flagged():
    """A pixel inside of the edge of the exposure a flux is 5 % too large."""
    n = 60
    _, _, _, _, wcs = field(CENTER.reshape(1), PIXEL)
    places = np.array([(n - 1.5, 30.3), (30.0, 30.0), (0.5, 10.0)])
    sky = wcs.pixel_to_world(*places.T)
    mosaic, *others, _ = field(sky, PIXEL, flux=100.0)
    result = photometer(PIXEL).measure(mosaic, *others)
    edge = (result.flags & int(ForcedFlags.EDGE)) != 0
    assert edge.tolist() == [True, False, True]
    assert result.flux.value[1] == pytest.approx(100, rel=0.02)


def test_the_rim_is_what_lies_beside_the_footprint_alone():
    usable = np.zeros((9, 12), bool)
    usable[2:7, 3:11] = True
    usable[4, 6] = False
    rim = rim_pixels(usable)
    inner = np.zeros_like(usable)
    inner[3:6, 4:10] = True
    np.testing.assert_array_equal(rim, usable & ~inner)
    # an exposure ends with its array
    assert not rim_pixels(np.ones((5, 6), bool)).any()
