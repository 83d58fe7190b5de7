"""
Models between the nodes of a grid, interpolated from the nodes around them.

Logarithms of fluxes and of what is derived from models are parabolas through three nodes of each parameter
(products of those of all parameters), on a scale of the parameter on which they are nearly straight. That of flux
times z^2, without the distance at low redshift, is linear in ln(1 + z) between two redshifts. AGN fraction and
mass enter in closed form. Nothing is said of what lies beyond the outermost nodes.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from miricigale.fitting import _core
from miricigale.fitting.posterior import cell_edges

__all__ = ["Continuation"]

#: Powers of a parameter that may be its scale; those below 0 with the sign changed.
_POWERS = (1.0, 0.5, 0.1, -0.5)
#: Fluxes below this part of a model's brightest band are interpolated as if they were it.
_DARK = 1e-12
#: Least of what is interpolated in the logarithm.
_TINY = 1e-290
#: Largest ln of a number.
_LARGE = 690.0
#: Largest change of ln flux from the nearest node that is followed.
_STEEP = 5.0
#: Error of interpolated ln flux, as a part of how far the middle of three nodes is off a straight line: of 68 % of
#: models of the chain of Yang et al. 2021 between the nodes of a coarse grid (0.02 to 0.09), but for 24 um.
_INTERPOLATED = 0.25
#: The latter of two nodes, which show no curvature, as a part of their difference: of polar dust at 100, 300 K.
_TWO = 0.25
#: Part of the steps of AGN light that widens errors: some AGN have little light beside the galaxy's.
_OF_AGN = 0.25


@dataclass(frozen=True, eq=False)
class Cells:
    """Nodes of an axis, edges of the cells around them, prior density in each, and the nodes on a scale."""

    values: np.ndarray
    edges: np.ndarray
    density: np.ndarray
    power: float
    scaled: np.ndarray

    def nearest(self, value):
        """Nodes in whose cells values lie."""
        place = np.searchsorted(self.edges, value, side="right") - 1
        return np.clip(place, 0, self.values.size - 1)

    def weights(self, value, node):
        """First of the nodes around values, shape (n,), and the weights of that and the next two, (n, 3)."""
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
        return first, out


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

    def nearest(self, node):
        """Models of nodes, -1 where there is none."""
        return self.model[tuple(node[name] for name in self.names)] + 0 * node["redshift"]

    def fluxes(self, place):
        """Interpolated fluxes, shape (n, nb)."""
        z, other, part = place.between
        ln = self._sum(self.flux, place, z, other, part)
        here = self.flux[z, np.maximum(self.nearest(place.node), 0)]
        ln = here + np.clip(ln - here, -_STEEP, _STEEP)
        return np.exp(ln - _two_ln(place.redshift)[:, None])

    def at_redshift(self, redshift, z, other, part):
        """Fluxes of all models at a redshift, part of the way from a node to another: (1, n_models, nb)."""
        ln = (1.0 - part) * self.flux[z] + part * self.flux[other]
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
        choice = np.indices(np.minimum(shape, 3)).reshape(shape.size, -1).T.astype(np.int64)
        return stride, choice.reshape(-1, shape.size), choice @ stride

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

        Of ln flux but for a factor, shape (m, nb), and of what else is interpolated, (m, n_rows). With two nodes
        it is a part of their difference.
        """
        table = np.moveaxis(self.model, self.names.index(name), 0).reshape(x.size, -1)
        out = []
        for numbers in (self.flux[len(self.flux) // 2], self.rows[0][:, self.lit]):
            if x.size == 2:
                both = table[:, (table >= 0).all(axis=0)]
                out.append(_TWO * (numbers[both[1]] - numbers[both[0]]))
                continue
            parts = []
            for i, t in enumerate((x[1:-1] - x[:-2]) / (x[2:] - x[:-2])):
                low, here, high = table[i : i + 3, (table[i : i + 3] >= 0).all(axis=0)]
                parts.append(numbers[here] - (1.0 - t) * numbers[low] - t * numbers[high])
            out.append(np.concatenate(parts))
        return _less_factor(out[0]), out[1]

    def steps(self, name):
        """Half of the change of ln flux, but for a factor, between neighbors: (m, nb)."""
        table = np.moveaxis(self.model, self.names.index(name), 0)
        low, high = table[:-1].ravel(), table[1:].ravel()
        both = (low >= 0) & (high >= 0) & (low != high)
        flux = self.flux[len(self.flux) // 2]
        return 0.5 * _less_factor(flux[high[both]] - flux[low[both]])


@dataclass(frozen=True, eq=False)
class Place:
    """Values of n models between the nodes, and where they lie; dicts by name."""

    values: dict
    node: dict  # of the cell
    weights: dict  # first of the nodes around, and their weights
    redshift: np.ndarray
    between: tuple  # nodes of redshift, the others, and the part of the way to those
    prior: np.ndarray  # ln of the density

    def rows(self, some):
        """Part of the models."""
        return Place(
            {name: value[some] for name, value in self.values.items()},
            {name: value[some] for name, value in self.node.items()},
            {name: (first[some], w[some]) for name, (first, w) in self.weights.items()},
            self.redshift[some],
            tuple(value[some] for value in self.between),
            self.prior[some],
        )


@dataclass(frozen=True, eq=False)
class Continuation:
    """
    A grid with what lies between its nodes; picklable.

    Parameters
    ----------
    priors : `~miricigale.fitting.priors.GridPriors`
        Its axes and priors.
    quantities, fraction : `Quantities` and `OtherFraction` or None
        What is derived from its models.
    engine : `~miricigale.fitting.grid.GridEngine`
        Its tables.
    """

    priors: object
    quantities: object
    fraction: object
    engine: object

    def __getstate__(self):
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @cached_property
    def kinds(self):
        """`Kind` of galaxies and of AGN: the last row of galaxies is the dust luminosity."""
        known, engine, of = self.quantities, self.engine, self.fraction
        galaxy = [*known.galaxy_scale, known.mixed_galaxy, engine.dust]
        agn = [*known.agn_scale, known.mixed_agn]
        if of is not None:
            galaxy.insert(-1, of.galaxy)
            agn.append(of.agn)
        axes, z = self.priors.axes.values(), self.priors.axes["redshift"].values
        return {
            kind: Kind.of_axes([a for a in axes if a.kind == kind], z, flux, rows)
            for kind, flux, rows in (("galaxy", engine.galaxy, galaxy), ("agn", engine.agn, agn))
        }

    @cached_property
    def cells(self):
        """`Cells` of each axis with several values, by name."""
        out = {}
        for name, axis in self.priors.axes.items():
            values, power = axis.values, 1.0
            if values.size == 1:
                continue
            edges = cell_edges(values)
            edges[[0, -1]] = values[[0, -1]]
            if axis.kind in self.kinds and values.size > 2 and values[0] >= 0:
                powers = [p for p in _POWERS if p > 0 or values[0] > 0]
                power = min(powers, key=lambda p, axis=axis: self._bent(axis, p))
            # redshifts have the priors of the object
            weights = np.ones(values.size) if name == "redshift" else axis.weights
            scaled = np.log1p(values) if name == "redshift" else _scaled(values, power)
            out[name] = Cells(values, edges, weights / np.diff(edges), power, scaled)
        return out

    def _bent(self, axis, power):
        bends = self.kinds[axis.kind].bends(axis.name, _scaled(axis.values, power))
        return sum(np.abs(bend).mean() for bend in bends if bend.size)

    @cached_property
    def errors(self):
        """Rms by band, (nb,), of ln flux but for a factor: from nodes to edges of cells, of interpolation."""
        flux = self.kinds["galaxy"].flux[:, :: max(self.priors.galaxy.size // 100, 1)]
        bends = _less_factor(flux[1:-1] - 0.5 * (flux[:-2] + flux[2:])).reshape(-1, flux.shape[2])
        edge, bent = 0.0, 0.0
        if len(flux) > 1:
            z = len(flux) // 2
            edge = _median(np.square(0.5 * _less_factor(flux[z] - flux[z - 1])))
        if len(flux) > 2:
            bent = np.square(_median(np.abs(bends)))
        for name, cells in self.cells.items():
            of = self.kinds.get(self.priors.axes[name].kind)
            if of is not None:
                part = 1.0 if of is self.kinds["galaxy"] else _OF_AGN
                edge = edge + part * _median(np.square(of.steps(name)))
                bent = bent + np.square(_median(np.abs(of.bends(name, cells.scaled)[0])))
        if "frac_agn" in self.cells:
            edge = edge + self._fraction_step
        none = np.zeros(flux.shape[2])
        return np.sqrt(edge + none), _INTERPOLATED * np.sqrt(bent + none)

    @property
    def _fraction_step(self):
        """Mean square of half the change of ln flux, but for a factor, between AGN fractions, by band."""
        engine, z = self.engine, len(self.engine.galaxy) // 2
        some = slice(None, None, max(self.priors.galaxy.size // 100, 1))
        power = engine.dust[some, None] * engine.frac / np.maximum(1.0 - engine.frac, 1e-12)
        agn = np.median(engine.agn[z], axis=0)
        ln = np.log(engine.galaxy[z, some, None] + power[..., None] * agn + _TINY)
        step = 0.5 * _less_factor(np.diff(ln, axis=1))
        return np.mean(np.square(step), axis=(0, 1))

    def place(self, values, log_prior, free):
        """
        `Place` of values by name, shape (n,); those that have none are at the only node of their axis.

        ``log_prior``, shape (nz,), is that of the redshifts; ``free`` are the names of what has a prior.
        """
        node, weights = {}, {}
        n = len(next(iter(values.values())))
        prior, none = np.zeros(n), np.zeros(n, np.int64)
        for name in self.priors.axes:
            if name not in values:
                node[name] = none
                continue
            value, cells = values[name], self.cells[name]
            node[name] = i = cells.nearest(value)
            if name not in ("redshift", "frac_agn"):
                inside = np.clip(value, *cells.values[[0, -1]])
                weights[name] = cells.weights(inside, i)
            if name in free:
                prior += np.log(np.maximum(cells.density[i], _TINY))
                prior[(value < cells.edges[0]) | (value > cells.edges[-1])] = -np.inf
        z = self.priors.axes["redshift"].values
        redshift, between = np.full(n, z[0]), (none, none, np.zeros(n))
        if "redshift" in values:
            redshift = values["redshift"]
            if "redshift" in free:
                redshift = np.clip(redshift, z[0], z[-1])
            between = self._between(redshift)
        prior += log_prior[node["redshift"]]
        galaxy = self.kinds["galaxy"].nearest(node)
        prior[(galaxy < 0) | ~self.engine.usable[node["redshift"], galaxy]] = -np.inf
        return Place(values, node, weights, redshift, between, prior)

    def _between(self, redshift):
        """Nodes below redshifts, the next ones, and the part of the way to those; beyond the last too."""
        x, nodes = np.log1p(redshift), np.log1p(self.priors.axes["redshift"].values)
        z = np.clip(np.searchsorted(nodes, x) - 1, 0, nodes.size - 2)
        return z, z + 1, (x - nodes[z]) / np.diff(nodes)[z]

    def at_redshift(self, redshift, node):
        """`GridEngine` of all models at one redshift; what else depends on it is that of a node."""
        engine, between = self.engine, self._between(redshift)
        template = engine.template_error
        galaxy, agn = (self.kinds[k].at_redshift(redshift, *between) for k in ("galaxy", "agn"))
        return replace(
            engine,
            galaxy=galaxy,
            agn=agn,
            usable=engine.usable[node : node + 1],
            template_error=None if template is None else template[node : node + 1],
        )

    def fluxes(self, place):
        """Fluxes of one solar mass formed, shape (n, nb), and the AGN's power."""
        galaxy = self.kinds["galaxy"]
        flux, power = galaxy.fluxes(place), np.zeros(len(place.prior))
        if self.engine.agn.shape[1]:
            frac = place.values.get("frac_agn", self.engine.frac[place.node["frac_agn"]])
            odds = frac / np.maximum(1.0 - frac, 1e-12)
            power = odds * galaxy.values(place, slice(-1, None))[0]
            flux = flux + power[:, None] * self.kinds["agn"].fluxes(place)
        return flux, power

    def at_nodes(self, place, engine):
        """Fluxes at the nodes in whose cells models lie, by an engine of all redshifts or of one."""
        galaxy, node = np.maximum(self.kinds["galaxy"].nearest(place.node), 0), place.node
        z = node["redshift"] if len(engine.galaxy) > 1 else 0 * galaxy
        flux = engine.galaxy[z, galaxy]
        if engine.agn.shape[1]:
            frac = engine.frac[node["frac_agn"]]
            power = engine.dust[galaxy] * frac / np.maximum(1.0 - frac, 1e-12)
            flux = flux + power[:, None] * engine.agn[z, self.kinds["agn"].nearest(node)]
        return flux

    def describe(self, place, power, scale):
        """Values of parameters and derived quantities of models of given scales: dicts by name."""
        axes, known, of = self.priors.axes, self.quantities, self.fraction
        values = {n: place.values.get(n, a.values[place.node[n]]) for n, a in axes.items()}
        galaxy, n, out = self.kinds["galaxy"].values(place), len(known.galaxy_scale), {}
        out.update(zip(known.names, scale * galaxy[:n], strict=False))
        total = scale * galaxy[n]
        if self.engine.agn.shape[1]:
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
        return values, out


def _two_ln(redshift):
    return 2.0 * np.log(np.maximum(redshift, 1e-6))


def _scaled(value, power):
    return np.sign(power) * np.power(value, power) if power != 1.0 else np.asarray(value, float)


def _median(numbers):
    return np.median(numbers, axis=0) if len(numbers) else 0.0


def _less_factor(change):
    return change - np.median(change, axis=-1, keepdims=True)
