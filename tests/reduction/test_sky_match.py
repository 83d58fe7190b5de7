import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.exposures import FIELD, gaussians, image_of
from miricigale.instrument import DQ, mosaic_wcs, north_up_wcs
from miricigale.reduction import MosaicSettings, Reducer, match_levels, sky_offsets

SHAPE = (160, 170)


def dither(dx, dy, level, *, rng, sources=()):
    wcs = north_up_wcs(FIELD, 0.11 * u.arcsec, SHAPE)
    wcs.wcs.crpix = wcs.wcs.crpix - [dx, dy]
    x, y, peaks = np.reshape(sources, (-1, 3)).T
    data = level + rng.normal(size=SHAPE) + gaussians(SHAPE, x - dx, y - dy, peaks, 1.5)
    return image_of(data, wcs, filter="miri.f770w")


def test_levels_are_those_put_in_whatever_the_sources():
    rng = np.random.default_rng(1)
    levels = np.array([0.0, 0.8, -1.5, 0.3])
    sources = [(*rng.uniform(10, 150, 2), 10 ** rng.uniform(1, 3)) for _ in range(40)]
    shifts = [(0, 0), (13.4, 5.2), (-20.7, 9.1), (6.5, -30.3)]
    pairs = zip(shifts, levels, strict=True)
    images = [dither(*shift, level, rng=rng, sources=sources) for shift, level in pairs]
    grid = mosaic_wcs([im.wcs for im in images], 0.11 * u.arcsec)
    offsets = sky_offsets(images, grid)
    # some 300 cells of 64 pixels: 0.01 each
    assert_allclose(offsets, levels - levels.mean(), atol=0.03)
    assert offsets.sum() == pytest.approx(0, abs=1e-9)
    for im, raw, offset in zip(match_levels(images, grid), images, offsets, strict=True):
        assert_allclose(im.data + offset, raw.data)
        assert im.meta["sky_offset"] == pytest.approx(offset)


def test_images_that_touch_by_way_of_others_are_matched_and_others_are_left():
    rng = np.random.default_rng(2)
    # a chain of three, and one far away
    steps = (0, 0.0), (110, 1.0), (220, 3.0), (900, 50.0)
    images = [dither(dx, 0, level, rng=rng) for dx, level in steps]
    grid = mosaic_wcs([im.wcs for im in images], 0.11 * u.arcsec)
    offsets = sky_offsets(images, grid)
    assert_allclose(offsets[:3], np.array([0, 1, 3]) - 4 / 3, atol=0.1)
    assert offsets[3] == pytest.approx(0, abs=1e-9)


def test_images_that_are_one_and_the_same_do_not_hide_the_others():
    rng = np.random.default_rng(4)
    one, other = (dither(dx, 0, level, rng=rng) for dx, level in ((0, 0.0), (20, 3.0)))
    grid = mosaic_wcs([one.wcs, other.wcs], 0.11 * u.arcsec)
    offsets = sky_offsets([one, one, other], grid)
    assert_allclose(offsets, [-1, -1, 2], atol=0.05)
    assert_array_equal(sky_offsets([one, one], grid), 0)


def test_levels_are_matched_before_outliers_are_searched():
    rng = np.random.default_rng(3)
    shifts = [(0, 0), (13, 5), (-20, 9), (6, -30)]
    pairs = zip(shifts, (0, 0, 0, 8), strict=True)
    images = [dither(*shift, level, rng=rng) for shift, level in pairs]
    images[1].data[80, 80] += 30
    grid = mosaic_wcs([im.wcs for im in images], 0.11 * u.arcsec)
    mosaic, used = Reducer().drizzle(images, grid)
    assert used[1].flags[80, 80] & DQ.OUTLIER
    # without, the fourth is an outlier everywhere
    assert max(im.meta["n_outliers"] for im in used) < 20
    _, plain = Reducer(mosaics=MosaicSettings(match_sky=False)).drizzle(images, grid)
    assert plain[3].meta["n_outliers"] > 1000
    inner = mosaic.n_images == 4
    assert abs(np.median(mosaic.image.data[inner]) - 2) < 0.02
