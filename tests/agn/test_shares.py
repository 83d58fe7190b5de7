"""The hierarchical sum against closed forms."""

import numpy as np
import pytest
from scipy import stats

from helpers.errors import refuses
from miricigale.agn import draw_shares, shares
from miricigale.fitting import AGNBins
from miricigale.fitting.posterior.priors import GridAxis


def two_normals(n, share, rng, prior):
    """Posteriors of objects with or without an AGN, of which x is measured as 0 or 2 with an error of 1."""
    x = rng.normal(2.0 * (rng.random(n) < share), 1.0)
    weight = np.stack([prior[0] * np.exp(-0.5 * x**2), prior[1] * np.exp(-0.5 * (x - 2.0) ** 2)], 1)
    table = weight / weight.sum(axis=1, keepdims=True)
    return table.reshape(n, 1, 2, 1)


def exact_share(table, prior):
    """Posterior mean and deviation of the share on a fine grid, with Jeffreys's prior."""
    share = (np.arange(4000) + 0.5) / 4000
    likelihood = table[:, 0, :, 0] / prior
    log = np.log(likelihood[:, :1] * (1.0 - share) + likelihood[:, 1:] * share).sum(axis=0)
    log -= 0.5 * np.log(share * (1.0 - share))
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = np.sum(weight * share)
    return mean, np.sqrt(np.sum(weight * (share - mean) ** 2))


@pytest.mark.parametrize("prior", [(0.9, 0.1), (0.5, 0.5)])
def test_draws_are_those_of_the_posterior_of_the_share(prior):
    table = two_normals(150, 0.3, np.random.default_rng(5), prior)
    mean, std = exact_share(table, prior)
    drawn = draw_shares(table, prior, n_draws=1500, seed=1).shares[:, 0, 1]
    assert drawn.mean() == pytest.approx(mean, abs=0.15 * std)
    assert drawn.std() == pytest.approx(std, rel=0.15)


def test_the_prior_of_the_fits_is_divided_out():
    drawn = []
    for prior in ((0.9, 0.1), (0.2, 0.8)):
        table = two_normals(200, 0.3, np.random.default_rng(6), prior)
        drawn.append(draw_shares(table, prior, n_draws=100, seed=2).shares)
    # the same data and likelihoods
    np.testing.assert_allclose(*drawn, atol=1e-9)


def test_intervals_hold_the_truth():
    rng = np.random.default_rng(7)
    inside = 0
    for seed in range(40):
        table = two_normals(100, 0.3, rng, (0.9, 0.1))
        drawn = draw_shares(table, (0.9, 0.1), n_draws=100, seed=seed).shares[:, 0, 1]
        low, high = np.percentile(drawn, [15.9, 84.1])
        inside += low <= 0.3 <= high
    # 27 are expected, with a scatter of 3
    assert 18 <= inside <= 36


def test_objects_without_information_change_no_share():
    prior = np.array([0.8, 0.2])
    table = two_normals(100, 0.3, np.random.default_rng(8), prior)
    empty = np.tile(prior[None, None, :, None], (100, 1, 1, 1))
    mean, std = exact_share(table, prior)
    both = draw_shares(np.concatenate([table, empty]), prior, n_draws=1500, seed=3).shares[:, 0, 1]
    assert both.mean() == pytest.approx(mean, abs=0.25 * std)


def test_sure_objects_are_counted_in_their_bins():
    table = np.zeros((30, 2, 2, 3))
    table[:10, 0, 0, 0] = table[10:25, 0, 1, 2] = table[25:, 1, 1, 1] = 1.0
    draws = draw_shares(table, [0.5, 0.5], n_draws=20, seed=1)
    assert np.all(draws.counts["galaxy"] == table.sum(axis=0))
    np.testing.assert_allclose(draws.probability["galaxy"], table, atol=1e-12)


def test_sure_objects_have_the_errors_of_a_counted_share():
    """Of 5 of 40 objects that are surely AGN, Jeffreys's interval."""
    table = np.zeros((40, 1, 4, 1))
    table[:35, 0, 0, 0] = table[35:38, 0, 1, 0] = table[38:, 0, 3, 0] = 1.0
    draws = draw_shares(table, [0.7, 0.1, 0.1, 0.1], n_draws=2500, seed=1)
    assert np.all(draws.counts["galaxy"] == table.sum(axis=0))
    share = draws.shares[:, 0, 1:].sum(axis=1)
    levels = np.array([0.16, 0.5, 0.84])
    expected = stats.beta(5.5, 35.5).ppf(levels)
    np.testing.assert_allclose(np.quantile(share, levels), expected, atol=0.003)


@pytest.mark.parametrize("n_fractions", [1, 12])
def test_bins_of_the_fraction_add_no_agn(n_fractions):
    """Data that do not tell fractions apart give the share of AGN of a single bin."""
    prior = np.array([0.9, 0.1])
    table = two_normals(60, 0.1, np.random.default_rng(11), prior)
    mean, std = exact_share(table, prior)
    split = np.repeat(table[:, :, 1:], n_fractions, axis=2) / n_fractions
    split = np.concatenate([table[:, :, :1], split], axis=2)
    own_prior = np.concatenate([prior[:1], np.full(n_fractions, prior[1] / n_fractions)])
    share = draw_shares(split, own_prior, n_draws=2000, seed=1).shares[:, 0, 1:].sum(axis=1)
    assert share.mean() == pytest.approx(mean, abs=0.15 * std)
    assert share.std() == pytest.approx(std, rel=0.15)


def test_fractions_of_a_redshift_are_drawn_to_those_of_all():
    """Against an integral over the common fraction, of two redshifts with 6 and 1 AGN."""
    numbers = np.array([[5, 1], [0, 1]])
    objects = np.repeat(np.arange(4), numbers.ravel())
    table = np.zeros((objects.size, 2, 3, 1))
    table[np.arange(objects.size), objects // 2, 1 + objects % 2, 0] = 1.0
    draws = draw_shares(table, [0.8, 0.1, 0.1], n_draws=3000, seed=1).shares
    drawn = draws[:, :, 1] / draws[:, :, 1:].sum(axis=2)
    common = (np.arange(2000) + 0.5) / 2000
    first = shares.COMMON_AGN * common
    second = shares.COMMON_AGN * (1.0 - common)
    weight = np.ones(common.size)
    for n_first, n_second in numbers:
        weight *= stats.betabinom(n_first + n_second, first, second).pmf(n_first)
    weight /= weight.sum()
    for z, (n_first, n_second) in enumerate(numbers):
        mean = (first + n_first) / (shares.COMMON_AGN + n_first + n_second)
        assert drawn[:, z].mean() == pytest.approx(weight @ mean, abs=0.02)


def test_classes_share_the_objects_by_their_evidence():
    table = np.zeros((40, 1, 2, 1))
    table[:, 0, 0, 0] = 1.0
    own = np.zeros((40, 1, 2, 1))
    own[:, 0, 1, 0] = 1.0
    ratio = np.where(np.arange(40) < 12, 50.0, -50.0)
    ratio[-1] = np.nan
    others = {"quasar": (ratio, own), "star": (np.full(40, -50.0), None)}
    draws = draw_shares(table, [0.5, 0.5], others=others, n_draws=50, seed=1)
    assert np.all(draws.counts["quasar"][:, 0, 1, 0] == 12)
    assert np.all(draws.counts["galaxy"].sum(axis=(1, 2, 3)) == 28)
    assert draws.probability["quasar"][:12].min() > 0.999


def test_a_class_may_have_no_members():
    table = np.zeros((5, 1, 2, 1))
    table[:, 0, 0, 0] = 1.0
    others = {"quasar": (np.full(5, -400.0), table)}
    draws = draw_shares(table, [0.5, 0.5], others=others, n_draws=5, seed=1)
    assert np.all(draws.counts["quasar"] == 0)


def test_the_same_seed_draws_the_same():
    table = two_normals(50, 0.3, np.random.default_rng(9), (0.5, 0.5))
    same = [draw_shares(table, (0.5, 0.5), n_draws=5, seed=4).shares for _ in range(2)]
    assert np.array_equal(*same)


def test_bins_of_known_models():
    bins = AGNBins((0.5, 1.0, 2.0), (43.0, 44.0))
    luminosity = [0.0, 1e42, 1e43, 2e44, 1e44]
    place = bins.place([0.5, 0.99, 1.0, 2.0, 0.1], [0.0, 0.05, 0.1, 0.99, 0.5], luminosity)
    assert [part.tolist() for part in place] == [[0, 0, 1, 2, 2], [0, 1, 2, 6, 4], [0, 0, 1, 2, 2]]


def test_prior_of_bins_is_that_of_the_cells():
    values = np.array([0.0, 0.2, 0.6])
    axis = GridAxis("frac_agn", values, 1, "frac_agn", np.array([0.7, 0.2, 0.1]), bounds=(0, 1))
    bins = AGNBins((0.0, 1.0), (43.0,), (0.0, 0.1, 0.4, 1.0))
    # cells from 0 to 0.4 and to 0.6, where the grid ends
    np.testing.assert_allclose(bins.prior(axis), [0.7, 0.05, 0.15, 0.1])


def test_refusals():
    table = np.ones((3, 1, 2, 1))
    refuses("'prior' must be 2 weights", draw_shares, table, [1.0])
    refuses("'prior' must be 0 or more, with a sum of 1", draw_shares, table, [1.0, 1.0])
    refuses("'table' must be finite", draw_shares, table * 0.0, [0.5, 0.5])
    refuses("'table' must be of shape", draw_shares, table[0], [0.5, 0.5])
    refuses(
        "'others' must be 3 ratios", draw_shares, table, [0.5, 0.5], others={"star": ([1.0], None)}
    )
    refuses("'redshift' must be 2 or more ascending edges", AGNBins, (1.0,), (43.0,))
    refuses("'frac_agn' must be edges from 0 to 1", AGNBins, (0.0, 1.0), (43.0,), (0.1, 1.0))
