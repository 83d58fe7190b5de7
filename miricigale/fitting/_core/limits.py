"""
Upper limits: the scale of a model that minimizes chi2 with error-function terms.

A limit F with error sigma adds T(u) = -2 ln(erfc(u / sqrt(2)) / 2), u = (s m - F) / sigma,
the probability that a measurement of the model flux s m lies below F (Sawicki 2012, PASP 124,
1208; Boquien et al. 2019, A&A 622, A103, section 4.3). T is convex and grows with u, so that what
detections alone allow is an upper bound, and Newton's method on the derivative, begun at the
scale that detections alone would have, comes down to the minimum from one side.

One limit (`_limit`) and one step (`_step`) stand once, for single models and for pairs side by side,
in either precision. Side by side the probabilities of the limits are multiplied rather than their
logarithms summed. For pairs that have little weight each single precision will do: what it could
not hold, the scale and the part of chi2 that detections add, stays in double precision; the limits'
part is of order 1, and rounding changes a weight by some 1e-6.
"""

import math

import numpy as np

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.structs import BLOCK, NO_LIGHT
from miricigale.utils._core.functions import exponential, polynomial
from miricigale.utils.compilation import PART, njit

# Offsets of the vectors in Lanes.limited: scale, half of chi2 and of its second derivative, the
# limits' probability over exp(exponent), the exponent, the scale without limits (0 in lanes that do
# not count), whether a model counts, change of what limits leave, unit of 1 / scale, work space.
_SCALE, _CHI2, _CURVATURE, _FACTOR, _EXPONENT, _DETECTED, _ALIVE, _CHANGE, _UNIT, _V = (
    i * BLOCK for i in range(10)
)
# Offsets in Lanes.limited32 or, in double precision, behind those: scale, derivatives of half of the
# limits' chi2, product of probabilities, their exponent.
_S, _G, _D, _H, _PRODUCT, _SUM = (i * BLOCK for i in range(6))
_TERMS = 10 * BLOCK
LIMITED_SIZE = 16 * BLOCK

_ROOT_HALF = 0.70710678118654752
_ROOT_TWO_OVER_PI = 0.79788456080286536
# Below this a term is 0 in double precision.
_NOTHING = -9.0
# Largest number of steps of Newton's method.
_MAX_STEPS = 60
# Size of the last step over the scale or its error, in double and in single precision.
_CLOSE = 1e-5
_CLOSE_32 = 5e-3
# The third derivative is taken into account in steps of less than one sigma, where it matters by
# less than this part.
_BEND = 0.1
# Minus logarithm of a weight for which a step may be seven times as large.
_SLIGHT = 10.0
# Number of factors that can be multiplied before the product could be too small.
_FACTORS = 8
# Largest flux ratio of single precision.
_LARGEST = 1e15
# What single precision may miss of the largest R.
_ROUNDING = 1e-3


# exp(z^2) erfc(z) / t for z >= 0 in 2 t - 1, with t = 3 / (3 + z): the Chebyshev interpolations (of
# scipy.special.erfcx) of degree 16, to 2e-12, and 10, to 3e-7.
_SCALED_ERFC = polynomial(
    (-7.909679668678854e-08, -1.327470214572296e-07, 8.281839527992843e-07, 1.295421122182736e-06,
     -5.739579827718830e-06, -9.890937187676496e-06, 3.581041826229913e-05, 9.213853674066139e-05,
     -1.827570762553639e-04, -1.011319029730867e-03, -4.041408907881644e-04, 8.942406098304561e-03,
     3.984258723799971e-02, 1.034890876840956e-01, 1.967427856984673e-01, 2.944648177153389e-01,
     3.580023023627791e-01),
    (2.346841757e-5, 7.026003732e-5, -1.714378741e-4, -9.910109220e-4, -4.088962160e-4,
     8.933821693e-3, 3.984341770e-2, 1.034905910e-1, 1.967427433e-1, 2.944647372e-1,
     3.580023050e-1),
)  # fmt: skip


@njit(**PART)
def _mills(u):
    """Mills' ratio of the normal distribution at abs(u), over sqrt(pi / 2)."""
    real = type(u)
    t = real(3.0) / (real(3.0) + abs(u) * real(_ROOT_HALF))
    return _SCALED_ERFC(t + t - real(1.0)) * t


@njit(**PART)
def _limit(u):
    """
    What one limit adds at u, in the precision of u.

    Returned are the derivatives of half of T (the hazard h, h (h - u) and so on), and factor and
    exponent of the probability factor exp(exponent).
    """
    real = type(u)
    zero = real(0.0)
    unity = real(1.0)
    half = real(0.5)
    mills = _mills(u)
    # of what is smaller than exp(-80) nothing is left compared with 1
    bell = exponential(max(-half * u * u, real(-80.0)))
    above = mills if u > zero else real(2.0) - mills * bell
    hazard = real(_ROOT_TWO_OVER_PI) * (unity if u > zero else bell) / above
    first = hazard * (hazard - u)
    third = first * (hazard - u) + hazard * (first - unity)
    # far out differences have no digits
    t = unity / max(u * u, unity)
    series = t * (unity - t * (real(3.0) - t * (real(15.0) - t * (real(105.0) - t * real(945.0)))))
    far = u > real(15.0)
    first = hazard * hazard * series if far else first
    third = real(2.0) * t / max(u, unity) if far else third
    return hazard, first, third, half * above, (-half * u * u if u > zero else zero)


@njit(**PART)
def _mixed(u, p):
    """
    `_limit`, of one that is wrong with a prior probability p > 0, in the precision of u: (1 - p) P + p.

    It is not convex, and where it is not no second derivative is returned, so that steps are of the detections.
    """
    first, second, third, factor, exponent = _limit(u)
    real = type(u)
    zero = real(0.0)
    unity = real(1.0)
    good = (unity - p) * factor * exponential(max(exponent, real(-80.0)))
    total = good + p
    share = good / total
    second = share * (second - (unity - share) * first * first)
    return share * first, max(second, zero), third if share == unity else zero, total, zero


@njit(**PART)
def _add_limit(terms, i, m, derivatives):
    """Add what `_limit` or `_mixed` returned to the sums of lane i, whose flux over its error is m for scale 1."""
    first, second, third, factor, exponent = derivatives
    terms[_G + i] += first * m
    terms[_D + i] += second * m * m
    terms[_H + i] += third * m * m * m
    terms[_PRODUCT + i] *= factor
    terms[_SUM + i] += exponent


@njit(**PART)
def _step(s, g, d, h):
    """
    Step to a lower chi2 from a scale s.

    Newton's, which converges from anywhere, and near the minimum (where it cannot lead astray) what
    the third derivative changes; g, d and h are the derivatives of half of chi2.
    """
    inverse = 1.0 / d
    step = -g * inverse
    bend = 0.5 * h * step * inverse
    step *= 1.0 - (bend if abs(bend) < _BEND and step * step * d < 1.0 else 0.0)
    return max(s + step, 0.0) - s


@njit(**PART)
def limited_scale(p, q, limits):
    """
    Best scale of one model, not negative.

    p = <m, wF> and q = <m, wm> are over the detections, ``limits.slope`` holds the model's fluxes
    (not negative) over the errors of the limits. Returned are also R, chi2 of a model without light
    minus that of this one, and the variance of the scale: 2 over the second derivative of chi2.
    """
    q = max(q, 1e-300)
    s = max(p, 0.0) / q
    d = q
    chi2 = 0.0
    for _ in range(_MAX_STEPS):
        g = q * s - p
        d = q
        h = 0.0
        chi2 = s * (q * s - 2.0 * p)
        for i in range(limits.level.size):
            m = limits.slope[i]
            u = s * m - limits.level[i]
            if u > _NOTHING:
                if limits.wrong[i] > 0.0:
                    first, second, third, factor, exponent = _mixed(u, limits.wrong[i])
                else:
                    first, second, third, factor, exponent = _limit(u)
                g += first * m
                d += second * m * m
                h += third * m * m * m
                chi2 -= 2.0 * (math.log(factor) + exponent)
        step = _step(s, g, d, h)
        s += step
        # the last step is small enough for a series
        chi2 += step * (2.0 * g + step * (d + step * h / 3.0))
        d += step * h
        tolerance = _CLOSE * _CLOSE
        if step * step <= tolerance * max(tolerance * s * s, 1.0 / d):
            break
    return s, max(limits.dark - chi2, 0.0) if s > 0.0 else 0.0, 1.0 / d


@njit(**PART)
def _best_scales(buffer, work, terms, limit, c, level, wrong, reference, close):
    """
    Fill the scales that minimize chi2 at one fraction, and what goes with them.

    work[_DETECTED] says which lanes count, work[_SCALE] where to begin. Filled are work[_SCALE],
    work[_CHI2] with half of chi2 but for a constant and the probabilities, work[_CURVATURE] with half
    its second derivative, and probabilities work[_FACTOR] times exp(work[_EXPONENT]). The limits' part
    is worked out in the precision of ``terms``, which is scratch, and ``limit``, fluxes of galaxies
    and (for c = 1) AGN models over the errors of the limits and the unit of the scale. ``reference`` is half
    of chi2 less ln(prior) that has weight 1: models of less need not be as good. ``close`` is the
    size of the last step over the scale or its error.
    """
    real = terms.dtype.type
    ratio = real(c)
    n = level.size
    far = 1.0
    steps = 0
    while far > 0.0 and steps < _MAX_STEPS:
        steps += 1
        for i in range(BLOCK):
            terms[_S + i] = real(work[_SCALE + i] * work[_UNIT + i])
        terms[_PRODUCT : _PRODUCT + BLOCK] = 1.0
        work[_FACTOR : _FACTOR + BLOCK] = 1.0
        terms[_G : _H + BLOCK] = 0.0
        terms[_SUM : _SUM + BLOCK] = 0.0
        for j in range(n):
            galaxy = limit[j]
            agn = limit[n + j]
            top = real(level[j])
            p_wrong = real(wrong[j])
            if p_wrong > real(0.0):
                for i in range(BLOCK):
                    m = galaxy[i] + ratio * agn[i]
                    _add_limit(terms, i, m, _mixed(terms[_S + i] * m - top, p_wrong))
            else:
                for i in range(BLOCK):
                    m = galaxy[i] + ratio * agn[i]
                    _add_limit(terms, i, m, _limit(terms[_S + i] * m - top))
            if j % _FACTORS == _FACTORS - 1 or j == n - 1:
                for i in range(BLOCK):
                    work[_FACTOR + i] *= terms[_PRODUCT + i]
                    terms[_PRODUCT + i] = real(1.0)
        for i in range(BLOCK):
            q = buffer[at.Q + i] + c * (buffer[at.X2 + i] + c * buffer[at.B + i])
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            # a pair that is not there has no p either
            p = max(buffer[at.P + i], -1e200) + c * buffer[at.A + i]
            s = work[_SCALE + i]
            t = work[_UNIT + i]
            g = q * s - p + terms[_G + i] * t
            d = q + terms[_D + i] * (t * t)
            h = terms[_H + i] * (t * t * t)
            step = _step(s, g, d, h)
            # the last step is small enough for a series
            chi2 = s * (0.5 * q * s - p) + step * (g + step * (0.5 * d + step * h / 6.0))
            work[_SCALE + i] = s + step
            work[_CHI2 + i] = chi2
            work[_CURVATURE + i] = d + step * h
            work[_EXPONENT + i] = terms[_SUM + i]
            # what the series misses goes with the fourth power of the step
            e = chi2 - terms[_SUM + i] - 0.5 * max(buffer[at.PRIOR + i], -1e200)
            e = min(max(e - reference, 0.0), _SLIGHT)
            tolerance = close * (1.0 + e * (0.25 + 0.03125 * e))
            work[_V + i] = step * step - tolerance * tolerance * max(s * s, 1.0 / d)
        far = 0.0
        for i in range(BLOCK):
            far += 1.0 if work[_V + i] > 0.0 and work[_DETECTED + i] > 0.0 else 0.0


@njit(**PART)
def limited_likelihoods(of_frac, lanes, limits, reference, scale_error, record, delta, single):
    """
    Do what `lanes.likelihoods` does, for objects with upper limits.

    Scales are sought where pairs evaluated before have theirs; models that are more than ``delta``
    below the reference without the limits get no weight.

    Returned are the number of models whose R reaches ``record``, to rounding (in single precision
    somewhat more), and the largest exponent of a weight; where it is large the reference must be raised.
    """
    buffer = lanes.buffer
    work = lanes.limited
    level = limits.level
    n = limits.level.size
    for i in range(BLOCK):
        # of the order of the signal-to-noise ratio of a scale of 1
        unit = np.sqrt(max(buffer[at.Q + i] + buffer[at.B + i], NO_LIGHT))
        work[_UNIT + i] = unit if single else 1.0
    if single:
        for m in range(2 * n):
            for i in range(BLOCK):
                lanes.limit32[m, i] = min(lanes.limit[m, i] / work[_UNIT + i], _LARGEST)
    buffer[at.W0 : at.WR + BLOCK] = 0.0
    reached = 0.0
    record -= _ROUNDING if single else 0.0
    over = 0.0
    warm = False
    zero_level = 0.5 * (limits.dark - reference)
    min_value = max(reference - delta, -1e200)
    for j in range(of_frac.shape[1]):
        c = of_frac[at.RATIO, j]
        f = of_frac[at.PRIOR_FRAC, j]
        lanes.frac_sum[j] = 0.0
        limit_share = lanes.limit_share[j * BLOCK : (j + 1) * BLOCK]
        weight = lanes.weight[j * BLOCK : (j + 1) * BLOCK]
        for i in range(BLOCK):
            q = buffer[at.Q + i] + c * (buffer[at.X2 + i] + c * buffer[at.B + i])
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            p = max(max(buffer[at.P + i], -1e200) + c * buffer[at.A + i], 0.0)
            s = p / q
            # limits only lower R: what has no weight without them has none with them
            value = max(p * s, 0.0) + buffer[at.PRIOR + i]
            work[_ALIVE + i] = 1.0 if value >= min_value else 0.0
            work[_DETECTED + i] = s if value >= min_value else 0.0
            # begin where limits leave as much of the scale as of the last pair's at this fraction,
            # but for what was different at the last fraction
            part = limit_share[i] * (work[_CHANGE + i] if warm else 1.0)
            work[_SCALE + i] = s * min(part, 1.0)
        some = 0.0
        for i in range(BLOCK):
            some += work[_ALIVE + i]
        warm = some > 0.0
        if not warm:
            weight[:] = 0.0
            continue
        if single:
            _best_scales(
                buffer, work, lanes.limited32, lanes.limit32, c, level, limits.wrong, zero_level,
                _CLOSE_32,
            )  # fmt: skip
        else:
            _best_scales(
                buffer, work, work[_TERMS:], lanes.limit, c, level, limits.wrong, zero_level, _CLOSE
            )
        for i in range(BLOCK):
            detected_scale = work[_DETECTED + i]
            detected_scale = (
                detected_scale if detected_scale > 0.0 else max(work[_SCALE + i], NO_LIGHT)
            )
            part = min(max(work[_SCALE + i] / detected_scale, 1e-3), 1.0)
            work[_CHANGE + i] = min(part / limit_share[i], 4.0)
            limit_share[i] = part
        some = 0.0
        for i in range(BLOCK):
            # half of R but for the product of probabilities
            e = 0.5 * limits.dark - work[_CHI2 + i] + work[_EXPONENT + i]
            e = e if work[_ALIVE + i] > 0.0 else -1e4
            work[_EXPONENT + i] = e
            some += 1.0 if 2.0 * e >= record else 0.0
        for i in range(BLOCK if some > 0.0 else 0):
            e = work[_EXPONENT + i]
            if 2.0 * e >= record:
                value = 2.0 * e + 2.0 * math.log(max(work[_FACTOR + i], 1e-300))
                reached += 1.0 if value >= record else 0.0
        for i in range(BLOCK):
            alive = work[_ALIVE + i]
            e = work[_EXPONENT + i] + 0.5 * (max(buffer[at.PRIOR + i], -1e200) - reference)
            over = max(over, e if alive > 0.0 else 0.0)
            t = exponential(min(max(e, -700.0), 700.0)) * f * work[_FACTOR + i] * alive
            work[_V + i] = t
        for i in range(BLOCK):
            t = work[_V + i]
            s = work[_SCALE + i]
            inverse = 1.0 / work[_CURVATURE + i]
            y = c * buffer[at.SHARE + i]
            phi = y / (1.0 + y)
            s2 = s * s + scale_error * inverse
            buffer[at.W0 + i] += t
            buffer[at.W1 + i] += t * s
            buffer[at.V1 + i] += t * s * c
            buffer[at.W2 + i] += t * s2
            buffer[at.U2 + i] += t * s2 * c
            buffer[at.V2 + i] += t * s2 * c * c
            buffer[at.F1 + i] += t * phi
            buffer[at.F2 + i] += t * phi * phi
            buffer[at.WR + i] += t * s * s * work[_CURVATURE + i]
            buffer[at.WZ + i] += t if s == 0.0 else 0.0
        # sums apart from stores: see `agn_products`
        total = 0.0
        for i in range(BLOCK):
            total += work[_V + i]
        lanes.frac_sum[j] = total
        for i in range(BLOCK):
            weight[i] = work[_V + i]
    return reached, over
