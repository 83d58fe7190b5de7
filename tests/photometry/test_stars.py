"""PSF photometry by photutils: against closed-form images and forced photometry."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.light import gaussian, gaussian_image
from helpers.scenes import tan_wcs
from miricigale.photometry import psf_photometry
from miricigale.psf import gaussian_psf, make_psf

SCALE = 0.11


@pytest.fixture(scope="module")
def psf(tools):
    # integrated over no pixel, as the images are made
    data = 16 * gaussian_image(161, 4 * tools.LO / SCALE)
    return make_psf(data, pixel_scale=SCALE * u.arcsec, oversampling=4, frame="sky")


@pytest.fixture(scope="module")
def stars(tools):
    """Isolated stars with white noise, one masked, one off the image."""
    rng = np.random.default_rng(8)
    dx, dy = tools.lattice(rng, 9, 3.25, 0.05)
    dx[-1] = 60.0
    sky, flux = tools.places(dx, dy), 10 ** rng.uniform(1, 2.5, 81)
    sigma = 0.02 / (SCALE**2 * tools.SR * 1e12)
    image = tools.picture(sky, flux, (300, 300), sigma=sigma, rng=rng)
    x, y = image.wcs.world_to_pixel(sky[0])
    image.mask = np.zeros(image.shape, bool)
    image.mask[int(y) - 12 : int(y) + 13, int(x) - 12 : int(x) + 13] = True
    return image, QTable({"id": np.arange(81) + 500, "sky": sky}), flux


def test_stars_come_back_with_true_errors_and_every_row_stays(stars, psf):
    image, catalog, flux = stars
    table = psf_photometry(image, psf, catalog)
    assert table["id"].tolist() == catalog["id"].tolist()
    assert table["flux"].unit == u.uJy
    good = np.arange(1, 80)
    assert np.isnan(table["flux"][[0, 80]]).all()
    assert np.all(table["flags"][[0, 80]] > 0)
    assert not table["flags"][good].any()
    pull = ((table["flux"].value - flux) / table["flux_err"].value)[good]
    assert 0.8 < pull.std() < 1.2
    assert abs(pull.mean()) < 4 / np.sqrt(len(good))
    # matched filter of a Gaussian in white noise: sigma sqrt(4 pi) width in pixels
    expected = 0.02 * np.sqrt(4 * np.pi) * 0.25 / SCALE
    assert_allclose(table["flux_err"].value[good], expected, rtol=0.03)
    assert_allclose(table["chi2"][good], 1, atol=0.45)
    # its position: sqrt(2) width over signal-to-noise along either axis
    snr = flux[good] / table["flux_err"].value[good]
    shift = table["shift"][good].to_value(u.arcsec) * snr / (np.sqrt(2) * 0.25)
    assert np.median(shift) == pytest.approx(np.sqrt(2 * np.log(2)), rel=0.25)
    assert shift.max() < 4.5
    assert not table["neighbor"].any()


def test_it_agrees_with_forced_photometry(tools, stars, psf):
    image, catalog, _ = stars
    fixed = psf_photometry(image, psf, catalog, max_shift=None)
    forced = tools.measured(image, catalog, errors=tools.WHITE)
    good = np.isfinite(fixed["flux"].value)
    assert good.sum() == 79
    assert np.all(fixed["shift"][good] == 0)
    difference = (fixed["flux"] - forced.flux).value[good] / forced.flux_err.value[good]
    # the square that is fitted leaves out some of the light, not more
    assert np.abs(difference).max() < 0.5
    assert_allclose(fixed["flux_err"].value[good], forced.flux_err.value[good], rtol=0.03)


def test_the_psf_is_turned_to_the_image(tools):
    # an elliptical star, drawn out along north, on an image whose +y points 30 degrees east of north
    def star(east, north):
        return gaussian(east / 0.2, north / 0.4, 1.0) / 0.08

    wcs = tan_wcs((121, 121), SCALE, pa=30.0)
    sky = wcs.pixel_to_world(60.3, 59.8)
    light = star(*tools.offsets(sky, wcs, *np.indices((121, 121))))
    image = tools.as_ccd(light * 50e-12 / tools.SR, wcs, 0.01)
    g = (np.arange(201) - 100) * SCALE / 4
    data = SCALE**2 * star(g, g[:, None])
    catalog = QTable({"sky": sky.reshape(1)})
    north_up = make_psf(data, pixel_scale=SCALE * u.arcsec, oversampling=4, frame="sky")
    assert_allclose(psf_photometry(image, north_up, catalog)["flux"].value, 50, rtol=0.01)
    detector = make_psf(data, pixel_scale=SCALE * u.arcsec, oversampling=4, frame="detector")
    table = psf_photometry(image, detector, catalog, pa=0 * u.deg)
    assert_allclose(table["flux"].value, 50, rtol=0.01)
    wrong = psf_photometry(image, detector, catalog, pa=90 * u.deg)["flux"].value[0]
    assert abs(wrong / 50 - 1) > 0.1
    refuses("pa", psf_photometry, image, detector, catalog)


def test_neighbors_are_told_and_options_checked(tools, stars, psf):
    image, catalog, _ = stars
    two = QTable({"sky": tools.places([0, 0.6])})
    assert psf_photometry(image, psf, two)["neighbor"].tolist() == [True, True]
    narrow = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.03 * u.arcsec, fov=3 * u.arcsec)
    # a PSF on other pixels is brought to the image's
    assert np.isfinite(psf_photometry(image, narrow, two)["flux"].value).all()
    assert len(psf_photometry(image, psf, catalog[:0])) == 0
