"""The smoothed high-resolution image, and the well-measured cores of its sources."""

import numpy as np
import scipy.ndimage

from miricigale.utils.parallel import chunks, parallel_map

#: Width (pixels) of the Gaussian that smooths the image.
_WIDTH = 1.5

#: Least signal-to-noise of the smoothed image in a core.
_CORE_SNR = 4.0

#: Noise of the smoothed image over that of the pixels.
SMOOTHED_NOISE = 1.0 / (2.0 * np.sqrt(np.pi) * _WIDTH)


def smooth_image(data, variance, executor):
    """
    Smooth the image, and find where its signal-to-noise is that of a core.

    Parameters
    ----------
    data, variance : `~numpy.ndarray`, shape (ny, nx)
        Light and variance of the pixels, infinite where not usable.
    executor : `concurrent.futures.Executor` or None
        Threads to work with.

    Returns
    -------
    light : float32 `~numpy.ndarray`, shape (ny, nx)
        The smoothed image.
    core : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels whose smoothed signal-to-noise is above 4.
    """
    light = np.empty(data.shape, np.float32)
    core = np.empty(data.shape, bool)
    rim = round(16 * _WIDTH) + 1

    def smooth(rows):
        first = max(rows.start - rim, 0)
        part = slice(first, rows.stop + rim)
        inner = slice(rows.start - first, rows.stop - first)
        usable = np.isfinite(variance[part])

        def filtered(image, width):
            values = np.where(usable, image[part], 0.0)
            return scipy.ndimage.gaussian_filter(values, width, output=float)[inner]

        smoothed = filtered(data, _WIDTH)
        noise = filtered(variance, 4 * _WIDTH)
        light[rows] = smoothed
        core[rows] = (noise > 0) & (smoothed > _CORE_SNR * SMOOTHED_NOISE * np.sqrt(noise))

    parallel_map(smooth, chunks(len(data), 256), executor=executor)
    return light, core
