import numpy as np
import pytest
from scipy.stats import norm

from helpers.errors import refuses
from miricigale.evaluation import coverage_table, posterior_ranks

LEVELS = np.linspace(0.001, 0.999, 999)


def gaussian_case(n, *, bias=0.0, width=1.0, seed=1):
    """True values, and posteriors about noisy measurements of them: quantiles at LEVELS."""
    rng = np.random.default_rng(seed)
    true = rng.normal(0, 30, n)
    measured = true + rng.normal(size=n) + bias
    return true, measured[:, None] + width * norm.ppf(LEVELS)


def rows(ranks, **kwargs):
    return coverage_table({"x": ranks}, **kwargs)


def test_right_posteriors_cover_as_they_say():
    true, values = gaussian_case(4000)
    table = rows(posterior_ranks(true, values, LEVELS))
    assert table["share"][0] == pytest.approx(0.68, abs=0.02)
    assert table["share"][1] == pytest.approx(0.95, abs=0.01)
    assert np.all((table["share_low"] < table["share"]) & (table["share"] < table["share_high"]))
    assert table["mean_rank"][0] == pytest.approx(0.5, abs=0.02)
    assert table["p_uniform"][0] > 0.01


def test_narrow_posteriors_cover_too_little():
    """Half the width: a central 68.27 % interval is one of half a sigma, 38.3 %."""
    true, values = gaussian_case(4000, width=0.5)
    table = rows(posterior_ranks(true, values, LEVELS), levels=(0.6827,))
    assert table["share"][0] == pytest.approx(0.383, abs=0.025)
    assert table["p_uniform"][0] < 1e-6


def test_biased_posteriors_have_low_ranks():
    true, values = gaussian_case(4000, bias=1.0)
    table = rows(posterior_ranks(true, values, LEVELS))
    # P(x + 1 < y) of two unit Gaussians
    assert table["mean_rank"][0] == pytest.approx(norm.cdf(-1 / np.sqrt(2)), abs=0.02)


def test_truths_on_nodes_have_uniform_ranks_by_drawing_within_their_cell():
    rng = np.random.default_rng(3)
    nodes = np.arange(11)
    node = rng.integers(11, size=3000)
    # the posterior is the prior: all nodes alike
    edges = np.r_[0, nodes[:-1] + 0.5, 10]
    cdf = np.linspace(0, 1, 12)
    true = nodes[node].astype(float)
    drawn = rows(posterior_ranks(true, edges, cdf, seed=1))
    assert drawn["share"][0] == pytest.approx(0.68, abs=0.03)
    assert drawn["p_uniform"][0] > 0.01
    # without it the first node always has the rank 0
    assert np.all(posterior_ranks(true, edges, cdf)[node == 0] == 0)


def test_ranks_by_hand():
    values, levels = [0.0, 1.0, 3.0], [0.0, 0.4, 1.0]
    got = posterior_ranks([0.5, 2.0, -1.0, 4.0, np.nan, 3.0], values, levels)
    np.testing.assert_allclose(got, [0.2, 0.7, 0.0, 1.0, np.nan, 1.0])


def test_a_step_of_the_posterior_has_the_ranks_of_its_height():
    """A third of the posterior is at 0, as of the power of an AGN that may be none."""
    values, levels = [0.0, 0.0, 1.0, 2.0], [0.001, 1 / 3, 2 / 3, 0.999]
    np.testing.assert_allclose(posterior_ranks([0.0, 1.0], values, levels), [1 / 6, 2 / 3])
    drawn = posterior_ranks(np.zeros(3000), values, levels, seed=1)
    assert (drawn.min(), drawn.max()) == pytest.approx((0, 1 / 3), abs=0.002)
    assert drawn.mean() == pytest.approx(1 / 6, abs=0.01)
    # all of it
    assert posterior_ranks([0.0], np.zeros(4), levels)[0] == 0.5


def test_posteriors_that_do_not_exist_have_no_rank():
    levels = np.array([[0.0, 0.5, 1.0], [np.nan] * 3])
    got = posterior_ranks([1.0, 1.0], [0.0, 1.0, 2.0], levels)
    np.testing.assert_allclose(got, [0.5, np.nan])
    table = coverage_table({"none": [np.nan]})
    assert table["n"].tolist() == [0, 0]
    assert np.isnan(table["share"]).all()


def test_refuses():
    with pytest.raises(ValueError, match="'values' must be of one shape"):
        posterior_ranks([1.0, 2.0], np.zeros((3, 4)), np.zeros(4))
    refuses("'ranks' must be between 0 and 1", coverage_table, {"x": [1.5]})
    refuses("'levels' must be between 0 and 1", coverage_table, {}, levels=(68,))
