"""The kernels against a plain evaluation of every model."""

import numpy as np
import pytest

from helpers.grids import derived_quantities, free_parameters
from miricigale.fitting import BayesFitter, GridSettings

CASES = {
    "default": ({}, {}),
    "priors": (
        {},
        {
            "priors": {
                "redshift": lambda z: z * np.exp(-z),
                "age": "log",
                "ebv_polar": [0.5, 1.0, 2.0],
                "temperature_polar": [1.0, 3.0],
            }
        },
    ),
    "prior_f by width": ({}, {}),
    "no galaxy-only models": ({"frac": [0.1, 0.5, 0.95]}, {}),
    "no AGN": ({"frac": [0.0]}, {}),
    "many fractions": ({"frac": np.append(np.arange(10) * 0.1, 0.99)}, {}),
    "one redshift": ({"n_z": 1}, {}),
    "more galaxies than a block": ({"n_tau": 20, "n_age": 7}, {}),
    "no model error": ({}, {"model_error": 0.0}),
    "no scale error": ({}, {"scale_error": False}),
    "error floor": ({}, {"error_floor": {"band1": 0.3}}),
}


def _compare(fitter, table, brute_force, *, rtol, atol=1e-12, **options):
    results = fitter.fit(table)
    assert np.all(results.fitted)
    parameters = list(free_parameters(fitter.grid, options.get("priors")))
    for i in range(len(table)):
        want = brute_force(fitter.grid, results.flux[i], results.sigma[i], **options)
        assert results.chi2[i] == pytest.approx(want["chi2"], rel=1e-9, abs=1e-9)
        assert tuple(results.best_index[i])[:2] == tuple(want["index"])[:2]
        constant = np.log(results.sigma[i][np.isfinite(results.sigma[i])]).sum()
        constant += 0.5 * results.n_bands[i] * np.log(2 * np.pi)
        assert results.log_evidence[i] + constant == pytest.approx(want["log_sum"], abs=1e-5)
        np.testing.assert_allclose(results.pdf_2d[i], want["zf"], rtol=rtol, atol=atol)
        for name, kind, _, share, _ in parameters:
            expected = share @ want[kind]
            np.testing.assert_allclose(results.pdf[name][i], expected, rtol=rtol, atol=atol)
        # quantities of an AGN that is not there are not worth their digits
        scale = np.abs(want["mean"]).max() * 1e-9
        np.testing.assert_allclose(
            results.moments[i, :, 0], want["mean"], rtol=rtol, atol=scale * atol / 1e-12
        )
        np.testing.assert_allclose(
            results.moments[i, :, 1], want["std"], rtol=1e3 * rtol, atol=1e2 * scale
        )
        np.testing.assert_allclose(results.model_flux[i], want["band"], rtol=max(rtol, 1e-7))
        np.testing.assert_allclose(results.model_flux_std[i], want["band_std"], rtol=1e-4)


@pytest.mark.parametrize("case", CASES)
def test_every_sum_equals_the_plain_one(case, make_grid, draw_photometry, brute_force):
    of_grid, of_fitter = CASES[case]
    grid = make_grid(3, **of_grid)
    prior_f = "uniform" if case == "prior_f by width" else "grid"
    fitter = BayesFitter(grid, settings=GridSettings(prior_f, rtol=0), **of_fitter)
    table, _ = draw_photometry(grid, 6, seed=5, missing=0.2)
    options = {k: v for k, v in of_fitter.items() if k not in ("model_error", "error_floor")}
    _compare(fitter, table, brute_force, rtol=1e-9, prior_f=prior_f, **options)


@pytest.mark.parametrize("noise", [1e-3, 0.03, 0.3, 3.0, 30.0])
@pytest.mark.parametrize("model_error", [0.0, 0.1])
def test_pruning_loses_no_more_than_asked(
    noise, model_error, make_grid, draw_photometry, brute_force
):
    grid = make_grid(7, n_tau=12, n_age=9)
    table, _ = draw_photometry(grid, 8, seed=11, noise=noise, missing=0.2)
    # the first row: nothing but noise, mostly negative
    for name in grid.filters:
        table[name][0] = -abs(table[name][0])
    table[grid.filters[0]][0] = abs(table[f"{grid.filters[0]}_err"][0])
    fitter = BayesFitter(grid, model_error=model_error, settings=GridSettings(rtol=1e-6))
    _compare(fitter, table, brute_force, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("n_bands", [1, 2, 3])
def test_few_bands(n_bands, make_grid, draw_photometry, brute_force):
    """With one band every model fits; with two, galaxy and torus are nearly parallel."""
    grid = make_grid(2)
    table, _ = draw_photometry(grid, 4, seed=4)
    for name in grid.filters[n_bands:]:
        table[name] = np.nan * table[name]
    fitter = BayesFitter(grid, n_bands_min=1)
    results = fitter.fit(table)
    for i in range(4):
        want = brute_force(grid, results.flux[i], results.sigma[i])
        np.testing.assert_allclose(results.pdf_2d[i], want["zf"], atol=1e-6)
        if n_bands == 1:
            allowed = grid.allowed.sum(axis=1)
            np.testing.assert_allclose(results.pdf["redshift"][i], allowed / allowed.sum())


def test_a_grid_of_one_model_has_the_closed_form(make_grid):
    """s = sum(m F / sigma^2) / sum(m^2 / sigma^2), sigma_s = sum(m^2 / sigma^2)^(-1/2)."""
    grid = make_grid(n_z=1, n_tau=1, n_age=1, frac=[0.0])
    rng = np.random.default_rng(0)
    from astropy import units as u
    from astropy.table import QTable

    model = grid.galaxy[0, 0]
    err = 0.1 * model * 1e10
    flux = 1e10 * model + err * rng.normal(size=6)
    table = QTable({"id": ["only"]})
    for i, name in enumerate(grid.filters):
        table[name] = [flux[i]] * u.uJy
        table[f"{name}_err"] = [err[i] * 1e-3] * u.mJy
    results = BayesFitter(grid, model_error=0.05).fit(table)
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


def test_percentiles_of_derived_quantities(make_grid, draw_photometry, brute_force):
    """Histogram of 0.01 dex against the sorted values of all models."""
    grid = make_grid(5, n_tau=12, n_age=9)
    fitter = BayesFitter(grid, scale_error=False)
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
            low = values[order][
                np.minimum(np.searchsorted(total, np.subtract(levels, 4e-3)), order.size - 1)
            ]
            high = values[order][
                np.minimum(np.searchsorted(total, np.add(levels, 4e-3)), order.size - 1)
            ]
            assert np.all(got >= low * 10**-0.011 - 1e-300), (name, i)
            assert np.all(got <= high * 10**0.011), (name, i)


def test_identical_models_are_counted_with_their_weight(make_grid, draw_photometry):
    """A torus that stands for two weighs as much as two copies of it."""
    from dataclasses import replace

    grid = make_grid(4)
    double = np.flatnonzero(grid.agn_multiplicity == 2)
    rows = np.sort(np.concatenate([np.arange(grid.n_agn), double]))
    copied = replace(
        grid,
        agn=grid.agn[:, rows],
        agn_parameters=grid.agn_parameters[rows],
        agn_properties=grid.agn_properties[rows],
        agn_multiplicity=np.ones(rows.size, int),
        inert=(),
    )
    table, _ = draw_photometry(grid, 5)
    one, two = BayesFitter(grid).fit(table), BayesFitter(copied).fit(table)
    for name in ("redshift", "frac_agn", "tau97", "ebv_polar"):
        np.testing.assert_allclose(one.pdf[name], two.pdf[name], atol=1e-6)


def test_galaxies_alone_weigh_one_over_the_number_of_fractions(make_grid, draw_photometry):
    """If the AGN emits in no used band every fraction fits alike: the posterior is the prior."""
    from dataclasses import replace

    grid = make_grid(4)
    dark = replace(grid, agn=np.zeros_like(grid.agn))
    table, _ = draw_photometry(dark, 3)
    results = BayesFitter(dark).fit(table)
    np.testing.assert_allclose(results.pdf["frac_agn"], 0.25, rtol=1e-6)
    np.testing.assert_allclose(results.pdf["temperature_polar"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(results.pdf["ebv_polar"], 1 / 3, rtol=1e-6)
    uniform = BayesFitter(dark, settings=GridSettings(prior_f="uniform")).fit(table)
    width = np.diff([0.0, 0.1, 0.35, 0.7, 1.0])
    np.testing.assert_allclose(uniform.pdf["frac_agn"][0], width, rtol=1e-6)
