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


def test_a_bright_pixel_is_spread_by_source_extractors_filter():
    # 3 x 3 pyramid: 4 / 16 of the light in the middle, 2 / 16 at the sides, 1 / 16 at the corners
    data = np.zeros((15, 15))
    data[7, 6] = 16.0
    y, x = np.indices(data.shape)
    steps = np.abs(y - 7) + np.abs(x - 6)
    square = np.maximum(np.abs(y - 7), np.abs(x - 6)) <= 1
    for threshold, seen in ((3.99, steps == 0), (1.995, steps <= 1), (0.999, square)):
        _, labels = sep_tools.extract(data, threshold, err=np.ones_like(data), min_area=1)
        np.testing.assert_array_equal(labels > 0, seen)
    objects, _ = sep_tools.extract(data, 4.001, err=np.ones_like(data), min_area=1)
    assert len(objects) == 0


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


def crowd(side, n):
    """A square of equal stars that touch, the first at pixel (8, 8), 8 pixels apart."""
    pixel = np.arange(side)
    line = np.sum(
        [np.exp(-0.5 * ((pixel - x) / 2.2) ** 2) for x in 8 * np.arange(1, n + 1)], axis=0
    )
    return 1e4 * np.outer(line, line)


def test_more_sources_in_one_area_than_sep_has_by_default():
    # sep ends at 1024
    data = crowd(336, 40)
    objects, labels = sep_tools.extract(data, 1.0, err=np.ones_like(data), deblend_contrast=1e-5)
    assert len(objects) == labels.max() == 1600
    places = {(8 * round(x / 8), 8 * round(y / 8)) for x, y in objects[["x", "y"]]}
    assert len(places) == 1600
    for axis in "xy":
        assert np.all(np.abs(objects[axis] - 8 * np.round(objects[axis] / 8)) < 1)


def test_all_pixels_above_the_threshold_fill_no_buffer():
    data = np.full((70, 50), 9.0)
    objects, labels = sep_tools.extract(data, 1.0, err=np.ones_like(data))
    assert objects["npix"].tolist() == [3500]
    assert np.all(labels == 1)


def test_more_peaks_than_sep_can_number_are_one_sentence(monkeypatch):
    monkeypatch.setattr(sep_tools, "_SUB_OBJECTS", 3)
    data = crowd(56, 5)
    match = "less than 3 peaks in one area"
    refuses(match, lambda: sep_tools.extract(data, 1.0, err=np.ones_like(data)))
