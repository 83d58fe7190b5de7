"""Numbers from posteriors on the nodes of an axis."""

import numpy as np

from miricigale.utils.exceptions import argument_error

__all__ = [
    "bin_cells",
    "cell_edges",
    "cell_percentiles",
    "check_levels",
    "moments",
    "node_cells",
    "randomised_ranks",
]

_ROWS = 256  # searched at once; more would cost digits


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
    # a matrix product's last digit would depend on how many rows there are
    mean = np.sum(pdf * values, axis=-1)
    # about the mean, so that narrow posteriors do not lose digits
    deviation = values - mean[..., None]
    return mean, np.sqrt(np.sum(pdf * deviation * deviation, axis=-1))


def check_levels(levels):
    """
    Levels of percentiles as an array.

    Raises
    ------
    ValueError
        If one is not between 0 and 1, or these are several lists.
    """
    levels = np.atleast_1d(np.asarray(levels, dtype=float))
    if levels.ndim != 1:
        raise argument_error("levels", "a number or a list of numbers", f"shape {levels.shape}")
    if not np.all((levels > 0) & (levels < 1)):
        raise argument_error("levels", "between 0 and 1", f"{levels}")
    return levels


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
    good = np.flatnonzero(np.isfinite(pdf).all(axis=1) & (pdf.sum(axis=1) > 0))
    if len(edges) == 2:
        out[good] = edges[0]
        return out
    for first in range(0, good.size, _ROWS):
        rows = good[first : first + _ROWS]
        part = pdf[rows]
        total = np.cumsum(part, axis=1)
        target = levels * total[:, -1:]
        # one search for all rows: each lies two above the one before it
        shift = 2.0 * np.arange(rows.size)[:, None]
        place = np.searchsorted(
            (total / total[:, -1:] + shift).ravel(), (np.minimum(levels, 1.0) + shift).ravel()
        )
        j = place.reshape(target.shape) - np.arange(rows.size)[:, None] * total.shape[1]
        j = _first_not_below(total, target, np.clip(j, 0, total.shape[1] - 1))
        own = np.take_along_axis(part, j, axis=1)
        below = np.take_along_axis(total, j, axis=1) - own
        inside = np.clip((target - below) / np.maximum(own, 1e-300), 0.0, 1.0)
        out[rows] = edges[j] + inside * (edges[j + 1] - edges[j])
    return out


def _first_not_below(total, target, place):
    """Mend places in rising rows that the shift rounded: the first that is not below the target."""
    last = total.shape[1] - 1
    while True:
        here = np.take_along_axis(total, place, axis=1)
        before = np.take_along_axis(total, np.maximum(place - 1, 0), axis=1)
        up = (here < target) & (place < last)
        down = (before >= target) & (place > 0)
        if not np.any(up | down):
            return place
        place = place + up - (down & ~up)


def randomised_ranks(pdf, node, draw):
    """
    Ranks of true values that lie on nodes, uniform if the posteriors are right.

    The distribution steps at every node: the rank is drawn from the step of the true one, for
    otherwise narrow posteriors have ranks of 0 and 1 only.

    Parameters
    ----------
    pdf : `~numpy.ndarray`, shape (m, n)
        Weights of the nodes of m objects.
    node : `~numpy.ndarray` of int, shape (m,)
        Node of each object's true value.
    draw : `~numpy.ndarray`, shape (m,)
        Uniform random numbers in [0, 1).

    Returns
    -------
    ranks : `~numpy.ndarray`, shape (m,)
    """
    node = np.asarray(node)[:, None]
    own = np.take_along_axis(pdf, node, axis=1)[:, 0]
    upto = np.take_along_axis(np.cumsum(pdf, axis=1), node, axis=1)[:, 0]
    return upto - own * np.asarray(draw)


def node_cells(values, nodes, bounds=(-np.inf, np.inf)):
    """
    Cells of values that lie on nodes.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (m,)
        Values; NaN is in no cell.
    nodes : `~numpy.ndarray`, shape (n,)
        Ascending nodes.
    bounds : tuple of float, optional
        See `cell_edges`.

    Returns
    -------
    edges : `~numpy.ndarray`, shape (n + 1,)
    place : `~numpy.ndarray` of int, shape (m,)
        Cell of the nearest node, -1 for NaN.
    """
    finite = np.isfinite(values)
    place = np.argmin(np.abs(np.where(finite, values, 0.0) - nodes[:, None]), axis=0)
    return cell_edges(nodes, bounds), np.where(finite, place, -1)


def bin_cells(values, bins, *, log=False):
    """
    Bins of values.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (m,)
        Values; NaN is in no bin.
    bins : int or array_like
        Number of bins between the least and the largest value, or edges.
    log : bool, optional
        Whether bins have equal widths in the logarithm, if all values are above 0.

    Returns
    -------
    edges : `~numpy.ndarray`, shape (n + 1,)
    place : `~numpy.ndarray` of int, shape (m,)
        Bin of each value; the last holds its upper edge too. -1 for those in none.
    """
    finite = np.isfinite(values)
    if np.ndim(bins):
        edges = np.asarray(bins, dtype=float)
    else:
        low, high = values[finite].min(), values[finite].max()
        # equal values get a narrow bin
        high = max(high, low + 1e-6 * max(abs(low), 1e-30))
        edges = np.linspace(low, high, int(bins) + 1)
        if log and low > 0:
            edges = np.geomspace(low, high, int(bins) + 1)
            edges[[0, -1]] = low, high
    place = np.searchsorted(edges, values, side="right") - 1
    place = np.where(values == edges[-1], edges.size - 2, place)
    inside = finite & (place >= 0) & (place < edges.size - 1)
    return edges, np.where(inside, place, -1)
