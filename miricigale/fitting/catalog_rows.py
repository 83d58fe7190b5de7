"""Rows of a catalog of photometry in a file, under our names and in units."""

import dataclasses

from miricigale.filters.catalog_files import CountedRows, MappedRows, as_catalog_map
from miricigale.filters.photometry_table import band_columns
from miricigale.utils.row_files import open_rows


def open_catalog(path, chunk_rows, *, hdu=None, catalog_map=None, flux_unit=None):
    """Open a catalog by rows (`~miricigale.utils.row_files.RowFile`), under our names or those of a map."""
    known = None if catalog_map is None else as_catalog_map(catalog_map)
    id_names = () if known is None else known.id_names
    rows = open_rows(path, chunk_rows, hdu=hdu, id_names=id_names)
    if known is not None:
        if flux_unit is not None:
            known = dataclasses.replace(known, units={"flux": flux_unit, **known.units})
        rows = MappedRows(rows, known)
    else:
        rows.rename(band_columns(rows.colnames, rows.path.name))
    return rows if "id" in rows.colnames else CountedRows(rows)


def give_units(table, fluxes, unit):
    """Give flux columns that have no unit one; None gives none."""
    if unit is None:
        return
    for name in fluxes.intersection(table.colnames):
        if table[name].unit is None:
            table[name].unit = unit
