"""Photometric figures against published ones and against the throughput curves."""

import astropy.units as u
import numpy as np
import pytest
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.filters import Filter
from miricigale.instrument import (
    background_level,
    background_spectrum,
    electron_rate,
    electrons_per_brightness,
    imager_filters,
    miri_detector,
    photmjsr,
    psf_fwhm,
)

# low background at the nominal wavelengths 5.6, 7.7, 10, 11.3, 12.8, 15, 18, 21, 25.5 um
BACKGROUND = [1.0, 5.1, 11.7, 16, 22, 38, 95, 254, 980]
NOMINAL = [5.6, 7.7, 10.0, 11.3, 12.8, 15.0, 18.0, 21.0, 25.5]


def test_nine_filters_blue_to_red():
    assert len(imager_filters()) == 9
    pivots = [Filter.from_name(name).pivot.value for name in imager_filters()]
    assert np.all(np.diff(pivots) > 0)


@pytest.mark.parametrize("name", imager_filters())
def test_conversion_follows_from_the_throughput(name):
    # electrons per second per MJy/sr: 1e-20 A Omega int T dlam / lam / h
    band = Filter.from_name(name)
    wave = band.wave.value
    integral = np.trapezoid(band.throughput / wave, wave)
    omega = (0.110498 * u.arcsec * 0.111336 * u.arcsec).to_value(u.sr)
    rate = 1e-20 * 25.4 * omega * integral / 6.62607015e-34
    assert_allclose(photmjsr(name, gain=3.1), 3.1 / rate, rtol=0.004)


def test_background_levels_are_the_published_ones():
    levels = [background_level(name).value for name in imager_filters()]
    assert_allclose(levels, BACKGROUND, rtol=0.10)
    assert_allclose(background_spectrum(NOMINAL * u.um).value, BACKGROUND, rtol=0.05)


@pytest.mark.parametrize("name", imager_filters())
def test_background_levels_are_band_means_of_the_spectrum(name):
    band = Filter.from_name(name)
    wave = np.linspace(band.wave.value[0], band.wave.value[-1], 4000)
    mean = band.weights(wave) @ background_spectrum(wave * u.um)
    assert_quantity_allclose(background_level(name), mean, rtol=0.003)
    thermal = band.weights(wave) @ background_spectrum(wave * u.um, zodi="none")
    assert_quantity_allclose(background_level(name, zodi="none"), thermal, rtol=0.004)
    assert_quantity_allclose(background_level(name, zodi=2), 2 * mean - thermal, rtol=0.003)


def test_background_beyond_the_curve_is_refused():
    refuses("'wave' must be between 2 and 31 um", background_spectrum, [5, 40] * u.um)
    match = "no zodiacal background 'bright'; known: low, none"
    refuses(match, background_level, "miri.f770w", error=KeyError, zodi="bright")


def test_widths_grow_as_the_diffraction_limit():
    for name in imager_filters():
        diffraction = (Filter.from_name(name).pivot / (6.5 * u.m)).to_value("") * u.rad
        # a little wider than lam / D, more so where the pixels are coarse
        assert 0.95 < psf_fwhm(name) / diffraction < 1.2


def test_charge_of_the_sky_is_light_times_conversion_and_dark():
    # DN/s by the conversion, times the gain; the conversion is in proportion to it
    assert_allclose(photmjsr("miri.f770w"), 0.272 * 4.0 / 3.1)
    refuses("'gain' must be positive", photmjsr, "miri.f770w", gain=0)
    detector = miri_detector().replace(gain=2.0, dark_current=0.5)
    assert_allclose(electrons_per_brightness("miri.f770w", detector), 3.1 / 0.272)
    assert_allclose(electrons_per_brightness("miri.f770w"), 3.1 / 0.272)
    rate = electron_rate("miri.f770w", 10 * u.MJy / u.sr, detector=detector)
    assert_allclose(rate, 10 * 3.1 / 0.272 + 0.5)
