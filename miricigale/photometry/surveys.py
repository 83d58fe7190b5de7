"""Depths and errors of surveys in other bands than MIRI's."""

import math
import types

#: 5-sigma AB depths of 15 bands of CANDELS/EGS like the paper's (after Stefanon 2017 and FIDEL): the
#: paper states none.
YANG2021_DEPTHS = types.MappingProxyType(
    {
        "megacam.u": 27.1, "megacam.g": 27.3, "megacam.r": 27.2, "megacam.i": 27.0, "megacam.z": 26.1,
        "acs.f606w": 28.8, "acs.f814w": 28.2, "wfc3.f125w": 27.6, "wfc3.f140w": 26.8, "wfc3.f160w": 27.6,
        "irac.ch1": 23.9, "irac.ch2": 24.2, "irac.ch3": 22.5, "irac.ch4": 22.8, "mips.24": 19.3,
    }
)  # fmt: skip

#: 5-sigma AB depths of deep surveys by Herschel, from 3-sigma depths in mJy: 0.6 and 1.3 with PACS in GOODS-South
#: (Magnelli et al. 2013, A&A 553, A132, abstract), and with SPIRE three times the confusion noise of 5.8, 6.3 and
#: 6.8 mJy / beam (Nguyen et al. 2010, A&A 518, L5, abstract), which no exposure goes below without priors.
_HERSCHEL = {
    "pacs_100": 0.6,
    "pacs_160": 1.3,
    "spire_250": 17.4,
    "spire_350": 18.9,
    "spire_500": 20.4,
}
HERSCHEL_DEPTHS = types.MappingProxyType(
    {
        f"sedpy.herschel_{name}": round(16.4 - 2.5 * math.log10(depth * 5 / 3), 2)
        for name, depth in _HERSCHEL.items()
    }
)


def fractional_error(name):
    """
    Part of the flux that is added to the error of a band other than MIRI's, in quadrature.

    0.10 for IRAC and MIPS, 0.03 otherwise: the package's own choice, not the paper's.
    """
    return 0.10 if name.startswith(("irac", "mips")) else 0.03
