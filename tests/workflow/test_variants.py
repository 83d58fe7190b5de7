"""Variant images: what they have otherwise, and numbers that are changes of the same sources."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from numpy.testing import assert_array_equal

from helpers.errors import refuses
from helpers.points import PRIOR, point_catalog, save_prior
from helpers.runs import STAGES, do_stage, one_band
from miricigale.evaluation import PUBLISHED
from miricigale.pages import Page
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow import Context
from miricigale.workflow.derived import changed_config
from miricigale.workflow.page.derived_sections import measured_reasons, write_variants
from miricigale.workflow.page.study_page import DeclaredPage
from miricigale.workflow.stages import variants
from miricigale.workflow.stages.exposures import IMAGES, study_exposures
from miricigale.workflow.stages.grids import grid_of
from miricigale.workflow.stages.images import (
    background_of,
    expose_and_reduce,
    imager_of,
    mosaics_of,
)
from miricigale.workflow.stages.measure import measure_band
from miricigale.workflow.truths import variant_changes

pytestmark = pytest.mark.slow

BAND = "miri.f2100w"


def config_of(images="all", **sections):
    options = {"kind": "rates", "n_groups": 10, "n_integrations": 4, **sections}
    return one_band(BAND, variants={"images": images}, **options)


def changed(config, changes):
    return changed_config(config, (*IMAGES, "highres"), changes)


def test_each_variant_switches_one_thing_over():
    assert variant_changes(config_of()) == {
        "residual": {"detector": {"residual": "etc"}},
        "gradient": {"scene": {"background_gradient": 0.0}},
        "plane": {"reduction": {"background_plane": False}},
    }
    scene, plane = {"background_gradient": 0.0}, {"background_plane": False}
    sections = {"detector": {"residual": 1e-3}, "scene": scene, "reduction": plane}
    other = config_of(["plane", "residual"], **sections)
    residual, plane = {"residual": 0.0}, {"background_plane": True}
    wanted = {"residual": {"detector": residual}, "plane": {"reduction": plane}}
    assert variant_changes(other) == wanted
    ramps = config_of("gradient", kind="ramps", scene={"background_gradient": 0.0})
    gradient = {"scene": {"background_gradient": 0.05}}
    assert variant_changes(ramps) == {"rates": {}, "gradient": gradient}
    assert variant_changes(config_of([])) == {}
    for images, text in (
        ("cosmic_rays", "must be one of"),
        (["plane", "plane"], "must not repeat"),
    ):
        refuses(rf"\[variants\] images {text}", config_of, images, error=ConfigError)


def test_a_changed_configuration_differs_in_what_it_says():
    config = config_of()
    own = changed(config, {"scene": {"background_gradient": 0.0}})
    assert (own.reduction, own.scene.background) == (config.reduction, config.scene.background)
    (exposure,) = study_exposures(config).values()
    level = background_of(own, exposure).image(exposure.wcs, exposure.shape)
    assert np.ptp(level) == 0
    tilted = background_of(config, exposure).image(exposure.wcs, exposure.shape)
    # 5 % for each of the 1.9 arcmin of the detector's sides, along a diagonal
    assert 0.12 < np.ptp(tilted) / level[0, 0] < 0.14
    names = [[type(e).__name__ for e in imager_of(c).effects] for c in (config, own)]
    assert names[0] == names[1]
    noisy = changed(config, {"detector": {"residual": "etc"}})
    assert [type(e).__name__ for e in imager_of(noisy).effects] == ["Residual", *names[0]]


def test_nothing_else_of_a_study_depends_on_the_variants():
    plain, config = config_of([]), config_of()
    for name, stage in STAGES.items():
        assert ("variants" in stage.sections) == (name == "report")
        if name in ("variants", "report"):
            continue
        assert stage.unit_names(plain) == stage.unit_names(config)
        for unit in stage.unit_names(plain):
            assert stage.plan is None or stage.plan(config, unit) == stage.plan(plain, unit)
    assert STAGES["variants"].unit_names(plain) == ()
    assert STAGES["variants"].unit_names(config) == (BAND,)


def made_truth(center):
    rng, places = np.random.default_rng(3), np.linspace(-25, 25, 6)
    truth = point_catalog(*np.meshgrid(places, places), rng, {PRIOR: 30.0}, center)
    truth[BAND] = rng.permutation(np.geomspace(3, 300, len(truth))) * u.uJy
    return truth


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Products up to the variants, of points 10 arcsec apart."""
    folder, config = tmp_path_factory.mktemp("variants"), config_of(["residual", "gradient"])
    truth = made_truth(SkyCoord(config.pointing.ra, config.pointing.dec, unit="deg"))
    save_prior(Context(config, folder), truth, grid_of(config, config.highres.pixel_scale))
    for name, unit in (("kernels", BAND), ("templates", ""), ("variants", BAND)):
        do_stage(config, folder, name, unit)
    return folder


def test_images_without_a_change_are_those_of_the_study(folder):
    """A variant is the path of the study: exposed, reduced and measured, with the same seeds."""
    config = config_of(["residual", "gradient"])
    context = Context(config, folder, stage=STAGES["variants"], unit=BAND)
    truth = QTable.read(folder / "agn00" / "truth.ecsv")
    (exposure,) = study_exposures(config).values()
    own = changed(config, {"scene": {"background_gradient": 0.0}})
    _, cal = expose_and_reduce(own, exposure, truth, seed=context.seed)
    _, mosaic, _ = next(mosaics_of(own, [cal]))
    study = measure_band(context, mosaic, BAND, "package").to_table()
    table = QTable.read(folder / "variants" / "gradient" / f"{BAND}.ecsv")
    found = np.isfinite(table[BAND])
    assert found.sum() > 30
    # detections that are no source are in the one table only
    assert np.isin(table[BAND][found].value, study["flux"].value).all()


def test_fluxes_of_all_images_are_the_true_ones(folder):
    for name in ("residual", "gradient"):
        table = QTable.read(folder / "variants" / name / f"{BAND}.ecsv")
        found = np.isfinite(table[BAND]) & (table[f"{BAND}_true"] > 30 * u.uJy)
        assert found.sum() > 10
        off = (table[BAND] - table[f"{BAND}_true"])[found] / table[f"{BAND}_err"][found]
        assert np.median(np.abs(off)) < 1.5


def mock(n=400, seed=1):
    """Study and variants with Gaussian errors: one as the study, one 1.5 times as noisy."""
    rng = np.random.default_rng(seed)
    true, noise = 10 ** rng.uniform(-1, 2, n), rng.normal(size=n)
    matched = QTable({"id": np.arange(n), "selection": np.zeros(n, int)})
    matched["selection"][:20] = 1
    matched[f"{BAND}_true"] = true * u.uJy
    matched[BAND] = (true + noise) * u.uJy
    sizes = {"residual": 1.5, "gradient": 1.0}
    tables = {name: QTable({BAND: (true + n * noise) * u.uJy}) for name, n in sizes.items()}
    return matched, {name: {BAND: table} for name, table in tables.items()}


def test_changes_are_of_the_same_sources():
    matched, tables = mock()
    # 5 sigma of unit errors
    limit = float((5 * u.uJy).to_value(u.ABmag))
    rows = variants.variant_numbers(matched, tables, {BAND: limit}, seed=3)
    study, residual, gradient = rows
    assert [row["images"] for row in rows] == ["study", "residual", "gradient"]
    assert study["n"] == 380
    assert study["limit"] == pytest.approx(limit, abs=4 * study["limit_err"])
    assert study["scatter"] == pytest.approx(1, abs=4 * study["scatter_err"])
    # of n numbers with a Gaussian distribution, as many of them as are faint enough
    assert 1 / np.sqrt(2 * 380) < study["scatter_err"] < 2 / np.sqrt(2 * 100)
    assert np.isnan(study["limit_change"])
    # noise 1.5 times as large: 0.44 mag, better known than the limits
    assert residual["limit_change"] == pytest.approx(-2.5 * np.log10(1.5), abs=0.02)
    assert residual["limit_change_err"] < 0.5 * residual["limit_err"]
    assert residual["scatter_change"] == pytest.approx(0.5, rel=1e-6)
    for name in ("limit_change", "limit_change_err", "scatter_change"):
        assert gradient[name] == 0
    field = matched[20:]
    found = np.count_nonzero(field[BAND].value > 5)
    assert study["detected"] == pytest.approx(found, abs=12)
    assert gradient["detected"] == study["detected"] > residual["detected"]
    # of Gaussian errors half of the sources at the limit are lost, and few far above
    assert residual["completeness"] < study["completeness"] < 1


def test_variants_of_ramps_are_compared_with_rates():
    matched, tables = mock()
    tables = {"rates": tables["residual"], "residual": tables["residual"]}
    rows = variants.variant_numbers(matched, tables, {BAND: 22.15}, seed=3)
    assert rows["limit_change"][1] == pytest.approx(-2.5 * np.log10(1.5), abs=0.02)
    assert rows["limit_change"][2] == 0


def test_the_report_says_what_each_costs(tmp_path):
    config = config_of(["residual", "gradient"])
    matched, tables = mock()
    context = Context(config, tmp_path)
    for name, bands in tables.items():
        context.save_table(f"variants/{name}/{BAND}.ecsv", bands[BAND])
    report = Page("made up")
    nothing = DeclaredPage(report, Context(config_of([]), tmp_path))
    assert write_variants(nothing, matched, {BAND: 22.15}) is None
    numbers = write_variants(DeclaredPage(report, context), matched, {BAND: 22.15})
    page = report.to_html()
    assert "residual noise</td>" in page
    assert "without the gradient</td>" in page
    written = QTable.read(tmp_path / "report" / "variants.ecsv")
    assert_array_equal(written["limit"], numbers["limit"])
    reasons = measured_reasons(numbers, config)
    published = measured_reasons(None, config)
    assert published == {number.key: number.why for number in PUBLISHED}
    changed = [key for key, reason in reasons.items() if reason != published[key]]
    assert changed == ["limit.f2100w"]
    reason = reasons["limit.f2100w"]
    assert "with the calculator's residual noise -0.4" in reason
    assert reason.endswith("without the gradient +0.00 mag")
