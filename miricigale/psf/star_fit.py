"""A model PSF corrected by stars: a few terms by least squares, then what stars have in common beyond them."""

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from miricigale.psf import _core
from miricigale.utils.options import check_that
from miricigale.utils.values import value_class

#: Terms of a correction and the standard deviation of each by its prior: relative width of the core, its
#: elongation along the axes and the diagonals, and the light beyond some full widths at half maximum.
_BEYOND = (1, 2, 4, 8)
TERMS = dict.fromkeys(["width", "elongation", "diagonal"] + [f"wings_{n}" for n in _BEYOND], 0.1)

#: How many of the terms may change over the field; standard deviations of all terms, and of their changes from the
#: middle of the field to its edges; deviation of single cells, as a fraction of the light about them.
_SLOPED = 3
_CELLS = 0.1
_SPREAD = np.array(list(TERMS.values()) + [0.05] * (2 * _SLOPED))

#: Least number of stars that are left out one by one (of fewer, halves are), with which changes over the field and
#: single cells are tried; how much smaller chi-square must be of what was left out, and as a part of it: less may
#: come from the wings of neighbors.
WHOLE = 3
_FIELD = 6
_EFFECTIVE = 3
_EVIDENCE = 9.0
_PART = 1e-3

#: Deviation of a star from any PSF, as a fraction of its light in a pixel; steps of the fit.
_SCATTER = 0.02
_STEPS = 5


@value_class
class Star:
    """
    Pixels of a star, each array of shape (ny, nx): its light, the error (infinite for pixels that do not count),
    and the distance from its catalog position in cells of the PSF.

    ``place`` is where it is in the field, -1 to 1 along each axis, ``area`` that of a pixel in cells.
    """

    data: np.ndarray
    sigma: np.ndarray
    u: np.ndarray
    v: np.ndarray
    place: tuple = (0.0, 0.0)
    area: float = 1.0

    def halves(self):
        """Return two stars, each with every other octant about its position."""
        odd = np.floor(np.arctan2(self.v, self.u) * (4 / np.pi)).astype(int) % 2 == 1
        sigmas = [np.where(part, np.inf, self.sigma) for part in (odd, ~odd)]
        return [dataclasses.replace(self, sigma=sigma) for sigma in sigmas]


def derivatives(psf, fwhm):
    """How a PSF, (n, n), changes with each of `TERMS` at constant light, shape (k, n, n); ``fwhm`` in cells."""
    xx = np.gradient(np.gradient(psf, axis=1), axis=1)
    yy = np.gradient(np.gradient(psf, axis=0), axis=0)
    variance = (fwhm / 2.3548) ** 2
    axis = np.arange(len(psf)) - len(psf) // 2
    place = np.log(np.maximum(np.hypot(axis, axis[:, None]), 0.1) / fwhm)
    cross = np.gradient(np.gradient(psf, axis=0), axis=1)
    wings = (
        np.clip(1.0 + (place - log_radius) / np.log(2.0), 0.0, 1.0)
        for log_radius in np.log(_BEYOND)
    )
    core = variance * (xx + yy), 0.5 * variance * (xx - yy), variance * cross
    changes = np.stack([*core, *(psf * log_radius for log_radius in wings)])
    light = changes.sum(axis=(1, 2))
    # what lies beyond the grid is wings too
    light[-len(_BEYOND) :] += 1.0 - psf.sum()
    return changes - light[:, None, None] * psf


class FittedStar:
    """
    A star with a PSF: flux, offset and background are fitted, what all stars have in common is not.

    Its arrays are of the pixels that count.

    ``images``, (n, n, 3 + k), are spline coefficients of the PSF, of its derivatives by x and y, and of its
    changes by the terms. The first of these change by ``slope``, (3, 2), over the field. ``offset`` is that of the
    center in cells.
    """

    def __init__(self, star, offset, images, slope):
        at, light, dx, dy, *terms = _splines_at(star, offset, images)
        light = light + (slope @ star.place) @ terms[:_SLOPED]
        columns, weight, solution = _solution(star, light, dx, dy)
        use = np.isfinite(star.sigma)
        data = star.data[use]
        sigma = star.sigma[use]
        flux = solution[0]
        self.star = star
        self.at = at
        self.flux = flux
        self.weight = weight
        self.offset = offset + _shift(solution)
        self.residual = data - columns @ solution
        #: What a change of the PSF by 1 is in each weighted pixel.
        self.scale = flux * star.area * weight
        self._basis = np.linalg.qr(columns * weight[:, None])[0]
        self._open_residual = self._without_own(self.residual * weight)
        sloped = np.multiply.outer(star.place, terms[:_SLOPED]).reshape(-1, data.size)
        self.columns = self._without_own((self.scale * np.concatenate([terms, sloped])).T)
        self.normal = self.columns.T @ self.columns
        self.right = self.columns.T @ self._open_residual
        light = np.maximum(light, 0.0)
        self.chi2 = float(light @ (self.residual * weight) ** 2 / light.sum())
        self.snr = flux * np.sqrt(np.sum((columns[:, 0] / sigma) ** 2))

    @property
    def dof(self):
        """Degrees of freedom of its chi-square: pixels less its own parameters."""
        return self.weight.size - self._basis.shape[1]

    @property
    def width(self):
        """Width of the core relative to the PSF's, less 1, and its error."""
        power = max(self.normal[0, 0], 1e-30)
        return self.right[0] / power, power**-0.5

    def _without_own(self, values):
        """Return what the star's own parameters leave of weighted pixels."""
        return values - self._basis @ (self._basis.T @ values)

    def misfit(self, change=0.0):
        """Return the chi-square if the weighted pixels of the model change by this."""
        return float(np.sum(self._without_own(self._open_residual - change) ** 2))


def _splines_at(star, offset, images):
    """Return the places of a star's pixels that count, (2, n), and splines of images (ny, nx, k) there."""
    half = len(images) // 2
    use = np.isfinite(star.sigma)
    at = (star.v[use] - offset[1] + half, star.u[use] - offset[0] + half)
    return at, *_core.cubic_splines(images, *at)


def _solution(star, light, dx, dy):
    """Fit flux, flux times shifts, and background: columns (n, 4) of the fit, weights of pixels, solution (4,)."""
    use = np.isfinite(star.sigma)
    data = star.data[use]
    sigma = star.sigma[use]
    columns = star.area * np.stack([light, -dx, -dy, np.ones_like(light)], axis=1)
    weight = 1.0 / sigma
    for _ in range(2):
        solution = np.linalg.lstsq(columns * weight[:, None], data * weight)[0]
        weight = 1.0 / np.hypot(sigma, _SCATTER * solution[0] * columns[:, 0])
    return columns, weight, solution


def _shift(solution):
    """Return the shift of a star's center in cells, one at most, (2,)."""
    flux = solution[0]
    # the shifts are in units of the flux
    shift = solution[1:3] / (flux if flux > 0 else np.inf)
    return np.clip(shift, -1, 1)


def _moved(star, offset, images, slope):
    """
    Return the offset of a star's center after a step, as `FittedStar` has it, and nothing else.

    ``images`` are the first of its own, without changes by terms if ``slope`` is zero.
    """
    _, light, dx, dy, *terms = _splines_at(star, offset, images)
    if terms:
        light = light + (slope @ star.place) @ terms
    return offset + _shift(_solution(star, light, dx, dy)[-1])


def fitted_stars(psf, stars, *, slope=None, offsets=None, steps=_STEPS):
    """
    Fit stars one by one.

    Parameters
    ----------
    psf : `~numpy.ndarray`, shape (n, n)
        The PSF in the middle of the field.
    stars : sequence of `Star`
        The stars.
    slope : `~numpy.ndarray`, shape (3, 2), optional
        How the first of `TERMS` change over the field.
    offsets : sequence of `~numpy.ndarray`, optional
        Where their centers stand at first; by default at the catalog positions.
    steps : int, optional
        Number of steps of each center.

    Returns
    -------
    fits : list of `FittedStar`
    """
    fwhm = _core.half_maximum_width(psf, len(psf) // 2, len(psf) // 2)
    images = [psf, *np.gradient(psf)[::-1], *derivatives(psf, fwhm)]
    images = np.stack([spline_filter(image) for image in images], axis=-1)
    if slope is None:
        slope = np.zeros((_SLOPED, 2))
    if offsets is None:
        offsets = np.zeros((len(stars), 2))
    # all steps but the last need the light and its derivatives alone
    n_images = 3
    if slope.any():
        n_images += _SLOPED
    first_images = np.ascontiguousarray(images[..., :n_images])
    fits = []
    for star, offset in zip(stars, offsets, strict=True):
        for _ in range(steps - 1):
            offset = _moved(star, offset, first_images, slope)
        fits.append(FittedStar(star, offset, images, slope))
    return fits


class StarPSF:
    """
    A PSF corrected by stars, as far as what is left out of the fit confirms it.

    Parameters
    ----------
    psf : `~numpy.ndarray`, shape (n, n), n odd
        The model, centered; its sum is the fraction of all light.
    stars : sequence of `Star`
        At least one.
    least : int, optional
        Number of stars below which the model is not corrected.

    Attributes
    ----------
    kind : str
        ``"model"`` (not corrected), ``"terms"``, ``"field"`` (terms that change over the field) or
        ``"effective"`` (single cells too).
    chi2 : dict of str to float
        Chi-square of what was left out, by kind; of ``"model"`` alone if no correction was tried.
    dof : int
        Degrees of freedom of these: pixels less flux, position and background of each star.
    terms, terms_err : `~numpy.ndarray`, shape (k,)
        Corrections of `TERMS` in the middle of the field, zero if it is not corrected, and their errors.
    error : float
        Relative error of a point source's flux by that of the PSF.
    before, after : list of `FittedStar`
        The stars with the model and with the corrected PSF.

    Notes
    -----
    Flux, position and background of each star are projected out, so that stars are left out by taking away
    their normal equations. Single cells are the mean of the residuals, weighted by noise and prior.

    References
    ----------
    Anderson & King 2000, PASP 112, 1360 (effective PSFs from residuals).
    """

    def __init__(self, psf, stars, least=1):
        stars = list(stars)
        check_that(stars, "stars", "at least one star", "none")
        self._model = psf
        half = len(psf) // 2
        self._fwhm = _core.half_maximum_width(psf, half, half)
        # of few stars each one counts as two, of which one is left out
        if len(stars) >= WHOLE:
            units = stars
        else:
            units = [half for star in stars for half in star.halves()]
        self.kind = "model"
        self._cells = 0.0
        self._state = np.zeros(len(_SPREAD))
        self.before = self._fitted(stars)
        fits, without, inverse = self._solved(units, 0)
        self.chi2 = {"model": sum(fit.misfit() for fit in fits)}
        self.dof = sum(fit.dof for fit in fits)
        for kind, n, k in (("terms", 1, len(TERMS)), ("field", _FIELD, len(_SPREAD))):
            if len(stars) < max(n, least):
                continue
            state_before = self._state
            kind_fits, kind_without, kind_inverse = self._solved(units, k)
            # each star is judged by the correction that the others ask for
            chi2 = 0.0
            for fit, step in zip(kind_fits, kind_without, strict=True):
                chi2 += fit.misfit(fit.columns @ step)
            if self._better(kind, chi2):
                fits = kind_fits
                without = kind_without
                inverse = kind_inverse
            else:
                self._state = state_before
        image = self.at()
        changes = np.tensordot(without[:, : len(TERMS)], derivatives(image, self._fwhm), 1)
        if self.kind != "model" and len(stars) >= _EFFECTIVE:
            common, cells = self._common_cells(fits, image)
            chi2 = 0.0
            for fit, cells_of_others in zip(fits, cells, strict=True):
                chi2 += fit.misfit(fit.scale * map_coordinates(cells_of_others, fit.at))
            if self._better("effective", chi2):
                self._cells = common
                changes = changes + cells - common
        self.after = self._fitted(stars)
        self.terms = self._state[: len(TERMS)]
        self.terms_err = np.sqrt(np.diag(inverse))
        matched = self.at() / np.sum(self.at() ** 2)
        slope = np.tensordot(derivatives(self.at(), self._fwhm), matched)
        scatter = (len(units) - 1) * np.var(np.tensordot(changes, matched))
        self.error = np.sqrt(slope @ inverse @ slope + scatter)

    def at(self, place=(0.0, 0.0), model=None):
        """
        Return the corrected PSF at a place of the field, shape (n, n).

        Parameters
        ----------
        place : tuple of float, optional
            -1 to 1 along each axis; the middle by default.
        model : `~numpy.ndarray`, shape (n, n), optional
            Another PSF that is corrected alike.

        Returns
        -------
        psf : `~numpy.ndarray`, shape (n, n)
        """
        terms = self._state[: len(TERMS)]
        image = model
        if model is None:
            image = self._model
        # in steps, since changes are linear for small ones
        for _ in range(_STEPS if terms.any() else 0):
            image = image + np.tensordot(terms / _STEPS, derivatives(image, self._fwhm), 1)
        terms_at_place = self.slope @ place
        if terms_at_place.any():
            image = image + np.tensordot(
                terms_at_place, derivatives(image, self._fwhm)[:_SLOPED], 1
            )
        return image + self._cells

    @property
    def slope(self):
        """Changes of the first terms over the field, shape (3, 2)."""
        return self._state[len(TERMS) :].reshape(2, _SLOPED).T

    def _fitted(self, stars, offsets=None, steps=_STEPS):
        return fitted_stars(self.at(), stars, slope=self.slope, offsets=offsets, steps=steps)

    def _solved(self, units, k):
        """Fit the first k terms: the stars, steps of terms where each is left out, covariance of `TERMS`."""
        self._state = np.zeros(len(_SPREAD))
        offsets = np.zeros((len(units), 2))
        prior = np.diag(_SPREAD**-2.0)
        fitted_terms = np.ix_(np.arange(k), np.arange(k))
        inverse = np.zeros_like(prior)

        def step(normal, right):
            inverse[fitted_terms] = np.linalg.inv((normal + prior)[fitted_terms])
            return inverse @ (right - prior @ self._state)

        n_rounds = _STEPS + 1
        steps = 1
        if k == 0:
            # nothing that the stars have in common changes between the steps
            n_rounds = 1
            steps = _STEPS + 1
        for last in np.arange(n_rounds) == n_rounds - 1:
            fits = self._fitted(units, offsets, steps)
            offsets = [fit.offset for fit in fits]
            normal = sum(fit.normal for fit in fits)
            right = sum(fit.right for fit in fits)
            if not last:
                self._state = self._state + step(normal, right)
        without = np.array([step(normal - fit.normal, right - fit.right) for fit in fits])
        step(normal, right)
        return fits, without, inverse[: len(TERMS), : len(TERMS)].copy()

    def _better(self, kind, chi2):
        """Tell whether a kind of correction is confirmed, which is then the kind."""
        self.chi2[kind] = chi2
        chi2_before = self.chi2[self.kind]
        better = chi2 < chi2_before - max(_EVIDENCE, _PART * chi2_before)
        if better:
            self.kind = kind
        return better

    def _common_cells(self, fits, image):
        """Return what the residuals have in common by cell, and that without each of the stars."""
        shape = image.shape
        sums = []
        for fit in fits:
            corner = np.floor(fit.at).astype(int)
            part = fit.at - corner
            inside = np.all((corner >= 0) & (corner < shape[0] - 1), axis=0)
            pair = np.zeros((2, image.size))
            for dy, dx in np.ndindex(2, 2):
                share = np.abs(1 - dy - part[0]) * np.abs(1 - dx - part[1])
                cell = np.ravel_multi_index((corner + [[dy], [dx]])[:, inside], shape)
                weight = (share * fit.scale**2)[inside]
                values = fit.residual[inside] / (fit.flux * fit.star.area)
                pair[0] += np.bincount(cell, weight * values, image.size)
                pair[1] += np.bincount(cell, weight, image.size)
            sums.append(pair.reshape((2,) + shape))
        # a PSF that ends within its grid is 0 beyond
        light = np.maximum(gaussian_filter(image, self._fwhm / 2.3548), 1e-9 * image.max())
        prior = (_CELLS * light) ** -2.0
        total = np.sum(sums, axis=0)

        def mean_change(values, weight):
            """Return the weighted mean of the residuals by cell, at constant light."""
            mean = values / (weight + prior)
            return mean - mean.sum() * image

        without_each = []
        for left_out in sums:
            without_each.append(mean_change(total[0] - left_out[0], total[1] - left_out[1]))
        return mean_change(total[0], total[1]), np.array(without_each)
