"""Models drawn from posteriors on a grid: on its nodes, or from the models between them that results rest on."""

from functools import partial

import numpy as np

from miricigale.fitting.data.likelihood import FitFlags
from miricigale.fitting.results.samples import Samples
from miricigale.utils.parallel import chunks, parallel_map
from miricigale.utils.random import stream
from miricigale.utils.values import value_class

#: Objects in a piece of the catalog that models are drawn for.
_AT_ONCE = 16


def draw_samples(fit, data, log_prior, n_draws, seed, **parallel):
    """
    Draw models from the posteriors of a catalog.

    Parameters
    ----------
    fit : `~miricigale.fitting.grid.grid_fit.GridFit`
        The fit.
    data : `~miricigale.fitting.data.likelihood.FitData`
        Photometry of n objects.
    log_prior : `~numpy.ndarray`, shape (n, nz)
        Ln of the prior of each redshift of the grid.
    n_draws, seed : int
        Draws of each object, and what chooses them.
    **parallel
        Passed to `~miricigale.utils.parallel.parallel_map`.

    Returns
    -------
    samples : `~miricigale.fitting.Samples`
    """
    slices = list(chunks(len(data), _AT_ONCE)) or [slice(0, 0)]
    pieces = [(data[rows], log_prior[rows]) for rows in slices]
    draw = partial(_draw_on_nodes, fit, n_draws, seed)
    if fit.between is not None:
        draw = partial(_draw_between, fit, n_draws, seed)
    parts = parallel_map(draw, pieces, desc="draws", **parallel)
    columns = Draws.concatenate(parts)
    flags = data.flags | columns.pop("flags")
    unfitted = ~np.isfinite(columns["scale"]).all(axis=1)
    unfitted &= (flags & FitFlags.UNFITTED) == 0
    flags[unfitted] |= FitFlags.NO_SIGNAL
    return Samples(fit.grid, data.ids, flags, axes=fit.priors.axes, seed=seed, **columns)


@value_class
class Draws:
    """
    Draws of a piece of a catalog.

    Parameters
    ----------
    index : `~numpy.ndarray` of int, shape (n, n_draws, 4)
        Redshift, galaxy, AGN model and AGN fraction, -1 where there is no draw.
    scale : `~numpy.ndarray`, shape (n, n_draws)
        Solar masses formed.
    flags : `~numpy.ndarray` of int, shape (n,)
        `FitFlags` of the draws.
    drawn : dict of str to `~numpy.ndarray`, shape (n, n_draws)
        Values of models between nodes.
    flux : `~numpy.ndarray` or None, shape (n, n_draws, nb)
        Their fluxes.
    """

    index: np.ndarray
    scale: np.ndarray
    flags: np.ndarray
    drawn: dict
    flux: np.ndarray | None

    @classmethod
    def empty(cls, n, n_draws, names, n_bands):
        """Make draws of n objects, of which none is drawn yet, with values of these names."""
        return cls(
            index=np.full((n, n_draws, 4), -1),
            scale=np.full((n, n_draws), np.nan),
            flags=np.zeros(n, np.int64),
            drawn={name: np.full((n, n_draws), np.nan) for name in names},
            flux=np.full((n, n_draws, n_bands), np.nan),
        )

    def put(self, i, index, values, flux):
        """Put the draws of an object in row ``i``; see `Continuation.draws`."""
        self.index[i] = index
        self.scale[i] = values["mass"]
        self.flux[i] = flux
        for name in self.drawn.keys() & values.keys():
            self.drawn[name][i] = values[name]

    @staticmethod
    def concatenate(parts):
        """Join the rows of pieces: dict of str to arrays, by attribute."""
        columns = {}
        for name in ("index", "scale", "flags"):
            columns[name] = np.concatenate([getattr(part, name) for part in parts])
        columns["drawn"] = {}
        for name in parts[0].drawn:
            columns["drawn"][name] = np.concatenate([part.drawn[name] for part in parts])
        columns["flux"] = None
        if parts[0].flux is not None:
            columns["flux"] = np.concatenate([part.flux for part in parts])
        return columns


def _draw_on_nodes(fit, n_draws, seed, piece):
    """Draw models of a piece of the catalog on the nodes: `Draws`."""
    data, log_prior = piece
    data = fit.with_all_errors(data, log_prior)
    seeds = [stream(seed, "fit", "draws", str(key)).integers(2**63) for key in data.ids]
    seeds = np.array(seeds, dtype=np.int64)
    index, scale = fit.engine.draw(n_draws=n_draws, seeds=seeds, **data.of_engine(log_prior))
    return Draws(index, scale, np.zeros(len(data), np.int64), {}, None)


def _draw_between(fit, n_draws, seed, piece):
    """Draw models of a piece of the catalog from those that the results of a fit rest on: `Draws`."""
    data, log_prior = piece
    data = fit.with_all_errors(data, log_prior)
    names = dict.fromkeys(("redshift", "frac_agn", *fit.priors.axes))
    names |= dict.fromkeys(fit.engine.quantities.names)
    draws = Draws.empty(len(data), n_draws, names, len(fit.filters))
    keys = _keys_of_data(data)
    posteriors = fit.between_posteriors(data, log_prior)
    for i, posterior in posteriors.items():
        rng = stream(seed, "fit", "draws", keys[i])
        rows = rng.choice(posterior.weight.size, n_draws, p=posterior.weight)
        draws.put(i, *fit.between.draws(posterior, rows))
        if not posterior.converged:
            draws.flags[i] = int(FitFlags.NOT_CONVERGED)
    is_fitted = np.isfinite(log_prior).any(axis=1)
    for i in np.setdiff1d(np.flatnonzero(is_fitted), list(posteriors)):
        # no model between the nodes is possible: on nodes, as in a fit
        drawn = _draw_one_on_nodes(fit, data[[i]], log_prior[[i]], n_draws, seed, keys[i])
        if drawn is not None:
            draws.put(i, *drawn)
            draws.flags[i] = int(FitFlags.NOT_CONVERGED)
    return draws


def _draw_one_on_nodes(fit, data, log_prior, n_draws, seed, key):
    """Draw models of one object on nodes, at its own redshift if that is known; see `Continuation.draws`."""
    engine = fit.engine
    node = None
    photometry = data.of_engine(log_prior)
    if fit.at_own_redshift(data):
        node = int(np.argmax(log_prior[0]))
        engine = fit.between.at_redshift(float(data.redshift[0]), node)
        photometry = data.of_engine(log_prior[:, node : node + 1])
    seeds = stream(seed, "fit", "draws", key).integers(2**63, size=1)
    index, scale = engine.draw(n_draws=n_draws, seeds=seeds, **photometry)
    if not np.isfinite(scale).all():
        return None
    z, g, k, f = index[0].T
    flux = engine.galaxy[z, g]
    if fit.grid.n_agn:
        frac = fit.grid.frac_agn[f]
        power = frac / (1.0 - frac) * fit.grid.dust_luminosity[g]
        flux = flux + power[:, None] * engine.agn[z, k]
    if node is not None:
        index[0, :, 0] = node
    # parameters without effect are keyed by the data too
    samples = Samples(fit.grid, [key], [0], index, scale, axes=fit.priors.axes, seed=seed)
    values = {name: samples.values(name).value[0] for name in samples.parameters}
    values["redshift"] = fit.grid.redshift[index[0, :, 0]]
    values["frac_agn"] = fit.grid.frac_agn[f]
    if node is not None:
        values["redshift"] = np.full(n_draws, float(data.redshift[0]))
    return index[0], values, scale[0][:, None] * flux


def _keys_of_data(data):
    """
    Make keys of random streams from the photometry of objects: list of str.

    They are those of single-precision numbers, so that other units give the same. Names of objects do not matter,
    and objects with other fluxes have independent streams.
    """
    columns = [data.flux, data.sigma, data.limit]
    if data.redshift is not None:
        columns.append(data.redshift[:, None])
    numbers = np.concatenate(columns, axis=1)
    with np.errstate(over="ignore"):
        # there is one NaN and one zero
        numbers = np.where(np.isnan(numbers), np.nan, numbers + 0.0).astype(np.float32)
    return [row.tobytes().hex() for row in numbers]
