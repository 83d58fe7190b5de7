"""How deep to go: the least bounds of the pairs that are evaluated."""

import math

import numpy as np

from miricigale.fitting._core.pairs import DONE, KEY_BITS
from miricigale.fitting._core.structs import BLOCK, KERNEL
from miricigale.utils.compilation import njit

__all__ = ["first_floor", "raise_bounds", "second_floor"]

_MASK = (1 << KEY_BITS) - 1
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


@njit(**KERNEL)
def _count(bound, n, reference, lowest, count):
    """Fill the histogram of the bounds of n runs above the lowest, of shape (2, _N_LEVELS + 1)."""
    for m in range(2):
        for j in range(_N_LEVELS + 1):
            count[m, j] = 0
    for r in range(n):
        row = bound[r]
        for i in range(BLOCK):
            if row[i] > lowest:
                column = (reference - row[i]) * _PER_UNIT
                # neighbors, which are often in the same bin, are counted apart
                count[i & 1, np.int64(min(max(column, 0.0), _N_LEVELS))] += 1


def first_floor(bound, n, reference):
    """
    Least bound to evaluate first, and whether in double precision.

    That is where these pairs are few; where many could be as good as the best (``reference``), none
    has much weight.
    """
    count = np.empty((2, _N_LEVELS + 1), np.int64)
    # a bin more than are looked at, for rounding
    _count(bound, n, reference, np.float32(reference - _FIRST - 1.0), count)
    total = np.cumsum(count[:, : int(_FIRST * _PER_UNIT)].sum(axis=0))
    many = np.flatnonzero(total > _MOST)
    if many.size == 0:
        return reference - _FIRST, True
    return reference - (many[0] + 1) / _PER_UNIT, bool(total[many[0]] < _FEW * _MOST)


@njit(**KERNEL)
def raise_bounds(tables, target, pairs, n, room, tail_galaxy, tail_agn):
    """
    Raise the bounds of the n listed runs by what second moments ask for.

    A model has s^2 <= R / <G, wG> and power^2 <= R / <A, wA>, R <= |F|^2_w. Their product with
    the quantities' squares is compared with the variances: ``tail_galaxy`` and ``tail_agn`` are from
    `widest`, ``room`` is |F|^2_w over how much more second moments may miss than weights. A bound is
    raised by 2 ln of how much more than its weight a pair can add to second moments.
    """
    weight = target.weight
    top = 0.0
    for b in range(weight.size):
        top = max(top, weight[b])
    z_now = np.int64(-1)
    for r in range(n):
        key = pairs.run_key[r]
        z = key >> (2 * KEY_BITS)
        if z != z_now:
            z_now = z
            for g in range(tail_galaxy.size):
                unit = tables.galaxy_unit[z, g]
                inverse = np.float64(pairs.inverse_norm[z, g])
                amp = tail_galaxy[g] * room * inverse * inverse / max(unit * unit * top, 1e-300)
                pairs.tail_galaxy[z, g] = 2.0 * math.log(amp) if amp > 1.0 else 0.0
            for k in range(tail_agn.size):
                b2 = 0.0
                for b in range(weight.size):
                    b2 += tables.agn[z, k, b] * tables.agn[z, k, b] * weight[b]
                amp = tail_agn[k] * room / b2 if b2 > 0.0 else 0.0
                pairs.tail_agn[z, k] = 2.0 * math.log(amp) if amp > 1.0 else 0.0
        start = ((key >> KEY_BITS) & _MASK) * BLOCK
        more = pairs.tail_agn[z, key & _MASK]
        for i in range(BLOCK):
            value = pairs.bound[r, i] + (pairs.tail_galaxy[z, start + i] + more)
            pairs.bound[r, i] = value if pairs.bound[r, i] > DONE else DONE


def second_floor(bound, n, reference, room, unit, delta):
    """
    Least bound to evaluate, once the weight of the best pairs is known.

    The weight of a pair is at most ``unit`` times exp((bound - reference) / 2), and ``room`` is what
    may be left out: the pairs below ``floor`` sum up to no more, and neither would all pairs if they
    were at ``sure``. A floor is at most ``delta`` below the reference.
    """
    if not room > 0.0:
        return _ALL, _ALL
    count = np.empty((2, _N_LEVELS + 1), np.int64)
    _count(bound, n, reference, DONE, count)
    count = count.sum(axis=0)
    # from the lowest up
    left = np.cumsum((count[:-1] * _DECAY * unit)[::-1])
    last = _N_LEVELS - np.searchsorted(left, room, side="right")
    floor = reference - min(last / _PER_UNIT, delta)
    whole = math.log(max(count.sum() * unit, 1e-300)) - math.log(room)
    return floor, min(floor, reference - 2.0 * whole)
