import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.stats import SigmaClip
from numpy.testing import assert_allclose, assert_array_equal
from photutils.background import SExtractorBackground
from scipy.ndimage import gaussian_filter

from helpers.cases import cases_of
from helpers.errors import refuses, warned
from helpers.exposures import gaussians
from helpers.exposures import image_of as make
from miricigale.instrument import DQ, north_up_wcs
from miricigale.reduction import (
    BackgroundFlags,
    Reducer,
    drizzle_images,
    estimate_background,
    remove_background,
)
from miricigale.reduction.images.cells import smoothed_cells
from miricigale.reduction.images.images import plain_mask
from miricigale.reduction.sky.sky_mesh import sky_boxes
from miricigale.utils import sep_tools
from miricigale.utils.exceptions import MiricigaleWarning

SHAPE = (400, 420)


def test_smoothed_cells_have_the_noise_of_a_gaussian_at_the_edge_too():
    rng = np.random.default_rng(3)
    cells = rng.standard_normal((400, 400)).astype(np.float32)
    smooth, covered = smoothed_cells(cells, np.ones(cells.shape, np.float32), 2.0)
    # white noise keeps 1 / (4 pi width^2) of its variance, at an edge half of that, which is divided out
    expected = (4 * np.pi * 2.0**2) ** -0.5
    assert_allclose(smooth[20:-20, 20:-20].std(), expected, rtol=0.03)
    assert_allclose(smooth[0].std(), expected, rtol=0.2)
    assert covered[20:-20, 20:-20].all()


def subtracted(image, **options):
    """Image less its background, and that."""
    negative = {name: options.pop(name) for name in list(options) if name.startswith("negative")}
    background = estimate_background(image, **options)
    return remove_background(image, background, **negative), background


@pytest.fixture
def noise():
    return np.random.default_rng(4).normal(size=SHAPE)


@pytest.fixture
def gradient():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    # 5 % per arcmin of a background of 100 sigma, pixels of 0.11"
    return 100 * (1 + 0.05 * 0.11 / 60 * ((x - 200) + (y - 200)) / np.sqrt(2))


def test_recovers_a_gradient(noise, gradient):
    background = estimate_background(make(noise + gradient))
    residual = background.level - gradient
    # also at the corners, where a box is 0.3 sigma from the next; each box of 32 x 32 pixels
    # knows its mean to 1/32 sigma, the median filter helps
    assert abs(residual.mean()) < 0.01
    assert residual.std() < 0.06
    assert np.abs(residual).max() < 0.2
    assert np.median(background.rms) == pytest.approx(1, rel=0.02)
    assert background.source_mask.mean() < 0.01


@pytest.mark.parametrize(("share", "n_skewed"), [(0.0, 0), (0.1, 0), (0.3, 2), (0.35, 3)])
def test_mode_of_a_box_is_that_of_photutils(share, n_skewed):
    """Boxes of noise, a share of whose pixels holds light of sources."""
    rng = np.random.default_rng(6)
    values = rng.normal(size=(64, 96)) + 7.0
    values += rng.uniform(2.0, 6.0, values.shape) * (rng.random(values.shape) < share)
    boxes = sky_boxes(values, np.zeros(values.shape, bool), 32, mode=True)
    median = sky_boxes(values, np.zeros(values.shape, bool), 32)
    clip = SigmaClip(3.0, maxiters=None, cenfunc="median", stdfunc="std")
    skewed = 0
    for i, j in np.ndindex(2, 3):
        box = values[32 * i : 32 * i + 32, 32 * j : 32 * j + 32]
        kept = clip(box, masked=False)
        mean, middle = kept.mean(), np.median(kept)
        is_skewed = abs(mean - middle) > 0.3 * kept.std()
        wanted = middle if is_skewed else 2.5 * middle - 1.5 * mean
        assert boxes.level[i, j] == pytest.approx(wanted, abs=1e-12)
        assert boxes.level[i, j] == pytest.approx(
            SExtractorBackground(sigma_clip=clip)(box), abs=1e-12
        )
        assert median.level[i, j] == pytest.approx(middle, abs=1e-12)
        assert boxes.count[i, j] == kept.size
        skewed += is_skewed
    assert skewed == n_skewed


@pytest.mark.parametrize("scale", [1e-3, 1.0, 200.0])
def test_surface_through_boxes_leaves_sources_out_in_any_unit(scale):
    """A plane, 3 % of whose boxes hold the light of a source: the same plane in every unit."""
    y, x = np.mgrid[:320, :320]
    plane = 5.0 + 0.01 * x - 0.02 * y
    values = plane + np.random.default_rng(3).normal(size=plane.shape)
    for i, j in ((64, 32), (160, 256), (288, 96)):
        values[i : i + 32, j : j + 32] += 8.0
    boxes = sky_boxes(scale * values, np.zeros(values.shape, bool), 32)
    surface, _ = boxes.surface(boxes.level, values.shape)
    assert_allclose(surface / scale, plane, atol=0.1)


def test_clipping_leaves_the_width_of_a_gaussian():
    values = np.random.default_rng(9).normal(4.0, 2.0, (640, 640))
    boxes = sky_boxes(values, np.zeros(values.shape, bool), 640)
    assert boxes.spread.item() == pytest.approx(2.0, rel=5e-3)
    assert boxes.error.item() == pytest.approx(2.0 * np.sqrt(np.pi / 2) / 640, rel=0.01)


def test_the_mesh_alone_is_off_where_a_box_is_seen_in_part():
    x = np.mgrid[:384, :384][1]
    # 3 sigma from box to box, and half of the first boxes masked
    gradient, mask = 3 * x / 32, x < 16
    image = make(gradient + np.random.default_rng(1).normal(size=x.shape), mask=mask)
    for plane, wanted in ((True, 0.0), (False, 0.75)):
        off = (estimate_background(image, plane=plane, box=32).level - gradient).mean(axis=0)
        # the middle of what is seen is 8 of 32 pixels from the center of the box
        assert off[15:17].mean() == pytest.approx(wanted, abs=0.1)
        assert np.abs(off[48:320]).max() < 0.1


def test_the_mesh_alone_does_not_take_a_gradient_for_sources():
    y, x = np.mgrid[:512, :512]
    # 2 sigma from box to box; the corner is hidden as that of the coronagraphs is
    gradient, mask = (x + y) / 32, (x < 140) & (y > 300)
    image = make(gradient + np.random.default_rng(2).normal(size=x.shape), mask=mask)
    for plane in (True, False):
        background = estimate_background(image, plane=plane)
        assert background.source_mask.mean() < 0.01
        off = (background.level - gradient)[~mask]
        assert abs(np.median(off)) < 0.02
        assert np.quantile(np.abs(off), 0.9) < 0.4


def test_fine_pixels_of_a_mosaic_are_masked_as_coarse_ones_are():
    """Of two drizzles of the same dithers both have the sky that was put in, of the sources the same part."""
    rng = np.random.default_rng(7)
    center, shape = SkyCoord(53.1, -27.8, unit="deg"), (320, 320)
    # their wings are what lifts a background
    (east, north), peaks = rng.uniform(-16, 16, (2, 120)), 10 ** rng.uniform(0, 2.5, 120)
    images = []
    for _ in range(4):
        wcs = north_up_wcs(center, 0.11 * u.arcsec, shape)
        wcs.wcs.crpix = wcs.wcs.crpix + rng.uniform(-5, 5, 2)
        y, x = np.mgrid[: shape[0], : shape[1]]
        data = 20 + rng.normal(size=shape)
        for dx, dy, peak in zip(east, north, peaks, strict=True):
            x0, y0 = wcs.wcs.crpix - 1 + np.array([dx, dy]) / 0.11
            data += peak / (1 + ((x - x0) ** 2 + (y - y0) ** 2) / 4) ** 2
        images.append(make(data, wcs))
    found = {}
    for scale in (0.11, 0.055):
        n = int(33 / scale)
        grid = north_up_wcs(center, scale * u.arcsec, (n, n))
        mosaic = drizzle_images(images, grid).image
        background = estimate_background(mosaic, box=int(7 / scale))
        seen = ~plain_mask(mosaic)
        noise = np.median(mosaic.uncertainty.array[seen])
        assert np.median(background.rms[seen]) == pytest.approx(noise, rel=0.15)
        off = np.median(background.level[seen]) - 20
        assert abs(off) < 0.05 * noise
        found[scale] = off, background.source_mask.mean()
    assert found[0.055][0] == pytest.approx(found[0.11][0], abs=0.01)
    assert found[0.055][1] == pytest.approx(found[0.11][1], rel=0.1)


def test_correlated_noise_is_no_source():
    white = np.random.default_rng(2).normal(size=SHAPE)
    smooth = sum(np.roll(white, step, (0, 1)) for step in np.ndindex(2, 2)) / 2
    assert estimate_background(make(smooth)).source_mask.mean() < 0.01


def test_far_negative_pixels_are_masked_with_the_reason(noise):
    noise[50, 60] = -25.0
    noise[51, 90] = -8.0
    image, background = subtracted(make(noise + 7))
    assert image.flags[50, 60] == DQ.NEGATIVE | DQ.DO_NOT_USE
    assert image.mask[50, 60]
    assert image.mask.sum() == 1
    assert image.meta["background"] == pytest.approx(7, abs=0.02)
    assert image.meta["background_error"] == np.float32(np.median(background.error))
    assert image.meta["background_flags"] == []
    assert_allclose(image.data + background.level, noise + 7, atol=1e-4)
    everything, _ = subtracted(make(noise + 7), negative_threshold=None)
    assert not everything.mask.any()


def test_masked_pixels_do_not_count(noise):
    mask = np.zeros(SHAPE, bool)
    mask[:, :150] = True
    background = estimate_background(make(np.where(mask, 1e6, noise), mask=mask))
    assert abs(background.level[:, 150:].mean()) < 0.02


@pytest.mark.parametrize(("options", "match"), cases_of(__file__, "refused"))
def test_bad_options_are_named(noise, options, match):
    refuses(match, subtracted, make(noise), **options)


def blobs(shape, number, peak, width):
    """Gaussians on random places."""
    x, y = np.random.default_rng(0).uniform(0, 1, (number, 2)).T
    return gaussians(shape, shape[1] * x, shape[0] * y, np.full(number, peak), width)


def test_a_crowded_field_is_told_and_its_error_holds():
    shape = (256, 256)
    noise = np.random.default_rng(1).normal(size=shape)
    image = make(50 + noise + blobs(shape, 1500, 100, 3))
    match = "the background of .* cannot be trusted .* Light of sources"
    background = warned(match, estimate_background, image)
    assert background.flags & BackgroundFlags.CONFUSED
    assert not background.trusted
    off = background.level - 50
    assert np.all(np.abs(off) < 2 * background.error)
    # no place is dark, but far from the mean of the light, 50 above
    assert np.median(off) < 0.4 * np.median(image.data - 50)


def test_a_galaxy_that_fills_the_frame_is_told():
    y, x = np.mgrid[:64, :72]
    light = 60 * np.exp(-np.hypot(x - 36, y - 32) / 16)
    image = make(5 + light + np.random.default_rng(2).normal(size=light.shape) * 0.05, error=0.05)
    with pytest.warns(MiricigaleWarning, match="cannot be trusted") as told:
        background = estimate_background(image)
    assert len(told) == 1
    # the darkest corner has 3.9 of its light
    assert np.abs(np.median(background.level) - 5 - 3.9) < 2
    assert np.all(np.abs(background.level - 5) < 2 * background.error)


@pytest.mark.parametrize("number", [0, 6])
def test_the_error_is_that_of_many_draws(number):
    rng, scene = np.random.default_rng(3), blobs((192, 192), number, 300, 2)
    draws = [estimate_background(make(scene + rng.normal(size=scene.shape))) for _ in range(60)]
    assert all(background.trusted for background in draws)
    levels, errors = ([getattr(b, k)[96, 96] for b in draws] for k in ("level", "error"))
    # with sources the light that masks may miss is in it too
    assert np.std(levels) * (1 if number else 0.65) < np.median(errors)
    assert np.median(errors) < np.std(levels) * (5 if number else 1.35)
    assert abs(np.mean(levels)) < 0.01


@pytest.mark.parametrize(("density", "most"), [(0.002, 0.3), (0.02, 3.0), (0.05, 6.0)])
def test_light_that_no_mask_finds_is_in_the_error(density, most):
    """Sources of two sigma in a PSF of 7 pixels: none is seen alone."""
    shape, errors = (256, 256), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        points = rng.poisson(density, shape) * 2 * 2 * np.pi * 3.0**2
        scene = gaussian_filter(points, 3.0, mode="wrap")
        background = estimate_background(make(30 + scene + rng.normal(size=shape)), warn=False)
        errors.append(np.median(background.error))
        assert abs(np.median(background.level) - 30) < 2 * errors[-1]
    assert np.median(errors) < most


def test_structure_as_dark_as_bright_is_not_taken_for_sources():
    """Waves of the detector, finer than the mesh, are in the error and not in the level."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    wave = 0.4 * np.sin(2 * np.pi * x / 24) * np.sin(2 * np.pi * y / 24)
    background = estimate_background(make(7 + wave + np.random.default_rng(5).normal(size=SHAPE)))
    assert background.trusted
    assert np.median(background.level) == pytest.approx(7, abs=0.02)
    assert 0.05 < np.median(background.error) < 0.4


@pytest.mark.parametrize(("width", "most"), [(1.2, 0.003), (5.0, 0.01)])
def test_the_background_takes_no_light_of_sources(width, most):
    """With the same noise with and without the sources: the share within ten widths."""
    noise = np.random.default_rng(5).normal(size=SHAPE)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    places = [(80, 90), (90, 320), (210, 200), (320, 100), (330, 330)]
    distance = [np.hypot(x - x0, y - y0) for y0, x0 in places]
    # exponential light, as of galaxies
    flux = 4e4
    scene = sum(flux * np.exp(-r / width) / (2 * np.pi * width**2) for r in distance)
    level = estimate_background(make(7 + noise + scene)).level
    without = estimate_background(make(7 + noise)).level
    taken = [(level - without)[r < 10 * width].sum() / flux for r in distance]
    assert abs(np.mean(taken)) < most


def test_the_plain_mesh_is_that_of_sep(noise):
    data = noise + blobs(SHAPE, 100, 30, 2) + 20
    background = estimate_background(make(data), method="sep", box=32, filter_size=3)
    level, rms = sep_tools.background(data, None, 32, 3)
    assert_array_equal(background.level, level.astype(np.float32))
    assert_array_equal(background.rms, rms.astype(np.float32))
    assert not background.source_mask.any()


def test_the_plain_mask_of_negative_pixels_is_by_key_and_counted(noise):
    error = np.ones(SHAPE)
    noise[50, 60], noise[51, 90], error[51, 90] = -25.0, -25.0, 10.0
    image, _ = subtracted(make(noise + 7, error=error))
    assert image.meta["n_negative"] == 1
    assert not image.mask[51, 90]
    plain, background = subtracted(make(noise + 7, error=error), negative_noise="background")
    assert plain.meta["n_negative"] == 2
    assert_array_equal(plain.mask, plain.data < -10 * background.rms)


def test_a_level_that_is_not_known_is_not_taken_off():
    """Light that fills the image, of 409 +- 460 where the sky is 5, stays in it with a warning."""
    rng = np.random.default_rng(3)
    shape = (256, 256)
    nebula = gaussians(shape, [128], [120], [1000.0], [100.0])
    sky = (5.0 + rng.normal(0, 0.1, shape)).astype(np.float32)
    image, background = warned(
        r"MJy / sr .*leaves the sky in the image",
        Reducer().subtract_background,
        make((sky + nebula).astype(np.float32)),
    )
    assert BackgroundFlags.UNKNOWN in background.flags
    assert_array_equal(background.level, 0)
    assert_allclose(image.data, sky + nebula, rtol=1e-6)
    image, background = Reducer().subtract_background(make(sky))
    assert background.trusted
    assert np.median(image.data) == pytest.approx(0.0, abs=0.01)


def test_a_sky_that_is_off_already_is_never_called_unknown():
    """Glow of 0.2 about a mean of 0 is wider than a box: its error exceeds the level, which is nothing."""
    shape = (256, 256)
    y, x = np.indices(shape)
    glow = 0.4 * np.sin(2 * np.pi * x / 60) * np.sin(2 * np.pi * y / 60)
    noise = np.random.default_rng(4).normal(0, 0.05, shape)
    image = make((glow + noise).astype(np.float32), error=0.05)
    background = estimate_background(image, warn=False)
    assert BackgroundFlags.UNKNOWN not in background.flags
