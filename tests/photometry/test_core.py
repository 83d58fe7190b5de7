import numpy as np
import pytest
import scipy.fft
import scipy.sparse
from numpy.testing import assert_allclose
from scipy.ndimage import convolve
from scipy.special import erf

from miricigale.photometry._core.noise import autocorrelation
from miricigale.photometry._core.sampling import (
    box_response,
    convolve_batch,
    sample_stamps,
    spline_response,
)
from miricigale.photometry._core.solve import block_covariance, factorize
from miricigale.photometry._core.stamps import (
    add_model,
    convolve_stamps,
    cross_pairs,
    find_pairs,
    pair_products,
    projections,
)


@pytest.fixture
def stamps():
    """Random stamps in random boxes on an image of 60 x 70."""
    rng = np.random.default_rng(1)
    size = rng.integers(3, 12, (25, 2))
    corner = (rng.random((25, 2)) * (np.array([60, 70]) - size)).astype(int)
    corner = corner[np.argsort(corner[:, 0])]
    size = np.minimum(size, np.array([60, 70]) - corner)
    box = np.concatenate([corner, size], axis=1)
    start = np.concatenate([[0], np.cumsum(box[:, 2] * box[:, 3])])
    return box, start, rng.normal(size=start[-1]).astype(np.float32)


def dense(box, start, values, shape=(60, 70)):
    out = np.zeros((len(box), *shape))
    for k, (y, x, h, w) in enumerate(box):
        out[k, y : y + h, x : x + w] = values[start[k] : start[k + 1]].reshape(h, w)
    return out


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


def test_jacobian_keeps_the_sum():
    # a Gaussian on a stretched and curved grid
    n = 64
    y, x = np.mgrid[:n, :n] - 32
    image = np.exp(-0.5 * (x**2 + y**2) / 3.0**2)
    coefficients = convolve_batch(image[None], 1 / spline_response((n, n)), (n, n))
    poly = np.array(
        [[[32.0, 1.7, 0.2, 0.004, 0.002, -0.003], [32.0, -0.3, 1.6, 0.001, 0.0, 0.005]]]
    )
    out = np.zeros(41 * 41)
    box, start = np.array([[0, 0, 41, 41]]), np.array([0, out.size])
    sample_stamps(
        coefficients, np.zeros(1, int), np.ones(1), np.array([[20.2, 19.7]]), poly, box, start, out
    )
    assert_allclose(out.sum(), image.sum(), rtol=1e-4)


def test_pairs_are_all_that_overlap(stamps):
    box, _, _ = stamps
    for grow in (0, 3):
        found = {tuple(p) for p in find_pairs(box, grow)}
        expected = set()
        for i in range(len(box)):
            for j in range(i + 1, len(box)):
                apart = [
                    box[j, a] >= box[i, a] + box[i, a + 2] + grow
                    or box[i, a] - grow >= box[j, a] + box[j, a + 2]
                    for a in (0, 1)
                ]
                if not any(apart):
                    expected.add((i, j))
        assert found == expected


def test_pairs_of_two_sets_are_all_that_overlap(stamps):
    box, _, _ = stamps
    other = np.concatenate([box[::2] + np.array([-3, 2, 4, 1]), [[20, 20, 0, 4], [5, 5, 40, 3]]])
    other = other[np.argsort(other[:, 0], kind="stable")]
    found = [tuple(p) for p in cross_pairs(box, other)]
    expected = set()
    for i, (y0, x0, ny, nx) in enumerate(box):
        for j, (v0, u0, nv, nu) in enumerate(other):
            rows = set(range(y0, y0 + ny)) & set(range(v0, v0 + nv))
            columns = set(range(x0, x0 + nx)) & set(range(u0, u0 + nu))
            if rows and columns:
                expected.add((i, j))
    assert len(found) == len(expected) > 10
    assert set(found) == expected
    assert len(cross_pairs(box[:0], other)) == 0


def test_products_projections_and_models_are_those_of_dense_images(stamps):
    box, start, values = stamps
    images = dense(box, start, values)
    pairs = find_pairs(box)
    out = np.empty(len(pairs))
    pair_products(values, box, start, values, box, start, pairs, out)
    gram = np.einsum("iyx,jyx->ij", images, images)
    assert_allclose(out, gram[pairs[:, 0], pairs[:, 1]], rtol=1e-6, atol=1e-6)
    sky = np.random.default_rng(3).normal(size=(60, 70))
    one = np.empty(len(box))
    projections(values, box, start, sky, one)
    assert_allclose(one, np.einsum("iyx,yx->i", images, sky), atol=1e-10)
    model = np.zeros((60, 70))
    add_model(model, values, box, start, one)
    assert_allclose(model, np.einsum("i,iyx->yx", one, images), atol=1e-10)


def test_stamps_convolved_with_a_small_kernel(stamps):
    box, start, values = stamps
    kernel = np.random.default_rng(0).normal(size=(5, 5))
    kernel = kernel + kernel[::-1, ::-1]
    grown = box + np.array([-2, -2, 4, 4])
    grown_start = np.concatenate([[0], np.cumsum(grown[:, 2] * grown[:, 3])])
    out = np.full(grown_start[-1], np.nan, np.float32)
    shape = (16, 18)
    transfer = scipy.fft.rfft2(kernel, s=shape)
    rows = [k for k in range(len(box)) if k != 7]
    convolve_stamps(values, box, start, rows, transfer, shape, grown, grown_start, out)
    # those that were not asked for are not touched
    assert np.isnan(out).sum() == np.prod(grown[7, 2:])
    for k, (_, _, h, w) in enumerate(box):
        if k == 7:
            continue
        stamp = np.pad(values[start[k] : start[k + 1]].reshape(h, w), 2)
        expected = convolve(stamp.astype(float), kernel, mode="constant")
        got = out[grown_start[k] : grown_start[k + 1]].reshape(h + 4, w + 4)
        assert_allclose(got, expected, atol=1e-5)


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
