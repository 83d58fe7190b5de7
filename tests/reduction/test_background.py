import numpy as np
import pytest
from astropy.nddata import CCDData, StdDevUncertainty

from miricigale.instrument import DQ
from miricigale.reduction import estimate_background, subtract_background

SHAPE = (400, 420)


def make(data, error=1.0, mask=None):
    error = np.broadcast_to(np.float32(error), data.shape).copy()
    return CCDData(data, unit="MJy/sr", uncertainty=StdDevUncertainty(error), mask=mask)


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


def test_the_mesh_alone_is_off_where_a_box_is_seen_in_part():
    x = np.mgrid[:384, :384][1]
    # 3 sigma from box to box, and half of the first boxes masked
    gradient, mask = 3 * x / 32, x < 16
    image = make(gradient + np.random.default_rng(1).normal(size=x.shape), mask=mask)
    for plane, wanted in ((True, 0.0), (False, 0.75)):
        off = (estimate_background(image, plane=plane).level - gradient).mean(axis=0)
        # the middle of what is seen is 8 of 32 pixels from the center of the box
        assert off[15:17].mean() == pytest.approx(wanted, abs=0.1)
        assert np.abs(off[48:320]).max() < 0.1


def test_sources_do_not_lift_it(noise, gradient):
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    scene = np.zeros(SHAPE)
    for _ in range(60):
        x0, y0, peak, width = *rng.uniform(10, 390, 2), 10 ** rng.uniform(1, 3), rng.uniform(1, 4)
        scene += peak * np.exp(-0.5 * ((x - x0) ** 2 + (y - y0) ** 2) / width**2)
    image = make(noise + gradient + scene)
    bare = estimate_background(image, iterations=0).level - gradient
    masked = estimate_background(image).level - gradient
    assert abs(masked.mean()) < 0.03
    assert abs(masked.mean()) < 0.5 * abs(bare.mean())
    assert np.abs(masked).max() < 0.3


def test_correlated_noise_is_no_source():
    white = np.random.default_rng(2).normal(size=SHAPE)
    smooth = (
        white + np.roll(white, 1, 0) + np.roll(white, 1, 1) + np.roll(white, (1, 1), (0, 1))
    ) / 2
    assert estimate_background(make(smooth)).source_mask.mean() < 0.01


def test_far_negative_pixels_are_masked_with_the_reason(noise):
    noise[50, 60] = -25.0
    noise[51, 90] = -8.0
    image, background = subtract_background(make(noise + 7))
    assert image.flags[50, 60] == DQ.NEGATIVE | DQ.DO_NOT_USE
    assert image.mask[50, 60]
    assert image.mask.sum() == 1
    assert image.meta["background"] == pytest.approx(7, abs=0.02)
    np.testing.assert_allclose(image.data + background.level, noise + 7, atol=1e-4)
    everything, _ = subtract_background(make(noise + 7), negative_threshold=None)
    assert not everything.mask.any()


def test_masked_pixels_do_not_count(noise):
    mask = np.zeros(SHAPE, bool)
    mask[:, :150] = True
    background = estimate_background(make(np.where(mask, 1e6, noise), mask=mask))
    assert abs(background.level[:, 150:].mean()) < 0.02


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"box": 2}, "'box' must be at least 4"),
        ({"threshold": 0}, "'threshold' must be positive"),
        ({"iterations": -1}, "'iterations' must be at least 0"),
        ({"negative_threshold": 0}, "'negative_threshold' must be positive or None"),
    ],
)
def test_bad_options_are_named(noise, options, match):
    with pytest.raises(ValueError, match=match):
        subtract_background(make(noise), **options)
