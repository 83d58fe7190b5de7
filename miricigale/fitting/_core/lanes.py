"""
Pairs of galaxy and torus side by side, in double precision, at every AGN fraction.

For a galaxy with p = <G, wF>, q = <G, wG> and a torus with a = <A, wF>, b = <A, wA>,
X = <G, wA>, the model s (G + x A) with x = c L_dust has the best scale
s = (p + x a) / (q + 2 x X + x^2 b) and |F|^2_w - chi2 = R = (p + x a) s. Where p + x a is
negative the best scale that is not negative is 0 and R = 0.
"""

import numpy as np

from miricigale.fitting._core.limits import limited_scale
from miricigale.fitting._core.options import INNER, ONCE
from miricigale.fitting._core.structs import NO_LIGHT
from miricigale.utils.compilation import njit

__all__ = [
    "LANES",
    "N_INPUT",
    "SIZE",
    "exponential",
    "fill_block",
    "fill_dead",
    "gather",
    "lane_model",
    "light_exponential",
    "likelihoods",
]

#: Pairs evaluated side by side: a block of galaxies with one torus, or single pairs.
LANES = 64


# Offsets of the vectors in Scratch.buffer, with A, X and B for x = c: what the pairs
# are ...
P, Q, X2, A, B, PRIOR, SHARE, DUST = (i * LANES for i in range(8))
# ... sums over the fractions of prior * likelihood l, l s, l s^2, l c s, l c s^2, l c^2 s^2, the
# other fraction phi and its square, l of s = 0 and l (s / sigma_s)^2; the largest R ...
W0, W1, W2, V1, U2, V2, F1, F2, WZ, WR, TOP = (i * LANES for i in range(8, 19))
# ... and work space.
_T, _S, _S2, _PHI = (i * LANES for i in range(19, 23))
#: Number of vectors that say what the pairs are, and length of the whole buffer.
N_INPUT = 8
SIZE = 23 * LANES

_LOG2E = 1.4426950408889634
_LN2_HIGH = 0.6931471803691238
_LN2_LOW = 1.9082149292705877e-10
_LOWEST = -700.0
_LOG2E_32 = np.float32(1.4426950408889634)
_LN2_HIGH_32 = np.float32(0.693359375)
_LN2_LOW_32 = np.float32(-2.12194440e-4)


@njit(**ONCE)
def fill_dead(buffer, index, start):
    """Fill the lanes from ``start`` on with pairs of no weight."""
    for i in range(max(start, 0), LANES):
        buffer[P + i] = -1e300
        buffer[Q + i] = 1.0
        buffer[X2 + i] = 0.0
        buffer[A + i] = 0.0
        buffer[B + i] = 0.0
        buffer[PRIOR + i] = -1e300
        buffer[SHARE + i] = 0.0
        buffer[DUST + i] = 0.0
        index[0, i] = 0
        index[1, i] = 0


@njit(**ONCE)
def fill_block(buffer, index, run, n_run, pq, blocks, block, cross, a, b, k, log_torus, share):
    """Fill the lanes with a block of galaxies and one torus; those not in the run are dead."""
    last = run[n_run - 1]
    for i in range(LANES):
        d = blocks[0, block, i]
        buffer[P + i] = -1e300
        buffer[Q + i] = pq[1, block, i]
        buffer[X2 + i] = 2.0 * cross[0, i] * d
        buffer[A + i] = a * d
        buffer[B + i] = b * d * d
        buffer[PRIOR + i] = -1e300
        buffer[SHARE + i] = blocks[2, block, i] * share
        buffer[DUST + i] = d
    for i in range(LANES):
        index[0, i] = block * LANES + min(i, last)
        index[1, i] = k
    for j in range(n_run):
        i = run[j]
        buffer[P + i] = pq[0, block, i]
        buffer[PRIOR + i] = log_torus + blocks[1, block, i]


@njit(**ONCE)
def gather(pending, index, run, n_run, pq, blocks, block, cross, a, b, k, log_torus, share, filled):
    """Add the pairs of a short run to those gathered; returns how many there are now."""
    for j in range(n_run):
        i = run[j]
        d = blocks[0, block, i]
        pending[P + filled] = pq[0, block, i]
        pending[Q + filled] = pq[1, block, i]
        pending[X2 + filled] = 2.0 * cross[0, i] * d
        pending[A + filled] = a * d
        pending[B + filled] = b * d * d
        pending[PRIOR + filled] = log_torus + blocks[1, block, i]
        pending[SHARE + filled] = blocks[2, block, i] * share
        pending[DUST + filled] = d
        index[2, filled] = block * LANES + i
        index[3, filled] = k
        filled += 1
    return filled


@njit(**INNER)
def lane_model(lanes, limits, c, i, floor):
    """
    Scale, R and variance of the scale of the pair in lane i at one fraction, c = f / (1 - f).

    With limits, those whose R is below ``floor`` without them are left as they are then.
    """
    buffer, slope = lanes.buffer, lanes.slope
    p = buffer[P + i] + c * buffer[A + i]
    q = buffer[Q + i] + c * (buffer[X2 + i] + c * buffer[B + i])
    q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
    inverse = 1.0 / q
    s = max(p, 0.0) * inverse
    r = max(p, 0.0) * s
    if limits is not None and r >= floor:
        n = limits.bands.size
        for m in range(n):
            slope[m] = lanes.limit[m, i] + c * lanes.limit[n + m, i]
        s, r, inverse = limited_scale(p, q, slope, limits.level, limits.dark)
    return s, r, inverse


@njit(**INNER)
def exponential(e):
    """
    exp(e) for e from -700 to 700 to 1e-11, as a number and the bits of a power of two.

    After Cody & Waite.
    """
    m = np.floor(e * _LOG2E + 0.5)
    r = e - m * _LN2_HIGH
    r = r - m * _LN2_LOW
    v = 1.0 / 362880.0
    v = v * r + 1.0 / 40320.0
    v = v * r + 1.0 / 5040.0
    v = v * r + 1.0 / 720.0
    v = v * r + 1.0 / 120.0
    v = v * r + 1.0 / 24.0
    v = v * r + 1.0 / 6.0
    v = v * r + 0.5
    v = v * r + 1.0
    v = v * r + 1.0
    return v, np.int64(np.int32(m) + 1023) << np.int64(52)


@njit(**INNER)
def light_exponential(e):
    """Do what `exponential` does for e from -80 to 80, in single precision."""
    m = np.floor(e * _LOG2E_32 + np.float32(0.5))
    r = e - m * _LN2_HIGH_32
    r = r - m * _LN2_LOW_32
    v = np.float32(1.9875691500e-4)
    v = v * r + np.float32(1.3981999507e-3)
    v = v * r + np.float32(8.3334519073e-3)
    v = v * r + np.float32(4.1665795894e-2)
    v = v * r + np.float32(1.6666665459e-1)
    v = v * r + np.float32(5.0000001201e-1)
    v = v * (r * r) + r + np.float32(1)
    return v, (np.int32(m) + np.int32(127)) << np.int32(23)


@njit(**ONCE)
def likelihoods(
    buffer, power, weight, ratio, frac_prior, first, reference, scale_error, out
):  # fmt: skip
    """
    Evaluate the pairs in the lanes at every AGN fraction and sum over the fractions.

    Parameters
    ----------
    buffer : `~numpy.ndarray`
        Vectors of LANES pairs at offsets known to the compiler, which can then see that they do
        not overlap.
    power : `~numpy.ndarray` of int64, shape (LANES,)
        Scratch.
    weight : `~numpy.ndarray`, shape (n_ratio * LANES,) or more
        Filled with prior * likelihood.
    ratio, frac_prior, first
        c = f / (1 - f) of the fractions above 0, and priors of all, these from ``first`` on.
    reference, scale_error : float
        R + 2 ln(prior) that has weight 1; whether the scale's variance counts.
    out : `~numpy.ndarray`, shape (n_ratio,)
        Filled with the sums of the weights.

    Returns
    -------
    top : float
        Largest R.
    """
    two = power.view(np.float64)
    low = 1e300
    c_0, c_1 = ratio[0], ratio[-1]
    for i in range(LANES):
        # the numerator of the scale is linear in c
        p, a = buffer[P + i], buffer[A + i]
        low = min(low, min(p + c_0 * a, p + c_1 * a) if p > -1e29 else 1e300)
        buffer[W0 + i] = 0.0
        buffer[W1 + i] = 0.0
        buffer[W2 + i] = 0.0
        buffer[V1 + i] = 0.0
        buffer[U2 + i] = 0.0
        buffer[V2 + i] = 0.0
        buffer[F1 + i] = 0.0
        buffer[F2 + i] = 0.0
        buffer[WZ + i] = 0.0
        buffer[TOP + i] = 0.0
    for j in range(ratio.size):
        c = ratio[j]
        f = frac_prior[j + first]
        for i in range(LANES):
            p = max(buffer[P + i] + c * buffer[A + i], 0.0)
            q = buffer[Q + i] + c * (buffer[X2 + i] + c * buffer[B + i])
            # without light in the used bands there is no scale to speak of
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            # one division for both 1 / q and y / (1 + y)
            y = c * buffer[SHARE + i]
            both = 1.0 / (q * (1.0 + y))
            inverse = both * (1.0 + y)
            phi = y * both * q
            s = p * inverse
            r = p * s
            e = 0.5 * (r + buffer[PRIOR + i] - reference)
            buffer[TOP + i] = max(buffer[TOP + i], r)
            v, power[i] = exponential(min(max(e, _LOWEST), 700.0))
            buffer[_T + i] = v * f
            buffer[_S + i] = s
            buffer[_S2 + i] = s * s + scale_error * inverse
            buffer[_PHI + i] = phi
        for i in range(LANES):
            t = buffer[_T + i] * two[i]
            s = buffer[_S + i]
            phi = buffer[_PHI + i]
            buffer[_T + i] = t
            weight[j * LANES + i] = t
            t1 = t * s
            t2 = t * buffer[_S2 + i]
            tp = t * phi
            buffer[W0 + i] += t
            buffer[W1 + i] += t1
            buffer[V1 + i] += t1 * c
            buffer[W2 + i] += t2
            buffer[U2 + i] += t2 * c
            buffer[V2 + i] += t2 * (c * c)
            buffer[F1 + i] += tp
            buffer[F2 + i] += tp * phi
        # sums apart from stores: see `agn_products`
        f_sum = 0.0
        for i in range(LANES):
            f_sum += buffer[_T + i]
        out[j] = f_sum
    if low <= 0.0:
        for j in range(ratio.size):
            c = ratio[j]
            for i in range(LANES):
                dark = buffer[P + i] + c * buffer[A + i] <= 0.0
                buffer[WZ + i] += weight[j * LANES + i] if dark else 0.0
    top = 0.0
    for i in range(LANES):
        # sum of l R, with R = (p + c a) s; lanes without weight have no p either
        buffer[WR + i] = buffer[P + i] * buffer[W1 + i] + buffer[A + i] * buffer[V1 + i]
        top = max(top, buffer[TOP + i])
    return top
