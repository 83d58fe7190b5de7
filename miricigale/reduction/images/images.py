"""Small helpers for `~astropy.nddata.CCDData` with flags."""

import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.wcs import WCS

from miricigale.instrument import DQ, ImageFacts, mosaic_wcs
from miricigale.instrument.image import Image
from miricigale.instrument.image_planes import standard_deviation
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import attributes, without_none
from miricigale.utils.options import check_that, check_type
from miricigale.utils.units import SURFACE_BRIGHTNESS


def flagged_image(data, unit, *, error, flags, wcs, meta, mask=False):
    """Make an image that is also masked where its flags say so, or where it is not finite."""
    data = np.asarray(data, np.float32)
    flags = np.asarray(flags, np.int64)
    mask = mask | ((flags & DQ.DO_NOT_USE) != 0) | ~np.isfinite(data)
    uncertainty = None
    if error is not None:
        uncertainty = StdDevUncertainty(np.asarray(error, np.float32))
        mask |= ~np.isfinite(uncertainty.array)
    return Image(
        data, unit=unit, uncertainty=uncertainty, mask=mask, flags=flags, wcs=wcs, meta=dict(meta)
    )


def plain_mask(image):
    """Mask of an image as a bool array, with pixels that are not finite."""
    bad = ~np.isfinite(image.data)
    if image.mask is None:
        return bad
    return bad | np.asarray(image.mask, bool)


def plain_flags(image):
    """Return the flags of an image as a new int64 array; zeros where it has none."""
    if image.flags is None:
        return np.zeros(image.data.shape, np.int64)
    return np.array(image.flags, np.int64)


def sigma(image, name="image"):
    """Standard deviation of each pixel, in the image's unit; an image without uncertainty is refused."""
    check_that(image.uncertainty is not None, name, "an image with an uncertainty", "one without")
    return np.asarray(standard_deviation(image).array)


def with_data(source, data, *, factor=None, unit=None, **meta):
    """
    Copy an image with other data, its uncertainty multiplied by ``factor``, in another ``unit``.

    Further keywords are added to the meta dictionary.
    """
    uncertainty = None
    if source.uncertainty is not None:
        error = sigma(source)
        uncertainty = StdDevUncertainty(np.array(error if factor is None else error * factor))
    return Image(
        data,
        unit=source.unit if unit is None else unit,
        uncertainty=uncertainty,
        mask=plain_mask(source),
        flags=plain_flags(source),
        wcs=source.wcs,
        meta={**source.meta, **meta},
    )


def flag_pixels(source, selected, flag):
    """Copy an image with ``flag`` set, and masked if the flag says so, where ``where``."""
    out = with_data(source, source.data)
    out.flags[selected] |= int(flag)
    if flag & DQ.DO_NOT_USE:
        out.mask |= selected
    return out


def exposure_values(exposure):
    """Return the fields of an exposure in values that fit a header."""
    names = ("filter", "readout", "subarray", "n_groups", "n_integrations", "dither")
    values = attributes(exposure, names)
    for name in ("group_time", "exposure_time"):
        values[name] = float(getattr(exposure, name).to_value("s"))
    if exposure.pointing is not None:
        values |= {
            "ra": float(exposure.pointing.ra.deg),
            "dec": float(exposure.pointing.dec.deg),
            "roll": float(exposure.roll.to_value("deg")),
            "pa_aper": float(exposure.pa_aper.to_value("deg")),
        }
    return without_none(values)


def seen_wcs(im):
    """Return the WCS of the part of an image that holds its unmasked pixels, with its shape."""
    good = ~plain_mask(im)
    rows = np.flatnonzero(good.any(axis=1))
    columns = np.flatnonzero(good.any(axis=0))
    if rows.size == 0:
        rows, columns = map(np.arange, im.shape)
    part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    wcs = im.wcs.slice(part)
    wcs.pixel_shape = tuple(int(np.ptp(index)) + 1 for index in (columns, rows))
    return wcs


def own_grid(images, pixel_scale):
    """Return the smallest north-up grid that holds every unmasked pixel of images that can be put together."""
    check_alike(images)
    return mosaic_wcs([seen_wcs(im) for im in images], pixel_scale)


def check_images(images, wcs):
    """Refuse images that cannot be put together, and what is no grid for them."""
    check_type(wcs, "wcs", WCS, "an astropy WCS")
    check_that(wcs.pixel_shape is not None, "wcs", "a WCS with a pixel_shape", "one without")
    check_alike(images)


def check_alike(images):
    """Refuse images that cannot be put together."""
    check_that(images, "images", "at least one image", "none")
    for im in images:
        if not isinstance(im, CCDData) or im.wcs is None or im.uncertainty is None:
            raise argument_error("images", "CCDData with uncertainty and WCS", repr(type(im)))
        if im.unit != images[0].unit:
            raise argument_error("images", f"in one unit ({images[0].unit})", str(im.unit))
    if not images[0].unit.is_equivalent(SURFACE_BRIGHTNESS):
        wanted = f"surface brightness (convertible to {SURFACE_BRIGHTNESS}; see calibrate)"
        raise argument_error("images", wanted, f"unit {images[0].unit}")
    facts = [ImageFacts.of(im) for im in images]
    filters = {fact.band: fact.filter for fact in facts if fact.band is not None}
    check_that(len(filters) <= 1, "images", "of one filter", ", ".join(sorted(filters.values())))


def check_overlap(pixel_maps, shape):
    """Refuse a grid that no image touches."""
    if not any(overlaps(pixels, shape) for pixels in pixel_maps):
        got = "one elsewhere on the sky: no image touches it"
        raise argument_error("wcs", "a grid that overlaps the images", got)


def overlaps(pixel_map, shape):
    """Tell whether an image's pixels come within half a pixel of a grid (NaN does not)."""
    x, y = pixel_map
    ny, nx = shape
    return bool(np.any((x > -1) & (x < nx) & (y > -1) & (y < ny)))
