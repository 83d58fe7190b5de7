"""
Logarithmic histograms, from which the percentiles of derived quantities are read.

Bins are 0.01 dex wide and span 10.24 dex on either side of the quantity at the best model;
what lies beyond is counted in the outermost bins.
"""

import math

import numpy as np
from numba import njit

__all__ = [
    "HALF_BINS",
    "N_BINS",
    "PER_DEX",
    "add_scaled",
    "clear_rows",
    "fill_log10",
    "log_summary",
]

PER_DEX = 100
HALF_BINS = 1024
N_BINS = 2 * HALF_BINS

_OPTIONS = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}

_LN_10 = 2.3025850929940457
_LOG10_E = 0.43429448190325183
_LOG10_2 = 0.30102999566398120
_LOG10_E2 = 0.86858896380650366  # 2 log10(e)
_MANTISSA = np.int64(0x000FFFFFFFFFFFFF)
_HALF_ONE = np.int64(0x3FE0000000000000)
_ROOT_HALF = 0.70710678118654752


@njit(**_OPTIONS)
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


@njit(**_OPTIONS)
def clear_rows(hist, bins):
    """Set the used bins of every row to zero and mark the rows as empty."""
    for i in range(hist.shape[0]):
        for j in range(bins[i, 0], bins[i, 1] + 1):
            hist[i, j] = 0.0
        bins[i, 0] = N_BINS
        bins[i, 1] = -1


@njit(**_OPTIONS)
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
        for j in range(bins[i, 0], bins[i, 1] + 1):
            m = hist[i, j]
            if m > 0.0:
                low = min(max(j + step, 0), N_BINS - 1)
                high = min(max(j + step + 1, 0), N_BINS - 1)
                out[low] += (1.0 - part) * m
                out[high] += part * m
    return shift, zero


@njit(cache=True, nogil=True, error_model="numpy")
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
