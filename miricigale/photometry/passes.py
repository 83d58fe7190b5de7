"""The fits of one image: the catalogue, then with what its residual shows to be lacking."""

import dataclasses

import numpy as np

from miricigale.photometry.arrays import local_maps
from miricigale.photometry.diagnostics import diagnose
from miricigale.photometry.offsets import fit_offsets, source_offsets
from miricigale.photometry.template_fit import TemplateFit
from miricigale.utils.units import ANGLE

__all__ = ["fit_image"]

#: How often positions of new sources are refined.
_REFINED = 2


def fit_image(arrays, bank, settings, catalog, grid_wcs):
    """
    Fit an image, and once more with second components and sources that the catalogue lacks.

    Parameters
    ----------
    arrays : `~miricigale.photometry.arrays.FitArrays`
        The image.
    bank : `~miricigale.photometry.templates.TemplateBank`
        The templates of the sources on or near it.
    settings : `~miricigale.photometry.template_fit.FitSettings`
        How they are fitted.
    catalog : `~miricigale.photometry.packaging.CatalogRows`
        The catalogue; ``near`` lists the bank's sources.
    grid_wcs : `~astropy.wcs.WCS`
        Of the grid on which templates are made.

    Returns
    -------
    fit : `~miricigale.photometry.template_fit.TemplateFit`
    diagnostics : `~miricigale.photometry.diagnostics.Diagnostics`
    new_xy : `~numpy.ndarray`, shape (m, 2)
        Positions, in the catalogue's frame, of sources that it lacks: the last of the fit's sources.
    """
    if settings.offset_order is None:
        fit = TemplateFit(arrays, bank, settings)
    else:
        fit = fit_offsets(arrays, bank, settings, catalog)
    # templates that may change hide some of the light of a point in their middle
    double = np.flatnonzero(_double(fit, catalog))
    fit.free_templates(catalog.fitted)
    diagnostics = diagnose(fit, catalog.xy)
    new_xy = np.empty((0, 2))
    if settings.second_pass:
        peaks = diagnostics.peaks.refined
        new_xy = peaks - fit.displacement(peaks)
    if len(double) or len(new_xy):
        fit, new_xy = _refit(fit, bank, double, new_xy, catalog, grid_wcs)
        diagnostics = diagnose(fit, np.concatenate([catalog.xy, new_xy]))
    return fit, diagnostics, new_xy


def _double(fit, catalog):
    """Which of the bank's sources get a second component."""
    if catalog.double is not None:
        return catalog.double[catalog.near]
    double = np.zeros(len(catalog.near), bool)
    if fit.settings.components == 2:
        double[fit.bank.order] = diagnose(fit, catalog.xy).poor
    return double


def _refit(first, bank, double, new_xy, catalog, grid_wcs):
    """Fit once more with second components and new sources, whose positions are refined."""
    arrays, settings = first.arrays, first.settings
    if first.shift is None and first.offset_map is None:
        # one that was not believed is not searched again
        settings = dataclasses.replace(settings, max_shift=None, offset_order=None)
    n, shape = len(catalog.near), arrays.flux.shape
    host = np.concatenate([np.arange(n), double, n + len(double) + np.arange(len(new_xy))])
    half = settings.kernel.target.shape[0] // 2 + 1
    half = half * settings.kernel.pixel_scale.to_value(ANGLE) / first.scale / 2

    def fit(**changes):
        xy = np.concatenate([catalog.xy[catalog.near[double]], new_xy])
        poly = local_maps(xy, np.full(len(xy), half), arrays.wcs, grid_wcs)
        both = bank.with_points(xy, poly, shape, settings.radius / first.scale)
        moved = first.displacement(np.concatenate([catalog.xy[catalog.near], xy]))
        if first.offset_map is None:
            moved = moved[0]
        changed = dataclasses.replace(settings, **changes)
        return TemplateFit(arrays, both, changed, host=host, moved=moved)

    for _ in range(_REFINED if len(new_xy) else 0):
        found = fit(max_shift=None)
        rows = found.rows[found.bank.order[found.rows] >= n + len(double)]
        model = found.model()
        step, error, _ = source_offsets(found, found.residual(model), model, rows)
        limit = found.psf_width
        good = error < 0.25 * limit
        step = np.clip(step[good], -limit, limit)
        new_xy[found.bank.order[rows[good]] - n - len(double)] += step
    found = fit()
    found.free_templates(catalog.fitted)
    found.offset_map = first.offset_map
    return found, new_xy
