"""
Pixels with jumps, saturated groups or differences cut from outside, many at once.

Each of `LANES` lanes holds the differences of one pixel; ``keep`` is 0 where a difference is cut,
also behind the last of each integration, so that sums which run through all of them begin
anew there. What a lane gives does not depend on the others.
"""

import numpy as np

from miricigale.reduction._core.pixel import (
    JUMP,
    JUMP_NEIGHBOR,
    SATURATED,
    X_MIN,
    at,
    cut_by_flags,
    gather,
)
from miricigale.utils.compilation import njit

__all__ = ["LANES", "fill_lane", "fit_lanes", "fitting_lanes", "refit", "settle"]

#: Pixels that are fitted side by side (inner, vectorized loop).
LANES = 32

# rows of what is known of the pixels in the lanes
_S, _INV_GAIN, _SLOPE, _TOTAL, _SQUARES, _V, _USED, _WORST, _T2, _SIGN, _D, _SLOW = range(12)
_N_VALUES = 20

# columns of what becomes of them
_Y, _X, _JUMPS, _FLAGS = range(4)


@njit(cache=True, nogil=True)
def fitting_lanes(n_int, n_diff):
    """Arrays of the lanes: differences, which are kept, scratch (3), values, pixels (-1: none)."""
    n = n_int * (n_diff + 1)
    return (
        np.zeros((n, LANES)),
        np.zeros((n, LANES)),
        np.zeros((n, LANES)),
        np.zeros((n, LANES)),
        np.zeros((n, LANES)),
        np.ones((_N_VALUES, LANES)),
        np.full((LANES, 4), -1),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def fill_lane(lanes, b, d, cut, valid, s, inv_gain, slow, y, x, jumps, flags):
    """Put a pixel into a lane: its differences, which are cut, and how many each integration has."""
    values, pixels = lanes[5], lanes[6]
    n_int = valid.size
    n_diff = d.size // n_int
    i = 0
    for k in range(n_int):
        for j in range(n_diff):
            lanes[0][i, b] = d[k * n_diff + j]
            lanes[1][i, b] = 1.0 if j < valid[k] and not cut[k * n_diff + j] else 0.0
            i += 1
        i += 1
    values[_S, b] = s
    values[_INV_GAIN, b] = inv_gain
    values[_SLOW, b] = slow
    pixels[b, _Y] = y
    pixels[b, _X] = x
    pixels[b, _JUMPS] = jumps
    pixels[b, _FLAGS] = flags


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def fit_lanes(lanes, n_int):
    """Fit all lanes: slopes, sums of weights, and the difference with the largest statistic."""
    d, keep, left, right, forward, values, _ = lanes
    n = d.shape[0]
    each = n // n_int
    s, inv_gain, slope = values[_S], values[_INV_GAIN], values[_SLOPE]
    total, squares, v, used = values[_TOTAL], values[_SQUARES], values[_V], values[_USED]
    worst, worst_t2, sign, worst_d = values[_WORST], values[_T2], values[_SIGN], values[_D]
    slow, acc, eps, inv_v, swd = values[_SLOW], values[12], values[13], values[14], values[18]
    lam, inv_d, inv_total = values[15], values[16], values[17]
    used[:] = 0.0
    swd[:] = 0.0
    for i in range(n):
        for b in range(LANES):
            used[b] += keep[i, b]
            swd[b] += keep[i, b] * d[i, b]
    for b in range(LANES):
        slope[b] = swd[b] / used[b]
    # start with the plain mean, then twice the weights of the last slope
    for _ in range(2):
        for b in range(LANES):
            vv = slope[b] * inv_gain[b]
            low = X_MIN * s[b]
            vv = (vv if vv > low else low) + slow[b]
            v[b] = vv
            x = vv / s[b]
            q = 0.5 * x + np.sqrt(x + 0.25 * x * x)
            eps[b] = q / (1.0 + q)
            lam[b] = 1.0 / (1.0 + q)
            inv_v[b] = 1.0 / vv
            inv_d[b] = (1.0 + q) / (s[b] * q * (2.0 + q))
            acc[b] = 0.0
            total[b] = 0.0
            squares[b] = 0.0
            swd[b] = 0.0
        for i in range(n):
            for b in range(LANES):
                acc[b] = (acc[b] + (1.0 - acc[b]) * eps[b]) * keep[i, b]
                left[i, b] = acc[b]
        acc[:] = 0.0
        for i in range(n - 1, -1, -1):
            for b in range(LANES):
                acc[b] = (acc[b] + (1.0 - acc[b]) * eps[b]) * keep[i, b]
                right[i, b] = acc[b]
                both = left[i, b] * acc[b]
                # f of the whole segment, from the two sides
                full = left[i, b] + acc[b] - both
                w = both * inv_v[b] / (2.0 - full)
                total[b] += w
                squares[b] += w * w
                swd[b] += w * d[i, b]
        for b in range(LANES):
            slope[b] = swd[b] / total[b]
    # jump statistic of every difference
    for b in range(LANES):
        inv_total[b] = 1.0 / total[b]
        acc[b] = 0.0
        worst[b] = -1.0
        worst_t2[b] = -1.0
        worst_d[b] = 0.0
        sign[b] = 1.0
    for i in range(n):
        for b in range(LANES):
            h = left[i, b] * (2.0 - left[i, b])
            acc[b] = (lam[b] * acc[b] + h * (d[i, b] - slope[b])) * keep[i, b]
            forward[i, b] = acc[b]
    for k in range(n_int):
        acc[:] = 0.0
        for i in range((k + 1) * each - 1, k * each - 1, -1):
            for b in range(LANES):
                f, g = left[i, b], right[i, b]
                both = f * g
                full = f + g - both
                unit = 1.0 / (full * (2.0 - full))
                h, m = f * (2.0 - f), g * (2.0 - g)
                z = (m * forward[i, b] + h * acc[b]) * (unit * inv_d[b])
                c = h * m * (unit * inv_d[b])
                w = both * full * unit * inv_v[b]
                p = c - w * w * inv_total[b]
                t2 = z * z / p
                best, one = worst_t2[b], d[i, b]
                # two differences cannot tell which of them jumped: cosmic rays go up
                higher = (t2 >= best * (1.0 - 1e-6)) & (one > worst_d[b])
                take = (p > 1e-9 * c) & ((t2 > best * (1.0 + 1e-6)) | (higher & (best >= 0.0)))
                worst_t2[b] = t2 if take else best
                worst_d[b] = one if take else worst_d[b]
                worst[b] = float(i) if take else worst[b]
                sign[b] = z if take else sign[b]
                acc[b] = lam[b] * (acc[b] + m * (one - slope[b])) * keep[i, b]


@njit(cache=True, nogil=True, error_model="numpy")
def settle(lanes, n_int, scale, threshold, events, n_event, free, out):
    """
    Cut the most significant jump of each fitted lane, or store what has none and free its lane.

    ``free`` gets the lanes that hold no pixel; returns their number, the list of jumps (see
    `fit_rows`; grown where it is full), and the number of those.
    """
    rate, var_poisson, var_read, n_used, n_jump, dq = out
    keep, values, pixels = lanes[1], lanes[5], lanes[6]
    each = keep.shape[0] // n_int
    n_free = 0
    for b in range(LANES):
        y, x = pixels[b, _Y], pixels[b, _X]
        used = int(values[_USED, b])
        t2 = values[_T2, b]
        if y >= 0 and used > 1 and t2 > threshold * threshold:
            i = int(values[_WORST, b])
            keep[i, b] = 0.0
            pixels[b, _JUMPS] += 1
            if n_event == events.shape[0]:
                # by hand: an assignment of slices takes seconds to compile
                grown = np.empty((2 * n_event, 5))
                for k in range(n_event):
                    for j in range(5):
                        grown[k, j] = events[k, j]
                events = grown
            events[n_event, 0] = y
            events[n_event, 1] = x
            events[n_event, 2] = i // each
            events[n_event, 3] = i % each
            events[n_event, 4] = np.sqrt(t2) if values[_SIGN, b] > 0.0 else -np.sqrt(t2)
            n_event += 1
            continue
        if y >= 0:
            jumps, flags = pixels[b, _JUMPS], pixels[b, _FLAGS]
            if used == 0:
                rate[y, x] = var_poisson[y, x] = var_read[y, x] = np.nan
            else:
                var = 1.0 / values[_TOTAL, b]
                photon = (values[_V, b] - values[_SLOW, b]) * values[_SQUARES, b] * var * var
                rate[y, x] = values[_SLOPE, b] * scale
                var_poisson[y, x] = photon * scale * scale
                var_read[y, x] = max(var - photon, 0.0) * scale * scale
            n_used[y, x] = used
            n_jump[y, x] = jumps
            dq[y, x] = flags | (JUMP if jumps > 0 else 0)
            pixels[b, _Y] = -1
        free[n_free] = b
        n_free += 1
    return n_free, events, n_event


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _gather_lanes(data, levels, response, ys, xs, g0, g1, scratch, d, top):
    """Linear differences (n_diff of all integrations, LANES) of some pixels, and their highest DN."""
    drift, bias, reset = levels
    coefficients, _, dark = response
    coef, start, level, value, before = scratch
    n_coef = coefficients.shape[0]
    n = ys.size
    for b in range(n):
        start[b] = at(bias, ys[b], xs[b])
        top[b] = 0.0
        for j in range(n_coef):
            coef[j, b] = at(coefficients[j], ys[b], xs[b])
    i = -1
    for k in range(data.shape[0]):
        for g in range(g1):
            plane = data[k, g]
            shift = drift[k, g]
            for b in range(n):
                raw = float(plane[ys[b], xs[b]])
                top[b] = raw if raw > top[b] else top[b]
                row = ys[b] if drift.shape[2] > 1 else 0
                level[b] = raw - (shift[row, xs[b] % drift.shape[3]] + start[b])
            # groups before the first count for the saturation alone
            if g < g0:
                continue
            if g < reset.shape[1]:
                plane = reset[min(k, reset.shape[0] - 1), g]
                for b in range(n):
                    level[b] -= plane[ys[b], xs[b]]
            for b in range(LANES):
                value[b] = coef[n_coef - 1, b]
            for j in range(n_coef - 2, -1, -1):
                for b in range(LANES):
                    value[b] = value[b] * level[b] + coef[j, b]
            if dark.shape[1] > 0:
                plane = dark[min(k, dark.shape[0] - 1), g]
                for b in range(n):
                    value[b] -= plane[ys[b], xs[b]]
            if g > g0:
                i += 1
                for b in range(LANES):
                    d[i, b] = value[b] - before[b]
            for b in range(LANES):
                before[b] = value[b]


@njit(cache=True, nogil=True, error_model="numpy")
def refit(
    data,
    levels,
    response,
    group_dq,
    ys,
    xs,
    start,
    cuts,
    g0,
    g1,
    noise,
    scale,
    threshold,
    rate,
    var_poisson,
    var_read,
    n_used,
    n_jump,
    dq,
):
    """
    Fit the pixels ``ys``, ``xs`` again with differences that are cut from outside.

    Pixel i is cut at ``cuts[start[i]:start[i + 1]]``, each the index of a difference: integration
    times number of differences plus difference; and where the flags of its groups say so. The other
    parameters are those of `fit_rows`. Jumps that were found before belong to the cuts; new ones are
    added to their number.
    """
    variance, inv_gain, slow = noise
    out = (rate, var_poisson, var_read, n_used, n_jump, dq)
    n_int = data.shape[0]
    n_diff = g1 - g0 - 1
    coefficients, limits, _ = response
    scratch = (
        np.zeros((coefficients.shape[0], LANES)),
        np.zeros(LANES),
        np.zeros(LANES),
        np.zeros(LANES),
        np.zeros(LANES),
    )
    gathered = np.empty((n_int * n_diff, LANES))
    top = np.empty(LANES)
    d = np.empty(n_int * n_diff)
    cut = np.empty(n_int * n_diff, np.bool_)
    valid = np.empty(n_int, np.int64)
    lanes = fitting_lanes(n_int, n_diff)
    free = np.arange(LANES)
    n_free = LANES
    events = np.empty((256, 5))
    i = 0
    while i < ys.size or n_free < LANES:
        if i == ys.size or n_free == 0:
            fit_lanes(lanes, n_int)
            n_free, events, _ = settle(lanes, n_int, scale, threshold, events, 0, free, out)
            continue
        y = ys[i]
        x = xs[i]
        b = i % LANES
        if b == 0:
            some = slice(i, min(i + LANES, ys.size))
            _gather_lanes(
                data, levels, response, ys[some], xs[some], g0, g1, scratch, gathered, top
            )
        saturated = top[b] >= at(limits, y, x)
        if saturated:
            gather(data, levels, response, y, x, g0, g1, d, valid)
        else:
            valid[:] = n_diff
            for j in range(d.size):
                d[j] = gathered[j, b]
        cut[:] = False
        full, jumped = cut_by_flags(group_dq, y, x, g0, g1, cut, valid)
        flags = SATURATED if saturated or full else 0
        if jumped:
            flags |= JUMP
        for j in range(start[i], start[i + 1]):
            cut[cuts[j]] = True
            flags |= JUMP | JUMP_NEIGHBOR
        n_free -= 1
        # its own jumps are among the cuts
        fill_lane(
            lanes, free[n_free], d, cut, valid, at(variance, y, x), at(inv_gain, y, x), at(slow, y, x),
            y, x, n_jump[y, x], flags,
        )  # fmt: skip
        i += 1
