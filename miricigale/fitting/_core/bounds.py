"""
Which (galaxy, torus) pairs can matter at all: bounds in single precision.

With whitened data d = F sqrt(w) and unit vectors g, t of a galaxy and a torus in the used
bands, p = <g, d>, a = <t, d>, X = <g, t>, the best chi2 of any non-negative mixture of the
two is |d|^2 - R with ::

    R = p^2 + (a - p X)^2 / (1 - X^2)    where a > p X and p > a X,
    R = max(p, a, 0)^2                   elsewhere.

No AGN fraction can do better, so a pair whose R lies far below the best is skipped. The
test is done without division, and leans to keeping a pair by more than the rounding of
single precision can amount to.
"""

import numpy as np

from miricigale.fitting._core.options import ONCE
from miricigale.utils.compilation import njit

__all__ = [
    "BLOCK",
    "DONE",
    "GROUP",
    "KEY_BITS",
    "galaxy_projections",
    "pair_block",
    "torus_projections",
]

#: Galaxies handled side by side; the tables are padded to a multiple of it.
BLOCK = 64
#: Tori handled side by side; arrays of unit vectors are padded with zeros to a multiple.
GROUP = 4
#: A run is a torus with a block of galaxies at one redshift; its key has so many bits for the
#: torus, as many for the block, and the redshift above.
KEY_BITS = 20
#: Bound of a pair that is not listed, or is no more.
DONE = np.float32(-3e38)


# Rounding of 64 products of unit vectors in float32, generously.
_ETA = np.float32(3e-6)
_EPS = np.float32(6e-6)
_TINY = np.float32(1e-28)
_ALWAYS = np.float32(4.0)


@njit(**ONCE)
def galaxy_projections(galaxy, bands, root_weight, data, p, inverse_norm):
    """
    Project the data on every galaxy of one redshift.

    Parameters
    ----------
    galaxy : `~numpy.ndarray` of float32, shape (n_bands, n_padded)
        Fluxes, each galaxy in its own unit.
    bands : `~numpy.ndarray` of int, shape (n_used,)
        The used bands.
    root_weight : `~numpy.ndarray` of float32, shape (n_used,)
        Square roots of the weights, the largest being 1.
    data : `~numpy.ndarray` of float32, shape (n_used,)
        Whitened data, of norm 1.
    p, inverse_norm : `~numpy.ndarray` of float32, shape (n_padded,)
        Filled with <g, d> and 1 / |g|. A galaxy too faint for single precision gets
        p = 4, which no bound can drop, and 0.
    """
    n = p.size
    zero = np.float32(0)
    one = np.float32(1)
    for i in range(n):
        p[i] = zero
        inverse_norm[i] = zero
    for j in range(bands.size):
        row = galaxy[bands[j]]
        s = root_weight[j]
        d = data[j]
        for i in range(n):
            t = row[i] * s
            inverse_norm[i] += t * t
            p[i] += t * d
    for i in range(n):
        q = inverse_norm[i]
        faint = q < _TINY
        r = one / np.sqrt(max(q, _TINY))
        inverse_norm[i] = zero if faint else r
        p[i] = _ALWAYS if faint else p[i] * r


@njit(**ONCE)
def torus_projections(agn, bands, root_weight, data, unit, a, a2):
    """
    Unit vectors of the tori of one redshift and their projections.

    Parameters
    ----------
    agn : `~numpy.ndarray` of float32, shape (n_agn, n_bands)
        Fluxes, each torus in its own unit.
    bands, root_weight, data
        As in `galaxy_projections`.
    unit : `~numpy.ndarray` of float32, shape (n_agn, n_used)
        Filled with the unit vectors.
    a, a2 : `~numpy.ndarray` of float32, shape (n_agn,)
        Filled with <t, d> and with the square of its positive part plus the rounding,
        4 for tori too faint for single precision.
    """
    zero = np.float32(0)
    for k in range(a.size):
        for j in range(bands.size):
            unit[k, j] = agn[k, bands[j]] * root_weight[j]
        # sums apart from stores: see `agn_products`
        norm = zero
        s = zero
        for j in range(bands.size):
            norm += unit[k, j] * unit[k, j]
            s += unit[k, j] * data[j]
        if norm < _TINY:
            a[k] = zero
            a2[k] = _ALWAYS if norm > zero else zero
            for j in range(bands.size):
                unit[k, j] = zero
        else:
            r = np.float32(1) / np.sqrt(norm)
            a[k] = s * r
            m = max(a[k], zero) + _ETA
            a2[k] = m * m
            for j in range(bands.size):
                unit[k, j] *= r


@njit(**ONCE)
def _products(unit_galaxy, unit_agn, x):
    """Fill x[m, i] = sum_j unit_agn[m, j] unit_galaxy[j, i] for GROUP tori (register blocking)."""
    zero = np.float32(0)
    for m in range(GROUP):
        for i in range(BLOCK):
            x[m, i] = zero
    x0 = x[0]
    x1 = x[1]
    x2 = x[2]
    x3 = x[3]
    n_used = unit_galaxy.shape[0]
    j = 0
    while j + 3 <= n_used:
        g0 = unit_galaxy[j]
        g1 = unit_galaxy[j + 1]
        g2 = unit_galaxy[j + 2]
        u00, u01, u02 = unit_agn[0, j], unit_agn[0, j + 1], unit_agn[0, j + 2]
        u10, u11, u12 = unit_agn[1, j], unit_agn[1, j + 1], unit_agn[1, j + 2]
        u20, u21, u22 = unit_agn[2, j], unit_agn[2, j + 1], unit_agn[2, j + 2]
        u30, u31, u32 = unit_agn[3, j], unit_agn[3, j + 1], unit_agn[3, j + 2]
        for i in range(BLOCK):
            h0 = g0[i]
            h1 = g1[i]
            h2 = g2[i]
            x0[i] += h0 * u00 + h1 * u01 + h2 * u02
            x1[i] += h0 * u10 + h1 * u11 + h2 * u12
            x2[i] += h0 * u20 + h1 * u21 + h2 * u22
            x3[i] += h0 * u30 + h1 * u31 + h2 * u32
        j += 3
    while j < n_used:
        g0 = unit_galaxy[j]
        u00, u10, u20, u30 = unit_agn[0, j], unit_agn[1, j], unit_agn[2, j], unit_agn[3, j]
        for i in range(BLOCK):
            x0[i] += g0[i] * u00
            x1[i] += g0[i] * u10
            x2[i] += g0[i] * u20
            x3[i] += g0[i] * u30
        j += 1


@njit(**ONCE)
def pair_block(
    unit_galaxy, p, threshold, base, norm, unit_agn, a, a2, key, start, run_key, bound, top
):
    """
    Find the pairs of one block of galaxies whose bound reaches a threshold.

    Parameters
    ----------
    unit_galaxy : `~numpy.ndarray` of float32, shape (n_used, BLOCK)
        Unit vectors of the galaxies.
    p : `~numpy.ndarray` of float32, shape (BLOCK,)
        Their projections; -1000 for a galaxy that may not be used.
    threshold : `~numpy.ndarray` of float32, shape (BLOCK,)
        Least bound R / |d|^2 to keep, 1e30 for a galaxy that may not be used.
    base : `~numpy.ndarray` of float32, shape (BLOCK,)
        2 ln(prior) of the galaxies, with that of their best partner.
    norm : float32
        |d|^2.
    unit_agn, a, a2
        From `torus_projections`.
    key : int
        Key of the block with torus 0.
    start : int
        Where to write in the list, which must have room for as many runs as there are tori.
    run_key : `~numpy.ndarray` of int64
        Filled with the keys of tori of which some pair is kept.
    bound : `~numpy.ndarray` of float32, shape (n, BLOCK)
        Filled with bounds of R + 2 ln(prior), `DONE` for pairs that are not kept.
    top : `~numpy.ndarray` of float32, shape (BLOCK,)
        Filled with the galaxies' largest bounds.

    Returns
    -------
    end : int
        One past the last run written.
    """
    one = np.float32(1)
    zero = np.float32(0)
    slack = np.float32(1e-6)
    x = np.empty((GROUP, BLOCK), np.float32)
    rest = np.empty(BLOCK, np.float32)
    least = np.empty(BLOCK, np.float32)
    score = np.empty(BLOCK, np.float32)
    alone = np.empty(BLOCK, np.float32)
    for i in range(BLOCK):
        p2 = max(p[i], zero) + _ETA
        p2 = p2 * p2
        alone[i] = p2
        rest[i] = threshold[i] - p2
        # a galaxy that passes alone passes with every torus
        least[i] = -one if p2 >= threshold[i] else threshold[i]
        top[i] = DONE
    end = start
    for k0 in range(0, unit_agn.shape[0], GROUP):
        _products(unit_galaxy, unit_agn[k0 : k0 + GROUP], x)
        for m in range(min(GROUP, a.size - k0)):
            ak = a[k0 + m]
            a2k = a2[k0 + m]
            xm = x[m]
            for i in range(BLOCK):
                n1 = ak - p[i] * xm[i] + _ETA
                n2 = p[i] - ak * xm[i] + _ETA
                r = n1 * n1 - rest[i] * (one - xm[i] * xm[i] - _EPS)
                score[i] = max(min(r, min(n1, n2)), a2k - least[i])
            most = score[0]
            for i in range(BLOCK):
                most = max(most, score[i])
            if most < zero:
                continue
            run_key[end] = key + k0 + m
            row = bound[end]
            for i in range(BLOCK):
                n1 = ak - p[i] * xm[i] + _ETA
                n2 = p[i] - ak * xm[i] + _ETA
                both = alone[i] + n1 * n1 / max(one - xm[i] * xm[i] - _EPS, _EPS)
                r = max(alone[i], a2k)
                r = max(r, both) if min(n1, n2) >= zero else r
                r = min(r, one) * norm
                # rounding of single precision is added
                value = r + base[i] + slack * (r + abs(base[i]))
                value = value if score[i] >= zero else DONE
                row[i] = value
                top[i] = max(top[i], value)
            end += 1
    return end
