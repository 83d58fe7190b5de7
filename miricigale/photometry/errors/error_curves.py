"""Curves of one band: the error as a function of flux, from bins or from a formula."""

import itertools

import astropy.units as u
import numpy as np

from miricigale.filters import as_photometry
from miricigale.filters.band_names import known_filter
from miricigale.utils.arrays import nans
from miricigale.utils.column_units import quantity_table
from miricigale.utils.ids import id_column
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.tables import (
    columns_among,
    described_columns,
    error_column,
    read_ids,
    require_columns,
)
from miricigale.utils.units import FNU, own_unit, to_array
from miricigale.utils.values import value_class

#: What turns the median of absolute values into a standard deviation.
STATISTICS = {"mad": 1.482602218505602, "median_abs": 1.0}


@value_class
class Binned:
    """Errors at nodes in flux, joined by straight lines in asinh(flux)."""

    flux: np.ndarray
    error: np.ndarray
    low: float
    high: float
    kind = "binned"

    def sigma(self, flux):
        scale = self.error[0] if self.error[0] > 0 else 1.0
        return np.interp(np.arcsinh(flux / scale), np.arcsinh(self.flux / scale), self.error)

    def outside(self, flux):
        return (flux < self.low) | (flux > self.high)

    def rows(self):
        nan = nans(len(self.flux))
        low = np.full(len(self.flux), self.low)
        high = np.full(len(self.flux), self.high)
        return [self.flux, self.error, low, high, nan, nan]


@value_class
class Analytic:
    """sigma^2 = sky^2 + fraction^2 flux^2 + photon max(flux, 0)."""

    sky: float
    fraction: float = 0.0
    photon: float = 0.0
    kind = "analytic"
    high = np.inf

    def sigma(self, flux):
        return np.sqrt(
            self.sky**2 + (self.fraction * flux) ** 2 + self.photon * np.maximum(flux, 0)
        )

    def outside(self, flux):
        return np.zeros(np.shape(flux), bool)

    def rows(self):
        values = [np.nan, self.sky, np.nan, np.nan, self.fraction, self.photon]
        return np.array(values)[:, None]


def measured_curve(name, true, measured, size, statistic):
    """Measure errors (uJy) of one band in bins of true flux, from arrays in uJy."""
    wanted = f"at least three measured sources in {name!r}"
    check_that(len(true) >= 3, "measured", wanted, f"{len(true)}")
    # bins of equal number, the brightest first; the faintest takes the remainder
    order = np.argsort(-true, kind="stable")
    edges = np.arange(0, max(len(true) // size, 1) * size + 1, size)
    edges[-1] = len(true)
    parts = [order[a:b] for a, b in itertools.pairwise(edges)][::-1]
    flux = np.empty(len(parts))
    error = np.empty(len(parts))
    for k, part in enumerate(parts):
        flux[k], error[k] = _scatter(true[part], measured[part])
    if statistic != "median_abs":
        error = _pooled(flux, error)
    return Binned(flux, error * STATISTICS[statistic], float(true.min()), float(true.max()))


def _pooled(flux, error):
    """
    Pool errors until they rise with the flux, as does the signal-to-noise.

    The scatter of thirty sources is known to a fifth at best. Bins that contradict either order
    are joined (isotonic regression in the logarithm); otherwise the limit, where the
    signal-to-noise crosses a value, would be that of one unlucky bin.
    """
    from scipy.optimize import isotonic_regression

    order = np.argsort(flux, kind="stable")
    flux = flux[order]
    error = error[order]
    if np.all(error > 0):
        # errors that rise, then signal-to-noise that rises
        error = np.exp(isotonic_regression(np.log(error)).x)
        # the signal-to-noise of positive fluxes rises too
        bright = flux > 0
        ratio = np.log(flux[bright] / error[bright])
        error[bright] = flux[bright] / np.exp(isotonic_regression(ratio).x)
    back = np.empty_like(error)
    back[order] = error
    return back


def _scatter(true, measured):
    """
    Return the median true flux of a bin and the median absolute deviation there.

    Bright sources scatter in proportion to their flux (templates, blends), faint ones by the
    noise of the sky. Where the signal-to-noise is above 5 the deviations are taken relative to
    each flux, or the brightest of a wide bin would set the error of the faintest.
    """
    flux = np.median(true)
    absolute = np.median(np.abs(measured - true))
    if flux > 5 * absolute and np.all(true > 0):
        return flux, flux * np.median(np.abs(measured / true - 1.0))
    return flux, absolute


def limiting_flux(curve, n_sigma):
    """Find the flux (uJy) above which the signal-to-noise exceeds ``n_sigma``; NaN if none reaches it."""
    from scipy.optimize import brentq

    def excess(flux):
        return flux - n_sigma * float(curve.sigma(flux))

    # the last flux of a grid below the limit brackets it
    grid = np.geomspace(1e-9, 1e9, 3601)
    undetected = np.flatnonzero(grid < n_sigma * curve.sigma(grid))
    if len(undetected) == 0:
        return grid[0]
    last = undetected[-1]
    if last == len(grid) - 1:
        return np.nan
    limit = brentq(excess, grid[last], grid[last + 1], rtol=1e-12)
    if limit > curve.high:
        return np.nan
    return limit


def common_bands(truth, measured):
    """Return the names of the flux columns that two tables both have; refuse tables without any."""
    require_columns(truth, [], "truth")
    require_columns(measured, [], "measured")
    errors = {error_column(name) for name in truth.colnames}
    shared = [name for name in truth.colnames if name in measured.colnames and name not in errors]
    bands = []
    for name in shared:
        unit = own_unit(truth[name])
        if unit is not None and u.Unit(unit).is_equivalent(FNU):
            bands.append(name)
    wanted = "tables that share a column of fluxes with a unit (or 'filters' given)"
    check_that(bands, "truth, measured", wanted, f"the common columns {shared}")
    return bands


def same_rows(truth, measured):
    """Return the rows of two tables that belong to the same source, by their ids or by place."""
    names = id_column(truth.colnames, "truth"), id_column(measured.colnames, "measured")
    if None not in names:
        _, rows, measured_rows = np.intersect1d(
            read_ids(truth, "truth"), read_ids(measured, "measured"), return_indices=True
        )
        return rows, measured_rows
    wanted = f"a table of {len(truth)} rows as 'truth', or ids in both"
    check_that(len(truth) == len(measured), "measured", wanted, len(measured))
    rows = np.arange(len(truth))
    return rows, rows


def flux_table(photometry, filters, model_bands):
    """Copy a table with fluxes in uJy, and choose the bands: those of ``model_bands`` that it has by default."""
    if filters is not None:
        filters = [known_filter(name, model_bands, "band of this error model") for name in filters]
    names = model_bands if filters is None else filters
    wanted = "a table that names the bands, such as QTable(fluxes, names=bands)"
    check_that(not isinstance(photometry, u.Quantity), "photometry", wanted, "fluxes without names")
    if names and not set(names) & set(getattr(photometry, "colnames", ())):
        photometry = as_photometry(photometry, names)
    require_columns(photometry, [], "photometry")
    if filters is None:
        filters = columns_among(photometry, model_bands)
    check_that(filters, "filters", "at least one band", "none")
    require_columns(photometry, filters, "photometry", units=dict.fromkeys(filters, FNU))
    table = quantity_table(photometry, copy=True)
    for name in filters:
        table[name] = to_array(table[name], FNU, name) * FNU
    return table, filters


def curves_to_table(curves, meta):
    """Make the table of curves by filter name."""
    rows = [np.stack(curve.rows()) for curve in curves.values()]
    counts = [values.shape[1] for values in rows]
    values = np.concatenate([np.empty((6, 0))] + list(rows), axis=1)
    flux, sigma, low, high, fraction, photon = values
    kinds = np.array([curve.kind for curve in curves.values()], str)
    columns = {
        "filter": np.repeat(np.array(list(curves), str), counts),
        "kind": np.repeat(kinds, counts),
        "flux": flux * FNU,
        "sigma": sigma * FNU,
        "low": low * FNU,
        "high": high * FNU,
        "fraction": fraction * u.dimensionless_unscaled,
        "photon": photon * FNU,
    }
    texts = column_texts("miricigale.photometry", "curves")
    return described_columns(columns, texts, dict(meta))


def curves_from_table(table):
    """Make the curves by filter name of what `curves_to_table` made."""
    wanted = ["filter", "kind", "flux", "sigma", "low", "high", "fraction", "photon"]
    require_columns(table, wanted, "table")
    curves = {}
    filters = np.asarray(table["filter"]).astype(str)
    for name in dict.fromkeys(filters):
        part = table[filters == name]
        sigma = u.Quantity(part["sigma"]).to_value(FNU)
        if part["kind"][0] == "binned":
            flux = u.Quantity(part["flux"]).to_value(FNU)
            low = u.Quantity(part["low"][0]).to_value(FNU)
            high = u.Quantity(part["high"][0]).to_value(FNU)
            curves[name] = Binned(flux, sigma, float(low), float(high))
        else:
            fraction = u.Quantity(part["fraction"][0]).value
            photon = u.Quantity(part["photon"][0]).to_value(FNU)
            curves[name] = Analytic(float(sigma[0]), float(fraction), float(photon))
    return curves
