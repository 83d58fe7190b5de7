"""Checks and joins of tables, and integer flags that explain themselves."""

import enum
from collections.abc import Mapping

import astropy.units as u
import numpy as np
from astropy.table import Table

from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error, units_error
from miricigale.utils.files import is_path
from miricigale.utils.frames import as_column, frame_columns, is_frame
from miricigale.utils.ids import id_column, ids_and_missing
from miricigale.utils.options import check_least, check_that, check_type
from miricigale.utils.units import ANGLE, FNU, flux_unit, own_unit, to_array


class Flags(enum.IntFlag):
    """
    Base of the flag sets: an IntFlag whose members have a meaning.

    A member is declared with its bit and a sentence, ``EDGE = 1, "The source is at an edge."``
    """

    def __new__(cls, value, meaning=""):
        member = int.__new__(cls, value)
        member._value_ = value
        member.meaning = meaning
        return member

    @classmethod
    def describe(cls):
        """One line of text that gives each bit its name, for a column's description."""
        bits = ", ".join(f"{m.value} {m.name.lower().replace('_', ' ')}" for m in cls if m.value)
        return f"bit flags (sum): {bits}; 0 good"

    def __str__(self):
        return ", ".join(self.names(self)) or "0"

    def __format__(self, spec):
        if spec:
            return format(int(self), spec)
        return str(self)

    @classmethod
    def names(cls, value):
        """Names of the bits set in ``value``, lower case; of an array or a column, a list for each value."""
        if np.ndim(value):
            return [cls.names(element) for element in value]
        return [m.name.lower() for m in cls if m.value and int(value) & m.value]

    @classmethod
    def meanings(cls):
        """
        Return what each bit means.

        Returns
        -------
        meanings : dict of int to tuple of str
            By value: its name in words, and a sentence.
        """
        meanings = {}
        for member in cls:
            name = member.name.lower().replace("_", " ")
            meanings[member.value] = (name, member.meaning.replace("``", ""))
        return meanings


def as_table(data, argument):
    """
    Table of anything that has columns.

    Parameters
    ----------
    data : `~astropy.table.Table`, row of one, dict, structured array, `pandas.DataFrame`, path-like or regions
        Columns by name; numbers in a dict are those of every row. Regions are positions
        (`miricigale.utils.region_files.region_table`). Of a DataFrame missing values are masked (NaN in
        floats), and an index that is not the count of the rows is a column (`miricigale.utils.frames`).
    argument : str
        The argument's name, for the message.

    Returns
    -------
    table : `~astropy.table.Table`
        Itself, if it is one.

    Raises
    ------
    ValueError
        If it is none of these, or columns differ in length.
    `~miricigale.utils.exceptions.DataError`
        If a file cannot be read as a table.
    """
    from astropy.table import QTable, Row

    from miricigale.utils.region_files import is_regions, region_table

    if isinstance(data, Table):
        return data
    if isinstance(data, Row):
        return data.table[data.index : data.index + 1]
    if is_path(data):
        from miricigale.utils.table_files import read_table

        return read_table(data, wanted="a table")
    if is_regions(data):
        return region_table(data)
    if is_frame(data):
        data = frame_columns(data, argument)
    is_records = isinstance(data, (list, tuple)) and len(data) > 0
    if is_records and all(isinstance(row, Mapping) for row in data):
        return QTable(rows=list(data))
    try:
        if isinstance(data, Mapping):
            shape = np.broadcast_shapes((1,), *map(np.shape, data.values()))
            columns = {name: _filled(column, shape[0]) for name, column in data.items()}
            return QTable(columns, copy=False)
        if isinstance(data, np.ndarray) and data.dtype.names:
            return QTable(data, copy=False)
    except ValueError as err:
        raise argument_error(argument, "a table with columns of one length", str(err)) from None
    wanted = "a table, a dict of columns, a list of dicts, a structured array, a DataFrame or the path of a table"
    raise argument_error(argument, wanted, type(data).__name__)


def _filled(column, n):
    """A column of ``n`` rows, of one value for all."""
    column = as_column(column)
    if np.ndim(column):
        return column
    if not hasattr(column, "unit"):
        return np.full(n, column)
    return u.Quantity([column] * n)


def described_table(columns, meta=None, *, cls=None):
    """
    Make a table whose columns say what they are.

    Parameters
    ----------
    columns : dict of str to tuple
        Values and description by name; no description if that is None.
    meta : dict, optional
        Provenance.
    cls : type, optional
        Class of the table, a `~astropy.table.QTable`; by default one that FITS files keep with its meta.

    Returns
    -------
    table : `~astropy.table.QTable`
        With copies of the values.
    """
    from miricigale.utils.result_table import ResultTable

    cls = cls or ResultTable
    table = cls({name: values for name, (values, _) in columns.items()}, meta=meta, copy=True)
    for name, (_, text) in columns.items():
        table[name].info.description = text
    return table


def described_columns(columns, texts, meta=None):
    """
    Make a table of columns whose descriptions are declared.

    Parameters
    ----------
    columns : dict of str to array-like
        Values by name, in the order of the table.
    texts : dict of str to str
        Description of each of these columns by name, in any order; empty for none.
    meta : dict, optional
        Provenance.

    Returns
    -------
    table : `~astropy.table.QTable`

    Raises
    ------
    ValueError
        If a column has no description, or a description no column.
    """
    different = sorted(columns.keys() ^ texts.keys())
    check_that(not different, "texts", f"descriptions of {list(columns)}", f"others: {different}")
    described = {name: (values, texts[name] or None) for name, values in columns.items()}
    return described_table(described, meta)


def described_rows(rows, texts):
    """
    Make a table from rows, whose columns say what they are.

    Parameters
    ----------
    rows : iterable of dict
        Values of one row each by name, all with the same names; there may be none. Quantities make a column with
        their unit.
    texts : dict of str to str
        Description of each column by name; the order of the columns is that of the rows.

    Returns
    -------
    table : `~astropy.table.QTable`

    Raises
    ------
    ValueError
        If a column has no description, or a description no column.
    """
    rows = list(rows)
    names = list(rows[0]) if rows else list(texts)
    columns = {}
    for name in names:
        values = [row[name] for row in rows]
        if rows and isinstance(values[0], u.Quantity):
            columns[name] = u.Quantity(values)
        else:
            columns[name] = np.array(values)
    return described_columns(columns, texts)


def error_column(name):
    """Name of the error column of a flux column."""
    return f"{name}_err"


def require_columns(table, names, argument, *, units=None):
    """
    Check that a table has columns, and that they convert to given units.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table to check.
    names : iterable of str
        Columns that must be there.
    argument : str
        The argument's name, for the message.
    units : dict, optional
        Column name to the unit that it must convert to.

    Raises
    ------
    ValueError
        If it is no table, or a column is missing; the message lists what is there.
    `~astropy.units.UnitsError`
        As of `check_units`.
    """
    check_type(table, argument, Table, "a table")
    missing = [name for name in names if name not in table.colnames]
    wanted = f"a table with the columns {missing}"
    check_that(not missing, argument, wanted, f"columns {table.colnames}")
    check_units(table, units or {}, argument)


def check_units(table, units, argument, *, user_names=None, takes_units=False):
    """
    Check that columns of a table convert to given units.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table to check.
    units : dict
        Column name to the unit that it must convert to; columns that are not there are skipped.
    argument : str
        The argument's name, for the message.
    user_names : dict, optional
        What the user calls columns, by the names of the table.
    takes_units : bool, optional
        Whether the function that the user calls has an argument ``units``.

    Raises
    ------
    `~astropy.units.UnitsError`
        If columns have no unit (the message names all of them), or one has a wrong unit (magnitudes are no
        fluxes).
    """
    user_names = user_names or {}
    without_unit = {}
    for name, unit in units.items():
        if name not in table.colnames:
            continue
        user_name = user_names.get(name, name)
        have = own_unit(table[name])
        if have is None:
            without_unit[user_name] = u.Unit(unit)
            continue
        have = flux_unit(have) or u.Unit(have)
        # magnitudes are no units of flux
        if not (isinstance(have, u.UnitBase) and have.is_equivalent(unit)):
            raise units_error(argument, f"convertible to {unit}", have, column=user_name)
    if without_unit:
        raise u.UnitsError(_lacking_units(without_unit, argument, takes_units))


def _lacking_units(units, argument, takes_units):
    """Return what to say of columns without a unit, by the units that they should convert to."""
    names = ", ".join(map(repr, units))
    # each unit once
    wanted = ", ".join(dict.fromkeys(map(str, units.values())))
    columns = "column"
    if len(units) > 1:
        columns = "columns"
    stated = {name: str(unit) for name, unit in units.items()}
    remedy = f"QTable(table, units={stated}) gives it"
    if takes_units:
        remedy = f"give units={stated}"
    if FNU in units.values():
        remedy += ", or 'ABmag', 'mJy' and so on for fluxes"
    return f"'{argument}' {columns} {names} must be convertible to {wanted}, got no unit; {remedy}"


def columns_among(photometry, names):
    """Return those of some names that are columns of photometry, in their order; refuse none (a `ValueError`)."""
    columns = [name for name in names if name in photometry.colnames]
    wanted = f"a table with at least one of the columns {list(names)}"
    check_that(columns, "photometry", wanted, f"columns {photometry.colnames}")
    return columns


def unique_ids(ids, argument):
    """Return ids as `read_ids` has them, after checking that none is there twice."""
    ids = _whole_ids(ids, argument)
    values, counts = np.unique(ids, return_counts=True)
    twice = values[counts > 1][:5].tolist()
    check_that(not twice, argument, "a table whose ids are unique", f"duplicates such as {twice}")
    return ids


def row_dicts(table):
    """Rows of a table as dicts by column."""
    return [dict(zip(table.colnames, row, strict=True)) for row in table]


def plain_rows(table):
    """Yield rows of a table as dicts by column, of quantities the values."""
    for row in table:
        yield {name: getattr(row[name], "value", row[name]) for name in table.colnames}


def read_ids(table, argument="photometry"):
    """
    Ids of a catalog: integers, or text whether it came as such or as bytes (`miricigale.utils.ids`).

    Their column is that of `~miricigale.utils.ids.id_column`. ``argument`` is its name in messages.
    A `ValueError` names ids that are masked or empty, for their objects could not be distinguished, numbers among
    text, several in a row, bytes that are not UTF-8, and floats that are not exact.
    """
    require_columns(table, [], argument)
    name = id_column(table.colnames, argument)
    if name is None:
        require_columns(table, ["id"], argument)
    return _whole_ids(table[name], argument)


def _whole_ids(column, argument):
    """Ids of a column, after checking that there is one in every row."""
    ids, missing = ids_and_missing(column, argument)
    if missing.any():
        rows = np.flatnonzero(missing)
        got = f"{rows.size} masked or empty, the first in row {rows[0]} (from 0)"
        raise argument_error(argument, "a table with an id in every row", got)
    return ids


def ascii_ids(ids, argument):
    """
    Return ids as an array after checking that a FITS table can hold them.

    Parameters
    ----------
    ids : array_like
        Numbers, which are always fine, or text.
    argument : str
        The argument's name, for the message.

    Raises
    ------
    ValueError
        If an id is text that is not ASCII or ends in a blank, which FITS drops; the message
        names the first three.
    """
    ids = np.asarray(ids)
    if ids.dtype.kind in "UO":
        texts = [key for key in ids.tolist() if isinstance(key, str)]
        foreign = [key for key in texts if not key.isascii() or key != key.rstrip(" ")]
        remainder = ""
        if len(foreign) > 3:
            remainder = f" and {len(foreign) - 3} more"
        wanted = "ASCII, with no blank at the end, where they go to a FITS file"
        check_that(not foreign, argument, wanted, ", ".join(map(repr, foreign[:3])) + remainder)
    return ids


def match_sky(coords, reference, *, radius):
    """
    Match each reference position to its nearest partner, one to one.

    Parameters
    ----------
    coords, reference : `~astropy.coordinates.SkyCoord`
        Measured and reference positions.
    radius : `~astropy.units.Quantity`
        Largest separation of a match.

    Returns
    -------
    index : `~numpy.ndarray` of int, shape (n_reference,)
        Row of ``coords`` that belongs to each reference, -1 where there is none. A row
        claimed by several references goes to the nearest.
    separation : `~astropy.units.Quantity`, shape (n_reference,)
        Separation in arcsec, NaN where there is no match.

    Raises
    ------
    `~astropy.units.UnitsError`, ValueError
        If ``radius`` is no angle, or not one of at least 0.
    """
    from astropy.coordinates import match_coordinates_sky

    limit = float(to_array(radius, ANGLE, "radius", ndim=0))
    check_least(limit, "radius", 0)
    n = len(reference)
    index = np.full(n, -1)
    separation = nans(n)
    if n and len(coords):
        nearest, sep, _ = match_coordinates_sky(reference, coords)
        sep = sep.to_value(u.arcsec)
        order = np.argsort(sep, kind="stable")
        rows, first = np.unique(nearest[order[sep[order] <= limit]], return_index=True)
        index[order[first]], separation[order[first]] = rows, sep[order[first]]
    return index, separation * u.arcsec
