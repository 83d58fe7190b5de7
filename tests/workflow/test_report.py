"""The page of a run: any number of bands, with and without a sample, from made-up products."""

import html
import json
import re

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from helpers.figures import legend_texts, no_pictures
from helpers.runs import (
    AREA,
    SCALE,
    SHAPE,
    make_run,
    noise_image,
    sky_image,
    small_config,
)
from miricigale.evaluation import PUBLISHED
from miricigale.fitting import FitResults
from miricigale.sed import SEDModel
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.page.numbers import above_proposal, as_ceers, as_paper
from miricigale.workflow.page.pictures import field_figure, residual_figure
from miricigale.workflow.page.provenance import sources_to_cite, stand_ins
from miricigale.workflow.page.result_sections import widths
from miricigale.workflow.page.source_figures import example_figure
from miricigale.workflow.stages.sample import footprint_area, in_field
from miricigale.workflow.truths import FIELD

pytestmark = pytest.mark.slow

FILTERS = {
    "one": ["miri.f1000w"],
    "four": ["miri.f2100w", "miri.f560w", "miri.f1000w", "miri.f2550w"],
    "truths": [f"miri.f{n}w" for n in (770, 1000, 1280, 1500, 1800, 2100)],
}


def page_of(report):
    """Markup of the page without its pictures, style sheet and links."""
    page = re.sub(r"src='data:[^']*'", "", (report / "index.html").read_text())
    page = re.sub(r"<style>.*?</style>|</?a\b[^>]*>", "", page, flags=re.DOTALL)
    return html.unescape(page)


def read_metrics(report):
    # a strict reader takes it: JSON has no word for NaN
    text = (report / "metrics.json").read_text()
    return json.loads(text, parse_constant=lambda word: pytest.fail(word))


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    """Reports of several kinds of run."""
    folder = tmp_path_factory.mktemp("reports")
    truths = {"frac_agn": (0.0, 0.4, FIELD), "sets": ("all", "none", "blue", "red")}
    # its figures are among those of the run of several truths
    with no_pictures():
        four = make_run(folder / "four", FILTERS["four"], points=True)
    return {
        "one": make_run(folder / "one", FILTERS["one"], mass=1e4),
        "four": four,
        "truths": make_run(folder / "truths", FILTERS["truths"], points=True, **truths),
    }


@pytest.mark.parametrize("kind", FILTERS)
def test_each_row_stands_once_and_nothing_is_nan(reports, kind):
    page = page_of(reports[kind])
    rows = re.findall(r"<tr>(.*?)</tr>", page)
    assert len(rows) == len(set(rows)) > 10
    # one spelling of each unit
    assert not re.search(r"\b(nan|um|uJy)\b|<tbody></tbody>", page, flags=re.IGNORECASE)
    assert read_metrics(reports[kind])["n_catalog"] == 24
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", page)
    assert len(captions) == len(set(captions)) > 5
    assert all(caption.endswith(".") for caption in captions)


def test_many_sources_are_read_and_fitted_in_pieces_to_the_same_page(
    reports, tmp_path, monkeypatch
):
    for place in ("engine.stage", "stages.inputs"):
        monkeypatch.setattr(f"miricigale.workflow.{place}.LONG", 10)
    with no_pictures():
        report = make_run(tmp_path, FILTERS["four"], points=True)
    for name in ("input_seds", "agn00/fits_all", "agn00/fits_none"):
        folder, _, name = f"./{name}".rpartition("/")
        assert len(list((tmp_path / folder).glob(f"{name}_000[012].fits"))) == 3
    assert (tmp_path / "agn00" / "matched.fits").is_file()
    assert read_metrics(report) == read_metrics(reports["four"])


@pytest.mark.parametrize("kind", ["one", "four"])
def test_bands_and_conditions_are_counted(reports, kind):
    labels = [name.removeprefix("miri.").upper() for name in FILTERS[kind]]
    page, metrics = page_of(reports[kind]), read_metrics(reports[kind])
    tables = re.findall(r"<table>.*?</table>", page, re.DOTALL)
    of_bands = [one for one in tables if "<th>band</th>" in one and "published" not in one]
    # exposures, recovery, conditions, limits
    assert [re.findall(r"<tr><td>(F\d+W)</td>", one) for one in of_bands] == [labels] * 4
    assert metrics["detections"] == {
        "n": 25, "n_field": 25, "n_spurious": 1, "n_ambiguous": 0,
        "n_spurious_bright": dict.fromkeys(metrics["bands"], 1),
    }  # fmt: skip
    for entry in metrics["bands"].values():
        found = entry["conditions"]
        assert (found["n_field"], found["n_not_measured"]) == (24, 0)
        assert (found["edge"]["n"], found["ambiguous"]["n"]) == (1, 0)
        assert found["isolated"]["n"] >= 24 - 1 - found["crowded"]["n"] > 0
    page = page.replace(" class=n", "")
    counts = {"of them spurious: no source of the catalog is near": 1} | metrics["n_left_out"]
    # what sources outside of the field are else is not counted
    assert re.search(rf"sources of\s+the catalog {counts.pop('outside_field')} lie outside", page)
    for name, n in counts.items():
        assert (f"<td>{name.replace('_', ' ')}</td><td>{n}</td>" in page) == (n > 0)
    assert "<th>crowded</th><th>edge</th><th>ambiguous</th>" in page


def test_conditions_of_the_fits_are_those_of_their_tables(reports):
    folder = reports["four"].parent
    fits = read_metrics(reports["four"])["fits"]["all"]
    assert fits["conditions"]["edge"]["n"] == 1
    assert fits["conditions"]["isolated"]["n"] <= fits["n"] - 1
    condition = np.asarray(QTable.read(folder / "agn00" / "fits_all.ecsv")["condition"])
    assert np.count_nonzero(condition & 1) == 1
    assert np.count_nonzero((condition & 7) == 0) == fits["conditions"]["isolated"]["n"]
    # every row of either catalog stands in the association once
    table = QTable.read(folder / "agn00" / "association.ecsv")
    assert sorted(table["first"]) == [-1, *range(24)]
    assert sorted(table["second"]) == list(range(25))
    assert list(table["status"]).count("unmatched") == 1


def test_numbers_of_the_fits_are_those_of_the_tables(reports):
    folder = reports["four"].parent
    metrics = read_metrics(reports["four"])
    truth, matched = (QTable.read(folder / f"agn00/{name}.ecsv") for name in ("truth", "matched"))
    sample = truth[np.asarray(matched["selection"]) == 0]
    for unit, found in metrics["fits"].items():
        table = QTable.read(folder / f"agn00/fits_{unit}.ecsv")
        dz = np.asarray((table["redshift_mean"] - sample["redshift"]) / (1 + sample["redshift"]))
        assert found["n"] == len(sample) > 10
        assert found["photoz_bias"] == pytest.approx(np.median(dz))
        assert found["photoz_sigma_mad"] == pytest.approx(1.48 * np.median(abs(dz - np.median(dz))))
        assert found["photoz_n_outliers"] == np.count_nonzero(abs(dz) > 0.15)
        assert found["photoz_outliers"] == pytest.approx(np.mean(abs(dz) > 0.15))
        off = np.asarray(table["frac_agn_mean"] - sample["frac_agn"])
        assert found["frac_agn_bias"] == pytest.approx(np.median(off))
        width = np.median(np.asarray(table["frac_agn_std"]))
        assert found["frac_agn_width"] == pytest.approx(width)
    assert metrics["truths"]["agn00"]["fits"] == metrics["fits"]
    assert set(metrics["fits"]) == {"all", "none"}


def test_one_number_says_how_many_redshifts_are_in_their_intervals(reports):
    """In the table of redshifts, of the coverage, and in the metrics."""
    page = page_of(reports["four"])
    rows = re.findall(r"<tr>(.*?)</tr>", page[page.index("Coverage of the posteriors") :])
    cells = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in rows]
    shares = {row[0]: row[3] for row in cells if len(row) == 6 and row[1] == "redshift"}
    fits = read_metrics(reports["four"])["fits"]
    assert len(shares) == len(fits) == 2
    for unit, label in (("all", "with MIRI"), ("none", "without MIRI")):
        share = 100 * fits[unit]["redshift_coverage"]
        assert shares[label].startswith(f"{share:.0f} % (")


def test_posteriors_are_judged_by_their_coverage():
    """Of the rows of the central 68 %: too narrow, too wide, right."""
    rows = [(0.5, 0.4, 0.6), (0.55, 0.45, 0.65), (0.9, 0.85, 0.95), (0.7, 0.6, 0.8)]
    share, low, high = np.transpose(rows)
    table = QTable({"share": share, "share_low": low, "share_high": high, "level": [0.68] * 4})
    assert widths(table) == {
        "n_sets": 4, "n_narrow": 2, "n_broad": 1, "n_right": 1, "verdict": "they differ",
    }  # fmt: skip
    assert widths(table[:2])["verdict"] == "most are too narrow"
    assert widths(table[2:3])["verdict"] == "most are too wide"
    assert widths(table[3:])["verdict"] == "most are right"


def test_sections_stand_in_the_order_of_the_paper(reports):
    pages = {kind: page_of(report) for kind, report in reports.items()}
    titles = {kind: re.findall(r"<h2>(.*?)</h2>", page) for kind, page in pages.items()}
    assert " | ".join(titles["truths"]) == (
        "At a glance | Exposures and catalog | Images | Detections | Forced photometry | "
        "Error function and limits | Example sources | Redshifts | AGN fraction | "
        "Luminosity of the accretion disk | X-rays | Classes | PAH features against residuals | "
        "Coverage of the posteriors | Comparison with Yang et al. 2021 | "
        "Inputs and published relations | How it was made"
    )
    # without an AGN there are no disks, X-rays and classes
    lacking = {"Luminosity of the accretion disk", "X-rays", "Classes"}
    assert titles["four"] == [title for title in titles["truths"] if title not in lacking]
    assert "Redshifts" not in titles["one"]


#: What must stand on the page of a kind of run, and what must not.
SAID = {
    "one": "too few bands for colors | No source is left to fit. | few bands 24 | "
    "fracAGN offset ± scatter with MIRI (no source in the fit) | no band of this run | "
    "The check with bright point sources was not made",
    "four": "point sources</th> | no band of CEERS | 7 x 1 | 31 % | "
    "IMF Kroupa (inferred) | torus: torus.parametric; torus.skirtor2016 is not registered | "
    "(products: 1.2) | photutils | numba | Somebody 2001, with page | Bruzual & Charlot 2003 | "
    "Momcheva et al. 2016 | seed 20210211 | 22.8 in 4662 s | CEERS proposal, for other exposures | "
    f"in the {AREA:.2f} square arcmin that all bands have imaged | "
    "it grows by 5 % of that for each arcmin toward position angle 45 deg | "
    # in order of wavelength, whatever the order of the configuration
    "F560W, F2100W, F2550W (the shortest, the middle and the longest",
    "truths": "Injected fracAGN 0, source | Injected fracAGN 0.4, source | Spectra of source | "
    "Redshift errors by injected fracAGN | by redshift, with median and scatter | of each true class | "
    "luminosity of the accretion disk | X-ray fluxes of the AGN of the field | matching kernel | "
    "background was subtracted | 3.4 of Gaussian errors | "
    "the field is another one: 24 galaxies; theirs has 463. | "
    "Bands or exposures of this run are not those of the paper (1665 s, F2100W 4662 s). | "
    "deeper than calculator by | "
    "its rank is drawn uniformly from the part of the posterior in the cell",
}
NOT_SAID = {
    "one": ["point sources</th>"],
    "four": ["No source is left", "<li>Somebody 2001</li>"],
    "truths": ["wider than they would have to be", "fall short", "fainter than calculator"],
}


@pytest.mark.parametrize("kind", SAID)
def test_the_page_says_what_was_done_and_what_is_missing(reports, kind):
    page = page_of(reports[kind])
    assert [text for text in SAID[kind].split(" | ") if text not in page] == []
    assert [text for text in NOT_SAID.get(kind, ()) if text in page] == []
    # what stands in comes after what was found; when it was made is not on it
    places = ("At a glance", "stands in for SKIRTOR", "<h2>Exposures and catalog")
    assert [page.index(text) for text in places] == sorted(map(page.index, places))
    assert not re.search(r"20\d\d-\d\d-\d\dT", page)
    if kind == "four":
        assert page.count("0.9987") == 4


def test_sources_and_counts_link_into_the_browser(reports):
    text = (reports["truths"] / "index.html").read_text()
    links = dict(re.findall(r"href='(sources-[^']*)'>([^<]*)<", text))
    metrics = read_metrics(reports["truths"])
    assert links["sources-agn00.html"] == "agn00"
    assert links["sources-agn00.html#?show=sample"] == str(metrics["n_sample"])
    keys = {one for one in links if re.fullmatch(r"sources-agn(00|40)\.html#\d+", one)}
    assert {links[key] for key in keys} == {key.rpartition("#")[2] for key in keys} != set()


def test_numbers_beside_the_paper_are_measured_where_the_run_has_them(reports):
    folder = reports["truths"].parent
    table = QTable.read(folder / "report" / "paper.ecsv")
    assert list(table["key"]) == [one.key for one in PUBLISHED]
    ours = dict(zip(table["key"], table["ours"], strict=True))
    # 25 detections, 24 of them sources; scaling and offsets of the made-up points
    assert ours["detected_catalog"] == 25
    assert ours["matched_catalog"] == 1
    assert ours["f_scaling.f770w"] == ours["f_scaling.f1800w"] == pytest.approx(0.9987)
    assert ours["f_aper.f2100w"] == pytest.approx(1.14)
    assert ours["points.offset"] == pytest.approx(0.0)
    # kernels of the package match PSFs far better than those of the paper
    assert 0 < ours["kernels.red"] <= ours["kernels"] < 0.01
    verdict = dict(zip(table["key"], table["verdict"], strict=True))
    # what is measured is told, and nothing else
    assert verdict["detected_catalog"].endswith("sigma: open")
    why = next(one.why for one in PUBLISHED if one.key == "f_aper.f770w")
    assert "a PSF as known before flight" in why
    assert verdict["f_aper.f770w"].endswith(why)


def test_bands_above_the_limits_of_the_proposal_are_counted():
    """25.5 AB in F770W and 24.8 in F1000W, of the CEERS proposal as Yang et al. 2021 quote it."""
    truth = QTable()
    for name, values in {"f770w": [25.4, 25.4, 25.6], "f1000w": [24.7, 24.9, 24.9]}.items():
        truth[f"miri.{name}"] = (values * u.ABmag).to(u.uJy)
    assert above_proposal(truth, truth.colnames).tolist() == [2, 1, 0]
    assert above_proposal(truth, ["miri.f560w"]) is None


@pytest.mark.parametrize("n", [1, 2, 3])
def test_fields_of_fewer_than_three_bands_are_gray(n):
    prior = noise_image(9, rim=0, scale=0.06, shape=(238, 312))[0]
    names = ["miri.f770w", "miri.f1000w", "miri.f2100w"][:n]
    figure = field_figure([noise_image(k)[0] for k in range(n)], prior, [*names, "wfc3.f160w"])
    pictures = [ax.images[0].get_array() for ax in figure.axes if ax.images]
    assert [picture.ndim for picture in pictures] == ([2, 3] if n == 3 else [2] * (n + 1))
    # both parts show the same sky: the unmasked 100 x 140 pixels of 0.11 arcsec
    for ax in figure.axes:
        if ax.images and ax.get_title():
            left, right, bottom, top = ax.images[0].get_extent()
            assert right - left == pytest.approx(140 * SCALE, abs=0.25)
            assert top - bottom == pytest.approx(100 * SCALE, abs=0.25)
            # scale bar, and north up, east left
            bar = ax.lines[0].get_xdata()
            assert bar[1] - bar[0] == pytest.approx(20)
            letters = {text.get_text(): text.get_position() for text in ax.texts}
            assert letters["N"][1] > letters["E"][1]
            assert letters["E"][0] < letters["N"][0]


def test_residuals_are_stretched_evenly_about_zero():
    image, light = noise_image()
    model = sky_image(SCALE, SHAPE, 0.5 * light)
    figure = residual_figure([(image, model)], ["miri.f770w"], size=100)
    drawn = {ax.get_title(): ax.images[0] for ax in figure.axes if ax.get_title()}
    norm = drawn["mosaic - model"].norm
    assert norm.vmin == -norm.vmax
    # unit noise: five sigma
    assert norm.vmax == pytest.approx(5, rel=0.1)
    negative, zero, positive = drawn["mosaic - model"].cmap([0.0, 0.5, 1.0])
    # negative blue, positive red
    assert negative[2] > negative[0]
    assert positive[0] > positive[2]
    assert np.allclose(zero[:3], zero[0], atol=0.01)


def test_area_is_that_of_the_rectangle_that_all_images_share():
    first, second = noise_image(0)[0], noise_image(1)[0]
    assert footprint_area([first]).to_value(u.arcmin**2) == pytest.approx(AREA, rel=1e-6)
    mask = second.mask.copy()
    mask[:, : SHAPE[1] // 2] = True
    second.mask = mask
    shared = footprint_area([first, second]).to_value(u.arcmin**2)
    assert shared == pytest.approx(AREA / 2, rel=1e-6)
    # the same field as that of the sources: their density times the area is their number
    rng = np.random.default_rng(0)
    y, x = rng.uniform(-0.5, [[SHAPE[0] - 0.5], [SHAPE[1] - 0.5]], size=(2, 20000))
    share = in_field(first.wcs.pixel_to_world(x, y), [first, second]).mean()
    whole = SHAPE[0] * SHAPE[1] * SCALE**2 / 3600
    assert share * whole == pytest.approx(shared, rel=0.05)
    with pytest.raises(ValueError, match="'images' must be on one grid"):
        footprint_area([first, noise_image(0, shape=(50, 60))[0]])


@pytest.mark.parametrize(
    ("exposures", "ceers", "paper"),
    [
        ({}, True, True),
        # the split into groups is not the survey's
        ({"n_groups": [100, 200, 100, 50, 50, 14], "n_integrations": [2, 1, 2, 4, 4, 20]}, True, True),
        ({"plan": "quick"}, False, False),
        ({"n_dithers": [2, 3, 3, 3, 3, 6]}, False, False),
        ({"filters": ["miri.f770w"]}, True, False),
    ],
)  # fmt: skip
def test_what_counts_as_ceers(exposures, ceers, paper):
    config = StudyConfig.from_dict({"exposures": exposures, "fit": {"min_detected": 1}})
    assert as_ceers(config, "miri.f770w") is ceers
    assert as_paper(config) is paper
    assert not as_ceers(small_config(["miri.f560w"]), "miri.f560w")


def test_stand_ins_are_those_of_the_model():
    config = StudyConfig()
    assert any("SKIRTOR" in text for text in stand_ins(config, SEDModel.yang2021()))
    assert not any("SKIRTOR" in text for text in stand_ins(config, SEDModel.yang2021(agn=False)))


def test_a_source_is_cited_once():
    metas = [{"citations": ["A 2001, ApJ 1, 2"]}, {"citations": ["A 2001", "B 2002"]}, {}]
    assert sources_to_cite([], metas) == ["A 2001, ApJ 1, 2", "B 2002"]
    assert sources_to_cite(["torus.parametric"], [])[0].startswith("Stalevski")


def test_posteriors_with_and_without_miri_have_one_range(reports):
    folder = reports["truths"].parent / "agn40"
    results = {name: FitResults.read(folder / f"fits_{name}.fits") for name in ("all", "none")}
    row = QTable.read(folder / "truth.ecsv")[3]
    figure = example_figure(results, row, row["id"], SEDModel.yang2021())
    upper, lower, redshift, fraction, first, second = figure.axes
    assert upper.get_title().startswith(f"source {row['id']}: injected z = {row['redshift']:.3f}")
    assert lower.get_ylabel().startswith("residual")
    for ax in (redshift, fraction):
        curves = ax.lines[:2]
        assert [curve.get_ydata().max() for curve in curves] == pytest.approx([1.0, 1.0])
        # a curve, not the steps of the cells, of another color and dash
        assert np.all(np.diff(curves[0].get_xdata()) > 0)
        assert curves[0].get_color() != curves[1].get_color()
        assert curves[0].get_linestyle() != curves[1].get_linestyle()
    assert legend_texts(redshift) == ["with MIRI", "without MIRI", "truth"]
    assert (first.get_xlim(), first.get_ylim()) == (second.get_xlim(), second.get_ylim())
    assert first.get_title() == "with MIRI"
