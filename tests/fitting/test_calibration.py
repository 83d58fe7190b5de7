"""Objects drawn from the prior: posteriors must be right on average."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_array_less
from scipy import stats

from helpers.grids import cells, make_grid, node_fitter, photometry_table
from miricigale.fitting.posterior.posterior import bin_edges, randomized_ranks
from miricigale.fitting.posterior.quantities import DERIVED_LEVELS

N = 3000


def _draw(grid, n, rng):
    """Draw models with equal weights and a flat prior in total signal to noise."""
    z_all, g_all = np.nonzero(grid.allowed)
    rows = rng.integers(z_all.size, size=n)
    k_weight = grid.agn_multiplicity / grid.agn_multiplicity.sum()
    z, g = z_all[rows], g_all[rows]
    k = rng.choice(grid.n_agn, n, p=k_weight)
    f = rng.integers(grid.frac_agn.size, size=n)
    model = grid.flux(z, g, k, f)
    sigma = np.array([0.1, 0.1, 0.2, 0.15, 0.1, 0.3])
    total = rng.uniform(5.0, 60.0, n)
    s = total / np.sqrt(np.sum((model / sigma) ** 2, axis=1))
    flux = s[:, None] * model + sigma * rng.normal(size=model.shape)
    return photometry_table(grid.filters, flux, sigma), z, g, k, f, s


@pytest.fixture(scope="module")
def fitted():
    grid = make_grid(11, n_z=8, n_tau=6, n_age=4, frac=np.append(np.arange(5) * 0.2, 0.95))
    rng = np.random.default_rng(4)
    # six values that several galaxies have, and as many as there are galaxies
    shape = QTable({"a_v": np.sqrt(grid.galaxy_parameters["tau"].value) * u.mag})
    shape["u_v"] = rng.normal(0.5, 0.7, grid.n_galaxies) * u.mag
    grid = dataclasses.replace(grid, galaxy_shape=shape)
    drawn = _draw(grid, N, rng)
    results = node_fitter(grid, model_error=0.0).fit(drawn[0])
    assert results.fitted.all()
    return grid, results, drawn[1:], rng


def _check(rank, name):
    # the largest distance from the diagonal of 3000 ranks, at a probability of 0.001
    assert stats.kstest(rank, "uniform").pvalue > 1e-3, name
    cover = np.mean((rank > 0.16) & (rank < 0.84))
    assert abs(cover - 0.68) < 0.03, (name, cover)


def test_randomized_ranks_of_nodes(fitted):
    _grid, results, (z, _g, _k, f, _s), rng = fitted
    for name, node in (("redshift", z), ("frac_agn", f)):
        _check(randomized_ranks(results.pdf[name], node, rng.random(N)), name)


@pytest.mark.parametrize("name", ["redshift", "frac_agn", "a_v", "u_v"])
def test_percentiles_of_the_distribution_linear_in_cells(fitted, name):
    """A truth anywhere in the cell of its node is below a percentile as often as it says."""
    grid, results, (z, g, _k, f, _s), rng = fitted
    if name in results.axes:
        axis = results.axes[name]
        node, edges = {"redshift": z, "frac_agn": f}[name], cells(axis.values, axis.bounds)
    else:
        values, node = np.unique(grid.galaxy_shape[name].value, return_inverse=True)
        node, edges = node[g], cells(values, (0, np.inf) if name == "a_v" else (-9, 9))
    truth = edges[node] + rng.random(N) * (edges[node + 1] - edges[node])
    percentiles = results.percentile(name, DERIVED_LEVELS).value
    below = np.mean(truth[:, None] < percentiles, axis=0)
    # five standard deviations of a binomial count
    error = np.sqrt(DERIVED_LEVELS * (1 - DERIVED_LEVELS) / N)
    assert_array_less(np.abs(below - DERIVED_LEVELS), 5 * error)
    low, high = results.percentile(name, [0.16, 0.84]).value.T
    assert abs(np.mean((truth > low) & (truth < high)) - 0.68) < 0.03


def test_mass(fitted):
    _grid, results, (*_, s), _rng = fitted
    kept = results.quantiles[:, results.quantities.index("mass")]
    rank = np.array([np.interp(x, row, DERIVED_LEVELS) for x, row in zip(s, kept, strict=True)])
    _check(rank, "mass")


@pytest.mark.parametrize("value", [1e-30, 3.0, 1e11, 1e40])
@pytest.mark.parametrize("log", [False, True])
def test_bins_of_equal_values_are_narrow_about_them(value, log):
    edges = bin_edges(np.full(3, value), log=log)
    assert np.all(np.diff(edges) > 0)
    assert edges[0] == value
    assert edges[-1] == pytest.approx(value, rel=2e-6, abs=0)
