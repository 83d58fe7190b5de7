"""
Exact evaluation of what the bounds left over.

Pairs come in runs: a torus with galaxies of one block. A run of many is evaluated as a block, so
that everything stands side by side in memory; those of short runs are gathered. Sums over one
redshift are kept apart, and model fluxes are summed up when a redshift is finished.
"""

import math

import numpy as np

from miricigale.fitting._core.bounds import BLOCK, DONE, KEY_BITS
from miricigale.fitting._core.collect import add_points, deposit_lanes, draw_lanes, find_best
from miricigale.fitting._core.lanes import (
    LANES,
    N_INPUT,
    fill_block,
    fill_dead,
    gather,
    likelihoods,
)
from miricigale.fitting._core.light import light_likelihoods
from miricigale.fitting._core.limited import limited_likelihoods
from miricigale.fitting._core.options import INNER, ONCE
from miricigale.fitting._core.products import (
    agn_products,
    best_mixtures,
    cross_products,
    few_products,
    galaxy_products,
)
from miricigale.fitting._core.totals import (
    add_all,
    add_block,
    add_gathered,
    add_joint,
    finish_redshift,
)
from miricigale.fitting._core.workspace import rescale
from miricigale.utils.compilation import njit

__all__ = ["evaluate_runs"]


_KEY_MASK = (1 << KEY_BITS) - 1
#: Runs with at least so many pairs are evaluated as a block.
_DENSE = 20
#: Products of fewer than so many pairs are worked out one by one.
_FEW = 8


@njit(**INNER)
def _fill_limits(galaxy, agn, dust, limits, lane_limit, z, g, k, lane):
    """Fill a lane with the fluxes of galaxy and torus (for c = 1) in bands with limits."""
    n = limits.bands.size
    for m in range(n):
        band = limits.bands[m]
        t = limits.inverse[m]
        lane_limit[m, lane] = galaxy[z, g, band] * t
        lane_limit[n + m, lane] = agn[z, k, band] * t * dust[g]


@njit(**ONCE)
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


@njit(**ONCE)
def _drop(row, run, n_run, cross, other, sure):
    """Note better bounds of what is not worth evaluating, mark the others as done."""
    n_left = np.int64(0)
    for j in range(n_run):
        i = run[j]
        value = cross[1, i]
        if value * (1.0 + 1e-9) < sure - other[i]:
            row[i] = np.float32(value + 1e-6 * (1.0 + abs(value)) + other[i])
        else:
            row[i] = DONE
            run[n_left] = i
            n_left += 1
    return n_left


@njit(**INNER)
def evaluate_runs(tables, request, target, limits, sums, scratch, n, floor, sure, single):
    """
    Add the pairs of the listed runs to the sums.

    Parameters
    ----------
    tables, request, target, limits, sums, scratch
        See `miricigale.fitting._core.structs`; ``scratch.run_key`` and ``scratch.bound`` list
        the pairs.
    n : int
        Number of runs in the list.
    floor : float
        Pairs whose bound of R + 2 ln(prior), raised by ``scratch.tail_galaxy`` and ``tail_agn``,
        is at least this are evaluated and marked as done in the list.
    sure : float
        Of these, pairs whose exact bound turns out lower than this get that bound in the list
        and are not evaluated.
    single : bool
        Whether single precision will do.
    """
    run, cross, pq, known = scratch.run, scratch.cross, scratch.pq, scratch.known
    bound, blocks, tiles = scratch.bound, tables.blocks, tables.tiles
    agn_pq, agn_weighted, bands = scratch.agn_pq, scratch.agn_weighted, target.bands
    galaxy_z, agn_z, lanes = scratch.galaxy_z, scratch.agn_z, scratch.lanes
    buffer, pending, index = lanes.buffer, lanes.pending, lanes.index
    weight, frac_sum, best, total = lanes.weight, lanes.frac_sum, sums.best, sums.total
    first = tables.zero_frac
    light = single and limits is None
    top_frac = -1e300
    for j in range(tables.zero_frac, tables.log_frac.size):
        top_frac = max(top_frac, tables.log_frac[j])
    low, high = tables.ratio[0], tables.ratio[-1]
    for i in range(lanes.left.size):
        lanes.left[i] = 1.0
    other = np.empty(BLOCK)
    n_listed = 1.0
    for r in range(n):
        for i in range(BLOCK):
            n_listed += bound[r, i] >= floor
    for i in range(known.size):
        known[i] = 0
    # typed, for a literal 0 would have kernels compiled once more
    z_now = np.int64(-1)
    filled = np.int64(0)
    waiting = np.int64(0)
    block = np.int64(0)
    k = np.int64(0)
    n_run = np.int64(0)
    r = np.int64(0)
    while True:
        z = np.int64(-1)
        if n_run == 0:
            while r < n:
                n_run = _next_run(bound[r], floor, run)
                if n_run > 0:
                    break
                r += 1
        if r < n:
            z = scratch.run_key[r] >> (2 * KEY_BITS)
        # gathered pairs are evaluated when there is no room for more of the same redshift
        if filled > 0 and (z != z_now or (filled + n_run > LANES and n_run < _DENSE)):
            for i in range(N_INPUT * LANES):
                buffer[i] = pending[i]
            for i in range(LANES):
                index[0, i] = index[2, i]
                index[1, i] = index[3, i]
            if limits is not None:
                for m in range(2 * limits.bands.size):
                    for i in range(LANES):
                        lanes.limit[m, i] = lanes.pending_limit[m, i]
            fill_dead(buffer, index, filled)
            filled = np.int64(0)
            k = np.int64(-1)
        else:
            # after the last run z is -1
            if z != z_now:
                if z_now >= 0:
                    finish_redshift(
                        tiles,
                        tables.agn,
                        galaxy_z,
                        agn_z,
                        sums.galaxy,
                        sums.agn,
                        sums.band,
                        sums.zg,
                        sums.zk,
                        z_now,
                    )
                z_now = z
                if r < n:
                    agn_products(tables.agn[z], target, agn_pq, agn_weighted)
            if r >= n:
                break
            key = scratch.run_key[r]
            k = key & _KEY_MASK
            block = (key >> KEY_BITS) & _KEY_MASK
            if known[block] != z + 1:
                known[block] = z + 1
                galaxy_products(tiles, z, block, target, pq)
            a, b = agn_pq[k, 0], agn_pq[k, 1]
            if n_run < _FEW:
                few_products(
                    tiles, z, block, bands, agn_weighted, k, pq, blocks, a, b, low, high, run,
                    n_run, cross,
                )  # fmt: skip
            else:
                cross_products(tiles, z, block, bands, agn_weighted, k, cross)
                best_mixtures(pq, blocks, block, a, b, low, high, cross)
            log_torus = target.log_prior[z] + tables.log_agn[k]
            rest = log_torus + top_frac + scratch.tail_agn[z, k]
            for i in range(BLOCK):
                other[i] = rest + blocks[1, block, i] + scratch.tail_galaxy[z, block * BLOCK + i]
            n_left = _drop(bound[r], run, n_run, cross, other, sure)
            whole = n_left >= _DENSE or filled + n_left > LANES
            if whole:
                fill_block(
                    buffer, index, run, n_left, pq, blocks, block, cross, a, b, k, log_torus,
                    tables.points.share_agn[k],
                )  # fmt: skip
                if limits is not None:
                    for j in range(n_left):
                        i = run[j]
                        _fill_limits(
                            tables.galaxy, tables.agn, tables.dust, limits, lanes.limit, z,
                            block * BLOCK + i, k, i,
                        )  # fmt: skip
            else:
                before = filled
                filled = gather(
                    pending, index, run, n_left, pq, blocks, block, cross, a, b, k, log_torus,
                    tables.points.share_agn[k], filled,
                )  # fmt: skip
                if limits is not None:
                    for i in range(before, filled):
                        _fill_limits(
                            tables.galaxy, tables.agn, tables.dust, limits, lanes.pending_limit, z,
                            index[2, i], k, i,
                        )  # fmt: skip
            r += 1
            n_run = np.int64(0)
            if not whole:
                continue
        top = -1.0
        if limits is not None:
            while True:
                top, over = limited_likelihoods(
                    buffer, lanes.limited, lanes.left, lanes.light, lanes.power, lanes.power32,
                    lanes.limit, lanes.limit_light, weight, tables.ratio, tables.prior_frac, first,
                    best[2], request.scale_error, frac_sum, limits.level, limits.dark,
                    request.delta, single,
                )  # fmt: skip
                if over < 200.0:
                    break
                # far better than the reference, which is found without regard to most limits
                add_points(tables.points, sums.hist, waiting)
                waiting = np.int64(0)
                best[2] += 2.0 * over
                factor = math.exp(-min(over, 700.0))
                rescale(sums.flat, sums.hist.flat, sums.draws.next, galaxy_z, agn_z, factor)
        elif light:
            top = light_likelihoods(
                buffer, lanes.light, lanes.power, lanes.power32, tables.ratio,
                tables.prior_frac, first, best[2], request.scale_error, frac_sum,
            )  # fmt: skip
        else:
            top = likelihoods(
                buffer, lanes.power, weight, tables.ratio, tables.prior_frac, first, best[2],
                request.scale_error, frac_sum,
            )  # fmt: skip
        if top >= best[0]:
            find_best(
                tables.ratio, tables.prior_frac, first, limits, best, sums.index, lanes, z_now
            )
        before = total[0]
        added = add_all(buffer, frac_sum, sums.zf, z_now, first, total, best)
        if k >= 0:
            add_block(
                buffer, tiles, blocks, tables.agn, tables.mixed_agn, z_now, block, k, galaxy_z,
                agn_z, sums.band, total,
            )  # fmt: skip
        else:
            add_gathered(
                buffer, index, tables.galaxy, tables.agn, tables.mixed_galaxy, tables.mixed_agn,
                z_now, galaxy_z, agn_z, sums.band, total,
                request.thin * (before + added) / n_listed,
            )  # fmt: skip
        if sums.gk.size + sums.fg.size + sums.fk.size > 0:
            add_joint(sums.gk, sums.fg, sums.fk, lanes, light, first, tables.ratio.size)
        if sums.draws.next.size > 0:
            draw_lanes(
                tables.ratio, first, limits, sums.draws, lanes, light, z_now, before, total[0]
            )
        waiting = deposit_lanes(
            tables.points, limits, sums.hist, lanes, light, total[0], added, waiting
        )
    add_points(tables.points, sums.hist, waiting)
