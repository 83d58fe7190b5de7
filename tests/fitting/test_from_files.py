"""``miricigale fit``: the folder it fills, and how it is resumed."""

import io
import warnings
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.models import BlackBody
from astropy.table import QTable, Table, vstack
from numpy.testing import assert_allclose

from helpers.browser import BROWSER, opened, read_sources
from helpers.commands import command
from helpers.errors import refuses
from helpers.figures import no_pictures
from miricigale.cli import catalogs, main
from miricigale.fitting import (
    FitFlags,
    SurveyCalibration,
    compare_classes,
    fit_catalog,
    open_results,
)
from miricigale.fitting.catalogs.catalog_rows import open_catalog
from miricigale.fitting.catalogs.page import fit_page
from miricigale.fitting.grid.node_scan import NodeScan
from miricigale.fitting.results.object_plots import write_plots
from miricigale.sed import SEDModel, read_spectra, red_dot_axes, template_grid
from miricigale.sed.foreground import band_extinction
from miricigale.utils.exceptions import MiricigaleWarning

BANDS = ("wfc3.f125w", "wfc3.f160w", "irac.ch1", "irac.ch2", "miri.f770w", "miri.f1500w")


def fit(path, *options, out="out", axes="yang2021-quick"):
    """``miricigale fit`` of a file, into a folder beside it."""
    folder = str(path.parent / out)
    return ["fit", str(path), "-o", folder, "--axes", axes, "--no-progress", *options]


@pytest.fixture(scope="module")
def catalog():
    """Five galaxies of the model, with 5 % errors."""
    axes = SEDModel.yang2021_axes("quick")
    z = axes["redshift"]
    z = z[np.linspace(z.size // 4, z.size // 2, 5).astype(int)]
    truth = QTable({"id": np.arange(5) + 1, "redshift": z, "mass": np.full(5, 1e10) * u.Msun})
    for name in ("tau", "age", "ebv", "alpha"):
        truth[name] = np.full(5, axes[name][0])
    table = SEDModel.yang2021(agn=False).fluxes(truth, list(BANDS))
    out = QTable({"id": truth["id"], "z_spec": z})
    for name in BANDS:
        out[name] = table[name]
        out[f"{name}_err"] = 0.05 * table[name]
    return out


@pytest.fixture(scope="module")
def fitted(catalog, tmp_path_factory):
    """Table of the fit of the catalog by the plain command."""
    path = tmp_path_factory.mktemp("fitted") / "cat.fits"
    catalog.write(path)
    with no_pictures():
        assert main(fit(path)) == 0
    return QTable.read(path.parent / "out" / "table.fits")


@pytest.mark.pictures
@pytest.mark.slow
def test_a_catalog_becomes_a_folder_of_results(catalog, tmp_path, capsys):
    catalog.write(tmp_path / "cat.fits")
    out = tmp_path / "out"
    options = ["--chunk-rows", "2", "--redshift", "z_spec", "--threads", "2"]
    options += ["--pairs", "age:tau", "--pairs", "ebv:age", "frac_agn:redshift"]
    argv = fit(tmp_path / "cat.fits", *options)
    assert "5 objects, 5 fitted; table: " in command(capsys, *argv).out
    assert len(open_results(out)) == 5
    for galaxy in open_results(out):
        joint = galaxy.joint_pdf("tau", "age")
        assert_allclose(joint.sum(axis=0), galaxy.pdf["age"], atol=1e-9)
        assert list(galaxy.pairs) == [("age", "tau"), ("ebv", "age")]
    table = QTable.read(out / "table.fits")
    page = (out / "page.html").read_text()
    for text in ("5 objects, 6 bands", "Redshifts were given", "miri.f770w", "What was left out"):
        assert text in page
    assert "Examples" in page
    assert page.count("<img") == 3
    # the mass formed that went in, within the errors of the fluxes and of the models between the nodes
    assert_allclose(table["mass_best"].to_value(u.Msun), 1e10, rtol=0.1)
    assert np.all(table["chi2_best"] < 0.05 * len(BANDS))
    err = command(capsys, *argv, "--chunk-rows", "3", status=2).err
    assert "holds results of another fit: chunk_rows differ" in err
    assert "give another folder, or --no-resume to replace them" in err
    assert "resume=" not in err
    with no_pictures():
        assert main([*argv, "--chunk-rows", "3", "--no-resume"]) == 0
    assert open_results(out).n_parts == 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["parquet", "vot"])
def test_catalogs_of_other_formats_and_from_standard_input(
    catalog, fitted, tmp_path, capsys, monkeypatch, kind
):
    """The values of a catalog in FITS; of parquet the table is parquet."""
    if kind == "parquet":
        pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    end = "parquet" if kind == "parquet" else "fits"
    catalog.write(tmp_path / f"cat.{kind}", format="votable" if kind == "vot" else None)
    data = io.BytesIO((tmp_path / f"cat.{kind}").read_bytes())
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(data))
    monkeypatch.chdir(tmp_path)
    for path, out in ((f"cat.{kind}", "file"), ("-", "stdin")):
        told = command(capsys, *fit(Path(path), out=out)).out
        assert f"{out}/table.{end};" in told
        found = QTable.read(f"{out}/table.{end}")
        assert found.colnames == fitted.colnames
        for name in ("id", "redshift_p50", "mass_best", "chi2_best"):
            assert_allclose(
                u.Quantity(found[name]).value, u.Quantity(fitted[name]).value, rtol=1e-12
            )


@pytest.mark.slow
def test_the_workers_of_a_scheduler_give_the_table_of_this_process(
    catalog, fitted, tmp_path, capsys
):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    catalog.write(tmp_path / "cat.fits")
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**options) as cluster:
        scheduler = ["--scheduler", cluster.scheduler_address, "--chunk-rows", "2"]
        command(capsys, *fit(tmp_path / "cat.fits", *scheduler, out="there"))
    assert open_results(tmp_path / "there").n_parts == 3
    there = QTable.read(tmp_path / "there" / "table.fits")
    for name in ("id", "redshift_p50", "mass_best", "chi2_best"):
        assert_allclose(u.Quantity(there[name]).value, u.Quantity(fitted[name]).value, rtol=1e-9)


@pytest.mark.slow
def test_real_galaxies_have_their_own_grid_whose_errors_are_logged(tmp_path, caplog):
    """Of models of the survey grid without noise the best fit is near what went in."""
    model, axes = SEDModel.survey(), SEDModel.survey_axes()
    nodes = {name: np.full(2, values[len(values) // 2]) for name, values in axes.items()}
    nodes["redshift"] = axes["redshift"][[len(axes["redshift"]) // 5, len(axes["redshift"]) // 2]]
    truth = QTable({"id": [1, 2], "mass": np.full(2, 1e10) * u.Msun} | nodes)
    # the likelihood is normalized, so that with few bands another redshift can beat chi2 = 0
    bands = [*BANDS, "acs.f435w", "acs.f606w", "acs.f814w", "miri.f1000w"]
    fluxes = model.fluxes(truth, bands)
    table = QTable({"id": truth["id"]})
    for name in bands:
        table[name], table[f"{name}_err"] = fluxes[name], 0.03 * fluxes[name]
    table.write(tmp_path / "cat.fits")
    assert main(fit(tmp_path / "cat.fits", axes="survey")) == 0
    for text in (
        "the grid 'survey' of 20,490,624 models, redshifts 0.01 to 10.13",
        "10 fitted, wfc3.f125w",
        "miri.f770w            prior  1.000              3.30       15.0",
        "calibration 'CEERS, bands of cat.fits (",
        "errors of the models 4 to 58 % of the flux",
        "2 to 15 % of the flux added to errors",
        "priors of frac_agn, age",
    ):
        assert text in caplog.text
    found = QTable.read(tmp_path / "out" / "table.fits")
    for name in ("redshift", "frac_agn", "ebv"):
        width = (found[f"{name}_p84"] - found[f"{name}_p16"]).value
        assert np.all(np.abs(found[f"{name}_best"].value - nodes[name]) < 2 * width)
    low, best, high = (np.log10(found[f"mass_{name}"].value) for name in ("p16", "best", "p84"))
    # the best is one of some thousand places; of 80 such galaxies 71 to 74 % are within half of this
    assert np.all(np.abs(best - 10) < high - low)
    assert np.all(found["chi2_best"] < 0.1 * len(bands))
    # on the nodes it has all of it, and errors that are given take the place of the calibration
    caplog.clear()
    options = ["--interpolate", "0", "--model-error", "0.1"]
    assert main(fit(tmp_path / "cat.fits", *options, axes="survey", out="nodes")) == 0
    found = QTable.read(tmp_path / "nodes" / "table.fits")
    for name in ("redshift", "frac_agn", "ebv"):
        assert_allclose(found[f"{name}_best"].value, nodes[name], rtol=1e-6)
    assert_allclose(found["mass_best"].to_value(u.Msun), 1e10, rtol=0.02)
    assert "calibration" not in caplog.text
    assert "10 % of the flux added to errors" in caplog.text


@pytest.mark.slow
def test_a_votable_in_magnitudes_by_a_map(catalog, tmp_path, capsys):
    """Names of a survey, AB magnitudes and text ids give the fits of the same fluxes."""
    table = Table({"ID": [f"obj-{k}" for k in catalog["id"]], "zspec": catalog["z_spec"]})
    lines = ["[columns]", 'id = "ID"']
    for k, name in enumerate(BANDS):
        table[f"m{k}"] = catalog[name].to_value(u.ABmag)
        table[f"dm{k}"] = np.full(5, 0.05 * 2.5 / np.log(10))
        lines += [f'"{name}" = "m{k}"', f'"{name}_err" = "dm{k}"']
    # 99 for a band of the second
    catalog = catalog.copy()
    table["m4"][1] = 99.0
    catalog["miri.f770w"][1] = np.nan * u.uJy
    table.write(tmp_path / "cat.xml", format="votable")
    (tmp_path / "map.toml").write_text("\n".join([*lines, "[units]", 'flux = "ABmag"']))
    catalog.write(tmp_path / "cat.fits")
    # draws between the nodes follow ids, which differ
    options = ["--interpolate", "0", "--chunk-rows", "3", "--redshift"]
    argv = fit(tmp_path / "cat.xml", *options, "zspec", out="one")
    with pytest.warns(MiricigaleWarning, match=r"cat\.xml: .*miri\.f770w 1 of 5 \(99\)"):
        told = command(capsys, *argv, "--map", tmp_path / "map.toml")
    assert "5 objects, 5 fitted; table: " in told.out
    assert main(fit(tmp_path / "cat.fits", *options, "z_spec", out="two")) == 0
    mine, theirs = (QTable.read(tmp_path / one / "table.fits") for one in ("one", "two"))
    assert mine["id"].tolist() == [f"obj-{k}" for k in range(1, 6)]
    for name in ("redshift_mean", "frac_agn_mean", "mass_best", "reduced_chi2"):
        # chi-square is the difference of sums of some thousands
        assert_allclose(mine[name], theirs[name], rtol=1e-9, atol=1e-15)
    assert mine["n_bands"].tolist() == [6, 5, 6, 6, 6]
    told = command(capsys, *argv, "--map", "candels", status=2)
    assert "a table with columns of 'candels'" in told.err


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished(catalog, tmp_path, capsys, monkeypatch):
    catalog.write(tmp_path / "cat.ecsv")
    out = tmp_path / "out"
    argv = fit(tmp_path / "cat.ecsv", "--chunk-rows", "2")
    own, calls = NodeScan.fit, []

    def stopped(self, *args, **kwargs):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return own(self, *args, **kwargs)

    monkeypatch.setattr(NodeScan, "fit", stopped)
    err = command(capsys, *argv, status=130).err
    assert f"stopped; 2 finished parts are in {out}/; the same command resumes here" in err
    assert main(argv) == 0
    assert len(calls) == 4
    assert len(QTable.read(out / "table.fits")) == 5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "unit"),
    [
        ({"ID": [7, 8], "mag_F770W": [23.9, -99.0], "magerr_F770W": [0.1, -99.0]}, None),
        ({"NUMBER": [7, 8], "F770W": [23.9, 99.0], "e_F770W": [0.1, 99.0]}, "ABmag"),
        ({"id": [7, 8], "F770W": [23.9, np.nan] * u.ABmag, "F770W_err": [0.1, 0.1] * u.mag}, None),
    ],
)
def test_magnitudes_in_files_are_the_fluxes_that_they_are_in_tables(tmp_path, table, unit):
    path = tmp_path / "cat.ecsv"
    QTable(table).write(path)
    got = open_catalog(path, 10, flux_unit=unit).chunk(0)
    assert got["id"].tolist() == [7, 8]
    np.testing.assert_allclose(got["miri.f770w"].to_value(u.uJy), [1.0, np.nan])
    np.testing.assert_allclose(
        got["miri.f770w_err"].to_value(u.uJy), [0.0921034, np.nan], rtol=1e-6
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--redshift", "z_phot"], "--redshift must be a column among"),
        (["--hdu", "SECOND"], "no binary table in extension 'SECOND'"),
        (["--chunk-rows", "0"], "--chunk-rows must be an integer >= 1, got 0"),
        (["--pairs", "age:mood"], "no parameter for 'pairs' 'mood'; known: age"),
        (
            ["--flux-unit", "mag"],
            "must be a unit of flux density, such as uJy, or 'ABmag', got 'mag'",
        ),
        (["--threads", "-1"], "at least 1 and an integer, got -1"),
    ],
)
def test_options_that_cannot_be_used_are_one_sentence(catalog, tmp_path, capsys, options, message):
    catalog.write(tmp_path / "cat.fits")
    assert message in command(capsys, *fit(tmp_path / "cat.fits", *options), status=2).err
    assert list((tmp_path / "out").glob("part-*")) == []


def test_pairs_are_two_names(capsys):
    refuses("2", main, ["fit", "--pairs", "age:tau", "cat.fits"], error=SystemExit)
    assert "'cat.fits' is no pair NAME:NAME" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"flux": [1.0] * u.uJy}, "a table with columns <filter> and <filter>_err"),
        (
            {"irac.ch1": [20.0] * u.mag, "irac.ch1_err": [0.1] * u.mag},
            "column 'irac.ch1' must be convertible to uJy, got mag",
        ),
    ],
)
def test_a_table_without_fluxes_is_refused_with_what_is_wanted(tmp_path, capsys, columns, message):
    QTable({"id": [1]} | columns).write(tmp_path / "cat.ecsv")
    err = command(capsys, *fit(tmp_path / "cat.ecsv"), status=2).err
    assert message in err
    assert "Traceback" not in err


@pytest.mark.pictures
@pytest.mark.slow
def test_the_page_says_how_redshifts_compare_and_what_is_left_out(catalog, tmp_path, monkeypatch):
    """Redshifts of the models themselves come back; a band of no error is counted, flags have their meanings."""
    table = catalog.copy()
    # ids that are no formulas of matplotlib
    table["id"] = [rf"$\frac{{{k}$$" for k in range(len(table))]
    table["irac.ch2_err"][1] = -1.0 * u.uJy
    table["miri.f999w"], table["miri.f999w_err"] = table["irac.ch1"], table["irac.ch1_err"]
    table.write(tmp_path / "cat.fits")
    with (
        pytest.warns(MiricigaleWarning, match=r"not fitted.*miri\.f999w"),
        pytest.warns(MiricigaleWarning, match=r"cat.fits: .* negative error .*: irac\.ch2 1;"),
    ):
        results = fit_catalog(tmp_path / "cat.fits", tmp_path / "out", axes="yang2021-quick")
    page = fit_page(results, tmp_path / "cat.fits").to_html()
    for text in (
        "objects with z_spec",
        "fluxes with an error that is no error (0, negative or infinite): irac.ch2 1;",
        "for want of a filter or of errors: miri.f999w",
        "4 bad error",
        "A flux whose error is zero, negative",
        "axis redshift",
    ):
        assert text in page, text
    assert "outliers, above 0.15" in page
    # a picture of each object that was fitted, by its id
    written = write_plots(results, tmp_path / "plots", table["id"][:2])
    assert [unquote(path.stem) for path in written] == table["id"][:2].tolist()
    refuses("no object with the id 'x'", write_plots, results, tmp_path, ["x"], error=KeyError)
    browser = tmp_path / "page.html"
    with no_pictures():
        page = fit_page(results, tmp_path / "cat.fits", browser=browser).to_html()
    assert "of all objects can be looked at <a href='sources.html'>one by one</a>" in page
    facts, entries = read_sources(tmp_path / "sources.html", tmp_path / "sources")
    assert facts["table"]["id"] == table["id"].tolist()
    fitted = results.to_table()
    assert_allclose(facts["table"]["redshift"], table["z_spec"], rtol=6e-4)
    assert_allclose(facts["table"]["z_1"], fitted["redshift_p50"], rtol=6e-4)
    assert_allclose(facts["table"]["mass_1"], np.log10(fitted["stellar_mass_p50"].value), rtol=6e-4)
    names = [parameter["name"] for parameter in facts["parameters"]]
    for k, entry in enumerate(entries):
        fit_of_page = entry["fits"]["fit"]
        sfr = fit_of_page["moments"][names.index("sfr")]
        assert_allclose(sfr[0], fitted["sfr_mean"][k].value, rtol=6e-4)
        # in thousandths
        start, weights = fit_of_page["pdf"]["redshift"]
        pdf = results[k].pdf["redshift"][start : start + len(weights)]
        assert_allclose(weights, 1000 * pdf, atol=0.5)
        best = results[k].best_sed().fnu_at(facts["wave"] * u.um).value
        ratio = 10 ** (np.array(fit_of_page["spectrum"]) / 1000) / best
        assert_allclose(np.median(ratio), 1.0, rtol=0.01)
    if BROWSER is not None:
        document = opened(tmp_path / "sources.html", "?chi2=<1e9", tmp_path / "browser")
        assert "5 of 5 sources" in document
        assert document.count('class="truth"') == 1
    monkeypatch.setattr("miricigale.fitting.catalogs.browser.MAX_OBJECTS", 2)
    with no_pictures():
        page = fit_page(results, tmp_path / "cat.fits", browser=browser).to_html()
    assert "of one object in 3 can be looked at" in page
    assert read_sources(tmp_path / "sources.html", tmp_path / "sources")[0]["table"]["id"] == (
        table["id"][::3].tolist()
    )
    monkeypatch.setattr("miricigale.fitting.catalogs.page._MAX_OBJECTS", 2)
    with no_pictures():
        few = fit_page(results, tmp_path / "cat.fits").to_html()
    assert "numbers and figures are of one object in 3, 2 of them" in few
    refuses("z_phot", fit_page, results, tmp_path / "cat.fits", z_spec="z_phot")


@pytest.mark.slow
def test_fluxes_behind_the_milky_way_give_the_galaxies_in_front_of_it(catalog, tmp_path):
    """E(B-V) of 0.3, 0.2 mag in F125W, put on the fluxes and given to the fit; without it masses are low."""
    table = catalog.copy()
    lost = band_extinction(list(BANDS), 0.3)
    for name in BANDS:
        for column in (name, f"{name}_err"):
            table[column] = table[column] * 10 ** (-0.4 * lost[name][0].value)
    table.write(tmp_path / "cat.fits")
    options = {"axes": "yang2021-quick", "redshift": "z_spec", "ebv": 0.3, "interpolate": 0}
    results = fit_catalog(tmp_path / "cat.fits", tmp_path / "out", **options)
    found = results.to_table(["mass_best", "chi2_best"])
    assert_allclose(found["mass_best"].to_value(u.Msun), 1e10, rtol=0.03)
    assert np.all(found["chi2_best"] < 0.1)


@pytest.mark.pictures
@pytest.mark.slow
def test_a_catalog_is_sorted_into_galaxies_quasars_and_stars(
    catalog, tmp_path, capsys, monkeypatch
):
    """Two stars of the library's own temperatures between the galaxies, which are of the galaxies' models."""
    wave = np.geomspace(0.2, 60, 2000) * u.um
    folder = tmp_path / "stars"
    folder.mkdir()
    for temperature in (3000, 5000, 9000):
        fnu = BlackBody(temperature * u.K)(wave) * u.sr
        flam = fnu.to(u.erg / u.s / u.cm**2 / u.AA, u.spectral_density(wave))
        columns = np.column_stack([wave.to_value(u.AA), flam.value])
        np.savetxt(folder / f"t{temperature}.dat", columns)
    grid = template_grid(read_spectra(folder), list(BANDS))
    rows = QTable({"id": [6, 7], "z_spec": [np.nan, np.nan]})
    for i, name in enumerate(BANDS):
        rows[name] = 10 * grid.galaxy[0, 1:, i] * u.uJy
        rows[f"{name}_err"] = 0.05 * rows[name]
    table = vstack([catalog, rows])
    table["miri.f999w"] = table["miri.f999w_err"] = 1.0 * u.uJy
    table.write(tmp_path / "cat.fits")
    out = tmp_path / "out"

    def warned(*args, **options):
        warnings.warn("a star is left out", MiricigaleWarning, stacklevel=2)
        return template_grid(*args, **options)

    monkeypatch.setattr("miricigale.sed.template_grid", warned)
    options = ["--chunk-rows", "4", "--quasars", "--stars"]
    argv = fit(tmp_path / "cat.fits", *options, str(folder))
    with pytest.warns(MiricigaleWarning) as record:
        assert main(argv) == 0
    # warnings of the catalog come once for all classes, those of one class too
    texts = [str(one.message) for one in record]
    assert sum("not fitted" in text and "miri.f999w" in text for text in texts) == 1
    assert texts.count("a star is left out") == 1
    table = QTable.read(out / "table.fits")
    assert table["class"].tolist() == ["galaxy"] * 5 + ["star"] * 2
    assert np.all(table["reduced_chi2_star"][5:] < 0.1)
    total = table["probability_galaxy"] + table["probability_quasar"] + table["probability_star"]
    assert_allclose(total, 1.0, rtol=1e-12)
    assert np.all(table["log_ratio_star"][:5] < -5)
    # one redshift, that of the class: stars have 0, and that as a galaxy stands beside it
    found = {"galaxy": open_results(out)}
    found |= {name: open_results(out / name) for name in ("quasar", "star")}
    galaxy = found["galaxy"].to_table()
    assert np.all(table["redshift_p50"][5:] == 0)
    assert_allclose(table["redshift_p50"][:5], galaxy["redshift_p50"][:5], rtol=1e-12)
    assert_allclose(table["redshift_p50_galaxy"], galaxy["redshift_p50"], rtol=1e-12)
    assert_allclose(table["stellar_mass_p50"].value, galaxy["stellar_mass_p50"].value, rtol=1e-12)
    assert table["stellar_mass_p50"].info.description.endswith("of the fit as a galaxy")
    other = (table["flags"] & FitFlags.OTHER_CLASS) > 0
    assert other.tolist() == [False] * 5 + [True] * 2
    # the same in Python
    same = compare_classes({name: results[:] for name, results in found.items()})
    for name in same.colnames:
        got = table[name].astype(str) if name == "class" else table[name]
        np.testing.assert_array_equal(np.asarray(got), np.asarray(same[name]))
    page = (out / "page.html").read_text()
    assert "Galaxy, quasar or star" in page
    assert "that of the galaxy" in page
    assert "those of the class of each object" in page
    monkeypatch.undo()
    # the fits of the classes are whole: the same command resumes from them, and finds nothing to do
    with no_pictures(), pytest.warns(MiricigaleWarning, match="not fitted"):
        assert main(argv) == 0
    assert "no such file" in command(capsys, *argv[:-1], tmp_path / "none", status=2).err


@pytest.mark.slow
def test_points_tell_stars_from_galaxies_of_their_colors(catalog, tmp_path):
    """A star with the spectrum of a galaxy: without points the two are the same."""
    axes = SEDModel.yang2021_axes("quick")
    sed = SEDModel.yang2021(agn=False).evaluate(
        redshift=catalog["z_spec"][0], tau=axes["tau"][0], age=axes["age"][0],
        ebv=axes["ebv"][0], alpha=axes["alpha"][0], mass=1e10,
    )  # fmt: skip
    inside = (sed.wave > 0.2 * u.um) & (sed.wave < 60 * u.um)
    flam = sed.fnu.to(u.erg / u.s / u.cm**2 / u.AA, u.spectral_density(sed.wave))
    columns = np.column_stack([sed.wave.to_value(u.AA), flam.value])
    np.savetxt(tmp_path / "galaxy.dat", columns[inside])
    table = vstack([catalog[:1]] * 3)
    table["id"] = [1, 2, 3]
    for name in ("miri.f770w", "miri.f1500w"):
        point = [0.0, 1.0, np.nan] * table[name]
        table[f"{name}_flux_point"] = point
        table[f"{name}_flux_point_err"] = 0.1 * table[name] + 0.0 * point
        table[f"{name}_flux_point_corr"] = [-0.4, -0.4, -0.4]
    table.write(tmp_path / "cat.fits")
    argv = fit(tmp_path / "cat.fits", "--nuclei", "--stars", str(tmp_path / "galaxy.dat"))
    with no_pictures():
        assert main(argv) == 0
    classes = QTable.read(tmp_path / "out" / "table.fits")
    assert classes["class"][:2].tolist() == ["galaxy", "star"]
    assert np.all(classes["class_probability"][:2] > 0.99)
    # two fluxes that differ by all of them, of variance V_P + V_T - 2 c
    galaxies = open_results(tmp_path / "out")[:]
    stars = open_results(tmp_path / "out" / "star")[:]
    without = stars.log_evidence[2]
    variance = 0.1**2 + 0.05**2 + 2 * 0.4 * 0.1 * 0.05
    # points have the errors of models, 10 % of the flux, too
    of_point = np.sqrt(variance + 0.1**2)
    width = np.array([table[name][0].to_value("uJy") for name in BANDS[4:]]) * of_point
    density = -np.log(np.sqrt(2.0 * np.pi) * width).sum()
    assert_allclose(stars.chi2[0] - stars.chi2[2], 2 / variance, rtol=0.1)
    assert galaxies.n_bands.tolist() == stars.n_bands.tolist() == [8, 8, 6]
    # the colors fit so that the density of the differences is all that is added
    assert_allclose(stars.log_evidence[1] - without, density, atol=0.3)


@pytest.mark.slow
def test_a_catalog_is_calibrated_by_its_known_redshifts(tmp_path, capsys, monkeypatch):
    """A zero point that is 15 % off is found, used, kept for the next call, and shown on the page."""
    axes, rng, n = SEDModel.yang2021_axes("quick"), np.random.default_rng(6), 104
    model = SEDModel.yang2021(agn=False)
    truth = QTable({"id": np.arange(n), "mass": np.full(n, 1e10) * u.Msun})
    for name in ("redshift", "tau", "age", "ebv", "alpha"):
        some = axes[name][8:20] if name == "redshift" else axes[name]
        truth[name] = rng.choice(some, n)
    names = ["acs.f606w", "acs.f814w", *BANDS]
    fluxes = model.fluxes(truth, names)
    table = QTable({"id": truth["id"], "zphot": truth["redshift"]})
    for name in names:
        point = 0.85 if name == "acs.f814w" else 1.0
        table[name] = point * (1 + 0.03 * rng.normal(size=n)) * fluxes[name]
        table[f"{name}_err"] = 0.03 * point * fluxes[name]
    table["zphot"][-3:] = np.nan
    table.write(tmp_path / "cat.fits")
    # few red dots: what they are tested for is that they have the same zero points
    thin = {name: values[[0, -1]] for name, values in red_dot_axes().items()}
    monkeypatch.setattr("miricigale.sed.red_dot_axes", lambda: dict(thin))
    monkeypatch.setattr("miricigale.sed.red_dot_spectra.red_dot_axes", lambda: dict(thin))
    nodes = ["--interpolate", "0"]
    options = ["--calibrate", "zphot", "--z-spec", "zphot", "--red-dots", *nodes]
    argv = fit(tmp_path / "cat.fits", *options)
    assert main(argv) == 0
    found = SurveyCalibration.read(tmp_path / "out" / "calibration.ecsv")
    points = dict(zip(found.bands["band"], found.bands["zero_point"], strict=True))
    assert points["acs.f814w"] == pytest.approx(1 / 0.85, abs=0.03)
    results = open_results(tmp_path / "out")
    first = next(iter(results.parts()))
    # the other class has the same zero points
    for some in (first, next(iter(open_results(tmp_path / "out" / "red_dot").parts()))):
        assert_allclose(some.flux[:, 1], points["acs.f814w"] * table["acs.f814w"].value, rtol=1e-6)
    page = (tmp_path / "out" / "page.html").read_text()
    for text in ("cat.fits by zphot", "zero point", "in their 16-84 % interval"):
        assert text in page
    monkeypatch.setattr("miricigale.fitting.survey.survey.calibrate", None)
    assert main(argv) == 0
    kept = ["--calibration", str(tmp_path / "out" / "calibration.ecsv")]
    # of some of the sources
    n_some = 30
    table[:n_some].write(tmp_path / "some.fits")
    assert main(fit(tmp_path / "some.fits", *kept, *nodes, out="again")) == 0
    again = next(iter(open_results(tmp_path / "again").parts()))
    assert_allclose(again.pdf["redshift"], first.pdf["redshift"][:n_some])
    # an error of the light of AGN widens what AGN are found
    for out, options in (("between", []), ("agn", ["--agn-error", "0.5"])):
        assert main(fit(tmp_path / "some.fits", *kept, *options, out=out)) == 0
    narrow, wide = (next(iter(open_results(tmp_path / out).parts())) for out in ("between", "agn"))
    assert wide.meta["fit"]["agn_error"] == 0.5
    # of each object: a mean is that of the few whose fractions are least certain
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = wide.std("frac_agn").value / narrow.std("frac_agn").value
    assert np.median(ratio[np.isfinite(ratio)]) > 1.03


def test_the_sentence_at_the_end_has_the_reason_of_objects_without_a_fit():
    """The names are those of the page of flags."""
    flags = Table({"flags": [0, int(FitFlags.NO_BAND), int(FitFlags.FEW_BANDS)]})
    results = SimpleNamespace(to_table=lambda columns: flags[columns])
    assert catalogs._outcome(results) == (
        "3 objects, 1 fitted (not fitted: 1 with the flag NO_BAND, 1 with the flag FEW_BANDS)"
    )
