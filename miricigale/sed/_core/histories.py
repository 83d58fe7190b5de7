"""Star-formation histories in steps of 1 Myr, and their weights on tabulated ages."""

import math

import numpy as np
from scipy.sparse import csr_matrix

from miricigale.sed._core.nodes import cells
from miricigale.utils.compilation import njit

YOUNG = 10  # Myr

_BLOCK = 64


@njit(fastmath={"reassoc", "contract"}, forceinline=True)
def _exponential(n, tau, delayed):
    """Compute ``exp(-t / tau)``, or ``t exp(-t / tau)``, for t = 0 ... n - 1, up to a factor."""
    # a rising exponential is counted from its last step, so that nothing overflows
    zero = n - 1 if tau < 0.0 else 0
    fine = np.empty(_BLOCK)
    out = np.empty(n)
    for i in range(_BLOCK):
        fine[i] = math.exp(-i / tau)
    for start in range(0, n, _BLOCK):
        coarse = math.exp(-(start - zero) / tau)
        for i in range(min(_BLOCK, n - start)):
            out[start + i] = coarse * fine[i]
    if delayed:
        for t in range(n):
            out[t] *= t
    return out


@njit(fastmath={"reassoc", "contract"}, forceinline=True)
def _finish(rate, f_burst, age_burst, tau_burst):
    """Add an exponential burst in the last steps that makes a fraction of all stars; sum 1e-6."""
    n = rate.size
    total = rate.sum()
    if f_burst > 0.0:
        last = min(age_burst, n)
        # typed, for a literal would have it compiled once more
        burst = _exponential(last, tau_burst, np.bool_(False))
        scale = f_burst / (1.0 - f_burst) * total / burst.sum()
        for i in range(last):
            rate[n - last + i] += scale * burst[i]
        total = rate.sum()
    factor = 1e-6 / total
    for i in range(n):
        rate[i] *= factor
    return rate


def delayed_history(age, tau, f_burst=0.0, age_burst=20.0, tau_burst=50.0):
    """
    Star-formation rate in steps of 1 Myr.

    ``t exp(-t / tau) / tau^2`` for t = 0 ... age - 1, and an exponential burst in the last
    ``age_burst`` steps that makes the fraction ``f_burst`` of all stars. The sum is 1e-6,
    so that one solar mass is formed by rates in Msun/yr. ``age`` is a whole number.
    """
    # a single step is at t = 0, where the rate is 0
    rate = _exponential(int(age), float(tau), int(age) > 1)
    return _finish(rate, float(f_burst), int(age_burst), float(tau_burst))


def double_exponential_history(age, tau, f_burst=0.0, age_burst=20.0, tau_burst=50.0):
    """
    Star-formation rate in steps of 1 Myr.

    ``exp(-t / tau)`` for t = 0 ... age - 1 (rising if ``tau`` is negative) and a burst as in
    `delayed_history`. The sum is 1e-6.
    """
    rate = _exponential(int(age), float(tau), False)
    return _finish(rate, float(f_burst), int(age_burst), float(tau_burst))


def table_history(time, rate):
    """
    Put rates in bins of any width (edges in Myr, one more than rates) on steps of 1 Myr.

    Mean rates from the first edge, the last step holding what is left: the integral is kept.
    """
    formed = np.concatenate([[0.0], np.cumsum(rate * np.diff(time))])
    n = int(np.ceil(np.round(time[-1] - time[0], 6)))
    edges = np.arange(n + 1, dtype=float)
    # the last edge lies at or beyond the end of the table, where all is formed
    return np.diff(np.interp(edges, time - time[0], formed))


def time_weights(age, n_steps):
    """
    Weights of tabulated ages (Myr, from 0) for every step of 1 Myr, shape (n_steps, n_age), sparse.

    A step k is the mean of ten linear interpolations, at k + 0.1 ... k + 1.0 Myr.
    """
    sample = (np.arange(n_steps)[:, None] + np.arange(1, 11) / 10.0).ravel()
    step = np.repeat(np.arange(n_steps), 10)
    cell, t = cells(age, sample)
    t = np.clip(t, 0.0, 1.0)
    data = np.concatenate([1 - t, t]) / 10.0
    index = (np.concatenate([step, step]), np.concatenate([cell, cell + 1]))
    return csr_matrix((data, index), shape=(n_steps, age.size))


def age_steps(age, n_steps):
    """
    Arrange the matrix of `time_weights` for `split_by_age`.

    Returns
    -------
    runs : int, shape (3, n_run)
        Steps that lie between two neighboring ages: first, last + 1, number of the younger age.
        A step k of them counts as mass at k + 0.55 Myr, the mean of its ten times.
    mixed : int, shape (n_mixed,)
        The other steps.
    indptr, indices, data
        Their rows of the matrix.
    """
    k = np.arange(n_steps)
    cell, _ = cells(age, k + 0.1)
    inside = (k + 0.1 >= age[cell]) & (k + 1.0 <= age[cell + 1])
    steps = k[inside]
    mixed = k[~inside]
    j, first, n = np.unique(cell[inside], return_index=True, return_counts=True)
    runs = np.array([steps[first], steps[first + n - 1] + 1, j], dtype=np.int64)
    rows = time_weights(age, n_steps)[mixed]
    return runs, mixed, rows.indptr, rows.indices, rows.data


@njit(fastmath={"reassoc", "contract"}, forceinline=True)
def _moments(history, first, last):
    """Sums of mass and of mass times (step - first), for steps counted back from the end."""
    n = history.size
    zero = 0.0
    first_moment = 0.0
    for i in range(last - first):
        rate = history[n - 1 - first - i]
        zero += rate
        first_moment += rate * i
    return 1e6 * zero, 1e6 * first_moment


@njit()
def split_by_age(histories, end, n_young, age, runs, mixed, indptr, indices, data):
    """
    Masses in Msun at tabulated ages, of young and of old stars, shape (2, n, n_age).

    ``histories`` holds n histories one after the other, each ending before one of ``end``: rates in Msun/yr in
    steps of 1 Myr, oldest first, of which the last ``n_young`` are young; ``runs`` and the
    following are `age_steps` of ``age``, for as many steps or more.
    """
    mass = np.zeros((2, end.size, age.size))
    for i in range(end.size):
        history = histories[end[i - 1] if i else 0 : end[i]]
        _split(history, n_young, age, runs, mixed, indptr, indices, data, mass[:, i])
    return mass


@njit()
def _split(history, n_young, age, runs, mixed, indptr, indices, data, mass):
    """One history of `split_by_age`; adds to ``mass``, shape (2, n_age)."""
    n = history.size
    for r in range(runs.shape[1]):
        cell = runs[2, r]
        for part in range(2):
            first = max(runs[0, r], n_young if part else 0)
            last = min(runs[1, r], n if part else min(n, n_young))
            if last > first:
                zero, first_moment = _moments(history, first, last)
                old = (first_moment + zero * (first + 0.55 - age[cell])) / (
                    age[cell + 1] - age[cell]
                )
                mass[part, cell] += zero - old
                mass[part, cell + 1] += old
        if runs[1, r] >= n:
            break
    for i in range(mixed.size):
        k = mixed[i]
        if k >= n:
            break
        formed = 1e6 * history[n - 1 - k]
        for j in range(indptr[i], indptr[i + 1]):
            mass[0 if k < n_young else 1, indices[j]] += data[j] * formed
