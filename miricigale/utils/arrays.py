"""Small operations on arrays: middles, places on images, peaks, ratios, boxes, and steps that thin out."""

import numpy as np

from miricigale.utils.options import check_that


def nans(shape):
    """Return a new array of NaN."""
    return np.full(shape, np.nan)


def spread_over(values, places, n):
    """Return an array of ``n`` rows with values at their places, row numbers or a mask, and NaN elsewhere."""
    spread = nans(n)
    spread[places] = values
    return spread


def finite_values(values):
    """Return those values of an array that are finite, shape (m,)."""
    return values[np.isfinite(values)]


def middles(edges):
    """Return the middles of cells between edges along the first axis: shape (n, ...) to (n - 1, ...)."""
    return 0.5 * (edges[1:] + edges[:-1])


def centered(n):
    """Return the places of ``n`` pixels about the middle of them: 0 in the middle, shape (n,)."""
    return np.arange(n) - (n - 1) / 2


def peak_index(values):
    """Return the index of the largest value of an array, along each axis: tuple of int."""
    return np.unravel_index(np.argmax(values), values.shape)


def is_inside(x, y, shape):
    """Return which places, in pixels, are on an image of a shape (ny, nx): bool of the shape of ``x``."""
    ny, nx = shape
    return (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)


def check_light(data):
    """Refuse ``data`` that is no image with light (a `ValueError`)."""
    good = data.ndim == 2 and np.all(np.isfinite(data)) and data.sum() > 0
    check_that(good, "data", "a finite 2D array with a positive sum", data.shape)


def quiet_division():
    """Return a context in which divisions by 0, and operations without a result, do not warn."""
    return np.errstate(divide="ignore", invalid="ignore")


def quotient(numerator, denominator, otherwise=0.0):
    """Divide arrays; ``otherwise`` where the denominator is not above 0."""
    shape = np.broadcast_shapes(np.shape(numerator), np.shape(denominator))
    out = np.full(shape, otherwise)
    return np.divide(numerator, denominator, out=out, where=denominator > 0)


def box_shape(box):
    """Return the shape (ny, nx) of a box of rows and columns, which are slices."""
    rows, columns = box
    return rows.stop - rows.start, columns.stop - columns.start


def thinning_step(n, most):
    """Return the smallest step with which at most ``most`` of ``n`` elements are left."""
    return max(1, -(-n // most))
