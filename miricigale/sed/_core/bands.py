"""Photon-counting band averages of piecewise linear spectra in piecewise linear passbands."""

import itertools

import numpy as np

from miricigale.utils.compilation import njit

#: Cells of equal width that a band is cut into, at least and at most.
MIN_CELLS = 2048
MAX_CELLS = 16384
#: Error of the integrals between the edges of the cells, as a part of those of the whole band. A line of a
#: spectrum that is 1e-4 of the band wide and ten times as bright as its surroundings multiplies it by 1e5.
_ERROR = 1e-11


def band_tables(start, band_wave, throughput):
    """
    Integrals over passbands that are linear between their points, on edges of cells of equal width.

    The mean of a spectrum that is linear between its wavelengths needs one function of the passband T, the
    integral over wavelength of Z = int T / lambda: it is smooth, so that a cubic in each cell gives it where
    the curve itself has many points. Bands get as many cells as their curves ask for.

    Parameters
    ----------
    start : int, shape (n_band + 1,)
        Where each band begins in ``band_wave`` and ``throughput``, which hold all bands one after the other.
    band_wave, throughput : shape (n,)
        Wavelengths in um and throughput.

    Returns
    -------
    span : shape (n_band, 2)
        First and last wavelength of each band.
    edge : int, shape (n_band + 1,)
        Where the edges of the cells of each band begin in ``integrals``.
    integrals : shape (n_edge, 2)
        The integral of Z from the beginning of the band to each edge, and Z there times the width of a cell.
    """
    span = []
    edge = [0]
    integrals = []
    for first, end in itertools.pairwise(start):
        curve = _Curve(band_wave[first:end], throughput[first:end])
        cells = curve.cells()
        integrals.append(cells)
        edge.append(edge[-1] + len(cells))
        span.append((curve.wave[0], curve.wave[-1]))
    return np.array(span), np.array(edge, dtype=np.int64), np.concatenate(integrals)


class _Curve:
    """Integrals of one passband, exact."""

    def __init__(self, wave, throughput):
        self.wave = wave
        step = np.diff(wave)
        self.rise = np.diff(throughput) / step
        self.offset = throughput[:-1] - self.rise * wave[:-1]
        zero = self.offset * np.log1p(step / wave[:-1]) + self.rise * step
        first_moment = step * (throughput[:-1] + 0.5 * self.rise * step)
        self.zero = np.append(0.0, np.cumsum(zero))
        self.first_moment = np.append(0.0, np.cumsum(first_moment))

    def at(self, x):
        """Z, and its integral over wavelength, from the beginning of the band to wavelengths in it."""
        i = np.clip(np.searchsorted(self.wave, x, side="right") - 1, 0, self.rise.size - 1)
        wave = self.wave[i]
        step = x - wave
        zero = self.zero[i] + self.offset[i] * np.log1p(step / wave) + self.rise[i] * step
        moment = step * (self.offset[i] + self.rise[i] * (wave + 0.5 * step))
        return zero, x * zero - (self.first_moment[i] + moment)

    def cells(self):
        """Integrals on the edges of as few cells as are good to `_ERROR` between them, shape (n_edge, 2)."""
        n = MIN_CELLS
        width = self.wave[-1] - self.wave[0]
        parts = np.array([0.25, 0.5, 0.75])
        while True:
            zero, integral = self.at(np.linspace(self.wave[0], self.wave[-1], n + 1))
            out = np.column_stack([integral, zero * (width / n)])
            midpoints = (np.arange(n)[:, None] + parts).ravel()
            _, exact = self.at(self.wave[0] + midpoints * (width / n))
            error = np.abs(_cubic(out, midpoints) - exact).max()
            if n == MAX_CELLS or error <= _ERROR * width * self.zero[-1]:
                return out
            n *= 2


def _cubic(integrals, place):
    """The integral of Z between the edges of one band, at places counted in cells."""
    k = np.minimum(place.astype(int), len(integrals) - 2)
    t = place - k
    value, slope = integrals[k].T
    next_value, next_slope = integrals[k + 1].T
    rise = next_value - value
    bend = 3.0 * rise - 2.0 * slope - next_slope
    twist = slope + next_slope - 2.0 * rise
    return value + t * (slope + t * (bend + t * twist))


@njit()
def _integrals_at(x, low, scale, first, last, integrals):
    """Z, and its integral over wavelength, from the beginning of a band to a wavelength in it."""
    place = (x - low) * scale
    k = max(min(int(place), last - first - 1), 0)
    t = place - k
    value = integrals[first + k, 0]
    slope = integrals[first + k, 1]
    rise = integrals[first + k + 1, 0] - value
    next_slope = integrals[first + k + 1, 1]
    bend = 3.0 * rise - 2.0 * slope - next_slope
    twist = slope + next_slope - 2.0 * rise
    zero = (slope + t * (2.0 * bend + 3.0 * t * twist)) * scale
    return zero, value + t * (slope + t * (bend + t * twist))


@njit(fastmath={"reassoc", "contract"})
def _turns(wave, turn, begin, end, low, scale, first, n_cells, integrals):
    """Sum of the changes of slope at wavelengths ``begin`` to ``end`` inside a band, times the integrals there."""
    total = 0.0
    for j in range(begin, end):
        # as in `_integrals_at`, without Z
        place = (wave[j] - low) * scale
        k = max(min(int(place), n_cells - 1), 0)
        t = place - k
        value = integrals[first + k, 0]
        slope = integrals[first + k, 1]
        rise = integrals[first + k + 1, 0] - value
        twist = slope + integrals[first + k + 1, 1] - 2.0 * rise
        total += turn[j] * (value + t * (slope + t * (rise - slope - twist + t * twist)))
    return total


@njit()
def band_means(wave, fnu, slope, turn, span, edge, integrals, tolerance, out):
    """
    Photon-counting means of F_nu in bands, without making a matrix of weights.

    With Z = int T / lambda and its integral S, ``int F T / lambda dlambda`` of an F with straight pieces is
    the value of F Z - F' S at the end, less that at the beginning, plus S times the change of slope at each
    wavelength between.

    Parameters
    ----------
    wave, fnu : shape (n,)
        Observed wavelengths, and the spectrum, which is linear between them.
    slope, turn : shape (n,)
        Slope of the spectrum beyond each wavelength, and its change there.
    span, edge, integrals
        From `band_tables`.
    tolerance : float
        The share of a band that may lie outside the spectrum: the mean is that of the rest.
    out : shape (n_band,)
        Filled with ``int F T / lambda dlambda / int T / lambda dlambda``; NaN where more of a band is not
        covered.
    """
    n = wave.size
    for band in range(span.shape[0]):
        low = span[band, 0]
        high = span[band, 1]
        if wave[0] >= high or wave[n - 1] <= low:
            out[band] = np.nan
            continue
        first = edge[band]
        last = edge[band + 1] - 1
        scale = (last - first) / (high - low)
        begin = np.searchsorted(wave, low, side="right")
        end = np.searchsorted(wave, high)
        total = 0.0
        covered = 0.0
        if begin == 0:
            zero, integral = _integrals_at(wave[0], low, scale, first, last, integrals)
            total -= fnu[0] * zero - slope[0] * integral
            covered -= zero
            begin = 1
        if end == n:
            zero, integral = _integrals_at(wave[n - 1], low, scale, first, last, integrals)
            total += fnu[n - 1] * zero - slope[n - 2] * integral
            end = n - 1
        else:
            zero = integrals[last, 1] * scale
            at_end = fnu[end - 1] + slope[end - 1] * (high - wave[end - 1])
            total += at_end * zero - slope[end - 1] * integrals[last, 0]
        covered += zero
        if covered < (1.0 - tolerance) * integrals[last, 1] * scale:
            out[band] = np.nan
            continue
        total += _turns(wave, turn, begin, end, low, scale, first, last - first, integrals)
        out[band] = total / covered
