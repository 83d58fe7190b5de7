"""Plans with images: the run that they become, and the comparison with their noise."""

import tomllib
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.cases import cases_of
from helpers.errors import refuses
from helpers.runs import do_stage
from miricigale.photometry import ErrorModel
from miricigale.planning import Planner, load_plan, paired_bands, paired_numbers
from miricigale.planning.exposures import band_plans
from miricigale.planning.images import ImagedSample, images_catalog, images_study
from miricigale.scene import read_catalog
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow import StudyConfig
from miricigale.workflow.stages.exposures import band_exposures, study_background
from miricigale.workflow.study import check_study

BANDS = ["miri.f770w", "miri.f1500w"]
SETTINGS = cases_of(__file__)


@pytest.fixture(scope="module")
def planner():
    return Planner(load_plan(overrides=SETTINGS))


@pytest.fixture(scope="module")
def study(planner, tmp_path_factory):
    """The run of the plan, as far as the truth of its sample."""
    folder = tmp_path_factory.mktemp("images")
    images_catalog(planner).write(folder / "images.ecsv")
    config = images_study(planner, folder / "images.ecsv")
    for name, unit in (("catalog", ""), ("seds", ""), ("truth", "catalog"), ("truth", "agn00")):
        do_stage(config, folder, name, unit)
    return config, folder


def test_the_run_exposes_what_the_plan_does(planner, study):
    config, _ = study
    check_study(config)
    for name, plan in planner.band_plans().items():
        exposures = band_exposures(config, name)
        assert len(exposures) == plan.n_dithers
        for one in exposures:
            assert one.exposure_time == plan.exposure.exposure_time
            assert (one.n_groups, one.readout) == (plan.exposure.n_groups, plan.exposure.readout)
    assert config.exposures.kind == "rates"
    assert config.run.seed == planner.config.plan.seed
    fit = planner.config.fit
    assert (config.fit.bands, config.fit.depths) == (fit.bands, fit.depths)
    # it is a configuration like any other
    assert StudyConfig.from_dict(tomllib.loads(config.to_toml())) == config
    middle = SkyCoord(config.pointing.ra * u.deg, config.pointing.dec * u.deg)
    # the bundled catalog is a circle about the default pointing
    assert middle.separation(SkyCoord(53.13440 * u.deg, -27.83444 * u.deg)) < 5 * u.arcsec


def test_the_sky_has_the_fluxes_of_the_sample(planner, study):
    """Each source has the fluxes and the AGN of the plan, and its neighbors are of the same mix."""
    _, folder = study
    truth = QTable.read(folder / "catalog" / "truth.ecsv")
    rows = [np.flatnonzero(truth["id"] == key)[0] for key in planner.sources["id"]]
    for name in planner.bands:
        assert_allclose(truth[name][rows], planner.sources[name], rtol=1e-10)
    assert_array_equal(truth["frac_agn"][rows], planner.sources["frac_agn"])
    others = np.setdiff1d(np.arange(len(truth)), rows)
    galaxies = others[~np.asarray(truth["star"][others], bool)]
    assert np.mean(truth["frac_agn"][galaxies] == 0) == pytest.approx(0.5, abs=0.1)
    assert set(np.unique(truth["frac_agn"])) == {0.0, 0.2, 0.4, 0.6, 0.8, 0.99}
    # the prior's sky has none, whatever the column of the catalog says
    assert not np.any(QTable.read(folder / "agn00" / "truth.ecsv")["frac_agn"])


def test_a_catalog_whose_fractions_cannot_be_is_refused(planner, tmp_path):
    catalog = images_catalog(planner)
    catalog["frac_agn"][3] = 1.5
    catalog.write(tmp_path / "images.ecsv")
    read_catalog("catalog.goodss").write(tmp_path / "plain.ecsv")
    for name, text in (
        ("images.ecsv", r"between 0 and 0\.99, got 1 of \d+ others, \[1\.5\]"),
        ("plain.ecsv", "needs a column frac_agn in the catalog"),
    ):
        config = images_study(planner, tmp_path / name)
        refuses(text, check_study, config, error=ConfigError)


def test_images_have_the_background_of_the_plan(tmp_path):
    exposures = {"bands": ["miri.f770w", "miri.f1500w"], "time": 900.0, "dithers": 2}
    for background in ({}, {"level": ["high", "50 MJy/sr"]}, {"ra": 150.0, "dec": 2.0}):
        values = {"images": {"enabled": True}, "exposures": exposures, "background": background}
        config = load_plan(overrides=values)
        plans, sources = band_plans(config), QTable({"frac_agn": [0.0]})
        planner = SimpleNamespace(config=config, sources=sources, min_detected=1)
        planner.band_plans = lambda p=plans: p
        study = images_study(planner, tmp_path / "images.ecsv")
        for name, plan in plans.items():
            assert study_background(study, name) == plan.background


@pytest.fixture(scope="module")
def imaged(planner):
    """Made-up images: six times the noise of the plan, and 5 % of light lost; two thirds are usable."""
    plans = planner.band_plans()
    mock = planner.photometry(plans.values())
    rng = np.random.default_rng(4)
    measured = QTable({"id": planner.sources["id"]})
    usable = np.arange(len(measured)) % 3 > 0
    for name in plans:
        error = mock[f"{name}_err"]
        flux = 0.95 * planner.sources[name] + 6 * error * rng.normal(size=len(measured))
        measured[name] = np.where(usable, flux.value, np.nan) * u.uJy
        measured[f"{name}_err"] = np.where(usable, 6 * error.value, np.nan) * u.uJy
    errors = ErrorModel.from_depths(dict.fromkeys(plans, 1.0 * u.uJy))
    return ImagedSample(measured, np.ones(len(measured), bool), usable, errors)


def test_noise_of_images_against_that_of_the_plan(planner, imaged):
    table = paired_bands(planner, imaged)
    assert table["filter"].tolist() == BANDS
    for row in table:
        # six times the noise; the lost light adds to it
        assert 6 - 4 * row["scatter_err"] < row["scatter"] < 9
        assert row["offset"] == pytest.approx(-0.05, abs=5 * row["offset_err"])
        assert row["n_detected_images"] < row["n_detected"] <= row["n"] == 60
        assert row["limit_images"].value == pytest.approx(23.9)


def test_differences_are_of_the_same_sources(planner, imaged):
    plans = planner.compare()
    others = planner.compare(measured=imaged.measured)
    # existing bands have no images
    assert_array_equal(plans[0].sources["redshift_mean"], others[0].sources["redshift_mean"])
    table = paired_numbers(planner, plans, others, imaged)
    assert set(table["plan"]) == {"all"}
    assert table["n"][0] <= np.count_nonzero(imaged.usable)
    assert_allclose(table["difference"], table["images"] - table["noise"], atol=1e-12)
    known = table[table["difference_err"] > 0]
    assert_allclose(known["sigma"], known["difference"] / known["difference_err"])
    # larger errors, wider posteriors
    width = table[table["number"] == "frac_width"][0]
    assert width["difference"] > 0
    # the same plan against itself differs by nothing
    same = paired_numbers(planner, plans, plans, imaged)
    assert_array_equal(same["difference"], 0)
    assert np.isnan(same["sigma"]).all()
