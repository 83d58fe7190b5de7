"""Curves of attenuation and extinction; wavelengths in um."""

import numpy as np

from miricigale.sed._core.thermal import drude

_BREAK = 0.0912  # nothing is attenuated at this wavelength and below
_B = 0.44
_V = 0.55


def leitherer_calzetti(wave):
    """k(lambda) of starbursts: Calzetti 2000, Leitherer 2002 in 0.0912-0.15 um, 0 below."""
    nm = np.asarray(wave, dtype=float) * 1e3
    with np.errstate(all="ignore"):
        short = -2.156 + 1.509e3 / nm - 0.198e6 / nm**2 + 0.011e9 / nm**3
        k = 2.659 * np.where(nm < 630.0, short, -1.857 + 1.040e3 / nm) + 4.05
        ultraviolet = 5.472 + 0.671e3 / nm - 9.218e3 / nm**2 + 2.62e6 / nm**3
        k = np.where(nm < 150.0, ultraviolet, k)
    return np.where(nm <= _BREAK * 1e3, 0.0, np.maximum(k, 0.0))


def attenuation_curve(wave, slope=0.0, bump=0.0, center=0.2175, width=0.035, scaling="exact"):
    """
    Starburst curve times (lambda / 0.55 um)^slope, plus a Drude bump, scaled in E(B-V).

    ``scaling="exact"`` keeps k(0.44 um) - k(0.55 um) of the starburst curve; ``"cigale"`` that of
    the starburst curve with the bump, so that a bump alone scales nothing (Boquien et al. 2019,
    equation 8 and their code).
    """
    wave = np.asarray(wave, dtype=float)
    band = np.array([_B, _V])
    old = leitherer_calzetti(band)
    new = old * (band / _V) ** slope
    curve = leitherer_calzetti(wave)
    if slope:
        curve = curve * (wave / _V) ** slope
    if bump:
        extra = bump * drude(band, center, width)
        new = new + extra
        if scaling == "cigale":
            old = old + extra
        curve = curve + bump * drude(wave, center, width)
    return curve * ((old[0] - old[1]) / (new[0] - new[1]))


def power_law_attenuation(wave, slope):
    """A(lambda) / A_V = (lambda / 0.55 um)^slope."""
    return (np.asarray(wave, dtype=float) / _V) ** slope


def smc_power_law(wave):
    """k(lambda) = 1.39 (lambda / um)^-1.2 of the SMC."""
    return 1.39 * np.asarray(wave, dtype=float) ** -1.2


def pei_extinction(wave, terms, r_v):
    """k(lambda) = (1 + R_V) xi(lambda), Pei 1992, of amplitudes, wavelengths, b and n."""
    xi = 0.0
    for amplitude, center, b, n in terms:
        ratio = (wave / center) ** n
        xi = xi + amplitude / (ratio + 1.0 / ratio + b)
    return (1.0 + r_v) * xi
