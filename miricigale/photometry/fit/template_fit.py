"""The fit of one image: all templates at once, with what they have in common."""

import typing

import numpy as np
import scipy.sparse
from scipy.signal import oaconvolve

from miricigale.photometry.images.arrays import pixel_scale
from miricigale.photometry.shapes.shapes import not_fitted
from miricigale.photometry.templates.free_templates import free_templates
from miricigale.photometry.templates.normal_equations import (
    LinearFit,
    normal_matrix,
    sandwich_matrix,
)
from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import PhotometryWarning, warn
from miricigale.utils.memory import return_freed_memory
from miricigale.utils.parallel import chunks
from miricigale.utils.units import ANGLE

#: Size of the covariance's blocks and of the margin around them, arcsec.
BLOCK_CORE = 18.0
BLOCK_HALO = 6.0


def fit_covariances(fit, correlation):
    """
    Calculate the covariances of a `TemplateFit`, with the correlation of the noise; None if that is white.

    Returns
    -------
    noise, template, psf : `~scipy.sparse.csr_array`, shape (n, n)
        Of the fitted rows: by the image's noise, by what is not known of the templates, and by the PSF, whose
        errors go together.
    common : `~numpy.ndarray`, shape (g, g)
        Of the common parameters.
    blending : `~numpy.ndarray`, shape (n,)
        Formal error over that of the source alone.
    """
    filling = None
    if correlation is not None:
        filling = _sandwich(fit, correlation)
    elif fit.free is not None:
        filling = fit.free.white_filling()
    noise, template, common, blending = row_covariances(fit, fit.bank.xy[fit.rows], filling)
    if len(fit.pairs):
        # that of the sum of two components
        first, second = np.searchsorted(fit.rows, fit.pairs.T)
        matrix = fit.fit.matrix
        middle = matrix
        if filling is not None:
            middle = filling[0]
        formal_error = np.sqrt(middle.diagonal()[: len(fit.rows)]) / matrix.diagonal()
        cross_terms = matrix_elements(noise, first, second)
        variance = noise.diagonal()
        blending[first] = (
            np.sqrt(variance[first] + variance[second] + 2 * cross_terms) / formal_error[first]
        )
        blending[second] = blending[first]
    parts = fit.bank.parts(np.arange(len(fit.flux)))
    return noise, template, psf_covariance(fit, parts, noise), common, blending


def row_covariances(fit, xy, filling):
    """
    Calculate the covariances of the fitted rows by noise and by errors of the templates.

    Parameters
    ----------
    fit : `TemplateFit` or `~miricigale.photometry.fit.exposure_fit.ExposureFit`
        The fit.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of the rows in pixels.
    filling : tuple or None
        Covariance of the right-hand side by noise: matrix, border, corner; None for the normal equations' own.

    Returns
    -------
    noise, template : `~scipy.sparse.csr_array`, shape (n, n)
    common : `~numpy.ndarray`, shape (g, g)
        Of the common parameters.
    blending : `~numpy.ndarray`, shape (n,)
        Formal error over that of the source alone.
    """
    n = len(fit.rows)
    changes = fit.free
    solution = fit.fit
    fillings = [filling]
    if changes is not None:
        solution = changes.fit
        xy = np.concatenate([xy, changes.xy])
        fillings.append(changes.filling(fit.fit.matrix))
    # elements for pairs of sources, not for their changes
    coo = fit.fit.matrix.tocoo()
    pattern = scipy.sparse.coo_array((coo.data, (coo.row, coo.col)), shape=solution.matrix.shape)
    covariances, blending = solution.covariances(
        xy, fillings, core=BLOCK_CORE / fit.scale, halo=BLOCK_HALO / fit.scale, pattern=pattern
    )
    noise, common = covariances[0]
    noise = noise[:n][:, :n]
    blending = blending[:n]
    template = scipy.sparse.csr_array((n, n))
    if changes is not None:
        blending = blending * np.sqrt(changes.remaining_power())
        template, change_common = covariances[1]
        template = template[:n][:, :n]
        common = common + change_common
    return noise, template, common, blending


def psf_covariance(fit, cutouts, noise):
    """
    Calculate the covariance of the fitted rows by the error of the PSF, which is fully correlated.

    ``cutouts`` are the templates of all rows, None for points; ``noise``, (n, n), has the pairs that are wanted.
    """
    is_image = [cutout is not None and cutout.kind == "cutout" for cutout in cutouts]
    error = psf_errors(fit, np.array(is_image, bool))[fit.rows]
    coo = noise.tocoo()
    data = error[coo.row] * error[coo.col]
    return scipy.sparse.coo_array((data, (coo.row, coo.col)), shape=noise.shape).tocsr()


def psf_errors(fit, image):
    """Return flux errors (uJy) of all rows due to that of the PSF; ``image``, (n,), says whose template is one."""
    settings = fit.settings.errors
    kernel = fit.settings.mean_kernel
    fraction = settings.psf_error
    if fraction is None:
        if settings.size_scatter is None:
            return np.zeros(len(fit.flux))
        fraction = image * np.max(np.abs(kernel.encircled_energy_error()))
    # power of a point source on the image's pixels: extended sources are less concerned
    point = np.sum(kernel.target**2) * (fit.scale / kernel.pixel_scale.to_value(ANGLE)) ** 2
    return fraction * np.minimum(fit.power / point, 1.0) * np.abs(fit.flux)


def _sandwich(fit, correlation):
    """Return the covariance of the right-hand side by correlated noise: matrix, border and corner."""
    keep = fit.rows
    white = list(map(fit.arrays.whitened, fit.columns))
    spread = [_spread(fit, image, correlation) for image in white]
    # what the diagnostics, and these transforms, have freed
    return_freed_memory()
    if fit.free is not None:
        # stamps are dropped where they are not needed any more, those of the changes first
        changes = fit.free.change_sandwich(fit, correlation, spread)
        return_freed_memory()
    middle, border = sandwich_matrix(fit.bank, fit.inverse_sigma, correlation, spread, last=True)
    return_freed_memory()
    middle = middle[keep][:, keep]
    border = border[keep]
    if fit.free is not None:
        middle, border = fit.free.sandwich(middle, border, changes)
    return middle, border, inner_products(white, spread)


def _spread(fit, image, correlation):
    """Convolve an image with the noise correlation."""
    kernel = correlation.astype(image.dtype)
    lag = correlation.shape[0] // 2
    out = fit.arrays.new()

    def convolve(part):
        rows = slice(max(part.start - lag, 0), part.stop + lag)
        convolved = oaconvolve(image[rows], kernel, mode="same")
        out[part] = convolved[part.start - rows.start :][: part.stop - part.start]

    fit.bank.map(convolve, chunks(len(image), 512))
    return out


#: Squared cosine between two components from which their sum alone is measured: errors of each are then
#: ten times that of the sum, and the difference is that of a template that is a few percent wrong.
_SEPARABLE = 0.99

#: Least part of a template's light on usable pixels: sources with less are not measured.
MIN_COVERAGE = 0.05
#: Largest share of a template's power that is its own noise and is taken off.
MAX_EXCESS = 0.5


class TemplateFit:
    """
    Least-squares fluxes of all templates of an image.

    Parameters
    ----------
    arrays : `~miricigale.photometry.images.arrays.FitArrays`
        The image.
    bank : `~miricigale.photometry.templates.templates.TemplateBank`
        The templates of the sources on or near it.
    settings : `~miricigale.photometry.ForcedPhotometer`
        How they are fitted.
    host : int `~numpy.ndarray`, shape (n,), optional
        For each source of the bank the one whose component it is: a second component has the
        number of that source, all others have their own.
    moved : `~numpy.ndarray`, shape (2,) or (n, 2), optional
        Pixels by which templates are moved; a shift that is fitted is searched from there.
    like : `~miricigale.photometry.templates.templates.TemplateBank`, optional
        A bank whose templates are taken where they are the same; it forgets its own.
    search : bool, optional
        Whether one shift of the image is fitted; if the settings ask for one by default.

    Attributes
    ----------
    scale : float
        Arcsec per pixel.
    bank, fit, free
        The templates where they were fitted; the solution (`LinearFit`, None without rows); that with
        templates that may change (`FreeTemplates` or None), whose fluxes are ``flux`` then.
    flux : `~numpy.ndarray`, shape (n,)
        uJy, in the order of the bank's rows as all that follows; zero where not fitted.
    rows : int `~numpy.ndarray`
        Rows that were fitted.
    degenerate, noisy, inseparable : bool `~numpy.ndarray`, shape (n,)
        Templates that equal another's; those whose power is mostly noise; second components that
        cannot be distinguished from the first.
    pairs : int `~numpy.ndarray`, shape (k, 2)
        Rows of the two components of the sources that have two.
    power, light : `~numpy.ndarray`, shape (n,) and (n, 2)
        Sums of squares of the templates; their fractions on the image, and on its usable pixels.
    columns : list of `~numpy.ndarray`
        The common parameters' images.
    places : dict of str to slice
        Where common parameters stand among ``columns`` and ``common``, by name: ``"background"`` and, where it is
        fitted, ``"shift"`` (x and y).
    shift, offset_map
        In arcsec, shape (2,), and the `OffsetMap` by which templates are moved; None without.
    evidence
        For a second pass (dict), where that was asked for; None otherwise.
    source_shifts : `~numpy.ndarray`, shape (n, 2)
        Pixels by which each source of the bank is moved beyond that; None without.
    """

    def __init__(self, arrays, bank, settings, *, host=None, moved=None, like=None, search=None):
        self.arrays = arrays
        self.settings = settings
        self.host = np.arange(len(bank.order)) if host is None else host
        self.scale = pixel_scale(arrays.wcs)
        self.inverse_sigma = arrays.inverse_sigma
        self._background = []
        if settings.background_order is not None:
            self._background = self.arrays.sky_columns(self.settings.background_order)
        self.shift = self.offset_map = self.free = self.source_shifts = self.evidence = None
        if moved is None:
            moved = np.zeros(2)
        self.bank = bank
        if np.any(moved):
            self.bank = bank.shifted(moved)
        if like is not None:
            self.bank.reuse(like)
        self._solve(self.bank, [])
        if search is None:
            search = settings.max_shift is not None and settings.offset_order is None
        if search and len(self.rows):
            self._find_shift(bank, moved)

    def _solve(self, bank, gradients):
        """Fit fluxes and common parameters with the templates of a bank."""
        if bank is not self.bank:
            self.bank.forget()
        self.bank = bank
        self.columns = list(self._background)
        self.places = {"background": slice(0, len(self.columns))}
        if gradients:
            self.places["shift"] = slice(len(self.columns), len(self.columns) + len(gradients))
            self.columns += gradients
        equations = BankEquations.of(self.arrays, bank, self.inverse_sigma, self.columns)
        # stamps over the noise, of which many were made and freed
        return_freed_memory()
        matrix = equations.matrix
        self.light = equations.light
        self.power = equations.power
        rows = (self.light[:, 1] >= MIN_COVERAGE) & (matrix.diagonal() > 0)
        self.noisy = equations.excess > MAX_EXCESS
        correction = scipy.sparse.diags_array(equations.correction)
        self.degenerate = duplicates(matrix, rows, bank.order)
        matrix = (matrix - correction).tocsr()
        self._find_pairs(matrix, rows & ~self.degenerate)
        # rows that can be fitted
        self.rows = np.flatnonzero(rows & ~self.degenerate & ~self.inseparable)
        matrix = matrix[self.rows][:, self.rows]
        self.fit = None
        self.flux = np.zeros(len(bank.order))
        if len(self.rows):
            rhs = equations.rhs[self.rows]
            border = equations.border[self.rows]
            corner = equations.corner
            self.fit = LinearFit(matrix, rhs, border, corner, equations.corner_rhs)
            self.flux[self.rows] = self.fit.flux

    def free_templates(self, fitted):
        """
        Let templates change as far as they are not known, and fit once more.

        ``fitted`` (`~miricigale.photometry.shapes.shapes.FITTED`, (k,)) is what is known of the bank's first
        sources; those after them are points.
        """
        if self.fit is None or self.settings.errors.size_scatter is None:
            return
        shapes = not_fitted(len(self.bank.order))
        shapes[: len(fitted)] = fitted
        # a point on top of a template leaves open how it is shaped, not whether it is a point
        hosts = self.host[self.bank.order[self.pairs[:, 1]]]
        shapes["point"][hosts] = 0.0
        # positions move no flux to first order, unless there are two components
        lone = np.setdiff1d(np.arange(len(shapes)), hosts)
        shapes["covariance"][lone, 1:3] = 0.0
        shapes["covariance"][lone, :, 1:3] = 0.0
        self.free = free_templates(self, shapes[self.bank.order[self.rows]])
        if self.free is not None:
            self.flux[self.rows] = self.free.flux

    def _find_pairs(self, matrix, rows):
        """Find the second components that can be fitted together with the first."""
        order = self.bank.order
        row = np.argsort(order)
        second = np.flatnonzero(self.host[order] != order)
        first = row[self.host[order[second]]]
        power = matrix.diagonal()
        # the squared cosine between the components
        overlap = matrix_elements(matrix, first, second)
        is_separable = overlap**2 < _SEPARABLE * power[first] * power[second]
        is_separable &= rows[first] & rows[second]
        self.inseparable = np.zeros(len(order), bool)
        self.inseparable[second[~is_separable]] = True
        self.degenerate[second] = False
        self.pairs = np.stack([first, second], axis=1)[is_separable]

    def _find_shift(self, unshifted, shift):
        limit = self.settings.max_shift.value / self.scale
        for _ in range(8):
            step = self._fit_step(unshifted.shifted(shift))
            total = shift + step
            if np.hypot(total[0], total[1]) > limit:
                msg = (
                    f"a shift of {np.round(total * self.scale, 3)} arcsec is beyond 'max_shift' "
                    f"{self.settings.max_shift}: measured without a shift"
                )
                warn(msg, PhotometryWarning)
                self._solve(unshifted, [])
                return
            if np.hypot(step[0], step[1]) < 1e-3:
                break
            shift = shift + np.clip(step, -1.0, 1.0)
        self.shift = total * self.scale

    def _fit_step(self, bank):
        """Fit with the templates of a bank and a small step of all of them: the step (x, y) in pixels."""
        # a small shift adds the model's gradient
        dy, dx = np.gradient(self.model())
        self._solve(bank, [-dx, -dy])
        return self.fit.common[self.places["shift"]]

    def include_shift(self, shift):
        """
        Fit once more with a shift about the one that the templates have, so that it has an error.

        Parameters
        ----------
        shift : `~numpy.ndarray`, shape (2,)
            Arcsec (x, y) by which the templates were moved.
        """
        if self.fit is not None:
            self.shift = shift + self._fit_step(self.bank) * self.scale

    def displacement(self, xy):
        """Return positions of templates less those of the catalog, (x, y) in pixels."""
        if self.offset_map is not None:
            x, y = xy.T
            return self.offset_map.field(x, y) / self.scale
        shift = np.zeros(2)
        if self.shift is not None:
            shift = self.shift / self.scale
        return np.broadcast_to(shift, xy.shape)

    @property
    def main(self):
        """Which rows are no second components, shape (n,)."""
        return self.host[self.bank.order] == self.bank.order

    @property
    def total(self):
        """Flux of each row, that of both components where there are two."""
        total = self.flux.copy()
        first, second = self.pairs.T
        total[first] += self.flux[second]
        return total

    @property
    def psf_width(self):
        """Rms width in pixels of a Gaussian as peaked as the image's PSF."""
        return gaussian_width(self.settings.mean_kernel) / self.scale

    @property
    def common(self):
        """The common parameters, shape (g,)."""
        solution = self.fit if self.free is None else self.free.fit
        return solution.common

    def add_background(self, image, factor=1.0):
        """Add the fitted background, in uJy per pixel, times a factor to an image in place."""
        if self.fit is None:
            return
        values = self.common[self.places["background"]]
        for column, value in zip(self._background, values, strict=True):
            image += np.float32(factor * value) * column

    def model(self):
        """Draw the sources' model in uJy per pixel, without background."""
        image = self.arrays.new()
        layers = [(self.bank, self.flux)]
        if self.free is not None:
            flux = np.zeros(len(self.flux))
            flux[self.rows], change = self.free.amplitudes
            layers = [(self.bank, flux), (self.free.bank, change)]
        for bank, flux in layers:
            bank.add_to(image, flux)
        return image

    def residual(self, model):
        """Subtract a model of the sources, and the background, from the image; zero where not usable."""
        residual = np.subtract(self.arrays.flux, model, out=self.arrays.new())
        self.add_background(residual, -1.0)
        residual[~self.arrays.usable] = 0.0
        return residual


class BankEquations(typing.NamedTuple):
    """Normal equations of the templates of a bank on an image, and of the common parameters."""

    matrix: object  # (n, n): Products of the templates, over the noise.
    rhs: np.ndarray  # (n,): With the image.
    border: np.ndarray  # (n, m): With the columns of the common parameters.
    corner: np.ndarray  # (m, m): Of these columns.
    corner_rhs: np.ndarray  # (m,): Of these with the image.
    light: np.ndarray  # (n, 2): Fractions of each template on the image, and on usable pixels.
    power: np.ndarray  # (n,): As of `normal_matrix`.
    excess: np.ndarray  # (n,): Noise of the templates over their power.

    @classmethod
    def of(cls, arrays, bank, inverse_sigma, columns):
        """Make those of the arrays of an image and the columns of its common parameters."""
        white = list(map(arrays.whitened, columns))
        data = arrays.whitened(arrays.flux)
        matrix, projection, power, light = normal_matrix(bank, inverse_sigma, [data] + white)
        with quiet_division():
            excess = bank.noise_terms() / np.where(power > 0, power, np.inf)
        return cls(
            matrix,
            projection[:, 0],
            projection[:, 1:],
            inner_products(white, white),
            inner_products(white, [data])[:, 0],
            light / bank.full_light()[:, None],
            power,
            excess,
        )

    @property
    def correction(self):
        """What the noise of the templates adds to the diagonal: errors in variables."""
        return np.minimum(self.excess, MAX_EXCESS) * self.matrix.diagonal()


def gaussian_width(kernel):
    """Return the rms width in arcsec of a Gaussian as peaked as the target of a kernel."""
    target = kernel.target
    width = np.sqrt(target.sum() / (2 * np.pi * target.max()))
    return width * kernel.pixel_scale.to_value(ANGLE)


def row_snr(fit):
    """Signal-to-noise of rows of a fit by their formal errors; 0 of those that are not fitted."""
    snr = np.zeros(len(fit.flux))
    snr[fit.rows] = fit.flux[fit.rows] * np.sqrt(fit.fit.matrix.diagonal())
    return snr


def inner(first, second):
    """Sum the products of two images, in double precision."""
    return float(np.einsum("ij,ij->", first, second, dtype=float, casting="same_kind"))


def inner_products(images, other_images):
    """Sum the products of each of n images with each of m others, shape (n, m)."""
    products = np.empty((len(images), len(other_images)))
    for i, first in enumerate(images):
        for j, second in enumerate(other_images):
            products[i, j] = inner(first, second)
    return products


def matrix_elements(matrix, rows, columns):
    """Return elements of a sparse matrix, shape (n,)."""
    elements = np.zeros(len(rows))
    for k, (row, column) in enumerate(zip(rows, columns, strict=True)):
        elements[k] = matrix[row, column]
    return elements


def duplicates(matrix, rows, order):
    """Find templates that equal another one's; the first in the catalog is kept."""
    coo = matrix.tocoo()
    scale = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    # the cosine between two templates is 1
    is_same = coo.data > (1 - 1e-6) * scale[coo.row] * scale[coo.col]
    is_same &= rows[coo.row] & rows[coo.col] & (order[coo.row] > order[coo.col])
    is_duplicate = np.zeros(len(rows), bool)
    is_duplicate[coo.row[is_same]] = True
    return is_duplicate
