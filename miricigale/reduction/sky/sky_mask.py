"""What of an image is sources, from bright cores to faint and wide light, and what they leave as sky."""

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter, label
from scipy.stats import norm

from miricigale.reduction.images.cells import cells_of, pixels_of, smoothed_cells
from miricigale.utils.arrays import centered

# detection of what is masked: standard deviations of the smoothing in pixels (cores, and
# the wings of bright sources), and the least number of connected pixels: those of the smoothing
_TIERS = ((0.85, 5), (2.5, 20))
# sigma by which sources rise above the sky
_THRESHOLD = 3.0
# light too faint and wide for these is looked for in cells (of 4 pixels a side): standard deviations of the
# smoothing in cells, least numbers of connected ones, and sigma
_WIDE_TIERS = ((1.0, 3, 3.0), (2.0, 12, 6.0))
# the mask of the sources is dilated by this many pixels
_GROW = 3
# the mask of a source grows by the first of these shares of its half width that leaves half of the sky
_GROWTH = (2.0, 1.0, 0.5)
# light that no mask finds is looked for in cells of so many pixels: those so many sigma below the sky
_DARK_CELL = 8
_DARK = 2.58
# less than the first of these, in the noise of a pixel, is not taken off, for errors are not known so well, nor
# where sources cover less than the second and it is less than the third, in that noise
_HIDDEN = 0.1
_LEAST_SHARE = 0.05
_STRUCTURE = 20.0
# shares of the light that masks find, and of that in the mesh where they cover all, in the error of the level,
# as measured (benchmarks/background.py)
_MASKED = 0.5
_WIDE = 2.5


def detect(residual, rms, mask, sources):
    """Return the pixels that rise above the noise of the image, smoothed little, more and much."""
    good = ~mask & (rms > 0)
    sky = good & ~sources
    if not sky.any():
        return np.zeros(mask.shape, bool)
    scaled = np.zeros(mask.shape, np.float32)
    np.divide(residual, rms, out=scaled, where=good, casting="same_kind")
    detected = np.zeros(mask.shape, bool)
    for width, area in _TIERS:
        smooth = gaussian_filter(scaled, width, mode="nearest")
        detected |= _risen(smooth, good, sky, _THRESHOLD, area)
    # what is found is left out, or it would be smeared over cells
    cells, share = cells_of(scaled, good & ~detected)
    sky = cells_of(sky) >= 0.5
    wide = np.zeros(share.shape, bool)
    for width, area, threshold in _WIDE_TIERS if sky.any() else ():
        smooth, covered = smoothed_cells(cells, share, width)
        wide |= _risen(smooth, covered, sky & covered, threshold, area)
    detected |= pixels_of(wide, mask.shape)
    return detected & ~mask


def _risen(smooth, good, sky, threshold, area):
    """Return the connected places of an image that rise above the noise that its sky has."""
    # correlated noise is smoothed less, so that it is measured, on the negative side: of the
    # other the mask leaves a part
    negative = -smooth[sky & (smooth < 0)]
    # a million of them determine the median
    negative = negative[:: max(1, negative.size // 1_000_000)].copy()
    if not negative.size:
        return np.zeros(smooth.shape, bool)
    high = good & (smooth > threshold * 1.4826 * _median(negative))
    labels, n = label(high, np.ones((3, 3), bool))
    # the sky, label 0, is most of the image: only what is high is looked at
    inside = labels[high]
    detected = np.zeros(smooth.shape, bool)
    detected[high] = (np.bincount(inside, minlength=n + 1) >= area)[inside]
    return detected


def grown(sources, mask):
    """Return a mask of sources, each part of it wider by a share of its half width, in cells."""
    # small ones by the cells around them
    cores = [(distance_transform_edt(cells_of(sources) < 0.5), 0.6)]
    radius = 2.5
    sources = binary_dilation(sources, iterations=_GROW)
    depth = distance_transform_edt(cells_of(sources) >= 0.5)
    while (core := depth >= radius).any():
        cores.append((distance_transform_edt(~core), radius))
        radius *= 1.5
    covered = cells_of(mask) < 0.5
    for growth in _GROWTH:
        wide = np.any([away <= (1 + growth) * r for away, r in cores], axis=0)
        if np.count_nonzero(covered & ~wide) >= 0.5 * np.count_nonzero(covered):
            break
    return sources | pixels_of(wide, sources.shape)


def light_left(mesh, sources, noise, step=1):
    """
    Return the light of sources in what is left as sky, as far as the image shows it.

    Parameters
    ----------
    mesh : `~miricigale.reduction.sky.sky_mesh.SkyMesh`
        Sky of the image.
    sources : `~numpy.ndarray` of bool, shape (ny, nx)
        All that was found as sources, if the mesh masks less.
    noise : `~numpy.ndarray`, shape (ny, nx)
        Error of each pixel, as it is in sums over many.
    step : int, optional
        Pixels that share their noise.

    Returns
    -------
    shift : float
        By how much the sky is too bright, where that is more than the noise may hide.
    dark : float
        By how much its darkest cells are darker than noise makes them.
    light : `~numpy.ndarray`, shape (ny, nx)
        Share of the sources' own light that may be in it.
    """
    good = ~mesh.mask
    size = _DARK_CELL * step
    sky = good & ~mesh.sources
    (mean, share), (error, _) = (cells_of(v, sky, size) for v in (mesh.residual, noise))
    enough = share >= min(0.5, share.max())
    error = error[enough] / (np.sqrt(share[enough]) * size)
    part = norm.cdf(-_DARK)
    low = -np.quantile(mean[enough] / error, part)
    chance = np.sqrt(part / error.size) / norm.pdf(_DARK)
    error = float(np.median(error))
    dark_level = max(0.0, low - _DARK)
    # in quadrature, beyond chance: all that may be there
    hidden = max(0.0, low**2 - _DARK**2 - 2 * _DARK * chance)
    dark = error * max(dark_level, np.sqrt(hidden))
    shift = error * max(0.0, dark_level - chance)
    covered = np.mean(sources[good])
    sigma = float(np.median(noise[good]))
    # without sources it is structure of another kind, as dark as bright, unless it is too strong for that
    sure = (covered / _LEAST_SHARE) ** 2 + (dark / (_STRUCTURE * sigma)) ** 2
    shift *= sure / (1 + sure) * shift**2 / (shift**2 + max(_HIDDEN * sigma, error) ** 2)
    # sources that cover the image are in the mesh
    wide = mesh.level
    for axis in (0, 1):
        place = centered(wide.shape[axis])
        slope = place @ wide.mean(axis=1 - axis) / max(place @ place, 1.0)
        wide = wide - np.expand_dims(np.float32(slope) * place.astype(np.float32), 1 - axis)
    wide = np.maximum(wide - np.quantile(wide[::8, ::8], 0.02), 0)
    light = _MASKED * max(0.0, np.median(mesh.residual[good])) + _WIDE * covered**2 * wide
    return np.float32(shift), np.float32(dark), light.astype(np.float32)


def _median(values):
    """Return the median of finite values; they are put in another order."""
    half = values.size // 2
    values.partition(half)
    if values.size % 2:
        return values[half]
    return np.mean([values[:half].max(), values[half]], dtype=values.dtype)
