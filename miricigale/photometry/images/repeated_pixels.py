"""Images that were enlarged by repeating their pixels."""

import astropy.units as u
import numpy as np
from astropy.nddata import StdDevUncertainty

from miricigale.instrument.image import Image
from miricigale.utils.exceptions import PhotometryWarning, warn


def own_pixels(image):
    """
    An image without copies of its pixels.

    Images are enlarged by repeating each pixel n x n times. A template has another value in each of these, and
    their noise is one.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Two-dimensional, with WCS.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        Itself unless pixels are repeated; then on the pixels that it had before, those that are cut by the edge
        left out, with n in ``meta["repeated_pixels"]``.

    Warns
    -----
    `~miricigale.utils.exceptions.PhotometryWarning`
        If pixels are repeated.
    """
    data = np.asarray(image.data)
    if data.ndim != 2 or min(data.shape) < 8:
        return image
    ends = [_first_lines(lines) for lines in (data, data.T)]
    n = np.diff(ends[0])[0]
    if n == 1 or any(np.any(np.diff(lines) != n) for lines in ends):
        return image
    msg = f"the image has each of its pixels {n} x {n} times: it is measured on the pixels that it had before"
    warn(msg, PhotometryWarning)
    first = [lines[0] % n for lines in ends]
    part = tuple(
        slice(k, k + (size - k) // n * n, n) for k, size in zip(first, data.shape, strict=True)
    )
    # a flux in a pixel is that of all its copies
    factor = n**2 if image.unit.is_equivalent(u.Jy) else 1
    parts = {"unit": image.unit, "wcs": image.wcs.slice(part)}
    parts["meta"] = {**image.meta, "repeated_pixels": int(n)}
    if image.mask is not None:
        parts["mask"] = image.mask[part]
    if image.uncertainty is not None:
        noise = image.uncertainty.represent_as(StdDevUncertainty).array[part]
        parts["uncertainty"] = StdDevUncertainty(noise * factor)
    return Image(data[part] * factor, **parts)


def _first_lines(lines):
    """Numbers of the lines, from 1 on, with other values than the one before."""
    sampled = np.asarray(lines[:, :: max(1, lines.shape[1] // 256)], float)
    step = np.abs(np.diff(sampled, axis=0))
    size = np.abs(sampled[1:])
    # a solid angle that changes by 1e-6 may have been divided out
    with np.errstate(invalid="ignore"):
        alike = np.sum(step <= 1e-5 * size, axis=1, where=size > 0)
        n_known = np.sum(np.isfinite(step) & (size > 0), axis=1)
    return np.flatnonzero(alike < 0.9 * np.maximum(n_known, 1)) + 1
