"""
Kernels of adaptive importance sampling: places of labels, and mixtures of t distributions that propose them.

A *label* is a range of cells on each axis: the one cell of a component that is absent or of a metallicity, or all
cells of what is present. Within a label a place has one coordinate for each axis, the normal score of its place
among the prior weights of these cells, so that where data say nothing the posterior is a standard normal
distribution. Axes without effect for a label stay at it; the others are *active*.
"""

import math
from collections import namedtuple

from miricigale.fitting._core.population import NEVER, _evaluate
from miricigale.utils._core.functions import exponential, polynomial
from miricigale.utils.compilation import KERNEL, PART, njit

#: Labels of a `Space`: first cell and number of cells of each axis, int64 (n_labels, n_axes); the active axes,
#: int64 (n_labels, n_axes), and their number, (n_labels,); share of the proposal below each cell, (n_axes,
#: n_largest + 1), and ln of the share of each, (n_axes, n_largest).
Labels = namedtuple("Labels", "first count axes n_active below log_share")
#: A mixture of n parts, sorted by label: index of the first part of each label, int64 (n_labels + 1,); label of
#: each, int64 (n,); shares, (n,); largest densities, (n,); means in the active axes, (n, n_axes); lower triangular
#: roots of the covariances, (n, n_axes, n_axes), and their inverses.
Parts = namedtuple("Parts", "start label share top mean root inverse")

#: Degrees of freedom of the t distributions.
FREEDOM = 8
#: Part of a cell that places keep from its ends, so that rounding does not move them to another.
_INSIDE = 1e-9
_ROOT_HALF = math.sqrt(0.5)
# ln of erfc(x) exp(x^2) / t in t = 1 / (1 + x / 2)
_ERFC = polynomial(
    (0.17087277, -0.82215223, 1.48851587, -1.13520398, 0.27886807)
    + (-0.18628806, 0.09678418, 0.37409196, 1.00002368, -1.26551223)
)
_LOG_ROOT_TWO_PI = 0.5 * math.log(2.0 * math.pi)


@njit(**PART)
def _shares_below(y, x):
    """
    Shares of the standard normal distribution below scores, to 1e-7.

    The fraction is that of Press et al. 1992, Numerical Recipes, section 6.2.
    """
    scores = y.reshape(y.size)
    out = x.reshape(y.size)
    for i in range(len(scores)):
        size = abs(scores[i]) * _ROOT_HALF
        t = 1.0 / (1.0 + 0.5 * size)
        exponent = _ERFC(t) - size * size
        tail = 0.5 * t * exponential(max(exponent, -700.0))
        out[i] = tail if scores[i] < 0.0 else 1.0 - tail


@njit(**PART)
def _to_unit(space, labels, label, x):
    """
    Put the place whose shares of the normal distribution below its scores are ``x`` in unit intervals.

    Returned is -ln of the proposal's density, but for the ranges of the label (`_log_ranges`).
    """
    log = 0.0
    for c in range(len(x)):
        first = labels.first[label, c]
        if labels.count[label, c] == 1 and space.low[c, first] == space.high[c, first]:
            # the cell is a value, whatever the score
            x[c] = (first + 0.5) / space.size[c]
            log -= labels.log_share[c, first]
            continue
        share_below = labels.below[c]
        last = first + labels.count[label, c] - 1
        start = share_below[first]
        range_share = share_below[last + 1] - start
        t = start + range_share * x[c]
        low = first
        high = last
        while low < high:
            middle = (low + high + 1) // 2
            if share_below[middle] <= t:
                low = middle
            else:
                high = middle - 1
        cell_share = share_below[low + 1] - share_below[low]
        part = 0.5
        if cell_share > 0.0:
            part = (t - share_below[low]) / cell_share
        part = min(max(part, _INSIDE), 1.0 - _INSIDE)
        x[c] = (low + part) / space.size[c]
        log -= labels.log_share[c, low]
    return log


@njit(**PART)
def _log_ranges(labels, label):
    """Ln of the share of the proposal in the cells of a label."""
    log = 0.0
    for c in range(len(labels.below)):
        first = labels.first[label, c]
        end = first + labels.count[label, c]
        log += math.log(labels.below[c, end] - labels.below[c, first])
    return log


@njit(**KERNEL)
def evaluate_places(space, labels, target, label, y, x, evaluated, flux, work):
    """
    Evaluate the posterior of an object at places.

    Parameters
    ----------
    space, labels, target : `Space`, `Labels`, `Object`
        What places are in, and the object.
    label : `~numpy.ndarray` of int, shape (n,)
        Labels of the places.
    y : `~numpy.ndarray`, shape (n, n_axes)
        Their scores.
    x : `~numpy.ndarray`, shape (n, n_axes)
        Gets the places in unit intervals.
    evaluated : `~numpy.ndarray`, shape (n, 5)
        Gets ln of the posterior in scores over the standard normal distribution of the axes that are not active,
        best scale, its variance, AGN power, and ln of the likelihood.
    flux : `~numpy.ndarray`, shape (n, nb)
        Gets fluxes for one solar mass formed; they mean nothing where there is no model.
    work : `Work`
        Scratch.
    """
    own_label = -1
    log_ranges = 0.0
    _shares_below(y, x)
    for i in range(len(y)):
        # neighbors share labels
        if label[i] != own_label:
            own_label = label[i]
            log_ranges = _log_ranges(labels, own_label)
        log = log_ranges + _to_unit(space, labels, label[i], x[i])
        prior, like, scale, variance = _evaluate(space, target, x[i], work)
        for a in range(labels.n_active[label[i]]):
            score = y[i, labels.axes[label[i], a]]
            log -= 0.5 * score * score + _LOG_ROOT_TWO_PI
        evaluated[i, 0] = NEVER
        if prior > 0.5 * NEVER:
            evaluated[i, 0] = log + prior + like
        evaluated[i, 1] = scale
        evaluated[i, 2] = variance
        evaluated[i, 3] = work.flux[0, len(work.flux[0]) - 1]
        evaluated[i, 4] = like
        for b in range(flux.shape[1]):
            flux[i, b] = work.flux[0, b]


@njit(**KERNEL)
def propose(labels, parts, upto, choice, normal, spread, label, y):
    """
    Draw places from a mixture.

    Parameters
    ----------
    labels, parts : `Labels`, `Parts`
        The mixture.
    upto : `~numpy.ndarray`, shape (n_parts,)
        Shares of the parts up to each.
    choice, normal, spread : `~numpy.ndarray`, shapes (n,), (n, n_axes) and (n,)
        Uniform numbers, which choose parts; standard normal numbers; roots of ``FREEDOM`` over numbers of a chi2
        distribution.
    label, y : `~numpy.ndarray`, shapes (n,) and (n, n_axes)
        Get labels and scores.
    """
    n_axes = y.shape[1]
    for i in range(len(y)):
        # the first part up to which there is as much
        p = 0
        last = len(upto) - 1
        while p < last:
            middle = (p + last) // 2
            if upto[middle] < choice[i]:
                p = middle + 1
            else:
                last = middle
        part_label = parts.label[p]
        label[i] = part_label
        for c in range(n_axes):
            y[i, c] = normal[i, c]
        axes = labels.axes[part_label]
        n = labels.n_active[part_label]
        for a in range(n):
            total = 0.0
            for b in range(a + 1):
                total += parts.root[p, a, b] * normal[i, axes[b]]
            y[i, axes[a]] = parts.mean[p, a] + spread[i] * total


@njit(**PART)
def _copy_active(y, first, n, axes, n_active, coordinate):
    """Copy active axes of n points, from point ``first`` on, to rows of ``coordinate``."""
    for a in range(n_active):
        row = coordinate[a]
        axis = axes[a]
        for i in range(n):
            row[i] = y[first + i, axis]


@njit(**PART)
def _squares(coordinate, n, n_active, mean, inverse, row, square):
    """Squared distances of n points from a mean, in units of a covariance whose inverse root is known."""
    square[:n] = 0.0
    for a in range(n_active):
        row[:n] = 0.0
        for b in range(a + 1):
            factor = inverse[a, b]
            middle = mean[b]
            values = coordinate[b]
            for i in range(n):
                row[i] += factor * (values[i] - middle)
        for i in range(n):
            square[i] += row[i] * row[i]


@njit(**PART)
def _add_t_density(n, n_active, share, top, square, row, density):
    """Add the density of a part at n points, whose squared distances are known, times its share."""
    # (1 + square / FREEDOM)^(-(FREEDOM + n_active) / 2)
    for i in range(n):
        row[i] = 1.0 / math.sqrt(1.0 + square[i] / FREEDOM)
        square[i] = share * top
    for _ in range(FREEDOM + n_active):
        for i in range(n):
            square[i] *= row[i]
    for i in range(n):
        density[i] += square[i]


@njit(**KERNEL)
def add_density(labels, parts, column, ends, y, coordinate, density):
    """
    Add the densities of parts of a mixture at places to others.

    Parameters
    ----------
    labels, parts : `Labels`, `Parts`
        The mixture.
    column : `~numpy.ndarray` of int, shape (n_parts,)
        Column of ``density`` that each part is added to.
    ends : `~numpy.ndarray` of int, shape (n_blocks, n_labels + 1)
        Blocks of places are sorted by label: index of the first of each label, and the end of the last.
    y : `~numpy.ndarray`, shape (n, n_axes)
        Scores.
    coordinate : `~numpy.ndarray`, shape (n_axes + 2, n_block)
        Scratch.
    density : `~numpy.ndarray`, shape (n_columns, n)
        Is added to.
    """
    n_axes = y.shape[1]
    row = coordinate[n_axes]
    square = coordinate[n_axes + 1]
    for block in range(len(ends)):
        for own_label in range(len(labels.n_active)):
            first = ends[block, own_label]
            n = ends[block, own_label + 1] - first
            if n == 0:
                continue
            n_active = labels.n_active[own_label]
            _copy_active(y, first, n, labels.axes[own_label], n_active, coordinate)
            for p in range(parts.start[own_label], parts.start[own_label + 1]):
                _squares(coordinate, n, n_active, parts.mean[p], parts.inverse[p], row, square)
                out = density[column[p], first : first + n]
                _add_t_density(n, n_active, parts.share[p], parts.top[p], square, row, out)
