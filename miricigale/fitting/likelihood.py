"""From a catalogue of photometry to fluxes, errors and flags that a fit can use."""

from dataclasses import dataclass

import numpy as np

from miricigale.fitting.flags import FitFlags
from miricigale.utils.exceptions import argument_error
from miricigale.utils.tables import error_column, require_columns
from miricigale.utils.units import FNU, to_array

__all__ = ["FitData", "limits", "per_band", "read_photometry"]

_TRUE = ("true", "t", "1")
_FALSE = ("false", "f", "0", "")


@dataclass(frozen=True, eq=False)
class FitData:
    """
    Photometry in arrays.

    Parameters
    ----------
    ids : `~numpy.ndarray`, shape (n,)
        Ids of the objects, as they came.
    flux, flux_err : `~numpy.ndarray`, shape (n, nb)
        Measured fluxes and errors in uJy; NaN where there is none.
    sigma : `~numpy.ndarray`, shape (n, nb)
        Errors with the model error added in quadrature, of upper limits their own errors;
        infinite in bands not used.
    limit : `~numpy.ndarray` of bool, shape (n, nb)
        Which of the bands used are upper limits.
    flags : `~numpy.ndarray` of int, shape (n,)
        `FitFlags`.
    """

    ids: np.ndarray
    flux: np.ndarray
    flux_err: np.ndarray
    sigma: np.ndarray
    limit: np.ndarray
    flags: np.ndarray

    @property
    def used(self):
        """Which bands are used, shape (n, nb)."""
        return np.isfinite(self.sigma)

    @property
    def measured(self):
        """Which bands are used and no upper limits, shape (n, nb)."""
        return self.used & ~self.limit


def read_photometry(table, filters, *, model_error, error_floor, n_bands_min, grid_filters=None):
    """
    Take fluxes and errors from a table.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Column ``id``, a flux column for each filter and its error ``<name>_err``. NaN (or a
        masked value) in flux or error is a missing band. Where a boolean column
        ``<name>_limit`` (see `limits`) is true the flux is an upper limit and the error its
        1 sigma, to which neither model error nor floor are added.
    filters : tuple of str
        Bands to use; columns must be there.
    model_error : `~numpy.ndarray`, shape (n_filters,)
        Part of the flux that is added to its error in quadrature.
    error_floor : `~numpy.ndarray`, shape (n_filters,)
        Part of the flux below which no measured error is believed.
    n_bands_min : int
        Objects with fewer usable bands are flagged.
    grid_filters : tuple of str, optional
        Order of the bands in the arrays returned, ``filters`` and others, which get no data.

    Returns
    -------
    data : `FitData`

    Raises
    ------
    ValueError
        If a column is missing, or one of limits holds something else than true and false.
    `~astropy.units.UnitsError`
        If a flux has no unit of flux density.
    """
    grid_filters = tuple(filters) if grid_filters is None else tuple(grid_filters)
    columns = [c for name in filters for c in (name, error_column(name))]
    require_columns(table, ["id", *columns], "photometry", units=dict.fromkeys(columns, FNU))
    n = len(table)
    shape = (n, len(grid_filters))
    flux, err, sigma = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.inf)
    limit = np.zeros(shape, dtype=bool)
    flags = np.zeros(n, dtype=int)
    for name, extra, floor in zip(filters, model_error, error_floor, strict=True):
        i = grid_filters.index(name)
        f = _column(table, name)
        e = _column(table, error_column(name))
        flags[np.isinf(f)] |= int(FitFlags.BAD_FLUX)
        bad = np.isfinite(f) & ~((e > 0) & np.isfinite(e))
        # a flux without error is a missing band; errors of no use are worth a word
        flags[bad & ~np.isnan(e)] |= int(FitFlags.BAD_ERROR)
        good = np.isfinite(f) & np.isfinite(e) & (e > 0)
        flux[:, i], err[:, i] = f, e
        size = np.abs(np.where(good, f, 0.0))
        total = np.hypot(np.maximum(np.where(good, e, 1.0), floor * size), extra * size)
        limit[:, i] = good & limits(table, name)
        sigma[:, i] = np.where(good, np.where(limit[:, i], e, total), np.inf)
    n_bands = np.isfinite(sigma).sum(axis=1)
    flags[(n_bands > 0) & (n_bands == limit.sum(axis=1))] |= int(FitFlags.ALL_LIMITS)
    flags[n_bands == 0] |= int(FitFlags.NO_BAND)
    flags[(n_bands > 0) & (n_bands < n_bands_min)] |= int(FitFlags.FEW_BANDS)
    ids = np.asarray(table["id"])
    first = np.zeros(n, dtype=bool)
    first[np.unique(ids, return_index=True)[1]] = True
    flags[~first] |= int(FitFlags.DUPLICATE_ID)
    return FitData(ids, flux, err, sigma, limit, flags)


def limits(table, name):
    """
    Rows whose flux in a band is an upper limit.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Photometry. Its column ``<name>_limit``, if it is there, is boolean, or holds 0 and 1 or
        ``true`` and ``false`` as text files do; masked and empty values are no limits.
    name : str
        The band.

    Returns
    -------
    limit : `~numpy.ndarray` of bool, shape (n,)

    Raises
    ------
    ValueError
        If the column holds something else, such as the limit itself.
    """
    column = f"{name}_limit"
    if column not in table.colnames:
        return np.zeros(len(table), dtype=bool)
    values = table[column]
    mask = np.asarray(getattr(values, "mask", False))
    values = np.asarray(getattr(values, "unmasked", np.ma.getdata(values)))
    if values.dtype.kind in "US":
        values = np.char.strip(np.char.lower(values.astype(str)))
        known = np.isin(values, [*_TRUE, *_FALSE])
        limit = np.isin(values, _TRUE)
    elif values.dtype.kind in "biuf" and getattr(table[column], "unit", None) is None:
        known, limit = (values == 0) | (values == 1), values == 1
    else:
        known = limit = np.zeros(len(table), dtype=bool)
    if values.shape != (len(table),) or not np.all(known | mask):
        wanted = f"a table whose column {column!r} is boolean"
        raise argument_error("photometry", wanted, _some(table[column]))
    return limit & ~mask


def _some(column):
    """First values of a column, for a message."""
    return f"{', '.join(str(value) for value in column[:3])}, ..."


def per_band(value, filters, name):
    """Return a setting as an array over the filters: a number, or a dict by filter name."""
    if isinstance(value, dict):
        unknown = sorted(set(value) - set(filters))
        if unknown:
            raise argument_error(name, f"a dict with keys among {list(filters)}", f"{unknown}")
        value = [value.get(f, 0.0) for f in filters]
    array = np.broadcast_to(np.asarray(value, dtype=float), (len(filters),)).copy()
    if not np.all(np.isfinite(array) & (array >= 0)):
        raise argument_error(name, "finite and not negative", f"{value}")
    return array


def _column(table, name):
    column = table[name]
    mask = getattr(column, "mask", None)
    array = to_array(getattr(column, "unmasked", column), FNU, name, ndim=1).copy()
    if mask is not None and np.any(mask):
        array[np.asarray(mask)] = np.nan
    return array
