"""Tables of rows that Arrow holds, as parquet files have them."""

import io

from astropy.table import Column, MaskedColumn, QTable, Table

from miricigale.utils.column_units import in_units, silent_units
from miricigale.utils.exceptions import CatalogWarning, warn
from miricigale.utils.optional_packages import require


def arrow_table(rows, cls=QTable, *, where=None):
    """
    Make a table of rows of a parquet file, as astropy does, with its units.

    Parameters
    ----------
    rows : `pyarrow.Table`
        The rows, with the metadata of the file.
    cls : type, optional
        Class of the table.
    where : str, optional
        Name of the file, for a warning about columns that are left out; none without it.

    Returns
    -------
    table : `~astropy.table.QTable`
        Missing numbers with a fraction are NaN, also those of columns without any value; other missing values are
        masked. Columns of bytes, lists and structures are left out.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of the columns that are left out.
    """
    pyarrow = require("pyarrow", extra="parquet")
    rows = _plain_columns(rows, where)
    metadata = dict(rows.schema.metadata or {})
    missing = {}
    for i, field in enumerate(rows.schema):
        column = rows.column(i)
        text = pyarrow.types.is_string(field.type)
        if column.null_count and not pyarrow.types.is_floating(field.type):
            missing[field.name] = column.is_null().to_numpy()
            column = column.fill_null("" if text else pyarrow.scalar(0).cast(field.type))
        if text:
            # what the file says of lengths may be of other rows
            longest = max(map(len, column.to_pylist()), default=0)
            metadata[f"table::len::{field.name}".encode()] = str(max(1, longest)).encode()
        rows = rows.set_column(i, field.name, column)
    stream = io.BytesIO()
    require("pyarrow.parquet", extra="parquet").write_table(
        rows.replace_schema_metadata(metadata), stream
    )
    with silent_units():
        table = Table.read(stream, format="parquet")
    for name, mask in missing.items():
        if name in table.colnames and isinstance(table[name], Column):
            table[name] = MaskedColumn(table[name], mask=mask)
    return in_units(table, cls)


def _plain_columns(rows, place):
    """Rows of Arrow with columns of types that a table can hold, and a warning about the others."""
    types = require("pyarrow", extra="parquet").types
    pyarrow = require("pyarrow", extra="parquet")
    lost = []
    for field in list(rows.schema):
        i = rows.schema.get_field_index(field.name)
        kind = field.type
        column = rows.column(i)
        if types.is_dictionary(kind):
            kind = kind.value_type
            column = column.cast(kind)
        if types.is_null(kind):
            # no value in any row: missing numbers
            column = column.cast(pyarrow.float64())
        elif types.is_decimal(kind):
            column = column.cast(pyarrow.float64())
        elif types.is_large_string(kind) or getattr(types, "is_string_view", types.is_string)(kind):
            column = column.cast(pyarrow.string())
        elif not (_is_plain(types, kind) or _is_vector(types, column)):
            lost.append(field.name)
            rows = rows.remove_column(i)
            continue
        if column is not rows.column(i):
            rows = rows.set_column(i, field.name, column)
    if lost and place is not None:
        names = ", ".join(map(repr, lost))
        text = "columns of bytes, lists or structures, which a table cannot hold, are left out"
        warn(f"{place}: {text}: {names}", CatalogWarning)
    return rows


def _is_plain(types, kind):
    """Whether a type of Arrow is one that a column of a table has."""
    number = types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)
    return number or types.is_string(kind) or types.is_timestamp(kind)


def _is_vector(types, column):
    """Whether a column of Arrow holds as many numbers in each row."""
    kind = column.type
    return (
        types.is_fixed_size_list(kind)
        and _is_plain(types, kind.value_type)
        and not column.null_count
    )
