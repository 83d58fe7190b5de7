"""What the grid engine finds."""

from dataclasses import dataclass, field

import numpy as np

__all__ = ["GridOutput"]


@dataclass(frozen=True, eq=False)
class GridOutput:
    """
    What a fit of n objects returns; not a number, or -1, in rows that were not fitted.

    Parameters
    ----------
    chi2 : `~numpy.ndarray`, shape (n,)
        Chi2 of the best model.
    log_sum : `~numpy.ndarray`, shape (n,)
        ln of the sum of prior exp(-chi2 / 2).
    n_models : `~numpy.ndarray`, shape (n,)
        How many models were evaluated.
    best_scale : `~numpy.ndarray`, shape (n,)
        Solar masses formed of the best model.
    index : `~numpy.ndarray` of int, shape (n, 4)
        Redshift, galaxy, torus and AGN fraction of the best model.
    zf : `~numpy.ndarray`, shape (n, nz, nf)
        Joint posterior of redshift and AGN fraction.
    galaxy, agn : `~numpy.ndarray`, shapes (n, nG) and (n, nA)
        Posteriors of galaxy models and tori.
    band : `~numpy.ndarray`, shape (n, 2, nb)
        Posterior mean and standard deviation of model fluxes.
    moments : `~numpy.ndarray`, shape (n, n_quantities, 3)
        Mean, standard deviation and mean log10 of derived quantities.
    quantiles : `~numpy.ndarray`, shape (n, n_quantities, n_levels)
        Quantiles of derived quantities.
    share, share_quantiles : `~numpy.ndarray`, shapes (n, 2) and (n, n_levels)
        Mean and standard deviation, and quantiles of the other AGN fraction.
    draw_index, draw_scale : `~numpy.ndarray`, shapes (n, n_draws, 4) and (n, n_draws, 2)
        Models drawn from the posterior; their scales and the variances of these.
    joint : dict of str to `~numpy.ndarray`, shape (n, ...)
        Joint posteriors that were asked for, by two letters of z, g, k and f.
    """

    chi2: np.ndarray
    log_sum: np.ndarray
    n_models: np.ndarray
    best_scale: np.ndarray
    index: np.ndarray
    zf: np.ndarray
    galaxy: np.ndarray
    agn: np.ndarray
    band: np.ndarray
    moments: np.ndarray
    quantiles: np.ndarray
    share: np.ndarray
    share_quantiles: np.ndarray
    draw_index: np.ndarray
    draw_scale: np.ndarray
    joint: dict = field(default_factory=dict)
