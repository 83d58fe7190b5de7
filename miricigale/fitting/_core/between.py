"""
Models between the nodes of a grid.

The logarithm of a model's fluxes is that of the nearest node, a parabola along each axis, and products of the
steps along two (at the corner next to it): of second order in all axes, from 1 + 2 n + n (n - 1) / 2 nodes of n
axes where products of parabolas would need 3^n.
"""

import math
from collections import namedtuple

import numpy as np

from miricigale.fitting._core.structs import KERNEL, PART
from miricigale.utils.compilation import njit

#: Least weight of a corner that counts.
_LEAST = 1e-10
#: Largest change of ln flux from the nearest node that is followed.
_STEEP = 5.0

#: Galaxies or AGN on the nodes between which they are interpolated: table, float64 (nz, n_models, n_columns),
#: ln(flux z^2); model, int64, flat, the models of all values of the axes (-1 where there is none); of each axis
#: its size, int64 (n_axes,), nodes on its scale, (n_axes, n_largest), and the power that is the scale, (n_axes,).
Kind = namedtuple("Kind", "table model size scaled power")
#: Scratch arrays: values, (n_axes,); of each axis weights of two more nodes and the part of the way to the next,
#: (n_axes, 3), and where these are in the list of models, int64; nodes of a model and their weights, (n_nodes,);
#: fluxes of the model and of its AGN, and weights, (3, n_columns); a place, (n_axes,).
Work = namedtuple("Work", "value part step row weight flux new")


def make_work(n_axes, n_columns):
    """Make the scratch arrays."""
    n = 1 + n_axes * (n_axes + 3) // 2
    part, step, row = np.zeros((n_axes, 3)), np.zeros((n_axes, 3), np.int64), np.zeros(n, np.int64)
    value, new = np.zeros((2, n_axes))
    return Work(value, part, step, row, np.zeros(n), np.zeros((3, n_columns)), new)


@njit(**PART)
def place_between(nodes, n, x):
    """Node below a place, and the part of the way to the next."""
    low, high = 0, max(n - 1, 1)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if nodes[middle] <= x else (low, middle)
    return low, (x - nodes[low]) / (nodes[low + 1] - nodes[low]) if n > 1 else 0.0


@njit(**PART)
def find_nodes(kind, value, work):
    """Fill nodes and weights of a model; returned are their number (0: there is none) and the nearest model."""
    part, step = work.part, work.step
    first, stride = 0, 1
    for a in range(len(kind.size) - 1, -1, -1):
        n, scaled, power = kind.size[a], kind.scaled[a], kind.power[a]
        part[a], step[a] = 0.0, 0
        if n > 1:
            x = value[a]
            # powers of 1/2 are roots of roots
            part[a, 0] = abs(power)
            while part[a, 0] < 1.0:
                x, part[a, 0] = math.sqrt(x), 2.0 * part[a, 0]
            x = x if power > 0.0 else -1.0 / x
            x = min(max(x, scaled[0]), scaled[n - 1])
            low, t = place_between(scaled, n, x)
            c = low + (1 if t > 0.5 else 0)
            # the nodes on both sides, at an end the next two
            i = 1 if c == 0 else -1
            j = 0 if n == 2 else -2 if c == n - 1 else 2 if c == 0 else 1
            d, one, two = x - scaled[c], scaled[c + i] - scaled[c], scaled[c + j] - scaled[c]
            part[a, 0] = d / one
            if n > 2:
                part[a, 0] *= (d - two) / (one - two)
                part[a, 1] = d * (d - one) / (two * (two - one))
            step[a, 0], step[a, 1] = i * stride, j * stride
            up = j == 1 and d > 0.0
            # the corner is on the side of the place
            part[a, 2], step[a, 2] = d / two if up else d / one, 1 if up else 0
            first += c * stride
        stride *= n
    nearest = kind.model[first]
    if nearest < 0:
        return 0, -1
    work.row[0], work.weight[0], count = nearest, 1.0, 1
    for a in range(len(kind.size)):
        for k in range(2):
            m = kind.model[first + step[a, k]]
            work.row[count], work.weight[count] = m if m >= 0 else nearest, part[a, k]
            work.weight[0] -= part[a, k]
            count += 1
    for a in range(len(kind.size)):
        for b in range(a):
            i, j, w = step[a, 2], step[b, 2], part[a, 2] * part[b, 2]
            m = kind.model[first + step[a, i] + step[b, j]]
            if m >= 0 and w > _LEAST:
                work.row[count], work.weight[count] = m, w
                work.weight[0] += w
                work.weight[1 + 2 * a + i] -= w
                work.weight[1 + 2 * b + j] -= w
                count += 1
    return count, nearest


@njit(**PART)
def add_up(table, z, part, count, work, out, n_fluxes):
    """Interpolate the columns of a table, the first of them ln flux, at a place whose nodes are in ``work``."""
    other = min(z + 1, table.shape[0] - 1)
    out[:] = 0.0
    for r in range(count):
        far = work.weight[r] * part
        near = work.weight[r] - far
        low, high = table[z, work.row[r]], table[other, work.row[r]]
        for j in range(table.shape[2]):
            out[j] += near * low[j] + far * high[j]
    nearest = table[other if part > 0.5 else z, work.row[0]]
    for j in range(n_fluxes):
        out[j] = min(max(out[j], nearest[j] - _STEEP), nearest[j] + _STEEP)


@njit(**KERNEL)
def interpolate(kind, table, log_z, values, redshift, n_fluxes, work, out):
    """
    Interpolate a table of models, as it is, at n places: ``out``, shape (n, n_columns).

    ``values`` are those of the axes, shape (n, n_axes); a table of one redshift is that of all. The first
    ``n_fluxes`` columns are ln flux.
    """
    for i in range(len(out)):
        z, part = place_between(log_z, len(table), math.log1p(redshift[i]))
        add_up(table, z, part, find_nodes(kind, values[i], work)[0], work, out[i], n_fluxes)
