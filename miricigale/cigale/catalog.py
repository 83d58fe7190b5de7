"""Catalogs of photometry as CIGALE reads them."""

from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from miricigale.filters.band_names import band_filters, filter_of_band, is_line
from miricigale.filters.filter_arguments import given_filters
from miricigale.utils.exceptions import CatalogWarning, data_error, warn
from miricigale.utils.missing_values import negative_errors, plain_floats, without_codes
from miricigale.utils.options import check_data
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import error_column, read_ids
from miricigale.utils.units import FNU

#: All below stands for nothing, besides NaN and the codes of `without_codes`.
THRESHOLD = -9990.0
#: Relative error of fluxes without a column of errors.
DEFAULT_ERROR = 0.1

#: What a warning says of bands without a filter.
GIVE_FILTER = "names={'band': a Filter, a name, such as 'xray_boxcar_0p5to2keV', or the path of a file} gives one"

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
    names : dict, optional
        Filters of bands that are not known, or otherwise known: by CIGALE's name a
        `~miricigale.filters.Filter`, the name of one, or the path of its file (wavelengths in Angstrom, as
        CIGALE's files; see `~miricigale.filters.Filter.read`), which is called as the band.
    strict : bool, optional
        Whether a band without a filter is an error, not a warning.

    Returns
    -------
    photometry : `~astropy.table.QTable`
        ``id``; ``redshift``, NaN where it is missing or negative, and 0 where a galaxy with a distance is a little
        below 0; ``distance`` if it is there; for each band, by our name, flux and error in uJy, and
        ``<filter>_limit`` if an object has an upper limit there: then the flux is the limit and the error its 1
        sigma.
        ``meta["cigale"]`` has ``bands`` (our names to CIGALE's), ``default_error`` (bands
        with an error of 10 %) and ``left_out``.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file cannot be read, a column is missing, two bands are the same filter, or,
        with ``strict``, columns would be left out.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of bands and columns that are left out, and limits that are not positive, all in one message.

    Notes
    -----
    Missing is a flux or error that is NaN, masked, below -9990, or -99, -99.9, -99.99, -999 and the like in the
    file's unit, an error of 0, and an upper limit that is not positive.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from astropy.table import Table
    >>> from miricigale.cigale import read_cigale_catalog
    >>> rows = Table({"id": ["a"], "redshift": [1.3], "IRAC1": [2.0e-3], "IRAC1_err": [1e-4]})
    >>> with TemporaryDirectory() as folder:
    ...     rows.write(f"{folder}/galaxies.txt", format="ascii")
    ...     table = read_cigale_catalog(f"{folder}/galaxies.txt")
    >>> print(table["id", "irac.ch1"])
     id irac.ch1
          uJy
    --- --------
      a      2.0
    """
    path = Path(path)
    if bands is not None:
        bands = list(bands)
    table = read_table(path, wanted="a catalog of CIGALE", cls=Table)
    chosen = _choose(path, table, bands)
    with_error = set(map(error_column, chosen)).intersection(bands or table.colnames)
    lines = [name for name in chosen if _is_flux_of_line(table[name])]
    names = given_filters(names)
    try:
        filters, lost = band_filters([name for name in chosen if name not in lines], names)
    except ValueError as err:
        raise data_error(path, f"cannot be used: {err}") from None
    check_data(filters, path, f"has no band that is known here, of {', '.join(chosen) or 'none'}")
    left_out = lost + [f"{name} (line)" for name in lines]
    named = {*_OWN, *chosen, *map(error_column, chosen)}
    unused = []
    if bands is None:
        unused = [name for name in table.colnames if name not in named]
    out = QTable()
    out["id"] = read_ids(table, path.name)
    redshift = _numbers(path, table, "redshift")
    out["redshift"] = np.where(redshift >= 0, redshift, np.nan)
    if "distance" in table.colnames:
        distance = _numbers(path, table, "distance")
        out["distance"] = _in_unit(path, table, "distance", distance, u.Mpc)
        # CIGALE's advice for near galaxies, whose velocities say little of their distances
        rounded_redshift = (redshift < 0) & (redshift > -_NEAR) & (out["distance"] > 0)
        out["redshift"] = np.where(rounded_redshift, 0.0, out["redshift"])
    no_error = []
    no_limit = []
    for name, band in filters.items():
        column = None
        if error_column(band) in with_error:
            column = error_column(band)
        flux, error = _fluxes(path, table, band, column)
        if column is None:
            no_error.append(band)
        n_lost = _add_band(out, name, flux, error, limits)
        if n_lost:
            no_limit.append(f"{band} {n_lost}")
        out[name].info.description = band
    note = {"file": path.name, "bands": filters, "default_error": no_error}
    out.meta["cigale"] = note | {"left_out": left_out + unused}
    notes = {
        f"left out, no filter here ({GIVE_FILTER})": left_out,
        "left out, no bands": unused,
        "10 % of the flux taken for the error": no_error,
        "taken as missing, upper limits that are not positive": no_limit,
    }
    problems = [f"{problem}: {', '.join(names)}" for problem, names in notes.items() if names]
    text = "; ".join(problems)
    check_data(not (strict and left_out), path, f"cannot be used as a whole: {text}")
    if text:
        warn(f"{path}: {text}", CatalogWarning)
    return out


#: Redshift to which motions of near galaxies may reach: 0.01 is 3000 km/s.
_NEAR = 0.01


def _choose(path, table, bands):
    """Return the bands to read."""
    have = table.colnames
    if bands is None:
        candidates = [name for name in have if name not in _OWN]
        bands = []
        for x in candidates:
            if error_column(x) in have or filter_of_band(x) or is_line(x):
                bands.append(x)
    lost = [name for name in ("id", "redshift", *bands) if name not in have]
    check_data(not lost, path, f"has no column {', '.join(lost)}; it has {', '.join(have)}")
    return [name for name in dict.fromkeys(bands) if not name.endswith("_err")]


def _is_flux_of_line(column):
    unit = column.unit
    return is_line(column.name) or (unit is not None and unit.is_equivalent(u.W / u.m**2))


def _fluxes(path, table, band, column):
    """Flux and error of a band in uJy, NaN where they are missing; 10 % of the flux without a column."""
    values = _numbers(path, table, band)
    errors = None
    if column is not None:
        errors = _numbers(path, table, column)
    missing, no_error = without_codes(values, errors)
    flux = np.where(missing | (values < THRESHOLD), np.nan, values)
    flux = _in_unit(path, table, band, flux, u.mJy).to_value(FNU)
    if errors is None:
        return flux, DEFAULT_ERROR * np.abs(flux)
    errors = np.where(no_error | (errors < THRESHOLD), np.nan, errors)
    return flux, _in_unit(path, table, column, errors, u.mJy).to_value(FNU)


def _add_band(out, name, flux, error, limits):
    """Add the columns of a band; how many upper limits are not positive."""
    limit, nothing = negative_errors(flux, error)
    gone = ~np.isfinite(flux) | ~np.isfinite(error) | (error == 0) | nothing
    gone |= limit & (not limits)
    limit &= ~gone
    out[name] = np.where(gone, np.nan, flux) * FNU
    out[error_column(name)] = np.where(gone, np.nan, np.abs(error)) * FNU
    if np.any(limit):
        out[f"{name}_limit"] = limit
        out[f"{name}_limit"].info.description = "whether the flux is an upper limit"
    if limits:
        return np.count_nonzero(nothing)
    return 0


def _numbers(path, table, name):
    """Return the column as floats, NaN where masked."""
    try:
        return plain_floats(table[name], name, path)
    except ValueError:
        raise data_error(path, f"has other than numbers in the column {name!r}") from None


def _in_unit(path, table, name, values, default):
    """Return the numbers of a column in its unit, or the default one where it has none, converted to that."""
    unit = table[name].unit or default
    try:
        return (values * u.Unit(unit)).to(default)
    except (u.UnitConversionError, TypeError, ValueError):
        raise data_error(
            path, f"cannot be used: column {name!r} must be convertible to {default}, got {unit}"
        ) from None
