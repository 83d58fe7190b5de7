"""Sersic profiles seen through a PSF, with their derivatives, by their transforms."""

import numpy as np
import scipy.fft
import scipy.interpolate
import scipy.special

from miricigale.utils.caching import cached
from miricigale.utils.compilation import njit

#: Sersic indices that can be fitted.
INDEX_RANGE = (0.4, 6.0)

#: Table of the transform: even in the fourth root of k R_e, from 0, and in ln n, from below the range.
STEP = 0.0125
_NODES = 460
_INDEX_STEP = 0.1
_FIRST = np.log(INDEX_RANGE[0]) - 2 * _INDEX_STEP

#: What the compiler may do with sums: nothing here is infinite or no number.
FAST = {"reassoc", "contract", "nsz"}

#: Ln(k R_e) below which all light is seen as one point.
_POINT = -9.0


@cached
def profile_table():
    """
    Return the transforms of Sersic profiles of unit light and radius, for the kernels.

    Returns
    -------
    table : `~numpy.ndarray`, shape (4, m, nodes)
        Coefficients of a cubic spline in ln n of the Hankel transforms, at nodes that are even in the fourth
        root of k R_e.
    """
    log_n = np.arange(_FIRST, np.log(INDEX_RANGE[1]) + 2.5 * _INDEX_STEP, _INDEX_STEP)
    step = 0.025
    log_r = (np.arange(2048) - 1023.5) * step
    log_k = log_r  # reciprocal grids, centered on 1
    rows = np.ones((len(log_n), _NODES))
    at = 4 * np.log(np.maximum(STEP * np.arange(_NODES), np.exp(_POINT / 4)))
    for row, n in zip(rows, np.exp(log_n), strict=True):
        # b_n of the profile, by which R_e holds half of the light
        bn = scipy.special.gammaincinv(2 * n, 0.5)
        log_light = 2 * n * np.log(bn) - scipy.special.gammaln(2 * n) + 2 * log_r
        light = np.exp(log_light - bn * np.exp(log_r / n)) / n  # d light / d ln R
        # the Hankel transform on a logarithmic grid
        transform = scipy.fft.fht(light * np.exp(-log_r), step, 0.0) * np.exp(-log_k)
        row[:] = np.where(at > _POINT, scipy.interpolate.CubicSpline(log_k, transform)(at), 1.0)
    return scipy.interpolate.CubicSpline(log_n, rows).c


@njit()
def profile_of(table, log_n):
    """Return the transform of one index at the nodes, and its derivative to ln n."""
    # the interval of the spline in ln n
    place = (log_n - _FIRST) / _INDEX_STEP
    m = min(max(int(place), 0), table.shape[1] - 1)
    t = _INDEX_STEP * (place - m)
    profile = np.empty((2, table.shape[2]), np.float32)
    for i in range(table.shape[2]):
        a = table[0, m, i]
        b = table[1, m, i]
        c = table[2, m, i]
        d = table[3, m, i]
        profile[0, i] = d + t * (c + t * (b + t * a))
        profile[1, i] = c + t * (2.0 * b + 3.0 * t * a)
    return profile


@njit(fastmath=FAST, forceinline=True)
def _cubic(profile, place):
    """Return the node below a place, the distance from it, and coefficients of the cubic through four nodes."""
    m = np.uint32(max(np.int32(place), np.int32(1)))
    a = profile[m - np.uint32(1)]
    b = profile[m]
    e = profile[m + np.uint32(1)]
    f = profile[m + np.uint32(2)]
    half = np.float32(0.5)
    # Catmull-Rom
    c1 = half * (e - a)
    c2 = a - np.float32(2.5) * b + (e + e) - half * f
    c3 = half * (f - a) + np.float32(1.5) * (b - e)
    return m, place - np.float32(m), c1, c2, c3


@njit(fastmath=FAST, forceinline=True)
def fill_curves(kx, ky, shape, profile, out):
    """
    Write the transform of a centered Sersic profile of unit light, and its derivatives.

    Parameters
    ----------
    kx, ky : float32 `~numpy.ndarray`, shape (m,)
        Frequencies in radians per pixel.
    shape : `~numpy.ndarray`, shape (4,)
        As for `shape_curves`.
    profile : `~numpy.ndarray`
        As from `profile_of`.
    out : float32 `~numpy.ndarray`, shape (1, m) or (5, m)
        For the profile, or also for its derivatives to the four.
    """
    changes = len(out) > 1
    g1 = np.float32(shape[2])
    g2 = np.float32(shape[3])
    eta = np.sqrt(shape[2] ** 2 + shape[3] ** 2)
    ch = 1.0 + 0.5 * eta * eta
    sh = 1.0 + eta * eta / 6.0
    bend = 1.0 / 3.0
    if eta > 1e-4:
        ch = np.cosh(eta)
        sh = np.sinh(eta) / eta
        bend = (ch - sh) / (eta * eta)
    ch = np.float32(ch)
    sh = np.float32(sh)
    bend = np.float32(bend)
    size = np.float32(np.exp(2.0 * shape[0]))
    light = out[0]
    last = np.float32(_NODES - 2.5)
    scale = np.float32(1.0 / STEP)
    # numbers of the language are of double precision, and so would be all that they are multiplied with
    zero = np.float32(0.0)
    half = np.float32(0.5)
    # a loop without branches, which the compiler turns into vector instructions
    for i in range(kx.size):
        x = kx[i]
        y = ky[i]
        form = ch * (x * x + y * y) + sh * (g1 * (x * x - y * y) + g2 * (x * y + x * y))
        # rounded it may be below zero
        place = np.sqrt(np.sqrt(np.sqrt(max(form, zero) * size)))
        light[i] = min(place * scale, last)
    if not changes:
        for i in range(kx.size):
            m, t, c1, c2, c3 = _cubic(profile[0], light[i])
            light[i] = profile[0, m] + t * (c1 + t * (c2 + t * c3))
        return
    for i in range(kx.size):
        place = light[i]
        m, t, c1, c2, c3 = _cubic(profile[0], place)
        light[i] = profile[0, m] + t * (c1 + t * (c2 + t * c3))
        # the derivative to ln(k R_e)
        slope = c1 + t * (c2 + c2 + np.float32(3.0) * t * c3)
        slope *= np.float32(0.25) * place
        x = kx[i]
        y = ky[i]
        # derivatives to the two ellipticities, by those of (k R_e)^2
        k2 = x * x + y * y
        d = x * x - y * y
        c = x * y + x * y
        turn = g1 * d + g2 * c
        ratio = half * slope / max(ch * k2 + sh * turn, np.float32(1e-30))
        bent = sh * k2 + bend * turn
        out[1, i] = slope
        out[2, i] = profile[1, m] + t * (profile[1, m + np.uint32(1)] - profile[1, m])
        out[3, i] = ratio * (g1 * bent + sh * d)
        out[4, i] = ratio * (g2 * bent + sh * c)


def shape_curves(kx, ky, shapes):
    """
    Return the transforms of centered Sersic profiles of unit light, without a PSF.

    Parameters
    ----------
    kx, ky : `~numpy.ndarray`, shape (m,)
        Frequencies in radians per pixel.
    shapes : `~numpy.ndarray`, shape (n, 4)
        Ln of the circularised half-light radius (pixels), ln of the index, and the ellipticity ln(major /
        minor) (cos 2 theta, sin 2 theta).

    Returns
    -------
    curves : `~numpy.ndarray`, shape (n, m)
    """
    out = np.empty((len(shapes), 1, len(kx)), np.float32)
    _fill_all(kx.astype(np.float32), ky.astype(np.float32), shapes, profile_table(), out)
    return out[:, 0]


@njit()
def _fill_all(kx, ky, shapes, table, out):
    """Write the transforms of shapes, (n, 4), into an array, (n, 1, m)."""
    for i in range(len(shapes)):
        fill_curves(kx, ky, shapes[i], profile_of(table, shapes[i, 1]), out[i])
