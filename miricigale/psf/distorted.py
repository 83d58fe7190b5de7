"""PSFs of places on the imager's array as they are on the sky, without the distortion of the pixels."""

import numpy as np

from miricigale.psf import _core
from miricigale.psf.field import miri_psf_grid, psf_at
from miricigale.psf.kernel_field import KernelField
from miricigale.psf.kernels import MatchingKernel
from miricigale.psf.miri import MIRI_PIXEL_SCALE, local_pixel
from miricigale.utils.arrays import centered
from miricigale.utils.exceptions import argument_error
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE


@takes_other_keywords
def undistorted_psf(psf):
    """
    Return the PSF of a place on the imager's array, on square cells.

    PSFs with a position (`miri_psf`) are sampled by the pixel that the distortion makes there, a parallelogram.
    Templates that are put on an exposure through its coordinates need the same light on the sky.

    Parameters
    ----------
    psf : `InstrumentPSF`
        In the detector frame, with ``position`` and ``subarray``.

    Returns
    -------
    psf : `InstrumentPSF`
        In the detector frame, whose +y is then at the position angle of the ideal frame (PA_APER), on cells of
        the imager's mean pixel. The light that the old grid holds is kept; beyond it there is none.

    Raises
    ------
    ValueError
        If the PSF has no position or is in the frame of the sky.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import miri_psf, undistorted_psf
    >>> psf = miri_psf("F1500W", position=(1000, 1000), fov=4 * u.arcsec)
    >>> print(f"{psf.pixel_scale:.4f}, {undistorted_psf(psf).pixel_scale:.4f}")
    0.1099 arcsec, 0.1109 arcsec
    """
    if psf.frame != "detector" or psf.position is None:
        raise argument_error("psf", "one of a place in the detector frame", repr(psf.frame))
    pixel = local_pixel(*psf.position, subarray=psf.subarray or "FULL")
    n_cells = psf.n_cells
    cell = MIRI_PIXEL_SCALE.to_value(ANGLE) / n_cells
    ny, nx = psf.data.shape
    x = centered(nx) * cell
    y = (centered(ny) * cell)[:, None]
    inverse = np.linalg.inv(pixel) * n_cells
    column = inverse[0, 0] * x + inverse[0, 1] * y + psf.origin[0]
    row = inverse[1, 0] * x + inverse[1, 1] * y + psf.origin[1]
    # light per cell, whose area is another
    factor = cell**2 * abs(np.linalg.det(inverse))
    data = _core.interpolate(np.asarray(psf.data), column, row) * factor
    return psf.replace(data, pixel_scale=MIRI_PIXEL_SCALE, origin=None)


def imager_kernels(
    hi, filter, wcs, pa, *, pixel_scale, grid_angle, subarray="FULL", n_psfs=9, **options
):
    """
    Return the kernels to the PSF of one MIRI exposure, by place on its array.

    Parameters
    ----------
    hi : `~photutils.psf.ImagePSF`
        The sharp PSF, on the sky.
    filter : str
        One of the nine imaging filters.
    wcs : `~astropy.wcs.WCS`
        Coordinates of the exposure.
    pa : `~astropy.units.Quantity`
        Position angle of the detector's +y (PA_APER).
    pixel_scale, grid_angle : `~astropy.units.Quantity`
        Pixel and position angle of +y of the high-resolution image.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`.
    n_psfs : int, optional
        Number of places, a square number of at least 4.
    **options
        Those of `miri_psf`.

    Returns
    -------
    kernels : `KernelField`
        Linear between the places. The regularization is that of the first place in all.

    Raises
    ------
    KeyError
        If there is no such filter or sub-array.
    ValueError
        If ``n_psfs`` is no square number of at least 4, or the sharp PSF is the wider one.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.instrument import imager_wcs
    >>> from miricigale.psf import filter_psf, imager_kernels
    >>> form = {"pixel_scale": 0.06 * u.arcsec}
    >>> sharp = filter_psf("F160W", **form)
    >>> wcs = imager_wcs("53.1 -27.8", 35 * u.deg)
    >>> kernels = imager_kernels(
    ...     sharp, "F1500W", wcs, 39.84 * u.deg, n_psfs=4, **form,
    ...     grid_angle=0 * u.deg, fov=4 * u.arcsec, oversampling=2,
    ... )  # fmt: skip
    >>> len(kernels)
    4
    """
    grid = miri_psf_grid(filter, n_psfs=n_psfs, subarray=subarray, **options)
    places = np.asarray(grid.grid_xypos, float)
    kernels = []
    chosen = "auto"
    for x, y in places:
        wide = undistorted_psf(psf_at(grid, x, y))
        kernel = MatchingKernel.from_psfs(
            hi,
            wide,
            pixel_scale=pixel_scale,
            lo_angle=pa,
            grid_angle=grid_angle,
            regularization=chosen,
        )
        chosen = kernel.regularization
        kernels.append(kernel)
    return KernelField(kernels, wcs.pixel_to_world(*places.T).icrs)


def moved_kernels(kernels, old, new):
    """
    Return the kernels of one exposure for another one of the same roll: the same at the same pixels.

    ``old`` and ``new`` are the coordinates of the two exposures.
    """
    places = old.world_to_pixel(kernels.sky)
    return KernelField(kernels.kernels, new.pixel_to_world(*places).icrs, kernels.method)
