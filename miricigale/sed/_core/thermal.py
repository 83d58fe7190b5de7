"""Thermal and resonance shapes; wavelengths in um."""

import numpy as np

PLANCK_K = 14387.768775  # h c / k in um K


def planck_lambda(wave, temperature):
    """B_lambda in arbitrary units, safe for large exponents."""
    x = np.minimum(PLANCK_K / (wave * temperature), 600.0)
    return wave**-5.0 / np.expm1(x)


def modified_blackbody(wave, temperature, beta):
    """(1 - exp(-(200 um / wave)^beta)) B_lambda(T), arbitrary units."""
    return -np.expm1(-((200.0 / wave) ** beta)) * planck_lambda(wave, temperature)


def drude(wave, center, width):
    """Drude profile, 1 at the center."""
    w = (width / center) ** 2
    return w / ((wave / center - center / wave) ** 2 + w)
