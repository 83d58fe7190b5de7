"""The fitter with real spectra and filters."""

import itertools

import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.grids import draw_photometry, node_fitter, other_fraction, photometry_table
from miricigale.fitting import BayesFitter, FitResults, GridSettings
from miricigale.sed import SEDModel

NAMES = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1", "irac.ch2"]
NAMES += ["miri.f770w", "miri.f1000w", "miri.f1500w", "miri.f2100w"]
AXES = {"redshift": [0.5, 1.0, 1.5, 2.0], "tau": [0.5, 3.0], "age": [1.0, 3.0], "ebv": [0.1, 0.4]}
AXES |= {"frac_agn": [0.0, 0.3, 0.8], "ebv_polar": [0.0, 0.2], "temperature_polar": [100.0, 200.0]}


@pytest.fixture(scope="module")
def fitter():
    return BayesFitter(SEDModel.yang2021(), NAMES, axes=AXES)


def test_the_best_spectrum_has_the_best_fluxes(fitter, tmp_path):
    from miricigale.filters import FilterSet

    table, _ = draw_photometry(fitter.grid, 4, noise=0.02)
    filters = FilterSet.from_names(NAMES)
    # between nodes fluxes are interpolated
    for interpolate, within in ((0, 1e-3), (600, 0.01)):
        settings = GridSettings(interpolate=interpolate)
        results = fitter.replace(settings=settings).fit(table)
        for result in results:
            sed = result.best_sed()
            got = filters.synthetic_fluxes(sed).to_value("uJy")
            assert_allclose(got, results.best_flux[results.row(result.ids)], rtol=within)
    results.write(tmp_path / "r.fits")
    again = FitResults.read(tmp_path / "r.fits")
    refuses("'model' must be an SEDModel", again[0].best_sed)
    sed = again.with_model(fitter.model)[0].best_sed()
    assert_allclose(sed.fnu.value, results[0].best_sed().fnu.value)


def test_every_combination_of_values_counts_as_one_model():
    # as in CIGALE: without AGN light, each torus and each polar dust is a model of its own
    axes = {"redshift": [0.8, 1.0], "ebv": [0.1, 0.4], "alpha": [1.0, 2.5], "ebv_polar": [0.0, 0.2]}
    axes |= {"frac_agn": [0.0, 0.1, 0.4], "tau97": [3.0, 7.0, 11.0]}
    axes["temperature_polar"] = [100.0, 300.0]
    model = SEDModel.yang2021(libraries="bundled")
    fitter = node_fitter(model, NAMES, axes=axes)
    table, _ = draw_photometry(fitter.grid, 4, noise=0.3)
    results = fitter.fit(table)
    models = QTable(rows=list(itertools.product(*axes.values())), names=list(axes))
    light = model.fluxes(models, NAMES)
    light = np.stack([light[name].to_value("uJy") for name in NAMES], axis=1)
    assert np.mean(np.asarray(models["frac_agn"]) == 0) == pytest.approx(1 / 3)
    names = ["frac_agn", "redshift", "alpha", "tau97"]
    found = np.array([results.to_table()[f"{name}_mean"] for name in names], float)
    for i, (flux, sigma) in enumerate(zip(results.flux, results.sigma, strict=True)):
        scale = light @ (flux / sigma**2) / (light**2 @ sigma**-2)
        chi2 = np.sum(((flux - scale[:, None] * light) / sigma) ** 2, axis=1)
        weight = np.exp(-0.5 * (chi2 - chi2.min()))
        means = [np.average(np.asarray(models[name], float), weights=weight) for name in names]
        assert_allclose(found[:, i], means, rtol=1e-3)
    assert np.any((found[0] > 0.01) & (found[0] < 0.3))


@pytest.mark.parametrize(
    ("definition", "name"), [("dust", "frac_agn_ir"), ("3-1000um", "frac_agn_dust")]
)
def test_agn_fraction_in_the_other_definition(definition, name):
    """That of the spectrum of the best model, and of draws, also without dust in the galaxy."""
    model = SEDModel.yang2021(libraries="bundled", frac_agn_definition=definition)
    axes = AXES | {"ebv": [0.0, 0.4], "frac_agn": [0.0, 0.1, 0.6]}
    fitter = node_fitter(model, NAMES, axes=axes)
    table, _ = draw_photometry(fitter.grid, 12, noise=0.1)
    results, samples = fitter.fit(table), fitter.sample(table, 3000, seed=2)
    assert results.parameters[-1] == name
    for result in results:
        derived = result.best_sed().meta["derived"]
        assert result.best[name].value == pytest.approx(derived[name].value, abs=1e-9)
        if result.best["frac_agn"] > 0 and derived["dust_luminosity"].value > 0:
            assert result.best[name] != result.best["frac_agn"]
    mean, std = results.mean(name).value, results.std(name).value
    assert np.all(np.abs(samples.mean(name).value - mean) < 4.5 * std / np.sqrt(3000) + 1e-6)
    assert_allclose(samples.std(name).value, std, rtol=0.1, atol=1e-3)
    g, k, f = np.moveaxis(samples.index, -1, 0)[1:]
    found, fraction = other_fraction(fitter.grid)
    assert found == name
    each = fraction[g, np.maximum(k, 0), f]
    assert_allclose(samples.values(name).value, each, rtol=1e-12, atol=1e-12)
    # without dust there is no power of the AGN, or nothing else than it
    clear = np.flatnonzero(fitter.grid.galaxy_properties["dust_luminosity"].value == 0)
    assert clear.size == 4
    flux = 1e10 * fitter.grid.flux(0, clear[0], 0, 2)
    bright = photometry_table(fitter.grid.filters, flux, 1e-3 * flux)
    drawn = BayesFitter(fitter.grid, model_error=0.0).sample(bright, 500, seed=4)
    _, g, _, f = np.moveaxis(drawn.index, -1, 0)
    alone = drawn.values(name).value[np.isin(g, clear) & (f > 0)]
    assert alone.size > 50
    assert_array_equal(alone, 0.0 if definition == "dust" else 1.0)
    column = results.to_table()[f"{name}_mean"]
    assert_array_equal(column.value, mean)
    assert samples.description(name) in column.info.description
