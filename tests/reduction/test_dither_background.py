import warnings

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from helpers.exposures import FIELD, gaussians, image_of
from miricigale.instrument import north_up_wcs
from miricigale.reduction import (
    BackgroundSettings,
    MosaicSettings,
    Reducer,
    dither_backgrounds,
    estimate_background,
)
from miricigale.reduction.mosaic.outliers import nan_median
from miricigale.utils.units import ANGLE

SHAPE = (192, 200)
SHIFTS = [(0, 0), (45, 8), (-40, 20), (12, -48), (-20, -35), (30, 42)]


def dithers(number=6, *, galaxy=0.0, noise=1.0, levels=None, seed=1):
    """Images with a ripple that stays on the detector, and a wide galaxy that moves; truth of the ripple."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    ripple = 0.5 * np.sin(2 * np.pi * (x + 0.5 * y) / 80)
    levels = np.zeros(number) if levels is None else levels
    images, scenes = [], []
    for (dx, dy), level in zip(SHIFTS[:number], levels, strict=True):
        r = np.hypot(x - 100 - dx, y - 96 - dy)
        scene = galaxy * np.exp(-r / 9)
        wcs = north_up_wcs(FIELD, 0.11 * ANGLE, SHAPE)
        wcs.wcs.crpix = wcs.wcs.crpix + [dx, dy]
        data = 30 + level + ripple + scene + noise * rng.normal(size=SHAPE)
        mask = np.zeros(SHAPE, bool)
        mask[:, :5] = True
        images.append(image_of(data, wcs, error=noise, mask=mask, filter="miri.f770w"))
        scenes.append(scene)
    return images, scenes, ripple


def test_what_stays_on_the_detector_goes_and_the_levels_are_each_image_s_own():
    levels = np.array([0.0, 1.5, -2.0, 0.5, 3.0, -1.0])
    images, _, ripple = dithers(levels=levels)
    found = dither_backgrounds(images)
    for background, level, im in zip(found, levels, images, strict=True):
        off = (background.level - 30 - level - ripple)[~im.mask]
        assert abs(off.mean()) < 0.03
        # the mesh of one image does not follow it at all
        alone = (estimate_background(im).level - 30 - level - ripple)[~im.mask]
        assert off.std() < 0.1
        assert alone.std() > 0.3
        assert 0.95 < np.median(background.rms) < 1.1


def test_light_of_a_wide_galaxy_is_left_to_it():
    """The mesh of a single image, which tells structure of the detector from galaxies by nothing, takes more."""
    images, scenes, ripple = dithers(galaxy=0.8)

    def taken(backgrounds):
        shares = [
            ((b.level - 30 - ripple)[scene > 0.05]).sum() / scene.sum()
            for b, scene in zip(backgrounds, scenes, strict=True)
        ]
        return np.sqrt(np.mean(np.square(shares)))

    assert taken(dither_backgrounds(images)) < 0.12
    assert taken([estimate_background(im) for im in images]) > 0.2


def test_sources_of_the_mosaic_are_masked_where_no_image_shows_them():
    images, _, ripple = dithers(6)
    for im, (dx, dy) in zip(images, SHIFTS, strict=True):
        im.data += gaussians(SHAPE, [100 + dx], [96 + dy], [1.0], 1.5) - ripple
    alone = [estimate_background(im) for im in images]
    deep = dither_backgrounds(images, alone)
    assert sum(b.source_mask[96, 100] for b in alone[:1]) == 0
    assert deep[0].source_mask[96, 100]
    assert deep[1].source_mask[96 + 8, 100 + 45]


def test_the_reducer_takes_backgrounds_of_dithers_in_its_second_pass():
    images, _, ripple = dithers()
    mosaics = MosaicSettings(outlier_threshold=None)
    reducer = Reducer(background=BackgroundSettings("dithers"), mosaics=mosaics)
    pairs = [reducer.subtract_background(im) for im in images]
    result = reducer.combine([im for im, _ in pairs], [b for _, b in pairs])
    assert not result.notes
    for im, background, raw in zip(result.images, result.backgrounds, images, strict=True):
        whole = im.data + background.level
        assert_allclose(whole + im.meta["sky_offset"], raw.data, atol=1e-4)
        assert np.std((background.level - ripple)[~raw.mask]) < 0.1
    few = reducer.combine([im for im, _ in pairs[:2]], [b for _, b in pairs[:2]])
    assert any("it takes three" in note for note in few.notes)


def test_medians_leave_out_what_is_not_known():
    rng = np.random.default_rng(2)
    stack = rng.normal(size=(6, 40, 50)).astype(np.float32)
    stack[rng.random(stack.shape) < 0.4] = np.nan
    stack[:, 3, 4] = np.nan
    found, count = nan_median(stack)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert_allclose(found, np.nanmedian(stack, axis=0), rtol=1e-6)
    assert_array_equal(count, np.isfinite(stack).sum(axis=0))
