"""
The posterior of one object: the search for the models that matter, and their exact evaluation.

Pairs are listed in runs, an AGN model with galaxies of one block, and gathered from these to be
evaluated side by side. Sums over one redshift are kept apart, and model fluxes are summed up when a
redshift is finished.
"""

import math

import numpy as np

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.batched_pairs import (
    best_scale,
    fill_up,
    galaxy_products,
    gather,
    likelihoods,
)
from miricigale.fitting._core.floors import first_floor, second_floor
from miricigale.fitting._core.histogram import add_model, widest
from miricigale.fitting._core.limits import limited_likelihoods
from miricigale.fitting._core.pairs import agn_products, best_of_galaxy, list_runs, project
from miricigale.fitting._core.single import single_likelihoods
from miricigale.fitting._core.structs import BLOCK, KEY_BITS
from miricigale.fitting._core.sums import (
    PARTS,
    add_joint,
    add_pairs,
    deposit,
    draw,
    find_best,
    finish_redshift,
    keep_best,
    take_draw,
)
from miricigale.utils.compilation import KERNEL, PART, njit

_LOG10_E = 0.43429448190325183
# Models without AGN so far below the best are not looked at for a reference.
_NEAR = 50.0
# Largest chi2 of a good model, and square of a limit over its error, for single precision with
# limits.
_MODEST = 1000.0


@njit(**KERNEL)
def _evaluate_alone(tables, target, limits, pairs, lanes, sums, delta, scale_error):
    """
    Add the models without AGN (f = 0), one for each galaxy and redshift, to the sums.

    In a first pass the best of them becomes the reference, for nothing has been summed up yet, and
    what their weights sum up to is estimated, for the histograms.
    """
    best = sums.best
    total = sums.total
    draws = sums.draws
    weight_estimate = 0.0
    carry = 0.0
    for sums_up in (False, True):
        depth = _NEAR
        if sums_up:
            depth = delta
        floor = best[2] - tables.log_zero - depth
        for z in range(target.log_prior.size):
            log_prior = target.log_prior[z]
            if log_prior < -1e200:
                continue
            # what no galaxy of this redshift exceeds, priors being at most 1
            if pairs.promise[z] + 1e-5 * target.norm[z] < floor:
                continue
            any_kept = False
            for block in range(tables.tiles.shape[1]):
                has_products = False
                for g in range(block * BLOCK, min((block + 1) * BLOCK, tables.galaxy.shape[1])):
                    p32 = max(pairs.p32[z, g], np.float32(0)) + 3e-6
                    prior = log_prior + tables.log_usable[z, g]
                    if p32 * p32 * target.norm[z] + prior < floor:
                        continue
                    if not has_products:
                        has_products = True
                        galaxy_products(tables, target, z, block, lanes.pq)
                    galaxy = tables.galaxy[z, g]
                    p = lanes.pq[0, g]
                    q = lanes.pq[1, g]
                    s, r, inverse = best_scale(limits, p, q, galaxy, galaxy, 0.0, 0.0)
                    value = r + prior + tables.log_zero
                    if not sums_up:
                        if value > best[2]:
                            weight_estimate *= math.exp(0.5 * (best[2] - value))
                            best[2] = value
                            floor = value - tables.log_zero - _NEAR
                        weight_estimate += math.exp(max(0.5 * (value - best[2]), -700.0))
                        continue
                    any_kept = True
                    keep_best(sums, r + target.level[z], s, z, g, np.int64(0), np.int64(0))
                    t = math.exp(max(0.5 * (value - best[2]), -700.0))
                    lanes.galaxy_z[0, g] += t
                    lanes.galaxy_z[1, g] += t * s
                    lanes.galaxy_z[2, g] += t * (s * s + scale_error * inverse)
                    sums.zf[z, 0] += t
                    sums.alone[g] += t
                    if sums.joint.fg.size > 0:
                        sums.joint.fg[0, g] += t
                    total[0] += t
                    total[1] += t * s * s / inverse
                    if s == 0.0:
                        total[2] += t
                    for d in range(draws.next.size):
                        while draws.next[d] <= total[0]:
                            reached = max(total[0], draws.next[d])
                            take_draw(
                                draws, d, reached, z, g, np.int64(-1), np.int64(0), s, inverse
                            )
                    carry += t
                    if carry >= max(total[0], weight_estimate) / PARTS:
                        add_model(tables, sums.hist, g, np.int64(-1), np.int64(0), s, carry)
                        carry = 0.0
            if any_kept:
                finish_redshift(tables, lanes, sums, z)


@njit(**PART)
def _rescale(sums, lanes, factor):
    """Multiply all weights, when a better model becomes the reference."""
    table = sums.hist.table
    span = sums.hist.span
    for array in (sums.flat, sums.hist.share, sums.draws.next):
        for i in range(array.size):
            array[i] *= factor
    for row in range(span.shape[0]):
        for i in range(span[row, 0], span[row, 1] + 1):
            table[row, i] *= factor
    for array in (lanes.galaxy_z, lanes.agn_z):
        for m in range(array.shape[0]):
            for i in range(array.shape[1]):
                array[m, i] *= factor


@njit(**KERNEL)
def _evaluate_runs(
    tables, target, limits, pairs, lanes, sums, request, n, reference, floor, single
):
    """
    Add the pairs of the n listed runs whose bound of R + 2 ln(prior) reaches the floor to the sums.

    They are marked as done in the list. The best model met so far, of R + 2 ln(prior) = ``reference``,
    gets weight 1. ``single``: whether single precision will do.
    """
    best = sums.best
    total = sums.total
    of_frac = tables.of_frac
    if reference > best[2]:
        if total[0] > 0.0:
            _rescale(sums, lanes, math.exp(0.5 * (best[2] - reference)))
        best[2] = reference
    light = single and limits is None
    lanes.limit_share[:] = 1.0
    lanes.products_at[:] = 0
    n_listed = 1.0
    for r in range(n):
        if pairs.top[r] >= floor:
            for i in range(BLOCK):
                n_listed += pairs.bound[r, i] >= floor
    # typed, for a literal 0 would have kernels compiled once more
    r = np.int64(0)
    start = np.int64(0)
    z_now = np.int64(-1)
    while r < n:
        z = pairs.run_key[r] >> (2 * KEY_BITS)
        if z != z_now:
            z_now = z
            agn_products(tables.agn[z], target, z, pairs.agn_pq, pairs.agn_weighted)
        filled = np.int64(0)
        while filled < BLOCK and r < n and pairs.run_key[r] >> (2 * KEY_BITS) == z:
            if pairs.top[r] >= floor:
                filled, start = gather(
                    tables, target, limits, pairs, lanes, r, start, floor, filled
                )
            if pairs.top[r] < floor or start == BLOCK:
                start = np.int64(0)
                r += 1
        if filled > 0:
            fill_up(lanes, filled)
            record = best[0] - target.level[z]
            if limits is not None:
                over = 1e300
                while over >= 200.0:
                    reached, over = limited_likelihoods(
                        of_frac, lanes, limits, best[2], request.scale_error, record,
                        request.delta, single,
                    )  # fmt: skip
                    if over >= 200.0:
                        # far better than the reference, which is found without regard to most limits
                        best[2] += 2.0 * over
                        _rescale(sums, lanes, math.exp(-min(over, 700.0)))
            elif light:
                reached = single_likelihoods(of_frac, lanes, best[2], request.scale_error, record)
            else:
                reached = likelihoods(of_frac, lanes, best[2], request.scale_error, record)
            if reached > 0.0:
                find_best(tables, limits, lanes, sums, z, target.level[z])
            before = total[0]
            added = add_pairs(tables, lanes, sums, z, request.thin / n_listed)
            if sums.joint.gk.size + sums.joint.fg.size + sums.joint.fk.size > 0:
                add_joint(sums.joint, lanes, light, tables.zero_frac, of_frac.shape[1])
            if sums.draws.next.size > 0:
                draw(tables, limits, lanes, sums, light, z, before)
            deposit(tables, limits, lanes, sums, light, z, added)
        if r == n or pairs.run_key[r] >> (2 * KEY_BITS) != z:
            finish_redshift(tables, lanes, sums, z)


@njit(**KERNEL)
def _begin(tables, target, limits, pairs, lanes, sums, delta, scale_error):
    """
    Find a good model to begin with, order the redshifts, and add the models without AGN to the sums.

    Returned is the best R + 2 ln(prior) met, -1e300 if there is no model that may be used.
    """
    project(tables, target, pairs)
    order = pairs.order
    promise = pairs.promise
    # sorted by insertion: numba's argsort takes memory, which these kernels are compiled without
    for z in range(order.size):
        i = z
        while i > 0 and promise[order[i - 1]] < promise[z]:
            order[i] = order[i - 1]
            i -= 1
        order[i] = z
    reference = -1e300
    scale = 1.0
    for i in range(order.size):
        z = order[i]
        if promise[z] < -1e29 or (i >= 3 and reference > -1e299):
            break
        agn_products(tables.agn[z], target, z, pairs.agn_pq, pairs.agn_weighted)
        g = pairs.galaxy_of[z]
        value, s = best_of_galaxy(tables, target, limits, pairs, z, g)
        if value > reference:
            reference = value
            q = 0.0
            for b in range(target.flux.size):
                q += tables.galaxy[z, g, b] ** 2 * target.weight[z, b]
            scale = 1.0
            if s > 0.0:
                scale = s
            elif q > 1e-290:
                # where the best has no light others have about what one sigma allows
                scale = 1.0 / math.sqrt(q)
    if reference < -1e299:
        return reference
    origin = sums.hist.origin
    origin[:] = _LOG10_E * math.log(scale)
    for i, row in ((1, at.DUST), (2, at.MIXED_GALAXY)):
        top = 1e-300
        for g in range(tables.of_galaxy.shape[1]):
            top = max(top, tables.of_galaxy[row, g])
        origin[i] += _LOG10_E * math.log(top)
    sums.best[2] = reference
    if tables.zero_frac == 1 and tables.prior_zero > 0.0:
        _evaluate_alone(tables, target, limits, pairs, lanes, sums, delta, scale_error)
    return reference


def sum_up(tables, scales, request, target, limits, sums, pairs, lanes, *, single):
    """
    Sum up the posterior of one object.

    Parameters
    ----------
    tables, scales, request, target, limits, sums, pairs, lanes
        See `miricigale.fitting._core.structs`; ``limits`` is None where there are none, and
        ``sums`` are empty.
    single : bool
        Whether single precision will do for pairs of little weight.

    Returns
    -------
    found : bool
        Whether there is any model with weight.
    """
    best = sums.best
    total = sums.total
    arguments = (tables, target, limits, pairs)
    reference = _begin(*arguments, lanes, sums, request.delta, request.scale_error)
    n_agn = tables.agn.shape[1]
    if reference < -1e299 or n_agn == 0:
        return total[0] > 0.0
    # a bound holds the largest prior of the fractions above 0, a weight those of all
    prior = tables.of_frac[at.PRIOR_FRAC]
    prior_sum = prior.sum()
    prior_top = prior.max(initial=0.0)
    end = 0
    if prior_top > 0.0:
        end = tables.tiles.shape[0] * tables.tiles.shape[1]
    position = 0
    share = 1.0
    if limits is not None:
        highest = np.square(limits.level).max()
    while position < end:
        n, position, reference = list_runs(*arguments, request.delta, reference, position)
        share *= 0.5
        if limits is not None:
            # a probability many sigma out is not one for single precision
            single = single and max(target.top + limits.dark - reference, highest) < _MODEST
        floor, in_double = first_floor(pairs, n, reference)
        light = single and not in_double
        _evaluate_runs(*arguments, lanes, sums, request, n, reference, floor, light)
        allowed = share * request.rtol * total[0]
        tail = (target.norm.max() + 1.0) / request.tail
        rise = math.exp(min(0.5 * (reference - best[2]), 600.0))
        rise = rise * prior_sum / max(prior_top, 1e-300)
        wide = None
        if allowed > 0.0:
            wide = widest(scales, sums)
        floor = second_floor(
            tables, target, pairs, n, reference, allowed, rise, request.delta, tail, wide
        )
        _evaluate_runs(*arguments, lanes, sums, request, n, reference, floor, single)
    return total[0] > 0.0
