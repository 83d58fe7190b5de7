"""
Best scales of pairs with upper limits, side by side.

The scale that minimises chi2 is found for all lanes at once, by the steps of
`limits.limited_scale`, and the probabilities of the limits are multiplied rather than their
logarithms summed. For pairs that have little weight each single precision will do: what it could
not hold, the scale and the part of chi2 that detections add, stays in double precision; the limits'
part is of order 1, and rounding changes a weight by some 1e-6.
"""

import numpy as np

from miricigale.fitting._core.lanes import (
    LANES,
    PRIOR,
    X2,
    A,
    B,
    P,
    Q,
    exponential,
    light_exponential,
)
from miricigale.fitting._core.options import INNER
from miricigale.fitting._core.structs import NO_LIGHT
from miricigale.utils.compilation import njit

__all__ = [
    "CHI2",
    "CURVATURE",
    "DETECTED",
    "EXPONENT",
    "FACTOR",
    "LIMITED_SIZE",
    "SCALE",
    "best_scales",
    "fill_light_limits",
    "light_scales",
]


# Offsets of the vectors in Lanes.limited: scale, half of chi2 and of its second derivative, the
# limits' probability over exp(exponent), the exponent, the scale without limits (0 in lanes that do
# not count) ...
SCALE, CHI2, CURVATURE, FACTOR, EXPONENT, DETECTED = (i * LANES for i in range(6))
# ... three of work space that are free for callers, and more of it.
_G, _H, _U, _M, _V, _MILLS, _UNIT = (i * LANES for i in range(9, 16))
LIMITED_SIZE = 16 * LANES
# Offsets in Lanes.light: scale, derivatives of half of the limits' chi2, product of probabilities,
# their exponent; work space.
_S32, _G32, _D32, _H32, _PRODUCT32, _EXPONENT32 = (i * LANES for i in range(6))
_U32, _M32, _MILLS32, _V32 = (i * LANES for i in range(6, 10))

_ROOT_HALF = 0.70710678118654752
_ROOT_TWO_OVER_PI = 0.79788456080286536
_ROOT_HALF_32 = np.float32(_ROOT_HALF)
_ROOT_TWO_OVER_PI_32 = np.float32(_ROOT_TWO_OVER_PI)
# Steps of Newton's method; relative size of the last. In single precision the last steps, those
# for which it matters by less than a part _BEND, take the third derivative into account.
_MOST = 60
_CLOSE = 1e-5
_CLOSE_32 = 5e-3
_BEND = 0.1
# Minus logarithm of a weight for which a step may be seven times as large.
_SLIGHT = 10.0
# In single precision: factors multiplied before they could be too small, and largest flux ratio.
_FACTORS = 8
_LARGEST = 1e15


@njit(**INNER)
def _scaled_erfc(z):
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


@njit(**INNER)
def _add_limit(work, power, slope_galaxy, slope_agn, c, level):
    """
    Add a limit to half the derivatives of chi2, to the product of probabilities and exponents.

    The probability is work[FACTOR] times exp(work[EXPONENT]).
    """
    two = power.view(np.float64)
    for i in range(LANES):
        m = slope_galaxy[i] + c * slope_agn[i]
        u = work[SCALE + i] * m - level
        work[_U + i] = u
        work[_M + i] = m
        work[_MILLS + i] = _scaled_erfc(abs(u) * _ROOT_HALF)
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
        work[CURVATURE + i] += first * m * m
        work[_H + i] += second * m * m * m
        work[FACTOR + i] *= 0.5 * above
        work[EXPONENT + i] -= 0.5 * u * u if u > 0.0 else 0.0


@njit(**INNER)
def best_scales(buffer, work, power, limit, c, level):
    """
    Fill the scales that minimise chi2 at one fraction, and what goes with them.

    Parameters
    ----------
    buffer
        See `lanes.likelihoods`.
    work : `~numpy.ndarray`, shape (LIMITED_SIZE,)
        Vectors: work[DETECTED] says which lanes count, work[SCALE] where to begin. Filled are
        work[SCALE], work[CHI2] with half of chi2 but for a constant and the probabilities' part,
        work[CURVATURE] with half its second derivative, and probabilities work[FACTOR] times
        exp(work[EXPONENT]).
    power : `~numpy.ndarray` of int64, shape (LANES,)
        Scratch.
    limit : `~numpy.ndarray`, shape (2 n or more, LANES)
        Fluxes of galaxies and (for c = 1) tori over the errors of the n limits.
    c : float
        f / (1 - f).
    level : `~numpy.ndarray`, shape (n,)
        See `structs.Target`.
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
            s = work[SCALE + i]
            work[_G + i] = q * s - p
            work[CURVATURE + i] = q
            work[_H + i] = 0.0
            work[CHI2 + i] = s * (0.5 * q * s - p)
            work[FACTOR + i] = 1.0
            work[EXPONENT + i] = 0.0
        for m in range(n):
            _add_limit(work, power, limit[m], limit[n + m], c, level[m])
        far = 0.0
        for i in range(LANES):
            s = work[SCALE + i]
            new = max(s - work[_G + i] / work[CURVATURE + i], 0.0)
            step = new - s
            # the last step is small enough for three terms of a series
            work[SCALE + i] = new
            work[CHI2 + i] += step * (work[_G + i] + 0.5 * step * work[CURVATURE + i])
            work[CURVATURE + i] += step * work[_H + i]
            moved = abs(step) - _CLOSE * s
            far = max(far, moved if work[DETECTED + i] > 0.0 else 0.0)


@njit(**INNER)
def fill_light_limits(buffer, work, limit, n, limit_light):
    """
    Fill the limits' slopes in single precision.

    Parameters
    ----------
    buffer, limit
        See `best_scales`.
    work : `~numpy.ndarray`, shape (LIMITED_SIZE,)
        A vector is filled with what a scale is multiplied by to be of the order of its
        signal-to-noise ratio.
    n : int
        Number of limits.
    limit_light : `~numpy.ndarray` of float32, shape (2 n or more, LANES)
        Filled with the slopes over that.
    """
    for i in range(LANES):
        work[_UNIT + i] = np.sqrt(max(buffer[Q + i] + buffer[B + i], NO_LIGHT))
        work[_U + i] = 1.0 / work[_UNIT + i]
    for m in range(2 * n):
        for i in range(LANES):
            limit_light[m, i] = min(limit[m, i] * work[_U + i], _LARGEST)


@njit(**INNER)
def _add_light_limit(light, power, slope_galaxy, slope_agn, c, level):
    """Do what `_add_limit` does, in single precision."""
    zero = np.float32(0)
    half = np.float32(0.5)
    one = np.float32(1)
    two = np.float32(2)
    three = np.float32(3)
    six = np.float32(6)
    scale = power.view(np.float32)
    for i in range(LANES):
        m = slope_galaxy[i] + c * slope_agn[i]
        u = light[_S32 + i] * m - level
        t = three / (three + abs(u) * _ROOT_HALF_32)
        x = t + t - one
        # exp(z^2) erfc(z) as in `_scaled_erfc`, of degree 10: to 3e-7
        v = np.float32(2.346841757e-5)
        v = v * x + np.float32(7.026003732e-5)
        v = v * x - np.float32(1.714378741e-4)
        v = v * x - np.float32(9.910109220e-4)
        v = v * x - np.float32(4.088962160e-4)
        v = v * x + np.float32(8.933821693e-3)
        v = v * x + np.float32(3.984341770e-2)
        v = v * x + np.float32(1.034905910e-1)
        v = v * x + np.float32(1.967427433e-1)
        v = v * x + np.float32(2.944647372e-1)
        v = v * x + np.float32(3.580023050e-1)
        light[_MILLS32 + i] = v * t
        light[_V32 + i], power[i] = light_exponential(max(-half * u * u, np.float32(-80.0)))
        light[_U32 + i] = u
        light[_M32 + i] = m
    for i in range(LANES):
        u, m, mills = light[_U32 + i], light[_M32 + i], light[_MILLS32 + i]
        bell = light[_V32 + i] * scale[i]
        above = mills if u > zero else two - mills * bell
        hazard = _ROOT_TWO_OVER_PI_32 * (one if u > zero else bell) / above
        first = hazard * (hazard - u)
        # far out the difference has no digits
        v = one / max(u * u, one)
        first = one - v * (one - six * v) if u > np.float32(12) else first
        second = first * (hazard - u) + hazard * (first - one)
        second = two * v / max(u, one) if u > np.float32(12) else second
        light[_G32 + i] += hazard * m
        light[_D32 + i] += first * m * m
        light[_H32 + i] += second * m * m * m
        light[_PRODUCT32 + i] *= half * above
        light[_EXPONENT32 + i] -= half * u * u if u > zero else zero


@njit(**INNER)
def light_scales(buffer, work, light, power, limit, c, level, reference):
    """
    Do what `best_scales` does, in single precision.

    Parameters
    ----------
    light : `~numpy.ndarray` of float32
        Scratch, of 10 vectors or more.
    power : `~numpy.ndarray` of int32, shape (LANES,)
        Scratch.
    limit : `~numpy.ndarray` of float32
        From `fill_light_limits`, which was called.
    reference : float
        Half of chi2 less ln(prior) that has weight 1. Models of less weight need not be as good.
    buffer, work, c, level
        As there; work[CHI2] also holds what probabilities change in the last step.
    """
    c_light = np.float32(c)
    far = 1.0
    steps = 0
    while far > 0.0 and steps < _MOST:
        steps += 1
        for i in range(LANES):
            light[_S32 + i] = work[SCALE + i] * work[_UNIT + i]
            light[_G32 + i] = np.float32(0)
            light[_D32 + i] = np.float32(0)
            light[_H32 + i] = np.float32(0)
            light[_PRODUCT32 + i] = np.float32(1)
            light[_EXPONENT32 + i] = np.float32(0)
            work[FACTOR + i] = 1.0
        for m in range(level.size):
            _add_light_limit(
                light, power, limit[m], limit[level.size + m], c_light, np.float32(level[m])
            )
            if m % _FACTORS == _FACTORS - 1 or m == level.size - 1:
                for i in range(LANES):
                    work[FACTOR + i] *= light[_PRODUCT32 + i]
                    light[_PRODUCT32 + i] = np.float32(1)
        for i in range(LANES):
            q = buffer[Q + i] + c * (buffer[X2 + i] + c * buffer[B + i])
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            p = max(buffer[P + i], -1e200) + c * buffer[A + i]
            s = work[SCALE + i]
            t = work[_UNIT + i]
            g = q * s - p + light[_G32 + i] * t
            d = q + light[_D32 + i] * (t * t)
            h = light[_H32 + i] * (t * t * t)
            inverse = 1.0 / d
            # Newton's step, which converges from anywhere, and near the minimum (where it cannot
            # lead astray) what the third derivative changes
            step = -g * inverse
            bend = 0.5 * h * step * inverse
            step *= 1.0 - (bend if abs(bend) < _BEND else 0.0)
            new = max(s + step, 0.0)
            step = new - s
            chi2 = s * (0.5 * q * s - p) + step * (g + step * (0.5 * d + step * h / 6.0))
            work[SCALE + i] = new
            work[CHI2 + i] = chi2
            work[CURVATURE + i] = d + step * h
            work[EXPONENT + i] = light[_EXPONENT32 + i]
            # what the series misses goes with the fourth power of the step
            e = chi2 - light[_EXPONENT32 + i] - 0.5 * max(buffer[PRIOR + i], -1e200)
            e = min(max(e - reference, 0.0), _SLIGHT)
            close = _CLOSE_32 * (1.0 + e * (0.25 + 0.03125 * e))
            work[_G + i] = step * step - close * close * max(s * s, inverse)
        far = 0.0
        for i in range(LANES):
            far = max(far, work[_G + i] if work[DETECTED + i] > 0.0 else 0.0)
