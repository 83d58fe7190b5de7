"""Columns of tables with curves: wavelengths, and the throughput or flux density at each."""

import re

import astropy.units as u

from miricigale.utils.options import check_data
from miricigale.utils.units import FLAM, own_unit

#: Units as STScI and others write them, in lower case.
_WAVE_UNITS = {
    "a": u.AA, "angstrom": u.AA, "angstroms": u.AA,
    "micron": u.um, "microns": u.um, "micrometer": u.um, "micrometers": u.um,
    "nanometer": u.nm, "nanometers": u.nm,
}  # fmt: skip
_FLUX_UNITS = {"flam": FLAM, "fnu": FLAM * u.AA / u.Hz}
#: Names of columns of wavelengths.
_WAVE_NAME = re.compile(r"wave|lambda|λ|^lam$|\bwl\b", re.IGNORECASE)
#: Names of columns of flux densities.
FLUX_NAME = re.compile(r"flux(?:_?density)?|f_?nu|f_?lam(?:bda)?|s_?nu", re.IGNORECASE)
#: Names of columns that tell how good another one is.
_QUALITY_NAME = re.compile(
    r"(?:^|[_\W\d])(?:e|d|err|errors?|unc|uncert\w*|sigma|std\w*|var|variance|ivar|weights?|dq|flags?|mask)(?:$|[_\W\d])",
    re.IGNORECASE,
)


def unit_of_wavelengths(unit):
    """
    Return the unit of a column of wavelengths, also of names that astropy does not have.

    Parameters
    ----------
    unit : `~astropy.units.Unit`, str or None
        As the table has it: ``ANGSTROMS`` and ``microns`` are known, and ``A`` is an Angstrom.

    Returns
    -------
    unit : `~astropy.units.Unit`, str or None
        The same for any other.
    """
    return _WAVE_UNITS.get(str(unit).strip().lower(), unit)


def unit_of_fluxes(unit):
    """
    Return the unit of a column of flux densities, also by the names of STScI, ``FLAM`` and ``FNU``.

    Parameters
    ----------
    unit : `~astropy.units.Unit`, str or None
        As the table has it.

    Returns
    -------
    unit : `~astropy.units.Unit`, str or None
        The same for any other.
    """
    return _FLUX_UNITS.get(str(unit).strip().lower(), unit)


def is_quality(name):
    """Whether a column is called an error, a weight or a flag."""
    return _QUALITY_NAME.search(name) is not None


def curve_columns(table, value_name, path):
    """
    Find the wavelengths of a curve, and what is given at them.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The curve.
    value_name : `re.Pattern`
        Names of the values that are wanted.
    path : path-like
        The file, for messages.

    Returns
    -------
    wave, value : str
        The columns that are called so, or whose unit is a length; without such names the first two, of
        which errors, weights and flags are none.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there are not two columns, or several are called as the values are.
    """
    waves = [name for name in table.colnames if _is_wave(table, name)]
    wave = (waves or table.colnames)[0]
    candidates = [name for name in table.colnames if name != wave and not is_quality(name)]
    named = [name for name in candidates if value_name.search(name)]
    # "flux" beside "flux_of_lines"
    exact = [name for name in named if value_name.fullmatch(name)]
    if len(exact) == 1:
        named = exact
    problem = f"has several columns that may be meant, {', '.join(named)}: leave one of them"
    check_data(len(named) < 2, path, problem)
    values = named or candidates
    check_data(values, path, f"has not two columns with a curve, only {', '.join(table.colnames)}")
    return wave, values[0]


def _is_wave(table, name):
    """Whether a column holds wavelengths by its unit, or without one by its name."""
    unit = unit_of_wavelengths(own_unit(table[name]))
    if unit is None or isinstance(unit, u.UnrecognizedUnit):
        return _WAVE_NAME.search(name) is not None
    return isinstance(unit, u.UnitBase) and unit.is_equivalent(u.m)
