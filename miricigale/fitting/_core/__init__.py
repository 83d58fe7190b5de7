"""
Kernels of the grid fit: arrays in, arrays out.

`sum_up` does one object. `begin` starts, `evaluate_singles` adds the models without AGN,
`list_runs` (`bounds`) lists the pairs that can matter, `first_floor`, `raise_bounds` and
`second_floor` say how many of them do, `evaluate_runs` sums them up (`lanes`: side by side, `light`:
in single precision, `limited`: with upper limits, `collect`: into histograms and draws).
`summarise` turns the sums into moments and quantiles. What is called from Python with many arrays
takes a second to compile for the call alone, so there is one such kernel. numba's cache of a function
holds the compiled code of those it calls, and does not see when they change: who edits one empties
``__pycache__``.
"""

from miricigale.fitting._core.bounds import BLOCK
from miricigale.fitting._core.histogram import N_BINS, PER_DEX
from miricigale.fitting._core.posterior import sum_up
from miricigale.fitting._core.structs import (
    Limits,
    PointTables,
    Request,
    Scratch,
    Sums,
    Tables,
    Target,
)
from miricigale.fitting._core.summary import summarise
from miricigale.fitting._core.workspace import JOINT, clear, make_scratch, make_sums

__all__ = [
    "BLOCK",
    "JOINT",
    "N_BINS",
    "PER_DEX",
    "Limits",
    "PointTables",
    "Request",
    "Scratch",
    "Sums",
    "Tables",
    "Target",
    "clear",
    "make_scratch",
    "make_sums",
    "sum_up",
    "summarise",
]
