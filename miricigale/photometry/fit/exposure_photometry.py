"""Forced photometry on exposures: all of them fitted together, none of them resampled."""

import dataclasses

import numpy as np
from astropy.stats import gaussian_sigma_to_fwhm
from astropy.wcs.utils import pixel_to_pixel

from miricigale.instrument import mosaic_wcs
from miricigale.photometry.detection.residual_sources import chosen_peaks
from miricigale.photometry.fit.exposure_fit import ExposureFit, ExposurePart
from miricigale.photometry.fit.exposure_kernels import ExposureKernels
from miricigale.photometry.fit.exposure_result import joint_result, plane_peaks
from miricigale.photometry.fit.offsets import (
    BRIGHT_SNR,
    COMMON_OFFSET,
    MAX_NEIGHBOR_LIGHT,
    MAX_OFFSET,
    MIN_SOURCES,
    OFFSET_FLOOR,
    OFFSET_PASSES,
    OFFSETS_DONE,
    row_snr,
    shrunk_offsets,
    source_offsets,
)
from miricigale.photometry.fit.progress import measurement_steps
from miricigale.photometry.fit.result_table import CatalogRows, warn_of_none
from miricigale.photometry.images.arrays import (
    fit_arrays,
    lengths,
    local_maps,
    pixel_scale,
    pixels_to_sky,
    sky_pixels,
)
from miricigale.photometry.images.coadd import Plane
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.photometry.templates.placement import Placement
from miricigale.utils.arrays import nans, quiet_division, spread_over
from miricigale.utils.exceptions import PhotometryWarning, argument_error, warn
from miricigale.utils.options import check_that
from miricigale.utils.parallel import single_threaded, threads
from miricigale.utils.positions import middle_pixel
from miricigale.utils.units import ANGLE

#: Change of an exposure's shift (pixels) at which it is done, and how often it is looked for.
_SHIFT_DONE = 1e-3
_MAX_SHIFT_STEPS = 8

#: How often positions of new sources are refined.
_REFINED = 2


def measure_exposures(
    photometer, images, highres, segmentation, catalog, *, templates, progress_bar=None
):
    """
    Measure the sources of a catalog on exposures that are fitted together.

    Parameters
    ----------
    photometer : `~miricigale.photometry.ForcedPhotometer`
        The settings; its kernel is one for all exposures, or `ExposureKernels`.
    images : sequence
        The exposures, each as the image of `~miricigale.photometry.ForcedPhotometer.measure`.
    highres, segmentation, catalog, templates, progress_bar
        As for `~miricigale.photometry.ForcedPhotometer.measure`.

    Returns
    -------
    result : `~miricigale.photometry.ForcedPhotometryResult`
        With ``exposures``.

    Raises
    ------
    ValueError, TypeError, `~astropy.units.UnitsError`
        If an input does not fit, or an option is not offered for exposures.
    """
    # check everything before templates are made
    images = _opened(images)
    settings = _settings_of_each(photometer, len(images))
    _check_offered(photometer)
    prior, sources = photometer._sources(images[0], highres, segmentation, catalog, templates)
    if sources.components is not None and np.any(sources.components == 2):
        raise argument_error("components", "1 for exposures", "2 for some of the sources")
    arrays = []
    placed = []
    for k, image in enumerate(images):
        exposure = fit_arrays(image, f"image[{k}]")
        arrays.append(exposure)
        placed.append(Placement.of(settings[k], exposure, sources.sky))
    n_pixels = sum(exposure.flux.size for exposure in arrays)
    with measurement_steps(progress_bar, n_pixels) as steps:
        # templates of those sources alone that an exposure shows
        near_rows = np.unique(np.concatenate([place.near_rows for place in placed]))
        warn_of_none(sources, near_rows, "the exposures")
        if templates is None:
            highres, segmentation, catalog = prior
            steps.begin("templates")
            templates = photometer._templates(highres, segmentation, catalog[near_rows])
        else:
            templates = templates[near_rows]
        photometer._check_grid(templates)
        # a common plane, for the search of new sources and for pictures
        plane = _plane(arrays)
        margin = max(place.margin for place in placed)
        xy = sky_pixels(sources.sky, plane.wcs, plane.shape, margin)
        rows = CatalogRows.of(sources, xy, near_rows, templates)
        meta = photometer._meta_of(images[0], templates)
        with threads(photometer.n_threads) as executor, single_threaded():
            joint = _Joint(photometer, plane, rows)
            steps.begin("templates on the exposures")
            joint.place(placed, templates, executor)
            steps.begin("fit")
            fit, new_xy, evidence, offsets = joint.fit_all()
            steps.begin("errors")
            return joint_result(fit, plane, images, rows, new_xy, evidence, offsets, meta)


def _opened(images):
    """Open the exposures as images, and check that they are of one filter."""
    check_that(len(images), "image", "at least one exposure", "none")
    opened = [as_mosaic(image, f"image[{k}]") for k, image in enumerate(images)]
    names = {str(image.meta["filter"]) for image in opened if image.meta.get("filter") is not None}
    check_that(len(names) <= 1, "image", "exposures of one filter", sorted(names))
    return opened


def _settings_of_each(photometer, n):
    """Return the photometer with the kernel of each of n exposures."""
    kernel = photometer.kernel
    if not isinstance(kernel, ExposureKernels):
        check_that(not photometer.bare, "kernel", "one with its PSFs for exposures", "one without")
        return [photometer] * n
    wanted = f"one for each of {n} exposures"
    check_that(len(kernel) == n, "kernel", wanted, f"{len(kernel)} kernels")
    # kernels of one roll are often the same object
    by_kernel = {}
    for kernel_of_one in kernel.kernels:
        if id(kernel_of_one) not in by_kernel:
            by_kernel[id(kernel_of_one)] = photometer.replace(kernel=kernel_of_one)
    return [by_kernel[id(kernel_of_one)] for kernel_of_one in kernel.kernels]


def _check_offered(photometer):
    """Refuse options that are not offered for exposures."""
    for name, value, offered in (
        ("components", photometer.components, 1),
        ("offset_order", photometer.offset_order, None),
    ):
        check_that(value == offered, name, f"{offered} for exposures", value)
    if photometer.psf_stars is True:
        wanted = "False or None for exposures (correct the PSFs beforehand)"
        raise argument_error("psf_stars", wanted, True)


def _plane(arrays):
    """Make the grid that exposures have in common: north up, with pixels of their mean size."""
    scale = np.mean([pixel_scale(exposure.wcs) for exposure in arrays])
    grids = []
    sized = []
    for exposure in arrays:
        shape = exposure.flux.shape
        grids.append((exposure.wcs, shape))
        wcs = exposure.wcs
        if wcs.pixel_shape is None:
            wcs = wcs.deepcopy()
            wcs.pixel_shape = shape[::-1]
        sized.append(wcs)
    wcs = mosaic_wcs(sized, scale * ANGLE)
    return Plane.over(wcs, grids)


class _Joint:
    """The fits of the sources of a catalog: shifts of exposures, bright sources, sources that it lacks."""

    def __init__(self, photometer, plane, catalog):
        self._settings = photometer
        self._plane = plane
        self._catalog = catalog
        self._scale = pixel_scale(plane.wcs)
        order = photometer.background_order
        # an exposure always has a sky of its own
        self._order = 0 if order is None else order
        self._n = len(catalog.near_rows)

    def place(self, placed, templates, executor):
        """Make the templates of each exposure."""
        self._placed = placed
        self._grids = [place.grid(templates) for place in placed]
        number = np.full(len(self._catalog.id), -1)
        number[self._catalog.near_rows] = np.arange(self._n)
        # memory that is kept is that of all exposures
        memory = self._settings.memory
        memory = dataclasses.replace(memory, max_bytes=memory.max_bytes / len(placed))
        self._parts = []
        for place in placed:
            rows = number[place.near_rows]
            placement = dataclasses.replace(place, settings=place.settings.replace(memory=memory))
            bank = placement.bank(place.near_rows, templates[rows], executor)
            self._parts.append(ExposurePart(place.arrays, place.settings, bank, rows))
        #: Pixels by which each exposure's templates are moved.
        self._shifts = np.zeros((len(placed), 2))
        # what they are found to be, with errors, whether they are fitted or not
        self._measured = nans((len(placed), 2))
        self._errors = nans((len(placed), 2))

    def fit_all(self):
        """
        Fit all: the last fit, new sources in the plane, the evidence for them, and offsets of exposures.

        The offsets are east and north in arcsec, (n_exposures, 2), with their errors, (n_exposures,).
        """
        fit = self._fit(self._parts)
        if not len(fit.rows):
            pass
        elif self._settings.max_shift is not None:
            fit = self._with_shifts(fit)
        else:
            self._measured, self._errors = self._steps(fit)
        new_xy = np.empty((0, 2))
        evidence = None
        if self._settings.second_pass is not False:
            new_xy, evidence = self._new_positions(fit)
        if len(new_xy):
            new_xy, fit = self._with_points(new_xy)
        elif not self._settings.second_pass:
            fit = self._settled(fit)
        fit.free_templates(self._catalog.fitted)
        offsets = self._on_sky(self._measured), self._errors.mean(axis=1) * self._scale
        return fit, new_xy, evidence, offsets

    def _fit(self, parts, new_xy=None, gradients=None):
        xy = self._catalog.xy[self._catalog.near_rows]
        if new_xy is not None:
            xy = np.concatenate([xy, new_xy])
        return ExposureFit(parts, self._settings, xy, self._scale, self._order, gradients)

    def _with_shifts(self, fit):
        """Fit with templates moved by a shift of each exposure."""
        limit = self._settings.max_shift.value
        fixed = np.zeros(len(self._parts), bool)
        first_parts = self._parts
        for _ in range(_MAX_SHIFT_STEPS):
            # shifts that the fit lacks; those that failed stay at zero
            steps, self._errors = self._steps(fit)
            self._measured = self._shifts + steps
            fixed |= np.isnan(steps[:, 0])
            shifts = self._shifts + np.where(fixed[:, None], 0.0, steps)
            scales = np.array([part.scale for part in fit.parts])
            far = lengths(shifts) * scales > limit
            for k in np.flatnonzero(far & ~fixed):
                value = np.round(shifts[k] * scales[k], 3)
                msg = (
                    f"a shift of exposure {k} by {value} arcsec is beyond 'max_shift' "
                    f"{self._settings.max_shift}: it is measured without a shift"
                )
                warn(msg, PhotometryWarning)
            fixed |= far
            shifts[fixed] = 0.0
            step = np.abs(shifts - self._shifts).max()
            # at most a pixel at a time: the gradient holds no farther
            self._shifts = self._shifts + np.clip(shifts - self._shifts, -1.0, 1.0)
            moved = []
            for part, shift, like in zip(first_parts, self._shifts, fit.parts, strict=True):
                moved.append(part.moved(shift, like))
            fit = self._fit(moved)
            if step < _SHIFT_DONE:
                break
        self._parts = fit.parts
        return fit

    def _steps(self, fit):
        """Measure shifts (pixels, (k, 2)) of exposures against their templates, to first order, and errors."""
        gradients = []
        for k, part in enumerate(fit.parts):
            dy, dx = np.gradient(fit.model(k))
            derivatives = [-dx, -dy]
            power = np.inf
            for image in derivatives:
                white = image * part.inverse_sigma
                power = min(power, np.sum(white**2, dtype=float))
            if power <= 1:
                # too little light to find a shift of less than a pixel
                derivatives = []
            gradients.append(derivatives)
        # fluxes, skies and shifts together
        trial = self._fit(fit.parts, fit.xy[self._n :], gradients)
        variance = np.diag(trial.fit.common_covariance)
        steps = nans((len(fit.parts), 2))
        errors = steps.copy()
        for k, places in enumerate(trial.places):
            if "shift" in places:
                steps[k] = trial.common[places["shift"]]
                errors[k] = np.sqrt(variance[places["shift"]])
        return steps, errors

    def _on_sky(self, shifts):
        """Convert shifts of exposures (pixels) to arcsec to the east and north."""
        offsets = []
        for part, shift in zip(self._parts, shifts, strict=True):
            middle = np.array([middle_pixel(part.arrays.flux.shape)])
            turn = self._turns(part, middle)[0]
            offsets.append((turn @ shift) * self._scale * [-1.0, 1.0])
        return np.array(offsets)

    def _new_positions(self, fit):
        """
        Find sources that the catalog lacks on the residuals, in the plane, and the evidence for them.

        As for one image, the negative of the residual and Gaussian noise say how many are false.
        """
        flux = spread_over(fit.flux, self._catalog.near_rows, len(self._catalog.id))
        xy = self._catalog.xy
        # peaks of the residual, and of its negative, which are false
        peaks, negative, usable = plane_peaks(fit, self._plane, xy)
        second_pass = self._settings.second_pass
        chosen, evidence = chosen_peaks(peaks, negative, xy, flux, usable, second_pass)
        return peaks.refined[chosen], evidence

    def _with_points(self, new_xy):
        """Refine positions of new sources, and fit with them."""
        fit = self._fit(self._added(new_xy, self._parts), new_xy)
        for _ in range(_REFINED):
            step, error, _ = self._offsets(fit)
            rows = np.arange(self._n, self._n + len(new_xy))
            width = fit.psf_width
            good = error[rows] < 0.25 * width
            new_xy = new_xy.copy()
            new_xy[good] += np.clip(step[rows][good], -width, width)
            fit = self._fit(self._added(new_xy, fit.parts), new_xy)
        return new_xy, fit

    def _added(self, new_xy, like):
        """Add points at positions of the plane to the exposures; templates that are those of ``like`` are kept."""
        sky = pixels_to_sky(new_xy, self._plane.wcs).icrs
        added = []
        for k, (part, place, grid) in enumerate(
            zip(self._parts, self._placed, self._grids, strict=True)
        ):
            wcs = part.arrays.wcs
            xy = sky_pixels(sky, wcs, part.arrays.flux.shape, place.margin)
            rows = np.flatnonzero(np.isfinite(xy[:, 0]))
            xy = xy[rows]
            poly = local_maps(xy, np.full(len(xy), place.margin / 2), wcs, grid)
            bank = part.bank.with_points(xy + self._shifts[k], poly)
            bank.reuse(like[k].bank)
            source = np.concatenate([part.source, self._n + rows])
            added.append(ExposurePart(part.arrays, part.settings, bank, source))
        return added

    def _offsets(self, fit):
        """
        Measure offsets of sources from their templates, of all exposures together.

        In pixels of the plane: the steps, (n, 2), their errors and the light of others over a source's own, (n,);
        errors are infinite where no exposure shows enough.
        """
        n = len(fit.xy)
        total = np.zeros((n, 2))
        weight = np.zeros(n)
        neighbors = np.zeros(n)
        for k, part in enumerate(fit.parts):
            if not len(part.source):
                continue
            model = fit.model(k)
            residual = fit.residual(k, model)
            flux = fit.flux[part.row_source]
            rows = np.arange(len(part.source))
            step, error, neighbor_light = source_offsets(part, flux, residual, model, rows)
            good = np.isfinite(error) & np.isfinite(step).all(axis=1) & (error > 0)
            source = part.row_source[good]
            # steps in the pixels of the plane, weighted by their errors
            plane_step = np.einsum("kij,kj->ki", self._turns(part, part.bank.xy)[good], step[good])
            step_weight = error[good] ** -2.0
            total[source] += step_weight[:, None] * plane_step
            weight[source] += step_weight
            neighbors[source] += step_weight * neighbor_light[good]
        with quiet_division():
            return total / weight[:, None], weight**-0.5, neighbors / weight

    def _turns(self, part, xy):
        """Return linear maps from pixels of an exposure to those of the plane at some pixels, (k, 2, 2)."""
        if not len(xy):
            # which astropy cannot convert
            return np.empty((0, 2, 2))
        wcs = part.arrays.wcs
        x, y = xy.T
        middle = np.array(pixel_to_pixel(wcs, self._plane.wcs, x, y))
        right = np.array(pixel_to_pixel(wcs, self._plane.wcs, x + 1.0, y))
        above = np.array(pixel_to_pixel(wcs, self._plane.wcs, x, y + 1.0))
        return np.stack([(right - middle).T, (above - middle).T], axis=-1)

    def _settled(self, fit):
        """
        Fit with bright isolated sources moved to where the exposures show them, as for one image.

        Nothing is done if offsets do not scatter beyond their errors, or if all have a large one in common.
        """
        if not len(fit.rows):
            return fit
        width = fit.psf_width
        offsets = np.zeros((len(fit.xy), 2))
        first_parts = self._parts
        for _ in range(OFFSET_PASSES):
            step, error, neighbors = self._offsets(fit)
            # bright isolated sources with a small error
            good = (
                (row_snr(fit) > BRIGHT_SNR)
                & (neighbors < MAX_NEIGHBOR_LIGHT)
                & ~fit.noisy
                & np.isfinite(error)
            )
            good &= (fit.light > 0.9).all(axis=1) & (error < width / BRIGHT_SNR * 2)
            # their offsets, those already applied included
            measured = offsets + np.where(good[:, None], step, 0.0)
            good &= lengths(measured) < MAX_OFFSET * width
            if np.count_nonzero(good) <= MIN_SOURCES:
                break
            error = np.hypot(error, OFFSET_FLOOR)
            common = np.median(measured[good], axis=0)
            if np.hypot(common[0], common[1]) > COMMON_OFFSET * gaussian_sigma_to_fwhm * width:
                break
            shrunk = shrunk_offsets(measured[good], error[good])
            if shrunk is None:
                break
            new = np.zeros_like(offsets)
            new[good] = shrunk
            change = np.abs(new - offsets).max()
            offsets = new
            moved = []
            for part, like in zip(first_parts, fit.parts, strict=True):
                inverse = np.empty((len(part.source), 2, 2))
                inverse[part.bank.order] = np.linalg.inv(self._turns(part, part.bank.xy))
                steps = np.einsum("kij,kj->ki", inverse, offsets[part.source])
                moved.append(part.moved(steps, like))
            fit = self._fit(moved)
            if change < OFFSETS_DONE:
                break
        return fit
