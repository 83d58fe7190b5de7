"""Images of the pipeline's later stages as files: rates, calibrated images, mosaics."""

import glob
import json
import os
from collections.abc import Mapping
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData

from miricigale.detector import Charge, Ramp
from miricigale.instrument import (
    DQ,
    ExposureHistory,
    check_imager,
    exposure_keywords,
    imager_wcs,
    joined_header,
    kept_keywords,
    read_dq,
    subarrays,
    with_own_bits,
)
from miricigale.instrument.data_models import is_data_model, read_data_model
from miricigale.instrument.header_wcs import header_wcs, image_wcs
from miricigale.instrument.image_planes import noise_kind, plane_data, plane_shape
from miricigale.instrument.keywords import header_text, keyword_text
from miricigale.instrument.product_files import PLANES
from miricigale.reduction.images.images import flagged_image, sigma
from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import DataError, argument_error, data_error
from miricigale.utils.files import is_path, open_fits
from miricigale.utils.named_values import without, without_none
from miricigale.utils.options import check_data
from miricigale.utils.parallel import check_memory
from miricigale.utils.units import RATE, SURFACE_BRIGHTNESS, with_adu
from miricigale.utils.values import value_class

_WANTED = "an image of JWST (FITS with SCI)"

_VARIANCES = PLANES[:3]

#: Keywords that become entries of the meta dictionary.
_META = {
    "NGROUPS": "n_groups", "NINTS": "n_integrations", "TGROUP": "group_time",
    "PHOTMJSR": "photmjsr", "PA_APER": "pa_aper", "XPOSURE": "exposure_time",
    "EFFEXPTM": "exposure_time", "RA_REF": "ra", "DEC_REF": "dec", "ROLL_REF": "roll",
}  # fmt: skip


@value_class
class ImageFile:
    """
    An image from a file, with all of its planes.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        With standard deviation, ``flags`` (`~miricigale.instrument.DQ`), mask (not to be used, or
        not finite), WCS, and what `~miricigale.instrument.ImageFacts` reads in its meta dictionary.
        Slopes are in adu / s, also of files that say DN/s.
    planes : dict of str to `~numpy.ndarray`
        Further planes of the file that are there: ``VAR_POISSON``, ``VAR_RNOISE``, ``VAR_FLAT``,
        ``AREA``, ``WHT``, ``CON`` and ``BKG``.
    header : `~astropy.io.fits.Header`
        Keywords of the primary header and of SCI.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> exposure = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> ramp = Detector.miri_imager().expose(sky, exposure, seed=1)
    >>> file = Reducer().fit_ramp(ramp, planes=True)
    >>> print(file.image.unit, sorted(file.planes))
    adu / s ['VAR_POISSON', 'VAR_RNOISE']
    """

    image: CCDData
    planes: Mapping
    header: fits.Header

    def __repr__(self):
        ny, nx = self.image.shape
        return f"<ImageFile {ny} x {nx} pixels, {self.image.unit}, {', '.join(self.planes)}>"


def read_images(path):
    """
    Read an image file of the JWST pipeline, or one of our own.

    Parameters
    ----------
    path : path-like
        A ``_rate``, ``_rateints``, ``_cal``, ``_calints``, ``_crf`` or ``_i2d`` file of the MIRI imager, or what
        `~miricigale.instrument.Image` wrote.

    Returns
    -------
    files : list of `ImageFile`
        One; or one for each integration.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, truncated or no such image, or its planes do not fit together.
    MemoryError
        If it is larger than the memory.

    Notes
    -----
    The errors are those of ERR, or, without it, of the variances. The world coordinates are
    those of the FITS header; of a file without them, that of the gwcs in its ASDF extension (with
    the package ``gwcs``); of a rate, whose header has their linear part only, those of the
    imager at its pointing.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> exposure = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> ramp = Detector.miri_imager().expose(sky, exposure, seed=1)
    >>> from miricigale.reduction import read_images, write_image
    >>> rate = Reducer().fit_ramp(ramp, planes=True)
    >>> path = write_image(rate, "sub64_rate.fits")  # doctest: +SKIP
    >>> read_images("sub64_rate.fits")[0].image.unit  # doctest: +SKIP
    """
    path = Path(path)
    with open_fits(path, wanted=_WANTED) as hdus:
        if "META" in hdus[0].header and len(hdus[0].shape) == 2:
            # as astropy names the planes of a CCDData
            hdus[0].name = "SCI"
            if "UNCERT" in hdus:
                hdus["UNCERT"].name = "ERR"
        if "SCI" not in hdus or hdus["SCI"].header.get("NAXIS") not in (2, 3):
            raise data_error(path, f"cannot be read as {_WANTED}: it has no image in SCI")
        header = joined_header(hdus)
        own_meta = None
        if "META" in header:
            own_meta = json.loads(header["META"])
        check_imager(path, header, own=own_meta)
        shape = hdus["SCI"].shape
        check_memory(24 * np.prod(shape, dtype=float), f"the image {path}", advice="cut it")
        unit = _unit(hdus["SCI"].header, path)
        meta = own_meta
        if own_meta is None:
            meta = _meta(header, path)
        meta.setdefault("keywords", kept_keywords(header))
        wcs = _wcs(hdus, header, meta)
        data = _plane(hdus, "SCI", shape, path)
        error = _error(hdus, shape, path)
        planes = {name: _plane(hdus, name, shape, path) for name in PLANES if name in hdus}
        flags = _flags(hdus, shape, path)
        if "MASK" in hdus:
            flags |= np.where(_plane(hdus, "MASK", shape, path) != 0, int(DQ.DO_NOT_USE), 0)
    error = _usable_error(error, planes, path)
    if len(shape) == 2:
        return [_image_file(data, unit, error, flags, wcs, meta, planes, header)]
    return _integrations(data, unit, error, flags, wcs, meta, planes, header)


def _usable_error(error, planes, path):
    """Error of ERR, or of the variances where ERR is missing or nowhere finite and above 0; None without any."""
    parts = [planes[name] for name in _VARIANCES if name in planes]
    if error is not None:
        if np.any(np.isfinite(error) & (error > 0)):
            return error
        if not parts:
            hint = "mend it"
            if "WHT" in planes:
                hint = "photometry.read_mosaic takes the errors of WHT"
            refused = "has no error in ERR, which is nowhere finite and above 0, and no variances"
            raise data_error(path, f"{refused}: {hint}")
    if not parts:
        return None
    return np.sqrt(np.sum([np.nan_to_num(part) for part in parts], axis=0))


def _image_file(data, unit, error, flags, wcs, meta, planes, header):
    """Make an `ImageFile` of arrays, masked where its weight is not above 0."""
    mask = False
    if "WHT" in planes:
        mask = ~(planes["WHT"] > 0)
    image = flagged_image(data, unit, error=error, flags=flags, wcs=wcs, meta=meta, mask=mask)
    return ImageFile(image, planes, header)


def _integrations(data, unit, error, flags, wcs, meta, planes, header):
    """Return the `ImageFile` of each integration of arrays whose first axis has these."""
    files = []
    for number in range(len(data)):
        error_of = None
        if error is not None:
            error_of = error[number]
        own_planes = {}
        for name, plane in planes.items():
            # maps and counts are those of all integrations
            if name == "CON" or plane.shape != data.shape:
                own_planes[name] = plane
            else:
                own_planes[name] = plane[number]
        arrays = (data[number], unit, error_of, flags[number], wcs)
        files.append(_image_file(*arrays, meta | {"integration": number}, own_planes, header))
    return files


def open_exposure(path):
    """
    Open a file of the pipeline at any stage.

    Parameters
    ----------
    path : path-like
        A ramp, as `~miricigale.detector.Ramp.read` takes it, or an image, as `read_images` does.

    Returns
    -------
    exposure : `~miricigale.detector.Ramp` or `~astropy.nddata.CCDData`
        Of a file with an image of each integration their mean, with its error.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If it is neither.

    Examples
    --------
    >>> from miricigale.reduction import open_exposure
    >>> exposure = open_exposure("jw01180001001_02101_00001_mirimage_uncal.fits")  # doctest: +SKIP
    """
    exposure = open_file(path)
    if isinstance(exposure, Ramp):
        return exposure
    return exposure.image


def open_file(path):
    """As `open_exposure`; images with their planes, `ImageFile`."""
    with open_fits(path, wanted=_WANTED) as hdus:
        ramp = "SCI" in hdus and hdus["SCI"].header.get("NAXIS") == 4
    if ramp:
        return Ramp.read(path)
    files = read_images(path)
    if len(files) == 1:
        return files[0]
    return _mean(files)


def _mean(files):
    """Return the mean of the integrations of an exposure; its flags are those of any, DO_NOT_USE those of all."""
    images = [file.image for file in files]
    error = None
    first = images[0]
    mask = np.array([im.mask for im in images])
    count = np.ma.masked_equal(np.count_nonzero(~mask, axis=0), 0)

    def total(values):
        return np.where(mask, 0, values).sum(axis=0, dtype=float)

    mean = total([im.data for im in images]) / count
    if all(im.uncertainty is not None for im in images):
        error = np.sqrt(total([np.square(sigma(im)) for im in images])) / count
        error = error.filled(np.nan)
    flags = np.bitwise_or.reduce([im.flags for im in images]) & ~int(DQ.DO_NOT_USE)
    flags |= np.where(mask.all(axis=0), int(DQ.DO_NOT_USE), 0)
    image = flagged_image(
        mean.filled(np.nan),
        first.unit,
        error=error,
        flags=flags,
        wcs=first.wcs,
        meta=shared_meta(first),
    )
    planes = {}
    for name in _VARIANCES:
        if name in files[0].planes:
            planes[name] = (total([file.planes[name] for file in files]) / count**2).filled(np.nan)
    return ImageFile(image, planes, files[0].header)


def scaled_planes(planes, before, after):
    """Return the variances and areas of an image, after it was multiplied as its errors say."""
    scaled = {}
    if "AREA" in planes:
        scaled = {"AREA": planes["AREA"]}
    if before.uncertainty is None:
        return scaled
    with quiet_division():
        factor = np.square(sigma(after) / sigma(before))
    return scaled | {name: planes[name] * factor for name in _VARIANCES if name in planes}


def shared_meta(entry):
    """Return the meta dictionary of an exposure, of an image of one of its integrations."""
    return without(entry.meta, ["integration"])


def _unit(header, path):
    """Return the unit of an image; DN is what astropy's CCDData and this package call adu."""
    text = header_text(header, "BUNIT")
    try:
        unit = None
        if text:
            unit = with_adu(u.Unit(text.replace("counts", "DN")))
    except ValueError:
        unit = None
    for own_unit in (RATE, SURFACE_BRIGHTNESS):
        if unit is not None and unit.is_equivalent(own_unit):
            factor = unit.to(own_unit)
            if factor == 1:
                return own_unit
            return u.Unit(factor * own_unit)
    wanted = "must state in BUNIT that it is a rate (DN/s, adu/s) or a surface brightness (MJy/sr)"
    raise data_error(path, f"{wanted}, got {text!r}")


def _plane(hdus, name, shape, path):
    if name not in hdus:
        return None
    data = hdus[name].data
    # maps and counts are those of all integrations
    if name in ("CON", "AREA"):
        last_axes = slice(-2, None)
    else:
        last_axes = slice(None)
    if data is None or data.shape[last_axes] != shape[last_axes]:
        got = None
        if data is not None:
            got = data.shape
        raise data_error(path, f"must have {shape} pixels in {name}, as in SCI, got {got}")
    kind = np.float32
    if data.dtype.kind in "iu":
        kind = data.dtype.newbyteorder("=")
    return np.array(data, kind)


def _error(hdus, shape, path):
    """Return the standard deviation in ERR; a variance or its inverse if UTYPE says so; None without data."""
    if "ERR" in hdus and hdus["ERR"].shape == ():
        if plane_shape(hdus["ERR"]) != shape:
            return None
        return plane_data(hdus["ERR"])
    values = _plane(hdus, "ERR", shape, path)
    if values is None:
        return None
    with quiet_division():
        kind = noise_kind(hdus["ERR"])
        if kind == "variance":
            return np.sqrt(values)
        if kind == "inverse_variance":
            return 1 / np.sqrt(values)
    return values


def _flags(hdus, shape, path):
    if "DQ" not in hdus:
        return np.zeros(shape, np.int64)
    hdu = hdus["DQ"]
    # planes without our legend are JWST's own
    if "DQSCHEME" in hdu.header:
        flags = read_dq(hdu)
    else:
        flags = np.asarray(hdu.data).astype(np.int64)
    check_data(
        flags.shape == shape, path, f"must have {shape} pixels in DQ, as in SCI, got {flags.shape}"
    )
    return with_own_bits(flags, hdus)


def _meta(header, path):
    """Return the facts of an image from the keywords of JWST."""
    meta = {name: header[key] for key, name in _META.items() if header.get(key) is not None}
    name, readout, part, meta["dither"] = exposure_keywords(header)
    if part not in subarrays():
        part = None
    mode = {"filter": name, "subarray": part, "readout": readout}
    meta |= without_none(mode)
    meta |= ExposureHistory.from_header(header).meta()
    meta["source"] = path.name
    return meta


def _wcs(hdus, header, meta):
    """Return the world coordinates of an image; None without any."""
    pointed = all(name in meta for name in ("ra", "dec", "roll", "subarray"))
    done = keyword_text(header.get, "S_WCS") == "COMPLETE"
    if pointed and not done and "META" not in header:
        # a rate: the header has the linear part
        pointing = SkyCoord(meta["ra"] * u.deg, meta["dec"] * u.deg)
        return imager_wcs(pointing, meta["roll"] * u.deg, subarray=meta["subarray"])
    science = hdus["SCI"].header
    if done:
        wcs = image_wcs(science, hdus)
    else:
        wcs = header_wcs(science, where=hdus.filename())
    if wcs is None:
        return None
    wcs.pixel_shape = (science["NAXIS1"], science["NAXIS2"])
    return wcs


def as_exposure(exposure):
    """Return an exposure of its file or data model; anything else itself."""
    if is_data_model(exposure):
        return read_data_model(exposure, open_exposure)
    if is_path(exposure):
        return open_exposure(exposure)
    return exposure


def exposure_list(exposures):
    """Return the exposures of one, of a pattern of files, or of several."""
    if isinstance(exposures, str) and glob.has_magic(exposures) and not os.path.exists(exposures):
        paths = sorted(glob.glob(os.path.expanduser(exposures)))
        if not paths:
            msg = f"no file is called {exposures}"
            raise DataError(msg)
        return paths
    if is_path(exposures) and os.path.isdir(exposures):
        raise argument_error(
            "ramps", f"files, such as {os.path.join(exposures, '*_uncal.fits')!r}", "a folder"
        )
    is_single = isinstance(exposures, (str, os.PathLike, Ramp, Charge, CCDData)) or is_data_model(
        exposures
    )
    if is_single:
        return [exposures]
    return exposures
