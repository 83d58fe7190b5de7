"""Results of fits whose posteriors are those of models between the nodes of a grid."""

from dataclasses import replace

import numpy as np

from miricigale.fitting.data.likelihood import FitFlags
from miricigale.fitting.posterior.quantities import DERIVED_LEVELS, draws_summary, node_shares
from miricigale.fitting.results.results import FitResults


def between_results(fit, data, posteriors, pairs):
    """
    Make the results of objects that all have a posterior between the nodes.

    Parameters
    ----------
    fit : `~miricigale.fitting.grid.grid_fit.GridFit`
        The fit.
    data : `~miricigale.fitting.data.likelihood.FitData`
        Photometry of n objects.
    posteriors : list of `~miricigale.fitting.grid.continuation.BetweenPosterior`
        Their posteriors.
    pairs : tuple of tuple of str
        Parameters whose joint posteriors are asked for.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`
    """
    axes = fit.priors.axes
    n = len(posteriors)
    # a grid without AGN has one fraction
    fractions = fit.grid.frac_agn.size
    size = {name: axis.values.size for name, axis in axes.items()} | {"frac_agn": fractions}
    arrays = {
        "pdf": {name: np.empty((n, size[name])) for name in axes},
        "pairs": {(x, y): np.empty((n, size[x], size[y])) for x, y in pairs},
        "pdf_2d": np.empty((n, size["redshift"], fractions)),
        "axis_moments": np.empty((n, len(axes), 2)),
        "axis_quantiles": np.empty((n, len(axes), DERIVED_LEVELS.size)),
    }
    for i, posterior in enumerate(posteriors):
        _put_parameters(arrays, i, posterior)
    flags = np.array(data.flags)
    converged = np.array([posterior.converged for posterior in posteriors], bool)
    # results rest on fewer models than were asked for
    flags[~converged] |= FitFlags.NOT_CONVERGED
    node = np.array([posterior.best_node for posterior in posteriors]).reshape(n, -1)
    log_errors = fit.log_errors(data)
    data = fit.with_template_error(data, node[:, 0])
    moments, quantiles = _derived_summaries(fit.engine.quantities, posteriors)
    flux = np.array([posterior.flux for posterior in posteriors])
    outlier = None
    if fit.engine.mixture is not None:
        wrong = np.array([posterior.wrong for posterior in posteriors])
        in_fit = np.isfinite(data.sigma) | data.limit
        outlier = np.where(in_fit, wrong, np.nan)
    bins = fit.given.agn_bins
    agn_weights = None
    if bins is not None:
        agn_weights = np.array([bins(posterior) for posterior in posteriors], np.float32)
    return FitResults(
        **data.columns,
        **arrays,
        **fit.result_settings(),
        flags=flags,
        chi2=_column(posteriors, "chi2"),
        log_evidence=_column(posteriors, "log_sum") - log_errors,
        best_index=fit.between.index_of_nodes(node),
        best_scale=_column(posteriors, "best_scale"),
        best=_best(fit, posteriors),
        moments=moments,
        quantiles=quantiles,
        model_flux=flux[:, 0],
        model_flux_std=flux[:, 1],
        best_flux=_column(posteriors, "best_flux"),
        outlier=outlier,
        agn_weights=agn_weights,
    )


def with_axis_summaries(results):
    """Add moments and quantiles of parameters to results on nodes, which are flagged as not converged."""
    names = list(results.axes)
    n = len(results)
    moments = np.full((n, len(names), 2), np.nan)
    quantiles = np.full((n, len(names), DERIVED_LEVELS.size), np.nan)
    flags = np.array(results.flags)
    fitted = np.isfinite(results.chi2)
    flags[fitted] |= FitFlags.NOT_CONVERGED
    for i in np.flatnonzero(fitted):
        single = results[i]
        for j, name in enumerate(names):
            moments[i, j] = (single.mean(name).value, single.std(name).value)
            quantiles[i, j] = single.percentile(name, DERIVED_LEVELS).value
    return replace(results, flags=flags, axis_moments=moments, axis_quantiles=quantiles)


def _put_parameters(arrays, i, posterior):
    """Put the posterior of the parameters in row ``i`` of arrays."""
    node = posterior.node
    weight = posterior.weight
    for j, (name, table) in enumerate(arrays["pdf"].items()):
        table[i] = node_shares((node[name],), table.shape[1:], weight)
        moments, quantiles = draws_summary(posterior.values[name], weight=weight)
        arrays["axis_moments"][i, j] = moments[:2]
        arrays["axis_quantiles"][i, j] = quantiles
    # every fit has the joint posterior of redshift and AGN fraction
    joint = arrays["pairs"] | {("redshift", "frac_agn"): arrays["pdf_2d"]}
    for (x, y), table in joint.items():
        table[i] = node_shares((node[x], node[y]), table.shape[1:], weight)


def _derived_summaries(quantities, posteriors):
    """Summarize derived quantities: moments (n, n_quantities, 3), quantiles (n, n_quantities, n_levels)."""
    n = len(posteriors)
    moments = np.full((n, len(quantities.names), 3), np.nan)
    quantiles = np.full((n, len(quantities.names), DERIVED_LEVELS.size), np.nan)
    for j, name in enumerate(quantities.names):
        # a mean of log10 has a meaning for what scales with mass
        with_log = name not in quantities.intensive
        for i, posterior in enumerate(posteriors):
            if name in posterior.derived:
                summary = draws_summary(
                    posterior.derived[name], with_log=with_log, weight=posterior.weight
                )
                moments[i, j] = summary[0]
                quantiles[i, j] = summary[1]
    return moments, quantiles


def _best(fit, posteriors):
    """Collect parameters and derived quantities of the best models: dict of str to array."""
    out = {}
    for name in list(fit.priors.axes) + list(fit.engine.quantities.names):
        values = [posterior.best.get(name, np.nan) for posterior in posteriors]
        out[name] = np.array(values, float)
    return out


def _column(posteriors, name):
    """Collect an attribute of all posteriors as an array."""
    return np.array([getattr(posterior, name) for posterior in posteriors])
