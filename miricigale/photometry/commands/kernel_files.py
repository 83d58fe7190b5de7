"""PSFs and kernels that others made, and the kernel that two images need."""

import logging

import astropy.units as u
import numpy as np

from miricigale.instrument.sky_axes import grid_angle
from miricigale.utils.exceptions import argument_error, data_error, file_errors
from miricigale.utils.files import file_place, open_fits, split_extension
from miricigale.utils.options import check_that
from miricigale.utils.units import ANGLE, to_array

_log = logging.getLogger(__name__)


def _read_psf(file, argument):
    """A PSF of a file, or the mean of several, with its center in the middle."""
    # the kernels of PSFs are compiled when they are needed
    from miricigale.psf import MODEL_FILTERS, average_psf, make_psf, psf_image, read_psf
    from miricigale.psf.files import core_position, header_grid, is_stpsf, is_written, read_planes

    path, header = file.psf, file.header
    known = header.filter in MODEL_FILTERS
    if split_extension(path)[1] is None and is_written(path):
        return _compared(read_psf(path), header, argument) if known else read_psf(path)
    planes, stated = read_planes(path, "a PSF")
    cell, turn = header_grid(stated)
    if file.psf_scale is not None:
        given = float(to_array(file.psf_scale, ANGLE, f"{argument}_scale"))
        if cell is not None and abs(given / cell - 1) > 0.02:
            wanted = f"{cell:.4g} arcsec, as the header of {path} says"
            raise argument_error(argument + "_scale", wanted, file.psf_scale)
        cell = given
    if file.psf_angle is not None:
        given = float(to_array(file.psf_angle, u.deg, f"{argument}_angle", finite=True))
        if turn is not None and abs((given - turn + 180) % 360 - 180) > 0.5:
            wanted = f"{turn:.4g} deg, as the header of {path} says"
            raise argument_error(argument + "_angle", wanted, file.psf_angle)
        turn = given
    on_detector = turn is None and is_stpsf(stated) and np.size(header.pa_aper) == 1
    if on_detector and header.pa_aper is not None:
        # its axes are those of the detector
        turn = float(np.ravel(header.pa_aper.to_value(u.deg))[0])
    own = _grid(header)
    if cell is None:
        # the model PSF tells if the pixel is another one
        wanted = f"given: {path} does not state its pixel, and no model PSF is there to test that of the image"
        check_that(known, argument + "_scale", wanted, None)
        cell = own[0]
        _log.info(
            "%s does not state its pixel: that of the image, %.4g arcsec, is taken", path, cell
        )
    if turn is None:
        turn = own[1]
    form = {"pixel_scale": cell * ANGLE, "frame": "sky", "angle": turn * u.deg}
    kept = []
    for data in planes:
        if not np.all(np.isfinite(data)) or not data.max() > 0 or not data.sum() > 0:
            raise data_error(path, "is no PSF: it has no light, or pixels that are not finite")
        total = float(data.sum())
        # the model PSF says which fraction of the light its array holds
        scaled = known and not 0.8 < total < 0.995
        if scaled:
            _log.info("%s sums to %.4g and is scaled to 1", path, total)
        with file_errors(path, "cannot be read as a PSF"):
            psf = make_psf(data / total if scaled else data, origin=core_position(data), **form)
        n = 2 * (min(data.shape) // 2) - 1
        middle = psf_image(psf, pixel_scale=cell * ANGLE, shape=n)
        middle = middle / middle.sum() if scaled else middle
        # only light beyond the edge is lost by the shift
        kept.append(make_psf(middle, **form, meta={"file": str(path)}))
    psf = kept[0] if len(kept) == 1 else average_psf(kept)
    # if the user stated the pixel scale, only smoothing of the image can explain a wider PSF
    smoothed = file.psf_scale is not None
    return _compared(psf, header, argument, smoothed=smoothed) if known else psf


def _grid(header):
    """Pixel in arcsec and position angle of +y in deg of an image."""
    from miricigale.photometry.images.arrays import pixel_scale

    return pixel_scale(header.wcs), grid_angle(header.wcs, header.shape).to_value(u.deg)


def _compared(psf, header, argument, *, smoothed=False):
    """A PSF, compared with the model of its image."""
    from miricigale.psf import checked_psf

    return checked_psf(
        psf,
        header.filter,
        pixel_scale=_grid(header)[0] * ANGLE,
        pa=header.pa_aper,
        resampling=None if header.exposure else "drizzle",
        smoothed=smoothed,
        argument=argument,
    )


def read_kernel(path, *, pixel_scale, highres_psf=None):
    """
    Read a kernel that others made.

    Parameters
    ----------
    path : path-like
        What `~miricigale.psf.MatchingKernel.write` wrote, or any image of a kernel
        (``file.fits[EXTENSION,PLANE]`` of a cube, ``mean`` for the mean of its planes).
    pixel_scale : `~astropy.units.Quantity`
        Pixel of the prior.
    highres_psf : `~photutils.psf.ImagePSF`, optional
        The sharp PSF on the prior's axes, for points and for wings, unless the file has it. That
        of the image is what the kernel makes of it.

    Returns
    -------
    kernel : `~miricigale.psf.MatchingKernel`
        Without PSFs if there is no sharp one.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, holds no kernel of odd and square shape whose sum is about 1, or one
        for other pixels.

    Warns
    -----
    `~miricigale.utils.exceptions.PSFWarning`
        As `~miricigale.psf.MatchingKernel.from_array`.
    """
    from miricigale.psf import MatchingKernel
    from miricigale.psf.files import header_grid, read_planes

    name = file_place(path)[0]
    with open_fits(name, wanted="a matching kernel") as hdus:
        own = all(part in hdus for part in ("KERNEL", "SOURCE", "TARGET"))
    if own:
        kernel = MatchingKernel.read(name, format="fits")
        stated = kernel.pixel_scale.value
    else:
        planes, header = read_planes(path, "a kernel")
        stated = header_grid(header)[0]
        with file_errors(path, "cannot be read as a kernel"):
            kernel = MatchingKernel.from_array(
                planes.mean(axis=0), pixel_scale=pixel_scale, source=highres_psf
            )
        kernel.meta["file"] = str(path)
    wanted = pixel_scale.to_value(ANGLE)
    if stated is not None and abs(stated / wanted - 1) > 0.02:
        what = f"{stated:.4g} arcsec, and those of the prior have {wanted:.4g} arcsec"
        raise data_error(path, f"is a kernel for pixels of {what}")
    return kernel


def can_be_modeled(header):
    """
    Whether `~miricigale.psf.filter_psf` has the PSF of an image, of which the header is given.

    It must know the filter and, unless that is one of WFC3/IR, the position angle.
    """
    from miricigale.psf import MODEL_FILTERS

    name = header.filter
    return name in MODEL_FILTERS and (name.startswith("wfc3.") or header.pa_aper is not None)


def image_psf(file, argument="psf"):
    """
    The PSF of an image: that of a file, or the model of its filter.

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
        resampling=None if header.exposure else "drizzle",
    )


def matching_kernel(image, highres, kernel=None):
    """
    The kernel from the prior to the image.

    Parameters
    ----------
    image, highres : `~miricigale.photometry.MosaicFile`
        The two images.
    kernel : path-like, optional
        As for `~miricigale.photometry.commands.from_files.measure_files`.

    Returns
    -------
    kernel : `~miricigale.psf.MatchingKernel`
        Without PSFs if a kernel was given and no PSF of the prior is known.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file cannot be read as what it should be.
    ValueError
        If the prior's PSF is not the narrower one, or a PSF is not that of its filter.
    """
    from miricigale.psf import MODEL_FILTERS, MatchingKernel, make_psf, rotate_psf

    scale, angle = _grid(highres.header)
    fine, turn, header = scale * ANGLE, angle * u.deg, image.header
    wide = image_psf(image) if kernel is None else None
    sharp = image_psf(highres, "highres_psf")
    psfs = {"psf": wide, "highres_psf": sharp}
    if kernel is not None:
        if sharp is not None:
            sharp = rotate_psf(sharp, grid_angle=turn)
        made = read_kernel(kernel, highres_psf=sharp, pixel_scale=fine)
        if made.target is not None and header.filter in MODEL_FILTERS:
            form = {"pixel_scale": fine, "frame": "sky", "angle": turn, "enclosed": 1.0}
            _compared(make_psf(made.target, **form), header, "kernel")
    else:
        _check_widths(sharp.fwhm, wide.fwhm)
        made = MatchingKernel.from_psfs(sharp, wide, pixel_scale=fine, grid_angle=turn)
    if made.target is not None:
        # the peaks of two PSFs of the same light
        _check_widths(1 / made.source.max(), made.target.sum() / made.target.max())
    made.meta["psfs"] = {
        what: {
            "from": str(one.meta.get("file", "model")),
            "fwhm": one.fwhm.value,
            "enclosed": one.enclosed,
        }
        for what, one in psfs.items()
        if one is not None
    }
    _log.info("%r", made)
    return made


def _check_widths(sharp, wide):
    # NaN (unknown width) passes
    if sharp >= wide:
        msg = (
            "the PSF of 'image' must be wider than that of 'highres', and it is not: are the two "
            "swapped, or their PSFs?"
        )
        raise ValueError(msg)
