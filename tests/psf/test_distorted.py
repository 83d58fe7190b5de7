import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.instrument import imager_wcs
from miricigale.psf import (
    MIRI_PIXEL_SCALE,
    gaussian_psf,
    imager_kernels,
    miri_psf,
    rotate_psf,
    undistorted_psf,
)
from miricigale.psf.distorted import moved_kernels

SMALL = {"fov": 5 * u.arcsec, "oversampling": 3}


@pytest.mark.parametrize("position", [(359.0, 0.0), (1026.0, 1023.0)])
def test_optics_without_distortion_are_the_same_everywhere(position):
    """On the sky the telescope's image does not know where on the array it falls."""
    place = miri_psf("F1500W", position=position, includes=(), **SMALL)
    plain = miri_psf("F1500W", includes=(), **SMALL)
    mended = undistorted_psf(place)
    assert mended.pixel_scale == MIRI_PIXEL_SCALE
    inner = np.s_[5:-5, 5:-5]
    peak = plain.data.max()
    assert_allclose(mended.data[inner], plain.data[inner], atol=2e-4 * peak)
    # which the cells of the place are not
    assert np.abs(place.data - plain.data).max() > 3e-3 * peak


def test_a_psf_without_a_place_is_refused():
    refuses("'psf' must be one of a place", undistorted_psf, miri_psf("F1500W", **SMALL))


@pytest.fixture(scope="module")
def field():
    wcs = imager_wcs("53.1 -27.8", 30 * u.deg)
    sharp = gaussian_psf(0.15 * u.arcsec, pixel_scale=0.06 * u.arcsec, fov=5 * u.arcsec)
    form = {"pixel_scale": 0.06 * u.arcsec, "grid_angle": 10 * u.deg, "n_psfs": 4, **SMALL}
    sharp = rotate_psf(sharp, grid_angle=10 * u.deg)
    return wcs, imager_kernels(sharp, "F1500W", wcs, 35 * u.deg, **form)


def test_kernels_of_an_exposure_hold_at_its_corners(field):
    wcs, kernels = field
    x, y = wcs.world_to_pixel(kernels.sky)
    assert_allclose(sorted(set(y.round(3))), [0, 1023])
    assert len(set(x.round(3))) == 2
    assert len({one.regularization for one in kernels.kernels}) == 1
    for one in kernels.kernels:
        assert_allclose(one.array.sum(), one.target.sum(), rtol=1e-6)


def test_kernels_of_another_dither_hold_at_the_same_pixels(field):
    wcs, kernels = field
    other = imager_wcs("53.11 -27.81", 30 * u.deg)
    moved = moved_kernels(kernels, wcs, other)
    assert_allclose(other.world_to_pixel(moved.sky), wcs.world_to_pixel(kernels.sky), atol=1e-5)
    assert moved.kernels is kernels.kernels
