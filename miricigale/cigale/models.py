"""Models of a run of CIGALE: all of them in a file, and quantities that its grids have besides ours."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.cigale.names import AGN_PARTS, cigale_names
from miricigale.fitting import Samples
from miricigale.sed.grid_spectra import row_values
from miricigale.utils.exceptions import config_error
from miricigale.utils.store import replacing

_MOST = 2_000_000


def save_models(setup, path, redshifts, *, overwrite):
    """See `CigaleSetup.save_models`."""
    axes = setup.axes(redshifts)
    if setup.xray_bands() and setup.model().has_agn:
        axes["alpha_ox"] = setup.xray["alpha_ox"]
    count = int(np.prod([len(values) for values in axes.values()], dtype=float))
    if count > _MOST:
        raise config_error(setup.path, f"has {count:,} models; at most {_MOST:,} are written")
    every = setup.bands | setup.predicted
    grid = setup.grid(list(every), redshifts)
    shape = grid.redshift.size, grid.n_galaxies, max(grid.n_agn, 1), grid.frac_agn.size
    index = np.indices(shape).reshape(4, -1).T
    n, mass = len(index), np.where(grid.allowed[index[:, 0], index[:, 1]], 1.0, np.nan)
    # each model as the only draw of an object, in the order of the file's parameters
    models = Samples(grid, np.arange(n), np.zeros(n, int), index[:, None], mass[:, None])
    models = models[np.lexsort([models.values(name)[:, 0].value for name in reversed(axes)])]
    fluxes = models.fluxes(list(every))[:, 0]
    out = QTable({"id": np.arange(n)})
    for i, band in enumerate(every.values()):
        out[band] = fluxes[:, i].to(u.mJy)
    for ours, (theirs, unit, factor) in cigale_names(setup.modules).items():
        if ours in models.parameters:
            out[theirs] = models.values(ours)[:, 0].value * factor * unit
    with replacing(path, overwrite=overwrite) as partial:
        out.write(partial, format="fits")
    return out


def with_agn_parts(grid, model):
    """A grid whose AGN have the luminosities of their parts too (`AGN_PARTS`), for each W of AGN power."""
    if not grid.n_agn:
        return grid
    chain, table = model.chain, grid.agn_properties.copy()
    parts = [chain.agn(row_values(model, grid.agn_parameters, k)) for k in range(grid.n_agn)]
    for name, (ours, theirs) in AGN_PARTS.items():
        light = np.array([chain.weights @ getattr(part, name) for part in parts])
        table[ours] = light * table["agn_power"]
        table[ours].info.description = f"{theirs} of CIGALE"
    return dataclasses.replace(grid, agn_properties=table)
