"""Tables in FITS files: what astropy reads otherwise than the file means it, and types that FITS does not have."""

import io
import warnings

import numpy as np
from astropy.io import fits
from astropy.table import Column, MaskedColumn
from astropy.utils.exceptions import AstropyUserWarning

from miricigale.utils.exceptions import CatalogWarning, warn
from miricigale.utils.meta import fits_meta
from miricigale.utils.options import check_that

#: The table of keywords in files of SExtractor, before that of its objects.
LDAC_HEADER = "LDAC_IMHEAD"
#: What astropy writes for a missing integer, if the column has no such number.
_NULL = 999999
#: Types that FITS does not have, or takes for truth values, by what stands for them.
FITS_TYPES = {np.dtype(np.int8): np.int16, np.dtype(np.float16): np.float32}


def first_table(hdus):
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


def table_read(hdus, chosen):
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
        change_type(table, name, FITS_TYPES)
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


def change_type(table, name, types):
    """Give a column of a table the type that stands for its own in a format."""
    column = table[name]
    dtype = getattr(column, "dtype", np.dtype(object)).newbyteorder("=")
    if dtype in types:
        changed = column.astype(types[dtype])
        changed.info = column.info
        table.replace_column(name, changed)


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
