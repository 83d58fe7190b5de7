"""Images of the reduction as files from which the official pipeline goes on."""

from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.nddata import StdDevUncertainty
from astropy.wcs.utils import proj_plane_pixel_area

from miricigale.instrument import (
    DQ,
    STEPS,
    ExposureHistory,
    aperture,
    dq_planes,
    imager_wcs,
    pixel_area_map,
    placed_keywords,
)
from miricigale.instrument.asdf_extension import asdf_extension
from miricigale.instrument.image import check_product_name
from miricigale.instrument.image_files import json_meta
from miricigale.instrument.sky_axes import pixel_to_radec
from miricigale.reduction.images.files import PLANES, ImageFile, shared_meta
from miricigale.reduction.images.images import flagged_image, plain_flags, plain_mask, sigma
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import replacing, write_fits
from miricigale.utils.named_values import without_none
from miricigale.utils.units import RATE, SURFACE_BRIGHTNESS

#: Products of JWST that are images, or cubes of them.
_PRODUCTS = ("rate", "rateints", "cal", "calints", "crf", "crfints", "i2d", "blot", "median")


def write_image(image, path, *, planes=None, overwrite=False):
    """
    Write an image as a FITS file that JWST's tools, photutils and DS9 open.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`, `ImageFile` or list of one of them
        Rate, calibrated image or mosaic; of a list, the integrations of an exposure, all planes
        are cubes (``_rateints``). Its WCS, with distortion, goes to the header of SCI; its
        meta dictionary, as JSON, to the keyword META, by which `read_images` restores it.
    path : path-like
        The file.
    planes : dict of str to `~numpy.ndarray`, optional
        Further planes by name (`ImageFile`), such as ``WHT``, ``CON`` (numbers of images)
        and ``BKG`` (what was subtracted), beside those of an `ImageFile`.
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
        If a plane has another name or shape, integrations do not belong together, or the name is one of ramps
        (``x_uncal.fits``).

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> exposure = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> ramp = Detector.miri_imager().expose(sky, exposure, seed=1)
    >>> from miricigale.reduction import write_image
    >>> rates = Reducer().fit_integrations(ramp, planes=True)
    >>> path = write_image(rates, "sub64_rateints.fits")  # doctest: +SKIP
    """
    path = Path(path)
    check_product_name(path, "miricigale.detector.Ramp.write(path)", own=_PRODUCTS)
    image, planes, wcs = _joined(image, planes or {})
    meta = image.meta
    cal = image.unit.is_equivalent(SURFACE_BRIGHTNESS)
    primary, science = placed_keywords(meta.get("keywords", {}), wcs=False)
    keywords = {
        "TELESCOP": "JWST", "INSTRUME": "MIRI", "DETECTOR": "MIRIMAGE", "EXP_TYPE": "MIR_IMAGE",
        "FILTER": str(meta.get("filter", "")).rpartition(".")[2].upper() or None,
        "SUBARRAY": meta.get("subarray"), "READPATT": meta.get("readout"),
        "DATAMODL": "ImageModel" if image.data.ndim == 2 else "CubeModel", "FILENAME": path.name,
    }  # fmt: skip
    steps = ExposureHistory.of(image).steps
    keywords |= {word: "COMPLETE" for word, step in STEPS.items() if step in steps}
    primary.update(without_none(keywords))
    # as the pipeline writes them; astropy takes DN/s for another unit than adu/s
    names = {RATE: "DN/s", SURFACE_BRIGHTNESS: "MJy/sr"}
    unit = next(
        (n for image_unit, n in names.items() if image.unit == image_unit),
        image.unit.to_string("fits"),
    )
    science["BUNIT"] = unit
    science["META"] = json_meta(meta)
    names = {"PHOTMJSR": "photmjsr", "PA_APER": "pa_aper", "XPOSURE": "exposure_time"}
    for key, name in names.items():
        if isinstance(meta.get(name), (int, float)):
            science[key] = meta[name]
    extension = asdf_extension()
    if wcs is not None:
        # what is no WCS keyword of this image confuses
        written = set(science) | {"DATE-OBS", "MJD-OBS", "TIMESYS"}
        sky = wcs.to_header(relax=True).cards
        science.extend(card for card in sky if card.keyword not in written)
        primary["S_WCS"] = "COMPLETE"
        ny, nx = image.shape[-2:]
        x = np.array([-0.5, -0.5, nx - 0.5, nx - 0.5])
        y = np.array([-0.5, ny - 0.5, ny - 0.5, -0.5])
        corners = np.transpose(pixel_to_radec(wcs, x, y)).flat
        science["S_REGION"] = "POLYGON ICRS " + " ".join(f"{angle:.9f}" for angle in corners)
        if cal and "resample" in steps:
            if "PIXAR_SR" not in science:
                science["PIXAR_SR"] = proj_plane_pixel_area(wcs) * u.deg.to(u.rad) ** 2
        elif cal:
            extension = asdf_extension(wcs, image.shape[-2:], science)
            if "AREA" not in planes or "PIXAR_SR" not in science:
                science["PIXAR_SR"] = _nominal_area()
                planes["AREA"] = pixel_area_map(wcs, image.shape[-2:]) / _nominal_area()
        if cal:
            science["PIXAR_A2"] = science["PIXAR_SR"] * u.rad.to(u.arcsec) ** 2
    primary = fits.PrimaryHDU(header=primary)
    hdus = [primary, fits.ImageHDU(np.asarray(image.data, np.float32), science, name="SCI")]
    if image.uncertainty is not None:
        error = image.uncertainty.represent_as(StdDevUncertainty).array
        hdus.append(fits.ImageHDU(np.asarray(error, np.float32), name="ERR"))
        hdus[-1].header["BUNIT"] = unit
    flags = plain_flags(image)
    if image.mask is not None:
        flags = flags | np.where(image.mask, int(DQ.DO_NOT_USE), 0)
    hdus += [fits.ImageHDU(plane, legend, name=name) for name, plane, legend in dq_planes(flags)]
    for name, plane in planes.items():
        plane = np.asarray(plane)
        if name not in PLANES or plane.shape[-2:] != image.shape[-2:]:
            wanted = f"of {image.shape} pixels, named {', '.join(PLANES)}"
            raise argument_error("planes", wanted, f"{name} of {plane.shape}")
        plane = plane.astype(np.int32 if name == "CON" else np.float32)
        hdus.append(
            fits.ImageHDU(plane[None] if name == "CON" and plane.ndim == 2 else plane, name=name)
        )
        if name == "BKG":
            hdus[-1].header["BUNIT"] = unit
    # a process that is killed leaves no half of a file
    with replacing(path, overwrite=overwrite) as partial:
        write_fits(hdus + [extension], partial)
    return path


@cached
def _nominal_area():
    """Solid angle of the pixel at the reference point of the full frame, sr."""
    part = aperture("FULL")
    x, y = map(round, part.reference)
    return float(pixel_area_map(imager_wcs("0 0", 0 * u.deg), part.shape)[y, x])


def _joined(image, planes):
    """Image, planes and WCS that are written of an image, of one with planes, or of integrations."""
    is_cube = isinstance(image, (list, tuple))
    files = []
    for part in image if is_cube else [image]:
        if isinstance(part, ImageFile):
            files.append(part)
        else:
            files.append(ImageFile(part, {}, fits.Header()))
    if files:
        first = files[0].image
    else:
        first = None
    alike = all(
        file.image.shape == first.shape
        and file.image.unit == first.unit
        and file.image.uncertainty is not None
        and set(file.planes) == set(files[0].planes)
        for file in files
    )
    if not files or (is_cube and not alike):
        wanted = "integrations of one shape and unit, with errors and the same planes"
        raise argument_error("image", wanted, f"{len(files)} others")
    if not is_cube:
        return first, {**files[0].planes, **planes}, first.wcs

    def cube(values):
        return np.array([values(file) for file in files])

    joined = flagged_image(
        cube(lambda file: file.image.data),
        first.unit,
        error=cube(lambda file: sigma(file.image)),
        flags=cube(lambda file: plain_flags(file.image)),
        wcs=None,
        meta=shared_meta(first),
        mask=cube(lambda file: plain_mask(file.image)),
    )
    cubes = {name: cube(lambda file, n=name: file.planes[n]) for name in files[0].planes}
    return joined, {**cubes, **planes}, first.wcs
