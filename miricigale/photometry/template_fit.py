"""The fit of one image: all templates at once, with what they have in common."""

import dataclasses
import warnings

import astropy.units as u
import numpy as np
import scipy.sparse
from scipy.signal import oaconvolve

from miricigale.photometry import _core
from miricigale.photometry.arrays import pixel_scale
from miricigale.photometry.errors import (
    LinearFit,
    noise_correlation,
    normal_matrix,
    sandwich_matrix,
)
from miricigale.photometry.fields import legendre_terms
from miricigale.photometry.free_templates import free_templates
from miricigale.photometry.shapes import not_fitted
from miricigale.photometry.template_changes import TemplateChanges
from miricigale.utils.exceptions import MiricigaleWarning
from miricigale.utils.parallel import chunks
from miricigale.utils.units import ANGLE

__all__ = ["Covariances", "FitSettings", "TemplateFit"]

#: Size of the covariance's blocks and of the margin around them.
_CORE, _HALO = 18.0 * u.arcsec, 6.0 * u.arcsec

#: Squared cosine between two components from which their sum alone is measured: errors of each are then
#: ten times that of the sum, and a template that is a few percent wrong says all of the difference.
_SEPARABLE = 0.99


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class FitSettings:
    """
    How an image is fitted; see `~miricigale.photometry.ForcedPhotometer`.

    Attributes
    ----------
    kernel : `~miricigale.psf.MatchingKernel`
        Its target is the image's PSF.
    template : str
        What sources look like.
    fit_background : bool
        Whether a constant is fitted.
    max_shift : `~astropy.units.Quantity` or None
        Largest shift of the image; None for none.
    offset_order : int or None
        Order of a map of offsets; None for one shift.
    background_order : int
        Order of the background, 0 for a constant.
    correlated_noise : bool
        Whether errors are those of the measured correlation of the noise.
    min_coverage : float
        Least fraction of a template's light on usable pixels.
    radius : float
        Half-width in arcsec to which templates are cut, or infinity.
    components : int
        1, or 2 for a point on top of the templates of poor fits.
    second_pass : bool
        Whether peaks of the residual are fitted with the sources.
    size_scatter : float or None
        Standard deviation of ln size between the bands; None for templates without error.
    psf_error : float or None
        Error of a point source's flux by that of the PSF; None for that of the kernel.
    positive : bool
        Whether fluxes that are not negative are found too.
    """

    kernel: object
    template: str = "auto"
    fit_background: bool = False
    max_shift: u.Quantity | None = None
    offset_order: int | None = None
    background_order: int = 0
    correlated_noise: bool = True
    min_coverage: float = 0.05
    radius: float = np.inf
    components: int = 1
    second_pass: bool = False
    size_scatter: float | None = None
    psf_error: float | None = None
    positive: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Covariances:
    """
    Errors of the fitted rows.

    Attributes
    ----------
    noise, template : sparse array, shape (n, n)
        By the image's noise, and by what is not known of the templates.
    psf : `~numpy.ndarray`, shape (n,)
        Errors by the PSF, which is the same for all.
    common : `~numpy.ndarray`, shape (g, g)
        Of the common parameters.
    blending : `~numpy.ndarray`, shape (n,)
        Formal error over that of the source alone.
    """

    noise: object
    template: object
    psf: np.ndarray
    common: np.ndarray
    blending: np.ndarray


class TemplateFit:
    """
    Least-squares fluxes of all templates of an image.

    Parameters
    ----------
    arrays : `~miricigale.photometry.arrays.FitArrays`
        The image.
    bank : `~miricigale.photometry.templates.TemplateBank`
        The templates of the sources on or near it.
    settings : `FitSettings`
        How they are fitted.
    host : int `~numpy.ndarray`, shape (n,), optional
        For each source of the bank the one whose component it is: a second component has the
        number of the source on which it stands, all others have their own.
    moved : `~numpy.ndarray`, shape (2,) or (n, 2), optional
        Pixels by which templates are moved; a shift that is fitted is searched from there.

    Attributes
    ----------
    scale : float
        Arcsec per pixel.
    bank
        The templates where they were fitted.
    flux : `~numpy.ndarray`, shape (n,)
        uJy, in the order of the bank's rows as all that follows; zero where not fitted.
    rows : int `~numpy.ndarray`
        Rows that were fitted.
    degenerate, noisy : bool `~numpy.ndarray`, shape (n,)
        Templates that equal another's; those whose power is mostly noise.
    inseparable : bool `~numpy.ndarray`, shape (n,)
        Second components that cannot be told from the first.
    pairs : int `~numpy.ndarray`, shape (k, 2)
        Rows of the two components of the sources that have two.
    light : `~numpy.ndarray`, shape (n, 2)
        Fractions of the templates on the image, and on its usable pixels.
    columns : list of `~numpy.ndarray`
        The common parameters' images: the background's first, then those of the shift.
    fit : `~miricigale.photometry.errors.LinearFit` or None
        The solution; None without rows.
    free : `~miricigale.photometry.free_templates.FreeTemplates` or None
        The solution with templates that may change, after `free_templates`; its fluxes are ``flux`` then.
    shift : `~numpy.ndarray`, shape (2,), or None
        In arcsec.
    offset_map : `~miricigale.photometry.offsets.OffsetMap` or None
        The map by which templates are moved.
    """

    def __init__(self, arrays, bank, settings, *, host=None, moved=None):
        self.arrays, self.settings = arrays, settings
        self.host = np.arange(len(bank.order)) if host is None else host
        self.scale = pixel_scale(arrays.wcs)
        self.inverse_sigma = arrays.inverse_sigma
        self._radius = settings.radius / self.scale
        self._background = self._background_columns() if settings.fit_background else []
        self.shift = self.offset_map = self.free = None
        self.bank = bank
        moved = np.zeros(2) if moved is None else moved
        self._solve(self._moved(bank, moved) if np.any(moved) else bank, [])
        if settings.max_shift is not None and settings.offset_order is None and len(self.rows):
            self._find_shift(bank, moved)

    def _background_columns(self):
        area, order = self.arrays.area, self.settings.background_order
        if order == 0:
            return [area]
        y, x = np.ogrid[: area.shape[0], : area.shape[1]]
        terms = legendre_terms(x, y, area.shape, order)
        return [
            np.multiply(area, term, out=self.arrays.new(), casting="same_kind") for term in terms
        ]

    def _moved(self, bank, pixels):
        return bank.shifted(pixels, self.arrays.flux.shape, self._radius)

    def _solve(self, bank, gradients):
        """Fit fluxes and common parameters with the templates of a bank."""
        if bank is not self.bank:
            self.bank.forget()
        self.bank, self.columns = bank, [*self._background, *gradients]
        white = [self.arrays.whitened(column) for column in self.columns]
        data = self.arrays.whitened(self.arrays.flux)
        matrix, projection, power, light = normal_matrix(bank, self.inverse_sigma, [data, *white])
        self.light, self._power = light / self._full_light(), power
        diagonal = matrix.diagonal()
        rows = (self.light[:, 1] >= self.settings.min_coverage) & (diagonal > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            excess = bank.noise_terms() / np.where(power > 0, power, np.inf)
        self.noisy = excess > 0.5
        correction = scipy.sparse.diags_array(np.minimum(excess, 0.5) * diagonal)
        self.degenerate = _duplicates(matrix, rows, bank.order)
        matrix = (matrix - correction).tocsr()
        self._find_pairs(matrix, rows & ~self.degenerate)
        self.rows = np.flatnonzero(rows & ~self.degenerate & ~self.inseparable)
        matrix = matrix[self.rows][:, self.rows]
        corner = np.array([[_inner(a, b) for b in white] for a in white])
        self.fit = None
        if len(self.rows):
            g = len(white)
            self.fit = LinearFit(
                matrix,
                projection[self.rows, 0],
                projection[self.rows, 1:],
                corner.reshape(g, g),
                np.array([_inner(a, data) for a in white]),
            )
        self.flux = np.zeros(len(bank.order))
        if self.fit is not None:
            self.flux[self.rows] = self.fit.flux

    def free_templates(self, fitted):
        """
        Let templates change as far as they are not known, and fit once more.

        Parameters
        ----------
        fitted : `~numpy.ndarray` of `~miricigale.photometry.shapes.FITTED`, shape (k,)
            What is known of the first sources of the bank; those after them are points.
        """
        if self.fit is None or self.settings.size_scatter is None:
            return
        known = not_fitted(len(self.bank.order))
        known[: len(fitted)] = fitted
        # a point on top of a template leaves open how it is shaped, not whether it is a point
        hosts = self.host[self.bank.order[self.pairs[:, 1]]]
        known["point"][hosts] = 0.0
        # positions move no flux to first order, unless there are two components
        lone = np.setdiff1d(np.arange(len(known)), hosts)
        known["covariance"][lone, 1:3] = 0.0
        known["covariance"][lone, :, 1:3] = 0.0
        self.free = free_templates(
            self.fit,
            self.bank,
            self.rows,
            known[self.bank.order[self.rows]],
            TemplateChanges(
                self.settings.kernel.source, self.settings.kernel.target, self.settings.size_scatter
            ),
            [self.arrays.whitened(one) for one in (self.arrays.flux, *self.columns)],
            self.inverse_sigma,
        )
        if self.free is not None:
            self.flux[self.rows] = self.free.flux

    def _find_pairs(self, matrix, rows):
        """Tell which second components can be fitted beside the first."""
        order = self.bank.order
        row = np.argsort(order)
        second = np.flatnonzero(self.host[order] != order)
        first = row[self.host[order[second]]]
        power = matrix.diagonal()
        overlap = np.array([matrix[i, j] for i, j in zip(first, second, strict=True)])
        apart = overlap**2 < _SEPARABLE * power[first] * power[second]
        apart &= rows[first] & rows[second]
        self.inseparable = np.zeros(len(order), bool)
        self.inseparable[second[~apart]] = True
        self.degenerate[second] = False
        self.pairs = np.stack([first, second], axis=1)[apart]

    def _full_light(self):
        """Light of a whole template, within the radius to which they are cut."""
        half = self._radius * self.scale / self.settings.kernel.pixel_scale.to_value(ANGLE)
        return self.bank.full_light(half)[:, None]

    def _find_shift(self, plain, shift):
        limit = self.settings.max_shift.value / self.scale
        for _ in range(8):
            dy, dx = np.gradient(self.model())
            self._solve(self._moved(plain, shift), [-dx, -dy])
            # the columns are steps from where the templates stand now
            step = self.fit.common[-2:]
            found = shift + step
            if np.hypot(*found) > limit:
                msg = (
                    f"a shift of {np.round(found * self.scale, 3)} arcsec is beyond 'max_shift' "
                    f"{self.settings.max_shift}: measured without a shift"
                )
                warnings.warn(msg, MiricigaleWarning, stacklevel=6)
                self._solve(plain, [])
                return
            if np.hypot(*step) < 1e-3:
                break
            shift = shift + np.clip(step, -1.0, 1.0)
        self.shift = found * self.scale

    def displacement(self, xy):
        """Where templates stand less where the catalogue has them, (x, y) in pixels, at positions."""
        if self.offset_map is not None:
            return self.offset_map.field(*xy.T) / self.scale
        shift = np.zeros(2) if self.shift is None else self.shift / self.scale
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
        target = self.settings.kernel.target
        fine = self.settings.kernel.pixel_scale.to_value(ANGLE)
        return np.sqrt(target.sum() / (2 * np.pi * target.max())) * fine / self.scale

    @property
    def solution(self):
        """The linear fit that the fluxes are from, and how many of its unknowns are fluxes."""
        return (self.fit if self.free is None else self.free.fit), len(self.rows)

    @property
    def common(self):
        """The common parameters, shape (g,)."""
        return self.solution[0].common

    def add_background(self, image, factor=1.0):
        """Add the fitted background, in uJy per pixel, times a factor to an image in place."""
        if self.fit is None:
            return
        for column, value in zip(self._background, self.common, strict=False):
            for part in chunks(len(image), 256):
                image[part] += np.float32(factor * value) * column[part]

    def model(self):
        """The sources' model in uJy per pixel, without background."""
        image = self.arrays.new()
        layers = [(self.bank, self.flux)]
        if self.free is not None:
            flux = np.zeros(len(self.flux))
            flux[self.rows], change = self.free.amplitudes
            layers = [(self.bank, flux), (self.free.bank, change)]
        for bank, flux in layers:
            for block in bank.blocks():
                part = flux[block.first : block.last]
                _core.add_model(image, block.values, block.box, block.start, part)
        return image

    def residual(self, model):
        """Image less a model of its sources and less the background, zero where not usable."""
        found = np.subtract(self.arrays.flux, model, out=self.arrays.new())
        self.add_background(found, -1.0)
        found *= self.arrays.usable
        return found

    def correlation(self, residual, model):
        """Measured correlation of the noise, or None where there is too little sky."""
        usable = self.arrays.usable
        free = self.arrays.new(bool)
        for part in chunks(len(free), 256):
            free[part] = np.abs(model[part]) * self.inverse_sigma[part] < 0.3
        free &= usable
        if np.count_nonzero(free) < max(400, 0.02 * np.count_nonzero(usable)):
            free = usable
        if np.count_nonzero(free) < 400:
            return None
        correlation = noise_correlation(
            residual, free, weight=self.inverse_sigma, executor=self.bank.executor
        )
        return correlation if correlation.any() else None

    def covariance(self, correlation=None):
        """
        Covariance of the fitted rows and of the common parameters, and the blending.

        Parameters
        ----------
        correlation : `~numpy.ndarray`, optional
            That of the noise, which is white without.

        Returns
        -------
        covariances : `Covariances`
        """
        n, g = len(self.rows), len(self.columns)
        fit, free, xy = self.fit, self.free, self.bank.xy[self.rows]
        if free is not None:
            fit, xy = free.fit, np.concatenate([xy, free.xy])
        noise = None if correlation is None else self._sandwich(correlation)
        if noise is None and free is not None:
            noise = (
                (fit.matrix - scipy.sparse.diags_array(free.prior)).tocsr(),
                fit.border,
                fit.corner,
            )
        coo = self.fit.matrix.tocoo()
        pattern = scipy.sparse.coo_array((coo.data, (coo.row, coo.col)), shape=fit.matrix.shape)
        options = {
            "core": _CORE.value / self.scale, "halo": _HALO.value / self.scale, "pattern": pattern
        }  # fmt: skip
        found, common, blending = fit.covariance(xy, noise=noise, **options)
        found, blending = found[:n][:, :n], blending[:n]
        template = scipy.sparse.csr_array((n, n))
        if free is not None:
            blending = blending * np.sqrt(free.alone())
            filling = free.filling(self.fit.matrix)
            nothing = np.zeros((len(fit.rhs), g)), np.zeros((g, g))
            template, more, _ = fit.covariance(xy, noise=(filling, *nothing), **options)
            template, common = template[:n][:, :n], common + more
        if len(self.pairs):
            # that of the sum of two components
            first, second = np.searchsorted(self.rows, self.pairs.T)
            filling = self.fit.matrix if noise is None else noise[0]
            alone = np.sqrt(filling.diagonal()[:n]) / self.fit.matrix.diagonal()
            both = np.array([found[i, j] for i, j in zip(first, second, strict=True)])
            variance = found.diagonal()
            blending[first] = np.sqrt(variance[first] + variance[second] + 2 * both) / alone[first]
            blending[second] = blending[first]
        return Covariances(found, template, self._psf_errors()[self.rows], common, blending)

    def _psf_errors(self):
        """Errors of the fluxes of all rows by that of the PSF."""
        kernel, fraction = self.settings.kernel, self.settings.psf_error
        if fraction is None:
            if self.settings.size_scatter is None:
                return np.zeros(len(self.flux))
            parts = self.bank.parts(np.arange(len(self.flux)))
            image = np.array([one is not None and one.kind == "cutout" for one in parts], float)
            fraction = image * np.max(np.abs(kernel.encircled_energy_error()))
        point = np.sum(kernel.target**2) * (self.scale / kernel.pixel_scale.to_value(ANGLE)) ** 2
        return fraction * np.minimum(self._power / point, 1.0) * np.abs(self.flux)

    def _sandwich(self, correlation):
        keep = self.rows
        white = [self.arrays.whitened(column) for column in self.columns]
        spread = [self._spread(image, correlation) for image in white]
        middle, border = sandwich_matrix(self.bank, self.inverse_sigma, correlation, spread)
        middle, border = middle[keep][:, keep], border[keep]
        if self.free is not None:
            middle, border = self.free.sandwich(
                self.bank, keep, self.inverse_sigma, correlation, middle, border, spread
            )
        corner = np.array([[_inner(a, b) for b in spread] for a in white])
        return middle, border, corner.reshape(len(white), len(white))

    def _spread(self, image, correlation):
        """An image convolved with the noise correlation."""
        kernel, lag = correlation.astype(image.dtype), correlation.shape[0] // 2
        out = self.arrays.new()

        def convolve(part):
            rows = slice(max(part.start - lag, 0), part.stop + lag)
            found = oaconvolve(image[rows], kernel, mode="same")
            out[part] = found[part.start - rows.start :][: part.stop - part.start]

        self.bank.map(convolve, chunks(len(image), 512))
        return out

    def statistics(self, residual):
        """Chi2, light left and light of each template's core (see the kernel), shape (n, 3)."""
        out = np.full((len(self.bank.order), 3), np.nan)
        if not len(self.rows):
            return out
        for block in self.bank.blocks():

            def measure(part, block=block):
                start = block.start[part.start : part.stop + 1]
                rows = slice(block.first + part.start, block.first + part.stop)
                stamps = (block.values, block.box[part], start)
                _core.residual_statistics(*stamps, residual, self.inverse_sigma, out[rows])

            self.bank.map(measure, block.parts())
        return out


def _inner(one, other):
    """Sum of the products of two images, in double precision."""
    return float(np.einsum("ij,ij->", one, other, dtype=float, casting="same_kind"))


def _duplicates(matrix, rows, order):
    """Templates that equal another one's; the first in the catalogue is kept."""
    coo = matrix.tocoo()
    scale = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    same = coo.data > (1 - 1e-6) * scale[coo.row] * scale[coo.col]
    same &= rows[coo.row] & rows[coo.col] & (order[coo.row] > order[coo.col])
    found = np.zeros(len(rows), bool)
    found[coo.row[same]] = True
    return found
