"""PSFs of WFC3/IR mosaics."""

import math

import astropy.units as u
import numpy as np
from scipy.optimize import brentq

from miricigale.filters.band_names import known_filter
from miricigale.psf import _core
from miricigale.psf.effects import detector_response
from miricigale.psf.model import make_psf
from miricigale.psf.optics import hst_pupil, polychromatic_psf
from miricigale.psf.telescope import band_quantiles, checked_grid, odd_cells
from miricigale.utils.caching import cached
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE, scalar

WFC3_FILTERS = ("wfc3.f105w", "wfc3.f125w", "wfc3.f140w", "wfc3.f160w")

#: Width of the WFC3/IR pixel in arcsec and of the drop relative to it in the mosaics.
_WFC3_PIXEL = 0.128
_WFC3_PIXFRAC = 0.8

#: FWHM of the mosaics' PSF at F160W in arcsec.
_WFC3_FWHM = 0.20


@cached(maxsize=8)
def _hst_optics(name, cell, n, angle):
    pupil = hst_pupil(angle=angle)
    flat = np.zeros((pupil.n, pupil.n))
    data = polychromatic_psf(pupil, flat, band_quantiles(name), step=cell, n=n)
    data.flags.writeable = False
    return data


def _hst_blurred(data, oversampling, scale, sigma):
    boxes = (_WFC3_PIXEL / scale, _WFC3_PIXEL * _WFC3_PIXFRAC / scale)
    return detector_response(data, oversampling=oversampling, boxes=boxes, jitter=sigma / scale)


@cached(maxsize=16)
def _hst_blur(scale):
    """Return the Gaussian sigma in arcsec with which the mosaic's PSF has its width at F160W."""
    oversampling = max(1, math.ceil(scale / 0.015))
    cell = scale / oversampling
    middle = odd_cells(2.4, cell) // 2
    data = _hst_optics("wfc3.f160w", cell, 2 * middle + 1, 45.0)

    def excess(sigma):
        image = _hst_blurred(data, oversampling, scale, sigma)
        return _core.half_maximum_width(image, middle, middle) * cell - _WFC3_FWHM

    wanted = f"so fine that optics and pixels are narrower than {_WFC3_FWHM} arcsec (FWHM)"
    check_that(excess(0.0) <= 0, "pixel_scale", wanted, f"{scale} arcsec")
    return brentq(excess, 0.0, _WFC3_FWHM, xtol=1e-5)


@takes_other_keywords
def hst_psf(
    filter="wfc3.f160w", *, pixel_scale=0.06 * u.arcsec, oversampling=4, fov=None, angle=0.0 * u.deg
):
    """
    Return the PSF of a north-up WFC3/IR mosaic.

    The annular pupil with its vanes over the band, the detector's pixel (0.128 arcsec),
    the drop (0.8 of it), the mosaic's pixel, and a Gaussian for all else (interpixel
    capacitance, jitter, registration), so wide that the FWHM at F160W is 0.20 arcsec. Other filters
    have the same blur.

    Parameters
    ----------
    filter : str or `~miricigale.filters.Filter`, optional
        A WFC3/IR filter.
    pixel_scale : `~astropy.units.Quantity`, optional
        Pixel of the mosaic.
    oversampling : int, optional
        Cells per mosaic pixel.
    fov : `~astropy.units.Quantity`, optional
        Width of the grid; 10 arcsec by default.
    angle : `~astropy.units.Quantity`, optional
        Position angle of the telescope's +y; the vanes are at 45 deg to it.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        In the sky frame, normalized as `miri_psf`.

    Raises
    ------
    KeyError
        If there is no such filter.
    ValueError
        If the pixel is so coarse that the PSF is wider.

    References
    ----------
    Krist, Hook & Stoehr 2011, SPIE 8127, 81270J; Skelton et al. 2014, ApJS 214, 24
    (mosaics of 0.06 arcsec pixels).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import hst_psf
    >>> psf = hst_psf("F160W", fov=4 * u.arcsec)
    >>> print(f"{psf.fwhm:.3f}")
    0.200 arcsec
    """
    name = known_filter(filter, WFC3_FILTERS, "PSF for the filter")
    oversampling, width = checked_grid(oversampling, fov, 10.0)
    scale = scalar(pixel_scale, ANGLE, "pixel_scale")
    sigma = _hst_blur(scale)
    cell = scale / oversampling
    # vanes at 45 deg to +y; on the sky an angle east of north is counter-clockwise
    turn = scalar(angle, u.deg, "angle")
    data = _hst_optics(name, cell, odd_cells(width, cell), (45.0 + turn) % 360.0)
    data = _hst_blurred(data, oversampling, scale, sigma) * oversampling**2
    form = {
        "pixel_scale": pixel_scale,
        "oversampling": oversampling,
        "frame": "sky",
        "filter": name,
    }
    meta = {"instrument": "WFC3/IR", "blur": sigma}
    effects = "pixel", "ipc", "jitter", "drizzle"
    return make_psf(data, includes=effects, total_known=True, meta=meta, **form)
