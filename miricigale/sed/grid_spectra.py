"""Fluxes and spectra of models of a grid, also in bands and wavelengths that it does not have."""

import numpy as np
from astropy.table import QTable

from miricigale.filters import FilterSet
from miricigale.sed.spectrum import distance
from miricigale.sed.tables import dilution
from miricigale.utils.exceptions import argument_error

__all__ = [
    "band_names",
    "check_model",
    "draw_fluxes",
    "model_fluxes",
    "observed_spectra",
    "rest_spectra",
]


def check_model(model, grid):
    """
    Refuse a model that is not the one of the grid, as far as the grid says what it was.

    Raises
    ------
    ValueError
        If components, options or definitions differ.
    """
    recipe = model.recipe
    for name, value in grid.recipe.items():
        if recipe.get(name) != value:
            raise argument_error(
                "model", f"the one of the grid ({name}: {value})", f"{recipe.get(name)}"
            )


def plain_index(grid, index):
    """Indices of models with those that make no difference set to 0: shape (..., 4)."""
    index = np.array(index)
    # without AGN light all tori are the same
    dark = grid.frac_agn[index[..., 3]] == 0.0
    index[..., 2] = np.where(dark, 0, index[..., 2])
    return index


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
        z, g, k, f = plain_index(grid, index[row]).T
        flux = grid.flux(z, g, k, f)[:, columns]
        out[row][:, own] = scale[row][:, None] * flux
    if extra and len(index):
        missing = [name for name, band in extra.items() if band is None]
        found = dict(zip(missing, FilterSet.from_names(missing), strict=True)) if missing else {}
        bands = [found.get(name, band) for name, band in extra.items()]
        other = [names.index(name) for name in extra]
        flux = model_fluxes(model, grid, index, bands)
        out[:, :, other] = flux * scale[:, :, None]
    return out


def model_fluxes(model, grid, index, filters):
    """
    Fluxes in any bands of models of a grid, each different one evaluated once.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        The model the grid was made from.
    grid : `~miricigale.sed.ModelGrid`
        The grid.
    index : `~numpy.ndarray` of int, shape (..., 4)
        Redshift, galaxy, torus and AGN fraction.
    filters : iterable of `~miricigale.filters.Filter`
        The bands.

    Returns
    -------
    fluxes : `~numpy.ndarray`, shape (..., n_filters)
        In uJy for each solar mass formed.
    """
    filters = FilterSet(list(filters))
    rows = plain_index(grid, index).reshape(-1, 4)
    different, place = np.unique(rows, axis=0, return_inverse=True)
    z, g, k, f = different.T
    table = QTable({"redshift": grid.redshift[z], "mass": np.ones(z.size)})
    for name in grid.galaxy_parameters.colnames:
        table[name] = grid.galaxy_parameters[name][g]
    if grid.n_agn:
        table["frac_agn"] = grid.frac_agn[f]
        for name in grid.agn_parameters.colnames:
            table[name] = grid.agn_parameters[name][k]
    elif model.has_agn:
        table["frac_agn"] = np.zeros(z.size)
    got = model.fluxes(table, filters)
    if np.any(got["flags"] != 0):
        bad = int(np.flatnonzero(got["flags"])[0])
        values = {name: str(table[name][bad]) for name in table.colnames}
        raise argument_error("model", "one that evaluates every model of the grid", f"{values}")
    flux = np.column_stack([got[name].value for name in filters.names])
    return flux[place.ravel()].reshape(*np.shape(index)[:-1], len(filters))


def _factors(model, grid, index):
    """L_nu in W/Hz of different galaxies (per solar mass) and tori (per W), and their places."""
    chain = model.chain
    defaults = {name: parameter.default for name, parameter in model.parameters.items()}
    galaxies, galaxy = np.unique(index[:, 1], return_inverse=True)
    tori, torus = np.unique(index[:, 2], return_inverse=True)
    light = np.array(
        [
            chain.galaxy(defaults | _row(model, grid.galaxy_parameters, g)).light
            for g in galaxies.tolist()
        ]
    )
    nuclei = np.zeros((1, chain.wave.size))
    if grid.n_agn and np.any(grid.frac_agn[index[:, 3]] > 0):
        parts = [chain.agn(defaults | _row(model, grid.agn_parameters, k)) for k in tori.tolist()]
        nuclei = np.array([part.total for part in parts])
        if model.frac_agn_definition != "dust":
            nuclei = nuclei / chain.infrared(nuclei)[:, None]
    else:
        torus = np.zeros_like(torus)
    return chain.lnu(light), galaxy.ravel(), chain.lnu(nuclei), torus.ravel()


def _row(model, table, row):
    """Parameters of one row as plain numbers in the model's units."""
    return {
        name: float(model.parameters[name].convert(table[name][row])) for name in table.colnames
    }


def rest_spectra(model, grid, index, scale):
    """
    Rest-frame spectra of models of a grid.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        The model the grid was made from.
    grid : `~miricigale.sed.ModelGrid`
        The grid.
    index : `~numpy.ndarray` of int, shape (n, 4)
        Redshift, galaxy, torus and AGN fraction.
    scale : `~numpy.ndarray`, shape (n,)
        Solar masses formed.

    Returns
    -------
    wave : `~numpy.ndarray`, shape (n_wave,)
        Rest wavelengths in um.
    lnu : `~numpy.ndarray`, shape (n, n_wave)
        L_nu in W/Hz, without absorption outside of the galaxy.
    """
    index = plain_index(grid, index)
    light, galaxy, nuclei, torus = _factors(model, grid, index)
    f = grid.frac_agn[index[:, 3]]
    power = scale * f / (1.0 - f) * grid.dust_luminosity[index[:, 1]]
    lnu = scale[:, None] * light[galaxy] + power[:, None] * nuclei[torus]
    return model.chain.wave, lnu


def observed_spectra(model, grid, index, scale):
    """
    Observed spectra of models of a grid, on one grid of wavelengths.

    Parameters are those of `rest_spectra`.

    Returns
    -------
    wave : `~numpy.ndarray`, shape (n_wave,)
        Observed wavelengths in um that all models cover.
    fnu : `~numpy.ndarray`, shape (n, n_wave)
        F_nu in uJy, with absorption between the galaxies and in the Milky Way.
    """
    rest, lnu = rest_spectra(model, grid, index, scale)
    redshift = grid.redshift[index[:, 0]]
    wave = rest * (1.0 + np.median(redshift))
    low, high = rest[0] * (1.0 + redshift.max()), rest[-1] * (1.0 + redshift.min())
    wave = wave[(wave >= low) & (wave <= high)]
    defaults = {name: parameter.default for name, parameter in model.parameters.items()}
    out = np.empty((redshift.size, wave.size))
    for z in np.unique(redshift):
        sky = model.chain.sky(defaults | {"redshift": float(z)})
        factor = sky * float(dilution(z, distance(z, model.cosmology)))
        for row in np.flatnonzero(redshift == z):
            out[row] = np.interp(wave, rest * (1.0 + z), lnu[row] * factor)
    return wave, out
