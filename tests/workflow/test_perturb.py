"""Skies that differ from what the analysis takes them for: each in what it says, and in nothing else."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.exposures import exposure_of
from helpers.runs import STAGES
from helpers.scenes import catalog_at
from miricigale.instrument import Exposure, flat_field, miri_detector
from miricigale.pages import Page
from miricigale.psf import miri_psf
from miricigale.scene import Scene
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow import Context, load_config
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.engine.stage import Units
from miricigale.workflow.page.derived_sections import write_perturbed
from miricigale.workflow.page.study_page import DeclaredPage
from miricigale.workflow.perturbation import (
    Perturbation,
    perturbed_model,
    perturbed_parameters,
    point_columns,
)
from miricigale.workflow.stages.fits import mock_photometry
from miricigale.workflow.stages.images import expose_and_reduce
from miricigale.workflow.stages.perturbed import perturbation_costs
from miricigale.workflow.truths import EFFECTS, study_truths

SEED, BAND, PRIOR = 7, "miri.f770w", "wfc3.f160w"
BANDS = [BAND, "miri.f1500w"]


def config_of(effects="all", **perturb):
    sections = {"exposures": {"filters": BANDS}, "sed": {"frac_agn": [0.0, 0.4]}}
    return StudyConfig.from_dict({**sections, "perturb": {"effects": effects, **perturb}})


def sources():
    return catalog_at(
        SkyCoord([53.134, 53.136, 53.133], [-27.834, -27.835, -27.836], unit="deg"),
        redshift=[0.5, 1.0, 2.0],
        profile="sersic",
        half_light_radius=[0.5, 0.3, 0.4] * u.arcsec,
        sersic_index=[1.0, 2.0, 4.0],
        axis_ratio=[0.8, 0.6, 1.0],
        position_angle=[0.0, 30.0, 60.0] * u.deg,
        **{name: k * np.array([10.0, 20.0, 30.0]) * u.uJy for k, name in enumerate(BANDS, start=1)},
    )


def test_each_effect_is_one_more_truth():
    truths = study_truths(config_of(of=[0.0, 0.4], cutouts="mine.fits"))
    without_agn = [name for name in EFFECTS if name not in ("torus", "point_agn")]
    own = [f"agn00+{name}" for name in (*without_agn, "all")]
    own += [f"agn40+{name}" for name in (*EFFECTS, "all")]
    assert list(truths) == ["agn00", "agn40", *own]
    assert truths["agn40+zero_point"].values() == {
        "name": "agn40+zero_point", "frac_agn": 0.4, "perturbations": {"zero_point": 0.02}
    }  # fmt: skip
    assert list(truths["agn40+all"].values()["perturbations"]) == list(EFFECTS)
    cutouts = {"image": "mine.fits", "psf": "", "of": "own"}
    assert dict(truths["agn40+cutouts"].perturbations) == {"cutouts": cutouts}
    # without an image there is no such sky
    assert "agn00+cutouts" not in study_truths(config_of())
    # of the reference unless it is said; alone it is all that there is
    assert list(study_truths(config_of("gain"))) == ["agn00", "agn40", "agn00+gain"]
    apart = config_of(["psf", "gain"], together=False)
    assert list(study_truths(apart))[2:] == ["agn00+psf", "agn00+gain"]
    assert list(study_truths(config_of([]))) == ["agn00", "agn40"]


@pytest.mark.parametrize(
    ("perturb", "message"),
    [
        ({"effects": ["smear"]}, "must be one of"),
        ({"effects": ["psf", "psf"]}, "must not repeat"),
        ({"of": [0.2]}, r"must be out of \[sed\] frac_agn"),
        ({"effects": ["torus"]}, r"must have a value above 0 for \['torus'\]"),
        ({"psf_width": 0.5}, "must be between 0.0 and 0.2"),
        ({"effects": ["cutouts"]}, "cutouts must name an image for the effect 'cutouts', got ''"),
        ({"effects": ["psf"], "cutouts": "mine.fits"}, "cutouts must be empty without the effect"),
        ({"cutouts_psf": "psf.fits"}, "cutouts_psf must be empty without an image in cutouts"),
        ({"cutouts_of": "all"}, "must be one of"),
    ],
)
def test_perturbations_that_cannot_be(perturb, message):
    refuses(message, config_of, error=ConfigError, **perturb)


def test_no_stage_of_the_analysis_knows_of_them():
    """Stages of truth and sky have them in their plans, those of a perturbed truth only."""
    plain, config = config_of([]), config_of(of=[0.0, 0.4])
    parts = {
        one: {n: Units(s.unit_names(one)) for n, s in STAGES.items()} for one in (plain, config)
    }
    for name, stage in STAGES.items():
        assert ("perturb" in stage.sections) == (name == "report")
        assert not [key for key in stage.sections if key.startswith("perturb.")]
        for unit in stage.unit_names(plain):
            # the page of sources has links to those of all truths
            if stage.plan and name != "sources":
                assert stage.plan(config, unit) == stage.plan(plain, unit)
            # nor do its inputs change; the report and the page of sources are of all skies
            if name not in ("sources", "report"):
                read = [stage.needed(one, unit, parts[one]) for one in (plain, config)]
                assert read[0] == read[1]
    for unit in STAGES["exposures"].unit_names(config):
        seen = STAGES["exposures"].plan(config, unit).get("perturbations", {})
        assert seen == dict(study_truths(config)[unit.partition("/")[0]].perturbations)
    # sizes count where they act
    other, plan = config_of(of=[0.0, 0.4], zero_point=0.03), STAGES["exposures"].plan
    units = STAGES["exposures"].unit_names(config)
    changed = {u.partition("/")[0] for u in units if plan(config, u) != plan(other, u)}
    assert changed == {f"agn{f}+{name}" for f in ("00", "40") for name in ("zero_point", "all")}
    assert STAGES["kernels"].plan(other, BAND) == STAGES["kernels"].plan(plain, BAND)


def test_astrometry_shifts_a_band_as_a_whole():
    sky, shift = sources()["sky"], Perturbation({"astrometry": 0.03}, SEED)
    moved = [shift.catalog(sources(), name)["sky"] for name in BANDS]
    for own in moved:
        assert_allclose(own.separation(sky).to_value(u.mas), 30, rtol=1e-4)
    angles = np.array([sky.position_angle(own).to_value(u.deg) for own in moved])
    assert np.all(np.ptp(angles, axis=1) < 0.1)
    assert abs(angles[0, 0] - angles[1, 0]) > 1


def test_zero_points_of_existing_bands_are_in_the_fluxes_that_are_fitted():
    """Without the noise of depths a flux is 1.02 or 0.98 of what it was, and its band's for all sources."""
    n = 50
    truth = QTable({"id": np.arange(n)})
    bands = ["acs.f606w", "acs.f814w", "wfc3.f125w", PRIOR, "irac.ch1"]
    for band in bands:
        truth[band] = np.linspace(10, 20, n) * u.uJy
    matched = QTable({"id": truth["id"], "selection": np.zeros(n, int)})
    for band in BANDS:
        matched[band], matched[f"{band}_err"] = truth[PRIOR], 0.1 * truth[PRIOR]
    fit = {"bands": bands, "depths": [40.0] * len(bands)}
    config = StudyConfig.from_dict({"fit": fit}, base=config_of([]))
    arguments = (config, truth, matched)
    plain, changed = (mock_photometry(*arguments, seed=SEED, zero_point=z) for z in (0, 0.02))
    ratios = {band: (changed[band] / plain[band]).value for band in bands}
    for band, ratio in ratios.items():
        assert_allclose(np.abs(ratio - 1), 0.02, rtol=1e-6)
        assert np.ptp(ratio) < 1e-9, band
    assert len({ratio[0] > 1 for ratio in ratios.values()}) == 2
    for band in BANDS:
        assert_array_equal(changed[band], plain[band])
    # of the skies that have it only; it is no part of the images
    config, fits = config_of(["psf", "zero_point_existing"], of=0.4), STAGES["fits"]
    units = {u for u in fits.unit_names(config) if "zero_point" in fits.plan(config, u)}
    skies = ("agn40+zero_point_existing", "agn40+all")
    assert units == {f"{sky}/{chosen}" for sky in skies for chosen in ("all", "none")}


def test_psf_of_another_telescope_and_of_another_width():
    own = miri_psf(BAND)
    other = Perturbation({"psf": None}, SEED).psf(BAND)
    assert np.abs(other.data - own.data).max() > 0.005 * own.data.max()
    assert other.fwhm.value == pytest.approx(own.fwhm.value, rel=0.02)
    assert other.enclosed == pytest.approx(own.enclosed, rel=2e-3)
    factors = set()
    for seed in range(8):
        wide = Perturbation({"psf_width": 0.02}, seed).psf(BAND)
        factor = wide.meta["width_factor"]
        assert abs(factor - 1) == pytest.approx(0.02)
        assert wide.fwhm.value == pytest.approx(factor * own.fwhm.value, rel=1e-3)
        assert wide.enclosed == pytest.approx(own.enclosed, rel=2e-3)
        factors.add(factor)
    assert len(factors) == 2


def test_gain_and_linearity_are_those_of_the_detector_only():
    known = miri_detector()
    assert Perturbation({"gain": 0.01}, SEED).detector == known.replace(gain=1.01 * known.gain)
    other = Perturbation({"linearity": 0.01}, SEED).detector
    full = known.saturation_dn
    for share in (0.25, 1.0):
        difference = other.linearize(share * full) - known.linearize(share * full)
        assert difference == pytest.approx(0.01 * share**2 * full)
    assert other.replace(nonlinearity=known.nonlinearity) == known


def test_flat_is_that_of_another_detector():
    exposure = Exposure(BAND, pointing=sources()["sky"][0], roll=0 * u.deg, n_groups=10)
    known = flat_field(BAND)

    def flat_of(size):
        image = CCDData(np.full(exposure.shape, 5.0), unit="MJy/sr")
        return Perturbation({"flat": size}, SEED).with_flat(image, exposure).data * known / 5

    seen, tenth = flat_of(1.0), flat_of(0.1)
    # pixels by 1 %, independent of those that the reduction divides by
    inner = np.s_[:, 4:-4]
    pixels = [np.diff(flat[inner]).ravel() for flat in (seen, known)]
    assert np.std(pixels[0]) == pytest.approx(np.std(pixels[1]), rel=0.02)
    assert abs(np.corrcoef(*pixels)[0, 1]) < 0.01
    assert seen[inner].mean() == pytest.approx(1, abs=1e-5)
    assert flat_field(BAND) is known or np.array_equal(flat_field(BAND), known)
    # a tenth of the difference: that of two independent draws
    off = np.diff((tenth / known)[inner]).ravel()
    assert np.std(off) == pytest.approx(0.1 * np.sqrt(2) * np.std(pixels[1]), rel=0.03)


def parameters():
    rng = np.random.default_rng(1)
    n = 20
    table = QTable({"id": np.arange(n), "redshift": rng.uniform(0.3, 2.5, n)})
    table["mass"] = 10 ** rng.uniform(10, 11, n)
    table["tau"], table["age"], table["ebv"], table["alpha"] = 1.0, 2.0, 0.3, 2.0
    table["frac_agn"], table["tau97"], table["inclination"] = 0.4, 5.0, 70.0
    return table


@pytest.mark.parametrize("effect", ["stars", "dust", "torus"])
def test_models_of_sources_change_in_one_part(effect):
    known, table = SEDModel.yang2021(), parameters()
    assert perturbed_model(["psf", "point_agn"], agn=True) is None
    other = perturbed_model([effect], agn=True)
    changed = perturbed_parameters([effect], table, (known, other), PRIOR, seed=SEED)
    bands = [PRIOR, "acs.f435w", "miri.f770w", "miri.f2100w"]
    plain, own = (model.fluxes(rows, bands) for model, rows in ((known, table), (other, changed)))
    ratio = {name: (own[name] / plain[name]).value for name in bands}
    # the prior's light is that of before; the AGN takes little part in it
    assert_allclose(ratio[PRIOR], 1, atol=0.02)
    assert_allclose(own["frac_agn_dust"], 0.4)
    power = (own["dust_luminosity"] / plain["dust_luminosity"]).value
    if effect == "stars":
        assert np.std(ratio["acs.f435w"]) > 0.02
        assert np.all((power > 0.5) & (power < 5))
    else:
        assert_allclose(ratio["acs.f435w"], 1, atol=0.02)
        # dust of near galaxies shows in the prior too
        assert_allclose(power, 1, rtol=0.01)
        assert np.abs(ratio["miri.f2100w"] - 1).max() > 0.05
    # drawn for each source, by its id
    part = perturbed_parameters([effect], table[5:], (known, other), PRIOR, seed=SEED)
    for name in part.colnames:
        assert_allclose(part[name], changed[name][5:], rtol=1e-9)


def test_an_agn_as_a_point_keeps_the_light():
    model, table = SEDModel.yang2021(), parameters()[:3]
    shares = point_columns(model, table, BANDS)
    alone = table.copy()
    alone["frac_agn"] = 0.0
    for band in BANDS:
        galaxy, both = (model.fluxes(rows, [band])[band].value for rows in (alone, table))
        assert_allclose((1 - shares[f"{band}_point"]) * both, galaxy, rtol=1e-9)
    assert np.all(shares[f"{BAND}_point"] > 0.05)
    catalog = sources()
    for name, share in shares.items():
        catalog[name] = share
    exposure = Exposure(BAND, pointing=catalog["sky"][0], roll=0 * u.deg, n_groups=10)
    options = {"filter": BAND, "wcs": exposure.wcs, "psf": miri_psf(BAND, fov=8 * u.arcsec)}
    differ = (Perturbation(effects, SEED) for effects in ({}, {"point_agn": None}))
    skies = [Scene(catalog, agn=one.point_column(BAND), **options) for one in differ]
    plain, pointed = (sky.render().data for sky in skies)
    known, truth = (sky.truth for sky in skies)
    assert_array_equal(truth["id"], catalog["id"])
    assert_allclose(truth["flux_total"], catalog[BAND])
    assert_allclose(truth["flux_in_image"], known["flux_in_image"], rtol=0.02)
    assert pointed.sum() == pytest.approx(plain.sum(), rel=0.01)
    assert pointed.max() > 1.2 * plain.max()


@pytest.fixture(scope="module")
def chain():
    """What comes out of the whole chain, from the scene to the calibrated image, of a band and effects."""
    overrides = {"exposures": {"kind": "rates"}, "detector": {"cosmic_rays": False}}
    config = load_config("goodss", overrides=overrides)
    field = SkyCoord(config.pointing.ra, config.pointing.dec, unit="deg")
    exposure = exposure_of(BAND, pointing=field, roll=0 * u.deg, n_groups=20)
    x, y = (v.ravel() + 40.0 for v in np.meshgrid([10.0, 90.0, 170.0], [30.0, 130.0]))
    table = catalog_at(exposure.wcs.pixel_to_world(x, y), **{BAND: 2000.0 * u.uJy})
    known = {}

    def run(effects, flux=1.0):
        key = str(effects), str(flux)
        if key not in known:
            catalog = table.copy()
            catalog[BAND] = flux * catalog[BAND]
            differ = None if effects is None else Perturbation(effects, SEED)
            rate, cal = expose_and_reduce(config, exposure, catalog, seed=1, perturbation=differ)
            known[key] = rate, cal, (x, y)
        return known[key]

    return run


def stars(cal, places, radius=12):
    """Light, center and width of stars: sums in a circle, and moments by a Gaussian of 1.5 pixels."""
    data = np.nan_to_num(cal.data)
    rows, columns = np.indices(data.shape)
    found = []
    for x, y in zip(*places, strict=True):
        near = np.hypot(columns - x, rows - y) < radius
        light = data[near] - np.median(data)
        weight = light * np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2)[near] / 1.5**2)
        cx, cy = (np.sum(weight * at[near]) / weight.sum() for at in (columns, rows))
        second = np.sum(weight * ((columns - cx) ** 2 + (rows - cy) ** 2)[near]) / weight.sum()
        found.append((light.sum(), cx, cy, second))
    return np.transpose(found)


SIZES = ("psf_width", "gain", "linearity", "zero_point", "zero_point_existing", "astrometry")


@pytest.mark.parametrize("effects", [{}, dict.fromkeys((*SIZES, "clumps"), 0.0)])
def test_no_effects_and_those_without_size_leave_every_bit(chain, effects):
    plain, none = chain(None), chain(effects)
    for first, second in zip(plain[:2], none[:2], strict=True):
        assert_array_equal(first.data, second.data)
        assert_array_equal(first.uncertainty.array, second.uncertainty.array)
        assert_array_equal(first.mask, second.mask)
    config = config_of(["zero_point_existing"], zero_point_existing=0.0)
    plans = [STAGES["fits"].plan(config, f"agn00{x}/all") for x in ("", "+zero_point_existing")]
    assert plans[0] == plans[1]


def test_each_effect_reaches_the_calibrated_image_in_its_size(chain):
    _, cal, places = chain({})
    light, x, y, width = stars(cal, places)

    def changed(effects):
        return stars(chain(effects)[1], places)

    # fluxes as of stars that are by 2 % brighter, and nothing else
    zero = changed({"zero_point": 0.02})
    sign = np.sign(zero[0][0] / light[0] - 1)
    assert_allclose(zero[0] / light, 1 + 0.02 * sign, atol=0.002)
    assert_allclose(stars(chain({}, 1 + 0.02 * sign)[1], places)[0], zero[0], rtol=1e-6)
    assert_allclose(zero[1:3], [x, y], atol=0.005)
    # the conversion takes DN for as many electrons as before
    assert_allclose(changed({"gain": 0.01})[0] / light, 1 / 1.01, atol=0.002)
    # 30 mas of 110 mas pixels, all in one direction
    moved = changed({"astrometry": 0.03})
    step = np.array([moved[1] - x, moved[2] - y]) * 0.11
    # the weight pulls the center back to the old place: by the share of its width in both
    pull = 1.0 / (1.0 - width / (2 * 1.5**2))
    length = np.hypot(*step) * pull
    assert_allclose(length, 0.03, rtol=0.25)
    assert np.ptp(np.arctan2(step[1], step[0])) < 0.2
    assert_allclose(moved[0] / light, 1, atol=0.003)
    # wider or narrower, with the same light
    wide = changed({"psf_width": 0.1})
    assert len(set(np.sign(wide[3] - width))) == 1
    assert np.all(np.abs(wide[3] / width - 1) > 0.03)
    assert_allclose(wide[0] / light, 1, atol=0.02)
    # another wavefront: other shapes, the same light
    other = changed({"psf": None})
    assert np.any(np.abs(other[3] / width - 1) > 1e-4)
    assert_allclose(other[0] / light, 1, atol=0.01)


def test_another_flat_takes_the_place_of_the_known_one(chain):
    """Slopes have the known flat field from pixel to pixel, or nothing of it; large scales are common to all."""
    inner = np.s_[8:-8, 8:-8]
    own = np.diff(np.log(flat_field(BAND, subarray="SUB256")[inner]), axis=1)

    def imprint(rate):
        steps = np.diff(np.log(np.where(rate.mask, np.nan, rate.data)[inner]), axis=1)
        near = np.abs(steps) < 1.0
        covariance = np.cov(steps[near], own[near])
        return covariance[0, 1] / covariance[1, 1]

    # pixels share some of their charge with their neighbors
    assert imprint(chain({})[0]) == pytest.approx(0.9, abs=0.12)
    # 57,000 pixels of 1 %, whose slopes have errors of 6 %
    assert imprint(chain({"flat": 1.0})[0]) == pytest.approx(0, abs=0.12)


def test_another_linearity_shows_where_wells_are_full(chain):
    flux = np.tile([0.1, 2.0], 3)
    images = (chain(effects, flux) for effects in ({}, {"linearity": 0.05}))
    first, second = (stars(cal, places)[0] for _, cal, places in images)
    faint, bright = np.median((second / first - 1).reshape(3, 2), axis=0)
    # signals are larger than they are taken for where wells are full
    assert bright < -0.005
    assert abs(faint) < 0.15 * abs(bright)


def study_tables(seed, *, flux=1.0, shift=0.0):
    """Tables of a truth as `StudyTables` has them: 200 sources with the noise of a seed."""
    rng, n = np.random.default_rng(seed), 200
    true, noise = rng.uniform(10, 100, n), rng.normal(size=(2, n))
    matched = QTable({"id": np.arange(n), "selection": np.zeros(n, int)})
    for band in BANDS:
        matched[f"{band}_true"] = true * u.uJy
        matched[band] = true * flux * (1 + 0.01 * noise[0]) * u.uJy
        matched[f"{band}_formal_err"] = np.full(n, 0.1) * u.uJy
        matched[f"{band}_flags"] = matched[f"{band}_condition"] = np.zeros(n, int)
    sample = QTable({"id": np.arange(n), "redshift": np.ones(n), "frac_agn": np.full(n, 0.4)})
    fit = QTable({"redshift_mean": 1 + 2 * (0.03 * noise[1] + shift)})
    fit["frac_agn_mean"] = 0.4 + 0.1 * noise[0] + shift
    return SimpleNamespace(matched=matched, sample=sample, fits={"all": fit})


def test_costs_are_changes_of_the_same_sources(tmp_path):
    config = config_of(["gain", "zero_point"], of=0.4)
    truths = study_truths(config)
    every = dict.fromkeys(truths, study_tables(3))
    every["agn40+zero_point"] = study_tables(3, flux=1.02)
    every["agn40+all"] = study_tables(3, flux=1.02, shift=0.2)
    table = perturbation_costs(truths, every, BANDS, seed=SEED)
    cost = {(row["perturbation"], row["quantity"]): row for row in table}
    assert set(table["truth"]) == {"agn40"}
    assert list(dict.fromkeys(table["perturbation"])) == ["none", "gain", "zero_point", "all"]
    for band in BANDS:
        offset = cost["zero_point", f"{band} offset"]
        assert offset["n"] == 200
        # noise is that of the other sky and takes no part in the change
        assert offset["change"] == pytest.approx(0.02, rel=0.02)
        assert offset["change_err"] < 2e-4 < 5e-4 < offset["value_err"]
        assert cost["gain", f"{band} offset"]["change"] == 0
    assert cost["zero_point", "photo-z outliers"]["change"] == 0
    assert cost["all", "photo-z outliers"]["value"] > 0.9
    assert cost["all", "fracAGN offset"]["change"] == pytest.approx(0.2)
    assert cost["all", "fracAGN scatter"]["change"] == pytest.approx(0)
    assert len(perturbation_costs(study_truths(config_of([])), every, BANDS, seed=SEED)) == 0
    report = Page("made up")
    page = DeclaredPage(report, Context(config, tmp_path))
    write_perturbed(page, study_truths(config_of([])), every)
    assert "does not know" not in report.to_html()
    write_perturbed(page, truths, every)
    page = report.to_html()
    assert "<th class=n>F770W offset</th>" in page
    assert "<td>agn40</td><td>zero point, MIRI</td><td class=n>+2.0 % (+2.0 ± 0.0 %)</td>" in page
    written = QTable.read(tmp_path / "report" / "perturbations.ecsv")
    assert_array_equal(written["change"], table["change"])
