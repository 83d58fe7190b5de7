"""Brightness of the sky in boxes of an image, and the smooth surface through them."""

import copy
import math

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import distance_transform_edt

from miricigale.utils.arrays import nans
from miricigale.utils.values import value_class

#: Clipping of a box, in standard deviations, and what it leaves of that of a Gaussian.
_CLIP = 3.0
_CLIPPED = 0.98655
#: Error of the median of n Gaussian values, times sqrt(n) over their standard deviation.
_MEDIAN_ERROR = 1.2533
#: A box counts if it has so many pixels of sky, and half as large a share of them as the boxes at large.
_MIN_PIXELS = 20


@value_class
class SkyBoxes:
    """
    The sky in boxes of nearly one size.

    Parameters
    ----------
    edges : tuple of `~numpy.ndarray`
        Where the boxes begin and end, along y and x.
    level, spread : `~numpy.ndarray`, shape (n, m)
        Clipped median (or mode) and standard deviation of the sky's pixels; NaN without any.
    count : `~numpy.ndarray` of int, shape (n, m)
        Pixels that were used.
    share : `~numpy.ndarray`, shape (n, m)
        Pixels that are not masked over those that are there at all.
    center : tuple of `~numpy.ndarray`, shape (n, m)
        Mean y and x of the pixels that are not masked.
    """

    edges: tuple
    level: np.ndarray
    spread: np.ndarray
    count: np.ndarray
    share: np.ndarray
    center: tuple

    @property
    def covered(self):
        """Boxes with enough sky to speak for their place."""
        full = self.count > 0
        if not full.any():
            return full
        enough = (self.count >= _MIN_PIXELS) & (self.share >= 0.5 * np.median(self.share[full]))
        if enough.any():
            return enough
        return full

    @property
    def error(self):
        """Statistical error of the level of each box."""
        return _MEDIAN_ERROR * self.spread / np.sqrt(np.maximum(self.count, 1))

    def surface(self, values, shape):
        """
        Fit a polynomial through values of the boxes that count, clipped at three standard deviations.

        It is a parabola with twenty boxes or more, for distortion bends a gradient of the sky; a plane
        with six; zero with fewer. Returns it at the pixels of an image of a ``shape``, float32, and at
        the mean places of the boxes' sky.
        """
        # in units of the image, about its middle
        y, x = (v / edge[-1] - 0.5 for v, edge in zip(self.center, self.edges, strict=True))
        everywhere = np.stack([np.ones_like(y), y, x, y * y, y * x, x * x], axis=-1)
        terms = everywhere[self.covered]
        level = values[self.covered]
        if level.size >= 20:
            number = 6
        elif level.size >= 6:
            number = 3
        else:
            number = 0
        coefficients = np.zeros(6)
        keep = np.ones(level.size, bool)
        for _ in range(10 if number else 0):
            fitted = np.linalg.lstsq(terms[keep, :number], level[keep], rcond=None)[0]
            coefficients[:number] = fitted
            residual = level - terms @ coefficients
            inner = residual[keep]
            spread = 1.4826 * np.median(np.abs(inner - np.median(inner)))
            new = np.abs(residual) <= 3 * spread
            if new.sum() < 2 * number or np.array_equal(new, keep):
                break
            keep = new
        y, x = (np.arange(n) / edge[-1] - 0.5 for n, edge in zip(shape, self.edges, strict=True))
        constant, along_y, along_x, y2, yx, x2 = coefficients
        # one product of matrices in place of six images
        row_terms = np.stack([constant + (along_y + y2 * y) * y, np.ones_like(y), yx * y], axis=1)
        right = np.stack([np.ones_like(x), (along_x + x2 * x) * x, x])
        pixels = row_terms.astype(np.float32) @ right.astype(np.float32)
        return pixels, everywhere @ coefficients

    def smooth(self, values, shape, filter_size):
        """
        Lay a smooth surface through values of the boxes.

        Parameters
        ----------
        values : `~numpy.ndarray`, shape (n, m)
            Of the boxes. Those that do not count take the median of those around them, or the nearest.
        shape : tuple of int
            Of the image.
        filter_size : int
            Boxes over which the median is taken before.

        Returns
        -------
        surface : `~numpy.ndarray` of float32, shape (ny, nx)
            Bicubic spline through the centers of the boxes, linear beyond the outermost.
        """
        filtered = _filled(_filtered(np.where(self.covered, values, np.nan), filter_size))
        filtered = filtered.astype(np.float32)
        for axis, edge in enumerate(self.edges):
            filtered = np.moveaxis(_spline(edge, shape[axis]) @ filtered, 0, 1)
        return filtered


def box_edges(n, box):
    """Return the edges of boxes of about ``box`` pixels that divide ``n`` evenly."""
    return np.linspace(0, n, max(1, round(n / box)) + 1).round().astype(int)


def sky_boxes(data, mask, box, *, mode=False):
    """
    Measure the sky in boxes.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Image; finite where it is not masked.
    mask : `~numpy.ndarray` of bool, shape (ny, nx)
        What is no sky.
    box : int
        Size in pixels.
    mode : bool, optional
        Whether the level is the mode, for sources that are not masked.

    Returns
    -------
    boxes : `SkyBoxes`

    Notes
    -----
    Values beyond three standard deviations of the median are clipped until none is left. The mode is
    2.5 median - 1.5 mean, or the median where the two differ by more than 0.3 standard deviations; it is 1.7
    times noisier than the median.

    References
    ----------
    Bertin & Arnouts 1996, A&AS 117, 393, sec. 4.
    """
    ny, nx = data.shape
    rows = box_edges(ny, box)
    columns = box_edges(nx, box)
    n = columns.size - 1
    width = int(np.diff(columns).max())
    at = columns[:-1, None] + np.arange(width)
    inside = at < columns[1:, None]
    at = np.minimum(at, nx - 1)
    level, spread, count, share, y, x = np.empty((6, rows.size - 1, n))
    for i in range(rows.size - 1):
        strip = slice(rows[i], rows[i + 1])
        good = ~mask[strip]
        # infinity sorts behind the pixels that count
        values = np.where(good, data[strip], np.inf)[:, at]
        values[:, ~inside] = np.inf
        values = np.sort(values.swapaxes(0, 1).reshape(n, -1), axis=1)
        number = np.add.reduceat(good.sum(axis=0), columns[:-1])
        for j, n_pixels in enumerate(number):
            level[i, j], spread[i, j], count[i, j] = _clipped(values[j, :n_pixels], mode)
        share[i] = number / (np.diff(columns) * good.shape[0])
        along_y = np.add.reduceat(good.T @ np.arange(rows[i], rows[i + 1]), columns[:-1])
        along_x = np.add.reduceat(good.sum(axis=0) * np.arange(nx), columns[:-1])
        y[i], x[i] = (v / np.maximum(number, 1) for v in (along_y, along_x))
    return SkyBoxes((rows, columns), level, spread, count.astype(int), share, (y, x))


def _clipped(values, mode):
    """Median or mode, standard deviation and number of the sorted values of a box, clipped; NaN of none."""
    if not values.size:
        return np.nan, np.nan, 0
    # sums of squares of what is near zero are exact enough
    shift = float(values[values.size // 2])
    values = values.astype(float) - shift
    low = 0
    high = values.size
    for _ in range(20):
        part = values[low:high]
        mean = np.add.reduce(part) / part.size
        spread = math.sqrt(max(part @ part / part.size - mean * mean, 0.0))
        median = 0.5 * (part[(part.size - 1) // 2] + part[part.size // 2])
        new = (
            values.searchsorted(median - _CLIP * spread),
            values.searchsorted(median + _CLIP * spread, side="right"),
        )
        if new == (low, high):
            break
        low, high = new
    if mode and abs(mean - median) <= 0.3 * spread:
        median = 2.5 * median - 1.5 * mean
    return median + shift, spread / _CLIPPED, high - low


def _spline(edges, n):
    """Return what a cubic spline through values at the centers of boxes is at each pixel, as a matrix."""
    nodes = 0.5 * (edges[1:] + edges[:-1] - 1)
    if nodes.size == 1:
        return np.ones((n, 1), np.float32)
    nodes = np.pad(nodes, 1, mode="reflect", reflect_type="odd")
    values = np.pad(np.eye(nodes.size - 2), [(1, 1), (0, 0)], mode="reflect", reflect_type="odd")
    return make_interp_spline(nodes, values)(np.arange(n)).astype(np.float32)


def _filtered(values, size):
    """Return the median of the finite values in windows; NaN where fewer than three would stand for none."""
    if size == 1:
        return values
    before = (size - 1) // 2
    after = size // 2
    # what rises toward an edge is continued beyond it, or the median would pull it back
    padded = values
    for axis, n in enumerate(values.shape):
        ends = []
        for k in (0, 1):
            if k == axis:
                ends.append((before, after))
            else:
                ends.append((0, 0))
        if n > after:
            mirror = {"mode": "reflect", "reflect_type": "odd"}
        else:
            mirror = {"mode": "edge"}
        padded = np.pad(padded, ends, **mirror)
    window = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
    window = window.reshape(values.shape + (-1,))
    valid = np.isfinite(values) | (np.isfinite(window).sum(axis=-1) >= 3)
    out = nans(values.shape)
    out[valid] = np.nanmedian(window[valid], axis=-1)
    return out


def _filled(values):
    """Return the values with the nearest finite one where there is none."""
    missing = ~np.isfinite(values)
    if not missing.any():
        return values
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


class SkyMesh:
    """
    A smooth surface and a mesh of boxes through the sky of an image, and what they leave.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Image; finite where it is not masked.
    mask : `~numpy.ndarray` of bool, shape (ny, nx)
        What is no data.
    box, filter_size : int
        Size of the boxes in pixels, and of the median filter in boxes.
    plane : bool
        Whether a plane or parabola is taken off before the boxes are measured.
    sources : `~numpy.ndarray` of bool, shape (ny, nx), optional
        What is no sky; if not given, levels are modes.
    """

    def __init__(self, data, mask, box, filter_size, plane, sources=None):
        self._data = data
        self.mask = mask
        self.plane = plane
        self.box = box
        self.filter_size = filter_size
        self._smooth = np.zeros((1, 1), data.dtype)
        mode = sources is None
        if mode:
            sources = np.zeros_like(mask)
        # boxes are measured once more without the surface, which widens their distribution
        if plane:
            boxes = sky_boxes(data, mask | sources, box, mode=mode)
            self._smooth, _ = boxes.surface(boxes.level, data.shape)
        self._measure(sources, mode=mode)

    def measured(self, sources):
        """Return the same of an image with other sources masked."""
        out = copy.copy(self)
        out._measure(sources)
        return out

    def _measure(self, sources, mode=False):
        self.sources = sources
        boxes = sky_boxes(self._data - self._smooth, self.mask | sources, self.box, mode=mode)
        values = boxes.level
        if self.plane:
            surface, is_valid = boxes.surface(values, self._data.shape)
            self._smooth = self._smooth + surface
            values = values - is_valid
        self._boxes = boxes
        mesh = self._over(values)
        self.residual = self._data - self._smooth - mesh
        self.level = (self._smooth + mesh).astype(np.float32)
        self.rms = np.maximum(self._over(boxes.spread), 0)

    def _over(self, values):
        return self._boxes.smooth(values, self._data.shape, self.filter_size)

    @property
    def error(self):
        """What noise leaves open of the level."""
        error = self._over(self._boxes.error)
        # that of a median of so many boxes
        number = np.clip(np.count_nonzero(self._boxes.covered), 1, self.filter_size**2)
        return np.maximum(error, 0) * np.float32(min(1.0, 1.2533 / np.sqrt(number)))
