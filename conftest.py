"""Tests see neither the data nor the caches of whoever runs them."""

import contextlib
import gc
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

# processes are forked, stopped by signals and limited there, which Windows does not know
POSIX = ("integration/test_study.py", "utils/test_lock.py", "workflow/test_robust.py")
# scripts of the gallery, which tests/test_docs.py runs, and the pages that Sphinx makes of them
collect_ignore_glob = ["docs/examples/*", "docs/how_to/*", "docs/tutorials/*", "docs/_build/*"]
collect_ignore = [f"tests/{name}" for name in POSIX] if os.name == "nt" else []


def pytest_configure(config):
    # figures belong to no window
    os.environ.setdefault("MPLBACKEND", "agg")
    if getattr(config.option, "numprocesses", None):
        # workers fill the cores: threads of the linear algebra would wait for each other
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from miricigale import conf

    config.own_folder = Path(tempfile.mkdtemp(prefix="miricigale-tests-"))
    conf.data_folder = str(config.own_folder / "data")
    conf.cache_folder = str(config.own_folder / "cache")
    # workers would compile the same kernels at the same time, each for itself, and processes that a test compares
    # would have some of either: once before them is less work, and all have the same
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        command = [sys.executable, "-m", "miricigale", "compile"]
        # elsewhere, so that it is the package under test, and not the folder of its source
        subprocess.run(command, cwd=config.own_folder, check=True)


def pytest_unconfigure(config):
    shutil.rmtree(config.own_folder, ignore_errors=True)


def pytest_collection_modifyitems(items):
    """Begin with whole studies, which take longest: the last worker would be alone with them."""
    items.sort(key=lambda item: "integration" not in item.path.parts)


def pytest_collection_finish():
    """Leave modules and collected tests, which stay, out of garbage collections."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Let one worker do all tests of a module, so that what they share is made once."""
    if config.getvalue("dist") != "load":
        return None
    from xdist.scheduler import LoadFileScheduling

    class FromBothEnds(LoadFileScheduling):
        """Every second worker begins at the end: two that are side by side compile the same kernels."""

        def _assign_work_unit(self, node):
            if self.nodes.index(node) % 2:
                self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
            super()._assign_work_unit(node)

    config.option.loadscopereorder = False
    return FromBothEnds(config, log)


@pytest.fixture(autouse=True)
def close_figures():
    """Close the figures that a test or a page has drawn."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture(autouse=True)
def pictures(request, monkeypatch):
    """Leave pictures out of pages in tests without the mark ``pictures``: drawing takes most of a page's time."""
    is_test = isinstance(request.node, pytest.Function)
    if is_test and request.node.get_closest_marker("pictures") is None:
        monkeypatch.setattr("miricigale.pages.page.image_of", lambda figure, dpi: ("data:,", 1))


@pytest.fixture(scope="session")
def data_file():
    """Path of a file or folder of the development data, or a skip that names it."""

    def find(name):
        folder = os.environ.get("MIRICIGALE_DATA")
        if not folder or not (Path(folder) / name).exists():
            pytest.skip(f"needs {name} in $MIRICIGALE_DATA")
        return Path(folder) / name

    return find


@pytest.fixture
def full_disk():
    """Context in which no file grows beyond some bytes, as on a disk that is full then."""
    resource = pytest.importorskip("resource")

    @contextlib.contextmanager
    def limited(n_bytes):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited
