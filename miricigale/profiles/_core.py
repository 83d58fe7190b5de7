"""
Numerical core: the light of a Sersic profile in square cells, cusp included.

A source is one row of parameters (see `PARAMETERS`) and one table of its enclosed light.
With ``(X, Y)`` the coordinates in which the ellipse is the unit circle, the light of a
polygon is a sum over its edges of integrals over the polar angle,

    flux / total = 1 / (2 pi) sum_edges integral F(R(phi)) dphi,

where F is the enclosed fraction, a closed form (incomplete gamma function); the same with
the first radial moment gives the centroid. Cells that the center is near to are done
like that, whatever the cusp. Elsewhere the profile is smooth over a cell and one
evaluation with the analytic Laplacian, or Gauss-Legendre points, suffice.
"""

import math

import numpy as np

from miricigale.utils.compilation import njit

#: Columns of a parameter row.
PARAMETERS = (
    # center, total light, central intensity per cell
    "x", "y", "total", "intensity",
    # pixel offsets to the unit circle: X = xx dx + xy dy, Y = yx dx + yy dy
    "xx", "xy", "yx", "yy",
    # w = R^2 = a dx^2 + 2 b dx dy + c dy^2
    "a", "b", "c",
    # intensity ~ exp(-bn w^power), power = 1 / (2 n)
    "power", "bn",
)  # fmt: skip

#: The table of enclosed light is even in ln(R / R_e): first node, step, number of nodes.
TABLE_START = math.log(1e-8)
TABLE_STEP = 0.05
TABLE_SIZE = 600

#: Largest relative change of the brightness within a cell (exponent) for which one value with
#: the Laplacian does, and for which 3 x 3 points do.
_LAPLACIAN = 0.12
_GAUSS3 = 1.0

_NODES8, _WEIGHTS8 = np.polynomial.legendre.leggauss(8)
_NODES3, _WEIGHTS3 = np.polynomial.legendre.leggauss(3)
_NODES6, _WEIGHTS6 = np.polynomial.legendre.leggauss(6)


@njit()
def _lookup(log_r, table):
    """Enclosed fraction and first radial moment at ln(R / R_e), by quintic and cubic pieces."""
    t = (log_r - TABLE_START) / TABLE_STEP
    if t <= 0.0:
        r = math.exp(log_r - TABLE_START)
        return table[0, 0] * r * r, table[2, 0] * r * r * r
    if t >= TABLE_SIZE - 1:
        return table[0, TABLE_SIZE - 1], table[2, TABLE_SIZE - 1]
    i = int(t)
    t -= i
    h00 = (1.0 + 2.0 * t) * (1.0 - t) * (1.0 - t)
    h10 = t * (1.0 - t) * (1.0 - t) * TABLE_STEP
    h01 = t * t * (3.0 - 2.0 * t)
    h11 = t * t * (t - 1.0) * TABLE_STEP
    t3 = t * t * t
    end = t3 * (10.0 - 15.0 * t + 6.0 * t * t)
    slope0 = (t - t3 * (6.0 - 8.0 * t + 3.0 * t * t)) * TABLE_STEP
    slope1 = -t3 * (4.0 - 7.0 * t + 3.0 * t * t) * TABLE_STEP
    bend0 = 0.5 * t * t * (1.0 - t) * (1.0 - t) * (1.0 - t) * TABLE_STEP * TABLE_STEP
    bend1 = 0.5 * t3 * (1.0 - t) * (1.0 - t) * TABLE_STEP * TABLE_STEP
    f = (1.0 - end) * table[0, i] + slope0 * table[1, i] + bend0 * table[4, i]
    f += end * table[0, i + 1] + slope1 * table[1, i + 1] + bend1 * table[4, i + 1]
    m = h00 * table[2, i] + h10 * table[3, i] + h01 * table[2, i + 1] + h11 * table[3, i + 1]
    return f, m


@njit()
def _edge(x1, y1, x2, y2, table, out):
    """Add the light (times 2 pi / total) and its first moments of the triangle (0, P1, P2)."""
    ex = x2 - x1
    ey = y2 - y1
    length = math.hypot(ex, ey)
    cross = x1 * y2 - x2 * y1
    d = abs(cross) / length
    if d < 1e-13 * length:
        return
    sign = 1.0 if cross > 0.0 else -1.0
    ex = ex / length
    ey = ey / length
    t1 = x1 * ex + y1 * ey
    t2 = x2 * ex + y2 * ey
    nx = (x1 - t1 * ex) / d
    ny = (y1 - t1 * ey) / d
    u1 = math.asinh(t1 / d)
    u2 = math.asinh(t2 / d)
    log_d = math.log(d)
    light = 0.0
    moment_n = 0.0
    moment_e = 0.0
    n_panels = max(1, math.ceil(u2 - u1))
    step = (u2 - u1) / n_panels
    for k in range(n_panels):
        mid = u1 + (k + 0.5) * step
        for j in range(8):
            u = mid + 0.5 * step * _NODES8[j]
            cosh = math.cosh(u)
            f, m = _lookup(log_d + math.log(cosh), table)
            weight = 0.5 * step * _WEIGHTS8[j] / cosh
            light += weight * f
            moment_n += weight * m / cosh
            moment_e += weight * m * math.tanh(u)
    out[0] += sign * light
    out[1] += sign * (moment_n * nx + moment_e * ex)
    out[2] += sign * (moment_n * ny + moment_e * ey)


@njit()
def _exact_cell(dx, dy, size, par, table, out):
    """Light and centroid of a square cell by its edges."""
    h = 0.5 * size
    out[0] = out[1] = out[2] = 0.0
    xx = par[4]
    xy = par[5]
    yx = par[6]
    yy = par[7]
    px = dx - h
    py = dy - h
    x0 = xx * px + xy * py
    y0 = yx * px + yy * py
    sx, sy = xx * size, yx * size  # one cell to the right
    tx, ty = xy * size, yy * size  # one cell up
    _edge(x0, y0, x0 + sx, y0 + sy, table, out)
    _edge(x0 + sx, y0 + sy, x0 + sx + tx, y0 + sy + ty, table, out)
    _edge(x0 + sx + tx, y0 + sy + ty, x0 + tx, y0 + ty, table, out)
    _edge(x0 + tx, y0 + ty, x0, y0, table, out)
    scale = par[2] / (2.0 * math.pi)
    light = out[0]
    if light > 1e-12:
        cx = out[1] / light
        cy = out[2] / light
        det = xx * yy - xy * yx
        ox = (yy * cx - xy * cy) / det - dx
        oy = (xx * cy - yx * cx) / det - dy
        out[1] = min(max(ox, -h), h)
        out[2] = min(max(oy, -h), h)
    else:
        out[1] = out[2] = 0.0
    out[0] = max(scale * light, 0.0)


@njit()
def cell(dx, dy, size, par, table, out):
    """
    Light of one square cell.

    Parameters
    ----------
    dx, dy : float
        Center of the cell minus the source's.
    size : float
        Side of the cell.
    par : array, shape (13,)
        The source's parameters.
    table : array, shape (5, TABLE_SIZE)
        Its enclosed light (`miricigale.profiles.sersic.light_table`).
    out : array, shape (3,)
        Filled with the light and the offset of its centroid from the cell's center.
    """
    a = par[8]
    b = par[9]
    c = par[10]
    gx = a * dx + b * dy
    gy = b * dx + c * dy
    w = gx * dx + gy * dy
    # largest change of w within the cell
    change = size * (abs(gx) + abs(gy)) + 0.25 * size * size * (a + c + 2.0 * abs(b))
    if change > 0.4 * w:
        _exact_cell(dx, dy, size, par, table, out)
        return
    power = par[11]
    bn = par[12]
    z = bn * math.exp(power * math.log(w))
    slope = power * z / w  # -d ln f / d w
    out[1] = out[2] = 0.0
    if z > 80.0 + slope * change:
        out[0] = 0.0
        return
    if slope * change < _LAPLACIAN:
        f = par[3] * math.exp(-z) * size * size
        # f'' / f = (slope^2 - slope (power - 1) / w) (grad w)^2 - slope laplacian w
        grad2 = 4.0 * (gx * gx + gy * gy)
        second = (slope * slope - slope * (power - 1.0) / w) * grad2 - 2.0 * slope * (a + c)
        out[0] = f * (1.0 + second * size * size / 24.0)
        out[1] = -2.0 * slope * gx * size * size / 12.0
        out[2] = -2.0 * slope * gy * size * size / 12.0
        return
    nodes = _NODES6
    weights = _WEIGHTS6
    if slope * change < _GAUSS3:
        nodes = _NODES3
        weights = _WEIGHTS3
    light = 0.0
    mx = 0.0
    my = 0.0
    for i in range(nodes.size):
        oy = 0.5 * size * nodes[i]
        for j in range(nodes.size):
            ox = 0.5 * size * nodes[j]
            x = dx + ox
            y = dy + oy
            w = a * x * x + 2.0 * b * x * y + c * y * y
            f = weights[i] * weights[j] * math.exp(-bn * math.exp(power * math.log(w)))
            light += f
            mx += f * ox
            my += f * oy
    out[0] = par[3] * light * 0.25 * size * size
    if light > 0.0:
        out[1] = mx / light
        out[2] = my / light


@njit()
def sersic_cells(image, par, table):
    """Add the light of one source to an image whose pixel centers are integers."""
    out = np.empty(3)
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            cell(j - par[0], i - par[1], 1.0, par, table, out)
            image[i, j] += out[0]
