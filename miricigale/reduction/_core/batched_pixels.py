"""
Pixels that are fitted many at once.

Each of `LANES` lanes holds the differences of one pixel; ``keep`` is 0 where a difference is cut,
also behind the last of each integration, so that sums which run through all of them begin
anew there. What a lane gives does not depend on the others.
"""

import numpy as np

from miricigale.reduction._core.pixel import (
    JUMP,
    JUMP_NEIGHBOR,
    SATURATED,
    at,
    cut_by_flags,
    gather,
    no_slope,
    store,
    weights,
    widen,
)
from miricigale.utils.compilation import njit

#: Pixels that are fitted side by side (inner, vectorized loop).
LANES = 32

# rows of what is known of the pixels in the lanes
_S, _INV_GAIN, _SLOW, _SHARED, _SUM, _SLOPE, _TOTAL, _SQUARES, _V, _USED, _WORST, _T2, _SIGN, _D = (
    range(14)
)
# those in which sums over the differences run: lambda, 1 - lambda, two inverses of variances, and three sums
_LAM, _EPS, _INV_D, _INV_V, _SWD, _F, _ACC, _N_VALUES = range(14, 22)

# columns of what becomes of them
_Y, _X, _JUMPS, _FLAGS = range(4)


@njit()
def fitting_lanes(n_int, n_diff):
    """Arrays of the lanes: differences, which are kept, scratch (3), values, pixels (-1: none)."""
    size = n_int * (n_diff + 1), LANES
    differences = np.zeros(size)
    keep = np.zeros(size)
    values = np.ones((_N_VALUES, LANES))
    weights_before = np.zeros(size)
    right = np.zeros(size)
    forward = np.zeros(size)
    return differences, keep, weights_before, right, forward, values, np.full((LANES, 4), -1)


@njit(error_model="numpy")
def fill_lane(lanes, b, d, cut, valid, s, inv_gain, slow, shared, y, x, jumps, flags):
    """Put a pixel into a lane: its differences, which are cut, and how many each integration has."""
    values = lanes[5]
    pixels = lanes[6]
    n_int = valid.size
    n_diff = d.size // n_int
    i = 0
    n_kept = 0.0
    total = 0.0
    for k in range(n_int):
        for j in range(n_diff):
            difference = d[k * n_diff + j]
            weight = 1.0 if j < valid[k] and not cut[k * n_diff + j] else 0.0
            lanes[0][i, b] = difference
            lanes[1][i, b] = weight
            n_kept += weight
            total += weight * difference
            i += 1
        i += 1
    values[_USED, b] = n_kept
    values[_SUM, b] = total
    values[_S, b] = s
    values[_INV_GAIN, b] = inv_gain
    values[_SLOW, b] = slow
    values[_SHARED, b] = shared
    pixels[b, _Y] = y
    pixels[b, _X] = x
    pixels[b, _JUMPS] = jumps
    pixels[b, _FLAGS] = flags


@njit(error_model="numpy", fastmath={"contract"})
def fit_lanes(lanes):
    """Fit all lanes: slopes, sums of weights, and the difference with the largest statistic."""
    d, keep, backward, right, forward, values, _ = lanes
    n = d.shape[0]
    s = values[_S]
    inv_gain = values[_INV_GAIN]
    slow = values[_SLOW]
    shared = values[_SHARED]
    slope = values[_SLOPE]
    total = values[_TOTAL]
    squares = values[_SQUARES]
    v = values[_V]
    n_used = values[_USED]
    worst = values[_WORST]
    worst_t2 = values[_T2]
    sign = values[_SIGN]
    worst_d = values[_D]
    lam = values[_LAM]
    eps = values[_EPS]
    inv_d = values[_INV_D]
    inv_v = values[_INV_V]
    swd = values[_SWD]
    f = values[_F]
    acc = values[_ACC]
    # start with the plain mean, then twice the weights of the last slope
    for b in range(LANES):
        slope[b] = values[_SUM, b] / n_used[b]
    for last in range(2):
        for b in range(LANES):
            v[b], lam[b], eps[b], inv_d[b] = weights(
                slope[b], s[b], inv_gain[b], slow[b], shared[b]
            )
            inv_v[b] = 1.0 / v[b]
        total[:] = squares[:] = swd[:] = f[:] = acc[:] = 0.0
        for i in range(n):
            for b in range(LANES):
                f[b] = (f[b] + (1.0 - f[b]) * eps[b]) * keep[i, b]
                backward[i, b] = f[b]
            if last:
                for b in range(LANES):
                    h = f[b] * (2.0 - f[b])
                    acc[b] = (lam[b] * acc[b] + h * (d[i, b] - slope[b])) * keep[i, b]
                    forward[i, b] = acc[b]
        f[:] = acc[:] = 0.0
        for i in range(n - 1, -1, -1):
            for b in range(LANES):
                f[b] = (f[b] + (1.0 - f[b]) * eps[b]) * keep[i, b]
                g = backward[i, b]
                residual = d[i, b] - slope[b]
                product = f[b] * g
                # f of the whole segment, from the two sides; 1 where there is none
                full = f[b] + g - product + (1.0 - keep[i, b])
                unit = 1.0 / (full * (2.0 - full))
                w = product * full * unit * inv_v[b]
                total[b] += w
                swd[b] += w * residual
                if last:
                    squares[b] += w * w
                    h = g * (2.0 - g)
                    m = f[b] * (2.0 - f[b])
                    # C^-1 times residuals, its diagonal and its sum
                    forward[i, b] = (m * forward[i, b] + h * acc[b]) * (unit * inv_d[b])
                    right[i, b] = h * m * (unit * inv_d[b])
                    backward[i, b] = w
                    acc[b] = lam[b] * (acc[b] + m * residual) * keep[i, b]
        for b in range(LANES):
            swd[b] /= total[b]
            slope[b] += swd[b]
    # jump statistic of every difference, with the residuals of the last slope
    inv_total = acc
    for b in range(LANES):
        inv_total[b] = 1.0 / total[b]
        worst[b] = worst_t2[b] = -1.0
        worst_d[b] = 0.0
        sign[b] = 1.0
    for i in range(n):
        for b in range(LANES):
            w = backward[i, b]
            c = right[i, b]
            z = forward[i, b] - swd[b] * w
            p = c - w * w * inv_total[b]
            t2 = z * z / p
            best = worst_t2[b]
            difference = d[i, b]
            # two differences cannot tell which of them jumped: cosmic rays go up
            higher = (t2 >= best * (1.0 - 1e-6)) & (difference > worst_d[b])
            take = (p > 1e-9 * c) & ((t2 > best * (1.0 + 1e-6)) | (higher & (best >= 0.0)))
            worst_t2[b] = t2 if take else best
            worst_d[b] = difference if take else worst_d[b]
            worst[b] = float(i) if take else worst[b]
            sign[b] = z if take else sign[b]


@njit(error_model="numpy")
def settle(lanes, n_int, scale, threshold, events, n_event, free_lanes, out):
    """
    Cut the most significant jump of each fitted lane, or store what has none and free its lane.

    ``free`` gets the lanes that hold no pixel; returns their number, the list of jumps (see
    `fit_pixels`; grown where it is full), and the number of those.
    """
    keep = lanes[1]
    values = lanes[5]
    pixels = lanes[6]
    n_rows = keep.shape[0] // n_int
    n_free = 0
    for b in range(LANES):
        y = pixels[b, _Y]
        x = pixels[b, _X]
        n_used = int(values[_USED, b])
        t2 = values[_T2, b]
        if y >= 0 and n_used > 1 and t2 > threshold * threshold:
            i = int(values[_WORST, b])
            keep[i, b] = 0.0
            values[_USED, b] -= 1.0
            values[_SUM, b] -= lanes[0][i, b]
            pixels[b, _JUMPS] += 1
            if n_event == events.shape[0]:
                events = np.concatenate((events, np.empty_like(events)))
            events[n_event, 0] = y
            events[n_event, 1] = x
            events[n_event, 2] = i // n_rows
            events[n_event, 3] = i % n_rows
            events[n_event, 4] = np.sqrt(t2) if values[_SIGN, b] > 0.0 else -np.sqrt(t2)
            n_event += 1
            if values[_SHARED, b] > 0.0:
                for j in (i - 1, i + 1):
                    # those beside it, as long as a difference is left
                    if 0 <= j < keep.shape[0] and keep[j, b] > 0.0 and values[_USED, b] > 1.0:
                        keep[j, b] = 0.0
                        values[_USED, b] -= 1.0
                        values[_SUM, b] -= lanes[0][j, b]
            continue
        if y >= 0:
            jumps = pixels[b, _JUMPS]
            flags = pixels[b, _FLAGS]
            if n_used == 0:
                no_slope(out, y, x)
            else:
                total = values[_TOTAL, b]
                squares = values[_SQUARES, b]
                noise = values[_V, b], values[_SLOW, b], values[_S, b], values[_SHARED, b]
                store(out, y, x, values[_SLOPE, b], noise, total, squares, scale)
            out[3][y, x] = n_used
            out[4][y, x] = jumps
            out[5][y, x] = flags | (JUMP if jumps > 0 else 0)
            pixels[b, _Y] = -1
        free_lanes[n_free] = b
        n_free += 1
    return n_free, events, n_event


@njit(error_model="numpy")
def fit_pixels(ramp, group_dq, ys, xs, start, cuts, fit, out):
    """
    Fit the ramps of the pixels ``ys``, ``xs``, and find their jumps.

    ``ramp`` is data, levels and response; ``fit`` the first group and the one behind the last, noise, scale and
    threshold. The data are DN as read, (n_int, n_group, ny, nx). Maps of pixels are (ny, nx) or, where all
    are alike, (1, 1), also within larger arrays:

    ``levels``: drift (n_int, n_group, 1 or ny, 1 or 4: the channels that columns belong to in
    turn), bias (map) and reset anomaly (integrations, groups, ny, nx), which are subtracted. The
    last integration of the anomaly stands for all further ones, and groups beyond it have none.

    ``response``: coefficients (ascending, each a map) of the polynomial that makes them linear;
    saturation (map): a group from it (raw DN) and all after it are dropped; dark signal
    (integrations, groups, ny, nx), subtracted last; and the part of a difference by which the last of averaged
    frames is above their mean, 0 for single reads. Anomaly and dark of no groups are none.

    ``noise``: variance of one read in DN^2, what times the slope is the Poisson variance of a
    difference, what slow noise of the read-out adds to it (maps), and what neighbors share of the Poisson
    variance (0 for single reads).

    ``scale`` is the inverse group time, and jumps are cut above ``threshold`` sigma. Pixel i is cut at
    ``cuts[start[i]:start[i + 1]]`` too, each the index of a difference: integration times number of differences
    plus difference; and where the flags of its groups say so. Its jumps of an earlier fit belong to the cuts; new
    ones are added to their number. The images ``out``, those of `RampFit` from ``rate`` to ``flags``, are filled
    in place.

    Returns an array (n_event, 5) in no order: y, x, integration, difference (from the first group) and
    signed significance of each jump.
    """
    data, levels, response = ramp
    g0, g1, noise, scale, threshold = fit
    variance, inv_gain, slow, shared = noise
    n_int = data.shape[0]
    n_diff = g1 - g0 - 1
    d = np.empty(n_int * n_diff)
    cut = np.empty(n_int * n_diff, np.bool_)
    valid = np.empty(n_int, np.int64)
    lanes = fitting_lanes(n_int, n_diff)
    free_lanes = np.arange(LANES)
    n_free = LANES
    events = np.empty((256, 5))
    i = n_event = 0
    while i < ys.size or n_free < LANES:
        if i == ys.size or n_free == 0:
            fit_lanes(lanes)
            n_free, events, n_event = settle(
                lanes, n_int, scale, threshold, events, n_event, free_lanes, out
            )
            continue
        y = ys[i]
        x = xs[i]
        saturated = gather(data, levels, response, y, x, g0, g1, d, valid)
        cut[:] = False
        full, jumped = cut_by_flags(group_dq, y, x, g0, g1, cut, valid, shared > 0.0)
        flags = SATURATED if saturated or full else 0
        if jumped:
            flags |= JUMP
        for j in range(start[i], start[i + 1]):
            cut[cuts[j]] = True
            if shared > 0.0:
                widen(cut, cuts[j], n_diff)
            flags |= JUMP | JUMP_NEIGHBOR
        n_free -= 1
        fill_lane(
            lanes, free_lanes[n_free], d, cut, valid, at(variance, y, x), at(inv_gain, y, x), at(slow, y, x),
            shared, y, x, out[4][y, x], flags,
        )  # fmt: skip
        i += 1
    return events[:n_event].copy()
