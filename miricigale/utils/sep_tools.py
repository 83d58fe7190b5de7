"""
Interface to sep: native byte order, contiguous memory, and explicit defaults.

sep wants C-contiguous arrays in native byte order and knows no NaN; and its ``extract``
filters with ``filter_type='matched'`` by default, which reads the threshold as
a filtered signal-to-noise and is not what Source Extractor's ``DETECT_THRESH`` means. The
functions here take any array, put NaN into the mask, and use ``filter_type='conv'``.
"""

import math

import numpy as np
import sep

from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.units import check_count


def native(array):
    """
    Return an array as sep wants it: C-contiguous, native byte order, not masked.

    Parameters
    ----------
    array : array_like
        Any array (FITS images are big-endian).

    Returns
    -------
    array : `~numpy.ndarray`
        Float32 stays float32, bool and int32 stay, all else becomes float64. A view of the input's
        own memory where it already complies, else a copy.
    """
    array = np.asarray(array)
    dtype = np.dtype(np.float64)
    if array.dtype.kind == "b" or (array.dtype.kind == "f" and array.dtype.itemsize == 4):
        dtype = array.dtype.newbyteorder("=")
    elif array.dtype.kind in "iu" and array.dtype.itemsize <= 4:
        dtype = np.dtype(np.int32)
    return np.ascontiguousarray(array, dtype=dtype)


def _masked_too(mask, bad):
    """Return a mask, or None, with further pixels masked."""
    if mask is None:
        return bad
    return mask | bad


def _image(data, mask):
    """Return native data with non-finite pixels zeroed and added to the mask."""
    data = native(data)
    check_that(data.ndim == 2, "data", "a two-dimensional image", f"shape {data.shape}")
    if data.dtype.kind != "f":
        data = data.astype(np.float64)
    if mask is not None:
        mask = native(np.asarray(mask) != 0)
        got = f"{mask.shape} of {data.shape}"
        check_that(mask.shape == data.shape, "mask", "of the image's shape", got)
    bad = ~np.isfinite(data)
    if bad.any():
        mask = _masked_too(mask, bad)
        data = np.where(bad, data.dtype.type(0), data)
    return data, mask


def background(data, mask=None, box=64, filter_size=3):
    """
    Estimate the smooth background of an image and its local rms.

    Parameters
    ----------
    data : array_like, shape (ny, nx)
        The image; NaN counts as masked.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel does not take part.
    box : int, optional
        Box size in pixels.
    filter_size : int, optional
        Size of the median filter in boxes.

    Returns
    -------
    back, rms : `~numpy.ndarray`, shape (ny, nx)
        Background and its rms in the unit and float type of ``data``.

    Raises
    ------
    ValueError
        If the image is not two-dimensional, sizes are not positive, or nothing is left
        unmasked.

    References
    ----------
    Bertin & Arnouts 1996, A&AS 117, 393, sec. 4; Barbary 2016, JOSS 1, 58.
    """
    data, mask = _image(data, mask)
    if mask is not None and mask.all():
        raise argument_error("mask", "a mask that leaves some pixels", "all pixels masked")
    box = check_count(box, "box")
    size = check_count(filter_size, "filter_size")
    result = sep.Background(data, mask=mask, bw=box, bh=box, fw=size, fh=size)
    return result.back(dtype=data.dtype), result.rms(dtype=data.dtype)


#: Sub-objects of one level of the deblending; 1024 in sep, which crowded fields exceed. sep keeps their
#: numbers in 16 bits and the size of its table (levels x limit x limit at most) in 32.
_SUB_OBJECTS = 8000

#: Detection filter of sep and Source Extractor.
_PYRAMID = np.array([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]])


def extract(
    data,
    threshold,
    *,
    err,
    mask=None,
    min_area=5,
    filter_kernel=_PYRAMID,
    deblend_n_thresholds=32,
    deblend_contrast=0.005,
):
    """
    Detect sources as Source Extractor does.

    Parameters
    ----------
    data : array_like, shape (ny, nx)
        Background-subtracted image; NaN counts as masked.
    threshold : float
        In units of ``err``.
    err : array_like, shape (ny, nx)
        Noise of a pixel. Values that are not finite or not positive count as masked.
    mask : array_like of bool, shape (ny, nx), optional
        True where there is no data.
    min_area : int, optional
        Least number of connected pixels above the threshold.
    filter_kernel : array_like or None, optional
        Detection filter; None for none.
    deblend_n_thresholds, deblend_contrast : optional
        Source Extractor's DEBLEND_NTHRESH and DEBLEND_MINCONT (1 turns deblending off).

    Returns
    -------
    objects : `~numpy.ndarray`
        sep's structured array.
    segmentation : `~numpy.ndarray` of int32, shape (ny, nx)
        Label i + 1 for object i.

    Raises
    ------
    ValueError
        If arguments disagree in shape or are out of range, or the area above the threshold has more peaks than
        sep can tell apart.
    """
    data, mask = _image(data, mask)
    err = np.ascontiguousarray(err, data.dtype)
    check_that(err.shape == data.shape, "err", f"of the image's shape {data.shape}", str(err.shape))
    bad = ~(np.isfinite(err) & (err > 0))
    if bad.any():
        mask = _masked_too(mask, bad)
        err = np.where(bad, err.dtype.type(1), err)
    # sep's buffer of detected pixels never overflows, also where all of them are above the threshold
    stack = data.size + data.shape[1] + 16
    sep.set_extract_pixstack(max(stack, sep.get_extract_pixstack()))
    levels = check_count(deblend_n_thresholds, "deblend_n_thresholds")
    sep.set_sub_object_limit(min(_SUB_OBJECTS, math.isqrt((2**31 - 1) // levels)))
    form = {"err": err, "mask": mask, "minarea": check_count(min_area, "min_area")}
    form |= {"deblend_nthresh": levels, "deblend_cont": float(deblend_contrast)}
    form |= {"filter_type": "conv", "filter_kernel": filter_kernel, "segmentation_map": True}
    if filter_kernel is not None:
        form["filter_kernel"] = native(filter_kernel)
    try:
        return sep.extract(data, float(threshold), **form)
    except Exception as err:
        # sep raises this class itself, and names its limit
        if type(err) is not Exception or "limit" not in str(err):
            raise
        wanted = f"one with less than {_SUB_OBJECTS} peaks in one area above the threshold"
        raise argument_error(
            "data", wanted, "more: its sky is not subtracted, or the threshold is too low"
        ) from None


def window_positions(data, x, y, width, *, mask):
    """
    Windowed centroids of sources, as Source Extractor's ``XWIN_IMAGE``.

    Parameters
    ----------
    data : array_like, shape (ny, nx)
        Background-subtracted image; NaN counts as masked.
    x, y : array_like, shape (n,)
        First positions in pixels.
    width : float
        Standard deviation of the Gaussian window in pixels.
    mask : array_like of bool, shape (ny, nx) or None
        True where there is no data.

    Returns
    -------
    x, y : `~numpy.ndarray`, shape (n,)
        Positions.
    fine : `~numpy.ndarray` of bool, shape (n,)
        Whether all of the window has data.
    """
    data, mask = _image(data, mask)
    x, y, flags = sep.winpos(data, x, y, float(width), mask=mask)
    return np.asarray(x), np.asarray(y), np.asarray(flags) == 0
