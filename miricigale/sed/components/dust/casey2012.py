"""A modified blackbody with a power law in the mid-infrared, after Casey 2012."""

import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import register
from miricigale.sed.components.dust.base import DustEmission
from miricigale.sed.parameter import Parameter

__all__ = ["Casey2012"]

WAVE_THICK = 200.0  # um, where the optical depth is 1
#: Constants of L(alpha, T) in um^1/2, um^1/2, 1 / (um K), 1 / (um K), of Casey 2012.
B = (26.68, 6.246, 1.905e-4, 7.243e-5)


#: Steps of 0.014 in ln(wavelength) where there is only the power law, of 0.0052 where the
#: spectrum bends: see docs/guide/sed/casey2012.rst for what straight lines between them cost.
NODES = np.append(np.geomspace(1.0, 3.0, 80)[:-1], np.geomspace(3.0, 3000.0, 1330))
NODES.flags.writeable = False


@register
class Casey2012(DustEmission):
    """
    Casey 2012: one blackbody of general opacity and a mid-infrared power law (her equation 3).

    S_nu = [1 - exp(-(200 um / l)^beta)] B_nu(T) + N l^alpha exp(-(l / l_c)^2); l_c is 3/4 of
    L(alpha, T), the wavelength where the slope of the blackbody is alpha, and N is such that
    the power law without its cut-off meets the blackbody at l_c, as in CIGALE.
    """

    name = "casey2012"
    reference = "Casey 2012, MNRAS 425, 3094"
    temperature_dust = Parameter(
        default=35.0, bounds=(10.0, 150.0), unit="K", doc="Temperature of the dust."
    )
    emissivity_dust = Parameter(
        default=1.6, bounds=(0.5, 3.0), doc="Slope beta of the opacity in frequency."
    )
    alpha_mir = Parameter(
        default=2.0, bounds=(1.0, 5.0), doc="Slope of S_nu in wavelength in the mid-infrared."
    )

    def nodes(self):
        return NODES

    @staticmethod
    def turnover(alpha_mir, temperature_dust):
        """
        Wavelength l_c above which the power law is cut off.

        Parameters
        ----------
        alpha_mir, temperature_dust : float or `~numpy.ndarray`
            Slope of the power law, and temperature in K.

        Returns
        -------
        wave : float or `~numpy.ndarray`
            In um, 3/4 of L(alpha, T) of Casey 2012.
        """
        slope = (B[0] + B[1] * alpha_mir) ** -2.0
        return 0.75 / (slope + (B[2] + B[3] * alpha_mir) * temperature_dust)

    def parts(self, values):
        """
        Blackbody and power law on one scale.

        Parameters
        ----------
        values : dict of str to float
            Values of all parameters.

        Returns
        -------
        blackbody, power_law : `~numpy.ndarray`
            L_lambda at `nodes`, arbitrary scale.
        """
        temperature, beta = values["temperature_dust"], values["emissivity_dust"]
        alpha = values["alpha_mir"]
        turn = self.turnover(alpha, temperature)
        # L_lambda goes as S_nu / lambda^2
        at_turn = _core.modified_blackbody(turn, temperature, beta, WAVE_THICK) * turn**2
        power_law = at_turn * (NODES / turn) ** alpha * np.exp(-((NODES / turn) ** 2)) / NODES**2
        return _core.modified_blackbody(NODES, temperature, beta, WAVE_THICK), power_law

    def spectrum(self, values):
        blackbody, power_law = self.parts(values)
        return blackbody + power_law
