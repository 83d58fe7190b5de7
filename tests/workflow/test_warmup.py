"""Compiling ahead: what is compiled, that it is enough, and what happens where it cannot be kept."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import miricigale
from miricigale.workflow import warmup

ROOT = Path(miricigale.__file__).parent.parent

#: The signatures of every kernel of the package that has code.
KERNELS = """
import sys
from numba.core.dispatcher import Dispatcher
def kernels(subpackage):
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith(f"miricigale.{subpackage}"):
            for key, value in vars(module).items():
                if isinstance(value, Dispatcher) and value.py_func.__module__ == name:
                    found[f"{name}.{key}"] = [str(one) for one in value.signatures]
    return found
"""
FIT = "from miricigale.workflow import warmup\nwarmup.compile_job('fit')"
APART = "from miricigale.workflow.warmup import compile_apart\ncompile_apart('images')"
REAL = """
import astropy.units as u
from astropy.table import QTable
from miricigale.fitting import BayesFitter
from miricigale.sed import SEDModel
names = ["acs.f606w", "acs.f814w", "wfc3.f160w", "irac.ch2", "miri.f1000w", "mips.24"]
table = QTable({"id": ["a", "b", "c"]})
for k, name in enumerate(names):
    table[name] = [1.0 + k, 2.0, 0.1] * u.uJy
    table[f"{name}_err"] = [0.1, 0.2, 0.3] * u.uJy
fitter = BayesFitter(SEDModel.yang2021(), names, axes=SEDModel.yang2021_axes("quick"))
fitter.fit(table)
axes = {name: values[:2] for name, values in SEDModel.yang2021_axes("quick").items()}
BayesFitter(SEDModel.yang2021().grid(axes, names)).fit(table)
SEDModel.yang2021().evaluate(redshift=1.0, frac_agn=0.3)
"""


def with_cache(cache):
    """The environment of a process with a cache of its own."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(cache)}


def python(code, folder, environment=None):
    """Run code in a process of its own, by default with the cache of the tests."""
    command = [sys.executable, "-W", "error::RuntimeWarning", "-c", KERNELS + code]
    options = {"capture_output": True, "text": True, "timeout": 900, "check": False}
    environment = environment or {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_fit_after_its_job_compiles_nothing(tmp_path):
    """What fits of a model and of a grid call the job has called: one signature of each kernel, none of limits."""
    shown = "\nimport json\nprint(json.dumps(kernels('fitting') | kernels('sed')))"
    of_job, of_fit = (
        json.loads(python(code + shown, tmp_path).splitlines()[-1]) for code in (FIT, REAL)
    )
    missing = {name for name, signatures in of_fit.items() if set(signatures) - {*of_job[name]}}
    assert missing == set()
    assert {name for name, signatures in of_fit.items() if len(signatures) > 1} == set()
    called = [name for name, signatures in of_fit.items() if signatures]
    assert len(called) > 10
    of_limits = [name for name in of_fit if "_core.limit" in name]
    assert len(of_limits) > 5
    assert [name for name in of_limits if of_fit[name]] == []


def test_what_is_compiled_is_known(tmp_path, monkeypatch):
    """A job of which the kernels are on disk, until somebody empties the cache."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    code = tmp_path / "kernel.nbi"
    monkeypatch.setitem(warmup.JOBS, "fit", (code.touch, "a job that keeps one kernel", 1))
    assert not warmup.is_compiled("fit")
    assert warmup.compile_job("fit")
    assert warmup.is_compiled("fit")
    assert not warmup.is_compiled("photometry")
    code.unlink()
    assert not warmup.is_compiled("fit")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_compilation_imports_nothing_of_the_folder_and_ends_with_the_process_that_asked(tmp_path):
    (tmp_path / "platform.py").write_text("import os\nopen('ran', 'w')\nos._exit(0)\n")
    command, env = [sys.executable, "-P", "-c", APART], with_cache(tmp_path / "cache")
    parent = subprocess.Popen(command, env=env, cwd=tmp_path)
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    # the first kernel is kept long after all imports, and long before the last
    while parent.poll() is None and not list(tmp_path.glob("cache/*/*.nbi")):
        time.sleep(0.1)
    assert not (tmp_path / "ran").exists()
    (child,) = children.read_text().split()
    parent.kill()
    parent.wait(timeout=60)
    deadline = time.monotonic() + 60
    while Path(f"/proc/{child}/cmdline").exists() and time.monotonic() < deadline:
        # a process that ended but was not waited for has no command line
        if not Path(f"/proc/{child}/cmdline").read_bytes():
            break
        time.sleep(0.05)
    else:
        assert not Path(f"/proc/{child}").exists()


def test_what_is_missing_is_compiled_and_said(monkeypatch, caplog):
    caplog.set_level("INFO", logger="miricigale.utils.compilation")
    done = []
    monkeypatch.setattr(warmup, "is_compiled", lambda name: name == "images")
    monkeypatch.setattr(warmup, "compile_apart", lambda name: done.append(name) or name == "fit")
    # one is not kept
    assert not warmup.compile_missing(2)
    assert sorted(done) == ["fit", "photometry"]
    told = [line.split(",")[0] for line in caplog.messages]
    assert told == ["compiling model spectra and their fit", "compiling photometry"]
    monkeypatch.setattr(warmup, "is_compiled", lambda name: True)
    assert warmup.compile_missing(2)
    assert len(done) == 2


def test_kernels_run_where_nothing_can_be_kept(tmp_path):
    """With no folder for the cache there is one warning, which names the variable."""
    code = (
        "import logging, numba.core.caching as caching\n"
        "caching.CacheImpl._locator_classes = []\n"
        "caching.CompileResultCacheImpl._locator_classes = []\n"
        "logging.basicConfig(stream=sys.stdout)\n"
        "from miricigale.photometry._core import stamps\n"
        "from miricigale.psf import _core as psf\n"
        "import numpy as np\n"
        "print(psf.polygon_coverage.__name__)\n"
    )
    out = python(code, tmp_path, with_cache(tmp_path))
    assert out.count("NUMBA_CACHE_DIR") == 1
