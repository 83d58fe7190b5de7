"""One pixel at a time: its linear differences, its saturation and the flags of its groups."""

from miricigale.utils.compilation import njit

__all__ = [
    "DO_NOT_USE",
    "JUMP",
    "JUMP_NEIGHBOR",
    "SATURATED",
    "X_MIN",
    "at",
    "cut_by_flags",
    "gather",
    "level_of",
    "linear",
]

# bits that the kernels set or read; instrument.DQ gives them names
DO_NOT_USE = 1
SATURATED = 2
JUMP = 4
JUMP_NEIGHBOR = 2**32

#: Least ratio of Poisson to read variance, to keep the closed forms finite.
X_MIN = 1e-8


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
