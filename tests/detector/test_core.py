import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from miricigale.detector._core.charge import add_poisson, cosmic_ray_deposits
from miricigale.detector._core.random import poisson, seed_stream, standard_normals
from miricigale.detector._core.readout import digitize, interpolate_response

KEY = np.array([11, 22, 33, 44], np.uint64)


def normals(shape, first_row=0, key=KEY):
    out = np.empty(shape)
    standard_normals(key, first_row, out)
    return out


def test_a_response_goes_on_along_its_last_piece():
    """Below, between, at and beyond the nodes of a table that bends, in a gain of 4 electrons a DN."""
    gain, step = 4.0, 10.0
    response = np.array([0.0, 9.0, 17.0, 24.0])
    linear = np.array([-5.0, 0.0, 4.0, 10.0, 25.0, 30.0, 50.0])
    expected = np.array([-4.5, 0.0, 3.6, 9.0, 20.5, 24.0, 38.0])
    ramp = np.float32(gain * linear)[None, None, None]
    interpolate_response(ramp, gain, response, step)
    assert_allclose(ramp[0, 0, 0], expected, atol=1e-5)


def test_normals_are_normal():
    sample = normals((200, 2000)).ravel()
    assert stats.kstest(sample, "norm").pvalue > 1e-3
    n = sample.size
    assert abs(sample.mean()) < 4 / np.sqrt(n)
    assert abs(sample.var() - 1) < 4 * np.sqrt(2 / n)
    assert abs(stats.skew(sample)) < 4 * np.sqrt(6 / n)
    assert abs(stats.kurtosis(sample)) < 4 * np.sqrt(24 / n)


def test_normal_tail_has_its_share():
    # beyond 3.6541 the ziggurat hands over to its tail
    sample = normals((400, 5000)).ravel()
    for limit in (3.0, 3.6541528853610088, 4.0):
        expected = sample.size * 2 * stats.norm.sf(limit)
        found = np.count_nonzero(np.abs(sample) > limit)
        assert abs(found - expected) < 4 * np.sqrt(expected)


def test_streams_of_rows_and_keys_are_apart():
    rows = normals((64, 4000))
    other = normals((64, 4000), key=KEY + np.uint64(1))
    correlation = np.corrcoef(np.vstack([rows, other]))
    np.fill_diagonal(correlation, 0)
    assert np.abs(correlation).max() < 5 / np.sqrt(4000)


@pytest.mark.parametrize("mean", [3.0, 31.0, 5000.0])
def test_single_numbers_are_poisson(mean):
    state = np.empty(4, np.uint64)
    seed_stream(state, KEY, 0, 0)
    counts = np.array([poisson(state, mean) for _ in range(500_000)])
    assert abs(counts.mean() - mean) < 4 * np.sqrt(mean / counts.size)
    spread = np.sqrt((2 + 1 / mean) / counts.size)
    assert abs(counts.var() / mean - 1) < 4 * spread


@pytest.mark.parametrize("mean", [0.05, 0.555, 3.0, 9.99, 10.0, 31.0, 161.0, 5000.0])
def test_poisson_numbers_are_poisson(mean):
    ramp = np.zeros((2, 100, 10, 100), np.float32)
    add_poisson(ramp, np.full((10, 100), mean), KEY, 0)
    counts = np.diff(ramp, axis=1, prepend=0).ravel().astype(int)
    low, high = stats.poisson.ppf([1e-3, 1 - 1e-3], mean).astype(int)
    # about 40 bins, each with many expected counts
    edges = np.unique(np.linspace(low, high, 40).astype(int))
    cdf = np.concatenate([[0], stats.poisson.cdf(edges, mean), [1]])
    expected = counts.size * np.diff(cdf)
    found = np.bincount(np.searchsorted(edges, counts), minlength=expected.size)
    keep = expected > 5
    chi2 = np.sum((found - expected)[keep] ** 2 / expected[keep])
    assert stats.chi2.sf(chi2, keep.sum() - 1) > 1e-3


def test_groups_of_any_means_are_poisson_and_independent():
    # every pixel another mean, across tables, their rests, and the means without a table
    rng = np.random.default_rng(3)
    mean = 10 ** rng.uniform(-2, 4.6, (20, 500))
    ramp = np.zeros((1, 200, 20, 500), np.float32)
    add_poisson(ramp, mean, KEY, 0)
    counts = np.diff(ramp[0].astype(float), axis=0, prepend=0)
    # beyond 2^24 the sum is no whole number in float32
    counts = counts[:, mean < 5e4]
    mean = mean[mean < 5e4]
    n = mean.size
    z = (counts - mean) / np.sqrt(mean)
    for part in np.array_split(np.argsort(mean), 8):
        # moments of Poisson numbers: 0, 1, 1 / sqrt(mean), 3 + 1 / mean
        m, size = mean[part], 200 * part.size
        assert abs(z[:, part].mean()) < 4 / np.sqrt(size)
        spread = np.sqrt((2 + np.mean(1 / m)) / size)
        assert abs(np.mean(z[:, part] ** 2) - 1) < 4 * spread
    large = mean > 1
    skew = np.mean(z[:, large] ** 3) - np.mean(mean[large] ** -0.5)
    assert abs(skew) < 4 * np.sqrt(60 / (200 * large.sum()))
    # groups next to each other, and first and last
    for lag in (1, 7, 199):
        both = z[lag:] * z[:-lag]
        assert abs(both.mean()) < 4 / np.sqrt(both.size)
    # pixels next to each other have tables in common
    both = z[:, 1:] * z[:, :-1]
    assert abs(both.mean()) < 4 / np.sqrt(both.size)
    # all groups together
    total = (counts.sum(axis=0) - 200 * mean) / np.sqrt(200 * mean)
    assert abs(total.var() - 1) < 4 * np.sqrt((2 + np.mean(1 / (200 * mean))) / n)


def test_a_pixel_draws_the_same_beside_other_rows_and_dark_columns():
    rng = np.random.default_rng(4)
    mean = 10 ** rng.uniform(0, 3, (6, 90))
    bright = np.arange(90) % 3 > 0
    mean[:, ~bright] = 0.0
    whole, part = np.zeros((2, 50, 6, 90), np.float32), np.zeros((2, 50, 2, 60), np.float32)
    add_poisson(whole, mean, KEY, 100)
    add_poisson(part, np.ascontiguousarray(mean[3:5, bright]), KEY, 103)
    assert_array_equal(whole[:, :, 3:5, bright], part)
    assert not whole[..., ~bright].any()


@pytest.mark.slow
def test_tracks_lie_in_all_directions_alike():
    # 160 hits per row, nearly each in a group of its own, along 12 pixels
    settings = (160.0, 1e6, 1.0, 0.0, 12.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    where, charge = cosmic_ray_deposits(KEY, 0, 500, (1, 2000000, 500, 500), settings)
    group, y, x = where
    # the angle of a complex second moment is twice that of the track
    start = np.flatnonzero(np.diff(group, prepend=-1))
    total, first, second = (np.add.reduceat(charge * (x + 1j * y) ** k, start) for k in range(3))
    twice = np.exp(1j * np.angle(second / total - (first / total) ** 2))
    # Rayleigh's test
    assert np.exp(-twice.size * np.abs(twice.mean()) ** 2) > 1e-3


def test_enormous_means_stay_finite():
    ramp = np.zeros((1, 3, 1, 4), np.float32)
    add_poisson(ramp, np.full((1, 4), 1e15), KEY, 0)
    assert_allclose(ramp[0, -1], 3e9, rtol=1e-3)


def test_rounding_and_limits_of_the_converter():
    values = np.array([-3.0, -0.505, -0.4, 0.49, 0.51, 1234.6, 65535.4, 65535.6, 1e6], np.float32)
    ramp = values.reshape(1, 1, 1, -1)
    counts = np.empty(ramp.shape, np.uint16)
    flags = np.zeros(ramp.shape, np.uint8)
    digitize(ramp, counts, flags, np.uint8(64), np.uint8(2))
    assert counts.ravel().tolist() == [0, 0, 0, 0, 1, 1235, 65535, 65535, 65535]
    assert flags.ravel().tolist() == [64, 64, 0, 0, 0, 0, 0, 2, 2]
