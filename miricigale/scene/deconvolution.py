"""The light of an image before its PSF, as far as the noise allows."""

import numpy as np
import scipy.fft

from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords


@takes_other_keywords
def deconvolve(image, psf, *, max_gain=3.0):
    """
    Undo the blur of a PSF at the spatial frequencies that it has left.

    The Fourier transform of the image is multiplied by ``conj(P) / max(|P|^2, 1 / max_gain^2)``, where
    P is that of the PSF: where the PSF leaves more than ``1 / max_gain`` of an amplitude the
    light is as it was, and beyond it falls off smoothly as ``(max_gain |P|)^2``. No amplitude, and so no noise,
    is raised by more than ``max_gain``. The sum is kept. Within the width of the PSF from the edges of the image
    the light is not what it was, since what lies beyond them is not known.

    Parameters
    ----------
    image : array-like, shape (ny, nx)
        Background subtracted, finite.
    psf : array-like, shape (my, mx)
        The PSF on the pixels of the image, centered, with odd sides; its sum is taken for all of the
        light.
    max_gain : float, optional
        Largest factor on an amplitude, at least 1.

    Returns
    -------
    image : `~numpy.ndarray`, shape (ny, nx)

    Raises
    ------
    ValueError
        If an array is not finite and two-dimensional, the PSF has an even side or no light, or
        ``max_gain`` is below 1.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.scene import deconvolve
    >>> y, x = np.mgrid[-30:31, -30:31]
    >>> wide, psf = (np.exp(-0.5 * (x**2 + y**2) / s**2) for s in (5.0, 2.0))
    >>> sharp = deconvolve(wide, psf)
    >>> print(f"width {np.sqrt(sharp.sum() / (2 * np.pi * sharp.max())):.2f} pixels")
    width 4.58 pixels
    """
    image = floats(image)
    psf = floats(psf)
    for name, array in (("image", image), ("psf", psf)):
        if array.ndim != 2 or not np.all(np.isfinite(array)):
            raise argument_error(name, "a finite 2D array", f"shape {array.shape}")
    if any(side % 2 == 0 for side in psf.shape) or not psf.sum() > 0:
        got = f"shape {psf.shape} with the sum {psf.sum():.4g}"
        raise argument_error("psf", "an array with odd sides and a positive sum", got)
    check_that(1 <= max_gain < np.inf, "max_gain", "a number of at least 1", max_gain)
    # so wide that nothing comes in again from the other side
    sides = np.add(image.shape, psf.shape).tolist()
    shape = [scipy.fft.next_fast_len(side, real=True) for side in sides]
    centered = np.zeros(shape)
    centered[: psf.shape[0], : psf.shape[1]] = psf / psf.sum()
    centered = np.roll(centered, (-(psf.shape[0] // 2), -(psf.shape[1] // 2)), axis=(0, 1))
    transfer = scipy.fft.rfft2(centered)
    inverse = np.conj(transfer) / np.maximum(np.abs(transfer) ** 2, max_gain**-2.0)
    ny, nx = image.shape
    return scipy.fft.irfft2(scipy.fft.rfft2(image, s=shape) * inverse, s=shape)[:ny, :nx]
