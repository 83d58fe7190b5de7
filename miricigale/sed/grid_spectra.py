"""Fluxes and spectra of models of a grid, also in bands and wavelengths that it does not have."""

import numpy as np
from astropy.table import QTable

from miricigale.filters import FilterSet, find_filter
from miricigale.sed.cells import cell_means, edges_around
from miricigale.sed.chain import STELLAR
from miricigale.sed.cosmology import distance
from miricigale.sed.tables import dilution
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import places
from miricigale.utils.options import check_that
from miricigale.utils.values import value_class


@value_class
class ListedModels:
    """
    Models that are none of a grid, for functions of this module that take one: model i is (i, i, i, i).

    Parameters
    ----------
    redshift, frac_agn : `~numpy.ndarray`, shape (n,)
        Their redshifts and AGN fractions.
    galaxy_parameters, agn_parameters : `~astropy.table.QTable`
        Their other parameters, n rows.
    n_agn : int
        Number of AGN models; 0 if the models have no AGN.
    """

    redshift: np.ndarray
    frac_agn: np.ndarray
    galaxy_parameters: QTable
    agn_parameters: QTable
    n_agn: int

    @property
    def index(self):
        """Indices of all of them, shape (n, 4)."""
        return np.tile(np.arange(len(self.redshift))[:, None], (1, 4))


def check_model(model, grid):
    """Refuse a model that is not the one of the grid, as far as the grid says what it was."""
    recipe = model.recipe
    for name, value in grid.recipe.items():
        wanted = f"the one of the grid ({name}: {value})"
        check_that(recipe.get(name) == value, "model", wanted, recipe.get(name))


def plain_index(grid, index):
    """Return the indices of models with those that make no difference set to 0: shape (..., 4)."""
    index = np.array(index)
    # without AGN light all AGN models are the same
    dark = grid.frac_agn[index[..., 3]] == 0.0
    index[..., 2] = np.where(dark, 0, index[..., 2])
    return index


def band_names(grid, filters):
    """
    Return the names of the bands asked for (None: those of the grid), and those that the grid has not.

    The latter as a dict of name to `~miricigale.filters.Filter`, or to the name where only that was given.
    """
    if filters is None:
        return list(grid.filters), {}
    check_that(
        not isinstance(filters, str), "filters", "a list of names or a FilterSet", repr(filters)
    )
    names = []
    curves = {}
    for band in filters:
        name = getattr(band, "name", band)
        if name not in grid.filters:
            # a usual name of a band of the grid
            name = find_filter(str(name)) or name
        names.append(name)
        if name not in grid.filters:
            curves[name] = name
            if not isinstance(band, str):
                curves[name] = band
    return names, curves


def draw_fluxes(grid, index, scale, names, extra, model):
    """
    Return the fluxes of drawn models in uJy, shape (n, n_draws, n_filters).

    ``index``, shape (n, n_draws, 4), numbers redshift, galaxy, AGN model and AGN fraction of each,
    none of them missing but AGN models at no fraction; ``scale``, shape (n, n_draws), is in Msun
    formed; ``names`` and ``extra`` come from `band_names`; ``model`` is that of the grid, for bands
    that this has not, or None.
    """
    out = nans(scale.shape + (len(names),))
    in_grid = [i for i, name in enumerate(names) if name in grid.filters]
    columns = [grid.filters.index(names[i]) for i in in_grid]
    for row in range(len(index)) if in_grid else ():
        z, g, k, f = plain_index(grid, index[row]).T
        flux = grid.flux(z, g, k, f)[:, columns]
        out[row][:, in_grid] = scale[row][:, None] * flux
    if extra and len(index):
        extra_columns = places(extra, names)
        flux = model_fluxes(model, grid, index, list(extra.values()))
        out[:, :, extra_columns] = flux * scale[:, :, None]
    return out


def model_fluxes(model, grid, index, filters):
    """
    Return the fluxes in any bands of models of a grid, each different one evaluated once.

    In uJy for each solar mass formed, shape (..., n_filters), for ``index`` of shape (..., 4).
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
    """
    Return the L_nu in W/Hz of different galaxies (per solar mass) and AGN (per W), and their places.

    Last comes what AGN fractions refer to, in W for each solar mass, of the galaxies.
    """
    chain = model.chain
    galaxies, galaxy = np.unique(index[:, 1], return_inverse=True)
    models, agn = np.unique(index[:, 2], return_inverse=True)
    rows = [row_values(model, grid.galaxy_parameters, g) for g in galaxies.tolist()]
    stars, history_of_row = chain.stars(chain.keys(rows, STELLAR))
    dims = chain.keys(rows, "attenuation")
    dusts = chain.keys(rows, "dust")
    light, absorbed = chain.attenuated(stars, history_of_row, dims, dusts)
    for i, row in enumerate(rows):
        if (excess := row.get("dust_excess", 1.0)) != 1.0:
            light[i] += (excess - 1.0) * absorbed[i] * chain.dust(dusts[i])
            absorbed[i] *= excess
    reference = absorbed
    if model.frac_agn_definition != "dust":
        reference = chain.reference(light)
    nuclei = np.zeros((1, chain.wave.size))
    if grid.n_agn and np.any(grid.frac_agn[index[:, 3]] > 0):
        parts = [chain.agn(row_values(model, grid.agn_parameters, k)) for k in models.tolist()]
        nuclei = np.array([part.total for part in parts])
        if model.frac_agn_definition != "dust":
            nuclei = nuclei / chain.reference(nuclei)[:, None]
    else:
        agn = np.zeros_like(agn)
    return chain.lnu(light), galaxy.ravel(), chain.lnu(nuclei), agn.ravel(), reference


def row_values(model, table, row):
    """Return the parameters of one row as plain numbers in the model's units, with defaults for the others."""
    return model.defaults | {
        name: float(model.parameters[name].convert(table[name][row]))
        for name in table.colnames
        # the slope of X-rays is none of the model
        if name in model.parameters
    }


def rest_spectra(model, grid, index, scale):
    """
    Return the rest-frame spectra of models of a grid, without absorption outside of the galaxy.

    For ``index`` of shape (n, 4) and ``scale``, shape (n,), in Msun formed: wavelengths in um, and L_nu
    in W/Hz, shape (n, n_wave).
    """
    index = plain_index(grid, index)
    light, galaxy, nuclei, agn, reference = _factors(model, grid, index)
    f = grid.frac_agn[index[:, 3]]
    power = scale * f / (1.0 - f) * reference[galaxy]
    lnu = scale[:, None] * light[galaxy] + power[:, None] * nuclei[agn]
    return model.chain.wave, lnu


def observed_spectra(model, grid, index, scale):
    """
    Return the observed spectra of models of a grid, with absorption between the galaxies and in the Milky Way.

    As `rest_spectra`, but observed wavelengths that all models cover, in the steps of the median redshift, and
    F_nu in uJy. Spectra of other redshifts are means around these wavelengths, so that bands keep the light of
    lines.
    """
    rest_wave, lnu = rest_spectra(model, grid, index, scale)
    redshift = grid.redshift[index[:, 0]]
    middle = np.median(redshift)
    wave = rest_wave * (1.0 + middle)
    low = rest_wave[0] * (1.0 + redshift.max())
    high = rest_wave[-1] * (1.0 + redshift.min())
    wave = wave[(wave >= low) & (wave <= high)]
    edges = edges_around(wave)
    out = np.empty((redshift.size, wave.size))
    for z in np.unique(redshift):
        sky = model.chain.sky(model.defaults | {"redshift": float(z)})
        factor = sky * float(dilution(z, distance(z, model.cosmology)))
        for row in np.flatnonzero(redshift == z):
            if z == middle:
                out[row] = np.interp(wave, rest_wave * (1.0 + z), lnu[row] * factor)
            else:
                out[row] = cell_means(rest_wave * (1.0 + z), lnu[row] * factor, edges)
    return wave, out
