"""Moves of places to a posterior, against distributions in closed form."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from miricigale.fitting.grid.moves import N_SWEEPS, move_places, systematic


def _moved(log_density, score, group, active, seed=1):
    """Scores after moves of places whose ln(posterior) is known."""

    def evaluate(rows, new):
        known = np.zeros((len(new), 4))
        known[:, 0] = log_density(group[rows], new)
        return known, new.copy()

    score = score.copy()
    known, place = evaluate(np.arange(len(score)), score)
    move_places(evaluate, group, active, score, known, place, seed)
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


def test_moves_end_where_places_have_the_distribution():
    """Begun with draws of it there are fewer evaluations than of all sweeps, and they keep its moments."""
    start = np.random.default_rng(9).standard_normal((2000, 3))
    evaluations = []

    def log_density(_, score):
        evaluations.append(len(score))
        return -0.5 * np.sum(score**2, axis=1)

    score = _moved(log_density, start, np.zeros(2000, int), np.ones((2000, 3), bool))
    assert 40 * 2000 <= sum(evaluations) < 0.8 * N_SWEEPS * 2000
    assert_allclose(score.mean(axis=0), 0.0, atol=0.07)
    assert_allclose(np.cov(score.T), np.eye(3), atol=0.1)


def test_small_groups_stay():
    start = np.random.default_rng(6).standard_normal((5, 2))
    score = _moved(lambda _, y: -(y**2).sum(axis=1), start, np.zeros(5, int), np.ones((5, 2), bool))
    assert_array_equal(score, start)


def test_systematic_draws_are_in_proportion():
    assert_array_equal(np.bincount(systematic(np.array([1.0, 0.0, 3.0]), 400)), [100, 0, 300])
