"""Mosaics do not depend on the order of exposures nor on where their grid begins."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.exposures import FIELD, exposure_of, image_of, imager_part, sky_of
from miricigale.detector import Detector
from miricigale.instrument import imager_wcs, mosaic_wcs
from miricigale.reduction import Reducer, drizzle_images

SHAPE = (90, 100)
#: Pixels at the edge of a grid, which get no light from drops whose centers lie beyond it.
RIM = 2


@pytest.fixture(scope="module")
def dithers():
    """Three dithers of noise, each with its own errors, and the grid of their mosaic."""
    rng = np.random.default_rng(8)
    whole, images, parts = imager_wcs(FIELD, 30 * u.deg), [], []
    x, y = whole.wcs.crpix - 1
    for dx, dy, error in ((0.0, 0.0, 1.0), (7.3, -4.6, 1.5), (-3.2, 5.9, 0.7)):
        wcs = imager_part(whole.pixel_to_world(x + dx, y + dy), (600, 420), SHAPE)
        error = error * rng.uniform(0.8, 1.2, SHAPE)
        images.append(image_of(5.0 + error * rng.normal(size=SHAPE), wcs, error=error))
        parts.append(wcs)
    return images, mosaic_wcs(parts, 0.09 * u.arcsec)


def assert_same_mosaic(mosaic, other, inside=(slice(None), slice(None)), rim=0):
    """Data to 3e-5 of the errors (single precision), errors to 1e-5, and the same pixels without data."""
    image, whole = mosaic.image, other.image
    error = whole.uncertainty.array[inside]
    good = ~whole.mask[inside]
    good[:rim] = good[:, :rim] = False
    assert good.mean() > 0.3
    np.testing.assert_array_equal(image.mask, whole.mask[inside])
    change = (image.data - whole.data[inside]) / error
    assert_allclose(change[good], 0.0, atol=3e-5)
    assert_allclose(image.uncertainty.array[good], error[good], rtol=1e-5)


@pytest.mark.parametrize("order", [(2, 0, 1), (1, 2, 0)])
def test_dithers_in_another_order(dithers, order):
    images, grid = dithers
    mosaic = drizzle_images([images[k] for k in order], grid)
    assert_same_mosaic(mosaic, drizzle_images(images, grid))


def test_a_grid_that_begins_whole_pixels_elsewhere(dithers):
    images, grid = dithers
    nx, ny = grid.pixel_shape
    part = grid.deepcopy()
    part.wcs.crpix -= [11, 6]
    part.pixel_shape = (nx - 11, ny - 6)
    inside = slice(6, None), slice(11, None)
    cut, whole = drizzle_images(images, part), drizzle_images(images, grid)
    assert_same_mosaic(cut, whole, inside, rim=RIM)


def test_an_exposure_of_two_integrations_is_that_of_each():
    """Slopes are the mean of those of both, weighted by their variances."""
    exposure = exposure_of(n_groups=12, n_integrations=2, subarray="SUB64")
    light = np.full(exposure.shape, 20.0)
    ramp = Detector.miri_imager().expose(sky_of(exposure, light), exposure, seed=3)
    reducer = Reducer()
    both = reducer.fit_ramp(ramp)
    singles = [reducer.fit_ramp(ramp[k]) for k in range(2)]
    usable = ~(both.mask | singles[0].mask | singles[1].mask)
    rates = [one.data[usable] for one in singles]
    errors = [one.uncertainty.array[usable] for one in singles]
    mean, error = both.data[usable], both.uncertainty.array[usable]
    low, high = np.minimum(*rates), np.maximum(*rates)
    assert np.all((mean >= low - 1e-4 * error) & (mean <= high + 1e-4 * error))
    weight = [one**-2.0 for one in errors]
    wanted = (weight[0] * rates[0] + weight[1] * rates[1]) / (weight[0] + weight[1])
    assert np.median(np.abs(mean - wanted) / error) < 0.05
    assert_allclose(np.median(error * np.sqrt(weight[0] + weight[1])), 1.0, rtol=0.02)
