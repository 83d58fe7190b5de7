"""What light, dark current and particles do to the charge of a ramp."""

import math

import numpy as np

from miricigale.detector._core.random import (
    GUIDE,
    PTRS_FROM,
    advance,
    fill_normals,
    fill_table,
    poisson,
    poisson_inversion,
    ptrs,
    ptrs_constants,
    seed_stream,
    table_lookup,
    uniform,
)
from miricigale.utils.compilation import njit

#: Greatest mean for which a draw is done; beyond it a pixel is saturated a thousandfold.
_MEAN_MAX = 1e9


#: Draws of a pixel's mean from which a table of it is worth its making.
_TABLE_DRAWS = 64

#: Greatest mean with a table.
_TABLE_MEAN = 2.0**14

# tables at hand: of means in steps of 1 / 1024 of an octave or more, and of the small means between them
_COARSE = 512
_FINE = 32

#: What is left of a mean, in electrons, that is drawn as single events.
_REST = 0.25

# pixels of a row whose groups are drawn before they are added
_PIXELS = 16


@njit(inline="always")
def _node(mean):
    """Split a mean into that of a coarse table, the number of this table, and the rest."""
    _, octave = math.frexp(mean)
    step = max(2.0 ** (octave - 11), 1.0 / 16.0)
    number = int(mean / step)
    return number * step, number & (_COARSE - 1), mean - number * step


@njit(inline="always")
def _add_tabulated(s0, s1, s2, s3, mean, slot, tables, out):
    """Add a draw of a mean to each of ``out``; the table in ``slot`` is made if it has another mean."""
    means, first, steps, guide = tables
    if means[slot] != mean:
        first[slot], _ = fill_table(mean, steps[slot], guide[slot])
        means[slot] = mean
    step = steps[slot]
    entry = guide[slot]
    smallest = first[slot]
    for g in range(out.size):
        s0, s1, s2, s3, bits = advance(s0, s1, s2, s3)
        out[g] += smallest + table_lookup(bits, step, entry)
    return s0, s1, s2, s3


@njit(inline="always")
def _add_single(state, mean, out):
    """Add a draw of a mean to each of ``out``, without a table."""
    if mean < PTRS_FROM:
        p0 = math.exp(-mean)
        for g in range(out.size):
            out[g] += poisson_inversion(uniform(state), mean, p0)
        return
    constants = ptrs_constants(mean)
    for g in range(out.size):
        out[g] += ptrs(state, mean, constants)


@njit()
def _draw_groups(state, mean, tables, out):
    """
    Fill ``out`` (n_group,) with Poisson numbers of a mean.

    The mean is the sum of those of one or two tables and of a rest, whose events are as many as
    all groups have together, each in a group of its own choice: a sum of Poisson numbers is one.
    """
    n_group = out.size
    out[:] = 0.0
    if tables[0].size == 0 or mean > _TABLE_MEAN:
        _add_single(state, mean, out)
        return
    s0 = state[0]
    s1 = state[1]
    s2 = state[2]
    s3 = state[3]
    node, slot, remainder = _node(mean)
    if node > 0.0:
        s0, s1, s2, s3 = _add_tabulated(s0, s1, s2, s3, node, slot, tables, out)
    number = int(remainder / _REST)
    if number > 0:
        slot = _COARSE + number
        s0, s1, s2, s3 = _add_tabulated(s0, s1, s2, s3, number * _REST, slot, tables, out)
        remainder -= number * _REST
    state[0] = s0
    state[1] = s1
    state[2] = s2
    state[3] = s3
    for _ in range(int(poisson(state, remainder * n_group))):
        out[min(int(uniform(state) * n_group), n_group - 1)] += 1.0


@njit()
def add_poisson(ramp, mean, key, first_row):
    """Add charge that arrives at random: ``mean`` electrons per group, (n_row, n_col)."""
    n_int, n_group, n_row, n_col = ramp.shape
    state = np.empty(4, np.uint64)
    columns = np.empty(n_col, np.int64)
    drawn = np.empty((_PIXELS, n_group))
    total = np.empty(_PIXELS)
    n_table = _COARSE + _FINE if n_int * n_group >= _TABLE_DRAWS else 0
    # wide enough for the distribution of the greatest mean, out to a part in 10^20
    width = 32
    if n_table > 0:
        for r in range(n_row):
            for x in range(n_col):
                if mean[r, x] > 0.0:
                    width = max(width, 32 + int(21.0 * math.sqrt(min(mean[r, x], _TABLE_MEAN))))
    tables = (
        np.full(n_table, -1.0),
        np.empty(n_table, np.int64),
        np.empty((n_table, width), np.int64),
        np.empty((n_table, GUIDE), np.int16),
    )
    for r in range(n_row):
        # pixels without light draw nothing
        n = 0
        for x in range(n_col):
            if mean[r, x] > 0.0:
                columns[n] = x
                n += 1
        if n == 0:
            continue
        gaps = columns[n - 1] - columns[0] > n - 1
        for i in range(n_int):
            seed_stream(state, key, i, first_row + r)
            for m in range(0, n, _PIXELS):
                part = min(_PIXELS, n - m)
                for j in range(part):
                    mean_charge = min(mean[r, columns[m + j]], _MEAN_MAX)
                    _draw_groups(state, mean_charge, tables, drawn[j])
                total[:] = 0.0
                for g in range(n_group):
                    row = ramp[i, g, r]
                    for j in range(part):
                        total[j] += drawn[j, g]
                    if gaps:
                        for j in range(part):
                            row[columns[m + j]] += np.float32(total[j])
                    else:
                        x = columns[m]
                        for j in range(part):
                            row[x + j] += np.float32(total[j])


@njit()
def add_latent(ramp, rates, released, key, first_row):
    """
    Add charge that earlier exposures left.

    ``rates`` (n_latent, n_row, n_col) are the former rates, ``released`` (n_latent, n_int, n_group)
    the expected electrons in each group for a former rate of one.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    n_latent = rates.shape[0]
    state = np.empty(4, np.uint64)
    for r, i in np.ndindex(n_row, n_int):
        seed_stream(state, key, i, first_row + r)
        for x in range(n_col):
            total = 0.0
            for g in range(n_group):
                mean = 0.0
                for k in range(n_latent):
                    mean += rates[k, r, x] * released[k, i, g]
                if mean > 0.0:
                    total += poisson(state, min(mean, _MEAN_MAX))
                ramp[i, g, r, x] += np.float32(total)


@njit()
def _push(deposits, n, slot, head, row, col, charge):
    """Append one deposit to the list of its group; returns the (grown) list and its length."""
    if n == deposits.shape[0]:
        # by hand: an assignment of slices takes seconds to compile
        deposits = np.concatenate((deposits, np.empty_like(deposits)))
    deposits[n, 0] = head[slot]
    deposits[n, 1] = row
    deposits[n, 2] = col
    deposits[n, 3] = charge
    head[slot] = n
    return deposits, n + 1


@njit()
def _add_track(x, y, dx, dy, charge, leakage, first_row, n_row, n_col, slot, deposits, n, head):
    """Append what a straight track of ``charge`` leaves in each pixel that it crosses and in the neighbors."""
    last_row = first_row + n_row
    # walk from pixel to pixel (Amanatides & Woo 1987); places along the track are parts of its length
    px = math.floor(x)
    py = math.floor(y)
    step_x = 1 if dx > 0.0 else -1
    step_y = 1 if dy > 0.0 else -1
    next_x = ((px + (step_x > 0)) - x) / dx if dx != 0.0 else math.inf
    next_y = ((py + (step_y > 0)) - y) / dy if dy != 0.0 else math.inf
    done = 0.0
    while done < 1.0:
        to = min(next_x, next_y, 1.0)
        q = charge * (to - done)
        done = to
        if abs(py - first_row) <= n_row + 1 and q > 0.0:
            for k in range(5):
                cx = px + (k == 1) - (k == 2)
                cy = py + (k == 3) - (k == 4)
                share = 1.0 - 4.0 * leakage if k == 0 else leakage
                if 0 <= cx < n_col and first_row <= cy < last_row and share > 0.0:
                    deposits, n = _push(deposits, n, slot, head, cy - first_row, cx, q * share)
        if next_x <= next_y:
            px += step_x
            next_x += abs(1.0 / dx) if dx != 0.0 else math.inf
        else:
            py += step_y
            next_y += abs(1.0 / dy) if dy != 0.0 else math.inf
    return deposits, n


@njit()
def _deposits(key, first_row, n_detector_rows, n_row, n_col, n_slot, settings):
    """
    Draw cosmic-ray hits of some rows, in all ``n_slot`` groups.

    ``settings`` are ten numbers; ``hits_per_row`` hits are expected in a row and all groups.

    ``thickness`` of the layer and ``track_max`` are in pixels; ``yield_median`` is in electrons per
    pixel of path and ``yield_sigma`` the scatter of its natural logarithm. ``leakage`` is the share
    of a deposit that goes to each of the four neighbors. A ``shower_fraction`` of the hits that leave
    ``shower_above`` electrons or more make a shower of ``shower_charge`` electrons and a Gaussian
    width of ``shower_sigma`` pixels.

    Returns the deposits (next of the same group, row, column, electrons), their number, and the
    first of each group; -1 ends a list.
    """
    hits_per_row, thickness, yield_median, yield_sigma, track_max, leakage = settings[:6]
    shower_fraction, shower_charge, shower_sigma, shower_above = settings[6:]
    reach = math.ceil(track_max) + 2
    if shower_fraction > 0.0:
        reach = max(reach, math.ceil(3.0 * shower_sigma) + 1)
    deposits = np.empty((1024, 4))
    head = np.full(n_slot, -1, np.int64)
    n = 0
    state = np.empty(4, np.uint64)
    normal = np.empty(1)
    last_row = first_row + n_row
    for row in range(max(0, first_row - reach), min(n_detector_rows, last_row + reach)):
        seed_stream(state, key, 0, row)
        for _hit in range(int(poisson(state, hits_per_row))):
            # every hit uses the same draws up to here, shower or not
            slot = min(int(uniform(state) * n_slot), n_slot - 1)
            x = uniform(state) * n_col
            y = row + uniform(state)
            # isotropic flux through a plane: p(cos) = 2 cos
            cos2 = uniform(state)
            azimuth = 2.0 * math.pi * uniform(state)
            fill_normals(state, normal)
            strength = math.exp(yield_sigma * normal[0])
            shower = uniform(state) < shower_fraction
            length = min(thickness * math.sqrt((1.0 - cos2) / cos2), track_max)
            dx = length * math.cos(azimuth)
            dy = length * math.sin(azimuth)
            charge = yield_median * strength * math.sqrt(thickness**2 + length**2)
            shower &= charge >= shower_above
            deposits, n = _add_track(
                x, y, dx, dy, charge, leakage, first_row, n_row, n_col, slot, deposits, n, head
            )
            if shower:
                peak = shower_charge * strength / (2.0 * math.pi * shower_sigma**2)
                r = math.ceil(3.0 * shower_sigma)
                iy = math.floor(y)
                ix = math.floor(x)
                for cy in range(max(iy - r, first_row), min(iy + r + 1, last_row)):
                    for cx in range(max(ix - r, 0), min(ix + r + 1, n_col)):
                        d2 = (cy + 0.5 - y) ** 2 + (cx + 0.5 - x) ** 2
                        q = peak * math.exp(-0.5 * d2 / shower_sigma**2)
                        deposits, n = _push(deposits, n, slot, head, cy - first_row, cx, q)
    return deposits, n, head


@njit()
def add_cosmic_rays(ramp, key, first_row, n_detector_rows, settings):
    """Add the charge of cosmic-ray hits; ``settings`` are those of `_deposits`."""
    n_int, n_group, n_row, n_col = ramp.shape
    deposits, _, head = _deposits(
        key, first_row, n_detector_rows, n_row, n_col, n_int * n_group, settings
    )
    plane = np.zeros((n_row, n_col), np.float32)
    for i in range(n_int):
        plane[:] = 0.0
        for g in range(n_group):
            k = head[i * n_group + g]
            while k >= 0:
                plane[int(deposits[k, 1]), int(deposits[k, 2])] += np.float32(deposits[k, 3])
                k = int(deposits[k, 0])
            for r in range(n_row):
                for x in range(n_col):
                    ramp[i, g, r, x] += plane[r, x]


@njit()
def cosmic_ray_deposits(key, first_row, n_detector_rows, shape, settings):
    """
    List what `add_cosmic_rays` would add to a ramp of a ``shape``.

    Returns the group (counted through all integrations), the row of the block and the column of
    each deposit, (3, n), and its electrons (n,), in the order of the groups.
    """
    n_int, n_group, n_row, n_col = shape
    deposits, n, head = _deposits(
        key, first_row, n_detector_rows, n_row, n_col, n_int * n_group, settings
    )
    places = np.empty((3, n), np.int32)
    charge = np.empty(n)
    m = 0
    for slot in range(head.size):
        k = head[slot]
        while k >= 0:
            places[0, m] = slot
            places[1, m] = int(deposits[k, 1])
            places[2, m] = int(deposits[k, 2])
            charge[m] = deposits[k, 3]
            m += 1
            k = int(deposits[k, 0])
    return places, charge


@njit()
def couple_neighbors(ramp, kernel):
    """
    Replace each pixel by the sum of its 3 x 3 neighbors, weighted by a float32 kernel (3, 3).

    At an edge the missing neighbor is the pixel nearest to it, so that a symmetric
    kernel of sum 1 keeps a uniform field.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    padded = np.empty((n_row + 2, n_col + 2), np.float32)
    for i, g in np.ndindex(n_int, n_group):
        # in loops: copies of whole arrays take seconds to compile, for their message of other shapes
        for r in range(n_row + 2):
            row = min(max(r - 1, 0), n_row - 1)
            padded[r, 0] = ramp[i, g, row, 0]
            for x in range(n_col):
                padded[r, x + 1] = ramp[i, g, row, x]
            padded[r, n_col + 1] = ramp[i, g, row, n_col - 1]
        for r in range(n_row):
            for x in range(n_col):
                total = np.float32(0.0)
                for dy in range(3):
                    for dx in range(3):
                        total += kernel[dy, dx] * padded[r + dy, x + dx]
                ramp[i, g, r, x] = total
