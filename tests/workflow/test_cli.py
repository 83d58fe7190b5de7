import io
import shlex
from pathlib import Path

import astropy.units as u
import pytest
from astropy.table import Table
from numpy.testing import assert_array_equal

from miricigale.cli import main
from miricigale.cli.options import declarations, make_parser
from miricigale.detector import Detector
from miricigale.filters.surveys import SURVEYS
from miricigale.instrument import Exposure
from miricigale.psf import InstrumentPSF
from miricigale.reduction import Reducer
from miricigale.scene import Scene
from miricigale.sed import SEDModel
from miricigale.workflow import load_config
from miricigale.workflow.config import preset_names


def test_the_configuration_can_be_printed_and_given_back(capsys, tmp_path):
    assert main(["run", "goodss", "--quick", "--seed", "4", "--print-config"]) == 0
    path = tmp_path / "my.toml"
    path.write_text(capsys.readouterr().out)
    config = load_config(path)
    assert config.run.seed == 4
    assert config.exposures.plan == "quick"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "cosmos"], "no preset 'cosmos'; known: goodss"),
        (["run", "absent.toml"], "no configuration file absent.toml"),
        (["fit", "absent.ecsv"], "no table absent.ecsv"),
        (["data", "add", "nothing", "x"], "no resource 'nothing'; known:"),
        (
            ["photometry", "a.fits", "b.fits", "--filter", "miri.f770w", "--pa-aper", "0"],
            "a.fits cannot be read as an image",
        ),
    ],
)
def test_what_cannot_be_used_is_one_sentence_on_stderr(
    capsys, tmp_path, monkeypatch, arguments, message
):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"miricigale: {message}")
    assert captured.err.count("\n") == 1
    assert "Traceback" not in captured.err


def test_a_catalog_that_is_none_is_refused(capsys, tmp_path):
    (tmp_path / "cat.ecsv").write_text("not a table")
    config = tmp_path / "my.toml"
    config.write_text(f"[catalog]\nsource = '{tmp_path / 'cat.ecsv'}'\n")
    assert main(["run", str(config), "-o", str(tmp_path / "run"), "--no-progress"]) == 2
    assert "cat.ecsv" in capsys.readouterr().err


def test_keys_are_set_on_the_command_line(capsys):
    command = ["run", "goodss", "--print-config", "--seed", "4"]
    for text in (
        "sed.frac_agn=[0.0, 0.4]",
        "exposures.plan=quick",
        "catalog.source='my file.ecsv'",
    ):
        command += ["--set", text]
    assert main(command) == 0
    out = capsys.readouterr().out
    for line in ("frac_agn = [0.0, 0.4]", 'plan = "quick"', 'source = "my file.ecsv"', "seed = 4"):
        assert f"\n{line}\n" in out
    for text, reason in (
        ("frac_agn=0.4", "a setting must be section.key=value"),
        ("sed.frac_agn=2", "must be between 0.0 and 0.99"),
        ("sed.fraction=0.4", "does not know"),
    ):
        assert main(["run", "goodss", "--print-config", "--set", text]) != 0
        assert reason in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[highres]\nfilter = 'nircam.f200w'\n", "[highres] filter: "),
        ("[pointing]\nra = 10.0\n", "[pointing] at RA 10.0"),
        ("[scene]\nbackground_scale = 50.0\n", "the sky fills"),
        ("[catalog]\nmag_limit = 12.0\n", "mag_limit leaves none of the 1308 sources"),
        ("[exposures]\nfilters = ['miri.f560x']\n", "[exposures] filters must be one of"),
        ("[fit]\nbands = ['megacam.x']\ndepths = [25.0]\n", "[fit] bands must be filters that"),
    ],
)
def test_what_would_fail_late_is_refused_at_once(capsys, tmp_path, text, message):
    config = tmp_path / "my.toml"
    config.write_text(text)
    assert main(["run", str(config), "-o", str(tmp_path / "run"), "--no-progress"]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_data_names_licenses_and_checks_sums(capsys, monkeypatch, tmp_path):
    monkeypatch.delenv("MIRICIGALE_DATA", raising=False)
    assert main(["data", "list"]) == 0
    text = capsys.readouterr().out
    assert "ssp.bc03 (bundled)" in text
    assert text.count("license:") == text.count("cite:") > 5
    assert main(["data", "check"]) == 0
    assert "wrong checksum" not in capsys.readouterr().out


def test_filters_are_listed_with_published_pivots(capsys):
    assert main(["filters", "miri.f1500w"]) == 0
    assert "15.06" in capsys.readouterr().out
    assert main(["filters", "nonsense"]) == 1


def test_the_plan_states_the_exposures(capsys):
    assert main(["plan"]) == 0
    text = capsys.readouterr().out
    assert "miri.f2100w" in text
    assert "1665.0" in text
    assert "4662.0" in text


def test_the_plans_own_limits_lie_between_the_calculators_and_those_without_a_residual():
    from miricigale.depth import sensitivity
    from miricigale.planning import plan_table

    row = plan_table()[3]
    assert row["filter"] == "miri.f1500w"
    # the calculator's noise does not fall with dithers as a pattern does; of the proposal's
    # published depth (5 sigma, 23.8 AB) ours is within a quarter of a magnitude
    bare = sensitivity("miri.f1500w", row["time"], n_sigma=5, n_groups=100).to("mag(AB)")
    assert row["limit_etc"] < row["limit"] < bare
    assert row["limit"].value == pytest.approx(23.8, abs=0.25)


def test_help_and_version(capsys):
    assert main([]) == 2
    assert "run a study" in capsys.readouterr().out
    assert main(["--version"]) == 0


def test_every_command_has_two_examples_that_it_can_read():
    declared = declarations()
    parser = make_parser(["--help"])
    for name, command in declared.items():
        if name == "shared":
            continue
        assert len(command["examples"]) == 2
        for example in command["examples"]:
            program, *words = shlex.split(example)
            assert program == "miricigale"
            # exits where options or arguments are none of the command's
            parser.parse_args(words)


def test_help_names_presets_and_surveys(capsys):
    for command, words in (("run", preset_names()), ("fit", SURVEYS)):
        with pytest.raises(SystemExit) as stop:
            main([command, "--help"])
        text = " ".join(capsys.readouterr().out.split())
        assert stop.value.code == 0
        assert ", ".join(words) in text
        assert "examples:" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit"], "miricigale fit: the following arguments are required: CATALOG"),
        (["fitt"], "miricigale: argument COMMAND: invalid choice: 'fitt'"),
        (["plan", "--depth", "x"], "miricigale plan: argument --depth: invalid float value"),
        (["photometry", "a", "b", "--error", "c", "--weight", "d"], "not allowed with argument"),
        (["reduce", "absent_uncal.fits", "-o", "out"], "miricigale: no file absent_uncal.fits"),
        (["show", "absent.fits"], "miricigale: no file absent.fits"),
        (["-v", "-q", "filters"], "not allowed with argument"),
    ],
)
def test_wrong_calls_are_one_sentence_and_status_2(
    capsys, tmp_path, monkeypatch, arguments, message
):
    monkeypatch.chdir(tmp_path)
    try:
        status = main(arguments)
    except SystemExit as stop:
        status = stop.code
    text = capsys.readouterr().err
    assert status == 2
    assert message in text
    assert text.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_quiet_and_verbose_stand_anywhere():
    parser = make_parser([])
    for words in (["-q", "compile"], ["compile", "-q"], ["compile", "--quiet"]):
        assert parser.parse_args(words).quiet
    assert not hasattr(parser.parse_args(["compile"]), "verbose")


def test_plans_of_bands_are_exposed_as_in_ceers(capsys):
    assert main(["plan", "--bands", "f2100w", "F770W", "--print-config"]) == 0
    captured = capsys.readouterr()
    assert 'bands = ["miri.f2100w", "miri.f770w"]' in captured.out
    assert "time = [4662.0, 1665.0]" in captured.out
    assert "exposed as in CEERS: 4662 s, 1665 s" in captured.err
    command = ["plan", "--set", "exposures.pointings=3", "--print-config"]
    assert main(command) == 0
    assert "pointings = 3" in capsys.readouterr().out


def test_products_are_shown_cited_and_have_psfs(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exposure = Exposure("F770W", n_groups=8, pointing="150.1 2.2", subarray="SUB64")
    catalog = {"ra": [150.1], "dec": [2.2], "F770W": [20.0] * u.uJy, "profile": "point"}
    ramp = Detector().expose(Scene(catalog, exposure, background="low"), seed=1)
    ramp.write("a_uncal.fits")
    Reducer().run(ramp).write("mosaic.fits")
    Table({"x": [1, 2]}, meta={"citations": ["Nobody 2030"]}).write("t.ecsv")
    for name, words in (("a_uncal.fits", "Ramp"), ("mosaic.fits", "Image"), ("t.ecsv", "Table")):
        assert main(["show", name]) == 0
        assert f"{name}: " in (text := capsys.readouterr().out)
        assert words in text
        assert Path(f"{name}.png").exists() == (name != "t.ecsv")
    assert main(["cite", "t.ecsv"]) == 0
    assert capsys.readouterr().out == "Nobody 2030\n"
    assert main(["cite"]) == 0
    assert "ApJ 908, 144" in capsys.readouterr().out
    assert main(["psf", "mosaic.fits", "-o", "psf.fits"]) == 0
    # Perrin et al.: 0.269 arcsec, and what drizzling adds
    assert 0.26 < InstrumentPSF.read("psf.fits").fwhm.to_value(u.arcsec) < 0.31
    assert main(["psf", "t.ecsv"]) == 2


def test_a_catalog_comes_from_standard_input(tmp_path, monkeypatch):
    bands = ("miri.f770w", "miri.f1000w", "miri.f1500w")
    table = SEDModel.yang2021().fluxes({"redshift": [1.0, 2.0]}, bands)
    rows = [[v for n in bands for v in (row[n].value, 0.1 * row[n].value)] for row in table]
    theirs = "F770W,F770W_err,f_f1000w,e_f1000w,JWST/MIRI.F1500W,JWST/MIRI.F1500W_err"
    ours = ",".join(f"{name},{name}_err" for name in bands)
    body = "".join(f"{k},{','.join(map(repr, map(float, row)))}\n" for k, row in enumerate(rows))
    text = f"id,{theirs}\n{body}".encode()
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text)))
    (tmp_path / "ours.csv").write_text(f"id,{ours}\n{body}")
    options = ["--axes", "quick", "--flux-unit", "uJy", "--no-progress", "--threads", "1"]
    for path, name in (("-", "fits"), (str(tmp_path / "ours.csv"), "same")):
        assert main(["fit", path, "-o", str(tmp_path / name), *options]) == 0
    assert (tmp_path / "fits-input.csv").read_bytes() == text
    found, same = (Table.read(tmp_path / name / "table.fits") for name in ("fits", "same"))
    for column in ("id", "redshift_p50", "chi2_best"):
        assert_array_equal(found[column], same[column])
