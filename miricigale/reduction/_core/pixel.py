"""One pixel at a time: segments between jumps, saturation, and pixels fitted again."""

import numpy as np

from miricigale.utils.compilation import njit

__all__ = [
    "DO_NOT_USE",
    "JUMP",
    "JUMP_NEIGHBOR",
    "SATURATED",
    "X_MIN",
    "at",
    "cut_by_flags",
    "fit_pixel",
    "gather",
    "level_of",
    "linear",
    "refit",
    "store",
]

# bits that the kernels set or read; instrument.DQ gives them names
DO_NOT_USE = 1
SATURATED = 2
JUMP = 4
JUMP_NEIGHBOR = 2**32

#: Least ratio of Poisson to read variance, to keep the closed forms finite.
X_MIN = 1e-8


@njit(cache=True, error_model="numpy", inline="always")
def _poisson(slope, inv_gain, s):
    """Poisson variance of a difference, floored at a trace of the read variance."""
    v = slope * inv_gain
    low = X_MIN * s
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
def fit_pixel(d, cut, valid, n_diff, s, inv_gain, slow, threshold, f, tmp, first, last, found):
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
        v = _poisson(slope, inv_gain, s) + slow
        slope, total, total2 = _solve(d, first, last, n_seg, v, s, f)
        v = _poisson(slope, inv_gain, s) + slow
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
    var_poisson = (v - slow) * total2 * var * var
    return slope, var_poisson, max(var - var_poisson, 0.0), n_used, n_new


@njit(cache=True, error_model="numpy", inline="always")
def at(values, y, x):
    """Value of a pixel: maps hold one for all (1, 1) or one for each (ny, nx)."""
    return values[y if values.shape[0] > 1 else 0, x if values.shape[1] > 1 else 0]


@njit(cache=True, error_model="numpy", inline="always")
def level_of(levels, k, g, y, x):
    """DN of an empty pixel in a group: drift of the read-out, bias and reset anomaly."""
    drift, bias, reset = levels
    row = y if drift.shape[2] > 1 else 0
    channel = x % drift.shape[3]
    value = drift[k, g, row, channel] + at(bias, y, x)
    if g < reset.shape[1]:
        value += reset[min(k, reset.shape[0] - 1), g, y, x]
    return value


@njit(cache=True, error_model="numpy", inline="always")
def linear(value, coef, y, x):
    """Linearity polynomial of a pixel, coefficients ascending, (n, 1, 1) or (n, ny, nx)."""
    row = y if coef.shape[1] > 1 else 0
    column = x if coef.shape[2] > 1 else 0
    out = coef[coef.shape[0] - 1, row, column]
    for k in range(coef.shape[0] - 2, -1, -1):
        out = out * value + coef[k, row, column]
    return out


@njit(cache=True, error_model="numpy")
def gather(data, levels, response, y, x, g0, g1, d, valid):
    """Linear differences of one pixel, and how many are usable in each integration."""
    coef, limits, dark = response
    n_int = data.shape[0]
    n_diff = g1 - g0 - 1
    saturation = at(limits, y, x)
    saturated = False
    for k in range(n_int):
        valid[k] = n_diff
        before = 0.0
        for g in range(g0, g1):
            raw = float(data[k, g, y, x])
            if raw >= saturation and valid[k] == n_diff:
                valid[k] = max(g - g0 - 1, 0)
                saturated = True
            value = linear(raw - level_of(levels, k, g, y, x), coef, y, x)
            if dark.shape[1] > 0:
                value -= dark[min(k, dark.shape[0] - 1), g, y, x]
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
def cut_by_flags(group_dq, y, x, g0, g1, cut, valid):
    """
    Cut the differences of one pixel that the flags of its groups forbid.

    A group that is not to be used takes both of its differences, a jump the one before it, and
    a saturated group ends its integration. ``group_dq`` of no groups has no flags. Returns whether
    a group was saturated and whether a jump was flagged.
    """
    n_diff = g1 - g0 - 1
    saturated, jumped = False, False
    if group_dq.shape[1] == 0:
        return saturated, jumped
    for k in range(group_dq.shape[0]):
        for g in range(g1):
            flag = group_dq[k, g, y, x]
            if flag & SATURATED:
                valid[k] = min(valid[k], max(g - g0 - 1, 0))
                saturated = True
            if g < g0:
                continue
            i = k * n_diff + g - g0
            if g > g0 and flag & (DO_NOT_USE | JUMP):
                cut[i - 1] = True
            if g < g1 - 1 and flag & DO_NOT_USE:
                cut[i] = True
            if flag & JUMP:
                jumped = True
    return saturated, jumped


@njit(cache=True, error_model="numpy")
def store(y, x, scale, result, saturated, had_cut, rate, var_poisson, var_read, n_used, n_jump, dq):
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
    if jumps > 0:
        flag |= JUMP
    if had_cut:
        flag |= JUMP | JUMP_NEIGHBOR
    dq[y, x] = flag


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
        saturated = gather(data, levels, response, y, x, g0, g1, d, valid)
        cut[:] = False
        flags = cut_by_flags(group_dq, y, x, g0, g1, cut, valid)
        for j in range(start[i], start[i + 1]):
            cut[cuts[j]] = True
        result = fit_pixel(
            d, cut, valid, n_diff, at(variance, y, x), at(inv_gain, y, x), at(slow, y, x),
            threshold, f, tmp, first, last, found,
        )  # fmt: skip
        # its own jumps are among the cuts
        jumps = n_jump[y, x] + result[4]
        result = (result[0], result[1], result[2], result[3], jumps)
        store(
            y, x, scale, result, saturated or flags[0], start[i + 1] > start[i],
            rate, var_poisson, var_read, n_used, n_jump, dq,
        )  # fmt: skip
        if flags[1]:
            dq[y, x] |= JUMP
