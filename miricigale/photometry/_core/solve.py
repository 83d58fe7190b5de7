"""Sparse normal equations: their solution, and elements of their inverse."""

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse.linalg import splu

from miricigale.utils.compilation import njit


def symmetric_lu(matrix):
    """Factorize a symmetric sparse matrix without pivots (`scipy.sparse.linalg.SuperLU`)."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def factorize(matrix):
    """
    Factorize a symmetric positive sparse matrix after scaling it to a unit diagonal.

    Returns
    -------
    solve : callable
        Solves for a vector or a matrix of right-hand sides.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular.
    """
    scale = np.sqrt(matrix.diagonal())
    if not np.all(scale > 0):
        msg = "the normal matrix has a diagonal element that is not positive"
        raise np.linalg.LinAlgError(msg)
    unit = scipy.sparse.diags_array(1.0 / scale)
    try:
        lu = symmetric_lu(unit @ matrix @ unit)
    except RuntimeError as err:
        msg = f"the normal equations are singular ({err})"
        raise np.linalg.LinAlgError(msg) from None

    def solve(rhs):
        rhs = np.asarray(rhs, float)
        row_scale = scale if rhs.ndim == 1 else scale[:, None]
        return lu.solve(rhs / row_scale) / row_scale

    return solve


def block_covariance(matrix, y, x, *, core, halo, middles=(None,), pattern=None, exact=1500):
    """
    Calculate elements of the inverse of a normal matrix, by dense inversion of blocks on the sky.

    Parameters
    ----------
    matrix : sparse array, shape (n, n)
        Normal matrix H^-1.
    y, x : float arrays, shape (n,)
        Positions in pixels.
    core, halo : float
        Size of the blocks and of the margin around each, in pixels. The inverse decays
        exponentially away from a source, so that a margin of several PSF widths suffices.
    middles : sequence of sparse array, shape (n, n), or None, optional
        For each of them elements of H middle H are returned, for None those of H.
    pattern : sparse array, shape (n, n), optional
        Which elements are wanted (its non-zeros); those of ``matrix`` by default.
    exact : int, optional
        Up to this many sources are done in one block, without approximation.

    Returns
    -------
    covariances : list of `~scipy.sparse.csr_array`, shape (n, n)
        Symmetric, with the elements of ``pattern``; one for each middle.
    inverse_diagonal : `~numpy.ndarray`, shape (n,)
        Diagonal of H.
    """
    n = matrix.shape[0]
    # to a unit diagonal, for numerical stability
    scale = 1.0 / np.sqrt(matrix.diagonal())
    unit = scipy.sparse.diags_array(scale)
    matrix = (unit @ matrix @ unit).tocsr()
    # H M H = D (S^-1 (D M D) S^-1) D with S = D H^-1 D
    parts = _arrays(matrix)
    scaled_middles = []
    for middle in middles:
        if middle is None:
            scaled_middles.append(None)
        else:
            scaled_middles.append(_arrays((unit @ middle @ unit).tocsr()))
    row_start, row_columns = parts[:2]
    if pattern is not None:
        row_start, row_columns, _ = _arrays(pattern.tocsr())
    rows = []
    columns = []
    values = [[] for _ in scaled_middles]
    inverse_diagonal = np.empty(n)
    place = np.full(n, -1)
    for members, inner in _blocks(n, y, x, core, halo, exact):
        place[members] = np.arange(len(members))
        inverse = _dense_inverse(_dense(*parts, members, place))
        inverse_diagonal[members[inner]] = np.diag(inverse)[inner]
        i, j = _elements(row_start, row_columns, members, inner, place)
        rows.append(members[i])
        columns.append(members[j])
        # rows and columns of the block that hold elements which are wanted
        block_rows, i_place = np.unique(i, return_inverse=True)
        block_columns, j_place = np.unique(j, return_inverse=True)
        for middle, elements in zip(scaled_middles, values, strict=True):
            if middle is None:
                elements.append(inverse[i, j])
                continue
            # H M H of these rows and columns
            block = inverse[block_rows] @ _dense(*middle, members, place)
            block = block @ inverse[:, block_columns]
            elements.append(block[i_place, j_place])
        place[members] = -1
    rows = np.concatenate(rows)
    columns = np.concatenate(columns)

    def matrix_of(elements):
        data = np.concatenate(elements) * scale[rows] * scale[columns]
        # each element stands in the block of its row: the mean with the transpose is symmetric
        half = scipy.sparse.coo_array((data, (rows, columns)), shape=(n, n)).tocsr()
        return ((half + half.T) * 0.5).tocsr()

    return [matrix_of(elements) for elements in values], inverse_diagonal * scale**2


def _arrays(matrix):
    """Return starts of the rows, columns and values of a sparse matrix, as the kernels take them."""
    return matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64), matrix.data


@njit()
def _dense(start, column, data, members, place):
    """Fill some rows and columns of a sparse matrix; ``place``, (n,), is that of each among them, or -1."""
    block = np.zeros((len(members), len(members)))
    for i, row in enumerate(members):
        for k in range(start[row], start[row + 1]):
            j = place[column[k]]
            if j >= 0:
                block[i, j] += data[k]
    return block


@njit()
def _elements(start, column, members, inner, place):
    """Find the places, among some rows and columns, of the non-zeros in the inner ones of the rows."""
    capacity = 0
    for i, row in enumerate(members):
        if inner[i]:
            capacity += start[row + 1] - start[row]
    places = np.empty((2, capacity), np.int64)
    count = 0
    for i, row in enumerate(members):
        if inner[i]:
            for k in range(start[row], start[row + 1]):
                if place[column[k]] >= 0:
                    places[0, count] = i
                    places[1, count] = place[column[k]]
                    count += 1
    return places[:, :count]


def _blocks(n, y, x, core, halo, exact):
    """Yield the members of each block with its halo, and which of them are its own."""
    if n <= exact:
        yield np.arange(n), np.ones(n, bool)
        return
    iy = np.floor(y / core).astype(int)
    ix = np.floor(x / core).astype(int)
    order = np.argsort(y, kind="stable")
    ys = y[order]
    for row in np.unique(iy):
        # a row of blocks with its halo
        low, high = np.searchsorted(ys, [row * core - halo, (row + 1) * core + halo])
        strip = order[low:high]
        for column in np.unique(ix[iy == row]):
            members = strip[
                (x[strip] >= column * core - halo) & (x[strip] < (column + 1) * core + halo)
            ]
            yield members, (iy[members] == row) & (ix[members] == column)


def _dense_inverse(block):
    factor, info = scipy.linalg.lapack.dpotrf(block, lower=1)
    if info == 0:
        inverse, info = scipy.linalg.lapack.dpotri(factor, lower=1)
        if info == 0:
            return np.tril(inverse) + np.tril(inverse, -1).T
    return scipy.linalg.pinvh(block)
