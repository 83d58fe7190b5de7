import numpy as np
import pytest

from helpers.light import gaussian_image
from miricigale.psf import cruciform_fraction, effects


def moments(image):
    n = image.shape[0]
    axis = np.arange(n) - n // 2
    total = image.sum()
    return total, (image.sum(0) @ axis**2) / total, (image.sum(1) @ axis**2) / total


@pytest.mark.parametrize("oversampling", [3, 4])
def test_pixel_response_is_a_box(oversampling):
    """A box of width w adds w^2 / 12 to the variance and keeps the light."""
    image = gaussian_image(121, 5.0)
    out = effects.detector_response(image, oversampling=oversampling)
    total, vx, vy = moments(out)
    assert total == pytest.approx(1.0, abs=1e-9)
    assert vx == pytest.approx(25 + oversampling**2 / 12, rel=1e-6)
    assert vy == pytest.approx(25 + oversampling**2 / 12, rel=1e-6)


def test_interpixel_capacitance_moves_charge_to_the_neighbours():
    image = np.zeros((41, 41))
    image[20, 20] = 1.0
    out = effects.detector_response(image, oversampling=4, pixel=False, ipc=(0.03, 0.02, 0.01))
    assert out.sum() == pytest.approx(1.0, abs=1e-12)
    expected = {(0, 4): 0.03, (0, -4): 0.03, (4, 0): 0.02, (-4, 0): 0.02, (4, 4): 0.01}
    for (dy, dx), value in expected.items():
        assert out[20 + dy, 20 + dx] == pytest.approx(value, abs=1e-12)
    assert out[20, 20] == pytest.approx(1 - 2 * 0.03 - 2 * 0.02 - 4 * 0.01, abs=1e-12)


def test_jitter_adds_its_variance():
    total, vx, _ = moments(
        effects.detector_response(gaussian_image(121, 4.0), oversampling=2, pixel=False, jitter=1.5)
    )
    assert total == pytest.approx(1.0, abs=1e-9)
    assert vx == pytest.approx(16 + 9, rel=1e-6)


@pytest.mark.parametrize("name", ["miri.f560w", "miri.f770w"])
def test_cruciform_takes_the_stated_fraction_and_keeps_the_rest(name):
    image = np.zeros((2401, 2401))
    image[1200, 1200] = 1.0
    out = effects.cruciform(image, name, oversampling=4)
    fraction = cruciform_fraction(name)
    # 300 px = 12 folding lengths
    assert out.sum() == pytest.approx(1.0, abs=2e-4)
    assert out[1200].sum() + out[:, 1200].sum() - out[1200, 1200] == pytest.approx(out.sum())
    # the sampled kernel also hits the centre itself
    assert out[1200, 1200] == pytest.approx(1 - fraction, abs=0.003)
    # e-folding of 25 pixels
    assert out[1200, 1200 + 400] / out[1200, 1200 + 300] == pytest.approx(np.exp(-1), rel=1e-6)
    np.testing.assert_allclose(out, out.T, atol=1e-15)


def test_cruciform_does_not_depend_on_the_oversampling():
    arms = []
    for k in (2, 4):
        image = np.zeros((201 * k, 201 * k))
        c = 100 * k
        image[c, c] = 1.0
        arm = effects.cruciform(image, "miri.f560w", oversampling=k)[c, c + 20 * k : c + 60 * k]
        arms.append(arm.sum())
    assert arms[0] == pytest.approx(arms[1], rel=0.02)


def test_in_flight_f560w_scatters_about_twice_as_much():
    flight = cruciform_fraction("miri.f560w")
    stpsf = cruciform_fraction("miri.f560w", calibration="stpsf")
    assert flight / (1 - flight) == pytest.approx(2 * stpsf / (1 - stpsf))
    assert cruciform_fraction("miri.f2100w") == 0


def test_unknown_calibration():
    with pytest.raises(ValueError, match="'calibration' must be 'flight' or 'stpsf'"):
        cruciform_fraction("miri.f560w", calibration="ground")
