"""Numbers of the objects of a fitted catalog that a page shows, and their known redshifts."""

import numpy as np
from astropy.table import Table, vstack

from miricigale.utils.arrays import nans, quiet_division
from miricigale.utils.missing_values import plain_floats
from miricigale.utils.named_values import places
from miricigale.utils.options import check_that

#: Columns that hold known redshifts, the first that is there.
KNOWN_REDSHIFTS = ("z_spec", "zspec", "z_true", "redshift_spec", "redshift")


def thinned(parts, step):
    """Yield parts with every ``step``-th of their rows, counted through all parts."""
    first = 0
    for part in parts:
        yield part[first::step]
        first = (first - len(part)) % step


def fit_numbers(results, step):
    """
    Collect the numbers of all objects, or of every ``step``-th, in the order of the catalog.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResultsFiles`
        The fit.
    step : int
        For catalogs that are longer than memory.

    Returns
    -------
    table : `~astropy.table.Table`
        A row for each object: redshift, fraction and mass at 16, 50 and 84 %, fit, and ratios and pulls in the
        bands ``meta["filters"]``; ``meta["fixed"]`` is whether redshifts were given.
    """
    table = vstack([Table(_numbers(part)) for part in thinned(results.parts(), step)])
    first = next(iter(results.parts()))
    table.meta.update(filters=first.fitted_filters, fixed=first.redshift_fixed)
    return table


def _numbers(part):
    n = len(part)
    bands = places(part.fitted_filters, part.filters)
    measured = np.isfinite(part.sigma[:, bands]) & ~part.limit[:, bands]
    error = part.flux_err[:, bands]
    with quiet_division():
        model = part.best_flux[:, bands]
        flux = part.flux[:, bands]
        ratio = np.where(measured & (model > 0), flux / model, np.nan)
        pull = np.where(measured, (flux - model) / part.sigma[:, bands], np.nan)
    out = {
        "ids": np.array(part.ids).astype(str),
        "flags": np.array(part.flags),
        "n_bands": np.array(part.n_bands),
        "good": np.isfinite(part.reduced_chi2),
        "chi2": np.array(part.reduced_chi2, float),
        "ratio": ratio.astype(np.float32),
        "pull": pull.astype(np.float32),
        # a flux whose error is NaN is a missing band, and no mistake
        "unusable": np.isfinite(flux) & ~np.isfinite(part.sigma[:, bands]) & ~np.isnan(error),
    }
    if part.outlier is not None:
        out["wrong"] = part.outlier[:, bands] > 0.5
    for name, parameter in (("z", "redshift"), ("frac", "frac_agn"), ("mass", "stellar_mass")):
        values = nans((n, 3))
        if parameter in part.parameters:
            values = np.asarray(part.percentile(parameter, [0.16, 0.5, 0.84]).value)
        elif parameter in part.constants:
            values[:] = np.where(part.fitted, part.constants[parameter], np.nan)[:, None]
        out[name] = values
    return out


def known_redshifts(rows, name, step=1):
    """
    Read the known redshifts of a catalog.

    Parameters
    ----------
    rows : `~miricigale.utils.row_files.RowFile` or `~miricigale.filters.catalog_files.MappedRows`
        The catalog.
    name : str or None
        The column; None for the first of `KNOWN_REDSHIFTS` that is there.
    step : int, optional
        As for `fit_numbers`.

    Returns
    -------
    name : str or None
        The column, None without one.
    redshift : `~numpy.ndarray`, shape (n,)
        NaN where it is missing or not positive.

    Raises
    ------
    ValueError
        If there is no column ``name``.
    """
    names = rows.colnames
    if name is None:
        name = next((column for column in KNOWN_REDSHIFTS if column in names), None)
    if name is None:
        return None, nans(len(range(0, rows.n_rows, step)))
    check_that(name in names, "z_spec", f"one of the columns {list(names)}", repr(name))
    chunks = thinned(map(rows.chunk, range(rows.n_chunks)), step)
    z = np.concatenate([plain_floats(chunk[name], name, "photometry") for chunk in chunks])
    return name, np.where(z > 0, z, np.nan)
