"""Numbers from posteriors on the nodes of an axis."""

import numpy as np

__all__ = ["cell_edges", "cell_percentiles", "moments"]


def cell_edges(values, bounds=(-np.inf, np.inf)):
    """
    Edges of the cells around the nodes of an axis.

    Parameters
    ----------
    values : array_like, shape (n,)
        Ascending nodes.
    bounds : tuple of float, optional
        Limits of the outermost cells.

    Returns
    -------
    edges : `~numpy.ndarray`, shape (n + 1,)
        Half way between the nodes; the outermost cells are symmetric about their nodes, as far
        as the bounds allow. A single node has a cell of no width.
    """
    values = np.asarray(values, dtype=float)
    if values.size == 1:
        return np.array([values[0], values[0]])
    middle = 0.5 * (values[1:] + values[:-1])
    first = max(2.0 * values[0] - middle[0], bounds[0])
    last = min(2.0 * values[-1] - middle[-1], bounds[1])
    return np.concatenate([[first], middle, [last]])


def moments(values, pdf):
    """
    Mean and standard deviation.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (n,)
        Nodes.
    pdf : `~numpy.ndarray`, shape (..., n)
        Weights of the nodes; the last axis sums to 1.

    Returns
    -------
    mean, std : `~numpy.ndarray`, shape (...)
    """
    mean = pdf @ values
    # about the mean, so that narrow posteriors do not lose digits
    deviation = values - mean[..., None]
    return mean, np.sqrt(np.sum(pdf * deviation * deviation, axis=-1))


def cell_percentiles(values, pdf, levels, bounds=(-np.inf, np.inf)):
    """
    Percentiles from the cumulative distribution, linear within each cell.

    Parameters
    ----------
    values : array_like, shape (n,)
        Ascending nodes.
    pdf : `~numpy.ndarray`, shape (m, n)
        Weights of the nodes of m objects; rows of NaN give NaN.
    levels : array_like, shape (k,)
        Levels in (0, 1).
    bounds : tuple of float, optional
        See `cell_edges`.

    Returns
    -------
    percentiles : `~numpy.ndarray`, shape (m, k)
    """
    edges = cell_edges(values, bounds)
    levels = np.asarray(levels, dtype=float)
    out = np.full((pdf.shape[0], levels.size), np.nan)
    if len(edges) == 2:
        out[np.isfinite(pdf[:, 0])] = edges[0]
        return out
    total = np.cumsum(pdf, axis=1)
    for i, row in enumerate(total):
        if not np.isfinite(row[-1]):
            continue
        target = levels * row[-1]
        j = np.minimum(np.searchsorted(row, target), len(row) - 1)
        below = np.where(j > 0, row[j - 1], 0.0)
        part = np.clip((target - below) / np.maximum(pdf[i, j], 1e-300), 0.0, 1.0)
        out[i] = edges[j] + part * (edges[j + 1] - edges[j])
    return out
