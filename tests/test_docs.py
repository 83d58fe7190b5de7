"""Pages are short and show something, and the scripts of the gallery run and draw."""

import importlib
import inspect
import itertools
import re
import runpy
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from miricigale.fitting.grid import model_tables
from miricigale.fitting.grid.part_tables import MAX_MODELS, TOLERANCE, PartAxes
from miricigale.sed import presets

DOCS = Path(__file__).parents[1] / "docs"
BUILT = {"_build", "changes", "how_to", "tutorials", "api", "sg_execution_times.rst"}
PAGES = [
    path
    for path in sorted(DOCS.rglob("*.rst"))
    if not BUILT.intersection(path.relative_to(DOCS).parts)
]
EXAMPLES = DOCS / "examples"
SCRIPTS = sorted(EXAMPLES.rglob("*.py"))
#: Numbers of scripts that take long, and smaller ones, with which the test makes the same calls.
SMALLER = {
    "how_to/fit/galaxy_quasar_star": {"n = 20": "n = 6"},
    "how_to/fit/large_catalog": {"n = 60": "n = 16", '"chunk_rows": 15': '"chunk_rows": 4'},
    "how_to/fit/mock_analysis": {"[bright][:36]": "[bright][:12]"},
    "how_to/fit/model_errors": {"n = 120": "n = 24"},
    "how_to/fit/photometric_redshifts": {"[:220]": "[:130]"},
    "how_to/measure/image_offsets": {"size=50 ": "size=36 "},
    "how_to/measure/large_mosaic": {"size=30 ": "size=18 ", "patch_size=300": "patch_size=180"},
    "how_to/run/agn_classes": {"n = 150": "n = 50"},
    "how_to/run/cluster": {"n = 60": "n = 20"},
    "how_to/run/compare_with_truth": {"n = 100": "n = 30", "size=20 ": "size=16 "},
    "tutorials/agn_from_images": {
        "width = 45 ": "width = 27 ",
        "n_injections=24": "n_injections=8",
        "calibrate=False": "calibrate=False, interpolate=60",
    },
    "tutorials/by_hand": {"n_groups=60, n_integrations=2": "n_groups=20, n_integrations=1"},
    "tutorials/large_catalogs": {"n = 240": "n = 80", "chunk_rows=60": "chunk_rows=20"},
}
ALL_AXES = presets._values
SUBPACKAGES = ("filters", "sed", "scene", "detector", "reduction", "photometry", "fitting")


def name_of(path):
    return str(path.relative_to(DOCS).with_suffix(""))


def code_of(text):
    """Lines of code of a page: of its blocks and prompts, without their indentation."""
    indent, options = None, False
    for line in text.split("\n"):
        bare = line.lstrip()
        if indent is not None and bare and len(line) - len(bare) <= indent:
            indent = None
        # options of a directive end at an empty line
        options = options and bool(bare)
        if (indent is not None and not options) or bare.startswith((">>> ", "... ")):
            yield bare
        # text of a list stands beside its number
        bare = re.sub(r"^(\d+\.|[-*]) ", "", bare)
        is_block = re.match(r"\.\. (code-block|plot|doctest)::", bare)
        if indent is None and (is_block or (bare.endswith("::") and not bare.startswith(".."))):
            indent, options = len(line) - len(bare), True


def few_redshifts(name):
    """Axes of a preset, with every fourth of many redshifts."""
    axes = ALL_AXES(name)
    if len(axes.get("redshift", ())) > 40:
        axes["redshift"] = axes["redshift"][::4]
    return axes


def coarse_part(axes, evaluate, refuses, n=MAX_MODELS, tolerance=TOLERANCE, powers=None):
    """A table of models with ten times the error between its nodes."""
    return PartAxes(axes, evaluate, refuses, n, 10 * tolerance, powers)


@pytest.mark.slow
@pytest.mark.pictures
@pytest.mark.parametrize("path", SCRIPTS, ids=name_of)
def test_example_runs_and_draws(path, tmp_path, monkeypatch):
    """With the calls of the page, where these take long of fewer sources, and of fewer models."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(plt, "show", lambda: None)
    monkeypatch.setattr(model_tables, "REDSHIFT_STEP", 0.05)
    monkeypatch.setattr(model_tables, "PartAxes", coarse_part)
    monkeypatch.setattr(presets, "_values", few_redshifts)
    text = path.read_text(encoding="utf-8")
    for number, smaller in SMALLER.get(str(path.relative_to(EXAMPLES).with_suffix("")), {}).items():
        assert number in text
        text = text.replace(number, smaller)
    script = tmp_path / path.name
    script.write_text(text, encoding="utf-8")
    before = set(plt.get_fignums())
    try:
        runpy.run_path(str(script), run_name="__main__")
        drawn = set(plt.get_fignums()) - before
    finally:
        plt.close("all")
    assert drawn
    lines = path.read_text(encoding="utf-8").split("\n")
    assert len(lines) <= 250
    code = [line for line in lines if not line.startswith("#")]
    assert max(map(len, code[code.index('"""', 1) :])) <= 84


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_page_is_short_and_prints_no_truth_values(path):
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= 250
    assert [line for line in code_of(text) if len(line) > 84] == []
    prompts = re.findall(r"^ *>>> .*\n(?: *\.\.\. .*\n)*( *(?:True|False)\n)", text, re.MULTILINE)
    assert prompts == []


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_text_of_tables_stays_out_of_the_margins_of_columns(path):
    # docutils draws no table where it does not
    margins = []
    lines = path.read_text(encoding="utf-8").split("\n")
    for line, following in itertools.pairwise(lines):
        if re.fullmatch(r" *=+( +=+)+", line):
            margins = [match.start() for match in re.finditer(r"(?<==) ", line)]
            continue
        # a table ends at an empty line after a rule
        if not line.strip():
            margins = []
        # a heading of several columns has a line of its own below
        if re.fullmatch(r" *-+( +-+)+", line) or re.fullmatch(r" *-+( +-+)+", following):
            continue
        assert [line for k in margins if line[k : k + 1].strip()] == []


def test_scripts_with_smaller_numbers_are_those_of_the_gallery():
    assert SMALLER.keys() <= {name_of(path).removeprefix("examples/") for path in SCRIPTS}


def test_scripts_of_the_gallery_have_different_names():
    stems = [path.stem for path in SCRIPTS]
    assert len(set(stems)) == len(stems)


@pytest.mark.parametrize("path", sorted((DOCS / "method").rglob("*.rst")), ids=name_of)
def test_page_of_a_method_has_a_figure(path):
    text = path.read_text(encoding="utf-8")
    assert re.search(r"^ *\.\. (plot|figure|image|sed-component)::", text, re.MULTILINE)


@pytest.mark.parametrize("name", SUBPACKAGES)
def test_public_objects_have_examples(name):
    package = importlib.import_module(f"miricigale.{name}")
    objects = {label: getattr(package, label) for label in package.__all__}
    documented = {k: v for k, v in objects.items() if inspect.isclass(v) or inspect.isroutine(v)}
    without = [k for k, v in documented.items() if ">>>" not in (inspect.getdoc(v) or "")]
    assert without == []
