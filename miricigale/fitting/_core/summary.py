"""Moments and quantiles of derived quantities, from the sums over all models."""

import numpy as np
from numba import njit

from miricigale.fitting._core.histogram import N_BINS, add_scaled, log_summary, share_quantiles
from miricigale.fitting._core.options import ENTRY

__all__ = ["summarise", "variances"]


#: Standard deviations of AGN quantities below this part of the mean total luminosity need not
#: hold their relative accuracy.
_FAINT = 1e-3


def _moments(tables, sums):
    """Means and variances: the galaxy's quantities, the torus's, then the one of both."""
    scales = np.vstack([tables.galaxy_scale, tables.mixed_galaxy])
    powers = np.vstack([tables.agn_scale, tables.mixed_agn])
    # no matrix products, whose last digits depend on the machine's threads
    galaxy = np.einsum("qg,gm->qm", scales, sums.galaxy[:, 1:2])[:, 0]
    galaxy_2 = np.einsum("qg,gm->qm", scales * scales, sums.galaxy[:, 2:])[:, 0]
    rows = sums.agn[: powers.shape[1]]
    agn = np.einsum("qk,km->qm", powers, rows[:, 1:2])[:, 0]
    agn_2 = np.einsum("qk,km->qm", powers * powers, rows[:, 2:])[:, 0]
    first = np.concatenate([galaxy[:-1], agn[:-1], [galaxy[-1] + agn[-1]]]) / sums.total[0]
    both = galaxy_2[-1] + agn_2[-1] + 2.0 * sums.total[3]
    second = np.concatenate([galaxy_2[:-1], agn_2[:-1], [both]]) / sums.total[0]
    return first, second - first * first


def variances(tables, sums):
    """
    Squares of derived quantities over their variance so far, the largest of each model.

    Parameters
    ----------
    tables, sums
        See `miricigale.fitting._core.structs`.

    Returns
    -------
    galaxy, agn : `~numpy.ndarray`, shapes (nG,) and (nA,)
        For each squared solar mass and W.
    """
    mean, variance = _moments(tables, sums)
    n_galaxy = tables.galaxy_scale.shape[0]
    least = 1e-12 * mean * mean
    least[n_galaxy:-1] = (_FAINT * mean[-1]) ** 2
    variance = np.maximum(variance, least)
    # of what is the same for all models, in numbers too small to square, nothing is asked
    inverse = np.divide(1.0, variance, out=np.zeros(variance.size), where=variance > 1e-290)
    galaxy = np.vstack([tables.galaxy_scale, tables.mixed_galaxy])
    agn = np.vstack([tables.agn_scale, tables.mixed_agn])
    of_galaxy = np.append(inverse[:n_galaxy], inverse[-1])
    of_agn = inverse[n_galaxy:]
    return (
        (galaxy * galaxy * of_galaxy[:, None]).max(axis=0, initial=0.0),
        (agn * agn * of_agn[:, None]).max(axis=0, initial=0.0),
    )


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


def summarise(tables, request, sums, moments, quantiles, share, share_levels):
    """
    Moments and quantiles of all derived quantities of one object.

    Parameters
    ----------
    tables, request, sums
        See `miricigale.fitting._core.structs`.
    moments, quantiles : `~numpy.ndarray`, shapes (n_quantities, 3) and (n_quantities, n_levels)
        Filled: mean, standard deviation and mean of log10; quantiles at ``request.levels``. The
        order is the galaxy's quantities, the torus's, then the one of both.
    share, share_levels : `~numpy.ndarray`, shapes (2,) and (n_levels,)
        Filled: mean and standard deviation, and quantiles of the other fraction.
    """
    total, hist = sums.total[0], sums.hist
    sigma = request.scale_error / np.sqrt(max(sums.total[1] / total, 1.0))
    mean, variance = _moments(tables, sums)
    moments[:, 0] = mean
    moments[:, 1] = np.sqrt(np.maximum(variance, 0.0))
    n_galaxy, n_agn = tables.galaxy_scale.shape[0], tables.agn_scale.shape[0]
    least = 1e-6 * total / tables.galaxy_scale.shape[1]
    mean_log = np.empty(len(moments))
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
    moments[:, 2] = mean_log
    share[0] = sums.total[4] / total
    share[1] = np.sqrt(max(sums.total[5] / total - share[0] ** 2, 0.0))
    share_quantiles(hist.share, request.levels, share_levels)
