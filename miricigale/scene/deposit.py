"""Light of Sersic profiles on the nodes of a grid, by as many threads as there are."""

import math

import numpy as np

from miricigale.scene import _core
from miricigale.utils.parallel import chunks, parallel_map, threads

#: Rows that one task owns; fixed, so that threads change nothing.
_ROWS = 64

#: Nodes in double precision that the cusps of one batch of sources take.
_BATCH = 2_000_000

#: The smooth part begins so many nodes from the center along a row and across the major axis,
#: and where the brightness changes by less than these fractions from node to node: the error is
#: below 3e-5 of the brightness there.
SMOOTH_ALONG = 40.0
SMOOTH_ACROSS = 16.0
SLOPE_ALONG = 0.075
SLOPE_ACROSS = 0.12


def smooth_from(rows, w_zone, w_cut):
    """
    Return the squared elliptical radius (N,) beyond which profiles are smooth for ``_core._add_smooth``.

    Infinite where they never are; parameters as of ``_core.fill_outskirts``.
    """
    a, b, c, power, bn = rows[:, 8:].T
    # the steepest direction, across the major axis
    steep = 0.5 * (a + c) + np.sqrt(0.25 * (a - c) ** 2 + b * b)
    inner = (np.sqrt(w_zone) + 4 * np.sqrt(steep)) ** 2
    w = np.maximum(inner, np.maximum(SMOOTH_ALONG**2 * a, SMOOTH_ACROSS**2 * steep))
    for scale, limit in ((a, SLOPE_ALONG), (steep, SLOPE_ACROSS)):
        # -d ln(brightness) per node is at most this times w^(power - 1/2)
        slope = 2 * power * bn * np.sqrt(scale)
        with np.errstate(divide="ignore", over="ignore"):
            bound = np.exp(np.log(limit / slope) / np.where(power == 0.5, 1.0, power - 0.5))
        # it grows outwards where n < 1
        fine = np.where(power == 0.5, slope <= limit, (power < 0.5) | (w_cut <= bound))
        w = np.where(fine, np.where(power < 0.5, np.maximum(w, bound), w), np.inf)
    return np.where(w < w_cut, w, np.inf)


def deposit_profiles(grid, rows, tables, w_zone, w_smooth, w_cut, land, *, n_threads):
    """
    Put Sersic profiles on the grid, in place, and return the light of each that lands on the image.

    Parameters are those of ``_core.fill_outskirts``.
    """
    with threads(n_threads) as executor:
        landed = _outskirts(grid, rows, tables, w_zone, w_smooth, w_cut, land, executor)
        landed += _cusps(grid, rows, tables, w_zone, land, executor)
    return landed


def _outskirts(grid, rows, tables, w_zone, w_smooth, w_cut, land, executor):
    def fill(part):
        landed = np.empty(len(rows))
        _core.fill_outskirts(
            grid, part.start, part.stop, rows, tables, w_zone, w_smooth, w_cut, land, landed
        )
        return landed

    # one after the other, as the rows come: sums do not depend on the threads
    landed = np.zeros(len(rows))
    for part in parallel_map(fill, chunks(grid.shape[0], _ROWS), executor=executor):
        landed += part
    return landed


def _cusps(grid, rows, tables, w_zone, land, executor):
    a = rows[:, 8]
    b = rows[:, 9]
    c = rows[:, 10]
    half = np.sqrt(w_zone / (a * c - b * b))
    box = np.empty((rows.shape[0], 4), dtype=np.int64)
    for m, (center, reach) in enumerate(((rows[:, 1], half * a**0.5), (rows[:, 0], half * c**0.5))):
        # a spline reaches two nodes beyond its cell
        box[:, 2 * m] = np.clip(np.floor(center - reach) - 3, 0, grid.shape[m])
        box[:, 2 * m + 1] = np.clip(np.ceil(center + reach) + 4, 0, grid.shape[m])

    def fill(k):
        i0, i1, j0, j1 = box[k]
        part = np.zeros((i1 - i0, j1 - j0))
        _core.fill_cusp(part, i0, j0, grid.shape[1], rows[k], tables[k], w_zone[k])
        return part

    landed = np.zeros(rows.shape[0])
    drawn = np.flatnonzero((box[:, 1] > box[:, 0]) & (box[:, 3] > box[:, 2]))
    sizes = (box[drawn, 1] - box[drawn, 0]) * (box[drawn, 3] - box[drawn, 2])
    for batch in np.array_split(drawn, max(1, math.ceil(sizes.sum() / _BATCH))):
        parts = parallel_map(fill, batch, executor=executor)
        for k, part in zip(batch, parts, strict=True):
            landed[k] = _core.add_part(grid, part, box[k, 0], box[k, 2], land)
    return landed
