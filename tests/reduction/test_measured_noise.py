import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData

from miricigale.detector import Detector, InterpixelCapacitance
from miricigale.instrument import Exposure, miri_detector
from miricigale.reduction import measure_noise


def expose(n_groups, light, properties):
    exposure = Exposure(
        "miri.f1000w",
        n_groups=n_groups,
        subarray="SUB256",
        pointing=SkyCoord(53.1344, -27.8344, unit="deg"),
        roll=30 * u.deg,
    )
    sky = CCDData(np.broadcast_to(light, exposure.shape).copy(), unit="MJy/sr")
    detector = Detector.miri_imager(properties=properties).without(InterpixelCapacitance)
    return detector.expose(sky, exposure, seed=1, n_threads=1)


@pytest.mark.parametrize(("gain", "read_noise"), [(4.0, 6.0), (2.5, 9.0)])
def test_noise_of_a_ramp_is_that_of_its_detector(gain, read_noise):
    properties = miri_detector().replace(gain=gain, read_noise=read_noise)
    # photon transfer, with cosmic rays in the way
    found = measure_noise(expose(40, np.linspace(20, 200, 256), properties))
    assert found.read_noise == pytest.approx(read_noise, abs=0.01 * read_noise)
    assert found.gain == pytest.approx(gain, abs=4 * found.gain_err + 0.02 * gain)
    assert found.gain_err < 0.1 * gain
    assert not found.effective


def test_one_brightness_tells_the_sum_of_what_grows_with_time():
    found = measure_noise(expose(40, 100.0, miri_detector()))
    assert found.effective
    assert found.gain == pytest.approx(miri_detector().gain, rel=0.05)
    assert "effective (measured on the ramp)" in found.describe("gain")


def test_few_groups_and_pixels_are_refused():
    ramp = expose(8, 10.0, miri_detector())
    with pytest.raises(ValueError, match="nine groups at least, to measure its noise, got 8"):
        measure_noise(ramp)
