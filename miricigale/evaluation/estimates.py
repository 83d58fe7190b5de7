"""Numbers of a sample with the error that the sample's size leaves them."""

import dataclasses

import numpy as np

from miricigale.evaluation.metrics import OUTLIER, fraction_interval, sigma_mad
from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import attributes
from miricigale.utils.random import check_seed, stream

#: Values that are held at once: draws are made in pieces of this size.
_PIECE = 4_000_000


@dataclasses.dataclass(frozen=True)
class Estimate:
    """
    A number of a sample with its 68 % interval.

    Parameters
    ----------
    value : float
        The number; NaN where there is nothing to take it from.
    low, high : float
        Ends of the interval.
    n : int
        Sources that it is of.
    n_all : int, optional
        Sources that it would be of if all had been found; unknown by default.

    Examples
    --------
    >>> from miricigale.evaluation import Estimate
    >>> share = Estimate.of_fraction(12, 40, n_all=80)
    >>> print(f"{share.value:.2f} +- {share.error:.2f}, of {share.completeness:.0%} of all")
    0.30 +- 0.07, of 50% of all
    """

    value: float
    low: float = np.nan
    high: float = np.nan
    n: int = 0
    n_all: int | None = None

    def columns(self):
        """Return value, interval, number of sources and completeness by name, for a row of a table."""
        return attributes(self, ("value", "low", "high", "n", "completeness"))

    @property
    def error(self):
        """Half the width of the interval."""
        return 0.5 * (self.high - self.low)

    @property
    def completeness(self):
        """Share of all sources that the number is of; NaN where that is unknown."""
        if self.n_all:
            return self.n / self.n_all
        return np.nan

    @classmethod
    def of_fraction(cls, success, total, *, n_all=None):
        """Share of ``success`` among ``total`` sources, with its Wilson interval."""
        return cls(*fraction_interval(int(success), int(total)), int(total), n_all)

    @classmethod
    def of_count(cls, n):
        """Number of sources, with the root of it as error."""
        return cls(float(n), n - np.sqrt(n), n + np.sqrt(n), int(n))


def median(values):
    """Return the median along the last axis without NaN: a statistic for `bootstrap`."""
    return np.nanmedian(values, axis=-1)


def scatter(values):
    """Return the `sigma_mad` along the last axis without NaN: a statistic for `bootstrap`."""
    return sigma_mad(values, axis=-1, ignore_nan=True)


def outlier_share(values):
    """Share beyond `OUTLIER` along the last axis: a statistic for `bootstrap`."""
    return np.mean(np.abs(values) > OUTLIER, axis=-1)


def weighted_share(found, among):
    """
    Share of weights found, with its Wilson interval.

    Parameters
    ----------
    found, among : array-like, shape (n,)
        Weights of the sources found, 0 for others, and of all; without NaN.

    Returns
    -------
    share : `Estimate`
        The interval is that of as many equal sources as have the variance of the weighted share.
    """
    total = np.sum(among)
    if not total > 0:
        return Estimate(np.nan)
    value = np.sum(found) / total
    variance = np.sum((found - value * among) ** 2) / total**2
    if variance > 0:
        like = value * (1 - value) / variance
    else:
        like = total**2 / np.sum(among**2)
    interval = Estimate.of_fraction(round(value * like), max(round(like), 1))
    return Estimate(value, interval.low, interval.high, np.count_nonzero(among))


def bootstrap(statistic, *columns, seed, n_draws=1000, n_all=None):
    """
    Return a statistic of a sample, with the scatter that it has in samples drawn with replacement.

    Parameters
    ----------
    statistic : callable
        Takes as many arrays as there are columns, shape (..., k), and returns one number for
        each row, shape (...).
    *columns : array-like, shape (n,) or (n, m)
        Values of the sources. Sources with a value that is not finite in one of the columns of one
        dimension are left out. Of columns of two dimensions (several values for a source, which
        are drawn together) those without any finite value are, and the statistic gets the rest in one
        row of k = n m values, NaN among them.
    seed : int or `~numpy.random.Generator`
        Seed of the draws.
    n_draws : int, optional
        Samples drawn.
    n_all : int, optional
        Passed to `Estimate`.

    Returns
    -------
    estimate : `Estimate`
        The statistic of the sample itself, and the 16th and 84th percentiles of those of the draws.

    Raises
    ------
    ValueError
        If there are no columns, or their lengths differ.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.evaluation import bootstrap
    >>> values = np.random.default_rng(1).normal(size=10_000)
    >>> mean = bootstrap(lambda v: v.mean(axis=-1), values, seed=1)
    >>> print(f"{mean.error:.2f}")
    0.01
    """
    columns = [floats(column) for column in columns]
    if not columns or len(set(map(len, columns))) != 1:
        raise argument_error("columns", "of one length", [column.shape for column in columns])
    good = np.ones(len(columns[0]), bool)
    for column in columns:
        good &= np.atleast_2d(np.isfinite(column).T).any(axis=0)
    columns = [column[good] for column in columns]
    n = len(columns[0])
    if n == 0:
        return Estimate(np.nan, n=0, n_all=n_all)
    rng = stream(check_seed(seed), "bootstrap")
    size = max(1, _PIECE // sum(column.size for column in columns))
    draws = []
    with quiet_division():
        value = float(statistic(*(column.reshape(-1) for column in columns)))
        for first in range(0, n_draws, size):
            rows = rng.integers(n, size=(min(size, n_draws - first), n))
            drawn = (column[rows].reshape(len(rows), -1) for column in columns)
            draws.append(np.asarray(statistic(*drawn), float))
    draws = np.concatenate(draws)
    draws = draws[~np.isnan(draws)]
    if not draws.size:
        return Estimate(value, n=n, n_all=n_all)
    # one of the draws: between two that are infinite there is nothing
    low, high = np.percentile(draws, [15.865, 84.135], method="nearest")
    return Estimate(value, float(low), float(high), n, n_all)
