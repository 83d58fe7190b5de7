"""Tables of the results of fits: methods of `~miricigale.fitting.FitResults`."""

import astropy.units as u

from miricigale.fitting.likelihood import FitFlags, filter_names
from miricigale.utils.declared import declared
from miricigale.utils.options import check_names
from miricigale.utils.tables import described_table, error_column
from miricigale.utils.units import FNU

#: Levels of the percentiles in the table.
LEVELS = (0.16, 0.5, 0.84)
#: Error of a redshift over 1 + z beyond which it is called an outlier.
OUTLIER = 0.15
#: What the column of the odds of redshifts is.
ODDS = f"probability that redshift_p50 is within {OUTLIER} (1 + z) of the redshift"
_TEXTS = declared("miricigale.fitting", "columns.toml")
#: Fields of results whose columns have another name.
_FIELDS = {"id": "ids", "chi2_best": "chi2"}


def to_table(results):
    """
    Results as a table.

    Returns
    -------
    table : `~astropy.table.QTable`
        One row for each object: ``id``, ``flags``, ``n_bands``, ``n_limits``,
        ``chi2_best``, ``reduced_chi2``, ``band_off``, ``log_evidence`` (of a sampler also
        ``log_evidence_err``, ``n_calls``, ``n_effective``, ``converged``), and for each
        parameter and derived quantity ``<name>_mean``, ``_std``, ``_p16``, ``_p50``, ``_p84``
        and ``_best``; derived quantities that scale with mass also have ``_logmean``, the mean
        of log10 (dex, in their unit). Of a fit with ``outliers``, for each band
        ``<band>_outlier``, how likely it is wrong. With free redshifts `redshift_odds`.
    """
    some = results._several()
    texts = _TEXTS["object"] | {"flags": FitFlags.describe()}
    columns = {n: (getattr(some, _FIELDS.get(n, n)), text) for n, text in texts.items()}
    columns = {n: value for n, value in columns.items() if value[0] is not None}
    for name in some.parameters:
        unit, meaning = some.unit(name), some._meaning(name)
        percentiles = some.percentile(name, LEVELS)
        parts = [some.mean(name), some.std(name), *percentiles.T, some.best[name]]
        for (suffix, text), value in zip(_TEXTS["parameter"].items(), parts, strict=True):
            columns[f"{name}_{suffix}"] = (value, f"{text} of {meaning}")
        if some.extensive(name):
            log_mean = some.moments[:, some._quantity(name), 2] * u.dex
            text = f"posterior mean of log10 of {meaning}, in {unit.to_string()}"
            columns[f"{name}_logmean"] = (log_mean, text)
        if name == "redshift" and not some.redshift_fixed:
            columns["redshift_odds"] = (some.redshift_odds, ODDS)
    if some.outlier is not None:
        for name in some.fitted_filters:
            value = some.outlier[:, some.filters.index(name)]
            columns[f"{name}_outlier"] = (value, f"how likely {name} is wrong")
    return described_table(columns, dict(results.meta))


def predict(results, filters=None):
    """
    Fluxes of the models over the posterior; `Samples.predict` has those in other bands.

    Parameters
    ----------
    filters : list of str or `~miricigale.filters.FilterSet`, optional
        Bands of the models, fitted or not; all by default.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``id`` and, for each filter, mean (by its name), standard deviation (``<name>_err``)
        and flux of the best model (``<name>_best``) in uJy.
    """
    some = results._several()
    columns = {"id": (some.ids, "identifier")}
    names = filter_names("filters", results.filters if filters is None else filters)
    check_names(names, "filter of the models", results.filters)
    for name in names:
        for column, array, text in (
            (name, some.model_flux, "posterior mean of the model flux"),
            (error_column(name), some.model_flux_std, "its posterior standard deviation"),
            (f"{name}_best", some.best_flux, "flux of the best model"),
        ):
            columns[column] = (array[:, results.filters.index(name)] * FNU, text)
    return described_table(columns, dict(results.meta))
