"""
Histograms, from which the percentiles of derived quantities are read, and their moments.

Bins are 0.01 dex wide and span 10.24 dex on either side of the quantity at the best model;
what lies beyond is counted in the outermost bins. A fraction has linear bins, in which each
model is spread evenly over its cell.
"""

import math

import numpy as np

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.structs import Scales
from miricigale.utils._core.functions import log10
from miricigale.utils.compilation import KERNEL, PART, njit

PER_DEX = 100
N_BINS = 2048
#: Bins of a fraction.
N_SHARE = 4096

_HALF = N_BINS // 2
# Variance in bins: 1/12 of a bin, and 1/6 of the sharing between neighbors.
_BINNED = 0.25
# Largest width of the kernel of scales in bins, and numbers that it has then.
_WIDEST = 200.0
KERNEL_SIZE = 1601
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
    hist.span[row, 0] = min(hist.span[row, 0], column)
    hist.span[row, 1] = max(hist.span[row, 1], column + 1)


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
    of_galaxy = tables.of_galaxy
    of_agn = tables.of_agn
    of_frac = tables.of_frac
    # what is spread over the cell of f = 0 need not be as many pieces as there are AGN models
    y = tables.share_mean
    low = 0.0
    high = tables.edge_zero
    power = 0.0
    if k >= 0:
        y = of_agn[at.SHARE_AGN, k]
        low = of_frac[at.EDGE_LOW, j]
        high = of_frac[at.EDGE_HIGH, j]
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
def clear_rows(table, span):
    """Set the used bins of every row to zero and mark the rows as empty."""
    for i in range(span.shape[0]):
        table[i, span[i, 0] : span[i, 1] + 1] = 0.0
        span[i, 0] = N_BINS
        span[i, 1] = -1


@njit(**{**KERNEL, "fastmath": False})
def _log_quantiles(hists, row, log, weight, min_weight, zero, width, levels, origin, quantiles):
    """
    Mean logarithm and quantiles of a quantity.

    ``log`` is log10 of its scale in the n rows of the table from ``row`` on, `NO_SCALE` where it is 0; rows of
    less weight (shape (n, ...), the first column) than ``least`` are left out. ``zero`` is the weight of models in
    which the quantity is zero, ``origin`` log10 of the rows' middle bins, ``width`` half of that of the kernel in
    the third row of ``Histograms.work``, by which histograms are broadened; its first two rows are zeros, and are
    again when this returns. ``quantiles`` are filled; NaN where there is no weight.
    """
    hist = hists.work[0]
    wide = hists.work[1]
    kernel = hists.work[2]
    table = hists.table[row:]
    span = hists.span[row:]
    low = np.int64(N_BINS)
    high = np.int64(0)
    top = 0.0
    middle = 0.0
    for i in range(len(weight)):
        if log[i] > NO_SCALE and weight[i, 0] > top:
            top = weight[i, 0]
            middle = log[i]
    nothing = zero
    for i in range(len(weight)):
        first = span[i, 0]
        last = span[i, 1]
        if weight[i, 0] <= min_weight or last < 0:
            continue
        if log[i] <= NO_SCALE:
            for j in range(first, last + 1):
                nothing += table[i, j]
            continue
        offset = (log[i] - middle) * PER_DEX
        step = math.floor(offset)
        part = offset - step
        step = min(max(np.int64(step), -2 * N_BINS), 2 * N_BINS)
        low = min(low, max(first + step, 0))
        high = max(high, min(last + step + 2, N_BINS))
        # what leaves the histogram is counted in its outermost bins
        for j in range(first, last + 1):
            column = min(max(j + step, 0), N_BINS - 1)
            hist[column] += (1.0 - part) * table[i, j]
            hist[min(max(j + step + 1, 0), N_BINS - 1)] += part * table[i, j]
    total = 0.0
    moment = 0.0
    for j in range(low, high):
        total += hist[j]
        moment += hist[j] * (j + 0.5)
        if hist[j] > 0.0:
            for i in range(2 * width + 1):
                wide[j + i] += hist[j] * kernel[i]
    for j in range(low, width):
        wide[width] += wide[j]
    for j in range(N_BINS + width, high + 2 * width):
        wide[width + N_BINS - 1] += wide[j]
    middle += origin
    _places(
        wide[width:], max(low - width, 0), N_BINS - 1, nothing, total + nothing, levels, quantiles
    )
    for i in range(levels.size):
        quantiles[i] = 10.0 ** (middle + (quantiles[i] - _HALF) / PER_DEX)
        if levels[i] * (total + nothing) <= nothing or total == 0.0:
            quantiles[i] = np.nan
            if total + nothing > 0.0:
                quantiles[i] = 0.0
    hist[low:high] = 0.0
    wide[low : high + 2 * width] = 0.0
    if total > 0.0:
        return middle + (moment / total - _HALF) / PER_DEX
    return np.nan


@njit(**{**PART, "fastmath": False})
def _places(bins, first, last, start, total, levels, out):
    """
    Fill the places, in bins, at which a distribution that is even within each bin reaches levels of the total.

    Weights from the ``first`` to the ``last`` bin are looked at, and ``start`` lies below them.
    """
    j = first
    weight_below = start
    for i in range(levels.size):
        target = levels[i] * total
        if target <= weight_below:
            j = first
            weight_below = start
        while j < last and weight_below + bins[j] < target:
            weight_below += bins[j]
            j += 1
        out[i] = j + (
            min(max((target - weight_below) / bins[j], 0.0), 1.0) if bins[j] > 0.0 else 0.0
        )


@njit(**{**KERNEL, "fastmath": False})
def percentile_places(pdf, levels, out):
    """Fill `_places` of the rows of a table (m, n), of levels (k,) in any order: (m, k)."""
    for row in range(pdf.shape[0]):
        total = 0.0
        for i in range(pdf.shape[1]):
            total += pdf[row, i]
        _places(pdf[row], 0, pdf.shape[1] - 1, 0.0, total, levels, out[row])


def make_scales(galaxy, agn):
    """Bundle derived quantities, as `Scales` has them."""
    logs = [
        np.log10(scale, where=scale > 0, out=np.full(scale.shape, NO_SCALE))
        for scale in (galaxy, agn)
    ]
    return Scales(galaxy, agn, *logs)


@njit(**KERNEL)
def _moments(scales, sums, out):
    """Fill means and standard deviations, scales' own variances included, of the derived quantities: (n, 2)."""
    total = sums.total[0]
    n = len(scales.galaxy) - 1
    m = len(scales.agn) - 1
    for i in range(n + m + 1):
        first = 0.0
        second = 0.0
        n_galaxy = 0
        n_agn = 0
        if i == n + m:
            # twice the product of the galaxy's and the AGN's part
            second = 2.0 * sums.total[3]
        if i < n or i == n + m:
            n_galaxy = scales.galaxy.shape[1]
        if i >= n:
            n_agn = scales.agn.shape[1]
        for g in range(n_galaxy):
            x = scales.galaxy[min(i, n), g]
            first += x * sums.galaxy[g, 1]
            second += x * x * sums.galaxy[g, 2]
        for k in range(n_agn):
            x = scales.agn[i - n, k]
            first += x * sums.agn[k, 1]
            second += x * x * sums.agn[k, 2]
        out[i, 0] = first / total
        out[i, 1] = math.sqrt(max(second / total - out[i, 0] ** 2, 0.0))


def widest(scales, sums):
    """Squares of quantities over their variance so far, the largest of each galaxy and AGN model."""
    n = len(scales.galaxy) - 1
    out = np.empty((n + len(scales.agn), 2))
    _moments(scales, sums, out)
    mean, std = out.T
    part = 1e-6 * mean
    part[n:-1] = _FAINT * mean[-1]
    value = np.square(np.maximum(std, part))
    # of what is the same for all models, in numbers too small to square, nothing is asked
    inverse = np.divide(1.0, value, where=value > 1e-290, out=np.zeros(value.size))
    of_galaxy = np.append(inverse[:n], inverse[-1])
    galaxy = np.max(np.square(scales.galaxy) * of_galaxy[:, None], axis=0)
    return galaxy, np.max(np.square(scales.agn) * inverse[n:, None], axis=0)


@njit(**{**KERNEL, "fastmath": False})
def summarize(scales, sums, scale_error, levels, out, quantiles):
    """
    Fill moments and quantiles of all derived quantities of one object.

    The order is the galaxy's quantities, the AGN model's, then the one of both; ``out`` has means,
    standard deviations and means of log10 in its rows.
    """
    total = sums.total[0]
    hist = sums.hist
    kernel = sums.hist.work[2]
    n = len(scales.galaxy) - 1
    m = len(scales.agn) - 1
    ng = len(sums.galaxy)
    na = len(sums.agn)
    _moments(scales, sums, out)
    sigma = scale_error / math.sqrt(max(sums.total[1] / total, 1.0))
    width = min(sigma * _LOG10_E * PER_DEX, _WIDEST)
    # what bins of equal density, and sharing between two of them, have added is left out
    width = math.sqrt(max(width * width - _BINNED, 0.0))
    reach = np.int64(0)
    if width > 0.15:
        reach = np.int64(math.ceil(4.0 * width))
    norm = 0.0
    for i in range(2 * reach + 1):
        kernel[i] = math.exp(-0.5 * ((i - reach) / max(width, 0.15)) ** 2)
        norm += kernel[i]
    for i in range(2 * reach + 1):
        kernel[i] /= norm
    # models without light, or any without AGN power, or without either
    dark = sums.total[2]
    min_weight = 1e-6 * total / ng
    no_power = _without(hist, ng, ng + na, total)
    neither = _without(hist, ng + na, ng + na + 1, total)
    for i in range(n):
        arguments = hist, 0, scales.log_galaxy[i], sums.galaxy, min_weight, dark, reach, levels
        out[i, 2] = _log_quantiles(*arguments, hist.origin[0], quantiles[i])
    for i in range(m):
        arguments = hist, ng, scales.log_agn[i], sums.agn, 0.0, no_power, reach, levels
        out[n + i, 2] = _log_quantiles(*arguments, hist.origin[1], quantiles[n + i])
    hist.work[3, 0] = total
    arguments = hist, ng + na, hist.work[4], hist.work[3:4], 0.0, neither, reach, levels
    out[n + m, 2] = _log_quantiles(*arguments, hist.origin[2], quantiles[n + m])


@njit(**PART)
def _without(hist, first, end, total):
    """Weight that is not in these rows of the histograms."""
    for i in range(first, end):
        for j in range(hist.span[i, 0], hist.span[i, 1] + 1):
            total -= hist.table[i, j]
    return max(total, 0.0)
