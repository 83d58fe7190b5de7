"""Mock catalogs refitted (what they are made of is in ``test_limits``), and bands left out."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.grids import draw_photometry, node_fitter
from miricigale.fitting import leave_out, mock_analysis
from miricigale.plotting.axes import new_figure


@pytest.fixture(scope="module")
def catalog(grid):
    return draw_photometry(grid, 400, seed=8, noise=0.15, missing=0.1)[0]


@pytest.fixture(scope="module")
def fitter(grid):
    return node_fitter(grid, model_error=0.0)


@pytest.fixture(scope="module")
def results(fitter, catalog):
    return fitter.fit(catalog)


@pytest.fixture(scope="module")
def mock(fitter, results, catalog):
    return mock_analysis(fitter, results, catalog, seed=5)


def test_recovery_is_calibrated(mock):
    """
    Best models have the noise of the catalog in them and are not drawn from the prior.

    The intervals need not hold 68 % of them, but not far from it.
    """
    table = mock.metrics()
    assert list(table["parameter"]) == list(mock.parameters)
    row = {name: table[table["parameter"] == name][0] for name in mock.parameters}
    for name in ("redshift", "frac_agn", "mass", "ir_luminosity"):
        assert abs(row[name]["coverage"] - 0.68) < 0.1, name
        assert abs(row[name]["offset"]) < max(row[name]["scatter"], 0.03), name
        assert row[name]["n"] == 400
    assert row["mass"]["unit"] == "dex"
    assert row["age"]["unit"] == "Gyr"
    # a torus that is not there has no true parameters
    with_agn = np.count_nonzero(mock.truth.best["frac_agn"] > 0)
    assert row["tau97"]["n"] == with_agn < 400


def test_without_noise_the_truth_comes_back(grid):
    table, truth = draw_photometry(grid, 30, seed=2, noise=1e-4)
    fitter = node_fitter(grid, model_error=0.0)
    results = fitter.fit(table)
    mock = mock_analysis(fitter, results, table, seed=1)
    out = mock.to_table()
    assert_allclose(out["redshift_mean"], out["redshift_true"])
    assert_allclose(out["mass_mean"], out["mass_true"], rtol=0.01)
    # where there is no dust the AGN fraction is of nothing, and any mass is right
    lit = np.array([grid.dust_luminosity[t[1]] > 0 for t in truth])
    assert_allclose(out["mass_true"].value[lit], np.array([t[4] for t in truth])[lit], rtol=0.01)
    assert np.all(np.abs(mock.metrics(["mass"])["offset"]) < 0.01)


def test_a_cut_changes_nothing(fitter, results, catalog, mock):
    few = catalog[[7, 300, 12]]
    part, other = (mock_analysis(fitter, fitter.fit(few), few, seed=seed) for seed in (5, 6))
    for name in results.filters:
        assert_array_equal(part.photometry[name], mock.photometry[name][[7, 300, 12]])
    assert np.any(other.photometry["band0"] != part.photometry["band0"])


def test_objects_without_fit_and_upper_limits_stay(fitter, catalog):
    table = catalog[:4].copy()
    for name in fitter.grid.filters:
        table[name][1] = np.nan
    table["band2_limit"] = [True, False, False, False]
    table["band2"][0] = 5 * u.uJy
    results = fitter.fit(table)
    mock = mock_analysis(fitter, results, table, seed=0, model_error=True)
    assert mock.recovered.flags[1] == results.flags[1] == 1
    assert mock.photometry["band2"][0] == 5 * u.uJy
    assert mock.photometry["band2"][2] != table["band2"][2]
    assert mock.metrics(["redshift"])["n"][0] == 3


def test_known_redshifts_have_to_be_given_again(fitter, catalog):
    table = catalog[:5]
    results = fitter.fit(table, redshift="redshift")
    refuses("'redshift' must be given again", mock_analysis, fitter, results, table, seed=0)
    mock = mock_analysis(fitter, results, table, seed=0, redshift="redshift")
    assert_array_equal(mock.recovered.best["redshift"], results.best["redshift"])
    arguments = (mock_analysis, fitter, results, table[::-1])
    refuses("'photometry' must be of the objects", *arguments, seed=0, redshift="redshift")


def test_bands_left_out(fitter, catalog, results):
    out = leave_out(fitter, catalog, ["band1", "band4"])
    assert out.results["band1"] is out.results["band4"]
    n_used = np.isfinite(results.sigma[:, [0, 2, 3, 5]]).sum(axis=1)
    assert_array_equal(out.results["band1"].n_bands, n_used)
    good = n_used >= 2
    want = (out.flux - out.predicted) / np.sqrt(out.flux_err**2 + out.predicted_std**2)
    assert_allclose(out.pull[good], want[good], rtol=1e-12)
    table = out.to_table()
    assert_array_equal(table["band4"], catalog["band4"].to(u.uJy))
    assert table["band4_predicted"].unit == u.uJy
    assert all(table[name].info.description for name in table.colnames)
    metrics = out.metrics()
    # models and errors are right here: pulls are centered and about a third beyond 1
    assert np.all(np.abs(metrics["pull"]) < 0.3)
    assert np.all(np.abs(metrics["within"] - 0.68) < 0.12)
    each = leave_out(fitter, catalog[:20], ["band1", "band4"], separately=True)
    assert each.results["band1"] is not each.results["band4"]
    assert np.all(each.results["band1"].n_bands >= out.results["band1"].n_bands[:20])


def test_a_wrong_zero_point_is_found(fitter, catalog):
    table = catalog[:100].copy()
    table["band3"] = table["band3"] * 3.0
    out = leave_out(fitter, table, ["band3"])
    assert out.metrics()["offset"][0] == pytest.approx(2.0, abs=0.5)


def test_nothing_left_to_fit_or_to_compare_is_refused(fitter, catalog):
    every, few = [f"band{i}" for i in range(6)], catalog["id", "band2", "band2_err"]
    for table, bands, error, text in (
        (catalog, ["band9"], KeyError, "no filter of the models 'band9'"),
        (catalog, "band1", ValueError, "'bands' must be a list"),
        (few, ["band1"], ValueError, r"'photometry' must be a table with the columns \['band1"),
        (catalog, every, ValueError, r"n_bands_min = 2 or more of .* are left, got .*'band5'"),
        (catalog, every[1:], ValueError, "'bands' must be such that n_bands_min = 2"),
    ):
        refuses(text, leave_out, fitter, table, bands, error=error)
    leave_out(fitter, catalog[:3], every[2:])
    table = catalog[:20].copy()
    table["band3"], table["band4_err"] = np.nan * u.uJy, 0.0 * u.uJy
    text = r"'bands' must be measured .*got \['band3', 'band4'\]"
    refuses(text, leave_out, fitter, table, every[2:5], separately=True)
    # a limit is a prediction's due
    table["band5_limit"] = True
    assert np.isfinite(leave_out(fitter, table, ["band5"]).predicted).any()
    assert len(leave_out(fitter, catalog[:0], ["band1"])) == 0
    refuses("'fitter' must be a BayesFitter, got dict", leave_out, {}, catalog, ["band1"])


def test_drawing(mock, fitter, catalog):
    ax = new_figure()[1][0, 0]
    assert mock.plot("mass", ax=ax) is ax
    assert ax.get_xscale() == "log"
    assert "Gyr" in mock.plot("age", ax=new_figure()[1][0, 0]).get_xlabel()
    out = leave_out(fitter, catalog[:50], ["band1"])
    assert out.plot("band1", ax=new_figure()[1][0, 0]).get_xlim() == (-5, 5)
    refuses("no band that was left out 'band2'", out.plot, "band2", error=KeyError)
