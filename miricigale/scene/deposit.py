"""Light of Sersic profiles on the nodes of a grid, by as many threads as there are."""

import concurrent.futures
import math
import os

import numpy as np

from miricigale.scene import _core
from miricigale.utils.parallel import chunks, parallel_map

__all__ = ["deposit_profiles"]

#: Rows that one task owns; fixed, so that threads change nothing.
_ROWS = 64

#: Nodes in double precision that the cusps of one batch of sources take.
_BATCH = 2_000_000


def deposit_profiles(grid, rows, tables, w_zone, w_smooth, w_cut, land, *, workers=None):
    """
    Put Sersic profiles on the grid.

    Parameters
    ----------
    grid : `~numpy.ndarray`, shape (ny, nx)
        Light on the nodes, changed in place.
    rows, tables, w_zone, w_smooth, w_cut, land
        As in ``_core.fill_outskirts``.
    workers : int, optional
        Threads; all processors if not given. The result does not depend on it.

    Returns
    -------
    landed : `~numpy.ndarray`, shape (N,)
        Light of each source that lands on the image.
    """
    n_threads = workers or os.cpu_count() or 1
    with concurrent.futures.ThreadPoolExecutor(n_threads) as pool:
        executor = pool if n_threads > 1 else None
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
    a, b, c = rows[:, 8], rows[:, 9], rows[:, 10]
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
    used = np.flatnonzero((box[:, 1] > box[:, 0]) & (box[:, 3] > box[:, 2]))
    sizes = (box[used, 1] - box[used, 0]) * (box[used, 3] - box[used, 2])
    for batch in np.array_split(used, max(1, math.ceil(sizes.sum() / _BATCH))):
        parts = parallel_map(fill, batch, executor=executor)
        for k, part in zip(batch, parts, strict=True):
            landed[k] = _core.add_part(grid, part, box[k, 0], box[k, 2], land)
    return landed
