"""Columns of data frames (pandas, polars, Arrow), with their missing values and ids."""

import numpy as np

from miricigale.utils.exceptions import CatalogWarning, warn
from miricigale.utils.ids import is_id_name, is_written_index
from miricigale.utils.missing_values import between_missing
from miricigale.utils.named_values import subset
from miricigale.utils.options import check_that


def is_frame(data):
    """Whether something is a frame: columns by name that turn into arrays."""
    return hasattr(data, "columns") and (hasattr(data, "to_numpy") or hasattr(data, "to_pylist"))


def frame_columns(data, argument):
    """
    Return the columns of a frame as arrays.

    Parameters
    ----------
    data : `pandas.DataFrame`, `polars.DataFrame` or `pyarrow.Table`
        The frame. Columns of polars and Arrow are read as those of parquet files are.
    argument : str
        What it is called in messages.

    Returns
    -------
    columns : dict of str to array or column
        Missing values are NaN in floats and masked in others (pandas' ``NA``, ``None``, null). An index of pandas
        that has a name, or is not the count of the rows, is a column: by its name, or ``id``. An index of
        whole numbers or text under another name is ``id`` too where no column is called as ids are.

    Raises
    ------
    ValueError
        If two columns have one name, or an index and a column have one name and differ.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        If a level of an index has no name, and is left out.
    """
    if not hasattr(data, "index"):
        from miricigale.utils.arrow_tables import arrow_table

        rows = data
        if not hasattr(data, "to_pylist"):
            rows = data.to_arrow()
        table = arrow_table(rows, where=argument)
        return subset(table, table.colnames)
    names = [str(name) for name in data.columns]
    repeated = sorted({name for name in names if names.count(name) > 1})
    check_that(not repeated, argument, "a frame whose columns have different names", repeated)
    columns = {name: _of_series(data[key]) for name, key in zip(names, data.columns, strict=True)}
    if names and is_written_index(names[0], names, columns[names[0]]):
        columns["id"] = columns.pop(names[0])
    return _of_index(data, columns, argument) | columns


def as_column(values):
    """Values of a column of a dict; a masked array of what pandas holds, and of a list with None."""
    if hasattr(values, "isna") and hasattr(values, "to_numpy"):
        return _of_series(values)
    if isinstance(values, list) and any(value is None for value in values):
        missing = np.array([value is None for value in values])
        present = np.array([value for value in values if value is not None])
        return np.ma.MaskedArray(between_missing(present, missing), mask=missing)
    return values


def _of_index(data, columns, argument):
    """Columns of an index that the frame does not have."""
    index = data.index
    if index.nlevels == 1 and index.name is None:
        counts = hasattr(index, "step") and index.start == 0 and index.step == 1
        # rows of a frame that has no other ids are known by it
        named = counts or any(map(is_id_name, columns))
        if named:
            return {}
        return {"id": _of_series(index)}
    levels = {}
    unnamed = [i for i, name in enumerate(index.names) if name is None]
    if unnamed:
        text = (
            f"levels of the index without a name are left out ({len(unnamed)} of {index.nlevels})"
        )
        warn(f"{argument}: {text}; reset_index() makes columns of them", CatalogWarning)
    for i, name in enumerate(index.names):
        if name is None:
            continue
        values = _of_series(index.get_level_values(i))
        if str(name) in columns:
            is_repeated = np.array_equal(np.ma.filled(values), np.ma.filled(columns[str(name)]))
            wanted = "a frame whose index and columns have different names"
            check_that(is_repeated, argument, wanted, f"two of {str(name)!r} that differ")
        else:
            levels[str(name)] = values
    if index.nlevels == 1 and not any(map(is_id_name, list(levels) + list(columns))):
        values = next(iter(levels.values()), None)
        if values is not None and values.dtype.kind in "iuUSO" and index.is_unique:
            levels["id"] = values
    return levels


def _of_series(series):
    """A column as an array, masked where whole numbers or text are missing."""
    missing = np.asarray(series.isna(), dtype=bool)
    if not missing.any():
        return series.to_numpy()
    # only what is there, for pandas makes floats of whole numbers beside a missing one
    present = series[~missing].to_numpy()
    if present.dtype.kind == "O":
        present = np.array(present.tolist())
    out = between_missing(present, missing)
    if present.dtype.kind == "f":
        out[missing] = np.nan
        return out
    return np.ma.MaskedArray(out, mask=missing)
