import math

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from helpers.errors import refuses
from helpers.grids import draw_photometry, make_grid, node_fitter, photometry_table
from miricigale.fitting import BayesFitter, FitFlags, GridSettings, SamplerSettings, leave_out
from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.sed import SEDModel
from miricigale.sed.components import BC03, DelayedSFH
from miricigale.utils.exceptions import CatalogWarning, FitWarning


def test_fixed_redshift_goes_to_the_nearest_node_or_is_flagged(grid, photometry):
    z = np.array(photometry["redshift"], dtype=float)
    z[:5] = [0.23, np.nan, -1.0, 0.0, 9.0]
    results = node_fitter(grid).fit(photometry, redshift=z)
    assert results.best["redshift"][0] == grid.redshift[0]
    names = [FitFlags.names(flag) for flag in results.flags[1:5]]
    assert names == [["no_redshift"]] * 3 + [["redshift_outside"]]
    assert not results.fitted[1:5].any()
    assert results.fitted[5:].all()
    fitter = node_fitter(grid, settings=GridSettings(redshift_tolerance=0.001))
    strict = fitter.fit(photometry, redshift=z)
    assert FitFlags.names(strict.flags[0]) == ["redshift_outside"]


def test_rows_that_cannot_be_fitted_stay_in_place(grid):
    table, _ = draw_photometry(grid, 7, noise=0.05)
    for name in grid.filters:
        table[name][0] = np.nan * u.uJy
    for name in grid.filters[1:]:
        table[f"{name}_err"][1] = np.nan * u.uJy
    table["band2_err"][2] = 0.0 * u.uJy
    table["band3_err"][2] = -1.0 * u.uJy
    table["id"][4] = table["id"][3]
    for name in grid.filters:
        table[name][5] = -table[name][5]
    table["band0"][6] *= 1e4
    table["band0_err"][6] = 1e-3 * table["band0"][6]
    fitter = node_fitter(grid, model_error=0.0)
    with (
        pytest.warns(CatalogWarning, match="1 row has an id that occurred before"),
        pytest.warns(
            FitWarning, match="fluxes with a negative error are not fitted: band3 1; where"
        ),
    ):
        results = fitter.fit(table)
    names = [FitFlags.names(f) for f in results.flags]
    assert [names[i] for i in (0, 1, 4)] == [["no_band"], ["few_bands"], ["duplicate_id"]]
    for i, name in ((2, "bad_error"), (5, "no_signal"), (6, "high_chi2")):
        assert name in names[i]
    assert results.n_bands[2] == 4
    assert list(results.ids) == list(table["id"])
    assert_array_equal(results.fitted, [0, 0, 1, 1, 0, 1, 1])
    out = results.to_table()
    assert "32 duplicate id" in out["flags"].info.description
    assert np.isnan(out["mass_mean"][0])


def test_a_band_that_is_not_fitted_is_predicted(grid):
    table, truth = draw_photometry(grid, 10, noise=1e-3)
    table.remove_columns(["band3", "band3_err"])
    results = node_fitter(grid, model_error=0.0).fit(table)
    assert "band3" not in results.meta["fit"]["filters"]
    want = [s * grid.flux(z, g, k, f)[3] for z, g, k, f, s in truth]
    assert_allclose(results.predict(["band3"])["band3"].value, want, rtol=0.05)


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"filters": ["band9"]}, KeyError, "no filter of the grid 'band9'; known: band0"),
        ({"filters": "band1"}, ValueError, "'filters' must be a list of names"),
        ({"engine": "tarot"}, KeyError, "no engine 'tarot'; known: dynesty, nautilus"),
        ({"model_error": -1}, ValueError, "'model_error' must be finite and not negative"),
        ({"model_error": {"x": 1}}, ValueError, r"'model_error' must be a dict with keys among"),
        ({"priors": {"mood": "log"}}, KeyError, "no grid parameter 'mood'; known: age"),
        ({"priors": {"tau": [1, 2]}}, ValueError, r"must be 5 weights, for tau"),
        ({"priors": {"frac_agn": "log"}}, ValueError, "with values above 0"),
        ({"priors": {"tau": lambda x: -x}}, ValueError, "finite, >= 0 and not all 0"),
        ({"settings": GridSettings("no")}, ValueError, "'prior_f' must be 'grid' or 'uniform'"),
        ({"settings": SamplerSettings()}, ValueError, "'settings' must be GridSettings"),
        ({"filters": ["band0", "band0"]}, ValueError, "must be different names, at least one"),
        ({"filters": []}, ValueError, "'filters' must be different names, at least one"),
        (
            {"priors": ["tau"]},
            ValueError,
            "'priors' must be a dict of parameter name to prior, got list",
        ),
        ({"n_bands_min": True}, ValueError, "'n_bands_min' must be an integer >= 1, got True"),
        ({"scale_error": "no"}, ValueError, "'scale_error' must be True, False or None, got 'no'"),
        ({"n_bands_min": 0}, ValueError, "'n_bands_min' must be an integer >= 1"),
        ({"axes": {"a": [1]}}, ValueError, "'axes' must be None when"),
    ],
)
def test_bad_options_are_named(grid, options, error, text):
    refuses(text, BayesFitter, grid, error=error, **options)


def test_bad_photometry_is_named(grid, photometry):
    fitter = node_fitter(grid)
    refuses("'photometry' must be a table with at least one of", fitter.fit, QTable({"id": [1]}))
    some, bare = photometry.copy(), photometry.copy()
    del some["band0_err"]
    refuses(r"'photometry' must be a table with the columns \['band0_err'\]", fitter.fit, some)
    bare["band0"] = bare["band0"].value
    refuses("'photometry' column 'band0' must be convertible", fitter.fit, bare, error=u.UnitsError)
    refuses("'redshift' must be a column among", fitter.fit, photometry, redshift="z_best")
    refuses("'redshift' must be 12 values", fitter.fit, photometry, redshift=[1.0, 2.0])
    own = SEDModel([DelayedSFH(), BC03()])
    refuses("'axes' must be given for a model that has no grid of its own", BayesFitter, own)
    refuses(
        "'yang2021', 'yang2021-quick' or a dict", BayesFitter, SEDModel.yang2021(), axes="survey"
    )
    refuses("or one of 'survey', 'far-infrared'", BayesFitter, axes="yang")
    refuses("'calibration' must be a SurveyCalibration", BayesFitter, grid, calibration="CEERS")


@pytest.mark.parametrize("filters", [None, ["band0", "band1"]])
def test_what_is_no_table_is_named(grid, photometry, filters):
    fitter = node_fitter(grid, filters)
    refuses("'photometry' must be a table, a dict of columns, .* got NoneType", fitter.fit, None)
    refuses("'photometry' must be a table with", fitter.fit, {"id": [1]})
    text = r"'redshift' must be numbers, got \['a', 'b'\]"
    refuses(text, fitter.fit, photometry[:2], redshift=["a", "b"])
    table = photometry.copy()
    table["band0"], table["band0_err"] = np.full(12, 22.0) * u.ABmag, np.ones(12) * u.K
    wanted = "column 'band0_err' must be convertible to uJy, got K"
    refuses(wanted, fitter.fit, table, error=u.UnitsError)


def test_a_band_that_is_not_there_is_a_missing_band(grid, photometry):
    fitter = node_fitter(grid, ["band0", "band1", "band2"], n_bands_min=2)
    without = photometry.copy()
    without["band1"] *= np.nan
    want = fitter.fit(without)
    without.remove_columns(["band1", "band1_err"])
    with pytest.warns(FitWarning, match="the photometry has no band1: missing bands of all obje"):
        got = fitter.fit(without)
    assert_array_equal(got.chi2, want.chi2)


# ------------------------------------------------------------- densities of redshift, limits


def test_densities_that_cannot_be_used_are_flagged_or_refused():
    grid = make_grid(3, n_z=6)
    fitter = node_fitter(grid)
    table, _ = draw_photometry(grid, 4, seed=2)
    nodes = np.array([0.0, 50.0, 51.0])
    density = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [np.nan, 1.0, 1.0], [0.0, 0.0, 0.0]])
    got = fitter.fit(table, redshift_prior=(nodes, density))
    for flag, name in zip(got.flags[1:], ("no_model", "no_redshift", "no_redshift"), strict=True):
        assert name in FitFlags.names(flag)
    assert got.fitted.tolist() == [True, False, False, False]
    for prior, match in (
        ((nodes, density[:2]), "'redshift_prior' must be"),
        ((nodes[::-1], density), "ascending"),
        ((nodes, -density[:1].repeat(4, axis=0)), "not negative"),
        ("p_z", "'redshift_prior' must be"),
    ):
        refuses(match, fitter.fit, table, redshift_prior=prior)
    both = {"redshift": 1.0, "redshift_prior": (nodes, density)}
    refuses("left out where .redshift. is given", fitter.fit, table, **both)


def test_choices_of_cigale():
    """No result where exp(-chi2 / 2) vanishes, no error below 5 %, no scatter of the scale."""
    grid = make_grid(3)
    table, _ = draw_photometry(grid, 4, seed=4)
    name = grid.filters[0]
    table[name][2] *= 1e4
    table[f"{name}_err"][2] *= 0.01
    ours = node_fitter(grid, model_error=0.0, scale_error=False).fit(table)
    theirs = node_fitter(grid, model_error=0.0, compat="cigale").fit(table)
    assert (ours.chi2 > 1417).tolist() == [False, False, True, False]
    assert theirs.fitted.tolist() == [True, True, False, True]
    assert "no_likelihood" in FitFlags.names(theirs.flags[2])
    assert np.isnan(theirs.mean("mass")[2])
    good = theirs.fitted
    for quantity in ("redshift", "frac_agn", "mass", "sfr"):
        mean, std = theirs.mean(quantity)[good], ours.std(quantity)[good]
        assert_array_equal(mean, ours.mean(quantity)[good])
        want = np.maximum(std, 0.05 * np.abs(mean))
        assert_allclose(theirs.std(quantity)[good].value, want.value, rtol=1e-12)
    for options, match in (
        ({"compat": "prospector"}, "'compat' must be None or 'cigale'"),
        ({"compat": "cigale", "scale_error": True}, "'scale_error' must be False"),
    ):
        refuses(match, BayesFitter, grid, **options)


@pytest.mark.parametrize("signal", [1.0, 2.9, 3.1, 30.0])
def test_signal_to_noise_below_three_is_flagged(signal):
    """Photometry that is a model of the grid has the S/N of its fluxes in quadrature."""
    grid = make_grid(2)
    galaxy = np.flatnonzero(grid.allowed[1])[-1]
    model = grid.flux(1, galaxy, 0, 2)
    sigma = np.linalg.norm(model) / signal
    table = photometry_table(grid.filters, model, sigma)
    results = node_fitter(grid, model_error=0.0).fit(table)
    assert results.chi2[0] == pytest.approx(0.0, abs=1e-9)
    assert bool(results.flags[0] & int(FitFlags.LOW_SIGNAL)) == (signal < 3.0)


def test_priors_may_be_distributions_and_functions_of_one_value(grid, photometry):
    """scipy's normal density over the cells of the nodes, given in four ways, and their weights."""
    normal = norm(1.5, 0.7)
    nodes = node_fitter(grid).priors.axes["tau"].values

    def density(tau):
        return np.exp(-0.5 * ((tau - 1.5) / 0.7) ** 2)

    def of_one(tau):
        return math.exp(-0.5 * ((tau - 1.5) / 0.7) ** 2)

    edges = cell_edges(nodes, (nodes[0], nodes[-1]))
    weights = normal.cdf(edges[1:]) - normal.cdf(edges[:-1])
    priors = (normal, normal.pdf, density, of_one, weights)
    fits = [node_fitter(grid, priors={"tau": prior}).fit(photometry) for prior in priors]
    for other in fits[1:]:
        assert_allclose(other.pdf["tau"], fits[0].pdf["tau"], rtol=1e-6)
    # the prior of tau is that of the mean posterior's ratio to one with a flat prior
    flat = node_fitter(grid).fit(photometry).pdf["tau"] * weights
    expected = flat / flat.sum(axis=1, keepdims=True)
    assert_allclose(fits[0].pdf["tau"], expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rtol": 1}, r"'rtol' must be in \[0, 0.1\), got 1"),
        ({"rtol": "low"}, r"'rtol' must be in \[0, 0.1\), got 'low'"),
        ({"redshift_tolerance": "x"}, "'redshift_tolerance' must be >= 0, got 'x'"),
        ({"interpolate": -1}, "'interpolate' must be an integer >= 0"),
        ({"interpolate": 10**9}, "'interpolate' must be at most 20000"),
        ({"agn_error": -0.1}, "'agn_error' must be 0 or more"),
        ({"agn_error": 0.3, "interpolate": 0}, "'agn_error' must be .* 0 without 'interpolate'"),
        ({"interpolate": 0, "finer": 1}, "'finer' must be None without 'interpolate'"),
        ({"interpolate": 9, "finer": 1}, "'finer' must be an SEDModel"),
    ],
)
def test_settings_that_mean_nothing_are_refused(options, message):
    refuses(message, GridSettings, **options)


def test_weights_and_pieces_have_no_unit_and_no_fraction(grid, photometry):
    fitter, priors = node_fitter(grid), {"tau": np.ones(5) * u.Gyr}
    text = r"'priors\['tau'\]' must be convertible to"
    refuses(text, BayesFitter, grid, priors=priors, error=u.UnitsError)
    for size in (2.5, "a", True):
        refuses("'chunk_size' must be an integer >= 1", fitter.fit, photometry, chunk_size=size)
    results, text = fitter.fit(photometry), "'filters' must be a list of names or a FilterSet"
    refuses(text, results.predict, "band0")
    refuses("'bands' must be different names", leave_out, fitter, photometry, 2 * ["band1"])
