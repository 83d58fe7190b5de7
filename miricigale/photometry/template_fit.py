"""The fit of one image: all templates at once, errors, flags and the result."""

import warnings

import astropy.units as u
import numpy as np
import scipy.sparse
from astropy.nddata import CCDData, StdDevUncertainty
from scipy.signal import oaconvolve

from miricigale.photometry import _core
from miricigale.photometry.errors import (
    LinearFit,
    noise_correlation,
    normal_matrix,
    sandwich_matrix,
)
from miricigale.photometry.flags import POOR_CHI2, ForcedFlags, unexplained_neighbours
from miricigale.photometry.results import ForcedPhotometryResult, crowded
from miricigale.utils.exceptions import MiricigaleWarning
from miricigale.utils.meta import provenance
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS

__all__ = ["TemplateFit"]

#: Size of the covariance's blocks and of the margin around them.
_CORE, _HALO = 18.0 * u.arcsec, 6.0 * u.arcsec


class TemplateFit:
    """
    One measurement: from templates to the numbers of the result.

    Parameters
    ----------
    arrays : `~miricigale.photometry.arrays.ImageArrays`
        The image.
    bank : `~miricigale.photometry.templates.TemplateBank`
        The templates of the sources on or near it.
    near, ids : int `~numpy.ndarray`
        Which rows of the catalogue those are, and the ids of all rows.
    scale, radius : float
        Arcsec per pixel; half-width in pixels to which templates are cut, or infinity.
    kernel, template, fit_background, max_shift, correlated_noise, min_coverage
        Settings of the `~miricigale.photometry.ForcedPhotometer`.
    """

    def __init__(
        self,
        arrays,
        bank,
        near,
        ids,
        scale,
        radius,
        *,
        kernel,
        template,
        fit_background,
        max_shift,
        correlated_noise,
        min_coverage,
    ):
        self.arrays, self.near, self.ids = arrays, near, ids
        self.scale, self.radius = scale, radius
        self.kernel, self.template, self.max_shift = kernel, template, max_shift
        self.correlated_noise, self.min_coverage = correlated_noise, min_coverage
        self.inverse_sigma = arrays.inverse_sigma
        self.data = arrays.flux * self.inverse_sigma
        self.background = [arrays.area] if fit_background else []
        self.shift = None
        self._solve(bank, [])
        if max_shift is not None and len(self.rows):
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
        rows = (self.light[:, 1] >= self.min_coverage) & (diagonal > 0)
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
        target = self.kernel.target
        if not np.isfinite(self.radius):
            return target.sum()
        fine = self.kernel.pixel_scale.to_value(ANGLE)
        half = min(int(self.radius * self.scale / fine), target.shape[0] // 2)
        middle = target.shape[0] // 2
        return target[middle - half : middle + half + 1, middle - half : middle + half + 1].sum()

    def _width(self):
        """Rms width in pixels of a Gaussian as peaked as the image's PSF."""
        target = self.kernel.target
        fine = self.kernel.pixel_scale.to_value(ANGLE)
        return np.sqrt(target.sum() / (2 * np.pi * target.max())) * fine / self.scale

    def model(self):
        """The sources' model in uJy per pixel, without background."""
        image = np.zeros(self.arrays.flux.shape)
        for block in self.bank.blocks():
            flux = self.flux[block.first : block.last]
            _core.add_model(image, block.values, block.box, block.start, flux)
        return image

    def _find_shift(self):
        plain, shift = self.bank, np.zeros(2)
        limit = self.max_shift.value / self.scale
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
                    f"{self.max_shift}: measured without a shift"
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
        white = [column * self.inverse_sigma for column in self.columns]
        spread = [oaconvolve(w, correlation, mode="same") for w in white]
        middle, border = sandwich_matrix(self.bank, self.inverse_sigma, correlation, spread)
        middle, border = middle[keep][:, keep], border[keep]
        corner = np.array([[np.sum(a * b) for b in spread] for a in white])
        return correlation, (middle, border, corner.reshape(len(white), len(white)))

    def _statistics(self, block, residual, out):
        def measure(part):
            start = block.start[part.start : part.stop + 1]
            stamps = (block.values, block.box[part], start)
            _core.residual_statistics(*stamps, residual, self.inverse_sigma, out[part])

        self.bank.map(measure, block.parts())

    def result(self, image, sky, xy, flags, kinds, snr, catalog):
        """Put everything in the order of the catalogue."""
        n = len(sky)
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
            if self.correlated_noise:
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
                self._statistics(block, residual, statistics[block.first : block.last])
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
        # where the measured noise is above that of the uncertainty, it is the measure
        lag = 0 if correlation is None else correlation.shape[0] // 2
        variance = 1.0 if correlation is None else max(1.0, correlation[lag, lag])
        flags[chi2 > POOR_CHI2 * variance] |= int(ForcedFlags.POOR_FIT)
        near = unexplained_neighbours(
            np.where(self.arrays.usable, residual, 0.0), model, self.inverse_sigma, self._width(),
            xy, flux,
        )  # fmt: skip
        flags[near & np.isfinite(flux)] |= int(ForcedFlags.UNEXPLAINED_NEIGHBOUR)
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
            template=kinds,
            template_snr=snr,
            crowded=crowded(sky, reference),
            x=xy[:, 0].copy(),
            y=xy[:, 1].copy(),
            noise_correlation=correlation,
            meta=provenance(
                **meta,
                template=self.template,
                pixel_scale=round(self.scale, 6),
                correlated_noise=correlation is not None,
                measured_noise=self.arrays.measured_noise,
            ),
            **extra,
        )


def _duplicates(matrix, rows, order):
    """Templates that equal another one's; the first in the catalogue is kept."""
    coo = matrix.tocoo()
    scale = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    same = coo.data > (1 - 1e-6) * scale[coo.row] * scale[coo.col]
    same &= rows[coo.row] & rows[coo.col] & (order[coo.row] > order[coo.col])
    found = np.zeros(len(rows), bool)
    found[coo.row[same]] = True
    return found
