"""What the skies of a study hold: galaxies alike in all of them, AGN of the wanted strength."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.runs import STAGES, do_stage
from helpers.scenes import catalog_at
from miricigale.evaluation import AGNPopulation
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.truths import band_sets, study_truths

N, PRIOR = 60, "wfc3.f160w"
ENDS = (("", 1.0), ("_err", 0.1))
FRACTIONS = [0.0, 0.4, 0.99, "field"]


def make_truths(folder, bands=None, **sed):
    """Truths of a catalog of massive galaxies, of which many have an AGN; ``bands`` are further fluxes."""
    rng = np.random.default_rng(5)
    parameters = QTable({"redshift": rng.uniform(0.5, 2.5, N), "age": np.full(N, 1.0)})
    parameters["mass"] = 10 ** rng.uniform(10.8, 11.5, N)
    parameters["tau"], parameters["ebv"], parameters["alpha"] = 1.0, 0.3, 2.0
    names = ["acs.f606w", "acs.f814w", "wfc3.f125w", PRIOR]
    light = SEDModel.yang2021(agn=False).fluxes(parameters, names)
    more = {f"{n}{end}": part * f for n, f in (bands or {}).items() for end, part in ENDS}
    sky = SkyCoord(53.1 + 0.001 * np.arange(N), np.full(N, -27.8), unit="deg")
    columns = {"redshift": parameters["redshift"], "mag_f160w": 20.0}
    table = catalog_at(sky, **columns, **{name: light[name] for name in names}, **more)
    table.write(folder / "mine.ecsv", overwrite=True)
    sed = {"frac_agn": FRACTIONS, "axes": "quick", **sed}
    config = StudyConfig.from_dict({"catalog": {"source": str(folder / "mine.ecsv")}, "sed": sed})
    for name in ("catalog", "seds", "truth"):
        for unit in STAGES[name].unit_names(config):
            do_stage(config, folder, name, unit)
    return {name: QTable.read(folder / name / "truth.ecsv") for name in study_truths(config)}


@pytest.fixture(scope="module")
def truths(tmp_path_factory):
    return make_truths(tmp_path_factory.mktemp("truths"))


def test_galaxies_are_alike_in_all_skies(truths):
    assert list(truths) == ["agn00", "agn40", "agn99", "field"]
    for truth in truths.values():
        for name in ("redshift", "mass", "age", "ebv"):
            assert_array_equal(truth[name], truths["agn00"][name])
        # integrals on the wavelengths of the torus too
        for name in ("stellar_mass", "dust_luminosity"):
            assert_allclose(truth[name], truths["agn00"][name], rtol=1e-4)
    catalog_flux = truths["agn00"][PRIOR]
    # as measured
    assert np.all(truths["agn00"]["prior_ratio"] > 0)
    assert np.all(truths["agn40"][PRIOR] >= catalog_flux)


def test_an_agn_has_its_share_of_the_power(truths):
    # by definition "dust": power of the AGN = dust luminosity f / (1 - f)
    for name, value in (("agn40", 0.4), ("agn99", 0.99)):
        truth = truths[name]
        assert_allclose(truth["frac_agn"], value)
        power = (truth["ir_luminosity"] - truths["agn00"]["ir_luminosity"]).to_value(u.W)
        wanted = truth["dust_luminosity"].to_value(u.W) * value / (1 - value)
        # the share within 3-1000 um is close to it
        assert_allclose(power, wanted, rtol=0.2)


def test_agn_of_the_field_have_the_luminosities_that_were_drawn(truths):
    truth = truths["field"]
    table = QTable({"id": truth["id"], "redshift": truth["redshift"]})
    table["stellar_mass"] = truth["stellar_mass"]
    drawn = AGNPopulation().draw(table, seed=StudyConfig().run.seed)
    has = np.asarray(drawn["has_agn"])
    assert 3 < has.sum() < N / 2
    assert_array_equal(np.asarray(truth["frac_agn"]) > 0, has)
    assert_allclose(truth["l_6um"].to_value(u.W), drawn["l_6um"].to_value(u.W), rtol=1e-9)
    # those through whose torus no line of sight goes are seen from above
    open_ones = has & ~np.asarray(drawn["obscured"])
    assert_array_equal(np.asarray(truth["inclination"])[has] <= 40, open_ones[has])
    # a galaxy without one has the fluxes of the sky without AGN
    for name in ("miri.f770w", "miri.f2100w"):
        assert_allclose(truth[name][~has], truths["agn00"][name][~has], rtol=1e-3)


def test_dust_of_the_main_sequence_leaves_the_stars(tmp_path):
    dusty, plain = (
        make_truths(tmp_path, infrared=one, frac_agn=0.0)["agn00"]
        for one in ("main-sequence", "fit")
    )
    assert np.all(dusty["dust_excess"] >= 1)
    assert np.any(dusty["dust_excess"] > 1.5)
    assert_allclose(dusty["acs.f606w"], plain["acs.f606w"], rtol=1e-6)
    ratio = dusty["dust_luminosity"] / plain["dust_luminosity"]
    assert_allclose(ratio, dusty["dust_excess"], rtol=1e-9)
    # light of the dust alone, far from the stars
    far = dusty["redshift"] < 1.0
    ratio = dusty["miri.f2100w"] / plain["miri.f2100w"]
    assert_allclose(ratio[far], dusty["dust_excess"][far], rtol=0.02)


def test_dust_is_that_of_ceers_where_no_band_shows_it(truths, tmp_path):
    dusty = truths["agn00"]
    # massive galaxies: log10 of the excess is 0.07 +- 0.30
    excess = np.log10(dusty["dust_excess"])
    assert np.mean(excess) == pytest.approx(0.07, abs=4 * 0.30 / np.sqrt(N))
    assert set(dusty["pah_33"]) == {0.1}
    bands = {"miri.f1500w": np.where(np.arange(N) < 2, 9.0, np.nan) * u.uJy}
    shown = make_truths(tmp_path, frac_agn=0.0, bands=bands)["agn00"]
    assert shown["dust_excess"][:2].tolist() == shown["pah_33"][:2].tolist() == [1, 1]
    # a source's draw does not depend on the others
    assert_allclose(shown["dust_excess"][2:], dusty["dust_excess"][2:])


def test_the_dusts_alpha_is_drawn_from_nodes(tmp_path):
    nodes = {"alpha": [1.5, 2.5], "alpha_draw": "nodes", "frac_agn": 0.0}
    assert set(make_truths(tmp_path, **nodes)["agn00"]["alpha"]) == {1.5, 2.0, 2.5}
    other = nodes | {"alpha": [1.6, 1.7]}
    refuses("must hold a node", make_truths, tmp_path, error=ConfigError, **other)


def test_names_of_truths_and_sets():
    config = StudyConfig.from_dict({"sed": {"frac_agn": 0.155}, "fit": {"sets": ["red", "all"]}})
    assert list(study_truths(config)) == ["agn15.5"]
    red = ("miri.f1500w", "miri.f1800w", "miri.f2100w")
    assert band_sets(config) == {"red": red, "all": config.exposures.filters}
    shuffled = {"filters": ["miri.f2100w", "miri.f560w", "miri.f1000w"]}
    config = StudyConfig.from_dict({"exposures": shuffled, "fit": {"sets": ["all", "blue"]}})
    assert band_sets(config)["blue"] == ("miri.f560w", "miri.f1000w")


BLUE = {"sets": ["all", "blue"], "min_detected": 1}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sed": {"frac_agn": []}}, "must begin with a number, got none"),
        ({"sed": {"frac_agn": [0.2, 0.2]}}, "must not repeat"),
        ({"sed": {"frac_agn": ["field", 0.0]}}, "must begin with a number"),
        ({"sed": {"frac_agn": [0.0, "quasars"]}}, r"must be one of \['field', 'catalog'\]"),
        ({"sed": {"frac_agn": [1.0]}}, "must be between 0.0 and 0.99"),
        ({"fit": {"sets": ["none"]}}, "must have 'all'"),
        ({"fit": BLUE, "exposures": {"filters": ["miri.f770w"]}}, "two filters and more"),
    ],
)
def test_truths_and_sets_that_cannot_be(values, message):
    refuses(message, StudyConfig.from_dict, values, error=ConfigError)
