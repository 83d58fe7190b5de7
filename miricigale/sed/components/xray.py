"""X-rays of the AGN, from its light at 6 um."""

import astropy.units as u

from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter
from miricigale.utils.units import LUMINOSITY

__all__ = ["XRay"]

_LAWS = {"stern2015": _core.stern2015}


@register
class XRay(Component):
    """
    X-rays of the AGN: 2-10 keV luminosity from 6 um, and flux of a power law in an observed band.

    It adds no light to the spectrum, only derived quantities (`columns`). The relation is not
    linear in luminosity: it takes that of the whole galaxy, not of a solar mass.

    Yang et al. 2021 have Gamma 1.8, 0.5-7 keV and ``xray_transmission`` 0.5.
    """

    name = "xray"
    role = "xray"
    reference = "Stern 2015, ApJ 807, 129"

    options = {"law": tuple(_LAWS)}

    #: Derived quantities: name to unit and description.
    columns = {
        "l_2_10kev": (LUMINOSITY, "rest-frame 2-10 keV luminosity of the AGN, unabsorbed"),
        "xray_flux": (u.W / u.m**2, "X-ray flux of the AGN in the observed band"),
    }

    photon_index = Parameter(
        default=1.8, bounds=(0.0, 4.0), doc="Gamma of the power law, N(E) ~ E^-Gamma."
    )
    xray_low = Parameter(
        default=0.5, bounds=(0.01, 100.0), unit="keV", doc="Lowest observed energy."
    )
    xray_high = Parameter(
        default=7.0, bounds=(0.01, 1000.0), unit="keV", doc="Highest observed energy."
    )
    xray_transmission = Parameter(
        default=1.0, bounds=(0.0, 1.0), doc="Share of the flux that absorption leaves."
    )

    def invalid(self, values):
        """Say so if the band is empty."""
        if values["xray_low"] < values["xray_high"]:
            return None
        low, high = values["xray_low"], values["xray_high"]
        return f"'xray_high' must be above 'xray_low', got {low:g} to {high:g} keV"

    def derived(self, l_6um, redshift, distance, values):
        """
        X-ray luminosity and flux.

        Parameters
        ----------
        l_6um : float or `~numpy.ndarray`
            nu L_nu of the AGN at rest 6 um in W, of the whole galaxy; 0 without an AGN.
        redshift, distance : float or `~numpy.ndarray`
            Redshift and luminosity distance in m.
        values : dict
            Values of `parameters`, numbers or arrays that broadcast with the rest.

        Returns
        -------
        derived : dict of str to `~numpy.ndarray`
            ``l_2_10kev`` in W and ``xray_flux`` in W/m2, see `columns`.
        """
        power = _LAWS[self.law](l_6um)
        flux = _core.xray_flux(
            power,
            redshift,
            distance,
            low=values["xray_low"],
            high=values["xray_high"],
            photon_index=values["photon_index"],
            transmission=values["xray_transmission"],
        )
        return {"l_2_10kev": power, "xray_flux": flux}
