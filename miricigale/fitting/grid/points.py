"""Quasi-random points, the same for all objects, of which places between the nodes of a grid are made."""

import numpy as np
from scipy.special import chdtri, ndtri
from scipy.stats import qmc

from miricigale.fitting import _core
from miricigale.utils.caching import cached

#: Distance that uniform numbers keep from 0 and 1.
_END = 1e-9


@cached(maxsize=8)
def quasi_random(n_axes, log2_n, scramble):
    """
    Make the Sobol points of all objects.

    Parameters
    ----------
    n_axes, log2_n : int
        Axes of the space, and base-2 logarithm of the number n of points.
    scramble : int
        Seed of the scrambling.

    Returns
    -------
    choice, uniform : `~numpy.ndarray`, shape (n,)
        Uniform numbers, which choose a part of a mixture and the error of a scale.
    normal : `~numpy.ndarray`, shape (n, n_axes)
        Standard normal numbers.
    spread : `~numpy.ndarray`, shape (n,)
        What makes normal numbers those of a t distribution.
    """
    points = qmc.Sobol(n_axes + 3, seed=scramble).random_base2(log2_n)
    points = np.clip(points, _END, 1.0 - _END)
    normal = np.ascontiguousarray(ndtri(points[:, 3:]))
    spread = np.sqrt(_core.FREEDOM / chdtri(_core.FREEDOM, points[:, 1]))
    return points[:, 0].copy(), points[:, 2].copy(), normal, spread
