"""What is said of the package in several files is the same in all of them."""

import configparser
import re
import tomllib
from importlib import resources
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
SETUP = configparser.ConfigParser()
SETUP.read(ROOT / "setup.cfg", encoding="utf-8")
EXTRAS = SETUP["options.extras_require"]


def requirements(text):
    return [Requirement(line) for line in text.split("\n") if line]


def test_oldestdeps_are_the_lower_bounds():
    tox = (ROOT / "tox.ini").read_text(encoding="utf-8")
    pinned = dict(re.findall(r"^ +oldestdeps: ([\w-]+)==(\S+)$", tox, re.MULTILINE))
    bounds = {
        item.name: specifier.version
        for item in requirements(SETUP["options"]["install_requires"] + EXTRAS["test"])
        for specifier in item.specifier
    }
    assert {name: Version(number) for name, number in pinned.items()} == {
        name: Version(number) for name, number in bounds.items()
    }


def test_recipe_requires_what_the_package_requires():
    path = ROOT / "recipe/meta.yaml"
    if not path.is_file():
        pytest.skip("the source archive has no recipe")
    recipe = path.read_text(encoding="utf-8").replace("matplotlib-base", "matplotlib")
    stated = re.findall(r"^    - ([\w-]+) >=([\w.]+)$", recipe.split("  run:\n")[1], re.MULTILINE)
    python = SETUP["options"]["python_requires"].removeprefix(">=")
    wanted = requirements(SETUP["options"]["install_requires"])
    bounds = {item.name: bound.version for item in wanted for bound in item.specifier}
    assert dict(stated) == bounds | {"python": python}
    assert f"license: {SETUP['metadata']['license_expression']}\n" in recipe


def test_the_installed_package_has_every_file_of_the_tree():
    tree, installed = ROOT / "miricigale", resources.files("miricigale")
    files = {path.relative_to(tree) for path in tree.rglob("*") if path.is_file()}
    wanted = {path for path in files if "__pycache__" not in path.parts}
    assert sorted(path for path in wanted if not (installed / path).is_file()) == []


def test_no_module_has_the_name_of_what_it_gives():
    """Attributes of a package are looked up by name: a module of that name hides the function."""
    pattern = re.compile(r"^from \.(\w+) import \1 as", re.MULTILINE)
    stubs = sorted((ROOT / "miricigale").rglob("*.pyi"))
    assert [path for path in stubs if pattern.search(path.read_text(encoding="utf-8"))] == []


def test_extras_are_documented():
    page = (ROOT / "docs/install.rst").read_text(encoding="utf-8")
    documented = dict(re.findall(r"^``(\w+)`` {2,}(.*)$", page, re.MULTILINE))
    assert sorted(documented) == sorted(EXTRAS)


def test_the_extra_all_is_all_that_a_user_may_need():
    """What it does not hold is another package's pipeline, or for those who work on the package."""
    page = (ROOT / "docs/install.rst").read_text(encoding="utf-8")
    documented = dict(re.findall(r"^``(\w+)`` {2,}(.*)$", page, re.MULTILINE))
    names = list(documented)
    (everything,) = requirements(EXTRAS["all"])
    above = names[: names.index("all")]
    assert everything.extras == set(above)
    numbers = {8: "eight", 9: "nine", 10: "ten"}
    assert documented["all"] == f"the {numbers[len(above)]} extras above"
    others = set(EXTRAS) - everything.extras - {"all"}
    assert others == {"jwst", "test", "galsim", "docs", "tools"}
    assert documented["jwst"].endswith("not in ``all``")


def test_each_extra_that_a_message_names_brings_the_package():
    """`require` tells users which extra to install: it has to hold the package that was missing."""
    # asdf-astropy brings asdf, jwst brings crds
    distributions = {"nautilus": "nautilus-sampler", "asdf": "asdf-astropy", "crds": "jwst"}
    call = re.compile(r"""require\(\s*"([\w.]+)",\s*extra="(\w+)\"""")
    asked = set()
    for path in (ROOT / "miricigale").rglob("*.py"):
        asked |= set(call.findall(path.read_text(encoding="utf-8")))
    assert {extra for _, extra in asked} >= {"dask", "gwcs", "parquet", "specutils"}
    missing = []
    for module, extra in sorted(asked):
        package = module.partition(".")[0]
        wanted = distributions.get(package, package)
        held = {item.name for item in requirements(EXTRAS[extra])}
        if wanted not in held:
            missing.append((module, extra))
    assert missing == []


def test_citation_has_the_version_of_the_last_release():
    changes = (ROOT / "CHANGES.rst").read_text(encoding="utf-8")
    released = re.search(r"^(\d\S*) \((\d{4}-\d\d-\d\d)\)$", changes, re.MULTILINE)
    scm = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    version, date = (
        released.groups() if released else (scm["setuptools_scm"]["fallback_version"], None)
    )
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    stated = dict(re.findall(r"^(version|date-released): (\S+)$", citation, re.MULTILINE))
    assert (stated["version"], stated.get("date-released")) == (version, date)


def test_addresses_stand_in_the_metadata_alone():
    """Files that cannot read the metadata say the same, or that nothing is published yet."""
    stated = SETUP["metadata"].get("project_urls", "")
    addresses = dict(re.findall(r"^(\w+) = (\S+)$", stated, re.MULTILINE))
    readme = (ROOT / "README.rst").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    code = re.findall(r"^repository-code: (\S+)$", citation, re.MULTILINE)
    assert code == [addresses["Repository"]] if addresses else code == []
    assert ("not yet published" in readme) == (not addresses)
    assert all(address in readme for address in addresses.values())


def test_readme_shows_the_calls_of_the_front_page():
    """The front page runs as a test."""
    readme = (ROOT / "README.rst").read_text(encoding="utf-8")
    front_page = (ROOT / "docs/index.rst").read_text(encoding="utf-8")
    shown = re.search(r"A galaxy with an AGN.*?(?=A table with a column)", readme, re.DOTALL)[0]
    lines = re.findall(r"^    (\S.*)$", shown, re.MULTILINE)
    assert len(lines) > 10
    for line in lines:
        assert line in front_page, line


def test_supported_versions_of_python_are_tested():
    pattern = r"Programming Language :: Python :: (3\.\d+)$"
    classified = re.findall(pattern, SETUP["metadata"]["classifiers"], re.MULTILINE)
    workflow = ROOT / ".github/workflows/ci.yml"
    if not workflow.is_file():
        pytest.skip("the source archive has no workflow")
    tested = set(re.findall(r'python: "(3\.\d+)", env: py', workflow.read_text(encoding="utf-8")))
    assert tested == set(classified)
    first, last = classified[0], classified[-1]
    for name in ("README.rst", "docs/install.rst", "docs/developers/contributing.rst"):
        assert f"Python {first} to {last}" in (ROOT / name).read_text(encoding="utf-8"), name


def test_commands_that_run_everything_name_folders_by_their_paths():
    # with --pyargs a bare name is that of an installed package, if there is one: gwcs installs its own "docs"
    for name in ("README.rst", "docs/developers/contributing.rst"):
        text = (ROOT / name).read_text(encoding="utf-8")
        folders = re.findall(r"-n 2 --pyargs miricigale ([\w./ ]+\w)", text)
        assert folders == ["./tests ./docs"], name
