"""What of an image is sources, from bright cores to faint and wide light, and what they leave as sky."""

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, label

# detection of what is masked: standard deviations of the smoothing in pixels (cores, and
# the wings of bright sources), and the least number of connected pixels: those of the smoothing
_TIERS = ((0.85, 5), (2.5, 20))
# sigma by which sources rise above the sky
_THRESHOLD = 3.0
# light too faint and wide for these is looked for in cells of so many pixels, smoothed by this many of
# them, from this many connected ones on that rise by this times the threshold
_CELL, _CELL_WIDTH, _CELL_AREA, _CELL_THRESHOLD = 4, 2.0, 12, 2.0
# the mask of a source grows by the first of these shares of its half width that leaves half of the sky
_GROWTH = (2.0, 1.0, 0.5)


def cells_of(values, weight=None, size=_CELL):
    """Mean of an image in cells, and the share of a cell that counts; without a weight, the share alone."""
    if weight is None:
        return _added(values.astype(np.uint8), size) / np.float32(size**2)
    total = _added(np.where(weight, values, np.float32(0)), size)
    count = _added(weight.astype(np.uint8), size)
    return total / np.maximum(count, 1), count / np.float32(size**2)


def _added(values, size):
    """Sums over cells; what is beyond the edge is zero."""
    left = [(0, -n % size) for n in values.shape]
    if any(more for _, more in left):
        values = np.pad(values, left)
    rows = values[::size] + values[1::size]
    for k in range(2, size):
        rows += values[k::size]
    # sums of neighbors as a product of matrices
    pairs = rows.astype(np.float32, copy=False).reshape(-1, size)
    return (pairs @ np.ones(size, np.float32)).reshape(len(rows), -1)


def pixels_of(cells, shape, size=_CELL):
    """Pixels of cells."""
    wide = np.repeat(np.repeat(cells, size, axis=0), size, axis=1)
    return wide[: shape[0], : shape[1]]


def detect(residual, rms, mask, sources):
    """Pixels that rise above the noise of the image, smoothed little, more and much."""
    good = ~mask & (rms > 0)
    sky = good & ~sources
    if not sky.any():
        return np.zeros(mask.shape, bool)
    scaled = np.zeros(mask.shape, np.float32)
    np.divide(residual, rms, out=scaled, where=good, casting="same_kind")
    found = np.zeros(mask.shape, bool)
    for width, area in _TIERS:
        smooth = gaussian_filter(scaled, width, mode="nearest")
        found |= _risen(smooth, good, sky, _THRESHOLD, area)
    # what is found is left out, or it would be smeared over cells
    cells, share = cells_of(scaled, good & ~found)
    smooth, weight = (
        gaussian_filter(a, _CELL_WIDTH, mode="constant") for a in (cells * share, share)
    )
    # of one noise also where few cells count, as at the edge
    smooth /= np.sqrt(np.maximum(weight, 1e-3))
    good, sky = (share >= 0.5) & (weight >= 0.3), cells_of(sky) >= 0.5
    if sky.any():
        wide = _risen(smooth, good, sky, _CELL_THRESHOLD * _THRESHOLD, _CELL_AREA)
        found |= pixels_of(wide, mask.shape)
    return found & ~mask


def _risen(smooth, good, sky, threshold, area):
    """Connected places of an image that rise above the noise that its sky has."""
    # correlated noise is smoothed less, so that it is measured, on the negative side: of the
    # other the mask leaves a part
    below = -smooth[sky & (smooth < 0)]
    # a million of them determine the median
    below = below[:: max(1, below.size // 1_000_000)].copy()
    if not below.size:
        return np.zeros(smooth.shape, bool)
    high = good & (smooth > threshold * 1.4826 * _median(below))
    labels, n = label(high, np.ones((3, 3), bool))
    # the sky, label 0, is most of the image: only what is high is looked at
    inside = labels[high]
    found = np.zeros(smooth.shape, bool)
    found[high] = (np.bincount(inside, minlength=n + 1) >= area)[inside]
    return found


def grown(sources, mask):
    """A mask of sources, each part of it wider by a share of its half width, in cells."""
    cells = cells_of(sources) >= 0.5
    depth = distance_transform_edt(cells)
    cores, radius = [], 2.5
    while (core := depth >= radius).any():
        cores.append((distance_transform_edt(~core), radius))
        radius *= 1.5
    seen = cells_of(mask) < 0.5
    for growth in _GROWTH:
        wide = np.any([away <= (1 + growth) * r for away, r in cores] or [cells], axis=0)
        if np.count_nonzero(seen & ~wide) >= 0.5 * np.count_nonzero(seen):
            break
    return sources | pixels_of(wide, sources.shape)


def contamination(data, sky, sources):
    """
    Light of sources in what is left as sky.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Image without gradient.
    sky, sources : `~numpy.ndarray` of bool, shape (ny, nx)
        What is left as sky, and what is taken for sources.

    Returns
    -------
    difference : float
        By how much the nearer half of the sky, by the distance of its cells from sources, is brighter than the
        farther, if that is more than three times its error; else 0.
    near : `~numpy.ndarray` of bool
        The nearer half, in cells.
    """
    mean, share = cells_of(data, sky)
    used = share >= 0.5
    near = np.zeros_like(used)
    cells = cells_of(sources) > 0
    if not cells.any() or np.count_nonzero(used) < 20:
        return 0.0, near
    distance = distance_transform_edt(~cells)
    near = used & (distance <= np.median(distance[used]))
    far = used & ~near
    if not far.any():
        return 0.0, near
    difference = float(np.median(mean[near]) - np.median(mean[far]))
    counts = 1 / np.count_nonzero(near) + 1 / np.count_nonzero(far)
    noise = 1.2533 * float(_spread(mean[far])) * np.sqrt(counts)
    return (difference if difference > 3 * noise else 0.0), near


def darkest(data, mask, box, least):
    """The darkest share of each box, in cells smoothed over their neighbors."""
    mean, share = cells_of(data, ~mask)
    smooth, weight = (gaussian_filter(a, 1.0) for a in (mean * share, share))
    used = share >= 0.5
    smooth = np.where(used, smooth / np.maximum(weight, 1e-3), np.inf)
    out = np.zeros_like(used)
    step = max(1, round(box / _CELL))
    for y in range(0, used.shape[0], step):
        for x in range(0, used.shape[1], step):
            part = np.s_[y : y + step, x : x + step]
            values = smooth[part][used[part]]
            if values.size:
                out[part] = smooth[part] <= np.quantile(values, least)
    return pixels_of(out, mask.shape) & ~mask


def _median(values):
    """Median of finite values; they are put in another order."""
    half = values.size // 2
    values.partition(half)
    if values.size % 2:
        return values[half]
    return np.mean([values[:half].max(), values[half]], dtype=values.dtype)


def _spread(values):
    """As `astropy.stats.mad_std`, in place: a fifth of the time of a background less."""
    values -= _median(values)
    return 1.4826 * _median(np.abs(values, out=values))
