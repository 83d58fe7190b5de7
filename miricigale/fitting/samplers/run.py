"""One object, fitted with continuous parameters by a sampler."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from astropy.table import QTable
from scipy.special import erfcx, log_ndtr

from miricigale.fitting.samplers import effective_size, get_sampler
from miricigale.fitting.settings import SamplerSettings
from miricigale.utils.parallel import single_threaded
from miricigale.utils.random import stream

#: Draws from the prior of which at least one has to be possible.
_TRIALS = 2048
_STEPS = 100
#: Below this the sum of x and the hazard is taken from its series.
_FAR = -100.0


@runtime_checkable
class FluxModel(Protocol):
    """What a sampler needs of a model: `~miricigale.sed.SEDModel`, or one of the user's."""

    parameters: dict
    meta: dict

    def fluxes(self, table, filters):
        """Fluxes and derived quantities for a table of parameters."""

    def derived_columns(self):
        """Derived quantities by name."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """
    Weighted sample of a posterior: n draws, and the model that fits best, at the scale that does.

    Parameters and derived quantities (mass among the latter) are by name; fluxes are in uJy. The
    numbers at the end are those of `~miricigale.fitting.FitResults`.
    """

    weight: np.ndarray  # (n,); sums to 1
    parameters: dict  # free ones without mass: arrays (n,)
    derived: dict
    flux: np.ndarray  # (n, n_bands)
    best: dict  # free parameters, mass and derived quantities: float
    best_flux: np.ndarray
    chi2: float
    log_evidence: float
    log_evidence_err: float
    n_calls: int
    n_effective: float
    converged: bool


class _Calls:
    """All evaluations of the likelihood of one object, in order."""

    def __init__(self, engine, data, space):
        self._engine, self._data, self._space = engine, data, space
        self._parts, self.n = [], 0
        sigma = data.sigma[data.measured]
        self._norm = np.log(sigma).sum() + 0.5 * sigma.size * np.log(2.0 * np.pi)

    def __call__(self, points):
        values = self._space.values(np.asarray(points))
        mass = values.pop("mass")
        flux, derived = self._engine.models(values)
        used, data = self._data.used, self._data
        good = np.isfinite(flux).all(axis=1)
        seen = np.where(good[:, None], flux[:, used], 1.0)
        measured = (data.flux[used], data.sigma[used], data.limit[used])
        if self._engine.profile:
            scale, variance = best_scale(seen, *measured)
        else:
            scale, variance = mass, np.zeros(len(mass))
        chi2 = chi2_at(scale, seen, *measured)
        chi2[~good] = np.inf
        part = {name: values[name] for name in self._space.free if name != "mass"}
        part = {"parameters": part, "derived": derived, "flux": flux}
        self._parts.append(part | {"scale": scale, "variance": variance, "chi2": chi2})
        number = self.n + np.arange(len(chi2))
        self.n += len(chi2)
        return -0.5 * chi2 - self._norm, number

    def of(self, name, calls):
        """Arrays of some of the calls; a dict of them where there are several by name."""
        parts = [part[name] for part in self._parts]
        if isinstance(parts[0], dict):
            return {key: np.concatenate([part[key] for part in parts])[calls] for key in parts[0]}
        return np.concatenate(parts)[calls]


@dataclass(frozen=True, eq=False)
class ContinuousEngine:
    """
    Posteriors of continuous parameters by a sampler (a name or function, see `get_sampler`).

    ``filters`` are the bands that are evaluated: a set of filters, or what the model takes for it.
    With ``profile`` the mass of each model is the one that fits best, with its Gaussian error if
    ``scale_error``, and no parameter.
    """

    model: object
    filters: object
    names: tuple
    sampler: object
    request: SamplerSettings
    profile: bool = True
    scale_error: bool = True

    @property
    def columns(self):
        """Derived quantities: `~miricigale.sed.Derived` by name."""
        columns = dict(self.model.derived_columns())
        # the parameter mass, by another name
        columns.pop("stellar_mass_formed", None)
        return columns

    def models(self, values, mass=None):
        """
        Fluxes in uJy (m, n_bands), NaN where a model is not possible, and derived quantities by name.

        ``values`` has all parameters but mass by name, each of shape (m,); ``mass`` is in solar masses
        formed, 1 by default.
        """
        n = len(next(iter(values.values())))
        table = QTable(values | {"mass": np.ones(n) if mass is None else mass}, copy=False)
        got = self.model.fluxes(table, self.filters)
        flux = np.column_stack([got[name].value for name in self.names])
        derived = {
            name: np.asarray(getattr(got[name], "value", got[name]), dtype=float)
            for name in self.columns
        }
        return flux, derived

    def fit(self, data, space, seed):
        """
        Sample the posterior of one object; None if its prior leaves no model.

        Its photometry is `~miricigale.fitting.likelihood.FitData`, its parameters are a `Space`.
        """
        key = str(data.ids)
        with single_threaded():
            calls, rng = _Calls(self, data, space), stream(seed, "fit", "prior", key)
            trials = (calls(rng.random((256, space.n_dim)))[0] for _ in range(_TRIALS // 256))
            if not any(np.isfinite(log_like).any() for log_like in trials):
                return None
            return self._fit(_Calls(self, data, space), space, key, seed)

    def _fit(self, calls, space, key, seed):
        draws = get_sampler(self.sampler)(
            calls, space.n_dim, stream(seed, "fit", key), self.request
        )
        weight = draws.weight
        keep = weight > 0
        weight, call = weight[keep], np.asarray(draws.call)[keep]
        # the best of all models that were met, whether or not they are part of the sample
        best = [int(np.argmin(calls.of("chi2", slice(None))))]
        scale, best_scale = calls.of("scale", call), calls.of("scale", best)
        if self.profile and self.scale_error:
            std = np.sqrt(calls.of("variance", call))
            scale = _positive_normal(scale, std, stream(seed, "scale", key))
        parameters, found = calls.of("parameters", call), calls.of("parameters", best)
        found |= self._scaled(calls.of("derived", best), found, best_scale, space.fixed)
        return Posterior(
            weight=weight / weight.sum(),
            parameters=parameters,
            derived=self._scaled(calls.of("derived", call), parameters, scale, space.fixed),
            flux=calls.of("flux", call) * scale[:, None],
            best={name: float(array[0]) for name, array in found.items()},
            best_flux=calls.of("flux", best)[0] * best_scale[0],
            chi2=float(calls.of("chi2", best)[0]),
            log_evidence=draws.log_evidence,
            log_evidence_err=draws.log_evidence_err,
            n_calls=calls.n,
            n_effective=effective_size(weight),
            converged=draws.converged,
        )

    def _scaled(self, derived, parameters, scale, fixed):
        """Derived quantities of models of given masses, from those for one solar mass."""
        columns = self.columns
        out = {"mass": scale}
        out |= {
            name: array * scale if columns[name].extensive else array
            for name, array in derived.items()
        }
        other = [name for name, column in columns.items() if column.of == "xray"]
        if other:
            # these are not proportional to mass
            rest = {n: np.full(scale.size, v) for n, v in fixed.items() if n != "mass"}
            got = self.models(rest | parameters, scale)[1]
            out |= {name: got[name] for name in other}
        return out


def _positive_normal(mean, std, rng):
    """Draws from normal distributions, those below 0 drawn again."""
    out = mean + std * rng.standard_normal(mean.size)
    for _ in range(1000):
        below = np.flatnonzero(out < 0)
        if not below.size:
            break
        out[below] = mean[below] + std[below] * rng.standard_normal(below.size)
    return out


def systematic_draws(weight, n, rng):
    """Rows in proportion to weights, with as few repetitions as possible (systematic resampling): shape (n,)."""
    total = np.cumsum(weight)
    place = (np.arange(n) + rng.random()) / n * total[-1]
    return np.minimum(np.searchsorted(total, place), weight.size - 1)


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
    Chi2 of m models, shape (m, n_bands) for a scale of 1, at given scales: shape (m,).

    Sum of ((F - s m) / sigma)^2 and, of limits, of -2 ln(1/2 (1 + erf((F - s m) / (sqrt2 sigma))))
    (Sawicki 2012, PASP 124, 1208, eq. A10; Boquien et al. 2019, section 4.3).
    """
    apart = (flux - scale[:, None] * model) / sigma
    return np.sum(np.where(limit, -2.0 * log_ndtr(apart), np.square(apart)), axis=1)


def best_scale(model, flux, sigma, limit):
    """
    Scales at which chi2 is least, not below 0, and their variances; arguments as of `chi2_at`.

    Without limits the minimum is closed-form. With limits chi2 is convex in the scale, its
    derivative convex too, and the scale of the measured bands alone (one at least) lies above the
    minimum: from there Newton's steps go down to it without passing it. The variance is that of the
    Gaussian with the curvature of chi2 at the minimum; both are 0 for a model without light there.
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
