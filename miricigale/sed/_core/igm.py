"""
Mean transmission of the intergalactic medium at observed wavelengths (um, in any order).

Absorbers stand between redshift 0 and the source: nothing absorbs at a source redshift of 0, a
line takes nothing below its rest wavelength, and the continuum seen below the Lyman limit
is integrated from redshift 0. Where the published formulae are silent (observed wavelengths below
0.0912 um) this is what their own integrands give.
"""

import math

import numpy as np

from miricigale.utils.caching import cached
from miricigale.utils.compilation import njit

LYMAN_LIMIT = 0.0912  # um, the rounded value that Madau, Meiksin and CIGALE use
INOUE_LIMIT = 0.09118  # um, Inoue et al. 2014, section 4

# Meiksin 2006, table 1: depth of the line n over that of Lyman alpha, n = 3 ... 9
_FACTORS = np.array([0.0, 0.0, 1.0, 0.348, 0.179, 0.109, 0.0722, 0.0508, 0.0373, 0.0283])
_N_MAX = 31  # lines n = 2 ... 30

# Madau 1995, eq. 12 and 15: amplitudes of Lyman alpha to delta
_MADAU = np.array([0.0036, 1.7e-3, 1.2e-3, 9.3e-4])

# Inoue et al. 2014, eq. 21 and 22: powers of 1 + z of the forest and of damped systems
_LAF_POWERS = np.array([1.2, 3.7, 5.5])
_DLA_POWERS = np.array([2.0, 3.0])


def lyman_lines(n_max=_N_MAX):
    """Wavelengths in um of the lines n -> 1, n = 2 ... n_max - 1."""
    n = np.arange(2, n_max)
    return LYMAN_LIMIT / (1.0 - 1.0 / n**2)


# ------------------------------------------------------------------------- Meiksin


@cached
def _lls_terms():
    factorial = [math.factorial(n) for n in range(10)]
    first = 0.2788 - math.exp(-1.0)
    first -= sum((-1.0) ** n / (factorial[n] * (2 * n - 1)) for n in range(9))
    series = [2.0 * (-1.0) ** n / (factorial[n] * (6 * n - 5) * (2 * n - 1)) for n in range(1, 10)]
    return first, np.array(series)


@cached
def _meiksin_lines():
    """Wavelengths of the lines n = 2 ... 30, and depths over Lyman alpha at 1 + z = 4."""
    n = np.arange(2, _N_MAX, dtype=float)
    depth = np.zeros(n.size)
    depth[1:8] = _FACTORS[3:10]
    # eq. 4: above n = 9 in proportion to the depth of n = 9 at the same observed wavelength,
    # that is, at another redshift
    depth[8:] = _FACTORS[9] * 720.0 / (n[8:] * (n[8:] ** 2 - 1.0))
    return lyman_lines(), depth


def meiksin_transmission(wave, redshift):
    """
    Meiksin 2006, as CIGALE has it.

    The optical depths of the higher lines are those of Table 1 times the Lyman-alpha depth
    at the source's redshift (CIGALE's reading; it absorbs a little more than the depth at
    the absorber's would). Below 0.07 (1 + z) um the transmission falls as wavelength squared, for
    any z > 0.
    """
    wave = np.ascontiguousarray(wave, dtype=float)
    return _meiksin(wave, float(redshift), *_lls_terms(), *_meiksin_lines())


@njit()
def _meiksin(wave, redshift, first, series, lines, depth):
    out = np.ones(wave.size)
    if redshift <= 0.0:
        return out
    z1 = 1.0 + redshift
    if redshift <= 4.0:
        amplitude = 0.00211
        power = 3.7
    else:
        amplitude = 0.00058
        power = 4.5
    tau_alpha = amplitude * z1**power
    # powers of 1 + z = w / line, split into one of w and one of the line
    third = (0.25 / lines) ** (1.0 / 3.0)
    sixth = np.sqrt(third)
    highest = lines[0] * z1
    for i in range(wave.size):
        w = wave[i]
        if w >= highest:
            continue
        tau = 0.0
        if w > lines[0]:
            tau += amplitude * (w / lines[0]) ** power
        cube = w ** (1.0 / 3.0)
        root = math.sqrt(cube)
        series_depth = 0.0
        for j in range(1, lines.size):
            if w >= lines[j] * z1:
                break
            if w <= lines[j]:
                continue
            if j <= 3:  # n = 3, 4, 5
                is_below_z3 = w < 4.0 * lines[j]
                series_depth += depth[j] * (third[j] * cube if is_below_z3 else sixth[j] * root)
            elif j <= 7:
                series_depth += depth[j] * third[j] * cube
            else:
                series_depth += depth[j] * third[7] * cube
        tau += tau_alpha * series_depth
        x = w / LYMAN_LIMIT
        if x < z1:
            low = max(x, 1.0)  # 1 + z of the nearest absorber
            tau += 0.805 * x**3 * (1.0 / low - 1.0 / z1)
            lls = first * x**1.5 * (z1 - low)
            far = (x / z1) ** 3
            low_cube = (x / low) ** 3
            a = z1**2.5
            b = low**2.5
            for k in range(series.size):
                a *= far
                b *= low_cube
                lls -= series[k] * (a - b)
            tau += 0.25 * lls
        out[i] = math.exp(-tau)
        if w < 0.07 * z1:
            out[i] *= (w / (0.07 * z1)) ** 2
    return out


# --------------------------------------------------------------------------- Madau


def madau_transmission(wave, redshift):
    """Madau 1995: four lines and the continuum (footnote 3)."""
    wave = np.asarray(wave, dtype=float)
    z1 = 1.0 + float(redshift)
    lines = lyman_lines(6)
    out = np.ones(wave.size)
    dimmed = wave < lines[0] * z1
    w = wave[dimmed]
    in_forest = (w[:, None] < lines * z1) & (w[:, None] > lines)
    tau = in_forest @ (_MADAU * lines**-3.46) * w**3.46
    is_continuum = w < LYMAN_LIMIT * z1
    x = w[is_continuum] / LYMAN_LIMIT
    low = np.maximum(x, 1.0)
    continuum = (
        0.25 * x**3 * (z1**0.46 - low**0.46)
        + 9.4 * x**1.5 * (z1**0.18 - low**0.18)
        - 0.7 * x**3 * (low**-1.32 - z1**-1.32)
        - 0.023 * (z1**1.68 - low**1.68)
    )
    # the last term is a fit that turns the sum negative far in the ultraviolet
    tau[is_continuum] += np.maximum(continuum, 0.0)
    out[dimmed] = np.exp(-tau)
    return out


# --------------------------------------------------------------------------- Inoue


def inoue_lines(table):
    """
    Prepare table 2 of Inoue et al. 2014 for `inoue_transmission`.

    Columns, longest wavelength first: wavelength in um, A_LAF,1 to 3, A_DLA,1 and 2. Returned are
    wavelengths, and amplitudes of forest and damped systems over the wavelength to the
    power that goes with them: shapes (n_line,), (n_line, 3), (n_line, 2).
    """
    table = np.asarray(table, dtype=float)
    wave = np.ascontiguousarray(table[:, 0])
    forest = table[:, 1:4] * wave[:, None] ** -_LAF_POWERS
    damped = table[:, 4:6] * wave[:, None] ** -_DLA_POWERS
    return wave, forest, damped


def inoue_transmission(wave, redshift, lines):
    """Inoue et al. 2014, section 4: lines by eq. 20 to 22 with table 2, continuum by eq. 25 to 29."""
    wave = np.ascontiguousarray(wave, dtype=float)
    return _inoue(wave, 1.0 + float(redshift), *lines)


@njit()
def _inoue(wave, z1, lines, forest, damped):
    out = np.ones(wave.size)
    highest = lines[0] * z1
    for i in range(wave.size):
        w = wave[i]
        if w >= highest:
            continue
        log = math.log(w)
        w12 = math.exp(1.2 * log)
        w37 = math.exp(3.7 * log)
        w55 = math.exp(5.5 * log)
        w2 = w * w
        w3 = w * w * w
        tau = 0.0
        for j in range(lines.size):
            line = lines[j]
            if w >= line * z1:
                break
            if w <= line:
                continue
            if w < 2.2 * line:
                tau += forest[j, 0] * w12
            elif w < 5.7 * line:
                tau += forest[j, 1] * w37
            else:
                tau += forest[j, 2] * w55
            tau += damped[j, 0] * w2 if w < 3.0 * line else damped[j, 1] * w3
        x = w / INOUE_LIMIT
        if x < z1:
            if x >= 1.0:
                tau += _inoue_forest(x, z1) + _inoue_damped(x, z1)
            else:
                # lower limit of the integrals at redshift 0 instead of x - 1
                tau += x**2.1 * _inoue_forest(1.0, z1) + _inoue_damped_near(x, z1)
        out[i] = math.exp(-tau)
    return out


@njit()
def _inoue_forest(x, z1):
    """Lyman continuum of the forest, eq. 25 to 27; x = wavelength / limit."""
    x21 = x**2.1
    if z1 < 2.2:
        return 0.325 * (x**1.2 - z1**-0.9 * x21)
    if z1 < 5.7:
        if x < 2.2:
            return 2.55e-2 * z1**1.6 * x21 + 0.325 * x**1.2 - 0.250 * x21
        return 2.55e-2 * (z1**1.6 * x21 - x**3.7)
    if x < 2.2:
        return 5.22e-4 * z1**3.4 * x21 + 0.325 * x**1.2 - 3.14e-2 * x21
    if x < 5.7:
        return 5.22e-4 * z1**3.4 * x21 + 0.218 * x21 - 2.55e-2 * x**3.7
    return 5.22e-4 * (z1**3.4 * x21 - x**5.5)


@njit()
def _inoue_damped(x, z1):
    """Lyman continuum of damped systems, eq. 28 and 29."""
    root = x**-0.3
    if z1 < 3.0:
        return 0.2113 * z1**2 - 0.07661 * z1**2.3 * root - 0.1347 * x**2
    far = 0.04696 * z1**3 - 0.01779 * z1**3.3 * root
    if x < 3.0:
        return 0.6340 + far - 0.1347 * x**2 - 0.2905 * root
    return far - 0.02916 * x**3


@njit()
def _inoue_damped_near(x, z1):
    """The same for x < 1: eq. 28 and 29 with their lower limit at redshift 0."""
    root = x**-0.3
    if z1 < 3.0:
        tau = 0.2113 * (z1**2 - 1.0) - 0.07661 * (z1**2.3 - 1.0) * root
    else:
        far = 0.04696 * z1**3 - 0.01779 * z1**3.3 * root
        tau = 0.6340 - 0.2113 + far - (0.2905 - 0.07661) * root
    # the form holds where damped systems are opaque: not in the far ultraviolet
    return max(tau, 0.0)
