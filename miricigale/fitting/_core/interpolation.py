"""
Models between the nodes of tables.

A galaxy is the sum of its parts: starlight, in which a burst mixes linearly, and the power that dust takes from
it times the dust's template. Logarithms of the parts are interpolated: that of the nearest node, a parabola along
each axis, and products of the steps along two (at the corner next to it): of second order in all axes, from
1 + 2 n + n (n - 1) / 2 nodes of n axes where products of parabolas would need 3^n.
"""

import math
from collections import namedtuple

import numpy as np

from miricigale.fitting._core.lanes import LANES, STEEPEST, add_exponentials
from miricigale.utils._core.functions import exponential
from miricigale.utils.compilation import KERNEL, PART, njit

#: Least weight of a node that counts.
_LEAST_WEIGHT = 1e-10
#: How quickly the power that dust takes saturates with the amount of dust: it is interpolated over
#: 1 - exp(-this * amount), which takes most of its change away.
SATURATION = 4.0

#: A table of one part of the light: ``table``, float32 (nz, n_models, n_columns), logarithms, of fluxes that of
#: flux * z^2, less an ``offset`` of each column, (n_columns,), so that single precision is enough; ``unit``, its
#: exponential; ``log_z``, (nz,), ln(1 + z) of its nodes, one where there is no redshift; ``model``, int64, flat,
#: the models of all values of the axes (-1 where there is none); of each axis its place among the parameters
#: ``axis``, int64 (n_axes,), its ``size``, int64, its nodes on the axis's scale, ``scaled`` (n_axes, n_largest),
#: and the ``power`` that is the scale.
Part = namedtuple("Part", "table offset unit log_z model axis size scaled power")
#: The parts of galaxies and the AGN; ``burst`` and ``dust`` have no models where there is none. Places among the
#: parameters, -1 where there is none: ``mixing`` of the burst's mass fraction, ``amount`` of that whose 0 is no
#: dust, ``excess`` of the dust's light over energy balance, ``age``; ``youth`` is the age of the universe at the
#: redshifts ``log_z`` of the starlight. ``by_dust``: whether AGN fractions refer to the dust's power.
Light = namedtuple("Light", "stars burst dust agn mixing amount excess age youth by_dust")
#: Scratch arrays: values of all parameters, (n_axes,); of each axis weights of two more nodes and the part of the
#: way to the next, (n_axes, 3), and where these are in the list of models, int64, and among the nodes,
#: (n_axes, 2); nodes of a model and their weights, (n_nodes,); columns of the model, its AGN, and memory for more,
#: (3, n_columns), and for logarithms of columns, (n_columns,); a place, (n_axes,).
Work = namedtuple("Work", "value part step slot row weight flux log new")


def make_work(n_axes, n_columns):
    """Make the scratch arrays for models of so many parameters, and tables of so many columns."""
    n_nodes = 1 + n_axes * (n_axes + 3) // 2
    return Work(
        value=np.zeros(n_axes),
        part=np.zeros((n_axes, 3)),
        step=np.zeros((n_axes, 3), np.int64),
        slot=np.zeros((n_axes, 2), np.int64),
        row=np.zeros(n_nodes, np.int64),
        weight=np.zeros(n_nodes),
        flux=np.zeros((3, n_columns)),
        log=np.zeros(n_columns),
        new=np.zeros(n_axes),
    )


@njit(**PART)
def place_between(nodes, n, x):
    """Node below a place, and the part of the way to the next."""
    if n <= 1:
        return 0, 0.0
    low = 0
    size = n - 1
    # the same number of steps for every place, without branches that processors would mispredict
    while size > 1:
        half = size // 2
        low += half * (nodes[low + half] <= x)
        size -= half
    return low, (x - nodes[low]) / (nodes[low + 1] - nodes[low])


@njit(**PART)
def _on_scale(value, power):
    """A value on the scale of its axis: a power of 1 or parts by 2, the sign changed below 0."""
    x = value
    # powers of 1/2 are roots of roots
    root = abs(power)
    while root < 1.0:
        x = math.sqrt(x)
        root *= 2.0
    if power > 0.0:
        return x
    return -1.0 / x


@njit(**PART)
def _axis_weights(a, n, stride, scaled, x, work):
    """Weights and steps along one axis; returned is the nearest node."""
    part = work.part
    step = work.step
    low, t = place_between(scaled, n, x)
    center = low
    if t > 0.5:
        center += 1
    # the nodes on both sides, at an end the next two
    first = -1
    if center == 0:
        first = 1
    if n == 2:
        second = 0
    elif center == n - 1:
        second = -2
    elif center == 0:
        second = 2
    else:
        second = 1
    d = x - scaled[center]
    to_first = scaled[center + first] - scaled[center]
    to_second = scaled[center + second] - scaled[center]
    part[a, 0] = d / to_first
    part[a, 1] = 0.0
    if n > 2:
        part[a, 0] *= (d - to_second) / (to_first - to_second)
        part[a, 1] = d * (d - to_first) / (to_second * (to_second - to_first))
    step[a, 0] = first * stride
    step[a, 1] = second * stride
    # the corner is on the side of the place
    part[a, 2] = d / to_first
    step[a, 2] = 0
    if second == 1 and d > 0.0:
        part[a, 2] = d / to_second
        step[a, 2] = 1
    return center


@njit(**PART)
def find_nodes(part_table, value, work):
    """Fill nodes and weights of a model of a `Part`; returned is their number, 0 if there is none."""
    part = work.part
    step = work.step
    size = part_table.size
    model = part_table.model
    n_axes = len(size)
    nearest_place = 0
    stride = 1
    for a in range(n_axes - 1, -1, -1):
        n = size[a]
        for k in range(3):
            part[a, k] = 0.0
            step[a, k] = 0
        if n > 1:
            scaled = part_table.scaled[a]
            x = _on_scale(value[part_table.axis[a]], part_table.power[a])
            x = min(max(x, scaled[0]), scaled[n - 1])
            nearest_place += stride * _axis_weights(a, n, stride, scaled, x, work)
        stride *= n
    nearest = model[nearest_place]
    if nearest < 0:
        return 0
    work.row[0] = nearest
    work.weight[0] = 1.0
    count = 1
    for a in range(n_axes):
        for k in range(2):
            if abs(part[a, k]) > _LEAST_WEIGHT:
                m = model[nearest_place + step[a, k]]
                # where there is no model the nearest stands for it
                if m < 0:
                    m = nearest
                work.row[count] = m
                work.weight[count] = part[a, k]
                work.weight[0] -= part[a, k]
                work.slot[a, k] = count
                count += 1
    # products of the steps along two axes
    for a in range(n_axes):
        for b in range(a):
            w = part[a, 2] * part[b, 2]
            if w > _LEAST_WEIGHT:
                side_a = step[a, 2]
                side_b = step[b, 2]
                m = model[nearest_place + step[a, side_a] + step[b, side_b]]
                if m >= 0:
                    work.row[count] = m
                    work.weight[count] = w
                    work.weight[0] += w
                    work.weight[work.slot[a, side_a]] -= w
                    work.weight[work.slot[b, side_b]] -= w
                    count += 1
    return count


@njit(**PART)
def add_up(part_table, log_z, count, work, out):
    """Interpolate the columns of a `Part` at ln(1 + z) between the nodes in ``work``: logarithms, into ``out``."""
    table = part_table.table
    n_z = table.shape[0]
    n_columns = table.shape[2]
    z, t = place_between(part_table.log_z, n_z, log_z)
    next_z = min(z + 1, n_z - 1)
    for j in range(n_columns):
        out[j] = 0.0
    for r in range(count):
        high_weight = work.weight[r] * t
        low_weight = work.weight[r] - high_weight
        low = table[z, work.row[r]]
        high = table[next_z, work.row[r]]
        for j in range(n_columns):
            out[j] += low_weight * low[j] + high_weight * high[j]
    nearest_z = z
    if t > 0.5:
        nearest_z = next_z
    nearest = table[nearest_z, work.row[0]]
    for j in range(n_columns):
        out[j] = min(max(out[j], nearest[j] - STEEPEST), nearest[j] + STEEPEST)
        out[j] += part_table.offset[j]


@njit(**PART)
def add_light(part_table, log_z, count, work, factor, out):
    """Add a factor times the columns of a `Part` at ln(1 + z) between the nodes in ``work`` to ``out``."""
    table = part_table.table
    n_columns = table.shape[2]
    if n_columns < LANES:
        log = work.log
        add_up(part_table, log_z, count, work, log)
        for j in range(n_columns):
            out[j] += factor * exponential(log[j])
        return
    z, t = place_between(part_table.log_z, table.shape[0], log_z)
    next_z = min(z + 1, table.shape[0] - 1)
    nearest_z = z
    if t > 0.5:
        nearest_z = next_z
    nodes = (work.row, work.weight, count, z, next_z, nearest_z)
    add_exponentials(table, part_table.unit, *nodes, t, factor, out)


@njit(**PART)
def mixed(part_table, burst, share, log_z, value, work, out):
    """Columns of starlight, with a burst of a mass fraction, into ``out``; False where there is no model."""
    out[: part_table.table.shape[2]] = 0.0
    count = find_nodes(part_table, value, work)
    if count == 0:
        return False
    add_light(part_table, log_z, count, work, 1.0 - share, out)
    if share > 0.0:
        count = find_nodes(burst, value, work)
        add_light(burst, log_z, count, work, share, out)
    return True


@njit(**PART)
def dust_power(light, value, ratio):
    """Power of the dust's light, from its ratio to how far the amount of dust saturates."""
    power = ratio
    if light.amount >= 0:
        power *= 1.0 - math.exp(-SATURATION * value[light.amount])
    if light.excess >= 0:
        power *= value[light.excess]
    return power


@njit(**PART)
def galaxy_light(light, value, log_z, work):
    """
    Fluxes times z^2 of a galaxy, and last what AGN fractions refer to, into ``work.flux[0]``.

    Returned is whether there is such a galaxy.
    """
    flux = work.flux[0]
    last = light.stars.table.shape[2] - 1
    if light.age >= 0:
        z, t = place_between(light.stars.log_z, len(light.youth), log_z)
        oldest = light.youth[z]
        if len(light.youth) > 1:
            oldest += t * (light.youth[z + 1] - light.youth[z])
        if value[light.age] > oldest:
            return False
    share = 0.0
    if light.mixing >= 0:
        share = value[light.mixing]
    if not mixed(light.stars, light.burst, share, log_z, value, work, flux):
        return False
    power = dust_power(light, value, flux[last])
    if light.dust.table.shape[1] > 0 and power > 0.0:
        count = find_nodes(light.dust, value, work)
        add_light(light.dust, log_z, count, work, power, flux)
    if light.by_dust:
        flux[last] = power
    else:
        flux[last] = flux[last - 1]
    return True


@njit(**PART)
def with_agn(light, value, frac, log_z, work):
    """
    Add an AGN of a fraction to the galaxy in ``work.flux[0]``, whose last value becomes the AGN's power.

    Its own fluxes stay in ``work.flux[1]``. Returned is whether there is such an AGN.
    """
    flux = work.flux[0]
    last = light.stars.table.shape[2] - 1
    power = flux[last] * frac / max(1.0 - frac, 1e-12)
    flux[last] = power
    if not power > 0.0:
        return True
    agn = work.flux[1]
    count = find_nodes(light.agn, value, work)
    if count == 0:
        return False
    agn[: last - 1] = 0.0
    add_light(light.agn, log_z, count, work, power, agn)
    for j in range(last - 1):
        flux[j] += agn[j]
    return True


@njit(**KERNEL)
def interpolate_light(light, values, redshift, frac, work, flux, power):
    """
    Fluxes of n models, (n, nb), with AGN of fractions (n,); NaN where there is no model.

    ``power``, (2, n), gets what the fractions refer to, and the power of the AGN.
    """
    last = light.stars.table.shape[2] - 1
    for i in range(len(values)):
        log_z = math.log1p(redshift[i])
        exists = galaxy_light(light, values[i], log_z, work)
        power[0, i] = work.flux[0, last]
        if exists:
            exists = with_agn(light, values[i], frac[i], log_z, work)
        power[1, i] = work.flux[0, last]
        nearer = max(redshift[i], 1e-6) ** -2.0
        if exists:
            for j in range(flux.shape[1]):
                flux[i, j] = work.flux[0, j] * nearer
        else:
            flux[i, :] = np.nan


@njit(**KERNEL)
def interpolate_columns(part_table, values, redshift, work, out):
    """Interpolate the logarithms in a table at n places: ``out``, (n, n_columns); NaN where there is none."""
    for i in range(len(out)):
        count = find_nodes(part_table, values[i], work)
        if count == 0:
            out[i, :] = np.nan
        else:
            add_up(part_table, math.log1p(redshift[i]), count, work, out[i])


@njit(**KERNEL)
def interpolate_exponentials(part_table, values, redshift, work, out):
    """Do what `interpolate_columns` does for the exponentials of logarithms."""
    for i in range(len(out)):
        count = find_nodes(part_table, values[i], work)
        if count == 0:
            out[i, :] = np.nan
        else:
            out[i, :] = 0.0
            add_light(part_table, math.log1p(redshift[i]), count, work, 1.0, out[i])
