"""Arrays of kernels: convolution of images with one, and the mean of several."""

import numpy as np
from scipy.signal import fftconvolve, oaconvolve

from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that


def convolved(image, array):
    """Return the image of the same shape, convolved with an array and zero outside of it."""
    image = floats(image)
    check_that(image.ndim == 2, "image", "2D", f"shape {image.shape}")
    bad = int(np.count_nonzero(~np.isfinite(image)))
    check_that(not bad, "image", "finite", f"{bad} pixels that are NaN or infinite")
    convolve = fftconvolve
    if min(image.shape) > 2 * array.shape[0]:
        convolve = oaconvolve
    full = convolve(image, array, mode="full")
    h = array.shape[0] // 2
    return full[h : h + image.shape[0], h : h + image.shape[1]]


def blended(kernels, weights=None):
    """What the weighted mean of kernels is made of, by the arguments of `~miricigale.psf.MatchingKernel`."""
    n = len(kernels)
    names = ("array", "source", "target")
    w = np.ones(n)
    if weights is not None:
        w = floats(weights)
    if w.shape != (n,) or np.any(w < 0) or not w.sum() > 0:
        raise argument_error("weights", f"{n} non-negative numbers, not all 0", weights)
    forms = {(k.pixel_scale, *(np.shape(getattr(k, name)) for name in names)) for k in kernels}
    check_that(len(forms) <= 1, "kernels", "alike in pixel, shape and PSFs", forms)
    w = w / w.sum()
    mean = {}
    for name in names:
        if getattr(kernels[0], name) is not None:
            mean[name] = np.tensordot(w, [getattr(k, name) for k in kernels], axes=1)
    meta = {"weights": w.tolist(), "lost": float(w @ [k.meta.get("lost", 0) for k in kernels])}
    return {**mean, "pixel_scale": kernels[0].pixel_scale, "meta": meta}
