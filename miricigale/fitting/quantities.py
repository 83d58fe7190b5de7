"""Parameters and derived quantities of the models of a grid."""

from dataclasses import dataclass
from functools import cached_property

import astropy.units as u
import numpy as np

from miricigale.fitting.posterior import cell_percentiles
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.random import stream
from miricigale.utils.units import LUMINOSITY, MASS

#: Levels at which the distributions of derived quantities are kept.
DERIVED_LEVELS = np.array(
    [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.16, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5]
    + [0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.84, 0.9, 0.95, 0.975, 0.99, 0.995, 0.999]
)
DERIVED_LEVELS.flags.writeable = False
#: Values of a shape quantity closer than this part of their range are one.
_SAME = 1e-9
#: Shape quantities whose outermost cells end at 0.
_NOT_NEGATIVE = ("a_v", "age_mass", "age_light")
#: AGN fractions by name, and what they are; the AGN's part in them and the galaxy's.
_IR = ("AGN share of 3-1000 um light", "ir_luminosity_agn", "ir_luminosity_galaxy")
_DUST = ("AGN power over the sum with the dust luminosity", "agn_power", "dust_luminosity")
_FRACTIONS = {"frac_agn_dust": _DUST, "frac_agn_ir": _IR}
_ALL = 1e30


def plain(column):
    """Values of a column as an array of float, without its unit."""
    return np.asarray(getattr(column, "value", column), dtype=float)


def unit_of(column):
    """Unit of a column; dimensionless if it has none."""
    return getattr(column, "unit", None) or u.dimensionless_unscaled


def draws_summary(value, *, with_log=True):
    """
    Mean, standard deviation and mean log10, and quantiles at `DERIVED_LEVELS`, of finite draws.

    The mean log10, of draws above 0, is NaN without ``with_log``: for quantities that do not scale with mass.
    """
    value = value[np.isfinite(value)]
    if not value.size:
        return np.full(3, np.nan), np.full(DERIVED_LEVELS.size, np.nan)
    lit = value[value > 0]
    log = np.mean(np.log10(lit)) if with_log and lit.size else np.nan
    return np.array([value.mean(), value.std(), log]), np.quantile(value, DERIVED_LEVELS)


def kept_percentiles(name, levels, kept):
    """
    Percentiles of a quantity, shape (n, n_levels), linear between its kept quantiles.

    ``kept`` has those at `DERIVED_LEVELS`, shape (n, n_kept). A `ValueError` is raised for levels beyond
    these: nothing is known of the tails.
    """
    low, high = DERIVED_LEVELS[[0, -1]]
    if np.any((levels < low) | (levels > high)):
        wanted = f"from {low:g} to {high:g} for {name!r}, whose distribution is kept there"
        raise argument_error("levels", wanted, f"{levels.tolist()}")
    out = np.array([np.interp(levels, DERIVED_LEVELS, row) for row in kept])
    return out.reshape(len(kept), levels.size)


@dataclass(frozen=True, eq=False)
class ShapeQuantities:
    """
    What is derived from a galaxy model and does not scale with its mass: attenuation, ages, colors.

    ``values``, shape (n_quantities, nG), has one for each galaxy model, so that their posterior follows
    from the marginal weights of the galaxy models; those that are not finite are left out.
    """

    names: tuple
    units: tuple
    descriptions: tuple
    values: np.ndarray

    @classmethod
    def of_grid(cls, grid):
        """Take all columns of ``grid.galaxy_shape`` (`~miricigale.sed.ModelGrid`)."""
        columns = tuple(grid.galaxy_shape.itercols())
        values = [plain(column) for column in columns]
        return cls(
            tuple(column.info.name for column in columns),
            tuple(unit_of(column) for column in columns),
            tuple(_text(column, "") for column in columns),
            np.array(values, float).reshape(len(columns), grid.dust_luminosity.size),
        )

    @cached_property
    def _nodes(self):
        """For each quantity: galaxies by ascending value, starts of equal values, the values."""
        out = []
        for row in self.values:
            finite = np.flatnonzero(np.isfinite(row))
            order = finite[np.argsort(row[finite], kind="stable")]
            value = row[order]
            if value.size == 0:
                out.append((order, np.zeros(0, int), value))
                continue
            step = np.diff(value) > _SAME * (value[-1] - value[0])
            start = np.concatenate([[0], np.flatnonzero(step) + 1])
            out.append((order, start, value[start]))
        return out

    def nodes(self, name):
        """Different values of a quantity in the grid, ascending: array, shape (n_nodes,)."""
        return self._nodes[self.names.index(name)][2]

    def bounds(self, name):
        """Limits that the outermost cells do not pass."""
        return (0.0 if name in _NOT_NEGATIVE else -np.inf, np.inf)

    def summarize(self, weights, levels):
        """
        Moments, shape (n, n_quantities, 3), and quantiles, from posterior weights of galaxies (n, nG).

        The moments are mean, standard deviation, and NaN (a mean of log10 has no meaning here); the
        quantiles, at ``levels``, those of the distribution over the different values, linear within each
        cell. Rows of NaN give NaN.
        """
        n = len(weights)
        out = np.full((n, len(self.names), 3), np.nan)
        quantiles = np.full((n, len(self.names), len(levels)), np.nan)
        for i, (order, start, nodes) in enumerate(self._nodes):
            if nodes.size == 0:
                continue
            # sums along rows in memory, so that pieces of a catalog give the same digits
            part = np.take(weights, order, axis=1)
            total = part.sum(axis=1, keepdims=True)
            # an object may have all its weight on models without a value
            part = np.divide(part, total, out=np.full(part.shape, np.nan), where=total > 0)
            value = self.values[i, order]
            mean = np.sum(part * value, axis=1)
            out[:, i, 0] = mean
            out[:, i, 1] = np.sqrt(np.sum(part * (value - mean[:, None]) ** 2, axis=1))
            pdf = np.add.reduceat(part, start, axis=1)
            quantiles[:, i] = cell_percentiles(nodes, pdf, levels, self.bounds(self.names[i]))
        return out, quantiles


@dataclass(frozen=True, eq=False)
class Quantities:
    """
    What is derived from the models of a grid, and how.

    The order is: the galaxy's quantities (for each solar mass formed), the AGN's (for each W of
    AGN power), the one that both have a part in (``mixed``), then those that do not scale with mass
    (``shape``). Arrays of galaxies have the shape (n_quantities, nG) or (nG,), those of the AGN likewise.
    """

    names: tuple
    units: tuple
    descriptions: tuple
    galaxy_scale: np.ndarray
    agn_scale: np.ndarray
    mixed_galaxy: np.ndarray
    mixed_agn: np.ndarray
    shape: ShapeQuantities

    @classmethod
    def of_grid(cls, grid):
        """
        Quantities of a model grid.

        All columns of its property tables are taken. A column of both tables (``ir_luminosity``)
        gives three quantities: the sum, and the parts ``<name>_galaxy`` and ``<name>_agn``;
        without one, the sum is ``total_luminosity``, dust luminosity and AGN power.
        """
        n_galaxy, n_agn = grid.dust_luminosity.size, grid.agn_multiplicity.size
        of_galaxy, of_agn = grid.galaxy_properties, grid.agn_properties
        both = [n for n in of_galaxy.colnames if n_agn and n in of_agn.colnames]
        names, units, texts = ["mass"], [MASS], ["mass of stars formed"]
        galaxy_scale, agn_scale = [np.ones(n_galaxy)], []
        for name in of_galaxy.colnames:
            names.append(f"{name}_galaxy" if name in both else name)
            column = of_galaxy[name]
            unit = unit_of(column) * MASS
            in_watt = unit.is_equivalent(LUMINOSITY)
            factor = unit.to(LUMINOSITY) if in_watt else 1.0
            units.append(LUMINOSITY if in_watt else unit)
            texts.append(_text(column, ", for one solar mass formed"))
            galaxy_scale.append(plain(column) * factor)
        for name in of_agn.colnames if n_agn else ():
            names.append(f"{name}_agn" if name in both else name)
            column = of_agn[name]
            unit = unit_of(column)
            units.append(LUMINOSITY if unit == u.dimensionless_unscaled else unit * LUMINOSITY)
            texts.append(_text(column, ", W for each W of AGN power"))
            agn_scale.append(plain(column))
        if both:
            name = both[0]
            mixed_galaxy = galaxy_scale[1 + of_galaxy.colnames.index(name)]
            mixed_agn = agn_scale[of_agn.colnames.index(name)]
            names.append(name)
            texts.append(f"{texts[1 + of_galaxy.colnames.index(name)]}; and of the AGN")
        else:
            mixed_galaxy, mixed_agn = np.asarray(grid.dust_luminosity), np.ones(n_agn)
            names.append("total_luminosity")
            texts.append("dust luminosity and AGN power")
        units.append(LUMINOSITY)
        shape = ShapeQuantities.of_grid(grid)
        return cls(
            (*names, *shape.names),
            (*units, *shape.units),
            (*texts, *shape.descriptions),
            np.array(galaxy_scale),
            np.array(agn_scale, float).reshape(len(agn_scale), n_agn),
            np.array(mixed_galaxy, float),
            np.array(mixed_agn, float),
            shape,
        )

    def summarize(self, out):
        """Moments and quantiles of all quantities, from what the grid engine found for n objects."""
        moments, quantiles = self.shape.summarize(out.galaxy, DERIVED_LEVELS)
        return (
            np.concatenate([out.moments, moments], axis=1),
            np.concatenate([out.quantiles, quantiles], axis=1),
        )

    def evaluate(self, name, grid, g, k, frac, scale):
        """
        Values of a quantity for single models: galaxies, AGN templates, fractions and scales.

        Indices and numbers have one shape, and the values have it too; a scale of NaN gives NaN.
        """
        i = self.names.index(name)
        n_galaxy, n_agn = len(self.galaxy_scale), len(self.agn_scale)
        if i < n_galaxy:
            return scale * self.galaxy_scale[i][g]
        if i > n_galaxy + n_agn:
            # no value where there is no model
            return np.where(
                np.isfinite(scale), self.shape.values[i - n_galaxy - n_agn - 1][g], np.nan
            )
        power = scale * frac / (1.0 - frac) * grid.dust_luminosity[g]
        if i < n_galaxy + n_agn:
            return power * self.agn_scale[i - n_galaxy][k]
        mixed = scale * self.mixed_galaxy[g]
        return mixed + power * self.mixed_agn[k] if self.mixed_agn.size else mixed

    def best(self, grid, g, k, frac, scale):
        """Values of all quantities for single models (see `evaluate`): shape (n_quantities, ...)."""
        return np.array([self.evaluate(n, grid, g, k, frac, scale) for n in self.names])


def _text(column, ending):
    text = getattr(column.info, "description", None) or column.info.name
    return text.removesuffix(ending)


@dataclass(frozen=True, eq=False)
class OtherFraction:
    """
    AGN fraction of every model in a second definition: y / (1 + y), y = c galaxy[g] agn[k].

    c = f / (1 - f) is that of the grid's own fraction f. If the latter refers to the dust
    luminosity the other is the AGN's share of 3-1000 um light, and the other way round. It does
    not scale with mass. ``galaxy``, shape (nG,), and ``agn``, shape (nA,), are the factors of y.
    """

    name: str
    description: str
    galaxy: np.ndarray
    agn: np.ndarray

    @classmethod
    def of_grid(cls, grid):
        """Of a `~miricigale.sed.ModelGrid`; None if it has no AGN or not the quantities needed."""
        by_dust = grid.frac_agn_definition == "dust"
        name = "frac_agn_ir" if by_dust else "frac_agn_dust"
        of_galaxy = "ir_luminosity" if by_dust else "dust_luminosity"
        of_agn = "ir_luminosity" if by_dust else "agn_power"
        tables = (grid.galaxy_properties, of_galaxy), (grid.agn_properties, of_agn)
        if not grid.n_agn or any(column not in table.colnames for table, column in tables):
            return None
        galaxy, agn = (_in_watt(table[column]) for table, column in tables)
        reference = np.asarray(grid.dust_luminosity, float)
        # where a galaxy has none of it all of it is the AGN's
        ratio = np.where(reference > 0, _ALL, 0.0)
        np.divide(reference, galaxy, out=ratio, where=galaxy > 0)
        return cls(name, _FRACTIONS[name][0], ratio, agn)

    def evaluate(self, g, k, frac):
        """Values for models of galaxies g and AGN models k at fractions of the grid."""
        y = frac / (1.0 - frac) * self.galaxy[g] * self.agn[k]
        return y / (1.0 + y)


def _in_watt(column):
    """Values in W for each solar mass, or plain ones."""
    if isinstance(column, u.Quantity) and column.unit.is_equivalent(LUMINOSITY / MASS):
        return column.to_value(LUMINOSITY / MASS)
    return plain(column)


def check_draws(grid, ids, flags, index, scale):
    """Refuse models drawn from a grid whose shapes do not agree, or that are none of the grid."""
    n, shape = ids.size, np.shape(scale)
    if len(shape) != 2 or shape[0] != n or shape[1] < 1:
        raise argument_error("scale", f"of shape ({n}, n_draws)", f"{shape}")
    if np.shape(index) != (*shape, 4):
        raise argument_error("index", f"of shape {(*shape, 4)}", f"{np.shape(index)}")
    if np.shape(flags) != (n,):
        raise argument_error("flags", f"of shape ({n},)", f"{np.shape(flags)}")
    sizes = (grid.redshift.size, grid.n_galaxies, max(grid.n_agn, 1), grid.frac_agn.size)
    index = np.asarray(index, dtype=np.int64)
    drawn = index[(index[:, :, 0] >= 0).all(axis=1)].reshape(-1, 4)
    lowest = np.array([0, 0, -1, 0])
    if np.any(drawn < lowest) or np.any(drawn >= np.array(sizes)):
        raise argument_error("index", f"within the grid's {sizes}", "others")
    if np.any((drawn[:, 2] < 0) & (grid.frac_agn[drawn[:, 3]] > 0)):
        raise argument_error("index", "with an AGN model where the AGN fraction is above 0", "none")


class ModelValues:
    """
    Values of parameters and derived quantities of models of a grid.

    ``axes`` are the parameters that have several values, with ``share``; ``seed`` chooses values of
    parameters without effect.
    """

    def __init__(self, grid, axes, seed):
        self.grid, self.axes, self.seed = grid, axes, seed
        self.quantities = Quantities.of_grid(grid)
        have = set(self.quantities.names)
        self.fractions = tuple(n for n, parts in _FRACTIONS.items() if set(parts[1:]) <= have)

    @property
    def names(self):
        """Names of parameters, derived quantities and AGN fractions."""
        return (*self.axes, *self.quantities.names, *self.fractions)

    def unit(self, name):
        """Unit of a parameter or quantity."""
        if name in self.axes:
            return u.Unit(self.axes[name].unit)
        if name in self.fractions:
            return u.dimensionless_unscaled
        if name not in self.quantities.names:
            raise unknown_name("parameter", name, self.names)
        return self.quantities.units[self.quantities.names.index(name)]

    def description(self, name):
        """One line on a parameter or quantity."""
        if name in self.quantities.names:
            return self.quantities.descriptions[self.quantities.names.index(name)]
        if name in self.fractions:
            return _FRACTIONS[name][0]
        for table in (self.grid.galaxy_parameters, self.grid.agn_parameters):
            if name in table.colnames and table[name].info.description:
                return table[name].info.description
        return name

    def extensive(self, name):
        """Whether a quantity scales with mass."""
        return name in self.quantities.names and name not in self.quantities.shape.names

    def values(self, name, ids, index, scale):
        """
        Values of a parameter or quantity in models drawn for n objects: shape (n, n_draws).

        ``ids`` key the streams of parameters without effect; NaN for parameters of an AGN that is not
        there. See `~miricigale.fitting.Samples` for ``index`` and ``scale``.
        """
        z, g, k, f = np.moveaxis(index, -1, 0)
        grid = self.grid
        if name == "redshift":
            return grid.redshift[z]
        if name in self.axes:
            axis = self.axes[name]
            if axis.kind == "frac_agn":
                return grid.frac_agn[f]
            return self._of_axis(axis, g if axis.kind == "galaxy" else k, ids)
        if name in self.fractions:
            agn, galaxy = (self.values(part, ids, index, scale) for part in _FRACTIONS[name][1:])
            whole = agn + galaxy
            return np.divide(agn, whole, out=np.zeros_like(whole), where=whole != 0)
        frac = grid.frac_agn[f]
        return self.quantities.evaluate(name, grid, g, np.maximum(k, 0), frac, scale)

    def _of_axis(self, axis, model, ids):
        """Values of a parameter; where a model stands for several, drawn as its prior has it."""
        share = axis.share
        out = axis.values[np.argmax(share, axis=0)][model]
        several = np.count_nonzero(share > 0, axis=0) > 1
        many = several[model] & (model >= 0)
        total = np.cumsum(share, axis=0)
        for i in np.flatnonzero(many.any(axis=1)):
            rng = stream(self.seed, "samples", axis.name, str(ids[i]))
            draw = rng.random(model.shape[1])[many[i]]
            cdf = total[:, model[i][many[i]]]
            out[i, many[i]] = axis.values[np.sum(draw * cdf[-1] >= cdf, axis=0)]
        return np.where(model >= 0, out, np.nan)
