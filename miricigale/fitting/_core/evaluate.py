"""
The posterior of one object: the search for the models that matter, and their exact evaluation.

Pairs come in runs: an AGN model with galaxies of one block. A run of many is evaluated as a block, so
that everything stands side by side in memory; those of short runs are gathered. Sums over one
redshift are kept apart, and model fluxes are summed up when a redshift is finished.
"""

import math

import numpy as np

from miricigale.fitting._core.histogram import add_alone, widest
from miricigale.fitting._core.lanes import (
    N_INPUT,
    fill_block,
    fill_dead,
    galaxy_products,
    gather,
    likelihoods,
    run_products,
)
from miricigale.fitting._core.limits import limited_likelihoods, limited_scale
from miricigale.fitting._core.pairs import (
    DONE,
    KEY_BITS,
    agn_products,
    best_of_galaxy,
    first_floor,
    list_runs,
    project,
    raise_bounds,
    second_floor,
)
from miricigale.fitting._core.single import single_likelihoods
from miricigale.fitting._core.structs import (
    BLOCK,
    DUST,
    KERNEL,
    LOG_AGN,
    LOG_FRAC,
    LOG_GALAXY,
    MIXED_GALAXY,
    NO_LIGHT,
    PART,
    PRIOR_FRAC,
)
from miricigale.fitting._core.sums import (
    PARTS,
    add_all,
    add_block,
    add_gathered,
    add_joint,
    deposit,
    draw,
    find_best,
    finish_redshift,
    keep_best,
    take_draw,
)
from miricigale.utils.compilation import njit

__all__ = ["sum_up"]

_MASK = (1 << KEY_BITS) - 1
_LOG10_E = 0.43429448190325183
# Runs with at least so many pairs are evaluated as a block.
_DENSE = 20
# Models without AGN so far below the best are not looked at for a reference.
_NEAR = 50.0
# Largest chi2 of a good model, and square of a limit over its error, for single precision with
# limits.
_MODEST = 1000.0


@njit(**PART)
def _alone(tables, limits, lanes, z, g):
    """Scale, R and variance of the scale of a galaxy without AGN."""
    p, q = lanes.pq[0, g], lanes.pq[1, g]
    # without light the scale is 0, and nothing is known of its error
    q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
    s = max(p, 0.0) / q
    r = max(p, 0.0) * s
    inverse = 1.0 / q
    if limits is not None:
        for m in range(limits.bands.size):
            limits.slope[m] = tables.galaxy[z, g, limits.bands[m]] * limits.inverse[m]
        s, r, inverse = limited_scale(p, q, limits)
    return s, r, inverse


@njit(**KERNEL)
def _evaluate_singles(tables, target, limits, pairs, lanes, sums, delta, scale_error):
    """
    Add the models without AGN (f = 0), one for each galaxy and redshift, to the sums.

    In a first pass the best of them becomes the reference, for nothing has been summed up yet, and
    what their weights sum up to is estimated, for the histograms.
    """
    best, total, draws = sums.best, sums.total, sums.draws
    about = 0.0
    carry = 0.0
    for sums_up in (False, True):
        floor = best[2] - tables.log_zero - (delta if sums_up else _NEAR)
        for z in range(target.log_prior.size):
            log_prior = target.log_prior[z]
            if log_prior < -1e200:
                continue
            # what no galaxy of this redshift exceeds, priors being at most 1
            if pairs.promise[z] + 1e-5 * target.norm < floor:
                continue
            some = False
            for block in range(tables.tiles.shape[1]):
                known = False
                for g in range(block * BLOCK, min((block + 1) * BLOCK, tables.galaxy.shape[1])):
                    p32 = max(pairs.p32[z, g], np.float32(0)) + 3e-6
                    prior = log_prior + tables.log_usable[z, g]
                    if p32 * p32 * target.norm + prior < floor:
                        continue
                    if not known:
                        known = True
                        galaxy_products(tables, target, z, block, lanes.pq)
                    s, r, inverse = _alone(tables, limits, lanes, z, g)
                    value = r + prior + tables.log_zero
                    if not sums_up:
                        if value > best[2]:
                            about *= math.exp(0.5 * (best[2] - value))
                            best[2] = value
                            floor = value - tables.log_zero - _NEAR
                        about += math.exp(max(0.5 * (value - best[2]), -700.0))
                        continue
                    some = True
                    keep_best(sums, r, s, z, g, np.int64(0), np.int64(0))
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
                    total[2] += t if s == 0.0 else 0.0
                    best[3] += 1.0
                    for d in range(draws.next.size):
                        while draws.next[d] <= total[0]:
                            now = max(total[0], draws.next[d])
                            take_draw(draws, d, now, z, g, np.int64(-1), np.int64(0), s, inverse)
                    carry += t
                    if carry >= max(total[0], about) / PARTS:
                        add_alone(tables, sums.hist, g, s, carry)
                        carry = 0.0
            if some:
                finish_redshift(tables, lanes, sums, z)


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
        other = rest + tables.of_galaxy[LOG_GALAXY, g] + pairs.tail_galaxy[z, g]
        if value * (1.0 + 1e-9) < sure - other:
            row[i] = np.float32(value + 1e-6 * (1.0 + abs(value)) + other)
        else:
            row[i] = DONE
            run[n_left] = i
            n_left += 1
    return n_left


@njit(**PART)
def _fill_limits(tables, limits, lane_limit, z, g, k, lane):
    """Fill a lane with the fluxes of galaxy and AGN model (for c = 1) in bands with limits."""
    n = limits.bands.size
    for m in range(n):
        band = limits.bands[m]
        t = limits.inverse[m]
        lane_limit[m, lane] = tables.galaxy[z, g, band] * t
        lane_limit[n + m, lane] = tables.agn[z, k, band] * t * tables.of_galaxy[DUST, g]


def _rescale(sums, lanes, factor):
    """Multiply all weights, when a better model becomes the reference."""
    hist = sums.hist
    # columns in use; all others are 0
    table = hist.table[:, hist.used[:, 0].min() : hist.used[:, 1].max() + 1]
    for array in (sums.flat, table, hist.share, sums.draws.next, lanes.galaxy_z, lanes.agn_z):
        array *= factor


@njit(**PART)
def _rescale_within(sums, lanes, factor):
    """Do what `_rescale` does, within a kernel."""
    for array in (sums.flat, sums.hist.flat, sums.draws.next):
        for i in range(array.size):
            array[i] *= factor
    for table in (lanes.galaxy_z, lanes.agn_z):
        for m in range(table.shape[0]):
            for i in range(table.shape[1]):
                table[m, i] *= factor


@njit(**PART)
def _take_gathered(limits, lanes, filled):
    """Move the gathered pairs to the lanes."""
    buffer, index = lanes.buffer, lanes.index
    for i in range(N_INPUT * BLOCK):
        buffer[i] = lanes.pending[i]
    for i in range(BLOCK):
        index[0, i] = index[2, i]
        index[1, i] = index[3, i]
    if limits is not None:
        for m in range(2 * limits.bands.size):
            for i in range(BLOCK):
                lanes.limit[m, i] = lanes.pending_limit[m, i]
    fill_dead(buffer, index, filled)


@njit(**KERNEL)
def _evaluate_runs(tables, target, limits, pairs, lanes, sums, request, n, floor, sure, single):
    """
    Add the pairs of the n listed runs to the sums.

    Those whose bound of R + 2 ln(prior), raised by ``pairs.tail_galaxy`` and ``tail_agn``, is at least
    ``floor`` are evaluated and marked as done in the list; of these, pairs whose exact bound turns out
    lower than ``sure`` get that bound there and are not evaluated. ``single``: whether single
    precision will do.
    """
    best, total, of_frac, first = sums.best, sums.total, tables.of_frac, tables.zero_frac
    light = single and limits is None
    top_frac = -1e300
    for j in range(of_frac.shape[1]):
        top_frac = max(top_frac, of_frac[LOG_FRAC, j])
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
    n_run = np.int64(0)
    r = np.int64(0)
    while True:
        while n_run == 0 and r < n:
            n_run = _next_run(pairs.bound[r], floor, lanes.run)
            if n_run == 0:
                r += 1
        # after the last run z is -1
        z = pairs.run_key[r] >> (2 * KEY_BITS) if r < n else np.int64(-1)
        # gathered pairs are evaluated when there is no room for more of the same redshift
        if filled > 0 and (z != z_now or (filled + n_run > BLOCK and n_run < _DENSE)):
            _take_gathered(limits, lanes, filled)
            filled = np.int64(0)
            k = np.int64(-1)
        else:
            if z != z_now:
                if z_now >= 0:
                    finish_redshift(tables, lanes, sums, z_now)
                z_now = z
                if r < n:
                    agn_products(tables.agn[z], target, pairs.agn_pq, pairs.agn_weighted)
            if r >= n:
                break
            k = pairs.run_key[r] & _MASK
            block = (pairs.run_key[r] >> KEY_BITS) & _MASK
            start = block * BLOCK
            if lanes.known[block] != z + 1:
                lanes.known[block] = z + 1
                galaxy_products(tables, target, z, block, lanes.pq)
            run_products(tables, target.bands, pairs, lanes, z, block, k, n_run)
            log_torus = target.log_prior[z] + tables.of_agn[LOG_AGN, k]
            rest = log_torus + top_frac + pairs.tail_agn[z, k]
            n_run = _drop(tables, pairs, lanes, r, z, block, n_run, rest, sure)
            whole = n_run >= _DENSE or filled + n_run > BLOCK
            if whole:
                fill_block(tables, pairs, lanes, block, k, n_run, log_torus)
                if limits is not None:
                    for j in range(n_run):
                        i = lanes.run[j]
                        _fill_limits(tables, limits, lanes.limit, z, start + i, k, i)
            else:
                before = filled
                filled = gather(tables, pairs, lanes, block, k, n_run, log_torus, filled)
                if limits is not None:
                    for i in range(before, filled):
                        g = lanes.index[2, i]
                        _fill_limits(tables, limits, lanes.pending_limit, z, g, k, i)
            r += 1
            n_run = np.int64(0)
            if not whole:
                continue
        if limits is not None:
            over = 1e300
            while over >= 200.0:
                top, over = limited_likelihoods(
                    of_frac, lanes, limits, best[2], request.scale_error, request.delta, single
                )
                if over >= 200.0:
                    # far better than the reference, which is found without regard to most limits
                    best[2] += 2.0 * over
                    _rescale_within(sums, lanes, math.exp(-min(over, 700.0)))
        elif light:
            top = single_likelihoods(of_frac, lanes, best[2], request.scale_error)
        else:
            top = likelihoods(of_frac, lanes, best[2], request.scale_error)
        if top >= best[0]:
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
        deposit(tables, limits, lanes, sums, light, added)


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
    for i, row in ((1, DUST), (2, MIXED_GALAXY)):
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
        _evaluate_singles(
            tables, target, limits, pairs, lanes, sums, request.delta, request.scale_error
        )
    # a bound holds the largest prior of the fractions above 0, a weight those of all
    prior = tables.of_frac[PRIOR_FRAC]
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
        # the best model met so far gets weight 1
        if reference > best[2]:
            if total[0] > 0.0:
                _rescale(sums, lanes, math.exp(0.5 * (best[2] - reference)))
            best[2] = reference
        # bounds are raised for second moments only after a first look
        pairs.tail_galaxy.fill(0.0)
        pairs.tail_agn.fill(0.0)
        if limits is not None:
            # a probability many sigma out is not one for single precision
            single = single and max(target.norm + limits.dark - reference, highest) < _MODEST
        floor, few = first_floor(pairs.bound, n, reference)
        _evaluate_runs(
            tables, target, limits, pairs, lanes, sums, request, n, floor, floor,
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
        _evaluate_runs(tables, target, limits, pairs, lanes, sums, request, n, floor, sure, single)
    return total[0] > 0.0
