"""Tables of users: read in any of the usual formats, or refused in one sentence, and written by suffix."""

import contextlib
import io
import math
import os
import re
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits, votable
from astropy.io.ascii import InconsistentTableError, convert_numpy
from astropy.table import Column, MaskedColumn, QTable, Table
from astropy.units import UnitsWarning, UnrecognizedUnit
from astropy.utils.exceptions import AstropyUserWarning, AstropyWarning

from miricigale.utils.exceptions import CatalogWarning, DataError, warn
from miricigale.utils.files import (
    is_zip,
    open_fits,
    packed_open,
    replacing,
    split_extension,
    unpacked_size,
    unreadable,
)
from miricigale.utils.ids import ids_of_text, is_id_name
from miricigale.utils.meta import fits_meta
from miricigale.utils.missing_values import is_missing_word
from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_that
from miricigale.utils.positions import sky_as_angles
from miricigale.utils.region_files import region_table
from miricigale.utils.text_tables import csv_layout, drop_repeated, is_sextractor, without_comments
from miricigale.utils.units import flux_unit

_PIECE = 1 << 20
_BOM = b"\xef\xbb\xbf"
#: Numbers that a reader of integers would not give back as they are written: 0007, +7.
_ODD_NUMBER = re.compile(rb"(?:^|[\s,;|&\"'])(?:[+-]?0[0-9]|\+[0-9])")
#: Above it a whole number may change when it becomes a float.
_EXACT = 2**53
#: The table of keywords in files of SExtractor, before that of its objects.
LDAC_HEADER = "LDAC_IMHEAD"
_DS9 = re.compile(rb"# *Region file format: *DS9|^(?:global |fk5|icrs|image)\b", re.IGNORECASE)


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
            with open_fits(path, wanted=wanted) as hdus, silent_units():
                if hdu is None:
                    chosen = _first_table(hdus)
                else:
                    chosen = hdu
                read = _table_read(hdus, chosen)
                check_names_differ(names_in_header(read))
                table = Table.read(hdus, format=form, character_as_bytes=False, hdu=chosen)
                mask_scaled_nulls(table, read)
                leave_ragged_out(table, read, Path(path).name)
        elif hdu is not None:
            raise unreadable(path, wanted, f"'hdu' is {hdu!r}, and it is no FITS file")
        elif form == "parquet":
            parquet = require("pyarrow.parquet", extra="parquet")
            check_names_differ(parquet.read_schema(path).names)
            rows = parquet.read_table(path)
            table = arrow_table(rows, Table, where=Path(path).name)
        else:
            _check_text(path)
            with silent_units():
                table = _read_text(path, form, id_names)
                # SExtractor numbers the parts of a vector as astropy does names that stand twice
                if form.startswith("ascii") and form != "ascii.sextractor":
                    drop_repeated(table, path)
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


@contextlib.contextmanager
def silent_units():
    """Silence warnings about unknown units: a column that is used says so itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnitsWarning)
        warnings.filterwarnings("ignore", ".*(?:did not parse as|Invalid unit)", AstropyWarning)
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


def _largest(column):
    """Largest absolute value of integers."""
    values = np.ma.getdata(column)
    return max(int(values.max()), -int(values.min()))


def _table_read(hdus, chosen):
    """The table of a FITS file that astropy reads by an extension, or None for the first one (a `ValueError`)."""
    if chosen is not None:
        try:
            return hdus[chosen]
        except (IndexError, KeyError):
            names = [hdu.name or "PRIMARY" for hdu in hdus]
            msg = f"it has no extension {chosen!r}, only {names}"
            raise ValueError(msg) from None
    tables = [hdu for hdu in hdus if isinstance(hdu, (fits.BinTableHDU, fits.TableHDU))]
    if not tables:
        raise ValueError("it has no table")
    return tables[0]


def names_in_header(hdu):
    """Names of the columns of a FITS table as its header has them, also where two are the same."""
    header = getattr(hdu, "header", {})
    names = [header.get(f"TTYPE{i}") for i in range(1, header.get("TFIELDS", 0) + 1)]
    return [str(name).strip() for name in names if name is not None]


def check_names_differ(names):
    """Raise a `ValueError` if two columns have one name."""
    for i, name in enumerate(names):
        if name in names[:i]:
            msg = f"it has two columns {name!r}: give each its own name"
            raise ValueError(msg)


def mask_scaled_nulls(table, hdu):
    """
    Mask the missing values of scaled integers, which astropy scales like any other.

    Parameters
    ----------
    table : `~astropy.table.Table`
        As astropy read it; changed in place.
    hdu : `~astropy.io.fits.BinTableHDU`
        What it was read from, with TNULL, TSCAL and TZERO of its columns.
    """
    for column in getattr(hdu, "columns", ()):
        scaled = column.bscale not in ("", None, 1) or column.bzero not in ("", None, 0)
        if not scaled or column.null in ("", None) or column.name not in table.colnames:
            continue
        raw = np.asarray(hdu.data.view(np.ndarray)[column.name])
        missing = raw == int(column.null)
        if missing.any():
            values = table[column.name]
            missing = missing | np.ma.getmaskarray(np.ma.asarray(values))
            table[column.name] = MaskedColumn(values, mask=missing)


def ragged_columns(hdu):
    """Names of the columns of variable length of a binary table."""
    columns = getattr(hdu, "columns", ())
    return [column.name for column in columns if set(str(column.format)) & {"P", "Q"}]


def leave_ragged_out(table, hdu, place):
    """
    Leave columns of variable length out of a table, with a warning that names them.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Changed in place.
    hdu : `~astropy.io.fits.BinTableHDU`
        What it was read from.
    place : str
        Name of the file.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of the columns.
    """
    names = [name for name in ragged_columns(hdu) if name in table.colnames]
    table.remove_columns(names)
    warn_of_ragged(names, place)


def warn_of_ragged(names, place):
    """Warn of columns of variable length that are left out, if there are any."""
    if names:
        listed = ", ".join(map(repr, names))
        warn(f"{place}: columns of variable length are left out: {listed}", CatalogWarning)


def _first_table(hdus):
    """Number of the first table of a FITS file, without that of keywords; None if there is none."""
    tables = [i for i, hdu in enumerate(hdus) if isinstance(hdu, (fits.BinTableHDU, fits.TableHDU))]
    objects = [i for i in tables if hdus[i].name != LDAC_HEADER]
    if len(objects) < len(tables):
        if len(objects) != 1:
            msg = (
                f"it is FITS_LDAC with {len(objects)} tables of objects: name one, such as FILE[2]"
            )
            raise ValueError(msg)
        return objects[0]
    # astropy takes the first, and warns if there are more
    return None


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


def _read_text(path, form, id_names):
    """Table of a text file or another one that astropy reads by itself."""
    if form.startswith("ascii"):
        start = _start(path)
        if _DS9.search(start[:_PIECE]):
            return region_table(path)
        if start.lstrip()[:1] in (b"{", b"["):
            raise ValueError("it is JSON, and wanted are columns of text")
        source = str(path)
        options = {"format": form}
        n_comments = 0
        if form == "ascii.csv":
            options["delimiter"], n_comments = csv_layout(path)
        if n_comments or start.startswith(_BOM) or is_zip(path):
            # a mark at the start is no part of the first name, and of archives astropy reads no text
            with packed_open(path) as stream:
                source = stream.read().decode("utf-8-sig").splitlines()[n_comments:]
        if form == "ascii.csv":
            source = without_comments(source, path, options["delimiter"])
        with warnings.catch_warnings():
            # what 64 bits do not hold is read as text
            warnings.filterwarnings("ignore", "OverflowError converting to IntType", AstropyWarning)
            table = Table.read(source, **options)
        if form != "ascii.ecsv":
            names = [name for name in table.colnames if name in id_names or is_id_name(name)]
            _numbers_among_words(table, names)
            _ids_as_written(table, path, source, options, names)
            _unmark_first_name(table)
        return table
    if is_zip(path):
        msg = f"of {form} in a zip archive: unpack it first"
        raise ValueError(msg)
    if form == "votable":
        document = votable.parse(path)
        tables = list(document.iter_tables())
        if len(tables) == 1:
            check_names_differ([field.name for field in tables[0].fields])
        # names are what users see; astropy takes the IDs of fields
        return Table.read(document, format=form, use_names_over_ids=True)
    return Table.read(path, format=form)


def _unmark_first_name(table):
    """Take the mark of a comment off the first name: a line "#id,f,e" names columns, as many programs write it."""
    if not table.colnames:
        return
    first = table.colnames[0]
    plain = first.lstrip("# ")
    if first.startswith("#") and plain and plain not in table.colnames:
        table.rename_column(first, plain)


def _numbers_among_words(table, id_names):
    """Turn text into numbers where all but words for a missing value are numbers."""
    for name in table.colnames:
        if table[name].dtype.kind != "U" or name in id_names:
            continue
        column = MaskedColumn(table[name])
        texts = np.char.strip(np.asarray(column))
        missing = column.mask | is_missing_word(texts)
        if not missing.any() or missing.all():
            continue
        try:
            numbers = texts[~missing].astype(float)
        except ValueError:
            continue
        values = np.zeros(len(texts))
        values[~missing] = numbers
        table[name] = MaskedColumn(values, mask=missing, unit=column.unit)


def _ids_as_written(table, path, source, layout, names):
    """Put the ids of a text file in place that stand there, 0007 or 18446744073709551615."""
    for name in names:
        column = MaskedColumn(table[name])
        if column.dtype.kind in "iu" and not _has_odd_numbers(path):
            continue
        if column.dtype.kind == "U":
            texts = np.asarray(column)
        else:
            options = {"converters": {name: [convert_numpy(str)]}, "include_names": [name]}
            if layout["format"] != "ascii.sextractor":
                options["fast_reader"] = False
            texts = Table.read(source, **layout, **options)[name]
            texts = np.asarray(texts).astype(str)
        texts = np.char.strip(texts)
        missing = column.mask | is_missing_word(texts)
        ids = ids_of_text(texts[~missing].tolist())
        if ids.dtype.kind == "U":
            # a word may be an id among text
            missing = column.mask | (texts == "")
            ids = texts[~missing]
        texts_as_numbers = np.zeros(len(texts), dtype=ids.dtype)
        texts_as_numbers[~missing] = ids
        if missing.any():
            table[name] = MaskedColumn(texts_as_numbers, mask=missing)
        else:
            table[name] = Column(texts_as_numbers)


def _has_odd_numbers(path):
    """Whether a file has a number with a leading zero or plus sign, anywhere."""
    before = b""
    with packed_open(path) as stream:
        while piece := stream.read(_PIECE):
            if _ODD_NUMBER.search(before + piece):
                return True
            before = piece[-4:]
    return False


def _start(path):
    """First bytes of a file, unpacked."""
    with packed_open(path) as stream:
        return stream.read(1 << 16)


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
#: What astropy must know further to write a format; VOTables in binary, for its writer of text is not safe.
_OPTIONS = {
    "hdf5": {"path": "table", "serialize_meta": True},
    "votable": {"tabledata_format": "binary2"},
}
#: Types that FITS does not have, or takes for truth values, by what stands for them.
_FITS_TYPES = {np.dtype(np.int8): np.int16, np.dtype(np.float16): np.float32}
#: The same of VOTables.
_VOTABLE_TYPES = _FITS_TYPES | {
    np.dtype(np.uint16): np.int32,
    np.dtype(np.uint32): np.int64,
    np.dtype(np.uint64): np.int64,
}
#: What astropy writes for a missing integer, if the column has no such number.
_NULL = 999999


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
    if form == "parquet":
        require("pyarrow", extra="parquet")
    with replacing(path, overwrite=overwrite) as partial:
        if form == "fits":
            hdus = fits.HDUList([fits.PrimaryHDU(), table_hdu(table)])
            hdus.writeto(partial)
        else:
            if form == "votable":
                plain_table = _for_votable(sky_as_angles(table))
            elif form == "ascii.csv":
                # text of both angles in one cell is no position
                plain_table = sky_as_angles(table)
            else:
                plain_table = table
            plain_table.write(partial, format=form, **_OPTIONS.get(form, {}))


def _for_votable(table):
    """Table with what VOTables have: no unsigned integers, none above 2^63, and no masks of text."""
    table = table.copy(copy_data=False)
    for name in table.colnames:
        column = table[name]
        if getattr(column, "dtype", None) == np.uint64:
            largest = max(map(int, np.ma.compressed(np.ma.asarray(column))), default=0)
            wanted = f"a file of another format for unsigned integers such as those of {name!r}"
            check_that(largest < 2**63, "path", wanted, "a VOTable, which has none above 2^63")
        _change_type(table, name, _VOTABLE_TYPES)
        if isinstance(column, MaskedColumn) and column.dtype.kind in "US":
            # text has no mask there
            table.replace_column(name, Column(column.filled(""), name=name))
    return table


def _change_type(table, name, types):
    """Give a column of a table the type that stands for its own in a format."""
    column = table[name]
    dtype = getattr(column, "dtype", np.dtype(object)).newbyteorder("=")
    if dtype in types:
        changed = column.astype(types[dtype])
        changed.info = column.info
        table.replace_column(name, changed)


def table_hdu(table):
    """Binary table of a table with any columns that astropy has; its meta as `fits_meta` has it."""
    table = fits_ready(table)
    table.meta = fits_meta(table.meta)
    stream = io.BytesIO()
    with warnings.catch_warnings():
        # units such as dex are kept for astropy, and in the descriptions
        warnings.filterwarnings("ignore", "The unit .* could not be saved", AstropyUserWarning)
        table.write(stream, format="fits")
    stream.seek(0)
    return fits.open(stream)[1]


def fits_ready(table):
    """
    Prepare a table for FITS, whose missing integers are a number and whose truth values are never missing.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Any.

    Returns
    -------
    table : `~astropy.table.Table`
        A copy with the same data. Integers of 8 bits and floats of 16 have 16 and 32. Masked integers have a null
        value that does not occur among them, which is not so in astropy 8.0; truth values with missing ones are 0
        and 1 in bytes, as true and false cannot be missing.
    """
    table = table.copy(copy_data=False)
    for name in table.colnames:
        _change_type(table, name, _FITS_TYPES)
        column = table[name]
        if isinstance(column, Column) and column.dtype.kind == "U":
            _check_ascii(column)
        if not isinstance(column, MaskedColumn) or not column.mask.any():
            continue
        if column.dtype.kind == "b":
            column = MaskedColumn(column.astype(np.uint8), mask=column.mask, copy=False)
        elif column.dtype.kind in "iu":
            column = MaskedColumn(column, copy=True)
        else:
            continue
        column.info = table[name].info
        column.fill_value = _unused_number(column)
        table.replace_column(name, column)
    return table


def _check_ascii(column):
    """Refuse text that FITS cannot hold."""
    texts = np.ma.filled(column, "").ravel().tolist()
    foreign = next((text for text in texts if not text.isascii()), None)
    wanted = (
        f"a file of another format, such as .ecsv, for text in {column.name!r} that is not ASCII"
    )
    check_that(foreign is None, "path", wanted, f"FITS, for {foreign!r:.40}")


def _unused_number(column):
    """A number that no row of a column of integers has, as the null value of FITS."""
    values = column.compressed()
    limits = np.iinfo(column.dtype)
    for number in (_NULL, limits.min, limits.max):
        if limits.min <= number <= limits.max and number not in values:
            return number
    # a gap between neighbors, whose difference their own type may not hold
    ordered = np.unique(values).astype(object)
    gaps = np.flatnonzero(np.diff(ordered) > 1)
    if not gaps.size:
        msg = f"the column {column.name!r} has all numbers of its type, and missing ones: FITS has no null value"
        raise ValueError(msg)
    return int(ordered[gaps[0]]) + 1


def _table_format(path):
    start = _start(path).removeprefix(_BOM)
    first = start.strip().partition(b"\n")[0].decode(errors="replace")
    name = Path(path).name.lower()
    for packing in (".gz", ".bz2", ".xz", ".zip"):
        name = name.removesuffix(packing)
    suffix = Path(name).suffix
    if start.startswith(b"SIMPLE"):
        return "fits"
    if start.startswith(b"# %ECSV"):
        return "ascii.ecsv"
    if suffix in TABLE_FORMATS:
        return TABLE_FORMATS[suffix]
    named = first.startswith("#") and any(map(is_id_name, first.strip("# \r").split()))
    if is_sextractor(start):
        return "ascii.sextractor"
    if named:
        return "ascii.commented_header"
    # which astropy does not try
    if ";" in first:
        return "ascii.csv"
    return "ascii"
