"""Mean transmission of the intergalactic medium; observed wavelengths in um."""

import functools
import math

import numpy as np
from numba import njit

__all__ = ["LYMAN_LIMIT", "lyman_lines", "madau_transmission", "meiksin_transmission"]

LYMAN_LIMIT = 0.0912  # um, the rounded value that the conventions use
_FACTORS = np.array([0.0, 0.0, 1.0, 0.348, 0.179, 0.109, 0.0722, 0.0508, 0.0373, 0.0283])


def lyman_lines(n_max=31):
    """Wavelengths in um of the lines n -> 1, n = 2 ... n_max - 1."""
    n = np.arange(2, n_max)
    return LYMAN_LIMIT / (1.0 - 1.0 / n**2)


@functools.cache
def _lls_terms():
    factorial = [math.factorial(n) for n in range(10)]
    first = 0.2788 - math.exp(-1.0)
    first -= sum((-1.0) ** n / (factorial[n] * (2 * n - 1)) for n in range(9))
    series = [2.0 * (-1.0) ** n / (factorial[n] * (6 * n - 5) * (2 * n - 1)) for n in range(1, 10)]
    return first, np.array(series)


def meiksin_transmission(wave, redshift):
    """
    Mean transmission of the intergalactic medium, Meiksin 2006, as CIGALE has it.

    Parameters
    ----------
    wave : `~numpy.ndarray`
        Observed wavelength in um.
    redshift : float
        Redshift of the source.

    Notes
    -----
    The optical depths of the higher lines are those of Table 1 times the Lyman-alpha depth
    at the source's redshift (CIGALE's reading; it absorbs a little more than the depth at
    the absorber's would). Below 0.07 (1 + z) um the transmission falls as wavelength squared.
    """
    first, series = _lls_terms()
    return _meiksin(np.asarray(wave, dtype=float), float(redshift), first, series, _FACTORS)


@njit(cache=True)
def _meiksin(wave, redshift, first, series, factors):
    out = np.ones(wave.size)
    z1 = 1.0 + redshift
    if redshift <= 4.0:
        amplitude, power = 0.00211, 3.7
    else:
        amplitude, power = 0.00058, 4.5
    tau_alpha = amplitude * z1**power
    for i in range(wave.size):
        w = wave[i]
        if w >= z1 * 0.0912 / 0.75:
            continue
        tau = 0.0
        nine = factors[9] * tau_alpha * (0.25 * w / 0.0912 * (1.0 - 1.0 / 81.0)) ** (1.0 / 3.0)
        for n in range(2, 31):
            x = w / 0.0912 * (1.0 - 1.0 / (n * n))  # 1 + z of the absorber
            if x >= z1:
                continue
            if n == 2:
                tau += amplitude * x**power
            elif n <= 5:
                exponent = 1.0 / 3.0 if x < 4.0 else 1.0 / 6.0
                tau += tau_alpha * factors[n] * (0.25 * x) ** exponent
            elif n <= 9:
                tau += tau_alpha * factors[n] * (0.25 * x) ** (1.0 / 3.0)
            else:
                tau += nine * 720.0 / (n * (n * n - 1.0))
        limit = w / 0.0912
        if limit < z1:
            tau += 0.805 * limit**3 * (1.0 / limit - 1.0 / z1)
            lls = first * (z1 * limit**1.5 - limit**2.5)
            for k in range(series.size):
                n = k + 1
                lls -= series[k] * (z1 ** (2.5 - 3 * n) * limit ** (3 * n) - limit**2.5)
            tau += 0.25 * lls
        out[i] = math.exp(-tau)
        if w < 0.07 * z1:
            out[i] *= (w / (0.07 * z1)) ** 2
    return out


def madau_transmission(wave, redshift):
    """Mean transmission after Madau 1995: four lines and the continuum (footnote 3)."""
    wave = np.asarray(wave, dtype=float)
    z1 = 1.0 + redshift
    tau = np.zeros(wave.shape)
    lines = ((2, 0.0036), (3, 1.7e-3), (4, 1.2e-3), (5, 9.3e-4))
    for n, amplitude in lines:
        line = LYMAN_LIMIT / (1.0 - 1.0 / n**2)
        tau += np.where(wave < line * z1, amplitude * (wave / line) ** 3.46, 0.0)
    x = wave / LYMAN_LIMIT
    inside = x < z1
    x = np.where(inside, np.maximum(x, 1e-6), z1)
    continuum = (
        0.25 * x**3 * (z1**0.46 - x**0.46)
        + 9.4 * x**1.5 * (z1**0.18 - x**0.18)
        - 0.7 * x**3 * (x**-1.32 - z1**-1.32)
        - 0.023 * (z1**1.68 - x**1.68)
    )
    return np.exp(-tau - np.where(inside, np.maximum(continuum, 0.0), 0.0))
