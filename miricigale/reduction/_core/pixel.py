"""One pixel at a time: its linear differences, its weights, its saturation and the flags of its groups."""

import numpy as np

from miricigale.utils.compilation import njit

# bits that the kernels set or read; instrument.DQ gives them names
DO_NOT_USE = 1
SATURATED = 2
JUMP = 4
JUMP_NEIGHBOR = 2**32

#: Least ratio of Poisson to read variance, to keep the closed forms finite.
X_MIN = 1e-8

#: Share of the charge of a hit that each of the four neighbors holds at most (about 0.03 in flight).
LEAK = 0.05

#: Least size of the variance of averaged reads over the Poisson variance, to keep the closed forms finite.
S_MIN = 1e-6


@njit(error_model="numpy", inline="always")
def averaged_variance(s, v, shared):
    """
    Variance s of a read, less what neighboring differences of averaged groups share of their photons, v.

    Means of M frames have the covariance v I + (s - shared v) tridiag(-1, 2, -1) with shared = (M^2 - 1) / (6 M^2)
    (`shared_photons`): that of single reads with another s, which is negative where the photons count more.
    """
    total = s - shared * v
    floor = S_MIN * v
    return floor if shared > 0.0 and abs(total) < floor else total


@njit(error_model="numpy", inline="always")
def at(values, y, x):
    """Value of a pixel: maps hold one for all (1, 1) or one for each (ny, nx)."""
    return values[y if values.shape[0] > 1 else 0, x if values.shape[1] > 1 else 0]


@njit(error_model="numpy", inline="always")
def weights(slope, s, inv_gain, slow, shared):
    """Variance v of a difference, l and 1 - l of the weights, and 1 / (s (1/l - l))."""
    v = slope * inv_gain
    low = X_MIN * s
    v = v if v > low else low
    s = averaged_variance(s, v, shared)
    v += slow
    x = v / s
    root = np.sqrt(x + 0.25 * x * x)
    # of the two roots that with |l| < 1
    q = 0.5 * x + (root if s > 0.0 else -root)
    lam = 1.0 / (1.0 + q)
    return v, lam, q * lam, (1.0 + q) / (s * q * (2.0 + q))


@njit(error_model="numpy", inline="always")
def store(out, y, x, slope, noise, total, squares, scale):
    """
    Slope of a pixel and the two parts of its variance, from the sums of weights and their squares.

    ``noise`` is the variance of a difference, what of it is slow noise, the variance of a read, and the share of
    `averaged_variance`.
    """
    v, slow, s, shared = noise
    var = 1.0 / total
    photon = v - slow
    if shared > 0.0:
        # photons of averaged groups: v (I - shared T); the weights have w^T T w = (total - v squares) / s
        steps = (total - v * squares) / averaged_variance(s, photon, shared)
        photon *= (squares - shared * steps) * var * var
    else:
        photon *= squares * var * var
    out[0][y, x] = slope * scale
    out[1][y, x] = photon * scale * scale
    out[2][y, x] = max(var - photon, 0.0) * scale * scale


@njit(error_model="numpy", inline="always")
def no_slope(out, y, x):
    """Pixel without a slope."""
    out[0][y, x] = out[1][y, x] = out[2][y, x] = np.nan


@njit(error_model="numpy")
def own_charge(jumps, nx, n_diff):
    """
    Significance of jumps without what leaked from the jumps of the four neighbors at the same difference.

    ``jumps`` (n, 5) are those of `fit_pixels`, in the order of rows, columns, integrations and differences.
    """
    size = np.abs(jumps[:, 4])
    if size.size == 0:
        return size
    n_all = (int(jumps[:, 2].max()) + 1) * n_diff
    width = nx + 1
    key = ((jumps[:, 0] * width + jumps[:, 1]) * n_all + jumps[:, 2] * n_diff + jumps[:, 3]).astype(
        np.int64
    )
    leaked = np.zeros(size.size)
    # the two before, which leak and are leaked to
    for away in (1, width):
        before = np.searchsorted(key, key - away * n_all)
        for i in range(size.size):
            j = before[i]
            if key[j] == key[i] - away * n_all:
                leaked[i] += size[j]
                leaked[j] += size[i]
    return size - LEAK * leaked


@njit(error_model="numpy", fastmath={"contract"})
def gather(data, levels, response, y, x, g0, g1, d, valid):
    """Linear differences of one pixel, and how many are usable in each integration."""
    drift, bias, reset = levels
    coefficients, limits, dark, rise = response
    n_int = data.shape[0]
    n_diff = g1 - g0 - 1
    # of all groups
    row = y if drift.shape[2] > 1 else 0
    channel = x % drift.shape[3]
    start = at(bias, y, x)
    saturation = at(limits, y, x)
    coef = np.empty(coefficients.shape[0])
    for j in range(coef.size):
        coef[j] = at(coefficients[j], y, x)
    saturated = False
    for k in range(n_int):
        valid[k] = n_diff
        before = 0.0
        reads = data[k, :, y, x]
        shift = drift[k, :, row, channel]
        anomaly = reset[min(k, reset.shape[0] - 1), :, y, x]
        signal = dark[min(k, dark.shape[0] - 1), :, y, x]
        for g in range(g0, g1):
            raw = float(reads[g])
            last = raw
            if rise > 0.0 and g > 0:
                # the last of the frames whose mean a group is
                last += rise * max(raw - float(reads[g - 1]), 0.0)
            if last >= saturation and valid[k] == n_diff:
                valid[k] = max(g - g0 - 1, 0)
                saturated = True
            level = raw - (shift[g] + start)
            if g < anomaly.size:
                level -= anomaly[g]
            value = coef[-1]
            for j in range(coef.size - 2, -1, -1):
                value = value * level + coef[j]
            if signal.size > 0:
                value -= signal[g]
            if g > g0:
                d[k * n_diff + g - g0 - 1] = value - before
            before = value
        # groups dropped at the start may already be saturated
        for g in range(g0):
            if float(reads[g]) >= saturation:
                valid[k] = 0
                saturated = True
    return saturated


@njit(error_model="numpy")
def widen(cut, i, n_diff):
    """Cut difference ``i`` and those beside it in its integration: a hit amid averaged frames shows in two."""
    k = i // n_diff
    for j in range(max(i - 1, k * n_diff), min(i + 2, (k + 1) * n_diff)):
        cut[j] = True


@njit(error_model="numpy")
def cut_by_flags(group_dq, y, x, g0, g1, cut, valid, averaged):
    """
    Cut the differences of one pixel that the flags of its groups forbid.

    A group that is not to be used takes both of its differences, a jump the one before it, and
    a saturated group ends its integration; a jump in ``averaged`` groups takes those beside it too.
    ``group_dq`` of no groups has no flags. Returns whether a group was saturated and whether a jump was flagged.
    """
    n_diff = g1 - g0 - 1
    saturated = False
    jumped = False
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
                if averaged and g > g0:
                    widen(cut, i - 1, n_diff)
    return saturated, jumped
