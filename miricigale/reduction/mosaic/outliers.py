"""Pixels of a dither that disagree with the other dithers."""

import numpy as np
from drizzle.resample import Drizzle
from scipy.ndimage import gaussian_gradient_magnitude, label, map_coordinates

from miricigale.instrument import DQ, epoch_of
from miricigale.reduction.images.images import (
    check_images,
    flag_pixels,
    plain_flags,
    plain_mask,
    sigma,
)
from miricigale.reduction.mosaic.extended_outliers import extended_outliers
from miricigale.reduction.mosaic.mosaic import add_image, extent_of, pixel_maps_of, weight_map
from miricigale.utils.arrays import box_shape
from miricigale.utils.files import listed_images
from miricigale.utils.options import check_positive
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.parallel import chunks
from miricigale.utils.values import value_class

# rows of a grid of which the median of many images is taken together
_ROWS = 256
# steepest differences to its neighbors by which a pixel may differ from the other dithers
_DERIVATIVE = 1.2
# pixels by which the dithers may be misplaced, and the smoothing with which slopes of wide sources are found
_MISPLACED = 0.4
_GRADIENT_WIDTH = 3.0
# sigma of a pixel of an earlier exposure that may leave an afterglow
_BRIGHT = 100.0
# share of a place that is bright there, at least
_STAR_SHARE = 0.1
# differences to neighbors beyond so many times the median one are those of sources
_NOISE_SLOPES = 2.0


@takes_other_keywords
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
        In sigma of the pixel (with the noise of the median), and of the smoothed maps.
    weights, pixel_maps : list, optional
        As in `drizzle_images`.

    Returns
    -------
    images : list of `~astropy.nddata.CCDData`
        With `DQ.OUTLIER` set and masked; ``meta["n_outliers"]`` counts them. Only
        pixels that at least three images cover are judged. `DQ.PERSISTENCE` is added where the
        detector saw something bright in an earlier image.

    Notes
    -----
    Each image is drizzled alone, the median of these is interpolated back to the pixels of
    each image (linearly), and compared there. Beyond the noise a pixel may differ by 1.2 times the
    steepest difference to its four neighbors in the median image: point sources are sampled
    differently in each dither.

    What is left over is then smoothed on scales of 1.5, 6 and 16 pixels. Where one image is brighter than
    the others by ``threshold`` sigma of a smoothed map, and by more than an error of position of 0.4 pixels makes,
    its pixels are outliers together, down to 2 sigma: the afterglow of a star of an earlier dither, or a shower
    too faint for any single group or pixel.

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
    images = listed_images(images)
    check_images(images, wcs)
    check_positive(threshold, "threshold")
    if len(images) < 3:
        return images
    if weights is None:
        weights = [weight_map(im) for im in images]
    if pixel_maps is None:
        pixel_maps = pixel_maps_of(images, wcs)
    median = _MosaicMedian.of(*_median_of(images, wcs, weights, pixel_maps))
    checked = []
    for im, pixel_map in zip(images, pixel_maps, strict=True):
        single, extended = median.outliers(im, pixel_map, threshold)
        outlier = single | extended
        flagged = flag_pixels(im, outlier, DQ.OUTLIER | DQ.DO_NOT_USE)
        afterglow = _afterglow(extended, im, images)
        if afterglow.any():
            flagged = flag_pixels(flagged, afterglow, DQ.PERSISTENCE)
        flagged.meta["n_outliers"] = int(np.count_nonzero(outlier))
        checked.append(flagged)
    return checked


@value_class
class _MosaicMedian:
    """
    The median of images on a grid, (ny, nx), with which each of them is compared.

    ``steep`` is its largest step to a neighboring pixel, ``gradient`` its smooth gradient. ``judged`` are corners
    of four pixels, (ny - 1, nx - 1), in all of which enough images overlap, and ``share`` the variance of the
    median over that of an image.
    """

    data: np.ndarray
    steep: np.ndarray
    gradient: np.ndarray
    judged: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, median, count):
        """Make one of a median and the number of images in each pixel."""
        # where too few images overlap there is nothing to compare with
        enough = count >= 3
        share = np.where(enough, 1.5 / np.maximum(count, 1), 0.0).astype(np.float32)
        inner = slice(1, -1)
        before = slice(None, -2)
        after = slice(2, None)
        padded = np.pad(median, 1, constant_values=np.nan)
        neighbors = [(before, inner), (after, inner), (inner, before), (inner, after)]
        steep = np.fmax.reduce([np.abs(median - padded[place]) for place in neighbors])
        median = np.where(enough, median, 0.0)
        gradient = gaussian_gradient_magnitude(median, _GRADIENT_WIDTH)
        judged = enough[:-1, :-1] & enough[:-1, 1:] & enough[1:, :-1] & enough[1:, 1:]
        return cls(median, np.nan_to_num(steep), gradient, judged, share)

    def outliers(self, im, pixel_map, threshold):
        """
        Compare an image with the median.

        Returns
        -------
        single, extended : `~numpy.ndarray` of bool
            Pixels that are off by themselves, and further ones that are off together with others.
        """
        x, y = pixel_map
        ny, nx = self.data.shape
        column = np.floor(np.nan_to_num(x, nan=-1)).astype(int)
        row = np.floor(np.nan_to_num(y, nan=-1)).astype(int)
        inside = (column >= 0) & (column < nx - 1) & (row >= 0) & (row < ny - 1)
        column[~inside] = row[~inside] = 0
        good = inside & self.judged[row, column] & ~plain_mask(im)
        coords = np.array([y, x])
        options = {"order": 1, "mode": "constant", "cval": 0.0}
        difference = im.data - map_coordinates(self.data, coords, **options)
        slope = map_coordinates(self.steep, coords, **options)
        # the noise of the median too, of as many images as there are at this place
        noise = sigma(im) * np.sqrt(1 + self.share[row, column])
        with np.errstate(invalid="ignore"):
            far = np.abs(difference) > threshold * noise + _DERIVATIVE * slope
        single = far & good
        # sampling of sources is allowed for, the noise of the median's slopes is none of theirs
        noise_slope = 0.0
        if good.any():
            noise_slope = np.median(slope[good])
        allowed = _DERIVATIVE * np.maximum(slope - _NOISE_SLOPES * noise_slope, 0.0)
        # wide sources have slopes below the noise, over many pixels
        smooth_slope = map_coordinates(self.gradient, coords, **options)
        allowed = np.maximum(allowed, _MISPLACED * smooth_slope)
        excess = np.sign(difference) * np.maximum(np.abs(difference) - allowed, 0.0)
        with np.errstate(invalid="ignore"):
            extended = extended_outliers(excess / noise, good & ~single, threshold)
        return single, extended


def _afterglow(extended, image, images):
    """Tell which of the places that one image has alone were bright on the detector in an image before it."""
    epoch = epoch_of(image)
    bright = np.zeros(extended.shape, bool)
    if epoch is None or not extended.any():
        return bright
    for earlier in images:
        earlier_epoch = epoch_of(earlier)
        if earlier_epoch is None or earlier_epoch >= epoch or earlier.shape != image.shape:
            continue
        with np.errstate(invalid="ignore"):
            bright |= earlier.data > _BRIGHT * sigma(earlier)
        bright |= (plain_flags(earlier) & int(DQ.SATURATED)) != 0
    labels, n_places = label(extended, np.ones((3, 3), bool))
    size = np.bincount(labels.ravel(), minlength=n_places + 1)
    n_bright = np.bincount(labels[bright & extended], minlength=n_places + 1)
    # a shower may lie where a star was, too: an afterglow is as wide as the star
    is_afterglow = n_bright > _STAR_SHARE * size
    return is_afterglow[labels] & extended


def _median_of(images, wcs, weights, pixel_maps):
    """
    Return the median and number of images on each pixel of a grid, each image drizzled alone.

    Each is kept where it lies and the rows are taken in strips, for a field of many pointings
    has many images, few of which overlap.
    """
    shape = wcs.pixel_shape[::-1]
    parts = []
    for im, weight, (x, y) in zip(images, weights, pixel_maps, strict=True):
        extent = extent_of((x, y), shape)
        if extent is not None:
            rows, columns = extent
            size = box_shape(extent)
            sink = Drizzle(kernel="square", fillval="NAN", out_shape=size, disable_ctx=True)
            weight = np.where(plain_mask(im), 0.0, weight / (np.max(weight) or 1.0))
            moved = x - columns.start, y - rows.start
            add_image(sink, im, weight.astype(np.float32), moved, wcs)
            parts.append((rows, columns, sink.out_img))
    median = np.full(shape, np.nan, np.float32)
    count = np.zeros(shape, np.int16)
    for strip in chunks(shape[0], _ROWS):
        overlapping = [
            part for part in parts if part[0].start < strip.stop and part[0].stop > strip.start
        ]
        if not overlapping:
            continue
        stack = np.full((len(overlapping), strip.stop - strip.start, shape[1]), np.nan, np.float32)
        for plane, (rows, columns, plane_data) in zip(stack, overlapping, strict=True):
            first = max(rows.start, strip.start)
            last = min(rows.stop, strip.stop)
            rows_of_part = slice(first - rows.start, last - rows.start)
            plane[first - strip.start : last - strip.start, columns] = plane_data[rows_of_part]
        median[strip], count[strip] = nan_median(stack)
    return median, count


def nan_median(stack):
    """Return the median along the first axis of what is not NaN (NaN of nothing), and how many values it has."""
    # sorting puts NaN last
    ordered = np.sort(stack, axis=0)
    count = np.isfinite(stack).sum(axis=0)
    middle = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, stack.shape[0] - 1)
    low, high = (np.take_along_axis(ordered, i[None], axis=0)[0] for i in middle)
    return 0.5 * (low + high), count
