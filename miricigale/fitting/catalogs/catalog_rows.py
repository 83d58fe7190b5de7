"""Rows of a catalog of photometry in a file, under our names and in units."""

import dataclasses

import astropy.units as u
from astropy.table import vstack

from miricigale.filters import CatalogMap
from miricigale.filters.catalog_files import CountedRows, MappedRows, as_catalog_map
from miricigale.filters.photometry_table import band_columns, unit_of_fluxes
from miricigale.fitting.data.likelihood import flux_columns
from miricigale.fitting.data.nuclei import NucleusColumns, nucleus_columns, nucleus_table
from miricigale.utils.row_files import open_rows


def open_catalog(path, chunk_rows=1000, *, hdu=None, catalog_map=None, flux_unit=None):
    """Open a catalog by rows (`~miricigale.utils.row_files.RowFile`), under our names or those of a map."""
    column_map = None
    id_names = ()
    if catalog_map is not None:
        column_map = as_catalog_map(catalog_map)
        id_names = column_map.id_names
    rows = open_rows(path, chunk_rows, hdu=hdu, id_names=id_names)
    if column_map is not None:
        if flux_unit is not None:
            column_map = dataclasses.replace(
                column_map, units={"flux": flux_unit, **column_map.units}
            )
        rows = MappedRows(rows, column_map)
    else:
        rows = _named_rows(rows, flux_unit)
    if "id" in rows.colnames:
        return rows
    return CountedRows(rows)


def _named_rows(rows, flux_unit):
    """Put rows under our names; with magnitudes by a map that makes fluxes of them."""
    first = rows.chunk(0)
    names, magnitudes = band_columns(first, rows.path.name)
    unit = None
    if flux_unit is not None:
        unit = unit_of_fluxes(flux_unit, "flux_unit")
    is_ab = unit == u.ABmag
    if not magnitudes and not is_ab:
        rows.rename(names)
        return rows
    columns = {ours: theirs for theirs, ours in names.items()}
    units = {}
    if unit is not None:
        units = {"flux": unit}
    return MappedRows(rows, CatalogMap(columns, units | dict.fromkeys(magnitudes, u.ABmag)))


def give_units(table, fluxes, unit):
    """Give flux columns that have no unit one; None gives none."""
    if unit is None:
        return
    unit = unit_of_fluxes(unit, "flux_unit")
    if unit == u.ABmag:
        # magnitudes are fluxes by now
        return
    for name in fluxes.intersection(table.colnames):
        if table[name].unit is None:
            table[name].unit = unit


def read_catalog_nuclei(path, bands, *, hdu=None, catalog_map=None, flux_unit=None):
    """
    Read the fluxes of nuclei of a catalog in a file.

    Parameters
    ----------
    path, hdu, catalog_map, flux_unit
        As for `~miricigale.fitting.fit_catalog`.
    bands : list of str
        Bands whose nuclei are read, by our names.

    Returns
    -------
    nuclei : `~astropy.table.QTable`
        A row for each row of the file; see `~miricigale.fitting.data.nuclei.nucleus_table`.
    """
    rows = open_catalog(path, hdu=hdu, catalog_map=catalog_map, flux_unit=flux_unit)
    columns = NucleusColumns.of_table(rows.colnames, bands)
    fluxes = set(flux_columns(nucleus_columns(rows.colnames)))
    pieces = []
    for i in range(rows.n_chunks):
        table = rows.chunk(i)
        give_units(table, fluxes, flux_unit)
        pieces.append(nucleus_table(table, columns))
    return vstack(pieces)
