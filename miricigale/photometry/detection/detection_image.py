"""One image of several bands, in which sources of any color are detected."""

import numpy as np
from astropy.nddata import StdDevUncertainty
from scipy.special import gammaln

from miricigale.instrument.image import Image
from miricigale.photometry.images.arrays import image_arrays, same_grid
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.photometry.images.sky_noise import sky_noise
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import SURFACE_BRIGHTNESS


@takes_other_keywords
def chi_image(images):
    """
    Add images of several bands up to one in which sources of any color are detected.

    Parameters
    ----------
    images : iterable of `~astropy.nddata.CCDData`, path-like or other (see `as_mosaic`)
        On the same pixels, best of the same resolution. Of each the sky is subtracted and the noise measured, on
        source-free pixels.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        Root of the sum of squares of the pixels over their noise, less its mean on empty sky, in MJy/sr: times
        the noise of the first image. The uncertainty is the standard deviation on empty sky. A pixel has as many
        bands as have data there; without any it is masked. Its segments are those of sources, its values are no
        fluxes.

    Raises
    ------
    ValueError
        If there is no image, or they are not on the same pixels.

    Notes
    -----
    On empty sky with Gaussian noise the root follows the chi distribution with as many degrees of freedom as there
    are bands.

    References
    ----------
    Szalay, Connolly & Szokoly 1999, AJ 117, 68.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import chi_image
    >>> sky = SkyCoord(53.1, -27.8, unit="deg")
    >>> wcs = north_up_wcs(sky, 0.1 * u.arcsec, (200, 200))
    >>> noise = np.random.default_rng(1).normal(0, 1, (3, 200, 200))
    >>> chi = chi_image([CCDData(one, unit="MJy / sr", wcs=wcs) for one in noise])
    >>> (chi.data / chi.uncertainty.array).std().round(2)
    np.float64(1.0)
    """
    images = [as_mosaic(image, "images") for image in images]
    arrays = [image_arrays(image, "images") for image in images]
    wanted = "at least one, all on the same pixels"
    got = f"{len(arrays)} images"
    check_that(arrays, "images", wanted, got)
    first = arrays[0]
    square = np.zeros(first.flux.shape)
    n = np.zeros(first.flux.shape)
    for band in arrays:
        alike = band.flux.shape == first.flux.shape and same_grid(band.wcs, first.wcs)
        check_that(alike, "images", wanted, got)
        # deviations from the sky in units of the noise of source-free pixels
        values = band.flux / band.sigma
        level, rms, _ = sky_noise(values, band.usable)
        square += np.where(band.usable, (values - level) / rms, 0.0) ** 2
        n += band.usable
    sigma = np.where(first.usable, first.sigma / first.area, np.nan)
    sigma = np.where(np.isfinite(sigma), sigma, np.nanmedian(sigma))
    # mean of the chi distribution
    mean = np.sqrt(2.0) * np.exp(gammaln((n + 1) / 2) - gammaln(np.maximum(n, 1) / 2))
    spread = np.where(n > 0, np.sqrt(np.maximum(n - mean**2, 0)), np.nan)
    return Image(
        (np.sqrt(square) - mean) * sigma,
        unit=SURFACE_BRIGHTNESS,
        wcs=first.wcs,
        mask=n == 0,
        uncertainty=StdDevUncertainty(spread * sigma),
        meta={"bands": [image.meta.get("filter") for image in images]},
    )
