"""Background of dithers from each other: what stays on the detector while the sky moves over it."""

import dataclasses

import numpy as np
from scipy.ndimage import binary_dilation

from miricigale.instrument import DQ
from miricigale.reduction.images.images import check_images, own_grid, plain_mask, with_data
from miricigale.reduction.mosaic.mosaic import drizzle_images, pixel_maps_of
from miricigale.reduction.mosaic.outliers import nan_median
from miricigale.reduction.sky.background import estimate_background, warn_of
from miricigale.reduction.sky.sky_mesh import sky_boxes
from miricigale.utils.files import listed_images
from miricigale.utils.options import check_that
from miricigale.utils.parallel import chunks
from miricigale.utils.units import ANGLE

# rows of which the median of many images is taken together
_ROWS = 128
# pixels of the boxes over which the median of the dithers is smoothed
_BOX = 16
# the mask of the mosaic is widened by this many pixels: images are sharper or wider than it
_WIDER = 2


def dither_backgrounds(images, backgrounds=None, *, wcs=None):
    """
    Return the backgrounds of dithered images from the other dithers, with the sources masked ("super background").

    Parameters
    ----------
    images : list of `~astropy.nddata.CCDData`
        At least three of one filter and shape, calibrated and with their background; best a dozen, dithered by
        more than the sources are wide.
    backgrounds : list of `Background`, optional
        Of each alone; `estimate_background` if not given.
    wcs : `~astropy.wcs.WCS`, optional
        Grid of a mosaic, with its ``pixel_shape``, on which the sources are searched for that are masked; by
        default that of `~miricigale.instrument.mosaic_wcs` with pixels of 0.11 arcsec. What stays on the
        detector does not add up there, as sources do.

    Returns
    -------
    backgrounds : list of `Background`
        Of each image: the median of the other images in pixels of the detector, each less its own
        level, without masked pixels, smoothed over boxes of 16 pixels, and on the level of the image's
        own sky. Noise and flags are those of what is left.

    Raises
    ------
    ValueError
        If there are fewer than three images, they differ in shape, none of the others of an image sees sky in
        any of its pixels.

    Notes
    -----
    What lies still on the detector (glow, residuals of the flat field) goes, however fine it is; what is on
    the sky and wider than the dithers (zodiacal gradients apart, which all images share) stays in the
    background only as far as it stays in place. Light of galaxies that the mesh of a single image takes is left to
    them, if the dithers are wider than they are. Dithers of less than about 1.5 FWHM leave rests of
    the sources.

    References
    ----------
    Dicken et al. 2024, A&A 689, A5, sec. 10.2 (other dithers in place of all, and their limits); Yang et al. 2023,
    ApJL 956, L12 (CEERS); Ostlin et al. 2025, A&A 696, A57 (MIDIS).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> from miricigale.scene import Scene
    >>> first = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> star = {"id": [1], "ra": [53], "dec": [-27], "profile": ["point"]}
    >>> star["F770W"] = [500] * u.uJy
    >>> def exposed(exposure):
    ...     scene = Scene(star, exposure, background="low")
    ...     return Detector.miri_imager().collect(scene, seed=1)
    >>> from miricigale.reduction import dither_backgrounds
    >>> reducer = Reducer()
    >>> dithers = first.dithered("cycling-medium", 3)
    >>> cals = [
    ...     reducer.calibrate(reducer.fit_ramp(exposed(dither))) for dither in dithers
    ... ]
    >>> backgrounds = dither_backgrounds(cals)
    >>> print(f"{backgrounds[0].level.mean():.1f} MJy/sr")
    4.9 MJy/sr
    """
    images = listed_images(images)
    check_that(len(images) >= 3, "images", "at least three dithers", len(images))
    shape = images[0].shape
    for im in images:
        check_that(im.shape == shape, "images", f"of one shape {shape}", im.shape)
    if backgrounds is None:
        backgrounds = [estimate_background(im, warn=False) for im in images]
    single = list(backgrounds)
    wanted = f"one for each of {len(images)} images"
    check_that(len(single) == len(images), "backgrounds", wanted, len(single))
    masks = [plain_mask(im) for im in images]
    if wcs is None:
        wcs = own_grid(images, 0.11 * ANGLE)
    sources = _deep_masks(images, single, wcs)
    levels = [float(np.median(b.level[~m])) for b, m in zip(single, masks, strict=True)]
    templates = other_medians(images, masks, sources, levels)
    out = []
    for im, background, mask, source, level, template in zip(
        images, single, masks, sources, levels, templates, strict=True
    ):
        finite = np.isfinite(template)
        check_that(
            finite.any(), "images", "ones that leave some sky to each other", "none in common"
        )
        boxes = sky_boxes(np.where(finite, template, 0), ~finite, _BOX)
        smooth = boxes.smooth(boxes.level, shape, filter_size=1)
        error = boxes.smooth(boxes.error, shape, filter_size=1)
        sky = ~(mask | source)
        remainder = with_data(im, im.data - smooth)
        constant = level
        if sky.any():
            constant = float(np.median(remainder.data[sky]))
        # what is left is judged as an image is, its mesh is not taken off
        residual = estimate_background(
            remainder, warn=False, box=background.box, filter_size=background.filter_size
        )
        new = dataclasses.replace(
            residual,
            level=(smooth + constant).astype(np.float32),
            error=np.hypot(error, residual.error).astype(np.float32),
            source_mask=source,
        )
        warn_of(new, mask, im.unit)
        out.append(new)
    return out


def restored(image, level):
    """Return an image of which a background was subtracted, with that background."""
    image_with_sky = with_data(image, image.data + level)
    # what was far below the background is to be judged again
    low = (image_with_sky.flags & int(DQ.NEGATIVE)) != 0
    image_with_sky.flags[low] &= ~int(DQ.NEGATIVE | DQ.DO_NOT_USE)
    image_with_sky.mask[low] = False
    return image_with_sky


def _deep_masks(images, backgrounds, wcs):
    """Return the sources of the mosaic of the images, on the pixels of each."""
    check_images(images, wcs)
    pairs = zip(images, backgrounds, strict=True)
    flat = [with_data(im, im.data - background.level) for im, background in pairs]
    maps = pixel_maps_of(images, wcs)
    mosaic = drizzle_images(flat, wcs, pixel_maps=maps).image
    sources = binary_dilation(
        estimate_background(mosaic, warn=False).source_mask, iterations=_WIDER
    )
    out = []
    for x, y in maps:
        # beside the grid nothing is known
        inside = (
            (x > -0.5) & (x < sources.shape[1] - 0.5) & (y > -0.5) & (y < sources.shape[0] - 0.5)
        )
        at = (np.rint(np.where(inside, v, 0)).astype(int) for v in (y, x))
        out.append(sources[tuple(at)] & inside)
    return out


def other_medians(images, masks, sources, levels, uses=None):
    """
    Return for each image the median of the others in each pixel, each less its level; NaN without any.

    ``others`` has a row for each image: which ones count, all but itself by default.
    """
    if uses is None:
        uses = ~np.eye(len(images), dtype=bool)
    shape = images[0].shape
    out = [np.full(shape, np.nan, np.float32) for _ in images]
    for rows in chunks(shape[0], _ROWS):
        stack = np.stack(
            [
                np.where(mask[rows] | source[rows], np.nan, im.data[rows] - level)
                for im, mask, source, level in zip(images, masks, sources, levels, strict=True)
            ]
        ).astype(np.float32)
        for k, template in enumerate(out):
            template[rows], _ = nan_median(stack[uses[k]])
    return out
