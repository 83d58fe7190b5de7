"""Numbers that say how well truth was recovered."""

import dataclasses
import itertools

import numpy as np
from astropy.stats import binom_conf_interval

from miricigale.utils.arrays import quiet_division
from miricigale.utils.missing_values import floats, without_mask
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords

#: abs(dz) / (1 + z) above which a redshift is an outlier.
OUTLIER = 0.15


def one_by_one(dtype=float, **arrays):
    """Return two 1-D arrays of one length, of a type; an error by their names if they are not."""
    (name, first), (second_name, second) = arrays.items()
    first = _plain_values(first, name, dtype)
    second = _plain_values(second, second_name, dtype)
    good = first.shape == second.shape
    got = f"shapes {first.shape} and {second.shape}"
    check_that(good and first.ndim == 1, second_name, f"a 1-D array as long as '{name}'", got)
    return first, second


def _plain_values(values, name, dtype):
    """Return the values of a type: of numbers NaN where they are masked; others may not be masked."""
    if dtype is float:
        return floats(values)
    values, mask = without_mask(values)
    n_masked = 0
    if mask is not None:
        n_masked = int(np.count_nonzero(mask))
    check_that(mask is None, name, "without masked values", f"{n_masked} of them")
    if dtype is bool:
        # NaN would be true
        numbers = floats(values)
        n_missing = int(np.count_nonzero(np.isnan(numbers)))
        check_that(n_missing == 0, name, "without NaN", f"{n_missing} of them")
    return np.asarray(values, dtype)


@takes_other_keywords
def sigma_mad(values, *, axis=None, ignore_nan=False):
    """
    Return the robust scatter: 1.48 times the median absolute deviation from the median.

    Parameters
    ----------
    values : array-like
        Values; those that are not finite are an error of the caller and give NaN.
    axis : int, optional
        The axis along which it is taken; all values by default.
    ignore_nan : bool, optional
        Whether NaN is left out instead.

    Returns
    -------
    sigma : float or `~numpy.ndarray`
        NaN for an empty input.

    References
    ----------
    Yang et al. 2021, ApJ 908, 144, section 5 (sigma_MAD).

    Examples
    --------
    >>> from miricigale.evaluation import sigma_mad
    >>> sigma_mad([1.0, 2.0, 3.0, 4.0, 100.0])
    1.48
    """
    values = floats(values)
    if values.size == 0:
        return np.nan
    median = np.median
    if ignore_nan:
        median = np.nanmedian
    deviation = np.abs(values - median(values, axis=axis, keepdims=True))
    sigma = 1.48 * median(deviation, axis=axis)
    if axis is None:
        return float(sigma)
    return sigma


def fraction_interval(n_success, n_total):
    """
    Return a fraction with its 68 % interval (Wilson).

    Parameters
    ----------
    n_success, n_total : int
        Counts.

    Returns
    -------
    fraction, low, high : float
        NaN where ``n_total`` is zero.

    Examples
    --------
    >>> from miricigale.evaluation import fraction_interval
    >>> print("{:.2f} ({:.2f} to {:.2f})".format(*fraction_interval(3, 10)))
    0.30 (0.18 to 0.46)
    """
    if n_total == 0:
        return np.nan, np.nan, np.nan
    low, high = binom_conf_interval(n_success, n_total, interval="wilson")
    return n_success / n_total, float(low), float(high)


@dataclasses.dataclass(frozen=True)
class PhotozMetrics:
    """
    Quality of photometric redshifts.

    Parameters
    ----------
    n : int
        Sources compared.
    n_unusable : int
        Sources left out because one of the two redshifts is not finite.
    bias : float
        Median of dz = (z_fit - z_true) / (1 + z_true).
    sigma_mad : float
        1.48 x median abs(dz - median dz).
    outlier_fraction, outlier_low, outlier_high : float
        Share with abs(dz) above `OUTLIER` and its 68 % interval.
    n_outliers : int
        Their number.

    Examples
    --------
    >>> from miricigale.evaluation import photoz_metrics
    >>> metrics = photoz_metrics([1.0, 2.0, 0.5], [1.02, 2.9, 0.5])
    >>> metrics.n, metrics.n_outliers
    (3, 1)
    >>> print(f"{metrics.outlier_fraction:.2f} ({metrics.outlier_low:.2f} to {metrics.outlier_high:.2f})")
    0.33 (0.14 to 0.61)
    """

    n: int
    n_unusable: int
    bias: float
    sigma_mad: float
    outlier_fraction: float
    outlier_low: float
    outlier_high: float
    n_outliers: int


@takes_other_keywords
def photoz_metrics(z_true, z_fit):
    """
    Compare photometric with true redshifts.

    Parameters
    ----------
    z_true, z_fit : array-like, shape (n,)
        Redshifts; pairs with a NaN are counted apart.

    Returns
    -------
    metrics : `PhotozMetrics`

    Raises
    ------
    ValueError
        If the shapes differ.

    Examples
    --------
    >>> from miricigale.evaluation import photoz_metrics
    >>> metrics = photoz_metrics([1.0, 2.0, 0.5], [1.02, 2.9, 0.5])
    >>> print(f"bias {metrics.bias:.3f}, outliers {metrics.n_outliers} of {metrics.n}")
    bias 0.010, outliers 1 of 3
    """
    z_true, z_fit = one_by_one(z_true=z_true, z_fit=z_fit)
    good = np.isfinite(z_true) & np.isfinite(z_fit)
    delta = (z_fit[good] - z_true[good]) / (1 + z_true[good])
    n_out = int(np.count_nonzero(np.abs(delta) > OUTLIER))
    bias = np.nan
    if delta.size:
        bias = float(np.median(delta))
    scatter = sigma_mad(delta)
    share, share_low, share_high = fraction_interval(n_out, delta.size)
    n_bad = int(np.sum(~good))
    return PhotozMetrics(delta.size, n_bad, bias, scatter, share, share_low, share_high, n_out)


@dataclasses.dataclass(frozen=True)
class RecoveryMetrics:
    """
    Quality of a measured quantity.

    Parameters
    ----------
    n, n_unusable : int
        Pairs compared, and pairs left out because a value is not finite.
    median, median_err : float
        Median of measured minus true, and its standard error (1.253 sigma / sqrt n).
    sigma_mad : float
        Robust scatter of the difference.

    Examples
    --------
    >>> from miricigale.evaluation import recovery_metrics
    >>> metrics = recovery_metrics([1.0, 2.0, 4.0], [1.1, 2.3, 4.0], relative=True)
    >>> print(f"{metrics.median:.2f} +- {metrics.median_err:.2f}")
    0.10 +- 0.05
    """

    n: int
    n_unusable: int
    median: float
    median_err: float
    sigma_mad: float


@takes_other_keywords
def recovery_metrics(true, measured, *, relative=False):
    """
    Compare measured with true values.

    Parameters
    ----------
    true, measured : array-like, shape (n,)
        Values in the same unit.
    relative : bool, optional
        Whether differences are divided by the true value.

    Returns
    -------
    metrics : `RecoveryMetrics`

    Examples
    --------
    >>> from miricigale.evaluation import recovery_metrics
    >>> metrics = recovery_metrics([1.0, 2.0, 4.0], [1.1, 2.3, 4.0])
    >>> print(f"{metrics.median:.2f} +- {metrics.median_err:.2f}, scatter {metrics.sigma_mad:.2f}")
    0.10 +- 0.11, scatter 0.15
    """
    true, measured = one_by_one(true=true, measured=measured)
    with quiet_division():
        if relative:
            delta = (measured - true) / true
        else:
            delta = measured - true
    good = np.isfinite(delta)
    delta = delta[good]
    sigma = sigma_mad(delta)
    median = np.nan
    error = np.nan
    if delta.size:
        median = float(np.median(delta))
        error = 1.2533 * sigma / np.sqrt(delta.size)
    return RecoveryMetrics(
        n=delta.size,
        n_unusable=int(np.sum(~good)),
        median=median,
        median_err=error,
        sigma_mad=sigma,
    )


def running_median(x, y, *, size=20):
    """
    Return the median of ``y`` and ``x`` in consecutive bins of ``size`` points sorted by ``x``.

    Parameters
    ----------
    x, y : array-like, shape (n,)
        Points; those with a NaN are left out.
    size : int, optional
        Points per bin; what remains after the last full bin joins it.

    Returns
    -------
    x_mid, y_mid, y_sigma : `~numpy.ndarray`, shape (n_bins,)
        Medians and `sigma_mad` in each bin.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.evaluation import running_median
    >>> x = np.arange(40.0)
    >>> middle, median, error = running_median(x, 2 * x)
    >>> print(median)
    [19. 59.]
    """
    x, y = one_by_one(x=x, y=y)
    check_that(size >= 1, "size", "at least 1", size)
    good = np.isfinite(x) & np.isfinite(y)
    order = np.argsort(x[good], kind="stable")
    x = x[good][order]
    y = y[good][order]
    n_bins = 0
    if x.size:
        n_bins = max(1, x.size // size)
    edges = [k * size for k in range(n_bins)] + [x.size]
    bins = [slice(a, b) for a, b in itertools.pairwise(edges)]
    return (
        np.array([np.median(x[b]) for b in bins]),
        np.array([np.median(y[b]) for b in bins]),
        np.array([sigma_mad(y[b]) for b in bins]),
    )
