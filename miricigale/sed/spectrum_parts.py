"""Parts of a spectrum: stars, dust and AGN, and their sums; and parts in wavelength."""

import functools
import operator

import numpy as np

from miricigale.utils.exceptions import unknown_name
from miricigale.utils.options import check_that
from miricigale.utils.units import WAVE, to_array


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

    @property
    def names(self):
        """Names of the parts and of their sums."""
        return [*self, *self._groups()]

    def _groups(self):
        """Return lists of the parts in each sum."""
        groups = {"agn": [], "galaxy": []}
        for key, part in self.items():
            # light before attenuation is no part of the whole
            if not key.endswith("_intrinsic"):
                groups["agn" if key.startswith("agn_") else "galaxy"].append(part)
        return {group: parts for group, parts in groups.items() if parts}


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
