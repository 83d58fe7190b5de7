"""Aperture photometry in the manner of Source Extractor, to compare forced photometry with."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty
from photutils.aperture import ApertureStats, CircularAperture, PixelAperture, SkyAperture
from photutils.background import LocalBackground, SExtractorBackground
from photutils.segmentation import SourceCatalog

from miricigale.photometry.detection.detection import detect_sources
from miricigale.photometry.images.arrays import image_arrays, pixel_scale, sky_to_pixels
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.sep_tools import background as sep_background
from miricigale.utils.tables import described_table
from miricigale.utils.units import ANGLE, FNU, positive, scalar

#: The paper's PHOT_AUTOPARAMS: factor on the Kron radius, and least radius of the ellipse.
_KRON = (2.5, 3.5)

#: The paper's BACK_SIZE (pixels) and BACK_FILTERSIZE (boxes).
_BACKGROUND_BOX = 64
_BACKGROUND_FILTER = 6

#: Width (pixels) of the ring for the local background.
_RING = 40

#: Diameter of the circle (arcsec).
_DIAMETER = 1.86

#: Parts of a point source's light in the Kron ellipse and in the circle.
_AUTO_FRACTION = 0.94
_APERTURE_FRACTION = 0.8


@takes_other_keywords
def aperture_photometry(image, sky, diameter=None):
    """
    Sum light in circles, or in other apertures.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`, path-like or other (see `as_mosaic`)
        In units of surface brightness, with WCS.
    sky : `~astropy.coordinates.SkyCoord`, shape (n,), or `~photutils.aperture.Aperture`
        Positions of circles; or an aperture of photutils, on the sky or in pixels of the image.
    diameter : `~astropy.units.Quantity`, optional
        Of the circles.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``flux`` and ``flux_err`` (uJy; for noise that is not correlated: on a mosaic of the package's own to be
        multiplied by its ``meta["noise_correction"]``) and ``coverage``, the fraction of the aperture on usable
        pixels. NaN where that is zero.

    Raises
    ------
    ValueError
        If the diameter is not positive, positions are without one, or an aperture has one.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import aperture_photometry
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> table = aperture_photometry(image, sky, 0.6 * u.arcsec)
    >>> print(f"{table['flux'][0]:.2f} +- {table['flux_err'][0]:.2f}")
    1.58 uJy +- 0.05 uJy
    """
    arrays = image_arrays(as_mosaic(image), "image")
    if isinstance(sky, (PixelAperture, SkyAperture)):
        check_that(diameter is None, "diameter", "left out with an aperture", diameter)
        aperture = sky
        if isinstance(sky, SkyAperture):
            aperture = _on_pixels(sky, arrays.wcs)
        flux, flux_err, coverage = aperture_sums(arrays, aperture)
        shape = type(sky).__name__
    else:
        check_that(diameter is not None, "diameter", "given with positions", "None")
        size = positive(diameter, ANGLE, "diameter")
        xy = sky_to_pixels(sky, arrays.wcs)
        flux, flux_err, coverage = circle_sums(arrays, xy, size / 2 / pixel_scale(arrays.wcs))
        shape = f"a circle of {size:.4g} arcsec diameter"
    columns = {
        "flux": (flux * FNU, f"Light in {shape}"),
        "flux_err": (flux_err * FNU, "1-sigma error, if the noise is not correlated"),
        "coverage": (coverage, "Fraction of the aperture on usable pixels"),
    }
    return described_table(columns)


def _on_pixels(aperture, wcs):
    """
    Convert an aperture on the sky to pixels of an image.

    Position angles grow from north to east: clockwise in an image whose east is on the right. photutils (3.0.0)
    turns them counterclockwise in any image.
    """
    on_pixels = aperture.to_pixel(wcs)
    if not hasattr(aperture, "theta"):
        return on_pixels
    position = aperture.positions
    if not aperture.isscalar:
        position = position[0]
    angles = [0.0 * u.deg, 90.0 * u.deg, aperture.theta]
    beside = position.directional_offset_by(u.Quantity(angles), 1.0 * u.arcsec)
    north, east, along = sky_to_pixels(beside, wcs) - sky_to_pixels(position.reshape(1), wcs)
    east_is_left = north[0] * east[1] - north[1] * east[0] > 0
    if not east_is_left:
        on_pixels.theta = np.arctan2(along[1], along[0]) * u.rad
    return on_pixels


def circle_sums(arrays, xy, radius):
    """Sum flux (uJy), its error and the usable fraction in circles, exact in the pixels that they cut."""
    n = len(xy)
    if n == 0:
        return np.empty(0), np.empty(0), np.empty(0)
    return aperture_sums(arrays, CircularAperture(np.nan_to_num(xy, nan=-1e6), radius))


def aperture_sums(arrays, aperture):
    """Sum flux (uJy), its error and the usable fraction in apertures, exact in the pixels that they cut."""
    variance = np.where(arrays.usable, arrays.sigma, 0.0) ** 2

    def total(image):
        return np.atleast_1d(ApertureStats(image, aperture).sum)

    coverage = np.nan_to_num(total(arrays.usable.astype(float))) / aperture.area
    empty = coverage <= 0
    flux = np.where(empty, np.nan, total(arrays.flux))
    noise = np.where(empty, np.nan, total(variance))
    return flux, np.sqrt(noise), coverage


@takes_other_keywords
def source_extractor_photometry(
    image, *, preset="yang2021_miri", stated_on=0.06 * u.arcsec, weighted=True
):
    """
    Detect and measure on one image, blind, as Source Extractor does.

    Settings in pixels are those of the paper's images of 0.06 arcsec. On other pixels they are brought to the
    same sizes on the sky, and the threshold to the same surface brightness, so that a source has the same
    flux on any.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        In units of surface brightness, with WCS.
    preset : str or `DetectionPreset`, optional
        See `~miricigale.photometry.detect_sources`.
    stated_on : `~astropy.units.Quantity` or None, optional
        Pixel scale for which settings in pixels are meant; None for the image's own.
    weighted : bool, optional
        Whether the image's mask and errors count. Otherwise it is taken as by default in the program: pixels
        without data are 0, and the noise is one for all, the median rms of the background's boxes.

    Returns
    -------
    table : `~astropy.table.QTable`
        The detections, with ``flux_auto``, ``flux_auto_err``, ``flux_aper``, ``flux_aper_err`` as
        measured (Kron ellipses of PHOT_AUTOPARAMS 2.5, 3.5; circles of 1.86 arcsec), and ``flux_best``,
        ``flux_best_err``: the brighter of the two after each is divided by its part of a point source's light
        (0.94 and 0.8).

    References
    ----------
    Yang et al. 2021, ApJ 908, 144, appendix (the settings); Bertin & Arnouts 1996.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import source_extractor_photometry
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> table = source_extractor_photometry(image)
    >>> print(f"{len(table)} source, {table['flux_aper'][0]:.2f} in the circle")
    1 source, 2.28 uJy in the circle
    """
    arrays = image_arrays(image, "image")
    ratio = 1.0
    if stated_on is not None:
        ratio = scalar(stated_on, ANGLE, "stated_on") / pixel_scale(image.wcs)
    box = max(1, round(_BACKGROUND_BOX * ratio))
    empty = ~arrays.usable if weighted else None
    level, rms = sep_background(arrays.flux, empty, box, _BACKGROUND_FILTER)
    flux = arrays.flux - np.where(arrays.usable, level, 0.0)
    if not weighted:
        flux = arrays.flux - level
        sigma = np.full(flux.shape, np.median(rms[rms > 0]))
        arrays = dataclasses.replace(arrays, sigma=sigma, usable=sigma > 0)
    # detection on the image less its background
    data = np.where(arrays.usable, flux, np.nan)
    subtracted = CCDData(data, unit=FNU, uncertainty=StdDevUncertainty(arrays.sigma), wcs=image.wcs)
    segmentation, catalog = detect_sources(subtracted, preset=preset, stated_on=stated_on)
    values = [np.empty(0)] * 4
    if len(catalog):
        values = _measure(arrays, flux, segmentation, catalog, ratio)
    auto, auto_err, aper, aper_err = values
    # both brought to the total of a point source
    ellipse = np.stack([auto, auto_err]) / _AUTO_FRACTION
    circle = np.stack([aper, aper_err]) / _APERTURE_FRACTION
    best, best_err = np.where(np.nan_to_num(ellipse[0], nan=-np.inf) > circle[0], ellipse, circle)
    for name, flux, error, text in (
        ("flux_auto", auto, auto_err, "Light in the Kron ellipse"),
        ("flux_aper", aper, aper_err, "Light in the circle"),
        ("flux_best", best, best_err, "Brighter of the two after correction to total"),
    ):
        catalog[name] = flux * FNU
        catalog[f"{name}_err"] = error * FNU
        catalog[name].info.description = text
        catalog[f"{name}_err"].info.description = "1-sigma error, if the noise is not correlated"
    return catalog


def _measure(arrays, flux, segmentation, catalog, ratio):
    """Sum light and its errors (uJy) in Kron ellipses and circles, less the level of rings around them."""
    arrays = dataclasses.replace(
        arrays, flux=flux, sigma=np.where(arrays.usable, arrays.sigma, 0.0)
    )
    factor, min_radius = _KRON
    # Kron ellipses less the local background
    sources = SourceCatalog(
        flux,
        segmentation,
        error=arrays.sigma,
        mask=~arrays.usable,
        local_bkg_width=round(_RING * ratio),
        kron_params=(factor, min_radius / factor, 0.0),
    )
    auto = np.atleast_1d(sources.kron_flux)
    auto_err = np.atleast_1d(sources.kron_flux_err)
    radius = _DIAMETER / 2 / pixel_scale(arrays.wcs)
    xy = np.stack([catalog["x_centroid"], catalog["y_centroid"]], axis=-1)
    # circles, less the level of the ring
    aper, aper_err, coverage = circle_sums(arrays, xy, radius)
    # the mode, for faint sources within the rings raise the median
    mode = LocalBackground(radius, radius + _RING * ratio, bkg_estimator=SExtractorBackground())
    x, y = xy.T
    ring = np.nan_to_num(np.atleast_1d(mode(arrays.flux, x, y, mask=~arrays.usable)))
    return auto, auto_err, aper - ring * np.pi * radius**2 * coverage, aper_err
