"""
Pairs side by side in single precision, for those that have little weight each.

With x* the best x of a pair between the smallest and largest, R* = R(x*), s* the scale and
D* = <m, wm> there, R* D(x) - N(x)^2 is a quadratic in x that is 0 at x*, so that ::

    R* - R(x) = (x - x*) (K (x - x*) + M) / D(x),    K = R* b - a^2,

with M = 0 unless x* is an end of the range. What is worked out in double precision is x - x*, and
R*, which single precision could not distinguish from that of other pairs; the rest is of order 1, and
rounding changes a weight by some 1e-7.
"""

import numpy as np

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.structs import BLOCK, NO_LIGHT
from miricigale.utils._core.functions import exponential
from miricigale.utils.compilation import PART, njit

# Offsets of the vectors in Lanes.single: N, D, K, M, the scale's variance, the share, x*, the
# other fraction there ...
_P, _A, _Q, _X, _B, _K, _M, _VAR, _SHARE, _BEST, _OTHER = (i * BLOCK for i in range(11))
# ... sums over the fractions ...
_S0, _S1, _S2, _Y1, _SY, _Y2, _F1, _F2, _SZ = (i * BLOCK for i in range(11, 20))
# ... exponents, work space, and weights at every fraction, over those at x*.
_D, _I, _PHI = (i * BLOCK for i in range(20, 23))
_T = 23 * BLOCK

# Above this a share times any odds is as good as infinite, and would not fit with others.
_MOST = 1e11
# Products of the exponential of what is less than this would be too small for fast numbers.
_LOWEST = np.float32(-50.0)


def single_size(n_ratio):
    """Length of ``Lanes.single``."""
    return _T + n_ratio * BLOCK


@njit(**PART)
def pair_weight(lanes, single, j, i):
    """Prior * likelihood of the pair in lane i at a fraction."""
    if single:
        return lanes.buffer[at.TOP + i] * lanes.single[_T + j * BLOCK + i]
    return lanes.weight[j * BLOCK + i]


@njit(**PART)
def _prepare(buffer, light, low, high, reference, scale_error):
    """
    Fill the vectors of ``light`` that say what the pairs are.

    Weights at x* go to buffer[W0], units of the scales to buffer[W1], R* to buffer[W2], x* to
    buffer[WR], which are not needed before the sums.
    """
    for i in range(BLOCK):
        p = buffer[at.P + i]
        a = buffer[at.A + i]
        q = buffer[at.Q + i]
        x2 = buffer[at.X2 + i]
        b = buffer[at.B + i]
        t = 0.5 * x2
        rise = a * q - p * t
        fall = p * b - a * t
        inner = rise / fall if fall > 0.0 else 1e300
        best = min(max(inner, low), high) if rise > 0.0 else low
        num = max(p + best * a, 0.0)
        norm = q + best * (x2 + best * b)
        dark = norm <= NO_LIGHT
        inverse_norm = 1.0 / norm if not dark else NO_LIGHT
        factor = num * inverse_norm
        r = num * factor
        k = -0.5 * inverse_norm * (r * b - a * a)
        m = -inverse_norm * ((r * b - a * a) * best + r * t - p * a)
        unit = max(factor, np.sqrt(inverse_norm))
        factor = inverse_norm / unit
        e = 0.5 * (r + buffer[at.PRIOR + i] - reference)
        e = exponential(min(max(e, -700.0), 700.0))
        buffer[at.W0 + i] = e if buffer[at.PRIOR + i] > -1e200 else 0.0
        buffer[at.W1 + i] = unit
        buffer[at.W2 + i] = r
        buffer[at.WR + i] = best
        light[_P + i] = max(p * factor, -1e30)
        light[_A + i] = a * factor
        light[_Q + i] = q * inverse_norm if not dark else 1.0
        light[_X + i] = x2 * inverse_norm
        light[_B + i] = b * inverse_norm
        light[_K + i] = k if num > 0.0 else 0.0
        light[_M + i] = m if num > 0.0 and best != inner else 0.0
        light[_VAR + i] = scale_error * factor / unit
        light[_SHARE + i] = min(buffer[at.SHARE + i], _MOST)
        light[_BEST + i] = best
        y = best * buffer[at.SHARE + i]
        light[_OTHER + i] = y / (1.0 + y)


@njit(**PART)
def single_likelihoods(of_frac, lanes, reference, scale_error, record):
    """
    Do what `lanes.likelihoods` does, in single precision.

    Weights at every fraction are those of `pair_weight`. What is counted is pairs whose R*, which no
    R exceeds, reaches ``record``.
    """
    buffer = lanes.buffer
    light = lanes.single
    zero = np.float32(0)
    unity = np.float32(1)
    c_0 = of_frac[at.RATIO, 0]
    c_1 = of_frac[at.RATIO, -1]
    _prepare(buffer, light, c_0, c_1, reference, scale_error)
    light[_S0 : _SZ + BLOCK] = 0.0
    reached = 0.0
    n_dark = 0.0
    for i in range(BLOCK):
        reached += 1.0 if buffer[at.W2 + i] >= record else 0.0
        p = buffer[at.P + i]
        a = buffer[at.A + i]
        n_dark += 1.0 if p > -1e29 and min(p + c_0 * a, p + c_1 * a) <= 0.0 else 0.0
    # where a fraction has R = 0 the difference to R* is not that of the formula
    some_dark = n_dark > 0.0
    for j in range(of_frac.shape[1]):
        row = _T + j * BLOCK
        c_64 = of_frac[at.RATIO, j]
        c = np.float32(c_64)
        f = np.float32(of_frac[at.PRIOR_FRAC, j])
        for i in range(BLOCK):
            d = np.float32(c_64 - buffer[at.WR + i])
            y = c * light[_SHARE + i]
            den = light[_Q + i] + c * (light[_X + i] + c * light[_B + i])
            # one division for both 1 / D and y / (1 + y)
            inverse_both = unity / (den * (unity + y))
            inverse = inverse_both * (unity + y)
            light[_PHI + i] = y * inverse_both * den
            light[_I + i] = inverse
            light[_D + i] = d * (light[_K + i] * d + light[_M + i]) * inverse
        if some_dark:
            for i in range(BLOCK):
                # R* - R is R* there
                num = buffer[at.P + i] + c_64 * buffer[at.A + i]
                light[_D + i] = light[_D + i] if num > 0.0 else -0.5 * buffer[at.W2 + i]
        for i in range(BLOCK):
            t = exponential(max(light[_D + i], _LOWEST)) * f
            light[row + i] = t
            s = max(light[_P + i] + c * light[_A + i], zero) * light[_I + i]
            # about the values at x*, so that means and squares keep their digits
            ds = s - unity
            dy = c * s - light[_BEST + i]
            phi = light[_PHI + i] - light[_OTHER + i]
            # what the scale's own variance adds
            spread = t * light[_VAR + i] * light[_I + i]
            t_ds = t * ds
            t_dy = t * dy
            t_phi = t * phi
            light[_S0 + i] += t
            light[_S1 + i] += t_ds
            light[_S2 + i] += t_ds * ds + spread
            light[_Y1 + i] += t_dy
            light[_SY + i] += t_ds * dy + spread * c
            light[_Y2 + i] += t_dy * dy + spread * (c * c)
            light[_F1 + i] += t_phi
            light[_F2 + i] += t_phi * phi
        if some_dark:
            for i in range(BLOCK):
                dark = light[_P + i] + c * light[_A + i] <= zero
                light[_SZ + i] += light[row + i] if dark else zero
    for j in range(of_frac.shape[1]):
        total = 0.0
        for i in range(BLOCK):
            total += buffer[at.W0 + i] * light[_T + j * BLOCK + i]
        lanes.frac_sum[j] = total
    for i in range(BLOCK):
        w0 = buffer[at.W0 + i]
        unit = buffer[at.W1 + i]
        first = w0 * unit
        second = first * unit
        s0 = np.float64(light[_S0 + i])
        s1 = np.float64(light[_S1 + i])
        y1 = np.float64(light[_Y1 + i])
        f1 = np.float64(light[_F1 + i])
        best = np.float64(light[_BEST + i])
        best_share = np.float64(light[_OTHER + i])
        w1 = first * (s0 + s1)
        v1 = first * (best * s0 + y1)
        buffer[at.W0 + i] = w0 * s0
        buffer[at.TOP + i] = w0
        buffer[at.W1 + i] = w1
        buffer[at.W2 + i] = second * (s0 + 2.0 * s1 + light[_S2 + i])
        buffer[at.V1 + i] = v1
        buffer[at.U2 + i] = second * (best * (s0 + s1) + y1 + light[_SY + i])
        buffer[at.V2 + i] = second * (best * (best * s0 + 2.0 * y1) + light[_Y2 + i])
        buffer[at.F1 + i] = w0 * (best_share * s0 + f1)
        buffer[at.F2 + i] = w0 * (best_share * (best_share * s0 + 2.0 * f1) + light[_F2 + i])
        buffer[at.WZ + i] = w0 * light[_SZ + i]
        # sum of l R, with R = (p + c a) s; lanes without weight have no p either
        p = buffer[at.P + i]
        buffer[at.WR + i] = (p if p > -1e200 else 0.0) * w1 + buffer[at.A + i] * v1
    return reached
