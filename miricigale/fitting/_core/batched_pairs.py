"""
Pairs of galaxy and AGN model side by side, in double precision, at every AGN fraction.

For a galaxy with p = <G, wF>, q = <G, wG> and an AGN model with a = <A, wF>, b = <A, wA>,
X = <G, wA>, the model s (G + x A) with x = c L_dust has the best scale
s = (p + x a) / (q + 2 x X + x^2 b) and |F|^2_w - chi2 = R = (p + x a) s. Where p + x a is
negative the best scale that is not negative is 0 and R = 0.
"""

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.limits import limited_scale
from miricigale.fitting._core.structs import BLOCK, DONE, KEY_BITS, KEY_MASK, NO_LIGHT
from miricigale.utils._core.functions import exponential
from miricigale.utils.compilation import PART, njit


@njit(**PART)
def galaxy_products(tables, target, z, block, pq):
    """Fill ``Lanes.pq`` with <G, wF> and <G, wG> of a block of the galaxies of one redshift."""
    p = pq[0, block * BLOCK : (block + 1) * BLOCK]
    q = pq[1, block * BLOCK : (block + 1) * BLOCK]
    p[:] = 0.0
    q[:] = 0.0
    for b in target.bands:
        w = target.weight[z, b]
        wf = w * target.flux[b]
        tile = tables.tiles[z, block, b]
        for i in range(BLOCK):
            t = tile[i]
            p[i] += t * wf
            q[i] += t * t * w


@njit(**PART)
def best_mixture(p, q, t, a, b, low, high, tiny):
    """
    Best x = c L_dust from low to high of a galaxy with an AGN model, and R there, in the precision given.

    With p = <G, wF>, q = <G, wG>, t = <G, wA>, a = <A, wF>, b = <A, wA>; ``tiny`` is the least norm.
    """
    zero = type(p)(0.0)
    rise = a * q - p * t
    fall = p * b - a * t
    x = rise / fall if fall > tiny else high
    x = min(max(x, low), high) if rise > zero else low
    num = max(p + x * a, zero)
    return x, num * num / max(q + x * (t + t + x * b), tiny)


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
def gather(tables, target, limits, pairs, lanes, r, start, floor, filled):
    """
    Put pairs of run r, from galaxy ``start`` of its block on, whose bound reaches the floor, in lanes.

    They are marked as done. Returned are how many lanes are filled then, and the next galaxy,
    `BLOCK` if none is left.
    """
    key = pairs.run_key[r]
    row = pairs.bound[r]
    z = key >> (2 * KEY_BITS)
    block = (key >> KEY_BITS) & KEY_MASK
    k = key & KEY_MASK
    if lanes.products_at[block] != z + 1:
        lanes.products_at[block] = z + 1
        galaxy_products(tables, target, z, block, lanes.pq)
    buffer = lanes.buffer
    of_galaxy = tables.of_galaxy
    weighted = pairs.agn_weighted[k]
    a = pairs.agn_pq[k, 0]
    b = pairs.agn_pq[k, 1]
    share = tables.of_agn[at.SHARE_AGN, k]
    log_prior = target.log_prior[z] + tables.of_agn[at.LOG_AGN, k]
    i = start
    while i < BLOCK and filled < BLOCK:
        if row[i] >= floor:
            row[i] = DONE
            g = block * BLOCK + i
            galaxy = tables.galaxy[z, g]
            x = 0.0
            for m in range(weighted.size):
                x += galaxy[m] * weighted[m]
            d = of_galaxy[at.DUST, g]
            buffer[at.P + filled] = lanes.pq[0, g]
            buffer[at.Q + filled] = lanes.pq[1, g]
            buffer[at.X2 + filled] = 2.0 * x * d
            buffer[at.A + filled] = a * d
            buffer[at.B + filled] = b * d * d
            buffer[at.PRIOR + filled] = log_prior + tables.log_usable[z, g]
            buffer[at.SHARE + filled] = of_galaxy[at.SHARE_GALAXY, g] * share
            buffer[at.POWER + filled] = d
            lanes.index[0, filled] = g
            lanes.index[1, filled] = k
            if limits is not None:
                # fluxes of galaxy and AGN model (for c = 1) in bands with limits
                n = limits.bands.size
                for m in range(n):
                    band = limits.bands[m]
                    t = limits.inverse[m]
                    lanes.limit[m, filled] = galaxy[band] * t
                    lanes.limit[n + m, filled] = tables.agn[z, k, band] * t * d
            filled += 1
        i += 1
    return filled, i


@njit(**PART)
def fill_up(lanes, filled):
    """Fill the lanes from ``filled`` on with pairs of no weight."""
    buffer = lanes.buffer
    for i in range(filled, BLOCK):
        for v in (at.A, at.B, at.X2, at.SHARE, at.POWER):
            buffer[v + i] = 0.0
        buffer[at.P + i] = -1e300
        buffer[at.Q + i] = 1.0
        buffer[at.PRIOR + i] = -1e300
        lanes.index[0, i] = 0
        lanes.index[1, i] = 0


@njit(**PART)
def likelihoods(of_frac, lanes, reference, scale_error, record):
    """
    Evaluate the pairs in the lanes at every AGN fraction and sum over the fractions.

    ``lanes.weight`` is filled with prior * likelihood, ``frac_sum`` with the sums of it over the pairs.
    ``reference`` is R + 2 ln(prior) that has weight 1, ``scale_error`` whether the scale's variance
    counts. Returned is the number of pairs whose largest R reaches ``record`` (counted, for the largest
    of all would not be found side by side).
    """
    buffer = lanes.buffer
    weight = lanes.weight
    n_dark = 0.0
    c_0 = of_frac[at.RATIO, 0]
    c_1 = of_frac[at.RATIO, -1]
    for i in range(BLOCK):
        # the numerator of the scale is linear in c
        p = buffer[at.P + i]
        a = buffer[at.A + i]
        n_dark += 1.0 if p > -1e29 and min(p + c_0 * a, p + c_1 * a) <= 0.0 else 0.0
    buffer[at.W0 : at.T] = 0.0
    for j in range(of_frac.shape[1]):
        c = of_frac[at.RATIO, j]
        f = of_frac[at.PRIOR_FRAC, j]
        frac_weight = weight[j * BLOCK : (j + 1) * BLOCK]
        for i in range(BLOCK):
            p = max(buffer[at.P + i] + c * buffer[at.A + i], 0.0)
            q = buffer[at.Q + i] + c * (buffer[at.X2 + i] + c * buffer[at.B + i])
            # without light in the used bands there is no scale to speak of
            q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
            # one division for both 1 / q and y / (1 + y)
            y = c * buffer[at.SHARE + i]
            inverse_both = 1.0 / (q * (1.0 + y))
            inverse = inverse_both * (1.0 + y)
            phi = y * inverse_both * q
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
            frac_weight[i] = buffer[at.T + i]
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
