"""
Posteriors between the nodes of a grid: models interpolated from the nodes around.

A population of models begins as draws from the posterior of wider errors on the nodes, each put anywhere in
its node's cell, and is led to the posterior of the true errors in steps of the likelihood, at each of which it is
weighed, resampled and moved (sequential Monte Carlo: Del Moral et al. 2006, JRSS B 68, 411; moves along
differences of members: ter Braak 2006, Stat. Comput. 16, 239). Logarithms of fluxes and of what is derived from
models are parabolas through a node and its neighbors in each parameter, and linear in ln(1 + z).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr, ndtri

from miricigale.fitting.posterior import cell_edges
from miricigale.fitting.quantities import DERIVED_LEVELS
from miricigale.fitting.samplers.run import best_scale, chi2_at
from miricigale.utils.random import stream

__all__ = ["Between"]

#: Fluxes below this part of a model's brightest band are interpolated as if they were it.
_DARK = 1e-12
#: Least of what is interpolated in the logarithm.
_TINY = 1e-290
#: Largest ln of a number.
_LARGE = 690.0
#: Largest change of ln flux between neighbors that is followed.
_STEEP = 5.0
#: Error of interpolated fluxes as a part of the difference to the edge of a cell.
_INTERPOLATED = 0.15
#: Part of the population that the weights of a step may leave effective, and moves in each.
_EFFECTIVE, _MOVES = 0.4, 3
#: Moves under the true errors, and those of them after which the population is kept.
_LAST, _KEPT = 12, (4, 8, 12)


@dataclass(frozen=True, eq=False)
class Between:
    """
    How the posterior of a grid is continued between its nodes; picklable.

    Parameters
    ----------
    grid : `~miricigale.sed.ModelGrid`
        The grid.
    priors : `~miricigale.fitting.priors.GridPriors`
        Its axes and priors.
    quantities, fraction : `Quantities` and `OtherFraction` or None
        What is derived from its models.
    engine : `~miricigale.fitting.grid.GridEngine`
        What sums over the nodes.
    n_draws : int
        Members of the population of each object.
    """

    grid: object
    priors: object
    quantities: object
    fraction: object
    engine: object
    n_draws: int

    def __getstate__(self):
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    # ------------------------------------------------------------------ the grid

    @cached_property
    def _models(self):
        """Of galaxies and of AGN: names of their axes, and the model of each combination of values."""
        out = {}
        for kind, prior in (("galaxy", self.priors.galaxy), ("agn", self.priors.agn)):
            axes = [a for a in self.priors.axes.values() if a.kind == kind]
            model = np.full([a.values.size for a in axes], -1)
            for i in range(prior.size):
                # a model without effect of a parameter stands for all its values
                model[np.ix_(*(np.flatnonzero(a.share[:, i] > 0) for a in axes))] = i
            out[kind] = tuple(a.name for a in axes), model
        return out

    @cached_property
    def _cells(self):
        """Of each axis: edges of its cells, prior density in each, and its values on a scale."""
        out = {}
        for name, axis in self.priors.axes.items():
            if axis.values.size == 1:
                continue
            edges = cell_edges(axis.values, axis.bounds)
            scale = np.log1p if name == "redshift" else self._scale(axis)
            # redshifts have the priors of the object
            weights = np.ones(axis.values.size) if name == "redshift" else axis.weights
            out[name] = edges, weights / np.diff(edges), scale, scale(axis.values)
        return out

    def _scale(self, axis):
        """Logarithm or value of a parameter, that in which ln flux is nearer to linear."""
        if not (axis.kind in ("galaxy", "agn") and axis.values[0] > 0 and axis.values.size > 2):
            return np.asarray
        names, model = self._models[axis.kind]
        table = np.moveaxis(model, names.index(axis.name), 0)
        log = self._log[0][("galaxy", "agn").index(axis.kind)]
        log = log[len(log) // 2]
        found = []
        for scale in (np.asarray, np.log):
            x = scale(axis.values)
            part = (x[1:-1] - x[:-2]) / (x[2:] - x[:-2])
            error = 0.0
            for i, t in enumerate(part):
                low, here, high = (table[i + j].ravel() for j in range(3))
                some = (low >= 0) & (here >= 0) & (high >= 0)
                bent = log[here] - (1.0 - t) * log[low] - t * log[high]
                error += np.sum(_spread(bent[some]))
            found.append((error, scale))
        return min(found, key=lambda one: one[0])[1]

    @cached_property
    def _log(self):
        """Ln of the fluxes of galaxies and AGN, and of everything else that is interpolated."""
        known, engine = self.quantities, self.engine
        galaxy = [*known.galaxy_scale, known.mixed_galaxy, engine.dust]
        agn = [*known.agn_scale, known.mixed_agn]
        if self.fraction is not None:
            galaxy.append(self.fraction.galaxy)
            agn.append(self.fraction.agn)
        rows = (np.array(galaxy), np.array(agn).reshape(len(agn), engine.agn.shape[1]))
        fluxes = (_log_flux(engine.galaxy), _log_flux(engine.agn))
        # what is 0 for some models has no logarithm
        lit = [np.all(row > 0, axis=1) for row in rows]
        with np.errstate(divide="ignore"):
            rows = [
                np.where(some[:, None], np.log(row), row)
                for row, some in zip(rows, lit, strict=True)
            ]
        return fluxes, [*zip(rows, lit, strict=True)]

    @cached_property
    def cell_error(self):
        """Rms difference of ln flux, but for a factor, from nodes to the edges of cells, by band: (nb,)."""
        (galaxy, agn), total = self._log[0], 0.0
        z = len(galaxy) // 2
        for kind, log in (("galaxy", galaxy), ("agn", agn)):
            names, model = self._models[kind]
            for a in range(len(names)):
                table = np.moveaxis(model, a, 0)
                low, high = table[:-1].ravel(), table[1:].ravel()
                both = (low >= 0) & (high >= 0) & (low != high)
                # some AGN have little light beside the galaxy's
                part = 1.0 if kind == "galaxy" else 0.25
                total += part * _spread(log[z, high[both]] - log[z, low[both]])
        if len(galaxy) > 1:
            total += _spread(galaxy[z] - galaxy[z - 1])
        return np.sqrt(total)

    # ------------------------------------------------------------------- objects

    def widened(self, data):
        """Photometry with the errors by which nodes are drawn, and seeds of the draws."""
        more = np.where(data.measured, self.cell_error * np.nan_to_num(data.flux), 0.0)
        seeds = [stream(0, "between", str(key)).integers(2**63) for key in data.ids]
        return data._changed(sigma=np.hypot(data.sigma, more)), np.array(seeds, np.int64)

    def refine(self, data, wide, log_prior, index, seeds, results):
        """
        Results with posteriors, moments and percentiles of models between the nodes.

        ``index``, shape (n, n_draws, 4), are models drawn from the posteriors of ``wide``, with ln(prior)
        of redshifts ``log_prior``.
        """
        names, n = list(results.axes), len(data)
        new = {
            name: np.array(getattr(results, name)) for name in ("pdf_2d", "moments", "quantiles")
        }
        new["pdf"] = {name: np.array(results.pdf[name]) for name in names}
        new["axis_moments"] = np.full((n, len(names), 2), np.nan)
        new["axis_quantiles"] = np.full((n, len(names), DERIVED_LEVELS.size), np.nan)
        for i in np.flatnonzero((index[:, :, 0] >= 0).all(axis=1)):
            rng = np.random.default_rng(int(seeds[i]))
            one = _Object(self, data[i : i + 1], wide.sigma[i], log_prior[i], rng)
            values, node, derived = one.population(index[i])
            m = len(next(iter(values.values())))
            for j, name in enumerate(names):
                pdf = np.bincount(node[name], minlength=results.pdf[name].shape[1]) / m
                new["pdf"][name][i] = pdf
                moments, quantiles = _summary(values[name])
                new["axis_moments"][i, j], new["axis_quantiles"][i, j] = moments[:2], quantiles
            shape = new["pdf_2d"].shape[1:]
            place = node["redshift"] * shape[1] + node.get("frac_agn", 0)
            new["pdf_2d"][i] = np.bincount(place, minlength=shape[0] * shape[1]).reshape(shape) / m
            for j, name in enumerate(results.quantities):
                if name in derived:
                    moments, new["quantiles"][i, j] = _summary(derived[name])
                    # a mean of logarithms is not of every quantity
                    moments[2] *= np.where(np.isfinite(results.moments[i, j, 2]), 1.0, np.nan)
                    new["moments"][i, j] = moments
        return results._changed(**new)


class _Object:
    """The models of one object: a population, its likelihoods and how it moves."""

    def __init__(self, between, data, wide, log_prior, rng):
        self.grid, self.rng, self.log_prior = between, rng, log_prior
        used = data.used[0]
        self.used, self.limit, self.flux = used, data.limit[0][used], data.flux[0][used]
        self.sigma, self.wide = data.sigma[0][used], wide[used]
        # what interpolation is off by
        more = _INTERPOLATED * between.cell_error[used] * np.where(self.limit, 0.0, self.flux)
        self.sigma = np.hypot(self.sigma, more)
        self.free = list(between._cells)
        self.known = np.nan
        if data.redshift is not None and "redshift" in self.free:
            self.known = data.redshift[0]
            self.free.remove("redshift")
            # that of fixed redshifts is 0 at the nearest node alone
            self.log_prior = np.zeros(len(log_prior))

    def population(self, index):
        """Values, nodes and derived quantities of the population under the true errors: dicts."""
        x, at_node = self._begin(index)
        now = self._evaluate(x)
        # from the wider errors at the nodes to these between them, then to the true ones
        weight, step = now["wide"] + now["prior"] - at_node, 0.0
        while True:
            rise = now["true"] - now["wide"]
            weight, step = _next_step(weight, rise, step)
            chosen = _resampled(weight, self.rng)
            x, now = x[chosen], {key: value[chosen] for key, value in now.items()}
            if step == 1.0:
                break
            for _ in range(_MOVES):
                x, now = self._move(x, now, step)
            weight = np.zeros(len(x))
        kept = []
        for i in range(_LAST):
            x, now = self._move(x, now, 1.0)
            if i + 1 in _KEPT:
                kept.append(x)
        return self._describe(np.concatenate(kept))

    def _begin(self, index):
        """Values in the cells of nodes, and 2 ln of the density by which they were drawn."""
        z, g, k, f = index.T
        priors, rng, grid = self.grid.priors.axes, self.rng, self.grid
        node = {"redshift": z, "frac_agn": f}
        for name, axis in priors.items():
            if axis.kind in ("galaxy", "agn"):
                # drawn from the prior where the model has none of its own
                share = np.cumsum(
                    axis.share[:, g if axis.kind == "galaxy" else np.maximum(k, 0)], axis=0
                )
                node[name] = np.sum(rng.random(len(g)) * share[-1] >= share, axis=0)
        x = np.empty((len(z), len(self.free)))
        density = self.log_prior[z].copy()
        for j, name in enumerate(self.free):
            edges, prior, _, _ = grid._cells[name]
            low, high = edges[node[name]], edges[node[name] + 1]
            x[:, j] = low + (high - low) * rng.random(len(z))
            density += np.log(np.maximum(prior[node[name]], _TINY))
        engine = grid.engine
        flux = engine.galaxy[z, g]
        if engine.agn.shape[1]:
            power = engine.dust[g] * engine.frac[f] / (1.0 - engine.frac[f])
            flux = flux + power[:, None] * engine.agn[z, np.maximum(k, 0)]
        return x, density + self._likelihood(flux[:, self.used], z, self.wide)[2]

    def _place(self, x):
        """Nodes of values, neighbors with their parts by axis, and ln(prior density)."""
        node, near = {}, {}
        prior = np.zeros(len(x))
        columns = dict(zip(self.free, x.T, strict=True))
        if np.isfinite(self.known):
            columns["redshift"] = np.full(len(x), self.known)
        for name, axis in self.grid.priors.axes.items():
            if name not in columns:
                node[name] = np.zeros(len(x), int)
                if name == "redshift":
                    prior += self.log_prior[0]
                continue
            value, n = columns[name], axis.values.size
            edges, density, scale, nodes = self.grid._cells[name]
            i = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, n - 1)
            # what lies outside has no prior, and its fluxes no meaning
            inside = np.clip(value, edges[0], edges[-1])
            place = scale(np.maximum(inside, _TINY)) if scale is np.log else scale(inside)
            straight = n == 2 or name == "redshift"
            node[name], near[name] = (
                i,
                _neighbors(nodes, i, place, value >= axis.values[i], straight),
            )
            if name == "redshift":
                prior += self.log_prior[i]
            if name in self.free:
                prior += np.log(np.maximum(density[i], _TINY))
                prior[(value < edges[0]) | (value > edges[-1])] = -np.inf
        return columns, node, near, prior

    def _around(self, kind, node, near):
        """Models of nodes (-1: none), and neighbors with their parts."""
        names, table = self.grid._models[kind]
        here = tuple(node[name] for name in names)
        model = table[here] if names else np.zeros(len(node["redshift"]), int)
        beside = []
        for a, name in enumerate(names):
            for other, part in near.get(name, ()):
                other = table[(*here[:a], other, *here[a + 1 :])]
                beside.append((np.where(other >= 0, other, model), part))
        return model, beside

    def _fluxes(self, placed):
        """Fluxes of models, odds of their AGN, what surrounds them and whether they may be."""
        columns, node, near, _ = placed
        engine, (fluxes, rows) = self.grid.engine, self.grid._log
        z = node["redshift"]
        galaxy = self._around("galaxy", node, near)
        allowed = (galaxy[0] >= 0) & engine.usable[z, galaxy[0]]
        z_step = near["redshift"][0] if "redshift" in near else None
        flux = _between_flux(fluxes[0], z, z_step, *galaxy)[:, self.used]
        dust = _values(*rows[0], *galaxy)[len(self.grid.quantities.galaxy_scale) + 1]
        odds, agn = np.zeros(len(z)), None
        if engine.agn.shape[1]:
            frac = columns.get("frac_agn", engine.frac[node["frac_agn"]])
            odds = frac / np.maximum(1.0 - frac, 1e-12)
            agn = self._around("agn", node, near)
            more = _between_flux(fluxes[1], z, z_step, *agn)[:, self.used]
            flux = flux + (odds * dust)[:, None] * more
        return flux, odds * dust, galaxy, agn, allowed

    def _likelihood(self, flux, z, sigma):
        """Best scales, their variances, and ln(likelihood) but for a constant."""
        template, limit = self.grid.engine.template_error, self.limit
        out = np.empty((3, len(z)))
        for one in np.unique(z) if template is not None else (None,):
            rows = slice(None) if one is None else z == one
            s = sigma
            if one is not None:
                s = np.hypot(sigma, np.where(limit, 0.0, template[one][self.used] * self.flux))
            scale, variance = best_scale(flux[rows], self.flux, s, limit)
            chi2 = chi2_at(scale, flux[rows], self.flux, s, limit)
            out[:, rows] = scale, variance, -0.5 * chi2 - np.log(s[~limit]).sum()
        return out

    def _evaluate(self, x):
        placed = self._place(x)
        flux, *_, allowed = self._fluxes(placed)
        z = placed[1]["redshift"]
        prior = np.where(allowed, placed[3], -np.inf)
        true, wide = (self._likelihood(flux, z, s)[2] for s in (self.sigma, self.wide))
        return {"true": true, "wide": wide, "prior": prior}

    def _move(self, x, now, step):
        """Move every member along the difference of two others, where the posterior agrees."""
        n, d = x.shape
        a, b = (self.rng.permutation(n) for _ in range(2))
        # in some of the parameters at a time (Vrugt et al. 2009, Int. J. Nonlin. Sci. Num. Sim. 10, 273)
        some = self.rng.random((n, d)) < self.rng.integers(1, 4, size=(n, 1)) / 3.0
        free = np.maximum(some.sum(axis=1), 1)
        far = 2.38 / np.sqrt(2.0 * free) * self.rng.random(n) ** 0.5
        far = np.where(self.rng.random(n) < 0.1, 1.0, far)
        new = x + some * (far[:, None] * (x[a] - x[b]) + 1e-4 * x * self.rng.normal(size=x.shape))
        then = self._evaluate(new)
        old, new_value = (
            e["prior"] + (1.0 - step) * e["wide"] + step * e["true"] for e in (now, then)
        )
        take = np.log(1.0 - self.rng.random(n)) < new_value - old
        x = np.where(take[:, None], new, x)
        return x, {key: np.where(take, then[key], now[key]) for key in now}

    def _describe(self, x):
        """Values of parameters, their nodes, and derived quantities of models: dicts by name."""
        placed = self._place(x)
        columns, node = placed[:2]
        flux, power, galaxy, agn, _ = self._fluxes(placed)
        scale, variance, _ = self._likelihood(flux, node["redshift"], self.sigma)
        if self.grid.engine.scale_error:
            error = np.sqrt(np.maximum(variance, _TINY))
            low = ndtr(-scale / error)
            scale = scale + error * ndtri(low + (1.0 - low) * (1.0 - self.rng.random(len(scale))))
        values = {n: columns.get(n, a.values[node[n]]) for n, a in self.grid.priors.axes.items()}
        known, rows, of = self.grid.quantities, self.grid._log[1], self.grid.fraction
        n_galaxy, n_agn, out = len(known.galaxy_scale), len(known.agn_scale), {}
        of_galaxy = _values(*rows[0], *galaxy)
        of_agn = _values(*rows[1], *agn) if agn is not None else None
        for i, name in enumerate(known.names):
            if i < n_galaxy:
                out[name] = scale * of_galaxy[i]
            elif i < n_galaxy + n_agn:
                out[name] = scale * power * of_agn[i - n_galaxy]
            elif i == n_galaxy + n_agn:
                out[name] = scale * of_galaxy[n_galaxy]
                if agn is not None:
                    out[name] = out[name] + scale * power * of_agn[n_agn]
            else:
                out[name] = _between(known.shape.values[i - n_galaxy - n_agn - 1], *galaxy)
        if of is not None:
            dust = of_galaxy[n_galaxy + 1]
            odds = np.divide(power, dust, out=np.zeros(power.size), where=dust > 0)
            y = odds * of_galaxy[-1] * of_agn[-1]
            out[of.name] = y / (1.0 + y)
        return values, node, out


def _neighbors(nodes, i, place, above, straight):
    """
    Neighbors of nodes, and what part their differences from it have at places: a list of pairs.

    Two of them, for a parabola, or with ``straight`` one, on the side of the place where there is one.
    """
    n = nodes.size
    if straight:
        near = np.where(above, i + 1, i - 1)
        near = np.where(near < 0, 1, np.where(near >= n, n - 2, near))
        return [(near, (place - nodes[i]) / (nodes[near] - nodes[i]))]
    first = np.clip(i - 1, 0, n - 3)
    a, b = (np.where(i == first, first + 1, first), np.where(i == first + 2, first + 1, first + 2))
    x, xa, xb = nodes[i], nodes[a], nodes[b]
    return [
        (a, (place - x) * (place - xb) / ((xa - x) * (xa - xb))),
        (b, (place - x) * (place - xa) / ((xb - x) * (xb - xa))),
    ]


def _next_step(weight, rise, step):
    """Ln weights of the next step of the likelihood, the largest that leaves enough members effective."""
    low, high = step, 1.0

    def effective(to):
        log = weight + (to - step) * rise
        w = np.exp(log - log.max())
        return np.sum(w) ** 2 / np.sum(w * w)

    least = _EFFECTIVE * min(len(weight), effective(step))
    if effective(1.0) >= least:
        return weight + (1.0 - step) * rise, 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= least else (low, middle)
    # a step is made in any case
    to = max(low, step + 1e-3)
    return weight + (to - step) * rise, min(to, 1.0)


def _resampled(log_weight, rng):
    """Rows chosen in proportion to weights, as evenly as can be (systematic resampling)."""
    total = np.cumsum(np.exp(log_weight - log_weight.max()))
    n = total.size
    place = (np.arange(n) + rng.random()) / n * total[-1]
    return np.minimum(np.searchsorted(total, place), n - 1)


def _log_flux(flux):
    """Ln of fluxes, those that are nearly dark as if they were not."""
    top = flux.max(axis=-1, keepdims=True, initial=0.0)
    return np.log(np.maximum(flux, np.maximum(_DARK * top, _TINY)))


def _between(table, model, beside):
    """Values between nodes, linear in each parameter, of a table whose first axis is the models."""
    here = table[model]
    out = here.copy()
    for near, step in beside:
        out += (step[:, None] if here.ndim > 1 else step) * (table[near] - here)
    return out


def _values(rows, lit, model, beside):
    """Values between nodes, shape (n_rows, n), of rows that are logarithms where ``lit``."""
    out = _between(rows.T, model, beside).T
    return np.where(lit[:, None], np.exp(np.clip(out, -_LARGE, _LARGE)), np.maximum(out, 0.0))


def _between_flux(log, z, z_step, model, beside):
    """Fluxes, shape (n, nb), between nodes of redshift and of models; ``log`` has shape (nz, n, nb)."""
    here = log[z, model]
    change = np.zeros(here.shape)
    if z_step is not None:
        change += z_step[1][:, None] * (log[z_step[0], model] - here)
    for near, step in beside:
        change += step[:, None] * (log[z, near] - here)
    return np.exp(here + np.clip(change, -_STEEP, _STEEP))


def _spread(step):
    """Mean square by band of ln flux from nodes to edges of cells, less a factor, from steps between nodes."""
    if not len(step):
        return 0.0
    half = 0.5 * step
    return np.median(np.square(half - np.median(half, axis=1, keepdims=True)), axis=0)


def _summary(value):
    """Mean, standard deviation and mean log10, and quantiles at `DERIVED_LEVELS`, of draws."""
    value = value[np.isfinite(value)]
    if not value.size:
        return np.full(3, np.nan), np.full(DERIVED_LEVELS.size, np.nan)
    lit = value[value > 0]
    log = np.mean(np.log10(lit)) if lit.size else np.nan
    return np.array([value.mean(), value.std(), log]), np.quantile(value, DERIVED_LEVELS)
