"""Numerical kernels of the PSFs: outlines to pupils, matrix Fourier transforms, radial sums."""

import math

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from miricigale.utils.compilation import njit


@njit()
def polygon_coverage(vertices, n, step, rows):
    """
    Fraction, (n, n) by y and x, of each cell of a centered square grid that lies inside a polygon.

    Exact along x, sampled by ``rows`` lines per cell along y; even-odd rule. ``vertices``, (m, 2), are corners
    x, y from the grid's center in the unit of ``step``, the side of a cell; the outline closes itself.
    """
    m = vertices.shape[0]
    coverage = np.zeros((n, n))
    crossings = np.empty(m)
    for line in range(n * rows):
        y = ((line + 0.5) / rows - 0.5 * n) * step
        count = 0
        for i in range(m):
            k = (i + 1) % m
            y1 = vertices[i, 1]
            y2 = vertices[k, 1]
            if (y1 <= y) != (y2 <= y):
                x1 = vertices[i, 0]
                x2 = vertices[k, 0]
                # in cells from the left edge of the grid
                crossings[count] = (x1 + (y - y1) / (y2 - y1) * (x2 - x1)) / step + 0.5 * n
                count += 1
        if count < 2:
            continue
        # few, and numba takes seconds to compile a sort
        for i in range(1, count):
            x = crossings[i]
            k = i
            while k > 0 and crossings[k - 1] > x:
                crossings[k] = crossings[k - 1]
                k -= 1
            crossings[k] = x
        j = line // rows
        for pair in range(count // 2):
            start = min(max(crossings[2 * pair], 0.0), float(n))
            right = min(max(crossings[2 * pair + 1], 0.0), float(n))
            first = int(start)
            last = math.ceil(right)
            for i in range(first, last):
                coverage[j, i] += (min(right, i + 1.0) - max(start, float(i))) / rows
    return np.minimum(coverage, 1.0)


def remove_plane(values, weights):
    """Subtract the best plane of an image, (n, n), by weights >= 0; zero where the weight is zero."""
    inside = weights > 0
    y, x = np.nonzero(inside)
    design = np.stack([np.ones(x.size), x - x.mean(), y - y.mean()], axis=1)
    root = np.sqrt(weights[inside])
    solution = np.linalg.lstsq(design * root[:, None], values[inside] * root, rcond=None)[0]
    result = np.zeros_like(values)
    result[inside] = values[inside] - design @ solution
    return result


def _standardize(values, weights):
    values = remove_plane(values, weights)
    return values / np.sqrt(np.sum(weights * values**2) / np.sum(weights))


def wavefront(amplitude, segments, x, y, rms, segment_fraction, rng):
    """
    Draw a wavefront error: segments (piston, tip, tilt, focus) and low orders.

    Parameters
    ----------
    amplitude, segments : `~numpy.ndarray`, shape (n, n)
        Transmission of the pupil, the weight of the rms; segment of each cell from 1, 0 outside.
    x, y : `~numpy.ndarray`, shape (n, n)
        Pupil coordinates in units of its radius, in a frame fixed to the telescope.
    rms, segment_fraction : float
        Root mean square over the pupil, piston and tilt removed, in any unit; share of the variance
        that the segment terms have.
    rng : `~numpy.random.Generator`
        Source of the coefficients.

    Returns
    -------
    opd : `~numpy.ndarray`, shape (n, n)
        Optical path difference in the unit of ``rms``, 0 outside the pupil.
    """
    single = np.zeros_like(amplitude)
    for index in range(1, int(segments.max()) + 1):
        on_segment = segments == index
        u = x[on_segment] - x[on_segment].mean()
        v = y[on_segment] - y[on_segment].mean()
        r2 = u**2 + v**2
        radius = np.sqrt(r2.max())
        a = rng.normal(size=4) * (1.0, 0.5, 0.5, 0.6)
        single[on_segment] = a[0] + (a[1] * u + a[2] * v) / radius + a[3] * (r2 / radius**2 - 0.5)
    r = np.hypot(x, y)
    t = np.arctan2(y, x)
    low = np.zeros_like(amplitude)
    for term, weight in (
        (2 * r**2 - 1, 0.5),
        (r**2 * np.cos(2 * t), 1.0),
        (r**2 * np.sin(2 * t), 1.0),
        ((3 * r**3 - 2 * r) * np.cos(t), 0.7),
        ((3 * r**3 - 2 * r) * np.sin(t), 0.7),
        (r**3 * np.cos(3 * t), 0.7),
        (r**3 * np.sin(3 * t), 0.7),
        (6 * r**4 - 6 * r**2 + 1, 0.5),
    ):
        low += rng.normal() * weight * term
    weights = np.where(segments > 0, amplitude, 0.0)
    total = math.sqrt(segment_fraction) * _standardize(single, weights)
    total += math.sqrt(1 - segment_fraction) * _standardize(low, weights)
    return rms * _standardize(total, weights)


def _phases(angles, frequencies, dtype):
    """exp(-2 pi i times the outer product); whole turns go before the precision does."""
    turns = np.outer(angles, frequencies)
    turns -= np.rint(turns)
    result = np.empty(turns.shape, dtype=dtype)
    turns = (2 * np.pi * turns).astype(result.real.dtype)
    result.real = np.cos(turns)
    result.imag = -np.sin(turns)
    return result


def matrix_dft_intensity(
    pupil, step, wavelength, theta_x, theta_y, *, power=None, dtype=np.complex64
):
    """
    Intensity of the point-source image of a pupil on any grid of angles.

    Parameters
    ----------
    pupil : `~numpy.ndarray`, shape (n, n)
        Complex pupil function, indexed [y, x], centered.
    step : float
        Side of a pupil cell in m.
    wavelength : float
        In m.
    theta_x, theta_y : `~numpy.ndarray`
        Equally spaced angles of the columns and rows in rad.
    power : float, optional
        Light that enters, in cells of unit transmission; the sum of ``abs(pupil)**2`` if
        not given. For an anti-aliased pupil it is the sum of the amplitudes: a cell half
        covered passes half of the light, most of the other quarter to angles that the
        grid does not resolve.
    dtype : dtype, optional
        Precision of the matrices.

    Returns
    -------
    intensity : `~numpy.ndarray`, shape (theta_y.size, theta_x.size)
        Fraction of the light in each cell; the sum over one period of the transform,
        ``wavelength / step`` in each axis, is the sum of ``abs(pupil)**2`` over ``power``
        (Parseval).

    References
    ----------
    Soummer, Pueyo, Sivaramakrishnan & Vanderbei 2007, Optics Express 15, 15935, eq. 5.
    """
    n = pupil.shape[0]
    position = (np.arange(n) - 0.5 * (n - 1)) * step
    row_phases = _phases(theta_y, position / wavelength, dtype)
    is_square = theta_x is theta_y
    right = row_phases if is_square else _phases(theta_x, position / wavelength, dtype)
    field = row_phases @ pupil.astype(dtype) @ right.T
    cell = (theta_x[1] - theta_x[0]) * (theta_y[1] - theta_y[0]) * (step / wavelength) ** 2
    scale = cell / (np.sum(np.abs(pupil) ** 2) if power is None else power)
    return (field.real.astype(float) ** 2 + field.imag.astype(float) ** 2) * scale


def line_scatter(image, kernel, axis):
    """
    Convolve an image, (n, n), with a symmetric kernel along one axis (zeros outside).

    ``kernel``, (n,), is its value at distances 0, 1, ... n - 1.
    """
    n = image.shape[axis]
    size = next_fast_len(2 * n, real=True)
    circular = np.zeros(size)
    circular[:n] = kernel[:n]
    circular[size - n + 1 :] = kernel[1:n][::-1]
    transfer = rfft(circular).real
    # the lines side by side in memory
    lines = np.ascontiguousarray(np.moveaxis(image, axis, -1))
    result = irfft(rfft(lines, size) * transfer, size)[:, :n]
    return np.ascontiguousarray(np.moveaxis(result, -1, axis))


@njit()
def _overlap(dx, dy, radius, parts):
    """Part of the unit square around (dx, dy) inside a circle around 0."""
    if radius >= 12.0:
        # a ramp in r^2, which keeps the circle's area whatever its width
        w = 0.5 + (radius * radius - dx * dx - dy * dy) / (2.0 * radius)
        return min(max(w, 0.0), 1.0)
    area = 0.0
    for k in range(parts):
        y = dy + (k + 0.5) / parts - 0.5
        if abs(y) < radius:
            chord = math.sqrt(radius * radius - y * y)
            area += max(0.0, min(dx + 0.5, chord) - max(dx - 0.5, -chord))
    return area / parts


@njit()
def _sorted_sums(image, x_center, y_center, radii):
    """`radial_sums` for radii in ascending order."""
    m = radii.size
    full = np.zeros(m + 1)
    sums = np.zeros(m)
    for j in range(image.shape[0]):
        dy = j - y_center
        for i in range(image.shape[1]):
            dx = i - x_center
            r = math.sqrt(dx * dx + dy * dy)
            # half a diagonal either way: circles below do not see it, those above see all
            k = 0
            stop = m
            while k < stop:
                middle = (k + stop) // 2
                if radii[middle] < r - 0.71:
                    k = middle + 1
                else:
                    stop = middle
            while k < m and radii[k] < r + 0.71:
                sums[k] += image[j, i] * _overlap(dx, dy, radii[k], 16)
                k += 1
            full[k] += image[j, i]
    running = 0.0
    for k in range(m):
        running += full[k]
        sums[k] += running
    return sums


def radial_sums(image, x_center, y_center, radii):
    """
    Sums, (m,), of an image inside circles.

    Pixels cut by the circle count by the part inside: by 16 chords below a radius of 12
    pixels, to first order beyond (relative error of a smooth PSF's sum below 1e-3).
    Center and ``radii``, (m,), in any order, are in pixels.
    """
    image = np.ascontiguousarray(image, float)
    radii = np.asarray(radii, float)
    order = np.argsort(radii)
    sums = np.empty(radii.size)
    sums[order] = _sorted_sums(image, float(x_center), float(y_center), radii[order])
    return sums


def core_moments(data):
    """
    Center and rms width (cells) of a PSF's core, under a round Gaussian window as wide as it.

    Those of a Gaussian are its own. All of the core counts: noise in one pixel or a pattern
    of resampling changes them little, and distant wings do not enter. NaN where they do not settle.
    """
    columns = np.arange(data.shape[1])
    rows = np.arange(data.shape[0])
    y, x = (float(v) for v in np.unravel_index(np.argmax(data), data.shape))
    sigma = 2.0
    for _ in range(300):
        wx = np.exp(-0.5 * ((columns - x) / sigma) ** 2)
        wy = np.exp(-0.5 * ((rows - y) / sigma) ** 2)
        total = wy @ data @ wx
        if not total > 0:
            break
        dx = wy @ data @ (wx * (columns - x)) / total
        dy = (wy * (rows - y)) @ data @ wx / total
        squares = wy @ data @ (wx * (columns - x) ** 2) + (wy * (rows - y) ** 2) @ data @ wx
        # the window halves a Gaussian's offset and its variance, which is of two axes here
        x = x + 2 * dx
        y = y + 2 * dy
        last = sigma
        variance = squares / total - dx**2 - dy**2
        if not 0 < variance < max(data.shape) ** 2:
            break
        sigma = math.sqrt(variance)
        if max(abs(dx), abs(dy), abs(sigma - last)) < 1e-8 * sigma:
            return float(x), float(y), sigma
    return math.nan, math.nan, math.nan


@njit()
def spline_weights(t, w):
    """Weights (4) of the cubic B-splines at the nodes -1 to 2 for a position t from 0 to 1."""
    s = 1.0 - t
    w[0] = s * s * s / 6.0
    w[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
    w[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
    w[3] = t * t * t / 6.0


@njit()
def cubic_splines(coefficients, y, x):
    """Cubic splines of shape (ny, nx, k) at positions in cells, shape (k, n), zero outside of the grid."""
    ny, nx, k = coefficients.shape
    values = np.zeros((y.size, k))
    weights = np.empty((2, 4))
    nodes = np.empty((2, 4), np.int64)
    for n in range(y.size):
        if not (0 <= y[n] <= ny - 1 and 0 <= x[n] <= nx - 1):
            continue
        for axis, (position, size) in enumerate(((y[n], ny), (x[n], nx))):
            first = math.floor(position)
            spline_weights(position - first, weights[axis])
            for m in range(4):
                # the coefficients are mirrored at the edges
                nodes[axis, m] = size - 1 - abs(size - 1 - abs(first + m - 1))
        for a in range(4):
            for b in range(4):
                weight = weights[0, a] * weights[1, b]
                for m in range(k):
                    values[n, m] += weight * coefficients[nodes[0, a], nodes[1, b], m]
    return values.T


def half_maximum_width(data, x, y):
    """Full width at half maximum (cells) of the azimuthal mean around a point; NaN without a half."""
    limit = min(x, data.shape[1] - 1 - x, y, data.shape[0] - 1 - y)
    angles = np.arange(48) * (2 * np.pi / 48)
    for reach in (16.0, 64.0, limit):
        radii = np.arange(0.0, min(reach, limit), 0.25)
        rows = y + radii[:, None] * np.sin(angles)
        columns = x + radii[:, None] * np.cos(angles)
        profile = interpolate(data, columns, rows).mean(axis=1)
        faint = np.flatnonzero(profile < 0.5 * profile[0])
        if faint.size:
            k = faint[0]
            part = (profile[k - 1] - 0.5 * profile[0]) / (profile[k - 1] - profile[k])
            return 2 * (radii[k - 1] + part * 0.25)
    return float("nan")


def interpolate(data, x, y):
    """
    Cubic-spline values of an image at positions in cells, zero outside of it.

    The image is cut to what the positions need (and 12 cells, over which a spline
    forgets the cut).
    """
    from scipy.ndimage import map_coordinates

    ny, nx = data.shape
    x0 = max(0, int(np.floor(x.min())) - 12)
    x1 = min(nx, int(np.ceil(x.max())) + 13)
    y0 = max(0, int(np.floor(y.min())) - 12)
    y1 = min(ny, int(np.ceil(y.max())) + 13)
    if x1 <= x0 or y1 <= y0:
        return np.zeros(np.broadcast(x, y).shape)
    x, y = np.broadcast_arrays(x, y)
    # cells on the very edge belong to the image: 'constant' alone would taper half a cell
    values = map_coordinates(
        np.asarray(data[y0:y1, x0:x1], dtype=float), (y - y0, x - x0), order=3, mode="nearest"
    )
    inside = (x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)
    return np.where(inside, values, 0.0)
