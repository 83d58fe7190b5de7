"""Many models at once: tables of fluxes and factorised grids."""

import itertools
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.sed import _core
from miricigale.sed.chain import Galaxy
from miricigale.sed.components.agn import AGNTemplates
from miricigale.sed.grid import ModelGrid
from miricigale.sed.spectrum import distance
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.meta import provenance
from miricigale.utils.tables import Flags
from miricigale.utils.units import FNU, LUMINOSITY, MASS, WAVE

__all__ = ["DERIVED", "ModelFlags", "dilution", "flux_table", "model_grid", "row_state"]

_RATE = u.Msun / u.yr

#: Derived quantities: unit, whether they scale with mass, description.
DERIVED = {
    "stellar_mass": (MASS, True, "mass of living stars, without remnants"),
    "stellar_mass_formed": (MASS, True, "mass of all stars ever formed"),
    "sfr": (_RATE, True, "star-formation rate of the last 1 Myr"),
    "sfr_10myr": (_RATE, True, "mean star-formation rate of the last 10 Myr"),
    "sfr_100myr": (_RATE, True, "mean star-formation rate of the last 100 Myr"),
    "dust_luminosity": (LUMINOSITY, True, "power that dust takes from starlight and emits"),
    "ir_luminosity": (LUMINOSITY, True, "all light in 3-1000 um, AGN included"),
    "agn_power": (LUMINOSITY, True, "emission of torus and polar dust as seen"),
    "agn_luminosity": (LUMINOSITY, True, "all light of the AGN as seen"),
    "accretion_power": (LUMINOSITY, True, "luminosity of the accretion disk, over all directions"),
    "l_6um": (LUMINOSITY, True, "nu L_nu of the AGN at 6 um, as seen"),
    "frac_agn_dust": (u.dimensionless_unscaled, False, "AGN fraction, definition 'dust'"),
    "frac_agn_ir": (u.dimensionless_unscaled, False, "AGN share of 3-1000 um light"),
}
OF_AGN = tuple(list(DERIVED)[7:])


class ModelFlags(Flags):
    """Why a model could not be evaluated."""

    NOT_FINITE = 1
    OUT_OF_BOUNDS = 2
    OLDER_THAN_UNIVERSE = 4
    NOT_IN_LIBRARY = 8


def dilution(redshift, far):
    """Factor from rest-frame L_nu in W/Hz to observed F_nu in uJy; distance in m."""
    return (1.0 + redshift) / (4.0 * np.pi * np.square(far)) * 1e32


@dataclass(frozen=True, eq=False)
class RowState:
    """One model for one solar mass formed."""

    galaxy: Galaxy
    agn: AGNTemplates | None
    power: float
    spectrum: np.ndarray
    derived: dict


def row_state(model, values):
    """Work out one model for a dict of values: `RowState`, all for one solar mass formed."""
    chain = model.chain
    galaxy = chain.galaxy(values)
    stars, light = galaxy.stars, galaxy.light
    infrared = chain.infrared(light)
    derived = {
        "stellar_mass": stars.stellar_mass,
        "stellar_mass_formed": 1.0,
        "sfr": stars.sfr,
        "sfr_10myr": stars.sfr_10myr,
        "sfr_100myr": stars.sfr_100myr,
        "dust_luminosity": galaxy.dust_luminosity,
        "ir_luminosity": infrared,
    }
    if not model.has_agn:
        return RowState(galaxy, None, 0.0, light, derived)
    agn, power = chain.agn(values), 0.0
    seen = agn.total
    seen_infrared = chain.infrared(seen)
    ratio = values["frac_agn"] / (1.0 - values["frac_agn"])
    if model.frac_agn_definition == "dust":
        power = ratio * galaxy.dust_luminosity
    else:
        power = ratio * infrared / seen_infrared
    total = infrared + power * seen_infrared
    derived |= {
        "ir_luminosity": total,
        "agn_power": power,
        "agn_luminosity": power * np.trapezoid(seen, chain.wave),
        "accretion_power": power * agn.accretion_power,
        "l_6um": power * chain.six_micron(seen),
        "frac_agn_dust": _fraction(power, power + galaxy.dust_luminosity),
        "frac_agn_ir": _fraction(power * seen_infrared, total),
    }
    return RowState(galaxy, agn, power, light + power * seen, derived)


def _fraction(part, whole):
    return part / whole if part > 0.0 else 0.0


# ------------------------------------------------------------------ tables of rows


def _columns(model, table):
    """Values of every parameter for every row, in the declared units."""
    n = len(table)
    out = {}
    for name, parameter in model.parameters.items():
        if name in table.colnames:
            column = table[name]
            values = parameter.convert(column)
            values = np.ma.filled(np.ma.asarray(values).astype(float), np.nan)
            out[name] = np.asarray(values, dtype=float)
        elif name == "redshift":
            raise argument_error("table", "a table with a column 'redshift'", table.colnames)
        else:
            out[name] = np.full(n, parameter.default)
    return out


def _row_flags(model, columns, n):
    flags = np.zeros(n, dtype=np.int64)
    for name, parameter in model.parameters.items():
        values = columns[name]
        finite = np.isfinite(values)
        low, high = parameter.bounds
        flags[~finite] |= int(ModelFlags.NOT_FINITE)
        outside = finite & ((values < low) | (values > high))
        flags[outside] |= int(ModelFlags.OUT_OF_BOUNDS)
    good = flags == 0
    universe = np.zeros(n)
    universe[good] = model.cosmology.age(columns["redshift"][good]).to_value(u.Gyr)
    flags[good & (columns["age"] > universe)] |= int(ModelFlags.OLDER_THAN_UNIVERSE)
    for component in model.components:
        names = list(component.parameters)
        if not names or not np.any(good):
            continue
        # each different set of values is asked for once
        rows, inverse = np.unique(
            np.column_stack([columns[name][good] for name in names]), axis=0, return_inverse=True
        )
        bad = [bool(component.invalid(dict(zip(names, row, strict=True)))) for row in rows]
        flags[np.flatnonzero(good)[np.array(bad)[inverse.ravel()]]] |= int(
            ModelFlags.NOT_IN_LIBRARY
        )
    return flags


def _stack(filters):
    """All passbands one after the other, as `_core.band_means` takes them."""
    waves = [band.wave.to_value(WAVE) for band in filters]
    curves = [np.asarray(band.throughput, dtype=float) for band in filters]
    start = np.cumsum([0, *(w.size for w in waves)])
    bands = start, np.concatenate(waves), np.concatenate(curves)
    return *bands, _core.band_moments(*bands)


def flux_table(model, table, filters):
    """Fluxes and derived quantities of rows of parameters; see `SEDModel.fluxes`."""
    n, chain = len(table), model.chain
    columns = _columns(model, table)
    flags = _row_flags(model, columns, n)
    flux = np.full((n, len(filters)), np.nan)
    names = model.derived_columns()
    derived = {name: np.full(n, np.nan) for name in names}
    good = np.flatnonzero(flags == 0)
    far = np.zeros(n)
    far[good] = distance(columns["redshift"][good], model.cosmology)
    # neighbours share what was computed last
    order = np.lexsort([columns[name][good] for name in reversed(model.parameters)])
    bands = _stack(filters)
    previous, transmission = None, None
    for row in good[order]:
        values = {name: float(column[row]) for name, column in columns.items()}
        state = row_state(model, values)
        z = values["redshift"]
        if z != previous:
            previous, transmission = z, chain.transmission(z)
        fnu = chain.lnu(state.spectrum) * transmission
        scale = values["mass"] * dilution(z, far[row])
        flux[row] = _core.band_means(chain.wave * (1.0 + z), fnu, *bands) * scale
        for name, (_, extensive, _) in names.items():
            derived[name][row] = state.derived[name] * (values["mass"] if extensive else 1.0)
    out = QTable()
    if "id" in table.colnames:
        out["id"] = table["id"]
    for name, column in zip(filters.names, flux.T, strict=True):
        out[name] = column * FNU
        out[name].info.description = f"model flux density in {name}"
    for name, (unit, _, text) in names.items():
        out[name] = derived[name] * unit
        out[name].info.description = text
    out["flags"] = flags
    out["flags"].info.description = ModelFlags.describe()
    out.meta.update(model.meta)
    return out


# --------------------------------------------------------------------------- grids


def _axes(model, axes):
    """Check the axes: dict of name to values in the declared units."""
    out = {}
    for name, values in axes.items():
        if name not in model.parameters or name == "mass":
            raise unknown_name("axis", name, [n for n in model.parameters if n != "mass"])
        parameter = model.parameters[name]
        array = np.atleast_1d(np.asarray(parameter.convert(values), dtype=float))
        if array.ndim != 1 or array.size == 0 or np.any(np.diff(array) <= 0):
            raise argument_error(name, "ascending values", array)
        for value in array:
            parameter.check(value)
        out[name] = array
    if "redshift" not in out:
        raise argument_error("axes", "with 'redshift'", sorted(axes))
    return out


def _products(parameters, axes):
    """All combinations of parameters, the last one fastest: list of dicts."""
    values = [axes.get(name, [parameter.default]) for name, parameter in parameters.items()]
    return [
        dict(zip(parameters, map(float, row), strict=True)) for row in itertools.product(*values)
    ]


def _distinct(component, rows):
    """Merge rows that differ in parameters without effect: rows, counts."""
    groups = {}
    for row in rows:
        inert = component.inert(row)
        key = tuple((name, value) for name, value in row.items() if name not in inert)
        groups.setdefault(key, []).append(row)
    out = []
    for group in groups.values():
        merged = dict(group[0])
        for name in component.inert(merged):
            merged[name] = float(np.mean([row[name] for row in group]))
        out.append(merged)
    return out, np.array([len(group) for group in groups.values()], dtype=np.int64)


def _parameter_table(parameters, rows):
    out = QTable()
    for name, parameter in parameters.items():
        column = np.array([row[name] for row in rows], dtype=float)
        out[name] = u.Quantity(column, parameter.unit)
        out[name].info.description = parameter.doc
    return out


def model_grid(model, axes, filters):
    """The factorised grid of `SEDModel.grid`."""
    axes, chain = _axes(model, axes), model.chain
    redshift = axes["redshift"]
    agn_component = next((c for c in model.components if c.role == "agn"), None)
    of_agn = agn_component.parameters if agn_component else {}
    frac_agn = axes.get("frac_agn", np.zeros(1))
    with_agn = bool(of_agn) and np.any(frac_agn > 0.0)
    of_galaxy = {
        name: parameter
        for c in model.components
        if c.role not in ("agn", "igm")
        for name, parameter in c.parameters.items()
    }
    galaxies = _products(of_galaxy, axes)
    for component in model.components:
        if component.role not in ("agn", "igm"):
            why = next((w for w in map(component.invalid, galaxies) if w), None)
            if why:
                raise ValueError(why)

    # starlight and dust templates occur many times: keep the different ones
    star_index, dust_index, luminosity = _galaxy_parts(chain, galaxies)
    starlight = np.array([chain.lnu(s.light) for s in star_index.items])
    templates = np.array([chain.lnu(t) for t in dust_index.items])
    properties = _galaxy_properties(chain, galaxies, star_index, dust_index)
    agn_rows, count = [], np.zeros(0, int)
    agn_spectra, agn_properties, scale = np.zeros((0, chain.wave.size)), QTable(), np.zeros(0)
    agn_parameters = {n: p for n, p in of_agn.items() if n != "frac_agn"}
    if with_agn:
        rows = _products(agn_parameters, axes)
        agn_rows, count = _distinct(agn_component, [r | {"frac_agn": 0.0} for r in rows])
        parts = [chain.agn(row) for row in agn_rows]
        scale, agn_properties = _agn_properties(model, parts)
        agn_spectra = chain.lnu(np.array([t.total for t in parts])) * scale[:, None]
    reference = luminosity
    if model.frac_agn_definition != "dust":
        reference = properties["ir_luminosity"].value

    n_z, n_b = redshift.size, len(filters)
    galaxy = np.empty((n_z, len(galaxies), n_b))
    agn = np.empty((n_z, len(agn_rows), n_b))
    far = distance(redshift, model.cosmology)
    for i, z in enumerate(redshift):
        weights = filters.weights(chain.wave * (1.0 + z)) * chain.transmission(z)
        weights = weights.T * dilution(z, far[i])
        stellar, dust = starlight @ weights, templates @ weights
        galaxy[i] = stellar[star_index.rows]
        galaxy[i] += luminosity[:, None] * dust[dust_index.rows]
        agn[i] = agn_spectra @ weights
    age = np.array([row["age"] for row in galaxies])
    universe = model.cosmology.age(redshift).to_value(u.Gyr)
    meta = provenance(**model.meta)
    meta |= {"axes": {name: values.tolist() for name, values in axes.items()}}
    return ModelGrid(
        filters=filters.names,
        redshift=redshift,
        galaxy=galaxy,
        agn=agn,
        dust_luminosity=reference,
        frac_agn=frac_agn if with_agn else np.zeros(1),
        allowed=age[None, :] <= universe[:, None],
        galaxy_parameters=_parameter_table(of_galaxy, galaxies),
        agn_parameters=_parameter_table(agn_parameters, agn_rows) if with_agn else QTable(),
        galaxy_properties=properties,
        agn_properties=agn_properties,
        agn_multiplicity=count,
        meta=meta,
    )


class _Distinct:
    """Different items of a long list, by key."""

    def __init__(self):
        self.items, self.rows, self._seen = [], [], {}

    def add(self, key, make):
        if key not in self._seen:
            self._seen[key] = len(self.items)
            self.items.append(make())
        self.rows.append(self._seen[key])


def _galaxy_parts(chain, galaxies):
    stars, dust = _Distinct(), _Distinct()
    for row in galaxies:
        key = chain.key(row, "sfh", "stellar", "attenuation")
        stars.add(key, lambda row=row: chain.starlight(row))
        dust.add(chain.key(row, "dust"), lambda row=row: chain.dust(row))
    absorbed = np.array([stars.items[i].absorbed for i in stars.rows])
    return stars, dust, absorbed


def _galaxy_properties(chain, galaxies, stars, dust):
    out = QTable()
    parts = [chain.stars(row) for row in galaxies]
    for name in ("stellar_mass", "sfr", "sfr_10myr", "sfr_100myr"):
        unit, _, text = DERIVED[name]
        out[name] = np.array([getattr(p, name) for p in parts]) * (unit / u.Msun)
        out[name].info.description = f"{text}, for one solar mass formed"
    absorbed = np.array([stars.items[i].absorbed for i in stars.rows])
    infrared = np.array([chain.infrared(s.light) for s in stars.items])[stars.rows]
    infrared += absorbed * np.array([chain.infrared(t) for t in dust.items])[dust.rows]
    for name, values in (("dust_luminosity", absorbed), ("ir_luminosity", infrared)):
        out[name] = values * (LUMINOSITY / u.Msun)
        out[name].info.description = f"{DERIVED[name][2]}, for one solar mass formed"
    out["ir_luminosity"].info.description = "3-1000 um light of stars and dust, without AGN"
    return out


def _agn_properties(model, parts):
    """Properties of AGN for one watt of what the fraction refers to, and the scale to it."""
    chain = model.chain
    seen = np.array([t.total for t in parts])
    infrared = chain.infrared(seen)
    scale = np.ones(len(parts))
    if model.frac_agn_definition != "dust":
        scale = 1.0 / infrared
    values = {
        "agn_power": np.ones(len(parts)),
        "agn_luminosity": np.trapezoid(seen, chain.wave, axis=1),
        "accretion_power": np.array([t.accretion_power for t in parts]),
        "l_6um": chain.six_micron(seen),
        "ir_luminosity": infrared,
    }
    out = QTable()
    for name, column in values.items():
        out[name] = column * scale * u.dimensionless_unscaled
        out[name].info.description = f"{DERIVED[name][2]}, W for each W of AGN power"
    out["ir_luminosity"].info.description = "3-1000 um light of the AGN, W for each W of AGN power"
    return scale, out
