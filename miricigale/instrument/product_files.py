"""Images in the layout of JWST's products, from which JWST's tools go on."""

import os
import re
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.wcs.utils import proj_plane_pixel_area

from miricigale.filters.band_names import band_label
from miricigale.instrument.asdf_extension import asdf_extension
from miricigale.instrument.dq import DQ, dq_planes
from miricigale.instrument.history import ExposureHistory
from miricigale.instrument.image_facts import ImageFacts
from miricigale.instrument.image_planes import standard_deviation
from miricigale.instrument.keywords import STEPS, placed_keywords
from miricigale.instrument.published_tables import imager_filters
from miricigale.instrument.siaf import aperture
from miricigale.instrument.sky_axes import pixel_to_radec
from miricigale.instrument.wcs import imager_wcs, pixel_area_map
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import is_path, replacing, write_fits
from miricigale.utils.meta import json_meta
from miricigale.utils.named_values import without_none
from miricigale.utils.options import check_that
from miricigale.utils.units import RATE, SURFACE_BRIGHTNESS, header_unit, with_adu

#: How files of products of JWST are called.
_PRODUCT_NAME = re.compile(
    r"_(uncal|ramp|rate|rateints|cal|calints|crf|crfints|i2d|blot|median)\.fits(?:\.gz)?$"
)

#: Products in DN/s, and those in MJy/sr; others may have either unit.
_RATES = ("rate", "rateints")
_CALIBRATED = ("cal", "calints", "crf", "crfints", "i2d")

#: Products that hold ramps.
_RAMPS = ("uncal", "ramp")

#: Planes beside the image, its errors and its flags.
PLANES = ("VAR_POISSON", "VAR_RNOISE", "VAR_FLAT", "AREA", "WHT", "CON", "BKG")


def jwst_product(path):
    """
    Find which product of JWST a file is by its name.

    Parameters
    ----------
    path : path-like or other
        Where something is written; what is no path has no name.

    Returns
    -------
    product : str or None
        Such as ``"rate"`` for ``x_rate.fits``; None for other names.
    """
    if not is_path(path):
        return None
    name = _PRODUCT_NAME.search(os.fspath(path).lower())
    if name is None:
        return None
    return name[1]


def check_product(path, image):
    """
    Refuse an image that the product of JWST by which it is named cannot hold.

    Parameters
    ----------
    path : path-like
        Where it is written.
    image : `~astropy.nddata.CCDData`
        The image.

    Raises
    ------
    ValueError
        If the name is that of ramps, the unit is another one than the product's, the image has more or fewer axes,
        or the filter is not MIRI's.
    """
    product = jwst_product(path)
    name = repr(os.fspath(path))
    if product in _RAMPS:
        raise argument_error(
            "path", "a name of images; miricigale.detector.Ramp.write(path) writes ramps", name
        )
    unit = with_adu(image.unit)
    if product in _RATES and not unit.is_equivalent(RATE):
        raise argument_error(
            "path", "a name of rates for an image in DN/s alone", f"{name} for {image.unit}"
        )
    if product in _CALIBRATED and not unit.is_equivalent(SURFACE_BRIGHTNESS):
        wanted = "a name of calibrated images for an image in MJy/sr alone"
        raise argument_error("path", wanted, f"{name} for {image.unit}")
    n_axes = 3 if str(product).endswith("ints") else 2
    if product is not None and image.data.ndim != n_axes:
        raise argument_error(
            "image",
            f"of {n_axes} axes to be written as {name} (integrations: rateints, calints, crfints)",
            f"the shape {image.data.shape}",
        )
    band = ImageFacts.of(image).band
    bands = [filter_name.removeprefix("miri.") for filter_name in imager_filters()]
    if product is not None and band not in bands:
        wanted = f"of a filter of the MIRI imager to be written as {name}: meta['filter'] states it"
        raise argument_error("image", wanted, f"filter {image.meta.get('filter')!r}")


def write_product(image, path, *, planes=None, wcs=None, overwrite=False):
    """
    Write an image in the layout of JWST's products.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Rate, calibrated image or mosaic, of shape (ny, nx), or integrations, (n, ny, nx).
    path : path-like
        The file.
    planes : dict of str to `~numpy.ndarray`, optional
        Further planes by name (`PLANES`), and ``DQ`` for flags besides those of the image.
    wcs : `~astropy.wcs.WCS`, optional
        World coordinates of integrations; those of the image by default.
    overwrite : bool, optional
        Whether an existing file is replaced.

    Returns
    -------
    path : `pathlib.Path`

    Raises
    ------
    OSError
        If the file exists and ``overwrite`` is False.
    ValueError
        If a plane has another name or shape, or the image is none that the name of the file promises.
    """
    path = Path(path).expanduser()
    check_product(path, image)
    if wcs is None:
        wcs = image.wcs
    planes = {str(name).upper(): plane for name, plane in (planes or {}).items()}
    flags = _flags(image, planes.pop("DQ", 0))
    product_unit, scale = _product_unit(image.unit)
    primary, science = _headers(image, path.name)
    science["BUNIT"] = product_unit
    is_resampled = jwst_product(path) == "i2d" or "resample" in ExposureHistory.of(image).steps
    if is_resampled:
        primary["S_RESAMP"] = "COMPLETE"
    extension = asdf_extension()
    shape = image.shape[-2:]
    if wcs is not None:
        primary["S_WCS"] = "COMPLETE"
        _add_sky(science, wcs, shape)
        if image.unit.is_equivalent(SURFACE_BRIGHTNESS):
            _add_areas(science, planes, wcs, shape, is_resampled)
            if not is_resampled:
                extension = asdf_extension(wcs, shape, science)
    data = np.asarray(image.data * scale, np.float32)
    hdus = [fits.PrimaryHDU(header=primary), fits.ImageHDU(data, science, name="SCI")]
    if image.uncertainty is not None:
        error = standard_deviation(image).array
        hdus.append(fits.ImageHDU(np.asarray(error * scale, np.float32), name="ERR"))
        hdus[-1].header["BUNIT"] = science["BUNIT"]
    for name, plane, legend in dq_planes(flags):
        hdus.append(fits.ImageHDU(plane, legend, name=name))
    for name, plane in planes.items():
        if name.startswith("VAR_"):
            plane = np.asarray(plane) * scale**2
        if name == "BKG":
            plane = np.asarray(plane) * scale
        hdus.append(_plane_hdu(name, plane, image.shape))
        if name == "BKG":
            hdus[-1].header["BUNIT"] = science["BUNIT"]
    # a process that is killed leaves no half of a file
    with replacing(path, overwrite=overwrite) as partial:
        write_fits(hdus + [extension], partial)
    return path


def _add_areas(science, planes, wcs, shape, is_resampled):
    """Add the solid angle of pixels to the header of SCI, and a map of it to the planes of an exposure."""
    if is_resampled:
        if "PIXAR_SR" not in science:
            science["PIXAR_SR"] = proj_plane_pixel_area(wcs) * u.deg.to(u.rad) ** 2
    elif "AREA" not in planes or "PIXAR_SR" not in science:
        science["PIXAR_SR"] = _nominal_area()
        planes["AREA"] = pixel_area_map(wcs, shape) / _nominal_area()
    science["PIXAR_A2"] = science["PIXAR_SR"] * u.rad.to(u.arcsec) ** 2


def _headers(image, filename):
    """Return the keywords of the primary header and of SCI, without those of the sky."""
    meta = image.meta
    primary, science = placed_keywords(meta.get("keywords", {}), wcs=False)
    keywords = {
        "TELESCOP": "JWST", "INSTRUME": "MIRI", "DETECTOR": "MIRIMAGE", "EXP_TYPE": "MIR_IMAGE",
        "FILTER": band_label(str(meta.get("filter", ""))) or None,
        "SUBARRAY": meta.get("subarray"), "READPATT": meta.get("readout"),
        "DATAMODL": "ImageModel" if image.data.ndim == 2 else "CubeModel", "FILENAME": filename,
    }  # fmt: skip
    steps = ExposureHistory.of(image).steps
    for word, step in STEPS.items():
        if step in steps:
            keywords[word] = "COMPLETE"
    primary.update(without_none(keywords))
    science["META"] = json_meta(meta)
    names = {"PHOTMJSR": "photmjsr", "PA_APER": "pa_aper", "XPOSURE": "exposure_time"}
    for key, name in names.items():
        if isinstance(meta.get(name), (int, float)):
            science[key] = meta[name]
    return primary, science


def _product_unit(unit):
    """Unit of the pipeline, which takes no other, as it writes it, and the factor to it from the image's."""
    for product_unit, name in ((RATE, "DN/s"), (SURFACE_BRIGHTNESS, "MJy/sr")):
        if with_adu(unit).is_equivalent(product_unit):
            return name, np.float32(with_adu(unit).to(product_unit))
    return header_unit(unit), np.float32(1)


def _add_sky(science, wcs, shape):
    """Add the world coordinates and the outline of the image to the header of SCI."""
    # what is no WCS keyword of this image confuses
    written = set(science) | {"DATE-OBS", "MJD-OBS", "TIMESYS"}
    sky = wcs.to_header(relax=True).cards
    science.extend(card for card in sky if card.keyword not in written)
    ny, nx = shape
    x = np.array([-0.5, -0.5, nx - 0.5, nx - 0.5])
    y = np.array([-0.5, ny - 0.5, ny - 0.5, -0.5])
    corners = np.transpose(pixel_to_radec(wcs, x, y)).flat
    science["S_REGION"] = "POLYGON ICRS " + " ".join(f"{angle:.9f}" for angle in corners)


def _flags(image, further):
    """Return the flags of an image and further ones, with masked pixels as not to be used."""
    shape = image.data.shape
    further = np.asarray(further, np.int64)
    check_that(
        further.shape in ((), shape), "planes", f"of {shape} pixels", f"DQ of {further.shape}"
    )
    flags = np.zeros(shape, np.int64) | further
    if image.flags is not None:
        flags = flags | np.asarray(image.flags, np.int64)
    if image.mask is not None:
        flags = flags | np.where(image.mask, int(DQ.DO_NOT_USE), 0)
    return flags


def _plane_hdu(name, plane, shape):
    """Return the extension of a further plane."""
    plane = np.asarray(plane)
    if name not in PLANES or plane.shape[-2:] != shape[-2:]:
        raise argument_error(
            "planes", f"of {shape} pixels, named {', '.join(PLANES)}", f"{name} of {plane.shape}"
        )
    if name != "CON":
        return fits.ImageHDU(plane.astype(np.float32), name=name)
    plane = plane.astype(np.int32)
    if plane.ndim == 2:
        # jwst's CON is a cube of words of 32 bits
        plane = plane[None]
    return fits.ImageHDU(plane, name=name)


@cached
def _nominal_area():
    """Return the solid angle of the pixel at the reference point of the full frame, sr."""
    part = aperture("FULL")
    x, y = map(round, part.reference)
    return float(pixel_area_map(imager_wcs("0 0", 0 * u.deg), part.shape)[y, x])
