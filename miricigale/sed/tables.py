"""Models evaluated: one as spectra, rows of parameters as band fluxes, both with derived quantities."""

import difflib

import astropy.units as u
import numpy as np

from miricigale.filters.band_table import BandTable
from miricigale.filters.filter import UNCOVERED
from miricigale.sed import _core
from miricigale.sed.chain import SIX, SKY, STELLAR, distinct
from miricigale.sed.cosmology import distance
from miricigale.sed.derived import DERIVED, agn_quantities, galaxy_quantities, scaled_quantities
from miricigale.sed.parameter_names import LIVING_MASS, by_our_names
from miricigale.sed.spectrum import SED
from miricigale.utils.arrays import nans
from miricigale.utils.caching import cached
from miricigale.utils.column_units import quantity_table
from miricigale.utils.exceptions import ModelWarning, warn
from miricigale.utils.named_values import convert_values, rows_of
from miricigale.utils.options import check_that
from miricigale.utils.tables import Flags, as_table, described_table
from miricigale.utils.units import FNU, WAVE

BLOCK = 64  # rows worked out together: their spectra fit into the processor's cache


class ModelFlags(Flags):
    """
    Why a model could not be evaluated.

    Examples
    --------
    >>> from miricigale.sed import ModelFlags
    >>> ModelFlags.OLDER_THAN_UNIVERSE.value
    4
    >>> ModelFlags.names(20)
    ['older_than_universe', 'not_covered']
    """

    NOT_FINITE = 1, "A parameter is NaN or infinite."
    OUT_OF_BOUNDS = 2, "A parameter is outside its declared bounds."
    OLDER_THAN_UNIVERSE = 4, "The stars are older than the universe at this redshift."
    NOT_IN_LIBRARY = 8, "The library of spectra has no entry for these parameters."
    NOT_COVERED = 16, "A band reaches beyond the spectrum; it alone is NaN."
    NO_AGN_POWER = (
        32,
        "An AGN fraction was asked for, and there is no dust luminosity that it could refer to.",
    )


def dilution(redshift, far):
    """Return the factor from rest-frame L_nu in W/Hz to observed F_nu in uJy; distance in m."""
    return (1.0 + redshift) / (4.0 * np.pi * np.square(far)) * 1e32


def seen_agn(chain, parts):
    """Spectra of AGN templates, and the sums over them that the derived quantities need: dict of arrays."""
    total = np.array([t.total for t in parts])
    return total, {
        "infrared": total @ chain.functionals[0],
        "reference": chain.reference(total),
        "luminosity": total @ chain.weights,
        "six": total[:, chain.at[SIX]] * SIX,
        "accretion": np.array([t.accretion_power for t in parts]),
    }


def _columns(model, table):
    """Return the values of every parameter for every row, in the declared units."""
    check_that(
        "redshift" in table.colnames, "table", "a table with a column 'redshift'", table.colnames
    )
    out = {}
    for name, par in model.parameters.items():
        if name in table.colnames:
            out[name] = par.array(table[name])
        else:
            out[name] = np.full(len(table), par.default)
    return out


def _warn_of_slips(model, names):
    """Warn of columns that are left alone and look like a parameter misspelt."""
    lower = {name.lower(): name for name in model.parameters}
    for name in sorted(set(names) - set(model.parameters) - set(DERIVED)):
        close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.85)
        if close:
            msg = f"column {name!r} is no parameter and left alone: is it {lower[close[0]]!r}?"
            warn(msg, ModelWarning)


def _keys(columns, names, rows):
    """Return the values of some columns as a tuple for each row."""
    if not names:
        return [()] * len(rows)
    return list(zip(*(columns[name][rows].tolist() for name in names), strict=True))


def _row_flags(model, values, n):
    flags = np.zeros(n, dtype=np.int64)
    for name, parameter in model.parameters.items():
        finite = np.isfinite(values[name])
        low, high = parameter.bounds
        flags[~finite] |= ModelFlags.NOT_FINITE
        outside = finite & ((values[name] < low) | (values[name] > high))
        flags[outside] |= ModelFlags.OUT_OF_BOUNDS
    good = flags == 0
    universe = np.zeros(n)
    universe[good] = model.cosmology.age(values["redshift"][good]).to_value(u.Gyr)
    flags[good & (values["age"] > universe)] |= ModelFlags.OLDER_THAN_UNIVERSE
    for component in model.components:
        if not component.refuses or not np.any(good):
            continue
        # each different set of values is asked for once
        names = list(component.parameters) + list(component.others)
        rows = np.flatnonzero(good)
        different, index = distinct(_keys(values, names, rows))
        bad = [bool(component.invalid(dict(zip(names, row, strict=True)))) for row in different]
        flags[rows[np.array(bad)[index]]] |= ModelFlags.NOT_IN_LIBRARY
    return flags


@cached(maxsize=16)
def _stack(filters):
    """Return the integrals over all passbands, as `_core.band_means` takes them."""
    waves = [band.wave.to_value(WAVE) for band in filters]
    curves = [np.asarray(band.throughput, dtype=float) for band in filters]
    start = np.append(0, np.cumsum(list(map(len, waves))))
    return _core.band_tables(start, np.concatenate(waves), np.concatenate(curves))


def with_mass_formed(model, parameters):
    """
    Return the parameters of one model with the mass formed in place of that of living stars.

    Parameters
    ----------
    model : `SEDModel`
        The model.
    parameters : dict
        By our names; ``stellar_mass``, a number in solar masses or a quantity, is that of living stars.

    Raises
    ------
    ValueError
        If there are both masses.
    """
    if LIVING_MASS not in parameters:
        return parameters
    check_that(
        "mass" not in parameters, LIVING_MASS, "left out beside 'mass', the mass formed", "both"
    )
    out = dict(parameters)
    living = model.parameters["mass"].convert(out.pop(LIVING_MASS)) * u.Msun
    per_formed = spectra(model, model.values(out | {"mass": 1.0 * u.Msun})).derived[LIVING_MASS]
    return out | {"mass": living / per_formed.to_value(u.Msun)}


def _with_masses_formed(model, table, filters):
    """Return the table with the masses formed of rows in place of those of living stars."""
    if LIVING_MASS not in table.colnames or "mass" in table.colnames:
        return table
    out = table.copy()
    living = model.parameters["mass"].array(out[LIVING_MASS])
    del out[LIVING_MASS]
    out["mass"] = np.ones(len(out)) * u.Msun
    per_formed = _evaluate_rows(model, out, filters)[LIVING_MASS].to_value(u.Msun)
    # rows without a model are flagged, whatever their mass
    out["mass"] = living / np.where(per_formed > 0, per_formed, 1.0) * u.Msun
    return out


def spectra(model, values):
    """Return the spectrum of one model with its parts and derived quantities; see `SEDModel.evaluate`."""
    chain = model.chain
    z = values["redshift"]
    stars, rows = chain.stars([chain.key(values, STELLAR)])
    dim = chain.key(values, "attenuation")
    (starlight,), absorbed = chain.attenuated(stars, rows, [dim])
    absorbed *= values.get("dust_excess", 1.0)
    dust = absorbed * chain.dust(chain.key(values, "dust"))
    spectrum = starlight + dust
    parts = {"stellar_intrinsic": (stars.young + stars.old)[rows[0]], "stellar": starlight}
    if stars.nebular_young is not None:
        young, old, gas = chain.factors(dim)
        nebular = stars.nebular_young[rows[0]] * (young if gas is None else gas)
        nebular += stars.nebular_old[rows[0]] * (old if gas is None else gas)
        parts |= {"stellar": starlight - nebular, "nebular": nebular}
    parts["dust"] = dust
    sums = spectrum[None] @ chain.functionals.T
    got = galaxy_quantities(stars, rows, absorbed, sums, chain.reference_row)
    if model.has_agn:
        agn = chain.agn(values)
        fraction = values["frac_agn"]
        ratio = np.array([fraction / (1.0 - fraction)])
        _, observed = seen_agn(chain, [agn])
        got |= agn_quantities(model.frac_agn_definition, ratio, got, observed)
        spectrum = spectrum + got["agn_power"] * agn.total
        for name in ("disk", "torus", "polar"):
            parts[f"agn_{name}"] = got["agn_power"] * getattr(agn, name)
    if values.get("frac_agn", 0.0) > 0.0 and got["agn_power"][0] == 0.0:
        msg = "frac_agn has no effect: the galaxy has no dust luminosity that it could refer to"
        warn(msg, ModelWarning)
    far = distance(z, model.cosmology)
    scaled = scaled_quantities(model, got, np.array([values["mass"]]), z, far, values)
    factor = chain.sky(values) * (values["mass"] * float(dilution(z, far)))
    wave = chain.wave * (1.0 + z) * WAVE
    quantities = {n: u.Quantity(values[n], par.unit) for n, par in model.parameters.items()}
    columns = model.derived_columns().items()
    derived = {n: u.Quantity(scaled[n][0], entry.unit) for n, entry in columns}

    def sed(spectrum, **options):
        return SED(wave, chain.lnu(spectrum) * factor * FNU, redshift=z, **options)

    meta = {**model.meta, "parameters": quantities, "derived": derived}
    components = convert_values(sed, parts)
    return sed(spectrum, meta=meta, components=components)


class _Blocks:
    """Works out blocks of rows of one model; a model's spectra are never all in memory."""

    def __init__(self, model, values, bands, far):
        self.model = model
        self.values = values
        self.far = far
        self.chain = model.chain
        self.bands = bands
        self.span = np.array([bands[0].min(), bands[0].max()])
        self._light = np.empty((BLOCK, self.chain.wave.size))

    def _keys(self, rows, roles):
        return _keys(self.values, self.chain.names(roles), rows)

    def galaxies(self, rows):
        """Return the light of galaxies, and their derived quantities."""
        chain = self.chain
        stars, history_of_row = chain.stars(self._keys(rows, STELLAR))
        dims = self._keys(rows, "attenuation")
        dusts = self._keys(rows, "dust")
        light, absorbed = chain.attenuated(
            stars, history_of_row, dims, dusts, self._light[: len(rows)]
        )
        if "dust_excess" in self.values:
            excess = self.values["dust_excess"][rows]
            for i in np.flatnonzero(excess != 1.0):
                light[i] += (excess[i] - 1.0) * absorbed[i] * chain.dust(dusts[i])
            absorbed *= excess
        sums = light @ chain.functionals.T
        return light, galaxy_quantities(stars, history_of_row, absorbed, sums, chain.reference_row)

    def agn(self, rows):
        """Return the spectra of AGN for one watt, which of them each row has, and their sums."""
        chain = self.chain
        n = len(rows)
        model_of_row = np.zeros(n, dtype=np.int64)
        names = chain.names("agn")
        active = np.flatnonzero(self.values["frac_agn"][rows] > 0)
        # without any the first row stands for all, at no power
        if not active.size:
            active = np.array([0])
        different, index = distinct(self._keys(rows[active], "agn"))
        keys = [chain.agn_key(dict(zip(names, row, strict=True))) for row in different]
        keys, place = distinct(keys)
        parts = list(map(chain.agn_templates, keys))
        # the others have the first one, at no power
        model_of_row[active] = place[index]
        spectra, observed = seen_agn(chain, parts)
        return (
            spectra,
            model_of_row,
            rows_of(observed, model_of_row),
        )

    def run(self, rows):
        """Return the fluxes in uJy and derived quantities of rows, masses included."""
        chain = self.chain
        values = self.values
        n = len(rows)
        z = values["redshift"][rows]
        mass = values["mass"][rows]
        light, derived = self.galaxies(rows)
        power = np.zeros(n)
        model_of_row = np.zeros(n, dtype=np.int64)
        spectra = np.zeros((1, chain.wave.size))
        if self.model.has_agn:
            spectra, model_of_row, observed = self.agn(rows)
            fraction = values["frac_agn"][rows]
            definition = self.model.frac_agn_definition
            derived |= agn_quantities(definition, fraction / (1 - fraction), derived, observed)
            power = derived["agn_power"]
        names = ("redshift",) + chain.names(SKY)
        different, sky = distinct(_keys(values, names, rows))
        dim = np.ones((len(different), chain.wave.size))
        # the sky is needed where a band is
        edges = np.array([self.span / (1.0 + key[0]) for key in different])
        edges = np.maximum(np.searchsorted(chain.wave, edges) + [-1, 1], 0).tolist()
        for out, key, (a, b) in zip(dim, different, edges, strict=True):
            out[a:b] = chain.sky_transmission(key[0], key[1:], a, b)
        flux = np.empty((n, len(self.bands[0])))
        scale = mass * dilution(z, self.far[rows])
        _core.block_fluxes(
            chain.wave, chain.inverse_step, chain.to_lnu, light, spectra, model_of_row, power, dim, sky, z, scale,
            *self.bands, UNCOVERED, flux,
        )  # fmt: skip
        block = rows_of(values, rows)
        return flux, scaled_quantities(self.model, derived, mass, z, self.far[rows], block)


def flux_table(model, table, filters):
    """Return the fluxes and derived quantities of rows of parameters; see `SEDModel.fluxes`."""
    table = by_our_names(quantity_table(as_table(table, "table"), copy=False), model.parameters)
    _warn_of_slips(model, table.colnames)
    return _evaluate_rows(model, _with_masses_formed(model, table, filters), filters)


def _evaluate_rows(model, table, filters):
    """Do what `flux_table` does with a table of parameters by our names."""
    n = len(table)
    names = model.derived_columns()
    reserved = set(filters.names) & {"id", "flags", *names}
    check_that(not reserved, "filters", "without names of other columns", sorted(reserved))
    values = _columns(model, table)
    flags = _row_flags(model, values, n)
    flux = nans((n, len(filters)))
    derived = {name: nans(n) for name in names}
    good = np.flatnonzero(flags == 0)
    far = np.zeros(n)
    far[good] = distance(values["redshift"][good], model.cosmology)
    # neighbors share stars, then dust, then nuclei
    order = np.lexsort([values[name][good] for name in reversed(model.parameters)])
    blocks = _Blocks(model, values, _stack(filters), far)
    for first in range(0, good.size, BLOCK):
        rows = good[order[first : first + BLOCK]]
        flux[rows], got = blocks.run(rows)
        for name in names:
            derived[name][rows] = got[name]
        flags[rows[np.any(np.isnan(flux[rows]), axis=1)]] |= ModelFlags.NOT_COVERED
        if model.has_agn:
            without = (values["frac_agn"][rows] > 0) & (got["agn_power"] == 0)
            flags[rows[without]] |= ModelFlags.NO_AGN_POWER
    if "id" in table.colnames:
        out = {"id": (table["id"], table["id"].info.description)}
    else:
        out = {}
    for name, column in zip(filters.names, flux.T, strict=True):
        out[name] = column * FNU, f"model flux density in {name}"
    out |= {n: (derived[n] * entry.unit, entry.text) for n, entry in names.items()}
    columns = out | {"flags": (flags, ModelFlags.describe())}
    return described_table(columns, model.meta, cls=BandTable)
