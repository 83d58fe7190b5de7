"""Images do not depend on the order of a catalog nor on how pixels are counted."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.scenes import gaussian_psf, make_catalog, make_scene, tan_wcs

SHAPE = (70, 80)
X, Y = np.array([20.3, 51.7, 60.2, 33.0]), np.array([15.1, 40.9, 22.2, 55.5])


@pytest.fixture(scope="module")
def catalog():
    """Two points and two galaxies."""
    options = {"flux": [10.0, 3.0, 20.0, 8.0], "profile": ["point", "sersic", "point", "sersic"]}
    shapes = {"radius": 0.25, "index": 1.5, "ratio": 0.6, "angle": [0.0, 25.0, 0.0, 110.0]}
    return make_catalog(tan_wcs(SHAPE, pa=20.0), X, Y, **options, **shapes)


def rendered(catalog, wcs):
    return make_scene(catalog, wcs, gaussian_psf()).render().data


def test_the_order_of_a_catalog(catalog):
    wcs = tan_wcs(SHAPE, pa=20.0)
    image = rendered(catalog, wcs)
    other = rendered(catalog[[2, 0, 3, 1]], wcs)
    assert_allclose(other, image, rtol=0, atol=1e-11 * image.max())


def test_a_grid_that_begins_whole_pixels_elsewhere(catalog):
    wcs = tan_wcs(SHAPE, pa=20.0)
    part = wcs.deepcopy()
    part.wcs.crpix -= [5, 3]
    part.pixel_shape = (SHAPE[1] - 5, SHAPE[0] - 3)
    image = rendered(catalog, wcs)
    assert_allclose(rendered(catalog, part), image[3:, 5:], rtol=0, atol=1e-6 * image.max())


def test_pixels_counted_from_the_other_corner(catalog):
    """Steps of the other sign along both axes."""
    wcs = tan_wcs(SHAPE, pa=20.0)
    turned = wcs.deepcopy()
    turned.wcs.crpix = np.array(SHAPE[::-1]) + 1 - wcs.wcs.crpix
    turned.wcs.cd = -wcs.wcs.cd
    turned.wcs.set()
    image = rendered(catalog, wcs)
    assert_allclose(rendered(catalog, turned)[::-1, ::-1], image, rtol=0, atol=1e-6 * image.max())


def test_declination_first(catalog):
    """The rows of the matrix and the names of the axes exchanged: the same pixels of the sky."""
    wcs = tan_wcs(SHAPE, pa=20.0)
    swapped = wcs.deepcopy()
    swapped.wcs.ctype = wcs.wcs.ctype[1], wcs.wcs.ctype[0]
    swapped.wcs.crval = wcs.wcs.crval[::-1]
    swapped.wcs.cd = wcs.wcs.cd[::-1]
    swapped.wcs.set()
    image = rendered(catalog, wcs)
    assert_allclose(rendered(catalog, swapped), image, rtol=0, atol=1e-9 * image.max())
