"""PSFs on other grids: turned to the sky, averaged, sampled, drizzled."""

import logging
import math
from collections.abc import Iterable

import astropy.units as u
import numpy as np

from miricigale.psf import _core
from miricigale.psf.effects import detector_response
from miricigale.psf.model import instrument_psf
from miricigale.utils.arrays import centered
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_choice, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import middle_pixel
from miricigale.utils.units import ANGLE, check_count, positive, scalar

_log = logging.getLogger(__name__)

_ANGLES = ("pixel_scale", "angle")


def _degrees(angle, argument):
    wanted = "the position angle of the detector's +y axis, east of north"
    check_that(angle is not None, argument, wanted, "None: it is unknown where the PSF points")
    return scalar(angle, u.deg, argument)


def _turn_by(psf, angle, grid_angle, argument):
    """Return the counter-clockwise turn in deg that brings the PSF to the grid."""
    if psf.frame == "sky":
        check_that(
            angle is None, argument, "left out for a PSF that stands on the sky already", angle
        )
        start = psf.angle.value
    else:
        start = _degrees(angle, argument)
    return start - grid_angle


def sampled(psf, x, y, turn=0.0, data=None):
    """Values per cell at offsets x, y in arcsec (broadcast), after a turn in deg; of other data if given."""
    a = math.radians(turn)
    if turn % 360 == 0:
        u_ = x
        v_ = y
    else:
        u_ = x * math.cos(a) + y * math.sin(a)
        v_ = -x * math.sin(a) + y * math.cos(a)
    if data is None:
        data = psf.data
    return _core.interpolate(data, u_ / psf.cell + psf.origin[0], v_ / psf.cell + psf.origin[1])


@takes_other_keywords
def rotate_psf(psf, angle=None, *, grid_angle=0.0 * u.deg):
    """
    Turn a PSF from the detector's axes to those of an image of the sky.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF`
        In the detector frame, or in the sky frame at another angle.
    angle : `~astropy.units.Quantity`
        Position angle of the detector's +y axis, east of north (PA_APER). Needed for a
        PSF in the detector frame, refused for one that stands on the sky.
    grid_angle : `~astropy.units.Quantity`, optional
        Position angle of the image's +y axis; 0 for a mosaic with north up. Its +x is
        west of that, as on any image of the sky.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        Same grid, frame ``"sky"``; cells that come from beyond the old grid are 0.

    Raises
    ------
    ValueError
        If the angle of a PSF in the detector frame is not given.

    Notes
    -----
    With north up and east left a position angle grows counter-clockwise, and so does the
    turn.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import miri_psf, rotate_psf
    >>> psf = rotate_psf(miri_psf("F1500W", fov=6 * u.arcsec), 35 * u.deg)
    >>> psf.frame, psf.angle
    ('sky', <Quantity 0. deg>)
    """
    psf = instrument_psf(psf)
    grid = _degrees(grid_angle, "grid_angle")
    turn = _turn_by(psf, angle, grid, "angle")
    ny, nx = psf.data.shape
    if turn % 90 == 0 and nx == ny and tuple(psf.origin) == middle_pixel(psf.data.shape):
        # counter-clockwise with y up
        data = np.rot90(psf.data, -round(turn / 90))
    else:
        x = (np.arange(nx) - psf.origin[0]) * psf.cell
        y = ((np.arange(ny) - psf.origin[1]) * psf.cell)[:, None]
        data = sampled(psf, x, y, turn)
    return psf.replace(data, frame="sky", angle=grid * u.deg)


@takes_other_keywords
def average_psf(psfs):
    """
    Average PSFs, for instance over dithers or rolls.

    Parameters
    ----------
    psfs : sequence of `~photutils.psf.ImagePSF`
        All of the same grid, frame, angle and effects.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`

    Raises
    ------
    ValueError
        If the list is empty, or the PSFs differ.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import average_psf, gaussian_psf
    >>> form = {"pixel_scale": 0.1 * u.arcsec, "fov": 4 * u.arcsec}
    >>> both = average_psf([gaussian_psf(width * u.arcsec, **form) for width in (0.3, 0.4)])
    >>> print(f"{both.fwhm:.3f}")
    0.331 arcsec
    """
    psfs = alike(psfs, ("pixel_scale", "oversampling", "frame", "angle", "includes", "origin"))
    weights = np.full(len(psfs), 1 / len(psfs))
    data = np.tensordot(weights, np.stack([psf.data for psf in psfs]), axes=1)
    return psfs[0].replace(data, meta={"n_averaged": len(psfs)})


def alike(psfs, names):
    """Return the PSFs, checked: of one shape, and with the same ``names`` among their facts."""
    wanted = "a list of PSFs, at least one"
    is_list = isinstance(psfs, Iterable) and not isinstance(psfs, (str, np.ndarray))
    check_that(is_list, "psfs", wanted, type(psfs).__name__)
    psfs = [instrument_psf(psf, f"psfs[{i}]") for i, psf in enumerate(psfs)]
    check_that(psfs, "psfs", wanted, "none")
    first = psfs[0].facts
    for i, psf in enumerate(psfs[1:], start=1):
        for name in names:
            mine = psf.facts[name]
            theirs = first[name]
            close = name in _ANGLES and np.isclose(mine.value, theirs.value, rtol=1e-6)
            wanted = f"alike in {name}"
            check_that(close or mine == theirs, "psfs", wanted, f"{theirs} and {mine} (psfs[{i}])")
        shapes = f"{psfs[0].data.shape} and {psf.data.shape} (psfs[{i}])"
        check_that(psf.data.shape == psfs[0].data.shape, "psfs", "alike in shape", shapes)
    return psfs


@takes_other_keywords
def psf_image(psf, *, pixel_scale, shape, offset=(0.0, 0.0)):
    """
    Sample a PSF on another pixel grid of the same orientation.

    The PSF is evaluated at the pixels' centers and scaled by the ratio of the areas;
    no further pixel response is applied (see `psf_mosaic` for that).

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF`
        A PSF with the meta of `~miricigale.psf.make_psf`.
    pixel_scale : `~astropy.units.Quantity`
        Side of a pixel of the image.
    shape : int or tuple of int
        Rows and columns; the PSF's center is the middle of the image.
    offset : tuple of float, optional
        Shift of the center in x, y, in pixels of the image.

    Returns
    -------
    image : `~numpy.ndarray`, shape ``shape``
        Fraction of the light in each pixel; the sum is the encircled fraction.

    Raises
    ------
    ValueError
        If the pixel or the shape is not positive.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> image = psf_image(psf, pixel_scale=0.06 * u.arcsec, shape=31)
    >>> print(f"{image.max():.4f} of the light in the middle pixel, {image.sum():.3f} in all")
    0.0353 of the light in the middle pixel, 1.000 in all
    """
    psf = instrument_psf(psf)
    scale = positive(pixel_scale, ANGLE, "pixel_scale")
    if np.isscalar(shape):
        ny = shape
        nx = shape
    else:
        ny, nx = shape
    check_that(min(ny, nx) >= 1, "shape", "at least one row and column", shape)
    x = (centered(nx) - offset[0]) * scale
    y = ((centered(ny) - offset[1]) * scale)[:, None]
    return sampled(psf, x, y) * (scale / psf.pixel_scale.value) ** 2


@takes_other_keywords
def psf_mosaic(
    psf,
    pixel_scale,
    pa=None,
    fov=None,
    *,
    grid_angle=0.0 * u.deg,
    resampling="drizzle",
    pixfrac=1.0,
    oversampling=None,
):
    """
    Return the PSF of a mosaic made from many dithered exposures.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF`
        PSF of the exposures, detector frame (or sky frame, then without ``pa``).
    pixel_scale : `~astropy.units.Quantity`
        Pixel of the mosaic.
    pa : `~astropy.units.Quantity`, optional
        Position angle of the detector's +y; several (an array) are averaged.
    fov : `~astropy.units.Quantity`, optional
        Width of the grid; that of ``psf`` if not given.
    grid_angle : `~astropy.units.Quantity`, optional
        Position angle of the mosaic's +y.
    resampling : {"drizzle", None}, optional
        ``"drizzle"`` adds what the resampling does to the image, averaged over all
        sub-pixel positions: the drop (the detector's pixel times ``pixfrac``) and the
        mosaic's own pixel. None changes the grid only.
    pixfrac : float, optional
        Size of the drop.
    oversampling : int, optional
        Cells per mosaic pixel; by default as fine as ``psf``.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        Frame ``"sky"``, ``pixel_scale`` that of the mosaic, ``"drizzle"`` added to
        ``includes``.

    Raises
    ------
    ValueError
        If ``pa`` is missing for a PSF in the detector frame, or a size is not positive.

    References
    ----------
    Fruchter & Hook 2002, PASP 114, 144.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import miri_psf, psf_mosaic
    >>> psf = miri_psf("F1500W", fov=6 * u.arcsec)
    >>> mosaic = psf_mosaic(psf, 0.06 * u.arcsec, pa=35 * u.deg)
    >>> print(f"{psf.fwhm:.3f} -> {mosaic.fwhm:.3f}")
    0.513 arcsec -> 0.518 arcsec
    """
    psf = instrument_psf(psf)
    check_choice(resampling, "resampling", ("drizzle", None))
    check_that(0 < pixfrac <= 1, "pixfrac", "above 0 and at most 1", pixfrac)
    scale = positive(pixel_scale, ANGLE, "pixel_scale")
    grid = _degrees(grid_angle, "grid_angle")
    angles = [None]
    if pa is not None:
        angles = list(np.atleast_1d(pa))
    turns = [_turn_by(psf, angle, grid, "pa") for angle in angles]
    if oversampling is None:
        oversampling = max(1, math.ceil(scale / psf.cell - 1e-6))
    cell = scale / check_count(oversampling, "oversampling")
    if fov is None:
        width = 2 * psf.half_width
    else:
        width = positive(fov, ANGLE, "fov")
    n = 2 * round(0.5 * width / cell - 0.5) + 1
    blurred = psf.data
    if resampling == "drizzle":
        blurred = detector_response(
            psf.data, oversampling=psf.n_cells, pixel=False, boxes=(pixfrac,)
        )
    axis = (np.arange(n) - n // 2) * cell
    # dithers of one roll are alike
    different, counts = np.unique(turns, return_counts=True)
    stamps = []
    for turn in different:
        stamps.append(sampled(psf, axis, axis[:, None], turn, blurred))
    data = np.average(
        stamps,
        axis=0,
        weights=counts,
    )
    data *= (scale / psf.pixel_scale.value) ** 2
    includes = psf.includes
    if resampling == "drizzle":
        data = detector_response(data, oversampling=oversampling, pixel=True)
        includes = (*includes, "drizzle")
    return psf.replace(
        data,
        pixel_scale=scale * ANGLE,
        oversampling=oversampling,
        origin=None,
        frame="sky",
        angle=grid * u.deg,
        includes=includes,
    )


def centered_psf(psf, tolerance, argument="psf"):
    """
    Put a PSF's origin where its core is, if that is more than ``tolerance`` arcsec away.

    The PSF with the same data, and where the core was, x, y in arcsec from the old origin.

    Raises
    ------
    ValueError
        If no core is found, or it is nearer to the edge than to the origin.
    """
    psf = instrument_psf(psf, argument)
    x, y, _ = _core.core_moments(psf.data)
    offset = tuple(map(float, ([x, y] - psf.origin) * psf.cell))
    if not np.hypot(*offset) < 0.5 * psf.half_width:
        wanted = "a PSF whose core stands near its center"
        raise argument_error(argument, wanted, f"a core at x, y = {x:.4g}, {y:.4g}")
    if np.hypot(*offset) <= tolerance:
        return psf, (0.0, 0.0)
    text = "'%s': the core stood (%.4f, %.4f) arcsec off the center and was brought there"
    _log.info(text, argument, *offset)
    return psf.replace(origin=(x, y)), offset
