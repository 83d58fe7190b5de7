"""What the commands import before they begin to work."""

import json
import os
import subprocess
import sys

import pytest

import miricigale

HEAVY = ("numba", "photutils", "matplotlib", "scipy.stats", "scipy.signal", "synphot", "sep")
CODE = """
import json, sys
from miricigale.cli import main
try:
    status = main(sys.argv[2:])
except SystemExit as stop:
    status = stop.code
with open(sys.argv[1], "w") as file:
    json.dump({"status": status, "modules": sorted(sys.modules)}, file)
"""


def python(folder, code, *arguments):
    """Run code in a process of its own."""
    env = {**os.environ, "PYTHONPATH": os.path.dirname(os.path.dirname(miricigale.__file__))}
    words = [sys.executable, "-c", code, *arguments]
    subprocess.run(words, cwd=folder, env=env, check=True, capture_output=True, timeout=300)


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (["--version"], 0),
        (["fit", "--help"], 0),
        (["filters", "miri"], 0),
        (["data", "list"], 0),
        (["run", "goodss", "--quick", "--print-config"], 0),
        (["run", "absent.toml"], 2),
        (["run", "wrong.toml"], 2),
        (["run", "source.toml"], 2),
        (["fit", "absent.fits"], 2),
        (["fit", "empty.csv"], 2),
        (["photometry", "a.fits", "b.fits", "--filter", "miri.f770w", "--pa-aper", "0"], 2),
    ],
)
def test_light_commands_and_errors_import_nothing_heavy(tmp_path, arguments, status):
    (tmp_path / "wrong.toml").write_text("[run]\nsede = 1\n")
    (tmp_path / "source.toml").write_text('[catalog]\nsource = "absent.fits"\n')
    (tmp_path / "empty.csv").write_text("id,name\n1,a\n")
    python(tmp_path, CODE, "out.json", *arguments)
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["status"] == status
    assert [name for name in HEAVY if name in found["modules"]] == []


@pytest.mark.parametrize("package", ["fitting", "photometry", "psf", "scene", "sed", "workflow"])
def test_subpackages_import_what_is_asked_for(tmp_path, package):
    """No kernel until it is used; that all names are there is tested with the public names."""
    code = f"import sys, miricigale.{package} as p\nassert 'numba' not in sys.modules"
    python(
        tmp_path, f"{code}\nassert not hasattr(p, 'nothing')\nfrom miricigale.{package} import *"
    )
