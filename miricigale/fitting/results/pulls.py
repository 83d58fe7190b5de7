"""Pulls of bands as if each were left out of the fit, from the posterior of the fit with all."""

import contextlib
import re
import warnings

import numpy as np

from miricigale.fitting.data.likelihood import NOT_CONVERGED_TEXT
from miricigale.utils.arrays import finite_values
from miricigale.utils.exceptions import CatalogWarning, FitWarning, warn

#: Signal-to-noise ratio of the fluxes that count.
_MIN_SIGNAL = 5.0
#: Smallest number of such fluxes in a band.
_MIN_FLUXES = 30
#: Mean squared residual of the other bands below which a fit counts.
_MAX_MEAN_SQUARE = 2.0
#: Mean relative variance of the model fluxes, over that of a single model, above which a fit counts.
_MIN_SPREAD = 1.2
#: Scatter of pulls above which a band is warned of.
_MAX_SCATTER = 1.5
_TEXT = "fluxes scatter about what the other bands predict"
_REMEDY = (
    "'calibrate' measures errors, 'model_error' enlarges them, 'outliers' lets fluxes be wrong"
)


def left_out_pulls(results):
    r"""
    Compute pulls of fluxes about what the other bands predict, without fits of these.

    With the flux d, its error in the fit :math:`\sigma` (model error included), and mean m and standard deviation
    s of the model flux over the posterior, the pull is :math:`(d - m) / \sqrt{\sigma^2 - s^2}`. Where the
    posterior of the flux is normal this is exactly the pull of d about the prediction of a fit without it, over
    both errors in quadrature: a studentized residual (Cook & Weisberg 1982, Residuals and Influence in
    Regression, chapter 2).

    Parameters
    ----------
    results : `FitResults`
        Of several objects.

    Returns
    -------
    pull : `~numpy.ndarray`, shape (n, nb)
        NaN where no flux was fitted (limits among them), s is above :math:`\sigma`, or the flux is likely wrong.

    Examples
    --------
    >>> from miricigale.fitting.results.pulls import left_out_pulls
    >>> left_out_pulls(fitter.fit(photometry))  # doctest: +SKIP
    """
    sigma = np.where(results.limit | ~np.isfinite(results.sigma), np.nan, results.sigma)
    if results.outlier is not None:
        sigma[results.outlier > 0.5] = np.nan
    with np.errstate(all="ignore"):
        pull_error = np.sqrt(np.square(sigma) - np.square(results.model_flux_std))
        return np.where(pull_error > 0, (results.flux - results.model_flux) / pull_error, np.nan)


def wide_bands(results):
    """
    Find bands whose pulls scatter by more than 1.5: name to (scatter, number of fluxes).

    The scatter is 1.48 times the median absolute `left_out_pulls` of fluxes of S/N above 5, of which there have to
    be 30, in fits that describe the other bands (a mean squared residual below 2) by more than one model of the
    grid; to count it also has to be above 1 by twice its error. None if half of the bands or more have it: then
    it is the models that do not fit.
    """
    out = {}
    n_bands = 0
    pull = np.abs(left_out_pulls(results))
    measured = np.isfinite(results.sigma) & ~results.limit
    model = np.where(measured, results.model_flux, np.nan)
    sigma = np.where(measured, results.sigma, np.nan)
    with np.errstate(all="ignore"):
        square = np.nan_to_num(np.square((results.flux - model) / sigma))
        others_chi2 = np.sum(square, axis=1, keepdims=True) - square
        good = others_chi2 < _MAX_MEAN_SQUARE * (measured.sum(axis=1) - 1)[:, None]
        # of a single model only the scale is free, and its relative variance is 1 over this sum
        scale = np.nansum(np.square(model / sigma), axis=1)
        spread = np.sum(np.square(np.nan_to_num(results.model_flux_std / model)), axis=1)
        has_several_models = spread * scale > _MIN_SPREAD * measured.sum(axis=1)
        pull[
            ~(good & has_several_models[:, None] & (results.flux > _MIN_SIGNAL * results.flux_err))
        ] = np.nan
    for name, column in zip(results.filters, pull.T, strict=True):
        pulls = finite_values(column)
        if pulls.size >= _MIN_FLUXES:
            n_bands += 1
            scatter = 1.4826 * np.median(pulls)
            # the error of a median absolute deviation is 1.17 / sqrt(n)
            if scatter > _MAX_SCATTER and scatter * (1.0 - 2.0 * 1.17 / np.sqrt(pulls.size)) > 1.0:
                out[name] = (float(scatter), pulls.size)
    if 2 * len(out) < n_bands or n_bands == 1:
        return out
    return {}


def warn_of_pulls(results):
    """Warn of `wide_bands`, by name; not with ``compat``, where errors of model fluxes lack those of scales."""
    wide = wide_bands(results).items()
    if wide and not results.meta["fit"].get("compat"):
        bands = ", ".join(f"{k} {scatter:.1f} times ({n} fluxes)" for k, (scatter, n) in wide)
        text = "fluxes scatter about what the other bands predict by more than errors allow"
        warn(f"{text}: {bands}; {_REMEDY}", FitWarning)


@contextlib.contextmanager
def without_scatter_warnings():
    """Silence `warn_of_pulls`, for fits whose errors nobody can change."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", re.escape(_TEXT), FitWarning)
        yield


@contextlib.contextmanager
def without_warnings():
    """Silence warnings of catalogs, `warn_of_pulls` and flags, for fits that measure errors themselves."""
    with without_scatter_warnings():
        warnings.filterwarnings("ignore", f".*{NOT_CONVERGED_TEXT}", FitWarning)
        warnings.simplefilter("ignore", CatalogWarning)
        yield
