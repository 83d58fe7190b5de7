"""Units of columns that were read from a file: their usual names, and none for ids."""

import contextlib
import warnings

import numpy as np
from astropy.table import Column, QTable, Table
from astropy.units import UnitsWarning, UnrecognizedUnit
from astropy.utils.exceptions import AstropyUserWarning, AstropyWarning

from miricigale.utils.ids import is_id_name
from miricigale.utils.units import flux_unit

#: Above it a whole number may change when it becomes a float.
_EXACT = 2**53


@contextlib.contextmanager
def silent_units():
    """Silence warnings about unknown units: a column that is used says so itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnitsWarning)
        warnings.filterwarnings("ignore", ".*(?:did not parse as|Invalid unit)", AstropyWarning)
        # magnitudes with a mask are no quantity of astropy, and are read as they are
        warnings.filterwarnings("ignore", "column .* has a unit but is kept", AstropyUserWarning)
        yield


def in_units(table, cls=QTable, id_names=()):
    """
    Make a table of another class of one that was read, with whole ids and the usual names of units.

    Parameters
    ----------
    table : `~astropy.table.Table`
        With columns that are no quantities yet.
    cls : type, optional
        Class of the table that is wanted.
    id_names : iterable of str, optional
        Columns of ids, besides those known by their names.

    Returns
    -------
    table : `~astropy.table.Table`
        Of ``cls``. Integers have no unit in columns of ids, and where a float could not hold them.
    """
    for name in table.colnames:
        column = table[name]
        if not isinstance(column, Column) or column.unit is None:
            continue
        if column.dtype.kind in "iu":
            is_id = is_id_name(name) or name in id_names
            large = column.dtype.itemsize == 8 and len(column) and _largest(column) >= _EXACT
            if is_id or large:
                column.unit = None
                continue
        if isinstance(column.unit, UnrecognizedUnit):
            column.unit = flux_unit(column.unit) or column.unit
    with silent_units():
        return cls(table, copy=False)


def quantity_table(table, *, copy):
    """
    Return a table of a user with quantities for columns, whose whole ids stay so whatever their unit.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table, which stays as it is.
    copy : bool
        Whether its values are copied.

    Returns
    -------
    table : `~astropy.table.QTable`
    """
    if isinstance(table, QTable):
        return QTable(table, copy=copy)
    # astropy would make floats of integers with a unit
    return in_units(Table(table, copy=copy))


def _largest(column):
    """Largest absolute value of integers."""
    values = np.ma.getdata(column)
    return max(int(values.max()), -int(values.min()))
