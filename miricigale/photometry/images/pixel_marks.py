"""Pixels of an image that its file excludes: masks, flags of data quality and weights of 0."""

import numpy as np

from miricigale.instrument.dq_schemes import bad_pixels
from miricigale.instrument.image_planes import (
    MARKS,
    MASKS,
    check_plane,
    companion,
    plane_data,
    plane_shape,
)
from miricigale.utils.exceptions import PhotometryWarning, warn

#: Extensions that mark pixels, and weights, which are above 0.
_MARKS = (*MARKS, "WHT")
#: Part of the pixels with data that a mask may exclude without a warning.
_MOST = 0.5


def marked_good(hdus, index, mosaic, has_data):
    """
    Find pixels that no extension of marks or weights excludes.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The file.
    index : int
        Extension of the image.
    mosaic : `~miricigale.photometry.MosaicFile`
        Its ``path`` is named in messages, its ``section`` is read.
    has_data : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels with data, for a warning of masks that exclude most of them.

    Returns
    -------
    good : `~numpy.ndarray` of bool, shape (ny, nx), or True without marks
    scheme : str or None
        By which scheme bits of flags are read, if there are any.
    """
    header = hdus[index].header

    def get(key):
        return header.get(key, hdus[0].header.get(key))

    good = True
    scheme = None
    for name in _MARKS:
        # weights and plain masks by their value, others by their bits
        hdu = companion(hdus, index, name)
        if hdu is None or not hdu.is_image or (not hdu.shape and plane_shape(hdu) is None):
            continue
        check_plane(hdu, plane_shape(hdus[index]), mosaic.path, "marks of pixels")
        values = np.asarray(plane_data(hdu, mosaic.section))
        if name == "WHT":
            good = good & (values > 0)
            continue
        has_planes = any(str(key).startswith("MP_") for key in hdu.header)
        if name in MASKS and not has_planes:
            # a mask of astropy's has no bits
            good = good & (values == 0)
            _warn_of_sense(f"{mosaic.path}[{name}]", values != 0, has_data)
            continue
        bad, scheme = bad_pixels(values, hdu.header, get, f"{mosaic.path}[{name}]")
        good = good & ~bad
    return good, scheme


def _warn_of_sense(label, masked, has_data):
    """Warn of a mask that excludes most pixels with data, as one does in which 1 is good."""
    if not has_data.any():
        return
    part = np.mean(masked[has_data])
    if part > _MOST:
        msg = (
            f"{label} excludes {part:.0%} of the pixels with data: what is not 0 is bad there. "
            "If 1 is good in it, write 1 less it"
        )
        warn(msg, PhotometryWarning)
