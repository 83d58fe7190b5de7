"""Plans of a small sample: mock photometry, fits, ranks and the page."""

import re
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.browser import read_sources
from helpers.cases import cases_of
from helpers.commands import command
from helpers.errors import refuses
from miricigale.depth import saturation_flux
from miricigale.instrument import psf_fwhm
from miricigale.photometry import ErrorModel
from miricigale.planning import (
    Planner,
    area_table,
    comparison_table,
    depth_table,
    load_plan,
    wall_clock,
)
from miricigale.planning.accuracy import accuracy
from miricigale.planning.planner import EXISTING
from miricigale.utils.exceptions import ConfigError, FitWarning
from miricigale.utils.parallel import threads

BANDS = ["miri.f770w", "miri.f1500w"]
EXPOSURES = {"bands": BANDS, "time": 1665.0, "dithers": 3, "sets": ["all", "f770w"]}
SETTINGS = {"sample": {"n_sources": 60}, "exposures": EXPOSURES}
# dust as the fits have it
SETTINGS |= {"sed": {"infrared": "fit"}, "fit": {"axes": "quick", "dust_excess": ()}}
SETTINGS["survey"] = {"areas": [1, 4]}
FIELD = dict(SETTINGS)
SETTINGS["agn"] = {"frac_agn": [0.0, 0.2, 0.4, 0.6, 0.8, 0.99], "shares": [5, 1, 1, 1, 1, 1]}


@pytest.fixture(scope="module")
def planner():
    return Planner(load_plan(overrides=SETTINGS))


@pytest.fixture(scope="module")
def plans(planner):
    return planner.compare()


@pytest.mark.slow
def test_the_sample_has_the_mix_of_the_configuration(planner):
    sources = planner.sources
    assert len(sources) == 60
    values, counts = np.unique(sources["frac_agn"], return_counts=True)
    assert values.tolist() == [0.0, 0.2, 0.4, 0.6, 0.8, 0.99]
    assert counts.tolist() == [30, 6, 6, 6, 6, 6]
    # 1308 sources in a circle of 95 arcsec, some of which are stars
    assert 150 < planner.density < 1308 / (np.pi * (95 / 60) ** 2)


def test_depths_that_are_told_before_the_fits_are_those_of_the_plans(planner, plans):
    table = planner.exposure_table()
    assert list(zip(table["plan"], table["filter"], strict=True)) == [
        ("all", "miri.f770w"), ("all", "miri.f1500w"), ("f770w", "miri.f770w"),
    ]  # fmt: skip
    for plan in plans[1:]:
        exposures = table[table["plan"] == plan.name]
        bands = plan.band_table()
        for name in ("time", "dithers", "limit_used"):
            assert_array_equal(exposures[name], bands[name])
    # by the errors that are drawn, a fifth of the flux at the limit
    errors = planner.band_plans()["miri.f770w"].errors()
    limit = table["limit_used"][0].to(u.uJy)
    assert_allclose(errors.sigma(limit, "miri.f770w"), limit / 5, rtol=0.01)


def test_noise_is_that_of_the_errors(planner):
    """Pulls of the mock fluxes are those of a normal distribution, in each band and of each size."""
    table = planner.photometry(planner.band_plans().values())
    off = {name: table[name] - planner.sources[name] for name in planner.bands}
    pulls = np.array([(off[name] / table[f"{name}_err"]).value for name in planner.bands])
    assert np.mean(pulls) == pytest.approx(0, abs=5 / np.sqrt(pulls.size))
    assert np.std(pulls) == pytest.approx(1, abs=5 / np.sqrt(2 * pulls.size))
    # extended sources have larger errors than points of the same flux
    errors = planner.band_plans()["miri.f770w"].errors()
    own = table["miri.f770w_err"]
    point = errors.sigma(planner.sources["miri.f770w"], "miri.f770w")
    extended = planner.sources["size"] > 0.3 * u.arcsec
    assert np.all(own[extended] > point[extended])
    round_ = planner.sources["size"] == 0
    assert_allclose(own[round_], point[round_])


def test_sources_that_saturate_have_the_groups_before_or_no_flux(planner):
    band = planner.band_plans()["miri.f770w"]
    exposure = band.exposure
    assert exposure.n_groups == 100
    # points that fill the well in these groups, by the saturation of an exposure of so many
    full = [2, 3, 17, 100, 120]
    fluxes = [saturation_flux(exposure.replace(n_groups=g)).value for g in full] * u.uJy * 1.0001
    assert band.good_groups(fluxes).tolist() == [1, 2, 16, 99, 100]
    # as wide as the PSF a source of Gaussians has half the peak
    fwhm = psf_fwhm(band.filter)
    assert band.good_groups(2 * fluxes, fwhm).tolist() == [1, 2, 16, 99, 100]
    sources = planner.sources.copy()
    sources["miri.f770w"][:5], sources["size"][:5] = fluxes, 0 * u.arcsec
    other = Planner(planner.config, sources=sources)
    plan = other.evaluate(["miri.f770w"])
    table = other.photometry([band])
    assert plan.sources["miri.f770w_saturated"][:5].tolist() == [True] * 4 + [False]
    assert plan.sources["miri.f770w_missing"].tolist() == [True] + [False] * 59
    assert plan.band_table()["n_saturated", "n_missing"][0].as_void().tolist() == (4, 1)
    assert np.isnan([table[name][0].value for name in ("miri.f770w", "miri.f770w_err")]).all()
    # 2, 16 and 64 groups of 100 are exposures of so much less time, in as many ramps
    for row, n_groups in ((1, 2), (2, 16), (3, 64), (4, 100)):
        time = band.n_dithers * exposure.replace(n_groups=n_groups).exposure_time
        given = {"n_integrations": 6, "fractional": 0.03, "excess": 1.4}
        errors = ErrorModel.from_exposure("F770W", time, **given)
        assert_allclose(table["miri.f770w_err"][row], errors.sigma(fluxes[row], "F770W"), rtol=1e-6)
    # a source without its flux in MIRI is fitted with the existing bands
    alone = other.evaluate(())
    assert plan.sources["redshift_mean"][0] == pytest.approx(alone.sources["redshift_mean"][0])


def test_draws_belong_to_source_and_band_and_no_thread_changes_them(planner, plans):
    with threads(2) as executor:
        other = Planner(planner.config, executor=executor)
        again = other.evaluate(["miri.f770w"])
    mine = plans[2].sources
    assert list(again.bands) == ["miri.f770w"]
    for name in mine.colnames:
        assert_array_equal(mine[name], again.sources[name])
    seeded = Planner(load_plan(overrides=SETTINGS | {"plan": {"seed": 5}}))
    assert list(seeded.sources["id"]) != list(planner.sources["id"])


def test_more_bands_make_better_fits(planner, plans):
    assert [plan.name for plan in plans] == [EXISTING, "all", "f770w"]
    chosen = planner.common(plans)
    numbers = {plan.name: planner.accuracy(plan, chosen) for plan in plans}
    for name in ("z_width", "frac_width", "frac_scatter"):
        assert numbers["all"][name].value < numbers[EXISTING][name].value
    assert numbers["all"]["completeness"].value > 0.5


def test_more_bands_never_lose_a_source_by_the_selection(planner, plans):
    both, one = (planner.common([plan]) for plan in plans[1:])
    assert np.all(both[one])
    # a band is enough, and twice as many sets do not change that
    measured = planner.photometry(planner.band_plans().values())
    assert_array_equal(
        both, np.any([measured[b] > 5 * measured[f"{b}_err"] for b in BANDS], axis=0)
    )


def test_counts_have_the_errors_of_the_sample(planner, plans):
    """Binomial: the root of n p (1 - p), in the area."""
    table, scale = comparison_table(planner, plans), planner.density * 74 * 113 / 3600
    row = table[table["plan"] == "all"][0]
    p = planner.common(plans[1:2]).mean()
    assert row["n_detected"] == pytest.approx(scale * p)
    assert row["n_detected_err"] == pytest.approx(scale * np.sqrt(p * (1 - p) / 60), rel=0.05)
    assert row["n_agn_true"] == pytest.approx(scale * 24 / 60)


def test_the_tables_rank_by_the_hour(planner, plans):
    table = comparison_table(planner, plans)
    assert table["plan"][0] == EXISTING
    assert np.isnan(table["merit"][0])
    assert table["merit"][1] >= table["merit"][2]
    row = table[1]
    expected = row["n_agn"] * row["purity"] / row["time"].to_value(u.h)
    assert row["merit"] == pytest.approx(expected)
    # the same sources in every row
    assert len(set(table["n"])) == 1


def test_more_pointings_are_more_sources_and_shallower(planner):
    one, four = planner.divide()
    table = area_table(planner, [one, four])
    assert list(table["pointings"]) == [1, 4]
    assert table["area"][1] == 4 * table["area"][0]
    assert table["n_detected"][0] < table["n_detected"][1] < 4 * table["n_detected"][0]
    for name in BANDS:
        light = four.bands[name].time.value / one.bands[name].time.value
        assert light == pytest.approx(0.25, rel=0.02)
    # a quarter of the light each: overheads are what the area costs
    assert one.time < four.time < 4 * one.time


def test_accuracy_counts_what_it_says():
    z = np.array([0.0, 1.0, 2.0, 3.0])
    table = QTable({"redshift": z, "redshift_mean": z + [0.0, 0.4, 0.0, np.nan]})
    table["redshift_std"] = 0.1 * (1 + z)
    table["frac_agn"], table["frac_agn_mean"] = [0.0, 0.5, 0.5, 0.9], [0.1, 0.6, 0.6, 0.9]
    table["frac_agn_std"], table["selected"] = 0.1, [True, True, False, True]
    numbers = accuracy(table, seed=1)
    wanted = {"z_outliers": 1 / 3, "z_width": 0.1, "frac_bias": 0.1, "purity": 2 / 3}
    for name, value in (wanted | {"completeness": 2 / 3}).items():
        assert numbers[name].value == pytest.approx(value), name


def test_sources_of_the_caller_are_taken_as_they_are(planner):
    own = planner.sources[:8]
    given = Planner(planner.config, sources=own)
    assert given.sources is own
    text, few = "'sources' must be a table with the columns", own["id", "redshift"]
    refuses(text, Planner, planner.config, sources=few)


def test_scatter_of_mock_fluxes_is_not_warned_of_and_that_of_measured_ones_is(planner):
    """Fluxes off by a factor of 2 either way: how to mend errors is no advice on those that a plan drew."""
    band = "miri.f770w"
    sources = planner.sources.copy()
    sources[band] = sources[band] * np.where(np.arange(len(sources)) % 2, 2.0, 0.5)
    off = Planner(planner.config, sources=sources)
    with warnings.catch_warnings():
        warnings.simplefilter("error", FitWarning)
        off.evaluate([band])
    measured = off.photometry([off.band_plans()[band]])
    with pytest.warns(FitWarning, match=rf"errors allow: {band} "):
        off.evaluate([band], measured=measured)


def test_a_luminosity_function_gives_the_sample(tmp_path):
    """One cell holds nearly all galaxies: they are drawn there, as many as the volume holds."""
    from astropy.cosmology import FlatLambdaCDM

    table = QTable({"log_luminosity": np.tile([11.0, 11.2], 2), "phi": np.full(4, 1e-3)})
    table["redshift"] = np.repeat([1.0, 1.1], 2)
    table.write(tmp_path / "lf.ecsv")
    sample = {"n_sources": 40, "luminosity_function": str(tmp_path / "lf.ecsv")}
    planner = Planner(load_plan(overrides=SETTINGS | {"sample": sample}))
    sources = planner.sources
    assert np.all((sources["redshift"] >= 1.0) & (sources["redshift"] <= 1.1))
    log_luminosity = np.log10(sources["luminosity"].value)
    assert np.all((log_luminosity >= 11.0) & (log_luminosity <= 11.2))
    # phi times the dex times the comoving volume of a square arcmin, WMAP7
    cosmology = FlatLambdaCDM(70.4, 0.272)
    volume = cosmology.comoving_volume(1.1) - cosmology.comoving_volume(1.0)
    sky = (4 * np.pi * u.sr).to_value(u.arcmin**2)
    assert planner.density == pytest.approx(1e-3 * 0.2 * volume.to_value(u.Mpc**3) / sky, rel=1e-3)
    # a missing number is none of the function
    table["phi"][1] = np.nan
    table.write(tmp_path / "lf.ecsv", overwrite=True)
    match = "'luminosity_function' must be a table of finite numbers in 'phi', got 1 that are not"
    refuses(match, lambda: Planner(planner.config).sources)


@pytest.mark.slow
def test_a_field_has_few_agn_and_cuts_that_leave_nothing_are_named():
    fields = Planner(load_plan(overrides=FIELD | {"sample": {"n_sources": 6000}}))
    first = fields.sources[fields.sources["sky"] == 0]
    assert len(np.unique(fields.sources["id"])) == len(fields.sources) > len(first) == 6000
    # by default: 4 to 8 a pointing are more than a tenth of the infrared light
    pointing = fields.density * 74 * 113 / 3600
    assert 4 < pointing * np.mean(first["frac_agn"] > 0.1) < 8
    # galaxies of several skies: the same ones
    assert np.sum(first["template"] == first["template"][0]) == 5
    # AGN of further skies: above the limit only, as many in each as in the first
    others, n_skies = fields.sources[6000:], fields.sources.meta["n_skies"]
    assert np.all(others["frac_agn"] >= 0.4)
    assert len(others) / (n_skies - 1) == pytest.approx(np.sum(first["frac_agn"] >= 0.4), rel=0.5)


def test_agn_of_other_skies_count_by_their_share():
    """Two skies, three AGN in each, four of six found; one galaxy of three is selected, too."""
    fractions = [0.0, 0.0, 0.0, *[0.9] * 6]
    table = QTable({"frac_agn": fractions, "sky": [0] * 6 + [1] * 3}, meta={"n_skies": 2})
    table["redshift"], table["redshift_std"], table["frac_agn_std"] = 1.0, 0.1, 0.1
    table["redshift_mean"], table["frac_agn_mean"] = [1.0] * 6 + [9.0] * 3, fractions
    table["selected"] = [True, False, False, True, True, False, True, True, False]
    numbers = accuracy(table, seed=1)
    assert numbers["completeness"].value == pytest.approx(4 / 6)
    assert numbers["purity"].value == pytest.approx(2 / (2 + 1))
    # redshifts are those of the sample
    assert numbers["z_outliers"].value == 0
    # binomial, of six
    assert numbers["completeness"].error == pytest.approx(np.sqrt(4 / 6 * 2 / 6 / 6), rel=0.1)
    none = load_plan(overrides={"sample": {"redshift": [11.0, 12.0]}})
    with pytest.raises(ConfigError, match=r"\[sample\] redshift leaves none of the"):
        _ = Planner(none).sources


@pytest.mark.pictures
@pytest.mark.slow
def test_the_command_writes_a_page(tmp_path, capsys):
    path = tmp_path / "plan.toml"
    path.write_text(load_plan(overrides=SETTINGS).to_toml())
    folder = tmp_path / "out"
    told = command(capsys, "plan", "--config", path, "--sources", "30", "-o", folder)
    assert "existing bands" in told.out
    page = (folder / "plan.html").read_text()
    # it opens with the answer, as the command ends
    answer = re.search(r"A plan of F.*\(1665 s, 3 dithers\) reaches 5 sigma at .*", told.out)[0]
    assert "It ranks first of 2 plans: per hour, the AGN found times the purity comes to" in answer
    assert page.index(answer) < page.index("<li>")
    assert len(re.findall("<img ", page)) == 4
    assert "nan" not in re.sub(r"base64,[^']*", "", page)
    table = QTable.read(folder / "comparison.ecsv")
    assert set(table["plan"]) == {EXISTING, "all", "f770w"}
    assert len(QTable.read(folder / "sources-1.ecsv")) == 30
    assert load_plan(folder / "plan.toml").sample.n_sources == 30
    # the sources one by one, with what each set finds
    assert "30 of 30 simulated sources can be looked at <a href='plan-sources.html'>" in page
    facts, entries = read_sources(folder / "plan-sources.html", folder / "plan-sources")
    sources = QTable.read(folder / "sources-1.ecsv")
    (number,) = [k for k, one in enumerate(facts["sets"]) if one["name"] == "all"]
    assert facts["table"]["id"] == sources["id"].tolist()
    assert np.allclose(facts["table"][f"frac_agn_{number}"], sources["frac_agn_mean"], rtol=6e-4)
    found = np.array(facts["table"][f"found_{number}"])
    assert np.array_equal(found, sources["selected"] & (sources["frac_agn"] >= 0.4))
    assert len(entries) == 30
    assert [band["name"] for band in facts["bands"] if band["miri"]] == BANDS
    # a second plan does not replace the first one, and never the file that it was made from
    page = (folder / "plan.html").read_bytes()
    arguments = ("plan", "--sources", "20", "-o", folder)
    told = command(capsys, *arguments, status=2).err
    assert (
        "--output must be a folder without files of the same names (or --overwrite given)" in told
    )
    assert "plan.html, plan.toml, comparison.ecsv, areas.ecsv, bands-1.ecsv" in told
    assert (folder / "plan.html").read_bytes() == page
    text = path.read_bytes()
    arguments = ("plan", "--config", path, "-o", tmp_path, "--overwrite")
    told = command(capsys, *arguments, status=2).err
    assert "--output must be another file than those that are read" in told
    assert path.read_bytes() == text


@pytest.mark.parametrize(("arguments", "message"), cases_of(__file__, "refused"))
def test_what_cannot_be_planned_is_one_sentence(capsys, arguments, message):
    err = command(capsys, "plan", *arguments, status=2).err
    assert err.startswith(f"miricigale: {message}")
    assert err.count("\n") == 1


def test_a_budget_in_hours_is_what_is_charged():
    """As long as the budget allows, with overheads, in the ratio of the times."""
    bands = ["miri.f770w", "miri.f1500w", "miri.f2100w"]
    sets = ["f770w", "f1500w,f2100w"]
    exposures = {"bands": bands, "time": [1000, 1000, 3000], "dithers": 4, "sets": sets, "hours": 6}
    planner = Planner(load_plan(overrides={"exposures": exposures}))
    for name in sets:
        chosen = planner.config.set_bands(name)
        plans = planner.band_plans(planner.share(chosen))
        mine = [plans[band] for band in chosen]
        charged = wall_clock(mine, planner.config.overheads).to_value(u.h)
        # exposures are whole numbers of integrations and groups
        assert 5.9 < charged <= 6.0
    assert_allclose(mine[1].time / mine[0].time, 3, rtol=0.05)
    one, four = planner.share(chosen), planner.share(chosen, 4)
    # each of four pointings has a visit of its own
    assert four < one / 4
    assert planner.share(()) == 1.0
    short = Planner(load_plan(overrides={"exposures": exposures | {"hours": 0.5}}))
    refuses("hours must be at least 0.8. for f770w", short.share, bands[:1], error=ConfigError)
    refuses("no band of the plan 'miri.f560w'", short.share, ["miri.f560w"], error=KeyError)
    # groups that are averages of 8 frames are longer, and so is the shortest exposure
    averaged = Planner(load_plan(overrides={"exposures": exposures | {"readout": "FASTGRPAVG8"}}))
    plans = averaged.band_plans(averaged.share(chosen))
    charged = wall_clock([plans[band] for band in chosen], averaged.config.overheads).to_value(u.h)
    assert 5.8 < charged <= 6.0
    assert plans[chosen[0]].exposure.n_frames == 8
    # what a set costs is its own: the shortest exposures of other bands do not count
    unequal = {"time": [100, 1000, 10000], "hours": 1}
    alone = Planner(load_plan(overrides={"exposures": exposures | unequal}))
    plans = alone.band_plans(alone.share(bands[2:]), bands[2:])
    assert list(plans) == bands[2:]
    charged = wall_clock(plans.values(), alone.config.overheads).to_value(u.h)
    assert 0.95 < charged <= 1.0
    with_depths = {"exposures": exposures | {"depth": 25.0}}
    refuses(
        "hours must be left out with depths", load_plan, overrides=with_depths, error=ConfigError
    )


def test_planners_say_what_they_take_and_plan():
    refuses("'config' must be a PlanConfig .load_plan.path.*, got str", Planner, "F1500W")
    refuses("'config' must be a PlanConfig", depth_table, "F1500W")
    config = load_plan(overrides={"exposures": {"bands": ["miri.f770w", "miri.f1500w"]}})
    assert repr(Planner(config)) == "<Planner f770w, f1500w: 1 sets of bands>"
