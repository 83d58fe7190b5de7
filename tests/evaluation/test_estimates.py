import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.evaluation import Estimate, bootstrap, sigma_mad


def mean(values):
    return values.mean(axis=-1)


@pytest.mark.parametrize(("function", "factor"), [(np.mean, 1.0), (np.median, 1.2533)])
def test_errors_of_mean_and_median_are_those_of_gaussian_samples(function, factor):
    values = np.random.default_rng(2).normal(3.0, 2.0, 2000)
    got = bootstrap(lambda v: function(v, axis=-1), values, seed=4, n_draws=4000)
    assert got.value == pytest.approx(function(values))
    # 4000 draws know the width of a Gaussian to 1.5 %, and the median is not yet one
    tolerance = 0.05 if factor == 1 else 0.15
    assert got.error == pytest.approx(factor * values.std() / np.sqrt(2000), rel=tolerance)
    assert got.low < got.value < got.high
    assert got.n == 2000


def test_intervals_hold_the_truth_in_two_thirds_of_samples():
    rng = np.random.default_rng(5)
    inside = 0
    for k in range(300):
        got = bootstrap(mean, rng.normal(size=60), seed=k, n_draws=300)
        inside += got.low <= 0 <= got.high
    # binomial error 2.7 %
    assert inside / 300 == pytest.approx(0.68, abs=0.08)


def test_values_of_one_source_are_drawn_together():
    """Three copies of a value know no more than one."""
    values = np.random.default_rng(6).normal(size=400)
    one = bootstrap(mean, values, seed=1, n_draws=2000)
    copies = bootstrap(mean, np.tile(values[:, None], 3), seed=1, n_draws=2000)
    assert copies.error == pytest.approx(one.error)
    apart = bootstrap(mean, np.tile(values, 3), seed=1, n_draws=2000)
    assert apart.error == pytest.approx(one.error / np.sqrt(3), rel=0.1)


def test_columns_are_drawn_together():
    """The ratio of a column to twice itself has no error."""
    values = np.random.default_rng(7).uniform(1, 2, 100)
    got = bootstrap(lambda a, b: mean(a) / mean(b), values, 2 * values, seed=1)
    assert (got.value, got.low, got.high) == pytest.approx((0.5, 0.5, 0.5))


def test_sources_without_a_value_are_left_out():
    got = bootstrap(lambda a, b: mean(a) + mean(b), [1, np.nan, 3], [1, 2, np.inf], seed=1)
    assert (got.value, got.n) == (2.0, 1)
    table = np.array([[1.0, np.nan], [np.nan, np.nan], [3.0, 5.0]])
    got = bootstrap(lambda v: np.nanmean(v, axis=-1), table, seed=1, n_all=4)
    assert (got.value, got.n, got.completeness) == (3.0, 2, 0.5)
    empty = bootstrap(mean, [np.nan], seed=1)
    assert np.isnan(empty.value)
    assert empty.n == 0


def test_a_ratio_that_may_be_infinite_has_an_interval():
    counts = np.r_[np.ones(2), np.zeros(98)]
    got = bootstrap(lambda a, b: a.sum(axis=-1) / b.sum(axis=-1), np.ones(100), counts, seed=1)
    assert got.value == 50
    assert got.low < 50 < got.high


def test_draws_in_pieces_are_the_same_as_with_another_seed_not():
    values = np.random.default_rng(8).normal(size=50)
    first, again, other = (bootstrap(mean, values, seed=seed) for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_shares_have_the_interval_of_wilson():
    got = Estimate.of_fraction(0, 40, n_all=80)
    assert (got.value, got.low) == (0.0, 0.0)
    assert got.high == pytest.approx(1 / 41, rel=0.02)  # z^2 / (n + z^2) for z = 1
    assert got.completeness == 0.5


def test_columns_of_other_lengths_are_refused():
    refuses("'columns' must be of one length", bootstrap, mean, [1.0, 2.0], [1.0], seed=1)


def test_sigma_mad_by_hand_and_along_an_axis():
    assert np.isnan(sigma_mad([]))
    table = np.array([[1, 2, 3, 4, 100], [0, 0, 0, 0, 0]], float)
    assert_allclose(sigma_mad(table, axis=-1), [1.48, 0.0])
    table[0, 4] = np.nan
    assert_allclose(sigma_mad(table, axis=-1, ignore_nan=True), [1.48, 0.0])
    assert np.isnan(sigma_mad(table[0]))
