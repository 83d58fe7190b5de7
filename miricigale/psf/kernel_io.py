"""Matching kernels, and fields of them, in FITS files: our own layouts, and images that others made."""

import json

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits

from miricigale.psf.files import fits_image
from miricigale.psf.kernel_field import KernelField
from miricigale.psf.kernels import MatchingKernel
from miricigale.utils.exceptions import data_error, file_errors
from miricigale.utils.file_formats import register
from miricigale.utils.files import open_fits, replacing, write_fits
from miricigale.utils.meta import plain_value
from miricigale.utils.store import native, open_parts, write_parts
from miricigale.utils.units import ANGLE

#: Arrays of a `MatchingKernel` in files.
_ARRAYS = ("array", "source", "target")


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


register(MatchingKernel, read=_read_kernel, write=_write_kernel)
register(KernelField, read=_read_field, write=_write_field)
