"""
Models between the nodes of a grid, interpolated in the parts in which their light is smooth.

Starlight, the dust's template and the AGN are tables of their own (`~miricigale.sed.light_parts`), each refined
along its axes and in redshift until the interpolation is good; the burst enters linearly, and so does the power
that dust takes. Of a grid whose model is unknown the whole galaxies are interpolated between its own nodes.
"""

import astropy.units as u
import numpy as np

from miricigale.filters import FilterSet
from miricigale.fitting import _core
from miricigale.fitting.grid.model_tables import ModelTables
from miricigale.fitting.grid.part_tables import (
    empty_part,
    log_columns,
    log_part_columns,
    logarithms,
    make_part,
    part_columns,
    straightest_power,
    with_columns,
)
from miricigale.fitting.posterior.priors import grid_priors
from miricigale.fitting.posterior.quantities import Quantities, column_values
from miricigale.utils.values import value_class


@value_class
class _GalaxiesOfGrid:
    """Derived quantities of galaxies interpolated between those of a grid."""

    scaling: tuple
    scaling_names: tuple
    shape: tuple
    shape_names: tuple

    def quantities(self, light, values):
        """Derive quantities as `ModelGalaxies.quantities` does."""
        scaling = part_columns(self.scaling, values).T
        quantities = dict(zip(self.scaling_names, scaling, strict=True))
        shape = log_part_columns(self.shape, values).T
        return quantities | dict(zip(self.shape_names, shape, strict=True))


@value_class
class _Names:
    """Names of the quantities of a grid, and what turns luminosities into W."""

    galaxy: tuple
    galaxy_factors: tuple
    agn: tuple
    shape: tuple

    @classmethod
    def of_grid(cls, grid):
        factors = []
        for column in grid.galaxy_properties.itercols():
            unit = (getattr(column, "unit", None) or u.one) * u.Msun
            factor = 1.0
            if unit.is_equivalent(u.W):
                factor = unit.to(u.W)
            factors.append(factor)
        agn = ()
        if grid.n_agn:
            agn = tuple(grid.agn_properties.colnames)
        return cls(
            tuple(grid.galaxy_properties.colnames),
            tuple(factors),
            agn,
            tuple(grid.galaxy_shape.colnames),
        )


@value_class
class InterpolatedModels:
    """
    Models between the nodes of a grid; picklable.

    Parameters
    ----------
    parameters : tuple of str
        Redshift, AGN fraction, the axes of galaxies, those of AGN: the order of values.
    constants : `~numpy.ndarray`, shape (n_parameters,)
        Value of each where none is given.
    quantities : `~miricigale.fitting.posterior.quantities.Quantities`
        Of the grid.
    light : `_core.Light`
        Tables of the parts.
    galaxies : `ModelGalaxies` or `_GalaxiesOfGrid`
        Derived quantities.
    agn_columns : `_core.Part`
        Properties of the AGN.
    names : `_Names`
    n_bands : int
        Number of bands.
    """

    parameters: tuple
    constants: np.ndarray
    quantities: Quantities
    light: tuple
    galaxies: object
    agn_columns: tuple
    names: _Names
    n_bands: int

    # ------------------------------------------------------------------------- making

    @classmethod
    def of_grid(cls, grid, axes=None):
        """Interpolate between the nodes of a `~miricigale.sed.ModelGrid`, with its `GridAxis` by name if known."""
        if axes is None:
            axes = grid_priors(grid).axes
        quantities = Quantities.of_grid(grid)
        parameters = parameter_names(axes)
        place = {name: i for i, name in enumerate(parameters)}
        n_bands = len(grid.filters)
        reference = np.asarray(grid.dust_luminosity, float)
        model, values = _models_and_values(axes, "galaxy", grid.n_galaxies)
        amount, reference = _saturating_reference(reference, model, values)
        place_of_amount = -1
        if amount is not None:
            place_of_amount = place[amount]
        # last columns: what AGN fractions refer to, and the power that dust takes
        columns = np.column_stack([reference, reference])
        flux = np.moveaxis(np.asarray(grid.galaxy), 0, 1)
        table = logarithms(flux, columns, grid.redshift)
        stars = _part_of_grid(table, model, values, grid.redshift, place)
        names = _Names.of_grid(grid)
        scaling_names = list(names.galaxy) + ["reference"]
        scaling = [column_values(column) for column in grid.galaxy_properties.itercols()]
        scaling.append(np.asarray(grid.dust_luminosity, float))
        scaling = log_columns(np.array(scaling).T)
        shape = np.array([column_values(column) for column in grid.galaxy_shape.itercols()], float)
        shape = shape.reshape(len(names.shape), grid.n_galaxies).T
        agn = empty_part(n_bands)
        agn_columns = empty_part(len(names.agn))
        if grid.n_agn:
            model_agn, values_agn = _models_and_values(axes, "agn", grid.n_agn)
            flux = np.moveaxis(np.asarray(grid.agn), 0, 1)
            table = logarithms(flux, np.zeros((grid.n_agn, 0)), grid.redshift)
            agn = _part_of_grid(table, model_agn, values_agn, grid.redshift, place)
            columns = np.array([column_values(column) for column in grid.agn_properties.itercols()])
            agn_columns = with_columns(agn, log_columns(columns.T))
        light = _core.Light(
            stars=stars,
            burst=empty_part(n_bands + 2),
            dust=empty_part(n_bands + 1),
            agn=agn,
            mixing=-1,
            amount=place_of_amount,
            excess=-1,
            age=-1,
            youth=np.zeros(len(grid.redshift)),
            by_dust=True,
        )
        galaxies = _GalaxiesOfGrid(
            with_columns(stars, scaling),
            tuple(scaling_names),
            with_columns(stars, shape),
            names.shape,
        )
        constants = np.array([_first_value(axes, grid, name) for name in parameters])
        return cls(parameters, constants, quantities, light, galaxies, agn_columns, names, n_bands)

    @classmethod
    def of_model(cls, model, grid, filters, constants, axes=None):
        """
        Interpolate between the nodes of finer tables of the model that made a grid.

        Parameters
        ----------
        model : `~miricigale.sed.SEDModel`
        grid : `~miricigale.sed.ModelGrid`
        filters : list of str or `~miricigale.filters.FilterSet`
            Bands of the grid.
        constants : dict of str to float
            Parameters of the grid with one value.
        axes : dict of str to `~miricigale.fitting.posterior.priors.GridAxis`, optional

        Raises
        ------
        ValueError
            If the model has other fluxes at the nodes of the grid.
        """
        if axes is None:
            axes = grid_priors(grid).axes
        if not isinstance(filters, FilterSet):
            filters = FilterSet.from_names(filters)
        parameters = parameter_names(axes)
        place = {name: i for i, name in enumerate(parameters)}
        tables = ModelTables(model, filters, constants, axes, place, grid.redshift)
        tables.check(grid)
        light, galaxies, agn_columns = tables.tables()
        first = [_first_value(axes, grid, name) for name in parameters]
        return cls(
            parameters,
            np.array(first),
            Quantities.of_grid(grid),
            light,
            galaxies,
            agn_columns,
            _Names.of_grid(grid),
            len(grid.filters),
        )

    # ------------------------------------------------------------------------- models

    @property
    def n_columns(self):
        """Most columns of a table that fluxes are interpolated from."""
        return self.light.stars.table.shape[2]

    @property
    def sizes(self):
        """Number of models of each table: dict of str to int."""
        names = ("stars", "burst", "dust", "agn")
        return {name: getattr(self.light, name).table.shape[1] for name in names}

    def make_work(self):
        """Make the scratch arrays of the kernels."""
        return _core.make_work(len(self.parameters), self.n_columns)

    def vector(self, values, redshift):
        """Arrange values by name, of shape (n,), in the order of ``parameters``: (n, n_parameters)."""
        vector = np.tile(self.constants, (len(redshift), 1))
        for i, name in enumerate(self.parameters):
            if name in values:
                vector[:, i] = values[name]
        vector[:, 0] = redshift
        return vector

    def fluxes(self, values, redshift, frac):
        """Interpolate fluxes in uJy of one solar mass formed with AGN, (n, nb), and the AGN's power in W, (n,)."""
        redshift = np.asarray(redshift, float)
        flux = np.empty((len(redshift), self.n_bands))
        power = np.empty((2, len(redshift)))
        vector = self.vector(values, redshift)
        frac = np.broadcast_to(np.asarray(frac, float), redshift.shape)
        work = self.make_work()
        _core.interpolate_light(self.light, vector, redshift, frac.copy(), work, flux, power)
        return flux, power[1]

    def galaxy_fluxes(self, values, redshift):
        """Interpolate the fluxes of galaxies of one solar mass formed in uJy, shape (n, nb)."""
        flux, _ = self.fluxes(values, redshift, 0.0)
        return flux

    def agn_fluxes(self, values, redshift):
        """Interpolate the fluxes of AGN of one watt in uJy, shape (n, nb)."""
        redshift = np.asarray(redshift, float)
        vector = self.vector(values, redshift)
        flux = np.empty((len(redshift), self.n_bands))
        _core.interpolate_columns(self.light.agn, vector, redshift, self.make_work(), flux)
        # tables hold ln of flux times z^2
        return np.exp(flux) * np.maximum(redshift, 1e-6)[:, None] ** -2.0

    def describe(self, values, redshift, power, scale):
        """Derive quantities of models of AGN power (n,), for one solar mass, and scale (n,): dict by name."""
        vector = self.vector(values, np.asarray(redshift, float))
        galaxy = self.galaxies.quantities(self.light, vector)
        names = self.names
        described = {"mass": scale}
        for name, factor in zip(names.galaxy, names.galaxy_factors, strict=True):
            if name in names.agn:
                label = f"{name}_galaxy"
            else:
                label = name
            described[label] = scale * galaxy[name] * factor
        agn = {}
        if names.agn:
            columns = part_columns(self.agn_columns, vector).T
            agn = dict(zip(names.agn, columns, strict=True))
        for name in names.agn:
            if name in names.galaxy:
                label = f"{name}_agn"
            else:
                label = name
            described[label] = scale * power * agn[name]
        shared = [name for name in names.galaxy if name in names.agn]
        if shared:
            described[shared[0]] = described[f"{shared[0]}_galaxy"] + described[f"{shared[0]}_agn"]
        else:
            described["total_luminosity"] = scale * (galaxy["reference"] + power)
        for name in names.shape:
            described[name] = galaxy[name]
        if self.quantities.fraction is not None:
            described[self.quantities.fraction.name] = self._other_fraction(galaxy, agn, power)
        return described

    def _other_fraction(self, galaxy, agn, power):
        """Compute the AGN fraction in the definition that the grid does not use."""
        if self.quantities.fraction.name == "frac_agn_ir":
            of_galaxy = galaxy["ir_luminosity"]
            of_agn = power * agn["ir_luminosity"]
        else:
            of_galaxy = galaxy["dust_luminosity"]
            of_agn = power * agn["agn_power"]
        # share of the AGN in the sum
        total = of_galaxy + of_agn
        return np.divide(of_agn, total, out=np.zeros(len(total)), where=total > 0)


def parameter_names(axes):
    """Order the parameters of models: redshift, AGN fraction, axes of galaxies, axes of AGN."""
    galaxy = [name for name, axis in axes.items() if axis.kind == "galaxy"]
    agn = [name for name, axis in axes.items() if axis.kind == "agn"]
    return tuple(["redshift", "frac_agn"] + galaxy + agn)


def _first_value(axes, grid, name):
    if name in axes:
        return float(axes[name].values[0])
    return float(grid.frac_agn[0])


def grid_models(axes, kind, n_models):
    """
    Find the models of all combinations of the values of a grid's axes.

    Parameters
    ----------
    axes : dict of str to `~miricigale.fitting.posterior.priors.GridAxis`
    kind : {"galaxy", "agn"}
    n_models : int

    Returns
    -------
    model : `~numpy.ndarray` of int, one axis for each parameter
        -1 where there is none.
    """
    kind_axes = [axis for axis in axes.values() if axis.kind == kind]
    if not kind_axes:
        return np.array(0)
    model = np.full([axis.values.size for axis in kind_axes], -1)
    for i in range(n_models):
        # a model without effect of a parameter stands for all its values
        places = [np.flatnonzero(axis.share[:, i] > 0) for axis in kind_axes]
        model[np.ix_(*places)] = i
    return model


def _models_and_values(axes, kind, n_models):
    values = {name: axis.values for name, axis in axes.items() if axis.kind == kind}
    return grid_models(axes, kind, n_models), values


def _part_of_grid(table, model, values, redshift, place):
    """Make the `_core.Part` of the models of a grid."""
    full = table[model.ravel()].reshape(*model.shape, *table.shape[1:])
    full = np.where((model >= 0)[..., None, None], full, np.nan)
    # shapes matter, not brightness; one redshift is enough
    at_middle = full[..., table.shape[1] // 2, :]
    powers = {}
    for i, name in enumerate(values):
        along = np.moveaxis(at_middle, i, 0).reshape(len(values[name]), -1, table.shape[2])
        # a common factor of all bands is taken out
        along = along - np.median(along, axis=-1, keepdims=True)
        powers[name] = straightest_power(values[name], along)
    return make_part(tuple(values), values, powers, table, redshift, place, model)


def _saturating_reference(reference, model, values):
    """
    Find the axis of the amount of dust, whose 0 is none, and the dust's power over how far it saturates.

    The ratio at no dust is that of the next node. Without such an axis None and the power itself.
    """
    if np.all(reference > 0):
        return None, reference
    power = np.where(model >= 0, reference[model], np.nan)
    for i, (name, nodes) in enumerate(values.items()):
        along = np.moveaxis(power, i, 0)
        with_dust = along[1:][np.isfinite(along[1:])]
        without = along[0][np.isfinite(along[0])]
        if nodes[0] != 0 or len(nodes) < 2 or np.any(without > 0) or np.any(with_dust <= 0):
            continue
        ratio = reference.copy()
        models = np.moveaxis(model, i, 0)
        for j in range(len(nodes) - 1, -1, -1):
            rows = models[j][models[j] >= 0]
            # power over 1 - exp(-a x), whose limit at x = 0 is that of the next node
            if j:
                ratio[rows] = reference[rows] / -np.expm1(-_core.SATURATION * nodes[j])
            else:
                has_neighbor = (models[0] >= 0) & (models[1] >= 0)
                ratio[models[0][has_neighbor]] = ratio[models[1][has_neighbor]]
        return name, ratio
    return None, reference
