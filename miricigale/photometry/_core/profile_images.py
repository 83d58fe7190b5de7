"""Images of Sersic profiles seen through a PSF, from their transforms."""

import collections

import numpy as np

from miricigale.photometry._core.shapes import FAST, STEP
from miricigale.utils.compilation import njit

#: How square images are made from transforms, by products of small matrices: frequencies kx and ky (rad per pixel)
#: at ky >= 0, then at ky <= 0, (2 ny nx,), what their squares count in the sum over all pixels; the PSF's
#: transform, (2, ny, nx); cosines and sines along y, (2, ny, half + 1), and cosines and negative sines along x,
#: (2, nx, half + 1), at distances from the middle pixel; largest part of the PSF's light in each row, (ny,), and
#: column, (nx,).
Plan = collections.namedtuple("Plan", "kx ky weight response waves_y waves_x light_y light_x")

#: Part of a source's light below which the frequencies of its image are left out.
_FAINT = 1e-4


def make_plan(size, transform, passed):
    """
    Make the `Plan` of square images, corners of a square that is periodic.

    Parameters
    ----------
    size : int
        Pixels along a side of the images, odd.
    transform : complex `~numpy.ndarray`, shape (period, period // 2 + 1)
        `scipy.fft.rfft2` of the PSF about the first pixel.
    passed : float
        Part of the PSF's light below which frequencies are left out.

    Returns
    -------
    plan : `Plan`
    """
    period, n = transform.shape
    use = np.abs(transform) > passed * np.abs(transform[0, 0])
    rows = np.arange(n)
    nx = 1 + np.flatnonzero(use.any(axis=0)).max()
    ny = 1 + np.flatnonzero((use[rows] | use[-rows]).any(axis=1)).max()
    # frequencies that are not their own negative count twice, along x, or are there twice, along y
    twice = (rows > 0) & (2 * rows != period)
    passed_waves = np.where(use, transform, 0.0)[:, :nx] / period
    response = np.stack([passed_waves[rows[:ny]], passed_waves[-rows[:ny]] * twice[:ny, None]])
    light = np.abs(response).max(axis=0) / np.abs(response[0, 0, 0])
    weight = (np.abs(response) ** 2 * (1 + twice[:nx])).ravel()
    response *= (1 + twice[:nx]) / period
    frequency = 2 * np.pi / period
    ky, kx = np.meshgrid(frequency * np.arange(ny), frequency * np.arange(nx), indexing="ij")
    distance = np.arange(size // 2 + 1)
    phase_y = ky[:, :1] * distance
    phase_x = kx[0][:, None] * distance
    return Plan(
        kx=np.tile(kx.ravel(), 2).astype(np.float32),
        ky=np.append(ky, -ky).astype(np.float32),
        weight=weight.astype(np.float32),
        response=response.astype(np.complex64),
        waves_y=np.array([np.cos(phase_y), np.sin(phase_y)]).astype(np.float32),
        waves_x=np.array([np.cos(phase_x), -np.sin(phase_x)]).astype(np.float32),
        light_y=light.max(axis=1).astype(np.float32),
        light_x=light.max(axis=0).astype(np.float32),
    )


@njit()
def _count(light, frequency, radius, profile):
    """Count the rows or columns of frequencies up to the last in which a profile has light."""
    n = len(light)
    while n > 1:
        # the profile falls with frequency: at the node below it is larger
        node = int(np.sqrt(np.sqrt(radius * frequency * (n - 1))) / STEP)
        if light[n - 1] * abs(profile[min(node, len(profile) - 1)]) > _FAINT:
            break
        n -= 1
    return n


@njit()
def frequency_extent(plan, shape, profile):
    """Return the numbers (ny, nx) of rows and columns of frequencies in which a shape, (4,), has light."""
    _, all_y, all_x = plan.response.shape
    eta = np.sqrt(shape[2] ** 2 + shape[3] ** 2)
    turn = 0.0
    if eta > 0.0:
        turn = np.sinh(eta) * shape[2] / eta
    # the least k R_e at one kx, or one ky
    size = np.exp(shape[0])
    radius_y = size / np.sqrt(np.cosh(eta) + turn)
    radius_x = size / np.sqrt(np.cosh(eta) - turn)
    ny = _count(plan.light_y, plan.ky[all_x * min(1, all_y - 1)], radius_y, profile)
    nx = _count(plan.light_x, plan.kx[min(1, all_x - 1)], radius_x, profile)
    return ny, nx


@njit()
def frequencies_of(plan, ny, nx):
    """Return kx, ky and weights of the first ny rows and nx columns of a plan, each (2 ny nx,)."""
    _, all_y, all_x = plan.response.shape
    if ny == all_y and nx == all_x:
        return plan.kx, plan.ky, plan.weight
    values = np.empty((3, 2 * ny * nx), np.float32)
    # by number: expressions of pieces of arrays take longer to compile
    for sign in range(2):
        for i in range(ny):
            first = (sign * ny + i) * nx
            source = (sign * all_y + i) * all_x
            for j in range(nx):
                values[0, first + j] = plan.kx[source + j]
                values[1, first + j] = plan.ky[source + j]
                values[2, first + j] = plan.weight[source + j]
    return values[0], values[1], values[2]


@njit()
def _turns(frequency, shift, n):
    """Return the factors (n,) by which a shift turns the phases of multiples of a frequency."""
    turns = np.empty(n, np.complex64)
    step = complex(np.cos(shift * frequency), -np.sin(shift * frequency))
    turn = complex(1.0, 0.0)
    for j in range(n):
        turns[j] = turn
        turn *= step
    return turns


@njit(fastmath=FAST, forceinline=True)
def draw_quarters(plan, curves, x, y, n_moved, size):
    """
    Draw images of transforms, (n, 2, ny, nx), on a square of at most the plan's size, with a center (x, y) on it.

    They may have fewer frequencies than the plan.
    After the first image come its derivatives to x and to y if ``n_moved`` is 1. The result, (2, 2 (half + 1) m,
    half + 1), has the parts of the m images that are even and odd along x; their rows are parts that are even and
    odd along y, of these the distances from the middle row, and of these the images.
    """
    n, _, ny, nx = curves.shape
    m = n + 2 * n_moved
    half = size // 2
    all_x = plan.response.shape[2]
    # the shift theorem, from the middle pixel
    along_x = _turns(plan.kx[min(1, nx - 1)], x - half, nx)
    along_y = _turns(plan.ky[all_x * min(1, ny - 1)], y - half, ny)
    # real and imaginary parts of the sums of the two at +-ky, and of their differences times i
    sums = np.empty((4, ny, m * nx), np.float32)
    placed = np.empty((4, nx), np.float32)
    for i in range(ny):
        turn = along_y[i]
        for j in range(nx):
            positive = plan.response[0, i, j] * along_x[j] * turn
            negative = plan.response[1, i, j] * along_x[j] * np.conj(turn)
            placed[0, j] = positive.real
            placed[1, j] = positive.imag
            placed[2, j] = negative.real
            placed[3, j] = negative.imag
        for c in range(n):
            first = c * nx
            if c > 0:
                first += 2 * n_moved * nx
            for j in range(nx):
                at_positive = curves[c, 0, i, j]
                at_negative = curves[c, 1, i, j]
                positive_real = at_positive * placed[0, j]
                positive_imag = at_positive * placed[1, j]
                negative_real = at_negative * placed[2, j]
                negative_imag = at_negative * placed[3, j]
                sums[0, i, first + j] = positive_real + negative_real
                sums[1, i, first + j] = negative_imag - positive_imag
                sums[2, i, first + j] = positive_imag + negative_imag
                sums[3, i, first + j] = positive_real - negative_real
        if n_moved:
            # derivatives to the place: -i k times the transform
            ky = plan.ky[i * all_x]
            for j in range(nx):
                kx = plan.kx[j]
                for parity in range(2):
                    sums[parity, i, nx + j] = kx * sums[2 + parity, i, j]
                    sums[2 + parity, i, nx + j] = -kx * sums[parity, i, j]
                for part in (0, 2):
                    sums[part, i, 2 * nx + j] = -ky * sums[part + 1, i, j]
                    sums[part + 1, i, 2 * nx + j] = ky * sums[part, i, j]
    # inverse transforms along y, then along x, as products of matrices
    halves = np.empty((4, half + 1, m * nx), np.float32)
    rows = halves.reshape(2, 2 * (half + 1) * m, nx)
    quarters = np.empty((2, 2 * (half + 1) * m, half + 1), np.float32)
    for k in range(4):
        np.dot(_nearest(plan.waves_y[k % 2], ny, half + 1).T, sums[k], halves[k])
    for k in range(2):
        np.dot(rows[k], _nearest(plan.waves_x[k], nx, half + 1), quarters[k])
    return quarters


@njit()
def _nearest(waves, n, n_distances):
    """Return the waves of the first n frequencies, at the first distances from the middle."""
    if waves.shape[1] == n_distances:
        return waves[:n]
    nearest = np.empty((n, n_distances), np.float32)
    for i in range(n):
        for j in range(n_distances):
            nearest[i, j] = waves[i, j]
    return nearest


@njit()
def draw_curves(plan, curves, x, y, n_derivatives):
    """
    Draw the images of transforms.

    Parameters
    ----------
    plan : `Plan`
        As from `make_plan`.
    curves : float32 `~numpy.ndarray`, shape (n, 2 ny nx)
        Real transforms, without the PSF.
    x, y : float
        Their center.
    n_derivatives : {0, 2}
        Whether derivatives of the first to x and y come after it.

    Returns
    -------
    images : float32 `~numpy.ndarray`, shape (n + n_derivatives, size, size)
    """
    _, ny, nx = plan.response.shape
    half = plan.waves_x.shape[2] - 1
    size = 2 * half + 1
    curves = curves.reshape(-1, 2, ny, nx)
    quarters = draw_quarters(plan, curves, x, y, n_derivatives // 2, size)
    images = np.empty((len(curves) + n_derivatives, size, size), np.float32)
    # the inverse of no noise
    inverse = np.ones((size, size), np.float32)
    for k in range(len(images)):
        whiten(quarters, k, inverse, 0, 0, images[k].reshape(-1))
    return images


@njit()
def whiten(quarters, k, inverse, y, x, column):
    """Write image k of `draw_quarters` over the noise into a column: the pixels of a rectangle, from (y, x) on."""
    half = quarters.shape[2] - 1
    n_odd = quarters.shape[1] // 2
    m = n_odd // (half + 1)
    width = inverse.shape[1]
    for row in range(2 * half + 1):
        i = abs(row - half) * m + k
        sign = np.float32(1.0 if row >= half else -1.0)
        noise = inverse[y + row]
        middle = (y + row) * width + x + half
        # by pixel: expressions of short pieces of arrays take longer than their pixels
        for j in range(half + 1):
            even = quarters[0, i, j] + sign * quarters[0, n_odd + i, j]
            odd = quarters[1, i, j] + sign * quarters[1, n_odd + i, j]
            column[middle + j] = (even + odd) * noise[x + half + j]
            column[middle - j] = (even - odd) * noise[x + half - j]
