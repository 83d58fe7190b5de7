"""
Kernels of the grid fit: arrays in, arrays out.

For one object `begin` starts, `evaluate_singles` adds the models without AGN, `list_runs`
(`bounds`) lists the pairs that can matter, `first_floor`, `raise_bounds` and `second_floor` say
how many of them do, `evaluate_runs` sums them up (`lanes`: side by side, `light`: in single
precision, `limited`: with upper limits, `collect`: into histograms and draws), and `summarise`
turns the sums into moments and quantiles. numba's cache of a function holds the compiled code of
those it calls, and does not see when they change: who edits one empties ``__pycache__``.
"""

from miricigale.fitting._core.bounds import BLOCK
from miricigale.fitting._core.evaluate import evaluate_runs
from miricigale.fitting._core.floors import first_floor, raise_bounds, second_floor
from miricigale.fitting._core.histogram import N_BINS, PER_DEX
from miricigale.fitting._core.search import begin, list_runs
from miricigale.fitting._core.singles import evaluate_singles
from miricigale.fitting._core.structs import PointTables, Request, Scratch, Sums, Tables, Target
from miricigale.fitting._core.summary import summarise, variances
from miricigale.fitting._core.workspace import JOINT, clear, make_scratch, make_sums, rescale

__all__ = [
    "BLOCK",
    "JOINT",
    "N_BINS",
    "PER_DEX",
    "PointTables",
    "Request",
    "Scratch",
    "Sums",
    "Tables",
    "Target",
    "begin",
    "clear",
    "evaluate_runs",
    "evaluate_singles",
    "first_floor",
    "list_runs",
    "make_scratch",
    "make_sums",
    "raise_bounds",
    "rescale",
    "second_floor",
    "summarise",
    "variances",
]
