"""Draws between the nodes of a grid, against the fit that they are of and the model that made the grid."""

from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import spearmanr

from helpers.errors import refuses, warned
from helpers.results import assert_same_tables
from miricigale.filters import FilterSet
from miricigale.fitting import BayesFitter, FitFlags, GridSettings, Samples
from miricigale.fitting.grid import drawn_models
from miricigale.fitting.grid.continuation import Continuation
from miricigale.sed import SED, SEDModel

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w", "miri.f1500w"]
AXES = {"redshift": [0.8, 1.0, 1.2, 1.4, 1.6], "age": [1.0, 3.0, 5.0]}
AXES |= {"ebv": [0.0, 0.1, 0.3, 0.5], "frac_agn": [0.0, 0.1, 0.3, 0.6]}
N = 4000
#: Errors within which a number of draws has to be what it should.
N_SIGMA = 4.5
NOT_CONVERGED = int(FitFlags.NOT_CONVERGED)


@pytest.fixture(scope="module")
def model():
    return SEDModel.yang2021(libraries="bundled")


@pytest.fixture(scope="module")
def fitter(model):
    settings = GridSettings(interpolate=300)
    return BayesFitter(model, BANDS, axes=AXES, model_error=0.05, settings=settings)


@pytest.fixture(scope="module")
def table(model):
    truth = {"redshift": [1.2, 1.05], "mass": [3e10, 1e10], "frac_agn": [0.3, 0.0]}
    fluxes = model.fluxes(truth | {"age": [3.0, 2.0], "ebv": [0.3, 0.2]}, BANDS)
    photometry = QTable({"id": ["a", "b"], "z": truth["redshift"]})
    for band in BANDS:
        photometry[band] = fluxes[band]
        photometry[f"{band}_err"] = 0.1 * fluxes[band]
    return photometry


@pytest.fixture(scope="module")
def results(fitter, table):
    return fitter.fit(table)


@pytest.fixture(scope="module")
def samples(fitter, table):
    return fitter.sample(table, N, seed=1)


@pytest.fixture(scope="module")
def few(fitter, table):
    return fitter.sample(table, 100, seed=1)


def test_means_and_percentiles_are_those_of_the_fit(results, samples):
    """Within their sampling errors: of means std / sqrt(n), of a distribution at p sqrt(p (1 - p) / n)."""
    assert set(results.parameters) <= set(samples.parameters)
    for name in results.parameters:
        draws = samples.values(name).value
        std = results.std(name).value
        off = draws.mean(axis=1) - results.mean(name).value
        assert np.all(np.abs(off) < N_SIGMA * std / np.sqrt(N)), name
        assert_allclose(draws.std(axis=1), std, rtol=0.1)
        for level in (0.16, 0.5, 0.84):
            value = results.percentile(name, [level]).value
            # one model of the fit has 1 % of the weight at most
            error = N_SIGMA * np.sqrt(level * (1.0 - level) / N) + 0.01
            assert np.all(np.mean(draws < value, axis=1) < level + error), name
            assert np.all(np.mean(draws <= value, axis=1) > level - error), name


def test_distributions_are_those_of_the_fit(results, samples):
    """Also where what is absent has a weight of its own."""
    for key in ("a", "b"):
        for name in AXES:
            wanted = results.loc[key].pdf[name]
            error = N_SIGMA * np.sqrt(wanted * (1.0 - wanted) / N) + 2e-3
            assert np.all(np.abs(samples.pdf(name, key)[1] - wanted) < error), name
        wanted = results.loc[key].pdf_2d
        joint = samples.pdf_2d("redshift", "frac_agn", key)[2]
        assert np.all(np.abs(joint - wanted) < N_SIGMA * np.sqrt(wanted / N) + 2e-3)
    # node and cell of a value are the same
    node = samples.axes["frac_agn"].cell_of(samples.values("frac_agn").value)
    assert_array_equal(node, samples.index[..., 3])
    assert 0.01 < np.mean(samples.values("frac_agn") == 0) < 0.99


def test_fluxes_are_those_of_the_model_at_the_drawn_place(model, results, samples):
    flux = samples.fluxes().value
    off = flux.mean(axis=1) - results.model_flux
    assert np.all(np.abs(off) < N_SIGMA * results.model_flux_std / np.sqrt(N))
    other = samples.fluxes(["miri.f1000w", "irac.ch1"]).value
    assert_array_equal(other[..., 1], flux[..., BANDS.index("irac.ch1")])
    bands = FilterSet.from_names([*BANDS, "miri.f1000w"])
    names = [*AXES, "mass"]
    for i, j in ((0, 5), (0, 77), (1, 300)):
        drawn = {name: samples.values(name)[i, j] for name in names}
        sed = model.evaluate(**drawn)
        exact = bands.synthetic_fluxes(sed).to_value(u.uJy)
        # fluxes of a fit are interpolated, those in other bands are not
        assert_allclose(flux[i, j], exact[:-1], rtol=0.02)
        assert other[i, j, 0] == pytest.approx(exact[-1], rel=1e-4)
        for name in ("sfr", "stellar_mass", "agn_power", "dust_luminosity", "a_v", "frac_agn_ir"):
            got = samples.values(name)[i, j].value
            assert got == pytest.approx(sed.derived[name].value, rel=0.02, abs=1e-3), name


def test_spectra_hold_the_fluxes(few):
    """The bands of the spectrum of each draw are its fluxes, and the percentiles go along."""
    wave, spectra = few.spectra("a", rest=False)
    filters = FilterSet.from_names(BANDS)
    flux = few.fluxes()[0]
    for j in range(0, few.n_draws, 20):
        got = filters.synthetic_fluxes(SED(wave, spectra[j]))
        assert_allclose(got.value, flux[j].value, rtol=0.02)
    band = few.sed_band("a", rest=False)
    low, high = (filters.synthetic_fluxes(SED(wave, band[name])) for name in ("p16", "p84"))
    median = np.median(flux, axis=0)
    assert np.all((median > low) & (median < high))


def test_draws_do_not_depend_on_names_order_pieces_and_workers(fitter, table, samples, monkeypatch):
    renamed = table.copy()
    renamed["id"] = [8, 5]
    renamed = renamed[::-1]
    monkeypatch.setattr(drawn_models, "_AT_ONCE", 1)
    with ThreadPoolExecutor(2) as pool:
        again = fitter.sample(renamed, N, seed=1, executor=pool)
    assert_array_equal(again.scale[::-1], samples.scale)
    assert_array_equal(again.index[::-1], samples.index)
    assert_array_equal(again.flux[::-1], samples.flux)
    other = fitter.sample(table, N, seed=2)
    assert np.mean(other.scale == samples.scale) < 0.1
    # other objects are drawn independently: ranks have a scatter of 1 / sqrt(n)
    a, b = samples.values("redshift").value
    assert abs(spearmanr(a, b).statistic) < N_SIGMA / np.sqrt(N)


def test_known_redshifts_are_those_of_all_draws(fitter, table):
    known = fitter.sample(table, 50, seed=1, redshift="z")
    assert_array_equal(known.values("redshift").value, np.repeat(table["z"][:, None], 50, axis=1))
    results = fitter.fit(table, redshift="z")
    assert_allclose(known.mean("mass").value, results.mean("mass").value, rtol=0.2)
    assert_array_equal(known.index[:, 0, 0], results.best_index[:, 0])


@pytest.mark.parametrize("redshift", [None, "z"])
def test_objects_without_models_between_are_drawn_on_nodes(fitter, table, redshift, monkeypatch):
    monkeypatch.setattr(Continuation, "place", lambda *_: None)
    n = 500
    samples = fitter.sample(table, n, seed=1, redshift=redshift)
    results = warned("not converged", fitter.fit, table, redshift=redshift)
    assert np.all(samples.flags & NOT_CONVERGED)
    assert np.all(results.flags & NOT_CONVERGED)
    assert set(samples.values("age").value.ravel()) <= set(AXES["age"])
    for name in ("mass", "age", "frac_agn", "sfr"):
        off = samples.mean(name) - results.mean(name)
        assert np.all(np.abs(off) < N_SIGMA * results.std(name) / np.sqrt(n)), name
    off = samples.fluxes().value.mean(axis=1) - results.model_flux
    assert np.all(np.abs(off) < N_SIGMA * results.model_flux_std / np.sqrt(n))
    if redshift is not None:
        assert_array_equal(samples.values("redshift")[:, 0], table["z"])


def test_objects_without_fits_are_flagged(fitter, table):
    empty = table.copy()
    for band in BANDS:
        empty[f"{band}_err"][1] = np.nan * u.uJy
    samples = fitter.sample(empty, 20, seed=1)
    assert_array_equal(samples.fitted, [True, False])
    assert samples.flags[1] & int(FitFlags.UNFITTED)
    assert np.isnan(samples.values("mass")[1]).all()
    assert np.isnan(samples.fluxes()[1]).all()


def test_rows_and_joins(fitter, table, samples):
    one = samples["b"]
    assert_array_equal(one.values("age"), samples.values("age")[1])
    assert_array_equal(one.fluxes(), samples.fluxes()[1])
    joined = Samples.concatenate([one, samples["a"]])
    assert_array_equal(joined.values("a_v"), samples.values("a_v")[::-1])
    on_nodes = fitter.replace(settings=GridSettings(interpolate=0)).sample(table, N, seed=1)
    assert on_nodes.on_nodes
    assert not samples.on_nodes
    refuses("'parts' must be with the same 'drawn'", Samples.concatenate, [samples, on_nodes])


def test_write_and_read(fitter, model, few, tmp_path):
    path = tmp_path / "draws.fits"
    few.write(path)
    again = Samples.read(path, fitter.grid, model=model)
    assert_same_tables(again.to_table(), few.to_table())
    assert_array_equal(again.fluxes(), few.fluxes())
    assert_array_equal(again.index, few.index)
    few["b"].write(path, overwrite=True)
    single = Samples.read(path, fitter.grid)
    assert single.isscalar
    assert_array_equal(single.values("sfr"), few.values("sfr")[1])
    few.write(tmp_path / "draws.ecsv")
    plain = QTable.read(tmp_path / "draws.ecsv")
    assert_allclose(plain["age"], few.to_table()["age"], rtol=1e-12)


def test_corner_plots_are_finer_than_the_grid(samples):
    axes = samples.plot_corner("a", ["redshift", "mass", "frac_agn"])
    low, high = axes[2, 0].get_xlim()
    redshift = samples["a"].values("redshift").value
    assert np.quantile(redshift, 0.001) <= low < high <= np.quantile(redshift, 0.999)
    plt.close("all")


def test_histories_are_those_of_the_drawn_galaxies(samples):
    table = samples.sfh_band("a", (0.5,))
    age = samples["a"].values("age").max()
    step = np.diff(table["lookback"])[0]
    assert u.isclose(table["lookback"][-1] + 0.5 * step, age)
    samples.plot_sfh("a")
    plt.close("all")


def test_incomplete_draws_are_refused(samples):
    parts = (samples.grid, samples.ids, samples.flags, samples.index, samples.scale)
    drawn = dict(samples.drawn)
    refuses("'flux' must be None without 'drawn'", Samples, *parts, flux=samples.flux)
    refuses("'flux' must be of shape", Samples, *parts, drawn=drawn)
    short = drawn | {"age": drawn["age"][:, 1:]}
    refuses(r"'drawn' must be of shape .*\(age\)", Samples, *parts, drawn=short, flux=samples.flux)
    del drawn["sfr"]
    refuses("'drawn' must be with 'sfr'", Samples, *parts, drawn=drawn, flux=samples.flux)
