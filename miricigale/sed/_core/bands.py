"""Photon-counting band averages, exact for piecewise linear spectra and passbands."""

import math

import numpy as np

from miricigale.utils.compilation import njit

BUCKETS = 2048  # of equal width in each band, to find a point of its curve without a search


@njit(cache=True)
def band_tables(start, band_wave, throughput):
    """
    What `band_means` needs to know of passbands that are linear between their points.

    ``start``, int, shape (n_band + 1,), is where each band begins in ``band_wave`` and ``throughput``,
    which hold all bands one after the other.

    Returns
    -------
    moments : shape (5, n)
        Integrals of T / lambda and of T from the first point of the band to each point, the
        logarithm of the wavelength, and offset and slope of the curve beyond each point.
    bucket : int, shape (n_band, BUCKETS)
        The last point at or before the lower edge of each bucket.
    """
    out = np.zeros((5, band_wave.size))
    bucket = np.zeros((start.size - 1, BUCKETS), dtype=np.int32)
    for band in range(start.size - 1):
        first = start[band]
        last = start[band + 1] - 1
        for i in range(first, last + 1):
            out[2, i] = math.log(band_wave[i])
        for i in range(first, last):
            rise = (throughput[i + 1] - throughput[i]) / (band_wave[i + 1] - band_wave[i])
            out[3, i] = throughput[i] - rise * band_wave[i]
            out[4, i] = rise
            step = band_wave[i + 1] - band_wave[i]
            first_moment = step * (throughput[i] + 0.5 * rise * step)
            zero = out[3, i] * math.log1p(step / band_wave[i]) + rise * step
            out[0, i + 1] = out[0, i] + zero
            out[1, i + 1] = out[1, i] + first_moment
        width = (band_wave[last] - band_wave[first]) / BUCKETS
        i = first
        for k in range(BUCKETS):
            edge = band_wave[first] + k * width
            while i < last - 1 and band_wave[i + 1] <= edge:
                i += 1
            bucket[band, k] = i
    return out, bucket


@njit(cache=True)
def _moments_at(x, log_x, band, first, last, band_wave, moments, bucket):
    """Integrals of T / lambda and of T from the first point of a band to a wavelength in it."""
    scale = BUCKETS / (band_wave[last] - band_wave[first])
    # one bucket back: the division may round up over an edge
    i = bucket[band, max(min(int((x - band_wave[first]) * scale), BUCKETS) - 1, 0)]
    while i < last - 1 and band_wave[i + 1] <= x:
        i += 1
    step = x - band_wave[i]
    rise = moments[4, i]
    zero = moments[0, i] + moments[3, i] * (log_x - moments[2, i]) + rise * step
    first_moment = moments[1, i] + step * (moments[3, i] + rise * (band_wave[i] + 0.5 * step))
    return zero, first_moment


@njit(cache=True)
def band_means(wave, log_wave, fnu, start, band_wave, moments, bucket, tolerance, out):
    """
    Photon-counting means of F_nu in bands, without making a matrix of weights.

    ``fnu`` is linear between observed wavelengths ``wave`` with logarithms ``log_wave``; ``moments`` and
    ``bucket`` come from `band_tables`. ``tolerance`` is the share of a band that may lie outside the
    spectrum: the mean is that of the rest. ``out``, shape (n_band,), is filled with ``int F T / lambda
    dlambda / int T / lambda dlambda``, exact; NaN where more of a band is not covered.
    """
    n = wave.size
    for band in range(start.size - 1):
        first = start[band]
        last = start[band + 1] - 1
        low = band_wave[first]
        high = band_wave[last]
        if wave[0] >= high or wave[n - 1] <= low:
            out[band] = np.nan
            continue
        scale = BUCKETS / (high - low)
        begin = 0.0
        first_moment = 0.0
        total = 0.0
        j = np.searchsorted(wave, low, side="right") - 1
        if j < 0:
            j = 0
            begin, first_moment = _moments_at(
                wave[0], log_wave[0], band, first, last, band_wave, moments, bucket
            )
        zero = begin
        while True:
            if wave[j + 1] < high:
                # `_moments_at`, whose call for each step would cost more than the step
                right = wave[j + 1]
                log_right = log_wave[j + 1]
                i = bucket[band, max(min(int((right - low) * scale), BUCKETS) - 1, 0)]
                while i < last - 1 and band_wave[i + 1] <= right:
                    i += 1
                step = right - band_wave[i]
                rise = moments[4, i]
                new_zero = moments[0, i] + moments[3, i] * (log_right - moments[2, i]) + rise * step
                at = moments[3, i] + rise * band_wave[i]
                new_one = moments[1, i] + step * (at + 0.5 * rise * step)
            else:
                new_zero = moments[0, last]
                new_one = moments[1, last]
            slope = (fnu[j + 1] - fnu[j]) / (wave[j + 1] - wave[j])
            total += (fnu[j] - slope * wave[j]) * (new_zero - zero) + slope * (
                new_one - first_moment
            )
            zero = new_zero
            first_moment = new_one
            if wave[j + 1] >= high or j == n - 2:
                break
            j += 1
        covered = zero - begin
        enough = covered >= (1.0 - tolerance) * moments[0, last]
        out[band] = total / covered if enough else np.nan
