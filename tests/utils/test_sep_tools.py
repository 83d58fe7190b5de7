import numpy as np
import pytest

from helpers.errors import refuses
from helpers.exposures import gaussians
from miricigale.utils import sep_tools


@pytest.fixture
def image():
    data = np.random.default_rng(1).normal(size=(120, 150))
    return data + gaussians(data.shape, [30, 100, 105], [40, 80, 20], [60, 60, 60], 2.0)


def test_byte_order_and_layout_do_not_matter(image):
    back, rms = sep_tools.background(image, box=30)
    for other in (image.astype(">f8"), np.asfortranarray(image), image[::-1][::-1]):
        back2, rms2 = sep_tools.background(other, box=30)
        np.testing.assert_array_equal(back, back2)
        np.testing.assert_array_equal(rms, rms2)
        objects, labels = sep_tools.extract(other, 5.0, err=np.ones_like(image))
        assert len(objects) == labels.max() == 3


def test_nan_counts_as_masked(image):
    image[10:20, 10:20] = np.nan
    back, rms = sep_tools.background(image, box=30)
    assert np.all(np.isfinite([back, rms]))
    mask = np.isnan(image)
    back2, _ = sep_tools.background(np.nan_to_num(image, nan=1e9), mask, box=30)
    np.testing.assert_allclose(back, back2)
    image[38:43, 28:33] = np.nan
    objects, _ = sep_tools.extract(image, 5.0, err=np.ones_like(image))
    assert not np.any(np.hypot(objects["x"] - 30, objects["y"] - 40) < 1)


def test_float32_stays_float32(image):
    back, rms = sep_tools.background(image.astype(np.float32))
    assert back.dtype == rms.dtype == np.float32


def test_threshold_means_what_source_extractor_means():
    noise = np.random.default_rng(0).normal(size=(300, 300))
    # 3 x 3 smoothing leaves 3/8 of the noise: 1.5 sigma of the data are 4 of the smoothed
    found, _ = sep_tools.extract(noise, 1.5, err=np.ones_like(noise))
    assert len(found) < 10


def test_bad_errors_are_masked(image):
    err = np.ones_like(image)
    err[38:43, 28:33] = 0
    objects, _ = sep_tools.extract(image, 5.0, err=err)
    assert not np.any(np.hypot(objects["x"] - 30, objects["y"] - 40) < 1)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda d: sep_tools.background(d[0]), "'data' must be a two-dimensional"),
        (lambda d: sep_tools.background(d, np.zeros((2, 2))), "'mask' must be of the image"),
        (lambda d: sep_tools.background(d, np.ones(d.shape)), "'mask' must be a mask that leaves"),
        (lambda d: sep_tools.background(d, box=0), "'box' must be an integer >= 1"),
        (lambda d: sep_tools.extract(d, 1.0, err=np.ones(3)), "'err' must be of the image"),
        (lambda d: sep_tools.extract(d, 1.0, err=d, min_area=0), "'min_area' must be an"),
    ],
)
def test_bad_arguments_are_named(image, call, match):
    refuses(match, call, image)
