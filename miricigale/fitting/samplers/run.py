"""Likelihoods of models with continuous parameters, and the scales that fit best."""

from typing import Protocol, runtime_checkable

import numpy as np
from scipy.special import erfcx, log_ndtr

from miricigale.utils.arrays import quiet_division

_STEPS = 100
#: Below this the sum of x and the hazard is taken from its series.
_FAR = -100.0


@runtime_checkable
class FluxModel(Protocol):
    """What a sampler needs of a model: `~miricigale.sed.SEDModel`, or one of the user's."""

    parameters: dict
    meta: dict

    def fluxes(self, table, filters):
        """Return fluxes and derived quantities for a table of parameters."""

    def derived_columns(self):
        """Return derived quantities by name."""


class Calls:
    """All evaluations of the likelihood of one object, in order."""

    def __init__(self, fit, data, space):
        self._fit = fit
        self._data = data
        self._space = space
        self._parts = []
        self.n = 0
        # constant of the likelihood: the product of the normal densities' factors
        sigma = data.sigma[data.measured]
        self._norm = np.log(sigma).sum() + 0.5 * sigma.size * np.log(2.0 * np.pi)

    def __call__(self, points):
        values = self._space.values(np.asarray(points))
        mass = values.pop("mass")
        flux, derived = self._fit.models(values)
        in_use = self._data.used
        data = self._data
        good = np.isfinite(flux).all(axis=1)
        fitted_flux = np.where(good[:, None], flux[:, in_use], 1.0)
        measured = (data.flux[in_use], data.sigma[in_use], data.limit[in_use])
        if self._fit.profile:
            scale, variance = best_scale(fitted_flux, *measured)
        else:
            scale = mass
            variance = np.zeros(len(mass))
        chi2 = chi2_at(scale, fitted_flux, *measured)
        chi2[~good] = np.inf
        part = {name: values[name] for name in self._space.free if name != "mass"}
        part = {"parameters": part, "derived": derived, "flux": flux}
        self._parts.append(part | {"scale": scale, "variance": variance, "chi2": chi2})
        number = self.n + np.arange(len(chi2))
        self.n += len(chi2)
        return -0.5 * chi2 - self._norm, number

    def of(self, name, calls):
        """Return arrays of some of the calls; a dict of them where there are several by name."""
        parts = [part[name] for part in self._parts]
        if isinstance(parts[0], dict):
            return {key: np.concatenate([part[key] for part in parts])[calls] for key in parts[0]}
        return np.concatenate(parts)[calls]


def positive_normal(mean, std, rng):
    """Draw from normal distributions; draws below 0 are repeated."""
    out = mean + std * rng.standard_normal(mean.size)
    for _ in range(1000):
        negative = np.flatnonzero(out < 0)
        if not negative.size:
            break
        out[negative] = mean[negative] + std[negative] * rng.standard_normal(negative.size)
    return out


def systematic_draws(weight, n, rng):
    """Choose rows in proportion to weights, with few repetitions (systematic resampling): shape (n,)."""
    total = np.cumsum(weight)
    # n even steps along the cumulative weight, with one random offset
    place = (np.arange(n) + rng.random()) / n * total[-1]
    return np.minimum(np.searchsorted(total, place), weight.size - 1)


def _hazard(x):
    """
    Compute first and second derivative of -ln(cumulative normal distribution) at -x.

    With h = density / cumulative at x these are h and h (h + x).
    """
    # density over cumulative, by the scaled complementary error function: no overflow far out
    hazard = np.sqrt(2.0 / np.pi) / erfcx(-x / np.sqrt(2.0))
    with np.errstate(divide="ignore"):
        second = np.where(x < _FAR, 1.0 - 1.0 / np.square(x), hazard * (hazard + x))
    return hazard, second


def chi2_at(scale, model, flux, sigma, limit):
    """
    Compute chi2 of m models, shape (m, n_bands) for a scale of 1, at given scales: shape (m,).

    Sum of ((F - s m) / sigma)^2 and, of limits, of -2 ln(1/2 (1 + erf((F - s m) / (sqrt2 sigma))))
    (Sawicki 2012, PASP 124, 1208, eq. A10; Boquien et al. 2019, section 4.3).
    """
    residual = (flux - scale[:, None] * model) / sigma
    return np.sum(np.where(limit, -2.0 * log_ndtr(residual), np.square(residual)), axis=1)


def best_scale(model, flux, sigma, limit):
    """
    Find the scales at which chi2 is smallest, not below 0, and their variances; arguments as of `chi2_at`.

    Without limits the minimum is closed-form. With limits chi2 is convex in the scale, its
    derivative convex too, and the scale of the measured bands alone (one at least) lies above the
    minimum: from there Newton's steps go down to it without passing it. The variance is that of the
    Gaussian with the curvature of chi2 at the minimum; both are 0 for a model without light there.
    """
    unit = model / sigma
    measured = unit[:, ~limit]
    bound = unit[:, limit]
    # p = <m, F> and q = <m, m> over the detections, in units of the errors: scale p / q
    ratio = (flux / sigma)[~limit]
    p = measured @ ratio
    q = np.sum(measured * measured, axis=1)
    with quiet_division():
        scale = np.where(q > 0, np.maximum(p, 0.0) / q, 0.0)
        if not limit.any():
            return scale, np.where(q > 0, 1.0 / q, 0.0)
        ceiling = (flux / sigma)[limit]
        for _ in range(_STEPS):
            x = ceiling - scale[:, None] * bound
            first, second = _hazard(x)
            # half of the first and second derivative of chi2
            slope = q * scale - p + np.sum(bound * first, axis=1)
            curvature = q + np.sum(bound**2 * second, axis=1)
            # Newton's step, which comes down from above the minimum
            new = np.clip(scale - slope / curvature, 0.0, scale)
            done = np.all(~(scale - new > 1e-12 * scale))
            scale = new
            if done:
                break
        return scale, np.where(curvature > 0, 1.0 / curvature, 0.0)
