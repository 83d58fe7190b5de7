"""Results of fits whose posteriors are those of models between the nodes of a grid."""

import numpy as np

from miricigale.fitting.likelihood import FitFlags
from miricigale.fitting.quantities import DERIVED_LEVELS, draws_summary, node_shares, put_draws


def between_nodes(found, results):
    """
    Results with posteriors, moments and percentiles of models between the nodes.

    Parameters
    ----------
    found : dict of int to `~miricigale.fitting.continuation.BetweenPosterior` or None
        What `~miricigale.fitting.continuation.Continuation.place` found, by row.
    results : `~miricigale.fitting.FitResults`
        What was found on the nodes.
    """
    names, n, new = list(results.axes), len(results), results._mapped(np.array)
    # the best models stay those of the nodes
    del new["best"]
    new["axis_moments"] = np.full((n, len(names), 2), np.nan)
    new["axis_quantiles"] = np.full((n, len(names), DERIVED_LEVELS.size), np.nan)
    for i, posterior in found.items():
        if posterior is None or not posterior.models.converged:
            new["flags"][i] |= int(FitFlags.NOT_CONVERGED)
        if posterior is None:
            # what is known is that of the nodes
            one = results[i]
            for j, name in enumerate(names):
                new["axis_moments"][i, j] = one.mean(name).value, one.std(name).value
                new["axis_quantiles"][i, j] = one.percentile(name, DERIVED_LEVELS).value
            continue
        node, weight = posterior.node, posterior.weight
        if posterior.wrong is not None:
            new["outlier"][i] = np.where(np.isnan(new["outlier"][i]), np.nan, posterior.wrong)
        for j, name in enumerate(names):
            shape = new["pdf"][name].shape[1:]
            new["pdf"][name][i] = node_shares((node[name],), shape, weight)
            moments, quantiles = draws_summary(posterior.values[name], weight=weight)
            new["axis_moments"][i, j], new["axis_quantiles"][i, j] = moments[:2], quantiles
        pairs = new["pairs"] | {("redshift", "frac_agn"): new["pdf_2d"]}
        for (x, y), table in pairs.items():
            table[i] = node_shares((node[x], node[y]), table.shape[1:], weight)
        put_draws(results, new, i, posterior.derived, weight)
    return results._changed(**new)
