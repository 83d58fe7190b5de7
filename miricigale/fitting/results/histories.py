"""Star formation in the past: histories of the best models and of draws from posteriors."""

import astropy.units as u
import numpy as np

from miricigale.fitting.posterior.posterior import check_levels
from miricigale.fitting.results.percentile_columns import LEVELS, quantile_columns
from miricigale.sed.parameter import default_values
from miricigale.utils.options import check_that
from miricigale.utils.tables import described_table

#: Unit of star-formation rates, and steps of the history drawn.
_RATE = u.Msun / u.yr
_STEPS = 400


def rates_at(component, values, lookback):
    """Look up rates (Msun/yr for one solar mass formed) at lookback times (Gyr); 0 before the first stars."""
    history = component.history(values)
    # steps of 1 Myr, the oldest first
    step = history.size - 1 - np.floor(lookback * 1e3).astype(int)
    return np.where(step >= 0, history[np.maximum(step, 0)], 0.0)


def sfh_band(samples, key, levels=LEVELS):
    """
    Compute percentiles of the star-formation history of one object.

    Parameters
    ----------
    key : object
        Id of the object.
    levels : tuple of float, optional
        Levels of the percentiles, in (0, 1).

    Returns
    -------
    table : `~astropy.table.QTable`
        ``lookback`` (Gyr before the light left the galaxy) and a column for each level (``p16``, ``p50``,
        ``p84``), Msun / yr, taken at every time by itself: no draw need be that of a line.
    """
    levels = check_levels(levels)
    draws = samples.loc[key]._fitted_one()
    component = samples._model().component("sfh")
    columns = {}
    for name, parameter in component.parameters.items():
        columns[name] = np.full(draws.n_draws, parameter.default)
        if name in samples.axes:
            columns[name] = draws.values(name).value
        elif name in samples.grid.galaxy_parameters.colnames:
            column = samples.grid.galaxy_parameters[name]
            columns[name] = u.Quantity(column).value[draws.index[:, 1]]
    mass = draws.values("mass").to_value(u.Msun)
    lookback = (np.arange(_STEPS) + 0.5) / _STEPS * np.max(columns["age"])
    rows = np.array([columns[name] for name in columns]).T
    distinct, row_of_draw = np.unique(rows, axis=0, return_inverse=True)
    rates = [
        rates_at(component, dict(zip(columns, map(float, row), strict=True)), lookback)
        for row in distinct
    ]
    drawn = np.array(rates)[row_of_draw.reshape(-1)] * mass[:, None]
    table = {"lookback": (lookback * u.Gyr, "time before the light left the galaxy")}
    table |= quantile_columns(drawn * _RATE, levels, "the star-formation rate")
    return described_table(table, dict(samples.meta) | {"id": str(key)})


def plot_sfh_band(samples, key, ax=None, *, levels=LEVELS, **kwargs):
    """
    Draw the star-formation history of one object with its band.

    Parameters
    ----------
    key, levels : optional
        As for `sfh_band`.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    **kwargs
        Passed to `miricigale.plotting.posteriors.plot_history`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    from miricigale.plotting.posteriors import plot_history

    table = sfh_band(samples, key, levels)
    bands = [table[name] for name in table.colnames[1:]]
    return plot_history(table["lookback"], bands, ax=ax, **kwargs)


def plot_sfh(results, ax=None, *, model=None, **kwargs):
    """
    Draw the star-formation history of the best model of a single object.

    `Samples.plot_sfh` of draws (`BayesFitter.sample`) has the band of the posterior.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    model : `~miricigale.sed.SEDModel`, optional
        The model that was fitted; needed for results that were read from a file.
    **kwargs
        Passed to `miricigale.plotting.posteriors.plot_history`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`

    Raises
    ------
    ValueError
        If the model is not known, or has no star-formation history.
    """
    from miricigale.fitting.results.drawing import best_parameters
    from miricigale.plotting.posteriors import plot_history

    if model is None:
        model = results.model
    component = None
    if model is not None:
        component = model.component("sfh")
    check_that(component is not None, "model", "given where results were read from a file", "None")
    best = best_parameters(results, model)
    values = default_values(component.parameters)
    values |= {name: float(best[name].value) for name in values if name in best}
    lookback = (np.arange(_STEPS) + 0.5) / _STEPS * values["age"]
    rates = rates_at(component, values, lookback) * best["mass"].to(u.Msun).value
    return plot_history(lookback * u.Gyr, [rates * _RATE], ax=ax, **kwargs)
