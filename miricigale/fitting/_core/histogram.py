"""
Histograms, from which the percentiles of derived quantities are read, and their moments.

Bins are 0.01 dex wide and span 10.24 dex on either side of the quantity at the best model;
what lies beyond is counted in the outermost bins. A fraction has linear bins, in which each
model is spread evenly over its cell.
"""

import math

import numpy as np

from miricigale.fitting._core.lanes import as_type
from miricigale.fitting._core.structs import (
    DUST,
    EDGE_HIGH,
    EDGE_LOW,
    KERNEL,
    LOG_DUST,
    LOG_RATIO,
    MIXED_AGN,
    MIXED_GALAXY,
    PART,
    RATIO,
    SHARE_AGN,
    SHARE_GALAXY,
)
from miricigale.utils.compilation import njit

__all__ = [
    "N_BINS",
    "N_SHARE",
    "PER_DEX",
    "add_alone",
    "add_model",
    "clear_rows",
    "summarise",
    "widest",
]

PER_DEX = 100
N_BINS = 2048
#: Bins of a fraction.
N_SHARE = 4096

_HALF = N_BINS // 2
# Variance in bins: 1/12 of a bin, and 1/6 of the sharing between neighbours.
_BINNED = 0.25
_LOG10_E = 0.43429448190325183
_LOG10_2 = 0.30102999566398120
_LOG10_E2 = 0.86858896380650366  # 2 log10(e)
_MANTISSA = np.int64(0x000FFFFFFFFFFFFF)
_HALF_ONE = np.int64(0x3FE0000000000000)
_ROOT_HALF = 0.70710678118654752
_NO_SCALE = -1e9
# Standard deviations of AGN quantities below this part of the mean total luminosity need not hold
# their relative accuracy.
_FAINT = 1e-3


@njit(**PART)
def _log10(x):
    """log10(x) to 1e-7 for positive normal numbers (x = 0: about -308)."""
    # x = m 2^e with m in [0.5, 1)
    bits = as_type(x, np.int64)
    e = np.float64(np.int32((bits >> np.int64(52)) - np.int64(1022)))
    m = as_type((bits & _MANTISSA) | _HALF_ONE, np.float64) / _ROOT_HALF
    t = (m - 1.0) / (m + 1.0)
    t2 = t * t
    s = t * (1.0 + t2 * (1.0 / 3.0 + t2 * (0.2 + t2 * (1.0 / 7.0))))
    return (e - 0.5) * _LOG10_2 + _LOG10_E2 * s


@njit(**PART)
def _add_bin(hist, row, y, t):
    """Share a weight between the two bins whose middles are nearest to y, in bins."""
    y = min(max(y - 0.5, 0.0), N_BINS - 2.0)
    column = np.int64(y)
    part = (y - column) * t
    hist.table[row, column] += t - part
    hist.table[row, column + 1] += part
    hist.used[row, 0] = min(hist.used[row, 0], column)
    hist.used[row, 1] = max(hist.used[row, 1], column + 1)


@njit(**PART)
def _add_share(change, low, high, weight):
    """
    Add a weight that is spread evenly from ``low`` to ``high`` (within 0 and 1).

    ``change`` are changes of slope of the cumulative distribution at the edges of the bins.
    """
    # what is narrower than a bin is as wide as one, and lies within the last bin if all is there
    low = min(low, 1.0 - 1.0 / N_SHARE)
    high = max(high, low + 1.0 / N_SHARE)
    v = weight / (N_SHARE * (high - low))
    x = low * N_SHARE
    i = min(np.int64(x), N_SHARE)
    part = x - i
    change[i] += (1.0 - part) * v
    change[i + 1] += part * v
    x = min(high * N_SHARE, N_SHARE + 1.0)
    i = min(np.int64(x), N_SHARE)
    part = x - i
    change[i] -= (1.0 - part) * v
    change[i + 1] -= part * v


@njit(**PART)
def add_model(tables, hist, g, k, j, s, t):
    """Add a model of scale s and weight t."""
    of_galaxy, of_agn, of_frac = tables.of_galaxy, tables.of_agn, tables.of_frac
    y = of_galaxy[SHARE_GALAXY, g] * of_agn[SHARE_AGN, k]
    low, high = y * of_frac[EDGE_LOW, j], y * of_frac[EDGE_HIGH, j]
    _add_share(hist.share, low / (1.0 + low), high / (1.0 + high), t)
    if s == 0.0:
        return
    n_galaxy = tables.galaxy.shape[1]
    y = PER_DEX * (_log10(s) - hist.origin[0]) + _HALF
    _add_bin(hist, g, y, t)
    if of_galaxy[DUST, g] > 0.0:
        y += of_frac[LOG_RATIO, j] + PER_DEX * (
            of_galaxy[LOG_DUST, g] + hist.origin[0] - hist.origin[1]
        )
        _add_bin(hist, n_galaxy + k, y, t)
    power = of_frac[RATIO, j] * of_galaxy[DUST, g] * of_agn[MIXED_AGN, k]
    mixed = s * (of_galaxy[MIXED_GALAXY, g] + power)
    if mixed > 0.0:
        y = PER_DEX * (_log10(mixed) - hist.origin[2]) + _HALF
        _add_bin(hist, n_galaxy + of_agn.shape[1], y, t)


@njit(**PART)
def add_alone(tables, hist, g, s, t):
    """Add a model without AGN."""
    # what is spread over the cell of f = 0 need not be as many pieces as there are tori
    y = tables.edge_zero * tables.share_mean * tables.of_galaxy[SHARE_GALAXY, g]
    _add_share(hist.share, 0.0, y / (1.0 + y), t)
    if s > 0.0:
        y = _LOG10_E * math.log(s)
        _add_bin(hist, g, (y - hist.origin[0]) * PER_DEX + _HALF, t)
        mixed = tables.of_galaxy[MIXED_GALAXY, g]
        if mixed > 0.0:
            y += _LOG10_E * math.log(mixed) - hist.origin[2]
            last = tables.galaxy.shape[1] + tables.of_agn.shape[1]
            _add_bin(hist, last, y * PER_DEX + _HALF, t)


@njit(**KERNEL)
def clear_rows(table, used):
    """Set the used bins of every row to zero and mark the rows as empty."""
    for i in range(used.shape[0]):
        for j in range(used[i, 0], used[i, 1] + 1):
            table[i, j] = 0.0
        used[i, 0] = N_BINS
        used[i, 1] = -1


@njit(**KERNEL)
def _add_scaled(table, used, shift, keep, out):
    """
    Sum rows of histograms of log y to those of log(scale y), for several scales.

    ``shift``, of shape (n_quantities, n), is log10 of the scales in bins, `_NO_SCALE` where a scale
    is 0; ``keep`` says which of the n rows are not left out. ``out``, of shape (n_quantities,
    N_BINS + 1), is added to; in the last column the weight of rows whose scale is 0.
    """
    for q in range(shift.shape[0]):
        for i in range(shift.shape[1]):
            first, last = used[i, 0], used[i, 1]
            if not keep[i] or last < 0:
                continue
            if shift[q, i] == _NO_SCALE:
                for j in range(first, last + 1):
                    out[q, N_BINS] += table[i, j]
                continue
            step = math.floor(shift[q, i])
            part = shift[q, i] - step
            step = min(max(np.int64(step), -2 * N_BINS), 2 * N_BINS)
            # what leaves the histogram is counted in its outermost bins
            low = max(first, -step)
            high = min(last, N_BINS - 2 - step)
            for j in range(first, min(low, last + 1)):
                out[q, 0] += table[i, j]
            for j in range(max(high + 1, first), last + 1):
                out[q, N_BINS - 1] += table[i, j]
            if high < low:
                continue
            row = table[i, low : high + 1]
            left = out[q, low + step : high + step + 1]
            for j in range(row.size):
                left[j] += (1.0 - part) * row[j]
            right = out[q, low + step + 1 : high + step + 2]
            for j in range(row.size):
                right[j] += part * row[j]


def _scaled(table, used, scale, weight, floor):
    """
    Sum rows of histograms of log y to those of log(scale y).

    Rows of no more weight than ``floor`` are left out. Returned are what the log10 of the middle bin
    is above that of the rows, for each quantity, and the sums, of shape (n_quantities, N_BINS + 1),
    with the weight of rows whose scale is 0 in the last column.
    """
    lit = scale > 0
    log = _LOG10_E * np.log(scale, where=lit, out=np.zeros(scale.shape))
    top = np.argmax(np.where(lit, weight, 0.0), axis=1)
    middle = np.take_along_axis(log, top[:, None], axis=1)
    shift = np.where(lit, (log - middle) * PER_DEX, _NO_SCALE)
    out = np.zeros((len(scale), N_BINS + 1))
    _add_scaled(table, used, shift, weight > floor, out)
    return middle[:, 0], out


def _log_quantiles(hist, middle, zero, sigma, levels):
    """
    Mean logarithms and quantiles of quantities from their histograms, of shape (n, N_BINS).

    ``middle`` is log10 of the lower edge of the middle bin, ``zero`` the weight of models in which a
    quantity is zero: the former are of the others. Histograms are broadened by ``sigma``, the
    relative error of the scale. NaN where there is no weight.
    """
    used = np.flatnonzero(hist.any(axis=0))
    first, last = (used[0], used[-1]) if used.size else (0, 0)
    hist = hist[:, first : last + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        column = hist @ np.arange(first + 0.5, last + 1) / hist.sum(axis=1)
    width = min(sigma * _LOG10_E * PER_DEX, 200.0)
    # what bins of equal density, and sharing between two of them, have added is left out
    width = math.sqrt(max(width * width - _BINNED, 0.0))
    if width > 0.15:
        reach = math.ceil(4.0 * width)
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
        kernel /= kernel.sum()
        hist = np.array([np.convolve(row, kernel) for row in hist])
        # what leaves the histogram is counted in its outermost bins
        low, high = max(reach - first, 0), max(last + reach + 1 - N_BINS, 0)
        first, n = max(first - reach, 0), hist.shape[1] - high
        hist[:, low] += hist[:, :low].sum(axis=1)
        hist[:, n - 1] += hist[:, n:].sum(axis=1)
        hist = hist[:, low:n]
    below = np.cumsum(np.column_stack([zero, hist]), axis=1)
    quantiles = np.empty((len(hist), levels.size))
    for q, (row, sums) in enumerate(zip(hist, below, strict=True)):
        target = levels * sums[-1]
        j = np.minimum(np.searchsorted(sums[1:], target), row.size - 1)
        part = np.clip(target - sums[j], 0.0, row[j])
        part = np.divide(part, row[j], where=row[j] > 0, out=np.full(j.size, 0.5))
        bins = j + part + (first - _HALF)
        quantiles[q] = np.where(target > zero[q], 10.0 ** (middle[q] + bins / PER_DEX), 0.0)
    quantiles[below[:, -1] <= 0.0] = np.nan
    return middle + (column - _HALF) / PER_DEX, quantiles


def _share_quantiles(change, levels):
    """Quantiles of a fraction, from changes of slope; NaN if there is no weight."""
    slope = np.cumsum(change[:N_SHARE])
    below = np.cumsum(np.append(0.0, slope))
    target = levels * below[-1]
    if not below[-1] > 0.0:
        return np.full(levels.size, np.nan)
    j = np.minimum(np.searchsorted(below[1:], target), N_SHARE - 1)
    part = np.clip(target - below[j], 0.0, np.maximum(slope[j], 0.0))
    return (j + np.divide(part, slope[j], where=slope[j] > 0, out=np.zeros(j.size))) / N_SHARE


def _moments(scales, sums):
    """Means and variances of the derived quantities, scales' own variances included."""
    moments = []
    for power in (1, 2):
        galaxy = scales.galaxy**power @ sums.galaxy[:, power]
        agn = scales.agn**power @ sums.agn[:, power]
        moments.append(np.concatenate([galaxy[:-1], agn[:-1], galaxy[-1:] + agn[-1:]]))
    first, second = moments
    second[-1] += 2.0 * sums.total[3]
    mean = first / sums.total[0]
    return mean, second / sums.total[0] - mean * mean


def widest(scales, sums):
    """Squares of quantities over their variance so far, the largest of each galaxy and torus."""
    mean, variance = _moments(scales, sums)
    n = len(scales.galaxy) - 1
    part = 1e-6 * mean
    part[n:-1] = _FAINT * mean[-1]
    value = np.maximum(variance, part * part)
    # of what is the same for all models, in numbers too small to square, nothing is asked
    inverse = np.divide(1.0, value, where=value > 1e-290, out=np.zeros(value.size))
    of_galaxy = np.append(inverse[:n], inverse[-1])
    galaxy = np.max(scales.galaxy**2 * of_galaxy[:, None], axis=0)
    return galaxy, np.max(scales.agn**2 * inverse[n:, None], axis=0)


def summarise(scales, sums, scale_error, levels, out, quantiles, share, share_quantiles):
    """
    Moments and quantiles of all derived quantities of one object.

    Parameters
    ----------
    scales, sums
        See `miricigale.fitting._core.structs`.
    scale_error : float
        Whether the variances of the models' scales count.
    levels : `~numpy.ndarray`, shape (n_levels,)
        Of the quantiles, ascending.
    out, quantiles : `~numpy.ndarray`, shapes (n_quantities, 3) and (n_quantities, n_levels)
        Filled: mean, standard deviation and mean of log10; quantiles. The order is the galaxy's
        quantities, the torus's, then the one of both.
    share, share_quantiles : `~numpy.ndarray`, shapes (2,) and (n_levels,)
        Filled: mean and standard deviation, and quantiles of the other fraction.
    """
    total, hist = sums.total[0], sums.hist
    sigma = scale_error / np.sqrt(max(sums.total[1] / total, 1.0))
    mean, variance = _moments(scales, sums)
    out[:, 0] = mean
    out[:, 1] = np.sqrt(np.maximum(variance, 0.0))
    n_galaxy, n_agn = len(sums.galaxy), len(sums.agn)
    groups = (
        (0, scales.galaxy[:-1], sums.galaxy[:, 0], 1e-6 * total / n_galaxy),
        (n_galaxy, scales.agn[:-1], sums.agn[:, 0], 0.0),
        (n_galaxy + n_agn, np.ones((1, 1)), np.array([total]), 0.0),
    )
    middle, zero, tables = [], [], []
    for origin, (first, scale, weight, floor) in zip(hist.origin, groups, strict=True):
        rows = slice(first, first + weight.size)
        shift, table = _scaled(hist.table[rows], hist.used[rows], scale, weight, floor)
        middle.append(origin + shift)
        # models without light, or any without AGN power, or without either
        dark = sums.total[2] if first == 0 else max(total - hist.table[rows].sum(), 0.0)
        zero.append(dark + table[:, N_BINS])
        tables.append(table[:, :N_BINS])
    out[:, 2], quantiles[:] = _log_quantiles(
        np.concatenate(tables), np.concatenate(middle), np.concatenate(zero), sigma, levels
    )
    share[0] = sums.total[4] / total
    share[1] = np.sqrt(max(sums.total[5] / total - share[0] ** 2, 0.0))
    share_quantiles[:] = _share_quantiles(hist.share, levels)
