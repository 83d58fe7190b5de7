"""Positions on the sky in any of the usual forms."""

import re

import astropy.units as u
import numpy as np
from astropy.coordinates import Angle, SkyCoord, UnitSphericalRepresentation
from astropy.time import Time

from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import CatalogWarning, argument_error, units_error, warn
from miricigale.utils.missing_values import (
    floats,
    is_missing_word,
    mask_of,
    plain_floats,
    without_codes,
)
from miricigale.utils.options import check_that
from miricigale.utils.units import angle_unit, own_unit

_WANTED = "one SkyCoord, text such as '150.1 +2.2' or '10h00m24s +02d12m00s', or (ra, dec) in deg"
#: Columns of right ascension and declination, in lower case and without ``_j2000``: those of surveys, VizieR and
#: Source Extractor.
_PAIRS = (
    ("ra", "dec"),
    ("alpha", "delta"),
    ("alphawin", "deltawin"),
    ("raj2000", "dej2000"),
    ("raj2000", "decj2000"),
    ("_raj2000", "_dej2000"),
    ("ra_icrs", "de_icrs"),
    ("ra_deg", "dec_deg"),
    ("x_world", "y_world"),
)
#: Columns of proper motions, in lower case, and of the time of positions.
_MOTIONS = (("pmra", "pmdec"), ("pm_ra_cosdec", "pm_dec"), ("pm_ra", "pm_dec"), ("pmra", "pmde"))
_EPOCHS = ("ref_epoch", "refepoch", "obstime", "epoch")
_MOTION = u.mas / u.yr
#: Rounding of positions that is worth a word, deg; a tenth of a pixel of MIRI.
_ROUNDING = 0.011 / 3600
#: Right ascensions that are taken for degrees, which may go once around.
_RIGHT_ASCENSIONS = (-360.0, 720.0)


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
        If it is nothing of these, not finite, or has proper motions: at which time it is wanted is not known.
    """
    try:
        if isinstance(value, str):
            hours = re.search("[hH:]", value) or len(value.split()) > 2
            position = SkyCoord(value, unit=(u.hourangle if hours else u.deg, u.deg))
        elif isinstance(value, SkyCoord):
            position = at_epoch(value, None, argument)
        else:
            position = SkyCoord(*(u.Quantity(angle, u.deg) for angle in value))
        # a `ValueError` of more than one
        position = position.reshape(()).icrs
    except (TypeError, ValueError) as err:
        raise argument_error(argument, _WANTED, f"{value!r} ({err})") from None
    check_that(np.isfinite([position.ra.deg, position.dec.deg]).all(), argument, "finite", value)
    return SkyCoord(position.ra, position.dec)


def plain_positions(sky):
    """
    Positions without a mask.

    Parameters
    ----------
    sky : `~astropy.coordinates.SkyCoord`
        Masked or not.

    Returns
    -------
    sky : `~astropy.coordinates.SkyCoord`
        Itself if nothing is masked; else directions alone, NaN where they are masked.

    Raises
    ------
    ValueError
        If it is something else, such as a table or pairs of numbers.
    """
    if not hasattr(sky, "spherical"):
        wanted = "a SkyCoord, such as SkyCoord(table['ra'], table['dec'], unit='deg')"
        raise argument_error("sky", wanted, type(sky).__name__)
    place = sky.spherical
    hidden = mask_of(place.lon) | mask_of(place.lat)
    if not hidden.any():
        return sky
    lon = np.where(hidden, np.nan, getattr(place.lon, "unmasked", place.lon).to_value(u.deg))
    lat = np.where(hidden, np.nan, getattr(place.lat, "unmasked", place.lat).to_value(u.deg))
    directions = UnitSphericalRepresentation(lon * u.deg, lat * u.deg)
    return SkyCoord(sky.frame.replicate_without_data().realize_frame(directions))


def at_epoch(sky, epoch, argument):
    """
    Positions at the time of an image, by the proper motions that they carry.

    Parameters
    ----------
    sky : `~astropy.coordinates.SkyCoord`
        With or without proper motions; ``obstime`` is the time of the positions.
    epoch : `~astropy.time.Time` or None
        Time of the image; None where it is not known.
    argument : str
        What the positions are called in messages.

    Returns
    -------
    sky : `~astropy.coordinates.SkyCoord`
        ICRS, right ascension and declination alone.

    Raises
    ------
    ValueError
        If there are proper motions, and the time of the positions or that of the image is not known.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        If some of the positions have no proper motion: they stay where they are.

    Notes
    -----
    Motion is uniform and along a great circle: u + mu dt, normalized. Parallax and radial velocity, which
    change it by less than 0.1 mas in ten years for all but the nearest stars, do not count.

    References
    ----------
    ESA 1997, The Hipparcos and Tycho Catalogues, vol. 1, sec. 1.5.5.
    """
    if "s" not in sky.data.differentials:
        # positions in Cartesian coordinates have no right ascension
        angles = sky.icrs.represent_as(UnitSphericalRepresentation)
        return SkyCoord(angles.lon, angles.lat)
    icrs = sky.icrs
    east = floats(icrs.pm_ra_cosdec.to_value(u.rad / u.yr))
    north = floats(icrs.pm_dec.to_value(u.rad / u.yr))
    unknown = ~(np.isfinite(east) & np.isfinite(north))
    moving = np.where(unknown, 0.0, np.hypot(east, north)) > 0
    positions = SkyCoord(icrs.ra, icrs.dec)
    if not moving.any():
        return positions
    remedy = "sky.apply_space_motion(new_obstime=...) brings them to a time"
    if sky.obstime is None:
        wanted = "positions of a known time where they have proper motions (obstime=)"
        raise argument_error(argument, wanted, f"no obstime; {remedy}")
    if epoch is None:
        wanted = "positions without proper motions where the time of the image is not known"
        raise argument_error(argument, wanted, f"{np.count_nonzero(moving)} with; {remedy}")
    if unknown.any():
        msg = (
            f"{argument}: {np.count_nonzero(unknown)} of {unknown.size} positions have no proper motion: they "
            "stay where they are"
        )
        warn(msg, CatalogWarning)
    years = (epoch - sky.obstime).to_value(u.yr)
    # the length of the motion is that of the tangent
    distance = np.arctan(np.where(moving, years * np.hypot(east, north), 0.0)) * u.rad
    moved = positions.directional_offset_by(np.arctan2(east, north) * u.rad, distance)
    ra = np.where(moving, floats(moved.ra.deg), floats(positions.ra.deg))
    dec = np.where(moving, floats(moved.dec.deg), floats(positions.dec.deg))
    return SkyCoord(ra, dec, unit="deg")


def as_positions(table, argument, wcs=None, *, missing=False, epoch=None, motions=False):
    """
    Positions of the rows of a table, by whichever of its columns have them.

    Parameters
    ----------
    table : `~astropy.table.Table`
        With ``sky`` or another column of `~astropy.coordinates.SkyCoord`; ``ra`` and ``dec`` in any case and
        unit (degrees without one), also ``ALPHA_J2000`` and ``RAJ2000``; or, with a WCS, pixels ``x`` and ``y``.
        Text is right ascension in hours and declination in degrees (``03:32:30``, ``3h32m30s``), or a number.
    argument : str
        What the table is called in messages.
    wcs : `~astropy.wcs.WCS`, optional
        For 0-based pixels.
    missing : bool, optional
        Whether positions may be missing, which are then NaN.
    epoch : `~astropy.time.Time`, optional
        Time of the image that they are for, to which proper motions bring them (`at_epoch`).
    motions : bool, optional
        Whether columns of proper motions count beside ``ra`` and ``dec`` (`sky_with_motions`), as those of a
        `~astropy.coordinates.SkyCoord` do. A scene, which has no time, does without.

    Returns
    -------
    sky : `~astropy.coordinates.SkyCoord`
        ICRS.

    Raises
    ------
    ValueError
        If there are no such columns, two that differ in case alone, or values that are no such angles; if a
        position is not finite and ``missing`` is False, or there are proper motions without both times.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        If positions are rounded by more than a tenth of a pixel, as in single precision.
    """
    skies = [name for name in table.colnames if isinstance(table[name], SkyCoord)]
    columns = _by_plain_name(table.colnames)
    pair = next(((columns[a], columns[b]) for a, b in _PAIRS if {a, b} <= set(columns)), None)
    if "sky" in skies or (skies and pair is None):
        sky = at_epoch(table["sky" if "sky" in skies else skies[0]], epoch, argument)
    elif pair is not None:
        for name in pair:
            _check_only(table.colnames, name, argument)
        sky = SkyCoord(*_sky_degrees(table, pair, argument), unit="deg")
        if motions:
            sky = at_epoch(sky_with_motions(table, sky, columns, argument), epoch, argument)
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


def sky_with_motions(table, sky, columns, argument):
    """
    Positions with the proper motions that columns of their table state.

    Parameters
    ----------
    table : `~astropy.table.Table`
        ``pmra`` and ``pmdec`` in any case and unit of an angle by time (mas / yr without one), that of right
        ascension with the cosine of the declination, as Gaia has it; also ``pm_ra_cosdec`` and ``pmRA`` with
        ``pmDE``. The time of the positions is ``ref_epoch``, in years (J2016.0 as 2016.0) or a
        `~astropy.time.Time`.
    sky : `~astropy.coordinates.SkyCoord`, shape (n,)
        Positions, ICRS.
    columns : dict of str to str
        Names of the columns by their names in lower case.
    argument : str
        What the table is called in messages.

    Returns
    -------
    sky : `~astropy.coordinates.SkyCoord`
        With ``obstime``; as it was where no row moves.

    Raises
    ------
    `~astropy.units.UnitsError`
        If a motion has another unit.
    ValueError
        If a row moves and the time of its position is not there.
    """
    names = [pair for pair in _MOTIONS if set(pair) <= set(columns)]
    if not names:
        return sky
    east, north = (_motion(table, columns[name], argument) for name in names[0])
    moving = np.nan_to_num(np.hypot(east, north)) > 0
    if not moving.any():
        return sky
    epoch = next((columns[name] for name in _EPOCHS if name in columns), None)
    wanted = "a table with 'ref_epoch', the time of its positions, where it has proper motions"
    if epoch is None:
        got = f"the columns {table.colnames}; without {columns[names[0][0]]} positions count as they are"
        raise argument_error(argument, wanted, got)
    years = table[epoch]
    years = years.jyear if isinstance(years, Time) else _plain_years(years, epoch, argument)
    lost = np.flatnonzero(moving & ~((years > 1800) & (years < 2200)))
    if lost.size:
        wanted = f"years such as 2016.0 in {epoch!r} where there are proper motions"
        raise argument_error(argument, wanted, f"{years[lost[0]]} in row {lost[0]}")
    # a row without motion needs no time
    years = np.where(moving, years, 2000.0)
    motions = {"pm_ra_cosdec": east * _MOTION, "pm_dec": north * _MOTION}
    return SkyCoord(sky.ra, sky.dec, obstime=Time(years, format="jyear"), **motions)


def middle_pixel(shape):
    """Pixel (x, y) in the middle of an image of a shape (ny, nx)."""
    ny, nx = shape
    return (nx - 1) / 2, (ny - 1) / 2


def _known_floats(column, name, argument):
    """Values of a column as floats, NaN where it has none, infinity or a number that stands for no value."""
    values = plain_floats(column, name, argument)
    values[without_codes(values)[0] | np.isinf(values)] = np.nan
    return values


def _factor(column, unit, kind, name, argument):
    """Factor from the unit of a column, by default ``unit``, to this one."""
    column_unit = u.Unit(own_unit(column) or unit)
    if not column_unit.is_equivalent(unit):
        raise units_error(argument, kind, column_unit, column=name)
    return column_unit.to(unit)


def _motion(table, name, argument):
    """Proper motions, mas / yr, NaN where they are missing."""
    column = table[name]
    factor = _factor(column, _MOTION, "a proper motion", name, argument)
    return _known_floats(column, name, argument) * factor


def _plain_years(column, name, argument):
    """Years as plain floats, NaN where they are missing."""
    factor = _factor(column, u.yr, "years", name, argument)
    return plain_floats(column, name, argument) * factor


def _by_plain_name(colnames):
    """Columns by their names in lower case and without ``_j2000``; the shorter name is preferred."""
    columns = {}
    for name in colnames:
        lower = name.lower()
        stem = lower.removesuffix("_j2000")
        if stem not in columns or stem == lower:
            columns[stem] = name
    return columns


def _check_only(colnames, name, argument):
    """Refuse a column of a position beside another one whose name differs in case alone."""
    namesakes = [label for label in colnames if label.lower() == name.lower()]
    check_that(
        len(namesakes) == 1, argument, f"a table with one column {name.lower()!r}", namesakes
    )


def _sky_degrees(table, pair, argument):
    """Right ascensions and declinations in degrees, NaN where they are missing."""
    ra, dec = pair
    angles = [_degrees(table, ra, u.hourangle, argument), _degrees(table, dec, u.deg, argument)]
    low, high = _RIGHT_ASCENSIONS
    _check_range(angles[0], low, high, ra, argument)
    _check_range(angles[1], -90.0, 90.0, dec, argument)
    _warn_of_rounding(table[ra], angles[0], np.cos(np.radians(angles[1])), ra, argument)
    _warn_of_rounding(table[dec], angles[1], 1.0, dec, argument)
    return angles


def _check_range(values, low, high, name, argument):
    """Refuse angles in degrees that are outside a range."""
    rows = np.flatnonzero((values < low) | (values > high))
    if rows.size:
        wanted = f"a table with angles of {low:g} to {high:g} deg in {name!r}"
        raise argument_error(argument, wanted, f"{values[rows[0]]:g} in row {rows[0]} (from 0)")


def _warn_of_rounding(column, degrees, scale, name, argument):
    """Warn if a column of floats of few digits rounds its positions."""
    dtype = np.asarray(getattr(column, "value", column)).dtype
    if dtype.kind != "f" or dtype.itemsize >= 8:
        return
    with np.errstate(invalid="ignore"):
        steps = 0.5 * np.spacing(np.abs(degrees).astype(dtype)).astype(float) * scale
    largest = np.nanmax(steps, initial=0.0)
    if largest > _ROUNDING:
        msg = (
            f"{argument}: {name!r} has floats of {8 * dtype.itemsize} bits, which round positions by up to "
            f"{3600 * largest:.2g} arcsec"
        )
        warn(msg, CatalogWarning)


def _degrees(table, name, text_unit, argument):
    """Angles in degrees, NaN where they are missing; text that is no number is in ``text_unit``."""
    column = table[name]
    unit = angle_unit(own_unit(column) or u.deg)
    if not u.Unit(unit).is_equivalent(u.deg):
        raise units_error(argument, "an angle", unit, column=name)
    if column.dtype.kind in "OSU" and _is_sexagesimal(column):
        return _of_text(column, name, text_unit, argument)
    return _known_floats(column, name, argument) * u.Unit(unit).to(u.deg)


def _texts(column):
    """Values of a column as text, and where they are missing."""
    values = np.ma.getdata(getattr(column, "value", column))
    if values.dtype.kind == "S":
        values = np.char.decode(values, "utf-8", "replace")
    texts = np.char.strip(values.astype(str))
    return texts, mask_of(column) | is_missing_word(texts)


def _is_sexagesimal(column):
    """Whether text has angles such as 03:32:30, 3h32m30s or 3 32 30."""
    texts, missing = _texts(column)
    return any(re.search(r"\d *[:hd ] *\d|\d[hd]", text) for text in texts[~missing].tolist())


def _of_text(column, name, unit, argument):
    """Angles of text in degrees, NaN where they are missing."""
    texts, missing = _texts(column)
    values = nans(texts.shape)
    for row in np.flatnonzero(~missing):
        try:
            values[row] = Angle(str(texts[row]), unit).deg
        except (ValueError, TypeError, u.UnitsError):
            wanted = f"a table with angles in {name!r}"
            got = f"{texts[row]!s:.40} in row {row} (from 0)"
            raise argument_error(argument, wanted, got) from None
    return values


def sky_as_angles(table):
    """Copy of a table whose column ``sky`` is ``ra`` and ``dec`` in deg, for formats without positions."""
    table = table.copy(copy_data=False)
    if "sky" in table.colnames:
        at = table.colnames.index("sky")
        angles = [table["sky"].ra.deg, table["sky"].dec.deg] * u.deg
        table.add_columns(list(angles), indexes=[at, at], names=["ra", "dec"])
        table.remove_column("sky")
    return table
