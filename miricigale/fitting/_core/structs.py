"""Bundles of arrays that the kernels pass on (named tuples, which numba takes as they are)."""

from typing import NamedTuple

import numpy as np

__all__ = [
    "Draws",
    "Histograms",
    "Lanes",
    "Limits",
    "PointTables",
    "Request",
    "Scratch",
    "Sums",
    "Tables",
    "Target",
]

#: A model with <m, wm> below this has no light in the used bands.
NO_LIGHT = 1e-290


class PointTables(NamedTuple):
    """What the histograms need to know of the models; a part of `Tables`."""

    ratio: np.ndarray  # float64 (nf > 0,)
    log_ratio: np.ndarray  # float64 (nf > 0,): log10 of c, in bins
    edge: np.ndarray  # float64 (nf > 0, 2): c at the edges of the fractions' cells
    edge_zero: float  # c at the upper edge of the cell of f = 0
    dust: np.ndarray  # float64 (nG,), W / Msun
    log_dust: np.ndarray  # float64 (nG,), log10 of it; unused where it is 0
    mixed_galaxy: np.ndarray  # float64 (nG,): the galaxy's part of a quantity of both
    mixed_agn: np.ndarray  # float64 (nA,): the AGN's part of it
    share_galaxy: np.ndarray  # float64 (nG,), and
    share_agn: np.ndarray  # float64 (nA,): the other fraction is y / (1 + y), y = c times both
    share_mean: float  # mean of share_agn over the prior


class Tables(NamedTuple):
    """
    The model grid and the priors, laid out for the kernels.

    Only fractions f > 0 have an entry in ``ratio`` (c = f / (1 - f)); f = 0, if it is in the
    grid, is ``zero_frac`` = 1 and its prior comes first in ``prior_frac``.
    """

    galaxy: np.ndarray  # float64 (nz, nG, nb), uJy / Msun
    agn: np.ndarray  # float64 (nz, nA, nb), uJy / W
    tiles: np.ndarray  # float64 (nz, n_blocks, nb, BLOCK): ``galaxy``, padded with ones
    blocks: np.ndarray  # float64 (4, n_blocks, BLOCK): L_dust, 2 ln(prior), share, mixed quantity
    galaxy32: np.ndarray  # float32 (nz, nb, n_padded), each galaxy in its own unit
    agn32: np.ndarray  # float32 (nz, nA, nb), each torus in its own unit
    galaxy_unit: np.ndarray  # float64 (nz, nG): these units, uJy / Msun
    dust: np.ndarray  # float64 (nG,), W / Msun
    ratio: np.ndarray  # float64 (nf > 0,)
    zero_frac: int
    usable: np.ndarray  # bool (nz, nG): allowed by age and by the prior
    log_usable: np.ndarray  # float64 (nz, n_padded): 2 ln(prior) where usable, else -1e300
    prior_agn: np.ndarray  # float64 (nA,), sums to 1
    prior_frac: np.ndarray  # float64 (nf,)
    log_galaxy: np.ndarray  # float64 (nG,): 2 ln(prior), -1e300 where it is 0
    log_agn: np.ndarray  # float64 (nA,)
    log_frac: np.ndarray  # float64 (nf,)
    galaxy_scale: np.ndarray  # float64 (n_qg, nG): derived quantities for each Msun formed
    agn_scale: np.ndarray  # float64 (n_qa, nA): derived quantities for each W
    mixed_galaxy: np.ndarray  # float64 (nG,): the galaxy's part of a quantity of both
    mixed_agn: np.ndarray  # float64 (nA,): the AGN's part of it
    points: PointTables


class Request(NamedTuple):
    """What is asked of a fit, the same for every object."""

    delta: float  # pairs whose 2 ln(posterior) lies this much below the best are left out
    rtol: float  # of what is left, pairs that can only sum up to this part of the weight
    tail: float  # how much more, over rtol, second moments may miss
    thin: float  # part of its share of the weight below which a pair adds nothing to flux scatter
    scale_error: float  # 1: the scale's own variance 1/q enters the moments; 0: it does not
    levels: np.ndarray  # float64 (n_levels,), ascending, of the quantiles of derived quantities


class Target(NamedTuple):
    """The data of one object."""

    flux: np.ndarray  # float64 (nb,), uJy; 0 in bands not measured
    weight: np.ndarray  # float64 (nb,): 1 / sigma^2; 0 there
    log_prior: np.ndarray  # float64 (nz,): 2 ln(prior) of the redshifts, -1e300 where it is 0
    bands: np.ndarray  # int64 (n_used,): the measured bands
    norm: float  # |F|^2_w


class Limits(NamedTuple):
    """
    The upper limits of one object.

    The kernels take None where there are none: what they do with limits is then not even compiled.
    """

    bands: np.ndarray  # int64 (n_limits,): bands with an upper limit
    level: np.ndarray  # float64 (n_limits,): limiting flux over its sigma
    inverse: np.ndarray  # float64 (n_limits,): 1 / sigma
    dark: float  # sum of the limits' terms of chi2 for a model without light


class Histograms(NamedTuple):
    """Weights in bins of derived quantities, from which percentiles are read."""

    flat: np.ndarray  # (n,): what the next four and ``carry`` are parts of
    galaxy: np.ndarray  # (nG, N_BINS): l in bins of log s
    agn: np.ndarray  # (nA, N_BINS): l in bins of log(s c L_dust)
    mixed: np.ndarray  # (1, N_BINS): l in bins of the log of the mixed quantity
    share: np.ndarray  # (N_SHARE + 2,): changes of slope of the other fraction's distribution
    carry: np.ndarray  # (1,): weight not yet in the histograms
    range_galaxy: np.ndarray  # int64 (nG, 2): first and last bin in use
    range_agn: np.ndarray  # int64 (nA, 2)
    range_mixed: np.ndarray  # int64 (1, 2)
    origin: np.ndarray  # (3,): log10 of s, power and mixed quantity in the middle bins
    point: np.ndarray  # int64 (3, POINTS): galaxy, torus and fraction of models to add
    weight: np.ndarray  # (POINTS,)
    values: np.ndarray  # (2 * POINTS,): scales and mixed quantities
    logs: np.ndarray  # (2 * POINTS,)
    power: np.ndarray  # int64 (2 * POINTS,)


class Draws(NamedTuple):
    """Models drawn while the sums go on."""

    next: np.ndarray  # (n_draws,): sum l at which a draw is replaced
    index: np.ndarray  # int64 (n_draws, 4)
    scale: np.ndarray  # (n_draws, 2): s and its variance
    state: np.ndarray  # uint64 (1,): of the random numbers


class Sums(NamedTuple):
    """Weighted sums over the models, l being prior times likelihood over a common factor."""

    flat: np.ndarray  # (n,): what the arrays down to ``total`` are parts of
    zf: np.ndarray  # (nz, nf): sum l
    galaxy: np.ndarray  # (nG, 3): sum l, l s, l s^2
    agn: np.ndarray  # (nA, 3): sum l, l y, l y^2 with y = s c L_dust, f > 0 only
    alone: np.ndarray  # (nG,): sum l of f = 0
    band: np.ndarray  # (2, nb): sum l m, l m^2 with m the model flux
    zg: np.ndarray  # (nz, nG): sum l; this and the next four have no elements if not asked for
    zk: np.ndarray  # (nz, nA), f > 0 only
    gk: np.ndarray  # (nG, nA), f > 0 only
    fg: np.ndarray  # (nf, nG)
    fk: np.ndarray  # (nf, nA), f > 0 only
    total: np.ndarray  # (6,): sum l, l (s / sigma_s)^2, l of models with s = 0;
    #     sum l s^2 times galaxy's and AGN's part of the mixed quantity; l phi, l phi^2 with phi
    #     the other fraction
    best: np.ndarray  # (4,): R and s of the best model, R + 2 ln(prior) that has weight 1,
    #     number of models
    index: np.ndarray  # int64 (4,): z, galaxy, agn, frac of the best model; -1 where none
    hist: Histograms
    draws: Draws


class Lanes(NamedTuple):
    """Pairs that are evaluated side by side; a part of `Scratch`."""

    buffer: np.ndarray  # float64 (SIZE,): vectors of the pairs being evaluated
    light: np.ndarray  # float32 (light_size(nf),): the same in single precision
    limited: np.ndarray  # float64 (LIMITED_SIZE,): vectors of scales with limits
    left: np.ndarray  # float64 (nf * LANES,): what limits left of the scales of earlier pairs
    pending: np.ndarray  # float64 (N_INPUT * LANES,): the first of them, of gathered pairs
    power: np.ndarray  # int64 (LANES,)
    power32: np.ndarray  # int32 (LANES,)
    index: np.ndarray  # int64 (4, LANES): galaxies and tori of the pairs; of gathered ones
    limit: np.ndarray  # float64 (2 nb, LANES): their fluxes in bands with limits
    limit_light: np.ndarray  # float32 (2 nb, LANES): the same over the unit of the scale
    pending_limit: np.ndarray  # float64 (2 nb, LANES): those of gathered ones
    weight: np.ndarray  # float64 (nf * LANES,): prior * likelihood
    frac_sum: np.ndarray  # float64 (nf > 0,)
    slope: np.ndarray  # float64 (nb,): one model's fluxes over the limits' sigma


class Scratch(NamedTuple):
    """Work space that is made once for many objects."""

    run_key: np.ndarray  # int64 (capacity,): redshift, block of galaxies and torus of a run
    bound: np.ndarray  # float32 (capacity, BLOCK): bounds of its pairs, DONE where none
    order: np.ndarray  # int64 (nz,): redshifts, the most promising first
    promise: np.ndarray  # float64 (nz,): what galaxies alone reach there
    reference: np.ndarray  # float64 (1,): R + 2 ln(prior) that some model reaches
    count: np.ndarray  # float64 (n,): histogram of bounds
    p32: np.ndarray  # float32 (nz, n_padded)
    inverse_norm: np.ndarray  # float32 (nz, n_padded)
    tail_galaxy: np.ndarray  # float32 (nz, n_padded): what a pair's bound is raised by for
    tail_agn: np.ndarray  # float32 (nz, nA): second moments
    pq: np.ndarray  # float64 (2, n_blocks, BLOCK): <G, wF> and <G, wG> of one redshift
    known: np.ndarray  # int64 (n_blocks,): redshift + 1 for which they hold
    agn_weighted: np.ndarray  # float64 (nA, nb): w A of one redshift
    agn_pq: np.ndarray  # float64 (nA, 2): <A, wF>, <A, wA>
    cross: np.ndarray  # float64 (2, BLOCK): products of a block with a torus, best R
    run: np.ndarray  # int64 (BLOCK,): galaxies of a block that a run is about
    galaxy_z: np.ndarray  # float64 (3, n_blocks, BLOCK): sums over one redshift
    agn_z: np.ndarray  # float64 (nA, 3)
    mean: np.ndarray  # float64 (n_quantities,), and
    variance: np.ndarray  # float64 (n_quantities,) of derived quantities so far
    widest_galaxy: np.ndarray  # float64 (nG,): squares of quantities over their variances, and
    widest_agn: np.ndarray  # float64 (nA,): those of tori
    lanes: Lanes
