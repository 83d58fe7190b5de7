"""Scatter of pixels over their light, as resampling causes it, on mosaics whose truth is known."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from scipy.special import erf

from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import ForcedFlags, ForcedPhotometer
from miricigale.psf import make_psf
from miricigale.reduction import drizzle_images

CENTER = SkyCoord(53.0, -27.0, unit="deg")
PIXEL, FINE, FWHM = 0.11, 0.02, 0.24
TURN = np.radians(20.0)
SIGMA = 0.02
N_STARS = 25


def stars(rng):
    """Twenty-five stars with a signal-to-noise of 200 to 1000, on a grid."""
    grid = np.linspace(-5, 5, 5)
    offsets = np.array(np.meshgrid(grid, grid)).reshape(2, -1)
    offsets = offsets + rng.uniform(-0.3, 0.3, offsets.shape)
    sky = CENTER.spherical_offsets_by(*(offsets * u.arcsec))
    return sky, 10 ** rng.uniform(0.9, 1.8, N_STARS)


def light_of(sky, flux, wcs, n, width):
    """Light of Gaussians in each pixel, uJy: products of error functions."""
    edges = np.arange(n + 1) - 0.5
    light = np.zeros((n, n))
    for x, y, value in zip(*wcs.world_to_pixel(sky), flux, strict=True):
        columns, rows = (np.diff(erf((edges - at) / width / np.sqrt(2))) / 2 for at in (x, y))
        light += value * rows[:, None] * columns
    return light


def as_image(light, sigma, wcs, rng):
    """An image in MJy/sr with white noise of ``sigma`` uJy a pixel."""
    area = pixel_area_map(wcs, light.shape) * 1e12
    error = StdDevUncertainty(np.full(light.shape, sigma) / area)
    data = (light + rng.normal(0, sigma, light.shape)) / area
    meta = {"filter": "miri.f770w"}
    return CCDData(data, unit="MJy/sr", uncertainty=error, wcs=wcs, meta=meta)


def mosaic(seed, scale):
    """Four dithers of the stars, turned by 20 degrees, drizzled."""
    rng = np.random.default_rng(seed)
    sky, flux = stars(rng)
    n = 150
    exposures = []
    for shift in ((0.0, 0.0), (0.5, 0.5), (2.5, 1.0), (1.0, 3.5)):
        wcs = north_up_wcs(CENTER, PIXEL * u.arcsec, (n, n))
        wcs.wcs.pc = [[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]
        wcs.wcs.crpix = wcs.wcs.crpix + shift
        light = light_of(sky, flux, wcs, n, FWHM / 2.3548 / PIXEL)
        exposures.append(as_image(light, SIGMA, wcs, rng))
    size = int(1.4 * n * PIXEL / scale)
    image = drizzle_images(exposures, north_up_wcs(CENTER, scale * u.arcsec, (size, size))).image
    return image, sky, flux


def effective_psf(scale, width=1.0, size=201):
    """The Gaussian, seen through two pixels of the detector (response, drop) and one of the mosaic."""
    frequency = np.fft.fftfreq(size, FINE)
    fy, fx = np.meshgrid(frequency, frequency, indexing="ij")
    along = np.cos(TURN) * fx + np.sin(TURN) * fy
    across = np.cos(TURN) * fy - np.sin(TURN) * fx
    sigma = width * FWHM / 2.3548
    transfer = np.exp(-2 * (np.pi * sigma) ** 2 * (fx**2 + fy**2))
    transfer *= (np.sinc(PIXEL * along) * np.sinc(PIXEL * across)) ** 2
    transfer *= np.sinc(scale * fx) * np.sinc(scale * fy)
    psf = np.fft.fftshift(np.fft.ifft2(transfer).real)
    return make_psf(psf, pixel_scale=FINE * u.arcsec, enclosed=1.0)


def is_poor(result):
    return (result.flags & int(ForcedFlags.POOR_FIT)) != 0


@pytest.mark.parametrize("scale", [0.06, 0.08])
def test_exact_templates_on_drizzled_mosaics_are_no_poor_fits(scale):
    image, sky, flux = mosaic(1, scale)
    result = ForcedPhotometer(psf=effective_psf(scale)).measure(image, sky)
    # drizzling takes a per cent or two of the light of each pixel to its neighbors, at any flux
    assert 0.005 < result.meta["pixel_scatter"] < 0.03
    assert np.mean(is_poor(result)) < 0.1
    assert 0.5 < np.median(result.chi2) < 1.5
    # it conserves the fluxes, so that their errors are those of the noise
    pulls = (result.flux.value - flux) / result.flux_err.value
    assert 0.6 < np.sqrt(np.mean(pulls**2)) < 1.4
    # a wrong PSF has no power where it hides
    wrong = ForcedPhotometer(psf=effective_psf(scale, 1.04)).measure(image, sky)
    assert wrong.meta["pixel_scatter"] == pytest.approx(result.meta["pixel_scatter"], abs=3e-3)
    assert np.mean(is_poor(wrong)) > 0.9


def image_with_scatter(scatter, scale=0.08, n=250):
    """Stars whose pixels deviate independently of each other by a part of their light."""
    rng = np.random.default_rng(5)
    sky, flux = stars(rng)
    wcs = north_up_wcs(CENTER, scale * u.arcsec, (n, n))
    light = light_of(sky, flux, wcs, n, FWHM / 2.3548 / scale)
    light *= 1 + scatter * rng.normal(size=light.shape)
    # the response of the pixel alone
    frequency = np.fft.fftfreq(201, FINE)
    fy, fx = np.meshgrid(frequency, frequency, indexing="ij")
    transfer = np.exp(-2 * (np.pi * FWHM / 2.3548) ** 2 * (fx**2 + fy**2))
    transfer *= np.sinc(scale * fx) * np.sinc(scale * fy)
    psf = np.fft.fftshift(np.fft.ifft2(transfer).real)
    psf = make_psf(psf, pixel_scale=FINE * u.arcsec, enclosed=1.0)
    return ForcedPhotometer(psf=psf).measure(as_image(light, SIGMA, wcs, rng), sky)


def test_scatter_is_what_the_pixels_have():
    result = image_with_scatter(0.03)
    # the median of 25 sources of some 10 pixels each
    assert result.meta["pixel_scatter"] == pytest.approx(0.03, rel=0.15)
    assert np.median(result.chi2) == pytest.approx(1.0, abs=0.2)
    assert not is_poor(result).any()


def test_there_is_none_without_it_or_where_it_is_no_scatter():
    result = image_with_scatter(0.0)
    assert result.meta["pixel_scatter"] == 0
    assert not is_poor(result).any()
    # a fifth of the light is no matter of resampling
    result = image_with_scatter(0.2)
    assert result.meta["pixel_scatter"] == 0
    assert is_poor(result).all()
    # pixels that are too wide for the PSF have light at all frequencies
    assert image_with_scatter(0.03, scale=0.25, n=100).meta["pixel_scatter"] == 0
