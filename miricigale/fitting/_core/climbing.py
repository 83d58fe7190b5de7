"""
Peaks of the posterior of an object between nodes, with the normal distributions around them.

In scores (`importance`) the prior is a standard normal distribution, and chi2 a sum of squares: steps are those of
Levenberg and Marquardt (Marquardt 1963, J. SIAM 11, 431), with derivatives of the residuals by small differences.
The inverse of the matrix of second derivatives is the covariance of the posterior where that is normal (Laplace).
"""

import math
from collections import namedtuple

import numpy as np

from miricigale.fitting._core.importance import _invert, place_value
from miricigale.fitting._core.population import NEVER
from miricigale.fitting._core.structs import KERNEL, PART
from miricigale.utils.compilation import njit

#: Scratch: residuals at a place and at one beside it, (2, nb), their derivatives, (n_axes, nb); gradient, step and
#: a place in scores and in the unit interval, (4, n_axes); the matrix of second derivatives, that of a step, its
#: root and the root's inverse, (4, n_axes, n_axes).
ClimbWork = namedtuple("ClimbWork", "residual slope vector matrix")

#: Differences of scores that derivatives are taken of.
_DIFFERENCE = 1e-3
#: Damping to begin with, at least, and the factor that it changes by.
_DAMPING = 1e-2
_MIN_DAMPING = 1e-6
_MIN_RAISED = 1e-3
_DAMPING_FACTOR = 10.0
#: Number of dampings that are tried for a step.
_TRIES = 4
#: Largest step in any score, and largest score.
_LONGEST = 2.0
_MAX_SCORE = 4.0
#: Gain of ln(posterior) below which a peak is reached.
_STILL = 0.02
#: Squared distance in units of the covariance below which two peaks are one.
_SAME = 0.3
_LOG_TWO_PI = math.log(2.0 * math.pi)


def make_climb_work(n_axes, n_bands):
    """Make the scratch of `climb` for so many axes, and bands with those of nuclei."""
    return ClimbWork(
        residual=np.zeros((2, n_bands)),
        slope=np.zeros((n_axes, n_bands)),
        vector=np.zeros((4, n_axes)),
        matrix=np.zeros((4, n_axes, n_axes)),
    )


@njit(**PART)
def _residuals(observed, nuclei, mixture, scale, work, out):
    """Put residuals over errors of the model in the scratch into ``out``; limits have none."""
    flux = work.flux[0]
    weight = work.flux[2]
    if nuclei is not None:
        flux = nuclei.flux[0]
        weight = nuclei.flux[2]
    if mixture is not None:
        weight = mixture.weight
    target = observed.target
    for b in target.bands:
        out[b] = math.sqrt(weight[b]) * (target.flux[b] - scale * flux[b])


@njit(**PART)
def _derive(space, labels, target, label, y, work, climb):
    """Fill gradient and matrix of second derivatives at scores ``y``; returned is ln(posterior)."""
    residual = climb.residual[0]
    beside = climb.residual[1]
    gradient = climb.vector[0]
    near = climb.vector[2]
    x = climb.vector[3]
    matrix = climb.matrix[0]
    axes = labels.axes[label]
    n = labels.n_active[label]
    for a in range(len(y)):
        near[a] = y[a]
    value = NEVER
    # the place itself, and then those beside it
    for a in range(-1, n):
        # toward the middle, where models exist more often
        h = -_DIFFERENCE
        if a < 0:
            h = 0.0
        elif y[axes[a]] < 0.0:
            h = _DIFFERENCE
        near_value = NEVER
        scale = 0.0
        for _ in range(2):
            if a >= 0:
                near[axes[a]] = y[axes[a]] + h
            near_value, scale = place_value(space, labels, target, label, near, x, work)
            if near_value > 0.5 * NEVER:
                break
            h = -h
        if a < 0:
            value = near_value
            if value < 0.5 * NEVER:
                return value
            _residuals(target, target.nuclei, target.mixture, scale, work, residual)
            continue
        near[axes[a]] = y[axes[a]]
        gradient[a] = -y[axes[a]]
        slope = climb.slope[a]
        # without a model on either side the prior alone says how far to go
        exists = near_value > 0.5 * NEVER
        if exists:
            _residuals(target, target.nuclei, target.mixture, scale, work, beside)
        for b in target.target.bands:
            slope[b] = 0.0
            if exists:
                slope[b] = (beside[b] - residual[b]) / h
            gradient[a] -= slope[b] * residual[b]
        for c in range(a + 1):
            other = climb.slope[c]
            total = 0.0
            for b in target.target.bands:
                total += slope[b] * other[b]
            matrix[a, c] = total
        # of the prior
        matrix[a, a] += 1.0
    return value


@njit(**PART)
def _step(n, damping, climb):
    """Solve for a step, of limited length, with a damping."""
    gradient = climb.vector[0]
    step = climb.vector[1]
    matrix = climb.matrix[0]
    damped = climb.matrix[1]
    inverse = climb.matrix[3]
    for a in range(n):
        for c in range(a + 1):
            damped[a, c] = matrix[a, c]
        damped[a, a] *= 1.0 + damping
    _invert(damped, n, climb.matrix[2], inverse)
    for a in range(n):
        step[a] = 0.0
    longest = 0.0
    for c in range(n):
        total = 0.0
        for a in range(c + 1):
            total += inverse[c, a] * gradient[a]
        for a in range(c + 1):
            step[a] += inverse[c, a] * total
    for a in range(n):
        longest = max(longest, abs(step[a]))
    factor = 1.0
    if longest > _LONGEST:
        factor = _LONGEST / longest
    for a in range(n):
        step[a] *= factor


@njit(**PART)
def _square(n, axes, y, other, matrix):
    """Squared distance of two places in units of a covariance, whose inverse is known."""
    square = 0.0
    for a in range(n):
        d = y[axes[a]] - other[axes[a]]
        square += matrix[a, a] * d * d
        for b in range(a):
            square += 2.0 * matrix[a, b] * d * (y[axes[b]] - other[axes[b]])
    return square


@njit(**KERNEL)
def climb_places(space, labels, target, label, y, n_steps, value, log_weight, cov, work, climb):
    """
    Climb from places to peaks of the posterior.

    Parameters
    ----------
    space, labels, target : `Space`, `Labels`, `Object`
        What places are in, and the object.
    label : `~numpy.ndarray` of int, shape (n,)
        Labels of the places, which stay.
    y : `~numpy.ndarray`, shape (n, n_axes)
        Scores; they become those of the peaks.
    n_steps : int
        Largest number of steps.
    value : `~numpy.ndarray`, shape (n,)
        Gets ln of the posterior there, as `evaluate_places` returns it.
    log_weight : `~numpy.ndarray`, shape (n,)
        Gets ln of the integral of the normal distribution with this peak; `NEVER` of what reached one again.
    cov : `~numpy.ndarray`, shape (n, n_axes, n_axes)
        Gets its covariance in the active axes, lower triangle.
    work, climb : `Work`, `ClimbWork`
        Scratch.
    """
    step = climb.vector[1]
    tried = climb.vector[2]
    x = climb.vector[3]
    inverse = climb.matrix[3]
    for i in range(len(y)):
        axes = labels.axes[label[i]]
        n = labels.n_active[label[i]]
        damping = _DAMPING
        gain = 0.0
        log_weight[i] = NEVER
        for turn in range(n_steps + 1):
            value[i] = _derive(space, labels, target, label[i], y[i], work, climb)
            if turn == n_steps or value[i] < 0.5 * NEVER or 0.0 < gain < _STILL:
                break
            gain = 0.0
            for _ in range(_TRIES):
                _step(n, damping, climb)
                for a in range(len(tried)):
                    tried[a] = y[i, a]
                for a in range(n):
                    score = tried[axes[a]] + step[a]
                    tried[axes[a]] = min(max(score, -_MAX_SCORE), _MAX_SCORE)
                new, _ = place_value(space, labels, target, label[i], tried, x, work)
                if new > value[i]:
                    gain = new - value[i]
                    break
                damping = max(damping, _MIN_RAISED) * _DAMPING_FACTOR
            if gain == 0.0:
                break
            damping = max(damping / _DAMPING_FACTOR, _MIN_DAMPING)
            for a in range(len(tried)):
                y[i, a] = tried[a]
        if value[i] < 0.5 * NEVER:
            continue
        # -0.5 ln(determinant) is that of the inverse root
        log = -_invert(climb.matrix[0], n, climb.matrix[2], inverse)
        log_weight[i] = value[i] + log + 0.5 * n * _LOG_TWO_PI
        for a in range(n):
            for b in range(a + 1):
                total = 0.0
                for c in range(a, n):
                    total += inverse[c, a] * inverse[c, b]
                cov[i, a, b] = total
        # the higher of two ends of the same peak stays
        for k in range(i):
            if label[k] != label[i] or log_weight[k] < 0.5 * NEVER:
                continue
            if _square(n, axes, y[i], y[k], climb.matrix[0]) < _SAME:
                lower = k
                if value[k] >= value[i]:
                    lower = i
                log_weight[lower] = NEVER
