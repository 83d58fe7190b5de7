"""From a fit in the order of its templates to the result in the order of the catalogue."""

import dataclasses

import numpy as np
import scipy.sparse
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty

from miricigale.photometry.diagnostics import source_flags
from miricigale.photometry.results import ForcedPhotometryResult, crowded
from miricigale.utils.meta import provenance
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS

__all__ = ["CatalogRows", "package"]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class CatalogRows:
    """
    The sources of a catalogue, as far as they are known before the fit.

    Attributes
    ----------
    id, sky, flags, template, template_snr
        As in `~miricigale.photometry.ForcedPhotometryResult`, shape (n,).
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions on the image; NaN far outside.
    near : int `~numpy.ndarray`, shape (k,)
        The sources that have a template, in the order of the bank's sources.
    reference : `~numpy.ndarray` or None
        Fluxes that say who is crowded; None for those that are measured.
    """

    id: np.ndarray
    sky: SkyCoord
    xy: np.ndarray
    near: np.ndarray
    flags: np.ndarray
    template: np.ndarray
    template_snr: np.ndarray
    reference: np.ndarray | None = None


def package(fit, diagnostics, catalog, filter_name=None):
    """
    Make the result of a fit.

    Parameters
    ----------
    fit : `~miricigale.photometry.template_fit.TemplateFit`
        The fit.
    diagnostics : `~miricigale.photometry.diagnostics.Diagnostics`
        What was made of its residual.
    catalog : `CatalogRows`
        The catalogue.
    filter_name : str, optional
        The image's filter.

    Returns
    -------
    result : `~miricigale.photometry.ForcedPhotometryResult`
    """
    n, n_columns = len(catalog.sky), len(fit.columns)
    source = catalog.near[fit.bank.order]
    covariance = scipy.sparse.csr_array((n, n))
    common = np.full((n_columns, n_columns), np.nan)
    flux, flux_err = np.full(n, np.nan), np.full(n, np.nan)
    blending = np.full(len(source), np.nan)
    if len(fit.rows):
        found, common, blending[fit.rows] = fit.covariance(diagnostics.correlation)
        member = source[fit.rows]
        flux[member] = fit.flux[fit.rows]
        flux_err[member] = np.sqrt(found.diagonal())
        coo = found.tocoo()
        covariance = scipy.sparse.coo_array(
            (coo.data, (member[coo.row], member[coo.col])), shape=(n, n)
        ).tocsr()
    flags, coverage = source_flags(fit, diagnostics, catalog, flux, blending)
    chi2, left = np.full(n, np.nan), np.full(n, np.nan)
    chi2[source], left[source] = diagnostics.chi2, diagnostics.residual_fraction
    reference = np.nan_to_num(flux) if catalog.reference is None else catalog.reference
    meta = {} if filter_name is None else {"filter": str(filter_name)}
    return ForcedPhotometryResult(
        id=np.array(catalog.id),
        sky=catalog.sky,
        flux=flux * FNU,
        flux_err=flux_err * FNU,
        covariance=covariance,
        flags=flags,
        coverage=coverage,
        chi2=chi2,
        residual_fraction=left,
        template=catalog.template,
        template_snr=catalog.template_snr,
        crowded=crowded(catalog.sky, reference),
        x=catalog.xy[:, 0].copy(),
        y=catalog.xy[:, 1].copy(),
        noise_correlation=diagnostics.correlation,
        meta=provenance(
            **meta,
            template=fit.settings.template,
            pixel_scale=round(fit.scale, 6),
            correlated_noise=diagnostics.correlation is not None,
            measured_noise=fit.arrays.measured_noise,
        ),
        **_common(fit, common),
        **_images(fit, diagnostics, meta),
    )


def _common(fit, covariance):
    """Parameters of the whole image with their errors."""
    found, errors = {}, np.sqrt(np.diag(covariance)) if len(covariance) else np.empty(0)
    if fit.settings.fit_background and fit.fit is not None:
        found["background"] = fit.level * SURFACE_BRIGHTNESS
        found["background_err"] = errors[0] * SURFACE_BRIGHTNESS
    if fit.shift is not None:
        found["shift"] = fit.shift * ANGLE
        found["shift_err"] = errors[-2:] * fit.scale * ANGLE
    return found


def _images(fit, diagnostics, meta):
    arrays = fit.arrays
    residual = np.where(arrays.usable, diagnostics.residual / arrays.area, np.nan)
    sigma = np.where(arrays.usable, arrays.sigma, np.nan) / arrays.area
    options = {"unit": SURFACE_BRIGHTNESS, "wcs": arrays.wcs}
    return {
        "model_image": CCDData(
            diagnostics.model / arrays.area + fit.level, meta=dict(meta), **options
        ),
        "residual_image": CCDData(
            residual, mask=~arrays.usable, uncertainty=StdDevUncertainty(sigma), meta=dict(meta),
            **options,
        ),
    }  # fmt: skip
