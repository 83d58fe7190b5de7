"""What the commands import before they begin to work."""

import json
import os
import subprocess
import sys

import pytest

import miricigale

HEAVY = ("numba", "photutils", "matplotlib", "scipy.stats", "scipy.signal", "synphot", "sep")
#: Commands that work without heavy packages, and those that end with an error before they need any.
LIGHT = [
    "--version",
    "fit --help",
    "filters miri",
    "data list",
    "run goodss --quick --print-config",
]
WRONG = ["run absent.toml", "run wrong.toml", "run source.toml", "fit absent.fits", "fit empty.csv"]
WRONG += ["photometry a.fits b.fits --filter miri.f770w --pa-aper 0"]
CODE = """
import json, sys
from miricigale.cli import main
ends = {}
for command in json.loads(sys.argv[1]):
    try:
        status = main(command.split())
    except SystemExit as stop:
        status = stop.code
    ends[command] = status, sorted(sys.modules)
with open("out.json", "w") as file:
    json.dump(ends, file)
"""


def python(folder, code, *arguments):
    """Run code in a process of its own."""
    env = {**os.environ, "PYTHONPATH": os.path.dirname(os.path.dirname(miricigale.__file__))}
    words = [sys.executable, "-c", code, *arguments]
    subprocess.run(words, cwd=folder, env=env, check=True, capture_output=True, timeout=300)


def test_light_commands_and_errors_import_nothing_heavy(tmp_path):
    """One after the other in a process: the first that imports something heavy is named."""
    (tmp_path / "wrong.toml").write_text("[run]\nsede = 1\n")
    (tmp_path / "source.toml").write_text('[catalog]\nsource = "absent.fits"\n')
    (tmp_path / "empty.csv").write_text("id,name\n1,a\n")
    python(tmp_path, CODE, json.dumps(LIGHT + WRONG))
    ends = json.loads((tmp_path / "out.json").read_text())
    for command, (status, modules) in ends.items():
        assert status == (2 if command in WRONG else 0), command
        assert [name for name in HEAVY if name in modules] == [], command
    assert list(ends) == LIGHT + WRONG


def test_the_package_itself_imports_no_numpy(tmp_path):
    python(tmp_path, "import sys, miricigale; assert 'numpy' not in sys.modules")


#: First all subpackages, one after the other: the first that imports a kernel is named. Then all of their names.
SUBPACKAGES = """
import importlib, sys
packages = {}
for name in ("fitting", "photometry", "psf", "scene", "sed", "workflow"):
    packages[name] = importlib.import_module(f"miricigale.{name}")
    assert "numba" not in sys.modules, name
for name, package in packages.items():
    assert not hasattr(package, "nothing"), name
    exec(f"from miricigale.{name} import *")
"""


@pytest.mark.slow
def test_subpackages_import_what_is_asked_for(tmp_path):
    """No kernel until it is used; that all names are there is tested with the public names."""
    python(tmp_path, SUBPACKAGES)
