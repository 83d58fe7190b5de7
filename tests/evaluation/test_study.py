"""A mock study whose numbers are known from how it was drawn."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.studies import BANDS, FITS, LIMITS, mock_study, mock_truth
from miricigale.evaluation import (
    PUBLISHED,
    QUANTITIES,
    Estimate,
    PublishedNumber,
    StudyResults,
    TruthResults,
    compare_with_paper,
    measure,
    photoz_metrics,
    selection_table,
    study_confusion,
    study_numbers,
    xray_fluxes,
    yang2021_xray_flux,
)


@pytest.fixture(scope="module")
def study():
    return mock_study(n=1200)


def got(study, quantity, **kwargs):
    return measure(study, quantity, seed=1, n_draws=300, **kwargs)


@pytest.mark.parametrize("band_set", FITS)
def test_redshifts_come_out_as_drawn(study, band_set):
    scatter, outliers, _ = FITS[band_set]
    one = study.at(0.0)
    own = photoz_metrics(one.true("redshift"), one.fitted(band_set, "redshift_mean"))
    share = got(study, "z_outliers", band_set=band_set)
    got_share = (share.value, share.low, share.high)
    assert got_share == (own.outlier_fraction, own.outlier_low, own.outlier_high)
    # a shift by 1 is an outlier below z = 5.7
    assert share.value == pytest.approx(outliers, abs=4 * share.error)
    width = got(study, "z_scatter", band_set=band_set)
    assert width.value == own.sigma_mad
    assert width.value == pytest.approx(scatter, rel=0.25)
    assert width.low < width.value < width.high


def test_ratios_are_without_miri_over_with_it(study):
    ratios = ("none", "all")
    outliers = {name: got(study, "z_outliers", band_set=name).value for name in ratios}
    ratio = got(study, "z_outlier_ratio")
    assert ratio.value == pytest.approx(outliers["none"] / outliers["all"])
    assert ratio.low < ratio.value < ratio.high
    assert got(study, "width_ratio", truth=0.2).value == pytest.approx(3)
    near = {"truth": 0.2, "option": (0.0, 3.0)}
    scatter = {name: got(study, "frac_scatter", band_set=name, **near).value for name in ratios}
    ratio = got(study, "frac_scatter_ratio", **near)
    assert ratio.value == pytest.approx(scatter["none"] / scatter["all"])
    # of sizes: a fit that is too low is no better
    offset = {name: got(study, "frac_offset", truth=0.2, band_set=name).value for name in ratios}
    ratio = got(study, "frac_offset_ratio", truth=0.2)
    assert ratio.value == pytest.approx(abs(offset["none"] / offset["all"]))


def test_fractions_and_powers_come_out_as_drawn(study):
    offset = got(study, "frac_offset", truth=0.6)
    assert offset.value == pytest.approx(0, abs=4 * offset.error)
    scatter = got(study, "frac_scatter", truth=0.6)
    assert scatter.value == pytest.approx(0.05, abs=4 * scatter.error)
    for truth in (0.2, None):
        offset = got(study, "power_offset", truth=truth)
        assert offset.value == pytest.approx(-0.1, abs=4 * offset.error)
        assert got(study, "power_scatter", truth=truth).value == pytest.approx(0.3, rel=0.1)
    # the same at all fractions, if sources are drawn alike
    for name, ends in (("z_scatter_trend", (0.99, 0.2)), ("power_scatter_trend", (0.6, 0.2))):
        trend = got(study, name, option=ends)
        assert trend.value == pytest.approx(1, abs=4 * trend.error)
    # no AGN has no power
    assert got(study, "power_offset", truth=0.0).n == 0


def test_bins_of_redshift_hold_their_sources(study):
    bins = [got(study, "frac_offset", option=span) for span in ((0, 1), (1, 2), (2, 3), (3, 9))]
    whole = got(study, "frac_offset")
    assert sum(one.n for one in bins) == whole.n == np.count_nonzero(study.at(0.0).sample)
    assert sum(one.n_all for one in bins) == whole.n_all == np.count_nonzero(study.at(0.0).field)


def test_detections_are_shares_of_the_field(study):
    one = study.at(0.0)
    share = got(study, "detected_share", option=25.0)
    bright = one.field & (study.prior_magnitude(one) < 25)
    assert share.n == np.count_nonzero(bright)
    assert share.value == pytest.approx(np.mean(one.matched["n_detected"][bright] >= 2))
    # three times the flux in the prior's band
    share = got(study, "mips_share", option=(26.0, "mips.24", 24.0))
    magnitude = study.prior_magnitude(one)[one.field] - 2.5 * np.log10(3)
    assert share.value == pytest.approx(np.mean(magnitude[magnitude < 26 - 1.19] < 24), abs=0.01)


def test_limits_and_signal_to_noise(study):
    assert got(study, "limit_offset", option=BANDS[0]).value == pytest.approx(-0.5)
    other = got(study, "limit_offset", option=(BANDS[0], 24.0))
    assert other.value == pytest.approx(LIMITS[BANDS[0]] - 0.5 - 24.0)
    assert got(study, "etc_limit", option=BANDS[1]).value == LIMITS[BANDS[1]]
    one = study.at(0.0)
    band = BANDS[3]
    ratio = (one.matched[band] / one.matched[f"{band}_err"])[one.sample]
    assert got(study, "signal_to_noise", option=band).value == pytest.approx(np.median(ratio))
    # a band that the study does not have
    assert np.isnan(got(study, "signal_to_noise", option="miri.f560w").value)


def test_magnitudes_by_shape_and_crowding():
    one = mock_truth(0.0, n=3000)
    # high Sersic indices lose a fifth of their light, crowded sources scatter by 0.3 mag
    rng = np.random.default_rng(1)
    steep = (np.asarray(one.truth["profile"]) == "sersic") & (one.truth["sersic_index"] >= 2)
    for name in BANDS:
        flux = one.matched[f"{name}_true"] * np.where(steep, 0.8, 1.0)
        noise = 10 ** (-0.4 * rng.normal(0, np.where(one.crowded[name], 0.3, 0.1)))
        one.matched[name] = flux * noise
    study = StudyResults((one,), BANDS)
    lost = got(study, "magnitude_offset", option=(BANDS[3], "n >= 2"))
    assert lost.value == pytest.approx(-2.5 * np.log10(0.8), abs=4 * lost.error)
    for name in ("n < 2", "point", "not n >= 2"):
        kept = got(study, "magnitude_offset", option=(BANDS[3], name))
        assert kept.value == pytest.approx(0, abs=4 * kept.error)
    for name, drawn in (("crowded", 0.3), ("not crowded", 0.1)):
        scatter = got(study, "magnitude_scatter", option=(BANDS[3], name, "not n >= 2"))
        assert scatter.value == pytest.approx(drawn, abs=4 * scatter.error)
    kinds = ("point", "n < 2", "n >= 2")
    shares = [got(study, "kind_share", option=(BANDS[3], name)).value for name in kinds]
    assert sum(shares) == pytest.approx(1)
    crowded = got(study, "kind_share", option=(BANDS[3], "crowded"))
    assert crowded.value == pytest.approx(0.15, abs=4 * crowded.error)
    # half of Gaussian errors are within 0.6745 sigma
    true = one.matched[f"{BANDS[3]}_true"]
    one.matched[BANDS[3]] = true * 10 ** (-0.4 * rng.normal(0, 0.1, 3000))
    error = got(study, "bright_error", option=BANDS[3])
    assert error.n == 30
    assert error.value == pytest.approx(0.6745 * 0.1, rel=0.5)


@pytest.mark.slow
def test_xray_fluxes_are_those_of_the_relation(study):
    one = study.at(0.6)
    flux = yang2021_xray_flux(one.truth["l_6um"][:3], one.truth["redshift"][:3])
    assert_allclose(10 ** xray_fluxes(one)[:3], flux.value)
    assert np.isnan(xray_fluxes(study.at(0.0))).all()
    half = got(study, "xray_half", truth=0.6)
    found = one.sample[one.field]
    above = xray_fluxes(one)[one.field] > half.value
    assert found[above].mean() > 0.7
    assert half.low < half.value < half.high
    # at redshift 2 1e-16 erg/s/cm2 in 0.5-7 keV, halved by absorption, are 10^42.54 erg/s in 2-10 keV:
    # the paper's numbers (section 4.2)
    luminosity = got(study, "xray_luminosity", truth=0.6, option=2.0)
    assert luminosity.value - half.value == pytest.approx(42.54 + 16, abs=0.01)


def test_what_a_study_lacks_is_nan(study):
    assert np.isnan(got(study, "frac_scatter", truth=0.4).value)
    one = mock_truth(0.0, sets=("all",))
    alone = StudyResults((one,), BANDS)
    assert np.isnan(got(alone, "z_outliers", band_set="red").value)
    assert np.isnan(got(alone, "z_outlier_ratio").value)
    refuses("no quantity 'z_scater'", got, study, "z_scater", error=KeyError)


def test_all_numbers_of_all_fits(study):
    small = dataclasses.replace(study, truths=study.truths[:2])
    table = study_numbers(small, seed=3, n_draws=50)
    assert set(table["truth"]) == {"agn00", "agn20"}
    assert set(table["band_set"]) == set(FITS)
    assert set(table["quantity"]) <= set(QUANTITIES)
    row = table[(table["truth"] == "agn20") & (table["band_set"] == "red")]
    row = row[(row["quantity"] == "z_scatter") & (row["z_high"] == np.inf) & (row["z_low"] == 0)]
    assert row["value"][0] == got(study, "z_scatter", truth=0.2, band_set="red").value
    # a number has its own stream: its error does not depend on what else there is
    alone = study_numbers(dataclasses.replace(study, truths=study.truths[1:2]), seed=3, n_draws=50)
    both = table[table["truth"] == "agn20"]
    assert_array_equal(both["low"], alone["low"])


def test_confusion_of_a_study(study):
    table = study_confusion(study)
    one = np.count_nonzero(study.at(0.0).field)
    # fractions 0; 0.2; 0.6 and 0.99
    assert table["n"].tolist() == [one, one, 2 * one]
    lost = [np.count_nonzero(t.field & ~t.sample) for t in study.truths]
    assert table["unknown"].tolist() == [lost[0], lost[1], lost[2] + lost[3]]


def test_selection_in_a_realistic_field():
    one = mock_truth(0.0, n=1000, sets=("all",))
    frac = np.zeros(1000)
    frac[100:200] = 0.7
    one.truth["frac_agn"] = frac
    found = np.zeros(1000)
    found[100:180] = 0.7
    found[300:320] = 0.6
    sample = one.sample.copy()
    one.fits["all"]["frac_agn_p50"] = found[sample]
    table = selection_table(one, limits=(0.4,))
    wanted, selected = one.field & (frac > 0.4), sample & one.field & (found > 0.4)
    assert (table["n_wanted"][0], table["n_selected"][0]) == (wanted.sum(), selected.sum())
    assert table["completeness"][0] == pytest.approx((wanted & selected).sum() / wanted.sum())
    assert table["purity"][0] == pytest.approx((wanted & selected).sum() / selected.sum())
    assert table["completeness"][0] < 0.8


# ----------------------------------------------------------------------------------- the paper


def test_published_numbers_are_named_once_and_can_be_measured():
    keys = [one.key for one in PUBLISHED]
    assert len(set(keys)) == len(keys)
    assert {one.quantity for one in PUBLISHED} <= {*QUANTITIES, "extra"}
    assert {one.relation for one in PUBLISHED} <= set("=~<>")
    # section 2.1; 3.2.2 and 4.3 of the text
    by_key = {one.key: one for one in PUBLISHED}
    limits = [by_key[f"etc.{band.removeprefix('miri.')}"].value for band in BANDS]
    assert limits == [25.5, 24.8, 24.3, 23.8, 22.9, 22.8]
    assert [by_key[f"scatter.{name}"].value for name in ("crowded", "isolated")] == [0.23, 0.17]
    shares = [by_key[f"outliers.{name}"].value for name in ("none", "all", "blue", "red")]
    assert shares == [0.1, 0.015, 0.037, 0.059]
    assert by_key["frac_offset.0.none"].value / by_key["frac_offset.0.all"].value == pytest.approx(
        100
    )
    assert all(one.source for one in PUBLISHED)


OPTIONS = {"seed": 1, "n_draws": 100, "reasons": {"f_scaling.f770w": "no mismatch"}}


@pytest.fixture(scope="module")
def compared(study):
    """The study with numbers of other products, and its table beside the paper."""
    extra = {"points.scatter": Estimate(0.01), "f_scaling.f770w": Estimate(1.0, 0.99, 1.01, 40)}
    study = dataclasses.replace(study, extra=extra)
    return study, compare_with_paper(study, **OPTIONS)


@pytest.mark.slow
def test_a_study_beside_the_paper(compared):
    study, table = compared
    assert len(table) == len(PUBLISHED)
    row = {r["key"]: r for r in table}
    assert row["points.scatter"]["verdict"] == "within the bound"
    scaling = row["f_scaling.f770w"]
    assert scaling["sigma"] == pytest.approx(-0.08 / np.hypot(0.01, 0.01))
    assert scaling["verdict"] == "differs by -5.7 sigma: no mismatch"
    assert row["frac_scatter.0.4.all"]["verdict"] == "not measured"
    assert row["power_offset.0.6"]["verdict"].startswith("agrees (")
    # limits are 0.5 mag shallower than the proposal's: a bound of 1 mag on both sides, and 0.95 mag
    assert row["limit.f770w"]["verdict"] == "within the bound"
    assert row["limit.f2100w"]["verdict"].startswith("differs by +0.45: ")
    assert row["etc.f770w"]["verdict"] == "agrees (to 0.1)"
    deep = {name: limit + 1.6 for name, limit in study.limits.items()}
    table = compare_with_paper(dataclasses.replace(study, limits=deep), seed=1, n_draws=10)
    deep = {r["key"]: r["verdict"] for r in table}
    assert deep["limit.f770w"].startswith("differs by +0.1: ")
    right, one = row["class.0"], study.at(0.0)
    assert right["of_all"] == pytest.approx(right["ours"] * right["completeness"])
    assert right["completeness"] == pytest.approx(one.sample.sum() / one.field.sum())
    unknown = {"seed": 1, "reasons": {"outliers": "?"}}
    refuses("no published number 'outliers'", compare_with_paper, study, error=KeyError, **unknown)


@pytest.mark.slow
def test_numbers_of_other_exposures_are_not_judged(compared):
    """Two of 366 s next to 1665 s: only what does not depend on the depth has a verdict."""
    study, same = compared
    other = compare_with_paper(study, **OPTIONS, same_exposures=False)
    assert_allclose(other["ours"], same["ours"])
    judged = np.array([one.quantity == "extra" for one in PUBLISHED])
    assert set(other["verdict"][~judged]) == {"other exposures"}
    assert np.all(np.isnan(other["sigma"][~judged]))
    assert list(other["verdict"][judged]) == list(same["verdict"][judged])


@pytest.mark.parametrize(
    ("relation", "ours", "error", "verdict"),
    [
        ("<", 0.9, 0.05, "within the bound"),
        ("<", 1.06, 0.06, "agrees within its error: beyond the bound by 0.06 (+0.7 sigma)"),
        (">", 0.94, 0.06, "agrees within its error: beyond the bound by 0.06 (-0.7 sigma)"),
        ("<", 1.5, 0.1, "differs by +3.5 sigma: open"),
        ("=", 1.01, 0.1, "agrees (+0.1 sigma)"),
        ("=", 0.0, 0.0035, "differs by more than 10 sigma: open"),
    ],
)
def test_verdicts_say_what_is_beyond_a_bound(study, monkeypatch, relation, ours, error, verdict):
    one = PublishedNumber("a", "extra", 1.0, "text", "section", relation=relation)
    monkeypatch.setattr("miricigale.evaluation.paper.PUBLISHED", (one,))
    extra = {"a": Estimate(ours, ours - error, ours + error, 10)}
    table = compare_with_paper(dataclasses.replace(study, extra=extra), seed=1)
    assert table["verdict"].tolist() == [verdict]


def test_tables_of_other_sources_are_refused():
    one = mock_truth(0.2, n=100)
    values = {field.name: getattr(one, field.name) for field in dataclasses.fields(one)}
    with pytest.raises(ValueError, match="'matched' must be of the sources of 'truth'"):
        TruthResults(**values | {"matched": one.matched[::-1]})
    fits = {"all": one.fits["all"][1:]}
    refuses("'fits' must be tables of the sample", TruthResults, **values | {"fits": fits})
    refuses("'field' must be of shape", TruthResults, **values | {"field": one.field[1:]})
    assert repr(one) == f"<TruthResults 'agn20', {one.sample.sum()} fitted>"
    assert one.magnitude_error(BANDS[0]).shape == (100,)
    assert one.matched[BANDS[0]].unit == u.uJy
