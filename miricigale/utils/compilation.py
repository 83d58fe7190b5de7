"""
How kernels are compiled: with a message to the user, and without a cache where none can be kept.

numba compiles a kernel when it is first called and keeps the code on disk, in the folder
``NUMBA_CACHE_DIR`` or else beside the source, so that this happens once for each installation. The code of a
kernel holds that of the kernels it calls, and numba looks at the file of the first only: what is kept is
forgotten when any file of kernels changes.
"""

import gc
import hashlib
import logging
import sys
from pathlib import Path

import numba
from numba.core import event

from miricigale.utils.caching import cached

log = logging.getLogger(__name__)

# Code of a function may be in a process twice: its own, and in a kernel that calls it, compiled with that. Which
# of the two a call runs depends on what was loaded first, and sums that may be taken in any order then differ in
# the last digit. Functions with ``fastmath`` that kernels call are therefore copied into them (``forceinline``).

#: Options of kernels called from Python alone, which allocate nothing and whose sums may be taken in any order.
KERNEL = {
    "error_model": "numpy",
    "fastmath": True,
    "no_cfunc_wrapper": True,
    "_nrt": False,
}
#: Options of functions that become part of kernels.
PART = {**KERNEL, "no_cpython_wrapper": True, "forceinline": True}


class _Listener(event.Listener):
    """Says what is compiled, once for each subpackage; compiling is faster without garbage collection."""

    def __init__(self):
        self.reported = set()
        self.depth = 0
        self.collect = False

    # numba calls both with its compiler lock held
    def on_start(self, event):
        name = subpackage_of(event.data["dispatcher"].py_func.__module__)
        if name and name not in self.reported:
            self.reported.add(name)
            log.info("compiling kernels of %s, once for each installation, up to 20 s", name)
        if self.depth == 0:
            self.collect = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event):
        self.depth -= 1
        if self.depth == 0 and self.collect:
            gc.enable()


def subpackage_of(module):
    """Subpackage of this package that a module is in, by their names; empty for numba's own and for others'."""
    package, _, module_path = module.partition(".")
    if package == __name__.partition(".")[0]:
        return module_path.partition(".")[0]
    return ""


event.register("numba:compile", _Listener())


def njit(**options):
    """
    Compile a function as `numba.njit` does, with a cache and without the lock of Python's interpreter.

    There is no cache where there is no place for it, and it is made again where it is out of date.

    Parameters
    ----------
    **options
        Those of `numba.njit`.

    Returns
    -------
    decorator : callable
    """
    options = {"cache": True, "nogil": True} | options

    def decorate(function):
        try:
            kernel = numba.njit(**options)(function)
            if kernel.stats.cache_path is not None:
                _forget_stale(kernel.stats.cache_path, function.__module__.partition(".")[0])
            return kernel
        except RuntimeError as err:
            if "no locator available" not in str(err):
                raise
        _warn_of_no_cache()
        return numba.njit(**{**options, "cache": False})(function)

    return decorate


@cached
def _warn_of_no_cache():
    log.warning(
        "compiled kernels cannot be kept, as neither the package's folder nor the user's cache can be "
        "written: they are compiled in every process; set NUMBA_CACHE_DIR to a folder that can be written"
    )


@cached
def _forget_stale(folder, package):
    """Remove the index of what is kept in a folder, if it was compiled from other sources than today's."""
    current = _digest(package)
    marker = Path(folder) / "kernels.sha256"
    if marker.is_file() and marker.read_text() == current:
        return
    for index in Path(folder).glob("*.nbi"):
        index.unlink(missing_ok=True)
    marker.write_text(current)


@cached
def _digest(package):
    """Checksum of all files of kernels of a package, ``_core.py`` and ``_core/*.py``."""
    root = Path(sys.modules[package].__file__).parent
    digest = hashlib.sha256()
    for path in sorted([*root.glob("*/_core.py"), *root.glob("*/_core/*.py")]):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
