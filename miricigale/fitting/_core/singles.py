"""Models without AGN, one for each galaxy and redshift."""

import math

import numpy as np

from miricigale.fitting._core.bounds import BLOCK
from miricigale.fitting._core.collect import PARTS, deposit_single, note_best, take_draw
from miricigale.fitting._core.limits import limited_scale
from miricigale.fitting._core.options import INNER
from miricigale.fitting._core.products import galaxy_products
from miricigale.fitting._core.structs import NO_LIGHT
from miricigale.fitting._core.totals import finish_redshift
from miricigale.utils.compilation import njit

__all__ = ["evaluate_singles"]


@njit(**INNER)
def _model(galaxy, limits, p, q, slope):
    """Scale, R and variance of the scale of a galaxy with p = <G, wF> and q = <G, wG>."""
    # without light the scale is 0, and nothing is known of its error
    q = q if q > NO_LIGHT else 1.0 / NO_LIGHT
    s = max(p, 0.0) / q
    r = max(p, 0.0) * s
    inverse = 1.0 / q
    if limits is not None:
        for m in range(limits.bands.size):
            slope[m] = galaxy[limits.bands[m]] * limits.inverse[m]
        s, r, inverse = limited_scale(p, q, slope, limits.level, limits.dark)
    return s, r, inverse


@njit(**INNER)
def evaluate_singles(tables, request, target, limits, sums, scratch):
    """
    Add the models without AGN (f = 0), one for each galaxy and redshift, to the sums.

    Parameters
    ----------
    tables, request, target, limits, sums, scratch
        See `miricigale.fitting._core.structs`; `begin` was called, which projected the galaxies.
    """
    n_z, n_galaxy, _ = tables.galaxy.shape
    if tables.zero_frac == 0 or not tables.prior_frac[0] > 0.0:
        return
    slope, pq, galaxy_z = scratch.lanes.slope, scratch.pq, scratch.galaxy_z
    best, total, draws = sums.best, sums.total, sums.draws
    # nothing has been summed up yet: the best of these becomes the reference. And about what their
    # weights sum up to, for the histograms
    about = 0.0
    for z in range(n_z):
        prior = target.log_prior[z] + tables.log_frac[0]
        # what no galaxy of this redshift exceeds, priors being at most 1
        if scratch.promise[z] + tables.log_frac[0] + 1e-5 * target.norm < best[2] - 50.0:
            continue
        for block in range(tables.tiles.shape[1]):
            start = block * BLOCK
            known = False
            for i in range(min(BLOCK, n_galaxy - start)):
                p32 = max(scratch.p32[z, start + i], np.float32(0)) + 3e-6
                more = prior + tables.log_usable[z, start + i]
                if p32 * p32 * target.norm + more < best[2] - 50.0:
                    continue
                if not known:
                    known = True
                    galaxy_products(tables.tiles, z, block, target, pq)
                _, r, _ = _model(
                    tables.galaxy[z, start + i], limits, pq[0, block, i], pq[1, block, i], slope
                )
                value = r + more
                if value > best[2]:
                    about *= math.exp(0.5 * (best[2] - value))
                    best[2] = value
                about += math.exp(max(0.5 * (value - best[2]), -700.0))
    floor = best[2] - request.delta - tables.log_frac[0]
    carry = 0.0
    for z in range(n_z):
        log_prior = target.log_prior[z]
        if log_prior < -1e200:
            continue
        some = False
        for block in range(tables.tiles.shape[1]):
            start = block * BLOCK
            known = False
            for i in range(min(BLOCK, n_galaxy - start)):
                g = start + i
                prior = log_prior + tables.log_usable[z, g]
                p32 = max(scratch.p32[z, g], np.float32(0)) + 3e-6
                if p32 * p32 * target.norm + prior < floor:
                    continue
                if not known:
                    known = True
                    galaxy_products(tables.tiles, z, block, target, pq)
                s, r, inverse = _model(
                    tables.galaxy[z, g], limits, pq[0, block, i], pq[1, block, i], slope
                )
                note_best(best, sums.index, r, s, z, g, np.int64(0), np.int64(0))
                prior += tables.log_frac[0]
                t = math.exp(max(0.5 * (r + prior - best[2]), -700.0))
                some = True
                galaxy_z[0, block, i] += t
                galaxy_z[1, block, i] += t * s
                galaxy_z[2, block, i] += t * (s * s + request.scale_error * inverse)
                sums.zf[z, 0] += t
                sums.alone[g] += t
                if sums.fg.size > 0:
                    sums.fg[0, g] += t
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
                    deposit_single(tables.points, sums.hist, g, s, carry)
                    carry = 0.0
        if some:
            finish_redshift(
                tables.tiles, tables.agn, galaxy_z, scratch.agn_z, sums.galaxy, sums.agn, sums.band,
                sums.zg, sums.zk, z,
            )  # fmt: skip
