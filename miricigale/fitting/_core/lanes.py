"""
Pairs of galaxy and AGN model side by side, in double precision, at every AGN fraction.

For a galaxy with p = <G, wF>, q = <G, wG> and an AGN model with a = <A, wF>, b = <A, wA>,
X = <G, wA>, the model s (G + x A) with x = c L_dust has the best scale
s = (p + x a) / (q + 2 x X + x^2 b) and |F|^2_w - chi2 = R = (p + x a) s. Where p + x a is
negative the best scale that is not negative is 0 and R = 0.
"""

import numpy as np
from numba.extending import intrinsic

from miricigale.fitting._core.structs import (
    BLOCK,
    DUST,
    LOG_GALAXY,
    NO_LIGHT,
    PART,
    PRIOR_FRAC,
    RATIO,
    SHARE_AGN,
    SHARE_GALAXY,
)
from miricigale.utils.compilation import njit

__all__ = [
    "N_INPUT",
    "SIZE",
    "as_type",
    "best_mixture",
    "exponential",
    "exponential32",
    "fill_block",
    "fill_dead",
    "galaxy_products",
    "gather",
    "likelihoods",
    "run_products",
]

# Offsets of the vectors in Lanes.buffer, which lets the compiler see that they do not overlap. What
# the pairs are, with A, X and B for x = c ...
P, Q, X2, A, B, PRIOR, SHARE, POWER = (i * BLOCK for i in range(8))
# ... sums over the fractions of prior * likelihood l, l s, l s^2, l c s, l c s^2, l c^2 s^2, the
# other fraction phi and its square, l of s = 0 and l (s / sigma_s)^2; the largest R, work space.
W0, W1, W2, V1, U2, V2, F1, F2, WZ, WR, TOP, _T = (i * BLOCK for i in range(8, 20))
#: Number of vectors that say what the pairs are, and length of the whole buffer.
N_INPUT = 8
SIZE = 20 * BLOCK

# Products of fewer than so many pairs are worked out one by one.
_FEW = 8

_LOG2E = 1.4426950408889634
_LN2_HIGH = 0.6931471803691238
_LN2_LOW = 1.9082149292705877e-10
_LOG2E_32 = np.float32(1.4426950408889634)
_LN2_HIGH_32 = np.float32(0.693359375)
_LN2_LOW_32 = np.float32(-2.12194440e-4)


@intrinsic
def as_type(_, x, to):
    """Bits of a number as a number of another type of the same size."""
    out = to.instance_type

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], context.get_value_type(signature.return_type))

    return out(x, to), generate


@njit(**PART)
def exponential(e):
    """exp(e) for e from -700 to 700, to 1e-11 (after Cody & Waite)."""
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
    return v * as_type(np.int64(np.int32(m) + 1023) << np.int64(52), np.float64)


@njit(**PART)
def exponential32(e):
    """exp(e) for e from -80 to 80, in single precision."""
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
    return v * as_type(np.int32((np.int32(m) + 127) << 23), np.float32)


@njit(**PART)
def galaxy_products(tables, target, z, block, pq):
    """Fill ``Lanes.pq`` with <G, wF> and <G, wG> of a block of the galaxies of one redshift."""
    p, q = pq[0, block * BLOCK : (block + 1) * BLOCK], pq[1, block * BLOCK : (block + 1) * BLOCK]
    for i in range(BLOCK):
        p[i] = 0.0
        q[i] = 0.0
    for b in target.bands:
        w = target.weight[b]
        wf = w * target.flux[b]
        tile = tables.tiles[z, block, b]
        for i in range(BLOCK):
            t = tile[i]
            p[i] += t * wf
            q[i] += t * t * w


@njit(**PART)
def best_mixture(p, q, t, a, b, low, high):
    """
    Best R of a galaxy with an AGN model, x = c L_dust anything from low to high.

    With p = <G, wF>, q = <G, wG>, t = <G, wA>, a = <A, wF>, b = <A, wA>.
    """
    rise = a * q - p * t
    fall = p * b - a * t
    x = rise / fall if fall > 0.0 else high
    x = min(max(x, low), high) if rise > 0.0 else low
    num = max(p + x * a, 0.0)
    return num * num / max(q + x * (2.0 * t + x * b), 1e-300)


@njit(**PART)
def run_products(tables, bands, pairs, lanes, z, block, k, n_run):
    """Fill ``lanes.cross`` with <G, wA> and the best R of the galaxies of a run with its AGN model."""
    cross, pq, run, weighted = lanes.cross, lanes.pq, lanes.run, pairs.agn_weighted
    a, b = pairs.agn_pq[k, 0], pairs.agn_pq[k, 1]
    low, high = tables.of_frac[RATIO, 0], tables.of_frac[RATIO, -1]
    start = block * BLOCK
    if n_run < _FEW:
        for j in range(n_run):
            i = run[j]
            t = 0.0
            for m in bands:
                t += tables.tiles[z, block, m, i] * weighted[k, m]
            d = tables.of_galaxy[DUST, start + i]
            cross[0, i] = t
            cross[1, i] = best_mixture(
                pq[0, start + i], pq[1, start + i], t, a, b, low * d, high * d
            )
        return
    x, best, tiles = cross[0], cross[1], tables.tiles[z, block]
    for i in range(BLOCK):
        x[i] = 0.0
    m = 0
    while m + 4 <= bands.size:
        b0, b1, b2, b3 = bands[m], bands[m + 1], bands[m + 2], bands[m + 3]
        u0, u1, u2, u3 = weighted[k, b0], weighted[k, b1], weighted[k, b2], weighted[k, b3]
        t0, t1, t2, t3 = tiles[b0], tiles[b1], tiles[b2], tiles[b3]
        for i in range(BLOCK):
            x[i] += t0[i] * u0 + t1[i] * u1 + t2[i] * u2 + t3[i] * u3
        m += 4
    while m < bands.size:
        u0, t0 = weighted[k, bands[m]], tiles[bands[m]]
        for i in range(BLOCK):
            x[i] += t0[i] * u0
        m += 1
    p, q = pq[0, start : start + BLOCK], pq[1, start : start + BLOCK]
    dust = tables.of_galaxy[DUST, start : start + BLOCK]
    for i in range(BLOCK):
        best[i] = best_mixture(p[i], q[i], x[i], a, b, low * dust[i], high * dust[i])


@njit(**PART)
def fill_dead(buffer, index, start):
    """Fill the lanes from ``start`` on with pairs of no weight."""
    for i in range(max(start, 0), BLOCK):
        for v in range(N_INPUT):
            buffer[v * BLOCK + i] = 0.0
        buffer[P + i] = -1e300
        buffer[Q + i] = 1.0
        buffer[PRIOR + i] = -1e300
        index[0, i] = 0
        index[1, i] = 0


@njit(**PART)
def fill_block(tables, pairs, lanes, block, k, n_run, log_torus):
    """Fill the lanes with a block of galaxies and one AGN model; those not in the run are dead."""
    buffer, index, run, pq, of_galaxy = (
        lanes.buffer, lanes.index, lanes.run, lanes.pq, tables.of_galaxy,
    )  # fmt: skip
    a, b, share = pairs.agn_pq[k, 0], pairs.agn_pq[k, 1], tables.of_agn[SHARE_AGN, k]
    start = block * BLOCK
    last = run[n_run - 1]
    for i in range(BLOCK):
        d = of_galaxy[DUST, start + i]
        buffer[P + i] = -1e300
        buffer[Q + i] = pq[1, start + i]
        buffer[X2 + i] = 2.0 * lanes.cross[0, i] * d
        buffer[A + i] = a * d
        buffer[B + i] = b * d * d
        buffer[PRIOR + i] = -1e300
        buffer[SHARE + i] = of_galaxy[SHARE_GALAXY, start + i] * share
        buffer[POWER + i] = d
    for i in range(BLOCK):
        index[0, i] = start + min(i, last)
        index[1, i] = k
    for j in range(n_run):
        i = run[j]
        buffer[P + i] = pq[0, start + i]
        buffer[PRIOR + i] = log_torus + of_galaxy[LOG_GALAXY, start + i]


@njit(**PART)
def gather(tables, pairs, lanes, block, k, n_run, log_torus, filled):
    """Add the pairs of a short run to those gathered; returns how many there are now."""
    pending, index, run, pq, of_galaxy = (
        lanes.pending, lanes.index, lanes.run, lanes.pq, tables.of_galaxy,
    )  # fmt: skip
    a, b, share = pairs.agn_pq[k, 0], pairs.agn_pq[k, 1], tables.of_agn[SHARE_AGN, k]
    for j in range(n_run):
        g = block * BLOCK + run[j]
        d = of_galaxy[DUST, g]
        pending[P + filled] = pq[0, g]
        pending[Q + filled] = pq[1, g]
        pending[X2 + filled] = 2.0 * lanes.cross[0, run[j]] * d
        pending[A + filled] = a * d
        pending[B + filled] = b * d * d
        pending[PRIOR + filled] = log_torus + of_galaxy[LOG_GALAXY, g]
        pending[SHARE + filled] = of_galaxy[SHARE_GALAXY, g] * share
        pending[POWER + filled] = d
        index[2, filled] = g
        index[3, filled] = k
        filled += 1
    return filled


@njit(**PART)
def likelihoods(of_frac, lanes, reference, scale_error):
    """
    Evaluate the pairs in the lanes at every AGN fraction and sum over the fractions.

    ``lanes.weight`` is filled with prior * likelihood, ``frac_sum`` with the sums of it over the pairs.
    ``reference`` is R + 2 ln(prior) that has weight 1, ``scale_error`` whether the scale's variance
    counts. Returned is the largest R.
    """
    buffer, weight = lanes.buffer, lanes.weight
    low = 1e300
    c_0, c_1 = of_frac[RATIO, 0], of_frac[RATIO, -1]
    for i in range(BLOCK):
        # the numerator of the scale is linear in c
        p, a = buffer[P + i], buffer[A + i]
        low = min(low, min(p + c_0 * a, p + c_1 * a) if p > -1e29 else 1e300)
    for i in range(W0, _T):
        buffer[i] = 0.0
    for j in range(of_frac.shape[1]):
        c = of_frac[RATIO, j]
        f = of_frac[PRIOR_FRAC, j]
        now = weight[j * BLOCK : (j + 1) * BLOCK]
        for i in range(BLOCK):
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
            t = exponential(min(max(e, -700.0), 700.0)) * f
            t1 = t * s
            t2 = t * (s * s + scale_error * inverse)
            tp = t * phi
            buffer[_T + i] = t
            buffer[TOP + i] = max(buffer[TOP + i], r)
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
        for i in range(BLOCK):
            f_sum += buffer[_T + i]
        lanes.frac_sum[j] = f_sum
        for i in range(BLOCK):
            now[i] = buffer[_T + i]
    top = 0.0
    for i in range(BLOCK):
        # sum of l R, with R = (p + c a) s; lanes without weight have no p either
        buffer[WR + i] = buffer[P + i] * buffer[W1 + i] + buffer[A + i] * buffer[V1 + i]
        top = max(top, buffer[TOP + i])
    if low <= 0.0:
        for j in range(of_frac.shape[1]):
            for i in range(BLOCK):
                dark = buffer[P + i] + of_frac[RATIO, j] * buffer[A + i] <= 0.0
                buffer[WZ + i] += weight[j * BLOCK + i] if dark else 0.0
    return top
