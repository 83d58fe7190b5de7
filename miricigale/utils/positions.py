"""Positions on the sky in any of the usual forms."""

import re

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from miricigale.utils.exceptions import argument_error, units_error
from miricigale.utils.missing import floats, plain_floats, without_codes
from miricigale.utils.options import check_that

_WANTED = "one SkyCoord, text such as '150.1 +2.2' or '10h00m24s +02d12m00s', or (ra, dec) in deg"
#: Columns of right ascension and declination, in lower case and without ``_j2000``.
_PAIRS = (
    ("ra", "dec"),
    ("alpha", "delta"),
    ("alphawin", "deltawin"),
    ("raj2000", "dej2000"),
    ("raj2000", "decj2000"),
)


def as_position(value, argument):
    """
    One position of whatever says where it is.

    Parameters
    ----------
    value : `~astropy.coordinates.SkyCoord`, str or sequence of two
        Text is in degrees, or in hours and degrees where it has an ``h``, colons or six numbers; of a pair
        bare numbers are degrees.
    argument : str
        The argument's name, for the message.

    Returns
    -------
    position : `~astropy.coordinates.SkyCoord`
        One position, ICRS.

    Raises
    ------
    ValueError
        If it is nothing of these, or not finite.
    """
    try:
        if isinstance(value, str):
            hours = re.search("[hH:]", value) or len(value.split()) > 2
            position = SkyCoord(value, unit=(u.hourangle if hours else u.deg, u.deg))
        elif isinstance(value, SkyCoord):
            position = value
        else:
            position = SkyCoord(*(u.Quantity(angle, u.deg) for angle in value))
        # a `ValueError` of more than one
        position = position.reshape(()).icrs
    except (TypeError, ValueError) as err:
        raise argument_error(argument, _WANTED, f"{value!r} ({err})") from None
    check_that(np.isfinite([position.ra.deg, position.dec.deg]).all(), argument, "finite", value)
    return SkyCoord(position.ra, position.dec)


def as_positions(table, argument, wcs=None, *, missing=False):
    """
    Positions of the rows of a table, by whichever of its columns have them.

    Parameters
    ----------
    table : `~astropy.table.Table`
        With ``sky`` or another column of `~astropy.coordinates.SkyCoord`; ``ra`` and ``dec`` in any case and
        unit (degrees without one), also ``ALPHA_J2000`` and ``RAJ2000``; or, with a WCS, pixels ``x`` and ``y``.
    argument : str
        What the table is called in messages.
    wcs : `~astropy.wcs.WCS`, optional
        For 0-based pixels.
    missing : bool, optional
        Whether positions may be missing, which are then NaN.

    Returns
    -------
    sky : `~astropy.coordinates.SkyCoord`
        ICRS.

    Raises
    ------
    ValueError
        If there are no such columns, or a position is not finite and ``missing`` is False.
    """
    skies = [name for name in table.colnames if isinstance(table[name], SkyCoord)]
    columns = {}
    for name in table.colnames:
        columns.setdefault(name.lower().removesuffix("_j2000"), name)
    pair = next(((columns[a], columns[b]) for a, b in _PAIRS if {a, b} <= set(columns)), None)
    if "sky" in skies or (skies and pair is None):
        sky = table["sky" if "sky" in skies else skies[0]].icrs
    elif pair is not None:
        angles = [_degrees(table, name, argument) for name in pair]
        sky = SkyCoord(*angles, unit="deg")
    elif wcs is not None and {"x", "y"} <= set(columns):
        pixels = [plain_floats(table[columns[name]], columns[name], argument) for name in "xy"]
        sky = wcs.pixel_to_world(*pixels).icrs
    else:
        wanted = "a table with positions: 'sky' (SkyCoord), or 'ra' and 'dec'"
        wanted += "" if wcs is None else ", or pixels 'x' and 'y'"
        raise argument_error(argument, wanted, f"the columns {table.colnames}")
    # masked positions are missing ones
    angles = [floats(sky.ra.deg), floats(sky.dec.deg)]
    bad = np.flatnonzero(~(np.isfinite(angles[0]) & np.isfinite(angles[1])))
    if bad.size and not missing:
        wanted = "a table of finite positions"
        raise argument_error(argument, wanted, f"{bad.size} that are not, first in row {bad[0]}")
    return SkyCoord(*angles, unit="deg")


def _degrees(table, name, argument):
    """Angles in degrees, NaN where they are missing."""
    column = table[name]
    unit = getattr(column, "unit", None) or u.deg
    if not u.Unit(unit).is_equivalent(u.deg):
        raise units_error(argument, "an angle", unit, column=name)
    values = plain_floats(column, name, argument)
    values[without_codes(values)[0] | np.isinf(values)] = np.nan
    return values * u.Unit(unit).to(u.deg)


def sky_as_angles(table):
    """Copy of a table whose column ``sky`` is ``ra`` and ``dec`` in deg, for formats without positions."""
    table = table.copy(copy_data=False)
    if "sky" in table.colnames:
        at = table.colnames.index("sky")
        angles = [table["sky"].ra.deg, table["sky"].dec.deg] * u.deg
        table.add_columns(list(angles), indexes=[at, at], names=["ra", "dec"])
        table.remove_column("sky")
    return table
