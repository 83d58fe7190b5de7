"""The whole posterior of one object after the other."""

import math

import numpy as np
from numba import njit

from miricigale.fitting._core.bounds import (
    AGN_BITS,
    BLOCK,
    GROUP,
    ROW_BITS,
    galaxy_projections,
    pair_block,
    torus_projections,
)
from miricigale.fitting._core.evaluate import (
    LANES,
    agn_products,
    evaluate_pairs,
    evaluate_singles,
    row_best,
)
from miricigale.fitting._core.histogram import N_BINS, add_scaled, clear_rows, log_summary
from miricigale.fitting._core.structs import Scratch, Sums

__all__ = ["fit_many", "make_scratch", "make_sums"]

_OPTIONS = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}

_NEVER = np.float32(1e30)
_NOWHERE = np.float32(-1e3)
_LOG10_E = 0.43429448190325183
# Pairs whose bound is within this of the best are evaluated first.
_FIRST = 10.0
_GALAXY_MASK = (1 << (ROW_BITS - AGN_BITS)) - 1


def make_sums(n_z, n_galaxy, n_agn, n_frac, n_bands):
    """Make the accumulators of one object for a grid of the given size."""
    n_agn = max(n_agn, 1)
    ranges = [np.tile(np.array([[N_BINS, -1]]), (n, 1)) for n in (n_galaxy, n_agn, 1)]
    return Sums(
        np.zeros((n_z, n_frac)),
        np.zeros((n_galaxy, 6)),
        np.zeros((n_agn, 3)),
        np.zeros((2, n_bands)),
        np.zeros(5),
        np.zeros(3),
        np.full(4, -1),
        np.zeros((n_galaxy, N_BINS)),
        np.zeros((n_agn, N_BINS)),
        np.zeros((1, N_BINS)),
        *ranges,
        np.zeros(3),
    )


def make_scratch(n_z, n_galaxy, n_padded, n_agn, n_frac, n_bands, capacity):
    """Make the work space for a grid of the given size; ``capacity`` pairs are listed at once."""
    capacity = max(int(capacity), 2 * BLOCK * max(n_agn, 1))
    return Scratch(
        np.empty(capacity, np.int64),
        np.empty(capacity, np.float32),
        np.empty((n_z, n_padded), np.float32),
        np.empty((n_z, n_padded), np.float32),
        np.empty((n_galaxy, n_bands)),
        np.empty((n_galaxy, 2)),
        np.zeros(n_galaxy, np.int64),
        np.zeros(20 * LANES),
        np.zeros(LANES, np.int64),
        np.zeros((2, LANES), np.int64),
        np.zeros(n_frac * LANES),
        np.zeros(n_frac * LANES),
        np.zeros(2 * n_frac),
        np.zeros(2 * n_frac),
        np.zeros(2 * n_frac, np.int64),
        np.zeros(1, np.int64),
    )


@njit(**_OPTIONS)
def _clear(sums):
    """Empty the accumulators."""
    for table in (sums.zf, sums.galaxy, sums.agn, sums.band):
        for i in range(table.shape[0]):
            for j in range(table.shape[1]):
                table[i, j] = 0.0
    for i in range(sums.total.size):
        sums.total[i] = 0.0
    for i in range(sums.best.size):
        sums.best[i] = 0.0
    for i in range(sums.index.size):
        sums.index[i] = -1
    clear_rows(sums.hist_galaxy, sums.range_galaxy)
    clear_rows(sums.hist_agn, sums.range_agn)
    clear_rows(sums.hist_mixed, sums.range_mixed)


@njit(**_OPTIONS)
def _descending(x):
    """Order of the elements from large to small, by insertion (equal ones stay in order)."""
    order = np.empty(x.size, np.int64)
    for i in range(x.size):
        j = i
        while j > 0 and x[order[j - 1]] < x[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i
    return order


@njit(**_OPTIONS)
def _second_floor(request, scratch, n, reference, sums, top_frac):
    """
    Least bound to evaluate, once the weight of the best pairs is known.

    The weight of a pair is at most exp((bound - reference) / 2) / top_frac. The pairs below
    the first value returned sum up to at most ``rtol`` of the weight so far, and so would all
    pairs if they were at the second.
    """
    n_bins = int(min(request.delta, 1e4) * 4.0) + 1
    count = np.zeros(n_bins + 1)
    found = scratch.found
    bound = scratch.bound
    for i in range(n):
        column = (reference - bound[i]) * 4.0
        if found[i] >= 0 and 0.0 <= column < n_bins:
            count[int(column)] += 1.0
    unit = math.exp(min(0.5 * (reference - sums.best[2]), 0.0)) / top_frac
    room = request.rtol * sums.total[0]
    left = 0.0
    last = n_bins
    while last > 0:
        left += count[last - 1] * math.exp(-0.125 * (last - 1)) * unit
        if left > room:
            break
        last -= 1
    floor = reference - min(0.25 * last, request.delta)
    if not room > 0.0:
        return floor, -1e300
    return floor, min(floor, reference - 2.0 * math.log(max(n, 1) * unit / room))


@njit(**_OPTIONS)
def _fit_one(tables, request, data, weight, log_prior, sums, scratch):
    """
    Sum up the posterior of one object.

    Parameters
    ----------
    tables, request, sums, scratch
        See `miricigale.fitting._core.structs`.
    data, weight : `~numpy.ndarray`, shape (nb,)
        Fluxes in uJy and 1 / sigma^2, both 0 in unused bands.
    log_prior : `~numpy.ndarray`, shape (nz,)
        2 ln(prior) of the redshifts; -1e300 where it is 0.

    Returns
    -------
    norm : float
        |F|^2_w.
    """
    n_z, n_galaxy, n_bands = tables.galaxy.shape
    n_agn = tables.agn.shape[1]
    n_padded = tables.galaxy32.shape[2]
    zero = np.float32(0)
    _clear(sums)
    scratch.counter[0] = 0
    norm = 0.0
    top_weight = 0.0
    n_used = 0
    for b in range(n_bands):
        norm += data[b] * data[b] * weight[b]
        top_weight = max(top_weight, weight[b])
        n_used += weight[b] > 0.0
    if not norm > 0.0:
        return norm
    bands = np.empty(n_used, np.int64)
    root_weight = np.empty(n_used, np.float32)
    unit_data = np.empty(n_used, np.float32)
    j = 0
    for b in range(n_bands):
        if weight[b] > 0.0:
            bands[j] = b
            root_weight[j] = math.sqrt(weight[b] / top_weight)
            unit_data[j] = data[b] * math.sqrt(weight[b] / norm)
            j += 1
    # galaxies alone, and the most promising redshifts first
    promise = np.full(n_z, -1e30)
    row_of = np.zeros(n_z, np.int64)
    for z in range(n_z):
        if log_prior[z] < -1e200:
            continue
        p32 = scratch.p32[z]
        galaxy_projections(
            tables.galaxy32[z], bands, root_weight, unit_data, p32, scratch.inverse_norm[z]
        )
        top = np.float32(-1)
        for g in range(n_galaxy):
            if tables.usable[z, g] and p32[g] > top:
                top = p32[g]
                row_of[z] = g
        if top > -1.0:
            value = np.float64(max(top, zero))
            promise[z] = value * value * norm + log_prior[z]
    order = _descending(promise)
    agn_pq = np.empty((n_agn, 2))
    top_agn = 0.0
    for k in range(n_agn):
        top_agn = max(top_agn, tables.prior_agn[k])
    top_frac = 0.0
    for j in range(tables.prior_frac.size):
        top_frac = max(top_frac, tables.prior_frac[j])
    # the largest prior a pair (or, with f = 0, a galaxy) can have from torus and fraction
    log_top = 2.0 * math.log(max(top_frac, 1e-300))
    reference = -1e300
    for i in range(min(3, n_z)):
        z = order[i]
        if promise[z] < -1e29:
            break
        agn_products(tables.agn[z], data, weight, agn_pq)
        g = row_of[z]
        value, s = row_best(tables, z, g, data, weight, agn_pq)
        value += log_prior[z] + tables.log_galaxy[g]
        if value > reference:
            reference = value
            sums.origin[0] = _LOG10_E * math.log(s) if s > 0.0 else 0.0
    if reference < -1e299:
        return norm
    top_dust = 1e-300
    top_mixed = 1e-300
    for g in range(n_galaxy):
        top_dust = max(top_dust, tables.dust[g])
        top_mixed = max(top_mixed, tables.mixed_galaxy[g])
    sums.origin[1] = sums.origin[0] + _LOG10_E * math.log(top_dust)
    sums.origin[2] = sums.origin[0] + _LOG10_E * math.log(top_mixed)
    n_found = np.int64(0)
    if n_agn > 0 and tables.ratio.size > 0:
        log_pair = log_top + 2.0 * math.log(max(top_agn, 1e-300))
        n_groups = (n_agn + GROUP - 1) // GROUP
        unit_agn = np.zeros((n_groups * GROUP, n_used), np.float32)
        a32 = np.empty(n_agn, np.float32)
        a2 = np.empty(n_agn, np.float32)
        unit_galaxy = np.empty((n_used, BLOCK), np.float32)
        refined = np.zeros(n_galaxy, np.int64)
        margin = 2.0
        found = scratch.found
        bound = scratch.bound
        log_galaxy = tables.log_galaxy
        threshold = np.empty(BLOCK, np.float32)
        p_block = np.empty(BLOCK, np.float32)
        for i in range(n_z):
            z = order[i]
            if promise[z] < -1e29:
                break
            torus_projections(tables.agn32[z], bands, root_weight, unit_data, unit_agn, a32, a2)
            agn_known = False
            for start in range(0, n_padded, BLOCK):
                n_here = 0
                for m in range(BLOCK):
                    g = start + m
                    # what may not be used is parallel to nothing and reaches nothing
                    threshold[m] = _NEVER
                    p_block[m] = _NOWHERE
                    if g < n_galaxy and tables.usable[z, g]:
                        n_here += 1
                        t = reference - request.delta - log_prior[z] - log_pair
                        t -= tables.log_galaxy[g]
                        threshold[m] = max(min(t / norm, 1.0), -1.0) - 1e-6
                        p_block[m] = scratch.p32[z, g]
                if n_here == 0:
                    continue
                for j in range(n_used):
                    row = tables.galaxy32[z, bands[j]]
                    s32 = root_weight[j]
                    inverse = scratch.inverse_norm[z]
                    for m in range(BLOCK):
                        unit_galaxy[j, m] = row[start + m] * s32 * inverse[start + m]
                end = pair_block(
                    unit_galaxy,
                    p_block,
                    threshold,
                    unit_agn,
                    a32,
                    a2,
                    n_found,
                    (z << ROW_BITS) + (start << AGN_BITS),
                    found,
                    bound,
                )
                # galaxies that promise more than the reference are evaluated at once; when
                # that does not pay, only those that promise much more
                for m in range(n_found, end):
                    g = (found[m] >> AGN_BITS) & _GALAXY_MASK
                    value = min(np.float64(bound[m]), 1.0) * norm
                    value += log_prior[z] + log_galaxy[g] + log_pair
                    # from here on the list holds the bound of R + 2 ln(prior)
                    bound[m] = value + 3e-7 * abs(value)
                    if value > reference + margin and refined[g] != z + 1:
                        refined[g] = z + 1
                        if not agn_known:
                            agn_known = True
                            agn_products(tables.agn[z], data, weight, agn_pq)
                        value, s = row_best(tables, z, g, data, weight, agn_pq)
                        value += log_prior[z] + log_galaxy[g]
                        if value > reference:
                            reference = value
                            margin = 2.0
                        else:
                            margin *= 1.5
                n_found = end
                if n_found + BLOCK * n_agn > found.size:
                    floor = reference - request.delta
                    sums.best[2] = reference if sums.total[3] == 0.0 else sums.best[2]
                    evaluate_pairs(
                        tables,
                        request,
                        data,
                        weight,
                        log_prior,
                        sums,
                        scratch,
                        n_found,
                        floor,
                        floor,
                    )
                    n_found = np.int64(0)
        sums.best[2] = reference if sums.total[3] == 0.0 else sums.best[2]
        floor = reference - _FIRST
        evaluate_pairs(
            tables, request, data, weight, log_prior, sums, scratch, n_found, floor, floor
        )
        floor, sure = _second_floor(request, scratch, n_found, reference, sums, top_frac)
        evaluate_pairs(
            tables, request, data, weight, log_prior, sums, scratch, n_found, floor, sure
        )
    sums.best[2] = reference if sums.total[3] == 0.0 else sums.best[2]
    if tables.zero_frac == 1:
        floor = reference - request.delta
        evaluate_singles(tables, request, data, weight, log_prior, sums, scratch, floor, norm)
    return norm


@njit(**_OPTIONS)
def _derived(tables, request, sums, norm, sigma, hist, moments, quantiles):
    """
    Moments and quantiles of every derived quantity of one object.

    The order is the galaxy's quantities, the torus's, then the mixed one.

    Parameters
    ----------
    hist : `~numpy.ndarray`, shape (N_BINS,)
        Scratch.
    moments : `~numpy.ndarray`, shape (n_quantities, 3)
        Filled with mean, standard deviation and mean of log10.
    quantiles : `~numpy.ndarray`, shape (n_quantities, n_levels)
        Filled.
    """
    total = sums.total[0]
    least = 1e-6 * total / tables.galaxy.shape[1]
    n_galaxy_q = tables.galaxy_scale.shape[0]
    n_agn_q = tables.agn_scale.shape[0]
    row = 0
    for m in range(n_galaxy_q):
        scale = tables.galaxy_scale[m]
        mean = 0.0
        square = 0.0
        for g in range(scale.size):
            mean += sums.galaxy[g, 1] * scale[g]
            square += sums.galaxy[g, 2] * scale[g] * scale[g]
        for j in range(N_BINS):
            hist[j] = 0.0
        shift, zero = add_scaled(
            sums.hist_galaxy, sums.range_galaxy, scale, sums.galaxy[:, 0], least, hist
        )
        zero += sums.total[2]
        middle = sums.origin[0] + shift
        mean /= total
        moments[row, 0] = mean
        moments[row, 1] = math.sqrt(max(square / total - mean * mean, 0.0))
        moments[row, 2] = log_summary(hist, middle, zero, sigma, request.levels, quantiles[row])
        row += 1
    # weight of models without any AGN power
    power = 0.0
    for j in range(N_BINS):
        power += sums.hist_mixed[0, j]
    no_power = 0.0
    with_power = 0.0
    for k in range(sums.hist_agn.shape[0]):
        for j in range(sums.range_agn[k, 0], sums.range_agn[k, 1] + 1):
            with_power += sums.hist_agn[k, j]
    no_power = max(total - with_power, 0.0)
    for m in range(n_agn_q):
        scale = tables.agn_scale[m]
        mean = 0.0
        square = 0.0
        for k in range(scale.size):
            mean += sums.agn[k, 1] * scale[k]
            square += sums.agn[k, 2] * scale[k] * scale[k]
        for j in range(N_BINS):
            hist[j] = 0.0
        shift, zero = add_scaled(sums.hist_agn, sums.range_agn, scale, sums.agn[:, 0], 0.0, hist)
        middle = sums.origin[1] + shift
        mean /= total
        moments[row, 0] = mean
        moments[row, 1] = math.sqrt(max(square / total - mean * mean, 0.0))
        moments[row, 2] = log_summary(
            hist, middle, zero + no_power, sigma, request.levels, quantiles[row]
        )
        row += 1
    # the quantity that both have a part in
    mean = 0.0
    square = 2.0 * sums.total[4]
    for g in range(tables.dust.size):
        part = tables.mixed_galaxy[g]
        mean += sums.galaxy[g, 1] * part
        square += sums.galaxy[g, 2] * part * part
    for k in range(tables.mixed_agn.size):
        part = tables.mixed_agn[k]
        mean += sums.agn[k, 1] * part
        square += sums.agn[k, 2] * part * part
    for j in range(N_BINS):
        hist[j] = sums.hist_mixed[0, j]
    mean /= total
    moments[row, 0] = mean
    moments[row, 1] = math.sqrt(max(square / total - mean * mean, 0.0))
    moments[row, 2] = log_summary(
        hist, sums.origin[2], max(total - power, 0.0), sigma, request.levels, quantiles[row]
    )


@njit(**_OPTIONS)
def fit_many(tables, request, data, weight, log_prior, sums, scratch, out):
    """
    Fit objects one after the other.

    Parameters
    ----------
    tables, request, sums, scratch, out
        See `miricigale.fitting._core.structs`; ``out`` is filled.
    data, weight : `~numpy.ndarray`, shape (n, nb)
        Fluxes in uJy and 1 / sigma^2, both 0 in unused bands.
    log_prior : `~numpy.ndarray`, shape (n, nz)
        2 ln(prior) of the redshifts of each object; -1e300 where it is 0. A row of -1e300
        is left alone.
    """
    hist = np.zeros(N_BINS)
    n_z, n_galaxy, n_bands = tables.galaxy.shape
    n_agn = tables.agn.shape[1]
    for i in range(data.shape[0]):
        top = -1e300
        for z in range(n_z):
            top = max(top, log_prior[i, z])
        if top < -1e200:
            continue
        norm = _fit_one(tables, request, data[i], weight[i], log_prior[i], sums, scratch)
        total = sums.total[0]
        if not (norm > 0.0 and total > 0.0):
            continue
        out.norm[i] = norm
        out.log_sum[i] = math.log(total) + 0.5 * (sums.best[2] - norm)
        out.n_models[i] = sums.total[3]
        out.best_r[i] = sums.best[0]
        out.best_scale[i] = sums.best[1]
        for j in range(4):
            out.index[i, j] = sums.index[j]
        for z in range(n_z):
            for j in range(sums.zf.shape[1]):
                out.zf[i, z, j] = sums.zf[z, j] / total
        for g in range(n_galaxy):
            out.galaxy[i, g] = sums.galaxy[g, 0] / total
        # without AGN the data say nothing on the torus: its prior
        alone = 0.0
        if tables.zero_frac == 1:
            for z in range(n_z):
                alone += sums.zf[z, 0]
        for k in range(n_agn):
            out.agn[i, k] = (sums.agn[k, 0] + alone * tables.prior_agn[k]) / total
        for b in range(n_bands):
            mean = sums.band[0, b] / total
            out.band[i, 0, b] = mean
            out.band[i, 1, b] = math.sqrt(max(sums.band[1, b] / total - mean * mean, 0.0))
        mean_r = max(sums.total[1] / total, 1.0)
        sigma = request.scale_error / math.sqrt(mean_r)
        _derived(tables, request, sums, norm, sigma, hist, out.moments[i], out.quantiles[i])
