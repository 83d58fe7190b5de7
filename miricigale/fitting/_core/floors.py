"""How deep to go: the least bounds of the pairs that are evaluated."""

import math

import numpy as np

from miricigale.fitting._core.structs import BLOCK, DONE, KEY_BITS, KEY_MASK
from miricigale.utils._core.functions import log10
from miricigale.utils.compilation import KERNEL, PART, njit

# Steps of the histogram of bounds ...
_N_LEVELS = 1024
# ... and how many for each unit of chi2.
_PER_UNIT = 4.0
# Pairs whose bound is within this of the best are evaluated first ...
_FIRST = 10.0
# ... but not many more than so many of them.
_MOST = 8192
# ... and in double precision if there are fewer than so many times as many.
_FEW = 4
# Below every bound, above `DONE`.
_ALL = -1e37
_DECAY = np.exp(-0.5 / _PER_UNIT * np.arange(_N_LEVELS))
_TWO_LN_10 = 2.0 * math.log(10.0)


@njit(**KERNEL)
def _count(pairs, n, reference, lowest, count):
    """Add the bounds of n runs that are above the lowest to a histogram."""
    for r in range(n):
        if pairs.top[r] > lowest:
            _count_run(pairs.bound[r], reference, lowest, count)


@njit(**PART)
def _count_run(row, reference, lowest, count):
    """Add the bounds of a run to the histogram."""
    columns = count[2]
    for i in range(BLOCK):
        column = np.int32(min(max((reference - row[i]) * _PER_UNIT, 0.0), _N_LEVELS))
        # what is not counted goes to columns of no meaning, for a branch would take longer
        columns[i] = column if row[i] > lowest else np.int32(_N_LEVELS + 1 + i)
    for i in range(BLOCK):
        # neighbors, which are often in the same bin, are counted apart
        count[i & 1, columns[i]] += 1


def _make_count():
    """Make an empty histogram of bounds: twice the bins, and scratch."""
    return np.zeros((3, _N_LEVELS + 1 + BLOCK), np.int32)


def first_floor(pairs, n, reference):
    """
    Least bound to evaluate first, and whether in double precision.

    That is where these pairs are few; where many could be as good as the best (``reference``), none
    has much weight.
    """
    count = _make_count()
    # a bin more than are looked at, for rounding
    _count(pairs, n, reference, np.float32(reference - _FIRST - 1.0), count)
    total = np.cumsum(count[:2, : int(_FIRST * _PER_UNIT)].sum(axis=0))
    crowded = np.flatnonzero(total > _MOST)
    if crowded.size == 0:
        return reference - _FIRST, True
    return reference - (crowded[0] + 1) / _PER_UNIT, bool(total[crowded[0]] < _FEW * _MOST)


@njit(**KERNEL)
def _raise_bounds(tables, target, pairs, n, allowed, tail_galaxy, tail_agn, reference, count):
    """
    Raise the bounds of the n listed runs by what second moments ask for, and fill their histogram.

    A model has s^2 <= R / <G, wG> and power^2 <= R / <A, wA>, R <= |F|^2_w. Their product with
    the quantities' squares is compared with the variances: ``tail_galaxy`` and ``tail_agn`` are from
    `widest`, ``allowed`` is |F|^2_w over how much more second moments may miss than weights. A bound is
    raised by 2 ln of how much more than its weight a pair can add to second moments.
    """
    top = 0.0
    z_now = np.int64(-1)
    for r in range(n):
        key = pairs.run_key[r]
        row = pairs.bound[r]
        z = key >> (2 * KEY_BITS)
        if z != z_now:
            z_now = z
            weight = target.weight[z]
            top = 0.0
            for b in range(weight.size):
                top = max(top, weight[b])
            for g in range(tail_galaxy.size):
                unit = tables.galaxy_unit[z, g]
                inverse = np.float64(pairs.inverse_norm[z, g])
                amp = tail_galaxy[g] * allowed * inverse * inverse / max(unit * unit * top, 1e-300)
                pairs.tail_galaxy[g] = _TWO_LN_10 * log10(amp) if amp > 1.0 else 0.0
            for k in range(tail_agn.size):
                b2 = 0.0
                for b in range(weight.size):
                    b2 += tables.agn[z, k, b] * tables.agn[z, k, b] * weight[b]
                amp = tail_agn[k] * allowed / b2 if b2 > 0.0 else 0.0
                pairs.tail_agn[k] = _TWO_LN_10 * log10(amp) if amp > 1.0 else 0.0
        start = ((key >> KEY_BITS) & KEY_MASK) * BLOCK
        raised = pairs.tail_agn[key & KEY_MASK]
        highest = DONE
        for i in range(BLOCK):
            value = row[i] + (pairs.tail_galaxy[start + i] + raised)
            row[i] = value if row[i] > DONE else DONE
            highest = max(highest, row[i])
        pairs.top[r] = highest
        _count_run(row, reference, DONE, count)


def second_floor(tables, target, pairs, n, reference, allowed, unit, delta, tail, widest):
    """
    Least bound to evaluate, once the weight of the best pairs is known.

    The weight of a pair is at most ``unit`` times exp((bound - reference) / 2), and ``allowed`` is what
    may be left out: the pairs below the floor sum up to no more. It is at most ``delta`` below the
    reference. Bounds are raised by what second moments ask for: ``tail`` and ``widest`` are ``allowed``
    and both tails of `_raise_bounds`.
    """
    if not allowed > 0.0:
        return _ALL
    count = _make_count()
    _raise_bounds(tables, target, pairs, n, tail, *widest, reference, count)
    # from the lowest up
    weight_above = np.cumsum((count[:2, :_N_LEVELS].sum(axis=0) * _DECAY * unit)[::-1])
    last = _N_LEVELS - np.searchsorted(weight_above, allowed, side="right")
    return reference - min(last / _PER_UNIT, delta)
