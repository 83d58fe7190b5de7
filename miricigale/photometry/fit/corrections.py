"""Corrections from bright point sources: encircled energy, scale, apertures."""

import astropy.units as u
import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable

from miricigale.photometry.fit.aperture import circle_sums
from miricigale.photometry.images.arrays import image_arrays, sky_to_pixels
from miricigale.photometry.images.arrays import pixel_scale as image_scale
from miricigale.psf import encircled_energy, radius_of_encircled_energy
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE, FNU, to_array


@takes_other_keywords
def encircled_flux(image, sky, flux, radii):
    """
    Measure the light of point sources within radii, over their true flux.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        In units of surface brightness, background subtracted, with WCS.
    sky : `~astropy.coordinates.SkyCoord`, shape (n,)
        Positions of isolated point sources.
    flux : `~astropy.units.Quantity`, shape (n,)
        Their true fluxes.
    radii : `~astropy.units.Quantity`, shape (m,)
        Radii.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each radius: ``radius``, ``median``, ``scatter`` (1.4826 times the median
        absolute deviation) and ``values``, shape (m, n), NaN for apertures that touch
        pixels without data.

    References
    ----------
    Yang et al. 2021, ApJ 908, 144, section 3.2 (EEF_PT).

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import encircled_flux
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> table = encircled_flux(image, sky, [2] * u.uJy, [0.2, 0.4] * u.arcsec)
    >>> table["median"].round(2)
    array([0.49, 0.95])
    """
    arrays = image_arrays(image, "image")
    true = to_array(flux, FNU, "flux", ndim=1)
    if len(true) != len(sky):
        raise argument_error("flux", f"{len(sky)} fluxes, one for each position", len(true))
    check_that(len(true) > 0, "flux", "positive fluxes", "none")
    check_that(np.all(true > 0), "flux", "positive fluxes", true.min())
    radius = np.atleast_1d(to_array(radii, ANGLE, "radii"))
    scale = image_scale(image.wcs)
    xy = sky_to_pixels(sky, arrays.wcs)
    values = np.empty((len(radius), len(true)))
    for k, r in enumerate(radius):
        # light in circles that are on usable pixels alone
        inside, _, coverage = circle_sums(arrays, xy, r / scale)
        values[k] = np.where(coverage > 0.999, inside / true, np.nan)
    if not np.isfinite(values).any(axis=1).all():
        raise argument_error("sky", "positions whose apertures are on the image", "none")
    median = np.nanmedian(values, axis=1)
    # robust against neighbors
    scatter = mad_std(values, axis=1, ignore_nan=True)
    return QTable(
        {"radius": radius * ANGLE, "median": median, "scatter": scatter, "values": values}
    )


@takes_other_keywords
def flux_scaling(image, sky, flux, psf):
    """
    Calculate the factor by which an image is multiplied to have the true flux scale.

    Parameters
    ----------
    image, sky, flux
        As in `encircled_flux`.
    psf : `~photutils.psf.ImagePSF`
        PSF of the image, which must include all that its pixels do.

    Returns
    -------
    factor, error : float
        The PSF's part of the light over the median measured one, and the error of that from the
        scatter of the sources.

    Notes
    -----
    The PSF holds the response of a pixel, and a sum over an image's pixels spreads each over its
    square once more. At the radius of 80 % of the light, where the two are compared, that sum is therefore
    a little below it (0.3 % at F770W), which goes into the factor.

    References
    ----------
    Yang et al. 2021, ApJ 908, 144, section 3.2 (f_scaling).

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import flux_scaling
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> factor, error = flux_scaling(image, sky, [2] * u.uJy, psf)
    >>> print(f"{factor:.2f}")
    0.99
    """
    radius = radius_of_encircled_energy(psf, 0.8)
    table = encircled_flux(image, sky, flux, u.Quantity([radius]))
    n = int(np.isfinite(table["values"][0]).sum())
    # what the PSF's pixels would add up to
    expected = encircled_energy(psf, radius, pixel_scale=image_scale(image.wcs) * ANGLE)
    factor = expected / float(table["median"][0])
    # the error of a median is 1.2533 times that of a mean
    error = factor * 1.2533 * float(table["scatter"][0] / table["median"][0]) / np.sqrt(n)
    return factor, error


@takes_other_keywords
def aperture_correction(psf, radius, *, pixel_scale=None):
    """
    Calculate the factor from light in a circle to total light, for a point source.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF`
        PSF of the image.
    radius : `~astropy.units.Quantity`
        Of the circle.
    pixel_scale : `~astropy.units.Quantity`, optional
        If given, the light is a sum over an image of such pixels (see
        `~miricigale.psf.encircled_energy`).

    Returns
    -------
    factor : float or `~numpy.ndarray`
        1 / (encircled energy).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.photometry import aperture_correction
    >>> from miricigale.psf import miri_psf
    >>> psf = miri_psf("F1500W", fov=6 * u.arcsec)
    >>> aperture_correction(psf, [0.5, 1.0] * u.arcsec).round(3)
    array([1.469, 1.223])
    """
    energy = np.asarray(encircled_energy(psf, radius, pixel_scale=pixel_scale), float)
    check_that(not np.any(energy <= 0), "radius", "positive", radius)
    factor = 1.0 / energy
    return float(factor) if factor.ndim == 0 else factor
