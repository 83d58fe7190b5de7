"""The configuration of a plan: given back by its own text, and strict."""

import pytest

from helpers.errors import refuses
from miricigale.planning import PlanConfig, load_plan
from miricigale.utils.exceptions import ConfigError

IMAGES = {"images": {"enabled": True}}


def test_the_text_gives_the_configuration_back(tmp_path):
    exposures = {"bands": ["miri.f770w"], "time": 900, "dithers": 2}
    config = load_plan(overrides={"exposures": exposures})
    path = tmp_path / "plan.toml"
    path.write_text(config.to_toml())
    assert load_plan(path) == config
    assert config.exposures.time == (900.0,)
    assert load_plan() == PlanConfig()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"exposures": {"bands": []}}, r"\[exposures\] bands must name at least one"),
        ({"exposures": {"time": [1.0, 2.0]}}, r"time must have one number, or one per band \(6\)"),
        ({"exposures": {"time": 0.0}}, r"time must be positive, got 0"),
        ({"exposures": {"dithers": [3, 3]}}, r"dithers must have one number"),
        ({"exposures": {"sets": ["f560w"]}}, r"sets must be 'all' or bands of"),
        ({"exposures": {"colour": 1}}, r"\[exposures\] does not know \['colour'\]"),
        ({"agn": {"shares": [1.0]}}, r"shares must have one number per fracAGN \(0\)"),
        ({"agn": {"frac_agn": 0.2, "shares": 0.0}}, r"shares must not all be 0"),
        ({"sample": {"redshift": [2.0, 1.0]}}, r"redshift must be two numbers in order"),
        ({"background": {"date": "2027-03-01"}}, r"date must come with a position"),
        ({"background": {"level": "dark"}}, r"level must be one of \['low', 'medium', 'high'\]"),
        ({"noise": {"kind": "run"}}, r"run must be a folder"),
        ({"sed": {"frac_agn": 0.5}}, r"\[agn\] has the mix"),
        ({**IMAGES, "exposures": {"readout": "SLOWR1"}}, r"readout must be FASTR1 with \[images\]"),
        ({**IMAGES, "sample": {"luminosity_function": "lf"}}, r"_function must be left out"),
        ({"survey": {"rank": "price"}}, r"rank must be one of"),
        ({"catalog": {"columns": ["z"]}}, r"\[catalog\] columns must have the form 'name=value'"),
        (
            {"fit": {"depths": [25.0]}},
            r"\[fit\] depths must have one number per band \(15\), got 1",
        ),
        (
            {"exposures": {"bands": ["miri.f707w"]}},
            r"\[exposures\] bands must be one of .*'miri\.f770w'.*, got 'miri\.f707w'",
        ),
    ],
)
def test_what_cannot_be_planned_is_named(values, message):
    refuses(message, PlanConfig.from_dict, values, error=ConfigError)


def test_sets_are_in_order_of_wavelength_by_any_name():
    config = PlanConfig()
    assert config.set_bands("f1500w, miri.f770w") == ("miri.f770w", "miri.f1500w")
    assert config.set_bands("all") == config.exposures.bands


def test_a_file_that_is_not_there_is_named():
    refuses(r"no configuration file .*absent\.toml", load_plan, "absent.toml", error=ConfigError)


def test_bands_alone_have_the_exposures_of_ceers():
    """Yang et al. 2021: 1665 s in three dithers, 4662 s in six at 21 um."""
    config = load_plan(overrides={"exposures": {"bands": ["miri.f1500w", "miri.f2100w"]}})
    assert config.exposures.by_band("time") == (1665.0, 4662.0)
    assert config.exposures.by_band("dithers") == (3, 6)
    # numbers that are given stay, even where they are those of CEERS
    six = [1665.0, 1665.0, 1665.0, 1665.0, 1665.0, 4662.0]
    bands = [f"miri.f{n}w" for n in (560, 770, 1000, 2100, 1500, 1800)]
    given = {"bands": bands, "time": six, "dithers": 4}
    kept = load_plan(overrides={"exposures": given}).exposures
    assert (kept.by_band("time"), kept.by_band("dithers")) == (tuple(six), (4,) * 6)
