"""Parts of a spectrum: stars, dust and AGN, and their sums; and parts in wavelength."""

import functools
import operator

import astropy.units as u
import numpy as np

from miricigale.filters.band_names import find_filter
from miricigale.utils.exceptions import unknown_name
from miricigale.utils.options import check_that
from miricigale.utils.units import WAVE, to_array


class BandFlux(u.Quantity):
    """Flux densities of a spectrum, shape (n_wave,), whose call is the flux in a band."""

    def __call__(self, band):
        return self._sed.synthetic_flux(band)

    @classmethod
    def of(cls, sed):
        """Return the flux densities of an SED."""
        flux = sed.fnu.view(cls)
        flux._sed = sed
        return flux


class Parts(dict):
    """
    Parts of a spectrum by name.

    ``"agn"`` is the sum of those of the AGN, ``"galaxy"`` that of the others, so that both make up the whole.
    """

    def __missing__(self, name):
        groups = self._groups()
        if name not in groups:
            raise unknown_name("component", name, self.names)
        return functools.reduce(operator.add, groups[name])

    def __call__(self, name=None):
        if name is None:
            return self
        return self[name]

    @property
    def names(self):
        """Names of the parts and of their sums."""
        return [*self, *self._groups()]

    def hint(self, name):
        """Say which part may be meant by an attribute of a spectrum; empty if none."""
        for part in (name, f"agn_{name}"):
            if part in self.names:
                return f"components[{part!r}] is the spectrum of this part"
        return ""

    def _groups(self):
        """Return lists of the parts in each sum."""
        groups = {"agn": [], "galaxy": []}
        for key, part in self.items():
            # light before attenuation is no part of the whole
            if not key.endswith("_intrinsic"):
                groups["agn" if key.startswith("agn_") else "galaxy"].append(part)
        return {group: parts for group, parts in groups.items() if parts}


def component_of(sed, name):
    """
    Return a part of a spectrum by its name.

    Parameters
    ----------
    sed : `~miricigale.sed.SED`
        The spectrum.
    name : str
        Of a part, or of a sum of parts.

    Returns
    -------
    part : `~astropy.units.Quantity`, shape (n_wave,)
        Its flux density.

    Raises
    ------
    KeyError
        If there is no such part; of a band or an attribute it says what gives its value.
    """
    parts = sed.components
    if name in parts.names:
        return parts[name]
    say = ""
    if name in dir(sed):
        say = f"; sed.{name} is an attribute"
    elif find_filter(name) is not None:
        say = f"; sed.synthetic_flux({name!r}) is the flux in a band"
    if not parts:
        msg = f"no component {name!r}, for the spectrum has no parts{say}"
        raise KeyError(msg)
    problem = unknown_name("component", name, parts.names)
    msg = f"{problem.args[0]}{say}"
    raise KeyError(msg)


def points_of(key, wave):
    """
    Find the points of a spectrum that a key in brackets stands for.

    Parameters
    ----------
    key : slice of `~astropy.units.Quantity`, or `~numpy.ndarray` of bool, shape (n,)
        Wavelengths between which they are, or a mask.
    wave : `~numpy.ndarray`, shape (n,)
        Wavelengths of the points, um.

    Returns
    -------
    inside : `~numpy.ndarray` of bool, shape (n,)

    Raises
    ------
    ValueError
        If it is nothing of these, or a slice has a step.
    """
    if not isinstance(key, slice):
        inside = np.asarray(key)
        is_mask = inside.dtype == bool and inside.shape == wave.shape
        wanted = "two wavelengths (sed[5 * u.um:10 * u.um]), a mask of the points or the name of a component"
        check_that(is_mask, "key", wanted, repr(key))
        return inside
    check_that(key.step is None, "key", "two wavelengths without a step", key)
    inside = np.ones(wave.size, bool)
    if key.start is not None:
        inside &= wave >= to_array(key.start, WAVE, "key", ndim=0)
    if key.stop is not None:
        inside &= wave <= to_array(key.stop, WAVE, "key", ndim=0)
    return inside
