"""Models without AGN (f = 0), one for each galaxy and redshift, one by one."""

import math

import numpy as np

from miricigale.fitting._core.histogram import add_model
from miricigale.fitting._core.lanes import best_scale, galaxy_products
from miricigale.fitting._core.structs import BLOCK, KERNEL
from miricigale.fitting._core.sums import PARTS, finish_redshift, keep_best, take_draw
from miricigale.utils.compilation import njit

__all__ = ["evaluate_alone"]

# Models so far below the best are not looked at for a reference.
_NEAR = 50.0


@njit(**KERNEL)
def evaluate_alone(tables, target, limits, pairs, lanes, sums, delta, scale_error):
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
                    galaxy = tables.galaxy[z, g]
                    p, q = lanes.pq[0, g], lanes.pq[1, g]
                    s, r, inverse = best_scale(limits, p, q, galaxy, galaxy, 0.0, 0.0)
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
                        add_model(tables, sums.hist, g, np.int64(-1), np.int64(0), s, carry)
                        carry = 0.0
            if some:
                finish_redshift(tables, lanes, sums, z)
