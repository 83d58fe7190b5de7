"""
Posteriors between the nodes of a grid.

A population of models begins as draws from the posterior of wider errors on the nodes, each put anywhere in its
node's cell: exact draws from a likelihood that is that of the node all over its cell. From there it is led to the
likelihood between the nodes in steps, at each of which it is weighed, resampled and moved (sequential Monte Carlo:
Del Moral et al. 2006, JRSS B 68, 411), in coordinates in which the prior is normal. Moves are in turn along
differences of members (ter Braak 2006, Stat. Comput. 16, 239; in some parameters at a time: Vrugt et al. 2009,
Int. J. Nonlin. Sci. Num. Sim. 10, 273) and about the mean of all with their covariance (preconditioned
Crank-Nicolson moves for a t distribution: Grumitt et al. 2024, arXiv:2407.07781). `Continuation` has the models.
"""

import numpy as np
from scipy.special import ndtr, ndtri

from miricigale.fitting.interpolation import rows_of
from miricigale.fitting.quantities import (
    DERIVED_LEVELS,
    draws_summary,
    node_shares,
    put_draws,
)
from miricigale.fitting.samplers.run import best_scale, chi2_at, systematic_draws
from miricigale.utils.random import stream

#: Least variance of a scale.
_TINY = 1e-290
#: Part of the population that the weights of a step may leave effective, and moves in each.
_EFFECTIVE, _MOVES = 0.5, 12
#: Moves under the true errors: before the population is kept for the first time, all, and from one to the next.
_FIRST, _LAST, _NEXT = 18, 54, 6
#: Degrees of freedom of the t distribution, and part of the moves that shall be taken.
_DEGREES, _TAKEN = 5.0, 0.25


def between_nodes(models, engine, data, log_prior, n_draws, results):
    """
    Results with posteriors, moments and percentiles of models between the nodes.

    Parameters
    ----------
    models : `~miricigale.fitting.continuation.Continuation`
        The grid with what lies between its nodes.
    engine : `~miricigale.fitting.grid.GridEngine`
        Of the nodes, or of the redshift of one object.
    data : `~miricigale.fitting.likelihood.FitData`
        Photometry of n objects.
    log_prior : `~numpy.ndarray`, shape (n, nz)
        ln(prior) of their redshifts.
    n_draws : int
        Members of the population of each object.
    results : `~miricigale.fitting.FitResults`
        What was found on the nodes.
    """
    # nodes are drawn by wider errors
    more = np.where(data.measured, models.errors * np.nan_to_num(data.flux), 0.0)
    wide = data._changed(sigma=np.hypot(data.sigma, more))
    seeds = [stream(0, "between", str(key)).integers(2**63) for key in data.ids]
    seeds = np.array(seeds, np.int64)
    index, _ = engine.draw(n_draws=n_draws, seeds=seeds, **wide.of_engine(log_prior))
    names, n = list(results.axes), len(data)
    new = {name: np.array(getattr(results, name)) for name in ("pdf_2d", "moments", "quantiles")}
    new["pdf"] = {name: np.array(results.pdf[name]) for name in names}
    new["axis_moments"] = np.full((n, len(names), 2), np.nan)
    new["axis_quantiles"] = np.full((n, len(names), DERIVED_LEVELS.size), np.nan)
    for i in np.flatnonzero((index[:, :, 0] >= 0).all(axis=1)):
        rng = np.random.default_rng(int(seeds[i]))
        one = _Object(models, engine, data[i : i + 1], wide.sigma[i], log_prior[i], rng)
        values, node, derived = one.population(index[i])
        for j, name in enumerate(names):
            new["pdf"][name][i] = node_shares((node[name],), new["pdf"][name].shape[1:])
            moments, quantiles = draws_summary(values[name])
            new["axis_moments"][i, j], new["axis_quantiles"][i, j] = moments[:2], quantiles
        pair = node["redshift"], node.get("frac_agn", 0 * node["redshift"])
        new["pdf_2d"][i] = node_shares(pair, new["pdf_2d"].shape[1:])
        put_draws(results, new, i, derived)
    return results._changed(**new)


class _Object:
    """The models of one object: a population, its likelihoods and how it moves."""

    def __init__(self, models, engine, data, wide, log_prior, rng):
        self.models, self.engine, self.rng = models, engine, rng
        used = data.used[0]
        self.used, self.limit, self.flux = used, data.limit[0][used], data.flux[0][used]
        self.sigma, self.wide = data.sigma[0][used], wide[used]
        self.free, self.known = dict(models.cells), {}
        if data.redshift is not None and "redshift" in self.free:
            self.known["redshift"] = data.redshift[0]
            del self.free["redshift"]
        elif "redshift" in self.free:
            weights = np.exp(log_prior - log_prior.max())
            self.free["redshift"] = self.free["redshift"].with_weights(weights)
        self.size = 0.5

    def population(self, index):
        """Values, nodes and derived quantities of the population under the true errors: dicts."""
        x, step, kept = self._begin(index), 0.0, []
        now = self._evaluate(x, step)
        while step < 1.0:
            weight, step = _next_step(now["true"] - now["node"], step)
            chosen = systematic_draws(weight, weight.size, self.rng)
            x, now = x[chosen], {key: value[chosen] for key, value in now.items()}
            for i in range(_MOVES if step < 1.0 else _LAST):
                x, now = self._move(x, now, step, whole=i % 2)
                if step == 1.0 and i >= _FIRST and i % _NEXT == 0:
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
        """Coordinates in the cells of nodes: the prior is normal in each."""
        z, g, k, f = index.T
        rng, node = self.rng, {"redshift": z, "frac_agn": f}
        for name, axis in self.models.axes.items():
            if axis.kind in ("galaxy", "agn"):
                # drawn from the prior where the model has none of its own
                model = g if axis.kind == "galaxy" else np.maximum(k, 0)
                share = axis.share[:, model].cumsum(axis=0)
                node[name] = np.sum(rng.random(len(g)) * share[-1] >= share, axis=0)
        x = np.empty((len(z), len(self.free)))
        for j, (name, cells) in enumerate(self.free.items()):
            x[:, j] = ndtri(cells.cumulative(node[name], rng.random(len(z))))
        return x

    def _models(self, x):
        unit = ndtr(x)
        values = {name: np.full(len(x), value) for name, value in self.known.items()}
        values |= {n: cells.value(unit[:, j]) for j, (n, cells) in enumerate(self.free.items())}
        return self.models.models(values)

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

    def _evaluate(self, x, step):
        """Ln of the prior density and of the likelihoods between the nodes and, below step 1, at the nearest."""
        models = self._models(x)
        out = {"prior": -0.5 * np.sum(np.square(x), axis=1)}
        out |= {"true": np.full(len(x), -np.inf), "node": np.zeros(len(x))}
        some = np.flatnonzero(models.possible)
        if some.size:
            models = rows_of(models, some)
            z = models.node["redshift"]
            out["true"][some] = self._likelihood(self.models.fluxes(models)[0], z, self.sigma)[2]
            if step < 1.0:
                flux = self.models.at_nodes(models, self.engine)
                out["node"][some] = self._likelihood(flux, z, self.wide)[2]
        return out

    def _move(self, x, now, step, *, whole):
        """Move every member, where the posterior agrees."""
        if not x.shape[1]:
            return x, now
        new, more = self._about_mean(x) if whole else (self._along_differences(x), 0.0)
        then = self._evaluate(new, step)
        rise = more + sum(
            part * (then[key] - now[key])
            for key, part in (("prior", 1.0), ("node", 1.0 - step), ("true", step))
        )
        take = np.log(1.0 - self.rng.random(len(x))) < rise
        if whole:
            self.size = np.clip(self.size * np.exp(0.3 * (take.mean() - _TAKEN)), 0.05, 0.99)
        now = {key: np.where(take, then[key], value) for key, value in now.items()}
        return np.where(take[:, None], new, x), now

    def _along_differences(self, x):
        n, d = x.shape
        a, b = (self.rng.permutation(n) for _ in range(2))
        some = self.rng.random((n, d)) < self.rng.integers(1, 4, size=(n, 1)) / 3.0
        free = np.maximum(some.sum(axis=1), 1)
        far = 2.38 / np.sqrt(2.0 * free) * self.rng.random(n) ** 0.5
        # from one peak to another
        far = np.where(self.rng.random(n) < 0.1, 1.0, far)
        return x + some * (far[:, None] * (x[a] - x[b]) + 1e-3 * self.rng.normal(size=x.shape))

    def _about_mean(self, x):
        """Where members go, and ln of the ratio of the t densities from which and to which."""
        (n, d), rng = x.shape, self.rng
        mean = x.mean(axis=0)
        root = np.linalg.cholesky(np.atleast_2d(np.cov(x.T)) + 1e-6 * np.eye(d))

        def distance(x):
            return np.sum(np.linalg.solve(root, (x - mean).T) ** 2, axis=0)

        before = distance(x)
        wide = np.sqrt(0.5 * (_DEGREES + before) / rng.gamma(0.5 * (d + _DEGREES), size=n))
        drawn = wide[:, None] * (rng.normal(size=x.shape) @ root.T)
        new = mean + np.sqrt(1.0 - self.size**2) * (x - mean) + self.size * drawn
        ratio = np.log1p(distance(new) / _DEGREES) - np.log1p(before / _DEGREES)
        return new, 0.5 * (d + _DEGREES) * ratio


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
