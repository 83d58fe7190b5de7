"""What people type in a session: percent, names of other programs, units of plain tables, corner plots."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from matplotlib import pyplot as plt
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from helpers.errors import refuses
from helpers.grids import node_fitter
from miricigale import BayesFitter, SEDModel
from miricigale.fitting.posterior.posterior import shares_between
from miricigale.fitting.results.corner_panels import DrawPanel


@pytest.fixture(scope="module")
def fitter(grid):
    return node_fitter(grid)


@pytest.fixture(scope="module")
def results(fitter, photometry):
    return fitter.fit(photometry)


@pytest.fixture
def figure():
    yield plt.figure()
    plt.close("all")


def test_levels_are_parts_or_percent(results):
    parts = results.percentile("redshift", [0.16, 0.5, 0.84])
    assert_array_equal(results.percentile("redshift", [16, 50, 84]), parts)
    assert_array_equal(results.percentile("redshift"), parts)
    assert_array_equal(results.percentile("redshift", 16), parts[:, 0])
    assert_allclose(results.interval("redshift"), parts[:, [0, 2]], rtol=1e-12)
    assert_allclose(results.interval("redshift", 68), parts[:, [0, 2]], rtol=1e-12)
    # 1 may be one percent or all of it
    for levels in (1, [0.16, 84], [50, 100], [-1], [0]):
        refuses("'levels' must be all between 0 and 1, or perc", results.percentile, "mass", levels)


def test_quantities_are_found_by_the_names_of_cigale(results):
    mass = results.mean("mass")
    for name in ("sfh.integrated", "bayes.sfh.integrated"):
        assert_array_equal(results.mean(name), mass)
    assert_array_equal(results["z"], results.median("redshift"))
    assert_array_equal(results.std("agn.fracAGN"), results.std("frac_agn"))
    assert results.unit("sfh.integrated") == u.Msun
    assert_array_equal(results.cdf("z")[1], results.cdf("redshift")[1])
    redshifts, weights = results.pdf("z")
    assert_array_equal(redshifts, results.axes["redshift"].values)
    assert_array_equal(weights, results.pdf["redshift"])
    assert_array_equal(results[0].pdf("age")[0], results.axes["age"].values * u.Gyr)
    refuses("results.distribution.'mass'.", results.pdf, "mass", error=KeyError)
    assert_array_equal(results["redshift_median"], results.median("redshift"))
    assert_array_equal(results.redshift_median, results.median("redshift"))
    axis = results.axes["redshift"]
    assert_array_equal(np.asarray(axis[:3]), axis.values[:3])
    swapped = results.percentile([16, 84], "redshift")
    assert_array_equal(swapped, results.percentile("redshift", [16, 84]))
    refuses("probability.'redshift', 2.", results.probability, len, error=TypeError)
    assert f"<GridAxis redshift: {len(axis)} values from " in repr(axis)
    assert_array_equal(results.best("agn.fracAGN"), results.best["frac_agn"])
    refuses("a name gives the arrays", results.best, error=TypeError)
    assert "z" not in results.pdf
    refuses("no parameter 'redshft'; .*redshift", results.pdf, "redshft", error=KeyError)
    refuses("no parameter 'stellar.mstar'", results.mean, "stellar.mstar", error=KeyError)


def test_calls_that_results_do_not_take_end_in_those_that_they_do(results):
    for sampled in (lambda: results[0].samples("mass", 100), lambda: results.samples()):
        refuses("a grid hold no draws; fitter.sample.photometry, 1000, seed=1. makes", sampled)
    key = results.ids[0]
    assert_array_equal(results.loc(key).chi2, results.loc[key].chi2)
    refuses("plot_sed.id., or results.0.*takes ax, model, filters", results[0].plot_sed, *range(9),
            error=TypeError)  # fmt: skip


def test_a_table_without_units_is_fitted_in_the_unit_that_is_said(fitter, photometry, results):
    plain = {
        name: getattr(photometry[name], "value", photometry[name]) for name in photometry.colnames
    }
    refuses("got no unit: give one, as unit='uJy'", fitter.fit, plain, error=u.UnitsError)
    # messages name the columns as the user does
    theirs = {"band0": "f_band0", "band0_err": "e_band0"}
    renamed = {theirs.get(name, name): column for name, column in plain.items()}
    refuses("columns 'f_band0', 'e_band0', .*got no unit", fitter.fit, renamed,
            error=u.UnitsError)  # fmt: skip
    text = renamed | {"f_band0": np.full(len(plain["id"]), "faint")}
    refuses("with numbers in column 'f_band0', got text, faint in row 0", fitter.fit, text)
    del renamed["e_band0"]
    refuses("with the columns .'f_band0_err'.*got columns .*'f_band0'", fitter.fit, renamed)
    fitted = fitter.fit(plain, unit="uJy")
    assert_array_equal(fitted.pdf["redshift"], results.pdf["redshift"])
    smaller = fitter.fit(plain, unit="nJy")
    good = results.fitted
    ratio = smaller.best_scale[good] / results.best_scale[good]
    assert_allclose(ratio, 1e-3, rtol=1e-9)


def test_redshifts_are_compared_with_known_ones(results, figure):
    z = results.median("redshift").value
    good = results.fitted
    ax = results.plot_redshift(z / 1.0, figure.subplots())
    assert "bias +0.0000" in ax.get_title()
    assert ax.get_title().startswith(f"{np.count_nonzero(good)} objects")
    # all are off by 0.2 (1 + z): the bias is that, the scatter none, and all are outliers
    ax = results.plot_redshift((1 + z) / 1.2 - 1, figure.subplots())
    assert "bias +0.2000, $\\sigma_{MAD}$ 0.0000, 100.0 % outliers" in ax.get_title()
    refuses("'z_spec' must be 12 redshifts", results.plot_redshift, [1.0])
    nothing = np.full(len(results), np.nan)
    refuses("'z_spec' must be positive for one fitted", results.plot_redshift, nothing)
    fixed = dataclasses.replace(results, redshift_fixed=True)
    refuses("'redshift' must be free", fixed.plot_redshift, z)


def shown(axes):
    return [[ax.get_visible() for ax in row] for row in axes]


def test_a_corner_plot_has_each_parameter_and_each_pair(results, figure):
    key = results.ids[results.fitted][0]
    axes = results.plot_corner(key, truths={"z": 1.0}, figure=figure)
    assert shown(axes) == [[True, False], [True, True]]
    assert axes[1, 0].get_xlabel() == "redshift"
    assert axes[1, 0].get_ylabel() == "frac_agn"
    assert axes[1, 0].lines[-1].get_xdata()[0] == 1.0
    # the panel has the joint posterior over the areas of its cells, redshift along x
    density = np.asarray(axes[1, 0].collections[0].get_array())
    one = results.loc[key]
    z_width, f_width = (
        np.diff(one.distribution(name)[0].value) for name in ("redshift", "frac_agn")
    )
    joint = one.joint_pdf("redshift", "frac_agn")
    assert_allclose(density * z_width * f_width[:, None], joint.T, atol=1e-12)
    assert axes.figure is figure
    drawn = "fitter.sample.photometry, seed=1. draws"
    refuses(
        f"no joint posterior with mass; {drawn}",
        results.plot_corner,
        key,
        ["z", "mass"],
        error=KeyError,
    )
    refuses("no parameter 'masss'", results.plot_corner, key, ["z", "masss"], error=KeyError)
    refuses("no joint posterior of", results.plot_corner, key, ["z", "age"], error=KeyError)
    refuses("plot_corner is of a single object", results.plot_corner, error=TypeError)


def test_methods_of_an_object_take_its_id_first(results, figure):
    key = results.ids[results.fitted][0]
    for name in ("plot_sed", "plot_sfh", "plot_pdf", "plot_pdf2d", "best_sed"):
        usage = rf"{name} is of a single object: results.{name}\(id\), or results\[0\].{name}"
        refuses(usage, getattr(results, name), error=TypeError)
        refuses(usage, getattr(results, name), [key], error=TypeError)
        refuses(rf"no object with the id 'x'.*{usage}", getattr(results, name), "x", error=KeyError)
    ax = results.plot_pdf(key, "redshift", figure.add_subplot())
    assert ax.get_xlabel() == "redshift"
    assert ax.has_data()


def test_columns_of_a_parameter_are_attributes(results):
    table = results.to_table()
    for name in ("redshift_p16", "redshift_mean", "frac_agn_best", "mass_p84"):
        assert_allclose(getattr(results, name), table[name])
        assert_allclose(getattr(results[0], name), table[name][0])
    assert_allclose(results.mass_err, results.std("mass"))
    assert not hasattr(results, "mood_p16")
    assert not hasattr(results, "redshift_p17")


def test_several_columns_are_a_table(results):
    table = results[["redshift", "mass"]]
    assert table.colnames == ["redshift", "mass"]
    assert_array_equal(table["mass"].value, results.mass.value)
    assert len(results[["redshift"]]) == len(results)
    part = results.to_table(["chi2_best", "mass"])
    names = [f"mass_{suffix}" for suffix in ("mean", "std", "p16", "p50", "p84", "best")]
    assert part.colnames == ["chi2_best", *names, "mass_logmean"]
    refuses("no column 'masss'", results.to_table, ["masss"], error=KeyError)
    whole = QTable(results)
    assert whole.colnames == results.to_table().colnames
    assert_array_equal(whole["mass_p50"], results.mass)
    refuses("no column or id 'redshit'", results.__getitem__, ["redshit"], error=KeyError)


@pytest.mark.parametrize("name", ["redshift", "mass"])
def test_probabilities_are_those_of_percentiles(results, name):
    levels = results.percentile(name, [0.2, 0.9])
    for row in range(3):
        low, high = levels[row]
        within = results[row].probability(name, low, high)
        assert within == pytest.approx(0.7, abs=0.01)
        assert results[row].probability(name, high=low) == pytest.approx(0.2, abs=0.01)
        text = f"{name} > {u.Quantity(high).value:.17e}"
        assert results[row].probability(text) == results[row].probability(name, low=high)
        assert results.probability(name, high)[row] == pytest.approx(0.1, abs=0.01)
    refuses("'high' must be at least 'low'", results.probability, name, 2.0, 1.0)
    refuses("'low' must be given", results.probability, name)


def test_residuals_are_in_errors(results):
    chi2 = np.nansum(results.residuals**2, axis=1)
    assert results.residuals.shape == results.flux.shape
    assert_allclose(chi2[results.fitted], results.chi2[results.fitted], rtol=1e-6)


def test_a_corner_plot_of_draws_has_any_quantity(fitter, photometry, results, figure):
    samples = fitter.sample(photometry, 400, seed=1)
    key = results.ids[results.fitted][0]
    axes = samples.plot_corner(key, ["z", "mass"], truths={"mass": 1e10}, figure=figure)
    assert axes[1, 0].get_ylabel() == "log mass (solMass)"
    assert axes[1, 1].lines[-1].get_xdata()[0] == 10.0
    low, high = axes[1, 1].get_xlim()
    draws = np.log10(samples.loc[key].values("mass").value)
    inside = np.mean((draws >= low) & (draws <= high))
    assert inside >= 0.989
    refuses("no parameter 'mood'", samples.plot_corner, key, ["mood"], error=KeyError)


def test_joint_panels_are_nearer_the_density_than_counts():
    """Independent normal numbers have a known share in each cell."""
    rng = np.random.default_rng(2)
    edges = np.linspace(-2.5, 2.5, 21)
    x, y = (DrawPanel(values, edges, False, True) for values in rng.normal(size=(2, 1000)))
    shares = x.joint_shares(y)
    inside = (np.abs([x.values, y.values]) < 2.5).all(axis=0).mean()
    assert shares.sum() == pytest.approx(inside, rel=1e-9)
    cells = x.joint_edges, y.joint_edges
    exact = np.outer(*(np.diff(norm.cdf(edges)) for edges in cells))
    counts = np.histogram2d(x.values, y.values, cells)[0] / 1000
    assert np.abs(shares - exact).sum() < 0.4 * np.abs(counts - exact).sum()


def test_brackets_are_completed(results):
    assert set(results.parameters) <= set(results._ipython_key_completions_())


def test_errors_are_columns_by_the_names_of_attributes(results):
    assert_array_equal(results["redshift_err"], results.redshift_err)
    assert_array_equal(results[["redshift", "mass_err"]]["mass_err"], results.std("mass"))


@pytest.mark.parametrize("low", [0.0, 1.0])
def test_distributions_that_are_unknown_have_no_shares(low):
    """Of objects that are not fitted, whatever the limit, below all values too."""
    values = np.array([[0.5, 1.5], [0.5, 1.5]])
    levels = np.array([[0.0, 1.0], [np.nan, np.nan]])
    shares = shares_between(values, levels, low, None)
    assert_allclose(shares, [1.5 - max(low, 0.5), np.nan])


def test_catalogs_of_surveys_are_refused_with_the_map_that_reads_them():
    bands = ("F814W", "F115W", "F444W")
    three_d = {"id": [1]}
    jades = {"ID": [1]}
    dja = {"id": [1]}
    for band in bands:
        three_d |= {f"f_{band}": [9.0], f"e_{band}": [0.5]}
        jades |= {f"{band}_KRON": [9.0], f"{band}_KRON_e": [0.5]}
        dja |= {f"{band.lower()}_tot_1": [9.0], f"{band.lower()}_etot_1": [0.5]}
    model = SEDModel.yang2021(libraries="bundled")
    fitter = BayesFitter(model, ["F444W", "F115W"], axes={"redshift": [0.5, 1.0]})
    for fit in (fitter.fit, BayesFitter(model, axes={"redshift": [0.5, 1.0]}).fit):
        refuses("--map jades .read_catalog_photometry.path, 'jades'.", fit, jades)
        refuses("--map dja .read_catalog_photometry.path, 'dja'.", fit, dja)
    # fluxes without a unit are of zero point 25 there, not uJy
    refuses("no unit: .*has its own unit, which --map 3dhst", fitter.fit, three_d,
            error=u.UnitsError)  # fmt: skip
    plain = {"id": [1], "F444W": [1.0], "F444W_err": [0.1], "F115W": [1.0], "F115W_err": [0.1]}
    with pytest.raises(u.UnitsError) as refusal:
        fitter.fit(plain)
    assert "--map" not in str(refusal.value)
