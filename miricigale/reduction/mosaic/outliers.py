"""Pixels of a dither that disagree with the other dithers."""

import numpy as np
from drizzle.resample import Drizzle
from scipy.ndimage import map_coordinates

from miricigale.instrument import DQ
from miricigale.reduction.images.images import check_images, flag_pixels, plain_mask, sigma
from miricigale.reduction.mosaic.mosaic import add_image, extent_of, pixel_map, weight_map
from miricigale.utils.options import check_positive
from miricigale.utils.parallel import chunks

# rows of a grid of which the median of many images is taken together
_ROWS = 256
# steepest differences to its neighbors by which a pixel may differ from the other dithers
_DERIVATIVE = 1.2


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
    >>> from miricigale.reduction import match_levels, reject_outliers
    >>> images[0].data[50, 40] += 5
    >>> checked = reject_outliers(match_levels(images, wcs), wcs)
    >>> [image.meta["n_outliers"] for image in checked]
    [1, 0, 0]
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
    inner, (before, after) = slice(1, -1), (slice(None, -2), slice(2, None))
    around = np.pad(median, 1, constant_values=np.nan)
    beside = [(before, inner), (after, inner), (inner, before), (inner, after)]
    steep = np.fmax.reduce([np.abs(median - around[place]) for place in beside])
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


def _median_of(images, wcs, weights, pixel_maps):
    """
    Median and number of images on each pixel of a grid, each image drizzled alone.

    Each is kept where it lies and the rows are taken in strips, for a field of many pointings
    has many images, few of which overlap.
    """
    shape = wcs.pixel_shape[::-1]
    parts = []
    for im, weight, (x, y) in zip(images, weights, pixel_maps, strict=True):
        extent = extent_of((x, y), shape)
        if extent is not None:
            rows, columns = extent
            size = rows.stop - rows.start, columns.stop - columns.start
            sink = Drizzle(kernel="square", fillval="NAN", out_shape=size, disable_ctx=True)
            weight = np.where(plain_mask(im), 0.0, weight / (np.max(weight) or 1.0))
            moved = x - columns.start, y - rows.start
            add_image(sink, im, weight.astype(np.float32), moved, wcs)
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
