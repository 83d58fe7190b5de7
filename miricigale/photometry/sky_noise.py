"""The noise of an image on its source-free pixels, beside what a map says of it."""

import numpy as np

from miricigale.utils.exceptions import argument_error

__all__ = ["sky_noise", "weight_scale"]


def weight_scale(data, weight, *, mask=None):
    """
    Measure the factor between the noise of an image and what its weights say.

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
    """
    data, weight = np.asarray(data, float), np.asarray(weight, float)
    if data.ndim != 2 or data.shape != weight.shape:
        raise argument_error("weight", f"of the image's shape {data.shape}", weight.shape)
    usable = np.isfinite(data) & np.isfinite(weight) & (weight > 0)
    if mask is not None:
        usable &= ~np.asarray(mask, bool)
    if not usable.any():
        raise argument_error("weight", "positive in some usable pixels", "none")
    return sky_noise(np.where(usable, data * np.sqrt(np.where(usable, weight, 0)), 0.0), usable)[1]


def sky_noise(values, usable, *, width=2.0, threshold=3.5, grow=3):
    """
    Median and robust rms of the source-free pixels, and which they are.

    What is significant after smoothing is left out with a rim, until that changes nothing.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (ny, nx)
        The image, best in units of its local noise.
    usable : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels with data; at least one.
    width : float, optional
        Of the Gaussian, in pixels.
    threshold : float, optional
        In units of the rms of the smoothed image.
    grow : int, optional
        Rim in pixels.

    Returns
    -------
    level, rms : float
        Median and 1.4826 times the median absolute deviation.
    free : bool `~numpy.ndarray`, shape (ny, nx)
        The pixels that were taken.
    """
    import scipy.ndimage

    weight = scipy.ndimage.gaussian_filter(usable.astype(np.float32), width)
    smooth = scipy.ndimage.gaussian_filter(np.where(usable, values, 0).astype(np.float32), width)
    # as a mean of the usable pixels
    smooth = smooth / np.maximum(weight, 0.05)
    structure = scipy.ndimage.generate_binary_structure(2, 1)
    free = usable
    for _ in range(12):
        level, rms = _median_rms(smooth[free])
        bright = usable & (np.abs(smooth - level) > threshold * rms)
        bright = scipy.ndimage.binary_dilation(bright, structure, iterations=grow)
        found = usable & ~bright
        # an image that is full of light is measured as it is
        if np.count_nonzero(found) < max(100, 0.02 * np.count_nonzero(usable)):
            break
        if np.array_equal(found, free):
            break
        free = found
    return *_median_rms(values[free]), free


def _median_rms(values):
    level = float(np.median(values))
    return level, 1.4826 * float(np.median(np.abs(values - level)))
