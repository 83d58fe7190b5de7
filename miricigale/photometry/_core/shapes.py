"""Sersic profiles seen through a PSF, with their derivatives, by their transforms."""

import functools

import numpy as np
import scipy.fft
import scipy.interpolate
import scipy.special

from miricigale.utils.compilation import njit

#: Sersic indices that can be fitted.
INDEX_RANGE = (0.4, 6.0)

#: Table of the transform: even in ln(k R_e) and in ln n.
_START, _STEP, _NODES = -7.0, 0.05, 320
_INDEX_STEP = 0.1


@functools.cache
def _table():
    """Spline in ln n of the Hankel transforms, by ln(k R_e), of Sersic profiles of unit light and radius."""
    low, high = np.log(INDEX_RANGE)
    log_n = np.arange(low - 2 * _INDEX_STEP, high + 2.5 * _INDEX_STEP, _INDEX_STEP)
    step = _STEP / 2
    log_r = (np.arange(2048) - 1023.5) * step
    log_k = log_r  # reciprocal grids, centered on 1
    rows = np.empty((len(log_n), _NODES))
    at = _START + _STEP * np.arange(_NODES)
    for row, n in zip(rows, np.exp(log_n), strict=True):
        bn = scipy.special.gammaincinv(2 * n, 0.5)
        log_light = 2 * n * np.log(bn) - scipy.special.gammaln(2 * n) + 2 * log_r
        light = np.exp(log_light - bn * np.exp(log_r / n)) / n  # d light / d ln R
        transform = scipy.fft.fht(light * np.exp(-log_r), step, 0.0) * np.exp(-log_k)
        row[:] = scipy.interpolate.CubicSpline(log_k, transform)(at)
    return scipy.interpolate.CubicSpline(log_n, rows)


@njit(cache=True, nogil=True)
def _interpolated(profile, form):
    """Value of a profile at the square of k R_e, its derivative to ln(k R_e), and the place in the table."""
    t = (0.5 * np.log(form) - _START) / _STEP
    t = min(max(t, 1.0), profile.size - 3.0)
    m = int(t)
    t -= m
    a, b, e, f = profile[m - 1], profile[m], profile[m + 1], profile[m + 2]
    c1 = 0.5 * (e - a)
    c2 = a - 2.5 * b + 2.0 * e - 0.5 * f
    c3 = 0.5 * (f - a) + 1.5 * (b - e)
    slope = (c1 + t * (2.0 * c2 + 3.0 * t * c3)) / _STEP
    return b + t * (c1 + t * (c2 + t * c3)), slope, m, t


@njit(cache=True, nogil=True)
def _fill(kx, ky, shapes, profiles, by_index, out):
    """Write the transforms of unit models and, where ``out`` has room for them, their derivatives."""
    for s in range(shapes.shape[0]):
        g1, g2 = shapes[s, 2], shapes[s, 3]
        eta = np.sqrt(g1 * g1 + g2 * g2)
        ch, sh, bend = 1.0 + 0.5 * eta * eta, 1.0 + eta * eta / 6.0, 1.0 / 3.0
        if eta > 1e-4:
            ch, sh = np.cosh(eta), np.sinh(eta) / eta
            bend = (ch - sh) / (eta * eta)
        size = np.exp(2.0 * shapes[s, 0])
        profile, of_index = profiles[s], by_index[s]
        for i in range(kx.size):
            x2, y2 = kx[i] * kx[i], ky[i] * ky[i]
            k2, d, c = x2 + y2, x2 - y2, 2.0 * kx[i] * ky[i]
            turn = g1 * d + g2 * c
            form = ch * k2 + sh * turn
            if form * size < 1e-5:
                out[s, :, i] = 0.0
                out[s, 0, i] = 1.0
                continue
            value, slope, m, t = _interpolated(profile, form * size)
            out[s, 0, i] = value
            if out.shape[1] > 1:
                half, bent = 0.5 * slope / form, sh * k2 + bend * turn
                out[s, 1, i] = slope
                out[s, 2, i] = of_index[m] + t * (of_index[m + 1] - of_index[m])
                out[s, 3, i] = half * (g1 * bent + sh * d)
                out[s, 4, i] = half * (g2 * bent + sh * c)


def shape_curves(kx, ky, shapes, *, derivatives=False):
    """
    Transforms of centered Sersic profiles of unit light, without a PSF.

    Parameters
    ----------
    kx, ky : `~numpy.ndarray`, shape (m,)
        Frequencies in radians per pixel.
    shapes : `~numpy.ndarray`, shape (n, 4)
        Ln of the circularised half-light radius (pixels), ln of the index, and the ellipticity ln(major /
        minor) (cos 2 theta, sin 2 theta).
    derivatives : bool, optional
        Whether the derivatives to these four are wanted.

    Returns
    -------
    curves : `~numpy.ndarray`, shape (n, m), or (n, 5, m) with derivatives
    """
    out = np.empty((len(shapes), 5 if derivatives else 1, len(kx)))
    spline = _table()
    _fill(kx, ky, shapes, spline(shapes[:, 1]), spline(shapes[:, 1], 1), out)
    return out if derivatives else out[:, 0]
