"""Attenuation of starlight by dust."""

from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter

__all__ = ["Attenuation", "CalzettiLeitherer"]


class Attenuation(Component):
    """Base: `factors` gives transmissions for young and old stars."""

    role = "attenuation"

    def factors(self, wave, values):
        """
        Transmission at rest wavelengths in um.

        Returns
        -------
        young, old : `~numpy.ndarray`, shape of ``wave``
            Between 0 and 1.
        """
        raise NotImplementedError


@register
class CalzettiLeitherer(Attenuation):
    """
    Starburst attenuation with a free slope and an ultraviolet bump.

    Calzetti et al. 2000, continued by Leitherer et al. 2002 from 0.15 down to 0.0912 um (0
    below), times (lambda / 0.55 um)^slope, plus a Drude bump at 0.2175 um (width 0.035 um),
    scaled to keep E(B-V).
    """

    name = "calzetti"
    reference = "Calzetti et al. 2000, ApJ 533, 682; Leitherer et al. 2002, ApJS 140, 303"
    ebv = Parameter(
        default=0.3, bounds=(0.0, 3.0), unit="mag", doc="Colour excess of stars below 10 Myr."
    )
    ebv_factor = Parameter(
        default=1.0, bounds=(0.0, 1.0), doc="Colour excess of older stars over that of young ones."
    )
    uv_bump = Parameter(default=0.0, bounds=(0.0, 10.0), doc="Amplitude of the 0.2175 um bump.")
    slope = Parameter(default=0.0, bounds=(-1.2, 0.6), doc="Change of the curve's power-law slope.")

    def factors(self, wave, values):
        curve = _core.attenuation_curve(wave, values["slope"], values["uv_bump"])
        young = 10.0 ** (-0.4 * values["ebv"] * curve)
        return young, young ** values["ebv_factor"]

    def inert(self, values):
        return ("ebv_factor", "uv_bump", "slope") if values["ebv"] == 0.0 else ()
