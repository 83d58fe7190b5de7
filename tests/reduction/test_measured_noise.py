import numpy as np
import pytest

from helpers.errors import refuses
from helpers.exposures import exposure_of, sky_of
from miricigale.detector import Detector, InterpixelCapacitance, Ramp
from miricigale.instrument import DQ, miri_detector, reference_pixel_mask
from miricigale.reduction import Reducer, measure_noise
from miricigale.utils.exceptions import MiricigaleWarning


def expose(n_groups, light, properties, *, n_int=1, seed=1):
    exposure = exposure_of(n_groups=n_groups, n_integrations=n_int)
    detector = Detector.miri_imager(properties=properties).without(InterpixelCapacitance)
    return detector.expose(sky_of(exposure, light), exposure, seed=seed, n_threads=1)


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


def drawn(seed, *, light, slow, n_int=2, n_groups=40, gain=5.0, read=5.0):
    """A ramp of SUB64 whose read-out has slow noise, in light that all pixels see alike."""
    rng = np.random.default_rng(seed)
    exposure = exposure_of(n_groups=n_groups, n_integrations=n_int, subarray="SUB64")
    shape = (n_int, n_groups, *exposure.shape)
    steps = rng.normal(0, slow, shape)
    sees = ~reference_pixel_mask(subarray="SUB64")
    steps += sees * rng.poisson(light * gain, shape) / gain
    # levels of pixels differ by far more than their noise
    level = rng.uniform(9000, 11000, exposure.shape)
    data = level + np.cumsum(steps, axis=1) + rng.normal(0, read, shape)
    flags = np.where(sees, 0, int(DQ.REFERENCE_PIXEL)).astype(np.uint32)
    return Ramp(np.rint(data).astype(np.uint16), exposure, pixel_dq=flags)


def test_reference_pixels_tell_slow_noise_from_photons():
    sky = [measure_noise(drawn(seed, light=10.0, slow=0.7)) for seed in range(4)]
    assert np.mean([f.gain for f in sky]) == pytest.approx(5.0, rel=0.1)
    assert np.mean([f.slow_noise**2 for f in sky]) == pytest.approx(0.49, abs=0.1)
    assert not any(f.effective for f in sky)
    for found in sky:
        assert found.gain == pytest.approx(5.0, abs=4 * found.gain_err)
        assert found.read_noise == pytest.approx(5.0, rel=0.02)


def test_slow_noise_of_a_dark_is_no_photon_noise():
    found = measure_noise(drawn(7, light=0.05, slow=0.7))
    assert found.gain == np.inf
    assert not found.effective
    assert found.slow_noise == pytest.approx(0.7, rel=0.1)
    assert found.read_noise == pytest.approx(5.0, rel=0.02)
    assert found.describe("gain").startswith("no photon noise, 0.")
    # and slopes with it have the scatter that they say
    ramp = drawn(8, light=0.05, slow=0.7, n_int=5)
    with pytest.warns(MiricigaleWarning, match="slopes without references"):
        fit = Reducer(references="none", jump_threshold=None).fit_groups(ramp)
    truth = 0.05 / ramp.group_time
    assert np.nanstd((fit.rate - truth) / fit.error) == pytest.approx(1, abs=0.05)


def test_stars_do_not_make_the_gain_wrong():
    properties = miri_detector().replace(gain=5.5, nonlinearity=(0.0, 1.0, 3e-6, 4e-11))
    light = np.full((256, 256), 12.0)
    light[40:210:17, 60:230:17] = 660.0
    found = [measure_noise(expose(30, light, properties, n_int=2, seed=s)) for s in (1, 2, 3)]
    assert np.mean([f.gain for f in found]) == pytest.approx(5.5, rel=0.1)


def test_few_groups_and_pixels_are_refused():
    ramp = expose(8, 10.0, miri_detector())
    refuses("nine groups at least, to measure its noise, got 8", measure_noise, ramp)
