"""
Pairs of galaxy and AGN model side by side, in double precision, at every AGN fraction.

For a galaxy with p = <G, wF>, q = <G, wG> and an AGN model with a = <A, wF>, b = <A, wA>,
X = <G, wA>, the model s (G + x A) with x = c L_dust has the best scale
s = (p + x a) / (q + 2 x X + x^2 b) and |F|^2_w - chi2 = R = (p + x a) s. Where p + x a is
negative the best scale that is not negative is 0 and R = 0.
"""

from miricigale.fitting._core import rows as at
from miricigale.fitting._core.functions import exponential
from miricigale.fitting._core.limits import limited_scale
from miricigale.fitting._core.structs import BLOCK, NO_LIGHT, PART
from miricigale.utils.compilation import njit

__all__ = [
    "best_mixture",
    "best_scale",
    "galaxy_products",
    "likelihoods",
    "place",
    "run_products",
    "take_gathered",
]

# Products of fewer than so many pairs are worked out one by one.
_FEW = 8


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
def best_scale(limits, p, q, galaxy, agn, x, floor):
    """
    Best scale, R and variance of the scale of a model, p = <m, wF> and q = <m, wm>.

    With limits, those whose R is below ``floor`` without them are left as they are then; ``galaxy``
    and ``agn`` are fluxes at the redshift, the model is the sum of the first and x times the second.
    """
    # without light in the used bands there is no scale to speak of
    q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
    inverse = 1.0 / q
    s = max(p, 0.0) * inverse
    r = max(p, 0.0) * s
    if limits is not None and r >= floor:
        for m in range(limits.bands.size):
            b = limits.bands[m]
            limits.slope[m] = (galaxy[b] + x * agn[b]) * limits.inverse[m]
        s, r, inverse = limited_scale(p, q, limits)
    return s, r, inverse


@njit(**PART)
def run_products(tables, bands, pairs, lanes, z, block, k, n_run):
    """Fill ``lanes.cross`` with <G, wA> and the best R of the galaxies of a run with its AGN model."""
    cross, pq, run, weighted = lanes.cross, lanes.pq, lanes.run, pairs.agn_weighted
    a, b = pairs.agn_pq[k, 0], pairs.agn_pq[k, 1]
    low, high = tables.of_frac[at.RATIO, 0], tables.of_frac[at.RATIO, -1]
    start = block * BLOCK
    if n_run < _FEW:
        for j in range(n_run):
            i = run[j]
            t = 0.0
            for m in bands:
                t += tables.tiles[z, block, m, i] * weighted[k, m]
            d = tables.of_galaxy[at.DUST, start + i]
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
    dust = tables.of_galaxy[at.DUST, start : start + BLOCK]
    for i in range(BLOCK):
        best[i] = best_mixture(p[i], q[i], x[i], a, b, low * dust[i], high * dust[i])


@njit(**PART)
def _fill_dead(buffer, index, start):
    """Fill the lanes from ``start`` on with pairs of no weight."""
    for i in range(start, BLOCK):
        for v in range(at.N_INPUT):
            buffer[v * BLOCK + i] = 0.0
        buffer[at.P + i] = -1e300
        buffer[at.Q + i] = 1.0
        buffer[at.PRIOR + i] = -1e300
        index[0, i] = 0
        index[1, i] = 0


@njit(**PART)
def place(tables, limits, pairs, lanes, z, block, k, first, last, log_agn, filled, whole):
    """
    Put pairs of a run, from first to last, in lanes; returns how many are gathered then.

    Those of a ``whole`` block go where their galaxies are in the block, others to those gathered, of
    which there are ``filled``.
    """
    index, run, pq, of_galaxy = lanes.index, lanes.run, lanes.pq, tables.of_galaxy
    buffer, limit = lanes.pending, lanes.pending_limit
    if whole:
        buffer, limit = lanes.buffer, lanes.limit
        _fill_dead(buffer, index, 0)
    to = 0 if whole else 2
    a, b, share = pairs.agn_pq[k, 0], pairs.agn_pq[k, 1], tables.of_agn[at.SHARE_AGN, k]
    for j in range(first, last):
        i = run[j] if whole else filled + j - first
        g = block * BLOCK + run[j]
        d = of_galaxy[at.DUST, g]
        buffer[at.P + i] = pq[0, g]
        buffer[at.Q + i] = pq[1, g]
        buffer[at.X2 + i] = 2.0 * lanes.cross[0, run[j]] * d
        buffer[at.A + i] = a * d
        buffer[at.B + i] = b * d * d
        buffer[at.PRIOR + i] = log_agn + of_galaxy[at.LOG_GALAXY, g]
        buffer[at.SHARE + i] = of_galaxy[at.SHARE_GALAXY, g] * share
        buffer[at.POWER + i] = d
        index[to, i] = g
        index[to + 1, i] = k
        if limits is not None:
            # fluxes of galaxy and AGN model (for c = 1) in bands with limits
            n = limits.bands.size
            for m in range(n):
                band = limits.bands[m]
                t = limits.inverse[m]
                limit[m, i] = tables.galaxy[z, g, band] * t
                limit[n + m, i] = tables.agn[z, k, band] * t * d
    return filled if whole else filled + last - first


@njit(**PART)
def take_gathered(limits, lanes, filled):
    """Move the gathered pairs to the lanes."""
    buffer, index = lanes.buffer, lanes.index
    for i in range(at.N_INPUT * BLOCK):
        buffer[i] = lanes.pending[i]
    for i in range(BLOCK):
        index[0, i] = index[2, i]
        index[1, i] = index[3, i]
    if limits is not None:
        for m in range(2 * limits.bands.size):
            for i in range(BLOCK):
                lanes.limit[m, i] = lanes.pending_limit[m, i]
    _fill_dead(buffer, index, filled)


@njit(**PART)
def likelihoods(of_frac, lanes, reference, scale_error, record):
    """
    Evaluate the pairs in the lanes at every AGN fraction and sum over the fractions.

    ``lanes.weight`` is filled with prior * likelihood, ``frac_sum`` with the sums of it over the pairs.
    ``reference`` is R + 2 ln(prior) that has weight 1, ``scale_error`` whether the scale's variance
    counts. Returned is the number of pairs whose largest R reaches ``record`` (counted, for the largest
    of all would not be found side by side).
    """
    buffer, weight = lanes.buffer, lanes.weight
    n_dark = 0.0
    c_0, c_1 = of_frac[at.RATIO, 0], of_frac[at.RATIO, -1]
    for i in range(BLOCK):
        # the numerator of the scale is linear in c
        p, a = buffer[at.P + i], buffer[at.A + i]
        n_dark += 1.0 if p > -1e29 and min(p + c_0 * a, p + c_1 * a) <= 0.0 else 0.0
    for i in range(at.W0, at.T):
        buffer[i] = 0.0
    for j in range(of_frac.shape[1]):
        c = of_frac[at.RATIO, j]
        f = of_frac[at.PRIOR_FRAC, j]
        now = weight[j * BLOCK : (j + 1) * BLOCK]
        for i in range(BLOCK):
            p = max(buffer[at.P + i] + c * buffer[at.A + i], 0.0)
            q = buffer[at.Q + i] + c * (buffer[at.X2 + i] + c * buffer[at.B + i])
            # without light in the used bands there is no scale to speak of
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            # one division for both 1 / q and y / (1 + y)
            y = c * buffer[at.SHARE + i]
            both = 1.0 / (q * (1.0 + y))
            inverse = both * (1.0 + y)
            phi = y * both * q
            s = p * inverse
            r = p * s
            e = 0.5 * (r + buffer[at.PRIOR + i] - reference)
            t = exponential(min(max(e, -700.0), 700.0)) * f
            t1 = t * s
            t2 = t * (s * s + scale_error * inverse)
            tp = t * phi
            buffer[at.T + i] = t
            buffer[at.TOP + i] = max(buffer[at.TOP + i], r)
            buffer[at.W0 + i] += t
            buffer[at.W1 + i] += t1
            buffer[at.V1 + i] += t1 * c
            buffer[at.W2 + i] += t2
            buffer[at.U2 + i] += t2 * c
            buffer[at.V2 + i] += t2 * (c * c)
            buffer[at.F1 + i] += tp
            buffer[at.F2 + i] += tp * phi
        # sums apart from stores: see `agn_products`
        f_sum = 0.0
        for i in range(BLOCK):
            f_sum += buffer[at.T + i]
        lanes.frac_sum[j] = f_sum
        for i in range(BLOCK):
            now[i] = buffer[at.T + i]
    reached = 0.0
    for i in range(BLOCK):
        # sum of l R, with R = (p + c a) s; lanes without weight have no p either
        buffer[at.WR + i] = (
            buffer[at.P + i] * buffer[at.W1 + i] + buffer[at.A + i] * buffer[at.V1 + i]
        )
    for i in range(BLOCK):
        reached += 1.0 if buffer[at.TOP + i] >= record else 0.0
    if n_dark > 0.0:
        for j in range(of_frac.shape[1]):
            for i in range(BLOCK):
                dark = buffer[at.P + i] + of_frac[at.RATIO, j] * buffer[at.A + i] <= 0.0
                buffer[at.WZ + i] += weight[j * BLOCK + i] if dark else 0.0
    return reached
