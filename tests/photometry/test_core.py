import numpy as np
import pytest
import scipy.fft
import scipy.sparse
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.photometry._core.noise import autocorrelation
from miricigale.photometry._core.solve import block_covariance, factorize


def crowded_matrix(n=500, size=300):
    """Normal matrix of Gaussian templates of rms 3 px, scattered at random."""
    rng = np.random.default_rng(0)
    y, x = rng.uniform(0, size, (2, n))
    distance2 = (y[:, None] - y) ** 2 + (x[:, None] - x) ** 2
    gram = np.exp(-distance2 / (4 * 3.0**2))
    gram[gram < 1e-5] = 0
    weight = rng.uniform(0.5, 2, n)
    gram = gram * weight[:, None] * weight + 1e-3 * np.eye(n)
    return scipy.sparse.csr_array(gram), y, x


@pytest.mark.parametrize("sandwich", [False, True])
def test_covariance_by_blocks_is_that_of_the_dense_inverse(sandwich):
    matrix, y, x = crowded_matrix()
    middle = matrix * 1.7 if sandwich else None
    form = {"core": 100.0, "halo": 80.0, "exact": 0}
    (found,), diagonal = block_covariance(matrix, y, x, middles=[middle], **form)
    inverse = np.linalg.inv(matrix.toarray())
    assert_allclose(diagonal, np.diag(inverse), rtol=1e-4)
    expected = inverse @ middle.toarray() @ inverse if sandwich else inverse
    assert_allclose(found.diagonal(), np.diag(expected), rtol=1e-4)
    coo = found.tocoo()
    scale = np.sqrt(np.diag(expected))
    error = (coo.data - expected[coo.row, coo.col]) / scale[coo.row] / scale[coo.col]
    assert np.abs(error).max() < 1e-3
    assert abs(found - found.T).max() == 0
    singular = scipy.sparse.csr_array(np.diag([1.0, 0.0]))
    refuses("not positive", factorize, singular, error=np.linalg.LinAlgError)


def test_autocorrelation_of_a_moving_average():
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(402, 402))
    image = 0.5 * (noise[1:, :] + noise[:-1, :])
    usable = rng.random(image.shape) < 0.8
    strips = [slice(0, 256), slice(256, 402)]
    covariance, error = autocorrelation(lambda rows: (image[rows], usable[rows]), strips, 3)
    expected = np.zeros((7, 7))
    expected[3, 3], expected[2, 3], expected[4, 3] = 0.5, 0.25, 0.25
    assert np.abs((covariance - expected) / error).max() < 4.5
    assert error.max() < 0.004
