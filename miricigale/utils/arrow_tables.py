"""Tables of rows that Arrow holds, as parquet files have them."""

import io
import json
import re

import numpy as np
from astropy.table import Column, MaskedColumn, QTable, Table

from miricigale.utils.column_units import in_units, silent_units
from miricigale.utils.exceptions import CatalogWarning, warn
from miricigale.utils.ids import is_id_name
from miricigale.utils.optional_packages import require


def arrow_table(rows, cls=QTable, *, where=None, start=0, index_id=None):
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
    start : int, optional
        Number of the first of these rows in the file.
    index_id : str, optional
        Column of an index of pandas that is ``id`` too (`index_of_ids`); by default that of these rows.

    Returns
    -------
    table : `~astropy.table.QTable`
        Missing numbers with a fraction are NaN, also those of columns without any value; other missing values are
        masked. Columns of bytes, lists and structures are left out. An index that pandas wrote is a column, and
        ``id`` where `~miricigale.utils.frames.frame_columns` makes it so.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of the columns that are left out.
    """
    pyarrow = require("pyarrow", extra="parquet")
    if index_id is None:
        index_id = index_of_ids(rows.schema, lambda name: rows.column(name))
    rows = _plain_columns(_with_index(rows, start, index_id), where)
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


def index_of_ids(schema, column):
    """
    Return the column of an index of pandas that holds ids under another name, as in frames in memory.

    Parameters
    ----------
    schema : `pyarrow.Schema`
        With the metadata that pandas wrote.
    column : callable
        Gives all values of a column by its name, a `pyarrow.ChunkedArray`.

    Returns
    -------
    name : str
        Empty if there is none: the only level of an index, without a name or of distinct whole numbers or texts,
        in a file none of whose columns is called as ids are.
    """
    levels = _index_levels(schema)
    if len(levels) != 1 or any(map(is_id_name, schema.names)):
        return ""
    level = levels[0]
    if isinstance(level, dict):
        name = level["name"]
        if not name:
            counts = level["start"] == 0 and level["step"] == 1
            return "" if counts else "id"
        return "" if is_id_name(name) else name
    if level not in schema.names:
        return ""
    if re.fullmatch(_UNNAMED, level):
        return level
    types = require("pyarrow", extra="parquet").types
    kind = schema.field(level).type
    values = column(level)
    of_ids = types.is_integer(kind) or types.is_string(kind) or types.is_large_string(kind)
    distinct = of_ids and not values.null_count and len(values.unique()) == len(values)
    return level if distinct else ""


#: What pandas calls the column of an index without a name.
_UNNAMED = r"__index_level_\d+__"


def _index_levels(schema):
    """Levels of an index of pandas: names of columns, and dicts of those that count from a start by a step."""
    metadata = (schema.metadata or {}).get(b"pandas")
    return json.loads(metadata).get("index_columns", []) if metadata else []


def _with_index(rows, start, index_id):
    """Rows with an index that counts, which pandas writes in the header alone, as a column, and with ids of it."""
    pyarrow = require("pyarrow", extra="parquet")
    for level in _index_levels(rows.schema):
        if not isinstance(level, dict):
            continue
        name = level["name"] or index_id
        if name and name not in rows.schema.names:
            # of pieces too
            numbers = level["start"] + level["step"] * np.arange(start, start + len(rows))
            rows = rows.append_column(name, pyarrow.array(numbers))
    if index_id and index_id != "id":
        rows = rows.append_column("id", rows.column(index_id))
    return rows


def _plain_columns(rows, place):
    """Rows of Arrow with columns of types that a table can hold, and a warning about the others."""
    pyarrow = require("pyarrow", extra="parquet")
    types = pyarrow.types
    lost = []
    for field in list(rows.schema):
        i = rows.schema.get_field_index(field.name)
        kind = field.type
        column = rows.column(i)
        if types.is_dictionary(kind):
            kind = kind.value_type
            column = column.cast(kind)
        if types.is_null(kind) or types.is_decimal(kind):
            # a column without any value has missing numbers
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
