import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.light import gaussian_image
from miricigale.psf import cruciform_fraction, effects, miri_psf


def moments(image):
    n = image.shape[0]
    axis = np.arange(n) - n // 2
    total = image.sum()
    return total, (image.sum(0) @ axis**2) / total, (image.sum(1) @ axis**2) / total


@pytest.mark.parametrize(
    ("oversampling", "options", "added"),
    [(3, {}, 9 / 12), (4, {}, 16 / 12), (2, {"pixel": False, "jitter": 1.5}, 9.0)],
)
def test_variances_of_pixel_and_jitter_add(oversampling, options, added):
    """A box of width w adds w^2 / 12 to the variance, and all keep the light."""
    out = effects.detector_response(gaussian_image(121, 5.0), oversampling=oversampling, **options)
    total, vx, vy = moments(out)
    assert total == pytest.approx(1.0, abs=1e-9)
    assert (vx, vy) == pytest.approx((25 + added, 25 + added), rel=1e-6)


def test_interpixel_capacitance_moves_charge_to_the_neighbors():
    image = np.zeros((41, 41))
    image[20, 20] = 1.0
    out = effects.detector_response(image, oversampling=4, pixel=False, ipc=(0.03, 0.02, 0.01))
    assert out.sum() == pytest.approx(1.0, abs=1e-12)
    expected = {(0, 4): 0.03, (0, -4): 0.03, (4, 0): 0.02, (-4, 0): 0.02, (4, 4): 0.01}
    for (dy, dx), value in expected.items():
        assert out[20 + dy, 20 + dx] == pytest.approx(value, abs=1e-12)
    assert out[20, 20] == pytest.approx(1 - 2 * 0.03 - 2 * 0.02 - 4 * 0.01, abs=1e-12)


@pytest.mark.parametrize("name", ["miri.f560w", "miri.f770w"])
def test_cruciform_takes_the_stated_fraction_and_keeps_the_rest(name):
    image = np.zeros((2401, 2401))
    image[1200, 1200] = 1.0
    # without a halo
    out = effects.cruciform(image, name, oversampling=4, calibration="stpsf")
    fraction = cruciform_fraction(name, calibration="stpsf")
    # 300 px = 12 folding lengths
    assert out.sum() == pytest.approx(1.0, abs=2e-4)
    assert out[1200].sum() + out[:, 1200].sum() - out[1200, 1200] == pytest.approx(out.sum())
    # the sampled kernel also hits the center itself
    assert out[1200, 1200] == pytest.approx(1 - fraction, abs=0.003)
    # e-folding of 25 pixels
    assert out[1200, 1200 + 400] / out[1200, 1200 + 300] == pytest.approx(np.exp(-1), rel=1e-6)
    assert_allclose(out, out.T, atol=1e-15)


def test_cruciform_does_not_depend_on_the_oversampling():
    arms = []
    for k in (2, 4):
        image = np.zeros((201 * k, 201 * k))
        c = 100 * k
        image[c, c] = 1.0
        arm = effects.cruciform(image, "miri.f560w", oversampling=k)[c, c + 20 * k : c + 60 * k]
        arms.append(arm.sum())
    assert arms[0] == pytest.approx(arms[1], rel=0.02)


def test_halo_takes_its_share_of_the_scattered_light_as_far_as_the_arms_go(monkeypatch):
    n, name, halo = 1201, "miri.f560w", 0.35
    image = np.zeros((n, n))
    image[600, 600] = 1.0
    both = effects.cruciform(image, name, oversampling=2)
    monkeypatch.setattr(effects, "_HALO", {})
    cross = effects.cruciform(image, name, oversampling=2)
    # what is left of the arms, far from where the halo peaks
    arm = both[600, 700:1000].sum() - both[580:590, 700:1000].mean(axis=0).sum()
    assert arm == pytest.approx((1 - halo) * cross[600, 700:1000].sum(), rel=0.01)
    y, x = np.mgrid[:n, :n] - 600
    radius = np.hypot(x, y)
    for r in (10, 30, 60, 120, 400):
        here, there = both[radius < r].sum(), cross[radius < r].sum()
        assert here == pytest.approx(there, abs=1e-3)
    # and it is the same in all directions
    ring = (radius > 150) & (radius < 152) & (abs(x) > 5) & (abs(y) > 5)
    flat = (both * radius * np.exp(radius / 50))[ring]
    assert np.ptp(flat) < 0.005 * flat.mean()


def test_arms_and_halo_of_f560w_are_those_of_a_deep_image(monkeypatch):
    """Light of one arm per arcsec over that within 1 arcsec, off an empirical PSF of a deep field."""
    kind = {"fov": 17 * u.arcsec, "oversampling": 2}
    psf = miri_psf("miri.f560w", **kind)
    monkeypatch.setattr(effects, "halo_share", lambda *args, **options: 0.0)
    # another request, for what is kept has the halo
    without = miri_psf("miri.f560w", wavefront_error=75.001 * u.nm, **kind)
    step = psf.pixel_scale.to_value(u.arcsec) / 2
    axis = (np.arange(psf.data.shape[0]) - psf.data.shape[0] // 2) * step
    x, y = np.meshgrid(axis, axis)
    radius, angle = np.hypot(x, y), np.degrees(np.arctan2(y, x)) % 90
    between = np.minimum(angle, 90 - angle) > 15
    found = {2: 0.0051, 3: 0.0038, 4: 0.0028, 5.5: 0.0012}
    for (low, value), high in zip(found.items(), (3, 4, 5.5, 7.5), strict=True):
        ring = (radius >= low) & (radius < high)
        halo = [np.median(p.data[ring & between]) for p in (psf, without)]
        around = psf.data[ring & between].mean()
        arms = ring & (np.minimum(abs(x), abs(y)) < 0.5)
        light = np.sum(psf.data[arms] - around) / 4 / (high - low)
        assert light / psf.data[radius < 1].sum() == pytest.approx(value, rel=0.17)
        # the halo was seen at 1.5 to 4 times that of a model with the cross alone
        assert 1.5 < halo[0] / halo[1] < 4
        for r in (0.5, 1, 2, high):
            inside = radius < r
            assert psf.data[inside].sum() == pytest.approx(without.data[inside].sum(), rel=1e-3)


def test_in_flight_f560w_scatters_about_twice_as_much():
    flight = cruciform_fraction("miri.f560w")
    stpsf = cruciform_fraction("miri.f560w", calibration="stpsf")
    assert flight / (1 - flight) == pytest.approx(2 * stpsf / (1 - stpsf))
    assert cruciform_fraction("F560W") == flight
    assert cruciform_fraction("miri.f2100w") == 0
