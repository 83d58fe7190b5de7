"""What sky and dark current fill against known times and a closed form."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose

from miricigale.depth import saturation_forecast, saturation_time
from miricigale.instrument import DetectorProperties, Exposure


def test_sky_fills_the_wells_in_the_known_times():
    for name, time in (("miri.f2100w", 107), ("miri.f1800w", 347), ("miri.f1500w", 693)):
        assert_quantity_allclose(saturation_time(name), time * u.s, rtol=0.07)


def test_forecast_counts_photons():
    # without dark: level / photmjsr DN/s times gain, over the well
    detector = DetectorProperties(gain=4.0, dark_current=0.0, full_well=1e5)
    exposure = Exposure(
        "miri.f770w", n_groups=100, pointing=SkyCoord(1, 2, unit="deg"), roll=0 * u.deg
    )
    forecast = saturation_forecast(exposure, background=10 * u.MJy / u.sr, detector=detector)
    assert_allclose(forecast, 10 / (0.272 / 3.1) * 277.5 / 1e5)
    image = np.full((3, 4), 10.0) * u.MJy / u.sr
    assert saturation_forecast(exposure, background=image, detector=detector).shape == (3, 4)
