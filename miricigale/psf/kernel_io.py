"""Matching kernels, and fields of them, in FITS files: our own layouts, and images that others made."""

import dataclasses
import json

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from scipy.signal import fftconvolve

from miricigale.psf.files import PSFFile
from miricigale.psf.kernel_field import KernelField
from miricigale.psf.kernels import MatchingKernel
from miricigale.utils.exceptions import argument_error, data_error, file_errors
from miricigale.utils.file_formats import register
from miricigale.utils.files import file_place, open_fits, replacing, write_fits
from miricigale.utils.meta import plain_value
from miricigale.utils.store import native, open_parts, write_parts
from miricigale.utils.units import ANGLE, scalar

#: Arrays of a `MatchingKernel` in files.
_ARRAYS = ("array", "source", "target")
_FIELD_LAYOUT = "kernel-field-1"


def _write_kernel(kernel, path, *, overwrite=False):
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(kernel.array, name="KERNEL")]
    header = hdus[1].header
    # which other programs look for
    header["PIXSCALE"] = (kernel.pixel_scale.value, "arcsec")
    if np.isfinite(kernel.regularization):
        header["REGULAR"] = (kernel.regularization, "Wiener parameter")
    header["META"] = json.dumps(kernel.meta, default=plain_value)
    psfs = {"SOURCE": kernel.source, "TARGET": kernel.target}.items()
    hdus += [fits.ImageHDU(psf, name=name) for name, psf in psfs if psf is not None]
    with replacing(path, overwrite=overwrite) as partial:
        write_fits(hdus, partial)


def read_kernel(path, *, pixel_scale=None, source=None):
    """
    Read a kernel or a field of kernels, of this package or of others.

    Parameters
    ----------
    path : path-like
        A FITS file, or ``file.fits[EXTENSION,PLANE]``.
    pixel_scale, source : optional
        As for `_read_kernel`, of one kernel.

    Returns
    -------
    kernel : `MatchingKernel` or `KernelField`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or holds no kernel.
    ValueError
        If the pixel is unknown.
    """
    with open_fits(file_place(path)[0], wanted="a matching kernel") as hdus:
        is_field = hdus[0].header.get("FORMAT") == _FIELD_LAYOUT
    if is_field:
        return _read_field(path)
    return _read_kernel(path, pixel_scale=pixel_scale, source=source)


def _read_kernel(path, *, ext=None, plane=None, pixel_scale=None, source=None):
    """As documented in `MatchingKernel.read`."""
    name, path_extension, _ = file_place(path)
    names_image = not (ext is None and plane is None and path_extension is None)
    with open_fits(name, wanted="a matching kernel") as hdus:
        is_written = "KERNEL" in hdus and not names_image
        if is_written:
            header = hdus["KERNEL"].header
            arrays = {k: native(hdus[k].data) for k in _ARRAYS[1:] if k.upper() in hdus}
            array = native(hdus["KERNEL"].data)
    if not is_written:
        kernel_file = PSFFile.open(path, "a matching kernel", ext=ext, plane=plane)
        cell = kernel_file.cell
        _check_pixel(path, cell, pixel_scale)
        if pixel_scale is None and cell is None:
            raise argument_error(
                "pixel_scale", f"given: the header of {path} does not state the pixel", None
            )
        if pixel_scale is None:
            pixel_scale = cell * ANGLE
        # kernels are not moved to their cores: the images that they match may be shifted
        array = kernel_file.planes.mean(axis=0)
        with file_errors(path, "cannot be read as a kernel"):
            kernel = MatchingKernel.from_array(array, pixel_scale=pixel_scale, source=source)
        kernel.meta["file"] = str(path)
        return kernel
    with file_errors(path, "is not a complete matching kernel"):
        cell = float(header["PIXSCALE"])
        kernel = MatchingKernel(
            array,
            cell * ANGLE,
            regularization=header.get("REGULAR", float("nan")),
            meta=json.loads(header.get("META", "{}")),
            **arrays,
        )
    _check_pixel(path, cell, pixel_scale)
    if source is None or kernel.source is not None:
        return kernel
    # checks the PSF; the kernel keeps its own sum, the light that the wide PSF holds
    checked = MatchingKernel.from_array(
        array / array.sum(), pixel_scale=cell * ANGLE, source=source
    )
    target = fftconvolve(checked.source, kernel.array, mode="same")
    return dataclasses.replace(kernel, source=checked.source, target=target)


def _check_pixel(path, cell, pixel_scale):
    """Refuse a kernel whose pixel in arcsec is not that of the image that it is for."""
    if pixel_scale is None or cell is None:
        return
    scale = scalar(pixel_scale, ANGLE, "pixel_scale")
    if abs(cell / scale - 1) > 0.02:
        raise data_error(
            path,
            f"is a kernel for pixels of {cell:.4g} arcsec, and those of the image that it is for "
            f"have {scale:.4g} arcsec ('pixel_scale')",
        )


def _write_field(field, path, *, overwrite=False):
    kernels = field.kernels
    text = {
        "method": field.method,
        "pixel_scale": field.pixel_scale.value,
        "regularization": [kernel.regularization for kernel in kernels],
        "meta": [kernel.meta for kernel in kernels],
    }
    arrays = {name: np.stack([getattr(k, name) for k in kernels]) for name in _ARRAYS}
    icrs = field.sky.icrs
    arrays |= {"ra": icrs.ra.deg, "dec": icrs.dec.deg}
    write_parts(path, _FIELD_LAYOUT, text=text, arrays=arrays, overwrite=overwrite)


def _read_field(path):
    with open_parts(path, (_FIELD_LAYOUT,), wanted="fields of kernels") as parts:
        text = parts.text
        arrays = [parts.array(name) for name in _ARRAYS]
        kernels = []
        for array, source, target, mu, meta in zip(
            *arrays, text["regularization"], text["meta"], strict=True
        ):
            kernels.append(
                MatchingKernel(array, text["pixel_scale"] * ANGLE, source, target, mu, meta)
            )
        sky = SkyCoord(parts.array("ra"), parts.array("dec"), unit="deg")
        return KernelField(kernels, sky, text["method"])


register(MatchingKernel, read=_read_kernel, write=_write_kernel)
register(KernelField, read=_read_field, write=_write_field)
