"""Further fits of a sample: each does what it says, on the same sources as the study."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.runs import STAGES, do_stage
from miricigale.pages import Page
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow import Context, load_config
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.labels import texts_of
from miricigale.workflow.page.derived_sections import write_experiments
from miricigale.workflow.page.numbers import StudyTables
from miricigale.workflow.page.study_page import DeclaredPage
from miricigale.workflow.stages import experiments
from miricigale.workflow.truths import EXPERIMENTS

pytestmark = pytest.mark.slow

FILTERS = ["miri.f770w", "miri.f1500w", "miri.f2100w"]
FAST = ("far_infrared", "no_model_error", "known_redshift", "free_agn", "between")
#: Sources, one of which is not in the sample.
N = 13


def config_of(*names, frac_agn=(0.4,)):
    bands = ["megacam.r", "acs.f814w", "wfc3.f160w", "irac.ch1", "irac.ch2", "mips.24"]
    fit = {"bands": bands, "depths": [27.2, 28.2, 27.6, 23.9, 24.2, 19.3]}
    fit |= {"axes": "quick", "dust_excess": ()}
    fit |= {"sets": ["all"], "experiments": list(names)}
    exposures, sed = {"filters": FILTERS}, {"frac_agn": list(frac_agn)}
    return StudyConfig.from_dict({"exposures": exposures, "sed": sed, "fit": fit})


@pytest.fixture(scope="module")
def truth():
    rng = np.random.default_rng(2)
    table = QTable({"id": np.arange(1, N + 1), "redshift": np.linspace(0.5, 2.3, N)})
    table["mass"] = np.geomspace(5e10, 2e11, N) * u.Msun
    table["tau"], table["age"], table["ebv"], table["alpha"] = 1.0, 1.0, 0.3, 1.5
    table["frac_agn"] = 0.4
    table["p"], table["q"] = rng.choice([0.0, 0.5, 1.0], (2, N))
    config = config_of()
    light = SEDModel.yang2021().fluxes(table, [*config.fit.bands, *FILTERS])
    for name in light.colnames:
        if name not in table.colnames:
            table[name] = light[name]
    return table


@pytest.fixture(scope="module")
def folder(tmp_path_factory, truth):
    folder = tmp_path_factory.mktemp("experiments")
    config, rng = config_of(*FAST), np.random.default_rng(1)
    made = Context(config, folder)
    matched = truth["id",]
    matched["selection"] = np.where(np.arange(N) == 5, 16, 0)
    for name in FILTERS:
        error = 0.03 * truth[name] + 0.2 * u.uJy
        matched[f"{name}_err"], matched[f"{name}_condition"] = error, 0
        matched[name] = truth[name] + rng.normal(size=N) * error
    made.save_table("agn40/truth.ecsv", truth)
    made.save_table("agn40/matched.ecsv", matched)
    do_stage(config, folder, "fits", "agn40/all")
    for unit in STAGES["experiments"].unit_names(config):
        do_stage(config, folder, "experiments", unit)
    return folder


@pytest.fixture(scope="module")
def found(folder):
    """Tables of the experiments, and of the fit of the study."""
    tables = {name: read(folder, name) for name in FAST}
    return tables | {"study": QTable.read(folder / "agn40" / "fits_all.ecsv")}


def read(folder, name):
    return QTable.read(folder / "agn40" / "experiments" / f"{name}.ecsv")


def test_all_fit_the_sample_of_the_study(found):
    for table in found.values():
        assert list(table["id"]) == [1, 2, 3, 4, 5, *range(7, N + 1)]


@pytest.mark.parametrize("kind", ["fit", "quick"])
def test_freed_axes_hold_the_fixed_values(kind):
    config = load_config("goodss", overrides={"fit": {"axes": kind}})
    study, freed = (experiments.experiment_axes(n, config) for n in ("no_model_error", "free_agn"))
    defaults = SEDModel.yang2021().defaults
    for name in set(freed) - set(study):
        assert defaults[name] in freed[name]
        assert len(freed[name]) > 1
    assert set(freed) - set(study) == {"inclination", "p", "q"}
    for name in study:
        assert set(freed[name]) <= set(study[name])
    assert np.prod([len(values) for values in freed.values()]) < 1e8


def test_a_freed_torus_has_posteriors_of_its_own(found):
    table = found["free_agn"]
    for name, low, high in (("inclination", 60, 90), ("p", 0, 1), ("q", 0, 1)):
        mean = u.Quantity(table[f"{name}_mean"]).value
        assert np.all((mean >= low) & (mean <= high))
        assert np.all(u.Quantity(table[f"{name}_std"]).value > 0)
        assert f"{name}_mean" not in found["study"].colnames


def test_fits_between_the_nodes_are_of_all_values(found):
    """E(B-V) of a coarse grid has its posteriors on few nodes; between them they are wider."""
    spread = [np.asarray(found[name]["ebv_std"], float) for name in ("study", "between")]
    assert np.median(spread[1]) > np.median(spread[0])


def test_far_infrared_fluxes_are_of_the_truth_and_tell_the_dust(truth, found):
    many = truth[np.zeros(2000, int)]
    many["id"] = np.arange(2000)
    mock = experiments.far_infrared_photometry(many, seed=1)
    model = SEDModel.yang2021()
    names = ["id", *(n for n in truth.colnames if n in model.parameters)]
    for band, depth in experiments.HERSCHEL_DEPTHS.items():
        light = model.fluxes(truth[names][:1], [band])[band][0].to_value(u.uJy)
        sigma = np.hypot(10 ** (-0.4 * (depth - 23.9)) / 5, 0.1 * light)
        assert_allclose(np.mean(mock[band].value), light, atol=5 * sigma / np.sqrt(2000))
        assert_allclose(np.std(mock[band].value), sigma, rtol=0.1)
    # 3 sigma of Magnelli et al. 2013 are 0.6 mJy
    limit = 10 ** (-0.4 * (experiments.HERSCHEL_DEPTHS["sedpy.herschel_pacs_100"] - 23.9))
    assert_allclose(limit * 3 / 5, 600, rtol=0.01)
    tables = (found[name] for name in ("far_infrared", "study"))
    width = [np.median(t["dust_luminosity_std"] / t["dust_luminosity_mean"]) for t in tables]
    assert width[0] < width[1]


def test_without_model_error_posteriors_are_narrower(found):
    for name in ("redshift_std", "frac_agn_std"):
        assert np.median(found["no_model_error"][name]) < np.median(found["study"][name])


def test_known_redshifts_are_those_of_the_truth(truth, found):
    table = found["known_redshift"]
    true = np.asarray(truth["redshift"])[np.asarray(table["id"]) - 1]
    # nodes of the quick grid are 0.06 in ln(1 + z) apart
    assert np.all(np.abs(np.log((1 + table["redshift_mean"]) / (1 + true))) <= 0.0301)
    assert np.all(np.isnan(table["redshift_rank"]))
    numbers = experiments.experiment_numbers(truth, table)
    assert np.isnan(numbers["photoz_sigma_mad"])
    assert np.isfinite(numbers["frac_agn_sigma_mad"])


def test_numbers_of_perfect_fits(truth):
    table = truth["id", "redshift"]
    table["redshift_mean"], table["frac_agn_mean"] = truth["redshift"], truth["frac_agn"] + 0.1
    table["frac_agn_std"] = 0.05
    table["accretion_power_mean"] = truth["accretion_power"] * 10**0.2
    table["redshift_rank"], table["frac_agn_rank"] = 0.5, 0.9
    # the order of the sources does not matter
    numbers = experiments.experiment_numbers(truth[::-1], table)
    wanted = {"n": N, "photoz_sigma_mad": 0, "photoz_outliers": 0, "frac_agn_bias": 0.1,
              "frac_agn_sigma_mad": 0, "frac_agn_width": 0.05, "power_bias": 0.2,
              "power_sigma_mad": 0, "redshift_coverage": 1, "frac_agn_coverage": 0}  # fmt: skip
    assert set(numbers) == set(wanted)
    for name, value in wanted.items():
        assert_allclose(numbers[name], value, atol=1e-9, err_msg=name)


def page_of(folder, *names):
    """The section of the page on experiments."""
    report, context = Page("made up"), Context(config_of(*names), folder)
    study = StudyTables(Context(config_of(), folder), "agn40")
    write_experiments(DeclaredPage(report, context), {"agn40": study})
    return report.to_html()


def test_the_section_of_the_page(folder):
    page = page_of(folder, *FAST)
    for name in ("study", *FAST):
        assert texts_of("experiments")["labels"][name] in page
    numbers = QTable.read(folder / "report" / "experiments.ecsv")
    assert list(numbers["experiment"]) == ["study", *FAST]
    assert np.all(numbers["n"] == N - 1)
    assert "Further fits" not in page_of(folder)


def test_a_subset_is_spread_over_the_sample(folder, monkeypatch):
    monkeypatch.setattr(experiments, "N_FREE", 3)
    kept = read(folder, "free_agn")
    do_stage(config_of("free_agn"), folder, "experiments", "agn40/free_agn")
    few = read(folder, "free_agn")
    assert len(few) == 3
    assert list(few["id"][[0, -1]]) == [1, N]
    same = kept[np.isin(kept["id"], few["id"])]
    assert_allclose(few["frac_agn_mean"], same["frac_agn_mean"], rtol=1e-6)
    page_of(folder, "free_agn")
    numbers = QTable.read(folder / "report" / "experiments.ecsv")
    assert list(numbers["n_sources"]) == [N - 1, 3, 3]


def test_experiments_are_chosen_by_name():
    names = ("known_redshift", "free_agn")
    units = STAGES["experiments"].unit_names(config_of(*names, frac_agn=(0.0, 0.4)))
    assert units == tuple(f"{of}/{name}" for of in ("agn00", "agn40") for name in names)
    assert STAGES["experiments"].unit_names(config_of()) == ()
    refuses("experiments", config_of, "free", error=ConfigError)
    refuses("must not repeat", config_of, "free_agn", "free_agn", error=ConfigError)
    texts = texts_of("experiments")
    assert set(texts["labels"]) == {"study", *EXPERIMENTS}
    assert set(texts["sentences"]) == set(EXPERIMENTS)
