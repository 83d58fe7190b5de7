"""Products of models and data, in double precision: <m, wF>, <m, wm> and what follows."""

from miricigale.fitting._core.bounds import BLOCK
from miricigale.fitting._core.limits import limited_scale
from miricigale.fitting._core.options import INNER, ONCE
from miricigale.utils.compilation import njit

__all__ = [
    "agn_products",
    "best_mixture",
    "best_mixtures",
    "cross_products",
    "few_products",
    "galaxy_products",
    "row_best",
]


@njit(**ONCE)
def row_best(
    galaxy,
    agn,
    dust,
    ratio,
    prior_agn,
    log_agn,
    log_frac,
    zero_frac,
    target,
    limits,
    agn_pq,
    slope,
):
    """
    Best model of one galaxy at one redshift; with limits, a good one.

    Parameters
    ----------
    galaxy, agn : `~numpy.ndarray`, shapes (nb,) and (nA, nb)
        Fluxes of the galaxy and of all tori.
    dust : float
        Dust luminosity of the galaxy.
    ratio, prior_agn, log_agn, log_frac, zero_frac, target, limits
        See `miricigale.fitting._core.structs`.
    agn_pq : `~numpy.ndarray`, shape (nA, 2)
        <A, wF> and <A, wA> at this redshift.
    slope : `~numpy.ndarray`, shape (nb,)
        Scratch.

    Returns
    -------
    value : float
        Largest R + 2 ln(prior of torus and fraction).
    s : float
        Scale of the model that has it.
    """
    weight, bands = target.weight, target.bands
    p = 0.0
    q = 0.0
    for b in bands:
        t = galaxy[b] * weight[b]
        p += t * target.flux[b]
        q += t * galaxy[b]
    best_value = -1e300
    best_s = 0.0
    without = -1e300
    if zero_frac == 1 and q > 0.0 and log_frac[0] > -1e200:
        best_s = max(p, 0.0) / q
        r = max(p, 0.0) * best_s
        if limits is not None:
            for m in range(limits.bands.size):
                slope[m] = galaxy[limits.bands[m]] * limits.inverse[m]
            best_s, r, _ = limited_scale(p, q, slope, limits.level, limits.dark)
        best_value = r + log_frac[0]
    for k in range(agn_pq.shape[0]):
        if not prior_agn[k] > 0.0:
            continue
        x_cross = 0.0
        for b in bands:
            x_cross += galaxy[b] * weight[b] * agn[k, b]
        a = agn_pq[k, 0]
        b2 = agn_pq[k, 1]
        for j in range(ratio.size):
            x = ratio[j] * dust
            num = max(p + x * a, 0.0)
            den = q + x * (2.0 * x_cross + x * b2)
            if not den > 0.0:
                continue
            s = num / den
            log_prior = log_agn[k] + log_frac[j + zero_frac]
            value = num * s + log_prior
            # with limits, only at what would be better without them than all before
            if limits is not None:
                if value <= without:
                    continue
                without = value
                for m in range(limits.bands.size):
                    band = limits.bands[m]
                    slope[m] = (galaxy[band] + x * agn[k, band]) * limits.inverse[m]
                s, r, _ = limited_scale(num, den, slope, limits.level, limits.dark)
                value = r + log_prior
            if value > best_value:
                best_value = value
                best_s = s
    return best_value, best_s


@njit(**INNER)
def agn_products(agn, target, agn_pq, agn_weighted):
    """Fill agn_pq[k] = <A, wF>, <A, wA> and agn_weighted[k] = w A for all tori of one redshift."""
    weight, flux = target.weight, target.flux
    for k in range(agn_pq.shape[0]):
        for b in range(agn.shape[1]):
            agn_weighted[k, b] = agn[k, b] * weight[b]
        # apart from the loop above: a sum beside a store is taken in an order that depends on
        # where the arrays lie, and results shall not
        p = 0.0
        q = 0.0
        for b in range(agn.shape[1]):
            p += agn_weighted[k, b] * flux[b]
            q += agn_weighted[k, b] * agn[k, b]
        agn_pq[k, 0] = p
        agn_pq[k, 1] = q


@njit(**INNER)
def galaxy_products(tiles, z, block, target, pq):
    """Fill pq[:, block] with <G, wF> and <G, wG> of a block of the galaxies of one redshift."""
    for i in range(BLOCK):
        pq[0, block, i] = 0.0
        pq[1, block, i] = 0.0
    for b in target.bands:
        w = target.weight[b]
        wf = w * target.flux[b]
        for i in range(BLOCK):
            t = tiles[z, block, b, i]
            pq[0, block, i] += t * wf
            pq[1, block, i] += t * t * w


@njit(**ONCE)
def cross_products(tiles, z, block, bands, weighted, k, cross):
    """Fill cross[0, i] = <G_i, wA> for a block of galaxies and one torus."""
    for i in range(BLOCK):
        cross[0, i] = 0.0
    n = bands.size
    m = 0
    while m + 4 <= n:
        b0, b1, b2, b3 = bands[m], bands[m + 1], bands[m + 2], bands[m + 3]
        u0, u1, u2, u3 = weighted[k, b0], weighted[k, b1], weighted[k, b2], weighted[k, b3]
        for i in range(BLOCK):
            cross[0, i] += (
                tiles[z, block, b0, i] * u0
                + tiles[z, block, b1, i] * u1
                + tiles[z, block, b2, i] * u2
                + tiles[z, block, b3, i] * u3
            )
        m += 4
    while m < n:
        b0 = bands[m]
        u0 = weighted[k, b0]
        for i in range(BLOCK):
            cross[0, i] += tiles[z, block, b0, i] * u0
        m += 1


@njit(**INNER)
def best_mixture(p, q, t, a, b, low, high):
    """
    Best R of a galaxy with a torus, x = c L_dust anything from low to high.

    With p = <G, wF>, q = <G, wG>, t = <G, wA>, a = <A, wF>, b = <A, wA>.
    """
    rise = a * q - p * t
    fall = p * b - a * t
    x = rise / fall if fall > 0.0 else high
    x = min(max(x, low), high) if rise > 0.0 else low
    num = max(p + x * a, 0.0)
    return num * num / max(q + x * (2.0 * t + x * b), 1e-300)


@njit(**ONCE)
def best_mixtures(pq, blocks, block, a, b, low, high, cross):
    """Fill cross[1, i] with the best R of a block of galaxies with a torus."""
    for i in range(BLOCK):
        d = blocks[0, block, i]
        cross[1, i] = best_mixture(
            pq[0, block, i], pq[1, block, i], cross[0, i], a, b, low * d, high * d
        )


@njit(**ONCE)
def few_products(
    tiles, z, block, bands, weighted, k, pq, blocks, a, b, low, high, run, n_run, cross
):
    """Do what `cross_products` and `best_mixtures` do for some galaxies of a block."""
    for j in range(n_run):
        i = run[j]
        t = 0.0
        for m in bands:
            t += tiles[z, block, m, i] * weighted[k, m]
        cross[0, i] = t
        d = blocks[0, block, i]
        cross[1, i] = best_mixture(pq[0, block, i], pq[1, block, i], t, a, b, low * d, high * d)
