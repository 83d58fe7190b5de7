"""Factorised grids of models: galaxies and AGN at every redshift, each worked out once."""

import itertools
from collections.abc import Mapping

import astropy.units as u
import numpy as np
from scipy.sparse import csr_array, vstack

from miricigale.sed.chain import GALAXY_ROLES, STELLAR, distinct
from miricigale.sed.cosmology import distance
from miricigale.sed.derived import DERIVED, galaxy_quantities
from miricigale.sed.grid import ModelGrid
from miricigale.sed.tables import BLOCK, dilution, seen_agn
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import ModelWarning, unknown_name, warn
from miricigale.utils.missing_values import own_mask
from miricigale.utils.named_values import subset, without
from miricigale.utils.options import check_that, check_type
from miricigale.utils.tables import described_table
from miricigale.utils.units import WAVE, is_ascending

#: Largest number of bands whose weights are kept, each at the redshifts of one table: some 200 kB each.
_MAX_BANDS = 256
#: Wavelength at rest beyond which dust heated by the mean field shines, um.
_COLD = 30.0


def check_axes(model, axes):
    """Check the axes: dict of name to values in the declared units."""
    check_type(axes, "axes", Mapping, "a dict of parameter name to values")
    out = {}
    skipped = {"mass", *_names(model, ("xray", "igm", "foreground"))}
    for name, values in axes.items():
        if name not in model.parameters or name in skipped:
            raise unknown_name("axis", name, [n for n in model.parameters if n not in skipped])
        parameter = model.parameters[name]
        check_that(not np.any(own_mask(values)), name, "values without a mask", values)
        array = parameter.array(values)
        check_that(is_ascending(array), name, "ascending values", array)
        for value in array:
            parameter.check(value)
        out[name] = array
    check_that("redshift" in out, "axes", "with 'redshift'", sorted(axes))
    return out


def warn_of_one_field(model, axes, filters):
    """Warn of far-infrared bands where all dust is in the same field of starlight, ``u_min``."""
    reach = _COLD * (1.0 + axes["redshift"][0])
    far = [band.name for band in filters if band.pivot.to_value(WAVE) > reach]
    if far and "u_min" in model.parameters and len(axes.get("u_min", [1.0])) == 1:
        msg = f"'u_min' of the dust has one value, which fixes the temperature of what {', '.join(far)} see; "
        warn(msg + "survey_axes('far-infrared') has more (--axes far-infrared)", ModelWarning)


def _names(model, roles):
    return [n for c in model.components if c.role in roles for n in c.parameters]


def _products(parameters, axes):
    """Return all combinations of parameters, the last one fastest: list of dicts."""
    values = [axes.get(name, [parameter.default]) for name, parameter in parameters.items()]
    rows = itertools.product(*values)
    return [dict(zip(parameters, map(float, row), strict=True)) for row in rows]


def _distinct_agn(component, rows):
    """Merge rows that differ in parameters without effect: rows, counts, names of those."""
    groups = {}
    for row in rows:
        inert = component.inert(row)
        key = tuple(without(row, inert).items())
        groups.setdefault((key, tuple(sorted(inert))), []).append(row)
    out = []
    names = [inert for _, inert in groups]
    for group, inert in zip(groups.values(), names, strict=True):
        mean = {name: float(np.mean([row[name] for row in group])) for name in inert}
        out.append(group[0] | mean)
    return out, np.array([len(group) for group in groups.values()], dtype=np.int64), names


def _parameter_table(parameters, rows):
    columns = {}
    for name, parameter in parameters.items():
        values = np.array([row[name] for row in rows], dtype=float)
        columns[name] = (values * parameter.unit, parameter.doc)
    return described_table(columns)


class Starlight:
    """
    Starlight behind dust of many galaxies, each different one worked out once.

    Parameters
    ----------
    chain : `~miricigale.sed.chain.Chain`
    rows : list of dict
        Values of all parameters of each galaxy.

    Attributes
    ----------
    stars : `~miricigale.sed.chain.Stars`
    star_rows, light_rows : `~numpy.ndarray` of int, shape (n,)
        Which of the stars, and of the different galaxies, each galaxy has.
    """

    def __init__(self, chain, rows):
        self.chain = chain
        self.stars, self.star_rows = chain.stars(chain.keys(rows, STELLAR))
        dims = chain.keys(rows, "attenuation")
        self._pairs, self.light_rows = distinct(zip(self.star_rows.tolist(), dims, strict=True))

    def sums(self, functions):
        """
        Sums over the spectra of every galaxy, a block at a time: all spectra would not fit into the cache.

        Parameters
        ----------
        functions : list of callable
            Each gives the sums, shape (n_block, ...), of spectra L_lambda in W/um, shape (n_block, n_wave).

        Returns
        -------
        sums : list of `~numpy.ndarray`, shape (n, ...)
        absorbed : `~numpy.ndarray`, shape (n,)
            Power in W that dust takes.
        """
        n = len(self._pairs)
        scratch = np.empty((BLOCK, self.chain.wave.size))
        absorbed = np.empty(n)
        sums = [None for _ in functions]
        for first in range(0, n, BLOCK):
            part = slice(first, first + BLOCK)
            rows, keys = zip(*self._pairs[part], strict=True)
            spectra = scratch[: len(rows)]
            _, absorbed[part] = self.chain.attenuated(self.stars, np.array(rows), keys, out=spectra)
            for k, function in enumerate(functions):
                of_block = function(spectra)
                if sums[k] is None:
                    sums[k] = np.empty((n,) + of_block.shape[1:])
                sums[k][part] = of_block
        if n < len(self.light_rows):
            sums = [of_different[self.light_rows] for of_different in sums]
            absorbed = absorbed[self.light_rows]
        return sums, absorbed


class BandSums:
    """
    Sums over rest-frame spectra that give fluxes in bands at some redshifts.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
    values : dict
        Values of all parameters of what lies between the source and us.
    filters : `~miricigale.filters.FilterSet`
    redshift : `~numpy.ndarray`, shape (nz,)
    """

    def __init__(self, model, values, filters, redshift):
        self.shape = len(filters), len(redshift)
        chain = model.chain
        far = distance(redshift, model.cosmology)
        factor = np.empty((len(redshift), chain.wave.size))
        for i, z in enumerate(redshift):
            sky = chain.sky(values | {"redshift": float(z)})
            factor[i] = sky * chain.to_lnu * dilution(z, far[i])
        wave = chain.wave.tobytes()
        stretch = (1.0 + np.asarray(redshift, float)).tobytes()
        weights = []
        for band in filters:
            of_band = csr_array(_sparse_weights(band, wave, stretch), shape=factor.shape)
            weights.append(of_band.multiply(factor))
        # a band sees few of the wavelengths
        self.weights = vstack(weights, format="csr")

    def __call__(self, spectra):
        """Return the fluxes in uJy, shape (n, nz, nb), of spectra L_lambda in W/um, shape (n, n_wave)."""
        flux = np.empty((len(spectra),) + self.shape[::-1])
        for first in range(0, len(spectra), BLOCK):
            part = slice(first, first + BLOCK)
            sums = self.weights @ np.ascontiguousarray(spectra[part].T)
            flux[part] = sums.reshape(self.shape + (-1,)).T
        return flux


@cached(maxsize=_MAX_BANDS)
def _sparse_weights(band, wave, stretch):
    """
    Weights of a filter for rest wavelengths, times each of some factors; further models need them again.

    Wavelengths and factors are bytes of their arrays. Returned is what `scipy.sparse.csr_array` makes the weights
    of, shape (n_factor, n_wave).
    """
    wave = np.frombuffer(wave)
    factors = np.frombuffer(stretch)
    weights = np.empty((factors.size, wave.size))
    for row, factor in zip(weights, factors, strict=True):
        row[:] = band.weights(wave * factor)
    sparse = csr_array(weights)
    return sparse.data, sparse.indices, sparse.indptr


class Galaxies:
    """Galaxies of a grid: sums over their light."""

    def __init__(self, model, rows, band_sums):
        chain = model.chain
        excess = [row.get("dust_excess", 1.0) for row in rows]
        starlight = Starlight(chain, rows)
        (flux, sums), absorbed = starlight.sums([band_sums, chain.functional_sums])
        dusts, dust_rows = distinct(chain.keys(rows, "dust"))
        dust = chain.dusts(dusts)
        self.absorbed = absorbed * excess
        #: Fluxes in uJy of one solar mass formed, shape (n, nz, nb).
        self.flux = flux + self.absorbed[:, None, None] * band_sums(dust)[dust_rows]
        sums = sums + self.absorbed[:, None] * chain.functional_sums(dust)[dust_rows]
        #: Derived quantities: dict of arrays, one value for each galaxy.
        self.quantities = galaxy_quantities(
            starlight.stars, starlight.star_rows, self.absorbed, sums, chain.reference_row
        )


def _galaxy_tables(quantities):
    """Return what scales with mass, and what does not."""
    texts = {"ir_luminosity": "3-1000 um light of stars and dust, without AGN"}
    scaling = {}
    shape = {}
    for name, values in quantities.items():
        if name in ("stellar_mass_formed", "reference"):
            continue
        entry = DERIVED[name]
        text = texts.get(name, entry.text)
        if entry.extensive:
            scaling[name] = values * (entry.unit / u.Msun), f"{text}, for one solar mass formed"
        else:
            shape[name] = values * entry.unit, text
    return described_table(scaling), described_table(shape)


def agn_table(model, parts):
    """Return the L_nu and properties of AGN for one watt of what the fraction refers to."""
    spectra, observed = seen_agn(model.chain, parts)
    dusty = model.frac_agn_definition == "dust"
    if dusty:
        scale = np.ones(len(parts))
    else:
        scale = 1.0 / observed["reference"]
    values = {
        "agn_power": np.ones(len(parts)),
        "agn_luminosity": observed["luminosity"],
        "accretion_power": observed["accretion"],
        "l_6um": observed["six"],
        "ir_luminosity": observed["infrared"],
    }
    columns = {}
    for name, power in values.items():
        text = DERIVED[name].text
        if name == "ir_luminosity":
            text = "3-1000 um light of the AGN"
        columns[name] = (power * scale * u.one, f"{text}, W for each W of AGN power")
    return model.chain.lnu(spectra) * scale[:, None], described_table(columns)


def model_grid(model, axes, filters):
    """Return the factorised grid of `SEDModel.grid`, for axes that `check_axes` gave."""
    chain = model.chain
    redshift = axes["redshift"]
    agn_component = model.component("agn")
    frac_agn = np.zeros(1)
    if agn_component:
        default = agn_component.parameters["frac_agn"].default
        frac_agn = axes.get("frac_agn", np.array([default]))
    names = _names(model, GALAXY_ROLES) + ["dust_excess"] * ("dust_excess" in axes)
    of_galaxy = subset(model.parameters, names)
    rows = _products(of_galaxy, axes)
    defaults = model.defaults
    _refuse_invalid(model, [defaults | row for row in rows], GALAXY_ROLES)
    band_sums = BandSums(model, defaults, filters, redshift)
    galaxies = Galaxies(model, rows, band_sums)
    quantities = galaxies.quantities
    properties, shape = _galaxy_tables(quantities)

    nuclei = {}
    agn_spectra = np.zeros((0, chain.wave.size))
    if np.any(frac_agn > 0.0):
        agn_spectra, nuclei = _nuclei(model, axes, frac_agn)
    dusty = model.frac_agn_definition == "dust"

    # these are L_nu, and the sums take L_lambda
    agn = band_sums(agn_spectra / chain.to_lnu)
    age = np.array([row["age"] for row in rows])
    universe = model.cosmology.age(redshift).to_value(u.Gyr)
    return ModelGrid(
        filters=filters.names,
        redshift=redshift,
        galaxy=np.ascontiguousarray(np.moveaxis(galaxies.flux, 1, 0)),
        agn=np.ascontiguousarray(np.moveaxis(agn, 1, 0)),
        dust_luminosity=galaxies.absorbed if dusty else quantities["reference"],
        allowed=age[None, :] <= universe[:, None],
        galaxy_parameters=_parameter_table(of_galaxy, rows),
        galaxy_properties=properties,
        galaxy_shape=shape,
        meta=model.meta,
        axes=axes,
        bounds={name: parameter.bounds for name, parameter in model.parameters.items()},
        frac_agn_definition=model.frac_agn_definition,
        recipe=model.recipe,
        preset=model.preset,
        **nuclei,
    )


def _nuclei(model, axes, frac_agn):
    """Return the spectra of all distinct AGN, L_nu for one watt, and the columns of a grid about them."""
    component = model.component("agn")
    parameters = without(component.parameters, ["frac_agn"])
    models = [row | {"frac_agn": 0.0} for row in _products(parameters, axes)]
    _refuse_invalid(model, [model.defaults | row for row in models], ("agn",))
    rows, count, inert = _distinct_agn(component, models)
    spectra, properties = agn_table(model, [model.chain.agn(row) for row in rows])
    columns = {
        "frac_agn": frac_agn,
        "agn_parameters": _parameter_table(parameters, rows),
        "agn_properties": properties,
        "agn_multiplicity": count,
        "inert": inert,
    }
    return spectra, columns


def _refuse_invalid(model, rows, roles):
    for component in model.components:
        if component.role in roles and component.refuses:
            why = next((w for w in map(component.invalid, rows) if w), None)
            if why:
                raise ValueError(why)
