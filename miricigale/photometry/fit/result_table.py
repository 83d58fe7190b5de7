"""From a fit in the order of its templates to the result in the order of the catalog."""

import itertools

import numpy as np
import scipy.sparse
from astropy.coordinates import SkyCoord
from astropy.nddata import StdDevUncertainty
from astropy.stats import gaussian_sigma_to_fwhm
from astropy.table import QTable
from astropy.units import Quantity

from miricigale.instrument.image import Image
from miricigale.photometry.detection.residual_sources import unexplained_neighbors
from miricigale.photometry.fit.diagnostics import canceling, source_flags
from miricigale.photometry.fit.results import ForcedPhotometryResult, crowded
from miricigale.photometry.fit.template_fit import fit_covariances
from miricigale.photometry.images.arrays import pixels_to_sky
from miricigale.photometry.images.fields import SmoothField
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.utils.arrays import nans, spread_over
from miricigale.utils.exceptions import PhotometryWarning, warn
from miricigale.utils.meta import provenance
from miricigale.utils.parallel import chunks
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS
from miricigale.utils.values import value_class

#: Names of the errors of a flux after ``flux_err``: their sum, and its terms.
_TERMS = ("", "_noise", "_template", "_psf")

#: Least offset (pixels) that is warned of.
WARNED_OFFSET = 0.1

#: Fewest bright sources, and their signal-to-noise, with which offsets are warned of.
FEWEST_BRIGHT = 5
BRIGHT_SNR = 10.0

#: Relative error of templates.
_TEMPLATE_ERROR = 0.1


def warn_of_none(sources, near_rows, where):
    """Warn if none of the sources is on or near an image or exposures."""
    n = len(sources.id)
    if n and not len(near_rows):
        msg = f"none of the {n} sources is on or near {where}: nothing is measured"
        warn(msg, PhotometryWarning)


@value_class(kw_only=True)
class CatalogRows:
    """The sources of a catalog, as far as they are known before the fit."""

    #: As in `~miricigale.photometry.ForcedPhotometryResult`, shape (n,).
    id: np.ndarray
    sky: SkyCoord
    flags: np.ndarray
    template: np.ndarray
    template_snr: np.ndarray
    xy: np.ndarray  # (n, 2): Positions on the image; NaN far outside.
    near_rows: (
        np.ndarray
    )  # (k,): The sources that have a template, in the order of the bank's sources.
    fitted: np.ndarray  # (k,): What is known of the shapes of these.
    #: Fluxes by which crowded sources are found; None for those that are measured.
    reference: np.ndarray | None = None
    #: Which sources have two components; None where their fits decide.
    double: np.ndarray | None = None

    @classmethod
    def of(cls, sources, xy, near_rows, templates):
        """
        Make the rows of sources at pixels (x, y), (n, 2).

        ``sources`` and ``templates`` are `~miricigale.photometry.SourceTemplates`: of the whole catalog, and of
        the sources of ``near_rows``, (k,).
        """
        n = len(sources.id)
        # sources far off have no template
        flags = np.zeros(n, int)
        snr = nans(n)
        kinds = np.full(n, "none", "U6")
        flags[near_rows] = templates.flags
        snr[near_rows] = templates.snr
        kinds[near_rows] = templates.kind
        double = None
        if sources.components is not None:
            double = sources.components == 2
        return cls(
            id=np.asarray(sources.id),
            sky=sources.sky,
            xy=xy,
            near_rows=near_rows,
            flags=flags,
            template=kinds,
            template_snr=snr,
            fitted=templates.fitted,
            reference=sources.flux,
            double=double,
        )


@value_class
class NewSources:
    """Sources that a catalog lacks, as a `~miricigale.photometry.ForcedPhotometryResult` has them."""

    new_sources: QTable  # Their ``sky`` alone.
    psf_fwhm: Quantity
    meta: dict  # ``second_pass``, the evidence for them.

    @classmethod
    def of(cls, fit, xy, catalog):
        """Make those at pixels (x, y), (m, 2), of a fit."""
        sky = pixels_to_sky(xy, fit.arrays.wcs).transform_to(catalog.sky.frame)
        return cls(QTable({"sky": sky}), _full_width(fit), {"second_pass": fit.evidence})


def _full_width(fit):
    """Return the full width at half maximum of a fit's PSF."""
    return gaussian_sigma_to_fwhm * fit.psf_width * fit.scale * ANGLE


def package(fit, diagnostics, new_xy, catalog, meta):
    """
    Make the `ForcedPhotometryResult` of a fit.

    ``fit``, ``diagnostics`` and ``new_xy``, (m, 2), are what `~miricigale.photometry.fit.fit_loop.fit_image`
    returns, ``catalog`` are the `CatalogRows`, ``meta`` is provenance: the ``template``, and the
    ``filter`` if that is known.
    """
    n = len(catalog.sky)
    n_columns = len(fit.columns)
    n_all = n + len(new_xy)
    # sources that were added have the last numbers, after second components
    owner = np.full(len(fit.host), -1)
    owner[: len(catalog.near_rows)] = catalog.near_rows
    owner[len(owner) - len(new_xy) :] = np.arange(n, n_all)
    place = owner[fit.host[fit.bank.order]]
    main = fit.main
    # what was not measured is NaN
    common = nans((n_columns, n_columns))
    blending = nans(len(place))
    flux = nans(n_all)
    flux_err = nans((4, n_all))
    joint = scipy.sparse.csr_array((2 * n_all, 2 * n_all))
    if len(fit.rows):
        *covariances, common, blending[fit.rows] = fit_covariances(fit, diagnostics.correlation)
        terms = [
            _by_source(covariance, place[fit.rows], main[fit.rows], n_all)
            for covariance in covariances
        ]
        # total fluxes stand in the rows of the first components
        measured = fit.rows[main[fit.rows]]
        flux[place[measured]] = fit.total[measured]
        joint, flux_err = joint_errors(terms, place[measured], n_all)
    flags, coverage = source_flags(fit, diagnostics, place, flux, blending)
    xy = np.concatenate([catalog.xy, new_xy])
    has_neighbor = unexplained_neighbors(diagnostics.peaks, xy + fit.displacement(xy), flux)
    core_flux = spread_over(diagnostics.core_flux[main], place[main], n_all)
    add_flags(flags, catalog, has_neighbor, flux, flux_err, core_flux)
    columns = {"flags": flags, "coverage": coverage}
    for name in ("chi2", "residual_fraction"):
        columns[name] = spread_over(getattr(diagnostics, name)[main], place[main], n_all)
    columns |= flux_columns(flux, flux_err)
    image_meta = {}
    if "filter" in meta:
        image_meta["filter"] = meta["filter"]
    evidence = {}
    if fit.evidence is not None:
        evidence["second_pass"] = fit.evidence
    return result_of_columns(
        catalog,
        new_xy,
        fit.arrays.wcs,
        columns,
        second_pass=fit.settings.second_pass,
        covariance=joint[:n, :n],
        noise_correlation=diagnostics.correlation,
        psf_fwhm=_full_width(fit),
        meta=provenance(
            **meta,
            pixel_scale=round(fit.scale, 6),
            correlated_noise=diagnostics.correlation is not None,
            measured_noise=fit.arrays.measured_noise,
            pixel_scatter=round(diagnostics.pixel_scatter, 4),
            **_registration(fit, diagnostics, common, np.sum(flux > BRIGHT_SNR * flux_err[0])),
            **evidence,
        ),
        **_components(fit, catalog, joint, place, n_all),
        **_common(fit, common),
        **_images(fit, diagnostics, image_meta),
    )


def joint_errors(terms, rows, n):
    """
    Add covariances of noise, templates and PSF, which are independent.

    Parameters
    ----------
    terms : list of `~scipy.sparse.csr_array`
        The three.
    rows : `~numpy.ndarray` of int
        Sources that were measured, of ``n``.

    Returns
    -------
    joint : `~scipy.sparse.csr_array`
        Their sum.
    flux_err : `~numpy.ndarray`, shape (4, n)
        Errors of the sum, then of each; NaN where nothing was measured.
    """
    joint = terms[0] + terms[1] + terms[2]
    flux_err = [
        spread_over(np.sqrt(np.maximum(term.diagonal()[rows], 0.0)), rows, n)
        for term in (joint, *terms)
    ]
    return joint, np.array(flux_err)


def add_flags(flags, catalog, has_neighbor, flux, flux_err, core_flux):
    """
    Add the flags of a catalog and those that depend on fluxes, in place.

    Parameters
    ----------
    flags : `~numpy.ndarray` of int, shape (n,)
        Of the catalog's sources, then of new ones.
    catalog : `CatalogRows`
        The catalog.
    has_neighbor : `~numpy.ndarray` of bool, shape (n,)
        Which have an unexplained neighbor.
    flux, core_flux : `~numpy.ndarray`, shape (n,)
        Fluxes, and those in the cores.
    flux_err : `~numpy.ndarray`, shape (4, n)
        Errors, as of `joint_errors`.
    """
    n = len(catalog.id)
    flags[:n] |= catalog.flags
    flags[n:] |= ForcedFlags.NOT_IN_CATALOG
    flags[has_neighbor & np.isfinite(flux)] |= ForcedFlags.UNEXPLAINED_NEIGHBOR
    flags[canceling(flux, flux_err[0], core_flux)] |= ForcedFlags.CANCELING


def flux_columns(flux, flux_err):
    """Return columns of fluxes (uJy) and of their errors, (4, n) as of `joint_errors`: dict of `Quantity`."""
    columns = {"flux": flux * FNU}
    for name, error in zip(_TERMS, flux_err, strict=True):
        columns[f"flux_err{name}"] = error * FNU
    return columns


def result_of_columns(catalog, new_xy, wcs, columns, *, second_pass, **others):
    """
    Make a `ForcedPhotometryResult` of columns of all sources, first those of a catalog, then new ones.

    Parameters
    ----------
    catalog : `CatalogRows`
        The catalog.
    new_xy : `~numpy.ndarray`, shape (m, 2)
        Pixels of the sources that it lacks.
    wcs : `~astropy.wcs.WCS`
        Of these pixels.
    columns : dict of array
        ``flux``, ``flags``, ``coverage`` and others by name, shape (n + m,).
    second_pass : bool
        Whether new sources were looked for, so that there is a table of them without any too.
    **others
        The other fields of the result.
    """
    n = len(catalog.id)
    new = None
    if second_pass or len(new_xy):
        names = ("flux", "flux_err", "flags", "coverage", "chi2")
        rows = {name: columns[name][n:] for name in names}
        new = new_source_table(catalog, new_xy, wcs, rows)
    reference = catalog.reference
    if reference is None:
        reference = np.nan_to_num(columns["flux"][:n].value)
    return ForcedPhotometryResult(
        id=np.array(catalog.id),
        sky=catalog.sky,
        template=catalog.template,
        template_snr=catalog.template_snr,
        crowded=crowded(catalog.sky, reference),
        x=catalog.xy[:, 0].copy(),
        y=catalog.xy[:, 1].copy(),
        new_sources=new,
        **{name: values[:n] for name, values in columns.items()},
        **others,
    )


def _registration(fit, diagnostics, common, n_bright):
    """
    Measure how far the image lies from the prior, with its error, arcsec along x and y: for the meta dictionary.

    The shift that was fitted, the mean of the sources of a map, or else what the residuals show, to first order:
    then the error is the jackknife's over strips of rows, which has errors of single templates in it, and there
    is a warning of what a fitted shift would have mended, if sources are bright.
    """
    if fit.shift is not None:
        return _offset_meta(fit.shift, _common_errors(fit, common, "shift") * fit.scale)
    if fit.offset_map is not None:
        table = fit.offset_map.sources[fit.offset_map.sources["used"]]
        values = np.stack([table["dx"].value, table["dy"].value])
        return _offset_meta(values.mean(axis=1), values.std(axis=1) / np.sqrt(len(table)))
    model = diagnostics.model
    sums = []
    for part in chunks(len(model), int(np.clip(len(model) // 16, 4, 256))):
        # a row more on both sides for the gradient
        first = max(part.start - 1, 0)
        last = min(part.stop + 1, len(model))
        inner = slice(part.start - first, part.stop - first)
        weight = fit.inverse_sigma[part]
        # templates have errors too: the brightest shall not decide alone
        weight = weight / np.hypot(1.0, _TEMPLATE_ERROR * model[part] * weight)
        # columns of a fit of a shift: derivatives of the model to x and y, and the residual
        slope_y, slope_x = np.gradient(model[first:last])
        columns = [-slope_x[inner], -slope_y[inner], diagnostics.residual[part]]
        columns = (np.stack(columns) * weight).reshape(3, -1)
        sums.append(columns @ columns.T)
    sums = np.array(sums, float)
    # of all strips, and of all but each
    sums_of_strips = np.concatenate([[sums.sum(axis=0)], sums.sum(axis=0) - sums])
    # least squares for the shift, of all strips and without each
    normal = sums_of_strips[:, :2, :2]
    if np.linalg.det(normal).min() <= 0:
        return {}
    offsets = np.linalg.solve(normal, sums_of_strips[:, :2, 2:])[..., 0]
    offset = offsets[0]
    without = offsets[1:]
    # the jackknife's error
    error = np.sqrt((len(sums) - 1) * np.var(without, axis=0))
    far = (
        np.any((np.abs(offset) > WARNED_OFFSET) & (np.abs(offset) > 3 * error))
        and n_bright >= FEWEST_BRIGHT
    )
    # a shift that was asked for and is too large has a warning of its own
    if far and fit.settings.max_shift is None:
        x, y = offset * fit.scale
        msg = f"the image lies about {x:+.3f}, {y:+.3f} arcsec (x, y) from its templates: 'max_shift' fits that"
        warn(msg, PhotometryWarning)
    return _offset_meta(offset * fit.scale, error * fit.scale)


def _offset_meta(offset, error):
    """Return offset and error in arcsec as plain values."""
    return {"offset": offset.round(5).tolist(), "offset_err": error.round(5).tolist()}


def _by_source(covariance, place, main, n):
    """Return the covariance of sources' total fluxes, and after them of their second components, (2 n, 2 n)."""
    k = np.arange(len(place))
    rows = np.concatenate([place, n + place[~main]])
    # sums of both components, and the second ones alone
    gather = scipy.sparse.coo_array(
        (np.ones(len(rows)), (rows, np.concatenate([k, k[~main]]))), shape=(2 * n, len(k))
    ).tocsr()
    total = (gather @ covariance @ gather.T).tocsr()
    total.sort_indices()
    return total


def _components(fit, catalog, joint, place, n_all):
    """Return fluxes of points on top of templates, if any were asked for."""
    if catalog.double is None and fit.settings.components == 1:
        return {}
    n = len(catalog.sky)
    flux = nans(n)
    error = nans(n)
    second = fit.pairs[:, 1]
    flux[place[second]] = fit.flux[second]
    error[place[second]] = np.sqrt(joint.diagonal()[n_all + place[second]])
    keep = np.concatenate([np.arange(n), n_all + np.arange(n)])
    return {
        "flux_point": flux * FNU,
        "flux_point_err": error * FNU,
        "joint_covariance": joint[keep][:, keep],
    }


def new_ids(ids, n):
    """Make ids of ``n`` sources, (n,), that are not among ``ids``, and of their kind."""
    if ids.dtype.kind in "iu":
        return int(ids.max(initial=0)) + 1 + np.arange(n)
    taken_ids = set(ids.tolist())
    if n == 0:
        return ids[:0]
    new = []
    for k in itertools.count(1):
        name = f"new-{k}"
        if name not in taken_ids:
            new.append(name)
        if len(new) == n:
            return np.array(new)


def new_source_table(catalog, xy, wcs, columns):
    """Make the table of sources at pixels (x, y), (m, 2), that a catalog (`CatalogRows`) lacks."""
    table = QTable({"id": new_ids(np.asarray(catalog.id), len(xy))})
    table["sky"] = pixels_to_sky(xy, wcs).transform_to(catalog.sky.frame)
    table["x_centroid"], table["y_centroid"] = xy.T
    for name, values in columns.items():
        table[name] = values
    table["snr"] = (table["flux"] / table["flux_err"]).value
    return table


def _common(fit, covariance):
    """Return parameters of the whole image with their errors."""
    parameters = {}
    order = fit.settings.background_order
    shape = fit.arrays.flux.shape
    if order is not None and fit.fit is not None:
        terms = fit.common[fit.places["background"]]
        errors = _common_errors(fit, covariance, "background")
        parameters["background"] = terms[0] * SURFACE_BRIGHTNESS
        parameters["background_err"] = errors[0] * SURFACE_BRIGHTNESS
        parameters["background_field"] = SmoothField(terms, shape, order)
    if fit.shift is not None:
        parameters["shift"] = fit.shift * ANGLE
        parameters["shift_err"] = _common_errors(fit, covariance, "shift") * fit.scale * ANGLE
    if fit.offset_map is not None:
        parameters["offset_map"] = fit.offset_map
    return parameters


def _common_errors(fit, covariance, name):
    """Return errors of the common parameters of a name."""
    return np.sqrt(np.diag(covariance)[fit.places[name]])


def _images(fit, diagnostics, meta):
    arrays = fit.arrays
    # images can be large: what the fit needs no longer becomes the result
    model = diagnostics.model
    residual = diagnostics.residual
    fit.add_background(model)
    sigma = arrays.inverse_sigma
    area = arrays.areas(out=arrays.flux)
    for image in (residual, sigma):
        image[~arrays.usable] = np.nan
    np.divide(1, sigma, out=sigma)
    for image in (model, residual, sigma):
        image /= area
    options = {"unit": SURFACE_BRIGHTNESS, "wcs": arrays.wcs}
    return {
        "model_image": Image(model, meta=dict(meta), **options),
        "residual_image": Image(
            residual, mask=~arrays.usable, uncertainty=StdDevUncertainty(sigma, copy=False),
            meta=dict(meta), **options,
        ),
    }  # fmt: skip
