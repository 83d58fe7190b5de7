"""Draws of models from the posteriors of the grid engine."""

import numpy as np
from scipy.special import ndtr, ndtri

__all__ = ["draw_models"]


def draw_models(engine, flux, sigma, cells, n_draws, rng):
    """
    Draw models of one object, independently, from the joint posterior.

    Redshift and AGN fraction come from their joint posterior, which the engine has summed
    exactly; given both, all galaxies and tori are weighed.

    Parameters
    ----------
    engine : `~miricigale.fitting.engines.grid.GridEngine`
        The engine.
    flux, sigma : `~numpy.ndarray`, shape (nb,)
        Fluxes and errors in uJy; bands with infinite sigma are not used.
    cells : `~numpy.ndarray`, shape (nz, nf)
        Joint posterior of redshift and AGN fraction.
    n_draws : int
        Number of draws.
    rng : `~numpy.random.Generator`
        Where randomness comes from.

    Returns
    -------
    index : `~numpy.ndarray` of int, shape (n_draws, 4)
        Redshift, galaxy, torus and AGN fraction. Where the fraction is 0 the torus is drawn
        from its prior.
    scale : `~numpy.ndarray`, shape (n_draws,)
        Solar masses formed: if the engine has ``scale_error``, from the Gaussian about the best
        scale of the model, as far as it is positive; else the best scale.
    """
    weight = np.where(np.isfinite(sigma), 1.0 / np.square(sigma), 0.0)
    data = weight * np.where(weight > 0, flux, 0.0)
    total = np.cumsum(cells.ravel())
    chosen = np.searchsorted(total, rng.random(n_draws) * total[-1], side="right")
    z, f = np.unravel_index(np.minimum(chosen, total.size - 1), cells.shape)
    index = np.empty((n_draws, 4), dtype=np.int64)
    mean, error = np.empty(n_draws), np.empty(n_draws)
    uniform = rng.random((n_draws, 3))
    for node in np.unique(z):
        here = _Redshift(engine, node, data, weight)
        for fraction in np.unique(f[z == node]):
            rows = np.flatnonzero((z == node) & (f == fraction))
            g, k, mean[rows], error[rows] = here.draw(fraction, uniform[rows])
            index[rows] = np.column_stack([z[rows], g, k, f[rows]])
    if not engine.scale_error:
        return index, mean
    low = ndtr(-mean / error)
    # 1 - u, for the random numbers may be 0 but not 1
    return index, mean + error * ndtri(low + (1.0 - low) * (1.0 - uniform[:, 2]))


class _Redshift:
    """Projections of the models at one redshift on the fluxes of one object."""

    def __init__(self, engine, node, data, weight):
        self.engine = engine
        galaxy, agn = engine.galaxy[node], engine.agn[node]
        self.usable = engine.usable[node]
        self.p, self.q = galaxy @ data, np.square(galaxy) @ weight
        self.a, self.b = agn @ data, np.square(agn) @ weight
        self.cross = (galaxy * weight) @ agn.T
        with np.errstate(divide="ignore"):
            self.log_galaxy = np.where(self.usable, np.log(engine.prior_galaxy), -np.inf)
            self.log_agn = np.log(engine.prior_agn)

    def draw(self, fraction, uniform):
        """Galaxies, tori, best scales and their errors at one AGN fraction."""
        f = self.engine.frac[fraction]
        if f == 0.0 or self.a.size == 0:
            p, q, log_prior = self.p[:, None], self.q[:, None], self.log_galaxy[:, None]
        else:
            x = (f / (1.0 - f) * self.engine.dust)[:, None]
            p = self.p[:, None] + x * self.a
            q = self.q[:, None] + 2.0 * x * self.cross + np.square(x) * self.b
            log_prior = self.log_galaxy[:, None] + self.log_agn
        scale = np.divide(np.maximum(p, 0.0), q, out=np.zeros_like(q), where=q > 0)
        log_weight = (0.5 * scale * np.maximum(p, 0.0) + log_prior).ravel()
        g, k = np.divmod(_choose(np.exp(log_weight - log_weight.max()), uniform[:, 0]), p.shape[1])
        mean, error = scale[g, k], 1.0 / np.sqrt(q[g, k])
        if f == 0.0 and self.a.size:
            k = _choose(self.engine.prior_agn, uniform[:, 1])
        return g, k, mean, error


def _choose(weights, uniform):
    """Indices drawn with these weights."""
    total = np.cumsum(weights)
    index = np.searchsorted(total, uniform * total[-1], side="right")
    return np.minimum(index, np.flatnonzero(weights)[-1])
