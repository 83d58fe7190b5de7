"""The images of one filter put together: aligned, on one level, without outliers, drizzled."""

import numpy as np

from miricigale.instrument import ImageFacts, as_wcs
from miricigale.reduction.combine.align import align_images, visit_of
from miricigale.reduction.images.images import check_images, own_grid, with_data
from miricigale.reduction.mosaic.mosaic import drizzle_images, pixel_maps_of, weight_map
from miricigale.reduction.mosaic.outliers import reject_outliers
from miricigale.reduction.results import ReductionResult
from miricigale.reduction.sky.background import (
    BackgroundFlags,
    estimate_background,
    remove_background,
    subtractable,
)
from miricigale.reduction.sky.dither_background import dither_backgrounds, restored
from miricigale.reduction.sky.sky_match import match_levels
from miricigale.utils.options import check_that


def drizzle(settings, images, wcs, variances=()):
    """
    As `~miricigale.reduction.Reducer.drizzle`.

    Parameters
    ----------
    settings : `~miricigale.reduction.MosaicSettings`
        How images are combined.
    images, wcs
        As of that method.
    variances : list of dict, optional
        As of `~miricigale.reduction.drizzle_images`.

    Returns
    -------
    mosaic : `~miricigale.reduction.Mosaic`
    images : list of `~astropy.nddata.CCDData`
        The inputs on one level, with outliers masked.
    """
    images = list(images)
    check_images(images, wcs)
    weights = [weight_map(im) for im in images]
    maps = pixel_maps_of(images, wcs)
    if settings.match_sky and len(images) > 1:
        images = match_levels(images, wcs, pixel_maps=maps)
    judged = all(ImageFacts.of(im).n_outliers is not None for im in images)
    if settings.outlier_threshold is not None and len(images) >= 3 and not judged:
        images = reject_outliers(
            images, wcs, threshold=settings.outlier_threshold, weights=weights, pixel_maps=maps
        )
    mosaic = drizzle_images(
        images, wcs, pixfrac=settings.pixfrac, weights=weights, pixel_maps=maps, variances=variances
    )
    return mosaic, images


def subtract_dithers(reducer, images, single_backgrounds=None, wcs=None):
    """As `~miricigale.reduction.Reducer.subtract_dithers`, also with the background of each image by itself."""
    if single_backgrounds is None:
        single_backgrounds = []
        for image in images:
            background = estimate_background(image, warn=False, **reducer.background.mesh)
            single_backgrounds.append(background)
    backgrounds = list(map(subtractable, dither_backgrounds(images, single_backgrounds, wcs=wcs)))
    subtracted = []
    for image, background in zip(images, backgrounds, strict=True):
        subtracted.append(remove_background(image, background, **reducer.background.negative))
    return subtracted, backgrounds


def combine(reducer, images, backgrounds, rates, wcs, pixel_scale, align, planes=()):
    """
    As `~miricigale.reduction.Reducer.combine`.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        Settings.
    images, backgrounds, rates, wcs, pixel_scale, align, planes
        As of that method.

    Returns
    -------
    result : `~miricigale.reduction.ReductionResult`
    """
    check_that(images, "images", "at least one image", "none")
    images = _aligned(images, align)
    if wcs is None:
        wcs = own_grid(images, pixel_scale)
    wcs = as_wcs(wcs)
    notes = []
    if reducer.mosaics.outlier_threshold is not None and len(images) < 3:
        number = "a single dither" if len(images) == 1 else "two dithers"
        notes.append(f"{number}: outliers cannot be rejected, hits that ramps kept stay in")
    has_backgrounds = len(backgrounds) == len(images)
    if reducer.background.method == "dithers":
        if len(images) >= 3 and has_backgrounds:
            unsubtracted = []
            for image, background in zip(images, backgrounds, strict=True):
                unsubtracted.append(restored(image, background.level))
            images, backgrounds = subtract_dithers(reducer, unsubtracted, backgrounds, wcs)
        else:
            notes.append("backgrounds are those of single exposures: it takes three and theirs")
    untrusted = [background for background in backgrounds if not background.trusted]
    if untrusted:
        doubt = f"{len(untrusted)} of {len(backgrounds)} backgrounds cannot be trusted"
        notes.append(f"{doubt} ({_reasons(untrusted)})")
    with_background = []
    if has_backgrounds:
        for image, background in zip(images, backgrounds, strict=True):
            with_background.append(image.data + background.level)
    drizzled, images = drizzle(reducer.mosaics, images, wcs, planes)
    mosaic, mosaic_background = reducer.subtract_background(drizzled.image)
    subtracted = mosaic_background.level
    if has_backgrounds:
        subtracted = subtracted + _removed_light(reducer.mosaics, images, with_background, wcs)
    if not mosaic_background.trusted:
        reasons = _reasons([mosaic_background])
        notes.append(f"the background of the mosaic cannot be trusted ({reasons})")
    # the mosaic's own level would hide those of the dithers
    for key in ("background", "background_error", "background_flags"):
        mosaic.meta[f"mosaic_{key}"] = mosaic.meta.pop(key, None)
        if key in drizzled.image.meta:
            mosaic.meta[key] = drizzled.image.meta[key]
    return ReductionResult(
        rates=tuple(rates),
        images=tuple(images),
        backgrounds=tuple(backgrounds),
        mosaic=mosaic,
        weight=drizzled.weight,
        n_images=drizzled.n_images,
        mosaic_background=mosaic_background,
        subtracted=subtracted,
        notes=tuple(notes),
        variances=drizzled.variances,
    )


def _aligned(images, align):
    """Images aligned with sources at positions, or with each other; as they are if ``align`` is None."""
    if align is None:
        return images
    groups = None
    if isinstance(align, str):
        good = align in ("dithers", "visits")
        check_that(good, "align", "a SkyCoord, 'dithers' or None", repr(align))
        if align == "visits":
            groups = map(visit_of, images)
        align = None
    aligned, _ = align_images(images, align, groups=groups)
    return aligned


def _removed_light(settings, images, with_background, wcs):
    """Light taken from exposures on the mosaic's grid: their backgrounds, and what brought them to one level."""
    removed = []
    for image, data in zip(images, with_background, strict=True):
        removed.append(with_data(image, data - image.data))
    levels = drizzle_images(removed, wcs, pixfrac=settings.pixfrac).image
    return np.where(levels.mask, 0, levels.data)


def _reasons(backgrounds):
    """Tell why backgrounds cannot be trusted."""
    names = {name for background in backgrounds for name in BackgroundFlags.names(background.flags)}
    return ", ".join(sorted(names)).replace("_", " ")
