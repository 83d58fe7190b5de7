"""Catalogs of other people, read from files, whole or by pieces."""

import dataclasses
import os
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from astropy.table import Column

from miricigale.filters.catalog_map import TRANSLATE_SUFFIXES, CatalogMap
from miricigale.utils.exceptions import CatalogWarning, argument_error, warn
from miricigale.utils.files import is_path, reading
from miricigale.utils.ids import counted_ids, warn_of_duplicates
from miricigale.utils.missing_values import plain_floats, without_codes
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import error_column
from miricigale.utils.units import own_unit

#: Fluxes from which on a fit leaves them out and flags it.
_FLAGGED = 1e60
#: Bands whose missing values are counted one by one in a message.
_FEW = 8


@takes_other_keywords
def read_catalog_photometry(path, catalog_map=None, *, hdu=None, **options):
    """
    Read the photometry of a catalog of other people.

    Parameters
    ----------
    path : path-like
        FITS (``file.fits[2]`` names an extension), ECSV, VOTable, CSV or text.
    catalog_map : `CatalogMap`, str or path-like, optional
        Names and units; the name of a survey (`SURVEYS`), or a file (`CatalogMap.read`): TOML, or a translate file
        of EAZY.
    hdu : int or str, optional
        Extension of a FITS file with several tables.
    **options
        As for `CatalogMap`, in place of what it has: ``columns``, ``units``, ``survey``, ``missing``, ``factor``,
        ``limits``.

    Returns
    -------
    photometry : `~astropy.table.QTable`
        Of our names: ``id`` (integers or text, as in the file), fluxes by filter and ``<filter>_err`` in uJy, NaN
        where missing, and the other columns of the file. `~miricigale.fitting.BayesFitter.fit` and
        `~miricigale.photometry.ErrorModel.from_tables` take it as it is.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such file, or it is no table.
    KeyError, ValueError, `~astropy.units.UnitsError`
        As `CatalogMap` and `CatalogMap.convert`.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of numbers that stand for no value, of bands without a filter, and of ids that occur more than once.

    Examples
    --------
    >>> from miricigale.filters import read_catalog_photometry
    >>> table = read_catalog_photometry("egs.fits", "candels")  # doctest: +SKIP
    >>> table = read_catalog_photometry("mine.csv", units={"flux": "ABmag"})  # doctest: +SKIP
    """
    path = Path(path)
    table, lost, coded = mapped_table(path, as_catalog_map(catalog_map, options), hdu)
    if "id" in table.colnames:
        warn_of_duplicates(table["id"], path.name, what="fits take the first row of each only")
    for text in catalog_messages(lost, [coded]):
        warn(f"{path.name}: {text}", CatalogWarning)
    return table


def mapped_table(path, catalog_map, hdu=None):
    """
    Read a table under our names and in our units.

    Returns
    -------
    table : `~astropy.table.QTable`
        The table.
    lost, coded
        What `catalog_messages` tells of: columns of bands without a filter, and numbers that stand for no value.
    """
    table = read_table(path, wanted="a table", hdu=hdu, id_names=catalog_map.id_names)
    with reading(path, "a catalog"):
        _, lost = catalog_map.names(table.colnames, path.name)
        table, coded = catalog_map.convert(table, path.name)
    return table, lost, coded


def as_catalog_map(catalog_map, options=None):
    """Return a `CatalogMap` of what a caller gave: one, the name of a survey or a file, with keyword arguments."""
    if hasattr(catalog_map, "trans") and hasattr(catalog_map, "error"):
        catalog_map = CatalogMap.from_translate(catalog_map)
    elif isinstance(catalog_map, str) and "\n" in catalog_map:
        # as TranslateFile.to_csv() of EAZY gives it
        catalog_map = CatalogMap.from_translate(catalog_map)
    elif isinstance(catalog_map, str) and not _is_file_name(catalog_map):
        catalog_map = CatalogMap(survey=catalog_map)
    elif is_path(catalog_map):
        catalog_map = CatalogMap.read(catalog_map)
    elif catalog_map is None:
        catalog_map = CatalogMap()
    elif not isinstance(catalog_map, CatalogMap):
        wanted = "a CatalogMap, the name of a survey or a file"
        raise argument_error("catalog_map", wanted, type(catalog_map).__name__)
    return dataclasses.replace(catalog_map, **options or {})


def _is_file_name(text):
    """Tell whether a text is the name of a file rather than of a survey."""
    return text.lower().endswith((".toml",) + TRANSLATE_SUFFIXES) or os.sep in text


def catalog_messages(lost, pieces):
    """Yield warnings about bands without a filter, and numbers for no value in pieces (dicts as of `codes_of`)."""
    if lost:
        yield f"left out, no filter here: {', '.join(lost)}"
    by_code = {}
    sizes = Counter()
    parts = []
    for coded in pieces:
        for name, values in coded.items():
            sizes[name] += values.size
            values_there = np.round(values[~np.isnan(values)], 4)
            by_code.setdefault(name, Counter()).update(values_there.tolist())
    for name, counts in by_code.items():
        if counts:
            codes = ", ".join(f"{value:g}" for value in sorted(counts)[:3])
            parts.append(f"{name} {counts.total()} of {sizes[name]} ({codes})")
    if parts:
        listed = "; ".join(_first_few(parts))
        yield f"taken as missing, by the number that stands there: {listed}"


def _first_few(parts):
    """Return what is said of bands, of the first few and how many more there are."""
    if len(parts) <= _FEW:
        return parts
    return parts[:_FEW] + [f"and {len(parts) - _FEW} more bands"]


def _fluxes_and_errors(table, bands):
    """Yield bands whose fluxes and errors are columns of plain numbers, with both, (n,); readers refuse others."""
    for name in bands:
        error = error_column(name)
        names = (name, error)
        if not set(names) <= set(table.colnames):
            continue
        if any(np.ndim(table[n]) != 1 or table[n].dtype.kind == "c" for n in names):
            continue
        try:
            values = plain_floats(table[name], name, "photometry")
            errors = plain_floats(table[error], error, "photometry")
        except ValueError:
            continue
        yield name, values, errors


def codes_of(table, bands):
    """
    Return the numbers of a table that stand for no value (`miricigale.utils.missing_values`).

    Parameters
    ----------
    table : `~astropy.table.Table`
        Fluxes by band and their errors, whatever the unit.
    bands : iterable of str
        The bands; those whose columns hold no plain numbers are skipped.

    Returns
    -------
    coded : dict of str to `~numpy.ndarray` of float, shape (n,)
        By band the number, NaN in rows that have none; as `catalog_messages` takes it.
    """
    coded = {}
    for name, values, errors in _fluxes_and_errors(table, bands):
        missing, no_error = without_codes(values, errors)
        # fits leave out, and flag, zeros with zero errors and what is beyond all measurements
        missing &= (values != 0) & (np.abs(values) < _FLAGGED)
        no_error &= np.abs(errors) < _FLAGGED
        code = np.where(missing, values, np.nan)
        coded[name] = np.where(no_error & ~missing, errors, code)
    return coded


def count_negative_errors(table, bands):
    """
    Count the errors of fluxes that are negative, without those that stand for no value.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Fluxes by band and their errors, whatever the unit.
    bands : iterable of str
        The bands; those whose columns hold no plain numbers are skipped.

    Returns
    -------
    counts : `collections.Counter`
        By band.
    """
    counts = Counter()
    for name, values, errors in _fluxes_and_errors(table, bands):
        missing, no_error = without_codes(values, errors)
        is_measured = np.isfinite(values) & ~missing & ~no_error
        n_negative = np.count_nonzero(is_measured & (errors < 0))
        if n_negative:
            counts[name] = n_negative
    return counts


def negative_error_message(counts):
    """Say what becomes of negative errors, and how to read them as limits; an empty text if there is none."""
    if not counts:
        return ""
    parts = _first_few([f"{name} {n}" for name, n in counts.items()])
    return (
        f"fluxes with a negative error are not fitted: {', '.join(parts)}; where it marks an upper "
        "limit, as in CIGALE, read_catalog_photometry(path, limits=True), or limits = true in the "
        "file of --map, reads it as one (a table has limits where <band>_limit is true, with their errors)"
    )


def without_codes_of(table, coded):
    """
    Return the table with missing fluxes and errors where `codes_of` found numbers for no value.

    Parameters
    ----------
    table : `~astropy.table.Table`
        As for `codes_of`; it stays as it is.
    coded : dict of str to `~numpy.ndarray` of float, shape (n,)
        What `codes_of` returned.

    Returns
    -------
    table : `~astropy.table.Table`
        Itself, if there are none; else a copy in which errors are NaN there, and fluxes that are such a number.
    """
    bands = [name for name, values in coded.items() if not np.isnan(values).all()]
    if not bands:
        return table
    out = table.copy(copy_data=False)
    for band in bands:
        error = error_column(band)
        flux = plain_floats(table[band], band, "photometry")
        flux_err = plain_floats(table[error], error, "photometry")
        flux_err[~np.isnan(coded[band])] = np.nan
        flux[flux == coded[band]] = np.nan
        for name, values in ((band, flux), (error, flux_err)):
            out[name] = Column(values, unit=own_unit(table[name]))
    return out


class CountedRows:
    """
    A table on disk by pieces, without ids: ``id`` counts the rows from 1.

    Parameters
    ----------
    rows : `~miricigale.utils.row_files.RowFile` or `MappedRows`
        The file.
    """

    def __init__(self, rows):
        self._rows = rows
        self.colnames = ("id", *rows.colnames)

    def __getattr__(self, name):
        return getattr(self._rows, name)

    def chunk(self, i):
        """Return a piece of the table."""
        table = self._rows.chunk(i)
        start, _ = self._rows.span(i)
        table.add_column(counted_ids(table, self._rows.path.name, start), index=0, name="id")
        return table


class MappedRows:
    """
    A table on disk by pieces, with our names and units.

    Parameters
    ----------
    rows : `~miricigale.utils.row_files.RowFile`
        The file.
    catalog_map : `CatalogMap`
        The map.
    """

    def __init__(self, rows, catalog_map):
        names, self._lost = catalog_map.names(rows.colnames, rows.path.name)
        self._rows = rows
        self.map = catalog_map
        self.colnames = tuple(names.values())

    def __getattr__(self, name):
        return getattr(self._rows, name)

    def _convert(self, i, *, quiet):
        with warnings.catch_warnings():
            if quiet:
                warnings.simplefilter("ignore", CatalogWarning)
            return self.map.convert(self._rows.chunk(i), self._rows.path.name)

    def chunk(self, i):
        """Return a piece of the table; its warnings are those of `messages`."""
        return self._convert(i, quiet=True)[0]

    def messages(self):
        """Return the warnings about the whole file, all of which is read."""
        pieces = (self._convert(i, quiet=i > 0)[1] for i in range(self._rows.n_chunks))
        return list(catalog_messages(self._lost, pieces))
