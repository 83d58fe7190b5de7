"""
Exact evaluation of the pairs that the bounds left over, in double precision.

For a galaxy with p = <G, wF>, q = <G, wG> and a torus with a = <A, wF>, b = <A, wA>,
X = <G, wA>, the model s (G + x A) with x = c L_dust has the best scale
s = (p + x a) / (q + 2 x X + x^2 b) and |F|^2_w - chi2 = R = (p + x a) s. Where p + x a is
negative the best scale that is not negative is 0 and R = 0. Sums over the AGN fractions of
one pair are kept apart, so that moments of every quantity follow from few accumulators.
"""

import math

import numpy as np
from numba import njit

from miricigale.fitting._core.bounds import AGN_BITS, ROW_BITS
from miricigale.fitting._core.histogram import HALF_BINS, N_BINS, PER_DEX, fill_log10

__all__ = ["LANES", "evaluate_pairs", "evaluate_singles", "row_best"]

#: Pairs evaluated side by side.
LANES = 128

_OPTIONS = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
# Written into the caller: a call counts the references of every array of its bundles, which
# for small pieces of work takes longer than the work.
_INLINE = {**_OPTIONS, "inline": "always"}

# Offsets of the vectors in Scratch.buffer.
_P, _Q, _X2, _A, _B, _DUST, _PRIOR, _R, _S2, _E = (i * LANES for i in range(10))
_W0, _W1, _W2, _V1, _U2, _V2, _WR, _WZ, _TOP, _OVER = (i * LANES for i in range(10, 20))
_END = 20 * LANES
_AGN_MASK = (1 << AGN_BITS) - 1
_GALAXY_MASK = (1 << (ROW_BITS - AGN_BITS)) - 1
#: Pairs of a list that go into the histograms unthinned.
_SAMPLE = 50_000

_LOG2E = 1.4426950408889634
_LOG10_E = 0.43429448190325183
_LN2_HIGH = 0.6931471803691238
_LN2_LOW = 1.9082149292705877e-10


@njit(**_OPTIONS)
def row_best(tables, z, g, data, weight, agn_pq):
    """
    Best model of one galaxy at one redshift.

    Parameters
    ----------
    tables : `~miricigale.fitting._core.structs.Tables`
        The grid.
    z, g : int
        Redshift and galaxy.
    data, weight : `~numpy.ndarray`, shape (nb,)
        Fluxes in uJy and 1 / sigma^2, both 0 in unused bands.
    agn_pq : `~numpy.ndarray`, shape (nA, 2)
        <A, wF> and <A, wA> at this redshift.

    Returns
    -------
    value : float
        Largest R + 2 ln(prior of torus and fraction).
    s : float
        Scale of the model that has it.
    """
    galaxy = tables.galaxy[z, g]
    p = 0.0
    q = 0.0
    for b in range(data.size):
        t = galaxy[b] * weight[b]
        p += t * data[b]
        q += t * galaxy[b]
    best_value = -1e300
    best_s = 0.0
    dust = tables.dust[g]
    if tables.zero_frac == 1 and q > 0.0 and tables.prior_frac[0] > 0.0:
        best_s = max(p, 0.0) / q
        best_value = best_s * max(p, 0.0) + tables.log_frac[0]
    for k in range(agn_pq.shape[0]):
        if not tables.prior_agn[k] > 0.0:
            continue
        agn = tables.agn[z, k]
        x_cross = 0.0
        for b in range(data.size):
            x_cross += galaxy[b] * weight[b] * agn[b]
        log_prior = tables.log_agn[k]
        a = agn_pq[k, 0]
        b2 = agn_pq[k, 1]
        for j in range(tables.ratio.size):
            x = tables.ratio[j] * dust
            num = max(p + x * a, 0.0)
            den = q + x * (2.0 * x_cross + x * b2)
            if den > 0.0:
                value = num * num / den + log_prior + tables.log_frac[j + tables.zero_frac]
                if value > best_value:
                    best_value = value
                    best_s = num / den
    return best_value, best_s


@njit(**_OPTIONS)
def agn_products(agn, data, weight, agn_pq):
    """Fill agn_pq[k] = <A, wF>, <A, wA> for all tori of one redshift."""
    for k in range(agn_pq.shape[0]):
        p = 0.0
        q = 0.0
        for b in range(data.size):
            t = agn[k, b] * weight[b]
            p += t * data[b]
            q += t * agn[k, b]
        agn_pq[k, 0] = p
        agn_pq[k, 1] = q


@njit(**_OPTIONS)
def _note_best(sums, r, s, z, g, k, f):
    """Keep the best model; of equals the one with the lowest indices."""
    if r < sums.best[0]:
        return
    index = sums.index
    if r == sums.best[0] and index[0] >= 0:
        # compare (z, g, f, k), so that f = 0 comes before its copies
        if z != index[0]:
            if z > index[0]:
                return
        elif g != index[1]:
            if g > index[1]:
                return
        elif f != index[3]:
            if f > index[3]:
                return
        elif k >= index[2]:
            return
    sums.best[0] = r
    sums.best[1] = s
    index[0] = z
    index[1] = g
    index[2] = k
    index[3] = f


@njit(**_OPTIONS)
def _rescale(sums, factor):
    """Multiply all weights, when a better model becomes the reference."""
    for table in (sums.zf, sums.galaxy, sums.agn, sums.band):
        for i in range(table.shape[0]):
            for j in range(table.shape[1]):
                table[i, j] *= factor
    for i in range(5):
        sums.total[i] *= factor if i != 3 else 1.0
    for i in range(sums.hist_galaxy.shape[0]):
        for j in range(sums.range_galaxy[i, 0], sums.range_galaxy[i, 1] + 1):
            sums.hist_galaxy[i, j] *= factor
    for i in range(sums.hist_agn.shape[0]):
        for j in range(sums.range_agn[i, 0], sums.range_agn[i, 1] + 1):
            sums.hist_agn[i, j] *= factor
    for j in range(sums.range_mixed[0, 0], sums.range_mixed[0, 1] + 1):
        sums.hist_mixed[0, j] *= factor


@njit(**_OPTIONS)
def _likelihoods(buffer, power, scale, weight, ratio, frac_prior, reference, scale_error, n, out):
    """
    Evaluate n pairs at every AGN fraction and sum over the fractions.

    All vectors of LANES pairs stand in one buffer, at offsets known to the compiler, which
    can then see that they do not overlap. ``scale`` and ``weight`` (flat, n_ratio * LANES)
    are filled with the scales and with prior * likelihood; ``out[j]`` with their sum.

    Returns
    -------
    top : float
        Largest R.
    over : float
        Largest exponent; when it is large the reference must be changed.
    """
    bits = weight.view(np.int64)
    top = 0.0
    over = -700.0
    for i in range(_W0, _END):
        buffer[i] = 0.0
    for j in range(ratio.size):
        c = ratio[j]
        f = frac_prior[j]
        o = j * LANES
        for i in range(n):
            x = c * buffer[_DUST + i]
            num = max(buffer[_P + i] + x * buffer[_A + i], 0.0)
            den = buffer[_Q + i] + x * (buffer[_X2 + i] + x * buffer[_B + i])
            inverse = 1.0 / max(den, 1e-300)
            s = num * inverse
            r = num * s
            scale[o + i] = s
            buffer[_R + i] = r
            buffer[_S2 + i] = s * s + scale_error * inverse
            buffer[_E + i] = 0.5 * (r + buffer[_PRIOR + i] - reference)
        for i in range(n):
            # running maxima in lanes; a scalar one would not be vectorised
            buffer[_TOP + i] = max(buffer[_TOP + i], buffer[_R + i])
            buffer[_OVER + i] = max(buffer[_OVER + i], buffer[_E + i])
        # exp to 2e-15, after Cody & Waite
        for i in range(n):
            y = min(max(buffer[_E + i], -700.0), 700.0)
            m = np.floor(y * _LOG2E + 0.5)
            r = y - m * _LN2_HIGH
            r = r - m * _LN2_LOW
            v = 1.0 / 6227020800.0
            v = v * r + 1.0 / 479001600.0
            v = v * r + 1.0 / 39916800.0
            v = v * r + 1.0 / 3628800.0
            v = v * r + 1.0 / 362880.0
            v = v * r + 1.0 / 40320.0
            v = v * r + 1.0 / 5040.0
            v = v * r + 1.0 / 720.0
            v = v * r + 1.0 / 120.0
            v = v * r + 1.0 / 24.0
            v = v * r + 1.0 / 6.0
            v = v * r + 0.5
            v = v * r + 1.0
            v = v * r + 1.0
            weight[o + i] = v
            power[i] = np.int64(np.int32(m)) << np.int64(52)
        for i in range(n):
            bits[o + i] += power[i]
        f_sum = 0.0
        for i in range(n):
            t = weight[o + i] * f
            weight[o + i] = t
            s = scale[o + i]
            f_sum += t
            t1 = t * s
            t2 = t * buffer[_S2 + i]
            buffer[_W0 + i] += t
            buffer[_WR + i] += t * buffer[_R + i]
            buffer[_WZ + i] += t if s == 0.0 else 0.0
            buffer[_W1 + i] += t1
            buffer[_V1 + i] += t1 * c
            buffer[_W2 + i] += t2
            buffer[_U2 + i] += t2 * c
            buffer[_V2 + i] += t2 * (c * c)
        out[j] = f_sum
    for i in range(n):
        top = max(top, buffer[_TOP + i])
        over = max(over, buffer[_OVER + i])
    return top, over


@njit(**_OPTIONS)
def _find_best(tables, sums, scratch, z, n):
    """Look for the best model among the lanes, with the arithmetic of `_likelihoods`."""
    buffer = scratch.buffer
    for j in range(tables.ratio.size):
        c = tables.ratio[j]
        if not tables.prior_frac[j + tables.zero_frac] > 0.0:
            continue
        for i in range(n):
            x = c * buffer[_DUST + i]
            num = max(buffer[_P + i] + x * buffer[_A + i], 0.0)
            den = buffer[_Q + i] + x * (buffer[_X2 + i] + x * buffer[_B + i])
            s = num * (1.0 / max(den, 1e-300))
            g, k = scratch.lane_index[0, i], scratch.lane_index[1, i]
            _note_best(sums, num * s, s, z, g, k, j + tables.zero_frac)


@njit(**_INLINE)
def _fill_histograms(tables, sums, scratch, n, n_listed, share):
    """
    Add the pairs in the lanes to the histograms.

    Of long lists only every so many-th of the pairs that carry less than 5 times their share
    of the weight is taken, with so many times its weight.
    """
    n_ratio = tables.ratio.size
    buffer = scratch.buffer
    stride = 1 + n_listed // _SAMPLE
    while stride > 1 and (stride % 2 == 0 or stride % 3 == 0 or stride % 5 == 0 or stride % 7 == 0):
        stride += 1
    least = 1e-4 * share * sums.total[0]
    heavy = 5.0 * share * sums.total[0] if stride > 1 else 0.0
    index = scratch.lane_index
    scale = scratch.scale
    weight = scratch.weight
    values = scratch.values
    logs = scratch.logs
    power = scratch.log_power
    ratio = tables.ratio
    log_ratio = tables.log_ratio
    log_dust = tables.log_dust
    mixed_galaxy = tables.mixed_galaxy
    mixed_agn = tables.mixed_agn
    galaxy_hist, agn_hist, mixed_hist = sums.hist_galaxy, sums.hist_agn, sums.hist_mixed
    galaxy_range, agn_range, mixed_range = sums.range_galaxy, sums.range_agn, sums.range_mixed
    galaxy_middle = HALF_BINS - PER_DEX * sums.origin[0]
    agn_middle = HALF_BINS - PER_DEX * sums.origin[1]
    mixed_middle = HALF_BINS - PER_DEX * sums.origin[2]
    seen = scratch.counter[0]
    scratch.counter[0] += n
    mixed_first = mixed_range[0, 0]
    mixed_last = mixed_range[0, 1]
    for i in range(n):
        w = buffer[_W0 + i]
        if w <= least:
            continue
        factor = 1.0
        if w < heavy:
            if (seen + i) % stride != 0:
                continue
            factor = np.float64(stride)
        g, k = index[0, i], index[1, i]
        dust = buffer[_DUST + i]
        for j in range(n_ratio):
            s = scale[j * LANES + i]
            values[j] = s
            values[n_ratio + j] = s * (mixed_galaxy[g] + ratio[j] * dust * mixed_agn[k])
        fill_log10(values, power, logs, 2 * n_ratio)
        shift = PER_DEX * log_dust[g] + agn_middle
        first, last = galaxy_range[g, 0], galaxy_range[g, 1]
        agn_first, agn_last = agn_range[k, 0], agn_range[k, 1]
        for j in range(n_ratio):
            if values[j] == 0.0:
                continue
            t = weight[j * LANES + i] * factor
            y = logs[j] * PER_DEX
            column = min(max(np.int64(y + galaxy_middle), 0), N_BINS - 1)
            galaxy_hist[g, column] += t
            first = min(first, column)
            last = max(last, column)
            if dust > 0.0:
                column = min(max(np.int64(y + log_ratio[j] + shift), 0), N_BINS - 1)
                agn_hist[k, column] += t
                agn_first = min(agn_first, column)
                agn_last = max(agn_last, column)
            if values[n_ratio + j] > 0.0:
                y = logs[n_ratio + j] * PER_DEX + mixed_middle
                column = min(max(np.int64(y), 0), N_BINS - 1)
                mixed_hist[0, column] += t
                mixed_first = min(mixed_first, column)
                mixed_last = max(mixed_last, column)
        galaxy_range[g, 0], galaxy_range[g, 1] = first, last
        agn_range[k, 0], agn_range[k, 1] = agn_first, agn_last
    mixed_range[0, 0], mixed_range[0, 1] = mixed_first, mixed_last


@njit(**_OPTIONS)
def _widen(bins, row, first, last):
    """Widen the range of bins in use of a row."""
    bins[row, 0] = min(bins[row, 0], first)
    bins[row, 1] = max(bins[row, 1], last)


@njit(**_INLINE)
def _evaluate_lanes(tables, request, sums, scratch, z, n, n_listed):
    """
    Evaluate the first n pairs in the lanes, all at redshift z, and add them to the sums.

    What carries less than a small part of its share (1 / n_listed) of the weight so far is
    left out of histograms (1e-4) and of the moments of model fluxes (1e-8), and of nothing
    else.
    """
    buffer = scratch.buffer
    n_ratio = tables.ratio.size
    frac_sum = np.empty(n_ratio)
    frac_prior = tables.prior_frac[tables.zero_frac :]
    while True:
        top, over = _likelihoods(
            buffer,
            scratch.power,
            scratch.scale,
            scratch.weight,
            tables.ratio,
            frac_prior,
            sums.best[2],
            request.scale_error,
            n,
            frac_sum,
        )
        if over < 200.0:
            break
        # a far better model than the reference: it becomes the reference
        sums.best[2] += 2.0 * over
        _rescale(sums, math.exp(-min(over, 700.0)))
    if top >= sums.best[0]:
        _find_best(tables, sums, scratch, z, n)
    for j in range(n_ratio):
        sums.zf[z, j + tables.zero_frac] += frac_sum[j]
    index = scratch.lane_index
    galaxy_sums = sums.galaxy
    mixed_galaxy = tables.mixed_galaxy
    mixed_agn = tables.mixed_agn
    agn_sums = sums.agn
    total = 0.0
    total_r = 0.0
    total_zero = 0.0
    total_cross = 0.0
    for i in range(n):
        g, k = index[0, i], index[1, i]
        dust = buffer[_DUST + i]
        total += buffer[_W0 + i]
        total_r += buffer[_WR + i]
        total_zero += buffer[_WZ + i]
        total_cross += buffer[_U2 + i] * dust * mixed_galaxy[g] * mixed_agn[k]
        galaxy_sums[g, 0] += buffer[_W0 + i]
        galaxy_sums[g, 1] += buffer[_W1 + i]
        galaxy_sums[g, 2] += buffer[_W2 + i]
        galaxy_sums[g, 3] += buffer[_V1 + i]
        galaxy_sums[g, 4] += buffer[_U2 + i]
        galaxy_sums[g, 5] += buffer[_V2 + i]
        agn_sums[k, 0] += buffer[_W0 + i]
        agn_sums[k, 1] += buffer[_V1 + i] * dust
        agn_sums[k, 2] += buffer[_V2 + i] * dust * dust
    sums.total[0] += total
    sums.total[1] += total_r
    sums.total[2] += total_zero
    sums.total[4] += total_cross
    sums.total[3] += n * n_ratio
    share = 1.0 / n_listed
    least = 1e-8 * share * sums.total[0]
    n_bands = sums.band.shape[1]
    band = sums.band
    galaxy = tables.galaxy
    agn = tables.agn
    for i in range(n):
        if buffer[_W0 + i] > least:
            g, k = index[0, i], index[1, i]
            dust = buffer[_DUST + i]
            w1 = buffer[_W1 + i]
            w2 = buffer[_W2 + i]
            c1 = buffer[_V1 + i] * dust
            c2 = 2.0 * buffer[_U2 + i] * dust
            c3 = buffer[_V2 + i] * dust * dust
            for m in range(n_bands):
                x = galaxy[z, g, m]
                y = agn[z, k, m]
                band[0, m] += w1 * x + c1 * y
                band[1, m] += x * (w2 * x + c2 * y) + c3 * y * y
    _fill_histograms(tables, sums, scratch, n, n_listed, share)


@njit(**_OPTIONS)
def evaluate_pairs(tables, request, data, weight, log_prior, sums, scratch, n, floor, sure):
    """
    Add the listed pairs to the sums.

    Parameters
    ----------
    tables, request, sums, scratch
        See `miricigale.fitting._core.structs`; ``scratch.found`` and ``scratch.bound`` list
        the pairs.
    data, weight : `~numpy.ndarray`, shape (nb,)
        Fluxes in uJy and 1 / sigma^2, both 0 in unused bands.
    log_prior : `~numpy.ndarray`, shape (nz,)
        2 ln(prior) of the redshifts.
    n : int
        Number of pairs in the list.
    floor : float
        Pairs whose bound of R + 2 ln(prior) is at least this are evaluated and marked as
        done (-1) in the list.
    sure : float
        Of these, pairs whose exact bound turns out lower than this get that bound in the list
        and are not evaluated.
    """
    buffer = scratch.buffer
    n_agn = tables.agn.shape[1]
    n_bands = data.size
    n_ratio = tables.ratio.size
    agn_pq = np.empty((n_agn, 2))
    # typed, for a literal 0 would have every kernel compiled once more
    z_now = np.int64(-1)
    filled = np.int64(0)
    log_frac = -1e300
    for j in range(n_ratio):
        log_frac = max(log_frac, tables.log_frac[j + tables.zero_frac])
    galaxy = tables.galaxy
    agn = tables.agn
    dusts = tables.dust
    log_galaxy = tables.log_galaxy
    log_agn = tables.log_agn
    weighted = scratch.weighted
    pq = scratch.pq
    known = scratch.known
    found = scratch.found
    bound = scratch.bound
    index = scratch.lane_index
    c_low = tables.ratio[0]
    c_high = tables.ratio[n_ratio - 1]
    n_listed = np.int64(1)
    for i in range(n):
        n_listed += bound[i] >= floor and found[i] >= 0
    known[:] = 0
    for i in range(n + 1):
        # the round after the last one only empties the lanes
        pair = found[i] if i < n else np.int64(-1)
        if i < n and (bound[i] < floor or pair < 0):
            continue
        z = pair >> ROW_BITS
        if filled > 0 and (filled == LANES or z != z_now):
            _evaluate_lanes(tables, request, sums, scratch, z_now, filled, n_listed)
            filled = np.int64(0)
        if i == n:
            break
        k = pair & _AGN_MASK
        g = (pair >> AGN_BITS) & _GALAXY_MASK
        pair_prior = log_prior[z] + log_galaxy[g] + log_agn[k]
        pair_floor = sure - pair_prior - log_frac
        if z != z_now:
            z_now = z
            agn_products(agn[z], data, weight, agn_pq)
        if known[g] != z + 1:
            known[g] = z + 1
            p = 0.0
            q = 0.0
            for b in range(n_bands):
                t = galaxy[z, g, b] * weight[b]
                weighted[g, b] = t
                p += t * data[b]
                q += t * galaxy[z, g, b]
            pq[g, 0] = p
            pq[g, 1] = q
        p = pq[g, 0]
        q = pq[g, 1]
        cross = 0.0
        for b in range(n_bands):
            cross += weighted[g, b] * agn[z, k, b]
        a = agn_pq[k, 0]
        c = agn_pq[k, 1]
        # best R over the range of x that the fractions span
        dust = dusts[g]
        x_low = c_low * dust
        x_high = c_high * dust
        rise = a * q - p * cross
        fall = p * c - a * cross
        if rise <= 0.0:
            x = x_low
        elif rise >= x_high * fall:
            x = x_high
        else:
            x = max(rise / fall, x_low)
        num = max(p + x * a, 0.0)
        den = max(q + x * (2.0 * cross + x * c), 1e-300)
        # rounding of near-parallel pairs is allowed for
        if num * num * (1.0 + 1e-9) < pair_floor * den:
            value = num * num / den
            bound[i] = value + 1e-6 * (1.0 + abs(value)) + pair_prior + log_frac
            continue
        found[i] = -1
        buffer[_P + filled] = p
        buffer[_Q + filled] = q
        buffer[_X2 + filled] = 2.0 * cross
        buffer[_A + filled] = a
        buffer[_B + filled] = c
        buffer[_DUST + filled] = dust
        buffer[_PRIOR + filled] = pair_prior
        index[0, filled] = g
        index[1, filled] = k
        filled += 1


@njit(**_OPTIONS)
def evaluate_singles(tables, request, data, weight, log_prior, sums, scratch, floor, norm):
    """
    Add the models without AGN (f = 0), one for each galaxy and redshift, to the sums.

    Parameters
    ----------
    tables, request, data, weight, log_prior, sums, scratch, floor
        As in `evaluate_pairs`; ``scratch.p32`` holds the galaxies' projections.
    norm : float
        |F|^2_w, the unit of the squares of those projections.
    """
    n_z, n_galaxy, n_bands = tables.galaxy.shape
    f_prior = tables.prior_frac[0]
    if not f_prior > 0.0:
        return
    least = 1e-4 * sums.total[0] / (n_z * n_galaxy)
    work = np.empty(1, np.int64)
    x_log = np.empty(1)
    y_log = np.empty(1)
    for z in range(n_z):
        if log_prior[z] < -1e200:
            continue
        for g in range(n_galaxy):
            if not tables.usable[z, g]:
                continue
            prior = log_prior[z] + tables.log_galaxy[g] + tables.log_frac[0]
            p32 = max(scratch.p32[z, g], np.float32(0)) + 3e-6
            if p32 * p32 * norm + prior < floor:
                continue
            galaxy = tables.galaxy[z, g]
            p = 0.0
            q = 0.0
            for b in range(n_bands):
                t = galaxy[b] * weight[b]
                p += t * data[b]
                q += t * galaxy[b]
            inverse = 1.0 / max(q, 1e-300)
            num = max(p, 0.0)
            s = num * inverse
            r = num * s
            _note_best(sums, r, s, z, g, np.int64(0), np.int64(0))
            e = 0.5 * (r + prior - sums.best[2])
            if e > 200.0:
                sums.best[2] += 2.0 * e
                _rescale(sums, math.exp(-min(e, 700.0)))
                e = 0.0
            t = math.exp(max(e, -700.0))
            s2 = s * s + request.scale_error * inverse
            sums.zf[z, 0] += t
            sums.galaxy[g, 0] += t
            sums.galaxy[g, 1] += t * s
            sums.galaxy[g, 2] += t * s2
            sums.total[0] += t
            sums.total[1] += t * r
            sums.total[3] += 1.0
            for b in range(n_bands):
                sums.band[0, b] += t * s * galaxy[b]
                sums.band[1, b] += t * s2 * galaxy[b] * galaxy[b]
            if s == 0.0:
                sums.total[2] += t
            elif t > least:
                x_log[0] = s
                fill_log10(x_log, work, y_log, 1)
                y = y_log[0]
                column = np.int64((y - sums.origin[0]) * PER_DEX + HALF_BINS)
                column = min(max(column, 0), N_BINS - 1)
                sums.hist_galaxy[g, column] += t
                _widen(sums.range_galaxy, g, column, column)
                if tables.mixed_galaxy[g] > 0.0:
                    y += _LOG10_E * math.log(tables.mixed_galaxy[g]) - sums.origin[2]
                    column = np.int64(y * PER_DEX + HALF_BINS)
                    column = min(max(column, 0), N_BINS - 1)
                    sums.hist_mixed[0, column] += t
                    _widen(sums.range_mixed, 0, column, column)
