"""From weighted samples to moments, quantiles, histograms and draws of equal weight."""

from dataclasses import dataclass

import numpy as np

from miricigale.fitting.engines.continuous import ContinuousEngine
from miricigale.fitting.posterior import cell_edges
from miricigale.fitting.quantities import DERIVED_LEVELS
from miricigale.utils.random import stream

__all__ = ["FitOne"]


@dataclass(frozen=True, eq=False)
class FitOne:
    """
    Fit one object and reduce its sample to what results hold; picklable.

    Parameters
    ----------
    engine : `~miricigale.fitting.engines.continuous.ContinuousEngine`
        Model and sampler.
    axes : dict of str to `~miricigale.fitting.priors.GridAxis`
        Cells of the parameters.
    seed : int
        Seed of the whole catalogue.
    n_draws : int
        Draws of equal weight that are kept.
    pairs : tuple of tuple of str, optional
        Axes whose joint posteriors are returned too.
    """

    engine: ContinuousEngine
    axes: dict
    seed: int
    n_draws: int
    pairs: tuple = ()

    def __call__(self, target):
        found = self.engine.fit(target, self.seed)
        if found is None:
            return None
        weight, fixed = found.weight, target.space.fixed
        values = dict(found.parameters)
        best = dict(found.best)
        for name in self.axes:
            if name not in values:
                values[name] = np.full(weight.size, fixed[name])
                best[name] = fixed[name]
        cells = {name: _cell(axis, values[name]) for name, axis in self.axes.items()}
        pdf = {
            name: np.bincount(cells[name], weight, minlength=axis.values.size)
            for name, axis in self.axes.items()
        }
        size = {name: axis.values.size for name, axis in self.axes.items()}
        # one cell of the AGN fraction where it is no axis
        n_f, fraction = size.get("frac_agn", 1), cells.get("frac_agn", 0)

        def joint(i, j, n_x, n_y):
            return np.bincount(i * n_y + j, weight, minlength=n_x * n_y).reshape(n_x, n_y)

        axis_parts = [_summary(values[name], weight) for name in self.axes]
        parts = [_summary(array, weight) for array in found.derived.values()]
        drawn = _draw(weight, self.n_draws, stream(self.seed, "draws", target.key))
        columns = [values[name] for name in self.axes] + list(found.derived.values())
        mean = weight @ found.flux
        return {
            "pdf": pdf,
            "pdf_2d": joint(cells["redshift"], fraction, size["redshift"], n_f),
            "pairs": {(x, y): joint(cells[x], cells[y], size[x], size[y]) for x, y in self.pairs},
            "axis_moments": [part[0][:2] for part in axis_parts],
            "axis_quantiles": [part[1] for part in axis_parts],
            "moments": [part[0] for part in parts],
            "quantiles": [part[1] for part in parts],
            "draws": np.column_stack(columns)[drawn],
            "model_flux": mean,
            "model_flux_std": np.sqrt(weight @ np.square(found.flux - mean)),
            "best": best,
            "best_flux": found.best_flux,
            "chi2": found.chi2,
            "log_evidence": found.log_evidence,
            "log_evidence_err": found.log_evidence_err,
            "n_calls": found.n_calls,
            "n_effective": found.n_effective,
            "converged": found.converged,
        }


def _cell(axis, values):
    """Cell of an axis in which each value lies; the outermost take what is beyond."""
    if axis.values.size == 1:
        return np.zeros(values.size, dtype=np.int64)
    edges = cell_edges(axis.values, axis.bounds)
    return np.searchsorted(edges[1:-1], values, side="right")


def _summary(values, weight):
    """Mean, standard deviation and mean of log10, and quantiles, of a weighted sample."""
    good = np.isfinite(values)
    levels = np.asarray(DERIVED_LEVELS)
    if not good.any():
        return np.full(3, np.nan), np.full(levels.size, np.nan)
    values, weight = values[good], weight[good] / weight[good].sum()
    mean = weight @ values
    std = np.sqrt(weight @ np.square(values - mean))
    positive = values > 0
    log_mean = np.nan
    if positive.any():
        log_mean = weight[positive] @ np.log10(values[positive]) / weight[positive].sum()
    order = np.argsort(values, kind="stable")
    middle = np.cumsum(weight[order]) - 0.5 * weight[order]
    return np.array([mean, std, log_mean]), np.interp(levels, middle, values[order])


def _draw(weight, n, rng):
    """Rows of a weighted sample, in proportion to weight with as few repetitions as may be."""
    total = np.cumsum(weight)
    place = (np.arange(n) + rng.random()) / n * total[-1]
    return rng.permutation(np.minimum(np.searchsorted(total, place), weight.size - 1))
