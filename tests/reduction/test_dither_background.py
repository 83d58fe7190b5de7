import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty

from helpers.errors import refuses
from miricigale.instrument import north_up_wcs
from miricigale.reduction import (
    BackgroundSettings,
    MosaicSettings,
    Reducer,
    dither_backgrounds,
    estimate_background,
)
from miricigale.utils.units import ANGLE

SHAPE = (192, 200)
CENTER = SkyCoord(53.1344, -27.8344, unit="deg")
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
        wcs = north_up_wcs(CENTER, 0.11 * ANGLE, SHAPE)
        wcs.wcs.crpix = wcs.wcs.crpix + [dx, dy]
        data = 30 + level + ripple + scene + noise * rng.normal(size=SHAPE)
        error = StdDevUncertainty(np.full(SHAPE, noise, np.float32))
        mask = np.zeros(SHAPE, bool)
        mask[:, :5] = True
        meta = {"filter": "miri.f770w"}
        images.append(
            CCDData(data, unit="MJy/sr", uncertainty=error, mask=mask, wcs=wcs, meta=meta)
        )
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


def test_pixel_by_pixel_it_is_the_median_of_the_others():
    images, _, _ = dithers(5, noise=0.3)
    for im in images:
        im.data[60, 70] += 4
    backgrounds = [estimate_background(im) for im in images]
    found = dither_backgrounds(images, backgrounds, box=1)
    levels = [np.median(b.level[~im.mask]) for b, im in zip(backgrounds, images, strict=True)]
    stack = np.array([im.data - level for im, level in zip(images, levels, strict=True)])
    seen = ~np.any(
        [b.source_mask | im.mask for b, im in zip(backgrounds, images, strict=True)], axis=0
    )
    for k, background in enumerate(found):
        expected = np.median(np.delete(stack, k, axis=0), axis=0)
        off = (background.level - expected)[seen]
        # but for the constant of the image
        np.testing.assert_allclose(off, off[0], atol=1e-4)


def test_sources_of_the_mosaic_are_masked_where_no_image_shows_them():
    images, _, _ = dithers(6)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for im, (dx, dy) in zip(images, SHIFTS, strict=True):
        im.data -= 0.5 * np.sin(2 * np.pi * (x + 0.5 * y) / 80)
        im.data += 1.0 * np.exp(-0.5 * ((x - 100 - dx) ** 2 + (y - 96 - dy) ** 2) / 1.5**2)
    alone = [estimate_background(im) for im in images]
    deep = dither_backgrounds(images, alone)
    assert sum(b.source_mask[96, 100] for b in alone[:1]) == 0
    assert deep[0].source_mask[96, 100]
    assert deep[1].source_mask[96 + 8, 100 + 45]


def test_the_reducer_takes_backgrounds_of_dithers_in_its_second_pass():
    images, _, ripple = dithers()
    reducer = Reducer(
        background=BackgroundSettings("dithers"), mosaics=MosaicSettings(outlier_threshold=None)
    )
    pairs = [reducer.subtract_background(im) for im in images]
    result = reducer.combine(
        [im for im, _ in pairs], [b for _, b in pairs], pixel_scale=0.11 * ANGLE
    )
    assert not result.notes
    for im, background, raw in zip(result.images, result.backgrounds, images, strict=True):
        whole = im.data + background.level
        np.testing.assert_allclose(whole + im.meta["sky_offset"], raw.data, atol=1e-4)
        assert np.std((background.level - ripple)[~raw.mask]) < 0.1
    few = reducer.combine([im for im, _ in pairs[:2]], [b for _, b in pairs[:2]])
    assert any("it takes three" in note for note in few.notes)


def test_bad_input_is_named():
    images, _, _ = dithers(3)
    refuses("'images' must be at least three dithers, got 2", dither_backgrounds, images[:2])
    refuses("'box' must be at least 1", dither_backgrounds, images, box=0)
    refuses("'backgrounds' must be one for each of 3 images", dither_backgrounds, images, [])
    refuses("'method' must be 'masked' or 'sep' or 'dithers'", BackgroundSettings, "none")
