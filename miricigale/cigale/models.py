"""Models of a run of CIGALE: all of them in a file, and quantities that its grids have besides ours."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.cigale.names import AGN_PARTS, cigale_names
from miricigale.utils.exceptions import ConfigError
from miricigale.utils.store import replacing

__all__ = ["save_models", "with_agn_parts"]

_MOST = 2_000_000


def save_models(setup, path, redshifts, *, overwrite):
    """See `CigaleSetup.save_models`."""
    if setup.xray_bands():
        msg = (
            f"{setup.path}: models in X-ray bands ({', '.join(setup.xray_bands())}) are not written"
        )
        raise ConfigError(msg)
    axes = setup.axes(redshifts)
    count = int(np.prod([len(values) for values in axes.values()], dtype=float))
    if count > _MOST:
        msg = f"{setup.path}: {count:,} models are more than the {_MOST:,} that are written"
        raise ConfigError(msg)
    mesh = np.meshgrid(*axes.values(), indexing="ij")
    rows = QTable({name: values.ravel() for name, values in zip(axes, mesh, strict=True)})
    rows["mass"] = 1.0
    models = setup.model().fluxes(rows, setup.filters())
    out = QTable({"id": np.arange(count)})
    for name, band in (setup.bands | setup.predicted).items():
        out[band] = models[name].to(u.mJy)
    for ours, (theirs, unit, factor) in cigale_names(setup.modules).items():
        source = next((t for t in (models, rows) if ours in t.colnames), None)
        if source is not None:
            out[theirs] = np.asarray(getattr(source[ours], "value", source[ours])) * factor * unit
    with replacing(path, overwrite=overwrite) as partial:
        out.write(partial, format="fits")
    return out


def with_agn_parts(grid, model):
    """A grid whose AGN have the luminosities of their parts too (`AGN_PARTS`), for each W of AGN power."""
    if not grid.n_agn:
        return grid
    chain, table = model.chain, grid.agn_properties.copy()
    rows = [
        model.defaults
        | {name: float(model.parameters[name].convert(row[name])) for name in row.colnames}
        for row in grid.agn_parameters
    ]
    parts = [chain.agn(row) for row in rows]
    for name, (ours, theirs) in AGN_PARTS.items():
        light = np.array([chain.weights @ getattr(part, name) for part in parts])
        table[ours] = light * table["agn_power"]
        table[ours].info.description = f"{theirs} of CIGALE"
    return dataclasses.replace(grid, agn_properties=table)
