"""
Slopes of an exposure whose groups were not followed, with the noise of the fit.

A slope is the best linear combination of differences, so that little is needed to draw it: its
mean, which is the fit to the expected ramp; photon noise, which is that of the collected electrons
but counted over a shorter time; read noise; and for pixels that lose groups an independent amount
more, since the covariance of the best estimate with one from fewer data is its own variance. Hits
come one by one: each is found or kept by the statistic that the fit would compute, and what is
kept shifts the slope by the weight of its difference.
"""

import numpy as np
from numpy.polynomial import polynomial

from miricigale.reduction._core.drawing import draw_slopes, hit_slopes, tabulate, variances
from miricigale.reduction.ramps.rampfit import fit_result, threshold
from miricigale.utils.random import stream

# nodes of the tables by rate and by slope; they are even in its fourth root
_NODES = 1024
_SLOPES = 4096


def draw_groups(charge, maps, drift, usable, part, *, thresholds, poisson_factor):
    """
    Draw the slopes that `fit_groups` would fit to the ramps of an exposure.

    Parameters
    ----------
    charge : `~miricigale.detector.Charge`
        What is collected, and how it is read.
    maps : `DetectorMaps`
        What the fit knows of the detector, one number for all pixels; it need not be the truth.
    drift : float or array_like, shape (n_int, n_group)
        As for `fit_groups`; its mean over the integrations counts.
    usable : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels to fit; the others get NaN.
    part : tuple of int
        Range of groups that take part; the last is not included.
    thresholds : tuple of float or None
        For jumps and for their neighbors, as for `fit_groups`.
    poisson_factor : float
        As for `fit_groups`.

    Returns
    -------
    fit : `RampFit`
    """
    exposure = charge.exposure
    truth = charge.properties
    n_int = exposure.n_integrations
    n_group = exposure.n_groups
    group_time = charge.group_time
    n_diff = part[1] - part[0] - 1
    offset = np.asarray(maps.bias + drift, float)
    offset = np.broadcast_to(offset, (n_int, n_group)).mean(axis=0)
    level = charge.level
    limit = charge.limit(maps.saturation - level.mean())
    s = max(maps.read_noise**2 + 1 / 12, 1e-6)
    inv_gain = poisson_factor / maps.gain
    rng = stream(charge.seed, "slopes", exposure.filter, exposure.dither)

    # rates that fill a pixel by the last group, and below
    scale = (_NODES - 1) / (limit / (n_group * group_time)) ** 0.25
    rates = (np.arange(_NODES) / scale) ** 4
    groups = np.arange(*part)
    read = charge.measured(rates[:, None] * group_time * (groups + 1)) + (level - offset)[groups]
    linear = polynomial.polyval(read, maps.linearity)
    derivative = polynomial.polyval(read, polynomial.polyder(maps.linearity))
    table = tabulate(linear, derivative, n_int, s, charge.read_variance, inv_gain, group_time)
    zero = table[0, 0]
    table[0, 1:] = (table[0, 1:] - zero) / rates[1:]
    # where rates are too low to be distinguished from none
    table[0, :9] = table[0, 9]
    # pixels that are full in the first group have no slope
    quoted_scale = (_SLOPES - 1) / (limit / (group_time * truth.gain)) ** 0.25
    quoted = variances(
        (np.arange(_SLOPES) / quoted_scale) ** 4, n_int, n_diff, s, inv_gain, group_time
    )

    shape = exposure.shape
    images = tuple(np.empty(shape, np.float32) for _ in range(3))
    mean = np.where(usable, charge.mean, np.nan)
    normals = rng.standard_normal(shape, np.float32)
    draw_slopes(
        mean, charge.electrons, charge.total_time, normals, table, zero, scale, quoted,
        quoted_scale, images,
    )  # fmt: skip
    n_used = np.where(usable, np.int16(n_int * n_diff), np.int16(0))
    images += n_used, np.zeros(shape, np.int16), np.zeros(shape, np.int64)
    names = ("jump_threshold", "neighbor_threshold")
    jumps = hit_slopes(
        mean, charge.hits, charge.hit_electrons, (n_int, n_group, *part),
        (group_time, s, inv_gain), (limit, 1 / truth.gain),
        tuple(map(threshold, thresholds, names)), rng, images,
    )  # fmt: skip
    return fit_result(*images, jumps, part[0])
