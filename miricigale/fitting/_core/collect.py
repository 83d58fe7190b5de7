"""What models add to the sums: the best one, histograms, draws."""

import math

import numpy as np

from miricigale.fitting._core.histogram import (
    HALF_BINS,
    N_BINS,
    PER_DEX,
    POINTS,
    add_share,
    fill_log10,
)
from miricigale.fitting._core.lanes import LANES, PRIOR, W0, X2, A, B, P, Q, lane_model
from miricigale.fitting._core.light import pair_weight
from miricigale.fitting._core.options import EXACT, INNER, ONCE
from miricigale.fitting._core.products import best_mixture
from miricigale.utils.compilation import njit

__all__ = [
    "PARTS",
    "add_points",
    "deposit_lanes",
    "deposit_single",
    "draw_lanes",
    "find_best",
    "note_best",
    "take_draw",
]

#: Parts of the weight so far by which light models are sampled for the histograms ...
PARTS = 10_000.0
#: ... and how many of them a pair must have to go there with all its fractions.
_HEAVY = 8.0
_LOG10_E = 0.43429448190325183


@njit(**INNER)
def note_best(best, index, r, s, z, g, k, f):
    """Keep the best model; of equals the one with the lowest indices."""
    if r < best[0]:
        return
    if r == best[0] and index[0] >= 0:
        # compare (z, g, f, k), so that f = 0 comes before its copies
        if z != index[0]:
            if z > index[0]:
                return
        elif g != index[1]:
            if g > index[1]:
                return
        elif f != index[3]:
            if f > index[3]:
                return
        elif k >= index[2]:
            return
    best[0] = r
    best[1] = s
    index[0] = z
    index[1] = g
    index[2] = k
    index[3] = f


@njit(**ONCE)
def find_best(ratio, frac_prior, zero_frac, limits, best, index, lanes, z):
    """Look for the best model among the lanes."""
    buffer = lanes.buffer
    for i in range(LANES):
        if buffer[PRIOR + i] < -1e200:
            continue
        r = best_mixture(
            buffer[P + i], buffer[Q + i], 0.5 * buffer[X2 + i], buffer[A + i], buffer[B + i],
            ratio[0], ratio[-1],
        )  # fmt: skip
        if r * (1.0 + 1e-12) < best[0]:
            continue
        for j in range(ratio.size):
            if not frac_prior[j + zero_frac] > 0.0:
                continue
            s, r, _ = lane_model(lanes, limits, ratio[j], i, best[0])
            if r >= best[0]:
                g, k = lanes.index[0, i], lanes.index[1, i]
                note_best(best, index, r, s, z, g, k, j + zero_frac)


@njit(**INNER)
def _add_bin(hist, bins, row, y, t):
    """Share a weight between the two bins whose middles are nearest to y, in bins."""
    y = min(max(y - 0.5, 0.0), N_BINS - 2.0)
    column = np.int64(y)
    part = (y - column) * t
    hist[row, column] += t - part
    hist[row, column + 1] += part
    bins[row, 0] = min(bins[row, 0], column)
    bins[row, 1] = max(bins[row, 1], column + 1)


@njit(**INNER)
def add_points(tables, hist, n):
    """Add n models, of which ``hist.values`` holds the scale."""
    point, values, logs = hist.point, hist.values, hist.logs
    for i in range(n):
        g, k, j = point[0, i], point[1, i], point[2, i]
        power = tables.ratio[j] * tables.dust[g] * tables.mixed_agn[k]
        values[n + i] = values[i] * (tables.mixed_galaxy[g] + power)
    fill_log10(values, hist.power, logs, 2 * n)
    galaxy_middle = HALF_BINS - PER_DEX * hist.origin[0]
    agn_middle = HALF_BINS - PER_DEX * hist.origin[1]
    mixed_middle = HALF_BINS - PER_DEX * hist.origin[2]
    for i in range(n):
        g, k, j = point[0, i], point[1, i], point[2, i]
        t = hist.weight[i]
        y = tables.share_galaxy[g] * tables.share_agn[k]
        low, high = y * tables.edge[j, 0], y * tables.edge[j, 1]
        add_share(hist.share, low / (1.0 + low), high / (1.0 + high), t)
        if values[i] == 0.0:
            continue
        y = logs[i] * PER_DEX
        _add_bin(hist.galaxy, hist.range_galaxy, g, y + galaxy_middle, t)
        if tables.dust[g] > 0.0:
            y += tables.log_ratio[j] + PER_DEX * tables.log_dust[g] + agn_middle
            _add_bin(hist.agn, hist.range_agn, k, y, t)
        if values[n + i] > 0.0:
            y = logs[n + i] * PER_DEX + mixed_middle
            # typed, for a literal 0 would have it compiled once more
            _add_bin(hist.mixed, hist.range_mixed, np.int64(0), y, t)


@njit(**INNER)
def deposit_single(tables, hist, g, s, t):
    """Put a model without AGN into the histograms."""
    # what is spread over the cell of f = 0 need not be as many pieces as there are tori
    y = tables.edge_zero * tables.share_mean * tables.share_galaxy[g]
    add_share(hist.share, 0.0, y / (1.0 + y), t)
    if s > 0.0:
        y = _LOG10_E * math.log(s)
        x = (y - hist.origin[0]) * PER_DEX + HALF_BINS
        _add_bin(hist.galaxy, hist.range_galaxy, g, x, t)
        if tables.mixed_galaxy[g] > 0.0:
            y += _LOG10_E * math.log(tables.mixed_galaxy[g]) - hist.origin[2]
            _add_bin(hist.mixed, hist.range_mixed, np.int64(0), y * PER_DEX + HALF_BINS, t)


@njit(**ONCE)
def deposit_lanes(tables, limits, hist, lanes, single, total, added, n):
    """
    Note models in the lanes for the histograms; `add_points` puts them there.

    Heavy pairs go there with all their fractions. Of the light ones' weight, summed up from model
    to model, every ``PARTS``-th part of the weight so far goes to the model that it is full with
    (systematic sampling, proportional to weight). ``added`` is the weight of all lanes;
    ``n`` models wait already, and returned is how many do now.
    """
    buffer, index, ratio = lanes.buffer, lanes.index, tables.ratio
    part = total / PARTS
    carry = hist.carry[0]
    if carry + added < part:
        hist.carry[0] += added
        return n
    for i in range(LANES):
        w = buffer[W0 + i]
        if not w > 0.0 or buffer[PRIOR + i] < -1e200:
            continue
        whole = w >= _HEAVY * part
        if not whole and carry + w < part:
            carry += w
            continue
        for j in range(ratio.size):
            t = pair_weight(lanes, single, j, i)
            if not whole:
                carry += t
                if carry < part:
                    continue
                # a model has less than all of it: as many parts as there are
                t = part * math.floor(carry / part)
                carry -= t
            if not t > 0.0:
                continue
            s, _, _ = lane_model(lanes, limits, ratio[j], i, 0.0)
            hist.point[0, n] = index[0, i]
            hist.point[1, n] = index[1, i]
            hist.point[2, n] = j
            hist.weight[n] = t
            hist.values[n] = s
            n += 1
            if n == POINTS:
                add_points(tables, hist, n)
                n = np.int64(0)
    hist.carry[0] = carry
    return n


@njit(**EXACT)
def _uniform(state):
    """Next of the random numbers in (0, 1] (splitmix64; Steele et al. 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    x = state[0]
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return (np.float64(x >> np.uint64(11)) + 1.0) / 9007199254740992.0


@njit(**INNER)
def take_draw(draws, d, total, z, g, k, f, s, variance):
    """
    Replace draw d by a model, ``total`` being the weight of all models so far and this one.

    A sample of one that gives way to model i with the probability of its weight over the sum so
    far is a draw from all of them; it stays until the sum has grown by 1 / u, u uniform.
    """
    draws.index[d, 0] = z
    draws.index[d, 1] = g
    draws.index[d, 2] = k
    draws.index[d, 3] = f
    draws.scale[d, 0] = s
    draws.scale[d, 1] = variance
    draws.next[d] = total / _uniform(draws.state)


@njit(**ONCE)
def draw_lanes(ratio, zero_frac, limits, draws, lanes, single, z, before, after):
    """Let the models in the lanes replace draws; sums of weight are given before and after."""
    buffer = lanes.buffer
    for d in range(draws.next.size):
        while draws.next[d] <= after:
            total = before
            lane = -1
            for i in range(LANES):
                w = buffer[W0 + i]
                if not w > 0.0 or buffer[PRIOR + i] < -1e200:
                    continue
                # rounding may leave the last one short
                lane = i
                if total + w >= draws.next[d]:
                    break
                total += w
            if lane < 0:
                break
            f = -1
            for j in range(ratio.size):
                t = pair_weight(lanes, single, j, lane)
                if not t > 0.0:
                    continue
                f = j
                total += t
                if total >= draws.next[d]:
                    break
            if f < 0:
                break
            g, k = lanes.index[0, lane], lanes.index[1, lane]
            s, _, variance = lane_model(lanes, limits, ratio[f], lane, 0.0)
            take_draw(draws, d, max(total, draws.next[d]), z, g, k, f + zero_frac, s, variance)
