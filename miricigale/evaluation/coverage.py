"""Whether posteriors are as wide as they should be: ranks of the truth, and coverage of intervals."""

import numpy as np
from scipy.stats import kstest

from miricigale.evaluation.metrics import fraction_interval
from miricigale.utils.arrays import finite_values, quiet_division
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import described_rows


def posterior_ranks(true, values, levels, *, seed=None):
    """
    Rank of true values in their posteriors (probability integral transform).

    If the posteriors are right, ranks are uniform between 0 and 1.

    Parameters
    ----------
    true : array-like, shape (n,)
        True values; NaN has the rank NaN.
    values : array-like, shape (k,) or (n, k)
        Ascending values at which the cumulative distributions are known, in the unit of ``true``.
    levels : array-like, shape (k,) or (n, k)
        The distributions there (`~miricigale.fitting.FitResults.cdf` has both); NaN gives NaN.
    seed : int, optional
        With it ranks are drawn uniformly from the part of the posterior in the cell of the true
        value: needed where the truth lies on nodes of a grid (an injected AGN fraction), for the
        place within the cell then is no random one. Without it the distribution is linear within cells.
        Where several values are equal to the true one (a power of 0 of a galaxy without an AGN) the
        rank is drawn from the levels of all of them, or is in their middle.

    Returns
    -------
    ranks : `~numpy.ndarray`, shape (n,)
        0 and 1 for true values outside of the values.

    Raises
    ------
    ValueError
        If the shapes do not agree.

    Examples
    --------
    >>> from miricigale.evaluation import posterior_ranks
    >>> posterior_ranks([0.25, 0.75], [0.0, 0.5, 1.0], [0.0, 0.8, 1.0]).tolist()
    [0.4, 0.9]
    """
    true = floats(true)
    try:
        shape = np.broadcast_shapes(np.shape(values), np.shape(levels), (true.size, 1))
        values = np.broadcast_to(floats(values), shape)
        levels = np.broadcast_to(floats(levels), shape)
    except ValueError:
        raise argument_error(
            "values",
            "of one shape with 'levels', for each of 'true'",
            f"{np.shape(values)}, {np.shape(levels)} and {true.shape}",
        ) from None
    if true.ndim != 1 or shape[0] != true.size or shape[1] < 2:
        raise argument_error("values", f"of shape (k,) or ({true.size}, k)", shape)
    n, k = shape
    good = np.isfinite(true) & np.isfinite(values).all(axis=1) & np.isfinite(levels).all(axis=1)
    cell = np.clip(np.sum(values <= true[:, None], axis=1) - 1, 0, k - 2)
    rows = np.arange(n)
    low_value = values[rows, cell]
    high_value = values[rows, cell + 1]
    with quiet_division():
        inside = np.where(
            high_value > low_value, (true - low_value) / (high_value - low_value), 0.5
        )
    if seed is not None:
        inside = stream(check_seed(seed), "posterior ranks").uniform(size=n)
    low_level = levels[rows, cell]
    high_level = levels[rows, cell + 1]
    ranks = low_level + inside * (high_level - low_level)
    ranks = np.where(true < values[:, 0], 0.0, np.where(true > values[:, -1], 1.0, ranks))
    # where the distribution steps
    first = np.sum(values < true[:, None], axis=1)
    last = np.sum(values <= true[:, None], axis=1)
    step = last - first > 1
    low = np.where(first > 0, levels[rows, np.minimum(first, k - 1)], 0.0)
    high = np.where(last < k, levels[rows, np.maximum(last - 1, 0)], 1.0)
    part = 0.5
    if seed is not None:
        part = inside
    ranks = np.where(step, low + part * (high - low), ranks)
    return np.where(good, ranks, np.nan)


def interval_share(ranks, level=0.68):
    """Share of finite ranks, and so of true values, in the central interval of a level."""
    ranks = finite_values(ranks)
    inside = np.count_nonzero(np.abs(ranks - 0.5) <= 0.5 * level)
    return fraction_interval(inside, ranks.size)[0]


def coverage_table(ranks, *, levels=(0.68, 0.95)):
    """
    Share of true values within the central intervals of their posteriors.

    Parameters
    ----------
    ranks : dict of str to array-like, shape (n,)
        Ranks (`posterior_ranks`) by what they are of: a parameter, a fit with or without model error.
    levels : tuple of float, optional
        Parts of the posterior in the intervals.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each name and level: ``name``, ``n`` (finite ranks), ``level``, ``share`` of the true
        values in the interval with its 68 % (Wilson) limits ``share_low`` and ``share_high``,
        ``mean_rank`` (0.5 without bias; below it where the fits are too high), and ``p_uniform``, the
        probability of ranks as far from uniform as these (Kolmogorov-Smirnov).

    Raises
    ------
    ValueError
        If a level or rank is not between 0 and 1.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.evaluation import coverage_table
    >>> table = coverage_table({"redshift": np.linspace(0, 1, 101)})
    >>> table.round(2)
    >>> print(table["name", "n", "level", "share", "mean_rank"])
      name    n  level share mean_rank
    -------- --- ----- ----- ---------
    redshift 101  0.68  0.68       0.5
    redshift 101  0.95  0.94       0.5
    """
    levels = np.atleast_1d(floats(levels))
    check_that(np.all((levels > 0) & (levels < 1)), "levels", "between 0 and 1", levels)
    rows = []
    for name, values in ranks.items():
        values = floats(values)
        values = finite_values(values)
        bad = (values < 0) | (values > 1)
        check_that(not np.any(bad), "ranks", "between 0 and 1", values[bad])
        if values.size:
            p_uniform = kstest(values, "uniform").pvalue
            mean = values.mean()
        else:
            p_uniform = np.nan
            mean = np.nan
        for level in levels:
            inside = np.count_nonzero(np.abs(values - 0.5) <= 0.5 * level)
            share, low, high = fraction_interval(inside, values.size)
            rows.append(
                {
                    "name": name,
                    "n": values.size,
                    "level": level,
                    "share": share,
                    "share_low": low,
                    "share_high": high,
                    "mean_rank": mean,
                    "p_uniform": p_uniform,
                }
            )
    return described_rows(rows, column_texts("miricigale.evaluation", "coverage"))
