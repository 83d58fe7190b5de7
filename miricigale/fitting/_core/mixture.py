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
from miricigale.fitting._core.structs import KERNEL, PART
from miricigale.utils.compilation import njit

# Expectations from each start, times that bands are taken out, change of weights that ends it.
_STEPS, _ROUNDS, _STILL = 3, 3, 0.2
# Chi2 above the best up to which redshifts are looked at with more galaxies, and with all.
_NEAR, _NEARER = 40.0, 12.0
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
def _sum(few, n, data, share, n_used):
    """Fill the sums over bands with weights ``share``."""
    n_agn = few.agn.shape[0]
    for m in range(n_agn + 2):
        few.sums[m, :n] = np.float32(0)
    p, q = few.sums[n_agn], few.sums[n_agn + 1]
    for j in range(n_used):
        row, v = few.galaxy[j], np.float32(share[j])
        d = data[j] * v
        for i in range(n):
            p[i] += row[i] * d
            q[i] += row[i] * row[i] * v
        for k in range(n_agn):
            t, x = few.sums[k], few.agn[k, j] * v
            for i in range(n):
                t[i] += row[i] * x


@njit(**PART)
def _reach(few, n, ratio, data, share, base, n_used, first, last, ends):
    """Fill the best R without the bands from ``first`` to before ``last``; the best R."""
    zero, n_agn = np.float32(0), few.agn.shape[0]
    less = few.less
    t, p, q, best = less[_T], less[_P], less[_Q], less[_R]
    p_all, q_all = few.sums[n_agn], few.sums[n_agn + 1]
    for i in range(n):
        p[i], q[i] = p_all[i], q_all[i]
    for j in range(first, last):
        row, v = few.galaxy[j], np.float32(share[j] - min(share[j], base[j]))
        x = data[j] * v
        for i in range(n):
            p[i] -= row[i] * x
            q[i] -= row[i] * row[i] * v
    for i in range(n):
        num = max(p[i], zero)
        best[i] = num * num / max(q[i], _TINY)
    for k in range(n_agn):
        a = b = zero
        whole, limit = few.sums[k], ratio[k]
        for j in range(n_used):
            v = np.float32(min(share[j], base[j]) if first <= j < last else share[j])
            a += few.agn[k, j] * data[j] * v
            b += few.agn[k, j] * few.agn[k, j] * v
        for i in range(n):
            t[i] = whole[i]
        for j in range(first, last):
            row, x = few.galaxy[j], few.agn[k, j] * np.float32(share[j] - min(share[j], base[j]))
            for i in range(n):
                t[i] -= row[i] * x
        low, high = np.float32(ends[0]), np.float32(ends[1])
        for i in range(n):
            _, r = best_mixture(p[i], q[i], t[i], a, b, low * limit[i], high * limit[i], _TINY)
            best[i] = max(best[i], r)
    top = zero
    for i in range(n):
        top = max(top, best[i])
    return top


@njit(**PART)
def _take_out(few, n, ratio, data, norm, odds, base, n_used, ends, start):
    """Take out the bands, or neighbors, whose loss pays most, one after the other."""
    for _ in range(_ROUNDS):
        _sum(few, n, data, start, n_used)
        best, first, after = _HUGE, 0, 0
        for width in range(3):
            for j in range(n_used - width + 1 if width > 0 else 1):
                left = more = 0.0
                for i in range(n_used):
                    out = j <= i < j + width and start[i] > base[i]
                    more -= 2.0 * np.log(max(odds[i], 1e-30)) if out else 0.0
                    left += (base[i] if out else start[i]) * data[i] * data[i]
                if more == 0.0 and width > 0:
                    continue
                r = _reach(few, n, ratio, data, start, base, n_used, j, j + width, ends)
                value = norm * (left - r) + more
                if value < best:
                    best, first, after = value, j, j + width
        for j in range(first, after):
            start[j] = min(start[j], base[j])
        if after == first:
            break


@njit(**KERNEL)
def find_models(tables, target, few, odds, base, offset, ends, sizes, share, lowest, index, scale):
    """
    Find a model at each redshift that fits with some bands wrong.

    ``odds`` and ``base`` of the measured bands, shape (nz, n_used), are p sigma / ((1 - p) Sigma) and
    (sigma / Sigma)^2; ``offset``, shape (nz,), is added to chi2 where redshifts are compared; ``ends`` are the
    least and largest c, ``sizes`` the numbers of galaxies looked at everywhere, near the best redshift and nearer.
    Filled are ``share`` (as ``odds``) with weights over the stated ones, ``lowest``, shape (nz,), with chi2,
    ``index``, shape (nz, 2), with galaxy and AGN model (-1 where there is none), and ``scale``, shape
    (nz, 2), with factors of these.
    """
    n_used, n_agn = target.bands.size, few.agn.shape[0]
    start, model = few.share, few.model
    top_all = _HUGE
    for stage in range(len(sizes)):
        n = sizes[stage]
        near, top_all = top_all + (_NEAR if stage == 1 else _NEARER), _HUGE
        for z in range(target.log_prior.size):
            if target.log_prior[z] < -1e200 or (stage > 0 and lowest[z] + offset[z] > near):
                continue
            data, norm, v0 = target.data32[z], target.norm[z], base[z]
            top = 0.0
            for j in range(n_used):
                b, root = target.bands[j], target.root32[z, j]
                top = max(top, target.weight[z, b])
                for i in range(n):
                    few.galaxy[j, i] = few.flux[z, b, i] * root
                for k in range(n_agn):
                    few.agn[k, j] = tables.agn32[z, k, b] * root
            lowest[z], ratio, own, least = _HUGE, few.ratio[z], odds[z], _HUGE
            for j in range(n_used):
                least = min(least, -2.0 * np.log(max(own[j], 1e-30)))
            for begin in range(2 if stage == 0 else 1):
                if begin == 1 and lowest[z] < least:
                    continue
                for j in range(n_used):
                    start[j] = share[z, j] if stage > 0 else 1.0
                if begin == 1:
                    _take_out(few, n, ratio, data, norm, own, v0, n_used, ends, start)
                for _ in range(_STEPS):
                    _sum(few, n, data, start, n_used)
                    r, g = _reach(few, n, ratio, data, start, start, n_used, 0, 0, ends), 0
                    while g < n - 1 and few.less[_R, g] < r:
                        g += 1
                    k, x, num, den = np.int64(-1), np.float32(0), 0.0, 1e-30
                    r = max(few.less[_P, g], x) ** 2 / max(few.less[_Q, g], _TINY)
                    for m in range(n_agn):
                        a = b = np.float32(0)
                        for j in range(n_used):
                            v = np.float32(start[j])
                            a += few.agn[m, j] * data[j] * v
                            b += few.agn[m, j] * few.agn[m, j] * v
                        p, q, t = few.less[_P, g], few.less[_Q, g], few.sums[m, g]
                        low = np.float32(ends[0]) * ratio[m, g]
                        high = np.float32(ends[1]) * ratio[m, g]
                        y, value = best_mixture(p, q, t, a, b, low, high, _TINY)
                        if value > r:
                            r, x, k = value, y, m
                    for j in range(n_used):
                        model[j] = few.galaxy[j, g] + (x * few.agn[k, j] if k >= 0 else 0.0)
                        num += model[j] * data[j] * start[j]
                        den += model[j] * model[j] * start[j]
                    s, value, change = max(num, 0.0) / den, 0.0, 0.0
                    for j in range(n_used):
                        e = norm * (data[j] - s * model[j]) ** 2
                        good = np.exp(-min(0.5 * e * (1.0 - v0[j]), 600.0))
                        wrong = own[j] / (own[j] + good)
                        value += e * v0[j] - 2.0 * np.log(own[j] + good) if own[j] > 0.0 else e
                        v = 1.0 - wrong * (1.0 - v0[j])
                        change = max(change, abs(v - start[j]))
                        start[j] = v
                    if value < lowest[z]:
                        lowest[z], unit, place = value, np.sqrt(norm / top), few.index[z, g]
                        for j in range(n_used):
                            share[z, j] = start[j]
                        index[z, 0], index[z, 1] = place, k
                        scale[z, 0] = s * unit / tables.galaxy_unit[z, place]
                        scale[z, 1] = s * x * unit / tables.agn_unit[z, k] if k >= 0 else 0.0
                    if change < _STILL:
                        break
            top_all = min(top_all, lowest[z] + offset[z])
