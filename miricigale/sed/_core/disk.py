"""Accretion disk."""

import math

import numpy as np

__all__ = ["DISK_BREAKS", "DISK_SLOPES", "disk_spectrum"]

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
