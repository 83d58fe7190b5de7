"""The catalog of sources: its columns, what is refused and what is flagged."""

from collections.abc import Mapping

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from miricigale.filters.photometry_table import as_photometry
from miricigale.filters.surveys import flux_bands, is_band
from miricigale.profiles.sersic import describe_faults, sersic_faults
from miricigale.utils.arrays import nans
from miricigale.utils.column_units import quantity_table
from miricigale.utils.exceptions import CatalogWarning, argument_error, warn
from miricigale.utils.ids import id_column, likely_ids
from miricigale.utils.missing_values import own_mask, plain_floats, without_codes
from miricigale.utils.named_values import without, without_none
from miricigale.utils.options import check_that, check_type
from miricigale.utils.package_tables import declared
from miricigale.utils.positions import as_positions
from miricigale.utils.tables import (
    Flags,
    as_table,
    ascii_ids,
    check_units,
    error_column,
    read_ids,
    require_columns,
    unique_ids,
)
from miricigale.utils.units import FNU, flux_unit, own_unit

_DECLARED = declared("miricigale.scene", "columns.toml")
#: Columns that every catalog has, with their unit (None: dimensionless or not a number).
CATALOG_COLUMNS = {n: u.Unit(unit) if unit else None for n, unit in _DECLARED["catalog"].items()}

#: What makes a Sersic profile.
_SHAPE = ("half_light_radius", "sersic_index", "axis_ratio", "position_angle")

PROFILES = ("sersic", "point", "cutout")


class CatalogFlags(Flags):
    """
    What is wrong with a row of a catalog; the row is kept.

    Examples
    --------
    >>> from miricigale.scene import CatalogFlags, read_catalog
    >>> CatalogFlags.names(CatalogFlags.NO_FLUX)
    ['no_flux']
    >>> catalog = read_catalog("catalog.goodss")
    >>> CatalogFlags.names(int(max(catalog["flags"])))
    ['no_redshift']
    """

    BAD_RADIUS = 1, "a Sersic profile without a positive radius: drawn as a point"
    BAD_INDEX = 2, "index outside the range that profiles are made for: drawn as a point"
    BAD_AXIS_RATIO = 4, "not in (0, 1]: drawn as a point"
    BAD_ANGLE = 8, "not finite: drawn as a point unless it is round"
    NO_REDSHIFT = 16, "not finite or not positive (stars)"
    NO_FLUX = 32, "no band has a positive flux (with a positive error, where it has errors)"
    MISSING_CODE = 64, "a flux or error was a number that stands for no value, such as -99"

    @classmethod
    def unusable_profile(cls):
        """Return the bits that make a Sersic profile be drawn as a point."""
        return cls.BAD_RADIUS | cls.BAD_INDEX | cls.BAD_AXIS_RATIO | cls.BAD_ANGLE


#: Flag of a column that makes no Sersic profile.
_OF_SHAPE = {
    "half_light_radius": CatalogFlags.BAD_RADIUS,
    "sersic_index": CatalogFlags.BAD_INDEX,
    "axis_ratio": CatalogFlags.BAD_AXIS_RATIO,
    "position_angle": CatalogFlags.BAD_ANGLE,
}


def _plain_column(table, name, unit, argument):
    """Return a column as numbers in ``unit``, NaN where it has none or one that stands for no value."""
    values = plain_floats(table[name], name, argument)
    wanted = f"a table with one number a row in {name!r}"
    got = f"a column of shape {values.shape} (column[:, 0] is its first number)"
    check_that(values.ndim == 1, argument, wanted, got)
    if name != "position_angle":  # an angle on the sky may be -99
        values[without_codes(values)[0]] = np.nan
    values = u.Quantity(values, own_unit(table[name])).to(unit or u.one)
    if unit:
        return values
    return values.value


def _flux_units(table, filters):
    """Return the unit of fluxes by name, for filters that are asked for and those that are columns."""
    names = [*filters, *(name for name in table.colnames if is_band(name))]
    return dict.fromkeys(names, FNU)


def as_sources(data, filter, argument="catalog", *, units=None, takes_units=False):
    """
    Return the table of sources with our names of columns, of any table.

    Parameters
    ----------
    data : `~astropy.table.Table` or anything for `~miricigale.filters.photometry_table.as_photometry`
        Besides fluxes, shapes may have names that are usual elsewhere (``re``, ``n``, ``q``, ``pa``).
    filter : str
        The band of the fluxes that are meant.
    argument : str, optional
        What the table is called in messages.
    units : dict of str to unit-like, or unit-like, optional
        Units of columns that have none, by their names in ``data``; or that of the flux alone.
    takes_units : bool, optional
        Whether the function that the user calls has an argument ``units``, for messages.

    Returns
    -------
    table : `~astropy.table.QTable`
        A copy.

    Raises
    ------
    `~astropy.units.UnitsError`
        If radii, angles or fluxes have no unit, or a wrong one; the message names all that have none.
    ValueError
        If ``units`` names a column that is not there.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import Table
    >>> from miricigale.scene import as_sources
    >>> table = Table({"ID": [1], "F770W": [3] * u.uJy, "re": [0.4] * u.arcsec})
    >>> as_sources(table, "miri.f770w").colnames
    ['id', 'miri.f770w', 'half_light_radius']
    """
    user_table = as_table(data, argument)
    unit_of_flux = units
    if isinstance(units, Mapping):
        user_table = _with_units(user_table, units)
        unit_of_flux = None
    photometry = as_photometry(user_table, [filter], argument, units=unit_of_flux)
    table = QTable(photometry, copy=True)
    # columns keep their order; ids that are counted come last
    user_names = dict(zip(table.colnames, user_table.colnames, strict=False))
    for ours, aliases in _DECLARED["other_names"].items():
        theirs = [name for name in table.colnames if name.lower() in aliases]
        if ours not in table.colnames and theirs:
            table.rename_column(theirs[0], ours)
            user_names[ours] = user_names.pop(theirs[0])
    expected = without_none(CATALOG_COLUMNS) | _flux_units(table, [filter])
    check_units(table, expected, argument, user_names=user_names, takes_units=takes_units)
    return table


def _with_units(table, units):
    """Return a table with the units that a user says of columns without one."""
    absent = [name for name in units if name not in table.colnames]
    wanted = f"a dict with keys among {table.colnames}"
    check_that(not absent, "units", wanted, absent)
    stated = {name: unit for name, unit in units.items() if own_unit(table[name]) is None}
    for name, unit in stated.items():
        # usual words such as maggies
        stated[name] = flux_unit(unit) or u.Unit(unit)
    return QTable(table, units=stated)


def check_catalog(table, *, filters=(), wcs=None, argument="catalog"):
    """
    Check a catalog and bring it into the package's units.

    Parameters
    ----------
    table : `~astropy.table.Table`
        With positions (see `~miricigale.utils.positions.as_positions`) and fluxes, whose columns are called
        by their filter (``"miri.f770w"``), those of errors end on ``_err``. The other columns of
        `CATALOG_COLUMNS` may be there, ids must (`miricigale.utils.ids.id_column`). Without ``profile`` sources
        with a complete shape are Sersic profiles and the others points. Where ``profile`` says ``"sersic"``,
        radii and indices are needed; profiles are round without ``axis_ratio``. ``star`` (bool) marks stars.
    filters : iterable of str, optional
        Flux columns that must be there.
    wcs : `~astropy.wcs.WCS`, optional
        World coordinates of pixels ``x`` and ``y``, where there are no other positions.
    argument : str, optional
        What the table is called in messages.

    Returns
    -------
    catalog : `~astropy.table.QTable`
        A copy with ``sky`` in ICRS, radii in arcsec, angles in deg, fluxes in uJy and a
        column ``flags`` (`CatalogFlags`); ``star`` is False throughout where there was none.
        -99, -999 and the like in fluxes, errors, redshifts and shapes are NaN. Other columns
        are kept.

    Raises
    ------
    ValueError
        If ids, positions or fluxes are missing, ``star`` is not bool, an id is there twice or is no integer
        nor ASCII text, a position is not finite, a profile has an unknown name or there are no rows.
    `~astropy.units.UnitsError`
        If a column has no unit or a wrong one; a column called by a filter must be a flux.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        If there is no column ``profile``, with the number of sources that are points; and of Sersic profiles that
        are drawn as points, with their numbers by the column that is missing or wrong.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from miricigale.scene import check_catalog
    >>> table = QTable({"id": [1, 2], "ra": [53.1, 53.2], "dec": [-27.8, -27.9]})
    >>> table["miri.f770w"] = [3e-6, 5e-6] * u.Jy
    >>> table["profile"] = "point"
    >>> check_catalog(table)["id", "miri.f770w", "profile", "flags"].pprint()
     id miri.f770w profile flags
           uJy
    --- ---------- ------- -----
      1        3.0   point    16
      2        5.0   point    16
    """
    check_type(table, argument, Table, "a table")
    catalog = quantity_table(table, copy=True)
    check_that(len(catalog), argument, "a table with rows", "none")
    _name_ids(catalog, argument)
    catalog["sky"] = as_positions(catalog, argument, wcs)
    points = list(_fill_columns(catalog, argument))
    units = without_none(CATALOG_COLUMNS)
    units |= _flux_units(catalog, filters)
    require_columns(catalog, [*CATALOG_COLUMNS, *filters], argument, units=units)
    catalog["id"] = _checked_ids(catalog, argument)
    catalog["profile"] = _checked_profiles(catalog["profile"], argument)
    numbers = without(CATALOG_COLUMNS, ("id", "sky", "profile"))
    for name in catalog.colnames:
        unit = own_unit(catalog[name])
        linear = isinstance(unit, u.UnitBase)  # a magnitude is none
        if "." in name and linear and unit.is_equivalent(FNU):
            numbers[name] = FNU
    for name, unit in numbers.items():
        catalog[name] = _plain_column(catalog, name, unit, argument)
    if "star" not in catalog.colnames:
        catalog["star"] = np.zeros(len(catalog), dtype=bool)
    _check_stars(catalog["star"], argument)
    catalog["flags"] = _flags(catalog)
    catalog["flags"].info.description = CatalogFlags.describe()
    faults = describe_faults(_sersic_faults(catalog), catalog["profile"] == "sersic")
    if faults:
        points.append(f"{faults} (flagged)")
    for text in points:
        warn(f"{argument}: {text}", CatalogWarning)
    return catalog


def _name_ids(catalog, argument):
    """Call the column of ids ``id``; refuse a catalog without one."""
    ids = id_column(catalog.colnames, argument)
    if ids is None:
        looks = likely_ids(catalog)
        hint = ""
        if looks:
            hint = f" ({looks[0]!r} looks like ids: name it 'id')"
        raise argument_error(
            argument, "a table with the columns ['id']", f"columns {catalog.colnames}{hint}"
        )
    if ids != "id":
        catalog.rename_column(ids, "id")


def _checked_ids(catalog, argument):
    """Return the ids of a catalog, integers or ASCII text; refuse others, and one that is there twice."""
    ids = read_ids(catalog, argument)
    wanted = "a table with integers or text in 'id'"
    # a number with a fraction is rather a measurement
    is_plain = ids.dtype.kind in "iu" or (ids.dtype.kind == "U" and catalog["id"].dtype.kind != "f")
    check_that(is_plain, argument, wanted, catalog["id"].dtype)
    return unique_ids(ascii_ids(ids, argument), argument)


def _checked_profiles(profile, argument):
    """Return the names of profiles as text; refuse unknown and missing ones."""
    if hasattr(profile, "mask"):
        profile = profile.filled("")
    profile = np.asarray(profile).astype(str)
    unknown = sorted(set(profile.tolist()) - set(PROFILES))
    check_that(not unknown, argument, f"a table with 'profile' among {PROFILES}", unknown)
    return profile


def _check_stars(star, argument):
    """Refuse a column of stars that is not True or False in each row."""
    got = "missing values"
    if star.dtype != bool:
        got = star.dtype
    good = star.dtype == bool and not np.any(own_mask(star))
    check_that(good, argument, "a table with True or False in 'star'", got)


def _fill_columns(table, argument):
    """Add missing columns of redshifts and profiles to a table; yield what has become a point, and why."""
    missing = [name for name in _SHAPE if name not in table.colnames]
    if "profile" in table.colnames:
        sersic = _checked_profiles(table["profile"], argument) == "sersic"
        if missing and sersic.any():
            _complete_sersic(table, missing, sersic, argument)
    for name in ("redshift", *missing):
        if name not in table.colnames:
            table[name] = nans(len(table)) * (CATALOG_COLUMNS[name] or u.one)
    if "profile" in table.colnames:
        return
    usable = np.full(len(table), not missing)
    for name in () if missing else _SHAPE:
        values = plain_floats(table[name], name, argument)
        usable &= np.isfinite(values) & ((values > 0) | (name == "position_angle"))
    table["profile"] = np.where(usable, "sersic", "point")
    n = int(np.count_nonzero(~usable))
    if n:
        why = "incomplete or not positive shapes"
        if missing:
            why = f"no column {missing[0]!r}"
        yield f"{n} of {len(table)} sources are points ({why})"


def _complete_sersic(table, missing, sersic, argument):
    """Make Sersic profiles without an axis ratio round; refuse a table that lacks what these rows need."""
    if "axis_ratio" in missing:
        table["axis_ratio"] = 1.0
        missing.remove("axis_ratio")
    needed = [name for name in missing if name != "position_angle"]
    # round profiles need no angle
    ratio = plain_floats(table["axis_ratio"], "axis_ratio", argument)
    if "position_angle" in missing and np.any(ratio[sersic] != 1.0):
        needed.append("position_angle")
    wanted = f"a table with the columns {needed}, for its Sersic profiles"
    check_that(not needed, argument, wanted, f"columns {table.colnames}")


def _sersic_faults(catalog):
    """Which rows of a checked catalog have numbers that make no Sersic profile, by column."""
    return sersic_faults(
        radius=catalog["half_light_radius"].value,
        index=catalog["sersic_index"],
        ratio=catalog["axis_ratio"],
        angle=catalog["position_angle"].value,
    )


def _flags(catalog):
    flags = np.zeros(len(catalog), dtype=int)
    sersic = catalog["profile"] == "sersic"
    for name, rows in _sersic_faults(catalog).items():
        flags[sersic & rows] |= _OF_SHAPE[name]
    flags[~(catalog["redshift"] > 0)] |= CatalogFlags.NO_REDSHIFT
    if bands := flux_bands(catalog.colnames):
        usable = np.any([_usable(catalog, name) for name in bands], axis=0)
        flags[~usable] |= CatalogFlags.NO_FLUX
    return flags


def _usable(catalog, name):
    """Tell which sources have a positive flux in a band, with a positive error if it has errors."""
    names = [n for n in (name, error_column(name)) if n in catalog.colnames]
    return np.all([(catalog[n].value > 0) & np.isfinite(catalog[n].value) for n in names], axis=0)
