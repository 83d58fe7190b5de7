"""Catalogs of photometry as CIGALE reads them."""

import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from miricigale.filters.band_names import band_filters, filter_of_band, is_line
from miricigale.utils.exceptions import DataError, MiricigaleWarning
from miricigale.utils.files import read_table
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU

__all__ = ["cigale_columns", "read_cigale_catalog"]

#: Values that stand for nothing, besides NaN and all below `THRESHOLD`.
SENTINELS = (-99.0, -999.0)
THRESHOLD = -9990.0
#: Relative error of fluxes without a column of errors.
DEFAULT_ERROR = 0.1

_OWN = ("id", "redshift", "distance")


def read_cigale_catalog(path, *, bands=None, limits=True, names=None, strict=False):
    """
    Read a catalog of photometry in CIGALE's format.

    Parameters
    ----------
    path : path-like
        A text table (with a header line, after ``#`` or not), FITS or VOTable file. Columns:
        ``id``, ``redshift``, optionally ``distance`` (Mpc), and for each band its flux by the
        band's name and its error ``<band>_err``; without a unit they are in mJy.
    bands : iterable of str, optional
        Which bands to read; all by default. A band named without its error
        (``["IRAC1", "IRAC1_err", "MIPS1"]``) gets 10 % of its flux, as in CIGALE; so does a
        band that has no column of errors.
    limits : bool, optional
        Whether negative errors mark upper limits; if not, such a band is missing.
    names : dict of str to str, optional
        Filters of bands that are not known, or otherwise known: CIGALE's name to ours (see
        `~miricigale.filters.Filter.from_name`).
    strict : bool, optional
        Whether a band without a filter is an error, not a warning.

    Returns
    -------
    photometry : `~astropy.table.QTable`
        ``id``; ``redshift``, NaN where it is missing or negative; ``distance`` if it is there;
        for each band, by our name, flux and error in uJy, and ``<filter>_limit`` if an object
        has an upper limit there: then the flux is the limit and the error its 1 sigma.
        ``meta["cigale"]`` has ``bands`` (our names to CIGALE's), ``default_error`` (bands
        with an error of 10 %) and ``left_out``.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file cannot be read, a column is missing, two bands are the same filter, or,
        with ``strict``, columns would be left out.

    Warns
    -----
    `~miricigale.utils.exceptions.MiricigaleWarning`
        Of bands and columns that are left out, all in one message.

    Notes
    -----
    Missing is a flux or error that is NaN, masked, -99, -999 or below -9990, and an error of 0.
    """
    path = Path(path)
    bands = None if bands is None else list(bands)
    table = read_table(path, wanted="a catalog of CIGALE", cls=Table)
    for name in ("id", "redshift"):
        if name not in table.colnames:
            msg = f"{path} has no column {name!r}, only {', '.join(table.colnames)}"
            raise DataError(msg)
    chosen = _choose(path, table, bands)
    with_error = {error_column(name) for name in chosen}.intersection(bands or table.colnames)
    lines = [name for name in chosen if _is_flux_of_line(table[name])]
    try:
        filters, lost = band_filters([name for name in chosen if name not in lines], names or {})
    except ValueError as err:
        msg = f"{path}: {err}"
        raise DataError(msg) from None
    if not filters:
        msg = f"{path} has no band that is known here, of {', '.join(chosen) or 'none'}"
        raise DataError(msg)
    left_out = [*lost, *(f"{name} (line)" for name in lines)]
    own = {*_OWN, *chosen, *map(error_column, chosen)}
    other = [] if bands is not None else [name for name in table.colnames if name not in own]
    out = QTable()
    out["id"] = np.array(table["id"])
    redshift = _numbers(path, table, "redshift")
    out["redshift"] = np.where(redshift >= 0, redshift, np.nan)
    if "distance" in table.colnames:
        out["distance"] = _with_unit(path, table, "distance", u.Mpc)
    no_error = []
    for name, band in filters.items():
        flux = _missing(_with_unit(path, table, band, u.mJy).to_value(FNU), 1e3)
        column = error_column(band)
        if column in with_error:
            error = _missing(_with_unit(path, table, column, u.mJy).to_value(FNU), 1e3)
        else:
            error = DEFAULT_ERROR * np.abs(flux)
            no_error.append(band)
        _add_band(out, name, flux, error, limits)
        out[name].info.description = band
    out.meta["cigale"] = {
        "file": path.name,
        "bands": filters,
        "default_error": no_error,
        "left_out": left_out + other,
    }
    told = {
        "left out, no filter here": left_out,
        "left out, no bands": other,
        "10 % of the flux taken for the error": no_error,
    }
    text = "; ".join(f"{what}: {', '.join(which)}" for what, which in told.items() if which)
    if strict and left_out:
        msg = f"{path}: {text}"
        raise DataError(msg)
    if text:
        warnings.warn(f"{path}: {text}", MiricigaleWarning, stacklevel=2)
    return out


def cigale_columns(path):
    """
    Columns of a catalog in CIGALE's format by our names, for `~miricigale.scene.read_catalog`.

    Parameters
    ----------
    path : path-like
        As for `read_cigale_catalog`.

    Returns
    -------
    columns : dict of str to str
        Our name of each band that is known, and of its errors, to the file's.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file cannot be read, or two bands are the same filter.
    """
    names = read_table(path, wanted="a catalog of CIGALE", cls=Table).colnames
    try:
        columns, _ = band_filters([name for name in names if not name.endswith("_err")], {})
    except ValueError as err:
        msg = f"{path}: {err}"
        raise DataError(msg) from None
    errors = {error_column(ours): error_column(theirs) for ours, theirs in columns.items()}
    return columns | {ours: theirs for ours, theirs in errors.items() if theirs in names}


def _choose(path, table, bands):
    """Bands to read."""
    if bands is None:
        return [
            name
            for name in table.colnames
            if name not in _OWN
            and not name.endswith("_err")
            and (error_column(name) in table.colnames or filter_of_band(name) or is_line(name))
        ]
    lost = [name for name in bands if name not in table.colnames]
    if lost:
        msg = f"{path} has no column {', '.join(lost)}; it has {', '.join(table.colnames)}"
        raise DataError(msg)
    return [name for name in dict.fromkeys(bands) if not name.endswith("_err")]


def _is_flux_of_line(column):
    unit = column.unit
    return is_line(column.name) or (unit is not None and unit.is_equivalent(u.W / u.m**2))


def _missing(values, factor):
    """Set values that stand for nothing to NaN; ``factor`` has brought them from mJy to uJy."""
    bad = values < THRESHOLD * factor
    for sentinel in SENTINELS:
        # the file's own number times a unit: equal but for rounding
        bad |= np.abs(values - sentinel * factor) <= 1e-9 * factor
    return np.where(bad, np.nan, values)


def _add_band(out, name, flux, error, limits):
    limit = error < 0
    gone = ~np.isfinite(flux) | ~np.isfinite(error) | (error == 0)
    if not limits:
        gone |= limit
    limit &= ~gone
    out[name] = np.where(gone, np.nan, flux) * FNU
    out[error_column(name)] = np.where(gone, np.nan, np.abs(error)) * FNU
    if np.any(limit):
        out[f"{name}_limit"] = limit
        out[f"{name}_limit"].info.description = "whether the flux is an upper limit"


def _numbers(path, table, name):
    """Column as floats, NaN where masked."""
    column = table[name]
    try:
        values = np.array(np.ma.getdata(column), dtype=float)
    except (TypeError, ValueError):
        msg = f"{path}: the column {name!r} holds something else than numbers"
        raise DataError(msg) from None
    values[np.broadcast_to(np.ma.getmaskarray(column), values.shape)] = np.nan
    return values


def _with_unit(path, table, name, default):
    unit = table[name].unit or default
    try:
        return (_numbers(path, table, name) * u.Unit(unit)).to(default)
    except (u.UnitConversionError, TypeError, ValueError):
        msg = f"{path}: the column {name!r} must be convertible to {default}, got {unit}"
        raise DataError(msg) from None
