"""Faint light over many pixels that one dither has alone: afterglow of bright stars, and showers."""

import numpy as np
from scipy.ndimage import binary_propagation

from miricigale.reduction.images.cells import cells_of, pixels_of, smoothed_cells

# sides of cells in pixels, the Gaussian width, in cells, by which they are smoothed, a factor on the threshold: an
# afterglow is as wide as the image of a star, a shower some tens of pixels; where few pixels add up, errors
# that are a little wrong near sources count more
_SCALES = ((1, 1.5, 1.2), (3, 2.0, 1.0), (8, 2.0, 1.0))
# sigma down to which the surroundings of what is significant are followed
_EDGE = 2.0
# a single pixel counts no more than so many sigma, or it would be taken for a cloud
_CLIP = 5.0
# cells from which the noise of a scale can be measured
_LEAST = 100


def extended_outliers(excess, good, threshold):
    """
    Find places where an image is brighter than the other dithers, over many pixels.

    The excess is smoothed on three scales. Its noise is that of the smoothed map itself, below its median, so
    that correlated noise counts, and light that is only positive does not. It is at least that of independent
    pixels, for a small image has too few places of a large scale for it to be measured.

    Parameters
    ----------
    excess : `~numpy.ndarray`, shape (ny, nx)
        Image minus what the other dithers show there, in sigma of the pixel.
    good : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels that can be compared.
    threshold : float
        Sigma of the smoothed excess from which a place is found.

    Returns
    -------
    extended : `~numpy.ndarray` of bool, shape (ny, nx)
        The places, with their surroundings down to 2 sigma.
    """
    values = np.clip(np.where(good, excess, 0.0), -_CLIP, _CLIP).astype(np.float32)
    extended = np.zeros(good.shape, bool)
    if not good.any():
        return extended
    of_pixels = _lower_width(values[good])[1]
    for size, width, stricter in _SCALES:
        if size == 1:
            cells = values
            share = good.astype(np.float32)
        else:
            cells, share = cells_of(values, good, size)
        smooth, covered = smoothed_cells(cells, share, width)
        if np.count_nonzero(covered) < _LEAST:
            continue
        level, sigma = _lower_width(smooth[covered])
        # a Gaussian weights 4 pi width^2 cells
        sigma = max(sigma, of_pixels / (size * width * np.sqrt(4.0 * np.pi)))
        if not sigma > 0:
            continue
        significant = covered & (smooth - level > stricter * threshold * sigma)
        surroundings = covered & (smooth - level > _EDGE * sigma)
        place = binary_propagation(significant, mask=surroundings)
        extended |= pixels_of(place, good.shape, size)
    return extended & good


def _lower_width(values):
    """Measure the median of values, and how far below it their 16th percentile is."""
    level, low = np.percentile(values, (50.0, 15.87))
    return level, level - low
