"""Parameters and derived quantities of the models of a grid."""

from functools import cached_property

import astropy.units as u
import numpy as np

from miricigale.fitting import _core
from miricigale.fitting.posterior.posterior import cell_percentiles
from miricigale.utils.arrays import nans, quotient
from miricigale.utils.options import check_that
from miricigale.utils.units import LUMINOSITY, MASS, frozen_array, own_unit
from miricigale.utils.values import value_class

#: Levels at which the distributions of derived quantities are kept.
DERIVED_LEVELS = frozen_array(
    [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.16, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5]
    + [0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.84, 0.9, 0.95, 0.975, 0.99, 0.995, 0.999]
)
#: Levels of the 68 % interval and of its middle.
_INTERVAL = frozen_array([0.16, 0.5, 0.84])
#: Largest error of a percentile that is reported, in units of half of the 68 % interval.
_LARGEST_ERROR = 1e3
#: Values of a shape quantity closer than this part of their range are one.
_SAME = 1e-9
#: Shape quantities whose outermost cells end at 0.
_NOT_NEGATIVE = ("a_v", "age_mass", "age_light")
_IR = ("AGN share of 3-1000 um light", "ir_luminosity_agn", "ir_luminosity_galaxy")
_DUST = ("AGN power over the sum with the dust luminosity", "agn_power", "dust_luminosity")
#: AGN fractions by name: what they are, the AGN's part in them and the galaxy's.
FRACTIONS = {"frac_agn_dust": _DUST, "frac_agn_ir": _IR}
#: Factor of y where all of a luminosity is the AGN's.
_AGN_ALONE = 1e30
#: Other codes quote the mass of living stars, which is 0.2 to 0.3 dex less.
FORMED_TEXT = (
    "mass of all stars formed; that of living stars, which other codes quote, is stellar_mass"
)


def column_values(column):
    """Return the values of a column as an array of float, without its unit."""
    return np.asarray(getattr(column, "value", column), dtype=float)


def unit_of(column):
    """Return the unit of a column; dimensionless if it has none."""
    return own_unit(column) or u.dimensionless_unscaled


def draws_summary(value, *, with_log=True, weight=None):
    """
    Compute mean, standard deviation and mean log10, and quantiles at `DERIVED_LEVELS`, of finite draws.

    The mean log10, of draws above 0, is NaN without ``with_log``: for quantities that do not scale with mass.
    Draws have the same weight, or the weights ``weight``.
    """
    finite = np.isfinite(value)
    if weight is not None:
        if not finite.all():
            value = value[finite]
            weight = weight[finite]
        return _weighted_summary(value, weight, with_log)
    value = value[finite]
    if not value.size:
        return nans(3), nans(DERIVED_LEVELS.size)
    lit = value[value > 0]
    log = np.nan
    if with_log and lit.size:
        log = np.mean(np.log10(lit))
    place = DERIVED_LEVELS * (value.size - 1)
    quantiles = np.interp(place, np.arange(value.size), np.sort(value))
    return np.array([value.mean(), value.std(), log]), quantiles


def _weighted_summary(value, weight, with_log):
    """Do what `draws_summary` does, of finite draws with weights."""
    total = weight.sum()
    if not total > 0:
        return nans(3), nans(DERIVED_LEVELS.size)
    (values, middles, _), moments = _sorted_draws(value, weight, with_log)
    return moments, np.interp(DERIVED_LEVELS, middles, values)


def _sorted_draws(value, weight, with_log):
    """Sort draws with weights, and compute their moments; see `~miricigale.fitting._core.sort_draws`."""
    table = np.empty((3, value.size))
    moments = np.empty(3)
    value = np.ascontiguousarray(value, float)
    _core.sort_draws(value, weight, np.argsort(value), with_log, table, moments)
    return table, moments


def percentile_error(values, weight, lineage=None):
    """
    Estimate the largest error of the 16th, 50th and 84th percentiles of a finite number of weighted draws.

    Parameters
    ----------
    values, weight : `~numpy.ndarray`, shape (n,)
        The draws, and their weights, which sum to 1.
    lineage : `~numpy.ndarray` of int, shape (n,), optional
        Draws of the same number come from one, and have their weight together. By default each is on its own.

    Returns
    -------
    error : float
        In units of half of the 68 % interval; 0 where that is a single value.

    Notes
    -----
    The share p of the draws below a value has the variance sum w^2 (I - p)^2, with I = 1 for draws below and 0 for
    those above. The percentiles at shares that are a standard error smaller and larger say what that means for the
    value, also between two peaks, where there is no density to divide by. With lineages w (I - p) is summed over
    each before it is squared (Lee & Whiteley 2018, Biometrika 105, 609).
    """
    (ascending, middles, square_upto), _ = _sorted_draws(values, weight, with_log=False)
    percentiles = np.interp(_INTERVAL, middles, ascending)
    low = percentiles[0]
    high = percentiles[-1]
    half_width = 0.5 * (high - low)
    # values that differ by rounding are one
    if not half_width > _SAME * max(abs(low), abs(high)):
        return 0.0
    if lineage is None:
        below = np.interp(_INTERVAL, middles, square_upto)
        above = square_upto[-1] - below
        share_error = np.sqrt(np.square(1.0 - _INTERVAL) * below + np.square(_INTERVAL) * above)
    else:
        share_error = _share_error_of_lineages(values, weight, lineage, percentiles)
    smaller = np.interp(_INTERVAL - share_error, middles, ascending)
    larger = np.interp(_INTERVAL + share_error, middles, ascending)
    spread = 0.5 * np.max(larger - smaller)
    # half an interval may be as good as nothing, where most models have no dust
    return float(min(spread, _LARGEST_ERROR * half_width) / half_width)


def _share_error_of_lineages(values, weight, lineage, percentiles):
    """Compute the standard error of the share of draws below each percentile of the interval, (3,)."""
    share_error = np.empty(len(_INTERVAL))
    for i, level in enumerate(_INTERVAL):
        excess = weight * ((values <= percentiles[i]) - level)
        sums = np.bincount(lineage, excess)
        share_error[i] = np.sqrt(np.sum(sums * sums))
    return share_error


def put_draws(results, new, i, values):
    """Put moments and quantiles of derived quantities of draws, by name, into arrays of results, row ``i``."""
    for j, name in enumerate(results.quantities):
        if name in values:
            with_log = np.isfinite(results.moments[i, j, 2])
            moments, quantiles = draws_summary(values[name], with_log=with_log)
            new["moments"][i, j] = moments
            new["quantiles"][i, j] = quantiles


def node_shares(nodes, shape, weight=None):
    """
    Count the part of the draws at each combination of nodes: arrays of indices, one for each axis of ``shape``.

    Draws have the same weight, or the weights ``weight``.
    """
    place = np.ravel_multi_index(nodes, shape)
    if weight is None:
        total = len(place)
    else:
        total = weight.sum()
    return np.bincount(place, weight, minlength=np.prod(shape)).reshape(shape) / total


def kept_percentiles(name, levels, quantiles):
    """
    Interpolate percentiles of a quantity, shape (n, n_levels), linearly between its stored quantiles.

    ``quantiles`` has those at `DERIVED_LEVELS`, shape (n, n_kept). A `ValueError` is raised for levels beyond
    these: nothing is known of the tails.
    """
    low, high = DERIVED_LEVELS[[0, -1]]
    wanted = f"from {low:g} to {high:g} for {name!r}, whose distribution is kept there"
    check_that(not np.any((levels < low) | (levels > high)), "levels", wanted, f"{levels.tolist()}")
    i = np.maximum(np.searchsorted(DERIVED_LEVELS, levels) - 1, 0)
    part = (levels - DERIVED_LEVELS[i]) / (DERIVED_LEVELS[i + 1] - DERIVED_LEVELS[i])
    return quantiles[:, i] * (1.0 - part) + quantiles[:, i + 1] * part


@value_class
class ShapeQuantities:
    """
    What is derived from a galaxy model and does not scale with its mass: attenuation, ages, colors.

    ``values``, shape (n_quantities, nG), has one for each galaxy model, so that their posterior follows
    from the marginal weights of the galaxy models; those that are not finite are left out.
    """

    names: tuple
    values: np.ndarray

    @cached_property
    def _nodes(self):
        """Galaxies by ascending value, starts of equal values and the values, for each quantity."""
        out = []
        for row in self.values:
            finite = np.flatnonzero(np.isfinite(row))
            order = finite[np.argsort(row[finite], kind="stable")]
            value = row[order]
            width = 0.0
            if value.size:
                width = np.ptp(value)
            start = np.flatnonzero(np.diff(value, prepend=-np.inf) > _SAME * width)
            out.append((order, start, value[start]))
        return out

    def summarize(self, weights, levels):
        """
        Compute moments, (n, n_quantities, 3), and quantiles from posterior weights of galaxies (n, nG).

        The moments are mean, standard deviation, and NaN (a mean of log10 has no meaning here); the
        quantiles, at ``levels``, those of the distribution over the different values, linear within each
        cell. Rows of NaN give NaN.
        """
        shape = len(weights), len(self.names)
        out = nans(shape + (3,))
        quantiles = nans(shape + (len(levels),))
        for i, (order, start, nodes) in enumerate(self._nodes):
            if nodes.size == 0:
                continue
            # sums along rows in memory, so that pieces of a catalog give the same digits
            part = np.take(weights, order, axis=1)
            total = part.sum(axis=1, keepdims=True)
            # an object may have all its weight on models without a value
            part = quotient(part, total, np.nan)
            value = self.values[i, order]
            mean = np.sum(part * value, axis=1)
            out[:, i, 0] = mean
            out[:, i, 1] = np.sqrt(np.sum(part * (value - mean[:, None]) ** 2, axis=1))
            pdf = np.add.reduceat(part, start, axis=1)
            lowest = -np.inf
            if self.names[i] in _NOT_NEGATIVE:
                lowest = 0.0
            quantiles[:, i] = cell_percentiles(nodes, pdf, levels, (lowest, np.inf))
        return out, quantiles


@value_class
class OtherFraction:
    """
    AGN fraction of every model in a second definition: y / (1 + y), y = c galaxy[g] agn[k].

    c = f / (1 - f) is that of the grid's own fraction f. If the latter refers to the dust
    luminosity the other is the AGN's share of 3-1000 um light, and the other way round. It does
    not scale with mass. ``galaxy``, shape (nG,), and ``agn``, shape (nA,), are the factors of y.
    """

    name: str
    galaxy: np.ndarray
    agn: np.ndarray

    @classmethod
    def of_grid(cls, grid):
        """Make the fraction of a `~miricigale.sed.ModelGrid`; None without AGN or the quantities needed."""
        by_dust = grid.frac_agn_definition == "dust"
        # the definition that the grid does not use
        name = "frac_agn_dust"
        of_galaxy = "dust_luminosity"
        of_agn = "agn_power"
        if by_dust:
            name = "frac_agn_ir"
            of_galaxy = "ir_luminosity"
            of_agn = "ir_luminosity"
        has_galaxy = of_galaxy in grid.galaxy_properties.colnames
        has_agn = grid.n_agn and of_agn in grid.agn_properties.colnames
        if not (has_galaxy and has_agn):
            return None
        galaxy, _ = _in_watt(grid.galaxy_properties[of_galaxy])
        agn, _ = _in_watt(grid.agn_properties[of_agn])
        reference = grid.dust_luminosity
        # where a galaxy has none of this luminosity, all of it is the AGN's
        ratio = np.where(reference > 0, _AGN_ALONE, 0.0)
        np.divide(reference, galaxy, out=ratio, where=galaxy > 0)
        return cls(name, ratio, agn)


@value_class
class Quantities:
    """
    What is derived from the models of a grid, and how.

    The order is: the galaxy's quantities (for each solar mass formed), the AGN's (for each W of
    AGN power), the one that both have a part in (``mixed``), then those that do not scale with mass
    (``shape``), and the AGN fraction in the definition that the grid does not use, if it has one. Arrays of
    galaxies have the shape (n_quantities, nG) or (nG,), those of the AGN likewise.
    """

    names: tuple
    units: tuple
    descriptions: tuple
    galaxy_scale: np.ndarray
    agn_scale: np.ndarray
    mixed_galaxy: np.ndarray
    mixed_agn: np.ndarray
    shape: ShapeQuantities
    fraction: OtherFraction | None

    @classmethod
    def of_grid(cls, grid):
        """
        Collect the quantities of a model grid.

        All columns of its property tables are taken. A column of both tables (``ir_luminosity``)
        gives three quantities: the sum, and the parts ``<name>_galaxy`` and ``<name>_agn``;
        without one, the sum is ``total_luminosity``, dust luminosity and AGN power.
        """
        n_agn = grid.n_agn
        of_galaxy = grid.galaxy_properties
        of_agn = grid.agn_properties
        shared = []
        if n_agn:
            shared = [name for name in of_galaxy.colnames if name in of_agn.colnames]
        # name, unit and meaning of each
        quantities = [("mass", MASS, FORMED_TEXT)]
        galaxy_scale = [np.ones(grid.n_galaxies)]
        agn_scale = []
        mixed_galaxy = grid.dust_luminosity
        mixed_agn = np.ones(n_agn)
        mixed = ("total_luminosity", LUMINOSITY, "dust luminosity and AGN power")
        for column in of_galaxy.itercols():
            name = column.info.name
            text = _text(column, ", for one solar mass formed")
            values, unit = _in_watt(column)
            quantities.append((_part_name(name, "galaxy", shared), unit, text))
            galaxy_scale.append(values)
            if name in shared[:1]:
                mixed = (name, LUMINOSITY, f"{text}; and of the AGN")
                mixed_galaxy = values
        agn_columns = []
        if n_agn:
            agn_columns = list(of_agn.itercols())
        for column in agn_columns:
            name = column.info.name
            unit = unit_of(column)
            if unit == u.dimensionless_unscaled:
                unit = LUMINOSITY
            else:
                unit = unit * LUMINOSITY
            text = _text(column, ", W for each W of AGN power")
            quantities.append((_part_name(name, "agn", shared), unit, text))
            agn_scale.append(column_values(column))
            if name in shared[:1]:
                mixed_agn = agn_scale[-1]
        columns = list(grid.galaxy_shape.itercols())
        of_shape = [(c.info.name, unit_of(c), _text(c, "")) for c in columns]
        fraction = OtherFraction.of_grid(grid)
        quantities.append(mixed)
        quantities += of_shape
        if fraction is not None:
            text = FRACTIONS[fraction.name][0]
            quantities.append((fraction.name, u.dimensionless_unscaled, text))
        values = np.array([column_values(c) for c in columns], float).reshape(
            len(columns), grid.n_galaxies
        )
        names, units, descriptions = zip(*quantities, strict=True)
        return cls(
            names,
            units,
            descriptions,
            np.array(galaxy_scale),
            np.array(agn_scale, float).reshape(len(agn_scale), n_agn),
            np.array(mixed_galaxy, float),
            np.array(mixed_agn, float),
            ShapeQuantities(tuple(column.info.name for column in columns), values),
            fraction,
        )

    @property
    def intensive(self):
        """Names of those that do not scale with mass."""
        return self.names[len(self.galaxy_scale) + len(self.agn_scale) + 1 :]

    def summarize(self, out):
        """Compute moments and quantiles of all quantities, from the sums of the grid engine for n objects."""
        moments, quantiles = self.shape.summarize(out.galaxy, DERIVED_LEVELS)
        parts = [(out.moments, out.quantiles), (moments, quantiles)]
        if self.fraction is not None:
            share = np.column_stack([out.share, nans(len(out.share))])
            parts.append((share[:, None], out.share_quantiles[:, None]))
        return tuple(np.concatenate(part, axis=1) for part in zip(*parts, strict=True))

    def evaluate(self, name, grid, g, k, frac, scale):
        """
        Evaluate a quantity for single models: galaxies, AGN templates, fractions and scales.

        Indices and numbers have one shape, and the values have it too; a scale of NaN gives NaN.
        """
        i = self.names.index(name)
        n = len(self.galaxy_scale)
        fraction = self.fraction
        if i < n:
            return scale * self.galaxy_scale[i][g]
        # no value where there is no model
        if name in self.shape.names:
            values = self.shape.values[self.shape.names.index(name)][g]
            return np.where(np.isfinite(scale), values, np.nan)
        if fraction is not None and name == fraction.name:
            y = frac / (1.0 - frac) * fraction.galaxy[g] * fraction.agn[k]
            return np.where(np.isfinite(scale), y / (1.0 + y), np.nan)
        power = scale * frac / (1.0 - frac) * grid.dust_luminosity[g]
        if i < n + len(self.agn_scale):
            return power * self.agn_scale[i - n][k]
        mixed = scale * self.mixed_galaxy[g]
        if self.mixed_agn.size:
            return mixed + power * self.mixed_agn[k]
        return mixed


def _part_name(name, part, shared):
    """Return what a quantity of galaxies or AGN is called, if those that both have are shared."""
    if name in shared:
        return f"{name}_{part}"
    return name


def _text(column, ending):
    text = getattr(column.info, "description", None) or column.info.name
    return text.removesuffix(ending)


def _in_watt(column):
    """Return the values of a column for each solar mass, and the unit of the total: W of luminosities."""
    unit = unit_of(column) * MASS
    if not unit.is_equivalent(LUMINOSITY):
        return column_values(column), unit
    return column_values(column) * unit.to(LUMINOSITY), LUMINOSITY
