"""Attenuation of starlight by dust."""

import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter
from miricigale.utils.caching import cached
from miricigale.utils.package_tables import declared

# Cardelli et al. 1989, equation 5, in 1 um / lambda - 8: the highest power first
_FAR = ((-0.070, 0.137, -0.628, -1.073), (0.374, -0.420, 4.257, 13.670))


def milky_way(wave, r_v):
    """
    Return the k(lambda) of the Milky Way: Cardelli et al. 1989, the optical part of O'Donnell 1994.

    Given for 0.1-3.33 um (from dust_extinction); the cubic of the far ultraviolet continues below
    and the power law of the infrared has no end.
    """
    import astropy.units as u
    from dust_extinction.parameter_averages import O94

    low, high = O94.x_range
    x = 1.0 / np.asarray(wave, dtype=float)
    k = r_v * np.asarray(O94(Rv=r_v)(np.clip(x, low, high) / u.um), dtype=float)
    k = np.where(x < low, k * (x / low) ** 1.61, k)
    return np.where(x > high, r_v * np.polyval(_FAR[0], x - 8) + np.polyval(_FAR[1], x - 8), k)


def _pei1992(wave, galaxy):
    """Return the extinction k of mw, lmc or smc by table 4 of Pei 1992."""
    law = declared("miricigale.sed", "extinction.toml")["pei1992"][galaxy]
    return _core.pei_extinction(wave, **law)


_CURVES = {
    "calzetti": _core.attenuation_curve,
    "milky_way": milky_way,
    "power_law": _core.power_law_attenuation,
    "smc": _core.smc_power_law,
    "pei1992": _pei1992,
}
_MAG = -0.4 * np.log(10.0)


@cached(maxsize=64)
def _exponents(wave, law, *shape):
    """
    Return the first and last wavelength that a law dims, and ln of what one magnitude leaves there.

    A grid is asked for with thousands of amounts of dust: it is known by its bytes, which are
    hashed in 2 us.
    """
    wave = np.frombuffer(wave)
    exponent = _MAG * _CURVES[law](wave, *shape)
    if law != "calzetti":  # of whose curve the wing of a bump is left there
        exponent[wave <= _core.LYMAN_LIMIT] = 0.0
    inside = np.flatnonzero(exponent)
    if inside.size:
        first = int(inside[0])
        last = int(inside[-1]) + 1
    else:
        first = 0
        last = 0
    part = exponent[first:last].copy()
    part.flags.writeable = False
    return first, last, part


def _dimmed(wave, amount, law, *shape):
    """Return the 10^(-0.4 k amount), as a new array that cannot be written to."""
    first, last, part = _exponents(_core.wave_key(wave), law, *shape)
    out = np.ones(np.shape(wave))
    flat = out.reshape(-1)[first:last]
    np.multiply(part, amount, out=flat)
    np.exp(flat, out=flat)
    out.flags.writeable = False
    return out


class Attenuation(Component):
    """
    Base: `factors` gives transmissions for young and old stars, `gas_factor` that for gas.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import CalzettiLeitherer
    >>> law = CalzettiLeitherer(ebv=0.3)
    >>> values = {name: par.default for name, par in law.parameters.items()}
    >>> young, old = law.factors(np.array([0.15, 0.55, 2.2]), values)
    >>> young.round(3)
    array([0.058, 0.327, 0.903])
    """

    role = "attenuation"

    def factors(self, wave, values):
        """
        Transmission at rest wavelengths.

        Parameters
        ----------
        wave : `~numpy.ndarray`
            Rest wavelengths in um.
        values : dict
            Values of the parameters.

        Returns
        -------
        young, old : `~numpy.ndarray`, shape of ``wave``
            From 0 to 1 for stars below and above 10 Myr. Not to be written to; one array twice
            where they are the same.
        """
        raise NotImplementedError

    def gas_factor(self, wave, values):
        """
        Transmission for lines and continuum of the gas, where it is not that of the stars.

        Parameters are those of `factors`.

        Returns
        -------
        gas : `~numpy.ndarray`, shape of ``wave``, or None
            From 0 to 1, not to be written to, for the gas around stars of any age. None: gas is
            dimmed as the stars that it surrounds.
        """
        return None


class _Screen(Attenuation):
    """A curve k(lambda) times a color excess, which old stars have a share of."""

    ebv = Parameter(
        0.3, (0.0, 3.0), "Color excess of stars below 10 Myr.", unit="mag", absent_at_zero=True
    )
    ebv_factor = Parameter(1.0, (0.0, 1.0), "Color excess of older stars over that of young ones.")

    def _law(self, values):
        raise NotImplementedError

    def factors(self, wave, values):
        """See `Attenuation.factors`."""
        law = self._law(values)
        ebv = values["ebv"]
        factor = values["ebv_factor"]
        young = _dimmed(wave, ebv, *law)
        return young, young if factor == 1.0 else _dimmed(wave, ebv * factor, *law)


class _Starburst(Attenuation):
    """The starburst curve with a free slope and an ultraviolet bump."""

    options = {"ebv_scaling": ("exact", "cigale")}
    uv_bump = Parameter(0.0, (0.0, 10.0), "Amplitude of the ultraviolet bump in k (Milky Way: 3).")
    slope = Parameter(0.0, (-1.2, 0.6), "Change of the curve's power-law slope.")
    uv_bump_wavelength = Parameter(0.2175, (0.18, 0.26), "Center of the bump.", unit="um")
    uv_bump_width = Parameter(
        0.035, (0.005, 0.1), "Full width at half maximum of the bump.", unit="um"
    )

    def _law(self, values):
        bump = values["uv_bump"]
        if bump == 0.0:
            return "calzetti", values["slope"]
        center = values["uv_bump_wavelength"]
        width = values["uv_bump_width"]
        return "calzetti", values["slope"], bump, center, width, self.ebv_scaling


@register
class CalzettiLeitherer(_Starburst, _Screen):
    """
    Starburst attenuation with a free slope and an ultraviolet bump.

    Calzetti et al. 2000, continued by Leitherer et al. 2002 from 0.15 down to 0.0912 um (0
    below), times (lambda / 0.55 um)^slope, plus a Drude bump, scaled in E(B-V) as Noll et al.
    2009 and CIGALE do. The formula of Calzetti et al. for 0.63-2.2 um is continued to 3.115 um,
    where it reaches 0; beyond, only the wing of a bump is left.

    Parameters
    ----------
    ebv_scaling : {"exact", "cigale"}
        What the scaling keeps. ``"exact"``: k(0.44 um) - k(0.55 um) is that of the starburst curve,
        1.012, whatever the slope and the bump. ``"cigale"``: that of the starburst curve plus the
        bump, as in the code of CIGALE; the whole curve is then higher by 0.5 % for each unit of
        ``uv_bump``. Without a bump they are the same.
    **defaults
        New defaults of parameters.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import CalzettiLeitherer
    >>> law = CalzettiLeitherer(ebv=0.3, uv_bump=3.0)
    >>> values = {name: par.default for name, par in law.parameters.items()}
    >>> young, old = law.factors(np.array([0.15, 0.2175, 0.55]), values)
    >>> (-2.5 * np.log10(young)).round(2)  # magnitudes
    array([3.09, 3.39, 1.2 ])
    """

    name = "calzetti"
    reference = (
        "Calzetti et al. 2000, ApJ 533, 682; Leitherer et al. 2002, ApJS 140, 303; "
        "Noll et al. 2009, A&A 507, 1793"
    )


@register
class ModifiedStarburst(_Starburst):
    """
    Gas behind more dust than the stars: an extinction law for the one, the starburst curve for
    the other.

    Lines and continuum of the gas have the color excess ``ebv_lines`` and one of four laws of
    extinction; stars of every age have ``ebv_factor_stars`` of it (0.44: Calzetti et al. 1994,
    2000) and the curve of `CalzettiLeitherer`. What both lose heats the dust. Without gas in the
    chain only the stars' part is left.

    Parameters
    ----------
    ebv_scaling : {"exact", "cigale"}
        What the scaling of the stars' curve keeps, as in `CalzettiLeitherer`.
    gas_law : {"mw", "lmc", "smc", "mw_pei1992"}
        The gas's law. ``"mw"``: Cardelli, Clayton & Mathis 1989 with the optical part of O'Donnell
        1994, given for 0.1-3.3 um and continued by its own formulae, as CIGALE does: no
        silicates. The others: six terms of Pei 1992 each, far ultraviolet to far infrared,
        silicates included, R_V = 3.16 (LMC), 2.93 (SMC), 3.08 (Milky Way). Nothing is dimmed at
        0.0912 um and below.
    **defaults
        New defaults of parameters.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import ModifiedStarburst
    >>> law = ModifiedStarburst(ebv_lines=0.5)
    >>> values = {name: par.default for name, par in law.parameters.items()}
    >>> gas = law.gas_factor(np.array([0.4863, 0.6565]), values)  # H beta and H alpha
    >>> (-2.5 * np.log10(gas)).round(2)  # magnitudes
    array([1.83, 1.26])
    """

    name = "modified_starburst"
    reference = (
        "Calzetti et al. 1994, ApJ 429, 582; Calzetti et al. 2000, ApJ 533, 682; "
        "Cardelli et al. 1989, ApJ 345, 245; O'Donnell 1994, ApJ 422, 158; Pei 1992, ApJ 395, 130"
    )
    packages = ("dust_extinction",)
    options = {"gas_law": ("mw", "lmc", "smc", "mw_pei1992")}
    ebv_lines = Parameter(
        0.3, (0.0, 5.0), "Color excess of the gas.", unit="mag", absent_at_zero=True
    )
    ebv_factor_stars = Parameter(
        0.44, (0.0, 1.0), "Color excess of the stars over that of the gas."
    )
    r_v_gas = Parameter(3.1, (2.0, 6.0), "A(V) / E(B-V) of the gas's dust, for gas_law='mw' only.")

    def factors(self, wave, values):
        """See `Attenuation.factors`; the same for young and old stars."""
        ebv = values["ebv_lines"] * values["ebv_factor_stars"]
        stars = _dimmed(wave, ebv, *self._law(values))
        return stars, stars

    def gas_factor(self, wave, values):
        """See `Attenuation.gas_factor`."""
        if self.gas_law == "mw":
            law = ("milky_way", values["r_v_gas"])
        else:
            law = ("pei1992", self.gas_law.removesuffix("_pei1992"))
        return _dimmed(wave, values["ebv_lines"], *law)


@register
class SMC(_Screen):
    """
    Extinction of the Small Magellanic Cloud as a screen before the stars.

    Nothing is dimmed at 0.0912 um and below.

    Parameters
    ----------
    law : {"smc", "pei1992"}
        ``"smc"``: k = 1.39 (lambda / um)^-1.2, the law of the polar dust of AGN (a fit to Prevot et
        al. 1984 in the ultraviolet; k(0.55 um) = 2.85 and k(0.44 um) - k(0.55 um) = 0.87, so
        that ``ebv`` is the color excess but for 13 %). ``"pei1992"``: the six terms of Pei 1992,
        with silicates and R_V = 2.93.
    **defaults
        New defaults of parameters.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import SMC
    >>> law = SMC(ebv=0.1)
    >>> values = {name: par.default for name, par in law.parameters.items()}
    >>> young, old = law.factors(np.array([0.15, 0.55]), values)
    >>> (-2.5 * np.log10(young)).round(2)  # magnitudes
    array([1.35, 0.28])
    """

    name = "smc"
    reference = "Prevot et al. 1984, A&A 132, 389; Pei 1992, ApJ 395, 130"
    options = {"law": ("smc", "pei1992")}

    def _law(self, values):
        if self.law == "pei1992":
            return ("pei1992", "smc")
        return ("smc",)


@register
class CharlotFall(Attenuation):
    """
    Birth clouds and interstellar medium: two power laws, two populations.

    Charlot & Fall 2000 with free slopes: stars below 10 Myr are behind both, older ones behind
    the interstellar medium, A(lambda) = A_V (lambda / 0.55 um)^slope. Nothing is dimmed at 0.0912
    um and below. Defaults are CIGALE's.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import CharlotFall
    >>> law = CharlotFall(av_ism=0.6, mu=0.3)
    >>> values = {name: par.default for name, par in law.parameters.items()}
    >>> young, old = law.factors(np.array([0.55]), values)
    >>> print(f"A_V {-2.5 * np.log10(young[0]):.2f} (young), {-2.5 * np.log10(old[0]):.2f} (old)")
    A_V 2.00 (young), 0.60 (old)
    """

    name = "charlot_fall"
    reference = "Charlot & Fall 2000, ApJ 539, 718; Boquien et al. 2019, A&A 622, A103"
    av_ism = Parameter(
        1.0, (0.0, 10.0), "A_V of the interstellar medium.", unit="mag", absent_at_zero=True
    )
    mu = Parameter(
        0.44, (1e-4, 1.0), "A_V of the interstellar medium over that of it and the birth clouds."
    )
    slope_ism = Parameter(-0.7, (-3.0, 0.0), "Slope of attenuation in the interstellar medium.")
    slope_bc = Parameter(-1.3, (-3.0, 0.0), "Slope of attenuation in the birth clouds.")

    def factors(self, wave, values):
        """See `Attenuation.factors`."""
        av = values["av_ism"]
        mu = values["mu"]
        old = _dimmed(wave, av, "power_law", values["slope_ism"])
        if mu == 1.0:
            return old, old
        young = old * _dimmed(wave, av * (1.0 - mu) / mu, "power_law", values["slope_bc"])
        young.flags.writeable = False
        return young, old
