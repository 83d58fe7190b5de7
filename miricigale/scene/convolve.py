"""
The convolution of a grid of light with the PSFs of a field, tile by tile.

Between four PSFs of a rectangular grid the PSF of a place is bilinear, a polynomial in the place
of the light. Written in the place of the pixel and the offset between the two, it is a sum of
four images, each the same light convolved with a kernel and multiplied by 1, x, y or xy of the
pixel: one forward transform of the light serves all four.
"""

import itertools
import math

import numpy as np
from scipy.fft import fft, irfft2, next_fast_len, rfft
from scipy.ndimage import spline_filter

from miricigale.utils.parallel import thread_count


class Places:
    """
    Places of PSFs along one axis of the image: linear between them, constant beyond.

    ``at`` are sorted places in pixels; the image has ``n_pixels`` and is painted ``margin`` pixels
    beyond each edge, with ``oversampling`` nodes per pixel.
    """

    def __init__(self, at, *, n_pixels, margin, oversampling):
        self._at = np.asarray(at, dtype=float)
        self._margin = margin
        self._oversampling = oversampling
        self.n_pixels = n_pixels
        self._n_nodes = (n_pixels + 2 * margin) * oversampling

    def weights(self):
        """Return for each node the place below it, and the weight of the next one."""
        if self._at.size == 1:
            return np.zeros(self._n_nodes, dtype=np.int64), np.zeros(self._n_nodes)
        node = np.arange(self._n_nodes) / self._oversampling - self._margin
        lower_node = np.clip(np.searchsorted(self._at, node, "right") - 1, 0, self._at.size - 2)
        part = (node - self._at[lower_node]) / np.diff(self._at)[lower_node]
        return lower_node.astype(np.int64), np.clip(part, 0.0, 1.0)

    def tiles(self):
        """
        Yield stretches of nodes over which the weights are linear.

        Each is its first and last (excluded) node, the place below, that one's pixel and the
        distance of the next place, infinite where the weights are constant.
        """
        edges = np.ceil((self._at + self._margin) * self._oversampling - 1e-9)
        edges = np.clip(np.append(np.append(0, edges), self._n_nodes), 0, self._n_nodes).astype(int)
        if self._at.size == 1:
            edges = [0, self._n_nodes]
        for k, (first, stop) in enumerate(itertools.pairwise(edges)):
            if stop <= first:
                continue
            if k in (0, self._at.size):
                yield first, stop, max(k - 1, 0), 0.0, np.inf
            else:
                yield first, stop, k - 1, self._at[k - 1], self._at[k] - self._at[k - 1]


def _window(first, stop, n_pixels, margin, oversampling):
    """Return the pixels of a tile and of the image that it reaches, and the length of the transform."""
    start = first // oversampling
    end = -(-stop // oversampling)
    low = max(start - margin, margin)
    high = min(end + margin, margin + n_pixels)
    # what wraps round stays off the wanted pixels
    size = max(high - start + margin, end - low + margin, end - start)
    return start, end, low, high, next_fast_len(size, real=True)


def _spectrum(part, size, n_threads):
    """Return the half of the transform of an image padded with zeros, without work on empty rows."""
    rows = rfft(part, size[1], axis=1, workers=n_threads)
    return fft(rows, size[0], axis=0, workers=n_threads, overwrite_x=True)


def _kernel_spectrum(kernel, size, n_threads):
    """Return the same for a kernel whose middle is the origin."""
    half = kernel.shape[0] // 2
    taps = np.arange(-half, half + 1)
    wrapped = np.zeros((kernel.shape[0], size[1]))
    wrapped[:, taps % size[1]] = kernel
    rows = np.zeros((size[0], size[1] // 2 + 1), dtype=complex)
    rows[taps % size[0]] = rfft(wrapped, axis=1, workers=n_threads)
    return fft(rows, axis=0, workers=n_threads, overwrite_x=True)


def phases(data, origin, oversampling):
    """
    Return the cubic spline coefficients of a PSF by sub-pixel phase.

    ``data`` are its values on the nodes, ``origin`` the node x, y of its center. Shape of the
    result: (oversampling, oversampling, 2 L + 1, 2 L + 1), coefficients at the offsets of whole
    pixels less ``a`` and ``b`` nodes in y and x.
    """
    os_ = oversampling
    cx, cy = origin
    # space in which the splines decay
    reach = max(cx, cy, data.shape[1] - 1 - cx, data.shape[0] - 1 - cy) + 8
    half = math.ceil((reach + os_) / os_)
    size = half * os_ + os_ - 1
    padded = np.zeros((2 * size + 1, 2 * size + 1))
    padded[size - cy : size - cy + data.shape[0], size - cx : size - cx + data.shape[1]] = data
    coefficients = spline_filter(padded, order=3, mode="mirror")
    result = np.empty((os_, os_, 2 * half + 1, 2 * half + 1))
    steps = size + os_ * np.arange(-half, half + 1)
    for a in range(os_):
        for b in range(os_):
            result[a, b] = coefficients[np.ix_(steps - a, steps - b)]
    return result


def add_nodes(image, i, j, light, phases, *, margin):
    """
    Add the light of single nodes (row i, column j) to an image, in place.

    It is what `convolve` does with one PSF of these `phases`, which takes as long for one node as
    for all.
    """
    os_ = phases.shape[0]
    half = phases.shape[-1] // 2
    for row, column, value in zip(i, j, light, strict=True):
        y = row // os_ - margin
        x = column // os_ - margin
        y0 = max(y - half, 0)
        y1 = min(y + half + 1, image.shape[0])
        x0 = max(x - half, 0)
        x1 = min(x + half + 1, image.shape[1])
        if y1 > y0 and x1 > x0:
            stamp = phases[row % os_, column % os_]
            stamp = stamp[y0 - y + half : y1 - y + half, x0 - x + half : x1 - x + half]
            image[y0:y1, x0:x1] += value * stamp


def _kernels(data, origin, oversampling, order, y, x):
    """Return the phases of the kernels of 1, x, y and xy of the pixel, as far as they are not zero."""
    k_y, length_y = y
    k_x, length_x = x
    corner = data[order[k_y, k_x]]
    # the splines' coefficients are those of the PSF times the offset: not the offset times them
    u = (np.arange(corner.shape[1]) - origin[0]) / oversampling / length_x
    v = ((np.arange(corner.shape[0]) - origin[1]) / oversampling / length_y)[:, None]
    kernels = {(0, 0): corner}
    if np.isfinite(length_x):
        kernels[0, 1] = data[order[k_y, k_x + 1]] - corner
        kernels[0, 0] = corner - u * kernels[0, 1]
    if np.isfinite(length_y):
        kernels[1, 0] = data[order[k_y + 1, k_x]] - corner
        kernels[0, 0] = kernels[0, 0] - v * kernels[1, 0]
    if len(kernels) == 3:
        opposite = data[order[k_y + 1, k_x + 1]] - corner - kernels[0, 1] - kernels[1, 0]
        kernels[1, 1] = opposite
        kernels[0, 0] = kernels[0, 0] + u * v * opposite
        kernels[0, 1] = kernels[0, 1] - v * opposite
        kernels[1, 0] = kernels[1, 0] - u * opposite
    return {power: phases(kernel, origin, oversampling) for power, kernel in kernels.items()}


def convolve(grid, data, order, rows, columns, *, origin, margin, oversampling, n_threads=None):
    """
    Convolve the light on the nodes with the local coefficients; keep one node for each pixel.

    Parameters
    ----------
    grid : `~numpy.ndarray`, shape ((ny + 2 margin) os, (nx + 2 margin) os)
        Light on the nodes.
    data : `~numpy.ndarray`, shape (n_psfs, n, m)
        The PSFs on their nodes; their phases reach at most ``margin`` pixels.
    order : `~numpy.ndarray` of int, shape (n_y, n_x)
        The PSFs on their rectangular grid.
    rows, columns : `Places`
        Where the grid's rows and columns stand.
    origin, margin, oversampling, n_threads : optional
        As of `phases`, `Places` and `~miricigale.utils.parallel.thread_count`.

    Returns
    -------
    image : `~numpy.ndarray`, shape (ny, nx)
        Light in each pixel.
    """
    os_ = oversampling
    n_threads = thread_count(n_threads)
    image = np.zeros((rows.n_pixels, columns.n_pixels))
    for y_first, y_stop, k_y, y_0, length_y in rows.tiles():
        y0, y1, low_y, high_y, size_y = _window(y_first, y_stop, rows.n_pixels, margin, os_)
        for x_first, x_stop, k_x, x_0, length_x in columns.tiles():
            x0, x1, low_x, high_x, size_x = _window(x_first, x_stop, columns.n_pixels, margin, os_)
            if high_y <= low_y or high_x <= low_x:
                continue
            light = source_part = grid[y_first:y_stop, x_first:x_stop]
            if not source_part.any():
                continue
            full = (y1 - y0) * os_, (x1 - x0) * os_
            if source_part.shape != full:
                # the tile begins or ends within a pixel
                light = np.zeros(full, dtype=grid.dtype)
                i = y_first - y0 * os_
                j = x_first - x0 * os_
                light[i : i + source_part.shape[0], j : j + source_part.shape[1]] = source_part
            kernels = _kernels(data, origin, os_, order, (k_y, length_y), (k_x, length_x))
            size = (size_y, size_x)
            totals = dict.fromkeys(kernels, 0.0)
            for a in range(os_):
                for b in range(os_):
                    part = light[a::os_, b::os_]
                    if not part.any():
                        continue
                    spectrum = _spectrum(part.astype(float), size, n_threads)
                    for power, kernel in kernels.items():
                        product = _kernel_spectrum(kernel[a, b], size, n_threads)
                        product *= spectrum
                        totals[power] += product
            y = np.arange(low_y - margin, high_y - margin)
            x = np.arange(low_x - margin, high_x - margin)
            wrapped = np.ix_((y + margin - y0) % size_y, (x + margin - x0) % size_x)
            target = image[y[0] : y[-1] + 1, x[0] : x[-1] + 1]
            for (in_y, in_x), total in totals.items():
                piece = irfft2(total, size, workers=n_threads)[wrapped]
                if in_y:
                    piece *= ((y - y_0) / length_y)[:, None]
                if in_x:
                    piece *= (x - x_0) / length_x
                target += piece
    return image
