import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import norm

from helpers.errors import refuses
from miricigale.evaluation import coverage_table, posterior_ranks
from miricigale.evaluation.coverage import interval_share

LEVELS = np.linspace(0.001, 0.999, 999)


def gaussian_case(n, *, bias=0.0, width=1.0, seed=1):
    """True values, and posteriors about noisy measurements of them: quantiles at LEVELS."""
    rng = np.random.default_rng(seed)
    true = rng.normal(0, 30, n)
    measured = true + rng.normal(size=n) + bias
    return true, measured[:, None] + width * norm.ppf(LEVELS)


def test_the_share_of_an_interval_is_that_of_the_table():
    ranks = np.random.default_rng(2).uniform(size=500)
    table = coverage_table({"x": ranks}, levels=(0.5, 0.68))
    shares = [interval_share(ranks, level) for level in (0.5, 0.68)]
    assert_allclose(shares, table["share"])
    assert interval_share(np.append(ranks, np.nan)) == shares[1]


@pytest.mark.parametrize(("bias", "width"), [(0.0, 1.0), (0.0, 0.5), (1.0, 1.0)])
def test_coverage_is_that_of_gaussians(bias, width):
    true, values = gaussian_case(4000, bias=bias, width=width)
    table = coverage_table({"x": posterior_ranks(true, values, LEVELS)})
    reach = width * norm.ppf(0.5 + np.array([0.34, 0.475]))
    expected = norm.cdf(reach - bias) - norm.cdf(-reach - bias)
    close = 0.01 if (bias, width) == (0.0, 1.0) else 0.02
    assert_allclose(table["share"][0], expected[0], atol=0.02)
    assert_allclose(table["share"][1], expected[1], atol=close)
    assert np.all((table["share_low"] < table["share"]) & (table["share"] < table["share_high"]))
    expected = norm.cdf(-bias / np.hypot(1, width))
    assert table["mean_rank"][0] == pytest.approx(expected, abs=0.02)
    # uniform where the posteriors are right
    assert (table["p_uniform"][0] > 0.01) == ((bias, width) == (0, 1))


def test_truths_on_nodes_have_uniform_ranks_by_drawing_within_their_cell():
    rng = np.random.default_rng(3)
    nodes = np.arange(11)
    node = rng.integers(11, size=3000)
    # the posterior is the prior: all nodes alike
    edges = np.r_[0, nodes[:-1] + 0.5, 10]
    cdf = np.linspace(0, 1, 12)
    true = nodes[node].astype(float)
    drawn = coverage_table({"x": posterior_ranks(true, edges, cdf, seed=1)})
    assert drawn["share"][0] == pytest.approx(0.68, abs=0.03)
    assert drawn["p_uniform"][0] > 0.01
    # without it the first node always has the rank 0
    assert np.all(posterior_ranks(true, edges, cdf)[node == 0] == 0)


def test_ranks_by_hand():
    values, levels = [0.0, 1.0, 3.0], [0.0, 0.4, 1.0]
    got = posterior_ranks([0.5, 2.0, -1.0, 4.0, np.nan, 3.0], values, levels)
    assert_allclose(got, [0.2, 0.7, 0.0, 1.0, np.nan, 1.0])


def test_a_step_of_the_posterior_has_the_ranks_of_its_height():
    """A third of the posterior is at 0, as of the power of an AGN that may be none."""
    values, levels = [0.0, 0.0, 1.0, 2.0], [0.001, 1 / 3, 2 / 3, 0.999]
    assert_allclose(posterior_ranks([0.0, 1.0], values, levels), [1 / 6, 2 / 3])
    drawn = posterior_ranks(np.zeros(3000), values, levels, seed=1)
    assert (drawn.min(), drawn.max()) == pytest.approx((0, 1 / 3), abs=0.002)
    assert drawn.mean() == pytest.approx(1 / 6, abs=0.01)
    # all of it
    assert posterior_ranks([0.0], np.zeros(4), levels)[0] == 0.5


def test_posteriors_that_do_not_exist_have_no_rank():
    levels = np.array([[0.0, 0.5, 1.0], [np.nan] * 3])
    got = posterior_ranks([1.0, 1.0], [0.0, 1.0, 2.0], levels)
    assert_allclose(got, [0.5, np.nan])
    table = coverage_table({"none": [np.nan]})
    assert table["n"].tolist() == [0, 0]
    assert np.isnan(table["share"]).all()


def test_refuses():
    arguments = ([1.0, 2.0], np.zeros((3, 4)), np.zeros(4))
    refuses("'values' must be of one shape", posterior_ranks, *arguments)
    refuses("'ranks' must be between 0 and 1", coverage_table, {"x": [1.5]})
    refuses("'levels' must be between 0 and 1", coverage_table, {}, levels=(68,))
