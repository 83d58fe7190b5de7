"""The fits of one image: the catalog, then with what its residual shows to be lacking."""

import numpy as np
from astropy.wcs.utils import pixel_to_pixel

from miricigale.photometry.detection.residual_sources import chosen_peaks, residual_peaks
from miricigale.photometry.fit.diagnostics import diagnose
from miricigale.photometry.fit.offsets import fit_offsets, settled, source_offsets
from miricigale.photometry.fit.template_fit import TemplateFit
from miricigale.photometry.images.arrays import local_maps
from miricigale.utils.arrays import spread_over
from miricigale.utils.units import ANGLE

#: How often positions of new sources are refined.
_REFINED = 2

#: Errors by which the center of a profile differs from the catalog's position where it is taken instead.
_ELSEWHERE = 3.0


def fit_image(arrays, bank, settings, catalog, grid_wcs, *, until_new):
    """
    Fit an image, and once more with second components and sources that the catalog lacks.

    Parameters
    ----------
    arrays, bank, settings
        As for `~miricigale.photometry.fit.template_fit.TemplateFit`.
    catalog : `~miricigale.photometry.fit.result_table.CatalogRows`
        The catalog; ``near_rows`` lists the bank's sources.
    grid_wcs : `~astropy.wcs.WCS`
        Of the grid on which templates are made.
    until_new : bool
        Whether the work ends where sources that the catalog lacks are found: for their positions alone.

    Returns
    -------
    fit, diagnostics
        The `TemplateFit` and its `Diagnostics`; these are None where it ended with new sources.
    new_xy : `~numpy.ndarray`, shape (m, 2)
        Positions, in the catalog's frame, of sources that it lacks: the last of the fit's sources.
    """
    if settings.offset_order is None:
        fit = TemplateFit(arrays, bank, settings)
    else:
        fit = fit_offsets(arrays, bank, settings, catalog)
    if not settings.second_pass:
        # where the catalog is known to lack sources, these would move their neighbors
        fit = settled(fit, bank, catalog)
    added = _AddedPoints(bank, fit, catalog, grid_wcs)
    by_catalog = catalog.double is not None
    double = np.empty(0, int)
    if by_catalog:
        double = np.flatnonzero(catalog.double[catalog.near_rows])
    new_xy = np.empty((0, 2))
    poor = np.empty(0, int)
    choose = settings.components == 2 and not by_catalog
    if choose:
        # before templates may change, which hides some of the light of a point in their middle
        poor = _poor(fit, catalog, new_xy)
    evidence = None
    if settings.second_pass is not False:
        # templates that may change absorb some of the light of their neighbors
        new_xy, evidence = _new_positions(fit, catalog)
    if len(new_xy) or len(double):
        new_xy = added.refined(double, new_xy)
        if until_new and len(new_xy):
            fit.evidence = evidence
            return fit, None, new_xy
        fit = added.fit(double, new_xy)
        if choose:
            # sources that are poorly fitted also with the new sources next to them
            poor = _poor(fit, catalog, new_xy)
    if fit.free is None:
        fit.free_templates(catalog.fitted)
    diagnostics = diagnose(fit, np.concatenate([catalog.xy, new_xy]))
    if len(poor):
        fit, diagnostics = _split(fit, diagnostics, added, poor, new_xy)
    fit.evidence = evidence
    return fit, diagnostics, new_xy


def _poor(fit, catalog, new_xy):
    """Find those of the catalog's sources in a bank that are poorly fitted."""
    diagnostics = diagnose(fit, np.concatenate([catalog.xy, new_xy]))
    source = fit.bank.order[diagnostics.poor]
    return np.sort(source[source < len(catalog.near_rows)])


def _new_positions(fit, catalog):
    """
    Find sources that the catalog lacks on the residual, in the catalog's frame, and the evidence for them.

    The false ones are taken to be as many as the negative of the residual shows, and those of Gaussian noise.
    Where the evidence decides (``second_pass`` is None) there are none unless they are few.
    """
    xy = catalog.xy + fit.displacement(catalog.xy)
    flux = spread_over(fit.total, catalog.near_rows[fit.bank.order], len(xy))
    usable = fit.arrays.usable
    second_pass = fit.settings.second_pass
    model = fit.model()
    residual = fit.residual(model)
    # a background that is not fitted is no source
    level_residual = residual - usable * np.median(residual[usable])
    if second_pass is None:
        residual = level_residual
    peaks = residual_peaks(fit, residual, model, xy)
    negative = residual_peaks(fit, -level_residual, model, xy)
    chosen, evidence = chosen_peaks(peaks, negative, xy, flux, usable, second_pass)
    at = peaks.refined[chosen]
    return at - fit.displacement(at), evidence


def _split(fit, diagnostics, added, poor, new_xy):
    """Fit with second components of those sources that are better fitted with them."""

    def chi2(fit, diagnostics):
        values = np.empty(len(fit.host))
        values[fit.bank.order] = diagnostics.chi2
        return values[poor]

    chosen = poor
    before = chi2(fit, diagnostics)
    xy = np.concatenate([added.catalog.xy, new_xy])
    for _ in range(2):
        split_fit = added.fit(chosen, new_xy)
        split_fit.free_templates(added.catalog.fitted)
        # chi2 of both by the same measure
        split_diagnostics = diagnose(split_fit, xy, diagnostics.pixel_scatter)
        better = poor[chi2(split_fit, split_diagnostics) < before]
        if not len(better):
            return fit, diagnostics
        if len(chosen) == len(better):
            break
        chosen = better
    return split_fit, split_diagnostics


class _AddedPoints:
    """Fits of a bank's sources with points that are added, templates moved as in a first fit."""

    def __init__(self, bank, first, catalog, grid_wcs):
        self._bank = bank
        self.catalog = catalog
        self._grid_wcs = grid_wcs
        self._first = first
        self._made = first.bank

    def fit(self, double, new_xy, search=None):
        """Fit with second components of some of the sources, and new sources after those."""
        first = self._first
        near_rows = self.catalog.near_rows
        arrays = first.arrays
        settings = first.settings
        source_shifts = first.source_shifts
        n = len(near_rows)
        # second components have the number of their source, new sources their own
        host = np.concatenate([np.arange(n), double, n + len(double) + np.arange(len(new_xy))])
        all_xy = np.concatenate([self.catalog.xy[near_rows], self._centers(double), new_xy])
        xy = all_xy[n:]
        half = settings.mean_kernel.target.shape[0] // 2 + 1
        half = half * settings.mean_kernel.pixel_scale.to_value(ANGLE) / first.scale / 2
        poly = local_maps(xy, np.full(len(xy), half), arrays.wcs, self._grid_wcs)
        bank = self._bank.with_points(xy, poly)
        moved = np.array(first.displacement(all_xy))
        if source_shifts is not None:
            moved[:n] += source_shifts
        is_single = first.offset_map is None and source_shifts is None
        # positions are refined without a shift
        shifted = first.shift is not None and search is None
        if search is None:
            # a shift that was rejected is not searched again
            search = first.shift is not None and source_shifts is None
        if is_single:
            moved = moved[0]
        fit = TemplateFit(
            arrays, bank, settings, like=self._made, host=host, moved=moved, search=search
        )
        if shifted and not search:
            fit.include_shift(first.shift)
        fit.offset_map = first.offset_map
        self._made = fit.bank
        return fit

    def _centers(self, double):
        """Return positions of sources: of the catalog, or of their profiles where those are surely elsewhere."""
        xy = self.catalog.xy[self.catalog.near_rows[double]]
        fitted = self.catalog.fitted[double]
        # what is fitted to a piece of a galaxy is the whole of it
        is_whole = fitted["galaxy"] == 0
        rows = np.flatnonzero(np.isfinite(fitted["parameters"][:, 0]) & is_whole)
        if len(rows):
            center = fitted["parameters"][rows, :2]
            image_wcs = self._first.arrays.wcs
            x, y = xy[rows].T
            place = pixel_to_pixel(image_wcs, self._grid_wcs, x, y)
            offset = center - np.stack(place, axis=1)
            # chi^2 of the distance by the covariance of the center
            inverse = np.linalg.pinv(fitted["covariance"][rows, 1:3, 1:3])
            far = np.einsum("ki,kij,kj->k", offset, inverse, offset) > _ELSEWHERE**2
            if far.any():
                x, y = center[far].T
                place = pixel_to_pixel(self._grid_wcs, image_wcs, x, y)
                xy[rows[far]] = np.stack(place, axis=1)
        return xy

    def refined(self, double, new_xy):
        """Refine positions of new sources by some fits of where they are."""
        first_new = len(self.catalog.near_rows) + len(double)
        new_xy = new_xy.copy()
        if not len(new_xy):
            return new_xy
        for _ in range(_REFINED):
            fit = self.fit(double, new_xy, search=False)
            rows = fit.rows[fit.bank.order[fit.rows] >= first_new]
            model = fit.model()
            residual = fit.residual(model)
            step, error, _ = source_offsets(fit, fit.flux, residual, model, rows)
            good = error < 0.25 * fit.psf_width
            step = np.clip(step[good], -fit.psf_width, fit.psf_width)
            new_xy[fit.bank.order[rows[good]] - first_new] += step
        return new_xy
