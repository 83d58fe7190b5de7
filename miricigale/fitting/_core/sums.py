"""What models add to the sums: moments, the best one, joint sums, histograms, draws."""

import math

import numpy as np

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.batched_pairs import best_mixture, best_scale
from miricigale.fitting._core.histogram import add_model
from miricigale.fitting._core.single import pair_weight
from miricigale.fitting._core.structs import BLOCK
from miricigale.utils.compilation import PART, njit

#: Parts of the weight so far by which light models are sampled for the histograms ...
PARTS = 16_000.0
# ... and how many of them a pair must have to go there with all its fractions.
_HEAVY = 8.0


@njit(**PART)
def _model(tables, limits, lanes, z, i, j, floor):
    """Do what `best_scale` does for the pair in lane i at fraction j."""
    buffer = lanes.buffer
    c = tables.of_frac[at.RATIO, j]
    p = buffer[at.P + i] + c * buffer[at.A + i]
    q = buffer[at.Q + i] + c * (buffer[at.X2 + i] + c * buffer[at.B + i])
    galaxy = tables.galaxy[z, lanes.index[0, i]]
    agn = tables.agn[z, lanes.index[1, i]]
    return best_scale(limits, p, q, galaxy, agn, c * buffer[at.POWER + i], floor)


@njit(**PART)
def keep_best(sums, r, s, z, g, k, f):
    """Keep the best model; of equals the one with the lowest indices."""
    best = sums.best
    index = sums.index
    # the order is that of (z, g, f, k), so that f = 0 comes before its copies
    last = (index[0], index[1], index[3], index[2])
    if r < best[0] or (r == best[0] and index[0] >= 0 and (z, g, f, k) >= last):
        return
    best[0] = r
    best[1] = s
    index[0] = z
    index[1] = g
    index[2] = k
    index[3] = f


@njit(**PART)
def find_best(tables, limits, lanes, sums, z, level):
    """Look for the best model among the lanes; ``level`` is what R lacks to those of other redshifts."""
    buffer = lanes.buffer
    of_frac = tables.of_frac
    best = sums.best
    for i in range(BLOCK):
        if buffer[at.PRIOR + i] < -1e200:
            continue
        _, r = best_mixture(
            buffer[at.P + i], buffer[at.Q + i], 0.5 * buffer[at.X2 + i], buffer[at.A + i], buffer[at.B + i],
            of_frac[at.RATIO, 0], of_frac[at.RATIO, -1], 1e-300,
        )  # fmt: skip
        if r * (1.0 + 1e-12) + level < best[0]:
            continue
        for j in range(of_frac.shape[1]):
            if not of_frac[at.PRIOR_FRAC, j] > 0.0:
                continue
            s, r, _ = _model(tables, limits, lanes, z, i, j, best[0] - level)
            keep_best(
                sums, r + level, s, z, lanes.index[0, i], lanes.index[1, i], j + tables.zero_frac
            )


@njit(**PART)
def _finish(flux, of_redshift, joint, z, total, band):
    """Add the sums of galaxies or AGN models over one redshift to those over all, and begin anew."""
    for i in range(flux.shape[0]):
        if not of_redshift[0, i] > 0.0:
            continue
        if joint.size > 0:
            joint[z, i] += of_redshift[0, i]
        for b in range(band.shape[1]):
            t = flux[i, b]
            band[0, b] += of_redshift[1, i] * t
            band[1, b] += of_redshift[2, i] * t * t
        for m in range(3):
            total[i, m] += of_redshift[m, i]
            of_redshift[m, i] = 0.0


@njit(**PART)
def finish_redshift(tables, lanes, sums, z):
    """Add what was summed up over one redshift to the sums over all, and begin anew."""
    joint = sums.joint
    _finish(tables.galaxy[z], lanes.galaxy_z, joint.zg, z, sums.galaxy, sums.band)
    _finish(tables.agn[z], lanes.agn_z, joint.zk, z, sums.agn, sums.band)


@njit(**PART)
def add_pairs(tables, lanes, sums, z, thin):
    """
    Add the pairs in the lanes; returns their weight.

    Those of a weight below ``thin`` times that of all pairs so far are left out of the correlation of
    galaxy and AGN in model fluxes, and of nothing else.
    """
    buffer = lanes.buffer
    frac_sum = lanes.frac_sum
    total = sums.total
    galaxy_z = lanes.galaxy_z
    agn_z = lanes.agn_z
    band = sums.band
    for j in range(frac_sum.size):
        sums.zf[z, j + tables.zero_frac] += frac_sum[j]
    weight = 0.0
    total_r = 0.0
    total_zero = 0.0
    share_1 = 0.0
    share_2 = 0.0
    for i in range(BLOCK):
        weight += buffer[at.W0 + i]
        total_r += buffer[at.WR + i]
        total_zero += buffer[at.WZ + i]
        share_1 += buffer[at.F1 + i]
        share_2 += buffer[at.F2 + i]
    total[0] += weight
    total[1] += total_r
    total[2] += total_zero
    total[4] += share_1
    total[5] += share_2
    min_weight = thin * total[0]
    total_cross = 0.0
    for i in range(BLOCK):
        w = buffer[at.W0 + i]
        if not w > 0.0 or buffer[at.PRIOR + i] < -1e200:
            continue
        g = lanes.index[0, i]
        k = lanes.index[1, i]
        power = buffer[at.POWER + i]
        cross = buffer[at.U2 + i] * power
        total_cross += cross * tables.of_galaxy[at.MIXED_GALAXY, g] * tables.of_agn[at.MIXED_AGN, k]
        galaxy_z[0, g] += w
        galaxy_z[1, g] += buffer[at.W1 + i]
        galaxy_z[2, g] += buffer[at.W2 + i]
        agn_z[0, k] += w
        agn_z[1, k] += buffer[at.V1 + i] * power
        agn_z[2, k] += buffer[at.V2 + i] * power * power
        if w > min_weight:
            cross *= 2.0
            for m in range(band.shape[1]):
                band[1, m] += cross * tables.galaxy[z, g, m] * tables.agn[z, k, m]
    total[3] += total_cross
    return weight


@njit(**PART)
def add_joint(joint, lanes, single, first, n_ratio):
    """Add to the joint sums that were asked for."""
    gk = joint.gk
    fg = joint.fg
    fk = joint.fk
    for i in range(BLOCK):
        w = lanes.buffer[at.W0 + i]
        if not w > 0.0 or lanes.buffer[at.PRIOR + i] < -1e200:
            continue
        g = lanes.index[0, i]
        k = lanes.index[1, i]
        if gk.size > 0:
            gk[g, k] += w
        for j in range(n_ratio):
            if fg.size > 0:
                fg[j + first, g] += pair_weight(lanes, single, j, i)
            if fk.size > 0:
                fk[j + first, k] += pair_weight(lanes, single, j, i)


@njit(**PART)
def deposit(tables, limits, lanes, sums, single, z, added):
    """
    Put models in the lanes into the histograms.

    Heavy pairs go there with all their fractions. Of the light ones' weight, summed up from model
    to model, every ``PARTS``-th part of the weight so far goes to the model that it is full with
    (systematic sampling, proportional to weight). ``added`` is the weight of all lanes.
    """
    buffer = lanes.buffer
    index = lanes.index
    of_frac = tables.of_frac
    part = sums.total[0] / PARTS
    carry = sums.total[6]
    if carry + added < part:
        sums.total[6] += added
        return
    for i in range(BLOCK):
        w = buffer[at.W0 + i]
        if not w > 0.0 or buffer[at.PRIOR + i] < -1e200:
            continue
        is_heavy = w >= _HEAVY * part
        if not is_heavy and carry + w < part:
            carry += w
            continue
        for j in range(of_frac.shape[1]):
            t = pair_weight(lanes, single, j, i)
            if not is_heavy:
                carry += t
                if carry < part:
                    continue
                # a model has less than all of it: as many parts as there are
                t = part * math.floor(carry / part)
                carry -= t
            if t > 0.0:
                s, _, _ = _model(tables, limits, lanes, z, i, j, 0.0)
                add_model(tables, sums.hist, index[0, i], index[1, i], j, s, t)
    sums.total[6] = carry


@njit(**PART)
def _uniform(state):
    """Next of the random numbers in (0, 1] (splitmix64; Steele et al. 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    x = state[0]
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return (np.float64(x >> np.uint64(11)) + 1.0) / 9007199254740992.0


@njit(**PART)
def take_draw(draws, d, total, z, g, k, f, s, variance):
    """
    Replace draw d by a model, ``total`` being the weight of all models so far and this one.

    A sample of one that gives way to model i with the probability of its weight over the sum so
    far is a draw from all of them; it stays until the sum has grown by 1 / u, u uniform.
    """
    index = draws.index[d]
    index[0] = z
    index[1] = g
    index[2] = k
    index[3] = f
    draws.scale[d, 0] = s
    draws.scale[d, 1] = variance
    draws.next[d] = total / _uniform(draws.state)


@njit(**PART)
def draw(tables, limits, lanes, sums, single, z, before):
    """Let the models in the lanes replace draws; the sum of weight was ``before``."""
    buffer = lanes.buffer
    of_frac = tables.of_frac
    draws = sums.draws
    after = sums.total[0]
    for d in range(draws.next.size):
        while draws.next[d] <= after:
            total = before
            lane = -1
            for i in range(BLOCK):
                w = buffer[at.W0 + i]
                if not w > 0.0 or buffer[at.PRIOR + i] < -1e200:
                    continue
                # rounding may leave the last one short
                lane = i
                if total + w >= draws.next[d]:
                    break
                total += w
            if lane < 0:
                break
            f = -1
            for j in range(of_frac.shape[1]):
                t = pair_weight(lanes, single, j, lane)
                if not t > 0.0:
                    continue
                f = j
                total += t
                if total >= draws.next[d]:
                    break
            if f < 0:
                break
            g = lanes.index[0, lane]
            k = lanes.index[1, lane]
            s, _, variance = _model(tables, limits, lanes, z, lane, f, 0.0)
            reached = max(total, draws.next[d])
            take_draw(draws, d, reached, z, g, k, f + tables.zero_frac, s, variance)
