"""Kernels that fit mixtures of t distributions to places, for `importance`."""

import math

from miricigale.fitting._core.importance import (
    FREEDOM,
    _add_t_density,
    _copy_active,
    _squares,
)
from miricigale.fitting._core.population import NEVER
from miricigale.utils._core.functions import exponential
from miricigale.utils.compilation import KERNEL, PART, njit

_LOG_FREEDOM_PI = math.log(FREEDOM * math.pi)
_ROOT_HALF = math.sqrt(0.5)
#: Least square of a diagonal element of a root.
_NARROW = 1e-10
#: Steps in which places next to another are found, and how many times as many as wanted there may be.
_BISECTIONS = 30
_ENOUGH = 1.1


@njit(**PART)
def _invert(cov, n, root, inverse):
    """Lower triangular root of a covariance and its inverse; returned is ln of the root's determinant."""
    log = 0.0
    for a in range(n):
        for b in range(a + 1):
            total = cov[a, b]
            for c in range(b):
                total -= root[a, c] * root[b, c]
            if a == b:
                root[a, a] = math.sqrt(max(total, _NARROW))
                log += math.log(root[a, a])
            else:
                root[a, b] = total / root[b, b]
    for b in range(n):
        inverse[b, b] = 1.0 / root[b, b]
        for a in range(b + 1, n):
            total = 0.0
            for c in range(b, a):
                total -= root[a, c] * inverse[c, b]
            inverse[a, b] = total / root[a, a]
    return log


@njit(**PART)
def _set_part(labels, parts, p, label, cov):
    """Finish part p, whose mean is there, with a covariance in all active axes of its label."""
    n = labels.n_active[label]
    log = _invert(cov, n, parts.root[p], parts.inverse[p])
    half = 0.5 * (FREEDOM + n)
    log = math.lgamma(half) - math.lgamma(0.5 * FREEDOM) - log - 0.5 * n * _LOG_FREEDOM_PI
    parts.label[p] = label
    parts.top[p] = math.exp(log)


@njit(**KERNEL)
def add_widest(labels, parts, places, mean, cov, cov_active):
    """Set a part for each label, at ``places`` of the mixture, of a mean and covariance of all axes."""
    for label in range(len(places)):
        axes = labels.axes[label]
        p = places[label]
        for a in range(labels.n_active[label]):
            parts.mean[p, a] = mean[axes[a]]
            for b in range(a + 1):
                cov_active[a, b] = cov[axes[a], axes[b]]
        _set_part(labels, parts, p, label, cov_active)


@njit(**PART)
def _moments(coordinate, n, n_active, weight, mean, cov, row):
    """Mean and covariance of n points with weights; returned are the sum of weights and of their squares."""
    total = 0.0
    square = 0.0
    for i in range(n):
        total += weight[i]
        square += weight[i] * weight[i]
    inverse = 1.0 / max(total, 1e-300)
    for a in range(n_active):
        values = coordinate[a]
        first = 0.0
        for i in range(n):
            first += weight[i] * values[i]
        mean[a] = first * inverse
    for a in range(n_active):
        values = coordinate[a]
        middle = mean[a]
        for i in range(n):
            row[i] = inverse * weight[i] * (values[i] - middle)
        for b in range(a + 1):
            b_values = coordinate[b]
            b_mean = mean[b]
            second = 0.0
            for i in range(n):
                second += row[i] * (b_values[i] - b_mean)
            cov[a, b] = second
    return total, square


@njit(**KERNEL)
def fit_parts(
    labels, parts, p, label, n_parts, rounds, wide, y, weight, prior_mean, prior_cov, scratch
):
    """
    Fit parts of a mixture to points of one label, by expectation and maximization of normal distributions.

    Parameters
    ----------
    labels, parts : `Labels`, `Parts`
        Parts from p on are filled; their shares sum to 1.
    label, n_parts, rounds : int
        Label of the points; parts to fit, and rounds.
    wide : float
        What widths are multiplied by in the end.
    y : `~numpy.ndarray`, shape (n, n_axes)
        Scores of the points.
    weight : `~numpy.ndarray`, shape (n,)
        Their weights.
    prior_mean, prior_cov : `~numpy.ndarray`, shapes (n_axes,) and (n_axes, n_axes)
        Mean and covariance of all axes that those of few points are drawn to.
    scratch : tuple of `~numpy.ndarray`, shapes (n_axes + 2, n), (n_parts + 1, n), (n_axes, n_axes) and (n_parts,)
    """
    coordinate, part_weight, cov, of_part = scratch
    n = len(weight)
    n_axes = y.shape[1]
    n_active = labels.n_active[label]
    axes = labels.axes[label]
    row = coordinate[n_axes]
    square = coordinate[n_axes + 1]
    _copy_active(y, 0, n, axes, n_active, coordinate)
    # begin with slices along the axis in which the points scatter most
    total, _ = _moments(coordinate, n, n_active, weight, parts.mean[p], cov, row)
    longest = 0
    for a in range(n_active):
        if cov[a, a] > cov[longest, longest]:
            longest = a
    center = parts.mean[p, longest]
    width = math.sqrt(max(cov[longest, longest], 1e-300))
    for i in range(n):
        d = 0.0
        if n_active > 0:
            d = (coordinate[longest, i] - center) / width
        # of equal weight if these are normal
        k = min(int(n_parts * 0.5 * math.erfc(-d * _ROOT_HALF)), n_parts - 1)
        for j in range(n_parts):
            part_weight[j, i] = 0.0
        part_weight[k, i] = weight[i]
    n_rounds = 1
    if n_parts > 1:
        n_rounds = rounds
    for turn in range(n_rounds):
        last = turn == n_rounds - 1
        factor = 1.0
        if last:
            factor = wide * wide
        for j in range(n_parts):
            part_total, squares = _moments(
                coordinate, n, n_active, part_weight[j], parts.mean[p + j], cov, row
            )
            of_part[j] = part_total / total
            # few points say little of a covariance
            shrinkage = n_active / (n_active + part_total * part_total / max(squares, 1e-300))
            for a in range(n_active):
                for b in range(a + 1):
                    from_all = prior_cov[axes[a], axes[b]]
                    cov[a, b] = factor * ((1.0 - shrinkage) * cov[a, b] + shrinkage * from_all)
            if n_parts == 1:
                for a in range(n_active):
                    parts.mean[p, a] += shrinkage * (prior_mean[axes[a]] - parts.mean[p, a])
            _set_part(labels, parts, p + j, label, cov)
            parts.share[p + j] = of_part[j]
        if last:
            return
        # points belong to parts by the normal densities of these
        sums = part_weight[n_parts]
        sums[:n] = 1e-280
        for j in range(n_parts):
            inverse = parts.inverse[p + j]
            density = of_part[j]
            for a in range(n_active):
                density *= inverse[a, a]
            _squares(coordinate, n, n_active, parts.mean[p + j], inverse, row, square)
            for i in range(n):
                part_weight[j, i] = density * exponential(max(-0.5 * square[i], -600.0))
            for i in range(n):
                sums[i] += part_weight[j, i]
        for j in range(n_parts):
            for i in range(n):
                part_weight[j, i] *= weight[i] / sums[i]


@njit(**KERNEL)
def fit_groups(
    labels,
    parts,
    groups,
    order,
    rounds,
    wide,
    wide_share,
    y,
    weight,
    prior_mean,
    prior_cov,
    scratch,
):
    """
    Fit parts of a mixture to the points of each of several groups; see `fit_parts`.

    Parameters
    ----------
    labels, parts : `Labels`, `Parts`
        Parts are filled; their shares and those of the wide ones sum to 1 in each group.
    groups : `~numpy.ndarray` of int, shape (n_groups, 5)
        Label of each group, first of its points in ``order`` and the one after its last, first part, and number of
        parts to fit, after which the wide one comes.
    order : `~numpy.ndarray` of int, shape (n,)
        Points by group.
    rounds : int
        Rounds of each fit.
    wide, wide_share : float
        What widths are multiplied by in the end, and share of the wide part.
    y, weight : `~numpy.ndarray`, shapes (n, n_axes) and (n,)
        Scores of the points, and weights; those of weight 0 do not count.
    prior_mean, prior_cov : `~numpy.ndarray`, shapes (n_groups, n_axes) and (n_groups, n_axes, n_axes)
        Mean and covariance of all axes that those of few points are drawn to.
    scratch : tuple of `~numpy.ndarray`
        Shapes (n_axes + 2, n), (n_parts + 1, n), (n_axes, n_axes), (n_parts,), (n, n_axes) and (n,).
    """
    coordinate, part_weight, cov, of_part, own_y, own_weight = scratch
    for j in range(len(groups)):
        first = groups[j, 3]
        n_fitted = groups[j, 4]
        n = 0
        for k in range(groups[j, 1], groups[j, 2]):
            i = order[k]
            if weight[i] > 0.0:
                own_weight[n] = weight[i]
                for c in range(y.shape[1]):
                    own_y[n, c] = y[i, c]
                n += 1
        fit_parts(
            labels,
            parts,
            first,
            groups[j, 0],
            n_fitted,
            rounds,
            wide,
            own_y[:n],
            own_weight[:n],
            prior_mean[j],
            prior_cov[j],
            (coordinate, part_weight, cov, of_part),
        )
        for p in range(first, first + n_fitted):
            parts.share[p] *= 1.0 - wide_share
        parts.share[first + n_fitted] = wide_share


@njit(**KERNEL)
def mean_and_cov(y, weight, mean, cov):
    """
    Compute mean and covariance of points with weights.

    Parameters
    ----------
    y, weight : `~numpy.ndarray`, shapes (n, n_axes) and (n,)
        Points, and weights that are not all 0.
    mean, cov : `~numpy.ndarray`, shapes (n_axes,) and (n_axes, n_axes)
        Get them.
    """
    n_axes = len(mean)
    mean[:] = 0.0
    cov[:] = 0.0
    total = 0.0
    for i in range(len(weight)):
        w = weight[i]
        if w > 0.0:
            total += w
            for a in range(n_axes):
                mean[a] += w * y[i, a]
    for a in range(n_axes):
        mean[a] /= total
    for i in range(len(weight)):
        w = weight[i] / total
        if w > 0.0:
            for a in range(n_axes):
                part = w * (y[i, a] - mean[a])
                for b in range(n_axes):
                    cov[a, b] += part * (y[i, b] - mean[b])


@njit(**PART)
def _farthest_of(distance, n, n_near):
    """Return a distance within which ``n_near`` of n points are, or a few more."""
    low = 0.0
    high = 0.0
    for i in range(n):
        high = max(high, distance[i])
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        inside = 0
        for i in range(n):
            if distance[i] <= middle:
                inside += 1
        if inside < n_near:
            low = middle
        else:
            high = middle
            if inside < _ENOUGH * n_near:
                break
    return high


@njit(**KERNEL)
def add_local_parts(labels, parts, first, n_base, n_local, share, n_near, wide, points, scratch):
    """
    Add narrow parts where the others would leave places of a group with large weights.

    Each is put where places add most to the square of the weights, with the covariance of the places next to
    it around this one (incremental mixture importance sampling: Raftery & Bao 2010, Biometrics 66, 1162).

    Parameters
    ----------
    labels, parts : `Labels`, `Parts`
        The mixture.
    first, n_base, n_local : int
        First part of the group, number of those that are there, whose shares are lowered, and number of those that
        follow.
    share : float
        Share of the new parts.
    n_near : int
        Number of places next to the center of a part.
    wide : float
        What widths are multiplied by.
    points : tuple
        Scores of places of the group, shape (n, n_axes), their weights, which sum to 1, and the posterior in
        any unit, both of shape (n,).
    scratch : tuple of `~numpy.ndarray`, shapes (n_axes + 2, n), (4, n), (n_axes, n), and two of (n_axes, n_axes)
    """
    y, weight, target = points
    coordinate, rows_of_points, near, cov, cov_inverse = scratch
    n = len(weight)
    n_axes = y.shape[1]
    label = parts.label[first]
    n_active = labels.n_active[label]
    row = coordinate[n_axes]
    square = coordinate[n_axes + 1]
    base, local, near_weight, distance = rows_of_points
    _copy_active(y, 0, n, labels.axes[label], n_active, coordinate)
    base[:] = 1e-290
    for p in range(first, first + n_base):
        _squares(coordinate, n, n_active, parts.mean[p], parts.inverse[p], row, square)
        _add_t_density(n, n_active, parts.share[p], parts.top[p], square, row, base)
        parts.share[p] *= 1.0 - share
    local[:] = 0.0
    p = first + n_base
    _moments(coordinate, n, n_active, weight, parts.mean[p], cov, row)
    for a in range(n_active):
        cov[a, a] += 1e-6
    # what distances are measured in
    inverse = cov_inverse
    _invert(cov, n_active, parts.root[p], inverse)
    for t in range(n_local):
        p = first + n_base + t
        lowered = 1.0 - share * t / n_local
        best = -1.0
        center = 0
        for i in range(n):
            worth = weight[i] * target[i] / (lowered * base[i] + local[i])
            if worth > best:
                best = worth
                center = i
        mean = parts.mean[p]
        for a in range(n_active):
            mean[a] = coordinate[a, center]
        _squares(coordinate, n, n_active, mean, inverse, row, distance)
        farthest = _farthest_of(distance, n, n_near)
        # those that are near, side by side
        total = 0.0
        count = 0
        for i in range(n):
            if distance[i] <= farthest:
                for a in range(n_active):
                    near[a, count] = coordinate[a, i] - mean[a]
                near_weight[count] = weight[i]
                total += weight[i]
                count += 1
        total = max(total, 1e-300)
        for i in range(count):
            # between the posterior and the places as they were drawn
            near_weight[i] = 0.5 * near_weight[i] / total + 0.5 / count
        for a in range(n_active):
            for i in range(count):
                row[i] = near_weight[i] * near[a, i]
            for b in range(a + 1):
                second = 0.0
                for i in range(count):
                    second += row[i] * near[b, i]
                cov[a, b] = wide * wide * second
            cov[a, a] += 1e-6
        _set_part(labels, parts, p, label, cov)
        parts.share[p] = share / n_local
        _squares(coordinate, n, n_active, mean, parts.inverse[p], row, square)
        _add_t_density(n, n_active, parts.share[p], parts.top[p], square, row, local)


@njit(**KERNEL)
def flatten(log, wanted, weight):
    """
    Weights exp(power * log), at most 1, of which an effective number is wanted; the power is 1 or less.

    Returned are that power and the effective number.
    """
    top = NEVER
    for i in range(len(log)):
        top = max(top, log[i])
    power = 1.0
    while True:
        total = 0.0
        square = 0.0
        for i in range(len(log)):
            w = exponential(max(power * (log[i] - top), -600.0))
            weight[i] = w
            total += w
            square += w * w
        effective = total * total / square
        if effective >= wanted or power < 0.02:
            return power, effective
        power *= 0.75
