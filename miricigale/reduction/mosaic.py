"""Dithers to one image: outlier rejection and drizzle."""

import dataclasses

import numpy as np
from astropy.nddata import CCDData
from astropy.wcs import NoConvergence
from astropy.wcs.utils import proj_plane_pixel_area
from drizzle.resample import Drizzle
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import map_coordinates

from miricigale.instrument import DQ, ImageFacts
from miricigale.reduction.images import (
    check_images,
    check_overlap,
    flag_pixels,
    flagged_image,
    overlaps,
    plain_mask,
    sigma,
)
from miricigale.utils import sep_tools
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_positive
from miricigale.utils.parallel import chunks

# rows of a grid of which the median of many images is taken together
_ROWS = 256
# pixels of the boxes by which the variance that gives weights is smoothed
_WEIGHT_BOX = 32
# steepest differences to its neighbors by which a pixel may differ from the other dithers
_DERIVATIVE = 1.2
# nodes of the grid on which a distorted WCS is evaluated; between them bicubic splines
_NODES = 49


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
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
    """

    image: CCDData
    weight: np.ndarray
    n_images: np.ndarray

    def __repr__(self):
        ny, nx = self.weight.shape
        return f"<Mosaic {ny} x {nx} pixels of {int(self.n_images.max())} images>"


def pixel_map(wcs_in, wcs_out, shape):
    """
    Where the pixels of one image lie in another.

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
    """
    ny, nx = shape
    smooth = not any(
        getattr(w, name, None) is not None
        for w in (wcs_in, wcs_out)
        for name in ("cpdis1", "cpdis2", "det2im1", "det2im2")
    )
    if smooth and min(ny, nx) > _NODES:
        nodes_y, nodes_x = (np.linspace(0, n - 1, _NODES) for n in (ny, nx))
    else:
        nodes_y, nodes_x = np.arange(ny, dtype=float), np.arange(nx, dtype=float)
    grid_x, grid_y = np.meshgrid(nodes_x, nodes_y)
    world = wcs_in.all_pix2world(grid_x.ravel(), grid_y.ravel(), 0)
    try:
        found = wcs_out.all_world2pix(*world, 0)
    except NoConvergence:
        wanted = "a WCS whose distortion can be inverted where the image lies"
        raise argument_error(
            "wcs_out (the grid's wcs)", wanted, "one that diverges there"
        ) from None
    x, y = (np.reshape(values, grid_x.shape) for values in found)
    if x.shape == (ny, nx):
        return x, y
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        # splines know no NaN; images on the other side of the sky come here
        return np.full((2, ny, nx), np.nan)
    rows, columns = np.arange(ny, dtype=float), np.arange(nx, dtype=float)
    return tuple(RectBivariateSpline(nodes_y, nodes_x, values)(rows, columns) for values in (x, y))


def weight_map(source):
    """
    Inverse variance of an image that does not follow the data of single pixels.

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


def noise_correction(pixfrac, ratio):
    """
    Noise of large areas of a drizzled image over what its pixels' noise says.

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
    """
    r = pixfrac / ratio
    return r / (1 - 1 / (3 * r)) if r >= 1 else 1 / (1 - r / 3)


def drizzle_images(images, wcs, *, pixfrac=1.0, weights=None, pixel_maps=None):
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
        Weight of each pixel; by default `weight_map`.
    pixel_maps : list of (x, y), optional
        Results of `pixel_map`, if they are there already.

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
        the output has no shape or lies elsewhere on the sky.
    """
    images = list(images)
    check_images(images, wcs)
    if not 0 < pixfrac <= 1:
        raise argument_error("pixfrac", "above 0 and at most 1", pixfrac)
    shape = tuple(int(n) for n in wcs.pixel_shape[::-1])
    if pixel_maps is None:
        pixel_maps = [pixel_map(im.wcs, wcs, im.shape) for im in images]
    check_overlap(pixel_maps, shape)
    weights = [weight_map(im) for im in images] if weights is None else list(weights)
    # drizzle works in float32: weights near one
    positive = [w[w > 0] for w in weights]
    positive = [w for w in positive if w.size]
    unit_weight = float(np.median([np.median(w) for w in positive])) if positive else 1.0

    sink = Drizzle(
        kernel="square", fillval="NAN", fillval2="NAN", out_shape=shape, disable_ctx=True
    )
    n_images = np.zeros(shape, np.uint8)
    before = np.zeros(shape, np.float32)
    for im, weight, (x, y) in zip(images, weights, pixel_maps, strict=True):
        # an image of many may reach a small part of the grid
        part = _extent((x, y), shape)
        weight = np.where(plain_mask(im), 0.0, np.asarray(weight) / unit_weight)
        weight = weight.astype(np.float32)
        if part is None or not weight.any():
            continue
        variance = np.square(np.asarray(sigma(im), float))
        variance = np.where(weight > 0, variance, 0.0).astype(np.float32)
        _add(sink, im, weight, (x, y), wcs, pixfrac, data2=variance)
        n_images[part] += sink.out_wht[part] > before[part]
        before[part] = sink.out_wht[part]

    if n_images.any():
        data, variance, weight = sink.out_img, sink.out_img2[0], sink.out_wht
    else:
        data = np.full(shape, np.nan, np.float32)
        variance, weight = data, np.zeros(shape, np.float32)
    covered = (weight > 0) & np.isfinite(data)
    flags = np.where(covered, 0, int(DQ.NON_SCIENCE | DQ.DO_NOT_USE))
    ratio = _scale(wcs) / float(np.mean([_scale(im.wcs) for im in images]))
    before_drizzle = float(np.mean([ImageFacts.of(im).noise_correction for im in images]))
    meta = _meta(images) | {
        "pixfrac": float(pixfrac),
        "pixel_scale": _scale(wcs) * 3600,
        "noise_correction": noise_correction(pixfrac, ratio) * before_drizzle,
    }
    out = flagged_image(
        np.where(covered, data, np.nan),
        images[0].unit,
        error=np.sqrt(np.where(covered, variance, np.nan)),
        flags=flags,
        wcs=wcs,
        meta=meta,
    )
    return Mosaic(out, (weight * np.float32(unit_weight)).astype(np.float32), n_images)


def _add(sink, im, weight, pixel_map, wcs, pixfrac=1.0, **planes):
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


def reject_outliers(images, wcs, *, threshold=5.0, weights=None, pixel_maps=None):
    """
    Mask pixels that disagree with the other dithers.

    Parameters
    ----------
    images : list of `~astropy.nddata.CCDData`
        Background-subtracted images; fewer than three are returned as they are.
    wcs : `~astropy.wcs.WCS`
        Grid on which they are compared; best with pixels of about the detector's size.
    threshold : float, optional
        In sigma of the pixel (with the noise of the median).
    weights, pixel_maps : list, optional
        As in `drizzle_images`.

    Returns
    -------
    images : list of `~astropy.nddata.CCDData`
        With `DQ.OUTLIER` set and masked; ``meta["n_outliers"]`` counts them. Only
        pixels that at least three images cover are judged.

    Notes
    -----
    Each image is drizzled alone, the median of these is interpolated back to the pixels of
    each image (linearly), and compared there. Beyond the noise a pixel may differ by 1.2 times the
    steepest difference to its four neighbors in the median image: point sources are sampled
    differently in each dither.

    References
    ----------
    Fruchter & Hook 2002, PASP 114, 144, sec. 5 (without the second pass on neighbors).
    """
    images = list(images)
    check_images(images, wcs)
    check_positive(threshold, "threshold")
    if len(images) < 3:
        return images
    weights = [weight_map(im) for im in images] if weights is None else weights
    if pixel_maps is None:
        pixel_maps = [pixel_map(im.wcs, wcs, im.shape) for im in images]
    median, count = _median_of(images, wcs, weights, pixel_maps)
    # where too few images overlap there is nothing to compare with
    judged = count >= 3
    share = np.where(judged, 1.5 / np.maximum(count, 1), 0.0).astype(np.float32)
    steep = np.zeros_like(median)
    for axis in (0, 1):
        step = np.abs(np.diff(median, axis=axis))
        low, high = [slice(None)] * 2, [slice(None)] * 2
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        steep[tuple(low)] = np.fmax(steep[tuple(low)], step)
        steep[tuple(high)] = np.fmax(steep[tuple(high)], step)
    median = np.where(judged, median, 0.0)
    ny, nx = median.shape
    # between four pixels of the grid that all can be compared with
    between = judged[:-1, :-1] & judged[:-1, 1:] & judged[1:, :-1] & judged[1:, 1:]
    out = []
    for im, (x, y) in zip(images, pixel_maps, strict=True):
        column, row = (np.floor(np.nan_to_num(v, nan=-1)).astype(int) for v in (x, y))
        inside = (column >= 0) & (column < nx - 1) & (row >= 0) & (row < ny - 1)
        column[~inside] = row[~inside] = 0
        coords = np.array([y, x])
        options = {"order": 1, "mode": "constant", "cval": 0.0}
        expected = map_coordinates(median, coords, **options)
        slope = map_coordinates(np.nan_to_num(steep), coords, **options)
        known = inside & between[row, column]
        # that of the median too, of as many images as there are at this place
        noise = sigma(im) * np.sqrt(1 + share[row, column])
        with np.errstate(invalid="ignore"):
            far = np.abs(im.data - expected) > threshold * noise + _DERIVATIVE * slope
        outlier = far & known & ~plain_mask(im)
        flagged = flag_pixels(im, outlier, DQ.OUTLIER | DQ.DO_NOT_USE)
        flagged.meta["n_outliers"] = int(np.count_nonzero(outlier))
        out.append(flagged)
    return out


def _extent(pixel_map, shape):
    """Rows and columns of a grid that an image reaches, or None: it lies beside the grid."""
    if not overlaps(pixel_map, shape):
        return None
    x, y = pixel_map
    ends = [(np.nanmin(values) - 2, np.nanmax(values) + 3) for values in (y, x)]
    return tuple(
        slice(max(0, int(low)), min(n, int(high) + 1))
        for (low, high), n in zip(ends, shape, strict=True)
    )


def _median_of(images, wcs, weights, pixel_maps):
    """
    Median and number of images on each pixel of a grid, each image drizzled alone.

    Each is kept where it lies and the rows are taken in strips, for a field of many pointings
    has many images, few of which overlap.
    """
    shape = wcs.pixel_shape[::-1]
    parts = []
    for im, weight, (x, y) in zip(images, weights, pixel_maps, strict=True):
        extent = _extent((x, y), shape)
        if extent is not None:
            rows, columns = extent
            size = rows.stop - rows.start, columns.stop - columns.start
            sink = Drizzle(kernel="square", fillval="NAN", out_shape=size, disable_ctx=True)
            weight = np.where(plain_mask(im), 0.0, weight / (np.max(weight) or 1.0))
            moved = x - columns.start, y - rows.start
            _add(sink, im, weight.astype(np.float32), moved, wcs)
            parts.append((rows, columns, sink.out_img))
    median, count = np.full(shape, np.nan, np.float32), np.zeros(shape, np.int16)
    for strip in chunks(shape[0], _ROWS):
        here = [part for part in parts if part[0].start < strip.stop and part[0].stop > strip.start]
        if not here:
            continue
        stack = np.full((len(here), strip.stop - strip.start, shape[1]), np.nan, np.float32)
        for plane, (rows, columns, alone) in zip(stack, here, strict=True):
            first, last = max(rows.start, strip.start), min(rows.stop, strip.stop)
            own = slice(first - rows.start, last - rows.start)
            plane[first - strip.start : last - strip.start, columns] = alone[own]
        median[strip], count[strip] = nan_median(stack)
    return median, count


def nan_median(stack):
    """Median along the first axis of what is not NaN (NaN of nothing), and how many values it has."""
    # sorting puts NaN last
    ordered, count = np.sort(stack, axis=0), np.isfinite(stack).sum(axis=0)
    middle = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, stack.shape[0] - 1)
    low, high = (np.take_along_axis(ordered, i[None], axis=0)[0] for i in middle)
    return 0.5 * (low + high), count


def _scale(wcs):
    """Side of a pixel at the reference position, deg."""
    return float(np.sqrt(proj_plane_pixel_area(wcs)))


def _meta(images):
    """What the inputs say of themselves, put together."""
    metas = [im.meta for im in images]
    meta = {"n_exposures": len(images)}
    for key in ("exposure_time", "n_cosmic_rays", "n_negative", "n_outliers"):
        if all(key in m for m in metas):
            meta[key] = sum(m[key] for m in metas)
    for key in ("pa_aper", "dither", "background"):
        if all(key in m for m in metas):
            meta[key] = [m[key] for m in metas]
    for key in metas[0]:
        if key not in meta and all(m.get(key) == metas[0][key] for m in metas):
            meta[key] = metas[0][key]
    return meta
