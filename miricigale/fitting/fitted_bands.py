"""Bands of a catalog and of a fitter: methods of `~miricigale.fitting.BayesFitter`."""

import numpy as np

from miricigale.filters import as_photometry
from miricigale.filters.catalog_files import codes_of, warn_of_codes
from miricigale.filters.photometry_table import our_names
from miricigale.fitting.likelihood import PhotometryReader, is_filter, unused_bands
from miricigale.utils.exceptions import FitWarning, warn
from miricigale.utils.ids import warn_of_duplicates
from miricigale.utils.options import check_that
from miricigale.utils.tables import as_table, error_column, read_ids
from miricigale.utils.units import FNU


def bands_of(photometry):
    """
    Bands of a catalog that can be fitted: those of known filters that have an error.

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
    ours = our_names(table.colnames, "photometry")
    bands = bands_with_errors([ours.get(name, name) for name in table.colnames], "photometry")
    taken = {name for name, our in ours.items() if our in bands}
    return bands, unused_bands(table, {*bands, *taken})


def warn_of_unfitted(unused):
    """Warn of bands of a catalog that cannot be fitted."""
    if unused:
        why = "as their names ('miricigale filters') or errors are missing"
        warn(f"bands of the photometry are not fitted, {why}: {', '.join(unused)}", FitWarning)


def bands_with_errors(names, argument):
    """Of our names of columns those of bands that have an error: list of str, one at least."""
    bands = [name for name in names if is_filter(name) and error_column(name) in names]
    wanted = "a table with columns <filter> and <filter>_err ('miricigale filters' lists the names)"
    check_that(bands, argument, wanted, f"columns {list(names)}")
    return bands


def _table_of(fitter, photometry, unit=None):
    """
    The catalog by our names, fluxes without a unit in ``unit``, with what there is to warn of.

    A band of ``filters`` that it lacks is a missing one of all objects.
    """
    table = as_photometry(photometry, fitter.filters or fitter.bands, units=unit)
    lost = [name for name in fitter.filters or () if name not in table.colnames]
    if lost and len(lost) < len(fitter.filters):
        text = f"the photometry has no {', '.join(lost)}: missing bands of all objects"
        warn(text, FitWarning)
        table = table.copy(copy_data=False)
        for name in lost:
            table[name] = table[error_column(name)] = np.full(len(table), np.nan) * FNU
    warn_of_duplicates(read_ids(table), "photometry")
    warn_of_codes([codes_of(table, fitter._reader.fitted(table))], "photometry")
    fitter._warn_of_bands(table)
    return table


def _read_bands(fitter, photometry, bands):
    """Photometry (`~miricigale.fitting.likelihood.FitData`) of bands, with zero points and its own errors."""
    zero = dict.fromkeys(bands, 0.0)
    return PhotometryReader(bands, bands, zero, zero, 1, fitter.zero_points).read(photometry)


def _warn_of_bands(fitter, photometry):
    """Warn of bands that are not fitted, if the fitter does not name those that are."""
    unused = unused_bands(photometry, fitter._reader.fitted(photometry))
    if unused and fitter.filters is None:
        text = "bands of the photometry that the grid lacks are not fitted"
        warn(f"{text}: {', '.join(unused)}", FitWarning)
