"""
Pairs with upper limits side by side.

The scale that minimises chi2 is found for all lanes at once, by the steps of
`limits.limited_scale`, and the probabilities of the limits are multiplied rather than their
logarithms summed.
"""

import math

import numpy as np
from numba import njit

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
from miricigale.fitting._core.structs import NO_LIGHT

__all__ = ["LIMITED_SIZE", "limited_likelihoods", "scaled_erfc"]

_OPTIONS = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}

# Offsets of the vectors in Lanes.limited: scale, half of chi2 and its derivatives, the product of
# probabilities, the scale without limits, whether a model counts, and work space.
_S, _CHI2, _G, _D, _H, _FACTOR, _EXPONENT, _DETECTED, _ALIVE = (i * LANES for i in range(9))
_U, _M, _V, _MILLS = (i * LANES for i in range(9, 13))
LIMITED_SIZE = 13 * LANES

_ROOT_HALF = 0.70710678118654752
_ROOT_TWO_OVER_PI = 0.79788456080286536
# Steps of Newton's method; relative size of the last.
_MOST = 60
_CLOSE = 1e-5


@njit(**_OPTIONS)
def scaled_erfc(z):
    """
    exp(z^2) erfc(z) for z >= 0, to 2e-12.

    t = 3 / (3 + z) times a polynomial in 2 t - 1, the Chebyshev interpolation of degree 16 (of
    scipy.special.erfcx).
    """
    t = 3.0 / (3.0 + z)
    x = 2.0 * t - 1.0
    v = -7.909679668678854e-08
    v = v * x - 1.327470214572296e-07
    v = v * x + 8.281839527992843e-07
    v = v * x + 1.295421122182736e-06
    v = v * x - 5.739579827718830e-06
    v = v * x - 9.890937187676496e-06
    v = v * x + 3.581041826229913e-05
    v = v * x + 9.213853674066139e-05
    v = v * x - 1.827570762553639e-04
    v = v * x - 1.011319029730867e-03
    v = v * x - 4.041408907881644e-04
    v = v * x + 8.942406098304561e-03
    v = v * x + 3.984258723799971e-02
    v = v * x + 1.034890876840956e-01
    v = v * x + 1.967427856984673e-01
    v = v * x + 2.944648177153389e-01
    v = v * x + 3.580023023627791e-01
    return v * t


@njit(**_OPTIONS)
def _add_limit(work, power, slope_galaxy, slope_agn, c, level):
    """
    Add a limit to half the derivatives of chi2, to the product of probabilities and exponents.

    The probability is work[_FACTOR] times exp(work[_EXPONENT]).
    """
    two = power.view(np.float64)
    for i in range(LANES):
        m = slope_galaxy[i] + c * slope_agn[i]
        u = work[_S + i] * m - level
        work[_U + i] = u
        work[_M + i] = m
        work[_MILLS + i] = scaled_erfc(abs(u) * _ROOT_HALF)
        v, power[i] = exponential(max(-0.5 * u * u, -700.0))
        work[_V + i] = v
    for i in range(LANES):
        u, m, mills = work[_U + i], work[_M + i], work[_MILLS + i]
        bell = work[_V + i] * two[i]
        density = 1.0 if u > 0.0 else bell
        above = mills if u > 0.0 else 2.0 - mills * bell
        hazard = _ROOT_TWO_OVER_PI * density / above
        first = hazard * (hazard - u)
        # far out the difference has no digits
        v = 1.0 / max(u * u, 1.0)
        first = 1.0 - v * (1.0 - 6.0 * v) if u > 100.0 else first
        second = first * (hazard - u) + hazard * (first - 1.0)
        second = 2.0 * v / max(u, 1.0) if u > 100.0 else second
        work[_G + i] += hazard * m
        work[_D + i] += first * m * m
        work[_H + i] += second * m * m * m
        work[_FACTOR + i] *= 0.5 * above
        work[_EXPONENT + i] -= 0.5 * u * u if u > 0.0 else 0.0


@njit(**_OPTIONS)
def _best_scales(buffer, work, power, limit, c, level):
    """
    Fill the scales that minimise chi2 at one fraction, and what goes with them.

    work[_DETECTED] holds the scales without limits, 0 in lanes that do not count; work[_S] where to
    begin. On return work[_S] holds the scales, work[_G] half of chi2 there but for a constant and
    the probabilities' part, work[_D] half its second derivative.
    """
    n = level.size
    far = 1.0
    steps = 0
    while far > 0.0 and steps < _MOST:
        steps += 1
        for i in range(LANES):
            q = buffer[Q + i] + c * (buffer[X2 + i] + c * buffer[B + i])
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            # a pair that is not there has no p either
            p = max(buffer[P + i], -1e200) + c * buffer[A + i]
            s = work[_S + i]
            work[_G + i] = q * s - p
            work[_D + i] = q
            work[_H + i] = 0.0
            work[_CHI2 + i] = s * (0.5 * q * s - p)
            work[_FACTOR + i] = 1.0
            work[_EXPONENT + i] = 0.0
        for m in range(n):
            _add_limit(work, power, limit[m], limit[n + m], c, level[m])
        far = 0.0
        for i in range(LANES):
            s = work[_S + i]
            new = max(s - work[_G + i] / work[_D + i], 0.0)
            step = new - s
            # the last step is small enough for three terms of a series
            work[_S + i] = new
            work[_CHI2 + i] += step * (work[_G + i] + 0.5 * step * work[_D + i])
            work[_D + i] += step * work[_H + i]
            moved = abs(step) - _CLOSE * s
            far = max(far, moved if work[_DETECTED + i] > 0.0 else 0.0)


@njit(**_OPTIONS)
def limited_likelihoods(
    buffer, work, power, limit, weight, ratio, frac_prior, first, reference, scale_error, out,
    level, dark, delta,
):  # fmt: skip
    """
    Do what `lanes.likelihoods` does, for objects with upper limits.

    Parameters
    ----------
    work : `~numpy.ndarray`, shape (LIMITED_SIZE,)
        Scratch.
    limit : `~numpy.ndarray`, shape (2 n or more, LANES)
        Fluxes of galaxies and (for c = 1) tori over the errors of the n limits.
    level, dark
        See `structs.Target`.
    delta : float
        Models so far below the reference without the limits get no weight.
    buffer, power, weight, ratio, frac_prior, first, reference, scale_error, out
        As there.

    Returns
    -------
    top : float
        Largest R, to rounding.
    over : float
        Largest exponent of a weight; where it is large the reference must be raised.
    """
    two = power.view(np.float64)
    for i in range(W0, WR + LANES):
        buffer[i] = 0.0
    top = 0.0
    over = 0.0
    warm = False
    for j in range(ratio.size):
        c = ratio[j]
        f = frac_prior[j + first]
        out[j] = 0.0
        some = 0.0
        for i in range(LANES):
            q = buffer[Q + i] + c * (buffer[X2 + i] + c * buffer[B + i])
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            p = max(max(buffer[P + i], -1e200) + c * buffer[A + i], 0.0)
            s = p / q
            # what is hopeless without the limits is so with them
            alive = buffer[PRIOR + i] > -1e200
            alive = alive and p * s + buffer[PRIOR + i] >= reference - delta
            some += 1.0 if alive else 0.0
            # begin where limits leave as much of the scale as at the last fraction
            before = work[_S + i] / work[_DETECTED + i] if work[_DETECTED + i] > 0.0 else 1.0
            work[_S + i] = s * min(before, 1.0) if warm else s
            work[_DETECTED + i] = s if alive else 0.0
            work[_ALIVE + i] = 1.0 if alive else 0.0
        if some == 0.0:
            warm = False
            for i in range(LANES):
                weight[j * LANES + i] = 0.0
            continue
        warm = True
        _best_scales(buffer, work, power, limit, c, level)
        for i in range(LANES):
            # half of R but for the product of probabilities
            e = 0.5 * dark - work[_CHI2 + i] + work[_EXPONENT + i]
            e = e if work[_ALIVE + i] > 0.0 else -1e4
            work[_EXPONENT + i] = e
            e += 0.5 * (max(buffer[PRIOR + i], -1e200) - reference)
            over = max(over, e if work[_ALIVE + i] > 0.0 else 0.0)
            v, power[i] = exponential(min(max(e, -700.0), 700.0))
            work[_V + i] = v * f * work[_FACTOR + i] * work[_ALIVE + i]
        for i in range(LANES):
            e = work[_EXPONENT + i]
            if 2.0 * e > top:
                top = max(top, 2.0 * e + 2.0 * math.log(max(work[_FACTOR + i], 1e-300)))
        for i in range(LANES):
            t = work[_V + i] * two[i]
            s = work[_S + i]
            inverse = 1.0 / work[_D + i]
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
            buffer[WR + i] += t * s * s * work[_D + i]
            buffer[WZ + i] += t if s == 0.0 else 0.0
        # sums apart from stores: see `agn_products`
        total = 0.0
        for i in range(LANES):
            total += work[_V + i]
        out[j] = total
    return top, over
