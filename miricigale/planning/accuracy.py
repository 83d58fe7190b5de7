"""How well a plan recovers redshift, fracAGN and AGN: numbers of one plan, and of two with the same sources."""

import numpy as np

from miricigale.evaluation import OUTLIER, bootstrap
from miricigale.evaluation.estimates import median, scatter, weighted_share
from miricigale.utils.missing_values import floats


def _share(hits, population):
    """Share of sources found, by row: a statistic for `~miricigale.evaluation.bootstrap`."""
    return np.sum(hits, axis=-1) / np.sum(population, axis=-1)


def sky_weights(sources, agn_limit):
    """What each source counts for in one sky, shape (n,): an AGN one by all skies that its like are drawn from."""
    agn = floats(sources["frac_agn"]) >= agn_limit
    return np.where(agn, 1 / sources.meta.get("n_skies", 1), 1.0)


#: Statistic of each number, and the columns (`_columns`) that it is of.
NUMBERS = {
    "z_scatter": (scatter, "dz"),
    "z_outliers": (_share, "outlier", "known"),
    "z_width": (median, "z_std"),
    "frac_bias": (median, "df"),
    "frac_scatter": (scatter, "df"),
    "frac_width": (median, "f_std"),
    "completeness": (_share, "found", "agn"),
    "purity": (_share, "found", "selected"),
}


def columns_of(sources, agn_limit):
    """Return what the numbers are made of, by source."""
    z = floats(sources["redshift"])
    f = floats(sources["frac_agn"])
    dz = (floats(sources["redshift_mean"]) - z) / (1 + z)
    weight = sky_weights(sources, agn_limit)
    agn = f >= agn_limit
    # AGN of other skies are for completeness and purity
    first = np.where(np.asarray(sources.columns.get("sky", 0)) > 0, np.nan, 1.0)
    compared = np.isfinite(dz * first)
    columns = {
        "dz": first * dz,
        "known": compared,
        "outlier": compared & (np.abs(dz) > OUTLIER),
        "z_std": first * floats(sources["redshift_std"]) / (1 + z),
        "df": first * (floats(sources["frac_agn_mean"]) - f),
        "f_std": first * floats(sources["frac_agn_std"]),
        "agn": weight * agn,
        "selected": weight * np.asarray(sources["selected"], bool),
        "found": weight * (agn & np.asarray(sources["selected"], bool)),
    }
    return {name: np.asarray(values, float) for name, values in columns.items()}


def accuracy(sources, *, agn_limit=0.4, seed=0):
    """
    Tell how well redshift, fracAGN and AGN are recovered.

    Parameters
    ----------
    sources : `~astropy.table.QTable`
        Of a `~miricigale.planning.Plan`.
    agn_limit : float, optional
        True fracAGN from which a source is an AGN.
    seed : int, optional
        Of the bootstrap.

    Returns
    -------
    numbers : dict of str to `~miricigale.evaluation.Estimate`
        Of the posterior means ``z_scatter`` (sigma_MAD of dz/(1+z)), ``z_outliers`` (share with abs(dz)/(1+z)
        above 0.15), ``frac_bias`` and ``frac_scatter`` (median and sigma_MAD of the difference);
        ``z_width`` and ``frac_width``, median posterior standard deviations (of z over 1+z);
        ``completeness`` and ``purity`` of the selected AGN, the only ones for which AGN of other skies count.
    """
    columns = columns_of(sources, agn_limit)
    numbers = {}
    for name, (statistic, *wanted) in NUMBERS.items():
        values = [columns[key] for key in wanted]
        if statistic is _share:
            numbers[name] = weighted_share(*values)
        else:
            numbers[name] = bootstrap(statistic, *values, seed=seed)
    return numbers
