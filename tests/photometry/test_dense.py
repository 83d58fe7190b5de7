"""Small linear algebra of the kernels compared with numpy, and steps of fits with scipy's bounded ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

from miricigale.photometry._core.dense import (
    cholesky,
    inverse_of,
    log_determinant,
    solve_factor,
)
from miricigale.photometry._core.shape_fits import _step


@pytest.fixture
def matrix():
    root = np.random.default_rng(1).normal(size=(7, 9))
    return root @ root.T


def test_systems_are_solved_as_numpy_does(matrix):
    factor, right = cholesky(matrix), np.arange(7.0)
    assert_allclose(factor @ factor.T, matrix, rtol=1e-12)
    assert_allclose(matrix @ solve_factor(factor, right), right, atol=1e-11)
    assert_allclose(inverse_of(factor) @ matrix, np.eye(7), atol=1e-11)
    assert log_determinant(factor) == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-12)


def test_a_matrix_that_is_not_positive_has_no_determinant(matrix):
    matrix[3, 3] = -1.0
    assert np.isnan(log_determinant(cholesky(matrix)))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_steps_leave_parameters_at_their_limits(matrix, sign):
    # half of chi^2 is x A x / 2 - b x, of which the bounded minimum is that of least squares
    slope = matrix @ (sign * np.linspace(-1.0, 1.0, 7))
    root = np.linalg.cholesky(matrix)
    limits = np.tile([[-9.0], [9.0]], 6)
    # the last one is at a limit, beyond which the minimum would be
    limits[:, 5] = [-9.0, 0.0] if sign > 0 else [0.0, 9.0]
    # light has none that it reaches
    low = np.append(-9.0, limits[0])
    high = np.append(9.0, limits[1])
    best = lsq_linear(root.T, np.linalg.solve(root, slope), (low - 1e-12, high + 1e-12)).x
    step, gained = _step(matrix, slope, np.zeros((1, 6)), limits, 0.0)
    assert step[6] == 0.0
    assert_allclose(step, best, atol=1e-6)
    assert gained == pytest.approx(step @ matrix @ step, rel=1e-9)
