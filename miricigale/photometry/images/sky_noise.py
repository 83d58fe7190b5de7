"""The noise of an image on its source-free pixels, compared with its noise map."""

import numpy as np
from astropy.stats import mad_std

from miricigale.utils.exceptions import PhotometryWarning, argument_error, warn
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import FNU

#: Pixels of the smallest area that counts as filled.
_FILLED = 25
#: Side of a block of equal pixels that noise of a few counts does not make.
_BLOCK = 5
#: Noise next to an area that was filled, as a part of the number in it.
_FAR = 0.01
#: Pixels of which the different numbers are counted.
_SAMPLE = 20_000

#: Of what is no sky: the Gaussian that smooths, and the rim (pixels).
_WIDTH = 2.0
_RIM = 3


@takes_other_keywords
def weight_scale(data, weight, *, mask=None):
    """
    Measure the factor between the noise of an image and that of its weights.

    Parameters
    ----------
    data, weight : `~numpy.ndarray`, shape (ny, nx)
        Image and weights, of which 1 / weight should be the variance.
    mask : bool `~numpy.ndarray`, shape (ny, nx), optional
        True where a pixel is not to be used; those without weight are not in any case.

    Returns
    -------
    scale : float
        The noise is ``scale / sqrt(weight)``: 1.4826 times the median absolute deviation of
        ``data * sqrt(weight)`` on source-free pixels.

    Raises
    ------
    ValueError
        If shapes differ or no pixel is usable.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.photometry import weight_scale
    >>> data = np.random.default_rng(1).normal(0, 0.3, (200, 200))
    >>> weight = np.full(data.shape, 4.0)
    >>> round(weight_scale(data, weight), 2)
    0.59
    """
    data = floats(data)
    weight = floats(weight)
    if data.ndim != 2 or data.shape != weight.shape:
        raise argument_error("weight", f"of the image's shape {data.shape}", weight.shape)
    usable = np.isfinite(data) & np.isfinite(weight) & (weight > 0)
    if mask is not None:
        usable &= ~np.asarray(mask, bool)
    check_that(usable.any(), "weight", "positive in some usable pixels", "none")
    return sky_noise(np.where(usable, data * np.sqrt(np.where(usable, weight, 0)), 0.0), usable)[1]


def filled_areas(values, usable):
    """
    Find areas of pixels of one number for want of data, such as the corners of drizzled images.

    That number is 0, or the lowest or highest of the image if it is far beyond the pixels next to it, such as -99.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (ny, nx)
        The image.
    usable : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels that count as data so far.

    Returns
    -------
    filled : bool `~numpy.ndarray`, shape (ny, nx)
        Nowhere True if the pixels next to areas of 0 have no noise either (their median is below a tenth of that
        of all others): then the image is a noiseless one, and 0 is its sky.
    """
    filled = _areas_of(values, usable, 0.0)
    if not usable.any():
        return filled
    some_value = values.flat[np.argmax(usable)]
    lowest = np.min(values, where=usable, initial=some_value)
    highest = np.max(values, where=usable, initial=some_value)
    for value in (lowest, highest):
        if value != 0:
            filled |= _areas_of(values, usable, value)
    return filled


def _areas_of(values, usable, value):
    """Areas of one number next to pixels with noise, which are far from it if it is not 0."""
    import scipy.ndimage

    filled = usable & (values == value)
    if np.count_nonzero(filled) < _FILLED:
        return np.zeros_like(usable)
    core = filled
    if _is_coarse(values, usable):
        # noise of a few counts is the same number by chance, though not in whole blocks
        core = scipy.ndimage.binary_erosion(filled, np.ones((_BLOCK, _BLOCK), dtype=bool))
    labels, n = scipy.ndimage.label(filled)
    large = np.bincount(labels.ravel(), minlength=n + 1) >= _FILLED
    large &= np.bincount(labels[core], minlength=n + 1) > 0
    large[0] = False
    filled = large[labels]
    is_beside = scipy.ndimage.binary_dilation(filled, iterations=2) & usable & (values != value)
    is_other = usable & (values != value)
    if np.count_nonzero(is_beside) < 8:
        return np.zeros_like(usable)
    noise_beside = np.median(np.abs(values[is_beside]))
    noise = np.median(np.abs(values[is_other]))
    is_noisy = noise_beside > 0.1 * noise
    # a saturated star is bright around its plateau
    is_far = value == 0 or noise_beside < _FAR * abs(value)
    if not (is_noisy and is_far):
        return np.zeros_like(usable)
    return filled


def _is_coarse(values, usable):
    """Whether an image has few different numbers, as one in whole counts has."""
    sample = values[usable & (values != 0)][:_SAMPLE]
    return np.unique(sample).size < 0.1 * sample.size


def mask_filled(values, usable, name):
    """Take `filled_areas` off the usable pixels, in place, with a warning; their number."""
    filled = filled_areas(values, usable)
    n = int(np.count_nonzero(filled))
    if n:
        numbers = " or ".join(f"{value:g}" for value in np.unique(values[filled]))
        msg = (
            f"{name} has {n} pixels in areas that are exactly {numbers}, though not masked, beside pixels with "
            "noise: they are taken as without data"
        )
        warn(msg, PhotometryWarning)
        usable &= ~filled
    return n


def sky_noise(values, usable, *, significance=3.5):
    """
    Measure the median and robust rms of the source-free pixels, and find these.

    What is significant after smoothing is left out with a rim, until that changes nothing.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (ny, nx)
        The image, best in units of its local noise.
    usable : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels with data; at least one.
    significance : float, optional
        Of what is left out, after smoothing. Below 4 peaks of noise are left out too, and with them a part of the
        noise on large scales.

    Returns
    -------
    level, rms : float
        Median and 1.4826 times the median absolute deviation.
    free : bool `~numpy.ndarray`, shape (ny, nx)
        The pixels that were taken.
    """
    import scipy.ndimage

    weight = scipy.ndimage.gaussian_filter(usable.astype(np.float32), _WIDTH)
    smooth = scipy.ndimage.gaussian_filter(np.where(usable, values, 0).astype(np.float32), _WIDTH)
    # as a mean of the usable pixels
    smooth = smooth / np.maximum(weight, 0.05)
    structure = scipy.ndimage.generate_binary_structure(2, 1)
    is_free = usable
    for _ in range(12):
        level, rms = _median_rms(smooth[is_free])
        bright = usable & (np.abs(smooth - level) > significance * rms)
        bright = scipy.ndimage.binary_dilation(bright, structure, iterations=_RIM)
        is_sky = usable & ~bright
        # an image that is full of light is measured as it is
        if np.count_nonzero(is_sky) < max(100, 0.02 * np.count_nonzero(usable)):
            break
        if np.array_equal(is_sky, is_free):
            break
        is_free = is_sky
    level, rms = _median_rms(values[is_free])
    return level, rms, is_free


def _median_rms(values):
    level = float(np.median(values))
    return level, float(mad_std(values))


def _median(values):
    """Return the median of a million of the values, or of all."""
    return np.median(values[:: max(1, len(values) // 1_000_000)])


def warn_of_background(result, kernel):
    """
    Warn if an image had a background that was not fitted and is in the fluxes.

    If, that is, the median of the residual between the sources adds more than the median error to the flux of a
    point source, and is above 0.05 of the image's noise. ``kernel`` is that of the result.
    """
    residual = result.residual_image
    # rows of large images are as good as all
    step = np.s_[:: max(1, residual.data.size // 10_000_000)]
    sigma = residual.uncertainty.array[step]
    data = residual.data[step]
    is_free = ~residual.mask[step] & (np.abs(result.model_image.data[step]) < 0.3 * sigma)
    error = result.flux_err[np.isfinite(result.flux_err)]
    if np.count_nonzero(is_free) < 400 or not len(error):
        return
    level = float(_median(data[is_free])) * residual.unit
    # solid angle over which a fit of the PSF adds up a constant
    target = kernel.target
    area = target.sum() ** 2 / np.sum(target**2) * kernel.pixel_scale**2
    added = (level * area).to(FNU)
    # the error of a typical source
    error = np.median(error)
    # the errors of an image without noise are those of its model
    if abs(added) > error and abs(level.value) > 0.05 * _median(sigma[is_free]):
        msg = (
            f"'image' has a background of {level:.3g} between the sources, which is not fitted and adds about "
            f"{added:.3g} to fluxes whose median error is {error:.3g}: subtract it, or give 'background_order'"
        )
        warn(msg, PhotometryWarning)


def warn_of_sky(arrays, segments):
    """
    Warn if a high-resolution image (`ImageArrays`) has a sky that goes into the templates.

    If, that is, the median beyond the segments is more than 0.03 of the light of the median segment of
    signal-to-noise above 5.
    """
    is_free = arrays.usable & (segments == 0)
    if np.count_nonzero(is_free) < 400:
        return
    level = _median(arrays.flux[is_free])
    member = arrays.usable & (segments > 0)
    label = segments[member]
    light = np.bincount(label, arrays.flux[member])
    variance = np.bincount(label, arrays.sigma[member] ** 2)
    good = light > 5 * np.sqrt(variance)
    if not good.any():
        return
    part = float(np.median((level * np.bincount(label))[good] / light[good]))
    if abs(part) > 0.03:
        msg = (
            f"'highres' has a sky of {level / _median(arrays.sigma[is_free]):.3g} times its noise, "
            f"{part:.0%} of the light of the median segment: it goes into the templates; subtract it"
        )
        warn(msg, PhotometryWarning)
