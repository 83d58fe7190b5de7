"""Grids with what lies between their nodes: the prior there, and models that a finer grid may have."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from miricigale.fitting.grid import GridEngine
from miricigale.fitting.interpolation import Nodes, Place, less_factor
from miricigale.fitting.posterior import cell_edges

#: Least flux, and least part of a prior.
_TINY, _LEAST = 1e-290, 1e-9
#: Part of the steps of AGN light that widens errors: some AGN have little light compared with the galaxy's.
_OF_AGN = 0.25


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells around the nodes of an axis, none beyond the outermost: n + 1 edges, and the prior below each."""

    edges: np.ndarray
    below: np.ndarray

    @classmethod
    def of_nodes(cls, values, weights):
        """Around nodes with prior weights."""
        edges = cell_edges(values)
        edges[[0, -1]] = values[[0, -1]]
        return cls(edges, None).with_weights(weights)

    def with_weights(self, weights):
        """Copy with other prior weights of the nodes."""
        total = np.concatenate([[0.0], np.cumsum(weights)])
        return Cells(self.edges, total / total[-1])

    def of(self, value):
        """Nodes in whose cells values lie."""
        place = np.searchsorted(self.edges, value, side="right") - 1
        return np.clip(place, 0, self.edges.size - 2)

    def cumulative(self, node, part):
        """Cumulative prior part of the way through cells of nodes, inside (0, 1)."""
        prior = self.below[node] + part * (self.below[node + 1] - self.below[node])
        return np.clip(prior, _LEAST, 1.0 - _LEAST)

    def value(self, prior):
        """Values at which the cumulative prior is the one given."""
        return np.interp(prior, self.below, self.edges)


@dataclass(frozen=True, eq=False)
class Models:
    """Models between the nodes: values by name, nodes in whose cells they lie, and where among the finer nodes."""

    values: dict
    node: dict
    place: Place
    possible: np.ndarray  # (n,) of bool


@dataclass(frozen=True, eq=False)
class Continuation:
    """
    A grid with what lies between its nodes; picklable.

    Parameters
    ----------
    engine : `~miricigale.fitting.grid.GridEngine`
        Its models and priors.
    nodes, finer : `~miricigale.fitting.interpolation.Nodes`
        Its models, and those of a grid with more nodes between which models are interpolated: of the same, if
        there is none.
    """

    engine: GridEngine
    nodes: Nodes
    finer: Nodes

    @property
    def axes(self):
        """`~miricigale.fitting.priors.GridAxis` of each parameter with several values or a prior, by name."""
        return self.engine.priors.axes

    @cached_property
    def cells(self):
        """`Cells` of each axis with several values, by name."""
        axes = self.axes.items()
        return {n: Cells.of_nodes(a.values, a.weights) for n, a in axes if a.values.size > 1}

    @cached_property
    def errors(self):
        """Rms by band, (nb,), of ln flux, but for a factor, from nodes to edges of cells."""
        flux = self.engine.galaxy[:, self._few]
        steps = (np.square(step) for step in self._steps(flux) if len(step))
        return np.sqrt(sum((np.median(one, axis=0) for one in steps), np.zeros(flux.shape[2])))

    @property
    def _few(self):
        """Some hundred galaxies."""
        return slice(None, None, max(self.engine.grid.n_galaxies // 100, 1))

    @cached_property
    def _same(self):
        """Which of the finer models are those of the grid, by kind."""
        return {kind: self.finer.those_of(self.nodes, kind) for kind in self.finer.kinds}

    def _steps(self, some):
        """Half the changes of ln flux, but for a factor, between nodes: (m, nb) along each axis."""
        engine, z = self.engine, len(some) // 2
        if len(some) > 1:
            low, high = np.log(np.maximum(some[z - 1 : z + 1], _TINY))
            yield 0.5 * less_factor(high - low)
        for name in self.cells:
            kind = self.axes[name].kind
            if kind in self.nodes.kinds:
                part = 1.0 if kind == "galaxy" else np.sqrt(_OF_AGN)
                yield part * self.nodes.kinds[kind].steps(name)
        if "frac_agn" in self.cells:
            frac = engine.grid.frac_agn
            dust = engine.grid.dust_luminosity[self._few, None]
            power = dust * frac / np.maximum(1.0 - frac, 1e-12)
            agn = np.median(engine.agn[z], axis=0)
            ln = np.log(some[z][:, None] + power[..., None] * agn + _TINY)
            steps = 0.5 * less_factor(np.diff(ln, axis=1))
            # where the AGN outshines the galaxy few steps do
            yield np.sqrt(np.mean(np.square(steps), axis=(0, 1)))[None]

    def models(self, values):
        """`Models` of values by name, shape (n,), some of which may be missing: these have the only node."""
        n, axes = len(next(iter(values.values()))), self.axes
        node = {name: np.zeros(n, np.int64) for name in axes}
        node |= {name: self.cells[name].of(value) for name, value in values.items()}
        z = axes["redshift"].values
        place = self.finer.place(values, values.get("redshift", np.full(n, z[0])))
        galaxy = self.nodes.kinds["galaxy"].models(node)
        usable = (galaxy >= 0) & self.engine.usable[node["redshift"], galaxy]
        return Models(values, node, place, usable & self.finer.possible(place))

    def at_redshift(self, redshift, node):
        """`GridEngine` of all models of the grid at one redshift; what else depends on it is that of a node."""
        engine, between = self.engine, self.finer.between(redshift)
        new = {"usable": engine.usable[node : node + 1]}
        for kind, own in self.finer.kinds.items():
            new[kind] = own.at_redshift(redshift, between, self._same[kind])
        if engine.template_error is not None:
            new["template_error"] = engine.template_error[node : node + 1]
        return replace(engine, **new)

    def fluxes(self, models):
        """Fluxes of one solar mass formed, shape (n, nb), and the AGN's power."""
        at_node = self.engine.grid.frac_agn[models.node.get("frac_agn", 0)]
        frac = np.broadcast_to(models.values.get("frac_agn", at_node), models.possible.shape)
        return self.finer.fluxes(models.place, frac)

    def at_nodes(self, models, engine):
        """Fluxes at the nodes in whose cells models lie, by an engine of all redshifts or of one."""
        node, kinds = models.node, self.nodes.kinds
        galaxy = np.maximum(kinds["galaxy"].models(node), 0)
        z = node["redshift"] if len(engine.galaxy) > 1 else 0 * galaxy
        flux = engine.galaxy[z, galaxy]
        if engine.agn.shape[1]:
            frac = engine.grid.frac_agn[node["frac_agn"]]
            power = engine.grid.dust_luminosity[galaxy] * frac / np.maximum(1.0 - frac, 1e-12)
            flux = flux + power[:, None] * engine.agn[z, kinds["agn"].models(node)]
        return flux

    def describe(self, models, power, scale):
        """Values of parameters and derived quantities of models of given scales: dicts by name."""
        axes, node = self.axes, models.node
        values = {name: models.values.get(name, a.values[node[name]]) for name, a in axes.items()}
        return values, self.finer.describe(models.place, power, scale)
