"""Sky flats: what the flat field of a date leaves, from the sky of the user's own exposures."""

import dataclasses

import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty

from miricigale.instrument import ExposureHistory
from miricigale.reduction.images.images import plain_mask, with_data
from miricigale.reduction.sky.background import estimate_background
from miricigale.reduction.sky.dither_background import other_medians, restored
from miricigale.reduction.sky.sky_mesh import sky_boxes
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import listed_images
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords

#: Pixels over which the flat is smoothed.
_BOX = 16


@takes_other_keywords
def sky_flats(images, *, window=None):
    """
    Return the flat field of each of several exposures, from the sky of the others.

    Parameters
    ----------
    images : list of `~astropy.nddata.CCDData`
        At least three of one filter and shape, calibrated and with their background; the sources of a field must
        not lie on the same pixels in most of them.
    window : float, optional
        Days that two exposures may lie apart, if one is to count for the other; any time if not given.
        Exposures that do not state their day count for all.

    Returns
    -------
    flats : list of `~astropy.nddata.CCDData`
        Relative response with its standard deviation, median 1: the median of the other images, each over its own
        sky level and without its sources, smoothed over boxes of 16 pixels.

    Raises
    ------
    ValueError
        If fewer than two others lie within the window of an image, they differ in shape, or a sky level is not
        positive.

    Notes
    -----
    The flat is divided by, which corrects sources too. What lies still on the detector and is added to the light,
    such as glow, is taken for response: with faint skies `dither_backgrounds` is the better choice.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> from miricigale.reduction import sky_flats
    >>> first = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> sky, reducer = np.full(first.shape, 5.0) * u.MJy / u.sr, Reducer()
    >>> images = [
    ...     reducer.calibrate(
    ...         reducer.fit_ramp(Detector.miri_imager().collect(sky, e, seed=1))
    ...     )
    ...     for e in first.dithered("cycling-medium", 4)
    ... ]
    >>> flat = sky_flats(images)[0]
    >>> print(f"{np.median(flat.data):.2f} +- {np.median(flat.uncertainty.array):.3f}")
    1.00 +- 0.011
    """
    images = listed_images(images)
    if len({im.shape for im in images}) > 1:
        raise argument_error("images", f"of one shape {images[0].shape}", images[-1].shape)
    days = np.array([ExposureHistory.of(im).day for im in images], float)
    # comparisons with the NaN of an unknown day are False
    distant = np.abs(np.subtract.outer(days, days)) > (np.inf if window is None else window)
    uses = ~distant & ~np.eye(days.size, dtype=bool)
    if not uses.size or uses.sum(axis=1).min() < 2:
        raise argument_error("images", "three or more within the window", f"{len(images)} images")
    masks = [plain_mask(im) for im in images]
    sources = [np.zeros(mask.shape, bool) for mask in masks]
    out = None
    # peaks of the response look like sources: these are searched for when it is gone
    for search in (False, True):
        relative = []
        for k, im in enumerate(images):
            if search:
                flat_image = with_data(im, im.data / out[k].data)
                sources[k] = estimate_background(flat_image, warn=False).source_mask
            level = float(np.median(im.data[~(masks[k] | sources[k])]))
            check_that(level > 0, "images", "of positive sky levels", f"{level:.3g}")
            relative.append(with_data(im, im.data / level))
        out = []
        for template in other_medians(relative, masks, sources, [1.0] * len(images), uses):
            finite = np.isfinite(template)
            boxes = sky_boxes(np.where(finite, template, 0), ~finite, _BOX)
            flat = 1 + boxes.smooth(boxes.level, finite.shape, filter_size=1)
            error = boxes.smooth(boxes.error, finite.shape, filter_size=1)
            flat = flat / np.median(flat[finite])
            out.append(CCDData(flat, unit="", uncertainty=StdDevUncertainty(error)))
    return out


def flattened(reducer, images, backgrounds):
    """
    Divide exposures by their sky flats.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        Its ``background.sky_flat`` is the window.
    images : list of `~astropy.nddata.CCDData`
        Background subtracted.
    backgrounds : list of `Background`
        What was subtracted.

    Returns
    -------
    images : list of `~astropy.nddata.CCDData`
        Background subtracted; ``meta["sky_flat_error"]`` is the median error of the flat.
    backgrounds : list of `Background`
        Measured again, with the error of the flat in theirs.
    """
    unsubtracted = [restored(im, b.level) for im, b in zip(images, backgrounds, strict=True)]
    out = []
    flats = sky_flats(unsubtracted, window=reducer.background.sky_flat)
    for im, flat in zip(unsubtracted, flats, strict=True):
        error = flat.uncertainty.array
        flat_image = with_data(
            im, im.data / flat.data, factor=1 / flat.data, sky_flat_error=float(np.median(error))
        )
        flat_image, background = reducer.subtract_background(flat_image)
        error = np.hypot(background.error, background.level * error).astype(np.float32)
        out.append((flat_image, dataclasses.replace(background, error=error)))
    return tuple(map(list, zip(*out, strict=True)))
