"""Sersic profiles seen through a PSF, with their derivatives, by their transforms."""

import functools

import numpy as np
import scipy.fft
import scipy.interpolate
import scipy.special

from miricigale.utils.compilation import njit

#: Sersic indices that can be fitted.
INDEX_RANGE = (0.4, 6.0)

#: Table of the transform: even in ln(k R_e) and in ln n, with room for cubic pieces at its ends.
_START, _STEP, _NODES = -7.0, 0.05, 320
_INDEX_STEP = 0.1


@functools.cache
def _table():
    """Hankel transforms of Sersic profiles of unit light and radius: ln n by ln(k R_e)."""
    low, high = np.log(INDEX_RANGE)
    indices = np.exp(np.arange(low - 2 * _INDEX_STEP, high + 2.5 * _INDEX_STEP, _INDEX_STEP))
    step = _STEP / 2
    log_r = (np.arange(2048) - 1023.5) * step
    log_k = log_r  # reciprocal grids, centered on 1
    rows = np.empty((len(indices), _NODES))
    at = _START + _STEP * np.arange(_NODES)
    for row, n in zip(rows, indices, strict=True):
        bn = scipy.special.gammaincinv(2 * n, 0.5)
        log_light = 2 * n * np.log(bn) - scipy.special.gammaln(2 * n) + 2 * log_r
        light = np.exp(log_light - bn * np.exp(log_r / n)) / n  # d light / d ln R
        transform = scipy.fft.fht(light * np.exp(-log_r), step, 0.0) * np.exp(-log_k)
        row[:] = scipy.interpolate.CubicSpline(log_k, transform)(at)
    return indices, rows


def _profile(log_index):
    """Transform of one index by ln(k R_e), and its derivative to ln n."""
    indices, rows = _table()
    t = (log_index - np.log(indices[0])) / _INDEX_STEP
    i = int(np.clip(np.floor(t), 1, len(indices) - 3))
    t -= i
    weight = np.array(
        [-t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2,
         -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6]
    )  # fmt: skip
    slope = np.array(
        [-(3 * t * t - 6 * t + 2) / 6, (3 * t * t - 4 * t - 1) / 2,
         -(3 * t * t - 2 * t - 2) / 2, (3 * t * t - 1) / 6]
    )  # fmt: skip
    four = rows[i - 1 : i + 3]
    return weight @ four, slope @ four / _INDEX_STEP


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
def _fill(psf, fy, fx, x, y, log_s, g1, g2, profile, by_index, out):
    """Write the transforms of the unit model and its derivatives into ``out``."""
    eta = np.sqrt(g1 * g1 + g2 * g2)
    if eta < 1e-4:
        ch, sh, bend = 1.0 + 0.5 * eta * eta, 1.0 + eta * eta / 6.0, 1.0 / 3.0
    else:
        ch, sh = np.cosh(eta), np.sinh(eta) / eta
        bend = (ch - sh) / (eta * eta)
    size = np.exp(2.0 * log_s)
    n_out = out.shape[0]
    ex = np.exp(-1j * fx * x)
    for i in range(fy.size):
        ky = fy[i]
        ey = np.exp(-1j * ky * y)
        for j in range(fx.size):
            kx = fx[j]
            k2 = kx * kx + ky * ky
            d = kx * kx - ky * ky
            c = 2.0 * kx * ky
            turn = g1 * d + g2 * c
            form = ch * k2 + sh * turn
            factor = psf[i, j] * ex[j] * ey
            if form * size < 1e-5:
                s, ds, dn = 1.0, 0.0, 0.0
            else:
                s, ds, m, t = _interpolated(profile, form * size)
                dn = by_index[m] + t * (by_index[m + 1] - by_index[m])
            model = factor * s
            out[0, i, j] = model
            if n_out > 1:
                out[1, i, j] = -1j * kx * model
                out[2, i, j] = -1j * ky * model
            if n_out < 7:
                continue
            out[3, i, j] = factor * ds
            out[4, i, j] = factor * dn
            if form > 0.0:
                half = 0.5 * factor * ds / form
                out[5, i, j] = half * (g1 * (sh * k2 + bend * turn) + sh * d)
                out[6, i, j] = half * (g2 * (sh * k2 + bend * turn) + sh * c)
            else:
                out[5, i, j] = 0.0
                out[6, i, j] = 0.0


@njit(cache=True, nogil=True)
def _fill_curves(kx, ky, shapes, profiles, out):
    for s in range(shapes.shape[0]):
        g1, g2 = shapes[s, 2], shapes[s, 3]
        eta = np.sqrt(g1 * g1 + g2 * g2)
        ch = np.cosh(eta)
        sh = np.sinh(eta) / eta if eta > 1e-4 else 1.0
        size = np.exp(2.0 * shapes[s, 0])
        profile = profiles[s]
        for i in range(kx.size):
            x2, y2 = kx[i] * kx[i], ky[i] * ky[i]
            form = ch * (x2 + y2) + sh * (g1 * (x2 - y2) + 2.0 * g2 * kx[i] * ky[i])
            form *= size
            if form < 1e-5:
                out[s, i] = 1.0
                continue
            out[s, i], _, _, _ = _interpolated(profile, form)


def shape_curves(kx, ky, shapes):
    """
    Transforms of centered Sersic profiles of unit light, without a PSF, shape (n, m).

    ``kx`` and ``ky``, (m,), are frequencies in radians per pixel; ``shapes``, (n, 4), the last four parameters
    of `shape_models`.
    """
    out = np.empty((len(shapes), len(kx)))
    profiles = np.array([_profile(one)[0] for one in shapes[:, 1]])
    _fill_curves(kx, ky, shapes, profiles, out)
    return out


def shape_models(psf, size, shape, parameters, *, derivatives=6):
    """
    Sersic profile of unit light through a PSF, and its derivatives.

    Parameters
    ----------
    psf : complex `~numpy.ndarray`, shape (size, size // 2 + 1)
        Transform of the PSF, its center on the first pixel.
    size : int
        Size of the transform; images are periodic on it.
    shape : (int, int)
        Shape of the images returned, a corner of the transform's.
    parameters : sequence of 6 floats
        Center x and y, ln of the circularised half-light radius (pixels), ln of the
        index, and the ellipticity ln(major / minor) (cos 2 theta, sin 2 theta).
    derivatives : {6, 2, 0}, optional
        How many of the derivatives are wanted.

    Returns
    -------
    images : `~numpy.ndarray`, shape (1 + derivatives, *shape)
        The model and its derivatives to the first parameters, in single precision.
    """
    x, y, log_s, log_n, g1, g2 = (float(p) for p in parameters)
    profile, by_index = _profile(log_n)
    fy = 2 * np.pi * np.fft.fftfreq(size)
    fx = 2 * np.pi * np.fft.rfftfreq(size)
    out = np.empty((1 + derivatives, size, size // 2 + 1), np.complex64)
    _fill(psf, fy, fx, x, y, log_s, g1, g2, profile, by_index, out)
    return scipy.fft.irfft2(out, s=(size, size), overwrite_x=True)[:, : shape[0], : shape[1]]
