"""Priors of a grid are densities: the posterior without data is the prior, on any nodes."""

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.fitting.posterior import cell_edges
from miricigale.fitting.priors import _axis, density_log_prior

LEVELS = np.array([0.16, 0.5, 0.84])
NODES = {"steps": np.linspace(0.1, 10, 100), "ratios": np.geomspace(0.1, 10, 100)}


def percentiles(values, weights):
    """Percentiles of weights of cells, with straight lines within a cell."""
    edges = cell_edges(values, (0.0, np.inf))
    total = np.concatenate([[0.0], np.cumsum(weights)])
    return np.interp(LEVELS, total / total[-1], edges)


@pytest.mark.parametrize("nodes", NODES)
@pytest.mark.parametrize(
    ("prior", "truth"),
    [
        (scipy.stats.uniform(0.1, 9.9), scipy.stats.uniform(0.1, 9.9)),
        (scipy.stats.loguniform(0.1, 10), scipy.stats.loguniform(0.1, 10)),
        ("log", scipy.stats.loguniform(0.1, 10)),
        (lambda x: 1.0, scipy.stats.uniform(0.1, 9.9)),
        (lambda x: 1.0 / x, scipy.stats.loguniform(0.1, 10)),
        (lambda x: x * np.exp(-x), scipy.stats.gamma(2.0)),
    ],
)
def test_a_density_is_that_of_scipy_on_any_nodes(nodes, prior, truth):
    values = NODES[nodes]
    axis = _axis("tau", values, 1, "galaxy", {"tau": prior}, (0.0, np.inf))
    found = percentiles(values, axis.weights)
    inside = truth.cdf([0.1, 10.0])
    expected = truth.ppf(inside[0] + LEVELS * (inside[1] - inside[0]))
    assert_allclose(found, expected, rtol=0.03, atol=0.08)


@pytest.mark.parametrize("nodes", NODES)
def test_one_density_of_redshift_is_one_prior_by_either_argument(nodes):
    z = NODES[nodes]
    fine = np.linspace(z[0], z[-1], 6001)
    density = fine**2 * np.exp(-fine)
    flags = np.zeros(1, dtype=int)
    log_prior = density_log_prior((fine, density), z, np.ones(z.size, bool), flags)
    axis = _axis(
        "redshift", z, 1, "redshift", {"redshift": lambda x: x**2 * np.exp(-x)}, (0.0, np.inf)
    )
    weights = np.exp(log_prior[0])
    assert_allclose(axis.weights, weights / weights.sum(), rtol=1e-4)


def test_without_a_prior_each_node_has_the_same_weight():
    for values in NODES.values():
        assert_allclose(_axis("tau", values, 1, "galaxy", {}).weights, 1 / values.size)


def test_weights_of_nodes_are_taken_as_they_are():
    axis = _axis("tau", np.array([1.0, 2.0, 10.0]), 1, "galaxy", {"tau": [1.0, 2.0, 1.0]})
    assert_allclose(axis.weights, [0.25, 0.5, 0.25])
    masked = np.ma.MaskedArray([1.0, 2.0, 1.0], mask=[False, True, False])
    refuses("finite", _axis, "tau", np.array([1.0, 2.0, 10.0]), 1, "galaxy", {"tau": masked})


def test_a_density_of_one_node_is_no_information():
    assert _axis("tau", np.array([2.0]), 1, "galaxy", {"tau": scipy.stats.norm(2, 1)}).weights == [
        1.0
    ]
    assert _axis("tau", np.array([2.0]), 1, "galaxy", {"tau": "log"}).weights == [1.0]


def test_a_density_that_misses_the_nodes_is_refused():
    refuses(
        "not all 0", _axis, "tau", NODES["steps"], 1, "galaxy", {"tau": scipy.stats.uniform(20, 1)}
    )
