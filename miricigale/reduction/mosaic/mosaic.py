"""Dithers to one image by drizzling."""

import dataclasses

import drizzle
import numpy as np
from astropy.nddata import CCDData
from astropy.wcs import NoConvergence
from astropy.wcs.utils import proj_plane_pixel_area
from drizzle.resample import Drizzle
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import distance_transform_edt

from miricigale.instrument import DQ, ExposureHistory, ImageFacts
from miricigale.instrument.sky_axes import pixel_to_radec, radec_axes
from miricigale.reduction.images.files import PLANES
from miricigale.reduction.images.images import (
    check_images,
    check_overlap,
    flagged_image,
    overlaps,
    plain_mask,
    sigma,
)
from miricigale.utils import sep_tools
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import listed_images
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.values import value_class

# pixels of the boxes by which the variance that gives weights is smoothed
_WEIGHT_BOX = 32
# share of the area of a map of pixels that is covered at least, but for so many pixels of the grid
_LEAST_COVERED = 0.7
_FEW_PIXELS = 25
# nodes of the grid on which a distorted WCS is evaluated; between them bicubic splines
_NODES = 49


@value_class
class Mosaic:
    """
    A drizzled image.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Surface brightness in the unit of the inputs, with uncertainty, mask and WCS.
    weight : `~numpy.ndarray` of float32, shape (ny, nx)
        Sum of the inverse variances that went into each pixel (area-weighted).
    n_images : `~numpy.ndarray` of uint8, shape (ny, nx)
        Number of inputs that touch each pixel.
    variances : dict of str to `~numpy.ndarray`
        Parts of the variance of a pixel (``VAR_POISSON``, ``VAR_RNOISE``, ``VAR_FLAT``) that all inputs have.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> field = SkyCoord(53, -27, unit="deg")
    >>> wcs = north_up_wcs(field, 0.11 * u.arcsec, (100, 100))
    >>> rng = np.random.default_rng(1)
    >>> error = StdDevUncertainty(np.full((100, 100), 0.1))
    >>> images = [
    ...     CCDData(
    ...         rng.normal(level, 0.1, (100, 100)),
    ...         unit="MJy/sr",
    ...         uncertainty=error,
    ...         wcs=wcs,
    ...     )
    ...     for level in (5.0, 5.2, 5.1)
    ... ]
    >>> from miricigale.reduction import drizzle_images
    >>> drizzle_images(images, wcs)
    <Mosaic 100 x 100 pixels of 3 images>
    """

    image: CCDData
    weight: np.ndarray
    n_images: np.ndarray
    variances: dict = dataclasses.field(default_factory=dict)

    def __repr__(self):
        ny, nx = self.weight.shape
        return f"<Mosaic {ny} x {nx} pixels of {int(self.n_images.max())} images>"


def pixel_maps_of(images, wcs):
    """Return the `pixel_map` of each of some images on a grid."""
    return [pixel_map(image.wcs, wcs, image.shape) for image in images]


def pixel_map(wcs_in, wcs_out, shape):
    """
    Tell where the pixels of one image lie in another.

    Parameters
    ----------
    wcs_in, wcs_out : `~astropy.wcs.WCS`
        Distorted or not.
    shape : tuple of int
        ``(ny, nx)`` of the first image.

    Returns
    -------
    x, y : `~numpy.ndarray`, shape (ny, nx)
        Coordinates in the second image. Polynomial distortion is evaluated on a grid of 49
        x 49 nodes and interpolated by bicubic splines (1e-5 pixels or better); tables of
        distortion are followed pixel by pixel. NaN on the other side of the sky.

    Raises
    ------
    ValueError
        If the distortion of ``wcs_out`` cannot be inverted there.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> field = SkyCoord(53, -27, unit="deg")
    >>> wcs = north_up_wcs(field, 0.11 * u.arcsec, (100, 100))
    >>> rng = np.random.default_rng(1)
    >>> error = StdDevUncertainty(np.full((100, 100), 0.1))
    >>> images = [
    ...     CCDData(
    ...         rng.normal(level, 0.1, (100, 100)),
    ...         unit="MJy/sr",
    ...         uncertainty=error,
    ...         wcs=wcs,
    ...     )
    ...     for level in (5.0, 5.2, 5.1)
    ... ]
    >>> from miricigale.reduction import pixel_map
    >>> finer = north_up_wcs(field, 0.055 * u.arcsec, (200, 200))
    >>> x, y = pixel_map(wcs, finer, (100, 100))
    >>> x[0, :3].round(2)
    array([0.5, 2.5, 4.5])
    """
    ny, nx = shape
    smooth = not any(
        getattr(w, name, None) is not None
        for w in (wcs_in, wcs_out)
        for name in ("cpdis1", "cpdis2", "det2im1", "det2im2")
    )
    if smooth and min(ny, nx) > _NODES:
        nodes_y = np.linspace(0, ny - 1, _NODES)
        nodes_x = np.linspace(0, nx - 1, _NODES)
    else:
        nodes_y = np.arange(ny, dtype=float)
        nodes_x = np.arange(nx, dtype=float)
    grid_x, grid_y = np.meshgrid(nodes_x, nodes_y)
    sky = pixel_to_radec(wcs_in, grid_x.ravel(), grid_y.ravel())
    world = radec_axes(wcs_out, *sky)
    try:
        pixels = wcs_out.all_world2pix(*world, 0)
    except NoConvergence:
        raise argument_error(
            "wcs_out (the grid's wcs)",
            "a WCS whose distortion can be inverted where the image lies",
            "one that diverges there",
        ) from None
    x, y = np.reshape(pixels, (2,) + grid_x.shape)
    if x.shape == (ny, nx):
        return x, y
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        # splines know no NaN; images on the other side of the sky come here
        return nans((2, ny, nx))
    rows = np.arange(ny, dtype=float)
    columns = np.arange(nx, dtype=float)
    x_of_nodes = RectBivariateSpline(nodes_y, nodes_x, x)
    y_of_nodes = RectBivariateSpline(nodes_y, nodes_x, y)
    return x_of_nodes(rows, columns), y_of_nodes(rows, columns)


def weight_map(source):
    """
    Return the inverse variance of an image that does not follow the data of single pixels.

    Parameters
    ----------
    source : `~astropy.nddata.CCDData`
        With uncertainty.

    Returns
    -------
    weight : `~numpy.ndarray` of float32, shape (ny, nx)
        Zero where the image is masked.

    Notes
    -----
    The variance of a pixel is estimated from its own counts: weights by it would favor
    pixels that fluctuated low, and lower the mosaic by about sigma^2 / rate. It is smoothed
    by boxes of 32 pixels (their clipped modes, and medians of 3 x 3 boxes).

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> field = SkyCoord(53, -27, unit="deg")
    >>> wcs = north_up_wcs(field, 0.11 * u.arcsec, (100, 100))
    >>> rng = np.random.default_rng(1)
    >>> error = StdDevUncertainty(np.full((100, 100), 0.1))
    >>> images = [
    ...     CCDData(
    ...         rng.normal(level, 0.1, (100, 100)),
    ...         unit="MJy/sr",
    ...         uncertainty=error,
    ...         wcs=wcs,
    ...     )
    ...     for level in (5.0, 5.2, 5.1)
    ... ]
    >>> from miricigale.reduction import weight_map
    >>> print(f"{weight_map(images[0]).mean():.0f} per (MJy/sr)^2")
    100 per (MJy/sr)^2
    """
    mask = plain_mask(source)
    variance = np.square(np.asarray(sigma(source), float))
    bad = mask | ~np.isfinite(variance) | (variance <= 0)
    if bad.all():
        return np.zeros(mask.shape, np.float32)
    typical = np.median(variance[~bad])
    smooth, _ = sep_tools.background(variance / typical, bad, _WEIGHT_BOX)
    # the spline between boxes may overshoot: weights stay within a factor of ten
    smooth = np.clip(smooth, 0.1, 10.0) * typical
    return np.where(bad, 0.0, 1.0 / smooth).astype(np.float32)


@takes_other_keywords
def noise_correction(pixfrac, ratio):
    """
    Return the noise of large areas of a drizzled image over what its pixels' noise says.

    Parameters
    ----------
    pixfrac : float
        Side of the drops in input pixels.
    ratio : float
        Side of an output pixel over that of an input pixel.

    Returns
    -------
    factor : float
        At least 1: drizzling correlates neighbors, so that the sum over N pixels is this
        factor noisier than the pixels' errors in quadrature.

    References
    ----------
    Fruchter & Hook 2002, PASP 114, 144, eqs. 9 and 10.

    Examples
    --------
    >>> from miricigale.reduction import noise_correction
    >>> print(f"{noise_correction(pixfrac=1.0, ratio=0.06 / 0.11):.2f}")
    2.24
    """
    r = pixfrac / ratio
    if r >= 1:
        return r / (1 - 1 / (3 * r))
    return 1 / (1 - r / 3)


@takes_other_keywords
def drizzle_images(images, wcs, *, pixfrac=1.0, weights=None, pixel_maps=None, variances=()):
    """
    Drizzle images onto one grid.

    Parameters
    ----------
    images : list of `~astropy.nddata.CCDData`
        Surface brightness in one unit, with uncertainty and WCS; masked pixels get no
        weight.
    wcs : `~astropy.wcs.WCS`
        Of the output, with its ``pixel_shape``.
    pixfrac : float, optional
        Side of the drops in input pixels, 0-1.
    weights : list of `~numpy.ndarray`, optional
        Weight of each pixel, none where it is masked or NaN; by default `weight_map`.
    pixel_maps : list of (x, y), optional
        Results of `pixel_map`, if they are there already. Pixels whose place is not finite have no weight.
    variances : list of dict of str to `~numpy.ndarray`, optional
        Parts of the variance of each image by name, as the planes of an `ImageFile`; they go through as
        the variance does.

    Returns
    -------
    mosaic : `Mosaic`
        The brightness is the area- and weight-weighted mean (square kernel), so that the
        sum of brightness times pixel area is conserved. Variances go through with squared
        weights. ``image.meta["noise_correction"]`` says by how much sums over many
        pixels are noisier than these variances state (`noise_correction`).

    Raises
    ------
    ValueError
        If there are no images, they are not surface brightness of one unit and filter, or
        the output has no shape or lies elsewhere on the sky; or if drizzle covers less than 0.7 of the area of
        an image's map of pixels.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> field = SkyCoord(53, -27, unit="deg")
    >>> wcs = north_up_wcs(field, 0.11 * u.arcsec, (100, 100))
    >>> rng = np.random.default_rng(1)
    >>> error = StdDevUncertainty(np.full((100, 100), 0.1))
    >>> images = [
    ...     CCDData(
    ...         rng.normal(level, 0.1, (100, 100)),
    ...         unit="MJy/sr",
    ...         uncertainty=error,
    ...         wcs=wcs,
    ...     )
    ...     for level in (5.0, 5.2, 5.1)
    ... ]
    >>> from miricigale.reduction import drizzle_images
    >>> finer = north_up_wcs(field, 0.06 * u.arcsec, (180, 180))
    >>> mosaic = drizzle_images(images, finer)
    >>> print(f"{np.nanmean(mosaic.image.data):.2f} MJy/sr")
    5.10 MJy/sr
    """
    images = listed_images(images)
    check_images(images, wcs)
    check_that(0 < pixfrac <= 1, "pixfrac", "above 0 and at most 1", pixfrac)
    shape = tuple(map(int, wcs.pixel_shape[::-1]))
    if pixel_maps is None:
        pixel_maps = pixel_maps_of(images, wcs)
    check_overlap(pixel_maps, shape)
    if weights is None:
        weights = [weight_map(im) for im in images]
    else:
        weights = [floats(weight) for weight in weights]
        weights = [np.where(np.isnan(weight), 0.0, weight) for weight in weights]
    unit_weight = _typical_weight(weights)
    variances = list(variances) or [{}] * len(images)
    names = []
    for name in PLANES[:3]:
        if all(name in image_variances for image_variances in variances):
            names.append(name)
    grid = _DrizzledGrid(wcs, shape, pixfrac)
    for im, image_variances, weight, pixel_map in zip(
        images, variances, weights, pixel_maps, strict=True
    ):
        planes = [np.square(np.asarray(sigma(im), float))]
        planes += [floats(image_variances[name]) for name in names]
        grid.add(im, weight / unit_weight, pixel_map, planes)
    data, weight, parts = grid.planes(1 + len(names))
    covered = (weight > 0) & np.isfinite(data)
    out = flagged_image(
        np.where(covered, data, np.nan),
        images[0].unit,
        error=np.sqrt(np.where(covered, parts[0], np.nan)),
        flags=np.where(covered, 0, int(DQ.NON_SCIENCE | DQ.DO_NOT_USE)),
        wcs=wcs,
        meta=_drizzled_meta(images, weights, wcs, pixfrac),
    )
    weight = (weight * np.float32(unit_weight)).astype(np.float32)
    return Mosaic(out, weight, grid.n_images, dict(zip(names, parts[1:], strict=True)))


def _typical_weight(weights):
    """Return the median weight of images: drizzle works in float32, with weights that are near one."""
    medians = []
    for weight in weights:
        is_used = weight > 0
        if np.any(is_used):
            medians.append(np.median(weight[is_used]))
    if not medians:
        return 1.0
    return float(np.median(medians))


class _DrizzledGrid:
    """Pixels of a grid of the shape (ny, nx), onto which images are drizzled one after the other."""

    def __init__(self, wcs, shape, pixfrac):
        self._wcs = wcs
        self._shape = shape
        self._pixfrac = pixfrac
        self._sink = Drizzle(
            kernel="square", fillval="NAN", fillval2="NAN", out_shape=shape, disable_ctx=True
        )
        self._weight_before = np.zeros(shape, np.float32)
        #: images that reach each pixel
        self.n_images = np.zeros(shape, np.uint8)

    def add(self, image, weight, pixel_map, planes):
        """Add an image with its weights, the places (x, y) of its pixels and the variances ``planes``."""
        x, y = pixel_map
        nowhere = ~(np.isfinite(x) & np.isfinite(y))
        if nowhere.all():
            return
        if nowhere.any():
            x = _filled(x, nowhere)
            y = _filled(y, nowhere)
        # an image of many may reach a small part of the grid
        part = extent_of((x, y), self._shape)
        weight = np.where(plain_mask(image) | nowhere, 0.0, weight).astype(np.float32)
        if part is None or not weight.any():
            return
        planes = [np.where(weight > 0, plane, 0.0).astype(np.float32) for plane in planes]
        add_image(self._sink, image, weight, (x, y), self._wcs, self._pixfrac, data2=planes)
        weight_now = self._sink.out_wht[part]
        touched = weight_now > self._weight_before[part]
        _check_covered(touched, (x, y), weight > 0, self._shape, self._pixfrac)
        self.n_images[part] += touched
        self._weight_before[part] = weight_now

    def planes(self, n_variances):
        """Mean, weight and so many variances of each pixel; NaN and no weight where nothing was added."""
        if self.n_images.any():
            return self._sink.out_img, self._sink.out_wht, self._sink.out_img2
        data = np.full(self._shape, np.nan, np.float32)
        return data, np.zeros(self._shape, np.float32), [data] * n_variances


def _drizzled_meta(images, weights, wcs, pixfrac):
    """Return what the images say of themselves, put together, and what drizzling does to their noise."""
    usable = []
    for im, weight in zip(images, weights, strict=True):
        # the time of an exposure without any usable pixel does not count
        if np.any((weight > 0) & ~plain_mask(im)):
            usable.append(im)
    ratio = _scale(wcs) / float(np.mean([_scale(im.wcs) for im in images]))
    before_drizzle = float(np.mean([ImageFacts.of(im).noise_correction for im in images]))
    return _meta(usable or images) | {
        "pixfrac": float(pixfrac),
        "pixel_scale": _scale(wcs) * 3600,
        "noise_correction": noise_correction(pixfrac, ratio) * before_drizzle,
    }


def _check_covered(touched, pixel_map, weighted, shape, pixfrac):
    """
    Refuse a mosaic in which the area of an image is not that of its map of pixels.

    Versions of drizzle have left out half of an image, or all of it, for one pixel of a map. ``touched`` are the
    pixels of the grid that got some light, ``weighted`` those of the image that have a weight.
    """
    x, y = pixel_map
    ny, nx = shape
    if min(x.shape) < 2:
        return
    area = _pixel_area(x, y)
    # whole pixels within the grid
    reach = 0.5 * np.sqrt(area)
    inside = weighted & (x > reach) & (x < nx - 1 - reach) & (y > reach) & (y < ny - 1 - reach)
    expected = np.count_nonzero(inside) * area * pixfrac**2
    covered = np.count_nonzero(touched)
    if covered < _LEAST_COVERED * expected - _FEW_PIXELS:
        wanted = f"a map that drizzle {drizzle.__version__} follows"
        got = f"one of {expected:.0f} pixels of the grid, of which {covered} are covered"
        raise argument_error("pixel_maps", wanted, got)


def _pixel_area(x, y):
    """Return the typical area of a pixel of an image in pixels of the grid, by its map."""
    rows = np.arange(0, x.shape[0] - 1, 16)[:, None]
    columns = np.arange(0, x.shape[1] - 1, 16)
    along = x[rows, columns + 1] - x[rows, columns], y[rows, columns + 1] - y[rows, columns]
    across = x[rows + 1, columns] - x[rows, columns], y[rows + 1, columns] - y[rows, columns]
    return float(np.median(np.abs(along[0] * across[1] - along[1] * across[0])))


def _filled(values, nowhere):
    """
    Return the coordinates with finite ones where there are none.

    drizzle leaves out far more than the pixels of a map that are NaN, and takes corners of pixels from their
    neighbors: they are filled by a plane through the others and what the nearest of these is off it.
    """
    y, x = np.nonzero(~nowhere)
    terms = np.stack([np.ones(x.size), x, y], axis=1)
    plane = np.linalg.lstsq(terms, values[~nowhere], rcond=None)[0]
    rows, columns = np.indices(values.shape)
    smooth = plane[0] + plane[1] * columns + plane[2] * rows
    nearest = distance_transform_edt(nowhere, return_distances=False, return_indices=True)
    return np.where(nowhere, smooth + (values - smooth)[tuple(nearest)], values)


def add_image(sink, im, weight, pixel_map, wcs, pixfrac=1.0, **planes):
    """Drizzle an image onto a grid."""
    sink.add_image(
        np.where(weight > 0, im.data, 0.0).astype(np.float32),
        exptime=1.0,
        pixmap=np.dstack(pixel_map),
        weight_map=weight,
        pixfrac=float(pixfrac),
        pixel_scale_ratio=_scale(wcs) / _scale(im.wcs),
        in_units="cps",
        **planes,
    )


def extent_of(pixel_map, shape):
    """Return the rows and columns of a grid that an image reaches, or None: it lies beside the grid."""
    if not overlaps(pixel_map, shape):
        return None
    x, y = pixel_map
    return _reached(y, shape[0]), _reached(x, shape[1])


def _reached(values, n):
    """Return the rows or columns out of ``n`` around coordinates, with a margin for the sides of pixels."""
    low = np.nanmin(values) - 2
    high = np.nanmax(values) + 3
    return slice(max(0, int(low)), min(n, int(high) + 1))


def _scale(wcs):
    """Return the side of a pixel at the reference position, deg."""
    return float(np.sqrt(proj_plane_pixel_area(wcs)))


def _meta(images):
    """Return what the inputs say of themselves, put together."""
    metas = [im.meta for im in images]
    meta = {"n_exposures": len(images)}
    common = set(metas[0]).intersection(*metas)
    for key in ("exposure_time", "n_negative", "n_outliers"):
        if key in common:
            meta[key] = sum(m[key] for m in metas)
    for key in ("pa_aper", "dither", "background", "background_error", "background_flags"):
        if key in common:
            meta[key] = [m[key] for m in metas]
    keywords = _shared_keywords([m.get("keywords", {}) for m in metas])
    if keywords is not None:
        meta["keywords"] = keywords
    done = frozenset.intersection(*(ExposureHistory.of(im).steps for im in images))
    meta["steps"] = sorted(done | {"resample"})
    for key in metas[0]:
        if key not in meta and all(m.get(key) == metas[0][key] for m in metas):
            meta[key] = metas[0][key]
    return meta


def _shared_keywords(of_images):
    """Return the cards that all images have alike, without the area of their pixels; None if none has any."""
    if not any(of_images):
        return None
    shared = {}
    for key, card in of_images[0].items():
        is_shared = all(keywords.get(key) == card for keywords in of_images)
        if is_shared and not key.startswith("PIXAR"):
            shared[key] = card
    return shared
