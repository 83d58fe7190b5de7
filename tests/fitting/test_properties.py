"""What holds for any photometry: missing bands, limits, any S/N, any unit, negative fluxes."""

import dataclasses
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import log_ndtr

from helpers.grids import make_grid, node_fitter, photometry_table
from helpers.results import assert_same
from miricigale.fitting import FitFlags, GridSettings
from miricigale.fitting.posterior.quantities import DERIVED_LEVELS

#: Units of 1e12 make fluxes beyond 1e15, which are taken as missing; a user is told so.
pytestmark = pytest.mark.filterwarnings("ignore:photometry. taken as missing")

N = 200
SETTINGS = {
    "default": {},
    "no model error": {"model_error": 0.0},
    "exact": {"settings": GridSettings(rtol=0), "model_error": 0.02},
    "cigale": {"compat": "cigale"},
    "no scale error": {"scale_error": False, "error_floor": 0.05},
}


def wild_photometry(grid, n=N, seed=0, *, units=True):
    """Models at S/N of 1e-3 to 1e5 in units of 1e-12 to 1e12, some bands missing or limits."""
    rng = np.random.default_rng(seed)
    n_b = len(grid.filters)
    z, g = rng.integers(grid.redshift.size, size=n), rng.integers(grid.n_galaxies, size=n)
    k, f = rng.integers(grid.n_agn, size=n), rng.integers(grid.frac_agn.size, size=n)
    flux = 1e9 * grid.flux(z, g, k, f)
    if units:
        flux *= 10.0 ** rng.uniform(-12, 12, (n, 1))
    # one S/N for each object, and another for each band
    noise = 10.0 ** (-rng.uniform(-3, 5, (n, 1)) + rng.normal(0.0, 0.5, (n, n_b)))
    err = np.abs(flux) * noise
    flux = flux + err * rng.normal(size=flux.shape)
    flux = np.where(rng.random(flux.shape) < 0.02, -flux, flux)
    flux[rng.random(flux.shape) < rng.choice([0.0, 0.1, 0.6], (n, 1))] = np.nan
    err[rng.random(err.shape) < 0.01] = np.nan
    limit = rng.random(flux.shape) < rng.choice([0.0, 0.2, 0.7], (n, 1))
    flux = np.where(limit, np.abs(flux) + 10.0 ** rng.uniform(-1, 1, flux.shape) * err, flux)
    table = photometry_table(grid.filters, flux, err, [f"object {i}" for i in range(n)])
    for j, name in enumerate(grid.filters):
        table[f"{name}_limit"] = limit[:, j]
    return table


def assert_same_moments(got, want, rtol):
    """
    Means to rtol, and variances, which are the difference of two sums, to that and rounding.

    Shape (n, n_quantities, 2 or 3).
    """
    assert_allclose(got[..., 0], want[..., 0], rtol=rtol, atol=0)
    error = np.abs(got[..., 1] ** 2 - want[..., 1] ** 2)
    allowed = 3.0 * rtol * want[..., 1] ** 2 + 1e-14 * want[..., 0] ** 2
    assert np.all(error <= allowed)


@pytest.fixture(scope="module", params=[1, 2, 3])
def wild(request):
    grid = make_grid(request.param)
    return grid, wild_photometry(grid, seed=request.param)


@pytest.mark.parametrize("settings", SETTINGS)
def test_posteriors_are_posteriors(wild, settings):
    grid, table = wild
    results = node_fitter(grid, **SETTINGS[settings]).fit(table)
    assert list(results.ids) == list(table["id"])
    ok = results.fitted
    assert ok.mean() > 0.5
    assert np.all(((results.flags & int(FitFlags.UNFITTED)) != 0) == ~ok)
    for name, axis in results.axes.items():
        pdf = results.pdf[name]
        assert np.all(np.isnan(pdf[~ok]))
        assert np.all(np.isfinite(pdf[ok]))
        assert np.all(pdf[ok] >= 0)
        assert_allclose(pdf[ok].sum(axis=1), 1.0, rtol=1e-12, err_msg=name)
        mean, slack = results.mean(name).value[ok], 1e-12 * np.abs(axis.values).max()
        assert np.all(mean >= axis.values[0] - slack)
        assert np.all(mean <= axis.values[-1] + slack)
    assert_allclose(results.pdf_2d[ok].sum(axis=(1, 2)), 1.0, rtol=1e-12)
    assert_allclose(results.pdf_2d[ok].sum(axis=2), results.pdf["redshift"][ok])
    levels = [0.002, 0.025, 0.16, 0.5, 0.84, 0.975, 0.998]
    for name in results.parameters:
        mean, std = results.mean(name).value, results.std(name).value
        assert np.all(np.isnan(mean[~ok])), name
        assert np.all(np.isfinite(mean[ok])), name
        assert np.all(std[ok] >= 0), name
        percentiles = results.percentile(name, levels).value[ok]
        # interpolated between kept levels: equal but for rounding where they are
        steps = np.diff(percentiles, axis=1)
        assert np.all(steps >= -1e-12 * np.abs(percentiles[:, 1:])), name
    assert np.all(np.diff(results.quantiles[ok], axis=2) >= 0)
    assert results.quantiles.shape[2] == DERIVED_LEVELS.size
    assert np.all(results.mean("frac_agn_ir")[ok] >= 0)
    assert np.all(results.mean("frac_agn_ir")[ok] <= 1)
    assert np.all(results.mean("mass")[ok] >= 0)
    assert np.all(np.isfinite(results.log_evidence[ok]))
    assert np.all(results.model_flux[ok] >= 0)
    assert np.all(results.model_flux_std[ok] >= 0)


@pytest.mark.parametrize("settings", ["default", "no model error"])
def test_chi2_is_that_of_the_best_model(wild, settings):
    """Terms of detections and limits at the best parameters, one by one."""
    grid, table = wild
    results = node_fitter(grid, **SETTINGS[settings]).fit(table)
    ok = np.flatnonzero(results.fitted)
    z, g, k, f = results.best_index[ok].T
    model = results.best_scale[ok, None] * grid.flux(z, g, np.maximum(k, 0), f)
    assert_allclose(results.best_flux[ok], model, rtol=1e-12)
    assert np.all(results.chi2[ok] >= 0)
    sigma, limit = results.sigma[ok], results.limit[ok]
    used = np.isfinite(sigma)
    apart = np.where(used, (results.flux[ok] - model) / sigma, 0.0)
    terms = np.where(used, np.where(limit, -2.0 * log_ndtr(apart), apart**2), 0.0)
    # chi2 is what is left of sum F^2 / sigma^2: it has the digits of that
    whole = np.where(used & ~limit, np.square(results.flux[ok] / sigma), 0.0).sum(axis=1)
    error = np.abs(results.chi2[ok] - terms.sum(axis=1))
    assert np.all(error <= 1e-9 * results.chi2[ok] + 1e-14 * whole + 1e-9)
    assert np.all(results.best["redshift"][ok] == grid.redshift[z])
    assert np.all(grid.allowed[z, g])


def without_sample(results):
    """Results without the flag that depends on the other objects."""
    return dataclasses.replace(results, flags=results.flags & ~int(FitFlags.HIGH_CHI2))


def test_order_pieces_and_executors_change_nothing(wild):
    grid, table = wild
    fitter = node_fitter(grid)
    whole = fitter.fit(table)
    order = np.random.default_rng(0).permutation(N)[: N // 2]
    some = fitter.fit(table[order])
    with ThreadPoolExecutor(2) as pool:
        copied = pickle.loads(pickle.dumps(fitter))
        assert_same(copied.fit(table, executor=pool, chunk_size=23), whole)
    few = fitter.fit(table[:20], chunk_size=1)
    # but for the flag that says how an object compares with its sample
    for part, rows in ((some, order), (few, slice(0, 20))):
        assert_same(*map(without_sample, (part, whole[rows])))


@pytest.mark.parametrize("factor", [1e-9, 0.37, 1e6])
def test_brighter_and_heavier_is_the_same(factor):
    """All fluxes and errors times a factor: masses times it, everything else as it was."""
    grid = make_grid(5)
    table = wild_photometry(grid, 100, seed=4, units=False)
    fitter = node_fitter(grid, settings=GridSettings(rtol=0), model_error=0.05)
    other = table.copy()
    for name in (column for band in grid.filters for column in (band, f"{band}_err")):
        other[name] = factor * other[name]
    one, two = fitter.fit(table), fitter.fit(other)
    ok = one.fitted
    assert_array_equal(two.fitted, ok)
    # but for the flag of low masses
    both = [found.flags & ~int(FitFlags.LOW_MASS) for found in (one, two)]
    assert_array_equal(*both)
    assert_allclose(two.pdf_2d[ok], one.pdf_2d[ok], rtol=1e-7, atol=1e-10)
    assert_allclose(two.chi2[ok], one.chi2[ok], rtol=1e-8, atol=1e-8)
    n = one.n_bands - one.n_limits
    evidence = (one.log_evidence - n * np.log(factor))[ok]
    assert_allclose(two.log_evidence[ok], evidence, rtol=1e-9, atol=1e-8)
    extensive = [name not in one.intensive for name in one.quantities]
    moments = one.moments[ok][..., :2] * np.where(extensive, factor, 1.0)[:, None]
    assert_same_moments(two.moments[ok], moments, 1e-6)
    for name in one.axes:
        assert_allclose(two.pdf[name][ok], one.pdf[name][ok], rtol=1e-7, atol=1e-10)
    assert_allclose(two.model_flux[ok], factor * one.model_flux[ok], rtol=1e-7)
    mass = one.percentile("mass", [0.16, 0.5, 0.84]).value[ok] * factor
    # bins of 0.01 dex
    assert_allclose(two.percentile("mass", [0.16, 0.5, 0.84]).value[ok], mass, rtol=0.024)


def test_draws_are_models_of_the_grid(wild):
    grid, table = wild
    fitter = node_fitter(grid)
    results, samples = fitter.fit(table[:60]), fitter.sample(table[:60], 30, seed=4)
    ok = results.fitted
    assert_array_equal(samples.fitted, ok)
    assert_array_equal(samples.flags[~ok], results.flags[~ok])
    z, g = np.moveaxis(samples.index[ok][..., :2], -1, 0)
    assert grid.allowed[z, g].all()
    assert np.all(samples.scale[ok] >= 0)
    assert np.isfinite(samples.scale[ok]).all()
    # no draw of a redshift that the posterior has not
    assert np.all(np.take_along_axis(results.pdf["redshift"][ok], z, axis=1) > 0)
