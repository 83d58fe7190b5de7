"""Models of a run of CIGALE: all of them in a file, and quantities that its grids have besides ours."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.cigale.names import AGN_PARTS, cigale_names
from miricigale.sed.chain import distinct
from miricigale.sed.grid_spectra import row_values
from miricigale.sed.spectrum import distance
from miricigale.sed.xray_bands import XRays, disk_2500
from miricigale.utils.exceptions import ConfigError
from miricigale.utils.store import replacing

_MOST = 2_000_000


def save_models(setup, path, redshifts, *, overwrite):
    """See `CigaleSetup.save_models`."""
    axes, xray = setup.axes(redshifts), setup.xray_bands()
    if xray and setup.model().has_agn:
        axes["alpha_ox"] = setup.xray["alpha_ox"]
    count = int(np.prod([len(values) for values in axes.values()], dtype=float))
    if count > _MOST:
        msg = f"{setup.path}: {count:,} models are more than the {_MOST:,} that are written"
        raise ConfigError(msg)
    mesh = np.meshgrid(*axes.values(), indexing="ij")
    rows = QTable({name: values.ravel() for name, values in zip(axes, mesh, strict=True)})
    rows["mass"] = 1.0
    bands = [name for name in (*setup.bands, *setup.predicted) if name not in xray]
    # the last axis, the slope of X-rays, is none of the model
    same = len(axes.get("alpha_ox", [0]))
    models = setup.model().fluxes(rows[::same], setup.filters(bands))[np.arange(count) // same]
    if xray:
        _add_xrays(models, rows, setup)
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


def _add_xrays(models, rows, setup):
    """Add X-ray fluxes to models, and what is known of their coronae."""
    model = setup.model()
    xrays = XRays(**{k: value for k, value in setup.xray.items() if k != "alpha_ox"})

    def values(name):
        return (
            np.asarray(rows[name])
            if name in rows.colnames
            else np.full(len(rows), model.defaults[name])
        )

    quantities = ("sfr_100myr", "stellar_mass", "age_mass")
    sources = xrays.galaxy(*(models[name].value for name in quantities), values("metallicity"))
    if model.has_agn:
        agn = model.component("agn")
        names = [name for name in agn.parameters if name != "frac_agn"]
        different, place = distinct(zip(*(values(name).tolist() for name in names), strict=True))
        every = [model.defaults | dict(zip(names, row, strict=True)) for row in different]
        disk = np.array([disk_2500(model.chain, agn, row) for row in every])[place]
        disk = disk * models["accretion_power"].value
        sources["agn"] = corona = xrays.corona(
            disk, np.asarray(rows["alpha_ox"]), values("inclination")
        )
        models["l_2500"], models["l_2_10kev"] = disk * u.W / u.Hz, corona.power * u.W
    nodes, place = np.unique(rows["redshift"], return_inverse=True)
    far = distance(nodes, model.cosmology)
    for name, band in setup.xray_bands().items():
        seen = (one.dimming(band.value, nodes, far)[place] * one.power for one in sources.values())
        models[name] = sum(seen) * u.uJy


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
