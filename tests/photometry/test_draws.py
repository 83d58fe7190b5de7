"""Draws of fluxes, correlations and the map of chi-square."""

import astropy.units as u
import numpy as np
import pytest
import scipy.sparse
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.instrument import north_up_wcs
from miricigale.photometry import ErrorSettings, ForcedPhotometer
from miricigale.photometry.draws import correlated_draws


def measured(tools, n_threads=1, sky=None, **options):
    shape = (150, 150)
    wcs = north_up_wcs(tools.CENTER, 0.11 * u.arcsec, shape)
    # a chain of blends, a pair, one alone and one off the image
    east = np.array([0, 0.25, 0.5, 0.75, 4, 4.3, -4, 600.0])
    where = tools.CENTER.spherical_offsets_by(east * u.arcsec, np.zeros(8) * u.arcsec)
    noise = np.random.default_rng(2).normal(0, 0.3, shape)
    image = tools.as_ccd(tools.render(where[:7], [9.0] * 7, tools.LO, wcs, shape) + noise, wcs, 0.3)
    catalog = QTable({"id": np.arange(10, 18), "sky": where})
    if sky is not None:
        catalog = catalog[sky]
    return ForcedPhotometer(tools.kernel, template="psf", n_threads=n_threads, **options).measure(
        image, catalog=catalog
    )


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
    assert_allclose(
        np.cov(draws.T) / np.outer(error, error), cov / np.outer(error, error), atol=0.025
    )
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
    few = measured(tools, sky=[6, 4], errors=ErrorSettings(correlated_noise=False))
    many = measured(tools, errors=ErrorSettings(correlated_noise=False))
    assert_allclose(
        ((few.sample(5, seed=3) - few.flux) / few.flux_err)[:, 0].value,
        ((many.sample(5, seed=3) - many.flux) / many.flux_err)[:, 6].value,
        rtol=1e-9,
    )
    for size in (0, 2.5, True):
        refuses("'size' must be an integer of at least 1", result.sample, size)
    with pytest.raises(ValueError, match="'point' must be False where no second components"):
        result.sample(3, seed=1, point=True)


def test_draws_of_components_belong_together(tools):
    # cov of (total, point) in closed form for a point and a template twice as wide
    fine = north_up_wcs(tools.CENTER, tools.FINE * u.arcsec, (201, 201))
    wcs = north_up_wcs(tools.CENTER, 0.11 * u.arcsec, (101, 101))
    sky = tools.CENTER.reshape(1)
    high = tools.render(sky, [1.0], np.hypot(0.4, tools.HI), fine, (201, 201))
    low = tools.render(sky, [50.0], np.hypot(0.4, tools.LO), wcs, (101, 101))
    result = ForcedPhotometer(tools.kernel, errors=ErrorSettings(correlated_noise=False)).measure(
        tools.as_ccd(low, wcs, 0.1),
        tools.as_ccd(high, fine, high.max() * 1e-4),
        np.ones((201, 201), int),
        QTable({"sky": sky, "components": [2]}),
    )
    total, point = (result.sample(20_000, seed=1, point=k)[:, 0].value for k in (False, True))
    host = total - point
    expected = result.joint_covariance.toarray()
    assert_allclose(np.cov(total, point), expected, rtol=0.05)
    assert np.corrcoef(host, point)[0, 1] < -0.5
    assert host.std() > total.std()


def test_covariances_that_are_not_positive_keep_their_variances():
    # neighbours alone of a chain with correlations of -0.8: eigenvalues below zero
    n = 30
    covariance = scipy.sparse.diags_array(
        [np.full(n - 1, -0.8), np.ones(n), np.full(n - 1, -0.8)], offsets=[-1, 0, 1]
    ).tocsr()
    assert np.linalg.eigvalsh(covariance.toarray()).min() < 0
    draws = correlated_draws(covariance * 4.0, [(k,) for k in range(n)], 20_000, 5)
    found = np.cov(draws.T)
    assert_allclose(np.diag(found), 4.0, rtol=0.06)
    assert_allclose(np.diag(found, 1) / 4, -0.5, atol=0.12)


def test_map_of_chi_square(tools):
    shape, sigma = (240, 240), 0.2
    wcs = north_up_wcs(tools.CENTER, 0.11 * u.arcsec, shape)
    sky = tools.CENTER.spherical_offsets_by([-6.0, 6.0] * u.arcsec, [0.0, 0.0] * u.arcsec)
    data = tools.render(sky, [50.0, 50.0], tools.LO, wcs, shape)
    # the second has a neighbour that is not in the catalogue
    data += tools.render(sky[1:].spherical_offsets_by(0.9 * u.arcsec, 0 * u.arcsec), [30.0],
                         tools.LO, wcs, shape)  # fmt: skip
    data += np.random.default_rng(1).normal(0, sigma, shape)
    mask = np.zeros(shape, bool)
    mask[:30] = True
    image = tools.as_ccd(np.where(mask, 1e5, data), wcs, sigma, mask=mask)
    result = ForcedPhotometer(tools.kernel, template="psf").measure(
        image, catalog=QTable({"sky": sky})
    )
    assert_allclose(
        result.psf_fwhm.to_value(u.arcsec), tools.LO * np.sqrt(8 * np.log(2)), rtol=0.01
    )
    chi2 = result.chi2_image
    assert chi2.unit == u.dimensionless_unscaled
    assert_array_equal(np.isnan(chi2.data), mask)
    # mean of chi-square with one degree of freedom over n = 4 pi width^2 pixels: scatter (2 / n)^1/2
    effective = 4 * np.pi * (tools.LO / 0.11) ** 2
    assert abs(np.mean(chi2.data[140:]) - 1) < 0.03
    assert_allclose(np.std(chi2.data[140:]), np.sqrt(2 / effective), rtol=0.1)
    x, y = np.rint(wcs.world_to_pixel(sky)).astype(int)
    assert chi2.data[y[0], x[0]] < 2
    assert chi2.data[y[1] - 4 : y[1] + 5, x[1] - 9 : x[1] + 10].max() > 10
