import subprocess
import sys

import pytest

from miricigale.cli import main
from miricigale.workflow import load_config


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
    command = ["run", "goodss", "--print-config", "--set", "sed.frac_agn=[0.0, 0.4]"]
    command += [
        "--set",
        "exposures.plan=quick",
        "--set",
        "catalog.source='my file.ecsv'",
        "--seed",
        "4",
    ]
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


def test_an_empty_sample_is_refused(capsys, tmp_path):
    config = tmp_path / "my.toml"
    config.write_text("[catalog]\nmag_limit = 12.0\n")
    assert main(["run", str(config), "-o", str(tmp_path / "run"), "--no-progress"]) == 2
    assert "mag_limit leaves none of the 1308 sources" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[highres]\nfilter = 'nircam.f200w'\n", "[highres] filter: "),
        ("[pointing]\nra = 10.0\n", "[pointing] at RA 10.0"),
        ("[scene]\nbackground_scale = 50.0\n", "the sky fills"),
        (
            "[exposures]\nfilters = ['miri.f560x', 'miri.f770w']\n",
            "[exposures] filters must be filters out of",
        ),
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


def test_importing_the_package_opens_nothing_heavy():
    code = (
        "import sys, miricigale; "
        "print([m for m in ('numba', 'scipy', 'photutils', 'matplotlib', 'synphot') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
