"""The scale of models: the mass at which each fits best, and its error."""

import numpy as np
from scipy.special import erfcx, log_ndtr

__all__ = ["best_scale", "chi2_at"]

_STEPS = 100
#: Below this the sum of x and the hazard is taken from its series.
_FAR = -100.0


def _hazard(x):
    """
    First and second derivative of -ln(cumulative normal distribution) at -x.

    With h = density / cumulative at x these are h and h (h + x).
    """
    hazard = np.sqrt(2.0 / np.pi) / erfcx(-x / np.sqrt(2.0))
    with np.errstate(divide="ignore"):
        second = np.where(x < _FAR, 1.0 - 1.0 / np.square(x), hazard * (hazard + x))
    return hazard, second


def chi2_at(scale, model, flux, sigma, limit):
    """
    Chi2 of models at given scales.

    Parameters
    ----------
    scale : `~numpy.ndarray`, shape (m,)
        Scales.
    model : `~numpy.ndarray`, shape (m, n_bands)
        Fluxes for a scale of 1.
    flux, sigma : `~numpy.ndarray`, shape (n_bands,)
        Measured fluxes and errors, or upper limits and their 1-sigma errors.
    limit : `~numpy.ndarray` of bool, shape (n_bands,)
        Which bands are upper limits.

    Returns
    -------
    chi2 : `~numpy.ndarray`, shape (m,)
        Sum of ((F - s m) / sigma)^2 and, of limits, of -2 ln(1/2 (1 + erf((F - s m) / (sqrt2
        sigma)))) (Sawicki 2012, PASP 124, 1208, eq. A10; Boquien et al. 2019, section 4.3).
    """
    apart = (flux - scale[:, None] * model) / sigma
    return np.sum(np.where(limit, -2.0 * log_ndtr(apart), np.square(apart)), axis=1)


def best_scale(model, flux, sigma, limit):
    """
    Scales at which chi2 is least, not below 0, and their variances.

    Without limits the minimum is closed-form. With limits chi2 is convex in the scale, its
    derivative convex too, and the scale of the measured bands alone lies above the minimum: from
    there Newton's steps go down to it without passing it.

    Parameters
    ----------
    model, flux, sigma, limit : `~numpy.ndarray`
        As for `chi2_at`; one band at least is measured.

    Returns
    -------
    scale, variance : `~numpy.ndarray`, shape (m,)
        The variance is that of the Gaussian with the curvature of chi2 at the minimum; both are
        0 for a model without light in the measured bands.
    """
    unit = model / sigma
    measured, bound = unit[:, ~limit], unit[:, limit]
    ratio = (flux / sigma)[~limit]
    p, q = measured @ ratio, np.sum(measured * measured, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(q > 0, np.maximum(p, 0.0) / q, 0.0)
        if not limit.any():
            return scale, np.where(q > 0, 1.0 / q, 0.0)
        ceiling = (flux / sigma)[limit]
        for _ in range(_STEPS):
            x = ceiling - scale[:, None] * bound
            first, second = _hazard(x)
            slope = q * scale - p + np.sum(bound * first, axis=1)
            curvature = q + np.sum(bound**2 * second, axis=1)
            new = np.clip(scale - slope / curvature, 0.0, scale)
            done = np.all(~(scale - new > 1e-12 * scale))
            scale = new
            if done:
                break
        return scale, np.where(curvature > 0, 1.0 / curvature, 0.0)
