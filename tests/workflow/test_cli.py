import inspect
import io
import re
import shlex
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_array_equal

from helpers.commands import command
from helpers.errors import refuses
from miricigale.agn import AGNSurvey
from miricigale.cli import main
from miricigale.cli.exposures import reducer_of
from miricigale.cli.options import declarations, destination, make_parser, workers
from miricigale.detector import Detector
from miricigale.filters.surveys import SURVEYS
from miricigale.fitting import fit_catalog
from miricigale.injection import Injection
from miricigale.instrument import Exposure
from miricigale.photometry import image_errors, measure_files
from miricigale.psf import InstrumentPSF
from miricigale.reduction import Reducer, reduce_files
from miricigale.scene import Scene
from miricigale.sed import SEDModel
from miricigale.workflow import load_config, measure_patches
from miricigale.workflow.config import preset_names

SETTINGS = ("--filter", "miri.f770w", "--pa-aper", "0")


def test_the_configuration_can_be_printed_and_given_back(capsys, tmp_path):
    path = tmp_path / "my.toml"
    words = ("run", "goodss", "--quick", "--seed", "4", "--print-config")
    path.write_text(command(capsys, *words).out)
    config = load_config(path)
    assert config.run.seed == 4
    assert config.exposures.plan == "quick"


def test_keys_are_set_on_the_command_line(capsys):
    words = ["run", "goodss", "--print-config"]
    values = ("sed.frac_agn=[0.0, 0.4]", "exposures.plan=quick", "catalog.source='my file.ecsv'")
    settings = [word for text in values for word in ("--set", text)]
    out = command(capsys, *words, "--seed", "4", *settings).out
    for line in ("frac_agn = [0.0, 0.4]", 'plan = "quick"', 'source = "my file.ecsv"', "seed = 4"):
        assert f"\n{line}\n" in out
    for text, reason in (
        ("frac_agn=0.4", "a setting must be section.key=value"),
        ("sed.frac_agn=2", "must be between 0.0 and 0.99"),
        ("sed.fraction=0.4", "does not know"),
    ):
        assert reason in command(capsys, *words, "--set", text, status=2).err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[highres]\nfilter = 'nircam.f200w'\n", "[highres] filter: "),
        ("[pointing]\nra = 10.0\n", "[pointing] at RA 10.0"),
        ("[scene]\nbackground_scale = 50.0\n", "the sky fills"),
        ("[catalog]\nmag_limit = 12.0\n", "mag_limit leaves none of the 1308 sources"),
        ("[exposures]\nfilters = ['miri.f560x']\n", "[exposures] filters must be one of"),
        ("[fit]\nbands = ['megacam.x']\ndepths = [25.0]\n", "[fit] bands must be filters that"),
        ("[catalog]\nsource = 'cat.ecsv'\n", "cat.ecsv"),
    ],
)
def test_what_would_fail_late_is_refused_at_once(capsys, tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    Path("cat.ecsv").write_text("not a table")
    Path("my.toml").write_text(text)
    told = command(capsys, "run", "my.toml", "-o", "run", "--no-progress", status=2)
    assert message in told.err
    assert not Path("run").exists()


def test_data_names_licenses_and_checks_sums(capsys, monkeypatch, tmp_path):
    monkeypatch.delenv("MIRICIGALE_DATA", raising=False)
    text = command(capsys, "data", "list").out
    assert "ssp.bc03 (bundled)" in text
    assert text.count("license:") == text.count("cite:") > 5
    assert "wrong checksum" not in command(capsys, "data", "check").out


@pytest.mark.slow
def test_filters_and_exposures_are_listed(capsys):
    # a published pivot, and times of the survey
    assert "15.06" in command(capsys, "filters", "miri.f1500w").out
    rows = command(capsys, "filters", "F1500W", "F770W", "miri.f770w").out.splitlines()
    assert [row.split()[0] for row in rows[-2:]] == ["miri.f770w", "miri.f1500w"]
    command(capsys, "filters", "nonsense", status=1)
    text = command(capsys, "plan").out
    assert all(word in text for word in ("miri.f2100w", "1665.0", "4662.0"))


def test_depths_of_exposures_are_those_of_the_function(capsys):
    """Of the same frames; a brighter sky is shallower, and nothing is fitted."""
    from miricigale.depth import sensitivity

    words = ("depth", "F770W,F1500W", "--time", "1h", "--dithers", "8")
    lines = command(capsys, *words).out.splitlines()
    names = lines[0].split()
    rows = [dict(zip(names, line.split(), strict=True)) for line in lines[3:]]
    assert [row["filter"] for row in rows] == ["miri.f770w", "miri.f1500w"]
    for row in rows:
        time = float(row["time"]) * u.s
        assert abs(time - 1 * u.hour) < 60 * u.s
        frames = {"n_groups": int(row["groups"]), "n_dithers": int(row["dithers"])}
        limit = sensitivity(row["filter"], time, **frames).to_value("mag(AB)")
        assert float(row["limit"]) == pytest.approx(limit, abs=0.0051)
        assert float(row["saturation"]) < float(row["limit_etc"]) < float(row["limit"])
    bright = command(capsys, *words, "--background", "high").out.splitlines()[3].split()
    assert float(bright[names.index("limit")]) < float(rows[0]["limit"])
    # the other way around: the exposure that reaches a limit
    reached = command(capsys, "depth", "F1500W", "--depth", "24").out.splitlines()[3].split()
    assert float(reached[names.index("limit")]) == pytest.approx(24.0, abs=0.03)
    text = command(capsys, "depth", "F1500W", "--depth", "24", "--time", "1h", status=2).err
    assert "wanted are --time or --depth, not both" in text
    # without options those of CEERS, as of plan
    assert command(capsys, "depth").out == command(capsys, "plan").out


def test_the_plans_own_limits_lie_between_the_calculators_and_those_without_a_residual():
    from miricigale.depth import sensitivity
    from miricigale.planning import plan_table

    row = plan_table()[3]
    assert row["filter"] == "miri.f1500w"
    # the table, the function and the errors of plans have one formula; of the proposal's published depth
    # (5 sigma, 23.8 AB) it is within 0.15 mag
    same = sensitivity("miri.f1500w", row["time"], n_groups=row["groups"], n_dithers=row["dithers"])
    assert row["limit"].value == pytest.approx(same.to_value("mag(AB)"), abs=0.0051)
    assert row["limit_etc"] < row["limit"]
    assert row["limit"].value == pytest.approx(23.8, abs=0.15)


def test_help_and_version(capsys):
    assert "run a study" in command(capsys, status=2).out
    command(capsys, "--version")


def test_every_command_has_two_examples_that_it_can_read():
    parser = make_parser(["--help"])
    for name, declared in declarations().items():
        if name == "shared":
            continue
        assert len(declared["examples"]) >= 2
        for example in declared["examples"]:
            program, *words = shlex.split(example)
            assert program == "miricigale"
            # exits where options or arguments are none of the command's
            parser.parse_args(words)


def test_help_has_options_in_groups(capsys):
    refuses("^0$", main, ["photometry", "--help"], error=SystemExit)
    text = capsys.readouterr().out
    titles = re.findall(r"^(\S.*):$", text, re.MULTILINE)
    assert len(titles) == len(set(titles)) >= 8
    # each option is in the group that its heading begins
    assert text.index("PSFs and kernel:") < text.index("--kernel FITS  ") < text.index("the fit:")


def test_help_states_the_defaults_of_what_options_fill():
    """Defaults are declared once, by functions; the numbers in the help texts are these."""
    filled = {
        "fit": (fit_catalog,),
        "agn": (AGNSurvey,),
        "photometry": (measure_files, measure_patches),
        "errors": (image_errors,),
        "reduce": (Reducer, reduce_files),
        "inject": (Injection,),
    }
    n_stated = 0
    for command_name, functions in filled.items():
        defaults = {}
        for function in functions:
            for name, parameter in inspect.signature(function).parameters.items():
                defaults[name] = getattr(parameter.default, "value", parameter.default)
        defaults |= {"redshift_bins": defaults.get("redshift")}
        # a setting whose default is that of the instrument
        defaults["pixel_scale"] = Reducer().mosaic_scale().value
        for flags, option in declarations()[command_name]["options"].items():
            stated = re.search(r"\(([\d.]+(?: [\d.]+)*)\)", option["help"])
            if stated and "default" not in option:
                default = np.ravel(defaults[destination(flags, option)])
                assert_array_equal(np.array(stated[1].split(), float), default)
                n_stated += 1
    assert n_stated >= 14


def test_help_names_presets_and_surveys(capsys):
    for name, words in (("run", preset_names()), ("fit", SURVEYS)):
        refuses("^0$", main, [name, "--help"], error=SystemExit)
        text = " ".join(capsys.readouterr().out.split())
        assert ", ".join(words) in text
        assert "examples:" in text


@pytest.mark.parametrize(
    ("arguments", "taken", "message"),
    [
        (["plan", "--filters", "F77W"], "plan: --filters is taken as --bands", "'F77W'"),
        (["fit", "no.fits", "--ncores=4"], "fit: --ncores is taken as --threads", "no such file"),
        (["fit", "no.fits", "--model", "survy"], "fit: --model is taken as --axes", "'survey'"),
        (["fit", "no.fits", "--units", "Jy"], "--units is taken as --flux-unit", "no such file"),
        (["photometry", "a", "--prior", "b", *SETTINGS], "--prior is taken as --highres", "a can"),
    ],
)
def test_options_of_other_names_are_taken(capsys, tmp_path, monkeypatch, arguments, taken, message):
    monkeypatch.chdir(tmp_path)
    try:
        status = main(arguments)
    except SystemExit as err:
        status = err.code
    assert status == 2
    first, second = capsys.readouterr().err.strip().splitlines()[:2]
    assert taken in first
    assert message in second


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "cosmos"], "miricigale: no preset 'cosmos'; known: cosmosweb, goodss"),
        (["run", "absent.toml"], "miricigale: no configuration file absent.toml"),
        (["fit", "absent.ecsv"], "miricigale: absent.ecsv cannot be read as a catalog: no such"),
        (["data", "add", "nothing", "x"], "miricigale: no library 'nothing'; known:"),
        (["photometry", "a", "b", *SETTINGS], "miricigale: a cannot be read as an image"),
        (["fit"], "miricigale fit: the following arguments are required: CATALOG"),
        (["fitt"], "miricigale: argument COMMAND: invalid choice: 'fitt'"),
        (["fitt"], "; did you mean 'fit'? (see miricigale --help)"),
        (["fit", "a.fits", "--flux-unti", "Jy"], "did you mean '--flux-unit'? (see miricigale fit"),
        (["fit", "--catalog", "a.fits"], "CATALOG has no option before it"),
        (["fit", "a.fits", "--unit", "Jy"], "did you mean '--flux-unit'?"),
        (["help", "fit"], "did you mean '--help'?"),
        (["measure", "a"], "did you mean 'photometry'?"),
        (["simulate", "a"], "; Scene and Detector simulate exposures in Python, 'run' a whole"),
        (
            ["fit", "a.fits", "--zmax", "4"],
            "--zmax 4; the grid has the redshifts; BayesFitter(axes=",
        ),
        (["fit", "a.fits", "--zzz", "4"], "--zzz 4 (see miricigale fit --help)"),
        (["photometry", "a.fits"], "give the images and, last, the high-resolution image"),
        (["sensitivity", "F770W"], "did you mean 'depth'?"),
        (
            ["depth", "F770W", "--bands", "F1000W"],
            "--bands must be left out beside bands without it",
        ),
        (["depth", "F444W"], "no imaging filter 'F444W'"),
        (["depth", "F1500W", "3600"], "must be names of filters (a time is --time 3600, a magn"),
        (["fit", "a.fits", "--interp", "9"], "--interp 9; did you mean '--interpolate'?"),
        (
            ["run", "goodss", "--quick", "--plan", "--until", "mosaic"],
            "--until is 'mosaic', which is no",
        ),
        (["plan", "--depth", "x"], "miricigale plan: argument --depth: invalid float value"),
        (["photometry", "a", "b", "--error", "c", "--weight", "d"], "must be at most one of them"),
        (["reduce", "absent_uncal.fits", "-o", "out"], "miricigale: no file absent_uncal.fits"),
        (["show", "absent.fits"], "miricigale: no file absent.fits"),
        (["show", "."], "has no files of products (.fits, "),
        (["reduce", ".", "-o", "x"], "is a folder, wanted is a file"),
        (["run", "."], "is a folder without a config.toml, wanted is a preset or a configuration"),
        (["sed", "--redshift", "1"], "; SEDModel.yang2021().evaluate(redshift=1.5"),
        (["compare", "a", "b"], "; miricigale.evaluation.photoz_metrics("),
        (["agn-counts"], "did you mean 'agn'?"),
        (["fit", "a.fits", "--columns", "z"], "did you mean '--map'?"),
        (["calibrate", "c.fits"], "'--calibrate COLUMN' with known redshifts"),
        (["convert", "a", "b"], "Table.read(FILE).write(OTHER) in Python"),
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
    assert "Traceback" not in text
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words", ["fit cat", "agn cat", "reduce x.fits", "inject x.fits", "plan", "run goodss"]
)
@pytest.mark.parametrize("name", ["out.fits", "my.v2.FITS.gz", "taken"])
def test_folders_that_are_written_have_no_names_of_files(
    capsys, tmp_path, monkeypatch, words, name
):
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("a file")
    with pytest.raises(SystemExit) as end:
        main([*words.split(), "-o", name])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert "-o/--output: must be a folder" in error
    assert name in error
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_folders_have_defaults():
    for words, folder in (("reduce x", "reduced"), ("inject x", "injected")):
        parser = make_parser(words.split())
        assert parser.parse_args(words.split()).folder == Path(folder)


def test_folders_may_have_dots_in_their_names_and_stand_already(tmp_path):
    (tmp_path / "old.fits").mkdir()
    for name in ("out.v1.5", "old.fits"):
        args = make_parser(["fit"]).parse_args(["fit", "cat", "-o", str(tmp_path / name)])
        assert args.output == tmp_path / name


def test_quiet_and_verbose_stand_anywhere():
    parser = make_parser([])
    for words in (["-q", "compile"], ["compile", "-q"], ["compile", "--quiet"]):
        assert parser.parse_args(words).quiet
    assert not hasattr(parser.parse_args(["compile"]), "verbose")


def test_plans_of_bands_are_exposed_as_in_ceers(capsys):
    told = command(capsys, "plan", "--bands", "f2100w", "F770W", "--print-config")
    assert 'bands = ["miri.f2100w", "miri.f770w"]' in told.out
    assert "time = [4662.0, 1665.0]" in told.out
    assert "exposed as in CEERS: 4662 s, 1665 s" in told.err
    told = command(capsys, "plan", "--set", "exposures.pointings=3", "--print-config")
    assert "pointings = 3" in told.out
    # sets alone name the bands
    told = command(capsys, "plan", "--sets", "F770W,F2100W", "f770w", "--print-config")
    assert 'bands = ["miri.f770w", "miri.f2100w"]' in told.out
    told = command(capsys, "plan", "--sets", "all", "F770W", "--print-config")
    assert "miri.f1280w" in told.out


def test_bands_of_a_plan_need_no_option(capsys):
    told = command(capsys, "plan", "f770w", "F2100W", "--time", "60", "--print-config")
    assert 'bands = ["miri.f770w", "miri.f2100w"]' in told.out
    arguments = ("plan", "f770w", "--bands", "F2100W", "--print-config")
    assert "--bands must be left out beside" in command(capsys, *arguments, status=2).err


def test_options_with_a_unit_take_others(capsys):
    told = command(capsys, "plan", "--bands", "F770W", "--time", "2h", "--print-config")
    assert "time = [7200.0]" in told.out
    told = command(capsys, "plan", "--bands", "F770W", "--hours", "90 min", "--print-config")
    assert "hours = 1.5" in told.out
    args = make_parser(["reduce"]).parse_args(["reduce", "x", "-o", "y", "--pixel-scale", "60mas"])
    assert args.pixel_scale == 0.06 * u.arcsec
    with pytest.raises(SystemExit):
        main(["plan", "--time", "2um"])
    assert (
        "--time: must be a number in s, or with another unit, got '2um'" in capsys.readouterr().err
    )


@pytest.mark.slow
def test_products_are_shown_cited_and_have_psfs(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exposure = Exposure("F770W", n_groups=8, pointing="150.1 2.2", subarray="SUB64")
    catalog = {"ra": [150.1], "dec": [2.2], "F770W": [20.0] * u.uJy, "profile": "point"}
    ramp = Detector().expose(Scene(catalog, exposure, background="low"), seed=1)
    ramp.write("a_uncal.fits")
    Reducer().run(ramp).write("mosaic.fits")
    Table({"x": [1, 2]}, meta={"citations": ["Nobody 2030"]}).write("t.ecsv")
    for name, words in (("a_uncal.fits", "Ramp"), ("mosaic.fits", "Image"), ("t.ecsv", "Table")):
        text = command(capsys, "show", name).out
        assert f"{name}: " in text
        assert words in text
        # nothing is written unasked
        assert not Path(f"{name}.png").exists()
    command(capsys, "show", "mosaic.fits", "--picture")
    assert Path("mosaic.fits.png").read_bytes().startswith(b"\x89PNG")
    told = command(capsys, "show", "t.ecsv", "--picture", status=2).err
    assert "--picture must be left out for what has no picture" in told
    # a picture that is there stays
    Path("mine.png").write_text("mine")
    told = command(capsys, "show", "mosaic.fits", "--picture", "mine.png", status=2).err
    assert "--picture must be a new file (or --overwrite given)" in told
    assert Path("mine.png").read_text() == "mine"
    command(capsys, "show", "mosaic.fits", "--picture", "mine.png", "--overwrite")
    assert Path("mine.png").read_bytes().startswith(b"\x89PNG")
    # a folder: its products, one line each
    lines = command(capsys, "show", ".").out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["a_uncal.fits", "mosaic.fits", "t.ecsv"]
    assert lines[0].startswith("a_uncal.fits: Ramp, ")
    assert lines[2] == "t.ecsv: QTable, 2 rows, 1 columns"
    told = command(capsys, "show", ".", "--picture", status=2).err
    assert "--picture must be left out for a folder" in told
    assert command(capsys, "cite", "t.ecsv").out == "Nobody 2030\n"
    assert "ApJ 908, 144" in command(capsys, "cite").out
    # a folder names all of its products, BibTeX each once
    assert "Nobody 2030" in command(capsys, "cite", ".").out.splitlines()
    entry = command(capsys, "cite", "t.ecsv", "--bibtex").out
    assert (
        entry
        == "@misc{nobody2030,\n  author = {Nobody},\n  year = {2030},\n  note = {Nobody 2030}\n}\n"
    )
    command(capsys, "psf", "mosaic.fits", "-o", "psf.fits")
    # Perrin et al.: 0.269 arcsec, and what drizzling adds
    assert 0.26 < InstrumentPSF.read("psf.fits").fwhm.to_value(u.arcsec) < 0.31
    command(capsys, "psf", "t.ecsv", status=2)
    # a filter stands for a single exposure
    command(capsys, "psf", "F770W", "-o", "exposure.fits")
    assert InstrumentPSF.read("exposure.fits").frame == "detector"
    assert (
        "--pa-aper must be left out"
        in command(capsys, "psf", "F770W", "--pa-aper", "3", status=2).err
    )


@pytest.mark.slow
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
    options = ["--axes", "yang2021-quick", "--flux-unit", "uJy", "--no-progress", "--threads", "1"]
    for path, name in (("-", "fits"), (str(tmp_path / "ours.csv"), "same")):
        assert main(["fit", path, "-o", str(tmp_path / name), *options]) == 0
    assert (tmp_path / "fits-input.csv").read_bytes() == text
    found, same = (Table.read(tmp_path / name / "table.fits") for name in ("fits", "same"))
    for column in ("id", "redshift_p50", "chi2_best"):
        assert_array_equal(found[column], same[column])


def test_options_of_a_reduction_fill_its_settings():
    """Each goes to the field of its name, whichever settings have it."""
    words = "reduce a.fits -o out --stripes --sky-flat 3 --skip-first 2 --jump-threshold 0"
    argv = [*words.split(), "--references", "none", "--background", "sep"]
    reducer = reducer_of(make_parser(argv).parse_args(argv))
    assert (reducer.background.method, reducer.background.stripes) == ("sep", True)
    assert reducer.background.sky_flat == 3.0
    assert (reducer.skip_first, reducer.jump_threshold, reducer.references) == (2, None, "none")


def test_a_reader_that_leaves_ends_a_command_quietly():
    command = [sys.executable, "-m", "miricigale", "filters"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        # before anything is written
        process.stdout.close()
        message = process.stderr.read()
    assert process.returncode == 128 + signal.SIGPIPE
    assert message == b""


def test_a_command_on_one_thread_starts_no_other_process():
    with workers(None, 1) as executor:
        assert executor is None
    with workers(None, 2) as executor:
        assert isinstance(executor, ProcessPoolExecutor)
