"""Percentiles of samples by their columns."""

import numpy as np

#: Levels of percentiles.
LEVELS = (0.16, 0.5, 0.84)


def quantile_columns(draws, levels, text, prefix=""):
    """
    Compute columns of percentiles, for `~miricigale.utils.tables.described_table`.

    Parameters
    ----------
    draws : `~astropy.units.Quantity`, shape (n_draws, n)
        Values in each draw.
    levels : array_like, shape (n_levels,)
        Levels, in (0, 1).
    text : str
        What the values are.
    prefix : str, optional
        What the names of the columns begin with.

    Returns
    -------
    columns : dict of str to tuple
        By name (``p16``, ``p50``): percentiles, shape (n,), and description.
    """
    columns = {}
    for level, values in zip(levels, np.quantile(draws, levels, axis=0), strict=True):
        columns[f"{prefix}p{100 * level:g}"] = (values, f"quantile {level:g} of {text}")
    return columns
