"""
Numerical core: light deposited on an oversampled grid by cubic B-splines.

A PSF given by samples E on a grid of ``oversampling`` nodes per pixel is read between its
nodes by cubic B-splines, ``E(t) = sum_m C_m B3(t - m)``. The image of a point is then a
deposit of its light on 4 x 4 nodes with the weights B3, convolved with the coefficients C:
exact sub-pixel placement at the price of one convolution for all sources. Extended light
is deposited cell by cell: near the cusp in small cells at their centroids, farther out one
cell per node, followed by the filter (1, 6, 1) / 8, which gives with the cell's own width
(variance 1/12) the variance 1/3 of B3. Where the profile is smooth over many nodes, the deposit
of a node is the brightness there and a sixth of its Laplacian, computed on every fourth node
of a row and interpolated between.
"""

import math
from typing import NamedTuple

import numpy as np

from miricigale.profiles._core import cell
from miricigale.psf._core import spline_weights
from miricigale.utils.compilation import njit

#: Small cells per node and axis near the cusp.
SUB = 4

#: Sampling step of the smooth part; nodes between are interpolated (polynomials through six).
STEP = 4
LAGRANGE = np.array(
    [
        [np.prod([(m / STEP - q) / (p - q) for q in range(-2, 4) if q != p]) for p in range(-2, 4)]
        for m in range(STEP)
    ]
)


class Landing(NamedTuple):
    """
    Which part of the light deposited on a node lands on the image.

    ``sums``, shape (n_psfs, oversampling, oversampling, 2 L + 2, 2 L + 2), are cumulative sums of
    each PSF's coefficients, one table for each sub-pixel phase. ``order`` (n_y, n_x) holds the PSFs
    on their rectangular grid over the field. For each row (``_y``) or column (``_x``) of nodes
    ``low`` to ``high`` are the range in the tables that lies on the image, ``k`` the place on the
    grid of PSFs below it and ``t`` the weight of the next place.
    """

    sums: np.ndarray
    oversampling: int
    order: np.ndarray
    low_y: np.ndarray
    high_y: np.ndarray
    k_y: np.ndarray
    t_y: np.ndarray
    low_x: np.ndarray
    high_x: np.ndarray
    k_x: np.ndarray
    t_x: np.ndarray


@njit()
def _box(sums, y0, y1, x0, x1):
    """Sum of a table over a range, from its cumulative sums."""
    return sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]


@njit()
def share_row(land, i, j0, share):
    """Fill in what part of the light deposited on a row's nodes from ``j0`` on lands."""
    os_ = land.oversampling
    y0 = land.low_y[i]
    y1 = land.high_y[i]
    share[:] = 0.0
    if y1 <= y0:
        return
    low_x = land.low_x
    high_x = land.high_x
    k_x = land.k_x
    t_x = land.t_x
    for m in range(2):
        w_y = land.t_y[i] if m else 1.0 - land.t_y[i]
        if w_y == 0.0:
            continue
        sums = land.sums[:, i % os_]
        order = land.order[land.k_y[i] + m]
        for n in range(share.size):
            j = j0 + n
            x0 = low_x[j]
            x1 = high_x[j]
            if x1 <= x0:
                continue
            phase = j % os_
            k = k_x[j]
            t = t_x[j]
            part = _box(sums[order[k], phase], y0, y1, x0, x1)
            if t != 0.0:
                part += t * (_box(sums[order[k + 1], phase], y0, y1, x0, x1) - part)
            share[n] += w_y * part


@njit()
def _alike(land, i, k):
    """Whether the light of two rows of nodes lands alike."""
    return (
        land.low_y[i] == land.low_y[k]
        and land.high_y[i] == land.high_y[k]
        and land.k_y[i] == land.k_y[k]
        and land.t_y[i] == land.t_y[k]
    )


@njit()
def point_nodes(x, y, flux, land):
    """
    The nodes on which the light of points is deposited; ``x``, ``y`` in nodes.

    Returns row, column and light of each node that gets any, and the light of each point that lands
    on the image.
    """
    ny = land.low_y.size
    nx = land.low_x.size
    rows = np.empty(16 * x.size, np.int64)
    columns = np.empty(16 * x.size, np.int64)
    light = np.empty(16 * x.size)
    landed = np.zeros(x.size)
    wy = np.empty(4)
    wx = np.empty(4)
    share = np.empty(4)
    n = 0
    for k in range(x.size):
        iy = math.floor(y[k])
        ix = math.floor(x[k])
        j0 = max(ix - 1, 0)
        j1 = min(ix + 3, nx)
        if j1 <= j0:
            continue
        spline_weights(y[k] - iy, wy)
        spline_weights(x[k] - ix, wx)
        for a in range(4):
            i = iy - 1 + a
            if i < 0 or i >= ny:
                continue
            share_row(land, i, j0, share[: j1 - j0])
            for j in range(j0, j1):
                rows[n] = i
                columns[n] = j
                light[n] = flux[k] * wy[a] * wx[j - ix + 1]
                landed[k] += light[n] * share[j - j0]
                n += 1
    return rows[:n], columns[:n], light[:n], landed


@njit()
def deposit_nodes(grid, i, j, light):
    """Add the light of single nodes to the grid, one after the other."""
    for k in range(i.size):
        grid[i[k], j[k]] += light[k]


@njit()
def _deposit(part, y, x, light, wy, wx):
    """Put one point's light on the nodes of a part of the grid; light outside it is dropped."""
    ny, nx = part.shape
    iy = math.floor(y)
    ix = math.floor(x)
    if iy < -2 or ix < -2 or iy > ny or ix > nx:
        return
    spline_weights(y - iy, wy)
    spline_weights(x - ix, wx)
    for a in range(max(0, 1 - iy), min(4, ny - iy + 1)):
        for b in range(max(0, 1 - ix), min(4, nx - ix + 1)):
            part[iy - 1 + a, ix - 1 + b] += light * wy[a] * wx[b]


@njit()
def deposit_pieces(part, x, y, light):
    """Put pieces at ``x``, ``y`` (nodes) on a separate grid; parts outside it are dropped."""
    wy = np.empty(4)
    wx = np.empty(4)
    for k in range(x.size):
        _deposit(part, y[k], x[k], light[k], wy, wx)


@njit()
def add_part(grid, part, i0, j0, land):
    """Add a part to the grid at row ``i0`` and column ``j0``; return what lands on the image."""
    total = 0.0
    share = np.empty(part.shape[1])
    for i in range(part.shape[0]):
        share_row(land, i0 + i, j0, share)
        for j in range(part.shape[1]):
            grid[i0 + i, j0 + j] += part[i, j]
            total += part[i, j] * share[j]
    return total


@njit()
def _row_span(par, dy, limit, n):
    """First and last column whose node lies within the ellipse w <= limit in a row."""
    a = par[8]
    b = par[9]
    c = par[10]
    root = b * b * dy * dy - a * (c * dy * dy - limit)
    if root < 0.0:
        return 1, 0
    root = math.sqrt(root)
    first = math.ceil(par[0] + (-b * dy - root) / a)
    last = math.floor(par[0] + (-b * dy + root) / a)
    return max(first, 0), min(last, n - 1)


@njit()
def fill_cusp(part, i0, j0, n_x, par, table, w_zone):
    """
    Put the inner part of a Sersic profile on a grid of its own, in small cells.

    The grid ``part`` begins at row ``i0`` and column ``j0`` of the whole one, which has ``n_x``
    columns. ``par`` (13,) are the parameters of the profile in nodes, ``table`` (5, TABLE_SIZE)
    its enclosed light; ``w_zone`` is the squared elliptical radius (half-light radii) that is
    done here.
    """
    size = 1.0 / SUB
    wy = np.empty(4)
    wx = np.empty(4)
    out = np.empty(3)
    for i in range(i0, i0 + part.shape[0]):
        first, last = _row_span(par, i - par[1], w_zone, n_x)
        for j in range(first, last + 1):
            for si in range(SUB):
                y = i + (si + 0.5) * size - 0.5
                for sj in range(SUB):
                    x = j + (sj + 0.5) * size - 0.5
                    cell(x - par[0], y - par[1], size, par, table, out)
                    if out[0] > 0.0:
                        _deposit(part, y + out[2] - i0, x + out[1] - j0, out[0], wy, wx)


@njit()
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


@njit()
def _add_row(row, share, first, last, low, high, light, shift_x, shift_y, w_light, w_shift):
    """
    Add a row of cells to the nodes ``low`` to ``high`` of a row of the grid with two weights.

    Returns what lands on the image.
    """
    landed = 0.0
    for j in range(max(first - 1, low), min(last + 1, high) + 1):
        m = j - first + 2
        value = 14 / 24 * light[m] + 5 / 24 * (light[m - 1] + light[m + 1])
        value += shift_x[m - 1] - shift_x[m + 1]
        tilt = 14 / 24 * shift_y[m] + 5 / 24 * (shift_y[m - 1] + shift_y[m + 1])
        added = w_light * value + w_shift * tilt
        row[j] += added
        landed += added * share[j]
    return landed


@njit()
def _smooth_deposit(par, dx, dy):
    """Deposit on a node where the profile is smooth: brightness and a sixth of the Laplacian."""
    a = par[8]
    b = par[9]
    c = par[10]
    power = par[11]
    gx = a * dx + b * dy
    gy = b * dx + c * dy
    w = gx * dx + gy * dy
    z = par[12] * math.exp(power * math.log(w))
    slope = power * z / w
    grad2 = 4.0 * (gx * gx + gy * gy)
    second = (slope * slope - slope * (power - 1.0) / w) * grad2 - 2.0 * slope * (a + c)
    return par[3] * math.exp(-z) * (1.0 + second / 6.0)


@njit()
def _add_smooth(row, share, par, dy, first, last):
    """Add the smooth deposits of the nodes ``first`` to ``last``; return what lands."""
    landed = 0.0
    if last < first:
        return landed
    x = first - par[0]
    s0 = _smooth_deposit(par, x - 2 * STEP, dy)
    s1 = _smooth_deposit(par, x - STEP, dy)
    s2 = _smooth_deposit(par, x, dy)
    s3 = _smooth_deposit(par, x + STEP, dy)
    s4 = _smooth_deposit(par, x + 2 * STEP, dy)
    for start in range(first, last + 1, STEP):
        s5 = _smooth_deposit(par, start - par[0] + 3 * STEP, dy)
        row[start] += s2
        landed += s2 * share[start]
        for m in range(1, min(STEP, last + 1 - start)):
            q = LAGRANGE[m]
            value = q[0] * s0 + q[1] * s1 + q[2] * s2 + q[3] * s3 + q[4] * s4 + q[5] * s5
            row[start + m] += value
            landed += value * share[start + m]
        s0 = s1
        s1 = s2
        s2 = s3
        s3 = s4
        s4 = s5
    return landed


@njit()
def fill_outskirts(grid, start, stop, rows, tables, w_zone, w_smooth, w_cut, land, landed):
    """
    Add the outer parts of Sersic profiles to the rows ``start`` to ``stop`` of a grid, in place.

    One cell for each node, then the smooth part. ``rows`` (N, 13) are the parameters of the
    profiles in nodes, ``tables`` (N, 5, TABLE_SIZE) their enclosed light. Squared elliptical
    radii, all (N,): up to ``w_zone`` `fill_cusp` does them, from ``w_smooth``
    (``deposit.smooth_from``) they are smooth, at ``w_cut`` they end. ``landed`` (N,) is set to
    the light of these rows that lands on the image.
    """
    ny, nx = grid.shape
    light = np.empty(nx + 5)
    shift_x = np.empty(nx + 5)
    shift_y = np.empty(nx + 5)
    share = np.empty((stop - start, nx))
    os_ = land.oversampling
    for i in range(start, stop):
        if i - os_ >= start and _alike(land, i, i - os_):
            # by hand: numba takes seconds to compile the assignment of a slice
            for j in range(nx):
                share[i - start, j] = share[i - os_ - start, j]
        else:
            share_row(land, i, 0, share[i - start])
    for k in range(rows.shape[0]):
        par = rows[k]
        table = tables[k]
        half = math.sqrt(w_cut[k] * par[8] / (par[8] * par[10] - par[9] * par[9]))
        # cells of the rows just outside reach into this block
        lowest = max(start - 1, 0, math.ceil(par[1] - half))
        highest = min(stop, ny - 1, math.floor(par[1] + half))
        smooth = w_smooth[k] < w_cut[k]
        total = 0.0
        for i in range(lowest, highest + 1):
            dy = i - par[1]
            first, last = _row_span(par, dy, w_cut[k], nx)
            if last < first:
                continue
            if smooth:
                inner_first, inner_last = _row_span(par, dy, w_smooth[k], nx)
                if start <= i < stop:
                    row = grid[i]
                    share_of_row = share[i - start]
                    if inner_last < inner_first:
                        total += _add_smooth(row, share_of_row, par, dy, first, last)
                    else:
                        total += _add_smooth(row, share_of_row, par, dy, first, inner_first - 1)
                        total += _add_smooth(row, share_of_row, par, dy, inner_last + 1, last)
                # the cells that reach inner nodes of this row and its neighbors
                first = nx
                last = -1
                for step in range(-1, 2):
                    first_column, two = _row_span(par, dy + step, w_smooth[k], nx)
                    if first_column <= two:
                        first = min(first, first_column - 1)
                        last = max(last, two + 1)
                first = max(first, 0)
                last = min(last, nx - 1)
                if last < first:
                    continue
            hole_first, hole_last = _row_span(par, dy, w_zone[k], nx)
            _fill_row(par, table, dy, first, last, hole_first, hole_last, light, shift_x, shift_y)
            for step in range(-1, 2):
                if start <= i + step < stop:
                    low = 0
                    high = nx - 1
                    w_light = 5 / 24
                    if smooth:
                        low, high = _row_span(par, dy + step, w_smooth[k], nx)
                    if step == 0:
                        w_light = 14 / 24
                    total += _add_row(
                        grid[i + step],
                        share[i + step - start],
                        first,
                        last,
                        low,
                        high,
                        light,
                        shift_x,
                        shift_y,
                        w_light,
                        float(step),
                    )
        landed[k] = total
