"""X-rays of AGN from their light at 6 um: a component, and the same for any luminosities."""

import astropy.units as u
import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.cosmology import COSMOLOGY, distance
from miricigale.sed.parameter import Parameter
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import without_mask
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import LUMINOSITY, to_array

#: nu L_nu at 6 um that the samples of Stern 2015 span, roughly: Seyferts to luminous quasars.
STERN2015_RANGE = (1e42, 1e47) * u.erg / u.s

#: Unit of X-ray fluxes that these functions return.
XRAY_FLUX = u.erg / u.s / u.cm**2

_LAWS = {"stern2015": _core.stern2015}


def stern2015(l_6um):
    r"""
    Return the rest-frame 2-10 keV luminosity of an AGN from its light at 6 um.

    .. math:: \log L_{2-10\,\mathrm{keV}} = 40.981 + 1.024\,x - 0.047\,x^2, \quad
        x = \log(\nu L_\nu(6\,\mu\mathrm{m}) / 10^{41}\,\mathrm{erg/s})

    Parameters
    ----------
    l_6um : `~astropy.units.Quantity`
        nu L_nu of the AGN alone at rest 6 um, any shape.

    Returns
    -------
    l_x : `~astropy.units.Quantity`
        In W, corrected for absorption as the relation is; 0 where ``l_6um`` is 0.

    Raises
    ------
    ValueError
        If a luminosity is negative.
    `~astropy.units.UnitsError`
        If it is no luminosity.

    Notes
    -----
    The relation comes from samples between local Seyferts and quasars (`STERN2015_RANGE`). Outside it is
    extrapolated, without a warning: the slope, 1.02 at 1e41 erg/s, changes by -0.094 for each
    factor of ten, so that low luminosities fall faster than in proportion.

    References
    ----------
    Stern 2015, ApJ, 807, 129, equation 2.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.sed.xray import stern2015
    >>> print(f"{stern2015(1e44 * u.erg / u.s).to(u.erg / u.s):.3g}")
    4.27e+43 erg / s
    """
    values = to_array(l_6um, LUMINOSITY, "l_6um")
    _check("l_6um", ">= 0", values, values < 0)
    return _core.stern2015(values) * LUMINOSITY


def stern2015_6um(l_x):
    """
    Return the light of an AGN at 6 um from its 2-10 keV luminosity: `stern2015` solved for its argument.

    Parameters
    ----------
    l_x : `~astropy.units.Quantity`
        Rest-frame 2-10 keV luminosity, corrected for absorption, any shape.

    Returns
    -------
    l_6um : `~astropy.units.Quantity`
        nu L_nu at rest 6 um in W; 0 where ``l_x`` is 0, NaN above the relation's maximum of
        10^46.56 erg/s.

    Raises
    ------
    ValueError
        If a luminosity is negative.
    `~astropy.units.UnitsError`
        If it is no luminosity.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.sed.xray import stern2015_6um
    >>> print(f"{stern2015_6um(1e43 * u.erg / u.s).to(u.erg / u.s):.3g}")
    1.56e+43 erg / s
    """
    values = to_array(l_x, LUMINOSITY, "l_x")
    _check("l_x", ">= 0", values, values < 0)
    return _core.stern2015_6um(values) * LUMINOSITY


def band_luminosity(l_x, *, from_band, to_band, photon_index=1.8):
    """
    Return the luminosity of a power law in another band of the same frame.

    Parameters
    ----------
    l_x : `~astropy.units.Quantity`
        Luminosity (or flux) in ``from_band``.
    from_band, to_band : `~astropy.units.Quantity`, shape (2,)
        Lowest and highest energy.
    photon_index : float, optional
        Gamma of N(E) ~ E^-Gamma.

    Returns
    -------
    l_x : `~astropy.units.Quantity`
        In ``to_band``, in the unit of ``l_x``.

    Raises
    ------
    ValueError
        If a band is not two ascending positive energies.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.sed.xray import band_luminosity
    >>> full = [0.5, 7] * u.keV
    >>> hard = band_luminosity(1 * u.W, from_band=full, to_band=[2, 10] * u.keV, photon_index=2)
    >>> print(f"{hard:.4f}")
    0.6099 W
    """
    index = to_array(photon_index, u.dimensionless_unscaled, "photon_index", finite=True)
    top = _core.power_law_energy(*check_band(to_band, "to_band"), index)
    bottom = _core.power_law_energy(*check_band(from_band, "from_band"), index)
    values, mask = without_mask(l_x)
    values = u.Quantity(values) * (top / bottom)
    if mask is None:
        return values
    return np.where(mask, np.nan, values)


@takes_other_keywords
def xray_flux(l_x_2_10, redshift, *, band=(0.5, 7.0) * u.keV, photon_index=1.8, transmission=1.0):
    r"""
    Return the observed X-ray flux of a power law.

    .. math:: F = \frac{L_{2-10}}{4\pi d_L^2}
        \frac{\int_\mathrm{band} E^{1-\Gamma} dE}{\int_2^{10} E^{1-\Gamma} dE}
        (1+z)^{2-\Gamma} \, T

    Parameters
    ----------
    l_x_2_10 : `~astropy.units.Quantity`
        Luminosity in rest-frame 2-10 keV.
    redshift : float or `~numpy.ndarray`
        Redshifts >= 0; at 0 the flux at 10 pc.
    band : `~astropy.units.Quantity`, shape (2,), optional
        The band, in the observer's frame.
    photon_index : float, optional
        Gamma of N(E) ~ E^-Gamma.
    transmission : float, optional
        Share of the flux that absorption leaves; Yang et al. 2021 halve it.

    Returns
    -------
    flux : `~astropy.units.Quantity`
        In erg / s / cm2.

    Raises
    ------
    ValueError
        If a redshift is negative, the band is not two ascending positive energies, or the
        transmission not from 0 to 1.
    `~astropy.units.UnitsError`
        If a unit is missing or cannot be converted.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.sed.xray import xray_flux
    >>> flux = xray_flux(10**42.5 * u.erg / u.s, 2.0, transmission=0.5)
    >>> print(f"{flux:.2g}")
    9e-17 erg / (s cm2)
    """
    power = to_array(l_x_2_10, LUMINOSITY, "l_x_2_10")
    z = to_array(redshift, u.dimensionless_unscaled, "redshift", finite=True)
    _check("redshift", ">= 0", z, z < 0)
    index = to_array(photon_index, u.dimensionless_unscaled, "photon_index", finite=True)
    share = to_array(transmission, u.dimensionless_unscaled, "transmission", finite=True)
    _check("transmission", "from 0 to 1", share, (share < 0) | (share > 1))
    far = distance(z, COSMOLOGY)
    flux = _core.xray_flux(power, z, far, check_band(band, "band"), index, share)
    return (flux * u.W / u.m**2).to(XRAY_FLUX)


def check_band(band, name):
    """Return the ends of a band in keV; a ValueError unless these are two ascending positive energies."""
    ends = to_array(band, u.keV, name, ndim=1, finite=True)
    if ends.shape != (2,) or not 0 < ends[0] < ends[1]:
        raise argument_error(name, "two ascending positive energies", band)
    return float(ends[0]), float(ends[1])


def _check(name, wanted, values, bad):
    if np.any(bad):
        raise argument_error(name, wanted, np.atleast_1d(values)[np.atleast_1d(bad)][0])


@register
class XRay(Component):
    """
    X-rays of the AGN: 2-10 keV luminosity from 6 um, and flux of a power law in an observed band.

    It adds no light to the spectrum, only derived quantities (`columns`). The relation is not
    linear in luminosity: it takes that of the whole galaxy, not of a solar mass.

    Yang et al. 2021 have Gamma 1.8, 0.5-7 keV and ``xray_transmission`` 0.5.

    Examples
    --------
    >>> from miricigale import SEDModel
    >>> from miricigale.sed import XRay
    >>> paper = SEDModel.yang2021(libraries="bundled")
    >>> model = SEDModel([*paper.components, XRay(xray_transmission=0.5)])
    >>> flux = model.derived(frac_agn=0.4, redshift=2.0, mass=3e10)["xray_flux"]
    >>> print(f"{flux.to('erg / (s cm2)'):.2g}")
    1.2e-15 erg / (s cm2)
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

    photon_index = Parameter(1.8, (0.0, 4.0), "Gamma of the power law, N(E) ~ E^-Gamma.")
    xray_low = Parameter(0.5, (0.01, 100.0), "Lowest observed energy.", unit="keV")
    xray_high = Parameter(7.0, (0.01, 1000.0), "Highest observed energy.", unit="keV")
    xray_transmission = Parameter(1.0, (0.0, 1.0), "Share of the flux that absorption leaves.")

    def invalid(self, values):
        """Say so if the band is empty."""
        if values["xray_low"] < values["xray_high"]:
            return None
        low = values["xray_low"]
        high = values["xray_high"]
        return f"'xray_high' must be above 'xray_low', got {low:g} to {high:g} keV"

    def derived(self, l_6um, redshift, far, values):
        """
        Return the X-ray luminosity and flux.

        Parameters
        ----------
        l_6um : float or `~numpy.ndarray`
            nu L_nu of the AGN at rest 6 um in W, of the whole galaxy; 0 without an AGN.
        redshift, far : float or `~numpy.ndarray`
            Redshift and luminosity distance in m.
        values : dict
            Values of `parameters`, numbers or arrays that broadcast with the rest.

        Returns
        -------
        derived : dict of str to `~numpy.ndarray`
            ``l_2_10kev`` in W and ``xray_flux`` in W/m2, see `columns`.
        """
        power = _LAWS[self.law](l_6um)
        low = values["xray_low"]
        high = values["xray_high"]
        index = values["photon_index"]
        share = values["xray_transmission"]
        flux = _core.xray_flux(power, redshift, far, (low, high), index, share)
        return {"l_2_10kev": power, "xray_flux": flux}
