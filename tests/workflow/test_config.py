import dataclasses
import math
import tomllib

import numpy as np
import pytest

from helpers.errors import refuses
from miricigale.planning import PlanConfig
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow.config import StudyConfig, load_config, preset_names
from miricigale.workflow.options import toml_value


def written(tmp_path, config):
    """A configuration that was printed and read again."""
    path = tmp_path / "my.toml"
    path.write_text(config.to_toml(), encoding="utf-8")
    return load_config(path)


RESIDUALS = [{"overrides": {"detector": {"residual": value}}} for value in (0.01, 0, "etc")]
SOURCE = {"overrides": {"catalog": {"source": "été 😀 \x9c.fits"}}}


@pytest.mark.parametrize("config", [{"quick": True}, *RESIDUALS, SOURCE])
def test_a_printed_configuration_comes_back_the_same(tmp_path, config):
    made = load_config("goodss", **config)
    assert written(tmp_path, made) == made
    for section, values in config.get("overrides", {}).items():
        assert {key: getattr(getattr(made, section), key) for key in values} == values


def test_presets_are_listed_without_their_variants():
    assert preset_names() == ["cosmosweb", "goodss", "yang2021"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[detektor]\n", "unknown section .*detektor.*known: .*detector"),
        ("[run]\nsead = 1\n", r"\[run\] does not know \['sead'\]; known: .*'seed'"),
        ("[run]\nseed = 1.5\n", r"\[run\] seed must be of type int, got 1.5"),
        ("[run]\nseed = true\n", r"\[run\] seed must be of type int, got True"),
        ("[run]\nseed = -1\n", r"\[run\] seed must be at least 0, got -1"),
        ("[pointing]\ndec = 95.0\n", r"\[pointing\] dec must be between -90 and 90, got 95.0"),
        ("[pointing]\ndec = nan\n", r"\[pointing\] dec must be a finite number, got nan"),
        ("[pointing]\ntiles = [2]\n", r"\[pointing\] tiles must be two numbers, got \[2\]"),
        ("[pointing]\ntiles = [0, 1]\n", r"tiles must be between 1 and 30, got 0"),
        ("[pointing]\ncenters = ['53.1']\n", r"centers must have the form 'RA Dec' .*got '53.1'"),
        ("[pointing]\ncenters = ['3 95']\n", r"centers must have the form 'RA Dec'"),
        (
            "[pointing]\ncenters = ['3 5']\ntiles = [2, 1]\n",
            r"tiles must be \[1, 1\] with centers, got \[2, 1\]",
        ),
        ("[scene]\ngradient_angle = inf\n", r"gradient_angle must be a finite number, got inf"),
        ("[sed]\nalpha = [2.5, 1.5]\n", r"alpha must be two numbers in order"),
        ("[detector]\nresidual = 0.5\n", r"residual must be between 0.0 and 0.1, got 0.5"),
        ("[detector]\nresidual = 'flat'\n", r"residual must be one of \['etc'\], got 'flat'"),
        ("[detector]\nresidual = true\n", r"residual must be of type float, got True"),
        ("[fit]\naxes = 'huge'\n", r"\[fit\] axes must be one of \['fit', 'quick'\], got 'huge'"),
        ("[fit]\nbands = ['acs.f606w']\n", r"\[fit\] depths must have one number per band \(1\)"),
        ("[exposures]\nfilters = []\n", "at least one filter"),
        (
            "[fit]\nmin_detected = 7\n",
            r"min_detected must be at most the number of MIRI filters \(6\)",
        ),
        ("[exposures]\nfilters = ['miri.f770w', 'miri.f770w']\n", "must not repeat"),
        (
            "[exposures]\nn_groups = [10]\n",
            r"n_groups must have one number per filter \(6\), got 1",
        ),
        (
            "[photometry]\nmethod = 'yang2021'\n[highres]\npixel_scale = 0.05\n",
            "pixel_scale must be 0.06 with method = 'yang2021', got 0.05",
        ),
        ("[photometry]\nregularization = 'x'\n", r"must be one of \['auto', 'yang2021'\], got 'x'"),
        ("[photometry]\nregularization = -1\n", "regularization must be at least 1e-06, got -1.0"),
        ("run = 3\n", r"\[run\] must be a section, got 3"),
        ("[run\n", "is not valid TOML"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_sentence(tmp_path, text, message):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as info:
        load_config(path)
    assert "\n" not in str(info.value).split("TOML:")[0]


def test_missing_files_and_presets_are_named(tmp_path):
    absent, binary = tmp_path / "absent.toml", tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe")
    refuses(r"no configuration file .*absent\.toml", load_config, absent, error=ConfigError)
    refuses("no preset 'cosmos'; known: cosmosweb, goodss", load_config, "cosmos", error=KeyError)
    text = "--quick belongs to presets"
    refuses(text, load_config, absent, error=ConfigError, quick=True)
    refuses(r"binary\.toml is not a text file in UTF-8", load_config, binary, error=ConfigError)


@pytest.mark.parametrize(
    "name",
    [
        "", ".", "..", "../evil", "/tmp/evil", "a/b", "a\\b", "c:evil", ".hidden", " a", "a ", "a\nb", "a\x00b",
        "\x1b[0m", "a" * 300,
    ],
)  # fmt: skip
@pytest.mark.parametrize("kind", [(StudyConfig, "run"), (PlanConfig, "plan")])
def test_names_are_folders_in_the_current_one(kind, name):
    config, section = kind
    text = rf"\[{section}\] name must be the name of a folder in the current one"
    refuses(text, config.from_dict, {section: {"name": name}}, error=ConfigError)


@pytest.mark.parametrize("name", ["my study", "été-2", "v1.2", "$x_1$"])
def test_other_names_are_taken_as_they_are(name):
    assert PlanConfig.from_dict({"plan": {"name": name}}).plan.name == name


@pytest.mark.parametrize("config", [StudyConfig(), PlanConfig()], ids=["study", "plan"])
def test_every_key_is_explained_and_nothing_else(config):
    for section in vars(config).values():
        assert list(section.docs()) == [field.name for field in dataclasses.fields(section)]
        assert all(doc.endswith(".") for doc in section.docs().values())


def test_all_text_comes_back_from_toml():
    nasty = [*map(chr, range(0x100)), *"\u0100\u2028\ud7ff\ue000\ufeff\uffff😀\U0010ffff"]
    rng = np.random.default_rng(1)
    texts = ["", '"""', "\\", "C:\\new", "\\u007f", *nasty]
    texts += ["".join(rng.choice(nasty, size=12)) for _ in range(300)]
    for text in texts:
        line = f"x = {toml_value(text)}\n"
        assert tomllib.loads(line.encode().decode())["x"] == text
    assert tomllib.loads(f"x = {toml_value(tuple(texts))}")["x"] == texts


def test_all_numbers_come_back_from_toml():
    floats = [0.0, -0.0, 1e16, 1e-7, 5e-324, 1.7976931348623157e308, 0.1, math.inf, -math.inf]
    for value in (*floats, *np.array(floats), True, False, 0, -3, 2**60):
        read = tomllib.loads(f"x = {toml_value(value)}")["x"]
        assert isinstance(value, type(read))
        assert (read, math.copysign(1, read)) == (value, math.copysign(1, value))
    assert math.isnan(tomllib.loads(f"x = {toml_value(math.nan)}")["x"])
