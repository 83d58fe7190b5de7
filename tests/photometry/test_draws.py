"""Draws of fluxes, correlations and the map of chi-square."""

import astropy.units as u
import numpy as np
import scipy.sparse
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.photometry.templates.normal_equations import correlated_draws


def measured(tools, rows=slice(None), **options):
    # a chain of blends, a pair, one alone and one off the image
    sky = tools.places([0, 0.25, 0.5, 0.75, 4, 4.3, -4, 600.0])
    form = {"sigma": 0.3, "rng": np.random.default_rng(2)}
    image = tools.picture(sky[:7], [9.0] * 7, (150, 150), **form)
    return tools.measured(image, QTable({"id": np.arange(10, 18), "sky": sky})[rows], **options)


def test_moments_of_draws_are_those_of_the_covariance(tools):
    result = measured(tools)
    size = 40_000
    draws = result.sample(size, seed=3)
    assert draws.shape == (size, 8)
    assert np.isnan(draws[:, 7]).all()
    flux, cov = result.flux.value[:7], result.covariance.toarray()[:7, :7]
    error = np.sqrt(np.diag(cov))
    draws = draws.to_value(u.uJy)[:, :7]
    assert_allclose((draws.mean(axis=0) - flux) / error, 0, atol=4 / np.sqrt(size))
    scale = np.outer(error, error)
    assert_allclose(np.cov(draws.T) / scale, cov / scale, atol=0.025)
    assert result.correlation(10, 11) < -0.5
    assert_allclose(result.correlation(10, 11), np.corrcoef(draws.T)[0, 1], atol=0.02)
    assert abs(result.correlation(10, 16)) < 1e-12
    assert np.isnan(result.correlation(10, 17))
    refuses("no source with the id 3", result.correlation, 10, 3, error=KeyError)


def test_draws_depend_on_the_seed_alone(tools):
    result = measured(tools)
    draws = result.sample(5, seed=3)
    assert_array_equal(measured(tools, n_threads=2).sample(5, seed=3), draws)
    assert np.all(result.sample(5, seed=4)[:, :7] != draws[:, :7])
    # a source that stands alone does not know of the rest of the catalogue
    found = []
    for rows, k in (([6, 4], 0), (slice(None), 6)):
        one = measured(tools, rows, errors=tools.WHITE)
        found.append(((one.sample(5, seed=3) - one.flux) / one.flux_err).value[:, k])
    assert_allclose(*found, rtol=1e-9)
    for size in (0, 2.5, True):
        refuses("'size' must be an integer >= 1", result.sample, size)


def test_covariances_that_are_not_positive_keep_their_variances():
    # neighbours alone of a chain with correlations of -0.8: eigenvalues below zero
    n = 30
    diagonals = np.full(n - 1, -0.8), np.ones(n), np.full(n - 1, -0.8)
    covariance = scipy.sparse.diags_array(diagonals, offsets=[-1, 0, 1]).tocsr()
    assert np.linalg.eigvalsh(covariance.toarray()).min() < 0
    draws = correlated_draws(covariance * 4.0, [(k,) for k in range(n)], 20_000, 5)
    found = np.cov(draws.T)
    assert_allclose(np.diag(found), 4.0, rtol=0.06)
    assert_allclose(np.diag(found, 1) / 4, -0.5, atol=0.12)


def test_map_of_chi_square(tools):
    # the second has a neighbour that is not in the catalogue
    sky, form = tools.places([-6.0, 6.0, 6.9]), {"sigma": 0.2, "rng": np.random.default_rng(1)}
    image = tools.picture(sky, [50.0, 50.0, 30.0], (240, 240), **form)
    image.mask = mask = np.zeros(image.shape, bool)
    mask[:30] = True
    image.data[mask] = 1e5
    result = tools.measured(image, sky[:2])
    width = tools.LO * np.sqrt(8 * np.log(2))
    assert_allclose(result.psf_fwhm.to_value(u.arcsec), width, rtol=0.01)
    chi2 = result.chi2_image
    assert chi2.unit == u.dimensionless_unscaled
    assert_array_equal(np.isnan(chi2.data), mask)
    # mean of chi-square with one degree of freedom over n = 4 pi width^2 pixels: scatter (2 / n)^1/2
    effective = 4 * np.pi * (tools.LO / 0.11) ** 2
    assert abs(np.mean(chi2.data[140:]) - 1) < 0.03
    assert_allclose(np.std(chi2.data[140:]), np.sqrt(2 / effective), rtol=0.1)
    x, y = np.rint(image.wcs.world_to_pixel(sky)).astype(int)
    assert chi2.data[y[0], x[0]] < 2
    assert chi2.data[y[1] - 4 : y[1] + 5, x[1] - 9 : x[1] + 10].max() > 10
