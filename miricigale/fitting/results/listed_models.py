"""Models that the draws of one object are, and fluxes of those between the nodes of a grid."""

import numpy as np
from astropy.table import QTable

from miricigale.sed import grid_spectra
from miricigale.utils.named_values import places
from miricigale.utils.units import own_unit


def models_of_draws(draws):
    """
    Return the models of the draws of one object.

    Parameters
    ----------
    draws : `~miricigale.fitting.Samples`
        Of a single object.

    Returns
    -------
    models : `~miricigale.sed.ModelGrid` or `~miricigale.sed.grid_spectra.ListedModels`
        The grid for draws on its nodes; otherwise a model for each draw.
    index : `~numpy.ndarray` of int, shape (n_draws, 4)
        Indices of the draws in it.
    """
    grid = draws.grid
    if draws.on_nodes:
        return grid, draws.index
    models = grid_spectra.ListedModels(
        redshift=draws.drawn["redshift"],
        frac_agn=draws.drawn["frac_agn"],
        galaxy_parameters=_parameter_table(draws, grid.galaxy_parameters, draws.index[:, 1]),
        agn_parameters=_parameter_table(draws, grid.agn_parameters, draws.index[:, 2]),
        n_agn=grid.n_agn,
    )
    return models, models.index


def _parameter_table(draws, table, model):
    """Parameters of draws between nodes, of which ``model``, (n_draws,), are the nearest rows of a table."""
    out = QTable()
    for name in table.colnames:
        # draws without AGN have any AGN model
        column = table[name][np.maximum(model, 0)]
        if name in draws.axes:
            column = draws.drawn[name] * (own_unit(column) or 1.0)
        out[name] = column
    return out


def fluxes_between_nodes(draws, names, extra, model):
    """
    Compute the fluxes of draws between the nodes of a grid in uJy.

    Parameters
    ----------
    draws : `~miricigale.fitting.Samples`
        Of a single object.
    names : list of str
        Bands; those of the grid are known.
    extra : dict of str to `~miricigale.filters.Filter` or str
        Bands among them in which ``model`` is evaluated, as filters or names.
    model : `~miricigale.sed.SEDModel` or None
        Needed for ``extra``.

    Returns
    -------
    fluxes : `~numpy.ndarray`, shape (n_draws, n_bands)
    """
    out = np.empty((draws.n_draws, len(names)))
    for j, name in enumerate(names):
        if name not in extra:
            out[:, j] = draws.flux[:, draws.grid.filters.index(name)]
    if extra:
        models, index = models_of_draws(draws)
        flux = grid_spectra.model_fluxes(model, models, index, list(extra.values()))
        out[:, places(extra, names)] = flux * draws.scale[:, None]
    return out
