"""What sky and dark current fill against known times and a closed form."""

import astropy.units as u
import numpy as np
import pytest
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose

from helpers.exposures import exposure_of
from miricigale.depth import saturation_flux, saturation_forecast, saturation_time
from miricigale.instrument import DetectorProperties, background_level
from miricigale.psf import MIRI_PIXEL_SCALE, miri_psf, psf_image


def test_sky_fills_the_wells_in_the_known_times():
    for name, time in (("miri.f2100w", 107), ("miri.f1800w", 347), ("miri.f1500w", 693)):
        assert_quantity_allclose(saturation_time(name), time * u.s, rtol=0.07)


def test_forecast_counts_photons():
    # without dark: level / photmjsr DN/s times gain, over the well
    detector = DetectorProperties(gain=4.0, dark_current=0.0, full_well=1e5)
    exposure = exposure_of("miri.f770w", n_groups=100, subarray="FULL")
    forecast = saturation_forecast(exposure, background=10 * u.MJy / u.sr, detector=detector)
    assert_allclose(forecast, 10 / (0.272 / 3.1) * 277.5 / 1e5)
    image = np.full((3, 4), 10.0) * u.MJy / u.sr
    assert saturation_forecast(exposure, background=image, detector=detector).shape == (3, 4)


def test_a_point_source_of_the_saturation_flux_fills_the_well_by_the_last_group():
    exposure = exposure_of("miri.f1000w", n_groups=200, subarray="FULL")
    flux = saturation_flux(exposure)
    # the light of the source as a surface brightness of its brightest pixel
    share = psf_image(miri_psf("miri.f1000w"), pixel_scale=MIRI_PIXEL_SCALE, shape=(5, 5)).max()
    brightness = (flux * share / MIRI_PIXEL_SCALE**2).to(u.MJy / u.sr)
    sky = background_level("miri.f1000w")
    forecast = saturation_forecast(exposure, background=sky + brightness)
    assert forecast == pytest.approx(1.0, rel=1e-6)
    # where the sky alone fills the well nothing is left
    assert saturation_flux(exposure, background=1e4 * u.MJy / u.sr) == 0 * u.uJy
    # half the integration: more than twice the flux, as the sky takes its part of the well
    shorter = exposure.replace(n_groups=exposure.n_groups // 2)
    assert saturation_flux(shorter) > 2 * flux
    with pytest.raises(ValueError, match=r"'exposure' must be an Exposure, .* got 'F770W'"):
        saturation_flux("F770W")
