"""Completeness as a function of magnitude: a curve fitted to single sources, and its 50 % limit."""

import dataclasses

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, log_ndtr, logit, ndtr, ndtri

from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that

#: Least numbers of sources that were recovered, and that were not, from which a curve is fitted.
_FEWEST = 5

#: Width of the normal prior on the logarithm of the curve's width, about that of a limit of 5 sigma.
_WIDTH_PRIOR = 1.0
_USUAL_WIDTH = 0.2

#: Sources by which the prior prefers a plateau of 1: a beta distribution.
_PLATEAU_PRIOR = 0.5

#: Step of the differences that give the errors.
_STEP = 1e-3


@dataclasses.dataclass(frozen=True)
class CompletenessCurve:
    """
    Share of sources that are recovered, as a function of magnitude.

    Attributes
    ----------
    plateau : float
        Share of bright sources; below 1 where other sources hide some.
    middle, width : float
        Magnitude of half the plateau, and rms width of the fall as a fraction of the flux there.
    limit, limit_err : float
        Magnitude at which half of the sources are recovered, and its error; NaN if the plateau is below one
        half, or the magnitude is not within those of the sources.
    n : int
        Number of sources.

    Notes
    -----
    The share is ``plateau`` times the normal distribution function of ``(flux / flux_middle - 1) / width``: a
    threshold in flux with noise, of which ``width`` is the inverse signal-to-noise. It is fitted to the sources
    one by one by maximum likelihood, without bins.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.injection import CompletenessCurve
    >>> rng = np.random.default_rng(1)
    >>> magnitude = rng.uniform(24, 27, 2000)
    >>> curve = CompletenessCurve.fit(magnitude, magnitude + rng.normal(0, 0.2, 2000) < 25.5)
    >>> print(f"{curve.limit:.1f} {curve(24.5):.1f}")
    25.5 1.0
    """

    plateau: float
    middle: float
    width: float
    limit: float
    limit_err: float
    n: int

    @classmethod
    def fit(cls, magnitude, recovered):
        """
        Fit the curve.

        Parameters
        ----------
        magnitude : `~numpy.ndarray`, shape (n,)
            True magnitudes.
        recovered : bool `~numpy.ndarray`, shape (n,)
            Which sources were recovered.

        Returns
        -------
        curve : `CompletenessCurve` or None
            None with fewer than 5 sources that were recovered, or that were not.

        Raises
        ------
        ValueError
            If the two differ in length, or a magnitude is not finite or one of them masked.
        """
        magnitude = floats(magnitude)
        is_recovered = floats(recovered)
        check_that(np.isfinite(is_recovered).all(), "recovered", "true or false", "masked or NaN")
        recovered = is_recovered != 0
        wanted = f"one for each of {magnitude.size} magnitudes"
        check_that(recovered.shape == magnitude.shape, "recovered", wanted, recovered.size)
        check_that(np.isfinite(magnitude).all(), "magnitude", "finite", "NaN or infinite ones")
        n_recovered = int(np.count_nonzero(recovered))
        if min(n_recovered, magnitude.size - n_recovered) < _FEWEST:
            return None

        def loss(values):
            return -_log_posterior(values, magnitude, recovered)

        start = np.array([2.0, _first_middle(magnitude, recovered), np.log(_USUAL_WIDTH)])
        best = minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-6})
        best = minimize(loss, best.x, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-8})
        limit = _limit(best.x)
        # beyond the sources the priors alone say where the curve falls
        if not magnitude.min() <= limit <= magnitude.max():
            limit = np.nan
        limit_err = np.nan
        if np.isfinite(limit):
            limit_err = _limit_error(loss, best.x)
        return cls(
            plateau=float(expit(best.x[0])),
            middle=float(best.x[1]),
            width=float(np.exp(best.x[2])),
            limit=float(limit),
            limit_err=float(limit_err),
            n=magnitude.size,
        )

    def __call__(self, magnitude):
        """Return the share of sources of a magnitude that are recovered."""
        flux = _relative_flux(floats(magnitude), self.middle)
        return self.plateau * ndtr((flux - 1.0) / self.width)


def _relative_flux(magnitude, middle):
    return 10.0 ** (0.4 * (middle - magnitude))


def _first_middle(magnitude, recovered):
    """Return the magnitude that parts recovered sources from the others with the fewest on the wrong side."""
    order = np.argsort(magnitude, kind="stable")
    gain = np.cumsum(np.where(recovered[order], 1, -1))
    return magnitude[order][np.argmax(gain)]


def _log_posterior(values, magnitude, recovered):
    """Return the logarithm of the likelihood times weak priors that keep plateau and width finite."""
    raw_plateau, middle, log_width = values
    log_plateau = -np.logaddexp(0.0, -raw_plateau)
    log_rest = -np.logaddexp(0.0, raw_plateau)
    log_share = log_plateau + log_ndtr(
        (_relative_flux(magnitude, middle) - 1.0) / np.exp(log_width)
    )
    log_lost = np.log1p(-np.minimum(np.exp(log_share), 1.0 - 1e-12))
    likelihood = np.sum(np.where(recovered, log_share, log_lost))
    spread = (log_width - np.log(_USUAL_WIDTH)) / _WIDTH_PRIOR
    prior = -0.5 * spread**2 + _PLATEAU_PRIOR * (log_plateau + 0.1 * log_rest)
    return likelihood + prior


def _limit(values):
    """Return the magnitude at which the curve is one half; NaN if it never is."""
    raw_plateau, middle, log_width = values
    if raw_plateau <= logit(0.5):
        return np.nan
    flux = 1.0 + np.exp(log_width) * ndtri(0.5 / expit(raw_plateau))
    if flux > 0:
        return middle - 2.5 * np.log10(flux)
    return np.nan


def _limit_error(loss, best):
    """Return the error of the limit by the curvature of the likelihood; NaN where it has none."""
    n = len(best)
    steps = _STEP * np.eye(n)
    curvature = np.empty((n, n))
    gradient = np.empty(n)
    for i in range(n):
        gradient[i] = (_limit(best + steps[i]) - _limit(best - steps[i])) / (2 * _STEP)
        for j in range(n):
            corners = (
                loss(best + steps[i] + steps[j])
                - loss(best + steps[i] - steps[j])
                - loss(best - steps[i] + steps[j])
                + loss(best - steps[i] - steps[j])
            )
            curvature[i, j] = corners / (4 * _STEP**2)
    variance = gradient @ np.linalg.pinv(curvature, hermitian=True) @ gradient
    if variance > 0:
        return np.sqrt(variance)
    return np.nan
