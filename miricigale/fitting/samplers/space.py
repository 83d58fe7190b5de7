"""Priors of continuous parameters: from the unit cube to values."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.integrate import cumulative_trapezoid

from miricigale.fitting.data.likelihood import FitFlags
from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.fitting.posterior.priors import integrals_to, known_redshifts, read_density
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import without
from miricigale.utils.options import check_names, check_that
from miricigale.utils.units import are_not_negative
from miricigale.utils.values import value_class

#: Part of a prior without limits that may lie outside the cells of its axis.
_TAIL = 1e-3


@dataclass(frozen=True)
class Flat:
    """Flat from ``low`` to ``high``."""

    low: float
    high: float

    def transform(self, unit):
        """Return the values at which the cumulative prior is ``unit``."""
        return self.low + unit * (self.high - self.low)

    def cdf(self, value):
        """Return the cumulative prior."""
        return np.clip((value - self.low) / (self.high - self.low), 0.0, 1.0)

    @property
    def bounds(self):
        """Limits of the outermost cells."""
        return (self.low, self.high)

    def nodes(self, n):
        """Return the middles of n cells."""
        return self.transform((np.arange(n) + 0.5) / n)

    def cells(self, n):
        """Return nodes of n cells (or the prior's own values), their weights, and the limits of the outermost."""
        nodes = self.nodes(n)
        bounds = self.bounds
        total = self.cdf(cell_edges(nodes, bounds)[1:-1])
        return nodes, np.diff(np.concatenate([[0.0], total, [1.0]])), bounds

    def __str__(self):
        return f"flat from {self.low:g} to {self.high:g}"


class Log(Flat):
    """Flat in the logarithm from ``low`` to ``high``."""

    def transform(self, unit):
        """Return the values at which the cumulative prior is ``unit``."""
        # even steps in the logarithm
        return self.low * (self.high / self.low) ** np.asarray(unit)

    def cdf(self, value):
        """Return the cumulative prior."""
        value = np.clip(value, self.low, self.high)
        return np.log(value / self.low) / np.log(self.high / self.low)

    def __str__(self):
        return f"flat in log from {self.low:g} to {self.high:g}"


@value_class
class Choice:
    """These values only, ascending, with weights that sum to 1."""

    values: np.ndarray
    weights: np.ndarray

    def transform(self, unit):
        """Return the values at which the cumulative prior reaches ``unit``."""
        place = np.searchsorted(np.cumsum(self.weights), unit, side="right")
        return self.values[np.minimum(place, self.values.size - 1)]

    @property
    def bounds(self):
        """The first and the last value."""
        return (self.values[0], self.values[-1])

    def cells(self, n):
        """Return the values, whatever n, their weights and limits, as `Flat` does."""
        return self.values, self.weights, (-np.inf, np.inf)

    def __str__(self):
        return f"one of {', '.join(f'{v:g}' for v in self.values)}"


@value_class
class Continuous(Flat):
    """A distribution of `scipy.stats`, cut to ``low`` and ``high``."""

    law: object

    @property
    def _ends(self):
        return self.law.cdf(self.low), self.law.cdf(self.high)

    def transform(self, unit):
        """Return the values at which the cumulative prior is ``unit``."""
        first, last = self._ends
        return np.clip(self.law.ppf(first + unit * (last - first)), self.low, self.high)

    def cdf(self, value):
        """Return the cumulative prior."""
        first, last = self._ends
        return np.clip((self.law.cdf(value) - first) / (last - first), 0.0, 1.0)

    def nodes(self, n):
        """Return the middles of n cells: even, or even in the logarithm if they span more than a factor 30."""
        low, high = self.transform(np.array([_TAIL, 1.0 - _TAIL]))
        if 0 < 30 * low < high:
            return Log(low, high).nodes(n)
        return Flat(low, high).nodes(n)

    def __str__(self):
        law = getattr(getattr(self.law, "dist", None), "name", type(self.law).__name__)
        return f"{law} of mean {self.law.mean():g}, std {self.law.std():g}"


@value_class
class Table:
    """A density given at nodes and linear between them, such as p(z)."""

    value: np.ndarray
    density: np.ndarray

    @cached_property
    def _total(self):
        return cumulative_trapezoid(self.density, self.value, initial=0)

    @property
    def bounds(self):
        """The first and the last node."""
        return (self.value[0], self.value[-1])

    def nodes(self, n):
        """Return the middles of n equal cells."""
        return Flat(*self.bounds).nodes(n)

    cells = Flat.cells

    @property
    def area(self):
        """Integral of the density."""
        return float(self._total[-1])

    def cut(self, low, high):
        """Leave out what lies outside ``low`` and ``high``; None if nothing is left."""
        low = max(low, self.value[0])
        high = min(high, self.value[-1])
        if not low < high:
            return None
        inside = self.value[(self.value > low) & (self.value < high)]
        value = np.concatenate([[low], inside, [high]])
        new = Table(value, np.interp(value, self.value, self.density))
        if new.area > 0:
            return new
        return None

    def transform(self, unit):
        """Return the values at which the cumulative prior is ``unit``."""
        # cell in which the cumulative density reaches the target
        target = np.asarray(unit) * self.area
        i = np.clip(np.searchsorted(self._total, target, side="right") - 1, 0, self.value.size - 2)
        first = self.density[i]
        last = self.density[i + 1]
        width = self.value[i + 1] - self.value[i]
        remainder = target - self._total[i]
        # the root of first t + (last - first) t^2 / (2 width) = rest that stays finite
        root = np.sqrt(np.maximum(first**2 + 2.0 * remainder * (last - first) / width, 0.0))
        lower_root = first + root
        step = np.divide(
            2.0 * remainder, lower_root, out=np.zeros_like(remainder), where=lower_root > 0
        )
        return self.value[i] + np.clip(step, 0.0, width)

    def cdf(self, value):
        """Return the cumulative prior."""
        value = np.clip(value, self.value[0], self.value[-1])
        return integrals_to(value, self.value, self.density, self._total) / self.area


def make_prior(name, prior, parameter):
    """
    Make the prior of one parameter, or return its fixed value.

    ``prior`` is given as for `~miricigale.fitting.BayesFitter`, its numbers may be quantities;
    ``parameter`` is the declaration (`~miricigale.sed.Parameter`). A `ValueError` is raised for something else,
    or what lies outside the bounds of the parameter.
    """
    argument = f"priors[{name!r}]"
    if isinstance(prior, str) and prior in ("flat", "log"):
        low, high = parameter.bounds
        return _interval(argument, low, high, prior)
    if hasattr(prior, "ppf") and hasattr(prior, "cdf"):
        low, high = parameter.bounds
        law = Continuous(low, high, prior)
        # weight of the distribution within the bounds of the parameter
        first, last = law._ends
        text = f"with weight from {law.low} to {law.high}"
        check_that(last - first > 0, argument, text, str(law))
        return law
    if not isinstance(prior, tuple) and np.ndim(prior) == 1:
        return _choice(argument, prior, np.ones(len(prior)), parameter)
    pair = isinstance(prior, tuple) and len(prior) == 2
    if pair and np.ndim(prior[0]) == np.ndim(prior[1]) == 1:
        values, weights = prior
        return _choice(argument, values, weights, parameter)
    try:
        if pair or (isinstance(prior, tuple) and len(prior) == 3 and prior[2] in ("log", "flat")):
            low, high, kind = (*prior, "flat")[:3]
            return _interval(argument, parameter.check(low), parameter.check(high), kind)
        if not isinstance(prior, (tuple, str)):
            return parameter.check(prior)
    except TypeError:
        pass
    wanted = "(low, high), (low, high, 'log'), 'flat', 'log', values, a distribution or a number"
    raise argument_error(argument, wanted, repr(prior))


def _interval(argument, low, high, kind):
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise argument_error(argument, "(low, high), finite and ascending", f"({low}, {high})")
    if kind == "log":
        check_that(low > 0, argument, "above 0 if it is flat in the logarithm", low)
        return Log(low, high)
    return Flat(low, high)


def _choice(argument, values, weights, parameter):
    values = [parameter.check(value) for value in values]
    weights = floats(weights)
    text = f"a weight for each of {len(values)} values"
    check_that(weights.shape == (len(values),), argument, text, f"shape {weights.shape}")
    good = are_not_negative(weights) and weights.sum() > 0
    check_that(good, argument, "weights that are finite, >= 0 and not all 0", weights)
    # values ascend, as nodes of an axis do
    order = np.argsort(values)
    values = np.array(values)[order]
    weights = weights[order]
    check_that(np.all(np.diff(values) != 0), argument, "different values", values)
    if values.size == 1:
        return float(values[0])
    return Choice(values, weights / weights.sum())


@value_class
class Space:
    """The parameters of a fit by name: some free, with priors of this module, the others fixed."""

    free: dict
    fixed: dict

    @classmethod
    def of_model(cls, model, priors):
        """Take the priors of the parameters of a model; parameters without are at their defaults."""
        declared = model.parameters
        check_names(priors, "parameter", declared)
        prior_of = {name: make_prior(name, priors[name], declared[name]) for name in priors}
        free_priors = {}
        constants = {}
        for name, parameter in declared.items():
            prior = prior_of.get(name, parameter.default)
            if name in prior_of and not isinstance(prior, float):
                free_priors[name] = prior
            else:
                constants[name] = prior
        return cls(free_priors, constants)

    def with_redshift(self, prior):
        """Copy in which the redshift has another prior, or a value."""
        free_priors = without(self.free, ["redshift"])
        constants = without(self.fixed, ["redshift"])
        if isinstance(prior, float):
            constants["redshift"] = prior
        else:
            free_priors["redshift"] = prior
        return replace(self, free=free_priors, fixed=constants)

    @property
    def n_dim(self):
        """Number of free parameters."""
        return len(self.free)

    def at_redshifts(self, limits, photometry, redshift, flags):
        """Make copies with the redshift of every object, within ``limits``; unusable ones are flagged."""
        values = known_redshifts(photometry, redshift)
        missing = np.isnan(values)
        low, high = limits
        outside = ~missing & ~((values >= low) & (values <= high))
        flags[missing] |= FitFlags.NO_REDSHIFT
        flags[outside] |= FitFlags.REDSHIFT_OUTSIDE
        good = np.where(missing | outside, 0.5 * (low + high), values)
        return [self.with_redshift(float(z)) for z in good]

    def with_densities(self, limits, redshift_prior, flags):
        """
        Make copies with the prior of redshift of every object (`read_density`), cut to ``limits``.

        A prior that leaves nothing is flagged.
        """
        nodes, density = read_density(redshift_prior, len(flags))
        low, high = limits
        out = []
        for row, heights in enumerate(np.broadcast_to(density, (len(flags), nodes.size))):
            prior = None
            if np.isfinite(heights).all():
                prior = Table(nodes, np.array(heights)).cut(low, high)
            if prior is None:
                flags[row] |= FitFlags.NO_MODEL
                prior = Flat(low, high)
            out.append(self.with_redshift(prior))
        return out

    def values(self, points):
        """Convert points of the unit cube, shape (m, n_dim), to parameters by name, fixed ones included."""
        out = {name: np.full(len(points), value) for name, value in self.fixed.items()}
        for i, (name, prior) in enumerate(self.free.items()):
            out[name] = prior.transform(points[:, i])
        return out


def redshift_axis(spaces, limits, n):
    """
    Make the cells of redshift (see `Flat.cells`) for objects that may each have a prior or a redshift.

    The weights are the mean prior of the objects.
    """
    priors = [space.free["redshift"] for space in spaces if "redshift" in space.free]
    if not priors:
        values = [space.fixed["redshift"] for space in spaces] or [0.0]
        low = min(values)
        high = max(values)
        if high > low:
            return Flat(low, high).cells(n)
        return np.array([low]), np.ones(1), (low, low)
    if all(prior is priors[0] for prior in priors):
        return priors[0].cells(n)
    tables = [prior for prior in priors if isinstance(prior, Table)]
    lowest, highest = limits
    if tables:
        lowest = min(table.bounds[0] for table in tables)
        highest = max(table.bounds[1] for table in tables)
    nodes, _, bounds = Flat(lowest, highest).cells(n)
    edges = cell_edges(nodes, bounds)
    # without tables the priors are flat within the limits, and so is their mean
    cdf = np.mean([table.cdf(edges) for table in tables] or [edges], axis=0)
    return nodes, np.diff(cdf) / (cdf[-1] - cdf[0]), bounds
