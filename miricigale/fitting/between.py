"""Results of fits whose posteriors are those of models between the nodes of a grid."""

import numpy as np

from miricigale.fitting.likelihood import FitFlags
from miricigale.fitting.quantities import DERIVED_LEVELS, draws_summary, node_shares, put_draws

#: Part of the last moves below which the draws of an object rest on few models.
_STUCK = 0.01


def between_nodes(found, results):
    """
    Results with posteriors, moments and percentiles of models between the nodes.

    Parameters
    ----------
    found : dict of int to tuple
        What `~miricigale.fitting.continuation.Continuation.draw` found, by row.
    results : `~miricigale.fitting.FitResults`
        What was found on the nodes.
    """
    names, n, new = list(results.axes), len(results), results._mapped(np.array)
    # the best models stay those of the nodes
    del new["best"]
    new["axis_moments"] = np.full((n, len(names), 2), np.nan)
    new["axis_quantiles"] = np.full((n, len(names), DERIVED_LEVELS.size), np.nan)
    for i, (drawn, taken) in found.items():
        if taken < _STUCK:
            new["flags"][i] |= int(FitFlags.ONE_NODE)
        if drawn is None:
            continue
        values, node, derived, wrong = drawn
        if wrong is not None:
            new["outlier"][i] = np.where(np.isnan(new["outlier"][i]), np.nan, wrong)
        for j, name in enumerate(names):
            new["pdf"][name][i] = node_shares((node[name],), new["pdf"][name].shape[1:])
            moments, quantiles = draws_summary(values[name])
            new["axis_moments"][i, j], new["axis_quantiles"][i, j] = moments[:2], quantiles
        pairs = new["pairs"] | {("redshift", "frac_agn"): new["pdf_2d"]}
        for (x, y), table in pairs.items():
            table[i] = node_shares((node[x], node[y]), table.shape[1:])
        put_draws(results, new, i, derived)
    return results._changed(**new)
