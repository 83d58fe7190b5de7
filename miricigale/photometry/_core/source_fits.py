"""The fit of a source in one call: its Sersic profile, shapes about that, a point, and their probabilities."""

import numpy as np

from miricigale.photometry._core.dense import cholesky, solve_factor
from miricigale.photometry._core.shape_fits import evidence_of, minimum, parameter_limits
from miricigale.utils.compilation import njit

#: Ln radius (pixels) of what is drawn as a point.
POINT_SIZE = -30.0

#: Half-width (pixels) of the stamps, least and most, and in half-light radii.
LEAST_HALF = 16
_MOST_HALF = 48
_REACH = 4.0

#: Gain in chi^2 below which a fit ends.
GAIN = 0.1

#: Width of the density of the shapes that are looked at, over that of the normal distribution about the best.
_WIDER = 1.4

#: Excess of chi^2 over twice the evidence of the profile that rules a point out at once.
_FAR_BELOW = 200.0


@njit()
def half_width(parameters):
    """Return the half-width (pixels) of the stamp that a profile, (6,), is fitted on."""
    radius = np.exp(parameters[2] + 0.5 * np.sqrt(parameters[4] ** 2 + parameters[5] ** 2))
    return int(min(max(np.ceil(_REACH * radius), LEAST_HALF), _MOST_HALF))


@njit()
def cut_out(data, weight, means, half_widths):
    """
    Cut out the squares of pixels about the positions of sources, in the rectangle of all of them.

    Parameters
    ----------
    data, weight : `~numpy.ndarray`, shape (ny, nx)
        Light, and the inverse of its noise.
    means : `~numpy.ndarray`, shape (n, 6)
        Parameters whose first two are the positions, x and y.
    half_widths : int `~numpy.ndarray`, shape (n,)
        Pixels to either side of the middle one.

    Returns
    -------
    squares : int `~numpy.ndarray`, shape (n, 3)
        First x and y, and side, of each square.
    white, inverse : `~numpy.ndarray`, shape (h, w)
        Light over its noise, and the inverse of the noise; zero outside of the squares and of the data.
    """
    n = len(means)
    squares = np.empty((n, 3), np.int64)
    for s in range(n):
        squares[s, 0] = int(np.rint(means[s, 0])) - half_widths[s]
        squares[s, 1] = int(np.rint(means[s, 1])) - half_widths[s]
        squares[s, 2] = 2 * half_widths[s] + 1
    x0 = squares[0, 0]
    y0 = squares[0, 1]
    x1 = x0
    y1 = y0
    for s in range(n):
        x0 = min(x0, squares[s, 0])
        y0 = min(y0, squares[s, 1])
        x1 = max(x1, squares[s, 0] + squares[s, 2])
        y1 = max(y1, squares[s, 1] + squares[s, 2])
    white = np.zeros((y1 - y0, x1 - x0))
    inverse = np.zeros((y1 - y0, x1 - x0))
    for s in range(n):
        first_x = squares[s, 0]
        first_y = squares[s, 1]
        for y in range(max(first_y, 0), min(first_y + squares[s, 2], data.shape[0])):
            for x in range(max(first_x, 0), min(first_x + squares[s, 2], data.shape[1])):
                white[y - y0, x - x0] = data[y, x] * weight[y, x]
                inverse[y - y0, x - x0] = weight[y, x]
    return squares, white, inverse


@njit()
def _shapes_about(best, factor, covariance, normal, limits):
    """
    Draw shapes about the best from a normal distribution wider than that of the fit.

    ``best`` are its parameters, (6,), ``factor`` is Cholesky's of the covariance of its shape, (4, 4),
    ``covariance`` that of ln flux and parameters, (7, 7), and ``normal`` are independent unit deviates, (k, 4).

    Returns the shapes, (k, 4), the drift of their centers, (k, 2), and ln of the density that they are drawn from.
    """
    n = len(normal)
    shapes = np.empty((n, 4))
    drift = np.zeros((n, 2))
    density = np.empty(n)
    # the center moves with the shape as their covariance says
    with_x = np.empty(4)
    with_y = np.empty(4)
    for i in range(4):
        with_x[i] = covariance[3 + i, 1]
        with_y[i] = covariance[3 + i, 2]
    along_x = solve_factor(factor, with_x)
    along_y = solve_factor(factor, with_y)
    log_volume = 4 * np.log(_WIDER) + 2 * np.log(2 * np.pi)
    for i in range(4):
        log_volume += np.log(factor[i, i])
    for k in range(n):
        square = 0.0
        for i in range(4):
            change = 0.0
            for j in range(i + 1):
                change += _WIDER * factor[i, j] * normal[k, j]
            square += normal[k, i] ** 2
            value = best[2 + i] + change
            if i < 2:
                value = min(max(value, limits[0, 2 + i]), limits[1, 2 + i])
            shapes[k, i] = value
            drift[k, 0] += (value - best[2 + i]) * along_x[i]
            drift[k, 1] += (value - best[2 + i]) * along_y[i]
        density[k] = -0.5 * square - log_volume
    return shapes, drift, density


@njit()
def _odds(nodes, as_point, mean, precision, log_det, part_of_points):
    """Calculate the probabilities of nodes and of a point as `Population.odds` does, for one source."""
    n = len(nodes)
    odds = np.empty(n)
    point = as_point + np.log(part_of_points)
    most = point
    for k in range(n):
        chi2 = log_det
        for i in range(4):
            pull = 0.0
            for j in range(4):
                pull += precision[2 + i, 2 + j] * (nodes[k, 2 + j] - mean[2 + j])
            chi2 += (nodes[k, 2 + i] - mean[2 + i]) * pull
        # likelihood times prior over the density of the nodes
        odds[k] = nodes[k, 0] - 0.5 * chi2 + np.log((1.0 - part_of_points) / n)
        most = max(most, odds[k])
    point = np.exp(point - most)
    total = point
    for k in range(n):
        odds[k] = np.exp(odds[k] - most)
        total += odds[k]
    for k in range(n):
        odds[k] /= total
    return odds, point / total


@njit()
def _mean_shape(nodes, odds, best, covariance, flux_variance):
    """
    Calculate the mean light, shape and their covariance of nodes of given probabilities.

    The center, and its covariance, are those of the best profile, (6,) and (7, 7); ``flux_variance`` is that of ln
    flux with a given shape.
    """
    n = len(nodes)
    total = 0.0
    for k in range(n):
        total += odds[k]
    # ln flux and shape
    mean = np.zeros(5)
    moments = np.zeros((5, 5))
    part = np.empty(n)
    for k in range(n):
        part[k] = 1.0 / n
        if total > 0.0:
            part[k] = odds[k] / total
        for i in range(5):
            mean[i] += part[k] * nodes[k, 1 + i]
    for k in range(n):
        for i in range(5):
            off = part[k] * (nodes[k, 1 + i] - mean[i])
            for j in range(5):
                moments[i, j] += off * (nodes[k, 1 + j] - mean[j])
    moments[0, 0] += flux_variance
    parameters = best.copy()
    joint = np.zeros((7, 7))
    for i in range(2):
        for j in range(2):
            joint[1 + i, 1 + j] = covariance[1 + i, 1 + j]
    for i in range(5):
        row = 0 if i == 0 else 2 + i
        if i > 0:
            parameters[1 + i] = mean[i]
        for j in range(5):
            column = 0 if j == 0 else 2 + j
            joint[row, column] = moments[i, j]
    return np.exp(mean[0]), parameters, joint


@njit()
def fit_source(
    plan, table, white, inverse, squares, starts, mean, precision, log_det, part_of_points, changes,
    normal, steps,
):  # fmt: skip
    """
    Fit a Sersic profile and a point to a source, and calculate how probable each is.

    Parameters
    ----------
    plan, table, white, inverse, squares
        As for `~miricigale.photometry._core.shape_fits.minimum`.
    starts : `~numpy.ndarray`, shape (n, 6)
        Parameters of which the best is the one to begin with.
    mean, precision : `~numpy.ndarray`, shapes (1, 6) and (1, 6, 6)
        Of the prior, and the inverse of its covariance.
    log_det : float
        Ln of the determinant of 2 pi times the covariance of the prior of the shape.
    part_of_points : float
        Probability of a point beforehand.
    changes : `~numpy.ndarray`, shape (b, pixels)
        Whitened changes of the light of neighbors for each independent unit normal deviate.
    normal : `~numpy.ndarray`, shape (k, 4)
        Independent unit normal deviates of the shapes that are looked at; without any the best profile is the
        result.
    steps : int
        Largest number of steps of each fit.

    Returns
    -------
    found : bool
        Whether a profile of positive light fits.
    is_wider : bool
        Whether the profile found needs a wider stamp, if several were tried: parameters are all that is known.
    flux, parameters, covariance : float, `~numpy.ndarray`, shapes (6,) and (7, 7)
        Total light and parameters, and the covariance of ln flux and parameters: their mean over all shapes.
    nodes : `~numpy.ndarray`, shape (k, 6)
        Ln of the likelihood over the density of the shapes, ln flux, and the shapes.
    as_point, point : float
        Ln of the likelihood of a point, and its probability.
    """
    limits = parameter_limits(white)
    # constants would each have a kernel compiled for them
    no_steps = 0 * steps
    fixed = np.empty((1, 0, 0))
    no_nodes = np.empty((0, 6))
    # the best of some sizes to begin with
    start = starts[:1]
    if len(starts) > 1:
        least = np.inf
        for s in range(len(starts)):
            trial = starts[s : s + 1]
            misfit = minimum(
                plan, table, white, inverse, squares, trial, trial, fixed, limits, no_steps, GAIN
            )[0]
            if misfit < least:
                least = misfit
                start = trial
    chi2, fluxes, bests, evidence, covariances, matrix = minimum(
        plan, table, white, inverse, squares, start, mean, precision, limits, steps, GAIN
    )
    flux = fluxes[0]
    best = bests[0]
    covariance = covariances[0]
    if not np.isfinite(chi2):
        return False, False, flux, best, covariance, no_nodes, -np.inf, 0.0
    if len(starts) > 1 and 2 * half_width(best) + 1 > squares[0, 2]:
        return True, True, flux, best, covariance, no_nodes, -np.inf, 0.0
    if len(normal) == 0:
        return True, False, flux, best, covariance, no_nodes, -np.inf, 0.0
    # what else the source may be: shapes about the best
    factor = cholesky(covariance[3:, 3:].copy())
    if not np.isfinite(factor[3, 3]):
        return False, False, flux, best, covariance, no_nodes, -np.inf, 0.0
    shapes, drift, density = _shapes_about(best, factor, covariance, normal, limits)
    prior_of_center = precision[:, :2, :2].copy()
    likelihoods = evidence_of(
        plan,
        table,
        white,
        inverse,
        squares,
        bests,
        fluxes,
        shapes,
        drift,
        mean,
        prior_of_center,
        changes,
    )
    nodes = np.empty((len(normal), 6))
    for k in range(len(normal)):
        nodes[k, 0] = likelihoods[k, 0] - density[k]
        nodes[k, 1] = likelihoods[k, 1]
        for i in range(4):
            nodes[k, 2 + i] = shapes[k, i]
    # and a point; one that is far worse in the same place need not be moved to the best one
    as_point = -np.inf
    point_start = bests.copy()
    point_start[0, 2] = POINT_SIZE
    misfit = minimum(
        plan,
        table,
        white,
        inverse,
        squares,
        point_start,
        point_start,
        fixed,
        limits,
        no_steps,
        GAIN,
    )[0]
    if misfit < -2 * evidence + _FAR_BELOW:
        misfit, point_fluxes, _, point_evidence, _, _ = minimum(
            plan,
            table,
            white,
            inverse,
            squares,
            point_start,
            mean,
            prior_of_center,
            limits,
            steps,
            GAIN,
        )
        if np.isfinite(misfit):
            as_point = point_evidence - np.log(point_fluxes[0])
    odds, point = _odds(nodes, as_point, mean[0], precision[0], log_det, part_of_points)
    # the light of a given shape: the inverse of what the matrix says, in ln flux
    flux_variance = 1.0 / (flux**2 * matrix[0, 0])
    flux, parameters, covariance = _mean_shape(nodes, odds, best, covariance, flux_variance)
    return True, False, flux, parameters, covariance, nodes, as_point, point
