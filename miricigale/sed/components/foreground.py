"""Extinction by dust of the Milky Way, in the observed frame."""

import functools

import numpy as np

from miricigale.filters import FilterSet
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter
from miricigale.utils.exceptions import argument_error

__all__ = ["LAWS", "Foreground", "GalacticExtinction", "coverage", "extinction_curve"]

#: Laws of extinction with R_V, as `dust_extinction` names them, and whom to cite.
LAWS = {
    "G23": "Gordon et al. 2023, ApJ 950, 86",
    "F99": "Fitzpatrick 1999, PASP 111, 63",
    "F19": "Fitzpatrick et al. 2019, ApJ 886, 108",
    "F04": "Fitzpatrick 2004, ASP Conf. 309, 33",
    "M14": "Maiz Apellaniz et al. 2014, A&A 564, A63",
    "O94": "O'Donnell 1994, ApJ 422, 158",
    "CCM89": "Cardelli, Clayton & Mathis 1989, ApJ 345, 245",
}

#: What is done with bands that reach beyond the long end of a law.
BEYOND = ("refuse", "transparent")

_MAG = -0.4 * np.log(10.0)
_STEPS = 8192  # in ln(lambda): straight lines between them are good to 1e-5 of the extinction
_R_V = (2.0, 6.0)  # the widest of the laws


def _law(law):
    """The class of a law."""
    if law not in LAWS:
        raise argument_error("law", f"one of {', '.join(LAWS)}", repr(law))
    from dust_extinction import parameter_averages

    return getattr(parameter_averages, law)


def coverage(law):
    """
    Where a law is defined.

    Parameters
    ----------
    law : str
        One of `LAWS`.

    Returns
    -------
    low, high : float
        Wavelengths in um.

    Raises
    ------
    ValueError
        If there is no such law.
    """
    low, high = _law(law).x_range
    return 1.0 / high, 1.0 / low


def _outside(law, r_v):
    """Say why a law has no such R_V, or None."""
    low, high = _law(law).Rv_range
    if low <= r_v <= high:
        return None
    return f"'r_v' must be from {low} to {high} for the law {law}, got {r_v}"


@functools.lru_cache(maxsize=64)
def _table(law, r_v):
    """ln(first wavelength), steps per unit of ln, and A(lambda) / E(B-V) at the steps."""
    import astropy.units as u

    low, high = coverage(law)
    wave = np.geomspace(low, high, _STEPS)
    # the last digit of 1 / (1 / x) must not lie outside
    wave[0], wave[-1] = low, high
    k = r_v * np.asarray(_law(law)(Rv=r_v)(1.0 / wave / u.um), dtype=float)
    k.flags.writeable = False
    return np.log(low), (_STEPS - 1) / np.log(high / low), k


def extinction_curve(wave, law="G23", r_v=3.1):
    """
    Extinction for one magnitude of colour excess, A(lambda) / E(B-V).

    Parameters
    ----------
    wave : `~numpy.ndarray`
        Wavelengths in um.
    law : str, optional
        One of `LAWS`.
    r_v : float, optional
        A(V) / E(B-V).

    Returns
    -------
    k : `~numpy.ndarray`, shape of ``wave``
        NaN outside the `coverage` of the law. Interpolated in a table of 8192 steps in ln(lambda).

    Raises
    ------
    ValueError
        If there is no such law, or none with such an R_V.
    """
    sentence = _outside(law, r_v)
    if sentence:
        raise ValueError(sentence)
    start, scale, k = _table(law, float(r_v))
    place = (np.log(wave) - start) * scale
    # rounding at the ends
    inside = (place > -1e-6) & (place < k.size - 1 + 1e-6)
    step = np.clip(place, 0.0, k.size - 1.0)
    left = np.minimum(step.astype(int), k.size - 2)
    part = step - left
    return np.where(inside, k[left] * (1.0 - part) + k[left + 1] * part, np.nan)


def check_bands(filters, law, beyond="refuse"):
    """
    Check that a law is defined over bands.

    Parameters
    ----------
    filters : `~miricigale.filters.FilterSet` or iterable of str
        The bands.
    law : str
        One of `LAWS`.
    beyond : {"refuse", "transparent"}, optional
        Whether bands may reach beyond the long end of the law.

    Raises
    ------
    ValueError
        If more than 1e-4 of a band lies outside; the message names law, range and bands.
    """
    if beyond not in BEYOND:
        raise argument_error("beyond", f"one of {', '.join(BEYOND)}", repr(beyond))
    low, high = coverage(law)
    out = []
    for band in _filter_set(filters):
        first, last = band.wave.value[[0, -1]]
        top = max(high, 1.01 * last) if beyond == "transparent" else high
        if first >= low and last <= top:
            continue
        try:
            band.weights(np.array([low, top]))
        except ValueError:
            out.append(f"{band.name} ({first:.4g}-{last:.4g} um)")
    if out:
        msg = (
            f"the extinction law {law} is defined from {low:.4g} to {high:.4g} um and not over "
            f"the bands {', '.join(out)}"
        )
        if beyond == "refuse":
            msg += "; G23 reaches from 0.0912 to 32 um" if law != "G23" else ""
            msg += "; beyond='transparent' takes what is beyond the long end as free of extinction"
        raise ValueError(msg)


def _filter_set(filters):
    return filters if isinstance(filters, FilterSet) else FilterSet(filters)


class Foreground(Component):
    """Base: `transmission` at observed wavelengths, whatever the redshift."""

    role = "foreground"

    def transmission(self, wave, values):
        """
        Transmission of what lies in front of all.

        Parameters
        ----------
        wave : `~numpy.ndarray`, shape (n,)
            Observed wavelengths in um.
        values : dict
            Values of the parameters.

        Returns
        -------
        transmission : `~numpy.ndarray`, shape (n,)
            From 0 to 1.
        """
        raise NotImplementedError

    def check_bands(self, filters):
        """Raise a ValueError where the transmission is not known over a band."""


@register
class GalacticExtinction(Foreground):
    """
    Extinction by dust of the Milky Way.

    A(lambda) = ``ebv_galactic`` R_V [A(lambda) / A(V)], with A(lambda) / A(V) of one of the laws of
    the package dust_extinction (Gordon 2024, JOSS 9, 7023). Nothing is extrapolated: outside the
    `coverage` of the law the transmission is 1, and `check_bands` refuses bands that reach there.

    Parameters
    ----------
    law : {"G23", "F99", "F19", "F04", "M14", "O94", "CCM89"}
        The law. Only G23 (0.0912-32 um) covers the mid-infrared; the others end at 3.33 um.
    beyond : {"refuse", "transparent"}
        What `check_bands` says of bands beyond the long end of the law: refused, or taken as free
        of extinction. Bands beyond the short end are always refused.
    **defaults
        New defaults of parameters.

    Raises
    ------
    ValueError
        If the law is not defined for the default of ``r_v``.
    """

    name = "galactic_extinction"
    reference = (
        "Gordon et al. 2023, ApJ 950, 86 (G23) or that of the law; Gordon 2024, JOSS 9, 7023"
    )
    packages = ("dust_extinction",)
    options = {"law": tuple(LAWS), "beyond": BEYOND}
    ebv_galactic = Parameter(
        default=0.0, bounds=(0.0, 5.0), unit="mag", doc="Colour excess of the Milky Way's dust."
    )
    r_v = Parameter(default=3.1, bounds=_R_V, doc="A(V) / E(B-V) of the Milky Way's dust.")

    def __init__(self, **defaults):
        super().__init__(**defaults)
        sentence = _outside(self.law, self.r_v)
        if sentence:
            raise ValueError(sentence)

    def coverage(self):
        """Shortest and longest wavelength of the law in um."""
        return coverage(self.law)

    def transmission(self, wave, values):
        """See `Foreground.transmission`."""
        ebv = values["ebv_galactic"]
        if ebv == 0.0:
            return np.ones(np.shape(wave))
        k = extinction_curve(wave, self.law, values["r_v"])
        return np.exp(_MAG * ebv * np.where(np.isnan(k), 0.0, k))

    def check_bands(self, filters):
        """
        Check that the law is defined over bands.

        Parameters
        ----------
        filters : `~miricigale.filters.FilterSet` or iterable of str
            The bands.

        Raises
        ------
        ValueError
            If more than 1e-4 of a band lies outside; the message names law, range and bands.
        """
        check_bands(filters, self.law, self.beyond)

    def inert(self, values):
        """R_V where there is no dust."""
        return ("r_v",) if values["ebv_galactic"] == 0.0 else ()

    def invalid(self, values):
        """Say that the law has no such R_V."""
        return _outside(self.law, values["r_v"])
