"""Rival photometry of the first sky: the other method, and Source Extractor's."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from helpers.points import PRIOR, point_catalog, save_points
from helpers.runs import STAGES, do_stage, one_band
from miricigale.evaluation import PUBLISHED
from miricigale.pages import Page
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow import Context
from miricigale.workflow.config import load_config
from miricigale.workflow.engine.stage import Units
from miricigale.workflow.page.derived_sections import write_rivals
from miricigale.workflow.page.study_page import DeclaredPage
from miricigale.workflow.stages import rivals

BAND = "miri.f1500w"
#: The last two are far too faint for a blind detection.
N, N_FAINT = 14, 2


def config_of(method, **photometry):
    return one_band(BAND, photometry={"method": method, "rivals": True, **photometry})


def made_matched(truth):
    matched = truth["id", "sky"]
    matched[f"{BAND}_true"] = matched[BAND] = truth[BAND]
    matched[f"{BAND}_formal_err"] = np.full(N, 0.5) * u.uJy
    matched[f"{BAND}_condition"] = np.where(np.arange(N) < 5, 2, 0)
    matched["selection"] = np.zeros(N, int)
    return matched


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rivals")
    config, rng = config_of("package"), np.random.default_rng(3)
    x, y = (a.ravel()[:N] for a in np.meshgrid(np.linspace(-12.5, 12.5, 6), np.linspace(-7, 7, 3)))
    flux = np.append(np.geomspace(30, 300, N - N_FAINT), np.full(N_FAINT, 0.3))
    # the study's own method is made to measure the true fluxes
    truth = point_catalog(x, y, rng, {BAND: flux, PRIOR: 30.0})
    made = Context(config, folder)
    made.save_table("agn00/matched.ecsv", made_matched(truth))
    save_points(made, truth, BAND, np.random.default_rng(3), width=36.3)
    for name, unit in (("kernels", BAND), ("templates", ""), ("rivals", BAND)):
        do_stage(config, folder, name, unit)
    return folder


@pytest.fixture(scope="module")
def tables(folder):
    return rivals.read_rivals(Context(config_of("package"), folder))


def bright_ratio(table, method):
    """Fluxes by a method over the true ones, of the bright points: how far off, and their spread."""
    bright = table[:-N_FAINT]
    ratio = (bright[method] / bright["flux_true"]).to_value(u.one)
    return abs(np.median(ratio) - 1), np.ptp(ratio)


def test_points_come_back_by_the_other_method_and_as_by_source_extractor(tables):
    table = tables[BAND]
    for method, most, spread in (
        # the paper's factor for stamps cut to a square is that of a circle
        ("yang2021", 0.03, 0.03),
        # fixed fractions for the light outside, and sky from a mesh of 4 arcsec
        ("source_extractor", 0.06, 0.15),
    ):
        off, width = bright_ratio(table, method)
        assert off < most
        assert width < spread
    assert np.all(table["package"] == table["flux_true"])
    assert table.meta["method"] == "package"


def test_blind_detection_misses_the_faint_ones_only(tables):
    counts = rivals.rival_counts(tables[BAND])
    assert {name: one.n for name, one in counts.items()} == {
        "detected": N - N_FAINT, "matched": N - N_FAINT, "missed": N
    }  # fmt: skip
    found = rivals.source_extractor_numbers(tables, 1)
    assert set(found) <= {one.key for one in PUBLISHED if one.quantity == "extra"}
    assert found["source_extractor.detected"].value == N - N_FAINT
    assert found["source_extractor.missed"].value == pytest.approx(N_FAINT / N)
    offset = found["source_extractor.offset"]
    assert abs(offset.value) < 0.08
    assert offset.low <= offset.value <= offset.high
    assert offset.n == N - N_FAINT
    assert rivals.source_extractor_numbers({"miri.f770w": tables[BAND]}, 1) == {}


def test_numbers_by_group_count_every_source_once(tables):
    numbers = rivals.rival_numbers(tables)
    one = numbers[(numbers["band"] == "all") & (numbers["method"] == "package")]
    size = {(row["kind"], row["group"]): row["n_group"] for row in one}
    assert size["all", "above 5 sigma"] == size["shape", "point"] == N - N_FAINT
    assert size["neighbors", "crowded"] == 5
    assert size["neighbors", "isolated"] == N - N_FAINT - 5
    of_snr = [n for (kind, _), n in size.items() if kind == "true S/N"]
    assert sum(of_snr) == N - N_FAINT
    # the made-up fluxes are the true ones
    assert np.all(one["median"][one["n"] > 0] == 0)
    # one band: all together are the same
    for column in ("n", "median", "scatter", "pull_median", "pull_scatter"):
        halves = (numbers[column][numbers["band"] == band] for band in ("all", BAND))
        assert np.array_equal(*halves, equal_nan=True)


def test_galaxies_are_told_apart_by_size(tables):
    table = tables[BAND].copy()
    table["shape"][2:] = "n < 2"
    size = np.linspace(0.0, 1.2, N)
    table["half_light_radius"] = size * u.arcsec
    numbers = rivals.rival_numbers({BAND: table})
    one = numbers[(numbers["kind"] == "half-light radius") & (numbers["method"] == "package")]
    found = {row["group"]: row["n_group"] for row in one if row["band"] == BAND}
    # points have no size, and the faint ones are in no group
    assert sum(found.values()) == N - N_FAINT - 2
    inner = size[2:-N_FAINT]
    assert found["0.2 to 0.4 arcsec"] == np.count_nonzero((inner >= 0.2) & (inner < 0.4))
    assert found["above 0.8 arcsec"] == np.count_nonzero(inner >= 0.8)


def test_the_section_of_the_page(folder, tables):
    context, pages = Context(config_of("package"), folder), []
    for own in (tables, {}):
        report = Page("made up")
        write_rivals(DeclaredPage(report, context), own)
        pages.append(report.to_html())
    assert "Rival photometry" in pages[0]
    assert "F1500W" in pages[0]
    assert "Rival photometry" not in pages[1]


def test_the_rival_of_the_papers_method_is_the_packages(folder, tmp_path):
    import shutil

    shutil.copytree(folder, tmp_path / "run")
    config = config_of("yang2021")
    do_stage(config, tmp_path / "run", "rivals", BAND)
    table = QTable.read(tmp_path / "run" / "rivals" / f"{BAND}.ecsv")
    assert bright_ratio(table, "package")[0] < 0.005
    assert table.meta["method"] == "yang2021"


def test_rivals_are_asked_for():
    stage, config = STAGES["rivals"], config_of("package")
    assert stage.unit_names(config) == (BAND,)
    assert stage.unit_names(config_of("package", rivals=False)) == ()
    units = {name: Units(one.unit_names(config)) for name, one in STAGES.items()}
    assert stage.needed(config, BAND, units)["mosaics"] == [f"mosaics:agn00/{BAND}"]
    with pytest.raises(ConfigError, match=r"0\.06 with \[photometry\] rivals, got 0\.05"):
        load_config("goodss", overrides={"photometry": {"rivals": True},
                                         "highres": {"pixel_scale": 0.05}})  # fmt: skip
