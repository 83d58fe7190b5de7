"""Pairs with upper limits side by side."""

import math

import numpy as np

from miricigale.fitting._core.lanes import (
    F1,
    F2,
    LANES,
    PRIOR,
    SHARE,
    U2,
    V1,
    V2,
    W0,
    W1,
    W2,
    WR,
    WZ,
    X2,
    A,
    B,
    P,
    Q,
    exponential,
)
from miricigale.fitting._core.limited_scales import (
    CHI2,
    CURVATURE,
    DETECTED,
    EXPONENT,
    FACTOR,
    SCALE,
    best_scales,
    fill_light_limits,
    light_scales,
)
from miricigale.fitting._core.options import INNER
from miricigale.fitting._core.structs import NO_LIGHT
from miricigale.utils.compilation import njit

__all__ = ["limited_likelihoods"]


# What single precision may miss of the largest R.
_ROUNDING = 1e-3
# Vectors of Lanes.limited that scales leave free: whether a model counts, work space.
_ALIVE, _CHANGE, _V = (i * LANES for i in range(6, 9))


@njit(**INNER)
def limited_likelihoods(
    buffer, work, left, light, power, power32, limit, limit_light, weight, ratio, frac_prior,
    first, reference, scale_error, out, level, dark, delta, single,
):  # fmt: skip
    """
    Do what `lanes.likelihoods` does, for objects with upper limits.

    Scales are sought where pairs evaluated before have theirs.

    Parameters
    ----------
    work, light, power32, limit_light : `~numpy.ndarray`
        Scratch, see `limited_scales`.
    left : `~numpy.ndarray`, shape (n_ratio * LANES,)
        What limits left of the scales of pairs evaluated before, at every fraction.
    limit : `~numpy.ndarray`, shape (2 n or more, LANES)
        Fluxes of galaxies and (for c = 1) tori over the errors of the n limits.
    level, dark
        See `structs.Target`.
    delta : float
        Models so far below the reference without the limits get no weight.
    single : bool
        Whether single precision will do.
    buffer, power, weight, ratio, frac_prior, first, reference, scale_error, out
        As there.

    Returns
    -------
    top : float
        Largest R, to rounding; in single precision somewhat more.
    over : float
        Largest exponent of a weight; where it is large the reference must be raised.
    """
    two = power.view(np.float64)
    for i in range(W0, WR + LANES):
        buffer[i] = 0.0
    top = 0.0
    over = 0.0
    warm = False
    zero_level = 0.5 * (dark - reference)
    least = max(reference - delta, -1e200)
    if single:
        fill_light_limits(buffer, work, limit, level.size, limit_light)
    for j in range(ratio.size):
        c = ratio[j]
        f = frac_prior[j + first]
        out[j] = 0.0
        now = left[j * LANES : (j + 1) * LANES]
        for i in range(LANES):
            q = buffer[Q + i] + c * (buffer[X2 + i] + c * buffer[B + i])
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            p = max(max(buffer[P + i], -1e200) + c * buffer[A + i], 0.0)
            s = p / q
            # what is hopeless without the limits is so with them
            value = max(p * s, 0.0) + buffer[PRIOR + i]
            work[_ALIVE + i] = 1.0 if value >= least else 0.0
            work[DETECTED + i] = s if value >= least else 0.0
            # begin where limits leave as much of the scale as of the last pair's at this fraction,
            # but for what was different at the last fraction
            part = now[i] * (work[_CHANGE + i] if warm else 1.0)
            work[SCALE + i] = s * min(part, 1.0)
        some = 0.0
        for i in range(LANES):
            some += work[_ALIVE + i]
        if some == 0.0:
            warm = False
            for i in range(LANES):
                weight[j * LANES + i] = 0.0
            continue
        if single:
            light_scales(buffer, work, light, power32, limit_light, c, level, zero_level)
        else:
            best_scales(buffer, work, power, limit, c, level)
        for i in range(LANES):
            whole = work[DETECTED + i]
            whole = whole if whole > 0.0 else max(work[SCALE + i], NO_LIGHT)
            part = min(max(work[SCALE + i] / whole, 1e-3), 1.0)
            work[_CHANGE + i] = min(part / now[i], 4.0)
            now[i] = part
        warm = True
        for i in range(LANES):
            # half of R but for the product of probabilities
            e = 0.5 * dark - work[CHI2 + i] + work[EXPONENT + i]
            e = e if work[_ALIVE + i] > 0.0 else -1e4
            work[EXPONENT + i] = e
            e += 0.5 * (max(buffer[PRIOR + i], -1e200) - reference)
            over = max(over, e if work[_ALIVE + i] > 0.0 else 0.0)
            v, power[i] = exponential(min(max(e, -700.0), 700.0))
            work[_V + i] = v * f * work[FACTOR + i] * work[_ALIVE + i]
        most = -1e300
        for i in range(LANES):
            most = max(most, work[EXPONENT + i])
        for i in range(LANES if 2.0 * most > top else 0):
            e = work[EXPONENT + i]
            if 2.0 * e > top:
                top = max(top, 2.0 * e + 2.0 * math.log(max(work[FACTOR + i], 1e-300)))
        for i in range(LANES):
            t = work[_V + i] * two[i]
            s = work[SCALE + i]
            inverse = 1.0 / work[CURVATURE + i]
            y = c * buffer[SHARE + i]
            phi = y / (1.0 + y)
            s2 = s * s + scale_error * inverse
            work[_V + i] = t
            weight[j * LANES + i] = t
            buffer[W0 + i] += t
            buffer[W1 + i] += t * s
            buffer[V1 + i] += t * s * c
            buffer[W2 + i] += t * s2
            buffer[U2 + i] += t * s2 * c
            buffer[V2 + i] += t * s2 * c * c
            buffer[F1 + i] += t * phi
            buffer[F2 + i] += t * phi * phi
            buffer[WR + i] += t * s * s * work[CURVATURE + i]
            buffer[WZ + i] += t if s == 0.0 else 0.0
        # sums apart from stores: see `agn_products`
        total = 0.0
        for i in range(LANES):
            total += work[_V + i]
        out[j] = total
    return top + _ROUNDING if single else top, over
