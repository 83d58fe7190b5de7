"""Photon noise of added light, against counted electrons."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from numpy.testing import assert_allclose

from helpers.mosaics import CENTER
from miricigale.injection.photon_noise import PhotonNoise, photon_noise
from miricigale.instrument import north_up_wcs
from miricigale.photometry import MosaicFile

SIDE = 160
#: Electrons of 1 MJy/sr in each second.
RATE = 4.0
SKY = 5.0


def image_of(data, error):
    return CCDData(
        data, unit="MJy/sr", uncertainty=StdDevUncertainty(error), mask=np.zeros(data.shape, bool)
    )


def counted(time, rng):
    """Image of bright sources without its sky and the variance of its electrons, for times of pixels in s."""
    y, x = np.mgrid[:SIDE, :SIDE]
    light = np.zeros((SIDE, SIDE))
    for _ in range(12):
        x0, y0 = rng.uniform(0, SIDE, 2)
        light += rng.uniform(20, 200) * np.exp(-0.5 * ((x - x0) ** 2 + (y - y0) ** 2) / 9.0)
    electrons = rng.poisson((light + SKY) * RATE * time)
    data = electrons / (RATE * time) - SKY
    return data, electrons / (RATE * time) ** 2


@pytest.mark.parametrize("background", [0.0, -SKY])
def test_variance_maps_say_how_many_electrons_light_has(background):
    """Where one half was exposed twice as long, light has half the variance there, with the sky or without."""
    time = np.where(np.arange(SIDE) < SIDE // 2, 50.0, 100.0) * np.ones((SIDE, 1))
    data, variance = counted(time, np.random.default_rng(1))
    image = image_of(data - background, np.sqrt(variance))
    noise = PhotonNoise.of_variance(image, variance, in_errors=True)
    expected = 1.0 / (RATE * time)
    for half in (np.s_[:, : SIDE // 2], np.s_[:, SIDE // 2 :]):
        assert_allclose(np.median(noise.factor[half]), np.median(expected[half]), rtol=0.05)
    assert noise.of_pixels
    assert "VAR_POISSON" in noise.text


def test_an_image_of_empty_sky_does_not_say_it():
    rng = np.random.default_rng(2)
    electrons = rng.poisson(SKY * RATE * 50.0, (SIDE, SIDE))
    variance = electrons / (RATE * 50.0) ** 2
    image = image_of(electrons / (RATE * 50.0), np.sqrt(variance))
    noise = PhotonNoise.of_variance(image, variance, in_errors=True)
    assert noise.factor is None
    assert "not drawn: no pixel is so bright" in noise.text
    assert not noise.variance(np.ones((3, 3))).any()


@pytest.mark.parametrize("correlated", [False, True])
def test_light_has_the_noise_of_its_electrons(correlated):
    """Sums over areas scatter as counted electrons do, whatever pixels were resampled to."""
    noise = PhotonNoise(np.full((SIDE, SIDE), 1.0 / RATE), False, False, "")
    covariance = None
    if correlated:
        kernel = np.array([0.25, 0.5, 0.25])
        smooth = np.convolve(kernel, kernel)
        covariance = np.outer(smooth, smooth)
    light = np.full((SIDE, SIDE), 3.0)
    sums = []
    for seed in range(40):
        drawn = noise.draw(light, covariance, np.random.default_rng(seed))
        sums.append(drawn.reshape(4, SIDE // 4, 4, SIDE // 4).sum(axis=(1, 3)))
    electrons = 3.0 * RATE * (SIDE // 4) ** 2
    # 640 sums: their scatter is known to 3 %
    assert_allclose(np.std(sums) * RATE, np.sqrt(electrons), rtol=0.1)
    if correlated:
        assert_allclose(drawn.var(), 3.0 / RATE * covariance[2, 2], rtol=0.1)


@pytest.mark.parametrize("excess", [1.0, 50.0])
def test_pixels_have_the_variance_that_the_image_states(excess):
    """Whether residuals are those of noise or, as on a nebula, far larger."""
    noise = PhotonNoise(np.full((SIDE, SIDE), 1.0 / RATE), True, False, "")
    shape = np.array([0.2, 1.0, 0.2])
    light = np.full((SIDE, SIDE), 3.0)
    drawn = noise.draw(light, excess * np.outer(shape, shape), np.random.default_rng(1))
    assert_allclose(drawn.var(), 3.0 / RATE, rtol=0.1)
    # 1.4 is the sum of the correlation along an axis
    sums = drawn.reshape(16, SIDE // 16, 16, SIDE // 16).sum(axis=(1, 3))
    expected = 3.0 / RATE * (SIDE // 16) ** 2 * 1.4**2
    assert_allclose(sums.var(), expected, rtol=0.35)


@pytest.mark.parametrize(
    ("unit", "keywords", "electrons"),
    [
        ("electron/s", {"EXPTIME": 50.0}, 50.0),
        ("electron", {"EXPTIME": 50.0}, 1.0),
        ("adu/s", {"EXPTIME": 50.0, "GAIN": 2.5}, 125.0),
    ],
)
def test_headers_say_how_many_electrons_a_unit_has(unit, keywords, electrons):
    facts = {"EXPTIME": None, "GAIN": None} | keywords
    noise = PhotonNoise.of_header(u.Unit(unit), facts, 0.3)
    # (0.3 MJy/sr)^2 n / e^2 for n counts of e electrons, which are 0.3 n MJy/sr
    assert_allclose(noise.factor, 0.3 / electrons)


def test_headers_that_do_not_say_it():
    silent = {"EXPTIME": None, "GAIN": None}
    text = PhotonNoise.of_header(u.Unit("adu/s"), silent | {"EXPTIME": 5.0}, 1.0).text
    assert text == "not drawn: no VAR_POISSON, and pixels in adu / s without GAIN"
    text = PhotonNoise.of_header(u.Unit("electron/s"), silent, 1.0).text
    assert text == "not drawn: no VAR_POISSON, and pixels in electron / s without EXPTIME"
    text = PhotonNoise.of_header(u.Unit("MJy/sr"), silent | {"EXPTIME": 5.0}, 1.0).text
    assert (
        text == "not drawn: no VAR_POISSON, and pixels in MJy / sr, whose electrons are not stated"
    )


def test_files_state_it(tmp_path):
    """In nanojansky, with JWST's parts of the variance, which errors are made of."""
    rng = np.random.default_rng(3)
    data, variance = counted(np.full((SIDE, SIDE), 50.0), rng)
    wcs = north_up_wcs(CENTER, 0.11 * u.arcsec, (SIDE, SIDE))
    header = wcs.to_header()
    header.update(BUNIT="kJy/sr", FILTER="F770W", INSTRUME="MIRI", TELESCOP="JWST")
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(data * 1e3, header, name="SCI")]
    hdus.append(fits.ImageHDU(np.sqrt(variance) * 1e3, name="ERR"))
    hdus.append(fits.ImageHDU(variance * 1e6, name="VAR_POISSON"))
    path = tmp_path / "image.fits"
    fits.HDUList(hdus).writeto(path)
    file = MosaicFile(path, filter="F770W")
    image = file.read()
    noise = photon_noise(file)
    assert noise.in_errors
    assert_allclose(np.median(noise.factor), 1.0 / (RATE * 50.0), rtol=0.05)
    light = np.zeros((SIDE, SIDE))
    light[40, 50] = 100.0
    brighter = file.read(light, noise.variance(light))
    grown = brighter.uncertainty.array[40, 50] ** 2 - image.uncertainty.array[40, 50] ** 2
    assert_allclose(grown, 100.0 / (RATE * 50.0), rtol=0.3)
    same = brighter.uncertainty.array == image.uncertainty.array
    assert np.count_nonzero(~same) == 1
    # errors by a map of weights are those of the sky, whatever the file has besides
    fits.writeto(tmp_path / "weight.fits", 1e-6 / variance, wcs.to_header())
    weighted = MosaicFile(path, filter="F770W", weight=tmp_path / "weight.fits")
    assert not photon_noise(weighted).in_errors
