"""The search for the pairs that matter, of one object."""

import math

import numpy as np

from miricigale.fitting._core.bounds import (
    BLOCK,
    GROUP,
    KEY_BITS,
    galaxy_projections,
    pair_block,
    torus_projections,
)
from miricigale.fitting._core.options import INNER
from miricigale.fitting._core.products import agn_products, row_best
from miricigale.utils.compilation import njit

__all__ = ["begin", "list_runs"]


_NEVER = np.float32(1e30)
_NOWHERE = np.float32(-1e3)
_LOG10_E = 0.43429448190325183


@njit(**INNER)
def _sort_descending(x, order):
    """Fill the order of the elements from large to small, by insertion (equal ones stay so)."""
    for i in range(x.size):
        j = i
        while j > 0 and x[order[j - 1]] < x[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i


@njit(**INNER)
def _single_precision(target, root_weight, unit_data):
    """Fill root_weight with square roots of the weights over the largest, unit_data with d/|d|."""
    top_weight = 0.0
    for b in target.bands:
        top_weight = max(top_weight, target.weight[b])
    for j in range(target.bands.size):
        w = target.weight[target.bands[j]]
        root_weight[j] = math.sqrt(w / top_weight)
        unit_data[j] = target.flux[target.bands[j]] * math.sqrt(w / target.norm)


@njit(**INNER)
def _one_sigma(galaxy, target):
    """Error of a galaxy's scale; 1 if it has no light in the used bands."""
    q = 0.0
    for b in target.bands:
        q += galaxy[b] * galaxy[b] * target.weight[b]
    return 1.0 / math.sqrt(q) if q > 1e-290 else 1.0


@njit(**INNER)
def _row_best(tables, target, limits, scratch, z, g):
    """Do what `row_best` does, with R + 2 ln(prior) of the galaxy and the redshift too."""
    value, s = row_best(
        tables.galaxy[z, g], tables.agn[z], tables.dust[g], tables.ratio, tables.prior_agn,
        tables.log_agn, tables.log_frac, tables.zero_frac, target, limits, scratch.agn_pq,
        scratch.lanes.slope,
    )  # fmt: skip
    return value + target.log_prior[z] + tables.log_galaxy[g], s


@njit(**INNER)
def begin(tables, target, limits, scratch, origin):
    """
    Start on an object: look at galaxies without AGN, order the redshifts.

    Parameters
    ----------
    tables, target, limits, scratch
        See `miricigale.fitting._core.structs`.
    origin : `~numpy.ndarray`, shape (3,)
        Filled with the logarithms that the histograms begin with, see `structs.Histograms`.

    Returns
    -------
    ready : bool
        Whether there is any model that may be used.
    """
    n_z, n_galaxy, _ = tables.galaxy.shape
    log_prior, bands = target.log_prior, target.bands
    zero = np.float32(0)
    root_weight = np.empty(bands.size, np.float32)
    unit_data = np.empty(bands.size, np.float32)
    _single_precision(target, root_weight, unit_data)
    promise, order = scratch.promise, scratch.order
    row_of = np.full(n_z, -1)
    for z in range(n_z):
        promise[z] = -1e30
        if log_prior[z] < -1e200:
            continue
        p32 = scratch.p32[z]
        galaxy_projections(
            tables.galaxy32[z], bands, root_weight, unit_data, p32, scratch.inverse_norm[z]
        )
        top = np.float32(-2)
        row_top = np.float32(-2)
        for g in range(n_galaxy):
            if not tables.usable[z, g]:
                continue
            top = max(top, p32[g])
            # one too faint for single precision has 4, and may have no light at all
            if row_of[z] < 0 or (p32[g] < 2.0 and p32[g] > row_top):
                row_of[z] = g
                row_top = p32[g] if p32[g] < 2.0 else row_top
        if row_of[z] >= 0:
            value = np.float64(max(top, zero))
            promise[z] = value * value * target.norm + log_prior[z]
    _sort_descending(promise, order)
    reference = -1e300
    for i in range(n_z):
        z = order[i]
        if promise[z] < -1e29 or (i >= 3 and reference > -1e299):
            break
        agn_products(tables.agn[z], target, scratch.agn_pq, scratch.agn_weighted)
        g = row_of[z]
        value, s = _row_best(tables, target, limits, scratch, z, g)
        if value > reference:
            reference = value
            # where the best has no light others have about what one sigma allows
            s = s if s > 0.0 else _one_sigma(tables.galaxy[z, g], target)
            origin[0] = _LOG10_E * math.log(s)
    if reference < -1e299:
        return False
    scratch.reference[0] = reference
    top_dust = 1e-300
    top_mixed = 1e-300
    for g in range(n_galaxy):
        top_dust = max(top_dust, tables.dust[g])
        top_mixed = max(top_mixed, tables.mixed_galaxy[g])
    origin[1] = origin[0] + _LOG10_E * math.log(top_dust)
    origin[2] = origin[0] + _LOG10_E * math.log(top_mixed)
    return True


@njit(**INNER)
def list_runs(tables, request, target, limits, scratch, position):
    """
    List runs of pairs that can matter, until the list is full or all are seen.

    Parameters
    ----------
    tables, request, target, limits, scratch
        See `miricigale.fitting._core.structs`; `begin` was called. ``scratch.run_key`` and
        ``scratch.bound`` are filled, ``scratch.reference`` is raised when a better model is met.
    position : int
        Where to begin: place of the redshift in ``scratch.order`` times the number of blocks,
        plus the block.

    Returns
    -------
    n : int
        Number of runs in the list.
    position : int
        Where to go on; the number of redshifts times that of blocks when all are seen.
    """
    n_z = tables.galaxy.shape[0]
    n_agn = tables.agn.shape[1]
    n_blocks = tables.tiles.shape[1]
    log_prior, bands, norm = target.log_prior, target.bands, target.norm
    run_key, bound = scratch.run_key, scratch.bound
    n_used = bands.size
    root_weight = np.empty(n_used, np.float32)
    unit_data = np.empty(n_used, np.float32)
    _single_precision(target, root_weight, unit_data)
    top_agn = 0.0
    for k in range(n_agn):
        top_agn = max(top_agn, tables.prior_agn[k])
    top_frac = 0.0
    for j in range(tables.zero_frac, tables.prior_frac.size):
        top_frac = max(top_frac, tables.prior_frac[j])
    # the largest prior a pair can have from torus and fraction
    log_pair = 2.0 * math.log(max(top_frac, 1e-300)) + 2.0 * math.log(max(top_agn, 1e-300))
    unit_agn = np.zeros(((n_agn + GROUP - 1) // GROUP * GROUP, n_used), np.float32)
    a32 = np.empty(n_agn, np.float32)
    a2 = np.empty(n_agn, np.float32)
    unit_galaxy = np.empty((n_used, BLOCK), np.float32)
    threshold = np.empty(BLOCK, np.float32)
    base = np.empty(BLOCK, np.float32)
    p_block = np.empty(BLOCK, np.float32)
    top = np.empty(BLOCK, np.float32)
    reference = scratch.reference[0]
    margin = 2.0
    n = np.int64(0)
    z_now = np.int64(-1)
    agn_known = False
    while position < n_z * n_blocks and n + n_agn <= run_key.size:
        z = scratch.order[position // n_blocks]
        block = position % n_blocks
        if scratch.promise[z] < -1e29:
            position = np.int64(n_z * n_blocks)
            break
        position += 1
        if z != z_now:
            z_now = z
            agn_known = False
            torus_projections(tables.agn32[z], bands, root_weight, unit_data, unit_agn, a32, a2)
        start = block * BLOCK
        lowest = reference - request.delta - log_prior[z] - log_pair
        log_usable = tables.log_usable[z, start : start + BLOCK]
        p32 = scratch.p32[z, start : start + BLOCK]
        inverse = scratch.inverse_norm[z, start : start + BLOCK]
        n_here = 0
        for m in range(BLOCK):
            n_here += log_usable[m] > -1e200
        if n_here == 0:
            continue
        for m in range(BLOCK):
            # what may not be used is parallel to nothing and reaches nothing
            t = np.float32(max(min((lowest - log_usable[m]) / norm, 1.0), -1.0) - 1e-6)
            threshold[m] = t if log_usable[m] > -1e200 else _NEVER
            p_block[m] = p32[m] if log_usable[m] > -1e200 else _NOWHERE
            base[m] = max(log_usable[m] + (log_prior[z] + log_pair), -1e30)
        for j in range(n_used):
            row = tables.galaxy32[z, bands[j], start : start + BLOCK]
            s32 = root_weight[j]
            for m in range(BLOCK):
                unit_galaxy[j, m] = row[m] * s32 * inverse[m]
        n = pair_block(
            unit_galaxy, p_block, threshold, base, np.float32(norm), unit_agn, a32, a2,
            (((z << KEY_BITS) + block) << KEY_BITS), n, run_key, bound, top,
        )  # fmt: skip
        # galaxies that promise more than the reference are evaluated at once; when that does
        # not pay, only those that promise much more
        for m in range(BLOCK):
            if top[m] > reference + margin:
                if not agn_known:
                    agn_known = True
                    agn_products(tables.agn[z], target, scratch.agn_pq, scratch.agn_weighted)
                g = start + m
                value, _ = _row_best(tables, target, limits, scratch, z, g)
                if value > reference:
                    reference = value
                    margin = 2.0
                else:
                    # exponents of models that are not looked at stay in range
                    margin = min(1.5 * margin, 400.0)
    scratch.reference[0] = reference
    return n, position
