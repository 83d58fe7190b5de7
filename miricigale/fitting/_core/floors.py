"""How deep to go into the list of pairs."""

import math

import numpy as np

from miricigale.fitting._core.bounds import BLOCK, DONE, KEY_BITS
from miricigale.fitting._core.options import INNER, ONCE
from miricigale.utils.compilation import njit

__all__ = ["N_LEVELS", "first_floor", "raise_bounds", "second_floor"]


#: Steps of the histogram of bounds, and how many there are for each unit of chi2.
N_LEVELS = 8000
_PER_UNIT = 4.0
#: Pairs whose bound is within this of the best are evaluated first ...
_FIRST = 10.0
#: ... but not many more than so many of them.
_MOST = 8192
#: ... and in double precision if there are fewer than so many times as many.
_FEW = 4
# Below every bound, above `DONE`.
_ALL = -1e37
_BLOCK_MASK = (1 << KEY_BITS) - 1


@njit(**INNER)
def _count(bound, n, reference, count):
    """Fill the histogram of the bounds of n runs."""
    for j in range(count.size):
        count[j] = 0.0
    for r in range(n):
        row = bound[r]
        for i in range(BLOCK):
            if row[i] > DONE:
                column = (reference - row[i]) * _PER_UNIT
                count[np.int64(min(max(column, 0.0), N_LEVELS))] += 1.0


@njit(**ONCE)
def first_floor(bound, count, reference, n):
    """
    Least bound to evaluate first, and whether in double precision.

    Parameters
    ----------
    bound, count
        See `miricigale.fitting._core.structs.Scratch`; ``n`` runs are listed.
    reference : float
        The best bound that some model reaches.

    Returns
    -------
    floor : float
    few : bool
        Whether these are few enough for double precision; where many pairs could be as good as
        the best, none has much weight.
    """
    _count(bound, n, reference, count)
    total = 0.0
    for j in range(int(_FIRST * _PER_UNIT)):
        total += count[j]
        if total > _MOST:
            return reference - (j + 1) / _PER_UNIT, total < _FEW * _MOST
    return reference - _FIRST, True


@njit(**ONCE)
def raise_bounds(
    agn, galaxy_unit, weight, room, tail_galaxy, tail_agn, inverse_norm, run_key, bound, n,
    raise_galaxy, raise_agn,
):  # fmt: skip
    """
    Raise the bounds of the listed pairs by what second moments ask for.

    A model has s^2 <= R / <G, wG> and power^2 <= R / <A, wA>, R <= |F|^2_w. Their product with
    the quantities' squares is compared with the variances. A bound is raised by 2 ln of how much
    more than its weight a pair can add to second moments.

    Parameters
    ----------
    agn, galaxy_unit : `~numpy.ndarray`, shapes (nz, nA, nb) and (nz, nG)
        See `miricigale.fitting._core.structs.Tables`.
    weight : `~numpy.ndarray`, shape (nb,)
        1 / sigma^2.
    room : float
        |F|^2_w over how much more second moments may miss than weights.
    tail_galaxy, tail_agn : `~numpy.ndarray`, shapes (nG,) and (nA,)
        Squares of quantities over their variances, from `summary.variances`.
    inverse_norm, run_key, bound
        See `miricigale.fitting._core.structs.Scratch`; ``n`` runs are listed.
    raise_galaxy, raise_agn : `~numpy.ndarray` of float32, shapes (nz, n_padded) and (nz, nA)
        Filled for the redshifts in the list.
    """
    top = 0.0
    for b in range(weight.size):
        top = max(top, weight[b])
    z_now = np.int64(-1)
    for r in range(n):
        key = run_key[r]
        z = key >> (2 * KEY_BITS)
        if z != z_now:
            z_now = z
            for g in range(tail_galaxy.size):
                unit = galaxy_unit[z, g]
                inverse = np.float64(inverse_norm[z, g])
                amp = tail_galaxy[g] * room * inverse * inverse / max(unit * unit * top, 1e-300)
                raise_galaxy[z, g] = 2.0 * math.log(amp) if amp > 1.0 else 0.0
            for k in range(tail_agn.size):
                b2 = 0.0
                for b in range(weight.size):
                    b2 += agn[z, k, b] * agn[z, k, b] * weight[b]
                amp = tail_agn[k] * room / b2 if b2 > 0.0 else 0.0
                raise_agn[z, k] = 2.0 * math.log(amp) if amp > 1.0 else 0.0
        start = ((key >> KEY_BITS) & _BLOCK_MASK) * BLOCK
        more = raise_agn[z, key & _BLOCK_MASK]
        for i in range(BLOCK):
            value = bound[r, i] + (raise_galaxy[z, start + i] + more)
            bound[r, i] = value if bound[r, i] > DONE else DONE


@njit(**ONCE)
def second_floor(bound, count, reference, n, room, unit, delta):
    """
    Least bound to evaluate, once the weight of the best pairs is known.

    Parameters
    ----------
    bound, count, reference, n
        As in `first_floor`.
    room : float
        Weight that may be left out.
    unit : float
        The weight of a pair is at most ``unit`` times exp((bound - reference) / 2).
    delta : float
        How far below the reference a floor may be.

    Returns
    -------
    floor, sure : float
        The pairs below ``floor`` sum up to at most ``room``, and so would all pairs if they were
        at ``sure``.
    """
    if not room > 0.0:
        return _ALL, _ALL
    _count(bound, n, reference, count)
    n_listed = 0.0
    for j in range(N_LEVELS + 1):
        n_listed += count[j]
    left = 0.0
    last = N_LEVELS
    while last > 0:
        left += count[last - 1] * math.exp(-0.5 / _PER_UNIT * (last - 1)) * unit
        if left > room:
            break
        last -= 1
    floor = reference - min(last / _PER_UNIT, delta)
    return floor, min(floor, reference - 2.0 * math.log(max(n_listed, 1.0) * unit / room))
