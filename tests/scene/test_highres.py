import astropy.units as u
import numpy as np
import pytest

from helpers import scenes
from miricigale.instrument import north_up_wcs
from miricigale.psf import encircled_energy, hst_psf
from miricigale.scene import Scene, highres_image

FILTER = "miri.f770w"
SHAPE = (240, 250)
#: uJy of one MJy/sr on a pixel of 0.06 arcsec
AREA = (0.06 * u.arcsec).to_value(u.rad) ** 2 * 1e12


@pytest.fixture
def fine():
    return scenes.tan_wcs(SHAPE, 0.06)


@pytest.fixture
def catalog(fine):
    return scenes.make_catalog(fine, [100.0, 180.0], [60.0, 120.0], flux=[1.0, 2.0])


def test_noise_belongs_to_the_depth(fine, psf, catalog):
    image = highres_image(catalog, filter=FILTER, wcs=fine, psf=psf, depth=27 * u.ABmag, seed=4)
    truth = Scene(catalog, filter=FILTER, wcs=fine, psf=psf).render()
    noise = (image.data - truth.data) * AREA
    # blank apertures of the radius of the depth: a fifth of 27 AB = 0.0575 uJy
    y, x = np.mgrid[-3.5:4, -3.5:4]
    mask = np.hypot(x, y) <= 0.2 / 0.06
    blocks = noise[:240, :248].reshape(30, 8, 31, 8).swapaxes(1, 2)
    fluxes = (blocks * mask).sum(axis=(2, 3)) / np.sqrt(mask.sum() / (np.pi * (0.2 / 0.06) ** 2))
    assert fluxes.std() == pytest.approx(0.0575 / 5, rel=0.08)
    assert np.std(noise) == pytest.approx(np.mean(image.uncertainty.array) * AREA, rel=0.02)
    assert image.unit == u.MJy / u.sr
    assert image.meta["seed"] == 4


def test_noise_does_not_know_the_sources(fine, psf, catalog):
    both = highres_image(catalog, filter=FILTER, wcs=fine, psf=psf, seed=9)
    one = highres_image(catalog[:1], filter=FILTER, wcs=fine, psf=psf, seed=9)
    far = np.s_[150:, :100]
    np.testing.assert_allclose(both.data[far], one.data[far], rtol=1e-6, atol=1e-12)
    again = highres_image(catalog, filter=FILTER, wcs=fine, psf=psf, seed=9)
    np.testing.assert_array_equal(both.data, again.data)
    other = highres_image(catalog, filter=FILTER, wcs=fine, psf=psf, seed=10)
    assert not np.any(both.data == other.data)


def test_f160w_mosaic_through_its_psf():
    """The bundled F160W PSF on a north-up grid of 0.06 arcsec: a star's light, width and noise."""
    wcs = north_up_wcs(scenes.CENTER, 0.06 * u.arcsec, (201, 221))
    catalog = scenes.make_catalog(wcs, [110.0], [100.0], flux=[100.0])
    catalog.rename_column(FILTER, "wfc3.f160w")
    y, x = np.mgrid[:201, :221]
    psf = hst_psf()
    image = highres_image(catalog, wcs=wcs, psf=psf, depth=28 * u.ABmag, seed=3)
    r = np.hypot(x - 110, y - 100) * 0.06
    inside = [r < limit for limit in (0.3, 0.6, 1.2)]
    light = [np.sum(image.data[part]) * AREA / 100 for part in inside]
    # whole pixels in the place of circles
    radii = np.sqrt(np.sum(inside, axis=(1, 2)) / np.pi) * 0.06 * u.arcsec
    np.testing.assert_allclose(light, encircled_energy(psf, radii), atol=0.01)
    # 28 AB is 5 sigma in an aperture of 0.2 arcsec
    rms = 10 ** (-0.4 * (28 - 23.9)) / 5 / np.sqrt(np.pi * (0.2 / 0.06) ** 2) / AREA
    assert np.std(image.data[r > 5]) == pytest.approx(rms, rel=0.03)
    assert image.meta["psf_includes"] == list(psf.includes)
