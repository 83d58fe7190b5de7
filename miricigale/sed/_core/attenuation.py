"""Curves of attenuation and extinction; wavelengths in um."""

import numpy as np

from miricigale.sed._core.thermal import drude

_BREAK = 0.0912  # nothing is attenuated at this wavelength and below
_B, _V = 0.44, 0.55

# Pei 1992, table 4: amplitude, wavelength in um, b, n. Background, far-ultraviolet rise, 2175 A,
# silicates at 9.7 and 18 um, far infrared
_PEI = {
    "mw": (
        (165.0, 0.047, 90.0, 2.0),
        (14.0, 0.08, 4.0, 6.5),
        (0.045, 0.22, -1.95, 2.0),
        (0.002, 9.7, -1.95, 2.0),
        (0.002, 18.0, -1.80, 2.0),
        (0.012, 25.0, 0.0, 2.0),
    ),
    "lmc": (
        (175.0, 0.046, 90.0, 2.0),
        (19.0, 0.08, 5.5, 4.5),
        (0.023, 0.22, -1.95, 2.0),
        (0.005, 9.7, -1.95, 2.0),
        (0.006, 18.0, -1.80, 2.0),
        (0.020, 25.0, 0.0, 2.0),
    ),
    "smc": (
        (185.0, 0.042, 90.0, 2.0),
        (27.0, 0.08, 5.5, 4.0),
        (0.005, 0.22, -1.95, 2.0),
        (0.010, 9.7, -1.95, 2.0),
        (0.012, 18.0, -1.80, 2.0),
        (0.030, 25.0, 0.0, 2.0),
    ),
}
_PEI_RV = {"mw": 3.08, "lmc": 3.16, "smc": 2.93}


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


def pei_extinction(wave, galaxy):
    """k(lambda) = (1 + R_V) xi(lambda), Pei 1992, of mw, lmc or smc."""
    xi = 0.0
    for amplitude, center, b, n in _PEI[galaxy]:
        ratio = (wave / center) ** n
        xi = xi + amplitude / (ratio + 1.0 / ratio + b)
    return (1.0 + _PEI_RV[galaxy]) * xi
