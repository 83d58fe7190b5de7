"""Cells of wavelength: their edges around points, and means of spectra in them."""

import numpy as np
from scipy.integrate import cumulative_trapezoid

from miricigale.utils.arrays import middles


def edges_around(points):
    """
    Compute the edges of cells around points: half way to the neighbors, the outermost at the points.

    Parameters
    ----------
    points : `~numpy.ndarray`, shape (n,)
        Increasing values, of at least one point.

    Returns
    -------
    edges : `~numpy.ndarray`, shape (n + 1,)
        In the unit of the points.
    """
    middle = middles(points)
    return np.concatenate([points[:1], middle, points[-1:]])


def cell_means(x, y, edges):
    """
    Compute the mean of a function in cells, so that narrow lines keep their light.

    Parameters
    ----------
    x, y : `~numpy.ndarray`, shape (n,)
        Points of the function, x increasing, which straight lines join.
    edges : `~numpy.ndarray`, shape (m + 1,)
        Edges of the cells, increasing, within the range of x.

    Returns
    -------
    means : `~numpy.ndarray`, shape (m,)
    """
    width = np.diff(x)
    integral = cumulative_trapezoid(y, x, initial=0.0)
    step = np.clip(np.searchsorted(x, edges, side="right") - 1, 0, width.size - 1)
    slope = (y[step + 1] - y[step]) / width[step]
    distance = edges - x[step]
    at_edges = integral[step] + distance * (y[step] + 0.5 * slope * distance)
    return np.diff(at_edges) / np.diff(edges)
