"""Fits of Sersic profiles seen through a PSF: images, steps of the fit, and shapes about the best."""

import collections

import numpy as np

from miricigale.photometry._core.shapes import FAST, fill_curves
from miricigale.utils.compilation import njit

#: How square images are made from transforms, by products of small matrices: frequencies kx and ky (rad per pixel)
#: at ky >= 0, then at ky <= 0, (2 ny nx,), what their squares count in the sum over all pixels; the PSF's
#: transform, (2, ny, nx); cosines and sines along y, (2, size, 2 ny), and along x, (2, 2 nx, size), and their
#: derivatives to the place.
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
    # images move against the pixels
    inner = [np.hstack([one.real, one.imag]) for one in (inner, -1j * ky[:, 0] * inner)]
    outer = [np.vstack([one.real, -one.imag]) for one in (outer, -1j * kx[0, :, None] * outer)]
    real = np.tile(kx.ravel(), 2), np.append(ky, -ky), weight, np.array(inner), np.array(outer)
    kx, ky, weight, inner, outer = (one.astype(np.float32) for one in real)
    return Plan(kx, ky, weight, response.astype(np.complex64), inner, outer)


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
def _images(plan, curves, placed, n_moved):
    """
    Draw images, (size, n + 2 n_moved, size), of transforms, (n, 2, ny, nx).

    The first ``n_moved`` are followed by their derivatives to x, those to y, and the others.
    """
    (n, _, ny, nx), size = curves.shape, plan.inner.shape[1]
    # sums and differences of the two at +-ky, real and imaginary parts
    right = np.empty((2 * ny, n, 2 * nx), np.float32)
    for c in range(n):
        for i in range(ny):
            for j in range(nx):
                above = curves[c, 0, i, j] * placed[0, i, j]
                below = curves[c, 1, i, j] * placed[1, i, j]
                right[i, c, j] = above.real + below.real
                right[i, c, nx + j] = above.imag + below.imag
                right[ny + i, c, j] = below.imag - above.imag
                right[ny + i, c, nx + j] = above.real - below.real
    middle = np.dot(plan.inner[0], right.reshape(2 * ny, -1)).reshape(size, n, 2 * nx)
    images = np.dot(middle.reshape(-1, 2 * nx), plan.outer[0])
    middle = np.ascontiguousarray(middle[:, :n_moved])
    along_x = np.dot(middle.reshape(-1, 2 * nx), plan.outer[1])
    middle = np.dot(plan.inner[1], np.ascontiguousarray(right[:, :n_moved]).reshape(2 * ny, -1))
    along_y = np.dot(middle.reshape(-1, 2 * nx), plan.outer[0])
    images, form = images.reshape(size, n, size), (size, n_moved, size)
    moved = along_x.reshape(form), along_y.reshape(form)
    return np.concatenate((images[:, :n_moved], *moved, images[:, n_moved:]), axis=1)


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
    _, ny, nx = plan.response.shape
    placed = _placed(plan, np.array([[x, y]]))[0]
    return _images(plan, curves.reshape(-1, 2, ny, nx), placed, more // 2)


@njit(cache=True, nogil=True)
def _products(plan, table, inverse, corners, shapes, placed, columns):
    """Write whitened models and derivatives into all columns but the last; products of all columns."""
    k, (_, ny, nx), width = (len(columns) - 1) // len(shapes), plan.response.shape, inverse.shape[1]
    left, top = corners[:, 0].min(), corners[:, 1].min()
    curves = np.empty((5 if k == 7 else 1, 2, ny, nx), np.float32)
    for s in range(len(shapes)):
        x, y = corners[s]
        fill_curves(plan.kx, plan.ky, shapes[s], table, curves.reshape(len(curves), -1))
        images = _images(plan, curves, placed[s], min(k - 1, 1))
        for row in range(len(images)):
            first = (y - top + row) * width + x - left
            for j in range(k):
                # by pixel: expressions of short pieces of arrays take longer than their pixels
                for i in range(len(images)):
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
def _step(matrix, slope, parameters, limits, damping):
    """
    Damped Newton step of light and parameters, (n (1 + m),), and half of the gain in chi^2 without the damping.

    Parameters that are at a limit, and would go beyond it, stay there (Bertsekas 1982, SIAM J. Control Optim. 20, 221).
    """
    n, m = parameters.shape
    damped, free = matrix + np.diag(damping * np.diag(matrix)), slope.copy()
    for s in range(n):
        for j in range(m):
            k = s * (1 + m) + 1 + j
            beyond = slope[k] < 0.0 if parameters[s, j] <= limits[0, j] else slope[k] > 0.0
            if beyond and not limits[0, j] < parameters[s, j] < limits[1, j]:
                damped[k, :] = 0.0
                damped[:, k] = 0.0
                damped[k, k] = 1.0
                free[k] = 0.0
    step = np.linalg.solve(damped, free)
    return step, step @ free


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
    flux, matrix, slope = np.zeros(n), np.eye(n * k), np.zeros(n * k)
    trial, parameters, chi2, damping = start, start, np.inf, 0.1
    while True:
        placed = _placed(plan, trial[:, :2] - corners)
        products = _products(plan, table, inverse, corners, trial[:, 2:], placed, columns)
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
        step, gained = _step(matrix, slope, parameters[:, :m], limits, damping)
        trial = parameters.copy()
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


@njit(cache=True, nogil=True, fastmath=FAST)
def _center_products(images, s, inverse, white, products):
    """Products, (3, 4), of a whitened model and its derivatives to the center, with these and the data."""
    aa = ab = ac = ad = bb = bc = bd = cc = cd = 0.0
    n = images.shape[1] // 3
    for row in range(len(images)):
        for i in range(len(images)):
            noise, d = inverse[row, i], white[row, i]
            a, b, c = images[row, s, i], images[row, n + s, i], images[row, 2 * n + s, i]
            a, b, c = a * noise, b * noise, c * noise
            aa, ab, ac, ad = aa + a * a, ab + a * b, ac + a * c, ad + a * d
            bb, bc, bd, cc, cd = bb + b * b, bc + b * c, bd + b * d, cc + c * c, cd + c * d
    products[0], products[1], products[2] = (aa, ab, ac, ad), (ab, bb, bc, bd), (ac, bc, cc, cd)


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
    _, ny, nx = plan.response.shape
    # the best one first
    shapes = np.concatenate((best[:, 2:], shapes))
    curves = np.empty((len(shapes), 2, ny, nx), np.float32)
    for s in range(len(shapes)):
        fill_curves(plan.kx, plan.ky, shapes[s], table, curves[s].reshape(1, -1))
    images = _images(plan, curves, _placed(plan, best[:, :2] - corners)[0], len(shapes))
    found, known = np.zeros((len(shapes), 2)), np.zeros(len(beside))
    products, columns, data = np.empty((3, 4)), np.empty((3, white.size)), np.sum(white**2)
    log_prior, off = np.linalg.slogdet(precision[0])[1], (best - mean)[0, :2]
    pull = precision[0] @ off
    for s in range(len(shapes)):
        _center_products(images, s, inverse, white, products)
        if len(beside):
            # neighbors' light that was taken off is the best together with this one's
            for j in range(3):
                columns[j] = (images[:, j * len(shapes) + s] * inverse).reshape(-1)
            shared = columns @ beside.T
            if s == 0:
                known = flux * shared[0]
                data -= known @ known
            products[:, :3] -= shared @ shared.T
            products[:, 3] -= shared @ known
        found[s, 0] = -1e9
        power, seen = products[0, 0], products[0, 3]
        if power > 0 and seen > 0:
            # the center: changes of the pixels are in proportion to the light
            light, own = seen / power, products[1:, 0]
            slope = light * (products[1:, 3] - light * own) - pull
            matrix = precision[0] + light**2 * (products[1:, 1:3] - np.outer(own, own) / power)
            step = np.linalg.solve(matrix, slope)
            chi2 = data - light * seen + off @ pull
            log_det = np.linalg.slogdet(matrix)[1] + np.log(power)
            evidence = slope @ step - chi2 - log_det + log_prior
            found[s, 1] = np.log(light * max(1 - np.sum(own * step) / power, 0.1))
            found[s, 0] = 0.5 * evidence - found[s, 1]
    return found[1:]
