"""Fits of Sersic profiles seen through a PSF: images, steps of the fit, and shapes about the best."""

import collections

import numpy as np

from miricigale.photometry._core.shapes import FAST, fill_curves
from miricigale.utils.compilation import njit

#: How square images are made from transforms, by products of small matrices: frequencies kx and ky (rad per pixel)
#: at ky >= 0, then at ky <= 0, (2 ny nx,), what their squares count in the sum over all pixels; the PSF's
#: transform, (2, ny, nx); cosines and sines along y, (size, 2 ny), and along x, (2 nx, size).
Plan = collections.namedtuple("Plan", "kx ky weight response inner outer")


def make_plan(size, transform, passed):
    """
    The `Plan` of square images, corners of a square that is periodic.

    Parameters
    ----------
    size : int
        Pixels along a side of the images.
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
    used = np.where(use, transform, 0.0)[:, :nx] / period
    response = np.stack([used[rows[:ny]], used[-rows[:ny]] * twice[:ny, None]])
    weight = (np.abs(response) ** 2 * (1 + twice[:nx])).ravel()
    response *= (1 + twice[:nx]) / period
    ky, kx = np.meshgrid(*(2 * np.pi / period * np.arange(k) for k in (ny, nx)), indexing="ij")
    along, across = np.arange(size)[:, None] * ky[:, 0], kx[0, :, None] * np.arange(size)
    inner, outer = np.exp(1j * along), np.exp(1j * across)
    real = np.tile(kx.ravel(), 2), np.append(ky, -ky), weight
    products = np.hstack([inner.real, inner.imag]), np.vstack([outer.real, -outer.imag])
    kx, ky, weight, inner, outer = (one.astype(np.float32) for one in (*real, *products))
    return Plan(kx, ky, weight, response.astype(np.complex64), inner, outer)


@njit(cache=True, nogil=True)
def _buffers(plan, n_curves, n):
    """
    Arrays to draw n images of as many curves in, or of two more: derivatives of the first to the place.

    Transforms of profiles at +-ky; sums and differences of the two, real and imaginary parts, that cosines and
    sines along y are multiplied with; their products; and the images, (size, n, size).
    """
    (_, ny, nx), size = plan.response.shape, len(plan.inner)
    curves = np.empty((n_curves, 2, ny, nx), np.float32)
    right = np.empty((2 * ny, n, 2, nx), np.float32)
    middle = np.empty((size * n, 2 * nx), np.float32)
    return curves, right, middle, np.empty((size, n, size), np.float32)


@njit(cache=True, nogil=True)
def _placed(plan, xy):
    """The PSF's transform, moved to places, (n, 2)."""
    _, ny, nx = plan.response.shape
    found = np.empty((len(xy), 2, ny, nx), np.complex64)
    for s, (x, y) in enumerate(xy):
        along = np.exp(-1j * x * plan.kx[:nx]).astype(np.complex64)
        for i in range(ny):
            turn = np.complex64(np.exp(-1j * y * plan.ky[i * nx]))
            found[s, 0, i] = plan.response[0, i] * along * turn
            found[s, 1, i] = plan.response[1, i] * along * np.conj(turn)
    return found


@njit(cache=True, nogil=True, fastmath=FAST)
def _images(plan, placed, buffers):
    """Draw images of transforms; if there is space for two more, the first moved along x and y after it."""
    curves, right, middle, images = buffers
    (n_curves, _, ny, nx), n = curves.shape, images.shape[1]
    more = n - n_curves
    for c in range(n_curves):
        to = c + more if c else 0
        for i in range(ny):
            for j in range(nx):
                above = curves[c, 0, i, j] * placed[0, i, j]
                below = curves[c, 1, i, j] * placed[1, i, j]
                right[i, to, 0, j] = above.real + below.real
                right[i, to, 1, j] = above.imag + below.imag
                right[ny + i, to, 0, j] = below.imag - above.imag
                right[ny + i, to, 1, j] = above.real - below.real
    # times - i kx and - i ky
    for i in range(ny if more else 0):
        for j in range(nx):
            kx, ky = plan.kx[j], plan.ky[i * nx]
            for part in range(2):
                for row in (i, ny + i):
                    right[row, 1, part, j] = (kx - 2 * part * kx) * right[row, 0, 1 - part, j]
                right[i, 2, part, j] = -ky * right[ny + i, 0, part, j]
                right[ny + i, 2, part, j] = ky * right[i, 0, part, j]
    size = len(images)
    np.dot(plan.inner, right.reshape(2 * ny, -1), middle.reshape(size, -1))
    np.dot(middle, plan.outer, images.reshape(size * n, -1))


@njit(cache=True, nogil=True)
def draw_curves(plan, curves, x, y, more):
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
    more : {0, 2}
        Whether derivatives of the first to x and y come after it.

    Returns
    -------
    images : float32 `~numpy.ndarray`, shape (size, n + more, size)
    """
    buffers = _buffers(plan, len(curves), len(curves) + more)
    buffers[0].reshape(len(curves), -1)[:] = curves
    _images(plan, _placed(plan, np.array([[x, y]]))[0], buffers)
    return buffers[3]


@njit(cache=True, nogil=True)
def _products(plan, table, inverse, corners, shapes, placed, buffers, columns):
    """Write whitened models and derivatives into all columns but the last; products of all columns."""
    images = buffers[3]
    size, k, width = len(images), images.shape[1], inverse.shape[1]
    left, top = corners[:, 0].min(), corners[:, 1].min()
    for s in range(len(shapes)):
        x, y = corners[s]
        curves = buffers[0].reshape(len(buffers[0]), -1)
        fill_curves(plan.kx, plan.ky, shapes[s], table, curves)
        _images(plan, placed[s], buffers)
        for row in range(size):
            first = (y - top + row) * width + x - left
            for j in range(k):
                # by pixel: expressions of short pieces of arrays take longer than their pixels
                for i in range(size):
                    noise = inverse[y - top + row, x - left + i]
                    columns[s * k + j, first + i] = images[row, j, i] * noise
    return np.dot(columns, columns.T)


@njit(cache=True, nogil=True)
def _state(products, parameters, mean, precision):
    """Chi^2 with the prior, best light, and half of the second and (negative) first derivatives."""
    n, m = precision.shape[:2]
    k = 1 + m
    matrix, seen = products[:-1, :-1].copy(), products[:-1, -1].copy()
    power = matrix[::k, ::k].copy()
    # those without light have none
    power += np.diag(1e-12 * np.diag(power) + 1e-300)
    flux = np.linalg.solve(power, seen[::k].copy())
    light, scale = np.zeros(n * k), np.repeat(flux, k)
    light[::k], scale[::k] = flux, 1.0
    slope = seen - matrix @ light
    chi2 = products[-1, -1] - light @ (seen + slope)
    matrix *= scale * scale.reshape(-1, 1)
    slope *= scale
    for s in range(n):
        off, block = (parameters[s] - mean[s])[:m], slice(s * k + 1, (s + 1) * k)
        pull = np.sum(precision[s] * off, axis=1)
        chi2 += np.sum(off * pull)
        slope[block] -= pull
        matrix[block, block] += precision[s]
    return chi2, flux, matrix, slope


@njit(cache=True, nogil=True)
def minimum(plan, table, white, inverse, corners, start, mean, precision, limits, steps, gain):
    """
    Levenberg-Marquardt for the light and the first parameters of sources, with Gaussian priors.

    Parameters
    ----------
    plan, table : `Plan`, `~numpy.ndarray`
        As from `make_plan` and `~miricigale.photometry._core.shapes.profile_table`.
    white, inverse : `~numpy.ndarray`, shape (h, w)
        Light over its noise, and the inverse of the noise, zero for pixels that do not count, of the rectangle
        of all squares.
    corners : int `~numpy.ndarray`, shape (n, 2)
        First x and y of the square that each source is drawn on.
    start, mean : `~numpy.ndarray`, shape (n, 6)
        Parameters to begin with, and of the prior.
    precision : `~numpy.ndarray`, shape (n, m, m)
        Inverse of the prior's covariance of the m parameters that are free: 0, 2 or 6.
    limits : `~numpy.ndarray`, shape (2, 6)
        Least and largest parameters.
    steps, gain : int, float
        Largest number of steps, and the gain in chi^2 below which a step is the last.

    Returns
    -------
    chi2 : float
        With that of the prior, infinite without a minimum of positive light.
    flux, parameters : `~numpy.ndarray`, shapes (n,) and (n, 6)
        The best.
    evidence : float
        Laplace's, without the light's prior.
    covariance : `~numpy.ndarray`, shape (n, 1 + m, 1 + m)
        Of ln flux and the free parameters of each.
    matrix : `~numpy.ndarray`, shape (n (1 + m), n (1 + m))
        Inverse of the covariance of flux and free parameters of all.

    Raises
    ------
    `~numpy.linalg.LinAlgError`
        If a step is not determined.
    """
    n, m = precision.shape[:2]
    k = 1 + m
    columns = np.zeros((n * k + 1, white.size))
    columns[-1] = white.reshape(-1)
    buffers = _buffers(plan, 5 if m == 6 else 1, k)
    flux, matrix, slope = np.zeros(n), np.eye(n * k), np.zeros(n * k)
    trial, parameters, chi2, damping = start, start, np.inf, 0.1
    while True:
        placed = _placed(plan, trial[:, :2] - corners)
        products = _products(plan, table, inverse, corners, trial[:, 2:], placed, buffers, columns)
        state = _state(products, trial, mean, precision)
        if state[0] <= chi2:
            parameters, (chi2, flux, matrix, slope) = trial, state
            if steps == 0:
                break
            steps, damping = steps - 1, max(0.1 * damping, 1e-6)
        else:
            damping *= 10.0
            if damping >= 1e6:
                break
        step = np.linalg.solve(matrix + np.diag(damping * np.diag(matrix)), slope)
        trial, gained = parameters.copy(), step @ slope
        for s in range(n):
            for j in range(m):
                moved = trial[s, j] + min(max(step[s * k + 1 + j], -1.0), 1.0)
                trial[s, j] = min(max(moved, limits[0, j]), limits[1, j])
        if gained < gain:
            # so near the minimum everything is linear
            flux, parameters, chi2 = flux + step[::k], trial, chi2 - gained
            break
    sign, log_det = np.linalg.slogdet(matrix)
    evidence, covariance = -0.5 * (chi2 + log_det), np.empty((n, k, k))
    if not (sign > 0 and np.isfinite(chi2) and flux.min() > 0):
        return np.inf, flux, parameters, evidence, covariance, matrix
    whole = np.linalg.inv(matrix)
    for s in range(n):
        evidence += 0.5 * np.linalg.slogdet(precision[s])[1]
        covariance[s] = whole[s * k : (s + 1) * k, s * k : (s + 1) * k]
        covariance[s, 0] /= flux[s]
        covariance[s, :, 0] /= flux[s]
    return chi2, flux, parameters, evidence, covariance, matrix


@njit(cache=True, nogil=True)
def evidence_of(plan, table, white, inverse, corners, best, flux, shapes, mean, precision, beside):
    """
    Likelihoods of shapes of a source, with the light, the center and the neighbors that fit best.

    Parameters
    ----------
    plan, table, white, inverse, corners
        As for `minimum`.
    best, flux : `~numpy.ndarray`, shapes (1, 6) and (1,)
        The best parameters and light.
    shapes : `~numpy.ndarray`, shape (k, 4)
        The shapes.
    mean, precision : `~numpy.ndarray`, shapes (1, 6) and (1, 2, 2)
        The prior of the center.
    beside : `~numpy.ndarray`, shape (b, pixels)
        Whitened changes of the light of neighbors for each independent unit normal deviate.

    Returns
    -------
    found : `~numpy.ndarray`, shape (k, 2)
        Ln of the likelihood, integrated over a light that is flat in its logarithm, and ln flux; -1e9 and 0
        where no positive light fits.
    """
    buffers, parameters, columns = _buffers(plan, 1, 3), best.copy(), np.empty((4, white.size))
    columns[-1] = white.reshape(-1)
    found, known = np.zeros((len(shapes), 2)), np.empty(len(beside))
    placed, log_prior = _placed(plan, best[:, :2] - corners), np.linalg.slogdet(precision[0])[1]
    # the best one first
    for s in range(-1 if len(beside) else 0, len(shapes)):
        if s >= 0:
            parameters[0, 2:] = shapes[s]
        form = parameters[:, 2:]
        products = _products(plan, table, inverse, corners, form, placed, buffers, columns)
        if len(beside):
            shared = columns @ beside.T
            if s < 0:
                known = flux * shared[0]
                continue
            # the neighbors' light that was taken off is the best together with this one's
            shared[-1] = known
            products -= shared @ shared.T
        chi2, light, matrix, slope = _state(products, parameters, mean, precision)
        found[s, 0] = -1e9
        if light[0] > 0:
            # the center: changes of the pixels are in proportion to the light
            step = np.linalg.solve(matrix, slope)
            evidence = slope @ step - chi2 - np.linalg.slogdet(matrix)[1] + log_prior
            found[s, 1] = np.log(max(light[0] + step[0], 0.1 * light[0]))
            found[s, 0] = 0.5 * evidence - found[s, 1]
    return found
