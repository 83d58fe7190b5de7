"""Planes of images in FITS files of any origin: their pixels, and those that belong to an image."""

import numpy as np
from astropy.nddata import StdDevUncertainty

from miricigale.instrument.keywords import keyword_text
from miricigale.utils.exceptions import argument_error, data_error
from miricigale.utils.options import check_data

#: What maps of the noise hold, and the extensions of an image's own file that hold them.
NOISE_MAPS = {
    "error": (
        *("ERR", "ERROR", "RMS", "UNCERT", "SIGMA", "STDDEV"),
        *("UNC", "UNCERTAINTY", "NOISE", "STD", "STDEV", "RMSMAP", "RMS_MAP"),
    ),
    # STAT is that of ESO's files
    "variance": ("VAR", "VARIANCE", "STAT"),
    "inverse_variance": ("IVAR", "INVVAR", "INV_VAR", "INVERSE_VARIANCE"),
    "weight": ("WHT", "WEIGHT", "WEIGHTS", "WEIGHT_MAP", "WGT"),
}
#: Parts of the variance in files of JWST.
VARIANCE_PARTS = ("VAR_POISSON", "VAR_RNOISE", "VAR_FLAT")
#: Extensions that mark pixels: 0 is good in masks, bits of flags are those of the telescope.
MASKS = ("MASK", "BPM", "BADPIX")
MARKS = (*MASKS, "DQ", "FLAGS", "FLAG")
#: Extensions that belong to an image, and are none: noise, flags, times and weights.
PLANES = (
    *(name for names in NOISE_MAPS.values() for name in names),
    *VARIANCE_PARTS,
    *MARKS,
    *("CON", "CTX", "EXP", "EXPTIME", "AREA", "NSAMP", "COVERAGE", "COV", "CVG", "GOODPIX"),
)
#: What astropy states in UTYPE.
_UTYPES = {
    "STDDEVUNCERTAINTY": "error",
    "VARIANCEUNCERTAINTY": "variance",
    "INVERSEVARIANCE": "inverse_variance",
}


def plane_shape(hdu):
    """
    Return the rows and columns of an image extension.

    Parameters
    ----------
    hdu : HDU
        Axes of length 1 before the two are left out; an extension without data but with NPIX1, NPIX2 and PIXVALUE
        is a constant plane, as HST has them.

    Returns
    -------
    shape : tuple of int or None
        None if it is no image of two axes.
    """
    if not hdu.is_image:
        return None
    shape = tuple(hdu.shape or ())
    if not shape and _is_constant(hdu):
        return int(hdu.header["NPIX2"]), int(hdu.header["NPIX1"])
    while len(shape) > 2 and shape[0] == 1:
        shape = shape[1:]
    if len(shape) == 2:
        return shape
    return None


def plane_data(hdu, section=None):
    """
    Return the pixels of an image extension, or a part of them without reading the rest.

    Parameters
    ----------
    hdu : HDU
        As for `plane_shape`.
    section : tuple of slice, optional
        Rows and columns.

    Returns
    -------
    data : `~numpy.ndarray`, shape (ny, nx)
    """
    if not hdu.shape and _is_constant(hdu):
        data = np.full(plane_shape(hdu), float(hdu.header["PIXVALUE"]), np.float32)
        if section is None:
            return data
        return data[section]
    extra = len(hdu.shape) - 2
    if section is None:
        data = hdu.data
        if extra == 0:
            return data
        return data[(0,) * extra]
    if extra == 0:
        return hdu.section[section]
    # a slice for each axis: astropy counts dimensions of numbers in another way
    return hdu.section[(slice(0, 1),) * extra + tuple(section)][(0,) * extra]


def _is_constant(hdu):
    return all(key in hdu.header for key in ("NPIX1", "NPIX2", "PIXVALUE"))


def companion(hdus, index, name):
    """
    Return the extension of a file that belongs to an image, by its name and EXTVER.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The file.
    index : int
        The image.
    name : str
        Name of the extension, such as ``"ERR"``.

    Returns
    -------
    hdu : HDU or None
        That of the same EXTVER; if the file has one image and one extension of the name, that one. Those of
        several images without an EXTVER in common belong to none.
    """
    image = hdus[index]
    named = [hdu for hdu in hdus if hdu is not image and hdu.name == name]
    same_version = [hdu for hdu in named if hdu.ver == image.ver]
    if len(same_version) == 1:
        # of a file with two images and one map the map is that of the first by chance
        return same_version[0]
    alike = []
    for hdu in hdus:
        if hdu.name == image.name and plane_shape(hdu) is not None:
            alike.append(hdu)
    if len(named) == 1 and len(alike) <= 1:
        return named[0]
    return None


def check_plane(hdu, shape, path, plane_name):
    """
    Refuse a plane that is not on the pixels of its image.

    Parameters
    ----------
    hdu : HDU
        The plane.
    shape : tuple of int
        Rows and columns of the image.
    path, what : path-like, str
        File and what the plane is, for messages.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the shape is another one.
    """
    plane_size = plane_shape(hdu) or tuple(hdu.shape)
    problem = f"has an extension {hdu.name} ({plane_name}) of the shape {plane_size}, and its image {tuple(shape)}"
    check_data(
        plane_size == tuple(shape), path, f"{problem}: not on the same pixels; remove or mend it"
    )


def noise_kind(hdu):
    """
    Return the kind of a map of the noise by what its extension says of itself.

    Parameters
    ----------
    hdu : HDU
        By UTYPE, as astropy writes it, or by its name.

    Returns
    -------
    kind : str or None
        One of `NOISE_MAPS`; None if it says nothing.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If UTYPE is one of an unknown uncertainty.
    """
    kind_name = keyword_text(hdu.header.get, "UTYPE")
    if kind_name in _UTYPES:
        return _UTYPES[kind_name]
    if kind_name.endswith("UNCERTAINTY"):
        problem = (
            f"holds an uncertainty of unknown kind (UTYPE {hdu.header['UTYPE']!r}): say which it is"
        )
        extension = f"extension {hdu.name}"
        raise data_error(extension, problem)
    for kind, names in NOISE_MAPS.items():
        if hdu.name in names:
            return kind
    return None


def noise_planes(hdus, index):
    """
    Return the extensions of a file that can be maps of the noise of an image, the best first.

    Parameters
    ----------
    hdus, index
        As for `companion`.

    Returns
    -------
    planes : list of (str, HDU)
        Kind and extension.
    """
    planes = []
    for names in NOISE_MAPS.values():
        for name in names:
            hdu = companion(hdus, index, name)
            if hdu is not None and hdu.is_image:
                planes.append((noise_kind(hdu), hdu))
    return planes


def standard_deviation(image):
    """
    Return the uncertainty of an image as a standard deviation, in the unit of the image.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        With an uncertainty: a variance, an inverse variance or a standard deviation.

    Returns
    -------
    uncertainty : `~astropy.nddata.StdDevUncertainty`

    Raises
    ------
    ValueError
        If it is of unknown kind.
    """
    try:
        # inverse variances of 0, which is no data, are infinite
        with np.errstate(divide="ignore"):
            deviation = image.uncertainty.represent_as(StdDevUncertainty)
    except TypeError:
        wanted = "one with a standard deviation, a variance or an inverse variance"
        raise argument_error("image", wanted, type(image.uncertainty).__name__) from None
    # uncertainties may have a unit of their own
    if deviation.unit is None or image.unit is None or deviation.unit == image.unit:
        return deviation
    return StdDevUncertainty(deviation.array * deviation.unit.to(image.unit))
