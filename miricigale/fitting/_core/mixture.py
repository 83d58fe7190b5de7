"""
Models that fit with some bands wrong: one at each redshift, by expectation and maximization.

The likelihood of a band is a mixture of the stated error and a broad one. With the share q of the broad
part the best model is that of weights v = 1 - q + q v0, v0 the broad weight over the stated one, and q
follows from the model (Dempster et al. 1977). Where that ends depends on where it begins: with
all bands good, and with the bands, or neighbors of them, whose loss pays most.
"""

from typing import NamedTuple

import numpy as np

from miricigale.fitting._core.batched_pairs import best_mixture
from miricigale.utils.compilation import KERNEL, PART, njit

# Steps of expectation from each start.
_STEPS = 3
# Number of times that bands are taken out.
_ROUNDS = 3
# Change of weights below which it ends.
_STILL = 0.2
# Chi2 above the best up to which redshifts are searched with more galaxies.
_NEAR = 40.0
# Chi2 above the best up to which they are searched with all galaxies.
_NEARER = 12.0
_TINY = np.float32(1e-28)
_HUGE = 1e30
# Rows of ``Few.less``.
_T, _P, _Q, _R = range(4)


class Few(NamedTuple):
    """Some galaxies of each redshift, side by side, and work space."""

    index: np.ndarray  # int64 (nz, n): which
    flux: np.ndarray  # float32 (nz, nb, n), each in its own unit; 0 of no galaxy
    ratio: np.ndarray  # float32 (nz, nA, n): AGN model over galaxy for c = 1, each in its own unit
    galaxy: np.ndarray  # float32 (nb, n): whitened
    agn: np.ndarray  # float32 (nA, nb)
    sums: np.ndarray  # float32 (nA + 2, n): <G, wA>, <G, wF>, <G, wG>
    less: np.ndarray  # float32 (4, n): these of an AGN model with bands taken out, and the best R
    share: np.ndarray  # float64 (nb,): v now
    model: np.ndarray  # float64 (nb,): whitened model


@njit(**PART)
def _sum(galaxies, n, data, share, n_used):
    """Fill the sums over bands with weights ``share``."""
    n_agn = galaxies.agn.shape[0]
    for m in range(n_agn + 2):
        galaxies.sums[m, :n] = np.float32(0)
    p = galaxies.sums[n_agn]
    q = galaxies.sums[n_agn + 1]
    for j in range(n_used):
        row = galaxies.galaxy[j]
        v = np.float32(share[j])
        d = data[j] * v
        for i in range(n):
            p[i] += row[i] * d
            q[i] += row[i] * row[i] * v
        for k in range(n_agn):
            t = galaxies.sums[k]
            x = galaxies.agn[k, j] * v
            for i in range(n):
                t[i] += row[i] * x


@njit(**PART)
def _reach(galaxies, n, ratio, data, share, base, n_used, first, last, ends):
    """Fill the best R without the bands from ``first`` to before ``last``; the best R."""
    zero = np.float32(0)
    n_agn = galaxies.agn.shape[0]
    less = galaxies.less
    t = less[_T]
    p = less[_P]
    q = less[_Q]
    best = less[_R]
    p_all = galaxies.sums[n_agn]
    q_all = galaxies.sums[n_agn + 1]
    for i in range(n):
        p[i] = p_all[i]
        q[i] = q_all[i]
    for j in range(first, last):
        row = galaxies.galaxy[j]
        v = np.float32(share[j] - min(share[j], base[j]))
        x = data[j] * v
        for i in range(n):
            p[i] -= row[i] * x
            q[i] -= row[i] * row[i] * v
    for i in range(n):
        num = max(p[i], zero)
        best[i] = num * num / max(q[i], _TINY)
    for k in range(n_agn):
        a = b = zero
        all_bands = galaxies.sums[k]
        limit = ratio[k]
        for j in range(n_used):
            v = np.float32(min(share[j], base[j]) if first <= j < last else share[j])
            a += galaxies.agn[k, j] * data[j] * v
            b += galaxies.agn[k, j] * galaxies.agn[k, j] * v
        for i in range(n):
            t[i] = all_bands[i]
        for j in range(first, last):
            row = galaxies.galaxy[j]
            x = galaxies.agn[k, j] * np.float32(share[j] - min(share[j], base[j]))
            for i in range(n):
                t[i] -= row[i] * x
        low = np.float32(ends[0])
        high = np.float32(ends[1])
        for i in range(n):
            _, r = best_mixture(p[i], q[i], t[i], a, b, low * limit[i], high * limit[i], _TINY)
            best[i] = max(best[i], r)
    top = zero
    for i in range(n):
        top = max(top, best[i])
    return top


@njit(**PART)
def _take_out(galaxies, n, ratio, data, norm, odds, base, n_used, ends, start):
    """Take out the bands, or neighbors, whose loss pays most, one after the other."""
    for _ in range(_ROUNDS):
        _sum(galaxies, n, data, start, n_used)
        best = _HUGE
        first = 0
        after = 0
        for width in range(3):
            # taking out no band is tried once
            n_places = 1
            if width > 0:
                n_places = n_used - width + 1
            for j in range(n_places):
                chi2_left = 0.0
                penalty = 0.0
                for i in range(n_used):
                    out = j <= i < j + width and start[i] > base[i]
                    band_share = start[i]
                    if out:
                        band_share = base[i]
                        penalty -= 2.0 * np.log(max(odds[i], 1e-30))
                    chi2_left += band_share * data[i] * data[i]
                if penalty == 0.0 and width > 0:
                    continue
                r = _reach(galaxies, n, ratio, data, start, base, n_used, j, j + width, ends)
                value = norm * (chi2_left - r) + penalty
                if value < best:
                    best = value
                    first = j
                    after = j + width
        for j in range(first, after):
            start[j] = min(start[j], base[j])
        if after == first:
            break


@njit(**KERNEL)
def find_models(
    tables, target, galaxies, odds, base, offset, ends, sizes, share, lowest, index, scale
):
    """
    Find a model at each redshift that fits with some bands wrong.

    ``odds`` and ``base`` of the measured bands, shape (nz, n_used), are p sigma / ((1 - p) Sigma) and
    (sigma / Sigma)^2; ``offset``, shape (nz,), is added to chi2 where redshifts are compared; ``ends`` are the
    least and largest c, ``sizes`` the numbers of galaxies looked at everywhere, near the best redshift and nearer.
    Filled are ``share`` (as ``odds``) with weights over the stated ones, ``lowest``, shape (nz,), with chi2,
    ``index``, shape (nz, 2), with galaxy and AGN model (-1 where there is none), and ``scale``, shape
    (nz, 2), with factors of these.
    """
    n_used = target.bands.size
    n_agn = galaxies.agn.shape[0]
    start = galaxies.share
    model = galaxies.model
    top_all = _HUGE
    for stage in range(len(sizes)):
        n = sizes[stage]
        max_chi2 = top_all + _NEARER
        if stage == 1:
            max_chi2 = top_all + _NEAR
        top_all = _HUGE
        for z in range(target.log_prior.size):
            if target.log_prior[z] < -1e200 or (stage > 0 and lowest[z] + offset[z] > max_chi2):
                continue
            data = target.data32[z]
            norm = target.norm[z]
            v0 = base[z]
            top = 0.0
            for j in range(n_used):
                b = target.bands[j]
                root = target.root32[z, j]
                top = max(top, target.weight[z, b])
                for i in range(n):
                    galaxies.galaxy[j, i] = galaxies.flux[z, b, i] * root
                for k in range(n_agn):
                    galaxies.agn[k, j] = tables.agn32[z, k, b] * root
            lowest[z] = _HUGE
            ratio = galaxies.ratio[z]
            band_odds = odds[z]
            min_penalty = _HUGE
            for j in range(n_used):
                min_penalty = min(min_penalty, -2.0 * np.log(max(band_odds[j], 1e-30)))
            # with all bands good, and at first with bands taken out as well
            n_starts = 1
            if stage == 0:
                n_starts = 2
            for begin in range(n_starts):
                if begin == 1 and lowest[z] < min_penalty:
                    continue
                for j in range(n_used):
                    start[j] = 1.0
                    if stage > 0:
                        start[j] = share[z, j]
                if begin == 1:
                    _take_out(galaxies, n, ratio, data, norm, band_odds, v0, n_used, ends, start)
                for _ in range(_STEPS):
                    _sum(galaxies, n, data, start, n_used)
                    r = _reach(galaxies, n, ratio, data, start, start, n_used, 0, 0, ends)
                    g = 0
                    while g < n - 1 and galaxies.less[_R, g] < r:
                        g += 1
                    k = np.int64(-1)
                    x = np.float32(0)
                    num = 0.0
                    den = 1e-30
                    r = max(galaxies.less[_P, g], x) ** 2 / max(galaxies.less[_Q, g], _TINY)
                    for m in range(n_agn):
                        a = b = np.float32(0)
                        for j in range(n_used):
                            v = np.float32(start[j])
                            a += galaxies.agn[m, j] * data[j] * v
                            b += galaxies.agn[m, j] * galaxies.agn[m, j] * v
                        p = galaxies.less[_P, g]
                        q = galaxies.less[_Q, g]
                        t = galaxies.sums[m, g]
                        low = np.float32(ends[0]) * ratio[m, g]
                        high = np.float32(ends[1]) * ratio[m, g]
                        y, value = best_mixture(p, q, t, a, b, low, high, _TINY)
                        if value > r:
                            r = value
                            x = y
                            k = m
                    for j in range(n_used):
                        model[j] = galaxies.galaxy[j, g]
                        if k >= 0:
                            model[j] += x * galaxies.agn[k, j]
                        num += model[j] * data[j] * start[j]
                        den += model[j] * model[j] * start[j]
                    s = max(num, 0.0) / den
                    value = 0.0
                    change = 0.0
                    for j in range(n_used):
                        e = norm * (data[j] - s * model[j]) ** 2
                        good = np.exp(-min(0.5 * e * (1.0 - v0[j]), 600.0))
                        wrong = band_odds[j] / (band_odds[j] + good)
                        if band_odds[j] > 0.0:
                            e = e * v0[j] - 2.0 * np.log(band_odds[j] + good)
                        value += e
                        v = 1.0 - wrong * (1.0 - v0[j])
                        change = max(change, abs(v - start[j]))
                        start[j] = v
                    if value < lowest[z]:
                        lowest[z] = value
                        unit = np.sqrt(norm / top)
                        place = galaxies.index[z, g]
                        for j in range(n_used):
                            share[z, j] = start[j]
                        index[z, 0] = place
                        index[z, 1] = k
                        scale[z, 0] = s * unit / tables.galaxy_unit[z, place]
                        scale[z, 1] = 0.0
                        if k >= 0:
                            scale[z, 1] = s * x * unit / tables.agn_unit[z, k]
                    if change < _STILL:
                        break
            top_all = min(top_all, lowest[z] + offset[z])
