"""Images in square cells of pixels."""

import numpy as np
from scipy.ndimage import gaussian_filter

#: Pixels along a side of a cell.
CELL = 4


def cells_of(values, weight=None, size=CELL):
    """Mean of an image in cells, and the share of a cell that counts; without a weight, the share alone."""
    if weight is None:
        return _added(values.astype(np.uint8), size) / np.float32(size**2)
    total = _added(np.where(weight, values, np.float32(0)), size)
    count = _added(weight.astype(np.uint8), size)
    return total / np.maximum(count, 1), count / np.float32(size**2)


def smoothed_cells(cells, share, width):
    """
    Smooth cells so that their noise is the same everywhere, also where few cells count, as at the edge.

    Parameters
    ----------
    cells, share : `~numpy.ndarray`, shape (ny, nx)
        Mean of each cell and the share of it that counts, as `cells_of` returns them.
    width : float
        Sigma of the Gaussian, in cells.

    Returns
    -------
    smooth : `~numpy.ndarray`, shape (ny, nx)
        The smoothed image.
    covered : bool `~numpy.ndarray`, shape (ny, nx)
        Where enough cells count.
    """
    smooth = gaussian_filter(cells * share, width, mode="constant")
    weight = gaussian_filter(share, width, mode="constant")
    smooth /= np.sqrt(np.maximum(weight, 1e-3))
    return smooth, (share >= 0.5) & (weight >= 0.3)


def _added(values, size):
    """Return the sums over cells; what is beyond the edge is zero."""
    padding = [(0, -n % size) for n in values.shape]
    if any(end for _, end in padding):
        values = np.pad(values, padding)
    rows = values[::size] + values[1::size]
    for k in range(2, size):
        rows += values[k::size]
    # sums of neighbors as a product of matrices
    pairs = rows.astype(np.float32, copy=False).reshape(-1, size)
    return (pairs @ np.ones(size, np.float32)).reshape(len(rows), -1)


def pixels_of(cells, shape, size=CELL):
    """Return the pixels of cells."""
    wide = np.repeat(np.repeat(cells, size, axis=0), size, axis=1)
    return wide[: shape[0], : shape[1]]
