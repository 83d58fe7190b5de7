"""PSFs and kernels that others made, and the kernel that two images need."""

import dataclasses
import logging

import astropy.units as u
import numpy as np

from miricigale.instrument.sky_axes import grid_angle
from miricigale.utils.exceptions import file_errors
from miricigale.utils.files import split_extension
from miricigale.utils.options import check_that
from miricigale.utils.units import ANGLE

_log = logging.getLogger(__name__)


def _read_psf(file, argument):
    """Read the PSF of a file, on the sky, and compare it with the model of the filter if there is one."""
    # the kernels of PSFs are compiled when they are needed
    from miricigale.psf import MODEL_FILTERS, read_psf
    from miricigale.psf.files import PSFFile, is_written

    path = file.psf
    header = file.header
    has_model = header.filter in MODEL_FILTERS
    if split_extension(path)[1] is None and is_written(path):
        for name, value in (("_scale", file.psf_scale), ("_angle", file.psf_angle)):
            wanted = f"left out: {path} is a file of InstrumentPSF.write, which has it"
            check_that(value is None, argument + name, wanted, value)
        psf = read_psf(path)
        if has_model:
            psf = _compared(psf, header, argument)
        return psf
    psf_file = PSFFile.open(path)
    pixel_scale = psf_file.pixel_scale(file.psf_scale, argument=f"{argument}_scale")
    angle = psf_file.angle(file.psf_angle, argument=f"{argument}_angle")
    image_scale, image_angle = _grid(header)
    if pixel_scale is None:
        # the model PSF tells if the pixel is another one
        wanted = f"given: {path} does not state its pixel, and no model PSF is there to test that of the image"
        check_that(has_model, argument + "_scale", wanted, None)
        pixel_scale = image_scale * ANGLE
        _log.info("%s does not state its pixel: that of the image, %s, is taken", path, pixel_scale)
    has_roll = header.pa_aper is not None and np.size(header.pa_aper) == 1
    if angle is None and psf_file.on_detector and has_roll:
        angle = np.ravel(header.pa_aper)[0]
    if angle is None:
        angle = image_angle * u.deg
    total = float(psf_file.planes.mean(axis=0).sum())
    if has_model and total > 0 and not 0.8 < total < 0.995:
        # the model PSF says which fraction of the light its array holds
        _log.info("%s sums to %.4g and is scaled to 1", path, total)
        psf_file = dataclasses.replace(psf_file, planes=psf_file.planes / total)
    with file_errors(path, "cannot be read as a PSF"):
        psf = psf_file.make_psf(pixel_scale=pixel_scale, frame="sky", angle=angle)
    if not has_model:
        return psf
    # if the user stated the pixel scale, only smoothing of the image can explain a wider PSF
    return _compared(psf, header, argument, smoothed=file.psf_scale is not None)


def _grid(header):
    """Return the pixel in arcsec and the position angle of +y in deg of an image."""
    from miricigale.photometry.images.arrays import pixel_scale

    return pixel_scale(header.wcs), grid_angle(header.wcs, header.shape).to_value(u.deg)


def _resampling(header):
    """Return how an image was resampled: mosaics are drizzled, exposures are not."""
    if header.exposure:
        return None
    return "drizzle"


def _compared(psf, header, argument, *, smoothed=False):
    """Compare a PSF with the model of its image, and return it."""
    from miricigale.psf import checked_psf

    return checked_psf(
        psf,
        header.filter,
        pixel_scale=_grid(header)[0] * ANGLE,
        pa=header.pa_aper,
        resampling=_resampling(header),
        smoothed=smoothed,
        argument=argument,
    )


def can_be_modeled(header):
    """
    Return whether `~miricigale.psf.filter_psf` has the PSF of an image, of which the header is given.

    It must know the filter and, unless that is one of WFC3/IR, the position angle.
    """
    from miricigale.psf import MODEL_FILTERS

    name = header.filter
    return name in MODEL_FILTERS and (name.startswith("wfc3.") or header.pa_aper is not None)


def image_psf(file, argument="psf"):
    """
    Return the PSF of an image: that of a file, or the model of its filter.

    Parameters
    ----------
    file : `~miricigale.photometry.MosaicFile`
        The image.
    argument : str, optional
        What its PSF is called in messages.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF` or None
        In the frame of the sky. None without a file if there is no model (`can_be_modeled`).

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or holds no PSF.
    """
    from miricigale.psf import filter_psf

    if file.psf is not None:
        return _read_psf(file, argument)
    header = file.header
    if not can_be_modeled(header):
        return None
    scale, angle = _grid(header)
    _log.info("%s: the model of %s", argument, header.filter)
    return filter_psf(
        header.filter,
        pixel_scale=scale * ANGLE,
        pa=header.pa_aper,
        grid_angle=angle * u.deg,
        resampling=_resampling(header),
    )


def matching_kernel(image, highres, kernel=None):
    """
    Make the kernel from the prior to the image.

    Parameters
    ----------
    image, highres : `~miricigale.photometry.MosaicFile`
        The two images.
    kernel : path-like, optional
        As for `~miricigale.photometry.commands.from_files.measure_files`.

    Returns
    -------
    kernel : `~miricigale.psf.MatchingKernel` or `~miricigale.psf.KernelField`
        Without PSFs if a kernel was given and no PSF of the prior is known; a field if that of the file is of
        several places.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file cannot be read as what it should be.
    ValueError
        If the prior's PSF is not the narrower one, or a PSF is not that of its filter.
    """
    from miricigale.psf import MODEL_FILTERS, KernelField, MatchingKernel, make_psf, rotate_psf
    from miricigale.psf.kernel_io import read_kernel

    scale, angle = _grid(highres.header)
    fine = scale * ANGLE
    turn = angle * u.deg
    header = image.header
    # the PSFs on the sky, from which the kernel is made
    psfs = {}
    if kernel is None:
        psfs["psf"] = wide = image_psf(image)
    psfs["highres_psf"] = sharp = image_psf(highres, "highres_psf")
    if kernel is not None:
        if sharp is not None:
            sharp = rotate_psf(sharp, grid_angle=turn)
        matched = read_kernel(kernel, pixel_scale=fine, source=sharp)
        if isinstance(matched, KernelField):
            return matched
        if matched.target is not None and header.filter in MODEL_FILTERS:
            form = {"pixel_scale": fine, "frame": "sky", "angle": turn, "enclosed": 1.0}
            _compared(make_psf(matched.target, **form), header, "kernel")
    else:
        _check_widths(sharp.fwhm, wide.fwhm)
        matched = MatchingKernel.from_psfs(sharp, wide, pixel_scale=fine, grid_angle=turn)
    if matched.target is not None:
        # the peaks of two PSFs of the same light
        _check_widths(1 / matched.source.max(), matched.target.sum() / matched.target.max())
    matched.meta["psfs"] = {}
    for name, psf in psfs.items():
        if psf is not None:
            matched.meta["psfs"][name] = {
                "from": str(psf.meta.get("file", "model")),
                "fwhm": psf.fwhm.value,
                "enclosed": psf.enclosed,
            }
    _log.info("%r", matched)
    return matched


def _check_widths(sharp, wide):
    # NaN (unknown width) passes
    if sharp >= wide:
        msg = (
            "the PSF of 'image' must be wider than that of 'highres', and it is not: are the two "
            "swapped, or their PSFs?"
        )
        raise ValueError(msg)
