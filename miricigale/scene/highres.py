"""The high-resolution image that positions and templates come from, with its noise."""

import math

import astropy.units as u
import numpy as np
from astropy.nddata import StdDevUncertainty

from miricigale.instrument import pixel_area_map
from miricigale.scene.scene import Scene
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.random import check_seed, stream
from miricigale.utils.units import positive

#: Depth of the CANDELS wide fields in F160W, and the aperture and significance that it is for.
_DEPTH = 27.6 * u.ABmag
_APERTURE = 0.2 * u.arcsec
_N_SIGMA = 5


@takes_other_keywords
def depth_to_rms(depth, *, pixel_area):
    """
    Return the noise of a pixel that belongs to a depth in an aperture of 0.2" in radius.

    Parameters
    ----------
    depth : `~astropy.units.Quantity`
        AB magnitude (``u.ABmag``) or flux of 5 sigma in the aperture, without
        correction for the light outside it.
    pixel_area : array-like
        Solid angle of the pixels in sr.

    Returns
    -------
    rms : `~numpy.ndarray` or float
        Standard deviation in MJy/sr of noise without correlation between pixels.

    Raises
    ------
    ValueError
        If the depth is not positive.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.scene import depth_to_rms
    >>> area = (0.06 * u.arcsec) ** 2
    >>> round(float(depth_to_rms(27.6 * u.ABmag, pixel_area=area.to_value(u.sr))), 5)
    0.01325
    """
    # magnitudes become fluxes
    flux = depth
    if isinstance(depth, u.Magnitude):
        flux = depth.to(u.uJy)
    limit = positive(flux, u.uJy, "depth")
    pixel_area = floats(pixel_area)
    n_pixels = math.pi * _APERTURE.to_value(u.rad) ** 2 / pixel_area
    return (1e-12 * limit / _N_SIGMA / np.sqrt(n_pixels) / pixel_area)[()]


@takes_other_keywords
def highres_image(
    catalog, *, filter="wfc3.f160w", wcs, psf, depth=_DEPTH, seed=None, noise=None, **options
):
    """
    Return a high-resolution image with Gaussian noise.

    Parameters
    ----------
    catalog, filter, wcs, psf
        As of `~miricigale.scene.Scene`; the WCS is meant to be north-up with 0.06" pixels.
    depth : `~astropy.units.Quantity`, optional
        5-sigma depth in an aperture of 0.2" (see `depth_to_rms`); 27.6 AB by default, that of the
        CANDELS wide fields in F160W.
    seed : int, `~numpy.random.Generator` or None, optional
        Seed of the noise; its stream depends on the filter only, not on the sources.
    noise : `~numpy.ndarray`, optional
        Standard normal numbers of the pixels, in place of those of ``seed``: a part of a larger image.
    **options
        Passed to `~miricigale.scene.Scene` (such as ``enclosed`` or ``background``).

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        MJy/sr with `~astropy.nddata.StdDevUncertainty`.

    References
    ----------
    Stefanon et al. 2017, ApJS 229, 32 (depth of the CANDELS/EGS F160W image).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.psf import filter_psf
    >>> from miricigale.scene import highres_image, read_catalog
    >>> catalog = read_catalog("catalog.goodss")
    >>> wcs = north_up_wcs(catalog["sky"][600], 0.06 * u.arcsec, (100, 100))
    >>> psf = filter_psf("wfc3.f160w", pixel_scale=0.06 * u.arcsec, pa=0 * u.deg)
    >>> image = highres_image(catalog, wcs=wcs, psf=psf, depth=27.6 * u.ABmag, seed=1)
    >>> print(image.shape, image.unit)
    (100, 100) MJy / sr
    """
    scene = Scene(catalog, filter=filter, wcs=wcs, psf=psf, **options)
    image = scene.render()
    sigma = depth_to_rms(depth, pixel_area=pixel_area_map(wcs, image.shape))
    seed = check_seed(seed)
    if noise is None:
        noise = stream(seed, "highres", scene.filter).standard_normal(image.shape)
    noise = floats(noise)
    wanted = f"{image.shape} finite numbers"
    check_that(noise.shape == image.shape, "noise", wanted, f"shape {noise.shape}")
    n_missing = np.count_nonzero(~np.isfinite(noise))
    check_that(n_missing == 0, "noise", wanted, f"{n_missing} that are masked or not finite")
    image.data += noise * sigma
    image.uncertainty = StdDevUncertainty(sigma)
    image.meta |= {"seed": seed, "depth": str(depth), "aperture_radius": float(_APERTURE.value)}
    return image
