"""What is fitted where nothing else is said, and that Python and the command are one door."""

import re
import runpy
import textwrap
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pytest
from astropy.table import QTable
from astropy.utils.exceptions import AstropyDeprecationWarning
from numpy.testing import assert_allclose, assert_array_equal

from helpers.commands import command
from helpers.errors import refuses
from miricigale.filters import Filter
from miricigale.fitting import (
    BayesFitter,
    SurveyCalibration,
    TemplateError,
    fit_catalog,
    fit_file,
    leave_out,
)
from miricigale.fitting.catalogs.class_names import chosen_classes
from miricigale.fitting.fitter_text import statement
from miricigale.photometry import ErrorModel
from miricigale.sed import SEDModel, presets
from miricigale.utils.exceptions import FitWarning

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "nircam.f277w", "nircam.f444w"]
BANDS += ["miri.f770w"]
DOCS = Path(__file__).parents[2] / "docs"
#: Axes of the survey grid that keep all of their values.
KEPT = ("tau", "age", "metallicity", "frac_agn")


@pytest.fixture(autouse=True)
def thin_survey(monkeypatch):
    """The survey grid with one value of most parameters and 12 redshifts, of which priors know nothing."""
    axes = presets.survey_axes()
    thin = {name: values if name in KEPT else values[-1:] for name, values in axes.items()}
    thin["redshift"] = axes["redshift"][5:65:5]
    own = presets._values

    def values(name):
        return {n: v.copy() for n, v in thin.items()} if name == "survey_axes" else own(name)

    monkeypatch.setattr(presets, "_values", values)
    return thin


@pytest.fixture
def catalog(thin_survey):
    """Galaxies between the nodes of that grid, in AB magnitudes with errors of 5 %, one band without filter."""
    rng, n = np.random.default_rng(3), 6
    truth = QTable({"id": np.arange(n) + 1, "mass": np.full(n, 3e10) * u.Msun})
    fixed = {name: values[0] for name, values in thin_survey.items() if name not in KEPT}
    truth["redshift"] = rng.uniform(0.3, 1.5, n)
    truth["age"], truth["tau"] = rng.uniform(0.5, 3.0, n), rng.uniform(0.2, 2.0, n)
    for name, value in fixed.items():
        if name != "redshift":
            truth[name] = np.full(n, value)
    fluxes = SEDModel.survey().fluxes(truth, BANDS)
    table = QTable({"id": truth["id"]})
    for name in BANDS:
        flux = fluxes[name] * (1 + 0.05 * rng.normal(size=n))
        table[name] = flux.to_value(u.ABmag)
        table[f"{name}_err"] = np.full(n, 0.05 * 2.5 / np.log(10))
    return table


def in_flux(table):
    out = QTable({"id": table["id"]})
    for name in BANDS:
        out[name] = (table[name] * u.ABmag).to(u.uJy)
        out[f"{name}_err"] = 0.4 * np.log(10) * out[name] * table[f"{name}_err"]
    return out


@pytest.mark.slow
def test_models_bands_and_calibration_by_default():
    model, named = SEDModel.survey(), {"axes": "survey"}
    fitters = [
        BayesFitter(BANDS),
        BayesFitter(filters=BANDS),
        BayesFitter(model, BANDS),
        BayesFitter(model, BANDS, **named),
        BayesFitter(model, BANDS, axes=SEDModel.survey_axes()),
        BayesFitter().for_bands(BANDS),
        BayesFitter(model).for_bands(BANDS),
        # a grid that was made before, as one that was read is
        BayesFitter(model.grid(SEDModel.survey_axes(), BANDS)),
    ]
    for fitter in fitters:
        assert fitter.grid_name == "survey"
        # the errors of bands of which nothing was measured
        assert_array_equal(fitter.calibration.bands, fitters[0].calibration.bands)
        error = SurveyCalibration.survey().template_error.error
        assert_array_equal(fitter.calibration.template_error.error, error)
        assert fitter.grid.redshift.size == 12
        assert_array_equal(fitter.grid.galaxy, fitters[0].grid.galaxy)
        assert fitter.model_errors == dict.fromkeys(BANDS[:6], 0.02) | {"miri.f770w": 0.15}
    # errors that are given take its place, and None turns it off; other grids have none
    error = TemplateError([1.0] * u.um, [0.2])
    for options in (
        {"model_error": 0.1},
        {"template_error": error},
        {"calibration": None},
        {"compat": "cigale"},
        {"axes": SEDModel.survey_axes() | {"age": [1.0]}},
    ):
        fitter = BayesFitter(model, BANDS, **named | options)
        assert fitter.calibration is None
    other = BayesFitter(model.grid(SEDModel.survey_axes() | {"age": [1.0]}, BANDS))
    assert other.calibration is None
    assert set(BayesFitter(BANDS, calibration=None).model_errors.values()) == {0.1}
    changed = fitters[0].replace(model_error=0.2)
    assert changed.calibration is None
    back = changed.replace(model_error=None).calibration
    assert_array_equal(back.bands, fitters[0].calibration.bands)
    assert changed.model is fitters[0].model


def test_axes_without_a_model_change_those_of_the_survey():
    """Other redshifts keep its other axes and its calibration, which has nothing by redshift."""
    redshift = [0.5, 1.0, 1.5, 2.0]
    whole = SEDModel.survey_axes()
    n_others = np.prod([values.size for name, values in whole.items() if name != "redshift"])
    changed = {"redshift": redshift}
    fitters = [
        BayesFitter(BANDS, axes=changed),
        BayesFitter(axes=changed).for_bands(BANDS),
        BayesFitter(BANDS, grid=changed),
        BayesFitter(filters=BANDS, nodes=changed),
        BayesFitter(SEDModel.survey(), BANDS, axes=whole | changed),
        BayesFitter(SEDModel.survey().grid(whole | changed, BANDS)),
    ]
    usual = BayesFitter(BANDS)
    # not the grid that was made
    assert usual.replace(axes=whole | changed).grid.redshift.size == 4
    for fitter in fitters:
        assert fitter.grid.n_models == 4 * n_others
        assert fitter.grid_name is None
        assert fitter.model_errors == usual.model_errors
        assert_array_equal(fitter.template_error.error, usual.template_error.error)
        assert_allclose(fitter.priors.axes["age"].weights, usual.priors.axes["age"].weights)
        assert fitter.replace(n_bands_min=3).calibration.name == "CEERS"
    assert BayesFitter(grid="yang2021-quick").grid_name == "yang2021-quick"


def test_axes_that_lose_the_calibration_or_most_models_warn():
    text = "other values than the grid 'survey' has for age, inclination: there is no calibration"
    axes = {"age": [1.0], "inclination": [30.0, 70.0], "redshift": [0.5, 1.0]}
    with pytest.warns(FitWarning, match=text):
        fitter = BayesFitter(axes=axes)
    # once, and not where errors are given
    fitter = fitter.for_bands(BANDS)
    assert fitter.calibration is None
    assert fitter.grid.redshift.size == 2
    assert BayesFitter(BANDS, axes=axes, model_error=0.1).grid.n_models == fitter.grid.n_models
    assert BayesFitter(BANDS, axes=axes, calibration=None).calibration is None
    # axes of a model are all that it has
    text = "a grid of 2 models, whose galaxies all have tau=1, age=1, ebv=0.3; axes=SEDModel.survey"
    with pytest.warns(FitWarning, match=text):
        BayesFitter(SEDModel.survey(), BANDS, axes={"redshift": [0.5, 1.0]})
    refuses("takes the place of the model", BayesFitter, BANDS, grid=fitter.grid, error=TypeError)


def test_a_fitter_says_what_it_fits():
    """Models, bands, and errors with priors: those that are not flat in the nodes."""
    fitter = BayesFitter(BANDS)
    models, bands, errors = statement(fitter, ["miri.f999w"])
    assert f"the grid 'survey' of {fitter.grid.n_models:,} models, redshifts 0.12 to" in models
    assert bands == f"bands: 7 fitted, {', '.join(BANDS)}; not fitted: miri.f999w"
    assert (
        "calibration 'CEERS'; errors of the models 4 to 58 % of the flux; 2 to 15 % of the flux added"
        in errors
    )
    assert errors.endswith("mass and redshift")
    assert errors.removeprefix("errors and priors: ") in fitter.summary()
    weights = np.arange(1.0, 1.0 + fitter.priors.axes["age"].values.size)
    own = fitter.replace(model_error={BANDS[0]: 0.2}, outliers=0.05, priors={"age": weights})
    text = "0 to 20 % of the flux added to errors; 5 % of fluxes wrong; priors of age"
    assert statement(own)[2] == f"errors and priors: {text}"
    assert "bands: of the photometry" in BayesFitter().summary()


@pytest.mark.slow
def test_the_grid_of_the_study_is_asked_for_by_name():
    fitter = BayesFitter(BANDS, axes="yang2021-quick")
    assert fitter.model.preset == fitter.grid_name.partition("-")[0] == "yang2021"
    assert fitter.calibration is None
    assert set(fitter.model_errors.values()) == {0.1}
    galaxies = SEDModel.yang2021(agn=False)
    assert BayesFitter(galaxies).grid_name == "yang2021"
    wanted = SEDModel.yang2021_axes("galaxy")
    found = galaxies.named_axes()
    assert found.keys() == wanted.keys()
    for name, values in wanted.items():
        assert_array_equal(found[name], values)
    for former, name in (("quick", "yang2021-quick"), ("fit", "yang2021")):
        with pytest.warns(AstropyDeprecationWarning, match=f"{former!r} is now called {name!r}"):
            assert BayesFitter(axes=former).grid_name == name


@pytest.mark.slow
def test_without_bands_those_of_the_photometry_are_fitted(catalog, tmp_path):
    """As for the same bands by name, whatever columns are called, from a file too."""
    wanted = BayesFitter(BANDS).fit(in_flux(catalog))
    other = QTable({"id": catalog["id"]})
    for name in BANDS:
        short = name.partition(".")[2].upper()
        other[f"mag_{short}"] = catalog[name] * u.ABmag
        other[f"e_mag_{short}"] = catalog[f"{name}_err"] * u.mag
    fitter = BayesFitter()
    found = fitter.fit(other)
    assert found.filters == tuple(BANDS)
    assert_allclose(found.pdf["redshift"], wanted.pdf["redshift"], rtol=1e-9, atol=1e-15)
    assert fitter.for_bands(BANDS) is fitter.for_photometry(other)
    drawn = fitter.sample(other, 5, seed=1)
    assert_array_equal(drawn.ids, catalog["id"])
    table = in_flux(catalog)
    table["miri.f999w"] = table["miri.f999w_err"] = 1.0 * u.uJy
    table.write(tmp_path / "cat.fits")
    for call in (
        lambda: fitter.fit(table),
        lambda: fit_file(fitter, tmp_path / "cat.fits", tmp_path / "out"),
    ):
        with pytest.warns(FitWarning, match=r"are not fitted, .*: miri\.f999w"):
            found = call()
    assert len(found) == len(catalog)
    refuses("with columns <filter> and <filter>_err", fitter.fit, QTable({"id": [1]}))
    refuses("has some", BayesFitter(BANDS).for_bands, BANDS)
    refuses("left out where 'model' is a list of bands", BayesFitter, BANDS, BANDS)


@pytest.mark.slow
def test_python_and_the_command_give_the_same_numbers(catalog, tmp_path, capsys):
    """Of AB magnitudes through a map, of fluxes, and of a table in memory: without an option anywhere."""
    catalog.write(tmp_path / "mag.csv")
    (tmp_path / "ab.toml").write_text('[units]\nflux = "ABmag"\n')
    in_flux(catalog).write(tmp_path / "flux.fits")
    argv = ["fit", str(tmp_path / "mag.csv"), "--map", str(tmp_path / "ab.toml"), "--no-progress"]
    told = command(capsys, *argv, "-o", str(tmp_path / "one"))
    # --classes with no class is the same fit
    fluxes = ["fit", str(tmp_path / "flux.fits"), "--no-progress", "--classes", ""]
    command(capsys, *fluxes, "-o", str(tmp_path / "two"))
    assert "6 objects, 6 fitted" in told.out
    of_call = fit_catalog(tmp_path / "flux.fits", tmp_path / "three").to_table()
    in_memory = BayesFitter(BANDS).fit(in_flux(catalog)).to_table()
    again = BayesFitter().fit(in_flux(catalog)).to_table()
    for table in (
        QTable.read(tmp_path / "one" / "table.fits"),
        QTable.read(tmp_path / "two" / "table.fits"),
        of_call,
        again,
    ):
        assert table.colnames == in_memory.colnames
        for name in ("redshift_p50", "mass_p50", "frac_agn_best", "chi2_best", "log_evidence"):
            if name in table.colnames:
                # what went through magnitudes has other last digits
                assert_allclose(
                    u.Quantity(table[name]).value, u.Quantity(in_memory[name]).value, rtol=1e-6
                )
        assert table["flags"].tolist() == in_memory["flags"].tolist()


def test_classes_by_one_option():
    assert chosen_classes("") == set()
    assert chosen_classes("quasars, red-dots") == {"quasars", "red_dots"}
    assert chosen_classes(["stars"], stars="pickles") == {"stars"}
    assert chosen_classes("all") == {"quasars", "red_dots"}
    assert chosen_classes("all", stars="pickles") == {"quasars", "red_dots", "stars"}
    assert chosen_classes((), quasars=True, stars="pickles") == {"quasars", "stars"}
    refuses(
        "no class 'quasar'; known: quasars, red_dots, stars",
        chosen_classes,
        "quasar",
        error=KeyError,
    )
    refuses("'stars' must be spectra", chosen_classes, "stars")


@pytest.mark.slow
def test_the_command_of_the_how_to_gives_the_table_of_its_python(tmp_path, monkeypatch, capsys):
    """The script is run, then its command with the map that it prints."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda: None)
    path = DOCS / "examples" / "how_to" / "fit" / "own_catalog.py"
    wanted = runpy.run_path(str(path))["results"].to_table()
    plt.close("all")
    text = re.sub("^# ?", "", path.read_text(), flags=re.MULTILINE)
    (tmp_path / "mine.toml").write_text(
        textwrap.dedent(re.search(r"code-block:: toml\n\n((?: {3}.*\n|\n)+)", text)[1])
    )
    words = re.search(r"\$ miricigale (fit .*)", text)[1].split()
    assert "3 objects, 3 fitted" in command(capsys, *words, "--no-progress").out
    found = QTable.read(tmp_path / "fits" / "table.fits")
    for name in ("redshift_p50", "mass_p50", "frac_agn_p50", "chi2_best"):
        assert_allclose(u.Quantity(found[name]).value, u.Quantity(wanted[name]).value, rtol=1e-6)


def test_curves_of_ones_own_stand_among_names():
    model = SEDModel.yang2021(agn=False)
    box = Filter([7, 7.1, 9, 9.1] * u.um, [0, 1, 1, 0], "box")
    bands = ["F160W", "IRAC1", box]
    truth = {"id": ["a"], "redshift": [0.5], "age": [1.0], "mass": [1e10]}
    errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    photometry = errors.perturb(model.fluxes(truth, bands), seed=1, filters=bands)
    axes = {"redshift": [0.4, 0.5, 1.0], "age": [0.5, 1.0]}
    fitter = BayesFitter(model, bands, axes=axes, model_error=0.02)
    results = fitter.fit(photometry)
    assert results.filters == ("wfc3.f160w", "irac.ch1", "box")
    assert results["redshift"].value == pytest.approx(0.5, abs=0.05)
    # drawn at its wavelength
    lines = results[0].plot_sed()[0].get_lines()
    assert any(np.isclose(line.get_xdata(), box.pivot.value).any() for line in lines)
    plt.close("all")
    labels = results[0].plot_sed(components=True)[0].get_legend_handles_labels()[1]
    assert {"stellar", "dust", "best model"} <= set(labels)
    plt.close("all")
    # the best history forms the best mass
    line = results.plot_sfh("a").lines[0]
    steps = np.diff(line.get_xdata())[0] * 1e9
    assert_allclose(np.sum(line.get_ydata()) * steps, results[0].best["mass"].value, rtol=0.01)
    plt.close("all")
    assert_allclose(results.best_sed("a").fnu.value, results[0].best_sed().fnu.value)
    assert results.best_sed("a", redshift=1.0).redshift == 1.0
    for name, band in ((box, "box"), ("F160W", "wfc3.f160w")):
        assert leave_out(fitter, photometry, [name]).bands == (band,)


@pytest.mark.parametrize(
    ("names", "survey"),
    [
        (("f115w_tot_1", "f115w_etot_1", "f770w_tot_1", "f770w_etot_1"), "dja"),
        (("F115W_KRON", "F115W_KRON_e", "F770W_KRON", "F770W_KRON_e"), "jades"),
    ],
)
def test_columns_of_a_survey_are_recognized(names, survey):
    """Columns as DJA (Valentino et al. 2023) and JADES (Rieke et al. 2023) call them."""
    table = QTable({name: [1.0, 2.0] for name in names})
    with pytest.raises(ValueError, match=rf"or --map {survey} \(read_catalog_photometry"):
        BayesFitter(SEDModel.survey()).fit(table)
