"""The pages of single sources: what they hold is what the tables hold, and nothing is from outside."""

import re
import shutil

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from PIL import Image

from helpers.browser import BROWSER, opened, read_sources
from helpers.figures import no_pictures
from helpers.runs import (
    SCALE,
    SHAPE,
    do_stage,
    make_run,
    noise_image,
    sky_image,
    small_config,
)
from miricigale.fitting import FitResults
from miricigale.pages.browser import CHUNK
from miricigale.plotting import cutouts
from miricigale.plotting.cutouts import N_GRAY, Cutouts
from miricigale.sed import SEDModel
from miricigale.workflow import Context
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.page.sources_stage import FLAGS

BANDS = ["miri.f770w", "miri.f2100w"]


def read_page(folder, name="agn00"):
    """Facts of the page, and the details of all sources in its order."""
    report = folder / "report"
    return read_sources(report / f"sources-{name}.html", report / "sources" / name)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with a sample, and what its page holds."""
    folder = tmp_path_factory.mktemp("sources") / "run"
    make_run(folder, BANDS, report=False)
    do_stage(small_config(BANDS), folder, "sources", "agn00")
    return folder, *read_page(folder)


def product(folder, name):
    return QTable.read(folder / "agn00" / f"{name}.ecsv")


def close(values, wanted, rtol=6e-4):
    """Whether plain values, None for NaN, are those wanted."""
    values = np.array([np.nan if v is None else v for v in values], float)
    return np.allclose(values, np.asarray(wanted, float), rtol=rtol, equal_nan=True)


def test_the_table_holds_what_the_tables_hold(run):
    folder, facts, entries = run
    table = facts["table"]
    truth, matched = product(folder, "truth"), product(folder, "matched")
    assert {len(column) for column in table.values()} == {len(truth)}
    assert sorted(table["id"]) == sorted(truth["id"])
    assert [entry["id"] for entry in entries] == table["id"]
    rows = np.searchsorted(truth["id"], table["id"])
    assert close(table["redshift"], truth["redshift"][rows])
    assert close(table["mag"], truth["wfc3.f160w"].to_value(u.ABmag)[rows])
    for name in ("selection", "n_detected", "association"):
        assert table[name] == matched[name][rows].tolist()
    conditions = [np.asarray(matched[f"{name}_condition"]) for name in BANDS]
    assert table["condition"] == (conditions[0] | conditions[1])[rows].tolist()
    for name in BANDS:
        ratio = (matched[name] / matched[f"{name}_err"]).value[rows]
        assert close(table[f"sn_{name}"], ratio, rtol=6e-3)
    for chosen in ("all", "none"):
        fits = product(folder, f"fits_{chosen}")
        at = {key: k for k, key in enumerate(fits["id"])}
        for k, key in enumerate(table["id"]):
            if key not in at:
                assert table[f"redshift_{chosen}"][k] is None
                continue
            row, names = fits[at[key]], ("redshift_mean", "frac_agn_p50", "reduced_chi2", "flags")
            columns = [f"{name}_{chosen}" for name in ("redshift", "frac_agn", "chi2", "fit")]
            assert close([table[column][k] for column in columns], [row[name] for name in names])


@pytest.mark.slow
def test_ids_that_are_text_and_fractions_of_the_catalog(tmp_path):
    with no_pictures():
        page = make_run(tmp_path, BANDS, text_ids=True, frac_agn=(0.0, "catalog"))
    text = (page / "index.html").read_text("utf-8")
    assert "AGN of the catalog" in text
    assert "source src-" in text
    do_stage(small_config(BANDS, frac_agn=(0.0, "catalog")), tmp_path, "sources", "catalog")
    facts, entries = read_page(tmp_path, "catalog")
    truth = QTable.read(tmp_path / "catalog/truth.ecsv")
    assert sorted(truth["id"]) == sorted(f"src-{k}" for k in range(1, 25))
    assert sorted(facts["table"]["id"]) == sorted(truth["id"])
    assert [entry["id"] for entry in entries] == facts["table"]["id"]
    own = dict(zip(truth["id"].tolist(), truth["frac_agn"], strict=True))
    assert close(facts["table"]["frac_agn"], [own[key] for key in facts["table"]["id"]])


def test_details_are_those_of_the_fits(run):
    folder, facts, entries = run
    truth, matched = product(folder, "truth"), product(folder, "matched")
    model, bands = SEDModel.yang2021(), [band["name"] for band in facts["bands"]]
    assert bands == ["megacam.r", "wfc3.f160w", "irac.ch1", *BANDS]
    results = {n: FitResults.read(folder / f"agn00/fits_{n}.fits") for n in ("all", "none")}
    fitted = [entry for entry in entries if "fits" in entry]
    assert len(fitted) == np.count_nonzero(matched["selection"] == 0) > 5
    names = [parameter["name"] for parameter in facts["parameters"]]
    assert {"redshift", "frac_agn", "stellar_mass", "sfr"} < set(names)
    for entry in fitted[:6]:
        row = int(np.flatnonzero(truth["id"] == entry["id"])[0])
        assert close(entry["true"], [truth[name][row].value for name in bands])
        assert close(entry["flux"][3:], [matched[name][row].value for name in BANDS])
        for kind, column in (("photometry", "flags"), ("condition", "condition")):
            assert entry["bits"][kind] == [matched[f"{name}_{column}"][row] for name in BANDS]
        one = results["all"].loc[entry["id"]]
        assert [*one.filters] == bands
        assert close(entry["flux"], one.flux)
        assert close(entry["error"], one.flux_err, rtol=6e-3)
        assert close([entry["parameters"][names.index("sfr")]], [truth["sfr"][row].value])
        for name, found in results.items():
            one, fit = found.loc[entry["id"]], entry["fits"][name]
            assert (fit["n_bands"], True) == (one.n_bands, close([fit["chi2"]], [one.chi2]))
            mass = [kind("stellar_mass").value for kind in (one.mean, one.std)]
            assert close(fit["moments"][names.index("stellar_mass")], mass)
            for parameter, (first, weights) in fit["pdf"].items():
                whole = np.zeros(len(one.pdf[parameter]))
                whole[first : first + len(weights)] = weights
                assert np.allclose(whole, 1000 * one.pdf[parameter], atol=0.5)
                assert len(facts["pdf_edges"][name][parameter]) == len(whole) + 1
            # the cells conserve the light: their sum is that of the spectrum
            wave = np.array(facts["wave"])
            half = np.sqrt((wave[-1] / wave[0]) ** (1 / (len(wave) - 1)))
            flux = np.array([0.0 if v is None else 10 ** (v / 1000) for v in fit["spectrum"]])
            fine = np.geomspace(wave[0] / half, wave[-1] * half, 200_000)
            light = np.trapezoid(one.best_sed(model).fnu_at(fine * u.um).value, fine)
            assert np.sum(flux * wave * (half - 1 / half)) == pytest.approx(light, rel=2e-3)


@pytest.mark.slow
def test_a_source_without_a_fit_says_why(tmp_path):
    make_run(tmp_path, BANDS[:1], mass=1e4, report=False)
    do_stage(small_config(BANDS[:1]), tmp_path, "sources", "agn00")
    facts, entries = read_page(tmp_path)
    assert not any("fits" in entry for entry in entries)
    words = {word for word, _ in facts["flags"]["selection"].values()}
    assert "few bands" in words
    assert all(value & 16 for value in facts["table"]["selection"])
    assert facts["flags"]["selection"]["16"] == ["few bands", "Detected in too few MIRI bands."]


def test_pictures_are_of_so_many_sources_the_fitted_and_the_brightest_first(run, tmp_path):
    folder, facts, every = run
    assert facts["pictured"] == sum(entry["top"] is not None for entry in every)
    assert all(entry["imaged"] == (entry["top"] is not None) for entry in every)
    shutil.copytree(folder, tmp_path / "run")
    config = StudyConfig.from_dict({"report": {"pictures": 5}}, base=small_config(BANDS))
    do_stage(config, tmp_path / "run", "sources", "agn00")
    facts, entries = read_page(tmp_path / "run")
    shown = [entry["id"] for entry in entries if entry["top"] is not None]
    assert len(shown) == facts["pictured"] == 5
    # nothing else is left out
    kept, wanted = (
        sorted((one["id"], one["imaged"], "fits" in one) for one in some)
        for some in (entries, every)
    )
    assert kept == wanted
    magnitude = dict(zip(facts["table"]["id"], facts["table"]["mag"], strict=True))
    fitted = [entry["id"] for entry in every if "fits" in entry and entry["imaged"]]
    assert len(fitted) > 5
    assert sorted(shown) == sorted(sorted(fitted, key=magnitude.get)[:5])
    with Image.open(tmp_path / "run/report/sources/agn00/000.png") as sheet:
        assert sheet.size[1] == 5 * facts["cutouts"]["height"]


def test_pictures_of_many_sources_are_looked_at_in_parts(run, monkeypatch):
    context = Context(small_config(BANDS), run[0])
    paths = "mosaic_{}", "photometry/{}_model", "photometry/{}_residual"
    bands = {b: [context.image(f"agn00/{one.format(b)}.fits") for one in paths] for b in BANDS}
    cut = Cutouts(context.image("f160w.fits"), bands)
    monkeypatch.setattr(cutouts, "_AT_ONCE", 5)
    found = cut.on_image(product(run[0], "truth")["sky"])
    assert sum(found) == sum(entry["imaged"] for entry in run[2])


def test_every_flag_has_its_meaning():
    for flags in FLAGS.values():
        meanings = flags.meanings()
        assert list(meanings) == [member.value for member in flags]
        for word, text in meanings.values():
            assert word.replace(" ", "_").upper() in flags.__members__
            assert text.endswith("."), (word, text)


def test_the_page_needs_nothing_from_outside(run):
    folder = run[0]
    report = folder / "report"
    text = (report / "sources-agn00.html").read_text("utf-8")
    assert set(re.findall(r"\w+://[^\"'\s)]*", text)) <= {"http://www.w3.org/2000/svg"}
    assert not re.search(r"\b(fetch|XMLHttpRequest|import)\b", text)
    assert not re.findall(r"<(?:script|link|img)[^>]*\b(?:src|href)=", text)
    assert len(list((report / "sources/agn00").glob("*.js"))) == -(-24 // CHUNK)


def test_pictures_show_the_sky_about_the_source():
    data = np.random.default_rng(3).normal(size=SHAPE)
    # 10 pixels east and 15 north of the source
    data[65 + 15, 85 - 10] = 400.0
    image = sky_image(SCALE, SHAPE, data)
    model = sky_image(SCALE, SHAPE, np.where(data > 100, data, 0.0))
    residual = sky_image(SCALE, SHAPE, np.where(data > 100, 0.0, data))
    pictures = Cutouts(image, {"miri.f770w": [image, model, residual]})
    layout = pictures.describe()
    assert layout["prior"] == layout["side"] == 49
    assert layout["sigma"] == pytest.approx([1.0, 1.0], rel=0.03)
    here = image.wcs.pixel_to_world(85, 65)
    sky = SkyCoord([here, here.directional_offset_by(0 * u.deg, 30 * u.arcsec)])
    assert pictures.on_image(sky).tolist() == [True, False]
    sheet, tops = pictures.sheet(sky)
    pixels = np.asarray(sheet).reshape(2, layout["height"], 2 * 49)
    for top, left in ((0, 0), (0, 49), (49, 49)):
        picture = np.where(pixels[0] == N_GRAY, 0, pixels[0])[top : top + 49, left : left + 49]
        assert np.unravel_index(np.argmax(picture), (49, 49)) == (24 - 15, 24 - 10)
        assert picture.max() == N_GRAY - 1
    assert tops[0] == pytest.approx([400.0, 400.0])
    # nothing is there: no data, and the least range of the stretch
    assert np.all(pixels[1] == N_GRAY)
    assert tops[1] == pytest.approx(10 * np.array(layout["sigma"]), rel=1e-2)
    # one stretch: noise has the same shades in mosaic and residual
    mosaic, model, rest = (pixels[0, 49 * k : 49 * (k + 1), 49:] for k in range(3))
    dark = mosaic == N_GRAY - 1
    assert np.array_equal(mosaic[~dark], rest[~dark])
    assert len(np.unique(model)) == 2


def test_pictures_of_images_without_noise_are_clean():
    data = np.zeros(SHAPE)
    data[65, 85] = 5.0
    image, nothing = (sky_image(SCALE, SHAPE, values) for values in (data, np.zeros(SHAPE)))
    with np.errstate(all="raise"):
        pictures = Cutouts(image, {"miri.f770w": [image, image, nothing]})
        sheet, tops = pictures.sheet(SkyCoord([image.wcs.pixel_to_world(85, 65)]))
    assert tops == pytest.approx(np.array([[5.0, 5.0]]))
    prior, (mosaic, _, rest) = (
        np.asarray(sheet)[:49, :49],
        np.asarray(sheet)[:, 49:].reshape(3, 49, 49),
    )
    for picture, n_dark in ((prior, 1), (mosaic, 1), (rest, 0)):
        dark = picture == N_GRAY - 1
        assert np.count_nonzero(dark) == n_dark
        assert len(np.unique(picture[~dark])) == 1
        assert picture[~dark].max() < N_GRAY / 2


def test_pictures_of_fine_mosaics_are_no_larger():
    image, _ = noise_image(rim=0, scale=0.051, shape=(300, 300))
    pictures = Cutouts(image, {"miri.f770w": [image] * 3})
    assert (pictures.describe()["prior"], pictures.describe()["side"]) == (105, 53)
    # the light of `noise_image` is in the middle of the image
    sheet, _ = pictures.sheet(SkyCoord([image.wcs.pixel_to_world(150, 150)]))
    picture = np.asarray(sheet)[:53, 105:]
    y, x = np.nonzero(picture == picture.max())
    assert (np.mean(y), np.mean(x)) == pytest.approx((26, 26), abs=1.5)


def test_a_sheet_has_a_strip_for_each_source(run):
    folder, facts, entries = run
    layout, shown = facts["cutouts"], [entry for entry in entries[:CHUNK] if entry["top"]]
    width = layout["prior"] + len(BANDS) * layout["side"]
    with Image.open(folder / "report/sources/agn00/000.png") as sheet:
        assert (sheet.mode, sheet.size) == ("P", (width, len(shown) * layout["height"]))
    # those with pictures come first, so that the strip is the place in the file
    assert entries[: len(shown)] == shown


@pytest.mark.skipif(BROWSER is None, reason="needs a headless browser")
def test_the_page_opens_in_a_browser(run, tmp_path):
    folder, _, entries = run
    key = next(entry["id"] for entry in entries if "fits" in entry)
    page = folder / "report/sources-agn00.html"
    document = opened(page, f"{key}?show=all&redshift=0..9", tmp_path)
    assert f"<h2>Source {key}</h2>" in document
    assert f"{len(entries)} of {len(entries)} sources" in document
    # two posteriors and the spectra of two fits, each with its truth or its fluxes
    assert document.count('class="truth"') == 2
    assert document.count("<canvas") == 1 + 3 * len(BANDS)
    assert "dust luminosity (L☉)" in document
    # a filter that leaves the source out is named
    assert 'role="status"></span>' in document
    document = opened(page, f"{key}?show=all&redshift=>9", tmp_path)
    assert f'role="status">Source {key}, shown below, is not in the list' in document
