"""PSFs of other origin compared with the model of their filter."""

import astropy.units as u
import numpy as np
import pytest

from helpers.errors import refuses, warned
from miricigale.psf import (
    checked_psf,
    encircled_energy,
    filter_psf,
    fwhm,
    gaussian_psf,
    hst_psf,
    make_psf,
    miri_psf,
    psf_image,
    radius_of_encircled_energy,
)
from miricigale.utils.exceptions import MiricigaleWarning

PIXEL = 0.11 * u.arcsec
SKY = {"pixel_scale": PIXEL, "frame": "sky"}
SPIKES = "whose spikes stand as in the detector's axes"


@pytest.fixture(scope="module")
def mosaic():
    return filter_psf("miri.f770w", pixel_scale=PIXEL, pa=75 * u.deg)


@pytest.fixture(scope="module")
def north_up():
    return filter_psf("miri.f770w", pixel_scale=PIXEL, pa=0 * u.deg)


def stamp(psf, n, factor=None):
    data = psf_image(psf, pixel_scale=PIXEL, shape=n)
    return data if factor is None else factor * data / data.sum()


@pytest.mark.parametrize("name", ["miri.f1500w", "nircam.f200w", "wfc3.f160w"])
def test_models_stand_on_the_sky_by_name(name):
    psf = filter_psf(name, pixel_scale=0.06 * u.arcsec, pa=20 * u.deg, grid_angle=5 * u.deg)
    assert psf.frame == "sky"
    assert psf.angle.value == pytest.approx(5)
    assert "drizzle" in psf.includes
    with pytest.raises(KeyError, match=r"no model PSF for the filter 'miri\.f771w'; known: miri"):
        filter_psf("miri.f771w", pixel_scale=PIXEL)


def test_widths_and_energies_take_the_name_of_a_filter():
    for name, psf in (("F770W", miri_psf("F770W")), ("F160W", hst_psf("F160W"))):
        assert fwhm(name) == psf.fwhm
        assert encircled_energy(name, 0.3 * u.arcsec) == encircled_energy(psf, 0.3 * u.arcsec)
        assert radius_of_encircled_energy(name, 0.5) == radius_of_encircled_energy(psf, 0.5)
    refuses("no model PSF for the filter 'F771W'", fwhm, "F771W", error=KeyError)


def test_the_light_beyond_the_grid_is_that_of_the_model(mosaic):
    for n in (19, 61):
        held = stamp(mosaic, n).sum()
        with pytest.warns(MiricigaleWarning, match=r"taken to hold 0\."):
            psf = checked_psf(make_psf(stamp(mosaic, n, 1.0), **SKY), "miri.f770w", pa=75 * u.deg)
        assert psf.enclosed == pytest.approx(held, rel=1e-3)
        assert psf.total_known
        radius = 0.7 * u.arcsec
        truth = encircled_energy(mosaic, radius)
        assert encircled_energy(psf, radius) == pytest.approx(truth, rel=0.01)
    # a sum that may be true is kept, and one that is known is not looked at
    near = make_psf(stamp(mosaic, 61, held - 0.03), **SKY)
    with pytest.warns(MiricigaleWarning, match="taken to hold"):
        kept = checked_psf(make_psf(stamp(mosaic, 61, held - 0.08), **SKY), "miri.f770w")
    assert kept.enclosed == pytest.approx(held, rel=2e-3)
    assert checked_psf(near, "miri.f770w").enclosed == pytest.approx(held - 0.03)
    known = make_psf(stamp(mosaic, 61), **SKY, enclosed=0.9)
    assert checked_psf(known, "miri.f770w") is known


def test_widths_and_spikes_of_another_psf_are_refused(north_up):
    wide = gaussian_psf(0.6 * u.arcsec, pixel_scale=PIXEL, fov=5 * u.arcsec)
    with pytest.raises(ValueError, match=r"'lo' must be a PSF of miri.f770w, .* one of 0.6"):
        checked_psf(wide, "miri.f770w", argument="lo")
    with pytest.warns(MiricigaleWarning, match=r"is 2.1 times as wide .* this resolution"):
        assert checked_psf(wide, "miri.f770w", smoothed=True) is wide
    sharp = gaussian_psf(0.3 * u.arcsec, pixel_scale=PIXEL, fov=5 * u.arcsec)
    refuses(r"must be a PSF of miri\.f2100w", checked_psf, sharp, "miri.f2100w", smoothed=True)
    # turned by the wrong angle, and not at all
    plain = make_psf(stamp(north_up, 61), **SKY)
    refuses(SPIKES, checked_psf, plain, "miri.f770w", pa=75 * u.deg)
    assert checked_psf(plain, "miri.f770w", pa=0 * u.deg) is not None
    assert checked_psf(plain, "miri.f770w") is not None
    # six spikes come back at 60 deg, but for the struts
    refuses(SPIKES, checked_psf, plain, "miri.f770w", pa=60 * u.deg)
    # of a small angle nothing is certain
    assert checked_psf(plain, "miri.f770w", pa=4 * u.deg) is not None


def test_exposures_are_sharper_than_mosaics(mosaic):
    exposure = miri_psf("miri.f770w")
    assert checked_psf(exposure, "miri.f770w") is exposure
    sharp = make_psf(exposure.data, **SKY, oversampling=4, angle=75 * u.deg, enclosed=0.98)
    warned("7% narrower", checked_psf, sharp, "miri.f770w", pa=75 * u.deg)
    assert np.isclose(mosaic.fwhm.value / exposure.fwhm.value, 1.065, atol=0.01)


def test_noise_and_coarse_pixels_refuse_nothing(mosaic, north_up):
    """A wrong turn is found in noisy PSFs too, and never where there is none."""
    rng = np.random.default_rng(1)
    noisy = []
    for data in (stamp(north_up, 55), stamp(mosaic, 55)):
        noisy.append(make_psf(data + rng.normal(0, data.max() / 500, data.shape), **SKY))
    refuses(SPIKES, checked_psf, noisy[0], "miri.f770w", pa=75 * u.deg)
    assert checked_psf(noisy[1], "miri.f770w", pa=75 * u.deg) is not None
    # 1.3 pixels wide
    coarse = {"pixel_scale": 0.06 * u.arcsec}
    psf = filter_psf("nircam.f115w", **coarse, pa=0 * u.deg)
    data = psf_image(psf, **coarse, shape=51)
    psf = make_psf(data, **coarse, frame="sky")
    assert checked_psf(psf, "nircam.f115w", pa=0 * u.deg, **coarse) is not None
