"""Moments and quantiles of derived quantities, from the sums over all models."""

import numpy as np

from miricigale.fitting._core.histogram import N_BINS, add_scaled, log_summary, share_quantiles
from miricigale.fitting._core.options import ENTRY, EXACT, EXACT_ENTRY
from miricigale.utils.compilation import njit

__all__ = ["summarise", "variances"]


#: Standard deviations of AGN quantities below this part of the mean total luminosity need not
#: hold their relative accuracy.
_FAINT = 1e-3


@njit(**EXACT_ENTRY)
def moments(galaxy_scale, agn_scale, mixed_galaxy, mixed_agn, galaxy, agn, total, mean, variance):
    """
    Means and variances of the derived quantities, scales' own variances included.

    Parameters
    ----------
    galaxy_scale, agn_scale, mixed_galaxy, mixed_agn
        See `miricigale.fitting._core.structs.Tables`.
    galaxy, agn, total
        See `miricigale.fitting._core.structs.Sums`.
    mean, variance : `~numpy.ndarray`, shape (n_quantities,)
        Filled: the galaxy's quantities, the torus's, the one of both.
    """
    n = galaxy_scale.shape[0]
    for m in range(mean.size):
        first = 0.0
        second = 0.0
        if m < n or m == mean.size - 1:
            scale = galaxy_scale[m] if m < n else mixed_galaxy
            for g in range(scale.size):
                first += scale[g] * galaxy[g, 1]
                second += scale[g] * scale[g] * galaxy[g, 2]
        if m >= n:
            power = agn_scale[m - n] if m < mean.size - 1 else mixed_agn
            for k in range(power.size):
                first += power[k] * agn[k, 1]
                second += power[k] * power[k] * agn[k, 2]
        if m == mean.size - 1:
            second += 2.0 * total[3]
        first /= total[0]
        mean[m] = first
        variance[m] = second / total[0] - first * first


@njit(**EXACT)
def variances(tables, sums, mean, variance, galaxy, agn):
    """
    Squares of derived quantities over their variance so far, the largest of each model.

    Parameters
    ----------
    tables, sums
        See `miricigale.fitting._core.structs`.
    mean, variance : `~numpy.ndarray`, shape (n_quantities,)
        Scratch.
    galaxy, agn : `~numpy.ndarray`, shapes (nG,) and (nA,)
        Filled, for each squared solar mass and W.
    """
    moments(
        tables.galaxy_scale, tables.agn_scale, tables.mixed_galaxy, tables.mixed_agn, sums.galaxy,
        sums.agn, sums.total, mean, variance,
    )  # fmt: skip
    n = tables.galaxy_scale.shape[0]
    last = mean.size - 1
    galaxy[:] = 0.0
    agn[:] = 0.0
    for m in range(mean.size):
        part = _FAINT * mean[last] if n <= m < last else 1e-6 * mean[m]
        value = max(variance[m], part * part)
        # of what is the same for all models, in numbers too small to square, nothing is asked
        inverse = 1.0 / value if value > 1e-290 else 0.0
        if m < n or m == last:
            scale = tables.galaxy_scale[m] if m < n else tables.mixed_galaxy
            for g in range(galaxy.size):
                galaxy[g] = max(galaxy[g], scale[g] * scale[g] * inverse)
        if m >= n:
            power = tables.agn_scale[m - n] if m < last else tables.mixed_agn
            for k in range(agn.size):
                agn[k] = max(agn[k], power[k] * power[k] * inverse)


@njit(**ENTRY)
def _log_quantiles(
    hist, bins, weight, scale, zero, least, origin, sigma, levels, mean_log, quantiles
):
    """
    Quantiles and mean logarithms of quantities that scale with the same histograms.

    Parameters
    ----------
    hist, bins, weight : `~numpy.ndarray`, shapes (n, N_BINS), (n, 2) and (n,)
        Histograms of the rows, bins in use, total weights.
    scale : `~numpy.ndarray`, shape (n_quantities, n)
        Factors of the rows.
    zero, least, origin, sigma : float
        Weight of models in which all quantities are 0; rows of less weight than ``least`` are
        left out; log10 of the rows' middle bins; relative error of the models' scales.
    levels : `~numpy.ndarray`, shape (n_levels,)
    mean_log, quantiles : `~numpy.ndarray`, shapes (n_quantities,) and (n_quantities, n_levels)
        Filled.
    """
    joined = np.empty(N_BINS)
    for m in range(scale.shape[0]):
        for j in range(N_BINS):
            joined[j] = 0.0
        shift, more = add_scaled(hist, bins, scale[m], weight, least, joined)
        mean_log[m] = log_summary(joined, origin + shift, zero + more, sigma, levels, quantiles[m])


def summarise(tables, request, sums, out, quantiles, share, share_levels):
    """
    Moments and quantiles of all derived quantities of one object.

    Parameters
    ----------
    tables, request, sums
        See `miricigale.fitting._core.structs`.
    out, quantiles : `~numpy.ndarray`, shapes (n_quantities, 3) and (n_quantities, n_levels)
        Filled: mean, standard deviation and mean of log10; quantiles at ``request.levels``. The
        order is the galaxy's quantities, the torus's, then the one of both.
    share, share_levels : `~numpy.ndarray`, shapes (2,) and (n_levels,)
        Filled: mean and standard deviation, and quantiles of the other fraction.
    """
    total, hist = sums.total[0], sums.hist
    sigma = request.scale_error / np.sqrt(max(sums.total[1] / total, 1.0))
    mean, variance = np.empty(len(out)), np.empty(len(out))
    moments(
        tables.galaxy_scale, tables.agn_scale, tables.mixed_galaxy, tables.mixed_agn, sums.galaxy,
        sums.agn, sums.total, mean, variance,
    )  # fmt: skip
    out[:, 0] = mean
    out[:, 1] = np.sqrt(np.maximum(variance, 0.0))
    n_galaxy, n_agn = tables.galaxy_scale.shape[0], tables.agn_scale.shape[0]
    least = 1e-6 * total / tables.galaxy_scale.shape[1]
    mean_log = np.empty(len(out))
    # weight of models without light, without any AGN power, and without either
    dark = sums.total[2]
    no_power = max(total - hist.agn.sum(), 0.0)
    neither = max(total - hist.mixed.sum(), 0.0)
    agn_weight = np.ascontiguousarray(sums.agn[:, 0])
    for rows, scale, zero, table, bins, weight, floor, origin in (
        (
            slice(0, n_galaxy), tables.galaxy_scale, dark, hist.galaxy, hist.range_galaxy,
            np.ascontiguousarray(sums.galaxy[:, 0]), least, hist.origin[0],
        ),
        (
            slice(n_galaxy, n_galaxy + n_agn), tables.agn_scale, no_power, hist.agn,
            hist.range_agn, agn_weight, 0.0, hist.origin[1],
        ),
        (
            slice(n_galaxy + n_agn, None), np.ones((1, 1)), neither, hist.mixed, hist.range_mixed,
            np.array([total]), 0.0, hist.origin[2],
        ),
    ):  # fmt: skip
        _log_quantiles(
            table, bins, weight, scale, zero, floor, origin, sigma, request.levels,
            mean_log[rows], quantiles[rows],
        )  # fmt: skip
    out[:, 2] = mean_log
    share[0] = sums.total[4] / total
    share[1] = np.sqrt(max(sums.total[5] / total - share[0] ** 2, 0.0))
    share_quantiles(hist.share, request.levels, share_levels)
