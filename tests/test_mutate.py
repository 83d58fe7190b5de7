"""The tool that changes signs and constants reaches every module that makes a number."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOL = ROOT / "tools" / "mutate.py"


@pytest.fixture(scope="module")
def tool():
    if not TOOL.is_file():
        pytest.skip("the installed package has no tools")
    spec = importlib.util.spec_from_file_location("mutate", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def targets(tool):
    return tool.targets()


@pytest.mark.slow
def test_every_module_that_makes_a_number_is_changed(tool, targets):
    package = ROOT / "miricigale"
    changed = {str(path.relative_to(package)) for path in targets}
    # modules whose changes no test noticed while they were no targets
    assert changed >= {
        "photometry/shapes/template_choice.py", "reduction/sky/sky_mesh.py", "reduction/mosaic/mosaic.py",
        "psf/resample.py",
        "instrument/wcs.py", "scene/_core.py", "fitting/posterior/priors.py", "depth/_core.py", "filters/_core.py",
    }  # fmt: skip
    left_out = {str(path.relative_to(package)) for path in package.rglob("*.py")} - changed
    science = ("photometry", "fitting", "sed", "reduction", "scene", "psf", "detector", "depth")
    with_numbers = []
    for name in left_out:
        path = package / name
        is_page = path.name in ("page.py", "browser.py")
        if name.startswith(science) and not is_page and tool.Sites(path.read_text()).found:
            with_numbers.append(name)
    assert with_numbers == []


def test_targets_have_tests_that_are_there(tool, targets):
    for pattern in (*tool.TARGETS, *tool.NO_SCIENCE.split()):
        is_made = pattern == "_version.py"
        assert is_made or list((ROOT / "miricigale").glob(pattern)), pattern
    for path, names in targets.items():
        assert names, path
        for name in names.split():
            place = ROOT / "tests" / name
            assert place.is_dir() or place.with_suffix(".py").is_file(), (path, name)


def test_changes_are_those_of_the_text(tool, tmp_path):
    path = tmp_path / "light.py"
    path.write_text("def f(a, b):\n    return a * b - 0.5 if a < b else -a\n")
    lines = {tool.changed(path, site)[2] for site in tool.Sites(path.read_text()).found}
    assert lines == {
        "return a * b + 0.5 if a < b else -a",
        "return a / b - 0.5 if a < b else -a",
        "return a * b - 0.51 if a < b else -a",
        "return a * b - 0.5 if a <= b else -a",
        "return a * b - 0.5 if a < b else a",
    }
