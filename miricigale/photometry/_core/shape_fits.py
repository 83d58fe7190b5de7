"""Fits of Sersic profiles seen through a PSF: steps of the fit, and shapes about the best."""

import numpy as np

from miricigale.photometry._core.dense import (
    cholesky,
    inverse_of,
    log_determinant,
    solve_factor,
)
from miricigale.photometry._core.profile_images import (
    draw_quarters,
    frequencies_of,
    frequency_extent,
    whiten,
)
from miricigale.photometry._core.shapes import FAST, INDEX_RANGE, fill_curves, profile_of
from miricigale.utils.compilation import njit

#: Least half-light radius (pixels), and largest ellipticity, that are fitted.
_LEAST_RADIUS = 0.05
_MOST_ELLIPTICITY = 2.0


@njit(fastmath=FAST, forceinline=True)
def _product(a, b):
    """Sum of the products of two vectors: expressions of whole arrays take seconds to compile."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@njit()
def _rows(columns, first, n, low, high):
    """Copy pixels of n columns: expressions of pieces of arrays take longer to compile."""
    rows = np.empty((n, high - low))
    for i in range(n):
        for j in range(high - low):
            rows[i, j] = columns[first + i, low + j]
    return rows


@njit()
def _products(plan, table, inverse, squares, parameters, columns):
    """Write whitened models and derivatives into all columns but the last; products of all columns."""
    n = len(parameters)
    k = (len(columns) - 1) // n
    last = n * k
    width = inverse.shape[1]
    x0 = squares[0, 0]
    y0 = squares[0, 1]
    for s in range(n):
        x0 = min(x0, squares[s, 0])
        y0 = min(y0, squares[s, 1])
    # with the shape free (k = 7) the derivatives to its four parameters are drawn too
    n_curves = 5 if k == 7 else 1
    n_moved = min(k - 1, 1)
    products = np.zeros((last + 1, last + 1))
    for s in range(n):
        first = s * k
        shape = parameters[s, 2:]
        profile = profile_of(table, shape[1])
        ny, nx = frequency_extent(plan, shape, profile[0])
        kx, ky, _ = frequencies_of(plan, ny, nx)
        curves = np.empty((n_curves, 2, ny, nx), np.float32)
        fill_curves(kx, ky, shape, profile, curves.reshape(n_curves, -1))
        # each source is drawn on a square of its own
        center_x = parameters[s, 0] - squares[s, 0]
        center_y = parameters[s, 1] - squares[s, 1]
        quarters = draw_quarters(plan, curves, center_x, center_y, n_moved, squares[s, 2])
        for j in range(k):
            x = squares[s, 0] - x0
            y = squares[s, 1] - y0
            whiten(quarters, j, inverse, y, x, columns[first + j])
    if n == 1:
        return np.dot(columns, columns.T)
    products[last, last] = _product(columns[last], columns[last])
    for s in range(n):
        # on the rows of the square alone, beyond which there is no light
        low = squares[s, 1] - y0
        high = low + squares[s, 2]
        first = s * k
        own = _rows(columns, first, k, low * width, high * width)
        for i in range(k):
            right = _product(own[i], columns[last, low * width : high * width])
            products[first + i, last] = right
            products[last, first + i] = right
        block = np.dot(own, own.T)
        for i in range(k):
            for j in range(k):
                products[first + i, first + j] = block[i, j]
        for t in range(s):
            top = max(low, squares[t, 1] - y0)
            end = min(high, squares[t, 1] - y0 + squares[t, 2])
            if top >= end:
                continue
            left = _rows(columns, first, k, top * width, end * width)
            block = np.dot(left, _rows(columns, t * k, k, top * width, end * width).T)
            for i in range(k):
                for j in range(k):
                    products[first + i, t * k + j] = block[i, j]
                    products[t * k + j, first + i] = block[i, j]
    return products


@njit()
def parameter_limits(white):
    """Return the least and largest parameters, (2, 6), of a profile on a rectangle of pixels."""
    limits = np.empty((2, 6))
    # the place is free; ln radius, ln index, ellipticities
    for i in range(2):
        limits[0, i] = -np.inf
        limits[1, i] = np.inf
    limits[0, 2] = np.log(_LEAST_RADIUS)
    limits[1, 2] = np.log(max(white.shape[0], white.shape[1]))
    for i in range(2):
        limits[i, 3] = np.log(INDEX_RANGE[i])
    for i in range(4, 6):
        limits[0, i] = -_MOST_ELLIPTICITY
        limits[1, i] = _MOST_ELLIPTICITY
    return limits


@njit()
def _state(products, parameters, mean, precision):
    """Return chi^2 with the prior, the best light, and half of the second and (negative) first derivatives."""
    n, m = precision.shape[:2]
    k = 1 + m
    last = n * k
    power = np.empty((n, n))
    for s in range(n):
        for t in range(n):
            power[s, t] = products[s * k, t * k]
        # those without light have none
        power[s, s] += 1e-12 * power[s, s] + 1e-300
    # the light that fits best: linear least squares for given shapes
    flux = solve_factor(cholesky(power), products[last, :last:k])
    matrix = np.empty((last, last))
    slope = np.empty(last)
    chi2 = products[last, last]
    for i in range(last):
        # the gradient, and chi^2, with that light
        projection = products[i, last]
        slope[i] = projection
        for s in range(n):
            slope[i] -= products[i, s * k] * flux[s]
        if i % k == 0:
            chi2 -= flux[i // k] * (projection + slope[i])
    # columns are images of unit light: derivatives of the model to the shape are those times the light
    scale = np.ones(last)
    for i in range(last):
        if i % k:
            scale[i] = flux[i // k]
    for i in range(last):
        slope[i] *= scale[i]
        for j in range(last):
            matrix[i, j] = products[i, j] * scale[i] * scale[j]
    for s in range(n):
        for i in range(m):
            pull = 0.0
            row = s * k + 1 + i
            for j in range(m):
                pull += precision[s, i, j] * (parameters[s, j] - mean[s, j])
                matrix[row, s * k + 1 + j] += precision[s, i, j]
            chi2 += (parameters[s, i] - mean[s, i]) * pull
            slope[row] -= pull
    return chi2, flux, matrix, slope


@njit()
def _step(matrix, slope, parameters, limits, damping):
    """
    Calculate a damped Newton step of light and parameters, (n (1 + m),), and the gain in chi^2 without damping.

    Parameters that are at a limit, and would go beyond it, stay there (Bertsekas 1982, SIAM J. Control Optim. 20,
    221).
    """
    n, m = parameters.shape
    damped = matrix.copy()
    free_slope = slope.copy()
    for k in range(len(slope)):
        # Marquardt's damping of the diagonal
        damped[k, k] += damping * matrix[k, k]
    for s in range(n):
        for j in range(m):
            k = s * (1 + m) + 1 + j
            value = parameters[s, j]
            at_lower = value <= limits[0, j]
            at_upper = value >= limits[1, j]
            if (at_lower and slope[k] < 0.0) or (at_upper and slope[k] > 0.0):
                damped[k, :] = 0.0
                damped[:, k] = 0.0
                damped[k, k] = 1.0
                free_slope[k] = 0.0
    step = solve_factor(cholesky(damped), free_slope)
    gained = 0.0
    for k in range(len(slope)):
        gained += step[k] * free_slope[k]
    return step, gained


@njit()
def minimum(plan, table, white, inverse, squares, start, mean, precision, limits, steps, gain):
    """
    Fit the light and the first parameters of sources, with Gaussian priors, after Levenberg and Marquardt.

    Parameters
    ----------
    plan, table : `~miricigale.photometry._core.profile_images.Plan`, `~numpy.ndarray`
        As from `~miricigale.photometry._core.profile_images.make_plan` and
        `~miricigale.photometry._core.shapes.profile_table`.
    white, inverse : `~numpy.ndarray`, shape (h, w)
        Light over its noise, and the inverse of the noise, zero for pixels that do not count, of the rectangle
        of all squares.
    squares : int `~numpy.ndarray`, shape (n, 3)
        First x and y, and side, of the square that each source is drawn on; no side is larger than the plan's.
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
    """
    n, m = precision.shape[:2]
    k = 1 + m
    columns = np.zeros((n * k + 1, white.size))
    pixels = white.reshape(-1)
    for i in range(white.size):
        columns[n * k, i] = pixels[i]
    flux = np.zeros(n)
    matrix = np.zeros((n * k, n * k))
    for i in range(n * k):
        matrix[i, i] = 1.0
    slope = np.zeros(n * k)
    trial = start
    parameters = start
    chi2 = np.inf
    damping = 0.1
    while True:
        products = _products(plan, table, inverse, squares, trial, columns)
        state = _state(products, trial, mean, precision)
        if state[0] <= chi2:
            parameters = trial
            chi2, flux, matrix, slope = state
            if steps == 0:
                break
            steps -= 1
            damping = max(0.1 * damping, 1e-6)
        else:
            damping *= 10.0
            if damping >= 1e6:
                break
        step, gained = _step(matrix, slope, parameters[:, :m], limits, damping)
        trial = parameters.copy()
        for s in range(n):
            for j in range(m):
                # steps are limited to 1 in each parameter, and to the limits
                moved = trial[s, j] + min(max(step[s * k + 1 + j], -1.0), 1.0)
                trial[s, j] = min(max(moved, limits[0, j]), limits[1, j])
        if gained < gain:
            # so near the minimum everything is linear
            flux = flux.copy()
            for s in range(n):
                flux[s] += step[s * k]
            parameters = trial
            chi2 = chi2 - gained
            break
    factor = cholesky(matrix)
    # Laplace's approximation of the integral over all parameters
    evidence = -0.5 * (chi2 + log_determinant(factor))
    covariance = np.empty((n, k, k))
    least = flux[0]
    for s in range(n):
        least = min(least, flux[s])
    # without a positive matrix the evidence is no number
    if not (np.isfinite(evidence) and least > 0):
        return np.inf, flux, parameters, evidence, covariance, matrix
    joint_covariance = inverse_of(factor)
    for s in range(n):
        evidence += 0.5 * log_determinant(cholesky(precision[s]))
        for i in range(k):
            for j in range(k):
                covariance[s, i, j] = joint_covariance[s * k + i, s * k + j]
        # from flux to ln flux
        for i in range(k):
            covariance[s, 0, i] /= flux[s]
        for i in range(k):
            covariance[s, i, 0] /= flux[s]
    return chi2, flux, parameters, evidence, covariance, matrix


@njit(fastmath=FAST, forceinline=True)
def _image_products(quarters, inverse, white):
    """Sum the squares of the whitened image that `draw_quarters` hold alone, and its products with the data."""
    half = quarters.shape[2] - 1
    n_odd = quarters.shape[1] // 2
    power = 0.0
    projection = 0.0
    for row in range(2 * half + 1):
        i = abs(row - half)
        sign = np.float32(1.0 if row >= half else -1.0)
        noise = inverse[row]
        data = white[row]
        for j in range(half + 1):
            even = quarters[0, i, j] + sign * quarters[0, n_odd + i, j]
            odd = quarters[1, i, j] + sign * quarters[1, n_odd + i, j]
            right = (even + odd) * noise[half + j]
            left = (even - odd) * noise[half - j]
            if j == 0:
                # the middle counts once
                left = 0.0
            power += right * right + left * left
            projection += right * data[half + j] + left * data[half - j]
    return power, projection


@njit(fastmath=FAST, forceinline=True)
def _steepness(kx, ky, weight, curve):
    """Sum the squares of the slopes of an image over all pixels, by its transform and `frequencies_of`."""
    total = 0.0
    for i in range(curve.size):
        x = kx[i]
        y = ky[i]
        total += weight[i] * (x * x + y * y) * curve[i] * curve[i]
    return total


@njit()
def evidence_of(
    plan, table, white, inverse, squares, best, flux, shapes, drift, mean, precision, neighbors
):
    """
    Calculate likelihoods of shapes of a source, with the light, center and neighbors that fit best.

    Parameters
    ----------
    plan, table, white, inverse, squares
        As for `minimum`.
    best, flux : `~numpy.ndarray`, shapes (1, 6) and (1,)
        The best parameters and light.
    shapes : `~numpy.ndarray`, shape (k, 4)
        The shapes.
    drift : `~numpy.ndarray`, shape (k, 2)
        How far the best center of each shape is from that of the best shape.
    mean, precision : `~numpy.ndarray`, shapes (1, 6) and (1, 2, 2)
        The prior of the center.
    neighbors : `~numpy.ndarray`, shape (b, pixels)
        Whitened changes of the light of neighbors for each independent unit normal deviate.

    Returns
    -------
    likelihoods : `~numpy.ndarray`, shape (k, 2)
        Ln of the likelihood, integrated over a light that is flat in its logarithm, and ln flux; -1e9 and 0
        where no positive light fits.

    Notes
    -----
    The constraint on the center is that of the best shape, in proportion to the squares of the slopes of the
    images.
    """
    x0 = best[0, 0] - squares[0, 0]
    y0 = best[0, 1] - squares[0, 1]
    columns = np.empty((3, white.size))
    neighbor_data = np.zeros(len(neighbors))
    data = 0.0
    for row in white:
        data += _product(row, row)
    center = precision[0]
    log_prior = np.log(center[0, 0] * center[1, 1] - center[0, 1] ** 2)
    xx = 0.0
    xy = 0.0
    yy = 0.0
    likelihoods = np.zeros((len(shapes), 2))
    last_ny = 0
    last_nx = 0
    kx, ky, weight = plan.kx, plan.ky, plan.weight
    # the best one first, whose center is free
    for s in range(-1, len(shapes)):
        shape = best[0, 2:]
        if s >= 0:
            shape = shapes[s]
        profile = profile_of(table, shape[1])
        ny, nx = frequency_extent(plan, shape, profile[0])
        if ny != last_ny or nx != last_nx:
            kx, ky, weight = frequencies_of(plan, ny, nx)
            last_ny = ny
            last_nx = nx
        curves = np.empty((1, 2, ny, nx), np.float32)
        curve = curves.reshape(1, -1)
        fill_curves(kx, ky, shape, profile, curve)
        steepness = _steepness(kx, ky, weight, curve[0])
        x = x0
        y = y0
        n_moved = 1
        if s >= 0:
            x += drift[s, 0]
            y += drift[s, 1]
            n_moved = 0
        quarters = draw_quarters(plan, curves, x, y, n_moved, squares[0, 2])
        if s < 0 or len(neighbors):
            for i in range(1 + 2 * n_moved):
                whiten(quarters, i, inverse, 0, 0, columns[i])
        if s < 0:
            products = np.dot(columns, columns.T)
            if len(neighbors):
                # neighbors' light that was taken off is the best together with this one's
                shared = np.dot(columns, neighbors.T)
                for b in range(len(neighbors)):
                    neighbor_data[b] = flux[0] * shared[0, b]
                data -= _product(neighbor_data, neighbor_data)
                for i in range(3):
                    for j in range(3):
                        products[i, j] -= _product(shared[i], shared[j])
            own_x = products[1, 0]
            own_y = products[2, 0]
            power = max(products[0, 0], 1e-300)
            xx = (products[1, 1] - own_x * own_x / power) / steepness
            xy = (products[1, 2] - own_x * own_y / power) / steepness
            yy = (products[2, 2] - own_y * own_y / power) / steepness
            continue
        power, projection = _image_products(quarters, inverse, white)
        if len(neighbors):
            shared_light = np.dot(neighbors, columns[0])
            power -= _product(shared_light, shared_light)
            projection -= _product(shared_light, neighbor_data)
        likelihoods[s, 0] = -1e9
        if power > 0 and projection > 0:
            light = projection / power
            off_x = best[0, 0] + drift[s, 0] - mean[0, 0]
            off_y = best[0, 1] + drift[s, 1] - mean[0, 1]
            pull_x = center[0, 0] * off_x + center[0, 1] * off_y
            pull_y = center[0, 1] * off_x + center[1, 1] * off_y
            chi2 = data - light * projection + off_x * pull_x + off_y * pull_y
            # changes of the pixels with the center are in proportion to the light
            scale = light**2 * steepness
            det = (center[0, 0] + scale * xx) * (center[1, 1] + scale * yy)
            det -= (center[0, 1] + scale * xy) ** 2
            # Laplace's integral over center and light
            evidence = log_prior - chi2 - np.log(abs(det)) - np.log(power)
            likelihoods[s, 1] = np.log(light)
            likelihoods[s, 0] = 0.5 * evidence - likelihoods[s, 1]
    return likelihoods
