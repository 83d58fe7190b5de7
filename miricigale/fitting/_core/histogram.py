"""
Histograms, from which the percentiles of derived quantities are read.

Bins are 0.01 dex wide and span 10.24 dex on either side of the quantity at the best model;
what lies beyond is counted in the outermost bins. A fraction has linear bins, in which each
model is spread evenly over its cell.
"""

import math

import numpy as np

from miricigale.fitting._core.options import ENTRY, EXACT, EXACT_ENTRY, INNER
from miricigale.utils.compilation import njit

__all__ = [
    "HALF_BINS",
    "N_BINS",
    "N_SHARE",
    "PER_DEX",
    "POINTS",
    "add_scaled",
    "add_share",
    "clear_rows",
    "fill_log10",
    "log_summary",
    "share_quantiles",
]

PER_DEX = 100
HALF_BINS = 1024
N_BINS = 2 * HALF_BINS
#: Bins of a fraction.
N_SHARE = 4096
#: Models that are put into the histograms at a time.
POINTS = 256


_LN_10 = 2.3025850929940457
# Variance in bins: 1/12 of a bin, and 1/6 of the sharing between neighbours.
_BINNED = 0.25
_LOG10_E = 0.43429448190325183
_LOG10_2 = 0.30102999566398120
_LOG10_E2 = 0.86858896380650366  # 2 log10(e)
_MANTISSA = np.int64(0x000FFFFFFFFFFFFF)
_HALF_ONE = np.int64(0x3FE0000000000000)
_ROOT_HALF = 0.70710678118654752


@njit(**INNER)
def fill_log10(x, work, out, n):
    """
    Fill out[:n] = log10(x[:n]) to 1e-7 for positive normal numbers (x = 0: about -308).

    Parameters
    ----------
    x, out : `~numpy.ndarray`, shape (>= n,)
        Contiguous float64.
    work : `~numpy.ndarray` of int64, shape (>= n,)
        Scratch.
    n : int
        How many.
    """
    bits = x.view(np.int64)
    mantissa = out.view(np.int64)
    for i in range(n):
        # x = m 2^e with m in [0.5, 1)
        work[i] = (bits[i] >> np.int64(52)) - np.int64(1022)
        mantissa[i] = (bits[i] & _MANTISSA) | _HALF_ONE
    for i in range(n):
        m = out[i] / _ROOT_HALF
        t = (m - 1.0) / (m + 1.0)
        t2 = t * t
        s = t * (1.0 + t2 * (1.0 / 3.0 + t2 * (0.2 + t2 * (1.0 / 7.0))))
        out[i] = (np.float64(np.int32(work[i])) - 0.5) * _LOG10_2 + _LOG10_E2 * s


@njit(**ENTRY)
def clear_rows(hist, bins):
    """Set the used bins of every row to zero and mark the rows as empty."""
    for i in range(hist.shape[0]):
        for j in range(bins[i, 0], bins[i, 1] + 1):
            hist[i, j] = 0.0
        bins[i, 0] = N_BINS
        bins[i, 1] = -1


@njit(**INNER)
def add_scaled(hist, bins, scale, weight, least, out):
    """
    Sum rows of histograms of log y to one of log(scale y).

    Parameters
    ----------
    hist : `~numpy.ndarray`, shape (n, N_BINS)
        Histograms of the rows.
    bins : `~numpy.ndarray` of int, shape (n, 2)
        First and last bin in use.
    scale : `~numpy.ndarray`, shape (n,)
        Factor of each row.
    weight : `~numpy.ndarray`, shape (n,)
        Total weight of each row; rows at or below ``least`` are left out.
    least : float
        See above.
    out : `~numpy.ndarray`, shape (N_BINS,)
        The sum is added here.

    Returns
    -------
    shift : float
        log10 of the quantity in the middle bin minus that of the rows.
    zero : float
        Weight of rows whose scale is not positive.
    """
    top = 0.0
    shift = 0.0
    zero = 0.0
    for i in range(hist.shape[0]):
        if scale[i] > 0.0 and weight[i] > top:
            top = weight[i]
            shift = _LOG10_E * math.log(scale[i])
    for i in range(hist.shape[0]):
        if weight[i] <= least or bins[i, 1] < 0:
            continue
        if not scale[i] > 0.0:
            for j in range(bins[i, 0], bins[i, 1] + 1):
                zero += hist[i, j]
            continue
        offset = (_LOG10_E * math.log(scale[i]) - shift) * PER_DEX
        step = math.floor(offset)
        part = offset - step
        first, last = bins[i, 0], bins[i, 1]
        step = min(max(np.int64(step), -2 * N_BINS), 2 * N_BINS)
        # what leaves the histogram is counted in its outermost bins
        low = max(first, -step)
        high = min(last, N_BINS - 2 - step)
        for j in range(first, min(low, last + 1)):
            out[0] += hist[i, j]
        for j in range(max(high + 1, first), last + 1):
            out[N_BINS - 1] += hist[i, j]
        if high < low:
            continue
        row = hist[i, low : high + 1]
        left = out[low + step : high + step + 1]
        for j in range(row.size):
            left[j] += (1.0 - part) * row[j]
        right = out[low + step + 1 : high + step + 2]
        for j in range(row.size):
            right[j] += part * row[j]
    return shift, zero


@njit(**INNER)
def add_share(change, low, high, weight):
    """
    Add a weight that is spread evenly from ``low`` to ``high`` (within 0 and 1).

    Parameters
    ----------
    change : `~numpy.ndarray`, shape (N_SHARE + 2,)
        Changes of slope of the cumulative distribution at the edges of the bins.
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


@njit(**EXACT_ENTRY)
def share_quantiles(change, levels, quantiles):
    """
    Quantiles of a fraction.

    Parameters
    ----------
    change : `~numpy.ndarray`, shape (N_SHARE + 2,)
        From `add_share`.
    levels, quantiles : `~numpy.ndarray`, shape (n,)
        Levels, ascending, in (0, 1); quantiles, filled: NaN if there is no weight.
    """
    total = 0.0
    slope = 0.0
    for j in range(N_SHARE):
        slope += change[j]
        total += slope
    if not total > 0.0:
        quantiles[:] = np.nan
        return
    below = 0.0
    slope = change[0]
    j = 0
    for i in range(levels.size):
        target = levels[i] * total
        while j < N_SHARE - 1 and below + slope < target:
            below += slope
            j += 1
            slope += change[j]
        part = min(max((target - below) / slope, 0.0), 1.0) if slope > 0.0 else 0.0
        quantiles[i] = (j + part) / N_SHARE


@njit(**EXACT)
def log_summary(hist, middle, zero, sigma, levels, quantiles):
    """
    Quantiles and mean logarithm of a quantity from its logarithmic histogram.

    Parameters
    ----------
    hist : `~numpy.ndarray`, shape (N_BINS,)
        Weights; overwritten.
    middle : float
        log10 of the lower edge of bin HALF_BINS.
    zero : float
        Weight of models in which the quantity is zero.
    sigma : float
        Relative error of the scale, by which the histogram is broadened (0: not).
    levels : `~numpy.ndarray`, shape (n,)
        Ascending, in (0, 1).
    quantiles : `~numpy.ndarray`, shape (n,)
        Filled; NaN if there is no weight.

    Returns
    -------
    mean_log : float
        Mean of log10 over the models in which the quantity is not zero.
    """
    first = N_BINS
    last = -1
    total = 0.0
    moment = 0.0
    for j in range(N_BINS):
        if hist[j] > 0.0:
            if last < 0:
                first = j
            last = j
            total += hist[j]
            moment += hist[j] * (j + 0.5)
    all_weight = total + zero
    if not all_weight > 0.0:
        for i in range(levels.size):
            quantiles[i] = np.nan
        return np.nan
    width = min(sigma * 0.43429448190325182 * PER_DEX, 200.0)
    # what bins of equal density, and sharing between two of them, have added is left out
    width = math.sqrt(max(width * width - _BINNED, 0.0))
    if width > 0.15 and last >= 0:
        reach = math.ceil(4.0 * width)
        kernel = np.empty(2 * reach + 1)
        norm = 0.0
        for i in range(2 * reach + 1):
            kernel[i] = math.exp(-0.5 * ((i - reach) / width) ** 2)
            norm += kernel[i]
        new_first = max(first - reach, 0)
        new_last = min(last + reach, N_BINS - 1)
        smooth = np.zeros(N_BINS)
        for j in range(first, last + 1):
            m = hist[j] / norm
            if m > 0.0:
                for i in range(2 * reach + 1):
                    smooth[min(max(j + i - reach, 0), N_BINS - 1)] += m * kernel[i]
        for j in range(new_first, new_last + 1):
            hist[j] = smooth[j]
        first = new_first
        last = new_last
    j = first
    below = zero
    for i in range(levels.size):
        target = levels[i] * all_weight
        if target <= zero or last < 0:
            quantiles[i] = 0.0
            continue
        while j < last and below + hist[j] < target:
            below += hist[j]
            j += 1
        part = (target - below) / hist[j] if hist[j] > 0.0 else 0.5
        part = min(max(part, 0.0), 1.0)
        quantiles[i] = math.exp(_LN_10 * (middle + (j - HALF_BINS + part) / PER_DEX))
    if last < 0:
        return np.nan
    return middle + (moment / total - HALF_BINS) / PER_DEX
