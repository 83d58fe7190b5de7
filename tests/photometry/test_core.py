import numpy as np
import pytest
import scipy.fft
import scipy.sparse
from numpy.testing import assert_allclose
from scipy.special import erf

from miricigale.photometry._core.noise import autocorrelation
from miricigale.photometry._core.sampling import (
    box_response,
    convolve_batch,
    sample_stamps,
    spline_response,
)
from miricigale.photometry._core.solve import block_covariance, factorize


def sample(image, x, y, transfer=1.0):
    """Spline of a periodic image at positions (x, y), one stamp of one pixel each."""
    coefficients = convolve_batch(image[None], transfer / spline_response(image.shape), image.shape)
    n = len(x)
    poly = np.zeros((n, 2, 6))
    poly[:, 0, 0], poly[:, 1, 0] = x, y
    poly[:, 0, 1] = poly[:, 1, 2] = 1.0
    box = np.tile([0, 0, 1, 1], (n, 1))
    out = np.zeros(n)
    sample_stamps(
        coefficients, np.zeros(n, int), np.ones(n), np.zeros((n, 2)), poly, box, np.arange(n + 1), out
    )  # fmt: skip
    return out


def test_spline_goes_through_its_nodes():
    image = np.random.default_rng(0).normal(size=(32, 32))
    y, x = (a.ravel() for a in np.mgrid[8:24, 8:24])
    assert_allclose(sample(image, x, y), image[8:24, 8:24].ravel(), atol=1e-12)


def test_spline_and_pixel_response_of_a_gaussian():
    sigma, n = 2.0, 64
    y, x = np.mgrid[:n, :n] - 31.3
    image = np.exp(-0.5 * (x**2 + y**2) / sigma**2)
    at = 31.3 + np.array([0.0, 0.37, 1.9, -3.3])
    assert_allclose(sample(image, at, at), np.exp(-((at - 31.3) ** 2) / sigma**2), atol=1e-4)
    a, b = 1.8, 0.7
    mean = sample(image, at, at, box_response(image.shape, [[a, 0], [0, b]]))

    def average(d, side):
        edge = (d[:, None] + np.array([-side, side]) / 2) / sigma / np.sqrt(2)
        return sigma * np.sqrt(np.pi / 2) * np.diff(erf(edge), axis=1)[:, 0] / side

    assert_allclose(mean, average(at - 31.3, a) * average(at - 31.3, b), atol=1e-4)


def crowded_matrix(n=900, size=300, seed=0):
    """Normal matrix of Gaussian templates of rms 3 px, scattered at random."""
    rng = np.random.default_rng(seed)
    y, x = rng.uniform(0, size, (2, n))
    distance2 = (y[:, None] - y) ** 2 + (x[:, None] - x) ** 2
    gram = np.exp(-distance2 / (4 * 3.0**2))
    gram[gram < 1e-5] = 0
    weight = rng.uniform(0.5, 2, n)
    gram = gram * weight[:, None] * weight + 1e-3 * np.eye(n)
    return scipy.sparse.csr_array(gram), y, x


def test_sparse_solution_is_the_dense_one():
    matrix, _, _ = crowded_matrix()
    rhs = np.random.default_rng(1).normal(size=(900, 2))
    solve = factorize(matrix)
    expected = np.linalg.solve(matrix.toarray(), rhs)
    assert_allclose(solve(rhs), expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
    assert_allclose(solve(rhs[:, 0]), solve(rhs)[:, 0])
    with pytest.raises(np.linalg.LinAlgError, match="not positive"):
        factorize(scipy.sparse.csr_array(np.diag([1.0, 0.0])))


@pytest.mark.parametrize("sandwich", [False, True])
def test_covariance_by_blocks_is_that_of_the_dense_inverse(sandwich):
    matrix, y, x = crowded_matrix(n=500)
    middle = crowded_matrix(n=500, seed=0)[0] * 1.7 if sandwich else None
    (found,), diagonal = block_covariance(
        matrix, y, x, core=100.0, halo=80.0, middles=[middle], exact=0
    )
    inverse = np.linalg.inv(matrix.toarray())
    assert_allclose(diagonal, np.diag(inverse), rtol=1e-4)
    expected = inverse @ middle.toarray() @ inverse if sandwich else inverse
    assert_allclose(found.diagonal(), np.diag(expected), rtol=1e-4)
    coo = found.tocoo()
    scale = np.sqrt(np.diag(expected))
    error = (coo.data - expected[coo.row, coo.col]) / scale[coo.row] / scale[coo.col]
    assert np.abs(error).max() < 1e-3
    assert abs(found - found.T).max() == 0


def test_autocorrelation_of_a_moving_average():
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(402, 402))
    image = 0.5 * (noise[1:, :] + noise[:-1, :])
    usable = rng.random(image.shape) < 0.8
    covariance, error = autocorrelation(image.__getitem__, usable, 3)
    expected = np.zeros((7, 7))
    expected[3, 3], expected[2, 3], expected[4, 3] = 0.5, 0.25, 0.25
    assert np.abs((covariance - expected) / error).max() < 4.5
    assert error.max() < 0.004
