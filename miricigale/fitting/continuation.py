"""
Grids with what lies between their nodes, and the posteriors of objects there.

A population of models begins as draws from models that fill the prior, by a power of the likelihood. From there it
is led to the likelihood in steps, at each of which it is weighed, resampled and moved (sequential Monte Carlo: Del
Moral et al. 2006, JRSS B 68, 411), along differences of members (ter Braak 2006, Stat. Comput. 16, 239; in some
parameters at a time: Vrugt et al. 2009, Int. J. Nonlin. Sci. Num. Sim. 10, 273).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import qmc

from miricigale.fitting import _core
from miricigale.fitting.grid import GridEngine
from miricigale.fitting.interpolation import InterpolatedModels, grid_models
from miricigale.fitting.posterior import cell_edges
from miricigale.fitting.samplers.run import systematic_draws
from miricigale.utils.random import stream
from miricigale.utils.units import Frozen

#: Models that fill the prior, as a power of 2: of all redshifts, and of that of an object.
_LIBRARY, _AT_REDSHIFT = 17, 13
#: Moves of each member at every step; how often they are kept under the likelihood itself, and moves before that.
_MOVES, _KEPT, _NEXT = 10, 6, 14
#: Part of a population that the weights of a step may leave effective.
_EFFECTIVE = 0.9
#: Every so many of the kept say how likely a band is wrong.
_SOME = 4


@dataclass(frozen=True, eq=False)
class Continuation(Frozen):
    """
    A grid with what lies between its nodes; picklable.

    Parameters
    ----------
    engine : `~miricigale.fitting.grid.GridEngine`
        Its models and priors.
    models : `~miricigale.fitting.interpolation.InterpolatedModels`
        Models between its nodes.
    agn_error : float
        Error of the AGN's light as a part of it.
    """

    engine: GridEngine
    models: InterpolatedModels
    agn_error: float = 0.0

    @cached_property
    def cells(self):
        """Edges of the cells around nodes of redshift, AGN fraction, axes of galaxies and of AGN: dict by name."""
        out = {}
        for name in self.models.parameters:
            axis = self.engine.priors.axes.get(name)
            values = self.engine.grid.frac_agn if axis is None else axis.values
            out[name] = cell_edges(values)
            # none beyond the outermost
            out[name][[0, -1]] = values[[0, -1]]
        return out

    @cached_property
    def space(self):
        """`_core.Space` of the cells."""
        size = np.array([len(e) - 1 for e in self.cells.values()], np.int64)
        edge, log_prior = np.zeros((len(size), max(size) + 1)), np.zeros((len(size), max(size)))
        for i, (name, edges) in enumerate(self.cells.items()):
            edge[i, : len(edges)] = edges
            axis = self.engine.priors.axes.get(name)
            if axis is not None and axis.kind in ("frac_agn", "agn"):
                none = np.full(size[i], _core.NEVER)
                log_prior[i, : size[i]] = np.log(axis.weights, where=axis.weights > 0, out=none)
        axes = self.engine.priors.axes
        galaxy = grid_models(axes, "galaxy", self.engine.grid.n_galaxies)
        return _core.Space(size, edge, log_prior, galaxy.ravel(), galaxy.ndim, self.models.light)

    @cached_property
    def library(self):
        """Models that fill the prior: places, (n, n_axes), their fluxes, cells and ln(prior)."""
        return self._filled(qmc.Sobol(len(self.cells), seed=1).random_base2(_LIBRARY), 0.0)

    def _filled(self, x, redshift):
        n, n_bands = len(x), self.engine.galaxy.shape[2]
        made = np.empty((n, n_bands), np.float32), np.empty((n, 2), np.int64), np.empty(n)
        _core.fill_library(self.space, x, redshift, self._work(), *made)
        return x, *made

    def _work(self):
        return self.models.make_work()

    @cached_property
    def _values(self):
        """Values of the models of the grid by kind: dicts by name; of those with several values the first."""
        out = {}
        axes = self.engine.priors.axes
        for kind in ("galaxy", "agn"):
            names = [name for name, axis in axes.items() if axis.kind == kind]
            # of models that stand for several values the first
            first = [axes[name].share.argmax(axis=0) for name in names]
            out[kind] = {name: axes[name].values[i] for name, i in zip(names, first, strict=True)}
        return out

    def at_redshift(self, redshift, node):
        """`GridEngine` of all models of the grid at one redshift; what else depends on it is that of a node."""
        engine, new = self.engine, {"usable": self.engine.usable[node : node + 1]}
        for kind, values in self._values.items():
            z = np.full(getattr(engine, kind).shape[1], redshift)
            if not z.size:
                new[kind] = engine.agn[:1]
            elif kind == "galaxy":
                new[kind] = self.models.galaxy_fluxes(values, z)[None]
            else:
                new[kind] = self.models.agn_fluxes(values, z)[None]
        density, prior = engine.density, engine.mass_prior
        new["template_error"] = engine.template_error[node : node + 1]
        if density is not None:
            new["density"] = replace(density, table=density.table[node : node + 1])
        new["mass_prior"] = prior and (lambda formed, _: prior(formed, [node]))
        return replace(engine, **new)

    def draw(self, n_draws, ids, redshifts, found, i, target, limits, log_usable, wrong):
        """
        Draw models between the nodes from the posterior of an object.

        Parameters
        ----------
        n_draws : int
            Members of the population.
        ids, redshifts : `~numpy.ndarray`, shape (n,)
            Ids of objects, on which alone draws depend, and their redshifts; 0 if these are free.
        found : dict
            Gets, at ``i``, values of parameters, nodes in whose cells these are, and derived quantities (dicts of
            str to arrays), and how likely each band is wrong (None for all if no model is possible), and the part
            of moves of members that were taken.
        i, target, limits, log_usable, wrong
            What `GridEngine.fit` says of the object.
        """
        redshift, rng = float(redshifts[i]), stream(0, "between", str(ids[i]))
        mixture = wrong and self._mixture(*wrong)
        one = _core.Object(target, limits, mixture, log_usable, redshift, self.agn_error)
        free = np.flatnonzero(self.space.size > 1)
        free = free[free > 0] if redshift else free
        state = rng.integers(2**63, size=1, dtype=np.uint64)
        places, *models = self.library
        if redshift:
            places, *models = self._filled(places[: 2**_AT_REDSHIFT], redshift)
        known, work = np.empty((2, len(places))), self._work()
        _core.rate(one._replace(limits=None, mixture=None), *models, known)
        some, power = _next_step(known[1], known[0], 0.0, n_draws, n_draws, rng)
        x, now, kept = places[some], np.empty((n_draws, 5)), []
        by = power * known[1, some]

        def move(power, rounds):
            return _core.move(self.space, one, free, state, power, rounds, x, now, work)

        move(1.0, 0)
        while True:
            by = np.where(now[:, 0] > 0.5 * _core.NEVER, -by, _core.NEVER)
            if np.all(by == _core.NEVER):
                found[i] = None, 0.0
                return
            some, power = _next_step(now[:, 1], by, power, _EFFECTIVE * n_draws, n_draws, rng)
            x, now = x[some], now[some]
            if power == 1.0:
                break
            move(power, _MOVES)
            by = power * now[:, 1]
        taken = 0.0
        for _ in range(_KEPT):
            taken += move(1.0, _NEXT) / (_KEPT * _NEXT * n_draws)
            kept.append(np.hstack([x, now[:, 2:]]))
        found[i] = self._describe(np.concatenate(kept).T, one, wrong, rng), taken

    def _mixture(self, stated, sigma, broad):
        """`_core.Mixture` of an object."""
        used, part = stated.bands, self.engine.mixture.part[stated.bands]
        narrow, wide = np.take(stated.weight, used, axis=1), broad[used]
        odds = part / (1.0 - part) / np.sqrt(narrow) / wide
        # of fluxes in units of the errors without that of templates
        level = 0.5 * np.log(narrow * np.square(sigma[used])).sum(axis=1)
        return _core.Mixture(narrow, wide**-2.0, odds, level, np.zeros(len(broad)))

    def _describe(self, kept, one, wrong, rng):
        *places, scale, variance, power = kept
        values, node, share, rare = {}, {}, None, slice(None, None, _SOME)
        for (name, edges), x in zip(self.cells.items(), places, strict=True):
            y = x * (len(edges) - 1)
            node[name] = np.minimum(y.astype(np.int64), len(edges) - 2)
            values[name] = edges[node[name]] + (y - node[name]) * np.diff(edges)[node[name]]
        if one.redshift:
            values["redshift"] = np.full(len(scale), one.redshift)
        scale = self.engine.drawn_scale(scale, variance, rng)
        if wrong:
            some = {name: value[rare] for name, value in values.items()}
            flux = self.models.fluxes(some, some["redshift"], some["frac_agn"])[0]
            z, flux = 0 if one.redshift else node["redshift"][rare], flux * scale[rare, None]
            share = self.engine.mixture.shares(flux, wrong[0], wrong[2], one.limits, z)
        derived = self.models.describe(values, values["redshift"], power, scale)
        return values, node, derived, share


def _next_step(like, log, power, wanted, n, rng):
    """
    Draw n of some models by a weight of exp(log + power * like), the power being the largest that leaves enough.

    That is an effective number ``wanted``; the power grows in any case, to 1 at most. Returned are the models,
    shape (n,), and the power.
    """
    # some of many say how wide the likelihood is
    few = slice(None, None, max(len(like) // 8192, 1))
    part = wanted * len(like[few]) / len(like)

    def weight(to, some=slice(None)):
        value = log[some] + to * like[some]
        return np.exp(np.maximum(value - value.max(), -700.0))

    def enough(to):
        w = weight(to, few)
        return np.sum(w) ** 2 >= part * np.sum(w * w)

    low, high = max(power, 1e-4), 1.0
    for _ in range(0 if enough(1.0) else 10):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    power = 1.0 if enough(1.0) else min(1.02 * low, 1.0)
    return systematic_draws(weight(power), n, rng), power
