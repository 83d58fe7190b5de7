"""Accretion disks: powers of wavelength between breaks (um)."""

import math

import numpy as np

#: Breaks in um and slopes of L_lambda between them. ``skirtor``: the form of CIGALE since
#: 2020, Stalevski's from 8 nm on; ``stalevski2016``: as the SKIRTOR library was computed, from
#: 1 nm (12 % of its light is below 8 nm); ``schartmann2005``: after Schartmann et al. 2005,
#: A&A 437, 861, in CIGALE's numbers.
DISKS = {
    "skirtor": ((0.008, 0.01, 0.1, 5.0, 1000.0), (0.2, -1.0, -1.5, -4.0)),
    "schartmann2005": ((0.008, 0.05, 0.125, 10.0, 1000.0), (1.0, -0.2, -1.5, -4.0)),
    "stalevski2016": ((0.001, 0.01, 0.1, 5.0, 1000.0), (0.2, -1.0, -1.5, -4.0)),
}
DISK_BREAKS = DISKS["skirtor"][0]


def disk_spectrum(wave, delta=0.0, disk="skirtor"):
    """
    Accretion disk, L_lambda in 1/um in powers of wavelength between breaks, 0 outside; integral 1.

    ``delta`` is added to the third slope, -1.5, which holds in the optical and near infrared.
    """
    wave = np.asarray(wave, dtype=float)
    breaks, slopes = DISKS[disk]
    slopes = (*slopes[:2], slopes[2] + delta, slopes[3])
    out = np.zeros(wave.shape)
    value = 1.0
    total = 0.0
    for low, high, slope in zip(breaks[:-1], breaks[1:], slopes, strict=True):
        inside = (wave >= low) & (wave <= high)
        out[inside] = value * (wave[inside] / low) ** slope
        if abs(slope + 1.0) < 1e-12:
            total += value * low * math.log(high / low)
        else:
            total += value * low / (slope + 1.0) * ((high / low) ** (slope + 1.0) - 1.0)
        value *= (high / low) ** slope
    return out / total


def disk_nodes(disk, number=241):
    """
    Wavelengths in um that follow a disk: evenly in the logarithm to 30 um, with its breaks.

    The first lies just below the disk's beginning, where it is zero, so that nothing leaks to
    shorter wavelengths when grids are merged.
    """
    breaks = DISKS[disk][0]
    first = breaks[0]
    logarithmic = first * (30.0 / first) ** (np.arange(number) / (number - 1))
    return np.unique(np.concatenate([[first * (1.0 - 1e-5)], logarithmic, breaks[:-1]]))
