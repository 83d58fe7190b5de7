"""Tables of users: read in any of the usual formats, or refused in one sentence, and written by suffix."""

import io
import math
import os
import re
import warnings
from pathlib import Path

from astropy.io import fits
from astropy.table import Column, MaskedColumn, QTable
from astropy.utils.exceptions import AstropyUserWarning

from miricigale.utils.exceptions import DataError
from miricigale.utils.files import open_fits, replacing, unpacked_size, unreadable
from miricigale.utils.meta import fits_meta
from miricigale.utils.optional import require
from miricigale.utils.options import check_that
from miricigale.utils.positions import sky_as_angles

_PIECE = 1 << 20


def read_table(path, *, wanted, cls=QTable, form=None, hdu=None):
    """
    Read a table in any of the usual formats, or say which file could not be read as what.

    Parameters
    ----------
    path, wanted
        As for `open_fits`.
    cls : type, optional
        Class of the table.
    form : str, optional
        Format by `astropy.table.Table.read`. By default by content and suffix: those of `write_table`, or
        plain text, whose names of columns stand behind ``#`` if ``id`` is among them.
    hdu : int or str, optional
        Extension of a FITS file, the first table by default.

    Returns
    -------
    table : `~astropy.table.QTable`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or no such table.
    """
    # astropy would take text for the table itself
    if not Path(path).is_file():
        raise unreadable(path, wanted, FileNotFoundError())
    unpacked_size(path)
    try:
        form = _table_format(path) if form is None else form
        if form == "fits":
            with open_fits(path, wanted=wanted) as hdus:
                table = cls.read(hdus, format=form, character_as_bytes=False, hdu=hdu)
        elif hdu is not None:
            raise unreadable(path, wanted, f"'hdu' is {hdu!r}, and it is no FITS file")
        elif form == "parquet":
            table = arrow_table(require("pyarrow.parquet", extra="parquet").read_table(path), cls)
        else:
            _check_text(path)
            table = cls.read(path, format=form)
        if not table.colnames:
            raise unreadable(path, wanted, "it has no columns")
        return table
    except DataError:
        raise
    except Exception as err:  # readers of different formats raise different exceptions
        raise unreadable(path, wanted, err) from err


def arrow_table(rows, cls=QTable):
    """
    Make a table of rows of a parquet file, as astropy does, with its units.

    Parameters
    ----------
    rows : `pyarrow.Table`
        The rows, with the metadata of the file.
    cls : type, optional
        Class of the table.

    Returns
    -------
    table : `~astropy.table.QTable`
        Missing numbers with a fraction or a unit are NaN, other missing values are masked.
    """
    pyarrow = require("pyarrow", extra="parquet")
    known, missing = dict(rows.schema.metadata or {}), {}
    for i, field in enumerate(rows.schema):
        column, kind = rows.column(i), field.type
        if pyarrow.types.is_dictionary(kind):
            kind = kind.value_type
            column = column.cast(kind)
        text = pyarrow.types.is_string(kind) or pyarrow.types.is_large_string(kind)
        if column.null_count and not pyarrow.types.is_floating(kind):
            missing[field.name] = column.is_null().to_numpy()
            column = column.fill_null("" if text else pyarrow.scalar(0).cast(kind))
        if text:
            # what the file says of lengths may be of other rows
            longest = max(map(len, column.to_pylist()), default=0)
            known[f"table::len::{field.name}".encode()] = str(max(1, longest)).encode()
        rows = rows.set_column(i, field.name, column)
    stream = io.BytesIO()
    require("pyarrow.parquet", extra="parquet").write_table(
        rows.replace_schema_metadata(known), stream
    )
    table = cls.read(stream, format="parquet")
    for name, mask in missing.items():
        if isinstance(table[name], Column):
            table[name] = MaskedColumn(table[name], mask=mask)
        else:
            table[name][mask] = math.nan
    return table


def _check_text(path):
    """Refuse text that would take far more memory than the file has bytes."""
    size = os.stat(path).st_size
    with open(path, "rb") as stream:
        # arrays of columns in ECSV: each number takes a byte or more
        head = stream.read(_PIECE)
        for shape in re.findall(rb"subtype: *'?\w+\[([\d, null]*)\]", head):
            if math.prod(map(int, re.findall(rb"\d+", shape))) > size:
                msg = f"it declares arrays of {shape.decode()} numbers, and has {size} bytes"
                raise ValueError(msg)
        while len(head) == _PIECE:
            # a cell makes its whole column as wide
            if b"\n" not in head and b"\r" not in head:
                msg = f"a line is longer than {_PIECE} bytes"
                raise ValueError(msg)
            head = stream.read(_PIECE)


#: Formats of tables by suffix, as `astropy.table.Table` calls them.
TABLE_FORMATS = {
    ".fits": "fits",
    ".fit": "fits",
    ".ecsv": "ascii.ecsv",
    ".csv": "ascii.csv",
    ".xml": "votable",
    ".vot": "votable",
    ".votable": "votable",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".parquet": "parquet",
}
#: What astropy must know further to write a format.
_OPTIONS = {"hdf5": {"path": "table", "serialize_meta": True}}


def write_table(table, path, *, overwrite=False):
    """
    Write a table in the format that the suffix of the file names.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table.
    path : path-like
        FITS (or ``.fits.gz``), ECSV, CSV, VOTable (``.xml``), HDF5 (with h5py) or parquet (with pyarrow).
    overwrite : bool, optional
        Whether a file that is there is replaced.

    Raises
    ------
    ValueError
        If the suffix names no format.
    OSError
        If the file is there and ``overwrite`` is not set.
    """
    path = Path(path)
    form = TABLE_FORMATS.get(Path(path.name.lower().removesuffix(".gz")).suffix)
    wanted = f"a file ending in one of {', '.join(TABLE_FORMATS)}"
    check_that(form is not None, "path", wanted, str(path))
    with replacing(path, overwrite=overwrite) as partial:
        if form == "fits":
            hdus = fits.HDUList([fits.PrimaryHDU(), table_hdu(table)])
            hdus.writeto(partial)
        else:
            plain = sky_as_angles(table) if form == "votable" else table
            plain.write(partial, format=form, **_OPTIONS.get(form, {}))


def table_hdu(table):
    """Binary table of a table with any columns that astropy has; its meta as `fits_meta` has it."""
    table = table.copy(copy_data=False)
    table.meta = fits_meta(table.meta)
    stream = io.BytesIO()
    with warnings.catch_warnings():
        # units such as dex are kept for astropy, and in the descriptions
        warnings.filterwarnings("ignore", "The unit .* could not be saved", AstropyUserWarning)
        table.write(stream, format="fits")
    stream.seek(0)
    return fits.open(stream)[1]


def _table_format(path):
    with open(path, "rb") as stream:
        start = stream.read(65536)
    first = start.strip().partition(b"\n")[0].decode(errors="replace")
    suffix = Path(Path(path).name.lower().removesuffix(".gz")).suffix
    if start.startswith(b"SIMPLE"):
        return "fits"
    if start.startswith(b"# %ECSV"):
        return "ascii.ecsv"
    if suffix in TABLE_FORMATS:
        return TABLE_FORMATS[suffix]
    named = first.startswith("#") and "id" in first.strip("# \r").split()
    return "ascii.commented_header" if named else "ascii"
