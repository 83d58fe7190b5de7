"""The errors of an image: the noise of its pixels, how it is correlated, and limits of apertures and points."""

import astropy.units as u
import numpy as np
import scipy.ndimage
from astropy.nddata import CCDData
from astropy.stats import mad_std
from astropy.table import QTable
from photutils.aperture import CircularAperture
from scipy.signal import fftconvolve

from miricigale.instrument.image import Image
from miricigale.instrument.image_files import write_image
from miricigale.photometry.images.arrays import image_arrays, pixel_scale
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.photometry.images.sky_noise import sky_noise
from miricigale.photometry.templates.normal_equations import noise_correlation
from miricigale.psf import psf_image
from miricigale.utils.arrays import nans
from miricigale.utils.meta import provenance
from miricigale.utils.options import check_positive
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import column_texts
from miricigale.utils.random import check_seed
from miricigale.utils.tables import described_columns
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS, to_array
from miricigale.utils.values import value_class

#: Largest number of empty positions, and arcsec to the edge of a PSF that is fitted.
_EMPTY = 2000
_REACH = 2.0


@value_class
class ImageErrors:
    """
    The errors of an image; made by `image_errors`.

    Attributes
    ----------
    noise : `~astropy.nddata.CCDData`
        Noise of each pixel (1 sigma), MJy/sr.
    correlation : `~numpy.ndarray`, shape (2 m + 1, 2 m + 1)
        Covariance of the noise of pixels by separation, in units of their stated variance.
    table : `~astropy.table.QTable`
        A row for each aperture, and one for a point that is fitted: ``aperture``, ``error``, ``stated``,
        ``factor``, ``limit``, ``limit_mag``, ``enclosed``, ``scatter`` and ``n_empty``.
    limits : dict of str to `~astropy.units.Quantity`, shape (ny, nx)
        Maps of the limits in uJy, by ``aperture``: NaN without data.
    n_free : int
        Number of source-free pixels on which the noise was measured.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import image_errors
    >>> wcs = north_up_wcs(SkyCoord(53.1, -27.8, unit="deg"), 0.1 * u.arcsec, (300, 300))
    >>> noise = np.random.default_rng(1).normal(0, 1, (300, 300))
    >>> errors = image_errors(CCDData(noise, unit="MJy / sr", wcs=wcs), seed=1)
    >>> errors
    <ImageErrors of 0.5, 1>
    >>> errors.limits["0.5"].shape
    (300, 300)
    """

    noise: CCDData
    correlation: np.ndarray
    table: QTable
    limits: dict
    n_free: int

    def __repr__(self):
        return f"<ImageErrors of {', '.join(self.table['aperture'])}>"

    @property
    def factor(self):
        """How much noisier sums over many pixels are than for noise that is not correlated."""
        m = len(self.correlation) // 2
        return float(np.sqrt(max(self.correlation.sum(), 0.0) / self.correlation[m, m]))

    def write(self, path, *, overwrite=False):
        """
        Write the maps to a FITS file: SCI (the noise), ``LIMIT_<aperture>`` (uJy) and CORRELATION.

        Parameters
        ----------
        path : path-like
            The file.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Raises
        ------
        OSError
            If the file exists and ``overwrite`` is False.
        """
        planes = {}
        for name, limit in self.limits.items():
            planes[f"limit_{name}"] = limit.to_value(FNU).astype(np.float32)
        planes["correlation"] = self.correlation
        write_image(self.noise, path, planes=planes, overwrite=overwrite)


@takes_other_keywords
def image_errors(image, *, diameters=(0.5, 1.0) * u.arcsec, psf=None, n_sigma=5.0, seed=None):
    """
    Measure the errors of fluxes on an image, with the correlation of its noise.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`, path-like or other (see `as_mosaic`)
        In units of surface brightness or of the flux in a pixel, with WCS.
    diameters : `~astropy.units.Quantity`, shape (n,), optional
        Of the apertures.
    psf : `~photutils.psf.ImagePSF`, optional
        PSF of the image: errors of points that are fitted too.
    n_sigma : float, optional
        Errors that a limit has.
    seed : int or `~numpy.random.Generator`, optional
        Of the empty positions, at which the errors are tested.

    Returns
    -------
    errors : `ImageErrors`

    Raises
    ------
    ValueError, TypeError, `~astropy.units.UnitsError`
        If an input does not fit, or fewer than 100 pixels are free of sources.

    Notes
    -----
    The covariance of pixels is measured on source-free pixels, over their stated errors, up to a separation of 8
    pixels. The variance of a weighted sum of pixels is that of the weights with it, each pixel with its own stated
    error; pixels without data count as those around.

    References
    ----------
    Labbe et al. 2003, AJ 125, 1107, sec. 4.2 (empty apertures); Fruchter & Hook 2002, PASP 114, 144, sec. 7.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import image_errors
    >>> wcs = north_up_wcs(SkyCoord(53.1, -27.8, unit="deg"), 0.1 * u.arcsec, (300, 300))
    >>> noise = np.random.default_rng(1).normal(0, 1, (300, 300))
    >>> errors = image_errors(CCDData(noise, unit="MJy / sr", wcs=wcs), seed=1)
    >>> errors.table["factor"].round(1).tolist()
    [1.0, 1.0]
    """
    image = as_mosaic(image, "image")
    arrays = image_arrays(image, "image")
    rng = np.random.default_rng(check_seed(seed))
    check_positive(n_sigma, "n_sigma")
    scale = pixel_scale(arrays.wcs)
    usable = arrays.usable
    is_free = sky_noise(arrays.flux / arrays.sigma, usable, significance=4.0)[2]
    # the sky that is left
    level = np.median((arrays.flux / arrays.area)[is_free])
    flux = np.where(usable, arrays.flux - level * arrays.area, 0.0)
    correlation = noise_correlation(flux, is_free, 1 / arrays.sigma)
    m = len(correlation) // 2
    variance = np.where(usable, arrays.sigma, 0.0) ** 2
    # pixels beyond the image are not free
    distance = scipy.ndimage.distance_transform_edt(np.pad(is_free, 1))[1:-1, 1:-1]
    rows = []
    limits = {}
    for name, (weight, reach, inside) in _weights(diameters, psf, scale).items():
        square = weight**2
        ny, nx = weight.shape
        # variance of the weighted sum, for the measured covariance of pixels and for independent pixels
        spread = weight * fftconvolve(weight, correlation)[m : m + ny, m : m + nx]
        factor = np.sqrt(spread.sum() / square.sum())
        # pixels without data count as those around
        stated_error = fftconvolve(variance, square, "same")
        stated_error *= square.sum() / np.maximum(
            fftconvolve(usable.astype(float), square, "same"), 1e-9
        )
        stated_error = np.sqrt(np.where(usable, stated_error, np.nan))
        error = factor * np.nanmedian(stated_error) * FNU
        limits[name] = n_sigma * factor * stated_error * FNU
        # test: scatter of sums at empty places in units of these errors
        at = np.argwhere(usable & (distance > reach + 1))
        at = tuple(at[rng.permutation(len(at))[:_EMPTY]].T)
        pulls = fftconvolve(flux, weight[::-1, ::-1], "same")[at] / (factor * stated_error[at])
        limit = n_sigma * error
        scatter = np.nan
        if pulls.size > 1:
            scatter = mad_std(pulls)
        rows.append(
            {
                "aperture": name,
                "error": error,
                "stated": error / factor,
                "factor": factor,
                "limit": limit,
                "limit_mag": limit.to_value(u.ABmag),
                "enclosed": inside,
                "scatter": scatter,
                "n_empty": pulls.size,
            }
        )
    over = float(np.sqrt(correlation[m, m]))
    facts = {k: image.meta[k] for k in ("filter", "source", "noise") if k in image.meta}
    meta = provenance(n_sigma=n_sigma, noise_over_stated=round(over, 4), **facts)
    texts = column_texts("miricigale.photometry", "errors")
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    table = described_columns(columns, texts, meta)
    # errors scaled to the measured noise, as surface brightness
    noise = np.where(usable, arrays.sigma / arrays.area * over, np.nan)
    noise = Image(noise, unit=SURFACE_BRIGHTNESS, wcs=arrays.wcs, meta=facts)
    return ImageErrors(noise, correlation, table, limits, int(np.count_nonzero(is_free)))


def _weights(diameters, psf, scale):
    """Return for each aperture, and a point, weights of pixels, reach (pixels), and the light of a point in it."""
    radii = to_array(diameters, ANGLE, "diameters", ndim=1) / 2 / scale
    check_positive(float(min(radii, default=1.0)), "diameters")
    reach = max(radii, default=0)
    if psf is not None:
        reach = max(reach, _REACH / scale)
    half = int(np.ceil(reach))
    shape = (2 * half + 1,) * 2
    apertures = {}
    light = nans(shape)
    if psf is not None:
        light = psf_image(psf, pixel_scale=scale * ANGLE, shape=shape[0])
        apertures["psf"] = light / np.sum(light**2), psf.fwhm.to_value(ANGLE) / scale, 1.0
    for radius in radii:
        weight = CircularAperture((half, half), radius).to_mask(method="exact").to_image(shape)
        apertures[f"{2 * radius * scale:.3g}"] = weight, radius, float(np.sum(weight * light))
    return apertures
