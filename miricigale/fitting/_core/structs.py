"""
Bundles of arrays that the kernels take, and how kernels are compiled.

Kernels that Python calls need a wrapper, whose compilation takes some 10 ms for each array: their
bundles hold what one kind of work needs. Parts of kernels become part of these, for a call that
passes on bundles costs more than many of them do. Nothing is allocated within kernels, so that
arrays need no counting of references, which takes as long to compile as all else. Sums may be taken
in any order, except where digits would be lost.

The names of rows of tables, and of vectors of pairs, are not in ``__all__``: kernels call them
``at.DUST``, with this module as ``at``.
"""

from typing import NamedTuple

import numpy as np

#: Galaxies, or pairs, handled side by side; the tables of galaxies are padded to a multiple of it.
BLOCK = 64
#: A run is an AGN model with a block of galaxies at one redshift; its key has so many bits for the
#: AGN model, as many for the block, and the redshift above.
KEY_BITS = 20
KEY_MASK = (1 << KEY_BITS) - 1
#: Bound of a pair that is not listed, or is no more.
DONE = np.float32(-3e38)
#: A model with <m, wm> below this has no light in the used bands.
NO_LIGHT = 1e-290

#: Rows of ``Tables.of_galaxy``: dust luminosity in W for each solar mass formed and its log10 (-400
#: where it is 0), the galaxy's parts of the other fraction and of the quantity of both.
DUST, LOG_DUST, SHARE_GALAXY, MIXED_GALAXY = range(4)
#: Rows of ``Tables.of_agn``: 2 ln(prior), the AGN model's parts of these.
LOG_AGN, SHARE_AGN, MIXED_AGN = range(3)
#: Rows of ``Tables.of_frac``, fractions above 0: c = f / (1 - f), its log10 in bins, prior,
#: 2 ln(prior), c at the edges of the fractions' cells.
RATIO, LOG_RATIO, PRIOR_FRAC, LOG_FRAC, EDGE_LOW, EDGE_HIGH = range(6)

#: Offsets of the vectors in Lanes.buffer, which lets the compiler see that they do not overlap. What
# the pairs are, with A, X and B for x = c ...
P, Q, X2, A, B, PRIOR, SHARE, POWER = (i * BLOCK for i in range(8))
# ... sums over the fractions of prior * likelihood l, l s, l s^2, l c s, l c s^2, l c^2 s^2, the
# other fraction phi and its square, l of s = 0 and l (s / sigma_s)^2; the largest R, work space.
W0, W1, W2, V1, U2, V2, F1, F2, WZ, WR, TOP, T = (i * BLOCK for i in range(8, 20))
#: Length of the whole buffer.
SIZE = 20 * BLOCK


class Tables(NamedTuple):
    """
    The model grid and the priors, laid out for the kernels.

    The fraction f = 0, if it is in the grid, is not among those of ``of_frac``.
    """

    galaxy: np.ndarray  # float64 (nz, nG, nb), uJy / Msun
    agn: np.ndarray  # float64 (nz, nA, nb), uJy / W
    tiles: np.ndarray  # float64 (nz, n_blocks, nb, BLOCK): ``galaxy``, padded with ones
    galaxy32: np.ndarray  # float32 (nz, nb, n_padded), each galaxy in its own unit
    agn32: np.ndarray  # float32 (nz, nA, nb), each AGN model in its own unit
    galaxy_unit: np.ndarray  # float64 (nz, nG): these units, uJy / Msun
    agn_unit: np.ndarray  # float64 (nz, nA): and uJy / W
    log_usable: np.ndarray  # float64 (nz, n_padded): 2 ln(prior) where usable, else -1e300
    of_galaxy: np.ndarray  # float64 (4, n_padded)
    of_agn: np.ndarray  # float64 (3, nA)
    of_frac: np.ndarray  # float64 (6, nf > 0)
    zero_frac: int  # 1 if f = 0 is in the grid
    prior_zero: float  # its prior,
    log_zero: float  # 2 ln of it,
    edge_zero: float  # and c at the upper edge of its cell
    log_top_pair: float  # largest 2 ln(prior) of an AGN model and a fraction above 0
    share_mean: float  # mean of the AGN models's share over the prior


class Scales(NamedTuple):
    """Derived quantities of the models, in the last rows the parts of the one that is a sum."""

    galaxy: np.ndarray  # float64 (n_qg + 1, nG), for each Msun formed, and
    agn: np.ndarray  # float64 (n_qa + 1, nA), for each W
    log_galaxy: np.ndarray  # their log10; NO_SCALE of 0
    log_agn: np.ndarray


class Request(NamedTuple):
    """What is asked of a fit, the same for every object."""

    delta: float  # pairs whose 2 ln(posterior) lies this much below the best are left out
    rtol: float  # of what is left, pairs that can only sum up to this part of the weight
    tail: float  # how much more, over rtol, second moments may miss
    thin: float  # part of its share of the weight below which a pair adds nothing to flux scatter
    scale_error: float  # 1: the scale's own variance 1/q enters the moments; 0: it does not


class Target(NamedTuple):
    """The data of one object."""

    flux: np.ndarray  # float64 (nb,), uJy; 0 in bands not measured
    weight: np.ndarray  # float64 (nz, nb): 1 / sigma^2; 0 there
    log_prior: np.ndarray  # float64 (nz,): 2 ln(prior) of redshifts + ``level``; -1e300 if it is 0
    bands: np.ndarray  # int64 (n_used,): the measured bands
    root32: np.ndarray  # float32 (nz, n_used): roots of their weights, the largest being 1
    data32: np.ndarray  # float32 (nz, n_used): flux over sigma, of norm 1
    norm: np.ndarray  # float64 (nz,): |F|^2_w
    level: np.ndarray  # float64 (nz,): at most 0: R + level is top less chi2 and sum ln sigma^2,
    top: float  # and that, the least of the norm and sum ln sigma^2


class Limits(NamedTuple):
    """
    The upper limits of one object.

    The kernels take None where there are none: what they do with limits is then not even compiled.
    """

    bands: np.ndarray  # int64 (n_limits,): bands with an upper limit
    level: np.ndarray  # float64 (n_limits,): limiting flux over its sigma
    inverse: np.ndarray  # float64 (n_limits,): 1 / sigma
    slope: np.ndarray  # float64 (n_limits,), scratch: one model's fluxes over sigma
    dark: float  # sum of the limits' terms of chi2 for a model without light
    wrong: np.ndarray  # float64 (n_limits,): prior fraction of wrong ones, 0 but for a mixture


class Histograms(NamedTuple):
    """Weights in bins of derived quantities, from which percentiles are read."""

    table: np.ndarray  # (nG + nA + 1, N_BINS): l in bins of log s of every galaxy, of
    #     log(s c L_dust) of every AGN model, of the log of the mixed quantity
    share: np.ndarray  # (N_SHARE + 2,): changes of slope of the other fraction's distribution
    span: np.ndarray  # int64 (nG + nA + 1, 2): first and last bin in use
    origin: np.ndarray  # (3,): log10 of s, power and mixed quantity in the middle bins
    work: np.ndarray  # (5, N_BINS + KERNEL_SIZE), scratch, the last row zeros


class Draws(NamedTuple):
    """Models drawn while weights are summed up."""

    next: np.ndarray  # (n_draws,): sum l at which a draw is replaced
    index: np.ndarray  # int64 (n_draws, 4)
    scale: np.ndarray  # (n_draws, 2): s and its variance
    state: np.ndarray  # uint64 (1,): of the random numbers


class Joint(NamedTuple):
    """Joint sums of redshift, galaxy, AGN model and fraction; without elements if not asked for."""

    zg: np.ndarray  # (nz, nG): sum l
    zk: np.ndarray  # (nz, nA), f > 0 only
    gk: np.ndarray  # (nG, nA), f > 0 only
    fg: np.ndarray  # (nf, nG)
    fk: np.ndarray  # (nf, nA), f > 0 only


class Sums(NamedTuple):
    """Weighted sums over the models, l being prior times likelihood over a common factor."""

    flat: np.ndarray  # (n,): what the arrays down to ``total`` and ``joint`` are parts of
    zf: np.ndarray  # (nz, nf): sum l
    galaxy: np.ndarray  # (nG, 3): sum l, l s, l s^2
    agn: np.ndarray  # (nA, 3): sum l, l y, l y^2 with y = s c L_dust, f > 0 only
    alone: np.ndarray  # (nG,): sum l of f = 0
    band: np.ndarray  # (2, nb): sum l m, l m^2 with m the model flux
    total: np.ndarray  # (7,): sum l, l (s / sigma_s)^2, l of models with s = 0;
    #     sum l s^2 times galaxy's and AGN's part of the mixed quantity; l phi, l phi^2 with phi
    #     the other fraction; weight not yet in the histograms
    best: np.ndarray  # (3,): R and s of the best model, R + 2 ln(prior) that has weight 1
    index: np.ndarray  # int64 (4,): z, galaxy, agn, frac of the best model; -1 where none
    joint: Joint
    hist: Histograms
    draws: Draws


class Pairs(NamedTuple):
    """The list of pairs that can matter, and work space of the search."""

    run_key: np.ndarray  # int64 (capacity,): redshift, block of galaxies and AGN model of a run
    bound: np.ndarray  # float32 (capacity, BLOCK): bounds of its pairs, DONE where none
    top: np.ndarray  # float32 (capacity,): at least the largest of them
    promise: np.ndarray  # float64 (nz,): what galaxies alone reach there
    order: np.ndarray  # int64 (nz,): redshifts, the most promising first
    galaxy_of: np.ndarray  # int64 (nz,): the galaxy that does; -1 where none is usable
    p32: np.ndarray  # float32 (nz, n_padded): <g, d>
    inverse_norm: np.ndarray  # float32 (nz, n_padded): 1 / |g|
    tail_galaxy: np.ndarray  # float32 (n_padded,): what bounds of one redshift are raised by for
    tail_agn: np.ndarray  # float32 (nA,): second moments
    agn_pq: np.ndarray  # float64 (nA, 2): <A, wF>, <A, wA> of one redshift
    agn_weighted: np.ndarray  # float64 (nA, nb): w A
    unit_agn: np.ndarray  # float32 (n, nb + 2): unit vectors t of AGN models
    agn32: np.ndarray  # float32 (2, nA): <t, d>, the square of its positive part
    unit_galaxy: np.ndarray  # float32 (nb + 2, BLOCK)
    rows: np.ndarray  # float32 (ROWS * BLOCK,): vectors of a block of galaxies


class Lanes(NamedTuple):
    """Pairs that are evaluated side by side, and sums over one redshift."""

    buffer: np.ndarray  # float64 (SIZE,): vectors of the pairs being evaluated
    single: np.ndarray  # float32 (single_size(nf),): the same in single precision
    index: np.ndarray  # int64 (2, BLOCK): galaxies and AGN models of the pairs
    weight: np.ndarray  # float64 (nf * BLOCK,): prior * likelihood
    frac_sum: np.ndarray  # float64 (nf > 0,)
    pq: np.ndarray  # float64 (2, n_padded): <G, wF> and <G, wG> of one redshift
    products_at: np.ndarray  # int64 (n_blocks,): redshift + 1 of the products in ``pq``
    galaxy_z: np.ndarray  # float64 (3, n_padded): sums over one redshift
    agn_z: np.ndarray  # float64 (3, nA)
    limited: np.ndarray  # float64 (LIMITED_SIZE,): vectors of scales with limits
    limited32: np.ndarray  # float32 (LIMITED_SIZE,): the same in single precision
    limit_share: (
        np.ndarray
    )  # float64 (nf * BLOCK,): scale with limits over that without, of earlier pairs
    limit: np.ndarray  # float64 (2 nb, BLOCK): fluxes in bands with limits
    limit32: np.ndarray  # float32 (2 nb, BLOCK): the same over the unit of the scale
