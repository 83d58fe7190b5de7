"""Rectangles of pixels on an image, each a pair of slices (rows, columns)."""

import numpy as np

#: Pixels beyond a segment that are on the stamp of its source.
_STAMP_MARGIN = 6

#: Least and largest half-width (pixels) of the stamps that profiles are fitted on.
_MIN_STAMP_HALF_WIDTH = 16
_MAX_STAMP_HALF_WIDTH = 160


def rectangle_corner(place):
    """Return x and y of the first pixel of a rectangle."""
    rows, columns = place
    return np.array([columns.start, rows.start])


def hull(places):
    """Return the smallest rectangle that holds all of some rectangles."""
    ends = np.array([[y.start, x.start, y.stop, x.stop] for y, x in places])
    y0, x0 = ends[:, :2].min(axis=0).tolist()
    y1, x1 = ends[:, 2:].max(axis=0).tolist()
    return slice(y0, y1), slice(x0, x1)


def overlap(place, other_place):
    """Return whether two rectangles have pixels in common."""
    rows, columns = place
    other_rows, other_columns = other_place
    return _meet(rows, other_rows) and _meet(columns, other_columns)


def _meet(side, other_side):
    return side.start < other_side.stop and other_side.start < side.stop


def within(place, outer):
    """Return a rectangle in the pixels of a larger one that holds it."""
    rows, columns = place
    y0 = outer[0].start
    x0 = outer[1].start
    return slice(rows.start - y0, rows.stop - y0), slice(columns.start - x0, columns.stop - x0)


def source_stamp(place, xy, shape):
    """
    Return the stamp of a source: as far as its segment goes to either side, and a margin.

    Parameters
    ----------
    place : tuple of slice
        The rectangle of its segment.
    xy : (float, float)
        Its position.
    shape : (int, int)
        Shape of the image, to which the stamp is cut.

    Returns
    -------
    stamp : tuple of slice
    """
    rows, columns = place
    x = round(float(xy[0]))
    y = round(float(xy[1]))
    reach = max(rows.stop - y, y - rows.start, columns.stop - x, x - columns.start)
    half = int(np.clip(reach + _STAMP_MARGIN, _MIN_STAMP_HALF_WIDTH, _MAX_STAMP_HALF_WIDTH))
    return _cut_side(y, half, shape[0]), _cut_side(x, half, shape[1])


def _cut_side(center, half, n):
    """Return the pixels about a center, of n at most and of at least one."""
    first = min(max(center - half, 0), n - 1)
    last = max(min(center + half + 1, n), 1)
    return slice(first, last)
