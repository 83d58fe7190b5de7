"""The door to sep."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from miricigale.utils.sep_tools import background, extract, native


def image(n_sources=4):
    """Noise of 1 on a slope, with bright Gaussians on a diagonal."""
    y, x = np.mgrid[0:120, 0:160]
    data = np.random.default_rng(5).normal(size=(120, 160))
    for i in range(n_sources):
        data += 100 * np.exp(-((x - 20 - 35 * i) ** 2 + (y - 20 - 25 * i) ** 2) / 8)
    return data


def test_native_order():
    big = np.arange(4, dtype=">f4")
    assert native(big).dtype == np.dtype("=f4")
    assert_array_equal(native(big), big)
    own = np.arange(4.0)
    assert np.shares_memory(native(own), own)
    assert native(np.arange(4, dtype=np.int64)).dtype == np.float64
    assert native(own.astype(bool)).dtype == bool


def test_background_of_a_level_with_holes():
    data = np.full((128, 128), 7.0) + np.random.default_rng(6).normal(size=(128, 128))
    data[30:40, 30:40] = np.nan
    mask = np.zeros(data.shape, bool)
    mask[70:90, 70:90] = True
    data[mask] = 1e4
    level, rms = background(data.astype(">f8"), mask, box=32)
    assert_allclose(level, 7, atol=0.4)
    assert_allclose(rms, 1, atol=0.15)


def test_extract_finds_the_sources():
    objects, segmentation = extract(image(), 5.0, err=1.0)
    assert len(objects) == 4
    order = np.argsort(objects["x"])
    assert_allclose(objects["x"][order], [20, 55, 90, 125], atol=0.1)
    assert_allclose(objects["y"][order], [20, 45, 70, 95], atol=0.1)
    assert_array_equal(np.unique(segmentation), np.arange(5))


def test_threshold_means_what_it_means_in_source_extractor():
    # with "conv" 0.25 is a level of the image; "matched" takes it for a quarter of a sigma
    data = image() * 0.02
    conv = extract(data, 0.25, min_area=5, segmentation=False)
    assert len(conv) == 4
    matched = extract(data, 0.25, err=0.02, min_area=5, filter_type="matched", segmentation=False)
    assert len(matched) > 20


def test_nan_and_bad_errors_are_masked():
    data = image()
    data[15:26, 15:26] = np.nan
    err = np.ones_like(data)
    err[40:51, 50:61] = -1
    objects = extract(data, 5.0, err=err, segmentation=False)
    assert_allclose(np.sort(objects["x"]), [90, 125], atol=0.1)


def test_refuses():
    data = image()
    with pytest.raises(ValueError, match="'data' must be a two-dimensional image"):
        background(data[0])
    with pytest.raises(ValueError, match="'mask' must be of the image's shape"):
        background(data, data[:5] > 0)
    with pytest.raises(ValueError, match="all pixels masked"):
        background(data, np.ones(data.shape, bool))
    with pytest.raises(ValueError, match="'box' must be at least 1"):
        background(data, box=0)
    with pytest.raises(ValueError, match="'filter_type' must be 'conv' or 'matched'"):
        extract(data, 1, filter_type="none")
    with pytest.raises(ValueError, match="'err' must be positive"):
        extract(data, 1, err=0)
    with pytest.raises(ValueError, match="'min_area' must be at least 1"):
        extract(data, 1, min_area=0)
