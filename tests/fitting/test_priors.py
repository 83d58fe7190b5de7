"""Priors of a grid are densities: the posterior without data is the prior, on any nodes."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest
import scipy.stats
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.grids import make_grid
from miricigale.fitting import FitFlags
from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.fitting.posterior.priors import density_log_prior, grid_priors

LEVELS = np.array([0.16, 0.5, 0.84])
NODES = {"steps": np.linspace(0.1, 10, 100), "ratios": np.geomspace(0.1, 10, 100)}


def weights_of(values, **priors):
    """Prior weights of the values of tau, or of redshifts, of a grid that has these."""
    n = values.size
    if "redshift" in priors:
        grid = dataclasses.replace(make_grid(n_z=n, n_tau=1, n_age=1), redshift=values)
        return grid_priors(grid, priors).axes["redshift"].weights
    grid = make_grid(n_z=1, n_tau=n, n_age=1)
    table = QTable({"tau": values * u.Gyr, "age": grid.galaxy_parameters["age"]})
    grid = dataclasses.replace(grid, galaxy_parameters=table)
    return grid_priors(grid, priors).axes["tau"].weights


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
        ((0.1, 10), scipy.stats.uniform(0.1, 9.9)),
        ((0.5, 7.0), scipy.stats.uniform(0.5, 6.5)),
        ((0.5, 7.0, "log"), scipy.stats.loguniform(0.5, 7.0)),
        (lambda x: 1.0, scipy.stats.uniform(0.1, 9.9)),
        (lambda x: 1.0 / x, scipy.stats.loguniform(0.1, 10)),
        (lambda x: x * np.exp(-x), scipy.stats.gamma(2.0)),
    ],
)
def test_a_density_is_that_of_scipy_on_any_nodes(nodes, prior, truth):
    values = NODES[nodes]
    found = percentiles(values, weights_of(values, tau=prior))
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
    found = weights_of(z, redshift=lambda x: x**2 * np.exp(-x))
    weights = np.exp(log_prior[0])
    assert_allclose(found, weights / weights.sum(), rtol=1e-4)


def test_without_a_prior_each_node_has_the_same_weight():
    for values in NODES.values():
        assert_allclose(weights_of(values), 1 / values.size)


def test_weights_of_nodes_are_taken_as_they_are():
    values = np.array([1.0, 2.0, 10.0])
    assert_allclose(weights_of(values, tau=[1.0, 2.0, 1.0]), [0.25, 0.5, 0.25])
    masked = np.ma.MaskedArray([1.0, 2.0, 1.0], mask=[False, True, False])
    refuses("finite", weights_of, values, tau=masked)


def test_ends_of_a_prior_are_in_order():
    for ends in ((3.0, 1.0), (0.0, 3.0, "log"), (1.0, 3.0, "flat"), ("a", 3.0)):
        refuses(r"'priors\['tau'\]' must be \(low, high\)", weights_of, NODES["steps"], tau=ends)
    # two weights of two nodes
    assert_allclose(weights_of(np.array([1.0, 2.0]), tau=(1.0, 3.0)), [0.25, 0.75])


def test_a_density_of_one_node_is_no_information():
    assert weights_of(np.array([2.0]), tau=scipy.stats.norm(2, 1)) == [1.0]
    assert weights_of(np.array([2.0]), tau="log") == [1.0]


def test_a_density_that_misses_the_nodes_is_refused():
    refuses("not all 0", weights_of, NODES["steps"], tau=scipy.stats.uniform(20, 1))


def test_redshifts_that_no_model_has_get_no_prior():
    z = np.array([1.0, 2.0, 3.0])
    flags = np.zeros(2, dtype=int)
    # of the second object all lies where models are not allowed
    density = np.array([[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
    nodes = np.array([1.0, 1.5, 2.5, 3.0])
    log_prior = density_log_prior((nodes, density), z, np.array([True, True, False]), flags)
    assert_allclose(np.exp(log_prior[0]), [0.25, 0.5, 0.0])
    assert np.isneginf(log_prior[:, 2]).all()
    assert flags.tolist() == [0, int(FitFlags.NO_MODEL)]
