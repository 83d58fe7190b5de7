"""Images that were enlarged by repeating their pixels."""

import astropy.units as u
import numpy as np
from astropy.nddata import StdDevUncertainty

from miricigale.instrument.image import Image
from miricigale.instrument.image_planes import standard_deviation
from miricigale.utils.exceptions import PhotometryWarning, warn


def own_pixels(image):
    """
    Remove copies of pixels from an image.

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
    # lines at which the values change: one of each n
    rows = _first_lines(data)
    columns = _first_lines(data.T)
    n = np.diff(rows)[0]
    if n == 1 or np.any(np.diff(rows) != n) or np.any(np.diff(columns) != n):
        return image
    msg = f"the image has each of its pixels {n} x {n} times: it is measured on the pixels that it had before"
    warn(msg, PhotometryWarning)
    ny, nx = data.shape
    part = _whole_copies(rows[0] % n, ny, n), _whole_copies(columns[0] % n, nx, n)
    # a flux in a pixel is that of all its copies
    factor = n**2 if image.unit.is_equivalent(u.Jy) else 1
    parts = {"unit": image.unit, "wcs": image.wcs.slice(part)}
    parts["meta"] = {**image.meta, "repeated_pixels": int(n)}
    if image.mask is not None:
        parts["mask"] = image.mask[part]
    if image.uncertainty is not None:
        noise = standard_deviation(image).array[part]
        parts["uncertainty"] = StdDevUncertainty(noise * factor)
    return Image(data[part] * factor, **parts)


def _whole_copies(first, size, n):
    """Return one line of each n copies, those that are cut by the edge left out."""
    return slice(first, first + (size - first) // n * n, n)


def _first_lines(lines):
    """Return numbers of the lines, from 1 on, with other values than the one before."""
    sampled = np.asarray(lines[:, :: max(1, lines.shape[1] // 256)], float)
    # differences from line to line, over the values
    step = np.abs(np.diff(sampled, axis=0))
    size = np.abs(sampled[1:])
    # a solid angle that changes by 1e-6 may have been divided out
    with np.errstate(invalid="ignore"):
        alike = np.sum(step <= 1e-5 * size, axis=1, where=size > 0)
        n_known = np.sum(np.isfinite(step) & (size > 0), axis=1)
    return np.flatnonzero(alike < 0.9 * np.maximum(n_known, 1)) + 1
