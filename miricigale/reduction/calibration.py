"""Slopes to surface brightness: dark, flat, conversion, residual cosmic rays."""

import astroscrappy
import numpy as np
from scipy.ndimage import binary_dilation, convolve, find_objects, label, maximum_filter

from miricigale.instrument import DQ, field_mask, flat_field, photmjsr, psf_fwhm
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

# pixels that the filters of one pass of L.A.Cosmic reach (the widest, medians of 3 and 7 one after
# the other and the growth of hits, reach 6, the cleaning 2 more), and some to spare
_REACH = 12


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
    hits = _lacosmic(data, variance, ~good) & good
    if not hits.any():
        return hits
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


def _lacosmic(data, variance, mask):
    """
    L.A.Cosmic, only where there may be a hit.

    Its Laplacian has positive parts only, so that the median that is taken off lowers it: a hit
    lies within two pixels of where it is above the threshold. And later passes change nothing
    but around the hits of the first.
    """
    # by halves of pixels: twice the pixel less its neighbors on two sides, four times
    wide = np.pad(data, 1)
    up, down, left, right = wide[:-2, 1:-1], wide[2:, 1:-1], wide[1:-1, :-2], wide[1:-1, 2:]
    laplacian = sum(np.maximum(2 * data - y - x, 0) for y in (up, down) for x in (left, right))
    # a per cent for rounding
    seeds = ~mask & (laplacian > 0.99 * 8 * _SIGMA * np.sqrt(variance))
    for passes in (1, _PASSES):
        # new hits come from as far as the filters reach, and so do the errors at the rim of a part
        near = _grown(seeds, _REACH * (2 * passes - 1))
        found = np.zeros_like(mask)
        if near.mean() > 0.5:
            # parts that overlap would take longer than the whole
            near[:] = True
        for part in find_objects(label(near)[0]):
            hits, _ = astroscrappy.detect_cosmics(
                np.ascontiguousarray(data[part]),
                inmask=np.ascontiguousarray(mask[part]),
                invar=np.ascontiguousarray(variance[part]),
                sigclip=_SIGMA,
                sigfrac=_FRACTION,
                objlim=_CONTRAST,
                gain=1.0,
                readnoise=0.0,
                satlevel=np.inf,
                niter=passes,
            )
            found[part] |= hits & _grown(seeds[part], _REACH * (passes - 1) + 2)
        seeds = found
    return found


def _grown(mask, reach):
    """A mask widened to squares of ``reach`` pixels to each side."""
    return maximum_filter(mask, 2 * reach + 1, mode="constant")


def calibrate(
    rate,
    *,
    filter,
    subarray,
    dark,
    gain,
    ipc_kernel=None,
    flat=None,
    conversion=None,
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
        Whose flat field and conversion.
    dark : float
        Dark rate, DN/s.
    gain : float or None
        Electrons per DN; None if ``conversion`` is given.
    ipc_kernel : `~numpy.ndarray`, shape (3, 3), optional
        Coupling of neighbors that blurs the flat field as it blurs the image: a uniform
        sky comes out uniform. A flat field that is given is not blurred.
    flat : `~numpy.ndarray`, shape (ny, nx), or float, optional
        Relative response; that of the simulated detector if not given.
    conversion : float, optional
        MJy/sr per DN/s; that of the simulated detector and ``gain`` if not given.
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
    """
    if rate.unit is None or not rate.unit.is_equivalent(RATE):
        raise argument_error("rate", f"in {RATE}", f"unit {rate.unit}")
    inside = field_mask(subarray=subarray)
    if rate.shape != inside.shape:
        raise argument_error("rate", f"of shape {inside.shape} for {subarray!r}", rate.shape)
    if flat is None:
        flat = flat_field(filter, subarray=subarray)
        if ipc_kernel is not None:
            flat = convolve(flat, np.asarray(ipc_kernel, np.float32), mode="nearest")
    flat = np.broadcast_to(np.asarray(flat, np.float32), rate.shape)
    conversion = photmjsr(filter, gain=gain) if conversion is None else conversion
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
