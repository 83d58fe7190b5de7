"""Quantities that do not scale with mass: from the weights of the galaxy models."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.grids import brute_force, node_fitter
from helpers.results import assert_same
from miricigale.fitting import FitResults, GridSettings
from miricigale.fitting.posterior.posterior import cell_percentiles
from miricigale.fitting.posterior.quantities import DERIVED_LEVELS, ShapeQuantities


def with_shape(grid):
    """Ages, a color that some galaxies lack, and the tau of each model as an attenuation."""
    rng = np.random.default_rng(5)
    tau = grid.galaxy_parameters["tau"].value
    color = rng.normal(0, 1, tau.size)
    color[::4] = -np.inf
    table = QTable({"a_v": tau * u.mag, "u_v": color * u.mag})
    table["beta"] = np.full(tau.size, -2.0) * u.dimensionless_unscaled
    table["age_mass"] = grid.galaxy_parameters["age"] * 0.7
    table["a_v"].info.description = "attenuation"
    return dataclasses.replace(grid, galaxy_shape=table)


@pytest.fixture(scope="module")
def fitter(grid):
    return node_fitter(with_shape(grid), settings=GridSettings(rtol=0))


@pytest.fixture(scope="module")
def results(fitter, photometry):
    return fitter.fit(photometry)


def test_mean_and_scatter_against_every_model(fitter, results):
    table = fitter.grid.galaxy_shape
    for row in range(3):
        want = brute_force(fitter.grid, results.flux[row], results.sigma[row])["galaxy"]
        for name in table.colnames:
            value = table[name].value
            w = np.where(np.isfinite(value), want, 0.0) / want[np.isfinite(value)].sum()
            value = np.where(np.isfinite(value), value, 0.0)
            mean = w @ value
            assert results.mean(name)[row].value == pytest.approx(mean, rel=1e-9)
            std = np.sqrt(w @ (value - mean) ** 2)
            assert results.std(name)[row].value == pytest.approx(std, rel=1e-6, abs=1e-9)
        _z, g, _k, _f = results.best_index[row]
        assert results[row].best["a_v"] == table["a_v"][g]


def test_a_quantity_that_equals_a_parameter_has_its_posterior(results):
    """A_V is tau here: the two differ in the distance of the kept levels only."""
    for part in (results.mean, results.std):
        assert_allclose(part("a_v").value, part("tau").value, rtol=1e-9)
    got, want = (results.percentile(name, [0.16, 0.5, 0.84]).value for name in ("a_v", "tau"))
    assert_allclose(got, want, rtol=1e-9)
    # a single value has no scatter
    assert_allclose(results.mean("beta").value, -2.0, rtol=1e-12)
    assert_array_equal(results.percentile("beta", 0.3).value, -2.0)
    assert_allclose(results.std("beta").value, 0.0, atol=1e-12)


def test_uniform_weights_give_straight_quantiles():
    """Equal cells of equal weight: the quantiles are linear, whatever the order of the models."""
    order = np.random.default_rng(0).permutation(20)
    values = (np.arange(20) + 0.5)[order]
    # each value twice, to the last digit or nearly
    shape = ShapeQuantities(("v",), np.concatenate([values, values + 1e-12])[None])
    weights = np.full((300, 40), 1 / 40)
    weights[7] = np.nan
    moments, quantiles = shape.summarize(weights, DERIVED_LEVELS)
    assert_allclose(quantiles[0, 0], 20 * DERIVED_LEVELS, atol=1e-9)
    assert_allclose(quantiles[299, 0], quantiles[0, 0], rtol=1e-12)
    assert moments[0, 0, 0] == pytest.approx(10)
    assert moments[0, 0, 1] == pytest.approx(np.sqrt((20**2 - 1) / 12))
    assert np.isnan(moments[7]).all()
    assert np.isnan(quantiles[7]).all()


def test_the_last_node_has_its_whole_weight():
    """30 % at 0 and 70 % at 1, uniform in cells that end halfway to the next node."""
    weights = np.zeros((1, 11))
    weights[0, [0, 10]] = 0.3, 0.7
    percentiles = cell_percentiles(np.linspace(0, 1, 11), weights, [0.16, 0.5, 0.84], (0, 1))
    inside = np.array([0.2, 0.54]) / 0.7
    assert_allclose(percentiles[0, 0], 0.05 * 0.16 / 0.3, rtol=1e-12)
    assert_allclose(percentiles[0, 1:], 0.95 + 0.05 * inside, rtol=1e-12)


def test_the_place_in_a_catalog_makes_no_difference():
    """Rows are worked out together; each has the digits that it has alone, ties included."""
    rng = np.random.default_rng(1)
    weights = np.round(rng.dirichlet(np.full(30, 0.1), 300), 2)
    weights[::3] = 1 / 30
    levels = np.append(np.arange(1, 30) / 30, DERIVED_LEVELS)
    whole = cell_percentiles(np.arange(30.0), weights, levels)
    for row in (0, 17, 255, 256, 298):
        alone = cell_percentiles(np.arange(30.0), weights[row : row + 1], levels)
        assert_array_equal(whole[row], alone[0])
    # nor does the order of the levels
    order = rng.permutation(levels.size)
    assert_array_equal(cell_percentiles(np.arange(30.0), weights, levels[order]), whole[:, order])


def test_objects_without_a_value():
    """All weight on models without a color: no value, and no warning."""
    shape = ShapeQuantities(("c", "d"), np.array([[np.nan, 1.0]] * 2))
    moments, quantiles = shape.summarize(np.array([[1.0, 0.0], [0.5, 0.5]]), np.array([0.5]))
    assert np.isnan(moments[0]).all()
    assert_array_equal(moments[1, :, 0], 1.0)
    assert_array_equal(quantiles[:, 0, 0], [np.nan, 1.0])


def test_tables_files_and_views(results, tmp_path):
    table = results.to_table()
    assert table["a_v_p50"].unit == u.mag
    assert table["a_v_mean"].info.description == "posterior mean of attenuation"
    assert "a_v_logmean" not in table.colnames
    assert "mass_logmean" in table.colnames
    edges, weights = results[0].distribution("u_v")
    assert np.all(np.diff(edges.value) >= 0)
    assert weights.sum() == pytest.approx(0.998)
    for name in ("u_v", "mass", "redshift"):
        values, levels = results[0].cdf(name)
        middle = np.interp(0.5, levels, values.value)
        assert results[0].percentile(name, 0.5).value == pytest.approx(middle, rel=1e-9)
    # weights that add up to 1 + 2e-16
    draws = np.random.default_rng(0).random((1000, results.pdf["redshift"].shape[1]))
    draws /= draws.sum(axis=1, keepdims=True)
    draws = draws[np.cumsum(draws, axis=1)[:, -1] > 1][: len(results)]
    few = results[: len(draws)]
    lifted = dataclasses.replace(few, pdf=few.pdf | {"redshift": draws})
    assert lifted.cdf("redshift")[1].max() == 1
    results.write(tmp_path / "r.fits")
    again = FitResults.read(tmp_path / "r.fits")
    assert again.intensive == ("a_v", "u_v", "beta", "age_mass", "frac_agn_ir")
    assert_same(again, results)
    assert again.axes.keys() == results.axes.keys()
    for name, axis in results.axes.items():
        assert_array_equal(again.axes[name].values, axis.values)
    for name in ("filters", "quantities", "units", "descriptions", "constants", "redshift_fixed"):
        assert getattr(again, name) == getattr(results, name), name


def test_an_empty_catalog_has_all_columns(fitter, photometry):
    empty = fitter.fit(photometry[:0])
    assert len(empty.to_table()) == 0
    assert "a_v_mean" in empty.to_table().colnames
