"""
Ramp fitting kernels: exact generalised least squares on group differences, with jumps.

Arrays only. Differences of consecutive groups of one segment (no jump inside) have the
covariance C = v I + s T, with v the Poisson variance of a difference, s the variance of a
single read and T = tridiag(-1, 2, -1). Being Toeplitz and tridiagonal, C has closed-form
inverse and weights. With x = v / s, l = exp(-theta) and 2 cosh(theta) = 2 + x,
f_i = 1 - l^i, and a segment of L differences (i = 1 ... L)::

    w_i       = (C^-1 1)_i = f_i f_(L+1-i) / (v (1 + l^(L+1)))
    slope     = sum(w d) / sum(w),   variance = 1 / sum(w)
    (C^-1)_ij = l^(j-i) h_i h_(L+1-j) / (s (1/l - l) h_(L+1)),  i <= j,  h_i = 1 - l^(2 i)

so that the residuals' C^-1 r needs one recursion forwards and one backwards. A jump at
difference j has the likelihood-ratio statistic t_j = (C^-1 r)_j / sqrt((C^-1)_jj - w_j^2 / W),
r the residuals from the common slope, W the sum of all weights: t_j^2 is the drop in chi
squared that a free difference j brings.

All integrations of a pixel share one slope and one Poisson variance.
"""

import numpy as np
from numba import njit

__all__ = ["BLOCK", "FULLY_SATURATED", "JUMP", "JUMP_NEIGHBOUR", "SATURATED", "fit_rows", "refit"]

#: Pixels that are worked on together (inner, vectorised loop).
BLOCK = 64

# bits that the kernels set; reduction.flags gives them names
SATURATED = 4
FULLY_SATURATED = 8
JUMP = 16
JUMP_NEIGHBOUR = 32

#: Least ratio of Poisson to read variance, to keep the closed forms finite.
_X_MIN = 1e-8


@njit(cache=True, error_model="numpy", inline="always")
def _poisson(slope, inv_gain, s):
    """Poisson variance of a difference, floored at a trace of the read variance."""
    v = slope * inv_gain
    low = _X_MIN * s
    return v if v > low else low


@njit(cache=True, error_model="numpy")
def _solve(d, first, last, n_seg, v, s, f):
    """Slope, sum of weights and sum of squared weights over the segments of one pixel."""
    x = v / s
    q = 0.5 * x + np.sqrt(x + 0.25 * x * x)
    eps = q / (1.0 + q)
    longest = 0
    for k in range(n_seg):
        longest = max(longest, last[k] - first[k])
    f[0] = 0.0
    for i in range(longest + 1):
        f[i + 1] = f[i] + (1.0 - f[i]) * eps
    total = 0.0
    total2 = 0.0
    num = 0.0
    for k in range(n_seg):
        a = first[k]
        n = last[k] - a
        norm = 1.0 / (v * (2.0 - f[n + 1]))
        sw = 0.0
        sw2 = 0.0
        swd = 0.0
        for i in range(1, n + 1):
            w = f[i] * f[n + 1 - i]
            sw += w
            sw2 += w * w
            swd += w * d[a + i - 1]
        total += sw * norm
        total2 += sw2 * norm * norm
        num += swd * norm
    return num / total, total, total2


@njit(cache=True, error_model="numpy")
def _worst(d, first, last, n_seg, slope, v, s, total, f, tmp):
    """Difference with the largest squared jump statistic: its index, t^2 and sign of t."""
    x = v / s
    q = 0.5 * x + np.sqrt(x + 0.25 * x * x)
    lam = 1.0 / (1.0 + q)
    inv_d0 = (1.0 + q) / (s * q * (2.0 + q))
    best = -1
    best_t2 = 0.0
    best_sign = 1.0
    for k in range(n_seg):
        a = first[k]
        n = last[k] - a
        norm = 1.0 / (v * (2.0 - f[n + 1]))
        inv_d = inv_d0 / (f[n + 1] * (2.0 - f[n + 1]))
        acc = 0.0
        for j in range(1, n + 1):
            acc = lam * acc + f[j] * (2.0 - f[j]) * (d[a + j - 1] - slope)
            tmp[j] = acc
        acc = 0.0
        for j in range(n, 0, -1):
            h = f[j] * (2.0 - f[j])
            g = f[n + 1 - j] * (2.0 - f[n + 1 - j])
            z = (g * tmp[j] + h * acc) * inv_d
            c = h * g * inv_d
            w = f[j] * f[n + 1 - j] * norm
            p = c - w * w / total
            if p > 1e-9 * c:
                t2 = z * z / p
                i = a + j - 1
                # two differences cannot tell which of them jumped: cosmic rays go up
                tie = abs(t2 - best_t2) <= 1e-6 * best_t2
                if best < 0 or (tie and d[i] > d[best]) or (not tie and t2 > best_t2):
                    best = i
                    best_t2 = t2
                    best_sign = 1.0 if z > 0 else -1.0
            acc = lam * (acc + g * (d[a + j - 1] - slope))
    return best, best_t2, best_sign


@njit(cache=True, error_model="numpy")
def _segments(cut, valid, n_diff, first, last):
    """List the runs of uncut differences of one pixel."""
    n_seg = 0
    n_used = 0
    for k in range(valid.size):
        base = k * n_diff
        run = -1
        for i in range(valid[k]):
            if cut[base + i]:
                if run >= 0:
                    first[n_seg] = base + run
                    last[n_seg] = base + i
                    n_used += i - run
                    n_seg += 1
                run = -1
            elif run < 0:
                run = i
        if run >= 0:
            first[n_seg] = base + run
            last[n_seg] = base + valid[k]
            n_used += valid[k] - run
            n_seg += 1
    return n_seg, n_used


@njit(cache=True, error_model="numpy")
def _fit_pixel(d, cut, valid, n_diff, s, inv_gain, threshold, f, tmp, first, last, found):
    """
    Fit one pixel, cutting the most significant jump until none is left.

    ``cut`` is changed in place; the statistics of new jumps go to ``found`` (index in the
    same array of differences, NaN elsewhere). Returns slope, Poisson and read variance
    (per difference), number of differences used and of new jumps.
    """
    n_new = 0
    while True:
        n_seg, n_used = _segments(cut, valid, n_diff, first, last)
        if n_used == 0:
            return np.nan, np.nan, np.nan, 0, n_new
        mean = 0.0
        for k in range(n_seg):
            for i in range(first[k], last[k]):
                mean += d[i]
        slope = mean / n_used
        v = _poisson(slope, inv_gain, s)
        slope, total, total2 = _solve(d, first, last, n_seg, v, s, f)
        v = _poisson(slope, inv_gain, s)
        slope, total, total2 = _solve(d, first, last, n_seg, v, s, f)
        if n_used == 1:
            break
        j, t2, sign = _worst(d, first, last, n_seg, slope, v, s, total, f, tmp)
        if j < 0 or t2 <= threshold * threshold:
            break
        cut[j] = True
        found[j] = sign * np.sqrt(t2)
        n_new += 1
    var = 1.0 / total
    var_poisson = v * total2 * var * var
    return slope, var_poisson, max(var - var_poisson, 0.0), n_used, n_new


@njit(cache=True, error_model="numpy", inline="always")
def _linear(value, coef):
    """Linearity polynomial, coefficients ascending."""
    out = coef[coef.size - 1]
    for k in range(coef.size - 2, -1, -1):
        out = out * value + coef[k]
    return out


@njit(cache=True, error_model="numpy")
def _gather(data, offset, coef, saturation, y, x, g0, g1, d, valid):
    """Linear differences of one pixel, and how many are usable in each integration."""
    n_int = data.shape[0]
    n_diff = g1 - g0 - 1
    saturated = False
    for k in range(n_int):
        valid[k] = n_diff
        before = 0.0
        for g in range(g0, g1):
            raw = float(data[k, g, y, x])
            if raw >= saturation and valid[k] == n_diff:
                valid[k] = max(g - g0 - 1, 0)
                saturated = True
            value = _linear(raw - offset[k, g], coef)
            if g > g0:
                d[k * n_diff + g - g0 - 1] = value - before
            before = value
        # groups dropped at the start may already be saturated
        for g in range(g0):
            if float(data[k, g, y, x]) >= saturation:
                valid[k] = 0
                saturated = True
    return saturated


@njit(cache=True, error_model="numpy")
def _store(
    y, x, scale, result, saturated, had_cut, rate, var_poisson, var_read, n_used, n_jump, dq
):
    """Put one pixel's result into the images."""
    slope, vp, vr, used, jumps = result
    rate[y, x] = slope * scale
    var_poisson[y, x] = vp * scale * scale
    var_read[y, x] = vr * scale * scale
    n_used[y, x] = used
    n_jump[y, x] = jumps
    flag = 0
    if saturated:
        flag |= SATURATED
        if used == 0:
            flag |= FULLY_SATURATED
    if jumps > 0:
        flag |= JUMP
    if had_cut:
        flag |= JUMP_NEIGHBOUR
    dq[y, x] = flag


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def fit_rows(
    data,
    offset,
    coef,
    saturation,
    usable,
    y0,
    y1,
    g0,
    g1,
    s,
    inv_gain,
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
    Fit the ramps of rows ``y0`` to ``y1`` and find their jumps.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Groups in DN, as read.
    offset : `~numpy.ndarray` of float64, shape (n_int, n_group)
        Subtracted before linearisation (bias and common drift).
    coef : `~numpy.ndarray` of float64
        Linearity polynomial, ascending.
    saturation : float
        Raw DN from which a group, and all after it, is dropped.
    usable : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels to fit; the others get NaN.
    y0, y1, g0, g1 : int
        Range of rows, and of groups that take part.
    s : float
        Variance of one read in DN^2.
    inv_gain : float
        DN per electron: Poisson variance of a difference is slope times this.
    scale : float
        Inverse group time: DN per group to DN/s.
    threshold : float
        Jumps are cut above this many sigma; infinity for none.
    rate, var_poisson, var_read, n_used, n_jump, dq : `~numpy.ndarray`, shape (ny, nx)
        Filled in place.

    Returns
    -------
    events : `~numpy.ndarray` of float64, shape (n_event, 5)
        y, x, integration, difference (counted from ``g0``) and signed significance.
    """
    n_int, _, _, nx = data.shape
    n_diff = g1 - g0 - 1
    n_all = n_int * n_diff
    thr2 = threshold * threshold

    d = np.empty((n_all, BLOCK))
    mean = np.empty((n_diff, BLOCK))
    f = np.empty((n_diff + 2, BLOCK))
    h = np.empty((n_diff + 2, BLOCK))
    tmp = np.empty((n_diff + 1, BLOCK))
    before = np.empty(BLOCK)
    top = np.empty(BLOCK)
    slope = np.empty(BLOCK)
    v = np.empty(BLOCK)
    lam = np.empty(BLOCK)
    eps = np.empty(BLOCK)
    sw = np.empty(BLOCK)
    sw2 = np.empty(BLOCK)
    swd = np.empty(BLOCK)
    norm = np.empty(BLOCK)
    inv_d = np.empty(BLOCK)
    wf = np.empty(BLOCK)
    acc = np.empty(BLOCK)
    crit = np.empty(BLOCK)
    # scratch of the general path
    d1 = np.empty(n_all)
    cut = np.empty(n_all, np.bool_)
    found = np.empty(n_all)
    valid = np.empty(n_int, np.int64)
    f1 = np.empty(n_diff + 2)
    tmp1 = np.empty(n_diff + 1)
    first = np.empty(n_all + 1, np.int64)
    last = np.empty(n_all + 1, np.int64)
    events = np.empty((256, 5))
    n_event = 0

    for y in range(y0, y1):
        for x0 in range(0, nx, BLOCK):
            nb = min(BLOCK, nx - x0)
            top[:] = 0.0
            mean[:, :] = 0.0
            for k in range(n_int):
                for g in range(g0, g1):
                    off = offset[k, g]
                    row = data[k, g, y]
                    if g == g0:
                        for b in range(nb):
                            raw = float(row[x0 + b])
                            top[b] = raw if raw > top[b] else top[b]
                            before[b] = _linear(raw - off, coef)
                    else:
                        i = k * n_diff + g - g0 - 1
                        for b in range(nb):
                            raw = float(row[x0 + b])
                            top[b] = raw if raw > top[b] else top[b]
                            value = _linear(raw - off, coef)
                            d[i, b] = value - before[b]
                            mean[i - k * n_diff, b] += value - before[b]
                            before[b] = value
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
                    vv = slope[b] * inv_gain
                    low = _X_MIN * s
                    vv = vv if vv > low else low
                    v[b] = vv
                    xx = vv / s
                    q = 0.5 * xx + np.sqrt(xx + 0.25 * xx * xx)
                    lam[b] = 1.0 / (1.0 + q)
                    eps[b] = q / (1.0 + q)
                    inv_d[b] = (1.0 + q) / (s * q * (2.0 + q))
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
                for i in range(n_diff + 2):
                    for b in range(BLOCK):
                        h[i, b] = f[i, b] * (2.0 - f[i, b])
                for b in range(BLOCK):
                    inv_d[b] = inv_d[b] / h[n_diff + 1, b]
                    # w_j^2 / W with w_j = f f norm and W = n_int sw norm
                    wf[b] = norm[b] / (sw[b] * n_int)
                for k in range(n_int):
                    base = k * n_diff - 1
                    acc[:] = 0.0
                    for j in range(1, n_diff + 1):
                        for b in range(BLOCK):
                            acc[b] = lam[b] * acc[b] + h[j, b] * (d[base + j, b] - slope[b])
                            tmp[j, b] = acc[b]
                    acc[:] = 0.0
                    for j in range(n_diff, 0, -1):
                        m = n_diff + 1 - j
                        for b in range(BLOCK):
                            z = (h[m, b] * tmp[j, b] + h[j, b] * acc[b]) * inv_d[b]
                            c = h[j, b] * h[m, b] * inv_d[b]
                            w = f[j, b] * f[m, b]
                            p = c - w * w * wf[b]
                            p = p if p > 1e-9 * c else 1e-9 * c
                            q = z * z - thr2 * p
                            crit[b] = q if q > crit[b] else crit[b]
                            acc[b] = lam[b] * (acc[b] + h[m, b] * (d[base + j, b] - slope[b]))
            for b in range(nb):
                x = x0 + b
                if not usable[y, x]:
                    rate[y, x] = np.nan
                    var_poisson[y, x] = np.nan
                    var_read[y, x] = np.nan
                    continue
                if top[b] < saturation and crit[b] <= 0.0:
                    var = 1.0 / (sw[b] * norm[b] * n_int)
                    vp = v[b] * sw2[b] * norm[b] * norm[b] * n_int * var * var
                    rate[y, x] = slope[b] * scale
                    var_poisson[y, x] = vp * scale * scale
                    var_read[y, x] = max(var - vp, 0.0) * scale * scale
                    n_used[y, x] = n_all
                    continue
                if top[b] < saturation:
                    saturated = False
                    valid[:] = n_diff
                    for i in range(n_all):
                        d1[i] = d[i, b]
                else:
                    saturated = _gather(data, offset, coef, saturation, y, x, g0, g1, d1, valid)
                cut[:] = False
                result = _fit_pixel(
                    d1, cut, valid, n_diff, s, inv_gain, threshold, f1, tmp1, first, last, found
                )
                _store(
                    y, x, scale, result, saturated, False,
                    rate, var_poisson, var_read, n_used, n_jump, dq,
                )  # fmt: skip
                if result[4] > 0:
                    for i in range(n_all):
                        if cut[i]:
                            if n_event == events.shape[0]:
                                grown = np.empty((2 * n_event, 5))
                                grown[:n_event] = events
                                events = grown
                            events[n_event, 0] = y
                            events[n_event, 1] = x
                            events[n_event, 2] = i // n_diff
                            events[n_event, 3] = i % n_diff
                            events[n_event, 4] = found[i]
                            n_event += 1
    return events[:n_event].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def refit(
    data,
    offset,
    coef,
    saturation,
    ys,
    xs,
    start,
    cuts,
    g0,
    g1,
    s,
    inv_gain,
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
    Fit single pixels again with differences that are cut from outside.

    Parameters
    ----------
    ys, xs : `~numpy.ndarray` of int64, shape (n_pixel,)
        The pixels.
    start : `~numpy.ndarray` of int64, shape (n_pixel + 1,)
        Pixel i is cut at ``cuts[start[i]:start[i + 1]]``.
    cuts : `~numpy.ndarray` of int64
        Index of the difference, integration times number of differences plus difference.

    Other parameters are those of `fit_rows`. Jumps that were found before belong to the
    cuts; new ones are added to their number.
    """
    n_int = data.shape[0]
    n_diff = g1 - g0 - 1
    n_all = n_int * n_diff
    d = np.empty(n_all)
    cut = np.empty(n_all, np.bool_)
    found = np.empty(n_all)
    valid = np.empty(n_int, np.int64)
    f = np.empty(n_diff + 2)
    tmp = np.empty(n_diff + 1)
    first = np.empty(n_all + 1, np.int64)
    last = np.empty(n_all + 1, np.int64)
    for i in range(ys.size):
        y = ys[i]
        x = xs[i]
        saturated = _gather(data, offset, coef, saturation, y, x, g0, g1, d, valid)
        cut[:] = False
        for j in range(start[i], start[i + 1]):
            cut[cuts[j]] = True
        result = _fit_pixel(
            d, cut, valid, n_diff, s, inv_gain, threshold, f, tmp, first, last, found
        )
        # its own jumps are among the cuts
        jumps = n_jump[y, x] + result[4]
        result = (result[0], result[1], result[2], result[3], jumps)
        _store(
            y, x, scale, result, saturated, True,
            rate, var_poisson, var_read, n_used, n_jump, dq,
        )  # fmt: skip
