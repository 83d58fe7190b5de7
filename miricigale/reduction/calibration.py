"""Slopes to surface brightness: dark, flat, conversion, residual cosmic rays."""

import astroscrappy
import numpy as np
from scipy.ndimage import binary_dilation, convolve, maximum_filter

from miricigale.instrument import DQ, field_mask, psf_fwhm
from miricigale.reduction.images import flag_pixels, plain_flags, plain_mask, sigma, with_data
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_positive
from miricigale.utils.units import RATE, SURFACE_BRIGHTNESS

# mean scale of the imager's pixels, to turn a FWHM into pixels; the detection kernel
# needs no more accuracy
_PIXEL_SCALE = 0.1109

# L.A.Cosmic: Laplacian over noise from which a pixel counts, the fraction of it for the neighbors of a hit,
# the least contrast between the Laplacian and the fine structure (higher values protect point sources
# better), and passes
_SIGMA, _FRACTION, _CONTRAST, _PASSES = 5.0, 0.3, 3.0, 3

# how many times steeper than a Gaussian of the PSF's width, centered on a pixel, a hit must be: the peak less
# the mean of its four neighbors, over the highest of the eight neighbors
_SHARPNESS = 2.0


def find_cosmic_rays(image, *, fwhm):
    """
    Find what is sharper than a point source.

    L.A.Cosmic proposes hits; of these only pixels stay that rise more steeply above
    their neighbors than a point source does, with the hits that touch them.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        With uncertainty.
    fwhm : float
        Of the point-spread function, in pixels.

    Returns
    -------
    mask : `~numpy.ndarray` of bool, shape (ny, nx)
        True where there is a hit.

    Notes
    -----
    Without the last condition L.A.Cosmic flags the cores and diffraction patterns of bright
    point sources, for any choice of its parameters. The price are hits spread evenly
    over several pixels, which only the other dithers show (`reject_outliers`).

    References
    ----------
    van Dokkum 2001, PASP 113, 1420; McCully et al. 2018, astroscrappy.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> field = SkyCoord(53, -27, unit="deg")
    >>> wcs = north_up_wcs(field, 0.11 * u.arcsec, (100, 100))
    >>> rng = np.random.default_rng(1)
    >>> error = StdDevUncertainty(np.full((100, 100), 0.1))
    >>> images = [
    ...     CCDData(
    ...         rng.normal(level, 0.1, (100, 100)),
    ...         unit="MJy/sr",
    ...         uncertainty=error,
    ...         wcs=wcs,
    ...     )
    ...     for level in (5.0, 5.2, 5.1)
    ... ]
    >>> from miricigale.reduction import find_cosmic_rays
    >>> images[0].data[50, 40] += 20
    >>> np.argwhere(find_cosmic_rays(images[0], fwhm=2.4)).tolist()
    [[50, 40]]
    """
    check_positive(fwhm, "fwhm")
    mask = plain_mask(image)
    error = sigma(image)
    good = ~mask & np.isfinite(error) & (error > 0)
    if not good.any():
        return np.zeros(mask.shape, bool)
    level = np.median(image.data[good])
    # in units of the typical noise, so that float32 is enough whatever the unit
    unit = np.median(error[good])
    data = np.where(good, (image.data - level) / unit, 0.0).astype(np.float32)
    variance = np.where(good, np.square(error / unit), 1.0).astype(np.float32)
    hits, _ = astroscrappy.detect_cosmics(
        data,
        inmask=~good,
        invar=variance,
        sigclip=_SIGMA,
        sigfrac=_FRACTION,
        objlim=_CONTRAST,
        gain=1.0,
        readnoise=0.0,
        satlevel=np.inf,
        niter=_PASSES,
    )
    hits &= good
    # a Gaussian's pixel over its neighbor: exp(1 / (2 sigma^2))
    ratio = np.exp(0.5 * (2 * np.sqrt(2 * np.log(2)) / fwhm) ** 2)
    steep = max(_SHARPNESS * (ratio - 1), 1.0)
    mean = convolve(data, np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4)
    ring = np.ones((3, 3), bool)
    highest = maximum_filter(data, footprint=ring & (np.arange(9).reshape(3, 3) != 4))
    noise = np.sqrt(variance)
    rise = data - mean
    sharp = hits & (rise > steep * highest) & (rise > _SIGMA * noise)
    return hits & binary_dilation(sharp, ring)


def calibrate(
    rate,
    *,
    filter,
    subarray,
    dark,
    flat,
    conversion,
    flags=None,
    cosmic_rays=False,
):
    """
    Turn an image of slopes into surface brightness.

    Parameters
    ----------
    rate : `~astropy.nddata.CCDData`
        DN/s, with uncertainty.
    filter, subarray : str
        Of the exposure.
    dark : float
        Dark rate, DN/s.
    flat : `~numpy.ndarray`, shape (ny, nx), or float
        Relative response.
    conversion : float
        MJy/sr per DN/s.
    flags : `~numpy.ndarray` of int64, shape (ny, nx), optional
        Flags of the flat field.
    cosmic_rays : bool, optional
        Whether residual cosmic rays are searched and masked (`find_cosmic_rays`).

    Returns
    -------
    cal : `~astropy.nddata.CCDData`
        MJy/sr; ``meta["photmjsr"]`` is the conversion. Pixels behind the coronagraph masks are
        masked; sub-arrays that lie wholly outside the imager's field are left alone.

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
    ...     filter="miri.f770w",
    ...     subarray="SUB64",
    ...     dark=0.05,
    ...     flat=1.0,
    ...     conversion=photmjsr("miri.f770w"),
    ... )
    >>> print(f"{np.nanmedian(cal.data):.1f} {cal.unit}")
    5.0 MJy / sr
    """
    if rate.unit is None or not rate.unit.is_equivalent(RATE):
        raise argument_error("rate", f"in {RATE}", f"unit {rate.unit}")
    inside = field_mask(subarray=subarray)
    if rate.shape != inside.shape:
        raise argument_error("rate", f"of shape {inside.shape} for {subarray!r}", rate.shape)
    flat = np.broadcast_to(np.asarray(flat, np.float32), rate.shape)
    scale = np.float32(rate.unit.to(RATE) * conversion) / flat
    dark = np.float32(dark / rate.unit.to(RATE))
    out = with_data(
        rate,
        (np.asarray(rate.data, np.float32) - dark) * scale,
        factor=scale,
        unit=SURFACE_BRIGHTNESS,
        photmjsr=float(conversion),
    )
    if flags is not None:
        out.flags |= flags
        out.mask |= (flags & DQ.DO_NOT_USE) != 0
    outside = ~inside if inside.any() else np.zeros_like(inside)
    outside &= (plain_flags(rate) & DQ.REFERENCE_PIXEL) == 0
    out = flag_pixels(out, outside, DQ.NON_SCIENCE | DQ.DO_NOT_USE)
    if cosmic_rays:
        fwhm = psf_fwhm(filter).value / _PIXEL_SCALE
        hits = find_cosmic_rays(out, fwhm=fwhm)
        out = flag_pixels(out, hits, DQ.COSMIC_RAY | DQ.DO_NOT_USE)
        out.meta["n_cosmic_rays"] = int(np.count_nonzero(hits))
    return out
