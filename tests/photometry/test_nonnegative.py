"""Fluxes that are not negative, against the dense algorithm of scipy."""

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
from numpy.testing import assert_allclose, assert_array_equal

from miricigale.photometry.errors import LinearFit
from miricigale.photometry.nonnegative import nonnegative_fluxes
from miricigale.utils.exceptions import MiricigaleWarning


def problem(rng, n, overlap, n_common):
    """Templates along a line that overlap, common columns of any sign, and noisy data."""
    x = np.arange(4 * n)
    a = np.exp(-0.5 * ((x[:, None] - 4 * np.arange(n) - 1.5) / (4 * overlap)) ** 2)
    a[a < 1e-4] = 0
    common = np.cos(np.outer(x, np.arange(n_common)) * 0.1)
    truth = np.where(rng.random(n) < 0.5, 0.0, rng.exponential(3, n))
    data = a @ truth - common @ np.ones(n_common) + rng.normal(0, 1, len(x))
    return a, common, data


@pytest.mark.parametrize("n_common", [0, 1, 3])
@pytest.mark.parametrize("overlap", [0.3, 0.8, 1.2])
def test_solution_is_that_of_lawson_and_hanson(overlap, n_common):
    rng = np.random.default_rng(5)
    for n in (1, 2, 10, 60):
        a, common, data = problem(rng, n, overlap, n_common)
        normal = scipy.sparse.csr_array(a.T @ a)
        fit = LinearFit(normal, a.T @ data, a.T @ common, common.T @ common, common.T @ data)
        found = nonnegative_fluxes(fit, len(fit.rhs))
        # in the space that free parameters cannot reach
        beside = np.eye(len(data)) - common @ np.linalg.pinv(common)
        expected, _ = scipy.optimize.nnls(beside @ a, beside @ data)
        assert_allclose(found, expected, atol=1e-7 * max(1, np.abs(expected).max()))
        assert found.min() >= 0


def test_a_matrix_without_a_solution_warns():
    # chi-square falls without end along x1 = x2
    matrix = scipy.sparse.csr_array(np.array([[1.0, -2.0], [-2.0, 1.0]]))
    fit = LinearFit(matrix, np.ones(2), np.ones((2, 0)), np.ones((0, 0)), np.ones(0))
    with pytest.warns(MiricigaleWarning, match="no fluxes that are not negative"):
        assert np.isnan(nonnegative_fluxes(fit, len(fit.rhs))).all()


def test_positive_fluxes_stand_beside_the_others(tools):
    rng = np.random.default_rng(9)
    n, shape, sigma = 40, (90, 90), 0.3
    sky = tools.positions(rng, n, 3.0)
    flux = np.where(rng.random(n) < 0.5, 0.0, rng.exponential(1.0, n))
    image = tools.picture(sky, flux, shape, sigma=sigma, rng=rng)
    image.data += 0.5
    plain = tools.measured(image, sky, background_order=0)
    both = tools.measured(image, sky, background_order=0, positive=True)
    assert plain.flux_positive is None
    assert_array_equal(both.flux.value, plain.flux.value)
    assert (both.flux.value < 0).sum() > 5
    a = [tools.render(one.reshape(1), [1.0], tools.LO, image.wcs, shape).ravel() for one in sky]
    ones = np.ones(image.data.size)
    expected, _ = scipy.optimize.nnls(np.stack([*a, ones, -ones], axis=1), image.data.ravel())
    assert_allclose(both.flux_positive.value, expected[:n], atol=1e-3)
    table = both.to_table("miri.f770w")
    assert_array_equal(table["miri.f770w_flux_positive"], both.flux_positive)
