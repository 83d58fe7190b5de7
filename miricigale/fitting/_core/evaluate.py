"""
The posterior of one object: the search for the models that matter, and their exact evaluation.

Pairs come in runs: an AGN model with galaxies of one block. A run of many is evaluated as a block, so
that everything stands side by side in memory; those of short runs are gathered. Sums over one
redshift are kept apart, and model fluxes are summed up when a redshift is finished.
"""

import math

import numpy as np

from miricigale.fitting._core import rows as at
from miricigale.fitting._core.alone import evaluate_alone
from miricigale.fitting._core.floors import first_floor, raise_bounds, second_floor
from miricigale.fitting._core.histogram import widest
from miricigale.fitting._core.lanes import (
    galaxy_products,
    likelihoods,
    place,
    run_products,
    take_gathered,
)
from miricigale.fitting._core.limits import limited_likelihoods
from miricigale.fitting._core.pairs import (
    DONE,
    KEY_BITS,
    agn_products,
    best_of_galaxy,
    list_runs,
    project,
)
from miricigale.fitting._core.single import single_likelihoods
from miricigale.fitting._core.structs import BLOCK, KERNEL, PART
from miricigale.fitting._core.sums import (
    add_all,
    add_block,
    add_gathered,
    add_joint,
    deposit,
    draw,
    find_best,
    finish_redshift,
)
from miricigale.utils.compilation import njit

__all__ = ["sum_up"]

_MASK = (1 << KEY_BITS) - 1
_LOG10_E = 0.43429448190325183
# Runs with at least so many pairs are evaluated as a block.
_DENSE = 44
# Largest chi2 of a good model, and square of a limit over its error, for single precision with
# limits.
_MODEST = 1000.0


@njit(**PART)
def _next_run(row, floor, run):
    """Fill ``run`` with the pairs of a run whose bound reaches the floor; returns their number."""
    n = np.int64(0)
    for i in range(BLOCK):
        n += row[i] >= floor
    if n == 0:
        return n
    n = np.int64(0)
    for i in range(BLOCK):
        if row[i] >= floor:
            run[n] = i
            n += 1
    return n


@njit(**PART)
def _drop(tables, pairs, lanes, r, z, block, n_run, rest, sure):
    """
    Note better bounds of what is not worth evaluating, mark the others as done.

    ``rest`` is what is in a bound besides R and what goes with the galaxy. Returned is how many
    pairs of the run are left.
    """
    run, row = lanes.run, pairs.bound[r]
    n_left = np.int64(0)
    for j in range(n_run):
        i = run[j]
        g = block * BLOCK + i
        value = lanes.cross[1, i]
        other = rest + tables.of_galaxy[at.LOG_GALAXY, g] + pairs.tail_galaxy[z, g]
        if value * (1.0 + 1e-9) < sure - other:
            row[i] = np.float32(value + 1e-6 * (1.0 + abs(value)) + other)
        else:
            row[i] = DONE
            run[n_left] = i
            n_left += 1
    return n_left


@njit(**PART)
def _rescale(sums, lanes, factor):
    """Multiply all weights, when a better model becomes the reference."""
    table, used = sums.hist.table, sums.hist.used
    for array in (sums.flat, sums.hist.share, sums.draws.next):
        for i in range(array.size):
            array[i] *= factor
    for row in range(used.shape[0]):
        for i in range(used[row, 0], used[row, 1] + 1):
            table[row, i] *= factor
    for array in (lanes.galaxy_z, lanes.agn_z):
        for m in range(array.shape[0]):
            for i in range(array.shape[1]):
                array[m, i] *= factor


@njit(**KERNEL)
def _evaluate_runs(
    tables, target, limits, pairs, lanes, sums, request, n, reference, floor, sure, single
):
    """
    Add the pairs of the n listed runs to the sums.

    Those whose bound of R + 2 ln(prior), raised by ``pairs.tail_galaxy`` and ``tail_agn``, is at least
    ``floor`` are evaluated and marked as done in the list; of these, pairs whose exact bound turns out
    lower than ``sure`` get that bound there and are not evaluated. The best model met so far, of
    R + 2 ln(prior) = ``reference``, gets weight 1. ``single``: whether single precision will do.
    """
    best, total, of_frac, first = sums.best, sums.total, tables.of_frac, tables.zero_frac
    if reference > best[2]:
        if total[0] > 0.0:
            _rescale(sums, lanes, math.exp(0.5 * (best[2] - reference)))
        best[2] = reference
    light = single and limits is None
    for i in range(lanes.left.size):
        lanes.left[i] = 1.0
    n_listed = 1.0
    for r in range(n):
        for i in range(BLOCK):
            n_listed += pairs.bound[r, i] >= floor
    for i in range(lanes.known.size):
        lanes.known[i] = 0
    # typed, for a literal 0 would have kernels compiled once more
    z_now = np.int64(-1)
    filled = np.int64(0)
    block = np.int64(0)
    k = np.int64(0)
    r = np.int64(0)
    # pairs of the run, and how many of them have been taken
    n_run = np.int64(0)
    taken = np.int64(0)
    while True:
        if taken == n_run:
            n_run = np.int64(0)
            taken = np.int64(0)
            while n_run == 0 and r < n:
                n_run = _next_run(pairs.bound[r], floor, lanes.run)
                r += 1
            # after the last run z is -1
            z = pairs.run_key[r - 1] >> (2 * KEY_BITS) if n_run > 0 else np.int64(-1)
        whole = False
        if n_run > 0 and z == z_now:
            key = pairs.run_key[r - 1]
            k = key & _MASK
            block = (key >> KEY_BITS) & _MASK
            log_agn = target.log_prior[z] + tables.of_agn[at.LOG_AGN, k]
            if taken == 0:
                if lanes.known[block] != z + 1:
                    lanes.known[block] = z + 1
                    galaxy_products(tables, target, z, block, lanes.pq)
                run_products(tables, target.bands, pairs, lanes, z, block, k, n_run)
                rest = log_agn + tables.log_top_frac + pairs.tail_agn[z, k]
                n_run = _drop(tables, pairs, lanes, r - 1, z, block, n_run, rest, sure)
                whole = n_run >= _DENSE
            to = n_run if whole else min(n_run, taken + BLOCK - filled)
            filled = place(
                tables, limits, pairs, lanes, z, block, k, taken, to, log_agn, filled, whole
            )
            taken = to
            if not whole and filled < BLOCK:
                continue
        if not whole:
            if filled == 0:
                if z_now >= 0:
                    finish_redshift(tables, lanes, sums, z_now)
                if z < 0:
                    break
                z_now = z
                agn_products(tables.agn[z], target, pairs.agn_pq, pairs.agn_weighted)
                continue
            # gathered pairs are evaluated when there is no room for more, or none of the redshift
            take_gathered(limits, lanes, filled)
            filled = np.int64(0)
            k = np.int64(-1)
        if limits is not None:
            over = 1e300
            while over >= 200.0:
                reached, over = limited_likelihoods(
                    of_frac, lanes, limits, best[2], request.scale_error, best[0],
                    request.delta, single,
                )  # fmt: skip
                if over >= 200.0:
                    # far better than the reference, which is found without regard to most limits
                    best[2] += 2.0 * over
                    _rescale(sums, lanes, math.exp(-min(over, 700.0)))
        elif light:
            reached = single_likelihoods(of_frac, lanes, best[2], request.scale_error, best[0])
        else:
            reached = likelihoods(of_frac, lanes, best[2], request.scale_error, best[0])
        if reached > 0.0:
            find_best(tables, limits, lanes, sums, z_now)
        before_all = total[0]
        added = add_all(lanes, sums, z_now, first)
        if k >= 0:
            add_block(tables, lanes, sums, z_now, block, k)
        else:
            add_gathered(tables, lanes, sums, z_now, request.thin * (before_all + added) / n_listed)
        if sums.joint.gk.size + sums.joint.fg.size + sums.joint.fk.size > 0:
            add_joint(sums.joint, lanes, light, first, of_frac.shape[1])
        if sums.draws.next.size > 0:
            draw(tables, limits, lanes, sums, light, z_now, before_all)
        deposit(tables, limits, lanes, sums, light, z_now, added)


def _begin(tables, target, limits, pairs, origin):
    """
    Find a good model to begin with, and order the redshifts.

    ``origin`` is filled with the logarithms that the histograms begin with. Returned is the best
    R + 2 ln(prior) met, None if there is no model that may be used.
    """
    project(tables, target, pairs)
    pairs.order[:] = np.argsort(-pairs.promise, kind="stable")
    reference = -1e300
    scale = 1.0
    for i, z in enumerate(pairs.order):
        if pairs.promise[z] < -1e29 or (i >= 3 and reference > -1e299):
            break
        weighted = tables.agn[z] * target.weight
        pairs.agn_pq[:, 0] = weighted @ target.flux
        pairs.agn_pq[:, 1] = np.sum(weighted * tables.agn[z], axis=1)
        g = pairs.galaxy_of[z]
        value, s = best_of_galaxy(tables, target, limits, pairs, z, g)
        if value > reference:
            reference = value
            # where the best has no light others have about what one sigma allows
            q = np.sum(np.square(tables.galaxy[z, g]) * target.weight)
            scale = s if s > 0.0 else (1.0 / math.sqrt(q) if q > 1e-290 else 1.0)
    if reference < -1e299:
        return None
    origin[:] = _LOG10_E * math.log(scale)
    for i, row in ((1, at.DUST), (2, at.MIXED_GALAXY)):
        origin[i] += _LOG10_E * math.log(max(tables.of_galaxy[row].max(), 1e-300))
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
    reference = _begin(tables, target, limits, pairs, sums.hist.origin)
    if reference is None:
        return False
    best, total = sums.best, sums.total
    best[2] = reference
    if tables.zero_frac == 1 and tables.prior_zero > 0.0:
        evaluate_alone(
            tables, target, limits, pairs, lanes, sums, request.delta, request.scale_error
        )
    # a bound holds the largest prior of the fractions above 0, a weight those of all
    prior = tables.of_frac[at.PRIOR_FRAC]
    prior_sum, prior_top = prior.sum(), prior.max(initial=0.0)
    n_agn = tables.agn.shape[1]
    end = tables.tiles.shape[0] * tables.tiles.shape[1] if n_agn > 0 and prior_top > 0.0 else 0
    position = 0
    share = 1.0
    if limits is not None:
        highest = np.square(limits.level).max()
    while position < end:
        n, position, reference = list_runs(
            tables, target, limits, pairs, request.delta, reference, position
        )
        share *= 0.5
        # bounds are raised for second moments only after a first look
        pairs.tail_galaxy.fill(0.0)
        pairs.tail_agn.fill(0.0)
        if limits is not None:
            # a probability many sigma out is not one for single precision
            single = single and max(target.norm + limits.dark - reference, highest) < _MODEST
        floor, few = first_floor(pairs.bound, n, reference)
        _evaluate_runs(
            tables, target, limits, pairs, lanes, sums, request, n, reference, floor, floor,
            single and not few,
        )  # fmt: skip
        room = share * request.rtol * total[0]
        if room > 0.0:
            tail = (target.norm + 1.0) / request.tail
            raise_bounds(tables, target, pairs, n, tail, *widest(scales, sums))
        unit = (
            math.exp(min(0.5 * (reference - best[2]), 600.0)) * prior_sum / max(prior_top, 1e-300)
        )
        floor, sure = second_floor(pairs.bound, n, reference, room, unit, request.delta)
        _evaluate_runs(
            tables, target, limits, pairs, lanes, sums, request, n, reference, floor, sure, single
        )
    return total[0] > 0.0
