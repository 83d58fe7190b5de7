"""Moves of places to a posterior, against distributions in closed form."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from miricigale.fitting.grid.moves import Moves, systematic

N_SWEEPS = 100


def _moved(log_density, score, group, active, seed=1):
    """Scores after moves of places whose ln(posterior) is known."""

    def evaluate(rows, new):
        known = np.zeros((len(new), 5))
        known[:, 0] = log_density(group[rows], new)
        return known, new.copy()

    score = score.copy()
    known, place = evaluate(np.arange(len(score)), score)
    moves = Moves(evaluate, group, active, score, known, place)
    rng = np.random.default_rng(seed)
    for _ in range(N_SWEEPS):
        moves.sweep(rng)
    assert_array_equal(place, score)
    assert_array_equal(known[:, 0], log_density(group, score))
    return score


def test_places_move_to_narrow_correlated_distributions():
    """Of two groups, from far too wide a beginning; what has no effect stays as it is."""
    rng = np.random.default_rng(4)
    n = 3000
    group = np.repeat([0, 1], n // 2)
    active = np.ones((n, 3), bool)
    active[:, 2] = False
    mean = np.array([[2.0, -1.0], [-3.0, 0.5]])
    cov = np.array([[1.0, 0.95], [0.95, 1.0]]) * 0.04
    inverse = np.linalg.inv(cov)

    def log_density(group, score):
        apart = score[:, :2] - mean[group]
        return -0.5 * np.einsum("ni,ij,nj->n", apart, inverse, apart)

    start = rng.standard_normal((n, 3))
    start[:, :2] += mean[group]
    score = _moved(log_density, start, group, active)
    for k in (0, 1):
        places = score[group == k, :2]
        assert_allclose(places.mean(axis=0), mean[k], atol=0.025)
        assert_allclose(np.cov(places.T), cov, rtol=0.12)
    assert_array_equal(score[:, 2], start[:, 2])


def test_places_move_along_a_curved_ridge():
    """Rosenbrock's: the first coordinate is standard normal, the second its square within 0.1."""
    rng = np.random.default_rng(5)
    n = 4000

    def log_density(_, score):
        across = (score[:, 1] - score[:, 0] ** 2) / 0.1
        return -0.5 * (score[:, 0] ** 2 + across**2)

    start = rng.standard_normal((n, 2))
    start[:, 1] = start[:, 0] ** 2 + 0.5 * start[:, 1]
    score = _moved(log_density, start, np.zeros(n, int), np.ones((n, 2), bool))
    across = score[:, 1] - score[:, 0] ** 2
    assert abs(across.mean()) < 0.01
    assert_allclose(across.std(), 0.1, rtol=0.05)
    assert abs(score[:, 0].mean()) < 0.1
    assert_allclose(score[:, 0].std(), 1.0, rtol=0.1)


def test_moves_keep_the_distribution_that_places_have():
    start = np.random.default_rng(9).standard_normal((2000, 3))

    def log_density(_, score):
        return -0.5 * np.sum(score**2, axis=1)

    score = _moved(log_density, start, np.zeros(2000, int), np.ones((2000, 3), bool))
    assert_allclose(score.mean(axis=0), 0.0, atol=0.07)
    assert_allclose(np.cov(score.T), np.eye(3), atol=0.1)


def test_a_power_of_the_likelihood_makes_distributions_wider():
    """A standard normal prior times a normal likelihood of variance 0.01 with a power of 0.25."""
    rng = np.random.default_rng(3)
    score = rng.standard_normal((4000, 1))

    def evaluate(_, new):
        known = np.zeros((len(new), 5))
        known[:, 4] = -0.5 * (new[:, 0] - 1.0) ** 2 / 0.01
        known[:, 0] = known[:, 4] - 0.5 * new[:, 0] ** 2
        return known, new.copy()

    known, place = evaluate(None, score)
    active = np.ones((4000, 1), bool)
    moves = Moves(evaluate, np.zeros(4000, int), active, score, known, place, power=0.25)
    for _ in range(N_SWEEPS):
        moves.sweep(rng)
    variance = 1.0 / (1.0 + 25.0)
    assert_allclose(score.mean(), 25.0 * variance, atol=0.01)
    assert_allclose(score.std(), np.sqrt(variance), rtol=0.05)


def test_small_groups_stay():
    start = np.random.default_rng(6).standard_normal((5, 2))
    score = _moved(lambda _, y: -(y**2).sum(axis=1), start, np.zeros(5, int), np.ones((5, 2), bool))
    assert_array_equal(score, start)


def test_systematic_draws_are_in_proportion():
    assert_array_equal(np.bincount(systematic(np.array([1.0, 0.0, 3.0]), 400)), [100, 0, 300])
