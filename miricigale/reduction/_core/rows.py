"""Whole rows of pixels, many at once; those with saturation or jumps go to the lanes."""

import numpy as np

from miricigale.reduction._core.lanes import LANES, fill_lane, fit_lanes, fitting_lanes, settle
from miricigale.reduction._core.pixel import (
    SATURATED,
    at,
    gather,
    no_slope,
    polynomial,
    store,
    weights,
)
from miricigale.utils.compilation import njit

#: Pixels that are worked on together (inner, vectorized loop).
BLOCK = 64


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def fit_rows(ramp, usable, y0, y1, fit, out):
    """
    Fit the ramps of rows ``y0`` to ``y1``, and find their jumps.

    ``ramp`` is data, levels and response; ``fit`` the first group and the one behind the last, noise, scale and
    threshold. The data are DN as read, (n_int, n_group, ny, nx). Maps of pixels are (ny, nx) or, where all
    are alike, (1, 1), also within larger arrays:

    ``levels``: drift (n_int, n_group, 1 or ny, 1 or 4: the channels that columns belong to in
    turn), bias (map) and reset anomaly (integrations, groups, ny, nx), which are subtracted. The
    last integration of the anomaly stands for all further ones, and groups beyond it have none.

    ``response``: coefficients (ascending, each a map) of the polynomial that makes them linear;
    saturation (map): a group from it (raw DN) and all after it are dropped; dark signal
    (integrations, groups, ny, nx), subtracted last. Anomaly and dark of no groups are none.

    ``noise``: variance of one read in DN^2, what times the slope is the Poisson variance of a
    difference, and what slow noise of the read-out adds to it (maps).

    Pixels that are not ``usable`` get NaN. ``scale`` is the inverse group time, and jumps are cut
    above ``threshold`` sigma. The images ``out``, those of `RampFit` from ``rate`` to ``flags``, are filled in
    place.

    Returns an array (n_event, 5) in no order: y, x, integration, difference (from the first group) and
    signed significance of each jump.
    """
    data, levels, response = ramp
    g0, g1, noise, scale, threshold = fit
    drift, bias, reset = levels
    coefficients, limits, dark = response
    variances, poisson, wander = noise
    n_int, _, _, nx = data.shape
    n_coef = coefficients.shape[0]
    n_channel = drift.shape[3]
    n_diff = g1 - g0 - 1
    n_all = n_int * n_diff
    thr2 = threshold * threshold

    d = np.empty((n_all, BLOCK))
    # sums over the integrations
    mean = d if n_int == 1 else np.empty((n_diff, BLOCK))
    f = np.empty((n_diff + 2, BLOCK))
    tmp = np.empty((n_diff + 1, BLOCK))
    coef = np.empty((n_coef, BLOCK))
    start, level, value, before = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    saturation, s, inv_gain = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    slow, top, slope, v = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    lam, eps, sw, sw2 = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    swd, norm, inv_d, wf = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    acc, crit = np.empty(BLOCK), np.empty(BLOCK)
    # pixels with jumps or saturation
    d1 = np.empty(n_all)
    cut = np.zeros(n_all, np.bool_)
    valid = np.empty(n_int, np.int64)
    lanes = fitting_lanes(n_int, n_diff)
    free = np.arange(LANES)
    n_free = LANES
    events = np.empty((256, 5))
    n_event = 0

    for y in range(y0, y1):
        for x0 in range(0, nx, BLOCK):
            nb = min(BLOCK, nx - x0)
            top[:] = 0.0
            if n_int > 1:
                mean[:, :] = 0.0
            # of these pixels, and of the last one again behind the edge
            for b in range(BLOCK):
                x = min(x0 + b, nx - 1)
                start[b] = at(bias, y, x)
                saturation[b] = at(limits, y, x)
                s[b] = at(variances, y, x)
                inv_gain[b] = at(poisson, y, x)
                slow[b] = at(wander, y, x)
                for j in range(n_coef):
                    coef[j, b] = at(coefficients[j], y, x)
            for k in range(n_int):
                for g in range(g0, g1):
                    shift = drift[k, g, y if drift.shape[2] > 1 else 0]
                    if n_channel == 1:
                        off = shift[0]
                        for b in range(BLOCK):
                            level[b] = off + start[b]
                    else:
                        for b in range(BLOCK):
                            level[b] = shift[b % n_channel] + start[b]
                    if g < reset.shape[1]:
                        row = reset[min(k, reset.shape[0] - 1), g, y]
                        for b in range(nb):
                            level[b] += row[x0 + b]
                    row = data[k, g, y]
                    for b in range(nb):
                        raw = float(row[x0 + b])
                        top[b] = raw if raw > top[b] else top[b]
                        level[b] = raw - level[b]
                    polynomial(coef, level, value)
                    if dark.shape[1] > 0:
                        row = dark[min(k, dark.shape[0] - 1), g, y]
                        for b in range(nb):
                            value[b] -= row[x0 + b]
                    if g > g0:
                        i = k * n_diff + g - g0 - 1
                        for b in range(nb):
                            d[i, b] = value[b] - before[b]
                        if n_int > 1:
                            for b in range(nb):
                                mean[i - k * n_diff, b] += d[i, b]
                    for b in range(nb):
                        before[b] = value[b]
            for b in range(nb, BLOCK):
                d[:, b] = 0.0
            # start with the plain mean, then twice the weights of the last slope
            sw[:] = 0.0
            for i in range(n_diff):
                for b in range(BLOCK):
                    sw[b] += mean[i, b]
            for b in range(BLOCK):
                slope[b] = sw[b] / n_all
            for _ in range(2):
                for b in range(BLOCK):
                    v[b], lam[b], eps[b], inv_d[b] = weights(slope[b], s[b], inv_gain[b], slow[b])
                    f[0, b] = 0.0
                    sw[b] = 0.0
                    sw2[b] = 0.0
                    swd[b] = 0.0
                for i in range(n_diff + 1):
                    for b in range(BLOCK):
                        f[i + 1, b] = f[i, b] + (1.0 - f[i, b]) * eps[b]
                for i in range(1, n_diff + 1):
                    for b in range(BLOCK):
                        w = f[i, b] * f[n_diff + 1 - i, b]
                        sw[b] += w
                        sw2[b] += w * w
                        swd[b] += w * mean[i - 1, b]
                for b in range(BLOCK):
                    slope[b] = swd[b] / (sw[b] * n_int)
                    norm[b] = 1.0 / (v[b] * (2.0 - f[n_diff + 1, b]))
            # jump statistic of every difference
            crit[:] = -1.0
            if n_all > 1 and np.isfinite(threshold):
                for b in range(BLOCK):
                    inv_d[b] = inv_d[b] / (f[n_diff + 1, b] * (2.0 - f[n_diff + 1, b]))
                    # w_j^2 / W with w_j = f f norm and W = n_int sw norm
                    wf[b] = norm[b] / (sw[b] * n_int)
                for k in range(n_int):
                    base = k * n_diff - 1
                    acc[:] = 0.0
                    for j in range(1, n_diff + 1):
                        for b in range(BLOCK):
                            h = f[j, b] * (2.0 - f[j, b])
                            acc[b] = lam[b] * acc[b] + h * (d[base + j, b] - slope[b])
                            tmp[j, b] = acc[b]
                    acc[:] = 0.0
                    for j in range(n_diff, 0, -1):
                        m = n_diff + 1 - j
                        for b in range(BLOCK):
                            left, right = f[j, b], f[m, b]
                            h, g = left * (2.0 - left), right * (2.0 - right)
                            z = (g * tmp[j, b] + h * acc[b]) * inv_d[b]
                            c = h * g * inv_d[b]
                            w = left * right
                            p = c - w * w * wf[b]
                            p = p if p > 1e-9 * c else 1e-9 * c
                            q = z * z - thr2 * p
                            crit[b] = q if q > crit[b] else crit[b]
                            acc[b] = lam[b] * (acc[b] + g * (d[base + j, b] - slope[b]))
            for b in range(nb):
                x = x0 + b
                if not usable[y, x]:
                    no_slope(out, y, x)
                    continue
                if top[b] < saturation[b] and crit[b] <= 0.0:
                    total, squares = sw[b] * norm[b] * n_int, sw2[b] * norm[b] * norm[b] * n_int
                    store(out, y, x, slope[b], v[b], slow[b], total, squares, scale)
                    out[3][y, x] = n_all
                    continue
                valid[:] = n_diff
                saturated = top[b] >= saturation[b]
                if saturated:
                    saturated = gather(data, levels, response, y, x, g0, g1, d1, valid)
                else:
                    for i in range(n_all):
                        d1[i] = d[i, b]
                while n_free == 0:
                    fit_lanes(lanes)
                    n_free, events, n_event = settle(
                        lanes, n_int, scale, threshold, events, n_event, free, out
                    )
                n_free -= 1
                fill_lane(
                    lanes, free[n_free], d1, cut, valid, s[b], inv_gain[b], slow[b], y, x, 0,
                    SATURATED if saturated else 0,
                )  # fmt: skip
    while n_free < LANES:
        fit_lanes(lanes)
        n_free, events, n_event = settle(lanes, n_int, scale, threshold, events, n_event, free, out)
    return events[:n_event].copy()
