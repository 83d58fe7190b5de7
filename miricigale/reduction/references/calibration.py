"""Slopes to surface brightness: flat field and conversion."""

import numpy as np

from miricigale.instrument import DQ, field_mask
from miricigale.reduction.images.images import flag_pixels, plain_flags, with_data
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.units import RATE, SURFACE_BRIGHTNESS, with_adu


def calibrate(rate, *, subarray, flat, conversion, flags=None):
    """
    Turn an image of slopes into surface brightness.

    Parameters
    ----------
    rate : `~astropy.nddata.CCDData`
        DN/s, without the dark current, with uncertainty.
    subarray : str
        Of the exposure.
    flat : `~numpy.ndarray`, shape (ny, nx), or float
        Relative response.
    conversion : float
        MJy/sr per DN/s.
    flags : `~numpy.ndarray` of int64, shape (ny, nx), optional
        Flags of the flat field.

    Returns
    -------
    cal : `~astropy.nddata.CCDData`
        MJy/sr; ``meta["photmjsr"]`` is the conversion. Pixels behind the coronagraph masks are
        masked, and those that the flags of the flat field call NON_SCIENCE; sub-arrays that lie wholly outside
        the imager's field are left alone.

    Raises
    ------
    ValueError
        If the image is not in DN/s, or not of the shape of the sub-array.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> exposure = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> ramp = Detector.miri_imager().expose(sky, exposure, seed=1)
    >>> from miricigale.instrument import photmjsr
    >>> from miricigale.reduction import calibrate
    >>> cal = calibrate(
    ...     Reducer().fit_ramp(ramp),
    ...     subarray="SUB64",
    ...     flat=1.0,
    ...     conversion=photmjsr("miri.f770w"),
    ... )
    >>> print(f"{np.nanmedian(cal.data):.1f} {cal.unit}")
    5.0 MJy / sr
    """
    unit = with_adu(rate.unit)
    if unit is None or not unit.is_equivalent(RATE):
        raise argument_error("rate", f"in {RATE}", f"unit {rate.unit}")
    inside = field_mask(subarray=subarray)
    check_that(
        rate.shape == inside.shape, "rate", f"of shape {inside.shape} for {subarray!r}", rate.shape
    )
    flat = np.broadcast_to(floats(flat).astype(np.float32), rate.shape)
    scale = np.float32(unit.to(RATE) * conversion) / flat
    out = with_data(
        rate,
        np.asarray(rate.data, np.float32) * scale,
        factor=scale,
        unit=SURFACE_BRIGHTNESS,
        photmjsr=float(conversion),
    )
    if inside.any():
        outside = ~inside
    else:
        outside = np.zeros_like(inside)
    if flags is not None:
        out.flags |= flags
        out.mask |= (flags & DQ.DO_NOT_USE) != 0
        # the knife edge and other parts of the metering structure
        outside |= (flags & DQ.NON_SCIENCE) != 0
    outside &= (plain_flags(rate) & DQ.REFERENCE_PIXEL) == 0
    return flag_pixels(out, outside, DQ.NON_SCIENCE | DQ.DO_NOT_USE)
