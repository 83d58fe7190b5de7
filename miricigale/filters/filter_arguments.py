"""Filters of whatever a user gives for one."""

import os

import astropy.constants as const
import astropy.units as u
import numpy as np

from miricigale.filters.band_names import find_filter, xray_energies
from miricigale.filters.filter import Filter
from miricigale.utils.exceptions import argument_error
from miricigale.utils.table_formats import TABLE_FORMATS

_KEV = (const.h * const.c).to_value(u.keV * u.um)


def as_filter(given, name=None, *, unit=None):
    """
    Filter of anything that says which one is meant.

    Parameters
    ----------
    given : `Filter`, str, path-like, `synphot.SpectralElement` or `sedpy.observate.Filter`
        A filter, a name for `Filter.from_name`, the path of a file for `Filter.read`, or a bandpass of another
        package.
    name : str, optional
        Name of what comes from a file or a bandpass.
    unit : `~astropy.units.Unit`, optional
        As for `Filter.read`.

    Returns
    -------
    filter : `Filter`

    Raises
    ------
    KeyError
        If there is no filter of a name.
    `~miricigale.utils.exceptions.DataError`
        If a file cannot be read as a filter.
    ValueError
        If it is something else.

    Examples
    --------
    >>> import synphot
    >>> from miricigale.filters import as_filter
    >>> as_filter("IRAC 3.6")
    <Filter irac.ch1: pivot 3.5508 um, width 0.684 um>
    >>> box = synphot.SpectralElement(synphot.models.Box1D, x_0=50000, width=4000)
    >>> as_filter(box, "box")
    <Filter box: pivot 4.9987 um, width 0.400 um>
    """
    if isinstance(given, Filter):
        return given
    if isinstance(given, os.PathLike) or (isinstance(given, str) and _is_path(given)):
        return Filter.read(given, name=name, unit=unit)
    if isinstance(given, str):
        return Filter.from_name(given)
    if hasattr(given, "waveset"):
        return Filter.from_synphot(given, name=name)
    if hasattr(given, "wavelength") and hasattr(given, "transmission"):
        return Filter.from_sedpy(given, name=name)
    wanted = "a Filter, the name of one, the path of its file, or one of synphot or sedpy"
    raise argument_error(name or "filter", wanted, type(given).__name__)


def _is_path(text):
    if find_filter(text) is not None:
        return False
    endings = (".dat", ".txt", ".par", *TABLE_FORMATS)
    return text.lower().endswith(endings) or os.path.isfile(os.path.expanduser(text))


def given_filters(names):
    """
    Return the filters that a user of CIGALE gave for bands, a dict by the band of what `as_filter` takes.

    An X-ray band by its name (``xray_boxcar_0p5to2keV``) is a filter of that name, by which `xray_energies` knows
    it; a curve at its wavelengths is refused.
    """
    filters = {}
    for band, curve in (names or {}).items():
        filters[band] = _as_named_filter(band, curve)
    return filters


def _as_named_filter(band, curve):
    ends = None
    if isinstance(curve, str):
        ends = xray_energies(curve)
    if ends is not None:
        return Filter(_KEV / np.array(ends)[::-1] * u.um, [1.0, 1.0], name=curve)
    filter_ = as_filter(curve, band, unit=u.AA)
    if filter_.wave[0].to_value(u.um) < _KEV / 0.1:  # X-rays
        wanted = "the energies of an X-ray band, such as 'xray_boxcar_0p5to2keV'"
        raise argument_error("names", wanted, f"a curve of X-rays for {band!r}")
    return filter_
