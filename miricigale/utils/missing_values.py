"""Numbers that stand for no value, and columns as plain numbers."""

import numpy as np

from miricigale.utils.exceptions import argument_error

#: Numbers that stand for no value, of either sign in magnitudes, negative in all other columns.
_CODES = np.array(
    [99.0, 99.9, 99.99, 99.999, 999.0, 999.9, 999.99, 9999.0, 9999.9, 99999.0, 999999.0]
)
#: No flux of a source is as large in any unit of catalogs, from nJy to Jy; programs write 1e20, 1e30 or 1e37.
_MAX_VALUE = 1e15
#: No source is as faint in AB magnitudes (4 fJy), nor as bright.
_MAX_MAGNITUDE = 45.0


def without_codes(values, errors=None, *, magnitudes=False, further=()):
    """
    Where numbers stand for no value.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (n,)
        Fluxes or magnitudes as in the file.
    errors : `~numpy.ndarray`, shape (n,), optional
        Their errors.
    magnitudes : bool, optional
        Whether they are magnitudes.
    further : iterable of float, optional
        More such numbers.

    Returns
    -------
    missing, no_error : `~numpy.ndarray` of bool, shape (n,)
        Values that are missing: -99, -999 and the like, unless the error is one of their size (0.2 to 100 times),
        as of noise in nJy; in magnitudes 99 and the like too, and 0 with an error that is not positive or without
        errors; in fluxes 99 and the like with the same number for the error, and 0 with an error of 0; and numbers
        beyond all fluxes and magnitudes, such as 1e20. Errors that are missing though the value may be there: a
        negative code, unless the value is one to ten times as large and positive, as limits are, and numbers
        beyond all errors.
    """
    code = is_code(values)
    largest = _MAX_VALUE
    if magnitudes:
        largest = _MAX_MAGNITUDE
    too_large = np.isfinite(values) & (np.abs(values) >= largest)
    further = np.asarray(list(further), float)
    named = np.isin(values, further)
    none = np.zeros(np.shape(values), bool)
    if errors is None:
        zero = none
        if magnitudes:
            zero = values == 0
        return (code & (magnitudes | (values < 0))) | zero | named | too_large, none
    repeats_value = errors == values
    size = np.abs(values)
    coded = is_code(errors)
    noise = (errors >= 0.2 * size) & (errors <= 100.0 * size)
    no_error = coded & (negative_codes(values, errors) | magnitudes | repeats_value)
    no_error |= np.isin(errors, further)
    no_error |= np.isfinite(errors) & (np.abs(errors) >= largest)
    zero = (values == 0) & (~(errors > 0) if magnitudes else errors == 0)
    missing = code & (((values < 0) & (coded | ~noise)) | magnitudes | repeats_value)
    return missing | zero | named | too_large, no_error


def negative_codes(values, errors):
    """
    Errors of fluxes that stand for no value because they are negative, whatever the number.

    Numbers such as -99 become -0.099 with the unit of a catalog, and -1 marks what was not measured. Left out are
    those that may be 1 sigma of an upper limit, of a positive flux one to ten times as large.

    Parameters
    ----------
    values, errors : `~numpy.ndarray`, shape (n,)
        Fluxes and errors, NaN where they are missing.

    Returns
    -------
    code : `~numpy.ndarray` of bool, shape (n,)
    """
    sigma = np.abs(errors)
    limit = (values >= sigma) & (values <= 10.0 * sigma)
    return (errors < 0) & ~limit


def negative_errors(values, errors):
    """
    Upper limits by CIGALE's convention: the value is the limit, and minus the error its 1 sigma.

    Parameters
    ----------
    values, errors : `~numpy.ndarray`, shape (n,)
        Fluxes and errors, NaN where they are missing.

    Returns
    -------
    limit, nothing : `~numpy.ndarray` of bool, shape (n,)
        Upper limits, and those that are none because they are not positive: no source is fainter than nothing.
    """
    is_negative = np.isfinite(values) & np.isfinite(errors) & (errors < 0)
    nothing = is_negative & (values <= 0)
    return is_negative & ~nothing, nothing


def is_code(values):
    """Which numbers are of the size of one that stands for no value, such as 99 or -999."""
    # single precision has seven digits
    size = np.abs(values)[..., None]
    return (np.abs(size - _CODES) <= 1e-6 * _CODES).any(axis=-1)


#: Words that stand for no value in tables of text, in lower case.
_WORDS = (
    "",
    "nan",
    "null",
    "na",
    "n/a",
    "#n/a",
    "none",
    "<na>",
    "nil",
    "-",
    "--",
    "---",
    "...",
    "masked",
    # of IRAF and of databases
    "indef",
    "\\n",
)


def is_missing_word(texts):
    """Which texts stand for no value, such as ``null``, ``NA`` or ``--``: array of bool."""
    return np.isin(np.char.lower(np.char.strip(np.asarray(texts, dtype=str))), _WORDS)


def own_mask(values):
    """Mask that values carry, bool or an array of it; the missing values of pandas, whose ``mask`` is a method."""
    if hasattr(values, "isna"):
        return np.asarray(values.isna(), dtype=bool)
    return getattr(values, "mask", False)


def mask_of(values):
    """
    Return where values are masked.

    Parameters
    ----------
    values : array_like
        `~numpy.ma.MaskedArray`, a column, `~astropy.utils.masked.Masked`, a quantity or anything else; of objects
        None and pandas' ``NA`` count as masked.

    Returns
    -------
    mask : `~numpy.ndarray` of bool
        Of the shape of the values.
    """
    if not hasattr(values, "dtype") and not hasattr(values, "mask"):
        values = np.asanyarray(values)
    shape = np.shape(values)
    mask = np.broadcast_to(np.asarray(own_mask(values), dtype=bool), shape)
    kind = getattr(getattr(values, "dtype", None), "kind", "O")
    if kind == "O" and not hasattr(values, "unit"):
        objects = np.asarray(values, dtype=object)
        if objects.shape == shape:
            gone = [_is_none(value) for value in objects.ravel()]
            mask = mask | np.array(gone, dtype=bool).reshape(shape)
    return mask


def _is_none(value):
    """Whether an object stands for no value: None, pandas' NA or a masked one."""
    return value is None or value is np.ma.masked or type(value).__name__ == "NAType"


def between_missing(present, missing):
    """Put the values that are there in their places, and zeros or empty text where ``missing`` (bool) is True."""
    values = np.zeros(missing.size, dtype=present.dtype)
    values[~missing] = present
    return values


def without_mask(values):
    """
    Take values and their mask apart.

    Parameters
    ----------
    values : array_like
        As for `mask_of`, also a `pandas.Series`.

    Returns
    -------
    values : array_like
        Without a mask; where they are masked, anything.
    mask : `~numpy.ndarray` of bool or None
        None if nothing is masked.
    """
    if hasattr(values, "isna") and hasattr(values, "to_numpy"):
        missing = np.asarray(values.isna(), dtype=bool)
        unmasked = between_missing(values[~missing].to_numpy(), missing)
        if missing.any():
            return unmasked, missing
        return unmasked, None
    if isinstance(values, (list, tuple)) and any(
        value is None or value is np.ma.masked for value in values
    ):
        values = np.array(
            [None if value is np.ma.masked else value for value in values], dtype=object
        )
    if hasattr(values, "dtype") or hasattr(values, "mask"):
        mask = mask_of(values)
    else:
        mask = np.zeros((), bool)
    if not np.any(mask):
        return getattr(values, "unmasked", values), None
    unmasked = getattr(values, "unmasked", values)
    if isinstance(unmasked, np.ma.MaskedArray):
        # columns keep their unit
        unit = getattr(unmasked, "unit", None)
        unmasked = np.ma.getdata(unmasked)
        if unit is not None:
            unmasked = unmasked << unit
    if unmasked.dtype.kind == "O":
        unmasked = np.where(mask, 0.0, unmasked).astype(float)
    return unmasked, mask


def floats(values):
    """
    Values as an array of floats, NaN where they are masked.

    Parameters
    ----------
    values : array_like
        Numbers without a unit, or whose unit counts for nothing; masked as for `mask_of`.

    Returns
    -------
    array : `~numpy.ndarray` of float
    """
    # plain numbers and arrays of them, of which nothing is masked, are by far the most
    if type(values) is np.ndarray and values.dtype.kind in "fiu":
        return values.astype(float, copy=False)
    if isinstance(values, float):
        return np.array(values, dtype=float)
    values, mask = without_mask(values)
    array = np.asarray(getattr(values, "value", values), dtype=float)
    if mask is None:
        return array
    return np.where(mask, np.nan, array)


def plain_floats(column, name, argument):
    """
    A column as plain floats, NaN where masked, blank or a word for no value (`is_missing_word`).

    A `ValueError` names the row and the text that is no number; truth values, dates and complex numbers are none.
    """
    mask = mask_of(column)
    column = getattr(column, "value", column)
    values = np.ma.getdata(getattr(column, "unmasked", column))
    if values.dtype.kind not in "iufSUO":
        wanted = f"a table with numbers in {name!r}"
        raise argument_error(argument, wanted, f"values of the type {values.dtype}")
    if values.dtype.kind == "S":
        values = np.char.decode(values, "utf-8", "replace")
    if values.dtype.kind in "OU":
        # a column without a single number is text to the reader
        values = np.where(mask, "nan", values.astype(str))
        values = np.where(is_missing_word(values), "nan", values)
    try:
        return np.where(mask, np.nan, values.astype(float))
    except (TypeError, ValueError):
        row = first_word(values) or 0
        wanted = f"a table with numbers in {name!r}"
        raise argument_error(
            argument, wanted, f"{values[row]!s:.40} in row {row} (from 0)"
        ) from None


def first_word(values):
    """Row of the first value that is no number; None if all are."""
    for row, value in enumerate(values.tolist()):
        try:
            float(value)
        except (TypeError, ValueError):
            return row
    return None
