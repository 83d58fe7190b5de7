"""Tables of users: read in any of the usual formats, or refused in one sentence, and written by suffix."""

import json
import re
from pathlib import Path

import numpy as np
from astropy.io import fits, votable
from astropy.io.ascii import InconsistentTableError
from astropy.table import Column, MaskedColumn, QTable, Table

from miricigale.utils.arrow_tables import arrow_table
from miricigale.utils.column_units import in_units, silent_units
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import (
    open_fits,
    replacing,
    split_extension,
    unpacked_size,
    unreadable,
)
from miricigale.utils.fits_tables import (
    FITS_TYPES,
    change_type,
    check_names_differ,
    first_table,
    leave_ragged_out,
    mask_scaled_nulls,
    names_in_header,
    table_hdu,
    table_read,
)
from miricigale.utils.ids import is_id_name
from miricigale.utils.meta import full_meta, plain_value
from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_that
from miricigale.utils.positions import sky_as_angles
from miricigale.utils.table_formats import TABLE_FORMATS, WRITTEN_FORMATS, table_suffix
from miricigale.utils.text_reading import BOM, check_text, first_bytes, read_text
from miricigale.utils.text_tables import drop_repeated, is_barred, is_sextractor, names_in_comments


def read_table(path, *, wanted, cls=QTable, form=None, hdu=None, id_names=()):
    """
    Read a table in any of the usual formats, or say which file could not be read as what.

    Ids are kept as they stand in the file (`miricigale.utils.ids`): a unit does not make floats of them, and
    ``0007`` is text. In text, ``null``, ``NA``, ``--`` and the like among numbers are missing.

    Parameters
    ----------
    path : path-like
        The file; ``file.fits[2]`` or ``file.fits[NAME]`` names an extension.
    wanted
        As for `open_fits`.
    cls : type, optional
        Class of the table.
    form : str, optional
        Format by `astropy.table.Table.read`. By default by content and suffix: those of `write_table` (``.csv``
        also with semicolons or tabs, and after lines of comment), text of SExtractor with a line of comment for
        each column, or plain text, whose names of columns stand behind ``#`` if one of ids is among them.
    hdu : int or str, optional
        Extension of a FITS file; the first table by default, without that of keywords in FITS_LDAC.
    id_names : iterable of str, optional
        Columns of ids, besides those known by their names.

    Returns
    -------
    table : `~astropy.table.QTable`
        A column whose unit is unknown has no unit that converts to any other.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or no such table, or two columns of one name differ.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of columns of variable length in FITS, of those of a parquet file that no table can hold, and of columns
        that stand twice in text with the same values.
    """
    path, extension = split_extension(path)
    if hdu is None:
        hdu = extension
    # astropy would take text for the table itself
    if not Path(path).is_file():
        raise unreadable(path, wanted, FileNotFoundError())
    unpacked_size(path)
    try:
        if form is None:
            form = _table_format(path)
        if form == "fits":
            table = _read_fits(path, wanted, hdu)
        elif hdu is not None:
            raise unreadable(path, wanted, f"'hdu' is {hdu!r}, and it is no FITS file")
        elif form == "parquet":
            parquet = require("pyarrow.parquet", extra="parquet")
            check_names_differ(parquet.read_schema(path).names)
            table = arrow_table(parquet.read_table(path), Table, where=Path(path).name)
        else:
            table = _read_text(path, form, id_names)
        if not table.colnames:
            raise unreadable(path, wanted, "it has no columns")
        return in_units(table, cls, id_names)
    except DataError:
        raise
    except InconsistentTableError as err:
        # for text of an unknown layout astropy lists all that it tried
        if "Unable to guess" in str(err):
            err = "no usual layout of a table in text fits it"
        raise unreadable(path, wanted, err) from None
    except Exception as err:  # readers of different formats raise different exceptions
        raise unreadable(path, wanted, err) from err


def _read_fits(path, wanted, hdu):
    """Table of a FITS file: that of an extension, or the first one."""
    with open_fits(path, wanted=wanted) as hdus, silent_units():
        if hdu is None:
            hdu = first_table(hdus)
        read = table_read(hdus, hdu)
        check_names_differ(names_in_header(read))
        table = Table.read(hdus, format="fits", character_as_bytes=False, hdu=hdu)
        mask_scaled_nulls(table, read)
        leave_ragged_out(table, read, Path(path).name)
        table.meta = full_meta(table.meta)
        return table


def _read_text(path, form, id_names):
    """Table of a text file or another one that astropy reads by itself."""
    check_text(path)
    with silent_units():
        table = read_text(path, form, id_names)
        # SExtractor numbers the parts of a vector as astropy does names that stand twice
        if form.startswith("ascii") and form != "ascii.sextractor":
            drop_repeated(table, path)
        return table


#: What astropy must know further to write a format.
_OPTIONS = {
    "hdf5": {"path": "table", "serialize_meta": True},
}
#: The same of VOTables.
_VOTABLE_TYPES = FITS_TYPES | {
    np.dtype(np.uint16): np.int32,
    np.dtype(np.uint32): np.int64,
    np.dtype(np.uint64): np.int64,
}


def write_ecsv(value, path, *, overwrite=False):
    """Write the table of an object (``to_table``) as ECSV, whole or not at all."""
    with replacing(path, overwrite=overwrite) as partial:
        value.to_table().write(partial, format="ascii.ecsv")


def write_table(table, path, *, overwrite=False):
    """
    Write a table in the format that the suffix of the file names.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table.
    path : path-like
        FITS (or ``.fits.gz``), ECSV (also as ``.txt`` and ``.dat``), CSV, VOTable (``.xml``), HDF5 (with h5py) or
        parquet (with pyarrow).
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
    form = WRITTEN_FORMATS.get(Path(path.name.lower().removesuffix(".gz")).suffix)
    wanted = f"a file ending in one of {', '.join(WRITTEN_FORMATS)}"
    check_that(form is not None, "path", wanted, str(path))
    if form == "parquet":
        require("pyarrow", extra="parquet")
    with replacing(path, overwrite=overwrite) as partial:
        if form == "fits":
            hdus = fits.HDUList([fits.PrimaryHDU(), table_hdu(table)])
            hdus.writeto(partial)
        else:
            if form == "votable":
                _write_votable(sky_as_angles(table), partial)
                return
            if form == "ascii.csv":
                # text of both angles in one cell is no position
                plain_table = sky_as_angles(table)
            else:
                plain_table = table
            plain_table.write(partial, format=form, **_OPTIONS.get(form, {}))


def _write_votable(table, path):
    """Write a VOTable in binary, for astropy's writer of text is not safe, its meta as JSON in a parameter."""
    document = votable.from_table(_for_votable(table))
    element = document.get_first_table()
    if table.meta:
        text = json.dumps(dict(table.meta), default=plain_value)
        parameter = votable.tree.Param(
            document, name="META", datatype="unicodeChar", arraysize="*", value=text
        )
        element.params.append(parameter)
    document.to_xml(str(path), tabledata_format="binary2")


def _for_votable(table):
    """Table with what VOTables have: no unsigned integers, none above 2^63, and no masks of text."""
    table = table.copy(copy_data=False)
    for name in table.colnames:
        column = table[name]
        if getattr(column, "dtype", None) == np.uint64:
            largest = max(map(int, np.ma.compressed(np.ma.asarray(column))), default=0)
            wanted = f"a file of another format for unsigned integers such as those of {name!r}"
            check_that(largest < 2**63, "path", wanted, "a VOTable, which has none above 2^63")
        change_type(table, name, _VOTABLE_TYPES)
        if isinstance(column, MaskedColumn) and column.dtype.kind in "US":
            # text has no mask there
            table.replace_column(name, Column(column.filled(""), name=name))
    return table


def _table_format(path):
    start = first_bytes(path).removeprefix(BOM)
    first = start.strip().partition(b"\n")[0].decode(errors="replace")
    suffix = table_suffix(path)
    if start.startswith(b"SIMPLE"):
        return "fits"
    if start.startswith(b"# %ECSV"):
        return "ascii.ecsv"
    if suffix in TABLE_FORMATS:
        return TABLE_FORMATS[suffix]
    if suffix == ".tsv":
        return "ascii.csv"
    named = re.match("#(?!#)", first) and any(map(is_id_name, first.strip("# \r").split()))
    if is_sextractor(start):
        return "ascii.sextractor"
    if named:
        return "ascii.commented_header"
    if first.startswith("#") and names_in_comments(start.decode("utf-8", "replace")):
        return "ascii.no_header"
    # which astropy does not try, or takes for one column if the first name is empty
    if ";" in first or start.startswith(b"\t") or is_barred(start):
        return "ascii.csv"
    return "ascii"
