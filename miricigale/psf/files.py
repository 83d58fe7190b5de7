"""PSFs in FITS files: our own layout, and images that others made."""

import astropy.units as u
import numpy as np
from astropy.wcs import WCS

from miricigale.psf.model import InstrumentPSF, make_psf
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import open_fits
from miricigale.utils.options import check_that
from miricigale.utils.store import open_parts, write_parts
from miricigale.utils.unified import register
from miricigale.utils.units import ANGLE, to_array

#: Units of an `InstrumentPSF`'s quantities in files.
_UNITS = {"pixel_scale": ANGLE, "angle": u.deg, "pa_aper": u.deg}
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


register(InstrumentPSF, read=_read_psf, write=_write_psf)
