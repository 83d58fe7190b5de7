"""
Kernels of the grid fit: arrays in, arrays out.

`bounds` says which models can matter, `evaluate` sums these up, `histogram` keeps distributions,
`driver` goes through the objects. numba's cache of `driver` holds the compiled code of the other
modules, and does not see when they change: who edits one empties ``__pycache__``.
"""

from miricigale.fitting._core.driver import fit_many, make_scratch, make_sums
from miricigale.fitting._core.histogram import N_BINS, PER_DEX
from miricigale.fitting._core.structs import Output, Request, Scratch, Sums, Tables

__all__ = [
    "N_BINS",
    "PER_DEX",
    "Output",
    "Request",
    "Scratch",
    "Sums",
    "Tables",
    "fit_many",
    "make_scratch",
    "make_sums",
]
