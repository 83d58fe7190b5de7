"""The grid engine where grids, priors and data are at their limits."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.grids import (
    assert_plain,
    brute_force,
    draw_photometry,
    make_grid,
    node_fitter,
    photometry_table,
)
from miricigale.fitting import GridSettings
from miricigale.fitting.grid import grid as engine_module

#: As accurate as pruning leaves the sums.
PRUNED = {"rtol": 1e-6, "atol": 1e-6, "std_rtol": 1e-4}


def test_known_redshifts_of_bright_objects():
    """
    At S/N 1000 the best model of a galaxy lies tens of thousands in chi2 below that of others.

    Weights are taken over that of a model met early; were it a poor one they would overflow.
    """
    grid = make_grid(9, n_tau=12, n_age=9)
    table, truth = draw_photometry(grid, 12, seed=8, noise=1e-3)
    fitter = node_fitter(grid, model_error=0.0)
    redshift = [grid.redshift[t[0]] for t in truth]
    results = fitter.fit(table, redshift=redshift)
    assert_plain(results, grid, **PRUNED | {"rtol": 1e-5, "atol": 1e-5}, known=redshift)
    assert np.all(np.isfinite(results.model_flux_std))


def test_priors_that_leave_little():
    """Zeros in the priors of every parameter, f = 0 and the best galaxies among them."""
    grid = make_grid(3)
    priors = {"redshift": [0.0, 1.0, 0.0, 2.0], "frac_agn": [0.0, 1.0, 0.0, 1.0]}
    priors |= {"tau": [0.0, 1.0, 0.0, 1.0, 3.0], "tau97": [0.0, 1.0], "ebv_polar": [1.0, 0.0, 1.0]}
    table, _ = draw_photometry(grid, 4, seed=2, noise=0.3)
    for rtol in (0.0, 1e-6):
        settings = GridSettings(rtol=rtol)
        results = node_fitter(grid, priors=priors, settings=settings).fit(table)
        assert_plain(results, grid, **PRUNED, priors=priors)
        for name in priors:
            assert np.all(results.pdf[name][:, np.equal(priors[name], 0)] == 0), name
    priors = {"frac_agn": [1.0, 0.0, 0.0, 0.0]}
    assert_plain(node_fitter(grid, priors=priors).fit(table), grid, **PRUNED, priors=priors)


def test_a_heavy_prior_of_no_agn():
    """What all fractions above 0 weigh together counts in what may be left out."""
    grid = make_grid(5, n_tau=12, n_age=9, frac=np.append(0.0, np.linspace(0.05, 0.95, 19)))
    priors = {"frac_agn": np.append(1.0, np.full(19, 1e-4))}
    table, _ = draw_photometry(grid, 4, seed=2, noise=0.3)
    assert_plain(node_fitter(grid, priors=priors).fit(table), grid, **PRUNED, priors=priors)


def test_several_lists_equal_one(monkeypatch):
    """With every model evaluated, cutting the list changes the order of sums and nothing else."""
    grid = make_grid(8, n_tau=20, n_age=16)
    table, _ = draw_photometry(grid, 4, noise=0.5)
    pairs = [("age", "tau97"), ("tau", "frac_agn"), ("redshift", "age"), ("redshift", "tau97")]
    pairs += [("frac_agn", "tau97")]
    for rtol, tolerance in ((0.0, 1e-11), (1e-6, 1e-6)):
        fitter = node_fitter(grid, settings=GridSettings(rtol=rtol))
        want, drawn = fitter.fit(table, pairs=pairs), fitter.sample(table, 400, seed=1)
        with monkeypatch.context() as patch:
            patch.setattr(engine_module, "_CAPACITY", 1)
            short = node_fitter(grid, settings=GridSettings(rtol=rtol))
            got, others = short.fit(table, pairs=pairs), short.sample(table, 400, seed=1)
        assert_allclose(got.pdf_2d, want.pdf_2d, rtol=tolerance, atol=tolerance)
        assert_allclose(got.log_evidence, want.log_evidence, atol=tolerance)
        assert_allclose(got.moments[:, :, :2], want.moments[:, :, :2], rtol=1e3 * tolerance)
        for pair in pairs:
            assert_allclose(got.pairs[pair], want.pairs[pair], atol=tolerance)
        # draws of either are draws from the same posterior: z within 5 of their scatter
        for samples in (drawn, others):
            mean, std = want.mean("redshift").value, want.std("redshift").value
            pull = (samples.mean("redshift").value - mean) / (std / 20.0 + 1e-12)
            assert np.all(np.abs(pull) < 5.0)


@pytest.mark.parametrize("rtol", [0.0, 1e-6])
def test_models_without_light_in_the_used_bands(rtol):
    """
    They weigh exp(-|F|^2 / 2), as their scale of 0 says, and nothing becomes infinite.

    So it is in the far ultraviolet of high redshifts.
    """
    grid = make_grid(4)
    galaxy, agn = grid.galaxy.copy(), grid.agn.copy()
    galaxy[3, :, :3] = 0.0
    galaxy[1, 5, :3] = 0.0
    agn[:, :, :3] = 0.0
    dark = replace(grid, galaxy=galaxy, agn=agn)
    table, _ = draw_photometry(grid, 4, seed=4, noise=0.5)
    for name in grid.filters[3:]:
        del table[name], table[f"{name}_err"]
    fitter = node_fitter(dark, settings=GridSettings(rtol=rtol), model_error=0.0)
    results = fitter.fit(table)
    assert results.fitted.all()
    n_fractions = grid.frac_agn.size
    for i in range(4):
        flux, sigma = results.flux[i, :3], results.sigma[i, :3]
        model = galaxy[:, :, :3] / sigma
        q = np.sum(model**2, axis=2)
        p = model @ (flux / sigma)
        variance = np.divide(1.0, q, out=np.zeros(q.shape), where=q > 0)
        gain, s = np.maximum(p, 0.0) ** 2 * variance, np.maximum(p, 0.0) * variance
        weight = np.exp(0.5 * (gain - gain.max())) * dark.allowed
        weight /= weight.sum()
        assert_allclose(results.pdf["redshift"][i], weight.sum(axis=1), rtol=1e-5)
        assert_allclose(results.pdf["frac_agn"][i], 1 / n_fractions, rtol=1e-5)
        mean = np.sum(weight * s)
        std = np.sqrt(np.sum(weight * (s**2 + variance)) - mean**2)
        assert results.mean("mass")[i].value == pytest.approx(mean, rel=1e-5)
        assert results.std("mass")[i].value == pytest.approx(std, rel=1e-4)
    samples = fitter.sample(table, 20, seed=3)
    assert np.all(np.isfinite(samples.scale))
    assert np.all(samples.scale <= results.mean("mass")[:, None].value * 1e3)


def test_a_lightless_redshift_of_high_prior_hides_no_other():
    grid = make_grid(4, n_z=6)
    galaxy, agn = grid.galaxy.copy(), grid.agn.copy()
    galaxy[2:, :, :2] = 0.0
    agn[:, :, :2] = 0.0
    dark = replace(grid, galaxy=galaxy, agn=agn)
    table, _ = draw_photometry(replace(grid, agn=agn), 3, seed=1, noise=0.1)
    table = table["id", "band0", "band0_err", "band1", "band1_err"]
    results = node_fitter(dark).fit(table)
    assert results.fitted.all()
    assert np.all(results.pdf["redshift"][:, :2].sum(axis=1) > 0.9)


def test_percentiles_where_the_most_likely_model_has_no_light():
    """
    The mass of half the posterior is about one sigma, whatever the unit of the fluxes.

    One galaxy is negative in all it could match, and has most of the prior.
    """
    grid = make_grid(4, n_z=2, n_tau=2, n_age=1, frac=[0.0])
    galaxy = np.full_like(grid.galaxy, 1e-9)
    galaxy[0, :, 3:] = 1e-3 * 1e-9
    galaxy[1, :, :3] = 1e-3 * 1e-9
    grid = replace(grid, galaxy=galaxy, allowed=np.ones_like(grid.allowed))
    unit = 1e8
    flux = unit * np.array([[-0.5, -0.5, -0.5, 0.1, 0.1, 0.1]])
    table = photometry_table(grid.filters, flux, unit)
    fitter = node_fitter(grid, priors={"redshift": [0.6, 0.4]}, model_error=0.0, scale_error=False)
    results = fitter.fit(table)
    model = galaxy[1, 0]
    scale = np.sum(model * flux) / np.sum(model**2)
    high = results.percentile("mass", [0.95])[0, 0].value
    assert np.log10(high) == pytest.approx(np.log10(scale), abs=0.011)
    assert results.percentile("mass", [0.3])[0, 0].value == 0.0


@pytest.mark.parametrize("frac", [[0.0, 0.2, 0.5, 0.999999], [0.1, 0.9, 0.99, 0.999999]])
@pytest.mark.parametrize("rtol", [0.0, 1e-6])
def test_galaxies_without_dust_where_fractions_refer_to_all_infrared_light(frac, rtol):
    """All dust luminosity is then the AGN's, which holds in both precisions and in percentiles."""
    grid = make_grid(3, frac=frac)
    dust = grid.dust_luminosity * (np.arange(grid.n_galaxies) % 2)
    galaxy = QTable(grid.galaxy_properties)
    galaxy["ir_luminosity"] = np.where(dust > 0, dust, 1e26) * 1.1 * u.W / u.Msun
    galaxy["dust_luminosity"] = dust * u.W / u.Msun
    agn = QTable(grid.agn_properties)
    agn["agn_power"] = np.linspace(0.8, 1.2, grid.n_agn)
    parts = {"galaxy_properties": galaxy, "agn_properties": agn, "frac_agn_definition": "3-1000um"}
    grid = replace(grid, dust_luminosity=galaxy["ir_luminosity"].value, **parts)
    # tori so bright that no AGN at all fits best
    grid = replace(grid, agn=grid.agn * 1e3)
    table, _ = draw_photometry(grid, 6, seed=5, noise=0.1)
    fitter = node_fitter(grid, settings=GridSettings(rtol=rtol))
    results = fitter.fit(table)
    for i in range(len(table)):
        want = brute_force(grid, results.flux[i], results.sigma[i])
        assert_allclose(results.pdf_2d[i], want["zf"], rtol=1e-5, atol=1e-6)
        assert results.moments[i, -1, 0] == pytest.approx(want["mean"][-1], rel=1e-5, abs=1e-6)
        values, weights = want["values"]["frac_agn_dust"].ravel(), want["weights"].ravel()
        all_agn = weights[values > 1 - 1e-6].sum()
        if all_agn > 0.2:
            # the upper part of the distribution is at 1
            level = 1.0 - 0.25 * all_agn
            got = results.percentile("frac_agn_dust", [level])[i, 0]
            assert float(got) == pytest.approx(1.0, abs=1e-3)


def test_signal_to_noise_of_a_millionth():
    grid = make_grid(7, n_tau=12, n_age=9)
    table, _ = draw_photometry(grid, 6, seed=3, noise=1e6)
    # measurements are never all negative by chance
    table["band0"] = np.abs(table["band0"])
    results = node_fitter(grid, model_error=0.0).fit(table)
    assert results.fitted.all()
    assert np.all(np.isfinite(results.moments[:, :, :2]))
    assert_allclose(results.pdf_2d.sum(axis=(1, 2)), 1.0, rtol=1e-12)
    # nothing is known but the sign: no model is preferred by more than the few sigma of noise
    prior = grid.allowed.sum(axis=1) / grid.allowed.sum()
    assert np.all(np.abs(np.log(results.pdf["redshift"] / prior)) < 5.0)


def test_negative_fluxes_where_many_models_fit():
    """Light of the AGN that is not wanted: in single precision too a fraction may have no positive scale."""
    grid = make_grid(9, n_tau=45, n_age=45, frac=np.linspace(0, 0.95, 8))
    table, _ = draw_photometry(grid, 2, seed=3, noise=1.0)
    for name in grid.filters[-2:]:
        table[name] = -3 * table[f"{name}_err"]
    results = node_fitter(grid, model_error=0.0, settings=GridSettings(rtol=1e-6)).fit(table)
    assert_plain(results, grid, rtol=1e-5, atol=1e-6)
