"""
Models between the nodes of a grid, interpolated from the nodes around them.

Logarithms of fluxes and of what is derived from models are parabolas through three nodes of each parameter
(products of those of all parameters), on a scale of the parameter on which they are nearly straight. That of flux
times z^2, without the distance at low redshift, is linear in ln(1 + z) between two redshifts. AGN fraction and
mass enter in closed form. Nothing is said of what lies beyond the outermost nodes.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property, partial

import numpy as np
from astropy.table import QTable

from miricigale.fitting import _core
from miricigale.fitting.priors import grid_priors
from miricigale.fitting.quantities import Quantities
from miricigale.sed import ModelFlags
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import MASS

#: Powers of a parameter that may be its scale; those below 0 with the sign changed.
_POWERS = (1.0, 0.5, 0.1, -0.5)
#: Fluxes below this part of a model's brightest band are interpolated as if they were it.
_DARK = 1e-12
#: Fluxes below this part of it are not compared with the chain.
_FAINT = 1e-6
#: Least of what is interpolated in the logarithm.
_TINY = 1e-290
#: Largest ln of a number.
_LARGE = 690.0
#: Largest change of ln flux from the nearest node that is followed.
_STEEP = 5.0
#: Errors count up to this: fluxes that change by more between nodes are faint.
_MOST = 0.1
#: Rms error of interpolated ln flux along an axis of a finer grid, and the bytes that its table may fill.
_TOLERANCE, _LARGEST = 0.005, 1 << 27
#: Most times that the cells of an axis are halved.
_HALVINGS = 4


@dataclass(frozen=True, eq=False)
class Scale:
    """Nodes of an axis, and the power of the parameter on which models are nearest to straight."""

    values: np.ndarray
    power: float = 1.0

    @cached_property
    def scaled(self):
        """The nodes on the scale."""
        return _scaled(self.values, self.power)

    def around(self, value):
        """Nodes nearest to values, first of the three around, both (n,), and the weights of these, (n, 3)."""
        node = np.searchsorted(0.5 * (self.values[1:] + self.values[:-1]), value, side="right")
        n, x = self.values.size, _scaled(value, self.power)
        first = np.clip(node - 1, 0, max(n - 3, 0))
        out = np.zeros((len(x), 3))
        used = range(min(n, 3))
        for i in used:
            out[:, i] = 1.0
            for j in used:
                if j != i:
                    a, b = self.scaled[first + i], self.scaled[first + j]
                    out[:, i] *= (x - b) / (a - b)
        return node, first, out


@dataclass(frozen=True, eq=False)
class Place:
    """Where n models lie between the nodes: dicts by name of axis."""

    near: dict  # nearest nodes
    weights: dict  # first of the nodes around, and their weights
    redshift: np.ndarray
    between: tuple  # nodes of redshift, the others, and the part of the way to those


def rows_of(value, some):
    """Some rows of an array, or of all arrays in a dict, a sequence or a dataclass."""
    if isinstance(value, np.ndarray):
        return value[some]
    if isinstance(value, dict):
        return {name: rows_of(one, some) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return tuple(rows_of(one, some) for one in value)
    return type(value)(*(rows_of(getattr(value, item.name), some) for item in fields(value)))


@dataclass(frozen=True, eq=False)
class Kind:
    """Galaxies or AGN: their axes, the model of each combination of values, and what is interpolated."""

    names: tuple
    model: np.ndarray  # (n_1, n_2, ...), -1 where there is none
    flux: np.ndarray  # (nz, n_models, nb): ln(flux z^2)
    rows: np.ndarray  # (1, n_models, n_rows): ln where lit
    lit: np.ndarray  # (n_rows,): which have a logarithm

    @classmethod
    def of_axes(cls, axes, redshift, flux, rows):
        """Of n models with fluxes (nz, n, nb) and other numbers (n_rows, n)."""
        n = flux.shape[1]
        model = np.full([a.values.size for a in axes], -1 if axes else 0)
        for i in range(n) if axes else ():
            # a model without effect of a parameter stands for all its values
            model[np.ix_(*(np.flatnonzero(a.share[:, i] > 0) for a in axes))] = i
        top = flux.max(axis=-1, keepdims=True, initial=0.0)
        flux = np.log(np.maximum(flux, np.maximum(_DARK * top, _TINY)))
        flux += _two_ln(redshift)[:, None, None]
        rows = np.array(rows, float).reshape(len(rows), n)
        lit = np.all(rows > 0, axis=1)
        with np.errstate(divide="ignore"):
            rows = np.where(lit[:, None], np.log(rows), rows)
        return cls(tuple(a.name for a in axes), model, flux, rows.T[None].copy(), lit)

    def models(self, node):
        """Models of nodes, -1 where there is none."""
        return self.model[tuple(node[name] for name in self.names)] + 0 * node["redshift"]

    def fluxes(self, place):
        """Interpolated fluxes, shape (n, nb)."""
        z, other, part = place.between
        ln = self._sum(self.flux, place, z, other, part)
        here = self.flux[place.near["redshift"], np.maximum(self.models(place.near), 0)]
        ln = here + np.clip(ln - here, -_STEEP, _STEEP)
        return np.exp(ln - _two_ln(place.redshift)[:, None])

    def at_redshift(self, redshift, between, models):
        """Fluxes of some of the models at a redshift: (1, n, nb)."""
        z, other, part = between
        ln = (1.0 - part) * self.flux[z, models] + part * self.flux[other, models]
        return np.exp(ln - _two_ln(redshift))[None]

    def values(self, place, rows=slice(None)):
        """Interpolated rows, shape (n_rows, n)."""
        out = self.numbers(np.ascontiguousarray(self.rows[:, :, rows]), place)
        lit = self.lit[rows][:, None]
        return np.where(lit, np.exp(np.clip(out, -_LARGE, _LARGE)), np.maximum(out, 0.0))

    def numbers(self, table, place):
        """Interpolate a table of models at all redshifts, (1, n_models, n_rows), as it is: (n_rows, n)."""
        z = np.zeros_like(place.between[0])
        return self._sum(table, place, z, z, np.zeros(z.size)).T

    @cached_property
    def _around(self):
        """Steps from one value of each axis to the next, and choices of one of three nodes with their offsets."""
        shape = np.array(self.model.shape, np.int64)
        stride = np.array([shape[a + 1 :].prod() for a in range(shape.size)], np.int64)
        few = np.minimum(shape, 3)
        choice = np.indices(few).reshape(shape.size, few.prod()).T.astype(np.int64)
        return stride, choice, choice @ stride

    def _sum(self, table, place, z, other, part):
        n, (stride, choice, offset) = z.size, self._around
        first, weight = np.zeros(n, np.int64), np.zeros((n, len(self.names), 3))
        for a, name in enumerate(self.names):
            node, weight[:, a] = place.weights[name]
            first += node * stride[a]
        out, model = np.empty((n, table.shape[2])), self.model.ravel()
        _core.sum_nodes(table, z, other, part, model, first, choice, offset, weight, out)
        return out

    def bends(self, name, x):
        """
        How far middle nodes of an axis are off the straight lines between their neighbors on a scale ``x``.

        Of ln flux but for a factor, shape (m, nb), and of what else is interpolated, (m, n_rows).
        """
        table = np.moveaxis(self.model, self.names.index(name), 0).reshape(x.size, -1)
        out = []
        for numbers in (self.flux[len(self.flux) // 2], self.rows[0][:, self.lit]):
            parts = []
            for i, t in enumerate((x[1:-1] - x[:-2]) / (x[2:] - x[:-2])):
                low, here, high = table[i : i + 3, (table[i : i + 3] >= 0).all(axis=0)]
                parts.append(numbers[here] - (1.0 - t) * numbers[low] - t * numbers[high])
            out.append(np.concatenate(parts))
        return less_factor(out[0]), out[1]

    def steps(self, name):
        """Half of the change of ln flux, but for a factor, between neighbors: (m, nb)."""
        table = np.moveaxis(self.model, self.names.index(name), 0)
        low, high = table[:-1].ravel(), table[1:].ravel()
        both = (low >= 0) & (high >= 0) & (low != high)
        flux = self.flux[len(self.flux) // 2]
        return 0.5 * less_factor(flux[high[both]] - flux[low[both]])


@dataclass(frozen=True, eq=False)
class Nodes:
    """
    The models of a grid, for models between them; picklable.

    ``axes`` are `~miricigale.fitting.priors.GridAxis` by name, ``kinds`` has a `Kind` of galaxies, whose last row
    is what AGN fractions refer to, and one of AGN; ``allowed``, shape (nz, nG), are galaxies younger than the
    universe.
    """

    axes: dict
    quantities: Quantities
    kinds: dict
    allowed: np.ndarray

    @classmethod
    def of_grid(cls, grid, axes=None):
        """Of a `~miricigale.sed.ModelGrid`, whose axes may be known."""
        axes = grid_priors(grid).axes if axes is None else axes
        known = Quantities.of_grid(grid)
        of = known.fraction
        galaxy = [*known.galaxy_scale, known.mixed_galaxy, np.asarray(grid.dust_luminosity)]
        agn = [*known.agn_scale, known.mixed_agn]
        if of is not None:
            galaxy.insert(-1, of.galaxy)
            agn.append(of.agn)
        kinds = {}
        for kind, flux, rows in (("galaxy", grid.galaxy, galaxy), ("agn", grid.agn, agn)):
            own = [axis for axis in axes.values() if axis.kind == kind]
            kinds[kind] = Kind.of_axes(own, grid.redshift, np.asarray(flux), rows)
        axes = {name: replace(axis, share=None) for name, axis in axes.items()}
        return cls(axes, known, kinds, np.asarray(grid.allowed))

    @property
    def redshift(self):
        """Nodes of redshift."""
        return self.axes["redshift"].values

    @cached_property
    def scales(self):
        """`Scale` of each axis of galaxies and AGN with several values, by name."""
        out = {}
        for name, axis in self.axes.items():
            values, power = axis.values, 1.0
            if axis.kind not in self.kinds or values.size == 1:
                continue
            if values.size > 2 and values[0] >= 0:
                powers = [p for p in _POWERS if p > 0 or values[0] > 0]
                power = min(powers, key=lambda p, axis=axis: self._bent(axis, p))
            out[name] = Scale(values, power)
        return out

    def _bent(self, axis, power):
        bends = self.kinds[axis.kind].bends(axis.name, _scaled(axis.values, power))
        return sum(np.abs(bend).mean() for bend in bends if bend.size)

    def place(self, values, redshift):
        """`Place` of values by name, shape (n,), at redshifts; what has none is at the only node of its axis."""
        near, weights = {}, {}
        for name, axis in self.axes.items():
            near[name] = np.zeros(len(redshift), np.int64)
            if name in self.scales:
                inside = np.clip(values[name], *axis.values[[0, -1]])
                near[name], *weights[name] = self.scales[name].around(inside)
            elif axis.kind in self.kinds:
                weights[name] = near[name], np.tile([1.0, 0.0, 0.0], (len(redshift), 1))
        between = self.between(redshift)
        near["redshift"] = np.where(between[2] > 0.5, between[1], between[0])
        return Place(near, weights, redshift, between)

    def between(self, redshift):
        """Nodes below redshifts, the next ones, and the part of the way to those; beyond the last too."""
        x, nodes = np.log1p(redshift), np.log1p(self.redshift)
        z = np.clip(np.searchsorted(nodes, x) - 1, 0, max(nodes.size - 2, 0))
        if nodes.size == 1:
            return z, z, np.zeros(np.shape(z))
        return z, z + 1, (x - nodes[z]) / np.diff(nodes)[z]

    def possible(self, place):
        """Whether the nearest galaxies exist."""
        galaxy = self.kinds["galaxy"].models(place.near)
        return (galaxy >= 0) & self.allowed[place.near["redshift"], galaxy]

    def fluxes(self, place, frac):
        """Fluxes of one solar mass formed, shape (n, nb), with AGN of given fractions, and their power."""
        galaxy = self.kinds["galaxy"]
        flux, power = galaxy.fluxes(place), np.zeros(len(frac))
        if np.any(frac > 0):
            power = frac / (1.0 - frac) * galaxy.values(place, slice(-1, None))[0]
            flux = flux + power[:, None] * self.kinds["agn"].fluxes(place)
        return flux, power

    def describe(self, place, power, scale):
        """Derived quantities of models of given AGN power and scale: dict by name."""
        known, of = self.quantities, self.quantities.fraction
        galaxy, n, out = self.kinds["galaxy"].values(place), len(known.galaxy_scale), {}
        out.update(zip(known.names, scale * galaxy[:n], strict=False))
        total = scale * galaxy[n]
        if self.kinds["agn"].flux.shape[1]:
            agn, more = self.kinds["agn"].values(place), len(known.agn_scale)
            out.update(zip(known.names[n:], scale * power * agn[:more], strict=False))
            total, n = total + scale * power * agn[more], n + more
            if of is not None:
                odds = np.divide(power, galaxy[-1], out=np.zeros(power.size), where=galaxy[-1] > 0)
                y = odds * galaxy[-2] * agn[-1]
                out[of.name] = y / (1.0 + y)
        out[known.names[n]] = total
        shape = self.kinds["galaxy"].numbers(known.shape.values.T[None].copy(), place)
        out.update(zip(known.shape.names, shape, strict=True))
        return out

    def those_of(self, grid, kind):
        """Which models of a kind are those of a grid with some of the nodes: shape (n_models,)."""
        own, other = self.kinds[kind], grid.kinds[kind]
        pairs = ((self.axes[name].values, grid.axes[name].values) for name in own.names)
        places = [np.abs(mine - theirs[:, None]).argmin(axis=1) for mine, theirs in pairs]
        out = np.zeros(other.flux.shape[1], np.int64)
        if places:
            some = other.model >= 0
            out[other.model[some]] = own.model[np.ix_(*places)][some]
        return out


def finer_grid(model, grid, filters, constants, nodes):
    """
    Nodes of a grid of the same model, with cells halved until interpolation is good to 0.5 % along each axis.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        The model that made the grid.
    grid : `~miricigale.sed.ModelGrid`
    filters : list of str or `~miricigale.filters.FilterSet`
        Bands of the grid.
    constants : dict
        Parameters of the grid with one value.
    nodes : `Nodes`
        Of the grid.

    Returns
    -------
    finer : `Nodes`

    Raises
    ------
    ValueError
        If the model has other fluxes at the nodes of the grid.
    """
    axes = {name: [value] for name, value in constants.items()}
    axes |= {name: np.asarray(grid.axes.get(name, a.values)) for name, a in nodes.axes.items()}
    error = partial(_chain_rms, model, filters, constants, grid.frac_agn)
    if not error(nodes) < 1e-3:
        wanted = "the model that made the grid"
        raise argument_error("finer", wanted, "one with other fluxes at its nodes")
    finer = nodes
    for _ in range(_HALVINGS):
        before = axes
        rms = {name: error(finer, name) for name in ("redshift", *finer.scales)}
        # the worst first, as far as there is memory
        for name in sorted((n for n in rms if rms[n] > _TOLERANCE), key=rms.get, reverse=True):
            halved = axes | {name: np.sort([*axes[name], *_middles(finer, name)])}
            kinds = ("redshift", "galaxy")
            size = [len(halved[n]) for n, a in nodes.axes.items() if a.kind in kinds]
            if 8 * len(filters) * np.prod(size) <= _LARGEST:
                axes = halved
        if axes is before:
            break
        finer = Nodes.of_grid(model.grid(axes, filters))
    return finer


def _chain_rms(model, filters, constants, frac_agn, nodes, name=None, n=300):
    """
    Rms of interpolated ln flux, but for a factor, at random nodes, or anywhere between those of an axis.

    It is compared with the chain, and 0 where the chain has nothing between them.
    """
    rng, known = np.random.default_rng(1), model.parameters
    values = {other: rng.choice(axis.values, n) for other, axis in nodes.axes.items()}
    if name is not None:
        axis = nodes.axes[name].values
        first = rng.integers(max(axis.size - 1, 1), size=n)
        values[name] = axis[first] + rng.random(n) * (np.roll(axis, -1) - axis)[first]
    values |= {other: np.full(n, value) for other, value in constants.items()}
    table = QTable({other: value * known[other].unit for other, value in values.items()})
    table["mass"] = 1.0 * MASS
    true = model.fluxes(table, filters)
    flags = true["flags"]
    if np.any(flags & int(ModelFlags.NOT_IN_LIBRARY)) and name is not None:
        return 0.0
    frac = values.get("frac_agn", np.full(n, frac_agn[0]))
    place = nodes.place(values, values["redshift"])
    flux = nodes.fluxes(place, frac)[0]
    true = np.column_stack([true[band].value for band in true.colnames[: flux.shape[1]]])
    good = np.isfinite(true).all(axis=1)
    top = _FAINT * true[good].max(axis=1, keepdims=True)
    ratio = np.maximum(flux[good], top) / np.maximum(true[good], top)
    return np.sqrt(np.mean(np.minimum(np.abs(less_factor(np.log(ratio))), _MOST) ** 2))


def _middles(nodes, name):
    """Half way between the nodes of an axis."""
    values = nodes.axes[name].values
    if name == "redshift":
        return np.expm1(0.5 * (np.log1p(values[1:]) + np.log1p(values[:-1])))
    return 0.5 * (values[1:] + values[:-1])


def less_factor(change):
    """Changes of ln flux, shape (..., nb), but for a factor."""
    return change - np.median(change, axis=-1, keepdims=True)


def _two_ln(redshift):
    return 2.0 * np.log(np.maximum(redshift, 1e-6))


def _scaled(value, power):
    return np.sign(power) * np.power(value, power) if power != 1.0 else np.asarray(value, float)
