"""
Histograms, from which the percentiles of derived quantities are read, and their moments.

Bins are 0.01 dex wide and span 10.24 dex on either side of the quantity at the best model;
what lies beyond is counted in the outermost bins. A fraction has linear bins, in which each
model is spread evenly over its cell.
"""

import math

import numpy as np

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.functions import log10
from miricigale.fitting._core.structs import KERNEL, PART, Scales
from miricigale.utils.compilation import njit

PER_DEX = 100
N_BINS = 2048
#: Bins of a fraction.
N_SHARE = 4096

_HALF = N_BINS // 2
# Variance in bins: 1/12 of a bin, and 1/6 of the sharing between neighbors.
_BINNED = 0.25
_LOG10_E = 0.43429448190325183
#: Logarithm of a scale of 0.
NO_SCALE = -1e9
# Standard deviations of AGN quantities below this part of the mean total luminosity need not hold
# their relative accuracy.
_FAINT = 1e-3


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
    for edge, slope in ((low, v), (min(high, 1.0 + 1.0 / N_SHARE), -v)):
        x = edge * N_SHARE
        i = min(np.int64(x), N_SHARE)
        change[i] += (1.0 - (x - i)) * slope
        change[i + 1] += (x - i) * slope


@njit(**PART)
def add_model(tables, hist, g, k, j, s, t):
    """Add a model of scale s and weight t; without AGN its k is -1."""
    of_galaxy, of_agn, of_frac = tables.of_galaxy, tables.of_agn, tables.of_frac
    # what is spread over the cell of f = 0 need not be as many pieces as there are AGN models
    y, low, high, power = tables.share_mean, 0.0, tables.edge_zero, 0.0
    if k >= 0:
        y, low, high = of_agn[at.SHARE_AGN, k], of_frac[at.EDGE_LOW, j], of_frac[at.EDGE_HIGH, j]
        power = of_frac[at.RATIO, j] * of_galaxy[at.DUST, g]
    y *= of_galaxy[at.SHARE_GALAXY, g]
    _add_share(hist.share, y * low / (1.0 + y * low), y * high / (1.0 + y * high), t)
    if s == 0.0:
        return
    n_galaxy = tables.galaxy.shape[1]
    y = PER_DEX * (log10(s) - hist.origin[0]) + _HALF
    _add_bin(hist, g, y, t)
    mixed = of_galaxy[at.MIXED_GALAXY, g]
    if power > 0.0:
        mixed += power * of_agn[at.MIXED_AGN, k]
        y += of_frac[at.LOG_RATIO, j] + PER_DEX * (
            of_galaxy[at.LOG_DUST, g] + hist.origin[0] - hist.origin[1]
        )
        _add_bin(hist, n_galaxy + k, y, t)
    if mixed > 0.0:
        y = PER_DEX * (log10(s * mixed) - hist.origin[2]) + _HALF
        _add_bin(hist, n_galaxy + of_agn.shape[1], y, t)


@njit(**KERNEL)
def clear_rows(table, used):
    """Set the used bins of every row to zero and mark the rows as empty."""
    for i in range(used.shape[0]):
        table[i, used[i, 0] : used[i, 1] + 1] = 0.0
        used[i, 0] = N_BINS
        used[i, 1] = -1


@njit(**{**KERNEL, "fastmath": False})
def _log_quantiles(
    table, used, log, weight, least, zero, origin, kernel, work, levels, out, quantiles
):
    """
    Mean logarithms and quantiles of quantities that scale with the same histograms.

    ``log``, of shape (n_quantities, n), is log10 of their scales in the n rows of the table, `NO_SCALE`
    where one is 0; rows of less weight than ``least`` are left out. ``zero`` is the weight of models in
    which all quantities are zero, ``origin`` log10 of the rows' middle bins, ``kernel`` that by which
    histograms are broadened, ``work`` scratch of shape (2, n_bins + its length). ``out`` and
    ``quantiles`` are filled; NaN where there is no weight.
    """
    reach = kernel.size // 2
    for q in range(log.shape[0]):
        hist, wide = work[0, :N_BINS], work[1]
        hist[:] = 0.0
        wide[:] = 0.0
        top = 0.0
        middle = 0.0
        for i in range(weight.size):
            if log[q, i] > NO_SCALE and weight[i] > top:
                top = weight[i]
                middle = log[q, i]
        nothing = zero
        for i in range(weight.size):
            first, last = used[i, 0], used[i, 1]
            if weight[i] <= least or last < 0:
                continue
            if log[q, i] <= NO_SCALE:
                for j in range(first, last + 1):
                    nothing += table[i, j]
                continue
            offset = (log[q, i] - middle) * PER_DEX
            step = math.floor(offset)
            part = offset - step
            step = min(max(np.int64(step), -2 * N_BINS), 2 * N_BINS)
            # what leaves the histogram is counted in its outermost bins
            for j in range(first, last + 1):
                column = min(max(j + step, 0), N_BINS - 1)
                hist[column] += (1.0 - part) * table[i, j]
                hist[min(max(j + step + 1, 0), N_BINS - 1)] += part * table[i, j]
        total = 0.0
        moment = 0.0
        for j in range(N_BINS):
            total += hist[j]
            moment += hist[j] * (j + 0.5)
        for j in range(N_BINS):
            if hist[j] > 0.0:
                for i in range(kernel.size):
                    wide[j + i] += hist[j] * kernel[i]
        for j in range(reach):
            wide[reach] += wide[j]
            wide[reach + N_BINS - 1] += wide[reach + N_BINS + j]
        middle += origin
        out[q] = middle + (moment / total - _HALF) / PER_DEX if total > 0.0 else np.nan
        below = nothing
        j = 0
        for i in range(levels.size):
            target = levels[i] * (total + nothing)
            if target <= nothing or total == 0.0:
                quantiles[q, i] = 0.0 if total + nothing > 0.0 else np.nan
                continue
            while j < N_BINS - 1 and below + wide[reach + j] < target:
                below += wide[reach + j]
                j += 1
            now = wide[reach + j]
            part = min(max((target - below) / now, 0.0), 1.0) if now > 0.0 else 0.5
            quantiles[q, i] = 10.0 ** (middle + (j - _HALF + part) / PER_DEX)


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


def make_scales(galaxy, agn):
    """Bundle derived quantities, as `Scales` has them."""
    logs = [
        np.log10(scale, where=scale > 0, out=np.full(scale.shape, NO_SCALE))
        for scale in (galaxy, agn)
    ]
    return Scales(galaxy, agn, np.square(galaxy), np.square(agn), *logs)


def _moments(scales, sums):
    """Means and variances of the derived quantities, scales' own variances included."""
    moments = []
    for power, galaxy, agn in (
        (1, scales.galaxy, scales.agn),
        (2, scales.galaxy_square, scales.agn_square),
    ):
        of_galaxy, of_agn = galaxy @ sums.galaxy[:, power], agn @ sums.agn[:, power]
        of_galaxy[-1] += of_agn[-1]
        moments.append(np.concatenate([of_galaxy[:-1], of_agn[:-1], of_galaxy[-1:]]))
    first, second = moments
    second[-1] += 2.0 * sums.total[3]
    mean = first / sums.total[0]
    return mean, second / sums.total[0] - mean * mean


def widest(scales, sums):
    """Squares of quantities over their variance so far, the largest of each galaxy and AGN model."""
    mean, variance = _moments(scales, sums)
    n = len(scales.galaxy) - 1
    part = 1e-6 * mean
    part[n:-1] = _FAINT * mean[-1]
    value = np.maximum(variance, part * part)
    # of what is the same for all models, in numbers too small to square, nothing is asked
    inverse = np.divide(1.0, value, where=value > 1e-290, out=np.zeros(value.size))
    of_galaxy = np.append(inverse[:n], inverse[-1])
    galaxy = np.max(scales.galaxy_square * of_galaxy[:, None], axis=0)
    return galaxy, np.max(scales.agn_square * inverse[n:, None], axis=0)


def summarize(scales, sums, scale_error, levels, out, quantiles, share, share_quantiles):
    """
    Fill moments and quantiles of all derived quantities of one object, and of the other fraction.

    The order is the galaxy's quantities, the AGN model's, then the one of both; ``out`` has means,
    standard deviations and means of log10 in its rows, ``share`` mean and standard deviation.
    """
    total, hist = sums.total[0], sums.hist
    sigma = scale_error / np.sqrt(max(sums.total[1] / total, 1.0))
    mean, variance = _moments(scales, sums)
    out[:, 0] = mean
    out[:, 1] = np.sqrt(np.maximum(variance, 0.0))
    width = min(sigma * _LOG10_E * PER_DEX, 200.0)
    # what bins of equal density, and sharing between two of them, have added is left out
    width = math.sqrt(max(width * width - _BINNED, 0.0))
    kernel = np.ones(1)
    if width > 0.15:
        reach = math.ceil(4.0 * width)
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
        kernel /= kernel.sum()
    work = np.empty((2, N_BINS + kernel.size))
    n_galaxy, n_agn = len(sums.galaxy), len(sums.agn)
    mean_log = np.empty(len(out))
    row = 0
    for first, log, weight, least, origin in (
        (0, scales.log_galaxy[:-1], sums.galaxy[:, 0].copy(), 1e-6 * total / n_galaxy, 0),
        (n_galaxy, scales.log_agn[:-1], sums.agn[:, 0].copy(), 0.0, 1),
        (n_galaxy + n_agn, np.zeros((1, 1)), np.array([total]), 0.0, 2),
    ):
        rows, these = slice(first, first + weight.size), slice(row, row + len(log))
        # models without light, or any without AGN power, or without either
        dark = sums.total[2] if first == 0 else max(total - hist.table[rows].sum(), 0.0)
        _log_quantiles(
            hist.table[rows], hist.used[rows], log, weight, least, dark, hist.origin[origin], kernel,
            work, levels, mean_log[these], quantiles[these],
        )  # fmt: skip
        row += len(log)
    out[:, 2] = mean_log
    share[0] = sums.total[4] / total
    share[1] = np.sqrt(max(sums.total[5] / total - share[0] ** 2, 0.0))
    share_quantiles[:] = _share_quantiles(hist.share, levels)
