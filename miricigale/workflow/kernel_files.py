"""PSFs and kernels that others made, and the kernel that two images need."""

import logging

import numpy as np

from miricigale.photometry.grids import grid_angle
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import open_fits, split_extension
from miricigale.utils.units import ANGLE, to_array

__all__ = ["file_place", "is_own_kernel", "matching_kernel", "read_kernel"]

_log = logging.getLogger(__name__)


def file_place(path):
    """
    Take ``file.fits[EXTENSION,PLANE]`` apart.

    Parameters
    ----------
    path : path-like
        A file, with an extension and the plane of a cube in brackets or without.

    Returns
    -------
    path : str
        The file.
    extension : str or int
        The first without brackets.
    plane : int, "mean" or None
        None for an image.

    Raises
    ------
    ValueError
        If the plane is neither a number nor ``mean``.
    """
    name, extension = split_extension(path)
    if not isinstance(extension, str) or "," not in extension:
        return name, 0 if extension is None else extension, None
    extension, _, plane = (part.strip() for part in extension.rpartition(","))
    if plane != "mean" and not plane.isdigit():
        raise argument_error("path", "FILE[EXTENSION,PLANE], the plane a number or mean", path)
    extension = int(extension) if extension.isdigit() else extension
    return name, extension, plane if plane == "mean" else int(plane)


def _planes(path, wanted):
    """The planes that a path means, shape (n, ny, nx)."""
    name, extension, plane = file_place(path)
    with open_fits(name, wanted=wanted) as hdus:
        try:
            data = hdus[extension].data
        except (KeyError, IndexError):
            msg = f"{path}: there is no such extension, only {[hdu.name for hdu in hdus]}"
            raise DataError(msg) from None
        shape = getattr(data, "shape", None)
        if shape is None or len(shape) != (2 if plane is None else 3):
            kind = "an image" if plane is None else "a cube"
            hint = "; say FILE[EXTENSION,PLANE] or FILE[EXTENSION,mean] of a cube"
            msg = f"{path} must be {kind} with {wanted}, got the shape {shape}{hint}"
            raise DataError(msg)
        if isinstance(plane, int) and plane >= shape[0]:
            msg = f"{path}: the cube has the planes 0 to {shape[0] - 1}"
            raise DataError(msg)
        chosen = data[None] if plane is None else data if plane == "mean" else data[plane][None]
        return np.array(chosen, dtype=float)


def _centred(data):
    """The position x, y of the bright core of a PSF."""
    y, x = np.indices(data.shape)
    core = np.where(data > 0.3 * data.max(), data, 0.0)
    # of one peak only
    peak = np.unravel_index(np.argmax(data), data.shape)
    core[np.hypot(y - peak[0], x - peak[1]) > 0.25 * min(data.shape)] = 0
    return float((core * x).sum() / core.sum()), float((core * y).sum() / core.sum())


def _read_psf(path, scale, angle):
    """A PSF, or the mean of several, its centre in the middle."""
    from miricigale.psf import average_psf, make_psf, psf_image

    kept = []
    for data in _planes(path, "a PSF"):
        if not np.all(np.isfinite(data)) or not data.max() > 0:
            msg = f"{path} is no PSF: it has no light, or pixels that are not finite"
            raise DataError(msg)
        form = {"pixel_scale": scale * ANGLE, "frame": "sky", "angle": angle}
        try:
            psf = make_psf(data, origin=_centred(data), **form)
        except ValueError as err:
            msg = f"{path} cannot be read as a PSF: {err}"
            raise DataError(msg) from err
        n = 2 * (min(data.shape) // 2) - 1
        middle = psf_image(psf, pixel_scale=scale * ANGLE, shape=n)
        # the shift loses nothing but what is beyond the edge
        kept.append(make_psf(middle, **form, file=str(path)))
    return kept[0] if len(kept) == 1 else average_psf(kept)


def is_own_kernel(path):
    """
    Whether a file is a kernel with its PSFs, as `~miricigale.psf.MatchingKernel.write` makes it.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    own : bool
    """
    with open_fits(file_place(path)[0], wanted="a matching kernel") as hdus:
        return "KERNEL" in hdus and "SOURCE" in hdus and "TARGET" in hdus


def read_kernel(path, *, highres_psf=None, pixel_scale=None):
    """
    Read a kernel that others made.

    Parameters
    ----------
    path : path-like
        What `~miricigale.psf.MatchingKernel.write` wrote, or any image of a kernel
        (``file.fits[EXTENSION,PLANE]`` of a cube, ``mean`` for the mean of its planes).
    highres_psf : `~photutils.psf.ImagePSF`, optional
        The sharp PSF, for points and for wings; needed unless the file has it. That of the
        image is what the kernel makes of it.
    pixel_scale : `~astropy.units.Quantity`, optional
        Pixel of the kernel; needed likewise.

    Returns
    -------
    kernel : `~miricigale.psf.MatchingKernel`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, or holds no kernel of odd and square shape.
    """
    from scipy.signal import fftconvolve

    from miricigale.psf import MatchingKernel, psf_image

    if is_own_kernel(path):
        return MatchingKernel.read(file_place(path)[0])
    if highres_psf is None or pixel_scale is None:
        wanted = f"given, for {path} holds the kernel alone"
        raise argument_error("highres_psf, pixel_scale", wanted, None)
    array = _planes(path, "a kernel").mean(axis=0)
    n = array.shape[0]
    if array.shape != (n, n) or n % 2 == 0 or not np.all(np.isfinite(array)):
        msg = f"{path} must be a kernel, odd, square and finite, got the shape {array.shape}"
        raise DataError(msg)
    if not 0.8 < array.sum() < 1.05:
        msg = f"{path} must be a kernel whose sum is about 1, got {array.sum():.4g}"
        raise DataError(msg)
    source = psf_image(highres_psf, pixel_scale=pixel_scale, shape=n)
    source = source / source.sum()
    return MatchingKernel(
        array,
        pixel_scale,
        source=source,
        target=fftconvolve(source, array, mode="same"),
        meta={"file": str(path)},
    )


def matching_kernel(
    image, highres, filter_, pa_aper, *, kernel, psf, highres_psf, psf_scale, highres_psf_scale
):
    """
    The kernel from the prior to the image.

    Parameters
    ----------
    image, highres : `~miricigale.photometry.MosaicFile`
        Their files.
    filter_ : str
        Filter of the image, for the model PSF.
    pa_aper : `~astropy.units.Quantity` or None
        Position angle of the detector's +y axis, for the model PSF.
    kernel, psf, highres_psf, psf_scale, highres_psf_scale
        As for `~miricigale.workflow.photometry.measure_files`, any of them None.

    Returns
    -------
    kernel : `~miricigale.psf.MatchingKernel`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file cannot be read as what it should be.
    ValueError
        If the prior's PSF is not the narrower one.
    """
    from miricigale.photometry.arrays import pixel_scale
    from miricigale.psf import MatchingKernel, hst_psf, miri_psf, psf_mosaic

    grid = [one.header for one in (image, highres)]
    coarse, fine = (pixel_scale(one.wcs) for one in grid)
    low_angle, high_angle = (grid_angle(one.wcs, one.shape) for one in grid)
    sharp = None
    if highres_psf is not None:
        scale = fine if highres_psf_scale is None else to_array(highres_psf_scale, ANGLE, "scale")
        sharp = _read_psf(highres_psf, float(scale), high_angle)
    if kernel is not None:
        made = read_kernel(kernel, highres_psf=sharp, pixel_scale=fine * ANGLE)
    else:
        if sharp is None:
            sharp = hst_psf(highres.header.filter, pixel_scale=fine * ANGLE)
        if psf is None:
            low = {"grid_angle": low_angle}
            wide = psf_mosaic(miri_psf(filter_), coarse * ANGLE, pa_aper, **low)
        else:
            scale = coarse if psf_scale is None else to_array(psf_scale, ANGLE, "psf_scale")
            wide = _read_psf(psf, float(scale), low_angle)
        _check_widths(sharp.meta["fwhm"], wide.meta["fwhm"], image.path, highres.path)
        made = MatchingKernel.from_psfs(
            sharp, wide, pixel_scale=fine * ANGLE, grid_angle=high_angle
        )
    # the peaks of two PSFs of the same light
    _check_widths(1 / made.source.max(), 1 / made.target.max(), image.path, highres.path)
    _log.info("%r", made)
    return made


def _check_widths(sharp, wide, path, highres_path):
    # an unknown width is NaN
    if sharp >= wide:
        msg = (
            f"the PSF of {path} must be wider than that of {highres_path}, and it is not: are "
            "'image' and 'highres' swapped, or their PSFs?"
        )
        raise ValueError(msg)
