"""The high-resolution image that positions and templates come from, with its noise."""

import math

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty

from miricigale.instrument import pixel_area_map
from miricigale.scene.scene import Scene
from miricigale.utils.exceptions import argument_error
from miricigale.utils.random import check_seed, stream
from miricigale.utils.units import ANGLE, SURFACE_BRIGHTNESS, positive, to_array

__all__ = ["depth_to_rms", "highres_image"]

#: Of the CANDELS wide fields in F160W.
_DEPTH = 27.6 * u.ABmag


def depth_to_rms(depth, *, pixel_area, aperture_radius=0.2 * u.arcsec, n_sigma=5):
    """
    Noise of a pixel that belongs to a depth.

    Parameters
    ----------
    depth : `~astropy.units.Quantity`
        AB magnitude (``u.ABmag``) or flux of ``n_sigma`` in the aperture, without
        correction for the light outside it.
    pixel_area : array-like
        Solid angle of the pixels in sr.
    aperture_radius : `~astropy.units.Quantity`, optional
        Radius of the aperture.
    n_sigma : float, optional
        How many sigma the depth is.

    Returns
    -------
    rms : `~numpy.ndarray` or float
        Standard deviation in MJy/sr of noise without correlation between pixels.

    Raises
    ------
    ValueError
        If the depth, the aperture or ``n_sigma`` is not positive.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.scene import depth_to_rms
    >>> area = (0.06 * u.arcsec) ** 2
    >>> round(float(depth_to_rms(27.6 * u.ABmag, pixel_area=area.to_value(u.sr))), 5)
    0.01325
    """
    # magnitudes become fluxes
    flux = depth.to(u.uJy) if isinstance(depth, u.Magnitude) else depth
    limit = positive(flux, u.uJy, "depth")
    radius = positive(aperture_radius, u.rad, "aperture_radius")
    if not (np.isfinite(n_sigma) and n_sigma > 0):
        raise argument_error("n_sigma", "positive", n_sigma)
    pixel_area = np.asarray(pixel_area, dtype=float)
    n_pixels = math.pi * radius**2 / pixel_area
    return (1e-12 * limit / n_sigma / np.sqrt(n_pixels) / pixel_area)[()]


def highres_image(
    catalog,
    *,
    filter="wfc3.f160w",
    wcs,
    psf,
    depth=None,
    aperture_radius=0.2 * u.arcsec,
    rms=None,
    seed=None,
    **options,
):
    """
    A high-resolution image with Gaussian noise.

    Parameters
    ----------
    catalog, filter, wcs, psf
        As of `~miricigale.scene.Scene`; the WCS is meant to be north-up with 0.06" pixels.
    depth : `~astropy.units.Quantity`, optional
        5-sigma depth of a point-like aperture (see `depth_to_rms`). Without it and ``rms``
        it is 27.6 AB, that of the CANDELS wide fields in F160W.
    aperture_radius : `~astropy.units.Quantity`, optional
        Aperture that the depth is for.
    rms : `~astropy.units.Quantity`, optional
        Noise of the pixels instead of a depth: one value or a map.
    seed : int, `~numpy.random.Generator` or None, optional
        Seed of the noise; its stream depends on the filter only, not on the sources.
    **options
        Passed to `~miricigale.scene.Scene` (such as ``enclosed`` or ``background``).

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        MJy/sr with `~astropy.nddata.StdDevUncertainty`.

    Raises
    ------
    ValueError
        If the map of the noise has another shape or a negative value, or a depth is given
        besides it.

    References
    ----------
    Stefanon et al. 2017, ApJS 229, 32 (depth of the CANDELS/EGS F160W image).
    """
    if rms is None:
        depth = _DEPTH if depth is None else depth
    elif depth is not None:
        raise argument_error("rms", "left out where there is a depth", "both")
    scene = Scene(catalog, filter=filter, wcs=wcs, psf=psf, **options)
    image = scene.render()
    if rms is None:
        area = pixel_area_map(wcs, image.shape)
        sigma = depth_to_rms(depth, pixel_area=area, aperture_radius=aperture_radius)
    else:
        sigma = to_array(rms, SURFACE_BRIGHTNESS, "rms", finite=True)
        if sigma.ndim and sigma.shape != image.shape:
            raise argument_error("rms", f"one value or a map of shape {image.shape}", sigma.shape)
        if np.any(sigma < 0):
            raise argument_error("rms", "not negative", float(sigma.min()))
        sigma = np.broadcast_to(sigma, image.shape)
    seed = check_seed(seed)
    noise = stream(seed, "highres", scene.filter).standard_normal(image.shape)
    meta = {**image.meta, "seed": seed}
    if rms is None:
        meta["depth"] = str(depth)
        meta["aperture_radius"] = float(to_array(aperture_radius, ANGLE, "aperture_radius"))
    return CCDData(
        image.data + noise * sigma,
        unit=SURFACE_BRIGHTNESS,
        wcs=wcs,
        uncertainty=StdDevUncertainty(np.array(sigma)),
        meta=meta,
    )
