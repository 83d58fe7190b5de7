"""Forced photometry: all sources of a catalogue fitted at once, with templates."""

import warnings

import astropy.units as u
import numpy as np
import scipy.ndimage
import scipy.sparse
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from photutils.segmentation import SegmentationImage

from miricigale.photometry import _core
from miricigale.photometry.arrays import (
    fine_wcs,
    image_arrays,
    local_maps,
    pixel_scale,
    sky_pixels,
)
from miricigale.photometry.errors import (
    LinearFit,
    noise_correlation,
    normal_matrix,
    project,
    sandwich_matrix,
)
from miricigale.photometry.flags import ForcedFlags
from miricigale.photometry.results import ForcedPhotometryResult, crowded
from miricigale.photometry.templates import (
    FineTemplates,
    TemplateBank,
    cutouts,
    own_segments,
    sersic_cutouts,
)
from miricigale.utils.exceptions import MiricigaleWarning, argument_error
from miricigale.utils.meta import provenance
from miricigale.utils.tables import require_columns, unique_ids
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS, to_array

__all__ = ["ForcedPhotometer"]

#: Size of the covariance's blocks and of the margin around them.
_CORE, _HALO = 18.0 * u.arcsec, 6.0 * u.arcsec


class ForcedPhotometer:
    """
    Measure the sources of a catalogue on an image of lower resolution.

    Each source's light on a high-resolution image is brought to the image's resolution
    and pixels; the sum of all such templates, each times its flux, is fitted to the image.

    Parameters
    ----------
    kernel : `~miricigale.psf.MatchingKernel`
        From the high-resolution image's PSF (``source``) to the image's (``target``), on the
        pixels of the high-resolution image. ``target`` must be the PSF of the image that is
        measured: that of a drizzled mosaic for a drizzled mosaic.
    template : {"auto", "cutout", "psf", "sersic"}, optional
        What sources look like. ``"auto"`` cuts them from the high-resolution image where a
        segment of enough signal-to-noise belongs to them, otherwise takes a point source.
        ``"cutout"`` does so without regard to the signal-to-noise. ``"sersic"`` draws the
        profile that the catalogue states.
    min_snr : float, optional
        Least signal-to-noise of a segment for ``"auto"``.
    wings : bool, optional
        Whether cutouts are carried on beyond their well-measured core, by their mean on
        ellipses and then by the PSF; otherwise they are the segments as they are.
    fit_background : bool, optional
        Whether a constant is fitted with the sources.
    max_shift : `~astropy.units.Quantity`, optional
        If given, a shift of the whole image is fitted too. A larger one than this is not
        believed: a warning says so and the image is measured without.
    correlated_noise : bool, optional
        Whether the noise's autocorrelation is measured on source-free pixels and goes into
        the errors; otherwise the image's uncertainty is taken as white noise.
    integrate : bool, optional
        Whether templates are averaged over the image's pixels, for a kernel whose target
        does not include the response of the pixel.
    radius : `~astropy.units.Quantity`, optional
        Half-width to which templates are cut; as far as the kernel reaches by default.
    min_coverage : float, optional
        Sources with less of their template's light on usable pixels are not measured.
    max_bytes : float, optional
        Memory for templates; beyond it they are made anew for each pass.

    Raises
    ------
    ValueError
        If an option is out of range, or the kernel has no PSFs.

    Notes
    -----
    Normal equations in whitened form are factorised sparsely. Errors are the diagonal of
    H (A^T W C W A) H, where H is the inverse normal matrix and C the measured covariance
    of the noise; their scale is thus the one of the residuals, not that of the uncertainty.

    Cutouts of noisy segments make the fit too faint, since the template's own noise adds to
    its power: that part (noise variance times the kernel's power) is taken off the diagonal.

    References
    ----------
    Merlin et al. 2015, A&A 582, A15 (T-PHOT); Yang et al. 2021, ApJ 908, 144, section 3.4;
    Fuller 1987, Measurement Error Models (errors in variables).
    """

    def __init__(
        self,
        kernel,
        *,
        template="auto",
        min_snr=5.0,
        wings=True,
        fit_background=False,
        max_shift=None,
        correlated_noise=True,
        integrate=False,
        radius=None,
        min_coverage=0.05,
        max_bytes=1.5e9,
    ):
        if template not in ("auto", "cutout", "psf", "sersic"):
            raise argument_error("template", "'auto', 'cutout', 'psf' or 'sersic'", repr(template))
        for name in ("source", "target"):
            if getattr(kernel, name, None) is None:
                raise argument_error("kernel", f"a MatchingKernel with its {name}", "one without")
        if not min_snr >= 0:
            raise argument_error("min_snr", "at least 0", min_snr)
        if not 0 < min_coverage < 1:
            raise argument_error("min_coverage", "between 0 and 1", min_coverage)
        for name, value in (("max_shift", max_shift), ("radius", radius)):
            if value is not None and not float(to_array(value, ANGLE, name)) > 0:
                raise argument_error(name, "positive", value)
        self._kernel = kernel
        self._template = template
        self._min_snr = float(min_snr)
        self._wings = bool(wings)
        self._fit_background = bool(fit_background)
        self._max_shift = None if max_shift is None else u.Quantity(max_shift, ANGLE)
        self._correlated_noise = bool(correlated_noise)
        self._integrate = bool(integrate)
        self._radius = None if radius is None else u.Quantity(radius, ANGLE)
        self._min_coverage = float(min_coverage)
        self._max_bytes = float(max_bytes)

    @property
    def kernel(self):
        """The matching kernel."""
        return self._kernel

    def __repr__(self):
        return f"<ForcedPhotometer template={self._template!r}, {self._kernel!r}>"

    def measure(self, image, highres=None, segmentation=None, catalog=None):
        """
        Measure all sources of a catalogue.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData`
            The image, in units of surface brightness, background subtracted unless it is
            fitted, with WCS, uncertainty and mask. Any pixel scale and orientation.
        highres : `~astropy.nddata.CCDData`, optional
            The high-resolution image, background subtracted, on pixels of the kernel. Needed
            for cutouts; without it the kernel's grid is taken to be north up.
        segmentation : `~photutils.segmentation.SegmentationImage` or array, optional
            Segments of ``highres``; needed for cutouts.
        catalog : `~astropy.table.QTable`
            Column ``sky``, and if there are ``id`` (1, 2, ... otherwise), ``label`` (the
            segment; by default that at the position), ``flux`` (for the ``crowded``
            flag; the measured fluxes otherwise) and, for Sersic templates, those of the scene's
            catalogues.

        Returns
        -------
        result : `ForcedPhotometryResult`

        Raises
        ------
        ValueError, TypeError, `~astropy.units.UnitsError`
            If an input does not fit; the message says which.
        """
        arrays = image_arrays(image, "image")
        ids, sky, labels = _sources(catalog)
        scale = pixel_scale(image.wcs)
        fine_scale = self._kernel.pixel_scale.to_value(ANGLE)
        n, shape = len(sky), arrays.flux.shape
        margin = (self._kernel.target.shape[0] // 2 + 1) * fine_scale / scale
        xy = sky_pixels(sky, image.wcs, shape, margin)
        near = np.flatnonzero(np.isfinite(xy[:, 0]))
        grid_wcs, fine_arrays, segments = self._fine(image, highres, segmentation, arrays)
        fine_xy = np.stack(grid_wcs.world_to_pixel(sky[near]), axis=-1).reshape(-1, 2)
        poly = local_maps(xy[near], np.full(len(near), margin / 2), image.wcs, grid_wcs)
        flags = np.zeros(n, int)
        snr = np.full(n, np.nan)
        parts, flags[near], snr[near] = self._parts(
            catalog[near], sky[near], fine_xy, grid_wcs, fine_arrays, segments,
            None if labels is None else labels[near],
        )  # fmt: skip
        sides = None
        if self._integrate:
            middle = np.array([[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
            sides = local_maps(middle, [margin / 2], image.wcs, grid_wcs)[0, :, 1:3].T
        fine = FineTemplates(self._kernel.array, self._kernel.target, sides)
        radius = np.inf if self._radius is None else self._radius.value / scale
        bank = TemplateBank(
            fine, parts, fine_xy, xy[near], poly, shape, radius=radius, max_bytes=self._max_bytes
        )
        fit = _Fit(self, arrays, bank, near, ids, scale, radius)
        return fit.result(image, sky, xy, flags, snr, catalog)

    def _fine(self, image, highres, segmentation, arrays):
        """Coordinates, arrays and labels of the fine grid."""
        scale = self._kernel.pixel_scale.to_value(ANGLE)
        if highres is None:
            if self._template == "cutout" or segmentation is not None:
                raise argument_error("highres", "the image that the segments belong to", "None")
            return fine_wcs(image.wcs, arrays.flux.shape, scale), None, None
        fine_arrays = image_arrays(highres, "highres")
        have = pixel_scale(highres.wcs)
        if abs(have / scale - 1) > 0.01:
            raise argument_error(
                "highres", f"on the kernel's pixels of {scale:.4g} arcsec", f"{have:.4g} arcsec"
            )
        if segmentation is None:
            if self._template == "cutout":
                raise argument_error("segmentation", "given for cutouts", "None")
            return highres.wcs, fine_arrays, None
        segments = segmentation
        if isinstance(segmentation, SegmentationImage):
            segments = segmentation.data
        segments = np.asarray(segments)
        if segments.shape != fine_arrays.flux.shape or segments.dtype.kind not in "iu":
            raise argument_error(
                "segmentation",
                f"integers of the shape {fine_arrays.flux.shape} of 'highres'",
                f"{segments.dtype} of shape {segments.shape}",
            )
        return highres.wcs, fine_arrays, segments

    def _parts(self, catalog, sky, fine_xy, grid_wcs, fine_arrays, segments, labels):
        """The template of each source: a `Cutout`, or None for a point source."""
        n = len(sky)
        none = [None] * n, np.zeros(n, int), np.full(n, np.nan)
        if self._template == "psf" or n == 0:
            return none
        if self._template == "sersic":
            rows = _sersic_rows(catalog)
            return sersic_cutouts(rows, fine_xy, _pixels_per_arcsec(sky[0], grid_wcs)), *none[1:]
        if segments is None:
            return none[0], np.full(n, int(ForcedFlags.NO_SEGMENT)), none[2]
        label, flags = own_segments(segments, labels, fine_xy)
        parts, more, snr = cutouts(
            fine_arrays.flux,
            fine_arrays.sigma**2,
            segments,
            label,
            fine_xy,
            self._kernel.source,
            min_snr=self._min_snr if self._template == "auto" else 0.0,
            wings=self._wings,
        )
        return parts, flags | more, snr


class _Fit:
    """One measurement: from templates to the numbers of the result."""

    def __init__(self, settings, arrays, bank, near, ids, scale, radius):
        self.settings, self.arrays = settings, arrays
        self.near, self.ids, self.scale, self.radius = near, ids, scale, radius
        self.inverse_sigma = arrays.inverse_sigma
        self.data = arrays.flux * self.inverse_sigma
        self.background = [arrays.area] if settings._fit_background else []
        self.shift = None
        self._solve(bank, [])
        if settings._max_shift is not None and len(self.rows):
            self._find_shift()

    def _solve(self, bank, gradients):
        """Fit fluxes and common parameters with the templates of a bank."""
        self.bank, self.columns = bank, [*self.background, *gradients]
        white = [column * self.inverse_sigma for column in self.columns]
        matrix, projection, power, light = normal_matrix(
            bank, self.inverse_sigma, [self.data, *white]
        )
        self.light = light / self._full_light()
        diagonal = matrix.diagonal()
        rows = (self.light[:, 1] >= self.settings._min_coverage) & (diagonal > 0)
        self.degenerate = _duplicates(matrix, rows, self.near[bank.order])
        self.rows = np.flatnonzero(rows & ~self.degenerate)
        with np.errstate(divide="ignore", invalid="ignore"):
            excess = bank.noise_terms() / np.where(power > 0, power, np.inf)
        self.noisy = excess > 0.5
        correction = scipy.sparse.diags_array(np.minimum(excess, 0.5) * diagonal)
        matrix = (matrix - correction).tocsr()[self.rows][:, self.rows]
        corner = np.array([[np.sum(a * b) for b in white] for a in white])
        self.fit = None
        if len(self.rows):
            g = len(white)
            self.fit = LinearFit(
                matrix,
                projection[self.rows, 0],
                projection[self.rows, 1:],
                corner.reshape(g, g),
                np.array([np.sum(a * self.data) for a in white]),
            )
        self.flux = np.zeros(len(bank.order))
        if self.fit is not None:
            self.flux[self.rows] = self.fit.flux

    def _full_light(self):
        """Light of a whole template, within the radius to which they are cut."""
        target = self.settings._kernel.target
        if not np.isfinite(self.radius):
            return target.sum()
        fine = self.settings._kernel.pixel_scale.to_value(ANGLE)
        half = min(int(self.radius * self.scale / fine), target.shape[0] // 2)
        middle = target.shape[0] // 2
        return target[middle - half : middle + half + 1, middle - half : middle + half + 1].sum()

    def model(self):
        """The sources' model in uJy per pixel, without background."""
        image = np.zeros(self.arrays.flux.shape)
        for block in self.bank.blocks():
            flux = self.flux[block.first : block.last]
            _core.add_model(image, block.values, block.box, block.start, flux)
        return image

    def _find_shift(self):
        plain, shift = self.bank, np.zeros(2)
        limit = self.settings._max_shift.value / self.scale
        shape = self.arrays.flux.shape
        for _ in range(8):
            dy, dx = np.gradient(self.model())
            self._solve(plain.shifted(shift, shape, self.radius), [-dx, -dy])
            # the columns are steps from where the templates stand now
            step = self.fit.common[-2:]
            found = shift + step
            if np.hypot(*found) > limit:
                msg = (
                    f"a shift of {np.round(found * self.scale, 3)} arcsec is beyond 'max_shift' "
                    f"{self.settings._max_shift}: measured without a shift"
                )
                warnings.warn(msg, MiricigaleWarning, stacklevel=4)
                self._solve(plain, [])
                return
            if np.hypot(*step) < 1e-3:
                break
            shift = shift + np.clip(step, -1.0, 1.0)
        self.shift = found * self.scale

    def _noise(self, residual, model):
        """Measured correlation of the noise, and the sandwich's filling."""
        z = residual * self.inverse_sigma
        usable = self.arrays.usable
        free = usable & (np.abs(model) * self.inverse_sigma < 0.3)
        if np.count_nonzero(free) < max(400, 0.02 * np.count_nonzero(usable)):
            free = usable
        if np.count_nonzero(free) < 400:
            return None, None
        correlation = noise_correlation(z, free)
        if not correlation.any():
            return None, None
        keep = self.rows
        middle = sandwich_matrix(self.bank, self.inverse_sigma, correlation)
        middle = middle[keep][:, keep]
        white = [column * self.inverse_sigma for column in self.columns]
        spread = [scipy.ndimage.convolve(w, correlation, mode="constant") for w in white]
        border = project(self.bank, self.inverse_sigma, spread)[keep]
        corner = np.array([[np.sum(a * b) for b in spread] for a in white])
        return correlation, (middle, border, corner.reshape(len(white), len(white)))

    def result(self, image, sky, xy, flags, snr, catalog):
        """Put everything in the order of the catalogue."""
        settings, n = self.settings, len(sky)
        source = self.near[self.bank.order]
        n_columns = len(self.columns)
        model = self.model()
        level = self.fit.common[0] if self.background and self.fit is not None else 0.0
        residual = self.arrays.flux - np.where(
            self.arrays.usable, model + level * self.arrays.area, 0.0
        )
        correlation = None
        covariance = scipy.sparse.csr_array((n, n))
        common = np.full((n_columns, n_columns), np.nan)
        flux, flux_err = np.full(n, np.nan), np.full(n, np.nan)
        statistics = np.full((len(source), 3), np.nan)
        if len(self.rows):
            noise = None
            if settings._correlated_noise:
                correlation, noise = self._noise(residual, model)
            rows = self.rows
            found, common, blending = self.fit.covariance(
                self.bank.xy[rows],
                core=_CORE.value / self.scale,
                halo=_HALO.value / self.scale,
                noise=noise,
            )
            member = source[rows]
            flux[member] = self.flux[rows]
            flux_err[member] = np.sqrt(found.diagonal())
            coo = found.tocoo()
            covariance = scipy.sparse.coo_array(
                (coo.data, (member[coo.row], member[coo.col])), shape=(n, n)
            ).tocsr()
            flags[member[blending > 2]] |= int(ForcedFlags.BLENDED)
            for block in self.bank.blocks():
                _core.residual_statistics(
                    block.values, block.box, block.start, residual, self.inverse_sigma,
                    statistics[block.first : block.last],
                )  # fmt: skip
        coverage = np.zeros(n)
        coverage[source] = np.clip(self.light[:, 1], 0.0, 1.0)
        inside = np.zeros(n)
        inside[source] = self.light[:, 0]
        flags[inside < 0.9] |= int(ForcedFlags.EDGE)
        flags[coverage < 0.9 * np.minimum(inside, 1.0)] |= int(ForcedFlags.MASKED)
        flags[source[self.degenerate]] |= int(ForcedFlags.DEGENERATE)
        flags[source[self.noisy]] |= int(ForcedFlags.NOISY_SEGMENT)
        flags[np.isnan(flux) & (flags & int(ForcedFlags.DEGENERATE) == 0)] |= int(
            ForcedFlags.NO_DATA
        )
        chi2, left = np.full(n, np.nan), np.full(n, np.nan)
        chi2[source] = statistics[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            left[source] = statistics[:, 1] / (self.flux * statistics[:, 2])
        chi2[np.isnan(flux)] = left[np.isnan(flux)] = np.nan
        reference = catalog["flux"] if "flux" in catalog.colnames else np.nan_to_num(flux)
        filter_name = image.meta.get("filter", image.meta.get("FILTER"))
        common_err = np.sqrt(np.diag(common)) if n_columns else np.empty(0)
        extra = {}
        if self.background and self.fit is not None:
            extra["background"] = level * SURFACE_BRIGHTNESS
            extra["background_err"] = common_err[0] * SURFACE_BRIGHTNESS
        if self.shift is not None:
            extra["shift"] = self.shift * ANGLE
            extra["shift_err"] = common_err[-2:] * self.scale * ANGLE
        area = self.arrays.area
        images = {
            "model_image": model / area + level,
            "residual_image": np.where(self.arrays.usable, residual / area, np.nan),
        }
        meta = {} if filter_name is None else {"filter": str(filter_name)}
        sigma = np.where(self.arrays.usable, self.arrays.sigma, np.nan) / area
        for key, data in images.items():
            extra[key] = CCDData(
                data,
                unit=SURFACE_BRIGHTNESS,
                wcs=image.wcs,
                mask=~self.arrays.usable if key == "residual_image" else None,
                uncertainty=StdDevUncertainty(sigma) if key == "residual_image" else None,
                meta=dict(meta),
            )
        return ForcedPhotometryResult(
            id=np.array(self.ids),
            sky=sky,
            flux=flux * FNU,
            flux_err=flux_err * FNU,
            covariance=covariance,
            flags=flags,
            coverage=coverage,
            chi2=chi2,
            residual_fraction=left,
            template_snr=snr,
            crowded=crowded(sky, reference),
            x=xy[:, 0].copy(),
            y=xy[:, 1].copy(),
            noise_correlation=correlation,
            meta=provenance(
                **meta,
                template=settings._template,
                pixel_scale=round(self.scale, 6),
                correlated_noise=correlation is not None,
                measured_noise=self.arrays.measured_noise,
            ),
            **extra,
        )


def _sources(catalog):
    """Ids, positions and labels of a catalogue."""
    if catalog is None or not hasattr(catalog, "colnames"):
        raise argument_error("catalog", "a table with the column 'sky'", type(catalog).__name__)
    require_columns(catalog, ["sky"], "catalog")
    sky = catalog["sky"]
    if not isinstance(sky, SkyCoord):
        raise argument_error("catalog", "a table whose 'sky' is a SkyCoord", type(sky).__name__)
    ids = np.arange(1, len(sky) + 1)
    if "id" in catalog.colnames:
        ids = unique_ids(catalog["id"], "catalog")
    labels = np.asarray(catalog["label"]) if "label" in catalog.colnames else None
    return ids, sky, labels


def _sersic_rows(catalog):
    units = {"half_light_radius": u.arcsec, "position_angle": u.deg}
    names = ["half_light_radius", "sersic_index", "axis_ratio", "position_angle"]
    require_columns(catalog, names, "catalog", units=units)
    rows = np.stack(
        [
            u.Quantity(catalog[names[0]]).to_value(u.arcsec),
            np.asarray(catalog[names[1]], float),
            np.asarray(catalog[names[2]], float),
            u.Quantity(catalog[names[3]]).to_value(u.rad),
        ],
        axis=1,
    )
    if "profile" in catalog.colnames:
        rows[np.asarray(catalog["profile"]) != "sersic"] = np.nan
    return rows


def _pixels_per_arcsec(sky, wcs):
    """Jacobian [dx, dy] = J @ [east, north] of a WCS at a position."""
    x, y = wcs.world_to_pixel(sky)
    columns = []
    for angle in (90, 0):
        moved = sky.directional_offset_by(angle * u.deg, 1 * u.arcsec)
        columns.append(np.array(wcs.world_to_pixel(moved)) - [x, y])
    return np.stack(columns, axis=1)


def _duplicates(matrix, rows, order):
    """Templates that equal another one's; the first in the catalogue is kept."""
    coo = matrix.tocoo()
    scale = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    same = coo.data > (1 - 1e-6) * scale[coo.row] * scale[coo.col]
    same &= rows[coo.row] & rows[coo.col] & (order[coo.row] > order[coo.col])
    found = np.zeros(len(rows), bool)
    found[coo.row[same]] = True
    return found
