"""Curves of attenuation and extinction; wavelengths in um."""

import numpy as np

__all__ = ["attenuation_curve", "leitherer_calzetti"]


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
