import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from numpy.testing import assert_allclose, assert_array_equal
from reproject import reproject_exact

from helpers.errors import refuses
from helpers.exposures import FIELD as CENTER
from helpers.exposures import gaussians, imager_part
from helpers.exposures import image_of as make
from helpers.mosaics import render
from miricigale.instrument import DQ, imager_wcs, mosaic_wcs, north_up_wcs, pixel_area_map
from miricigale.reduction import (
    drizzle_images,
    noise_correction,
    pixel_map,
    reject_outliers,
    weight_map,
)
from miricigale.reduction.mosaic.extended_outliers import extended_outliers
from miricigale.reduction.mosaic.mosaic import add_image

FULL = (1024, 1032)


def small_wcs(dx=0.0, dy=0.0):
    """A cut of the distorted imager, moved by pixels."""
    whole = imager_wcs(CENTER, 30 * u.deg)
    x, y = whole.wcs.crpix - 1
    return imager_part(whole.pixel_to_world(x + dx, y + dy), (600, 420), (150, 160))


def test_pixel_map_is_the_wcs():
    inside = imager_wcs(CENTER, 77 * u.deg)
    outside = north_up_wcs(CENTER, 0.06 * u.arcsec, (2700, 2700))
    x, y = pixel_map(inside, outside, FULL)
    rng = np.random.default_rng(0)
    ys, xs = rng.integers(0, 1024, 3000), rng.integers(0, 1032, 3000)
    expected = outside.all_world2pix(*inside.all_pix2world(xs, ys, 0), 0)
    assert_allclose(x[ys, xs], expected[0], atol=1e-5)
    assert_allclose(y[ys, xs], expected[1], atol=1e-5)


@pytest.mark.parametrize("scale", [0.06, 0.11])
def test_agrees_with_reproject_exact(scale):
    wcs = small_wcs()
    data = np.random.default_rng(1).normal(size=(150, 160)) + 10
    out = mosaic_wcs([wcs], scale * u.arcsec)
    shape = out.pixel_shape[::-1]
    mosaic = drizzle_images([make(data, wcs)], out)
    expected, footprint = reproject_exact((data, wcs), out, shape_out=shape)
    inner = footprint > 0.9999
    assert inner.mean() > 0.4
    assert_allclose(mosaic.image.data[inner], expected[inner], atol=2e-3)
    assert_array_equal(mosaic.image.mask, np.isnan(mosaic.image.data))
    assert np.all(mosaic.image.flags[mosaic.image.mask] == DQ.NON_SCIENCE | DQ.DO_NOT_USE)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.06, 0.11])
def test_flux_of_point_sources_is_conserved_through_the_distortion(scale):
    rng = np.random.default_rng(5)
    images, grid = [], np.mgrid[100:920:160, 100:920:160].reshape(2, -1)
    sky = imager_wcs(CENTER, 30 * u.deg).pixel_to_world(*(grid + rng.uniform(-5, 5, grid.shape)))
    truth = rng.uniform(10, 100, grid.shape[1])
    for step in range(3):
        wcs = imager_wcs(SkyCoord(CENTER.ra + step * 1.1 * u.arcsec, CENTER.dec), 30 * u.deg)
        wcs.pixel_shape = FULL[::-1]
        images.append(make(render(sky, truth, 0.22, wcs, FULL), wcs, error=1e3))
    out = mosaic_wcs([im.wcs for im in images], scale * u.arcsec)
    mosaic = drizzle_images(images, out)
    # sum(brightness * area) is the flux
    light = np.nan_to_num(mosaic.image.data) * pixel_area_map(out, out.pixel_shape[::-1]) * 1e12
    xx = np.indices(light.shape)[1]
    for x, y, flux in zip(*out.world_to_pixel(sky), truth, strict=True):
        half = round(2.2 / scale)
        x0, y0 = round(float(x)), round(float(y))
        part = np.s_[y0 - half : y0 + half + 1, x0 - half : x0 + half + 1]
        assert light[part].sum() == pytest.approx(flux, rel=1e-5)
        center = np.average(xx[part], weights=light[part])
        assert center == pytest.approx(float(x), abs=0.02)


def test_variances_are_those_of_many_draws():
    rng = np.random.default_rng(6)
    wcss = [small_wcs(dx, dy) for dx, dy in ((0, 0), (8.4, 3.3), (-5.7, 6.1))]
    out = mosaic_wcs(wcss, 0.08 * u.arcsec)
    errors = [rng.uniform(0.5, 2.0) * rng.uniform(0.8, 1.2, (150, 160)) for _ in wcss]
    maps = [pixel_map(w, out, (150, 160)) for w in wcss]
    total, total2, n = 0.0, 0.0, 60
    for _ in range(n):
        images = [
            make(rng.normal(size=e.shape) * e, w, error=e)
            for e, w in zip(errors, wcss, strict=True)
        ]
        mosaic = drizzle_images(images, out, pixel_maps=maps)
        total = total + mosaic.image.data
        total2 = total2 + mosaic.image.data.astype(float) ** 2
    good = ~mosaic.image.mask
    scatter2 = (total2 / n)[good]
    predicted = mosaic.image.uncertainty.array[good] ** 2
    assert np.mean(scatter2 / predicted) == pytest.approx(1, abs=0.02)
    # weights are inverse variances
    assert mosaic.n_images.max() == 3
    single = drizzle_images(images[:1], out, pixel_maps=maps[:1])
    alone = np.median(single.weight[single.weight > 0])
    assert np.median(mosaic.weight[mosaic.n_images == 3]) > alone


def test_parts_of_the_variance_go_through_as_those_of_the_pipeline():
    """As its resampling has it: of pixels that lie upon each other, sum(w^2 v) / sum(w)^2."""
    wcs, variance, share = small_wcs(), np.array([0.5, 2.0, 8.0]), np.array([0.1, 0.5, 0.8])
    images = [make(np.full((150, 160), 3.0), wcs, error=np.sqrt(v)) for v in variance]
    parts = {"VAR_POISSON": share * variance, "VAR_RNOISE": (1 - share) * variance}
    planes = [{k: np.full((150, 160), v[i]) for k, v in parts.items()} for i in range(3)]
    # what one alone has is left out
    planes[0]["VAR_FLAT"] = np.ones((150, 160))
    mosaic, weight = drizzle_images(images, wcs, variances=planes), 1 / variance
    found = mosaic.variances
    assert_allclose(mosaic.weight[5:-5, 5:-5], weight.sum(), rtol=1e-4)
    assert set(found) == set(parts)
    for name, part in parts.items():
        wanted = np.sum(weight**2 * part) / np.sum(weight) ** 2
        assert_allclose(found[name][5:-5, 5:-5], wanted, rtol=1e-4)


def test_noise_correction_is_that_of_large_boxes():
    rng = np.random.default_rng(7)
    for scale in (0.06, 0.11):
        wcs = small_wcs()
        out = mosaic_wcs([wcs], scale * u.arcsec)
        ratios = []
        for _ in range(12):
            image = drizzle_images([make(rng.normal(size=(150, 160)), wcs)], out).image
            n = 24
            ny, nx = (k // n * n for k in image.shape)
            boxes = image.data[:ny, :nx].reshape(ny // n, n, nx // n, n).mean(axis=(1, 3))
            errors = image.uncertainty.array[:ny, :nx].reshape(ny // n, n, nx // n, n)
            errors = np.sqrt((errors**2).sum(axis=(1, 3))) / n**2
            good = np.isfinite(boxes)
            ratios += list(boxes[good] / errors[good])
        assert np.std(ratios) == pytest.approx(image.meta["noise_correction"], rel=0.08)
    assert noise_correction(1.0, 1.0) == pytest.approx(1.5)
    assert noise_correction(1.0, 0.5) == pytest.approx(2.4)


def test_noise_correction_is_that_of_the_overlap_of_drops():
    """Noise of the sum of all output pixels over theirs in quadrature, for drops at all places of a grid."""
    step = 0.01
    for pixfrac, ratio in ((0.5, 1.0), (0.25, 1.0), (0.8, 1.0), (1.0, 0.6), (0.9, 0.5)):
        # overlap of a drop at each place with a pixel, along one axis
        places = np.arange(-3, 3, step) + step / 2
        overlap = np.minimum(places + pixfrac / 2, ratio / 2)
        overlap -= np.maximum(places - pixfrac / 2, -ratio / 2)
        overlap = np.clip(overlap, 0.0, None) / pixfrac
        # the overlaps of a drop with all output pixels add up to one: the noise of the sum is the input's
        mean = overlap.mean() * 6 / ratio
        variance = np.mean(overlap**2) * 6 / ratio
        assert mean == pytest.approx(1.0, abs=1e-3)
        # one factor of the root of the variance for each axis
        assert noise_correction(pixfrac, ratio) == pytest.approx(1 / variance, rel=2e-3)
    # drops of half the size, and no step where the two forms meet
    assert noise_correction(0.5, 1.0) == pytest.approx(1.2)
    assert_allclose([noise_correction(r, 1.0) for r in (1 - 1e-9, 1.0, 1 + 1e-9)], 1.5, rtol=1e-8)


def test_masked_pixels_and_nan_have_no_weight():
    wcs = small_wcs()
    data = np.full((150, 160), 5.0)
    mask = np.zeros(data.shape, bool)
    data[70:75, 80:85], mask[70:75, 80:85] = 1e6, True
    data[20, 20] = np.nan
    # as jwst writes pixels of which one good group was left
    error = np.full(data.shape, 0.1)
    data[30, 30], error[30, 30] = 1e6, 0.0
    image = make(data, wcs, mask=mask, error=error)
    mosaic = drizzle_images([image], mosaic_wcs([wcs], 0.06 * u.arcsec))
    good = ~mosaic.image.mask
    assert_allclose(mosaic.image.data[good], 5.0, rtol=1e-5)
    x, y = mosaic.image.wcs.world_to_pixel(wcs.pixel_to_world(82, 72))
    assert mosaic.image.mask[round(float(y)), round(float(x))]
    assert np.all(mosaic.weight[~good] == 0)


def test_weights_do_not_follow_the_data():
    rng = np.random.default_rng(8)
    wcs = small_wcs()
    data = np.full((150, 160), 50.0)
    data[60:70, 60:70] += 1000
    # errors as an observer has them, from the counts themselves
    draws = rng.poisson(data, (4, *data.shape)).astype(float)
    images = [make(counts, wcs, error=np.sqrt(np.maximum(counts, 1))) for counts in draws]
    assert np.ptp(weight_map(images[0])) / weight_map(images[0]).mean() < 0.2
    mosaic = drizzle_images(images, mosaic_wcs([wcs], 0.11 * u.arcsec)).image
    sky = np.concatenate([mosaic.data[60:85, 60:120].ravel(), mosaic.data[110:120, 60:120].ravel()])
    # 1/counts weights would lower the sky by 1
    assert abs(sky.mean() - 50) < 0.3


def test_outliers_are_masked_and_stars_are_not():
    rng = np.random.default_rng(9)
    shifts = ((0, 0), (8.4, 3.3), (-5.7, 6.1), (3.2, -7.6))
    reference = small_wcs()
    sky = reference.pixel_to_world(*rng.uniform(25, 125, (2, 25)))
    peaks = 10 ** rng.uniform(1, 3.5, 25)
    images, where = [], []
    for shift in shifts:
        wcs = small_wcs(*shift)
        data = gaussians((150, 160), *wcs.world_to_pixel(sky), peaks, 0.95)
        stars = data > 1
        error = np.sqrt(1 + data / 50)
        data = data + rng.normal(size=data.shape) * error
        ys, xs = rng.integers(30, 120, (2, 20))
        free = ~stars[ys, xs]
        data[ys[free], xs[free]] += 20
        where.append((ys[free], xs[free], stars))
        images.append(make(data, wcs, error=error))
    out = reject_outliers(images, mosaic_wcs([im.wcs for im in images], 0.11 * u.arcsec))
    for im, (ys, xs, stars) in zip(out, where, strict=True):
        flagged = (im.flags & DQ.OUTLIER) != 0
        assert flagged[ys, xs].mean() > 0.9
        assert_array_equal(flagged, im.mask)
        flagged[ys, xs] = False
        assert flagged[stars].mean() < 0.002
        assert flagged.sum() < 5
        assert im.meta["n_outliers"] >= 0.9 * len(ys)
    assert not any(im.mask is not None and np.any(im.mask) for im in images)
    assert reject_outliers(images[:2], images[0].wcs) == images[:2]


def dithers_with_faint_light(*, star_first=False):
    """Four dithers of stars, with a cloud in the second, an afterglow in the third: images, cloud, place."""
    rng = np.random.default_rng(21)
    sky = small_wcs().pixel_to_world(*rng.uniform(25, 125, (2, 25)))
    peaks = 10 ** rng.uniform(1, 3, 25)
    y, x = np.indices((150, 160))
    cloud = 0.6 * np.exp(-((x - 80) ** 2 + (y - 70) ** 2) / (2 * 12**2))
    images = []
    for k, shift in enumerate(((0, 0), (8.4, 3.3), (-5.7, 6.1), (3.2, -7.6))):
        wcs = small_wcs(*shift)
        data = gaussians((150, 160), *wcs.world_to_pixel(sky), peaks, 0.95)
        error = np.sqrt(1 + data / 50)
        data = data + rng.normal(size=data.shape) * error
        if k == 1:
            data = data + cloud
        if k == 2:
            data = data + gaussians((150, 160), [40], [110], [3.0], 1.6)
        if k == 0 and star_first:
            data = data + gaussians((150, 160), [40], [110], [2000.0], 1.6)
        image = make(data, wcs, error=error)
        image.meta["day"] = 60310.0 + 0.01 * k
        images.append(image)
    return images, cloud, (110, 40)


def test_light_too_faint_for_a_pixel_is_found_in_the_dither_that_has_it():
    images, cloud, place = dithers_with_faint_light()
    grid = mosaic_wcs([im.wcs for im in images], 0.11 * u.arcsec)
    flagged = [(im.flags & DQ.OUTLIER) != 0 for im in reject_outliers(images, grid)]
    # no pixel of the cloud is 5 sigma high, and its light is gone
    assert cloud[flagged[1]].sum() > 0.8 * cloud.sum()
    assert flagged[1][cloud < 0.01].mean() < 0.05
    assert flagged[2][place]
    assert flagged[2].sum() < 200
    assert not flagged[0].any()
    assert not flagged[3].any()


def test_noise_of_small_images_holds_no_faint_light():
    """Of 60 images with so few places of the largest scale, one in 20 seemed to hold a cloud."""
    good = np.ones((95, 100), bool)
    for seed in range(60):
        noise = np.random.default_rng(seed).normal(size=good.shape)
        assert not extended_outliers(noise, good, 5.0).any()
    assert not extended_outliers(np.full(good.shape, np.nan), ~good, 5.0).any()


def test_wide_galaxies_of_dithers_that_are_misplaced_are_no_outliers():
    """Dithers a fifth of a pixel from where they say; a galaxy whose slopes are below the noise of a pixel."""
    rng = np.random.default_rng(5)
    y, x = np.indices((150, 160))
    shifts = ((0, 0), (8.4, 3.3), (-5.7, 6.1), (3.2, -7.6))
    errors = ((0.2, 0), (-0.2, 0), (0, 0.2), (0, -0.2))
    images = []
    for shift, (x_error, y_error) in zip(shifts, errors, strict=True):
        wcs = small_wcs(*shift)
        column, row = wcs.world_to_pixel(small_wcs().pixel_to_world(80, 75))
        radius = np.hypot(x - column - x_error, (y - row - y_error) / 0.7)
        data = 200 * np.exp(-radius / 20) + rng.normal(size=x.shape)
        images.append(make(data, wcs, error=np.ones(x.shape)))
    grid = mosaic_wcs([im.wcs for im in images], 0.11 * u.arcsec)
    n_outliers = [im.meta["n_outliers"] for im in reject_outliers(images, grid)]
    assert max(n_outliers) < 30


def test_afterglow_is_told_by_the_bright_star_before_it():
    for star_first in (False, True):
        images, _, place = dithers_with_faint_light(star_first=star_first)
        grid = mosaic_wcs([im.wcs for im in images], 0.11 * u.arcsec)
        checked = reject_outliers(images, grid)
        named = [(im.flags & DQ.PERSISTENCE) != 0 for im in checked]
        assert named[2][place] == star_first
        assert not any(flags.any() for flags in (named[0], named[1], named[3]))


def test_of_two_images_none_loses_the_good_pixel():
    """Two values do not say which is the outlier: the median of two is halfway, and jwst masks both."""
    wcs = small_wcs()
    rng = np.random.default_rng(1)
    images = [make(rng.normal(size=(150, 160)), wcs) for _ in range(2)]
    images[0].data[70, 80] += 50
    for fewest in (2, 1):
        checked = reject_outliers(images[:fewest], wcs)
        assert not any(im.mask is not None and im.mask[70, 80] for im in checked)
    mosaic = drizzle_images(reject_outliers(images, wcs), wcs)
    assert mosaic.n_images[70, 80] == 2
    assert np.isfinite(mosaic.image.data[70, 80])


def test_outliers_of_fields_side_by_side_are_those_of_each_field():
    """Two pointings of three dithers that do not touch: together each is judged as alone."""
    rng = np.random.default_rng(11)
    fields, places = [], [(60, 60), (75, 62), (90, 64)]
    for east in (0.0, 400.0):
        shifts = ((east, 0.0), (east + 8.4, 3.3), (east - 5.7, 6.1))
        images = [make(rng.normal(size=(150, 160)), small_wcs(*shift)) for shift in shifts]
        for im, place in zip(images, places, strict=True):
            im.data[place] = 12.0
        fields.append(images)
    every = [im for images in fields for im in images]
    grid = mosaic_wcs([im.wcs for im in every], 0.11 * u.arcsec)
    together = reject_outliers(every, grid)
    alone = [im for images in fields for im in reject_outliers(images, grid)]
    for one, two, place in zip(together, alone, places + places, strict=True):
        assert_array_equal(one.mask, two.mask)
        assert one.mask[place]
    mosaic = drizzle_images(every, grid)
    # each pixel has the images of its own field
    assert mosaic.n_images.max() == 3
    single = drizzle_images(fields[1], grid)
    inside = single.n_images > 0
    assert_array_equal(mosaic.n_images[inside], single.n_images[inside])
    assert_allclose(mosaic.image.data[inside], single.image.data[inside], atol=1e-5)


def test_refuses_what_cannot_be_put_together():
    wcs = small_wcs()
    good = make(np.zeros((150, 160)), wcs)
    grid = mosaic_wcs([wcs], 0.11 * u.arcsec)
    refuses("'images' must be at least one image", drizzle_images, [], grid)
    other = CCDData(good.data, unit="Jy", wcs=wcs, uncertainty=StdDevUncertainty(good.data))
    refuses("'images' must be in one unit", drizzle_images, [good, other], grid)
    plain = [CCDData(good.data, unit="Jy")]
    refuses("'images' must be CCDData with uncertainty and WCS", drizzle_images, plain, grid)
    refuses("'pixfrac' must be above 0", drizzle_images, [good], grid, pixfrac=0)
    bare = grid.deepcopy()
    bare.pixel_shape = None
    refuses("'wcs' must be a WCS with a pixel_shape", drizzle_images, [good], bare)
    refuses("'wcs' must be an astropy WCS, got NoneType", drizzle_images, [good], None)
    rate = CCDData(good.data, unit="adu/s", wcs=wcs, uncertainty=StdDevUncertainty(good.data))
    refuses(r"'images' must be surface brightness .*, got unit adu", drizzle_images, [rate], grid)
    bands = [make(good.data, wcs, filter=name) for name in ("miri.f770w", "miri.f1000w")]
    refuses(r"of one filter, got miri\.f1000w, miri\.f770w", drizzle_images, bands, grid)


@pytest.mark.parametrize(("ra", "dec"), [(53.2, -27.8344), (233.1, 27.8)])
def test_a_grid_elsewhere_on_the_sky_is_refused(ra, dec):
    wcs = small_wcs()
    good = make(np.zeros((150, 160)), wcs)
    elsewhere = north_up_wcs(SkyCoord(ra, dec, unit="deg"), 0.11 * u.arcsec, (150, 150))
    refuses("'wcs' must be a grid that overlaps the images", drizzle_images, [good], elsewhere)
    if dec < 0:
        distorted = imager_wcs(SkyCoord(ra, dec, unit="deg"), 30 * u.deg)
        refuses("whose distortion can be inverted", drizzle_images, [good], distorted)
    # one that lies beside the grid adds nothing and disturbs nothing
    beside = make(np.ones((150, 160)), small_wcs(dx=2000.0))
    grid = mosaic_wcs([wcs], 0.11 * u.arcsec)
    mosaic = drizzle_images([good, beside], grid)
    assert mosaic.n_images.max() == 1
    assert np.nanmax(mosaic.image.data) == 0


def test_a_place_that_is_not_finite_loses_its_own_pixel_alone():
    wcs = north_up_wcs(SkyCoord(53, -27, unit="deg"), 0.11 * u.arcsec, (60, 60))
    rng = np.random.default_rng(3)
    image = make(rng.normal(5, 1, (60, 60)), wcs, filter="miri.f770w")
    x, y = pixel_map(wcs, wcs, (60, 60))
    x, y = x.copy(), y.copy()
    x[20, 31] = np.nan
    y[40, 7] = np.inf
    mosaic = drizzle_images([image], wcs, pixel_maps=[(x, y)])
    whole = drizzle_images([image], wcs)
    # neighbors touch a pixel by what rounding leaves
    good = mosaic.weight > 1e-6 * np.median(mosaic.weight)
    assert {tuple(place) for place in np.argwhere(~good)} == {(20, 31), (40, 7)}
    assert_allclose(mosaic.image.data[good], whole.image.data[good], atol=1e-4)


def test_an_area_far_from_that_of_the_map_is_refused(monkeypatch):
    """As drizzle 2.2.0 and 3.0.0 lose half of an image, or all of it, for one NaN of some places of a map."""

    def lose_half(sink, im, weight, *args, **planes):
        weight = np.where(np.arange(len(weight))[:, None] < 30, 0, weight)
        return add_image(sink, im, weight, *args, **planes)

    wcs = north_up_wcs(SkyCoord(53, -27, unit="deg"), 0.11 * u.arcsec, (60, 60))
    image = make(np.random.default_rng(3).normal(5, 1, (60, 60)), wcs, filter="miri.f770w")
    monkeypatch.setattr("miricigale.reduction.mosaic.mosaic.add_image", lose_half)
    for pixfrac in (1.0, 0.9):
        wanted = (
            r"'pixel_maps' must be a map that drizzle .* follows, got one of .* 18\d\d are covered"
        )
        refuses(wanted, drizzle_images, [image], wcs, pixfrac=pixfrac)


def test_a_dead_exposure_has_no_exposure_time():
    wcs = north_up_wcs(SkyCoord(53, -27, unit="deg"), 0.11 * u.arcsec, (60, 60))
    rng = np.random.default_rng(3)
    images = [
        make(rng.normal(5, 1, (60, 60)), wcs, filter="miri.f770w", exposure_time=100.0)
        for _ in range(3)
    ]
    images[1].data[...] = np.nan
    meta = drizzle_images(images, wcs).image.meta
    assert meta["exposure_time"] == 200.0
    assert meta["n_exposures"] == 2


def test_pixels_with_an_error_of_zero_have_no_weight():
    # a rate of jwst has them where one good group was left
    wcs = north_up_wcs(SkyCoord(53, -27, unit="deg"), 0.11 * u.arcsec, (60, 60))
    rng = np.random.default_rng(3)
    error = np.ones((60, 60))
    error[10, 12] = 0.0
    data = rng.normal(5, 1, (60, 60))
    data[10, 12] = 1e4
    mosaic = drizzle_images([make(data, wcs, error=error, filter="miri.f770w")], wcs)
    assert mosaic.weight[10, 12] < 1e-6 * np.median(mosaic.weight)
    assert np.count_nonzero(mosaic.weight > 1e-6 * np.median(mosaic.weight)) == 60 * 60 - 1
