"""Tables of fits: a row for each object, with the columns of its parameters or of its model fluxes."""

import astropy.units as u
import numpy as np

from miricigale.filters.band_names import known_filter
from miricigale.filters.band_table import BandTable
from miricigale.fitting.data.likelihood import FitFlags, filter_names
from miricigale.fitting.results.percentile_columns import LEVELS
from miricigale.fitting.results.table_columns import FIELDS, ODDS, TEXTS
from miricigale.utils.arrays import quotient
from miricigale.utils.options import check_names
from miricigale.utils.tables import described_table, error_column
from miricigale.utils.units import FNU


def reduced_chi2(chi2, n_bands):
    """Return chi2 over the number of bands less one, shape (n,); NaN of a single band."""
    degrees = np.asarray(n_bands) - 1
    return quotient(chi2, degrees, np.nan)


def result_table(results, names=None):
    """
    Tabulate results; see `~miricigale.fitting.FitResults.to_table`.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        Of several objects.
    names : list of str, optional
        Columns to keep, or parameters for all columns of these; all by default.

    Returns
    -------
    table : `~astropy.table.QTable`
    """
    texts = TEXTS["object"] | {"flags": FitFlags.describe()}
    columns = {}
    for name, text in texts.items():
        values = getattr(results, FIELDS.get(name, name))
        if values is not None:
            columns[name] = (values, text)
    for name in results.parameters:
        columns |= _parameter_columns(results, name)
    if results.outlier is not None:
        for name in results.fitted_filters:
            values = results.outlier[:, results.filters.index(name)]
            columns[f"{name}_outlier"] = (values, f"how likely {name} is wrong")
    if names is not None:
        columns = _chosen(results, columns, names)
    return described_table(columns, dict(results.meta), cls=BandTable)


def _parameter_columns(results, name):
    """Columns of a parameter or derived quantity: dict of values and description."""
    columns = {}
    meaning = results._meaning(name)
    percentiles = results.percentile(name, LEVELS)
    statistics = [results.mean(name), results.std(name), *percentiles.T, results.best[name]]
    for (suffix, text), values in zip(TEXTS["parameter"].items(), statistics, strict=True):
        columns[f"{name}_{suffix}"] = (values, f"{text} of {meaning}")
    if results.extensive(name):
        log_mean = results.moments[:, results._quantity(name), 2] * u.dex
        unit = results.unit(name).to_string()
        columns[f"{name}_logmean"] = (
            log_mean,
            f"posterior mean of log10 of {meaning}, in {unit}",
        )
    if name == "redshift" and not results.redshift_fixed:
        columns["redshift_odds"] = (results.redshift_odds, ODDS)
    return columns


def _chosen(results, columns, names):
    """Columns by name, or all of some parameters."""
    chosen = {}
    for name in names:
        parameter = results._named(name)
        if parameter in results.parameters:
            for suffix in (*TEXTS["parameter"], "logmean"):
                column = f"{parameter}_{suffix}"
                if column in columns:
                    chosen[column] = columns[column]
        else:
            check_names([name], "column", columns)
            chosen[name] = columns[name]
    return chosen


def flux_table(results, filters=None):
    """
    Tabulate model fluxes over the posterior in uJy; see `~miricigale.fitting.FitResults.predict`.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        Of several objects.
    filters : list of str or `~miricigale.filters.FilterSet`, optional
        Bands of the models; all by default.

    Returns
    -------
    table : `~astropy.table.QTable`
    """
    bands = results.filters
    labels = filter_names("filters", bands if filters is None else filters)
    try:
        names = [known_filter(label, bands, "filter of the models") for label in labels]
    except KeyError as err:
        err.add_note(
            "draws have other bands: fitter.sample(photometry, 1000, seed=1).predict(filters)"
        )
        raise
    columns = {"id": (results.ids, "identifier")}
    for name in names:
        k = bands.index(name)
        mean = results.model_flux[:, k] * FNU
        std = results.model_flux_std[:, k] * FNU
        best = results.best_flux[:, k] * FNU
        columns[name] = (mean, "posterior mean of the model flux")
        columns[error_column(name)] = (std, "its posterior standard deviation")
        columns[f"{name}_best"] = (best, "flux of the best model")
    return described_table(columns, dict(results.meta), cls=BandTable)
