"""Weights of the differences of a ramp against the inverse of their covariance."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from miricigale.depth._core import difference_weight, weight_sums


@pytest.mark.parametrize("n", [1, 2, 3, 8, 45])
@pytest.mark.parametrize("ratio", [1e-6, 1e-2, 1.0, 300.0])
def test_weights_are_those_of_least_squares(n, ratio):
    """Differences share the read noise of the group between them: C = (v + 2 s) I - s (next to the diagonal)."""
    s = 2.5
    v = ratio * s
    covariance = (v + 2 * s) * np.eye(n) - s * (np.eye(n, k=1) + np.eye(n, k=-1))
    inverse = np.linalg.inv(covariance)
    weights = inverse.sum(axis=1)
    found = np.array([difference_weight(i, n, v, s) for i in range(1, n + 1)])
    assert_allclose(found[:, 0], weights, rtol=1e-7)
    assert_allclose(found[:, 1], np.diag(inverse), rtol=1e-7)
    assert_allclose(weight_sums(n, v, s), [weights.sum(), np.sum(weights**2)], rtol=1e-7)
