import dataclasses

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from astropy.tests.helper import assert_quantity_allclose
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.grids import node_fitter, photometry_table
from miricigale.fitting import FitFlags, FitResults
from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import DataError


@pytest.fixture(scope="module")
def results(grid, photometry):
    return node_fitter(grid).fit(photometry)


def test_table_has_units_descriptions_and_provenance(results, tmp_path):
    table = results.to_table()
    units = {"mass_mean": u.Msun, "sfr_p50": u.Msun / u.yr, "age_p84": u.Gyr}
    for name, unit in (units | {"accretion_power_std": u.W}).items():
        assert table[name].unit == unit
    assert all(table[name].info.description for name in table.colnames)
    assert table.meta["fit"]["prior_f"] == "grid"
    assert "nobody" in table.meta["citations"]
    assert_array_equal(table["id"], results.ids)
    path = tmp_path / "results.ecsv"
    table.write(path)
    again = QTable.read(path)
    assert_allclose(again["mass_mean"], table["mass_mean"])


def test_no_parameter_leaves_its_limits():
    """Reddening and time are not negative; a cell about the lowest node would reach below 0."""
    model = SEDModel.yang2021(libraries="bundled")
    bands = ["acs.f606w", "wfc3.f160w", "miri.f770w", "miri.f2100w"]
    axes = {"redshift": [1.0], "slope": [-0.4, 0.0], "frac_agn": [0.0, 0.5]}
    axes |= {"tau": [0.1, 1.0] * u.Gyr, "age": [0.1, 1.0] * u.Gyr, "ebv": [0.0, 0.4] * u.mag}
    axes |= {"ebv_polar": [0.0, 0.3] * u.mag, "temperature_polar": [100.0, 300.0] * u.K}
    grid = model.grid(axes, bands, cache=False)
    flux = 1e10 * grid.flux(0, np.arange(grid.n_galaxies))
    results = node_fitter(grid).fit(photometry_table(bands, flux, 0.05 * flux))
    assert set(axes) - {"redshift"} <= set(results.axes)
    for name in results.axes:
        low, high = model.parameters[name].bounds
        values = results.percentile(name, [0.001, 0.999]).value
        assert np.all((values >= low) & (values <= high)), name
        edges, _ = results[0].distribution(name)
        assert edges[0].value >= low
        assert edges[-1].value <= high
    # what may be negative is not cut at 0
    assert results[0].distribution("slope")[0][-1].value == pytest.approx(0.2)


def test_odds_of_redshifts_are_the_posterior_in_the_window_of_outliers(grid, photometry, results):
    """Flat, narrow, of two peaks, and not fitted: the window is cut out of the cells in closed form."""
    axis = dataclasses.replace(results.axes["redshift"], values=np.array([0.5, 1.5, 2.5, 3.5]))
    pdf = np.array([[0.25] * 4, [0, 1, 0, 0], [0.3, 0, 0, 0.7], [np.nan] * 4])
    some = results[:4]
    axes, pdf = some.axes | {"redshift": axis}, some.pdf | {"redshift": pdf}
    made = dataclasses.replace(some, axes=axes, pdf=pdf)
    # about medians of 2, 1.5 and 3.29, whose window holds all of the upper peak
    flat, narrow = (2.15 / 0.85 - 1.85 / 1.15) / 4, 1.65 / 0.85 - 1.35 / 1.15
    wanted = [flat, narrow, 0.7, np.nan]
    assert_allclose(made.to_table()["redshift_odds"], wanted, rtol=1e-12)
    assert made[1].redshift_odds == pytest.approx(narrow)
    known = node_fitter(grid).fit(photometry, redshift=np.full(len(photometry), grid.redshift[0]))
    assert "redshift_odds" not in known.to_table().colnames
    assert np.isnan(known.redshift_odds).all()


def test_views_agree_with_the_catalog(results):
    view = results[3]
    assert view.ids == 3
    assert view.chi2 == results.chi2[3]
    assert view.mean("mass") == results.mean("mass")[3]
    edges, weights = view.distribution("frac_agn")
    assert_allclose(edges, [0.0, 0.1, 0.35, 0.7, 1.0])
    assert weights.sum() == pytest.approx(1.0)
    assert_allclose(view.pdf_2d.sum(axis=0), weights, atol=1e-12)
    edges, weights = view.distribution("mass")
    assert edges.unit == u.Msun
    assert len(edges) == len(weights) + 1
    assert len(list(results)) == len(results)
    with pytest.raises(IndexError, match="no row 99 among 12"):
        results[99]
    with pytest.raises(KeyError, match="no object with the id 99 among 12; the first are 0, 1"):
        results.loc[99]
    refuses("no parameter 'mood'; known: accretion_power", results.mean, "mood", error=KeyError)
    refuses("'levels' must be all between 0 and 1", results.percentile, "mass", [0.5, 16])
    # fractions and percentages, or small percentages: which is meant is not guessed
    text = r"on both sides of 1 take parts, \[0.001, 0.999\] for percentages, got \[ ?0.1 99.9\]"
    refuses(text, results.percentile, "mass", [0.1, 99.9])
    refuses(r"\[0.01, 0.5\] for percentages", results.percentile, "mass", [1, 50])


def test_prediction_of_the_best_model(results, grid):
    table = results.predict()
    z, g, k, f = results.best_index[0]
    want = results.best_scale[0] * grid.flux(z, g, k, f)
    got = [table[f"{name}_best"][0].value for name in grid.filters]
    assert_allclose(got, want, rtol=1e-12)
    refuses("no filter of the models 'band9'", results.predict, ["band9"], error=KeyError)


def test_tails_that_are_not_kept_have_no_percentiles(results):
    wanted = "'levels' must be from 0.001 to 0.999 for 'mass', whose distribution is kept there"
    for level in (1e-5, 0.9995):
        refuses(f"{wanted}, got .*{level:g}", results.percentile, "mass", [0.5, level])
        refuses("for 'frac_agn_ir'", results[0].percentile, "frac_agn_ir", level)
    ends = results.percentile("mass", [0.001, 0.999])
    assert_array_equal(ends, results.quantiles[:, 0][:, [0, -1]] * u.Msun)
    # the distribution of a parameter is known in full: its first cell is uniform
    low, half = results.percentile("redshift", [1e-5, 2e-5])[0].value
    axis = results.axes["redshift"]
    first = cell_edges(axis.values, axis.bounds)[:2]
    weight = results.pdf["redshift"][0, 0]
    if weight > 2e-5:
        assert half - low == pytest.approx(1e-5 / weight * (first[1] - first[0]), rel=1e-6)


def test_foreign_files_are_refused(grid, tmp_path):
    path = tmp_path / "grid.fits"
    grid.write(path)
    refuses("holds no fit results", FitResults.read, path, error=DataError)
    path.write_text("text")
    for name in ("grid.fits", "none.fits"):
        text = f"{name} cannot be read as fit results: "
        refuses(text, FitResults.read, tmp_path / name, error=DataError)


def test_cells():
    assert_allclose(cell_edges([0, 1, 3]), [-0.5, 0.5, 2, 4])
    assert_allclose(cell_edges([0, 1, 3], (0, 3.5)), [0, 0.5, 2, 3.5])
    assert_allclose(cell_edges([2.0]), [2, 2])


def test_results_draw_what_they_hold(results):
    for name, label in (("frac_agn", "frac_agn"), ("mass", "mass (solMass)")):
        ax = Figure().subplots()
        assert results[2].plot_pdf(name, ax=ax) is ax
        edges, weights = results[2].distribution(name)
        density, drawn, _ = ax.patches[0].get_data()
        assert_array_equal(drawn, edges.value)
        width = np.diff(np.log10(drawn) if name == "mass" else drawn)
        assert_allclose(density * width, weights, atol=1e-12)
        assert ax.get_xlabel() == label
    ax = Figure().subplots()
    assert results[2].plot_pdf2d(ax=ax) is ax
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("redshift", "frac_agn")


def test_rows_ids_and_columns(results, tmp_path):
    assert results[0].ids == results.ids[0]
    assert results[-1].ids == results.ids[-1]
    assert results.loc[results.ids[2]].chi2 == results.chi2[2]
    assert results.loc[[3, 1]].ids.tolist() == [3, 1]
    table = results.to_table()
    assert_quantity_allclose(results["mass_p50"], table["mass_p50"])
    assert_quantity_allclose(results["mass"], results.median("mass"))
    # chi2_best of the table, by the name of the attribute
    assert_allclose(results["chi2"], table["chi2_best"])
    assert_quantity_allclose(results.median("mass"), table["mass_p50"])
    summary = results.summary()
    assert summary.colnames[:3] == ["id", "flags", "chi2_best"]
    assert len(results + results) == 2 * len(results)
    assert len(results.flag_names()) == len(results)
    flags = np.zeros(len(results), int)
    flags[1] = FitFlags.FEW_BANDS | FitFlags.HIGH_CHI2
    flagged = results._changed(flags=flags)
    assert str(flagged.flags[1]) == str(flagged[1].flags) == "few_bands, high_chi2"
    assert repr(flagged[1]).endswith("bands, few_bands, high_chi2>")
    assert repr(flagged[0]).endswith("bands>")
    assert flagged.to_table()["flags"].dtype.kind == "i"
    results.write(tmp_path / "a.csv")
    back = QTable.read(tmp_path / "a.csv")
    assert_allclose(back["mass_p50"], table["mass_p50"].value)
    with pytest.raises(AttributeError, match="'FitResults' object has no attribute 'medain'"):
        results.medain  # noqa: B018
    assert {"redshift", "mass", "median"} <= set(dir(results))
    assert results.loc._ipython_key_completions_() == results.ids.tolist()


def test_the_picture_of_several_objects_is_masses_over_redshifts(results):
    ax = results.plot(ax=Figure().subplots())
    x, y = ax.lines[0].get_data()
    assert_allclose(x, results["redshift"].value)
    assert_allclose(y, np.log10(results["mass"].to_value(u.Msun)))
