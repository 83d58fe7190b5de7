"""The blur of a PSF undone: at the frequencies that it has left, and with no more noise than stated."""

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData

from helpers import scenes
from helpers.errors import refuses
from helpers.light import gaussian_image as gaussian
from helpers.light import pixel_gaussian
from miricigale.psf import hst_psf, miri_psf, psf_image
from miricigale.scene import Cutout, Scene, deconvolve

FINE = 0.06 * u.arcsec


def test_the_blur_of_a_gaussian_is_undone():
    sharp, blurred = (gaussian(101, sigma, 4.3, -2.1) for sigma in (5.0, np.hypot(5.0, 1.5)))
    found = deconvolve(blurred, 5.0 * gaussian(31, 1.5))
    np.testing.assert_allclose(found, sharp, atol=1e-4 * sharp.max())
    assert found.sum() == pytest.approx(blurred.sum(), rel=1e-6)
    # a gain of 1 only takes away
    same = deconvolve(blurred, gaussian(31, 1.5), max_gain=1)
    assert same.max() < blurred.max()


@pytest.mark.parametrize("gain", [2.0, 3.0, 10.0])
def test_noise_grows_as_the_filter_says(gain):
    rng, sigma, n = np.random.default_rng(2), 1.5, 301
    noise = deconvolve(rng.normal(size=(n, n)), gaussian(31, sigma), max_gain=gain)
    # rms of the filter over all frequencies, of the transform of the Gaussian in closed form
    k = np.fft.fftfreq(512)
    transfer = np.exp(-2 * np.pi**2 * sigma**2 * (k**2 + k[:, None] ** 2))
    known = np.sqrt(np.mean((transfer / np.maximum(transfer**2, gain**-2)) ** 2))
    assert known < gain
    assert noise[40:-40, 40:-40].std() == pytest.approx(known, rel=0.03)


def test_a_stamp_of_hubble_becomes_the_galaxy_before_any_telescope():
    """Painted through the PSF of MIRI it is as the profile itself painted through it."""
    wcs = scenes.tan_wcs()
    shape = {"profile": "sersic", "radius": 0.35, "index": 1.0, "ratio": 0.5, "angle": 30.0}
    galaxy = scenes.make_catalog(wcs, 50.2, 44.7, **shape)
    sharp_wcs = scenes.tan_wcs(shape=(151, 151), scale=0.06)
    sharp_wcs.wcs.crval = galaxy["sky"].ra.deg[0], galaxy["sky"].dec.deg[0]
    galaxy["wfc3.f160w"] = galaxy["miri.f770w"]
    psf = hst_psf("wfc3.f160w", pixel_scale=FINE)
    seen = Scene(galaxy, filter="wfc3.f160w", wcs=sharp_wcs, psf=psf).render()
    sharper = deconvolve(seen.data, psf_image(psf, pixel_scale=FINE, shape=151))
    form = {"filter": "miri.f770w", "wcs": wcs, "psf": miri_psf("miri.f770w", fov=8 * u.arcsec)}
    known = Scene(galaxy, **form).render().data
    galaxy["profile"] = "cutout"
    errors = []
    for light in (seen.data, sharper):
        stamp = Cutout.from_image(CCDData(light, unit=seen.unit, wcs=sharp_wcs))
        image = Scene(galaxy, cutouts={1: stamp}, **form).render().data
        errors.append(np.abs(image - known).max() / known.max())
    assert errors[0] > 0.3
    assert errors[1] < 0.06


@pytest.mark.parametrize(
    ("image", "psf", "gain", "message"),
    [
        (np.ones(5), np.ones((3, 3)), 3, "'image' must be a finite 2D array"),
        (np.full((5, 5), np.nan), np.ones((3, 3)), 3, "'image' must be a finite 2D array"),
        (np.ones((5, 5)), np.ones((4, 3)), 3, "'psf' must be an array with odd sides"),
        (np.ones((5, 5)), np.zeros((3, 3)), 3, "a positive sum"),
        (np.ones((5, 5)), np.ones((3, 3)), 0.5, "'max_gain' must be a number of at least 1"),
    ],
)
def test_what_cannot_be_deconvolved(image, psf, gain, message):
    refuses(message, deconvolve, image, psf, max_gain=gain)


def test_half_light_radius():
    line = pixel_gaussian(121, 63.0, 8.0)
    stamp = Cutout(np.outer(line, line), pixel_scale=0.05 * u.arcsec, center=(63.0, 63.0))
    # sqrt(2 ln 2) sigma, in closed form
    assert stamp.half_light_radius.to_value(u.arcsec) == pytest.approx(1.17741 * 0.4, rel=0.01)
    point = np.zeros((5, 5))
    point[2, 2] = 1.0
    assert Cutout(point, pixel_scale=0.05 * u.arcsec).half_light_radius.value < 0.05
