"""
Numerical core: light deposited on an oversampled grid by cubic B-splines.

A PSF given by samples E on a grid of ``oversampling`` nodes per pixel is read between its
nodes by cubic B-splines, ``E(t) = sum_m C_m B3(t - m)``. The image of a point is then a
deposit of its light on 4 x 4 nodes with the weights B3, convolved with the coefficients C:
exact sub-pixel placement at the price of one convolution for all sources. Extended light
is deposited cell by cell: near the cusp in small cells at their centroids, elsewhere one
cell per node, followed by the filter (1, 6, 1) / 8, which gives with the cell's own width
(variance 1/12) the variance 1/3 of B3.
"""

import math

import numpy as np
from numba import njit, prange

from miricigale.profiles._core import cell

#: Rows that one task of the parallel loop owns; fixed, so that threads change nothing.
BLOCK = 64

#: Small cells per node and axis near the cusp.
SUB = 4


@njit(cache=True)
def _spline_weights(t, w):
    s = 1.0 - t
    w[0] = s * s * s / 6.0
    w[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
    w[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
    w[3] = t * t * t / 6.0


@njit(cache=True)
def _share(sums, low_y, high_y, low_x, high_x, oversampling, i, j):
    """Part of the light deposited on node (i, j) that lands on the image."""
    y0, y1, x0, x1 = low_y[i], high_y[i], low_x[j], high_x[j]
    if y1 <= y0 or x1 <= x0:
        return 0.0
    s = sums[i % oversampling, j % oversampling]
    if y0 == 0 and x0 == 0:
        return s[y1, x1]
    return s[y1, x1] - s[y0, x1] - s[y1, x0] + s[y0, x0]


@njit(cache=True)
def _deposit(grid, y, x, flux, sums, low_y, high_y, low_x, high_x, oversampling, wy, wx):
    """Put one point's light on the grid; return how much of it lands on the image."""
    iy, ix = math.floor(y), math.floor(x)
    _spline_weights(y - iy, wy)
    _spline_weights(x - ix, wx)
    landed = 0.0
    for k in range(4):
        i = iy - 1 + k
        if i < 0 or i >= grid.shape[0]:
            continue
        for m in range(4):
            j = ix - 1 + m
            if j < 0 or j >= grid.shape[1]:
                continue
            light = flux * wy[k] * wx[m]
            grid[i, j] += light
            landed += light * _share(sums, low_y, high_y, low_x, high_x, oversampling, i, j)
    return landed


@njit(cache=True)
def deposit_points(grid, x, y, flux, sums, low_y, high_y, low_x, high_x, oversampling):
    """
    Put points on the grid.

    Parameters
    ----------
    grid : array, shape (ny, nx)
        Light on the nodes, changed in place.
    x, y, flux : array, shape (N,)
        Positions in nodes and light.
    sums : array, shape (oversampling, oversampling, 2 L + 2, 2 L + 2)
        Cumulative sums of the PSF's coefficients, one table for each sub-pixel phase.
    low_y, high_y, low_x, high_x : array of int
        For each row or column of nodes the range in ``sums`` that lies on the image.
    oversampling : int

    Returns
    -------
    landed : array, shape (N,)
        Light that lands on the image.
    """
    landed = np.zeros(x.size)
    wy, wx = np.empty(4), np.empty(4)
    for k in range(x.size):
        landed[k] = _deposit(
            grid, y[k], x[k], flux[k], sums, low_y, high_y, low_x, high_x, oversampling, wy, wx
        )
    return landed


@njit(cache=True)
def deposit_pieces(part, x, y, light):
    """
    Put the pieces of one source on a grid of its own.

    Parameters
    ----------
    part : array, shape (ny, nx)
        Light on the nodes, changed in place; what falls beside it is lost.
    x, y, light : array, shape (N,)
        Positions in nodes and light.
    """
    wy, wx = np.empty(4), np.empty(4)
    ny, nx = part.shape
    for k in range(x.size):
        iy, ix = math.floor(y[k]), math.floor(x[k])
        if iy < -2 or ix < -2 or iy > ny or ix > nx:
            continue
        _spline_weights(y[k] - iy, wy)
        _spline_weights(x[k] - ix, wx)
        for a in range(max(0, 1 - iy), min(4, ny - iy + 1)):
            for b in range(max(0, 1 - ix), min(4, nx - ix + 1)):
                part[iy - 1 + a, ix - 1 + b] += light[k] * wy[a] * wx[b]


@njit(cache=True)
def landed_light(part, sums, low_y, high_y, low_x, high_x, oversampling):
    """Light of a grid that lands on the image; arguments as in `deposit_points`."""
    total = 0.0
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            if part[i, j] != 0.0:
                share = _share(sums, low_y, high_y, low_x, high_x, oversampling, i, j)
                total += part[i, j] * share
    return total


@njit(cache=True)
def _row_span(par, dy, limit, n):
    """First and last column whose node lies within the ellipse w <= limit in a row."""
    a, b, c = par[8], par[9], par[10]
    root = b * b * dy * dy - a * (c * dy * dy - limit)
    if root < 0.0:
        return 1, 0
    root = math.sqrt(root)
    first = math.ceil(par[0] + (-b * dy - root) / a)
    last = math.floor(par[0] + (-b * dy + root) / a)
    return max(first, 0), min(last, n - 1)


@njit(cache=True)
def deposit_cusps(grid, rows, tables, w_zone, sums, low_y, high_y, low_x, high_x, oversampling):
    """
    Put the inner parts of Sersic profiles on the grid, in small cells.

    Parameters
    ----------
    grid, sums, low_y, high_y, low_x, high_x, oversampling
        As in `deposit_points`.
    rows : array, shape (N, 13)
        Parameters of the profiles in nodes.
    tables : array, shape (N, 5, TABLE_SIZE)
        Their enclosed light.
    w_zone : array, shape (N,)
        Squared elliptical radius (in half-light radii) that is done here.

    Returns
    -------
    landed : array, shape (N,)
    """
    landed = np.zeros(rows.shape[0])
    wy, wx, out = np.empty(4), np.empty(4), np.empty(3)
    size = 1.0 / SUB
    for k in range(rows.shape[0]):
        par, table = rows[k], tables[k]
        half = math.sqrt(w_zone[k] * par[8] / (par[8] * par[10] - par[9] * par[9]))
        for i in range(
            max(0, math.ceil(par[1] - half)),
            min(grid.shape[0] - 1, math.floor(par[1] + half)) + 1,
        ):
            first, last = _row_span(par, i - par[1], w_zone[k], grid.shape[1])
            for j in range(first, last + 1):
                for si in range(SUB):
                    y = i + (si + 0.5) * size - 0.5
                    for sj in range(SUB):
                        x = j + (sj + 0.5) * size - 0.5
                        cell(x - par[0], y - par[1], size, par, table, out)
                        if out[0] > 0.0:
                            landed[k] += _deposit(
                                *(grid, y + out[2], x + out[1], out[0], sums),
                                *(low_y, high_y, low_x, high_x, oversampling, wy, wx),
                            )
    return landed


@njit(cache=True)
def _fill_row(par, table, dy, first, last, hole_first, hole_last, light, shift_x, shift_y):
    """Light and first moments of the cells of a row, shifted by 2 columns from ``first``."""
    out = np.empty(3)
    for j in range(last - first + 5):
        light[j] = shift_x[j] = shift_y[j] = 0.0
    j = first
    while j <= last:
        if hole_first <= j <= hole_last:
            j = hole_last + 1
            continue
        cell(j - par[0], dy, 1.0, par, table, out)
        m = j - first + 2
        light[m] = out[0]
        shift_x[m] = 0.5 * out[0] * out[1]
        shift_y[m] = 0.5 * out[0] * out[2]
        j += 1


@njit(cache=True)
def _add_row(row, share, first, last, light, shift_x, shift_y, w_light, w_shift):
    """Add a row of cells to one row of the grid with two weights; return what lands on the image."""
    landed = 0.0
    for j in range(max(first - 1, 0), min(last + 1, row.size - 1) + 1):
        m = j - first + 2
        value = 14 / 24 * light[m] + 5 / 24 * (light[m - 1] + light[m + 1])
        value += shift_x[m - 1] - shift_x[m + 1]
        tilt = 14 / 24 * shift_y[m] + 5 / 24 * (shift_y[m - 1] + shift_y[m + 1])
        added = w_light * value + w_shift * tilt
        row[j] += added
        landed += added * share[j]
    return landed


@njit(cache=True, parallel=True)
def deposit_outskirts(
    grid, rows, tables, w_zone, w_cut, sums, low_y, high_y, low_x, high_x, oversampling
):
    """
    Add the outer parts of Sersic profiles, one cell for each node.

    Parameters are those of `deposit_cusps` and ``w_cut``, the squared elliptical radius
    at which the profiles end.

    Returns
    -------
    landed : array, shape (N,)
    """
    ny, nx = grid.shape
    n_blocks = (ny + BLOCK - 1) // BLOCK
    landed = np.zeros((n_blocks, rows.shape[0]))
    for block in prange(n_blocks):
        light, shift_x, shift_y = np.empty(nx + 5), np.empty(nx + 5), np.empty(nx + 5)
        start, stop = block * BLOCK, min(ny, (block + 1) * BLOCK)
        share = np.empty((stop - start, nx))
        for i in range(start, stop):
            for j in range(nx):
                share[i - start, j] = _share(sums, low_y, high_y, low_x, high_x, oversampling, i, j)
        for k in range(rows.shape[0]):
            par, table = rows[k], tables[k]
            half = math.sqrt(w_cut[k] * par[8] / (par[8] * par[10] - par[9] * par[9]))
            # cells of the rows just outside reach into this block
            lowest = max(start - 1, 0, math.ceil(par[1] - half))
            highest = min(stop, ny - 1, math.floor(par[1] + half))
            total = 0.0
            for i in range(lowest, highest + 1):
                dy = i - par[1]
                first, last = _row_span(par, dy, w_cut[k], nx)
                if last < first:
                    continue
                hole_first, hole_last = _row_span(par, dy, w_zone[k], nx)
                _fill_row(
                    par, table, dy, first, last, hole_first, hole_last, light, shift_x, shift_y
                )
                for step in range(-1, 2):
                    if start <= i + step < stop:
                        total += _add_row(
                            grid[i + step],
                            share[i + step - start],
                            first,
                            last,
                            light,
                            shift_x,
                            shift_y,
                            14 / 24 if step == 0 else 5 / 24,
                            float(step),
                        )
            landed[block, k] = total
    result = np.zeros(rows.shape[0])
    for block in range(n_blocks):
        result += landed[block]
    return result
