"""Levels of dithers matched where they overlap."""

import numpy as np

from miricigale.reduction.images.images import check_images, plain_mask, with_data
from miricigale.reduction.mosaic.mosaic import pixel_maps_of
from miricigale.utils.arrays import is_inside
from miricigale.utils.files import listed_images
from miricigale.utils.named_values import without_none

# pixels of the grid that are averaged before images are compared
_CELL = 8
# so many cells in common make a comparison
_LEAST = 20


def sky_offsets(images, wcs, *, pixel_maps=None):
    """
    Return the constants by which the levels of images differ where they overlap.

    Parameters
    ----------
    images : list of `~astropy.nddata.CCDData`
        Surface brightness in one unit, with uncertainty and WCS.
    wcs : `~astropy.wcs.WCS`
        Grid, with its ``pixel_shape``, on which they are compared.
    pixel_maps : list of (x, y), optional
        Results of `pixel_map`, if they are there already.

    Returns
    -------
    offsets : `~numpy.ndarray`, shape (n,)
        In the unit of the images. Their mean is zero in each group of images that overlap one another, also
        by way of others; of an image alone it is zero.

    Raises
    ------
    ValueError
        If the images cannot be put together (`drizzle_images`).

    Notes
    -----
    Means of each image in cells of 8 x 8 pixels of the grid are compared pair by pair, by the median over
    the cells that both fill: sources are in both. The constants are the least-squares solution
    of all pairs, weighted by the scatter and number of the cells.

    References
    ----------
    As the method "match" of the step ``skymatch`` of the JWST pipeline, with cells in place of sky polygons.

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
    >>> from miricigale.reduction import sky_offsets
    >>> sky_offsets(images, wcs).round(2)
    array([-0.1,  0.1,  0. ])
    """
    images = listed_images(images)
    check_images(images, wcs)
    if pixel_maps is None:
        pixel_maps = pixel_maps_of(images, wcs)
    means = []
    for im, pixels in zip(images, pixel_maps, strict=True):
        means.append(_means(im, pixels, wcs.pixel_shape[::-1]))
    n = len(images)
    pairs = {(i, j): _difference(means[i], means[j]) for i in range(n) for j in range(i)}
    pairs = without_none(pairs)
    if not pairs:
        return np.zeros(n)
    # images that are one and the same have no scatter: others would count for nothing beside them
    floor = 1e-3 * max(spread for _, spread, _ in pairs.values()) or 1.0
    matrix = np.zeros((n, n))
    right = np.zeros(n)
    for (i, j), (difference, spread, number) in pairs.items():
        weight = number / max(spread, floor) ** 2
        # the normal equations of offset i - offset j = difference
        for k, m, sign in ((i, j, 1.0), (j, i, -1.0)):
            matrix[k, k] += weight
            matrix[k, m] -= weight
            right[k] += sign * weight * difference
    scale = matrix.max()
    # of the solutions the smallest: its mean is zero in each group
    return np.linalg.pinv(matrix / scale, rcond=1e-10, hermitian=True) @ (right / scale)


def _means(im, pixels, shape):
    """Return the numbers of the cells that an image fills at least by half, in order, and its mean in them."""
    x, y = pixels
    ny, nx = (-(-n // _CELL) for n in shape)
    good = ~plain_mask(im) & np.isfinite(x) & np.isfinite(y)
    column = np.floor((x[good] + 0.5) / _CELL).astype(int)
    row = np.floor((y[good] + 0.5) / _CELL).astype(int)
    inside = is_inside(column, row, (ny, nx))
    cell = (row * nx + column)[inside]
    if not cell.size:
        return cell, np.empty(0)
    count = np.bincount(cell)
    total = np.bincount(cell, np.asarray(im.data, float)[good][inside])
    numbers = np.flatnonzero(count >= max(1, 0.5 * np.percentile(count[count > 0], 90)))
    return numbers, total[numbers] / count[numbers]


def _difference(means, reference):
    """Median difference of two images in the cells that both fill, its scatter and their number; None with few."""
    _, i, j = np.intersect1d(means[0], reference[0], assume_unique=True, return_indices=True)
    if i.size < _LEAST:
        return None
    difference = means[1][i] - reference[1][j]
    middle = float(np.median(difference))
    return middle, 1.4826 * float(np.median(np.abs(difference - middle))), i.size


def match_levels(images, wcs, *, pixel_maps=None):
    """
    Take the `sky_offsets` off images.

    Parameters are those of `sky_offsets`.

    Returns
    -------
    images : list of `~astropy.nddata.CCDData`
        Of one level where they overlap; ``meta["sky_offset"]`` is what was taken off.

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
    >>> from miricigale.reduction import match_levels
    >>> [round(float(image.data.mean()), 2) for image in match_levels(images, wcs)]
    [5.1, 5.1, 5.1]
    """
    images = listed_images(images)
    offsets = sky_offsets(images, wcs, pixel_maps=pixel_maps)
    out = []
    for im, offset in zip(images, offsets, strict=True):
        out.append(
            with_data(
                im,
                im.data - np.asarray(offset, im.data.dtype),
                sky_offset=float(offset) + float(im.meta.get("sky_offset", 0.0)),
            )
        )
    return out
