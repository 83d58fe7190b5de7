"""X-rays of AGN as power laws; luminosities in W, energies in keV."""

import numpy as np
from scipy.special import exprel

_STERN = (40.981, 1.024, -0.047)
_ERG = 1e-7  # W s
_UNIT_6UM = 1e41 * _ERG  # W
_BAND = (2.0, 10.0)  # keV


def stern2015(l_6um):
    """Rest-frame 2-10 keV luminosity in W from nu L_nu at 6 um (>= 0), Stern 2015, equation 2."""
    l_6um = np.asarray(l_6um, dtype=float)
    none = l_6um == 0.0
    x = np.log10(np.where(none, _UNIT_6UM, l_6um) / _UNIT_6UM)
    return np.where(none, 0.0, 10.0 ** np.polyval(_STERN[::-1], x) * _ERG)


def stern2015_6um(l_2_10kev):
    """Power nu L_nu at 6 um in W for which `stern2015` gives this luminosity in W; NaN above its maximum."""
    l_2_10kev = np.asarray(l_2_10kev, dtype=float)
    none = l_2_10kev == 0.0
    c, b, a = _STERN
    offset = c - np.log10(np.where(none, 1.0, l_2_10kev) / _ERG)
    with np.errstate(invalid="ignore"):
        x = (-b + np.sqrt(b**2 - 4.0 * a * offset)) / (2.0 * a)
    return np.where(none, 0.0, 10.0**x * _UNIT_6UM)


def power_law_energy(low, high, photon_index):
    """Integral of E^(1 - Gamma) over energies from ``low`` to ``high``; ln(high/low) at Gamma = 2."""
    slope = 2.0 - np.asarray(photon_index, dtype=float)
    width = np.log(np.divide(high, low))
    return np.asarray(low, dtype=float) ** slope * width * exprel(slope * width)


def xray_flux(l_2_10kev, redshift, far, band, photon_index, transmission=1.0):
    """
    Observed flux in W/m2 of a power law N(E) ~ E^-Gamma in a band of the observer's frame.

    L (2-10 keV, rest) times the ratio of the bands, (1 + z)^(2 - Gamma) / (4 pi far^2), and what
    absorption leaves.
    """
    ratio = power_law_energy(band[0], band[1], photon_index) / power_law_energy(
        _BAND[0], _BAND[1], photon_index
    )
    stretch = (1.0 + np.asarray(redshift, dtype=float)) ** (2.0 - np.asarray(photon_index))
    return l_2_10kev * ratio * stretch * transmission / (4.0 * np.pi * np.square(far))
