"""PSFs of a round Gaussian."""

import math

import numpy as np

from miricigale.psf.model import make_psf
from miricigale.psf.telescope import odd_cells
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE, scalar


@takes_other_keywords
def gaussian_psf(fwhm, *, pixel_scale, oversampling=4, fov):
    """
    Return a round Gaussian.

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

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import gaussian_psf
    >>> psf = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> print(f"{psf.fwhm:.3f}, {psf.data.shape}")
    0.300 arcsec, (161, 161)
    """
    sigma = scalar(fwhm, ANGLE, "fwhm") / math.sqrt(8 * math.log(2))
    scale = scalar(pixel_scale, ANGLE, "pixel_scale")
    cell = scale / oversampling
    n = odd_cells(scalar(fov, ANGLE, "fov"), cell)
    axis = (np.arange(n) - n // 2) * cell
    r = np.hypot(axis, axis[:, None])
    profile = np.exp(-0.5 * (r / sigma) ** 2) / (2 * math.pi * sigma**2)
    return make_psf(
        profile * scale**2,
        pixel_scale=pixel_scale,
        oversampling=oversampling,
        frame="sky",
        total_known=True,
    )
