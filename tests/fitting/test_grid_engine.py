"""The kernels against a plain evaluation of every model."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.grids import (
    CASES,
    assert_plain,
    brute_force,
    derived_quantities,
    draw_photometry,
    make_grid,
    node_fitter,
    photometry_table,
)
from miricigale.fitting import GridSettings

MORE = {
    "many fractions": ({"frac": np.append(np.arange(10) * 0.1, 0.99)}, {}),
    "one galaxy": ({"n_tau": 1, "n_age": 1}, {}),
    "a whole block": ({"n_tau": 8, "n_age": 8}, {}),
    "one galaxy more": ({"n_tau": 13, "n_age": 5}, {}),
    "two whole blocks": ({"n_tau": 16, "n_age": 8}, {}),
    "more galaxies than two blocks": ({"n_tau": 20, "n_age": 7}, {}),
    "no model error": ({}, {"model_error": 0.0}),
    "error floor": ({}, {"error_floor": {"band1": 0.3}}),
}


@pytest.mark.parametrize("case", [*CASES, *MORE])
def test_every_sum_equals_the_plain_one(case):
    of_grid, of_fitter = (CASES | MORE)[case]
    grid = make_grid(3, **of_grid)
    prior_f = "uniform" if case == "prior_f by width" else "grid"
    fitter = node_fitter(grid, settings=GridSettings(prior_f, rtol=0), **of_fitter)
    table, _ = draw_photometry(grid, 6, seed=5, missing=0.2)
    options = {k: v for k, v in of_fitter.items() if k not in ("model_error", "error_floor")}
    assert_plain(fitter.fit(table), grid, rtol=1e-9, prior_f=prior_f, **options)


@pytest.mark.parametrize("noise", [1e-3, 0.03, 0.3, 3.0, 30.0])
@pytest.mark.parametrize("model_error", [0.0, 0.1])
def test_pruning_loses_no_more_than_asked(noise, model_error):
    grid = make_grid(7, n_tau=12, n_age=9)
    table, _ = draw_photometry(grid, 8, seed=11, noise=noise, missing=0.2)
    # the first row: nothing but noise, mostly negative
    for name in grid.filters:
        table[name][0] = -abs(table[name][0])
    table[grid.filters[0]][0] = abs(table[f"{grid.filters[0]}_err"][0])
    fitter = node_fitter(grid, model_error=model_error, settings=GridSettings(rtol=1e-6))
    assert_plain(fitter.fit(table), grid, rtol=1e-5, atol=1e-6, floor=1e6)


@pytest.mark.parametrize("n_bands", [1, 2, 3])
def test_few_bands(n_bands):
    """With one band every model fits; with two, galaxy and torus are nearly parallel."""
    grid = make_grid(2)
    table, _ = draw_photometry(grid, 4, seed=4)
    for name in grid.filters[n_bands:]:
        table[name] = np.nan * table[name]
    fitter = node_fitter(grid, n_bands_min=1)
    results = fitter.fit(table)
    for i in range(4):
        want = brute_force(grid, results.flux[i], results.sigma[i])
        assert_allclose(results.pdf_2d[i], want["zf"], atol=1e-6)
        if n_bands == 1:
            allowed = grid.allowed.sum(axis=1)
            assert_allclose(results.pdf["redshift"][i], allowed / allowed.sum())


def test_a_grid_of_one_model_has_the_closed_form():
    """s = sum(m F / sigma^2) / sum(m^2 / sigma^2), sigma_s = sum(m^2 / sigma^2)^(-1/2)."""
    grid = make_grid(n_z=1, n_tau=1, n_age=1, frac=[0.0])
    rng = np.random.default_rng(0)
    model = grid.galaxy[0, 0]
    err = 0.1 * model * 1e10
    flux = 1e10 * model + err * rng.normal(size=6)
    table = photometry_table(grid.filters, flux, err, ["only"])
    for name in grid.filters:
        table[f"{name}_err"] = table[f"{name}_err"].to(u.mJy)
    results = node_fitter(grid, model_error=0.05).fit(table)
    variance = err**2 + (0.05 * flux) ** 2
    q = np.sum(model**2 / variance)
    scale = np.sum(model * flux / variance) / q
    mass, std = results.mean("mass")[0], results.std("mass")[0]
    assert mass.to_value("Msun") == pytest.approx(scale, rel=1e-12)
    assert std.to_value("Msun") == pytest.approx(q**-0.5, rel=1e-9)
    chi2 = np.sum((flux - scale * model) ** 2 / variance)
    assert results["only"].chi2 == pytest.approx(chi2, rel=1e-9)
    low, high = results.percentile("mass", [0.16, 0.84])[0].to_value("Msun")
    assert (high - low) / 2 == pytest.approx(q**-0.5, rel=0.03)
    assert results.fitted.all()


def test_percentiles_of_derived_quantities():
    """Histogram of 0.01 dex against the sorted values of all models."""
    grid = make_grid(5, n_tau=12, n_age=9)
    fitter = node_fitter(grid, scale_error=False)
    table, _ = draw_photometry(grid, 6, seed=2, noise=0.6)
    results = fitter.fit(table)
    levels = [0.16, 0.5, 0.84]
    for i in range(6):
        want = brute_force(grid, results.flux[i], results.sigma[i])
        weights = want["weights"].ravel()
        for name in derived_quantities(grid):
            values = want["values"][name].ravel()
            order = np.argsort(values)
            total = np.cumsum(weights[order])
            got = results.percentile(name, levels)[i].value
            # where the distribution jumps, either side will do
            places = (np.searchsorted(total, np.add(levels, d)) for d in (-4e-3, 4e-3))
            low, high = (values[order][np.minimum(p, order.size - 1)] for p in places)
            assert np.all(got >= low * 10**-0.011 - 1e-300), (name, i)
            assert np.all(got <= high * 10**0.011), (name, i)
