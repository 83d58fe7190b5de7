"""World coordinates of images in FITS files: those of the header, and the gwcs of JWST's files."""

import importlib.util
import re
import warnings

import numpy as np
from astropy.io import fits

from miricigale.instrument.asdf_extension import asdf_wcs, read_gwcs
from miricigale.instrument.keywords import header_text, keyword_text
from miricigale.utils.exceptions import PhotometryWarning, data_error, warn
from miricigale.utils.options import check_that

#: Kinds of exposures of JWST by their instruments.
_KIND_OF_JWST = re.compile("(?:MIR|NRC|NRS|NIS|FGS)_")
#: Keywords of distortions in the convention SIP.
_SIP = re.compile(r"(?:A|B|AP|BP)_(?:ORDER|DMAX|\d+_\d+)")
#: Pixels by which the header and the gwcs of one image may be apart.
_APART = 0.1
#: The same at the reference pixel of a header that lacks the distortion.
_APART_AT_REFERENCE = 0.5


def header_wcs(header, hdus=None, *, where):
    """
    Return the celestial coordinates of a FITS header.

    SIP coefficients count only if CTYPE ends in ``-SIP``, as the convention says: headers of mosaics often keep
    those of an exposure. astropy applies them nevertheless.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Of an image; axes beyond two are left out.
    hdus : `~astropy.io.fits.HDUList`, optional
        The file, for lookup tables of distortion.
    where : str
        Name of the file, for messages.

    Returns
    -------
    wcs : `~astropy.wcs.WCS` or None
        None without celestial axes.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If they have no solution, such as a matrix of zeros.

    Warns
    -----
    `~miricigale.utils.exceptions.PhotometryWarning`
        If SIP coefficients are left out.

    References
    ----------
    Shupe et al. 2005, ASP Conf. 347, 491 (SIP).
    """
    from astropy.wcs import WCS, FITSFixedWarning, WcsError

    kinds = [header_text(header, f"CTYPE{axis}") for axis in (1, 2)]
    stray = [key for key in header if _SIP.fullmatch(key)]
    if stray and not any(kind.endswith("-SIP") for kind in kinds):
        header = header.copy()
        for key in stray:
            header.remove(key, ignore_missing=True, remove_all=True)
        if all(kinds):
            msg = (
                f"{where}: its header has SIP coefficients, but CTYPE1 = {kinds[0]!r} without -SIP states no "
                "distortion: they are not applied (write CTYPE with -SIP if they belong to this image)"
            )
            warn(msg, PhotometryWarning)
    with warnings.catch_warnings():
        # dates and the like that are written in another way
        warnings.simplefilter("ignore", FITSFixedWarning)
        try:
            wcs = WCS(header, hdus, naxis=2)
            is_celestial = wcs.has_celestial
        except WcsError as err:
            reason = str(err).strip().splitlines()[-1]
            raise data_error(
                where, f"has world coordinates that cannot be used: {reason}"
            ) from None
    if not is_celestial:
        return None
    if header.get("NAXIS", 2) > 2:
        # parts are cut by it, and of two axes it must have two
        wcs.pixel_shape = header["NAXIS1"], header["NAXIS2"]
    return wcs


def as_wcs(given):
    """
    Return the world coordinates of whatever holds some.

    Parameters
    ----------
    given : `~astropy.wcs.WCS`, `~astropy.io.fits.Header` or image with ``wcs``
        A header has those of its image, with the shape of the pixels if it states it.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`

    Raises
    ------
    ValueError
        If it is nothing of these, or without celestial axes.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from miricigale.instrument import as_wcs, north_up_wcs
    >>> wcs = north_up_wcs(SkyCoord(53.1, -27.8, unit="deg"), 0.1 * u.arcsec, (20, 30))
    >>> as_wcs(wcs.to_header()).wcs.ctype[0]
    'RA---TAN'
    """
    from astropy.wcs import WCS

    wcs = given
    if isinstance(given, fits.Header):
        wcs = header_wcs(given, where="'wcs'")
        if wcs is not None and "NAXIS2" in given:
            wcs.pixel_shape = given["NAXIS1"], given["NAXIS2"]
    elif not isinstance(given, WCS):
        shape = getattr(given, "shape", None)
        wcs = getattr(given, "wcs", None)
        if isinstance(wcs, WCS) and wcs.pixel_shape is None and shape is not None:
            wcs = wcs.deepcopy()
            wcs.pixel_shape = shape[::-1]
    celestial = isinstance(wcs, WCS) and wcs.has_celestial
    wanted = "an astropy WCS with celestial axes, or a header or an image with one"
    check_that(celestial, "wcs", wanted, type(given).__name__)
    return wcs


def image_wcs(header, hdus):
    """
    Return the celestial coordinates of an image in a file.

    Those of its header; those of the extension ASDF of JWST's pipeline (a gwcs), as polynomials good to 0.01
    pixels, if the header has none, or those of a single exposure without its distortion.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Of the extension with the image.
    hdus : `~astropy.io.fits.HDUList`
        The file.

    Returns
    -------
    wcs : `~astropy.wcs.WCS` or None
        None without any.

    Raises
    ------
    ImportError
        If the coordinates are in the ASDF extension alone and gwcs is not installed.

    Warns
    -----
    `~miricigale.utils.exceptions.PhotometryWarning`
        If SIP coefficients are left out, distortion is in the ASDF extension alone and gwcs is not installed, or
        the coordinates of header and gwcs (where it is installed) are not the same.
    """
    file = hdus.filename() or "the list of HDUs"
    wcs = header_wcs(header, hdus, where=file)
    if "ASDF" not in hdus:
        return wcs
    if wcs is None:
        return asdf_wcs(header, hdus)
    shape = header["NAXIS2"], header["NAXIS1"]
    if is_exposure(lambda key: header.get(key, hdus[0].header.get(key))) and wcs.sip is None:
        try:
            distorted = asdf_wcs(header, hdus)
        except ImportError as err:
            warn(
                f"{file}: the coordinates in the header lack the distortion, which is in "
                f"the extension ASDF: positions are pixels off. {err}",
                PhotometryWarning,
            )
            return wcs
        if distorted is None:
            # of an image without distortion, as it was given
            return wcs
        x, y = (np.atleast_1d(value - 1) for value in wcs.wcs.crpix)
        inside = -0.5 <= x[0] <= shape[1] - 0.5 and -0.5 <= y[0] <= shape[0] - 0.5
        if inside and (offset := _pixels_apart(wcs, distorted, x, y)) > _APART_AT_REFERENCE:
            warn(
                f"{file}: the coordinates in its header and those in its extension ASDF (gwcs) are {offset:.3g} "
                "pixels apart at the reference pixel: those of ASDF are used, which have the distortion. Was the "
                "header aligned, but not the gwcs?",
                PhotometryWarning,
            )
        return distorted
    _compare_with_gwcs(wcs, hdus, shape, file)
    return wcs


def check_kind_of_exposure(get, path):
    """
    Refuse exposures of JWST that are no images of the sky: acquisitions, coronagraphs, spectra.

    Parameters
    ----------
    get : callable
        Value of a keyword, or None.
    path : path-like
        Of the file, for the message.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If EXP_TYPE says so.
    """
    kind = keyword_text(get, "EXP_TYPE")
    if get("TELESCOP") not in ("JWST", None) or kind in ("", "N/A", "ANY"):
        return
    if _KIND_OF_JWST.match(kind) and not kind.endswith("IMAGE"):
        wanted = (
            "must be an image of the sky (EXP_TYPE MIR_IMAGE, NRC_IMAGE, NIS_IMAGE or their like)"
        )
        raise data_error(path, f"{wanted}, got {kind}")


def is_exposure(get):
    """Tell whether a header (``get(keyword)``) is that of a single exposure of JWST, not resampled."""
    return get("S_WCS") == "COMPLETE" and get("S_RESAMP") != "COMPLETE"


def _compare_with_gwcs(wcs, hdus, shape, file):
    """Warn if the gwcs of a file, where it can be read, says something else than its header."""
    if any(importlib.util.find_spec(name) is None for name in ("gwcs", "asdf")):
        return
    exact = read_gwcs(hdus)
    if exact is None:
        return
    offset = _pixels_apart(wcs, exact, *compared_pixels(shape))
    if offset > _APART:
        warn(
            f"{file}: the coordinates in its header and those in its extension ASDF (gwcs) are up to {offset:.3g} "
            "pixels apart: those of the header are used. If those of ASDF are right, remove the WCS keywords of "
            "the header; if not, the extension ASDF",
            PhotometryWarning,
        )


def compared_pixels(shape):
    """Return x and y of the corners and the middle of an image, where two coordinates are compared."""
    ny, nx = shape
    x = np.array([0, nx - 1, 0, nx - 1, (nx - 1) / 2])
    y = np.array([0, 0, ny - 1, ny - 1, (ny - 1) / 2])
    return x, y


def _pixels_apart(wcs, reference, x, y):
    """Largest distance of positions by two coordinates, in pixels of the first; 0 where one of them has none."""
    mapped = wcs.world_to_pixel(reference.pixel_to_world(x, y))
    distance = np.hypot(mapped[0] - x, mapped[1] - y)
    finite = np.isfinite(distance)
    if finite.any():
        return float(distance[finite].max())
    return 0.0
