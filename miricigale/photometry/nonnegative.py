"""Least squares with fluxes that are not negative."""

import numpy as np

from miricigale.photometry.errors import LinearFit
from miricigale.utils.exceptions import PhotometryWarning, warn

#: How often all wrong signs are changed at once without there being fewer, and steps in all.
_PATIENCE, _STEPS = 3, 300


def nonnegative_fluxes(fit, n):
    """
    Solve a `LinearFit` again under the condition that no flux is negative; other parameters are free.

    ``n`` is how many of its unknowns are fluxes. Shape (n,); NaN, with a warning, if no solution is found in 300
    steps, which happens only where the normal matrix is not positive.

    Notes
    -----
    Sources are zero (active) or fitted. All that come out negative are set to zero, and all zeros at
    which more flux would lessen chi-square are fitted, until there are none of either (block principal
    pivoting). Where that does not reduce their number, one is changed at a time, which always ends.

    References
    ----------
    Portugal, Judice & Vicente 1994, Mathematics of Computation 63, 625.
    """
    fitted = np.ones(len(fit.rhs), bool)
    flux, gradient = fit.flux, np.zeros(len(fit.rhs))
    root = np.sqrt(fit.matrix.diagonal())
    tolerance = 1e-10 * np.max(np.abs(fit.rhs / root), initial=0.0)
    fewest, patience = len(flux) + 1, _PATIENCE
    for _ in range(_STEPS):
        wrong = np.where(fitted, flux * root, gradient / root) < -tolerance
        wrong[n:] = False
        count = np.count_nonzero(wrong)
        if count == 0:
            return np.maximum(flux[:n], 0.0)
        if count < fewest:
            fewest, patience = count, _PATIENCE
        elif patience > 0:
            patience -= 1
        else:
            wrong[: np.flatnonzero(wrong)[-1]] = False
        fitted ^= wrong
        flux, common = _solve(fit, fitted)
        gradient = fit.matrix @ flux + fit.border @ common - fit.rhs
    msg = f"no fluxes that are not negative were found in {_STEPS} steps: they are NaN"
    warn(msg, PhotometryWarning)
    return np.full(n, np.nan)


def _solve(fit, fitted):
    """Fluxes, zero where not fitted, and common parameters."""
    rows, flux = np.flatnonzero(fitted), np.zeros(len(fitted))
    if not len(rows):
        return flux, np.linalg.solve(fit.corner, fit.corner_rhs)
    part = LinearFit(
        fit.matrix[rows][:, rows], fit.rhs[rows], fit.border[rows], fit.corner, fit.corner_rhs
    )
    flux[rows] = part.flux
    return flux, part.common
