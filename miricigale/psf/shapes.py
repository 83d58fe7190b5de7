"""PSFs of a simple round shape."""

import math

import numpy as np

from miricigale.psf.model import make_psf
from miricigale.psf.telescope import odd_cells
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import ANGLE, to_array


def _round_psf(profile, pixel_scale, oversampling, fov):
    scale = float(to_array(pixel_scale, ANGLE, "pixel_scale"))
    width = float(to_array(fov, ANGLE, "fov"))
    cell = scale / oversampling
    n = odd_cells(width, cell)
    axis = (np.arange(n) - n // 2) * cell
    return make_psf(
        profile(np.hypot(axis, axis[:, None])) * scale**2,
        pixel_scale=pixel_scale,
        oversampling=oversampling,
        frame="sky",
        total_known=True,
    )


def gaussian_psf(fwhm, *, pixel_scale, oversampling=4, fov):
    """
    A round Gaussian.

    Parameters
    ----------
    fwhm, pixel_scale, fov : `~astropy.units.Quantity`
        Width, pixel and width of the grid.
    oversampling : int, optional
        Cells per pixel.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        Of the surface brightness (no pixel response); sky frame, where it has no angle.
    """
    sigma = float(to_array(fwhm, ANGLE, "fwhm")) / math.sqrt(8 * math.log(2))

    def profile(r):
        return np.exp(-0.5 * (r / sigma) ** 2) / (2 * math.pi * sigma**2)

    return _round_psf(profile, pixel_scale, oversampling, fov)


def moffat_psf(fwhm, *, beta=3.0, pixel_scale, oversampling=4, fov):
    """
    A round Moffat profile, for ground-based images.

    Parameters
    ----------
    fwhm, pixel_scale, fov : `~astropy.units.Quantity`
        Width, pixel and width of the grid.
    beta : float, optional
        Exponent of the wings, above 1.
    oversampling : int, optional
        Cells per pixel.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        As `gaussian_psf`.

    Raises
    ------
    ValueError
        If ``beta`` is not above 1 (the light would be infinite).

    References
    ----------
    Moffat 1969, A&A 3, 455.
    """
    if not beta > 1:
        raise argument_error("beta", "above 1", beta)
    core = float(to_array(fwhm, ANGLE, "fwhm")) / (2 * math.sqrt(2 ** (1 / beta) - 1))

    def profile(r):
        return (beta - 1) / (math.pi * core**2) * (1 + (r / core) ** 2) ** -beta

    return _round_psf(profile, pixel_scale, oversampling, fov)
