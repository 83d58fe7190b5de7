"""Images of a run as FITS files."""

import json

import astropy.units as u
import numpy as np
from astropy.io import fits

from miricigale.instrument import DQ, dq_planes, read_dq, with_own_bits
from miricigale.instrument.header_wcs import header_wcs
from miricigale.instrument.image import Image
from miricigale.instrument.image_planes import standard_deviation
from miricigale.instrument.keywords import header_text
from miricigale.instrument.product_files import jwst_product, write_product
from miricigale.utils.exceptions import data_error
from miricigale.utils.files import open_fits, replacing, write_fits
from miricigale.utils.meta import json_meta
from miricigale.utils.options import check_data, check_that
from miricigale.utils.units import header_unit, with_adu

#: Steps of rounded values in the median error of an image: with its dither that adds less than 1e-3
#: of its error to a flux.
_STEPS = 2048


def _packed(values, name, header=None, *, step=None):
    """
    Return an image extension: compressed tiles (Rice), which FITS readers open as an image, where they can be.

    Integers of up to 32 bits keep every bit; floats are rounded to ``step`` (SCI with subtractive
    dither of a fixed seed), but for NaN and 0, and stay as they are without one. Never gzip, whose
    streams are dated.
    """
    options = {}
    if values.dtype.kind == "f" and step is not None:
        # integers of 32 bits hold the steps
        largest = np.fmax.reduce(values, axis=None)
        smallest = np.fmin.reduce(values, axis=None)
        packs = largest - smallest < 1e9 * step
        # a negative level is the step itself
        options = {"quantize_level": -step, "quantize_method": 2 if name == "SCI" else -1}
    else:
        packs = values.dtype.kind in "iu" and values.dtype.itemsize <= 4
    if not packs:
        return fits.ImageHDU(values, header, name=name)
    # of several rows, for each tile costs time
    if values.ndim == 2:
        options["tile_shape"] = (min(16, values.shape[0]), values.shape[1])
    return fits.CompImageHDU(
        values, header, name=name, compression_type="RICE_1", dither_seed=1, **options
    )


def write_image(image, path, *, planes=None, rounded=False, overwrite=False):
    """
    Write an image as FITS: SCI, ERR (standard deviation), MASK and further planes.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Its WCS (with distortion) goes to the SCI header, its meta as JSON to the keyword
        META, so that names and types survive.
    path : path-like
        The file. One named as a product of JWST (``x_rate.fits``, ``x_cal.fits``) has JWST's layout, as
        `miricigale.reduction.write_image` writes it.
    planes : dict of str to `~numpy.ndarray`, optional
        Further image extensions by name; ``dq`` holds flags (`~miricigale.instrument.DQ`).
    rounded : bool, optional
        Whether SCI and ERR are rounded to 1/2048 of the median of ERR, for a third of the size;
        otherwise every bit is kept.
    overwrite : bool, optional
        Whether an existing file is replaced.

    Raises
    ------
    OSError
        If the file exists and ``overwrite`` is False.
    ValueError
        If the uncertainty is of unknown kind, or the file is named as a product of JWST that the image is not.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import write_image
    >>> error = StdDevUncertainty(np.full((4, 4), 0.1))
    >>> image = CCDData(np.ones((4, 4)), unit="MJy/sr", uncertainty=error)
    >>> write_image(image, "image.fits", planes={"dq": np.zeros((4, 4), np.int64)})  # doctest: +SKIP
    """
    if jwst_product(path) is not None:
        check_that(not rounded, "rounded", "False for a product of JWST", rounded)
        write_product(image, path, planes=planes, overwrite=overwrite)
        return
    write_planes(image, path, planes=planes, rounded=rounded, overwrite=overwrite)


def write_planes(image, path, *, planes, rounded, overwrite=False):
    """Write what `write_image` writes, under any name: the files of a study are read by the package alone."""
    if image.wcs is not None:
        header = image.wcs.to_header(relax=True)
    else:
        header = fits.Header()
    header["BUNIT"] = header_unit(image.unit)
    header["META"] = json_meta(image.meta)
    data = np.asarray(image.data, np.float32)
    error = None
    if image.uncertainty is not None:
        error = np.asarray(standard_deviation(image).array, np.float32)
    step = None
    if rounded and error is not None and np.any(good := np.isfinite(error) & (error > 0)):
        step = float(np.median(error[good])) / _STEPS
    hdus = [fits.PrimaryHDU(), _packed(data, "SCI", header, step=step)]
    if error is not None:
        hdus.append(_packed(error, "ERR", step=step))
    if image.mask is not None:
        hdus.append(_packed(np.asarray(image.mask, np.uint8), "MASK"))
    for name, plane in (planes or {}).items():
        if name.lower() == "dq":
            hdus += [_packed(part, label, legend) for label, part, legend in dq_planes(plane)]
        else:
            hdus.append(_packed(np.asarray(plane), name.upper()))
    with replacing(path, overwrite=overwrite) as partial:
        write_fits(hdus, partial)


def _unit(header, path):
    """Return the unit of the pixels, as a header states it."""
    text = header_text(header, "BUNIT")
    try:
        if text:
            return with_adu(u.Unit(text))
    except ValueError:
        pass
    got = "none"
    if text:
        got = f"BUNIT = {text!r}"
    wanted = "must state the unit of its pixels, such as MJy/sr, in the keyword BUNIT"
    raise data_error(path, f"{wanted}, got {got}")


def _mask(hdus):
    """Mask of an image: that in MASK, or of a product of JWST, which has none, the pixels not to be used."""
    if "MASK" in hdus:
        return np.array(hdus["MASK"].data, bool)
    if "DQ" not in hdus or "DATAMODL" not in hdus[0].header:
        return None
    flags = with_own_bits(read_dq(hdus["DQ"]), hdus)
    bad = (flags & int(DQ.DO_NOT_USE)) != 0
    if bad.any():
        return bad
    return None


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

    Examples
    --------
    >>> from miricigale.instrument import read_image
    >>> image = read_image("exposures/miri.f770w-0.fits")  # doctest: +SKIP
    >>> image, dq = read_image("exposures/miri.f770w-0.fits", planes=["dq"])  # doctest: +SKIP
    """
    from astropy.nddata import StdDevUncertainty

    with open_fits(path, wanted="an image (FITS with SCI)") as hdus:
        names = [hdu.name for hdu in hdus]
        check_data("SCI" in hdus, path, f"has no SCI extension, only {names}")
        header = hdus["SCI"].header
        wcs = header_wcs(header, where=str(path))
        error = None
        if "ERR" in hdus:
            error = np.array(hdus["ERR"].data, np.float32)
        image = Image(
            np.array(hdus["SCI"].data, np.float32),
            unit=_unit(header, path),
            wcs=wcs,
            uncertainty=None if error is None else StdDevUncertainty(error),
            mask=_mask(hdus),
            meta=json.loads(header.get("META", "{}")),
        )
        extra = []
        for name in planes:
            if name.lower() == "dq":
                extra.append(with_own_bits(read_dq(hdus["DQ"]), hdus))
            else:
                extra.append(np.array(hdus[name.upper()].data))
    if extra:
        return (image, *extra)
    return image
