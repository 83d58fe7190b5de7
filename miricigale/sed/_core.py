"""Arithmetic of spectra: arrays in, arrays out (um, W/um, Myr unless said)."""

import functools
import math

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix

__all__ = [
    "attenuation_curve",
    "band_means",
    "band_moments",
    "delayed_history",
    "disk_spectrum",
    "hat_matrix",
    "leitherer_calzetti",
    "lyman_lines",
    "madau_transmission",
    "meiksin_transmission",
    "merge_nodes",
    "modified_blackbody",
    "planck_lambda",
    "time_weights",
]

LIGHT = 2.99792458e14  # um / s
PLANCK_K = 14387.768775  # h c / k in um K
LYMAN_LIMIT = 0.0912  # um, the rounded value that the conventions use
YOUNG = 10  # Myr


def merge_nodes(parts):
    """Sorted union of wavelengths; values closer than 1e-7 of themselves are one."""
    nodes = np.unique(np.concatenate([np.asarray(p, dtype=float) for p in parts]))
    keep = np.append(True, np.diff(nodes) > 1e-7 * nodes[1:])
    return nodes[keep]


def hat_matrix(nodes, wave):
    """Sparse matrix that interpolates linearly from nodes to wavelengths, 0 outside."""
    cell = np.clip(np.searchsorted(nodes, wave, side="right") - 1, 0, nodes.size - 2)
    t = (wave - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
    inside = (t >= 0) & (t <= 1)
    row = np.flatnonzero(inside)
    cell, t = cell[inside], t[inside]
    data = np.concatenate([1 - t, t])
    index = (np.concatenate([row, row]), np.concatenate([cell, cell + 1]))
    return csr_matrix((data, index), shape=(wave.size, nodes.size))


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


# ---------------------------------------------------------------- star formation


def delayed_history(age, tau, f_burst=0.0, age_burst=20.0, tau_burst=50.0):
    """
    Star-formation rate in steps of 1 Myr.

    ``t exp(-t / tau) / tau^2`` for t = 0 ... age - 1, and an exponential burst in the last
    ``age_burst`` steps that makes the fraction ``f_burst`` of all stars. The sum is 1e-6,
    so that one solar mass is formed by rates in Msun/yr. ``age`` is a whole number.
    """
    t = np.arange(int(age), dtype=float)
    rate = t * np.exp(-t / tau) / tau**2
    if t.size == 1:
        rate[:] = 1.0
    if f_burst > 0.0:
        n = min(int(age_burst), t.size)
        burst = np.exp(-np.arange(n) / tau_burst)
        rate[-n:] += burst * (f_burst / (1.0 - f_burst) * rate.sum() / burst.sum())
    return rate * (1e-6 / rate.sum())


def time_weights(age, n_steps):
    """
    Weights of tabulated ages for every step of 1 Myr.

    A step k is the mean of ten linear interpolations, at k + 0.1 ... k + 1.0 Myr.

    Parameters
    ----------
    age : `~numpy.ndarray`, shape (n_age,)
        Ages of the table in Myr, from 0.
    n_steps : int
        Number of steps.

    Returns
    -------
    weights : `scipy.sparse.csr_matrix`, shape (n_steps, n_age)
    """
    sample = (np.arange(n_steps)[:, None] + np.arange(1, 11) / 10.0).ravel()
    step = np.repeat(np.arange(n_steps), 10)
    cell = np.clip(np.searchsorted(age, sample, side="right") - 1, 0, age.size - 2)
    t = np.clip((sample - age[cell]) / (age[cell + 1] - age[cell]), 0.0, 1.0)
    data = np.concatenate([1 - t, t]) / 10.0
    index = (np.concatenate([step, step]), np.concatenate([cell, cell + 1]))
    return csr_matrix((data, index), shape=(n_steps, age.size))


# ------------------------------------------------------------------- attenuation


def leitherer_calzetti(wave):
    """k(lambda) of starbursts: Calzetti 2000, Leitherer 2002 in 0.0912-0.15 um, 0 below."""
    nm = np.asarray(wave, dtype=float) * 1e3
    with np.errstate(all="ignore"):
        short = -2.156 + 1.509e3 / nm - 0.198e6 / nm**2 + 0.011e9 / nm**3
        k = 2.659 * np.where(nm < 630.0, short, -1.857 + 1.040e3 / nm) + 4.05
        ultraviolet = 5.472 + 0.671e3 / nm - 9.218e3 / nm**2 + 2.62e6 / nm**3
        k = np.where(nm < 150.0, ultraviolet, k)
    return np.where(nm <= 91.2, 0.0, np.maximum(k, 0.0))


def _bump(wave, amplitude):
    nm = np.asarray(wave, dtype=float) * 1e3
    width = (nm * 35.0) ** 2
    return amplitude * width / ((nm**2 - 217.5**2) ** 2 + width)


def attenuation_curve(wave, slope=0.0, bump=0.0):
    """
    Starburst curve times (lambda / 0.55 um)^slope plus a bump at 0.2175 um.

    Scaled to keep E(B-V), taken between 0.44 and 0.55 um, that of the starburst curve.
    """
    wave = np.asarray(wave, dtype=float)
    band = np.array([0.44, 0.55])
    old = leitherer_calzetti(band)
    new = old * (band / 0.55) ** slope + _bump(band, bump)
    curve = leitherer_calzetti(wave) * (wave / 0.55) ** slope + _bump(wave, bump)
    return curve * ((old[0] - old[1]) / (new[0] - new[1]))


# ------------------------------------------------------------------------ thermal


def planck_lambda(wave, temperature):
    """B_lambda in arbitrary units, safe for large exponents."""
    x = np.minimum(PLANCK_K / (wave * temperature), 600.0)
    return wave**-5.0 / np.expm1(x)


def modified_blackbody(wave, temperature, beta, wave_thick=200.0):
    """(1 - exp(-(wave_thick / wave)^beta)) B_lambda(T), arbitrary units."""
    return -np.expm1(-((wave_thick / wave) ** beta)) * planck_lambda(wave, temperature)


# ---------------------------------------------------------------------------- AGN

DISK_BREAKS = (0.008, 0.01, 0.1, 5.0, 1000.0)
DISK_SLOPES = (0.2, -1.0, -1.5, -4.0)


def disk_spectrum(wave, delta=0.0):
    """
    Accretion disk, L_lambda in powers of wavelength between breaks, integral 1.

    The 2020 form of the SKIRTOR disk: slopes 0.2, -1, -1.5 + delta, -4 with breaks at
    0.008, 0.01, 0.1, 5 and 1000 um.
    """
    wave = np.asarray(wave, dtype=float)
    slopes = list(DISK_SLOPES)
    slopes[2] += delta
    out = np.zeros(wave.shape)
    value, total = 1.0, 0.0
    for low, high, slope in zip(DISK_BREAKS[:-1], DISK_BREAKS[1:], slopes, strict=True):
        inside = (wave >= low) & (wave <= high)
        out[inside] = value * (wave[inside] / low) ** slope
        if abs(slope + 1.0) < 1e-12:
            total += value * low * math.log(high / low)
        else:
            total += value * low / (slope + 1.0) * ((high / low) ** (slope + 1.0) - 1.0)
        value *= (high / low) ** slope
    return out / total


def drude(wave, centre, width):
    """Drude profile, 1 at the centre."""
    w = (width / centre) ** 2
    return w / ((wave / centre - centre / wave) ** 2 + w)


# ---------------------------------------------------------------------------- IGM

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
