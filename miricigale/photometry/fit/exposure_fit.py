"""The fit of several exposures together: one flux for each source, a sky level for each exposure."""

import dataclasses

import numpy as np
import scipy.linalg
import scipy.sparse

from miricigale.photometry.fit.template_fit import (
    MAX_EXCESS,
    MIN_COVERAGE,
    BankEquations,
    duplicates,
    gaussian_width,
    inner_products,
)
from miricigale.photometry.images.arrays import pixel_scale
from miricigale.photometry.shapes.shapes import not_fitted
from miricigale.photometry.templates.free_templates import (
    FreeTemplates,
    change_basis,
    find_changes,
    joined_matrix,
)
from miricigale.photometry.templates.normal_equations import (
    LinearFit,
    change_matrices,
    sandwich_matrix,
    stated_correlation,
)
from miricigale.utils.values import value_class


@dataclasses.dataclass(eq=False)
class ExposurePart:
    """
    One exposure of a joint fit.

    Attributes
    ----------
    arrays : `~miricigale.photometry.images.arrays.FitArrays`
        Its pixels.
    settings : `~miricigale.photometry.ForcedPhotometer`
        With the kernels of this exposure.
    bank : `~miricigale.photometry.templates.templates.TemplateBank`
        The templates of the sources on or near it.
    source : int `~numpy.ndarray`, shape (k,)
        Which of the joint fit's sources each of the bank's is.
    """

    arrays: object
    settings: object
    bank: object
    source: np.ndarray

    @property
    def inverse_sigma(self):
        """1 / sigma of the pixels, zero where not usable."""
        return self.arrays.inverse_sigma

    @property
    def scale(self):
        """Arcsec per pixel."""
        return pixel_scale(self.arrays.wcs)

    @property
    def psf_width(self):
        """Rms width in pixels of a Gaussian as peaked as the exposure's PSF."""
        return gaussian_width(self.settings.mean_kernel) / self.scale

    @property
    def row_source(self):
        """The joint fit's source of each row of the bank, shape (k,)."""
        return self.source[self.bank.order]

    @property
    def correlation(self):
        """Correlation of the noise as the exposure states it (charge that pixels share), or None."""
        factor = self.arrays.noise_correction
        if factor <= 1:
            return None
        return stated_correlation(factor)

    def gather(self, n):
        """Make the matrix, (n, k), that sums the bank's rows by source."""
        return selection(self.row_source, n)

    def moved(self, shift, like=None):
        """
        Return a copy with its templates moved by some pixels, (2,) or (k, 2).

        Templates that stay where they are in the bank of ``like``, another `ExposurePart`, are taken from there.
        """
        bank = self.bank.shifted(shift)
        source = self if like is None else like
        bank.reuse(source.bank)
        return dataclasses.replace(self, bank=bank)


@value_class
class JointChanges(FreeTemplates):
    """Changes of templates that are the same in all exposures; ``bank`` has those of each exposure."""

    places: np.ndarray = None  # (k, 2): Positions of all changes in the plane.

    @property
    def xy(self):
        """Positions of the changes that are fitted, shape (m, 2)."""
        return self.places[self.basis[self.n :, self.n :].tocsc().indices]


class ExposureFit:
    """
    Least-squares fluxes of sources on all exposures that show them.

    Each pixel of each exposure is one equation, with the exposure's own variance; nothing is resampled. The
    noise of pixels is independent, so that the inverse normal matrix is the covariance.

    Parameters
    ----------
    parts : list of `ExposurePart`
        The exposures.
    settings : `~miricigale.photometry.ForcedPhotometer`
        How they are fitted; its kernel is the mean of all.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of the sources in a plane that all exposures have in common, in its pixels.
    scale : float
        Arcsec per pixel of that plane.
    order : int
        Of the polynomial that is each exposure's sky.
    gradients : list of list of `~numpy.ndarray`, optional
        For each exposure the derivatives of its model by a shift of it along x and y, which are fitted too;
        empty for one without a shift.

    Attributes
    ----------
    rows : int `~numpy.ndarray`
        Sources that were fitted.
    fit, free
        `LinearFit` of these (None without), and `JointChanges` or None.
    flux : `~numpy.ndarray`, shape (n,)
        uJy; zero where not fitted.
    degenerate, noisy : bool `~numpy.ndarray`, shape (n,)
        As for `~miricigale.photometry.fit.template_fit.TemplateFit`.
    power : `~numpy.ndarray`, shape (n,)
        Sums of squares of the templates on the exposure that shows most of them.
    light : `~numpy.ndarray`, shape (n, 2)
        Fraction of each template on the exposure that shows most of it, and on its usable pixels.
    n_exposures : int `~numpy.ndarray`, shape (n,)
        Number of exposures with at least a twentieth of the template on usable pixels.
    places : list of dict of str to slice
        For each exposure where its ``"sky"`` and, if fitted, its ``"shift"`` stand among the common parameters.
    """

    def __init__(self, parts, settings, xy, scale, order, gradients=None):
        self.parts = parts
        self.settings = settings
        self.xy = xy
        self.scale = scale
        self.order = order
        self.free = None
        self._solve(gradients)

    def _solve(self, gradients):
        n = len(self.xy)
        matrix = scipy.sparse.csr_array((n, n))
        correction = np.zeros(n)
        rhs = np.zeros(n)
        self.light = np.zeros((n, 2))
        self.power = np.zeros(n)
        self.n_exposures = np.zeros(n, int)
        self.noisy = np.ones(n, bool)
        borders = []
        corners = []
        corner_rhs = []
        self.places = []
        n_common = 0
        for k, part in enumerate(self.parts):
            # common parameters of this exposure: its sky, and its shift if that is fitted
            columns = part.arrays.sky_columns(self.order)
            places = {"sky": slice(n_common, n_common + len(columns))}
            if gradients is not None and gradients[k]:
                columns = columns + gradients[k]
                places["shift"] = slice(places["sky"].stop, n_common + len(columns))
            n_common += len(columns)
            self.places.append(places)
            # normal equations of this exposure, then summed over exposures by source
            equations = BankEquations.of(part.arrays, part.bank, part.inverse_sigma, columns)
            light = equations.light
            # from rows of the bank to sources of the joint fit
            gather = part.gather(n)
            source = part.row_source
            matrix = matrix + gather @ equations.matrix @ gather.T
            correction += gather @ equations.correction
            rhs += gather @ equations.rhs
            borders.append(gather @ equations.border)
            corners.append(equations.corner)
            corner_rhs.append(equations.corner_rhs)
            is_seen = light[:, 1] >= MIN_COVERAGE
            self.n_exposures[source[is_seen]] += 1
            self.noisy[source[is_seen & (equations.excess <= MAX_EXCESS)]] = False
            # of each source the exposure that shows most of it
            best = light[:, 1] > self.light[source, 1]
            self.light[source[best]] = light[best]
            self.power[source[best]] = equations.power[best]
        self.noisy &= self.n_exposures > 0
        # sources with enough light somewhere
        rows = (self.n_exposures > 0) & (matrix.diagonal() > 0)
        self.degenerate = duplicates(matrix, rows, np.arange(n))
        self.rows = np.flatnonzero(rows & ~self.degenerate)
        # errors in variables, as for one image
        matrix = (matrix - scipy.sparse.diags_array(correction)).tocsr()
        matrix = matrix[self.rows][:, self.rows]
        self.fit = None
        self.flux = np.zeros(n)
        if len(self.rows):
            border = np.concatenate(borders, axis=1)[self.rows]
            corner = scipy.linalg.block_diag(*corners)
            self.fit = LinearFit(matrix, rhs[self.rows], border, corner, np.concatenate(corner_rhs))
            self.flux[self.rows] = self.fit.flux

    @property
    def psf_width(self):
        """Rms width in pixels of the plane of a Gaussian as peaked as the mean PSF."""
        return gaussian_width(self.settings.mean_kernel) / self.scale

    @property
    def common(self):
        """The common parameters, shape (g,); zero where nothing was fitted."""
        if self.fit is None:
            return np.zeros(self.places[-1]["sky"].stop)
        solution = self.fit if self.free is None else self.free.fit
        return solution.common

    def cutouts(self):
        """Return the light of each source (`~miricigale.photometry.detection.cutouts.Cutout`), None for points."""
        cutouts = [None] * len(self.xy)
        for part in self.parts:
            for source, light in zip(part.source, part.bank.sources.cutout, strict=True):
                cutouts[source] = light
        return cutouts

    def model(self, k):
        """Draw the sources on one exposure in uJy per pixel, without its sky."""
        part = self.parts[k]
        layers = [(part.bank, self.flux[part.row_source])]
        if self.free is not None:
            flux, change = self.free.amplitudes
            row_flux = np.zeros(len(self.flux))
            row_flux[self.rows] = flux
            bank, numbers = self.free.bank[k]
            layers = [(part.bank, row_flux[part.row_source]), (bank, change[numbers])]
        image = part.arrays.new()
        for bank, flux in layers:
            bank.add_to(image, flux)
        return image

    def sky(self, k):
        """Draw the sky of one exposure in uJy per pixel."""
        part = self.parts[k]
        values = self.common[self.places[k]["sky"]]
        image = part.arrays.new()
        for column, value in zip(part.arrays.sky_columns(self.order), values, strict=True):
            image += np.float32(value) * column
        return image

    def residual(self, k, model):
        """Subtract model and sky from one exposure; zero where not usable."""
        arrays = self.parts[k].arrays
        return (arrays.flux - model - self.sky(k)) * arrays.usable

    def free_templates(self, fitted):
        """
        Let templates change as far as they are not known, alike in all exposures, and fit once more.

        ``fitted`` (`~miricigale.photometry.shapes.shapes.FITTED`, (k,)) is what is known of the first sources;
        those after them are points. See `~miricigale.photometry.templates.free_templates.free_templates`.
        """
        if self.fit is None or self.settings.errors.size_scatter is None:
            return
        # sources that the catalog lacks are points
        shapes = not_fitted(len(self.xy))
        shapes[: len(fitted)] = fitted
        # positions move no flux to first order
        shapes["covariance"][:, 1:3] = 0.0
        shapes["covariance"][:, :, 1:3] = 0.0
        shapes = shapes[self.rows]
        cutouts = self.cutouts()
        parts = [cutouts[source] for source in self.rows]
        executor = self.parts[0].bank.executor
        owner, changes, scale, noise = find_changes(self, shapes, parts, executor)
        if not (changes or noise.any()):
            return
        # owners are counted among the fitted rows
        sources = self.rows[owner]
        fixed = np.array([change.fixed for change in changes], bool)
        light = np.array([change.light for change in changes])
        n = len(self.rows)
        n_changes = len(changes)
        basis = change_basis(n, owner, light, fixed)
        squares = scipy.sparse.csr_array((n_changes, n_changes))
        cross = scipy.sparse.csr_array((n, n_changes))
        rhs = np.zeros(n_changes)
        borders = []
        banks = []
        for k, part in enumerate(self.parts):
            bank, numbers = self._change_bank(part, sources, changes)
            banks.append((bank, numbers))
            data = part.arrays.whitened(part.arrays.flux)
            columns = part.arrays.sky_columns(self.order)
            white = list(map(part.arrays.whitened, columns))
            # normal equations of the changes on this exposure
            products, square, projection = change_matrices(
                part.bank, bank, part.inverse_sigma, [data] + list(white)
            )
            place = selection(numbers, n_changes)
            gather = part.gather(len(self.xy))[self.rows]
            squares = squares + place @ square @ place.T
            cross = cross + gather @ products @ place.T
            rhs += place @ projection[:, 0]
            border = np.zeros((n_changes, len(self.fit.corner_rhs)))
            border[:, self.places[k]["sky"]] = place @ projection[:, 1:]
            borders.append(border)
        # templates and changes in the columns of the basis, with priors of the changes
        border = basis.T @ np.concatenate([self.fit.border, np.sum(borders, axis=0)])
        owner = owner[~fixed]
        prior = np.concatenate([np.zeros(n), scale[owner] ** -2.0])
        matrix = joined_matrix(self.fit.matrix, cross, squares, basis)
        solution = LinearFit(
            (matrix + scipy.sparse.diags_array(prior)).tocsr(),
            basis.T @ np.concatenate([self.fit.rhs, rhs]),
            border,
            self.fit.corner,
            self.fit.corner_rhs,
        )
        places = self.xy[sources]
        self.free = JointChanges(solution, banks, n, basis, owner, prior, noise, places)
        self.flux[self.rows] = self.free.flux

    def _change_bank(self, part, sources, changes):
        """Make the bank of changes of some sources on an exposure, and return the number of each of its rows."""
        place = np.full(len(self.xy), -1)
        place[part.source] = np.arange(len(part.source))
        local = place[sources]
        shown = np.flatnonzero(local >= 0)
        bank = part.bank.at_resolution(local[shown], [changes[j].cutout for j in shown])
        return bank, shown[bank.order]

    def noise_filling(self):
        """
        Return the covariance of the right-hand side by noise stated to be correlated; None if all is white.

        Matrix, border and corner of the middle of the sandwich, as
        `~miricigale.photometry.templates.normal_equations.LinearFit.covariances` takes them.
        """
        if all(part.correlation is None for part in self.parts):
            return None
        n = len(self.rows)
        n_common = len(self.fit.corner_rhs)
        n_changes = 0
        if self.free is not None:
            n_changes = self.free.basis.shape[0] - n
        middle = scipy.sparse.csr_array((n, n))
        squares = scipy.sparse.csr_array((n_changes, n_changes))
        cross = scipy.sparse.csr_array((n, n_changes))
        border = np.zeros((n, n_common))
        change_border = np.zeros((n_changes, n_common))
        corner = np.zeros((n_common, n_common))
        for k, part in enumerate(self.parts):
            correlation = part.correlation
            if correlation is None:
                # that of white noise
                correlation = np.ones((1, 1))
            white = list(map(part.arrays.whitened, part.arrays.sky_columns(self.order)))
            spread = [_spread(column, correlation) for column in white]
            sky = self.places[k]["sky"]
            gather = part.gather(len(self.xy))[self.rows]
            # covariance of the right-hand side by this exposure's noise
            square, side = sandwich_matrix(part.bank, part.inverse_sigma, correlation, spread)
            # the exposures' noise is independent: their contributions add up
            middle = middle + gather @ square @ gather.T
            border[:, sky] = gather @ side
            corner[sky, sky] = inner_products(white, spread)
            if self.free is None:
                continue
            bank, numbers = self.free.bank[k]
            place = selection(numbers, n_changes)
            # and that of the changes
            products, square, side = change_matrices(
                part.bank, bank, part.inverse_sigma, spread, correlation
            )
            squares = squares + place @ square @ place.T
            change_border[:, sky] = place @ side
            cross = cross + gather @ products @ place.T
        if self.free is None:
            return middle, border, corner
        basis = self.free.basis
        middle = joined_matrix(middle, cross, squares, basis)
        return middle, basis.T @ np.concatenate([border, change_border]), corner


def selection(numbers, n):
    """Make the matrix, (n, k), that puts rows of a bank to their numbers."""
    k = len(numbers)
    return scipy.sparse.coo_array((np.ones(k), (numbers, np.arange(k))), shape=(n, k)).tocsr()


def _spread(image, correlation):
    """Convolve an image with the correlation of the noise."""
    from scipy.signal import oaconvolve

    return oaconvolve(image, correlation.astype(image.dtype), mode="same")
