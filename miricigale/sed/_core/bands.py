"""Photon-counting band averages, exact for piecewise linear spectra and passbands."""

import math

import numpy as np
from numba import njit

__all__ = ["band_means", "band_moments"]


@njit(cache=True)
def band_moments(start, band_wave, throughput):
    """
    Running integrals of passbands, linear between their points, in closed form.

    Parameters
    ----------
    start : `~numpy.ndarray` of int, shape (n_band + 1,)
        Where each band begins in the next two, which hold all bands one after the other.
    band_wave, throughput : `~numpy.ndarray`, shape (n,)
        Wavelengths and throughputs.

    Returns
    -------
    moments : `~numpy.ndarray`, shape (2, n)
        Integrals of T / lambda and of T from the first point of the band to each point.
    """
    out = np.zeros((2, band_wave.size))
    for band in range(start.size - 1):
        for i in range(start[band], start[band + 1] - 1):
            zero, one = _piece(band_wave, throughput, i, band_wave[i + 1])
            out[0, i + 1] = out[0, i] + zero
            out[1, i + 1] = out[1, i] + one
    return out


@njit(cache=True)
def _piece(wave, throughput, i, x):
    """Integrals of T / lambda and T from the point i to x on the piece that follows it."""
    step = x - wave[i]
    rise = (throughput[i + 1] - throughput[i]) / (wave[i + 1] - wave[i])
    one = step * (throughput[i] + 0.5 * rise * step)
    zero = (throughput[i] - rise * wave[i]) * math.log1p(step / wave[i]) + rise * step
    return zero, one


@njit(cache=True)
def band_means(wave, fnu, start, band_wave, throughput, moments):
    """
    Photon-counting means of F_nu in bands, without making a matrix of weights.

    Parameters
    ----------
    wave, fnu : `~numpy.ndarray`, shape (n_wave,)
        Observed wavelengths and a spectrum linear between them; it covers the bands.
    start, band_wave, throughput : `~numpy.ndarray`
        Passbands as for `band_moments`.
    moments : `~numpy.ndarray`, shape (2, n)
        Their `band_moments`.

    Returns
    -------
    means : `~numpy.ndarray`, shape (n_band,)
        ``int F T / lambda dlambda / int T / lambda dlambda``, exact.
    """
    out = np.empty(start.size - 1)
    for band in range(start.size - 1):
        first, last = start[band], start[band + 1] - 1
        low, high = band_wave[first], band_wave[last]
        j = np.searchsorted(wave, low, side="right") - 1
        j = min(max(j, 0), wave.size - 2)
        i, zero, one, total = first, 0.0, 0.0, 0.0
        while True:
            right = min(high, wave[j + 1])
            i += np.searchsorted(band_wave[i:last], right, side="right") - 1
            new_zero, new_one = _piece(band_wave, throughput, i, right)
            new_zero += moments[0, i]
            new_one += moments[1, i]
            slope = (fnu[j + 1] - fnu[j]) / (wave[j + 1] - wave[j])
            total += (fnu[j] - slope * wave[j]) * (new_zero - zero) + slope * (new_one - one)
            zero, one = new_zero, new_one
            if right >= high or j == wave.size - 2:
                break
            j += 1
        out[band] = total / moments[0, last]
    return out
