"""Bands of a catalog that can be fitted."""

from miricigale.filters.photometry_table import our_names
from miricigale.filters.surveys import map_names
from miricigale.fitting.data.likelihood import is_filter, unused_bands
from miricigale.utils.exceptions import FitWarning, warn
from miricigale.utils.options import check_that
from miricigale.utils.tables import as_table, error_column


def bands_of(photometry):
    """
    Find the bands of a catalog that can be fitted: those of known filters that have an error.

    Parameters
    ----------
    photometry : `~astropy.table.Table` or anything for `~miricigale.utils.tables.as_table`
        As for `~miricigale.fitting.BayesFitter.fit`.

    Returns
    -------
    bands, unused : list of str
        Those bands by our names, in the order of the columns, and others that the catalog has.

    Raises
    ------
    ValueError
        If there is none.
    """
    table = as_table(photometry, "photometry")
    ours = our_names(table.colnames)
    bands = bands_with_errors([ours.get(name, name) for name in table.colnames], "photometry")
    catalog_names = {name for name, our in ours.items() if our in bands}
    return bands, unused_bands(table, catalog_names.union(bands))


def warn_of_unfitted(unused):
    """Warn of bands of a catalog that cannot be fitted."""
    if unused:
        reason = "as their names ('miricigale filters') or errors are missing"
        warn(f"bands of the photometry are not fitted, {reason}: {', '.join(unused)}", FitWarning)


def bands_with_errors(names, argument):
    """Select, from our names of columns, the bands that have an error: list of str, at least one."""
    bands = [name for name in names if is_filter(name) and error_column(name) in names]
    wanted = "a table with columns <filter> and <filter>_err ('miricigale filters' lists the names)"
    if not bands:
        wanted += _maps_for(names)
    check_that(bands, argument, wanted, f"columns {list(names)}")
    return bands


def _maps_for(names):
    """Return what to say of maps that fit the columns of a catalog, or of maps at all."""
    maps = map_names(names)
    if not maps:
        return ", or names by --map (read_catalog_photometry in Python)"
    return f", or {maps}, whose columns these are"
