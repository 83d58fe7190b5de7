"""Polar dust of active nuclei; wavelengths in um."""

import math

import numpy as np

from miricigale.sed._core.attenuation import leitherer_calzetti, smc_power_law
from miricigale.sed._core.nodes import trapezoid_weights
from miricigale.sed._core.thermal import PLANCK_K
from miricigale.utils._core.functions import exponential
from miricigale.utils.compilation import njit

#: Mean over the sphere of cos i (1 + 2 cos i) / 3: a disk's light over its face-on value.
DISK_MEAN = 7.0 / 18.0

#: Names of the extinction laws, the first being CIGALE's default.
POLAR_LAWS = ("smc", "calzetti", "gaskell")

_WAVE_THICK = 200.0  # um: optical depth of the emitting dust is one
#: h c / (lambda k T) beyond which a body is dark: 1e-17 of its peak.
_LARGEST_EXPONENT = 60.0
#: Logarithm of the optical depth beyond which 1 - exp(-depth) is one to 1e-23.
_OPAQUE = 4.0
#: Logarithm of a transmission below which no light is left.
_LOG_DARK = -700.0


def polar_curve(wave, law):
    """
    Extinction k = A / E(B-V) of polar dust, by a law of `POLAR_LAWS`.

    ``smc``: 1.39 lambda^-1.2 (Prevot et al. 1984, as in Bongiorno et al. 2012), all wavelengths.
    ``calzetti``: Calzetti et al. 2000 from 0.15 um on, zero where it falls below zero (3.1 um);
    the polynomial of Leitherer et al. 2002 below 0.15 um, **continued** below 0.0912 um, since
    this dust stands before a source that is bright there.
    ``gaskell``: Gaskell et al. 2004, fit of their appendix for x = 1 / lambda in 1.6-8 um^-1;
    the cubic continues below 1.6 until it is zero (x = 0.60, 1.68 um), the line continues above
    8; divided by A(B)/A(V) - 1 = 0.182 (their table 3), as CIGALE does.
    """
    wave = np.asarray(wave, dtype=float)
    if law == "smc":
        return smc_power_law(wave)
    x = 1.0 / wave
    if law == "calzetti":
        short = wave < 0.15
        ultraviolet = 5.472 + 0.671 * x - 9.218e-3 * x**2 + 2.62e-3 * x**3
        return np.where(short, ultraviolet, leitherer_calzetti(np.where(short, 0.15, wave)))
    y = np.minimum(x, 3.69)
    cubic = -0.8175 + 1.5848 * y - 0.3774 * y**2 + 0.0296 * y**3
    line = 1.3468 + 0.0087 * x
    return np.maximum(np.where(x < 3.69, cubic, line), 0.0) / 0.182


def polar_grid(wave, curve):
    """
    What `add_polar` needs of a grid of wavelengths and the extinction k there: shape (5, n_wave).

    Rows: -0.4 ln(10) k; lambda^-5; h c / (lambda k); ln(200 um / lambda); weights of the
    trapezoidal rule.
    """
    wave = np.asarray(wave, dtype=float)
    weight = trapezoid_weights(wave)
    absorption = -0.4 * math.log(10.0) * curve
    return np.stack([absorption, wave**-5.0, PLANCK_K / wave, np.log(_WAVE_THICK / wave), weight])


def polar_share(opening_angle):
    """
    Share of the face-on disk's light that enters the cone of polar dust.

    The mean over the sphere of cos i (1 + 2 cos i) / 3 over i < 90 deg - opening angle, on both
    sides: 7/18 - sin^2 / 6 - 2 sin^3 / 9 (Yang et al. 2020, MNRAS 491, 740).
    """
    s = math.sin(math.radians(opening_angle))
    return DISK_MEAN - s**2 / 6.0 - 2.0 * s**3 / 9.0


@njit(fastmath={"reassoc", "contract"}, error_model="numpy")
def _dimmed(absorption, weight, face_on, disk, ebv, dims_disk, out):
    """Fill ``out`` with the disk behind polar dust, if it is; return the power taken from ``face_on``."""
    lost = 0.0
    for i in range(face_on.size):
        through = exponential(max(absorption[i] * ebv, _LOG_DARK))
        lost += weight[i] * face_on[i] * (1.0 - through)
        out[i] = disk[i]
        if dims_disk:
            out[i] *= through
    return lost


@njit(fastmath={"reassoc", "contract"}, error_model="numpy")
def _modified_blackbody(front, exponent, thick, weight, temperature, beta, out):
    """Fill ``out`` with the emission of polar dust on any scale; return its power."""
    n = front.size
    # wavelengths ascend
    first = 0
    while first < n and exponent[first] > _LARGEST_EXPONENT * temperature:
        out[first] = 0.0
        first += 1
    thin = first
    while thin < n and beta * thick[thin] > _OPAQUE:
        thin += 1
    per_temperature = 1.0 / temperature
    for i in range(first, n):
        out[i] = front[i] / (exponential(exponent[i] * per_temperature) - 1.0)
    for i in range(thin, n):
        out[i] *= 1.0 - exponential(-exponential(beta * thick[i]))
    power = 0.0
    for i in range(first, n):
        power += weight[i] * out[i]
    return power


@njit()
def add_polar(grid, face_on, disk, dust, ebv, temperature, beta, share, dims_disk):
    """
    Disk, torus and polar dust for one watt of dust emission.

    ``grid`` is that of `polar_grid`; ``face_on``, ``disk`` and ``dust``, shape (n_wave,), are the disk
    without obscuration seen from above, the disk as seen through the torus, and the torus, on one
    scale (W/um); ``share`` is that of `polar_share`; ``dims_disk`` whether the line of sight passes
    the polar dust. Returned are the parts as seen, shape (3, n_wave), the disk's light over all
    directions, and torus and polar emission on the given scale: where that is not positive,
    nothing is scaled. Exponentials are good to 1e-11.
    """
    weight = grid[4]
    n = face_on.size
    parts = np.zeros((3, n))
    power = 0.0
    total = 0.0
    for i in range(n):
        power += weight[i] * face_on[i]
        total += weight[i] * dust[i]
    polar = 0.0
    if ebv > 0.0:
        lost = _dimmed(grid[0], weight, face_on, disk, ebv, dims_disk, parts[0])
        body = _modified_blackbody(grid[1], grid[2], grid[3], weight, temperature, beta, parts[2])
        if body == 0.0 and lost > 0.0:
            return parts, power, math.nan  # the grid ends before the light of the dust
        if body > 0.0:
            polar = share * lost / body
            total += share * lost
    else:
        for i in range(n):
            parts[0, i] = disk[i]
    if not total > 0.0:
        return parts, power, total
    norm = 1.0 / total
    polar *= norm
    for i in range(n):
        parts[0, i] *= norm
        parts[1, i] = dust[i] * norm
        parts[2, i] *= polar
    return parts, DISK_MEAN * power * norm, total
