"""Bundles of arrays that the kernels pass on (named tuples, which numba takes as they are)."""

from typing import NamedTuple

import numpy as np

__all__ = ["Output", "Request", "Scratch", "Sums", "Tables"]


class Tables(NamedTuple):
    """
    The model grid and the priors, laid out for the kernels.

    Only fractions f > 0 have an entry in ``ratio`` (c = f / (1 - f)); f = 0, if it is in the
    grid, is ``zero_frac`` = 1 and its prior comes first in ``prior_frac``.
    """

    galaxy: np.ndarray  # float64 (nz, nG, nb), uJy / Msun
    agn: np.ndarray  # float64 (nz, nA, nb), uJy / W
    galaxy32: np.ndarray  # float32 (nz, nb, n_padded), each galaxy in its own unit
    agn32: np.ndarray  # float32 (nz, nA, nb), each torus in its own unit
    dust: np.ndarray  # float64 (nG,), W / Msun
    log_dust: np.ndarray  # float64 (nG,), log10 of it; unused where it is 0
    ratio: np.ndarray  # float64 (nf > 0,)
    log_ratio: np.ndarray  # float64 (nf > 0,): log10 of c, in bins
    zero_frac: int
    usable: np.ndarray  # bool (nz, nG): allowed by age and by the prior
    prior_galaxy: np.ndarray  # float64 (nG,)
    prior_agn: np.ndarray  # float64 (nA,), sums to 1
    prior_frac: np.ndarray  # float64 (nf,)
    log_galaxy: np.ndarray  # float64 (nG,): 2 ln(prior), -1e300 where it is 0
    log_agn: np.ndarray  # float64 (nA,)
    log_frac: np.ndarray  # float64 (nf,)
    galaxy_scale: np.ndarray  # float64 (n_qg, nG): derived quantities for each Msun formed
    agn_scale: np.ndarray  # float64 (n_qa, nA): derived quantities for each W
    mixed_galaxy: np.ndarray  # float64 (nG,): the galaxy's part of a quantity of both
    mixed_agn: np.ndarray  # float64 (nA,): the AGN's part of it


class Request(NamedTuple):
    """What is asked of a fit, the same for every object."""

    delta: float  # pairs whose 2 ln(posterior) lies this much below the best are left out
    rtol: float  # of what is left, pairs that can only sum up to this part of the weight
    scale_error: float  # 1: the scale's own variance 1/q enters the moments; 0: it does not
    levels: np.ndarray  # float64 (n_levels,), ascending, of the quantiles of derived quantities


class Sums(NamedTuple):
    """Weighted sums over the models, l being prior times likelihood over a common factor."""

    zf: np.ndarray  # (nz, nf): sum l
    galaxy: np.ndarray  # (nG, 6): sum l, l s, l s^2, l s c, l s^2 c, l s^2 c^2
    agn: np.ndarray  # (nA, 3): sum l, l y, l y^2 with y = s c L_dust, f > 0 only
    band: np.ndarray  # (2, nb): sum l m, l m^2 with m the model flux
    total: np.ndarray  # (5,): sum l, l R, l of models with s = 0; number of models; sum l s^2
    #     times galaxy's and AGN's part of the mixed quantity
    best: np.ndarray  # (3,): R and s of the best model, R + 2 ln(prior) that has weight 1
    index: np.ndarray  # int64 (4,): z, galaxy, agn, frac of the best model; -1 where none
    hist_galaxy: np.ndarray  # (nG, N_BINS): l in bins of log s
    hist_agn: np.ndarray  # (nA, N_BINS): l in bins of log(s c L_dust)
    hist_mixed: np.ndarray  # (1, N_BINS): l in bins of the log of the mixed quantity
    range_galaxy: np.ndarray  # int64 (nG, 2): first and last bin in use
    range_agn: np.ndarray  # int64 (nA, 2)
    range_mixed: np.ndarray  # int64 (1, 2)
    origin: np.ndarray  # (3,): log10 of s, power and mixed quantity in the middle bins


class Scratch(NamedTuple):
    """Work space that is made once for many objects."""

    found: np.ndarray  # int64 (capacity,)
    bound: np.ndarray  # float32 (capacity,)
    p32: np.ndarray  # float32 (nz, n_padded)
    inverse_norm: np.ndarray  # float32 (nz, n_padded)
    weighted: np.ndarray  # float64 (nG, nb): w G of one redshift
    pq: np.ndarray  # float64 (nG, 2)
    known: np.ndarray  # int64 (nG,): redshift + 1 for which the two above hold
    buffer: np.ndarray  # float64 (20 * LANES,): all vectors of the pairs being evaluated
    power: np.ndarray  # int64 (LANES,)
    lane_index: np.ndarray  # int64 (2, LANES): galaxies and tori of the pairs
    scale: np.ndarray  # float64 (nf * LANES,)
    weight: np.ndarray  # float64 (nf * LANES,)
    values: np.ndarray  # float64 (2 * nf,): one pair's scales and mixed quantity
    logs: np.ndarray  # float64 (2 * nf,)
    log_power: np.ndarray  # int64 (2 * nf,)
    counter: np.ndarray  # int64 (1,): pairs seen, for the thinning of histograms


class Output(NamedTuple):
    """What a fit of n objects returns; rows that were not fitted keep what they held."""

    norm: np.ndarray  # (n,): |F|^2_w; the best chi2 is this minus best_r
    log_sum: np.ndarray  # (n,): ln sum prior exp(-chi2 / 2)
    n_models: np.ndarray  # (n,): how many models were evaluated
    best_r: np.ndarray  # (n,)
    best_scale: np.ndarray  # (n,): Msun formed
    index: np.ndarray  # int64 (n, 4): z, galaxy, agn, frac of the best model
    zf: np.ndarray  # (n, nz, nf): joint posterior of redshift and AGN fraction
    galaxy: np.ndarray  # (n, nG): posterior of the galaxy models
    agn: np.ndarray  # (n, nA): posterior of the tori
    band: np.ndarray  # (n, 2, nb): posterior mean and standard deviation of model fluxes
    moments: np.ndarray  # (n, n_quantities, 3): mean, standard deviation, mean log10
    quantiles: np.ndarray  # (n, n_quantities, n_levels)
