"""
How the kernels are compiled.

Those called from Python need a wrapper, which takes time to compile; the others only become part of
them. Sums may be taken in any order, except where digits would be lost.
"""

__all__ = ["ENTRY", "EXACT", "EXACT_ENTRY", "INNER", "ONCE"]

_ALL = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_WITHIN = {**_ALL, "no_cpython_wrapper": True}
#: Kernels called from Python.
ENTRY = {**_ALL, "fastmath": True}
#: One in which the order of operations counts.
EXACT_ENTRY = _ALL
#: Parts of kernels.
INNER = {**_WITHIN, "fastmath": True}
#: Parts of kernels that are called in one place: they are not compiled by themselves. (Not for those
#: of many lines: compiling a kernel takes longer than in proportion to its length.)
ONCE = {**INNER, "inline": "always"}
#: Parts of kernels in which the order of operations counts.
EXACT = _WITHIN
