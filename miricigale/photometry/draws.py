"""Random draws of correlated fluxes."""

import numpy as np
import scipy.sparse

from miricigale.photometry._core.solve import symmetric_lu
from miricigale.utils.random import stream

#: What correlations are multiplied by until the matrix is positive.
_SHRINK = (1.0, 1 - 1e-9, 1 - 1e-6, 1 - 1e-4, 0.999, 0.99, 0.95, 0.9, 0.8, 0.5, 0.0)


def correlated_draws(covariance, keys, size, seed):
    """
    Draw from normal distributions of zero mean with a sparse covariance, shape (size, m).

    Parameters
    ----------
    covariance : sparse array, shape (m, m)
        Rows without variance give NaN.
    keys : sequence of tuple, length m
        What each row's random stream is for (see `~miricigale.utils.random.stream`): a row that
        is correlated with no other has the same draws whatever other rows there are.
    size, seed : int
        Number of draws, and their seed.

    Notes
    -----
    By the Cholesky factor of the correlation matrix, sparse. Of long chains of blends the covariance is
    known for pairs that overlap only, which need not be positive as a whole: correlations are then
    shrunk by the least factor of a few that makes it so; variances never change.
    """
    error = np.sqrt(covariance.diagonal())
    rows = np.flatnonzero(error > 0)
    draws = np.full((size, len(error)), np.nan)
    if not len(rows):
        return draws
    inverse = scipy.sparse.diags_array(1.0 / error[rows])
    unit = (inverse @ covariance[rows][:, rows] @ inverse).tocoo()
    lone = unit.row == unit.col
    normal = np.stack([stream(seed, *keys[k]).standard_normal(size) for k in rows])
    for factor in _SHRINK:
        data = np.where(lone, 1.0, factor * unit.data)
        found = _cholesky(scipy.sparse.coo_array((data, (unit.row, unit.col)), shape=unit.shape))
        if found is not None:
            break
    lower, order = found
    draws[:, rows] = ((lower @ normal[np.argsort(order)])[order]).T * error[rows]
    return draws


def _cholesky(matrix):
    """Lower factor of a sparse matrix and the place of each row in it, None if it is not positive."""
    try:
        lu = symmetric_lu(matrix)
    except RuntimeError:
        return None
    diagonal = lu.U.diagonal()
    if not (diagonal > 0).all() or not np.array_equal(lu.perm_r, lu.perm_c):
        return None
    return lu.L @ scipy.sparse.diags_array(np.sqrt(diagonal)), lu.perm_r
