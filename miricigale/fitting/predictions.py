"""Fluxes and spectra that draws of posteriors predict: in any band, as tables of percentiles."""

import numpy as np
from astropy.table import QTable

from miricigale.fitting import spectra
from miricigale.fitting.flags import FitFlags
from miricigale.utils.exceptions import argument_error
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU

__all__ = ["band_names", "draw_fluxes", "flux_table", "spectrum_table"]


def band_names(grid, filters):
    """
    Names of the bands asked for, and those that the grid has not.

    Parameters
    ----------
    grid : `~miricigale.sed.ModelGrid`
        The grid.
    filters : list of str or `~miricigale.filters.FilterSet` or None
        Bands; None: those of the grid.

    Returns
    -------
    names : list of str
    extra : dict of str to `~miricigale.filters.Filter` or None
        Those that are not in the grid; None where only a name was given.
    """
    if filters is None:
        return list(grid.filters), {}
    if isinstance(filters, str):
        raise argument_error("filters", "a list of names or a FilterSet", repr(filters))
    names = list(getattr(filters, "names", filters))
    given = dict(zip(names, filters, strict=True)) if hasattr(filters, "names") else {}
    return names, {name: given.get(name) for name in names if name not in grid.filters}


def draw_fluxes(grid, index, scale, names, extra, model):
    """
    Fluxes of drawn models.

    Parameters
    ----------
    grid : `~miricigale.sed.ModelGrid`
        The grid.
    index : `~numpy.ndarray` of int, shape (n, n_draws, 4)
        Redshift, galaxy, torus and AGN fraction; none is missing but tori of no AGN.
    scale : `~numpy.ndarray`, shape (n, n_draws)
        Solar masses formed.
    names, extra
        From `band_names`.
    model : `~miricigale.sed.SEDModel` or None
        The model of the grid, for bands that this has not.

    Returns
    -------
    fluxes : `~numpy.ndarray`, shape (n, n_draws, n_filters)
        In uJy.
    """
    out = np.full((*scale.shape, len(names)), np.nan)
    own = [i for i, name in enumerate(names) if name in grid.filters]
    columns = [grid.filters.index(names[i]) for i in own]
    for row in range(len(index)) if own else ():
        z, g, k, f = spectra.plain_index(grid, index[row]).T
        flux = grid.flux(z, g, k, f)[:, columns]
        out[row][:, own] = scale[row][:, None] * flux
    if extra and len(index):
        from miricigale.filters import FilterSet

        missing = [name for name, band in extra.items() if band is None]
        found = dict(zip(missing, FilterSet.from_names(missing), strict=True)) if missing else {}
        bands = [found.get(name, band) for name, band in extra.items()]
        other = [names.index(name) for name in extra]
        flux = spectra.model_fluxes(model, grid, index, bands)
        out[:, :, other] = flux * scale[:, :, None]
    return out


def flux_table(samples, names, fluxes, levels):
    """
    Posterior of fluxes: the table of `Samples.predict`.

    Parameters
    ----------
    samples : `~miricigale.fitting.Samples`
        Draws of n objects.
    names : list of str
        Bands.
    fluxes : `~numpy.ndarray`, shape (n, n_draws, n_filters)
        Fluxes of the draws in uJy.
    levels : `~numpy.ndarray`
        From `~miricigale.fitting.posterior.check_levels`.
    """
    out = QTable(
        {"id": np.array(samples.ids), "flags": np.array(samples.flags)}, meta=dict(samples.meta)
    )
    out["flags"].info.description = FitFlags.describe()
    for i, name in enumerate(names):
        flux = fluxes[:, :, i]
        columns = {
            name: (flux.mean(axis=1), "posterior mean of the model flux"),
            error_column(name): (flux.std(axis=1), "its standard deviation"),
        }
        for level, values in zip(levels, np.quantile(flux, levels, axis=1), strict=True):
            text = f"quantile {level:g} of the model flux"
            columns[f"{name}_{_suffix(level)}"] = (values, text)
        for column, (values, text) in columns.items():
            out[column] = values * FNU
            out[column].info.description = text
    return out


def spectrum_table(wave, values, levels, *, rest, meta):
    """
    Percentiles of spectra: the table of `Samples.sed_band`.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n_wave,)
        Wavelengths.
    values : `~astropy.units.Quantity`, shape (n_draws, n_wave)
        Spectra.
    levels : `~numpy.ndarray`
        From `~miricigale.fitting.posterior.check_levels`.
    rest : bool
        Whether these are rest-frame spectra.
    meta : dict
        Of the table.
    """
    out = QTable({"wave": wave}, meta=meta)
    out["wave"].info.description = f"{'rest' if rest else 'observed'} wavelength"
    for level, row in zip(levels, np.quantile(values.value, levels, axis=0), strict=True):
        column = _suffix(level)
        out[column] = row * values.unit
        out[column].info.description = f"quantile {level:g} of {'L_nu' if rest else 'F_nu'}"
    return out


def _suffix(level):
    return f"p{100 * level:g}"
