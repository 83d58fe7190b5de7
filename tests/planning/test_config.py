"""The configuration of a plan: given back by its own text, and strict."""

import pytest

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.planning import PlanConfig, load_plan
from miricigale.utils.exceptions import ConfigError


def test_the_text_gives_the_configuration_back(tmp_path):
    exposures = {"bands": ["miri.f770w"], "time": 900, "dithers": 2}
    config = load_plan(overrides={"exposures": exposures})
    path = tmp_path / "plan.toml"
    path.write_text(config.to_toml())
    assert load_plan(path) == config
    assert config.exposures.time == (900.0,)
    assert load_plan() == PlanConfig()


@pytest.mark.parametrize(("values", "message"), cases_of(__file__, "refused"))
def test_what_cannot_be_planned_is_named(values, message):
    refuses(message, PlanConfig.from_dict, values, error=ConfigError)


def test_sets_are_in_order_of_wavelength_by_any_name():
    config = PlanConfig()
    assert config.set_bands("f1500w, miri.f770w") == ("miri.f770w", "miri.f1500w")
    assert config.set_bands("F770W,JWST/MIRI.F1000W") == ("miri.f770w", "miri.f1000w")
    assert config.set_bands("all") == config.exposures.bands


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
