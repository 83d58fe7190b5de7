"""Images of a run as FITS files."""

import json

import astropy.units as u
import numpy as np
from astropy.io import fits

from miricigale.instrument import dq_legend, read_dq
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import image_unit, open_fits, write_fits
from miricigale.utils.meta import undated
from miricigale.utils.store import plain_value

__all__ = ["read_image", "write_image"]


def _plain(value):
    """A value as JSON knows it; a quantity keeps its unit as text."""
    return f"{value}" if isinstance(value, u.Quantity) else plain_value(value)


def write_image(image, path, *, planes=None):
    """
    Write an image as FITS: SCI, ERR, MASK and further planes.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Its WCS (with distortion) goes to the SCI header, its meta as JSON to the keyword
        META, so that names and types survive.
    path : path-like
        Where to; an existing file is replaced.
    planes : dict of str to `~numpy.ndarray`, optional
        Further image extensions by name; ``dq`` holds flags (`~miricigale.instrument.DQ`).
    """
    header = image.wcs.to_header(relax=True) if image.wcs is not None else fits.Header()
    header["BUNIT"] = image.unit.to_string("fits")
    header["META"] = json.dumps(undated(image.meta), default=_plain, allow_nan=True)
    hdus = [
        fits.PrimaryHDU(),
        fits.ImageHDU(np.asarray(image.data, np.float32), header, name="SCI"),
    ]
    if image.uncertainty is not None:
        hdus.append(fits.ImageHDU(np.asarray(image.uncertainty.array, np.float32), name="ERR"))
    if image.mask is not None:
        hdus.append(fits.ImageHDU(np.asarray(image.mask, np.uint8), name="MASK"))
    for name, plane in (planes or {}).items():
        header = dq_legend() if name.lower() == "dq" else None
        hdus.append(fits.ImageHDU(np.asarray(plane), header, name=name.upper()))
    write_fits(hdus, path, overwrite=True)


def read_image(path, *, planes=()):
    """
    Read what `write_image` wrote, in the byte order of the machine and with its own meta.

    Parameters
    ----------
    path : path-like
        The file.
    planes : iterable of str, optional
        Names of further planes wanted.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        Or a tuple of it and the planes, if some were asked for.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, or has no SCI extension or no unit of an image.
    """
    from astropy.nddata import CCDData, StdDevUncertainty
    from astropy.wcs import WCS

    with open_fits(path, wanted="an image (FITS with SCI)") as hdus:
        if "SCI" not in hdus:
            msg = f"{path} has no SCI extension, only {[hdu.name for hdu in hdus]}"
            raise DataError(msg)
        header = hdus["SCI"].header
        wcs = WCS(header)
        error = np.array(hdus["ERR"].data, np.float32) if "ERR" in hdus else None
        image = CCDData(
            np.array(hdus["SCI"].data, np.float32),
            unit=image_unit(header, path, like=None),
            wcs=wcs if wcs.has_celestial else None,
            uncertainty=None if error is None else StdDevUncertainty(error),
            mask=np.array(hdus["MASK"].data, bool) if "MASK" in hdus else None,
            meta=json.loads(header.get("META", "{}")),
        )
        extra = []
        for name in planes:
            hdu = hdus[name.upper()]
            extra.append(read_dq(hdu) if name.lower() == "dq" else np.array(hdu.data))
    return (image, *extra) if extra else image
