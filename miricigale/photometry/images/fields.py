"""Smooth functions of the position on an image."""

import numpy as np
from numpy.polynomial import legendre

from miricigale.utils.values import value_class


def n_terms(order):
    """Return the number of terms of a polynomial of two variables."""
    return (order + 1) * (order + 2) // 2


def legendre_terms(x, y, shape, order):
    """
    Return products of Legendre polynomials up to a total order, of size 1 at most on an image.

    Positions are in pixels, ``shape`` is that of the image, (ny, nx), whose edges are at -1 and 1. A list of
    ``(order + 1) (order + 2) / 2`` arrays of the shape of ``x * y``, the constant first.
    """
    ny, nx = shape
    px = _legendre(x, nx, order)
    py = _legendre(y, ny, order)
    terms = []
    for total in range(order + 1):
        for k in range(total + 1):
            terms.append(px[..., total - k] * py[..., k])
    return terms


def _legendre(positions, n, order):
    """Return Legendre polynomials of positions along an axis of n pixels, shape (..., order + 1)."""
    u = 2.0 * np.asarray(positions, float) / n - (n - 1) / n
    return legendre.legvander(u.ravel(), order).reshape(*u.shape, -1)


@value_class
class SmoothField:
    """
    A polynomial of the position on an image.

    Attributes
    ----------
    coefficients : `~numpy.ndarray`, shape (k,) or (k, m)
        Of the terms of `legendre_terms`.
    shape : (int, int)
        The image's.
    order : int
        Of the polynomial.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.photometry import SmoothField
    >>> field = SmoothField(np.array([1.0, 0.2, 0.0]), (100, 100), 1)
    >>> field(np.array([0, 99]), np.array([0, 0])).round(3)
    array([0.802, 1.198])
    """

    coefficients: np.ndarray
    shape: tuple
    order: int

    def __call__(self, x, y):
        """Return the value at positions in pixels, shape (..., m) or that of the positions."""
        terms = np.stack(legendre_terms(x, y, self.shape, self.order), axis=-1)
        return terms @ self.coefficients
