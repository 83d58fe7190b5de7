"""Linear algebra of small positive matrices in kernels: numpy's functions take a second each to compile."""

import numpy as np

from miricigale.utils.compilation import njit


@njit()
def cholesky(matrix):
    """
    Factorize a symmetric matrix after Cholesky.

    Parameters
    ----------
    matrix : `~numpy.ndarray`, shape (n, n)
        The matrix, whose lower half counts.

    Returns
    -------
    factor : `~numpy.ndarray`, shape (n, n)
        Lower half; its diagonal is NaN from the row on in which the matrix is not positive.
    """
    n = len(matrix)
    factor = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            # the factor's row i, from the rows above
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            else:
                factor[i, i] = np.sqrt(total) if total > 0.0 else np.nan
    return factor


@njit()
def solve_factor(factor, right):
    """
    Solve a linear system whose matrix has a given Cholesky factor.

    Parameters
    ----------
    factor : `~numpy.ndarray`, shape (n, n)
        As from `cholesky`.
    right : `~numpy.ndarray`, shape (n,)
        Right-hand side.

    Returns
    -------
    solution : `~numpy.ndarray`, shape (n,)
    """
    n = len(factor)
    solution = np.empty(n)
    for i in range(n):
        # forward substitution
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * solution[k]
        solution[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        # back substitution
        total = solution[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * solution[k]
        solution[i] = total / factor[i, i]
    return solution


@njit()
def log_determinant(factor):
    """
    Return the logarithm of the determinant of a matrix with a given Cholesky factor.

    Parameters
    ----------
    factor : `~numpy.ndarray`, shape (n, n)
        As from `cholesky`.

    Returns
    -------
    log_det : float
        NaN where the matrix is not positive.
    """
    total = 0.0
    for i in range(len(factor)):
        total += np.log(factor[i, i])
    return 2.0 * total


@njit()
def inverse_of(factor):
    """
    Invert a matrix with a given Cholesky factor.

    Parameters
    ----------
    factor : `~numpy.ndarray`, shape (n, n)
        As from `cholesky`.

    Returns
    -------
    inverse : `~numpy.ndarray`, shape (n, n)
    """
    n = len(factor)
    inverse = np.empty((n, n))
    unit = np.zeros(n)
    for i in range(n):
        unit[i] = 1.0
        row = solve_factor(factor, unit)
        unit[i] = 0.0
        # by number: to assign arrays takes more than a second to compile
        for j in range(n):
            inverse[i, j] = row[j]
    return inverse
