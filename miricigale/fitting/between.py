"""
Posteriors between the nodes of a grid.

A population of models begins as draws from the posterior of wider errors on the nodes, each put anywhere in its
node's cell: exact draws from a likelihood that is that of the node all over its cell. From there it is led to the
likelihood between the nodes in steps, at each of which it is weighed, resampled and moved (sequential Monte Carlo:
Del Moral et al. 2006, JRSS B 68, 411; moves along differences of members: ter Braak 2006, Stat. Comput. 16, 239).
`Continuation` has the models.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from miricigale.fitting.continuation import Continuation
from miricigale.fitting.quantities import DERIVED_LEVELS
from miricigale.fitting.samplers.run import best_scale, chi2_at
from miricigale.utils.random import stream

__all__ = ["Between"]

#: Least variance of a scale, and least prior density.
_TINY = 1e-290
#: Part of the population that the weights of a step may leave effective, and moves in each.
_EFFECTIVE, _MOVES = 0.5, 15
#: Moves under the true errors, and those of them after which the population is kept.
_LAST, _KEPT = 45, (15, 30, 45)


@dataclass(frozen=True, eq=False)
class Between:
    """
    How the posterior of a grid is continued between its nodes; picklable.

    Parameters
    ----------
    models : `~miricigale.fitting.continuation.Continuation`
        The grid with what lies between its nodes.
    n_draws : int
        Members of the population of each object.
    """

    models: Continuation
    n_draws: int

    def widened(self, data):
        """Photometry with the errors by which nodes are drawn, and seeds of the draws."""
        more = np.where(data.measured, self.models.errors * np.nan_to_num(data.flux), 0.0)
        seeds = [stream(0, "between", str(key)).integers(2**63) for key in data.ids]
        return data._changed(sigma=np.hypot(data.sigma, more)), np.array(seeds, np.int64)

    def refine(self, engine, data, wide, log_prior, index, seeds, results):
        """
        Results with posteriors, moments and percentiles of models between the nodes.

        ``index``, shape (n, n_draws, 4), are models of ``engine``, of the nodes or at the redshift of one object,
        drawn from the posteriors of ``wide`` with ln(prior) of redshifts ``log_prior``.
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
            one = _Object(self.models, engine, data[i : i + 1], wide.sigma[i], log_prior[i], rng)
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

    def __init__(self, models, engine, data, wide, log_prior, rng):
        self.models, self.engine, self.rng, self.log_prior = models, engine, rng, log_prior
        used = data.used[0]
        self.used, self.limit, self.flux = used, data.limit[0][used], data.flux[0][used]
        self.sigma, self.wide = data.sigma[0][used], wide[used]
        self.free, self.known = list(models.cells), {}
        if data.redshift is not None and "redshift" in self.free:
            self.known["redshift"] = data.redshift[0]
            self.free.remove("redshift")
            self.log_prior = np.zeros(len(models.engine.galaxy))

    def population(self, index):
        """Values, nodes and derived quantities of the population under the true errors: dicts."""
        x, step = self._begin(index), 0.0
        now = self._evaluate(self._models(x))
        while step < 1.0:
            weight, step = _next_step(now["true"] - now["node"], step)
            chosen = _resampled(weight, self.rng)
            x, now = x[chosen], {key: value[chosen] for key, value in now.items()}
            for _ in range(_MOVES):
                x, now = self._move(x, now, step)
        kept = []
        for i in range(_LAST):
            x, now = self._move(x, now, 1.0)
            if i + 1 in _KEPT:
                kept.append(x)
        models = self._models(np.concatenate(kept))
        flux, power = self.models.fluxes(models)
        scale, variance, _ = self._likelihood(flux, models.node["redshift"], self.sigma)
        if self.models.engine.scale_error:
            error = np.sqrt(np.maximum(variance, _TINY))
            low = ndtr(-scale / error)
            scale = scale + error * ndtri(low + (1.0 - low) * (1.0 - self.rng.random(len(scale))))
        values, derived = self.models.describe(models, power, scale)
        return values, models.node, derived

    def _begin(self, index):
        """Values in the cells of nodes."""
        z, g, k, f = index.T
        rng, node = self.rng, {"redshift": z, "frac_agn": f}
        for name, axis in self.models.priors.axes.items():
            if axis.kind in ("galaxy", "agn"):
                # drawn from the prior where the model has none of its own
                share = axis.share[:, g if axis.kind == "galaxy" else np.maximum(k, 0)].cumsum(
                    axis=0
                )
                node[name] = np.sum(rng.random(len(g)) * share[-1] >= share, axis=0)
        x = np.empty((len(z), len(self.free)))
        for j, name in enumerate(self.free):
            cells, i = self.models.cells[name], node[name]
            x[:, j] = cells.edges[i] + np.diff(cells.edges)[i] * rng.random(len(z))
        return x

    def _models(self, x):
        values = dict(zip(self.free, x.T, strict=True))
        values |= {name: np.full(len(x), value) for name, value in self.known.items()}
        return self.models.models(values, self.log_prior, self.free)

    def _likelihood(self, flux, z, sigma):
        """Best scales, their variances, and ln(likelihood) but for a constant."""
        template, limit, flux = self.models.engine.template_error, self.limit, flux[:, self.used]
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

    def _evaluate(self, models, step=0.0):
        """Ln of the prior density and of the likelihoods between the nodes and at the nearest."""
        z, node = models.node["redshift"], np.zeros(len(models.prior))
        true = self._likelihood(self.models.fluxes(models)[0], z, self.sigma)[2]
        if step < 1.0:
            node = self._likelihood(self.models.at_nodes(models, self.engine), z, self.wide)[2]
        return {"true": true, "node": node, "prior": models.prior}

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
        models = self._models(new)
        some = np.flatnonzero(np.isfinite(models.prior))
        if not some.size:
            return x, now
        then = self._evaluate(models.rows(some), step)
        old = {key: value[some] for key, value in now.items()}
        rise = sum(
            part * (then[key] - old[key])
            for key, part in (("prior", 1.0), ("node", 1.0 - step), ("true", step))
        )
        take = np.log(1.0 - self.rng.random(some.size)) < rise
        some, x, now = some[take], x.copy(), {key: value.copy() for key, value in now.items()}
        x[some] = new[some]
        for key, value in then.items():
            now[key][some] = value[take]
        return x, now


def _next_step(rise, step):
    """Ln weights of the next step, the largest that leaves enough members effective, and where it ends."""

    def weight(to):
        # members that are impossible have no weight
        log = np.where(np.isfinite(rise), (to - step) * rise, -np.inf)
        return np.exp(log - log.max())

    def enough(to):
        w = weight(to)
        return np.sum(w) ** 2 >= _EFFECTIVE * w.size * np.sum(w * w)

    low, high = step, 1.0
    if enough(1.0):
        return weight(1.0), 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    # a step is made in any case
    to = min(max(low, step + 1e-3), 1.0)
    return weight(to), to


def _resampled(weight, rng):
    """Rows chosen in proportion to weights, as evenly as can be (systematic resampling)."""
    total = np.cumsum(weight)
    n = total.size
    place = (np.arange(n) + rng.random()) / n * total[-1]
    return np.minimum(np.searchsorted(total, place), n - 1)


def _summary(value):
    """Mean, standard deviation and mean log10, and quantiles at `DERIVED_LEVELS`, of draws."""
    value = value[np.isfinite(value)]
    if not value.size:
        return np.full(3, np.nan), np.full(DERIVED_LEVELS.size, np.nan)
    lit = value[value > 0]
    log = np.mean(np.log10(lit)) if lit.size else np.nan
    return np.array([value.mean(), value.std(), log]), np.quantile(value, DERIVED_LEVELS)
