"""Star-formation histories in steps of 1 Myr, and their weights on tabulated ages."""

import numpy as np
from scipy.sparse import csr_matrix

__all__ = ["YOUNG", "delayed_history", "time_weights"]

YOUNG = 10  # Myr


def delayed_history(age, tau, f_burst=0.0, age_burst=20.0, tau_burst=50.0):
    """
    Star-formation rate in steps of 1 Myr.

    ``t exp(-t / tau) / tau^2`` for t = 0 ... age - 1, and an exponential burst in the last
    ``age_burst`` steps that makes the fraction ``f_burst`` of all stars. The sum is 1e-6,
    so that one solar mass is formed by rates in Msun/yr. ``age`` is a whole number.
    """
    t = np.arange(int(age), dtype=float)
    rate = t * np.exp(-t / tau) / tau**2
    if t.size == 1:
        rate[:] = 1.0
    if f_burst > 0.0:
        n = min(int(age_burst), t.size)
        burst = np.exp(-np.arange(n) / tau_burst)
        rate[-n:] += burst * (f_burst / (1.0 - f_burst) * rate.sum() / burst.sum())
    return rate * (1e-6 / rate.sum())


def time_weights(age, n_steps):
    """
    Weights of tabulated ages for every step of 1 Myr.

    A step k is the mean of ten linear interpolations, at k + 0.1 ... k + 1.0 Myr.

    Parameters
    ----------
    age : `~numpy.ndarray`, shape (n_age,)
        Ages of the table in Myr, from 0.
    n_steps : int
        Number of steps.

    Returns
    -------
    weights : `scipy.sparse.csr_matrix`, shape (n_steps, n_age)
    """
    sample = (np.arange(n_steps)[:, None] + np.arange(1, 11) / 10.0).ravel()
    step = np.repeat(np.arange(n_steps), 10)
    cell = np.clip(np.searchsorted(age, sample, side="right") - 1, 0, age.size - 2)
    t = np.clip((sample - age[cell]) / (age[cell + 1] - age[cell]), 0.0, 1.0)
    data = np.concatenate([1 - t, t]) / 10.0
    index = (np.concatenate([step, step]), np.concatenate([cell, cell + 1]))
    return csr_matrix((data, index), shape=(n_steps, age.size))
