"""
Upper limits: the scale of a model that minimises chi2 with error-function terms.

A limit F with error sigma adds T(u) = -2 ln(erfc(u / sqrt(2)) / 2), u = (s m - F) / sigma,
the probability that a measurement of the model flux s m lies below F (Sawicki 2012, PASP 124,
1208; Boquien et al. 2019, A&A 622, A103, section 4.3). T is convex and grows with u, so that what
detections alone allow is an upper bound, and Newton's method on the derivative, begun at the
scale that detections alone would have, comes down to the minimum from one side.
"""

import math

from miricigale.fitting._core.options import EXACT
from miricigale.utils.compilation import njit

__all__ = ["limit_term", "limited_scale"]


_ROOT_HALF = 0.70710678118654752
_ROOT_2PI = 2.5066282746310002
# Below this the term is 0 in double precision, above the other the asymptotic series is used.
_NOTHING = -9.0
_SERIES = 20.0


@njit(**EXACT)
def _far(u):
    """1 - u times Mills' ratio of the normal distribution, for u >= 20 (to 1e-15)."""
    t = 1.0 / (u * u)
    return t * (1.0 - t * (3.0 - t * (15.0 - t * (105.0 - t * (945.0 - t * 10395.0)))))


@njit(**EXACT)
def limit_term(u):
    """T(u), the term of chi2 of one limit."""
    if u < _SERIES:
        return -2.0 * math.log(0.5 * math.erfc(u * _ROOT_HALF))
    return u * u + 2.0 * math.log(u * _ROOT_2PI) - 2.0 * math.log1p(-_far(u))


@njit(**EXACT)
def _slopes(u):
    """Half the first and second derivative of T."""
    if u < _SERIES:
        hazard = math.exp(-0.5 * u * u) / (0.5 * _ROOT_2PI * math.erfc(u * _ROOT_HALF))
        return hazard, hazard * (hazard - u)
    rest = _far(u)
    hazard = u / (1.0 - rest)
    return hazard, hazard * hazard * rest


@njit(**EXACT)
def limited_scale(p, q, slope, level, dark):
    """
    Best scale of one model.

    Parameters
    ----------
    p, q : float
        <m, wF> and <m, wm> over the detections.
    slope, level : `~numpy.ndarray`, shape (n_limits,) or more
        Model flux (not negative) and limiting flux over the error of the limit.
    dark : float
        Sum of the terms of a model without light.

    Returns
    -------
    s : float
        Scale, not negative.
    r : float
        Chi2 of a model without light minus that of this one, not negative.
    inverse : float
        Variance of the scale: 2 over the second derivative of chi2.
    """
    q = max(q, 1e-300)
    s = max(p, 0.0) / q
    for _ in range(100):
        first = q * s - p
        second = q
        for i in range(level.size):
            u = s * slope[i] - level[i]
            if u > _NOTHING:
                h, d = _slopes(u)
                first += h * slope[i]
                second += d * slope[i] * slope[i]
        step = first / second
        if s == 0.0 or abs(step) <= 1e-10 * s:
            break
        s = max(s - step, 0.0)
    r = s * (2.0 * p - q * s) + dark
    for i in range(level.size):
        u = s * slope[i] - level[i]
        if u > _NOTHING:
            r -= limit_term(u)
    return s, max(r, 0.0) if s > 0.0 else 0.0, 1.0 / second
