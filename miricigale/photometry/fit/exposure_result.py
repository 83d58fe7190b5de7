"""From a fit of several exposures to its result: diagnostics, flags, errors, tables and images."""

import itertools

import numpy as np
import scipy.sparse
from astropy.nddata import StdDevUncertainty
from astropy.stats import gaussian_sigma_to_fwhm, mad_std
from astropy.table import QTable

from miricigale.instrument import pixel_area_map
from miricigale.instrument.image import Image
from miricigale.photometry._core.stamps import residual_statistics
from miricigale.photometry.detection.residual_sources import residual_peaks, unexplained_neighbors
from miricigale.photometry.fit.diagnostics import add_fit_flags, add_no_data, flags_of_light
from miricigale.photometry.fit.exposure_fit import selection
from miricigale.photometry.fit.result_table import (
    BRIGHT_SNR,
    FEWEST_BRIGHT,
    WARNED_OFFSET,
    add_flags,
    flux_columns,
    joint_errors,
    result_of_columns,
)
from miricigale.photometry.fit.template_fit import gaussian_width, psf_covariance, row_covariances
from miricigale.photometry.images.arrays import lengths
from miricigale.photometry.images.flags import POOR_CHI2, POOR_STRAIN
from miricigale.utils.arrays import nans, quiet_division, spread_over
from miricigale.utils.exceptions import PhotometryWarning, warn
from miricigale.utils.meta import provenance
from miricigale.utils.units import ANGLE, SURFACE_BRIGHTNESS
from miricigale.utils.values import value_class

#: Largest light of the model, over the noise, of pixels that count as free of sources.
_FREE = 0.3

#: Fewest such pixels of which the noise is measured, and by how much it may be another than is stated.
_FEWEST_PIXELS = 400
_OTHER_NOISE = 0.1

#: uJy per MJy.
_MICRO = 1e12


@value_class
class ExposureResults:
    """
    What a joint fit leaves of each exposure.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        A row for each exposure: ``exposure`` (its number from 0), ``source`` (its file), ``n_sources``,
        ``sky`` and ``sky_err`` (its mean level, MJy/sr), ``offset_east``, ``offset_north`` and ``offset_err`` (of
        the exposure from the templates, arcsec; fitted with ``max_shift``), ``noise`` (robust rms of the residual
        over the stated error, in pixels without sources) and ``correlation`` (of neighboring pixels there).
    model_images, residual_images : tuple of `~astropy.nddata.CCDData`
        MJy/sr, on the pixels of each exposure; the model has its sky, the residual its errors and mask. Empty
        if the result was read from a file.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import imager_wcs
    >>> from miricigale.photometry import ForcedPhotometer
    >>> from miricigale.psf import gaussian_psf
    >>> star = SkyCoord([53.1], [-27.8], unit="deg")
    >>> rng = np.random.default_rng(1)
    >>> exposures = []
    >>> for roll, sky in ((20, 3.0), (50, 5.0)):
    ...     wcs = imager_wcs(star[0], roll * u.deg, subarray="SUB64")
    ...     data = sky + rng.normal(0, 0.1, (64, 72))
    ...     error = StdDevUncertainty(np.full(data.shape, 0.1))
    ...     exposures.append(CCDData(data, unit="MJy/sr", wcs=wcs, uncertainty=error))
    >>> psf = gaussian_psf(0.5 * u.arcsec, pixel_scale=0.06 * u.arcsec, fov=3 * u.arcsec)
    >>> result = ForcedPhotometer(psf=psf).measure(exposures, star)
    >>> result.exposures
    <ExposureResults of 2 exposures>
    >>> result.exposures.table["sky"].round(2)
    <Quantity [3., 5.] MJy / sr>
    """

    table: QTable
    model_images: tuple = ()
    residual_images: tuple = ()

    def __len__(self):
        return len(self.table)

    def __repr__(self):
        return f"<ExposureResults of {len(self)} exposures>"


@value_class
class _PlaneFit:
    """What `residual_peaks` needs of a fit: the mean residual in the plane."""

    inverse_sigma: np.ndarray
    psf_width: float
    bank: object  # With the executor.


def plane_peaks(fit, plane, xy):
    """
    Find peaks of the mean residual of all exposures in their plane, of its negative, and the usable pixels.

    ``xy``, (n, 2), are all known sources.
    """
    means = _plane_means(plane, *_images(fit))
    peaks = _peaks(fit, plane, xy, means)
    negative = _peaks(fit, plane, xy, means, sign=-1.0)
    return peaks, negative, means[2] > 0


def _images(fit):
    """Return model without sky, residual and inverse errors of each exposure, in MJy/sr."""
    models = []
    residuals = []
    inverse = []
    for k, part in enumerate(fit.parts):
        area = part.arrays.areas()
        model = fit.model(k)
        residuals.append(fit.residual(k, model) / area)
        models.append(model / area)
        inverse.append(part.inverse_sigma * area)
    return models, residuals, inverse


def _plane_means(plane, models, residuals, inverse):
    """Mean model and residual of all exposures in the plane, and the weight of each pixel."""
    weights = [image.astype(float) ** 2 for image in inverse]
    model, weight = plane.mean(models, weights)
    residual, _ = plane.mean(residuals, weights)
    return model, residual, weight


def _peaks(fit, plane, xy, means, sign=1.0):
    """Find peaks of the mean residual in the plane, or of its negative; ``means`` are `_plane_means`."""
    model, residual, weight = means
    area = pixel_area_map(plane.wcs, plane.shape) * _MICRO
    view = _PlaneFit(np.sqrt(weight) / area, fit.psf_width, fit.parts[0].bank)
    return residual_peaks(view, sign * residual * area, model * area, xy)


def joint_result(fit, plane, images, catalog, new_xy, evidence, offsets, meta):
    """
    Make the `ForcedPhotometryResult` of a fit of exposures.

    Parameters
    ----------
    fit : `~miricigale.photometry.fit.exposure_fit.ExposureFit`
        The fit.
    plane : `~miricigale.photometry.images.coadd.Plane`
        What exposures have in common.
    images : list of `~astropy.nddata.CCDData`
        The exposures.
    catalog : `~miricigale.photometry.fit.result_table.CatalogRows`
        The catalog; ``near_rows`` lists the fit's sources.
    new_xy : `~numpy.ndarray`, shape (m, 2)
        Positions of sources that it lacks, in the plane: the last of the fit's sources.
    evidence : dict or None
        Of a second pass.
    offsets : tuple
        Of the exposures from the templates, east and north in arcsec, shape (k, 2), and their errors, (k,).
    meta : dict
        The ``template``, and the ``filter`` if that is known.
    """
    n = len(catalog.id)
    n_all = n + len(new_xy)
    # number of each of the fit's sources among all; new ones come after the catalog
    place = np.concatenate([catalog.near_rows, np.arange(n, n_all)])
    models, residuals, inverse = _images(fit)
    chi2, residual_fraction, core_flux, poor, checks = _compared(fit, models, residuals)
    terms, common, blending = _covariances(fit)
    joint = scipy.sparse.csr_array((n_all, n_all))
    flux_err = nans((4, n_all))
    measured = place[fit.rows]
    flux = spread_over(fit.flux[fit.rows], measured, n_all)
    if len(fit.rows):
        gather = selection(measured, n_all)
        spread = [(gather @ term @ gather.T).tocsr() for term in terms]
        joint, flux_err = joint_errors(spread, measured, n_all)
        joint = joint.tocsr()
        joint.sort_indices()
    # peaks of the last residual, for flags of their neighbors
    xy = np.concatenate([catalog.xy, new_xy])
    means = _plane_means(plane, models, residuals, inverse)
    peaks = _peaks(fit, plane, xy, means)
    flags, coverage = _flags(fit, place, n_all, flux, blending, poor)
    has_neighbor = unexplained_neighbors(peaks, xy, flux)
    core_flux = spread_over(core_flux, place, n_all)
    add_flags(flags, catalog, has_neighbor, flux, flux_err, core_flux)
    columns = {"flags": flags, "coverage": coverage}
    columns["chi2"] = spread_over(chi2, place, n_all)
    columns["residual_fraction"] = spread_over(residual_fraction, place, n_all)
    columns |= flux_columns(flux, flux_err)
    exposures = _exposures(fit, images, models, residuals, inverse, common, checks, offsets)
    model, residual, pixel_weight = means
    model, residual = _images_of(
        model, residual, pixel_weight > 0, np.sqrt(pixel_weight), plane.wcs, meta
    )
    sky = exposures.table["sky"]
    weight = exposures.table["sky_err"] ** -2
    # mean sky of the exposures, by their errors
    background = {}
    if len(fit.rows):
        background["background"] = np.sum(sky * weight) / np.sum(weight)
        background["background_err"] = np.sum(weight) ** -0.5
    counted = {}
    if evidence is not None:
        counted["second_pass"] = evidence
    has_offset = np.isfinite(offsets[1])
    if has_offset.any():
        # along x and y of the plane, as for one image
        weights = offsets[1][has_offset] ** -2.0
        east, north = np.average(offsets[0][has_offset], axis=0, weights=weights)
        counted["offset"] = [round(-float(east), 5), round(float(north), 5)]
        counted["offset_err"] = [round(float(np.sum(weights) ** -0.5), 5)] * 2
    return result_of_columns(
        catalog,
        new_xy,
        plane.wcs,
        columns,
        second_pass=fit.settings.second_pass,
        covariance=joint[:n, :n],
        **background,
        psf_fwhm=gaussian_sigma_to_fwhm * gaussian_width(fit.settings.mean_kernel) * ANGLE,
        model_image=model,
        residual_image=residual,
        exposures=exposures,
        meta=provenance(
            **meta,
            pixel_scale=round(fit.scale, 6),
            n_exposures=len(images),
            correlated_noise=any(part.correlation is not None for part in fit.parts),
            measured_noise=any(part.arrays.measured_noise for part in fit.parts),
            **counted,
        ),
    )


def _compared(fit, models, residuals):
    """
    Compare a fit with its exposures.

    Returns
    -------
    chi2, light_left, core_flux, poor : `~numpy.ndarray`, shape (n,)
        Of each source: chi-square, residual light of its core over its flux, the flux (uJy) with which it has all
        light of its core, and whether chi-square is too large for noise.
    checks : list of tuple of float
        Noise and correlation of each exposure.
    """
    n = len(fit.xy)
    square, weight, light_left, core_light, core = np.zeros((5, n))
    checks = []
    for part, model, residual in zip(fit.parts, models, residuals, strict=True):
        area = part.arrays.areas()
        source = part.row_source
        row_light = np.zeros(len(part.source))
        statistics = nans((len(part.source), 4))
        residual_flux = np.asarray(residual * area, np.float32)
        # an exposure is its model and the residual
        light = residual_flux + part.arrays.usable * np.asarray(model * area, np.float32)
        for block in part.bank.blocks():
            rows = slice(block.first, block.last)
            residual_statistics(
                *block.stamps, residual_flux, light, part.inverse_sigma, statistics[rows]
            )
            for row, (first, last) in enumerate(itertools.pairwise(block.start)):
                row_light[block.first + row] = block.values[first:last].sum()
        # sums over exposures by source, chi^2 weighted with the template's light
        good = np.isfinite(statistics[:, 0]) & (row_light > 0)
        np.add.at(square, source[good], (row_light * statistics[:, 0])[good])
        np.add.at(weight, source[good], row_light[good])
        np.add.at(light_left, source[good], statistics[good, 1])
        np.add.at(core_light, source[good], statistics[good, 2])
        np.add.at(core, source[good], statistics[good, 3])
        checks.append(
            _noise_check(
                residual_flux * part.inverse_sigma, model * area * part.inverse_sigma, part
            )
        )
    with quiet_division():
        chi2 = square / weight
        light_left = light_left / (fit.flux * core)
        core_flux = core_light / core
    out = np.ones(n, bool)
    out[fit.rows] = False
    chi2[out] = np.nan
    light_left[out] = np.nan
    core_flux[out] = np.nan
    poor = chi2 > POOR_CHI2
    if fit.free is not None:
        poor[fit.rows] |= fit.free.strain > POOR_STRAIN
    return chi2, light_left, core_flux, poor, checks


def _noise_check(white, model, part):
    """Measure the robust rms of a whitened residual without sources, and its correlation; NaN without sky."""
    is_free = part.arrays.usable & (np.abs(model) < _FREE)
    if np.count_nonzero(is_free) < _FEWEST_PIXELS:
        return np.nan, np.nan
    rms = float(mad_std(white[is_free]))
    if not rms > 0:
        return rms, np.nan
    # products of neighboring pixels along x and y, over the variance
    calm = is_free & (np.abs(white) < 5 * rms)
    products = []
    for first, second in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        calm_pairs = calm[first] & calm[second]
        products.append(np.mean(white[first][calm_pairs] * white[second][calm_pairs], dtype=float))
    return rms, float(np.mean(products) / np.mean(white[calm] ** 2, dtype=float))


def _covariances(fit):
    """Calculate covariances by noise, templates and PSF, that of the common parameters, and blending."""
    blending = nans(len(fit.xy))
    if not len(fit.rows):
        return [], None, blending
    filling = fit.noise_filling()
    if filling is None and fit.free is not None:
        filling = fit.free.white_filling()
    noise, template, common, row_blending = row_covariances(fit, fit.xy[fit.rows], filling)
    blending[fit.rows] = row_blending
    psf = psf_covariance(fit, fit.cutouts(), noise)
    return [noise, template, psf], common, blending


def _flags(fit, place, n_all, flux, blending, poor):
    """Return flags of all sources, and the fraction of each template on the exposure that shows most of it."""
    flags, coverage = flags_of_light(fit.light, place, n_all)
    add_fit_flags(flags, fit, place, blending, poor)
    add_no_data(flags, flux)
    return flags, coverage


def _exposures(fit, images, models, residuals, inverse, common, checks, offsets):
    """Make the `ExposureResults` of a fit."""
    table = QTable({"exposure": np.arange(len(images))})
    table["source"] = [str(image.meta.get("source", k)) for k, image in enumerate(images)]
    table["n_sources"] = list(map(_n_seen, fit.parts))
    # the constant term of each exposure's sky
    first = [places["sky"].start for places in fit.places]
    errors = nans(len(fit.common))
    if common is not None:
        errors = np.sqrt(np.diag(common))
    table["sky"] = fit.common[first] * SURFACE_BRIGHTNESS
    table["sky_err"] = errors[first] * SURFACE_BRIGHTNESS
    table["offset_east"], table["offset_north"] = offsets[0].T * ANGLE
    table["offset_err"] = offsets[1] * ANGLE
    table["noise"], table["correlation"] = np.transpose(checks)
    _warn_of_offsets(fit, offsets)
    for row in table:
        if abs(row["noise"] - 1) > _OTHER_NOISE:
            msg = (
                f"exposure {row['exposure']} ({row['source']}): noise between the sources is {row['noise']:.3g} "
                "times its stated errors, and so are the errors of fluxes"
            )
            warn(msg, PhotometryWarning)
    model_images = []
    residual_images = []
    for k, part in enumerate(fit.parts):
        # images of this exposure in MJy/sr
        sky = fit.sky(k) / part.arrays.areas()
        usable = part.arrays.usable
        model, residual = _images_of(
            models[k] + sky, residuals[k], usable, inverse[k], part.arrays.wcs, images[k].meta
        )
        model_images.append(model)
        residual_images.append(residual)
    return ExposureResults(table, tuple(model_images), tuple(residual_images))


def _images_of(model, residual, usable, inverse_sigma, wcs, meta):
    """Model and residual as images in MJy/sr; the residual is NaN where there are no data."""
    with np.errstate(divide="ignore"):
        sigma = np.where(usable, 1 / inverse_sigma, np.nan)
    residual = np.where(usable, residual, np.nan)
    noise = StdDevUncertainty(sigma)
    options = {"unit": SURFACE_BRIGHTNESS, "wcs": wcs}
    facts = {key: meta[key] for key in ("filter", "source") if key in meta}
    return (
        Image(model, meta=facts, **options),
        Image(residual, mask=~usable, uncertainty=noise, meta=dict(facts), **options),
    )


def _warn_of_offsets(fit, offsets):
    """Warn of exposures that lie off their templates, if sources are bright and no shift is fitted."""
    if fit.settings.max_shift is not None or not len(fit.rows):
        return
    snr = fit.fit.flux * np.sqrt(fit.fit.matrix.diagonal())
    offset = lengths(offsets[0])
    far = (offset > WARNED_OFFSET * fit.scale) & (offset > 3 * offsets[1])
    if far.any() and np.count_nonzero(snr > BRIGHT_SNR) >= FEWEST_BRIGHT:
        msg = (
            f"{np.count_nonzero(far)} exposures lie up to {offset[far].max():.3f} arcsec from their templates: "
            "'max_shift' fits that"
        )
        warn(msg, PhotometryWarning)


def _n_seen(part):
    """Count the sources that are on an exposure."""
    ny, nx = part.arrays.flux.shape
    x, y = part.bank.sources.xy.T
    return int(np.count_nonzero((x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)))
