"""PSFs and matching kernels in FITS files: our own layouts, and images that others made."""

import json

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from miricigale.psf.kernel_field import KernelField
from miricigale.psf.kernels import MatchingKernel
from miricigale.psf.model import InstrumentPSF, make_psf
from miricigale.utils.exceptions import argument_error, data_error, file_errors
from miricigale.utils.files import open_fits, replacing, write_fits
from miricigale.utils.meta import plain_value
from miricigale.utils.options import check_that
from miricigale.utils.store import native, open_parts, write_parts
from miricigale.utils.unified import register
from miricigale.utils.units import ANGLE, to_array

#: Units of an `InstrumentPSF`'s quantities, and arrays of a `MatchingKernel`, in files.
_UNITS = {"pixel_scale": ANGLE, "angle": u.deg, "pa_aper": u.deg}
_ARRAYS = ("array", "source", "target")
_LAYOUT = "psf-1"


def header_grid(header):
    """
    Side of a pixel (arcsec) and position angle of +y (deg) that the header of a PSF or kernel states.

    By world coordinates, or PIXELSCL or PIXSCALE (arcsec); None for what is not stated.

    Raises
    ------
    ValueError
        If the image is mirrored.
    """
    wcs = WCS(header, naxis=2, fix=False).celestial if "CTYPE1" in header else None
    if wcs is not None and wcs.has_celestial:
        (a, b), (c, d) = wcs.pixel_scale_matrix
        if a * d - b * c > 0:
            raise argument_error("path", "a file with east to the left where north is up", wcs)
        return float(np.sqrt(b * c - a * d)) * 3600, float(np.degrees(np.arctan2(b, d)))
    for key in ("PIXELSCL", "PIXSCALE"):
        if isinstance(header.get(key), (int, float)) and header[key] > 0:
            return float(header[key]), None
    return None, None


def fits_image(path, ext, plane, pixel_scale, *, wanted, oversampling=1):
    """
    An image of any FITS file, its header, pixel (a quantity), position angle (deg or None) and oversampling.

    Parameters and errors are those of `read_psf`; ``wanted`` describes the expected content for messages.
    """
    with open_fits(path, wanted=wanted, output_verify="silentfix") as hdus:
        data = hdus[ext].data
        if data is not None and plane is not None:
            data = data[plane]
        if data is None or data.ndim != 2:
            got = None if data is None else f"shape {data.shape}"
            raise argument_error("path", f"a file with a 2D image in extension {ext!r}", got)
        data, header = np.array(data, dtype=float), hdus[ext].header
    if oversampling is None:
        oversampling = int(header.get("OVERSAMP", 1))
    cell, angle = header_grid(header)
    if pixel_scale is None:
        if cell is None:
            raise argument_error("pixel_scale", "given where the header does not state it", None)
        pixel_scale = cell * oversampling * ANGLE
    elif cell is not None:
        mine = float(to_array(pixel_scale, ANGLE, "pixel_scale")) / oversampling
        stated = f"{cell * oversampling:.4g} arcsec by the header and 'oversampling'"
        check_that(abs(mine / cell - 1) <= 0.02, "pixel_scale", stated, pixel_scale)
    return data, header, pixel_scale, angle, oversampling


def read_psf(
    path,
    *,
    frame=None,
    ext=0,
    plane=None,
    pixel_scale=None,
    oversampling=None,
    angle=None,
    **options,
):
    """
    Read a PSF from an image in any FITS file, or from one that `InstrumentPSF.write` made.

    Parameters
    ----------
    path : path-like
        The file.
    frame, oversampling : optional
        As for `make_psf`; by default those of STPSF's files (the detector's frame, OVERSAMP), else the sky and 1.
    ext : int or str, optional
        The extension.
    plane : int, optional
        Which plane of a cube.
    pixel_scale, angle : `~astropy.units.Quantity`, optional
        As for `make_psf`. Where the header states them (world coordinates; PIXELSCL or
        PIXSCALE, arcsec per cell) they can be left out, and must agree with it if given.
    **options
        Further options of `make_psf`, such as ``includes`` and ``enclosed``.

    Returns
    -------
    psf : `InstrumentPSF`
        Its ``pa_aper`` is that of the header, for a PSF in the detector frame:
        `~miricigale.psf.MatchingKernel.from_psfs` turns by it if no angle is given.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or no FITS.
    ValueError
        If there is no 2D image there, or scale or angle are unknown or not the header's.

    Examples
    --------
    >>> from miricigale.psf import read_psf
    >>> psf = read_psf("f770w_psf.fits", ext=1, enclosed=0.95)  # doctest: +SKIP
    """
    if is_written(path):
        return _read_psf(path)
    data, header, pixel_scale, turn, oversampling = fits_image(
        path, ext, plane, pixel_scale, wanted="a PSF", oversampling=oversampling
    )
    if frame is None:
        # as STPSF and WebbPSF write them
        frame = "detector" if {"OVERSAMP", "PIXELSCL"} <= set(header) else "sky"
    if frame == "detector" and isinstance(header.get("PA_APER"), (int, float)):
        options.setdefault("pa_aper", float(header["PA_APER"]) * u.deg)
    if frame == "sky" and turn is not None:
        given = turn if angle is None else float(to_array(angle, u.deg, "angle", finite=True))
        if abs((given - turn + 180) % 360 - 180) > 0.5:
            raise argument_error("angle", f"the header's, {turn:.4g} deg", angle)
        angle = given * u.deg
    return make_psf(
        data,
        pixel_scale=pixel_scale,
        frame=frame,
        oversampling=oversampling,
        angle=0.0 * u.deg if angle is None else angle,
        **{**options, "meta": {"file": str(path), **options.get("meta", {})}},
    )


def is_written(path):
    """Whether `InstrumentPSF.write` made a file."""
    with open_fits(path, wanted="a PSF") as hdus:
        return hdus[0].header.get("FORMAT") == _LAYOUT


def _write_psf(psf, path, *, overwrite=False):
    facts = psf.facts
    for name, unit in _UNITS.items():
        facts[name] = None if facts[name] is None else facts[name].to_value(unit)
    text = {"facts": facts, "meta": psf.meta}
    write_parts(path, _LAYOUT, text=text, arrays={"psf": psf.data}, overwrite=overwrite)


def _read_psf(path):
    with open_parts(path, (_LAYOUT,), wanted="PSFs") as parts:
        facts = parts.text["facts"]
        for name, unit in _UNITS.items():
            facts[name] = None if facts[name] is None else facts[name] * unit
        return InstrumentPSF(parts.array("psf"), **facts, meta=parts.text["meta"])


def _write_kernel(kernel, path, *, overwrite=False):
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(kernel.array, name="KERNEL")]
    header = hdus[1].header
    # which other programs look for
    header["PIXSCALE"] = (kernel.pixel_scale.value, "arcsec")
    if np.isfinite(kernel.regularization):
        header["REGULAR"] = (kernel.regularization, "Wiener parameter")
    header["META"] = json.dumps(kernel.meta, default=plain_value)
    both = {"SOURCE": kernel.source, "TARGET": kernel.target}.items()
    hdus += [fits.ImageHDU(psf, name=name) for name, psf in both if psf is not None]
    with replacing(path, overwrite=overwrite) as partial:
        write_fits(hdus, partial)


def _read_kernel(path, *, ext=None, plane=None, pixel_scale=None, source=None):
    if ext is not None:
        data, _, pixel_scale, *_ = fits_image(
            path, ext, plane, pixel_scale, wanted="a matching kernel"
        )
        return MatchingKernel.from_array(data, pixel_scale=pixel_scale, source=source)
    with open_fits(path, wanted="a matching kernel") as hdus:
        if "KERNEL" not in hdus:
            raise data_error(path, f"has no KERNEL extension, only {[hdu.name for hdu in hdus]}")
        header = hdus["KERNEL"].header
        with file_errors(path, "is not a complete matching kernel"):
            return MatchingKernel(
                native(hdus["KERNEL"].data),
                header["PIXSCALE"] * ANGLE,
                regularization=header.get("REGULAR", float("nan")),
                meta=json.loads(header.get("META", "{}")),
                **{k: native(hdus[k].data) for k in ("source", "target") if k.upper() in hdus},
            )


def _write_field(field, path, *, overwrite=False):
    kernels = field.kernels
    text = {
        "method": field.method,
        "pixel_scale": field.pixel_scale.value,
        "regularization": [one.regularization for one in kernels],
        "meta": [one.meta for one in kernels],
    }
    arrays = {name: np.stack([getattr(k, name) for k in kernels]) for name in _ARRAYS}
    icrs = field.sky.icrs
    arrays |= {"ra": icrs.ra.deg, "dec": icrs.dec.deg}
    write_parts(path, "kernel-field-1", text=text, arrays=arrays, overwrite=overwrite)


def _read_field(path):
    with open_parts(path, ("kernel-field-1",), wanted="fields of kernels") as parts:
        text, arrays = parts.text, [parts.array(name) for name in _ARRAYS]
        kernels = [
            MatchingKernel(array, text["pixel_scale"] * ANGLE, source, target, mu, meta)
            for array, source, target, mu, meta in zip(
                *arrays, text["regularization"], text["meta"], strict=True
            )
        ]
        sky = SkyCoord(parts.array("ra"), parts.array("dec"), unit="deg")
        return KernelField(kernels, sky, text["method"])


register(InstrumentPSF, read=_read_psf, write=_write_psf)
register(MatchingKernel, read=_read_kernel, write=_write_kernel)
register(KernelField, read=_read_field, write=_write_field)
