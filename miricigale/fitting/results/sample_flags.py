"""Flags of fits that follow from the sample they are in, and the band that is off."""

import numpy as np
from scipy.stats import chi2

from miricigale.fitting.data.likelihood import HIGH_CHI2, NOT_CONVERGED_TEXT, FitFlags
from miricigale.utils.arrays import quiet_division, thinning_step
from miricigale.utils.exceptions import FitWarning, warn

#: Smallest number of fits that are a sample.
_MIN_SAMPLE = 50
#: Largest number of fits that are looked at.
_MAX_SAMPLE = 1_000_000
#: Reduced chi2 above which a fit without sample is flagged.
_LIMIT_WITHOUT_SAMPLE = 10.0
#: Limit of a sample in standard deviations of ln(reduced chi2) above the median, from the percentiles above it.
_N_SIGMA = 3.0
#: Probability to exceed below which chi2 is larger than errors alone make it.
_MIN_PROBABILITY = 1e-4
#: Residual, in errors of the fit, above which a single band is off.
_MIN_RESIDUAL = 4.0
#: Part of chi2 that such a band makes at least.
_MIN_CHI2_PART = 0.4


def chi2_step(n):
    """Return the step between those of n objects that `chi2_limit` looks at."""
    return thinning_step(n, _MAX_SAMPLE)


def chi2_limit(reduced_chi2):
    """
    Compute the reduced chi2 above which a fit of a sample is poor.

    In a sample it is three standard deviations above the median in the logarithm, of the scatter above the median:
    real galaxies have wider tails than errors, and errors that are too large or small shift the median.

    Parameters
    ----------
    reduced_chi2 : `~numpy.ndarray`, shape (n,)
        Of all objects of the sample, or every `chi2_step`-th of them; NaN of those that were not fitted.

    Returns
    -------
    limit : float
        10 of fewer than 50 fits, and 100 at most.
    """
    values = np.asarray(reduced_chi2, dtype=float)
    values = values[np.isfinite(values) & (values > 0.0)]
    if values.size < _MIN_SAMPLE:
        return _LIMIT_WITHOUT_SAMPLE
    median, high = np.percentile(np.log(values), [50.0, 84.0])
    return float(min(np.exp(median + _N_SIGMA * (high - median)), HIGH_CHI2))


def with_high_chi2(results, limit):
    """
    Flag results as ``HIGH_CHI2`` above a limit, where chi2 is also larger than errors alone make it.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        Of several objects.
    limit : float
        Of `chi2_limit`.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`
    """
    unlikely = chi2.sf(results.chi2, results.n_bands) < _MIN_PROBABILITY
    poor = results.fitted & unlikely & (results.reduced_chi2 > limit)
    if not poor.any():
        return results
    flags = np.array(results.flags)
    flags[poor] |= int(FitFlags.HIGH_CHI2)
    return results._changed(flags=flags)


def warn_of_unconverged(flags, fitted, n_asked):
    """
    Warn of fits with the flag ``NOT_CONVERGED``, once, with their number and what can be done.

    Parameters
    ----------
    flags : `~numpy.ndarray` of int, shape (n,)
        `FitFlags` of the objects.
    fitted : `~numpy.ndarray` of bool, shape (n,)
        Which were fitted.
    n_asked : int
        ``interpolate`` of the settings of the fit.
    """
    n_flagged = np.count_nonzero(np.asarray(flags) & int(FitFlags.NOT_CONVERGED))
    if n_flagged:
        msg = (
            f"{n_flagged} of {np.count_nonzero(fitted)} {NOT_CONVERGED_TEXT} (flag NOT_CONVERGED): "
            "their percentiles are uncertain; settings=GridSettings(interpolate=...) or "
            f"--interpolate of a larger number than {n_asked} evaluates more models"
        )
        warn(msg, FitWarning)


def worst_bands(results):
    """
    Find the band that is off, by object.

    It has the largest residual to the best model in errors of the fit, above 4, which makes at least 40 % of chi2.
    Of 120 galaxies of CEERS with seven bands of S/N above 5 one has one; with a random flux of HST or NIRCam
    times or over 3 or 5, 62 do, and in 60 of them it is the right band. Limits are left out.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        Of several objects.

    Returns
    -------
    number : `~numpy.ndarray` of int, shape (n,)
        Number of the band in ``results.filters``; -1 of objects without.
    """
    measured = np.isfinite(results.sigma) & ~results.limit
    with quiet_division():
        residual = np.where(measured, (results.flux - results.best_flux) / results.sigma, 0.0)
        square = np.nan_to_num(np.square(residual))
        if square.shape[1]:
            number = square.argmax(axis=1)
        else:
            number = np.zeros(len(square), int)
        largest = np.take_along_axis(square, number[:, None], axis=1)[:, 0]
        off = (largest > _MIN_RESIDUAL**2) & (largest > _MIN_CHI2_PART * results.chi2)
    # of two bands the other one alone cannot say which is off
    off &= results.fitted & (measured.sum(axis=1) > 2)
    return np.where(off, number, -1)
