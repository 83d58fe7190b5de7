"""Effects at the amplitudes of flight: where charge goes, and what is published of it."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose
from scipy.optimize import curve_fit

from helpers.errors import refuses
from miricigale.detector import (
    ADConversion,
    BrighterFatter,
    Detector,
    InterpixelCapacitance,
    LastFrame,
    Latent,
    Nonlinearity,
    Persistence,
    Photons,
    ResetAnomaly,
)
from miricigale.instrument import miri_detector

WELL = miri_detector().full_well


def test_bright_pixels_lose_charge_to_neighbors(make_block):
    block = make_block(n_groups=6, n_integrations=2)
    rng = np.random.default_rng(1)
    steps = rng.exponential(2e4, (2, 6, 64, 72)) * (rng.random((64, 72)) < 0.2)
    ramp = np.cumsum(steps, axis=1).astype(np.float32)
    expected = np.zeros(ramp.shape)
    held = np.concatenate([np.zeros((2, 1, 64, 72)), ramp.astype(float)], axis=1)
    for g in range(6):
        charge, middle = held[:, g + 1] - held[:, g], (held[:, g + 1] + held[:, g]) / 2
        new = charge.copy()
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            ys, yt = (slice(max(-d, 0), 64 - max(d, 0)) for d in (dy, -dy))
            xs, xt = (slice(max(-d, 0), 72 - max(d, 0)) for d in (dx, -dx))
            share = 0.2 * np.clip((middle[:, ys, xs] - middle[:, yt, xt]) / WELL, 0, 1)
            new[:, ys, xs] -= share * charge[:, ys, xs]
            new[:, yt, xt] += share * charge[:, ys, xs]
        expected[:, g] = new + (expected[:, g - 1] if g else 0)
    got = BrighterFatter(0.2).apply(ramp.copy(), block)
    assert_allclose(got, expected, rtol=2e-5, atol=0.1)
    assert_allclose(
        got.sum(axis=(2, 3), dtype=float), ramp.sum(axis=(2, 3), dtype=float), rtol=1e-6
    )


def test_a_steady_pixel_loses_with_the_square_of_time(make_block):
    block = make_block(n_groups=40)
    ramp = np.zeros((1, 40, 64, 72), np.float32)
    ramp[0, :, 30, 30] = np.linspace(0, WELL, 41)[1:]
    got = BrighterFatter(0.1).apply(ramp.copy(), block)
    # half of the share at the end, to each of four neighbors
    assert got[0, -1, 30, 30] == pytest.approx(WELL * (1 - 4 * 0.1 / 2), rel=1e-5)
    assert got[0, 19, 30, 31] == pytest.approx(WELL * 0.1 / 2 / 4, rel=1e-5)


def test_the_deficit_is_the_published_one(make_exposure, make_sky):
    exposure = make_exposure(n_groups=20, subarray="SUB128")
    image = make_sky(exposure, 10.0)
    image.data[:, 100:] = 1e6
    chain = (
        Photons(flat=False),
        Persistence((0,), (1,), deficit=0.0184),
        Nonlinearity(),
        ADConversion(),
    )
    detector = Detector(chain)
    first = detector.without(Persistence).expose(image, exposure, seed=1)
    latent = Latent.from_ramp(first, 11.6 * u.min)
    assert latent.saturated[:, 100:].all()
    assert not latent.saturated[:, :100].any()
    sky = make_sky(exposure, 300.0)
    plain = detector.expose(sky, exposure, seed=2).data[0, -1].astype(float)
    for later, lost in ((0, 0.0169), (5.16, 0.00169)):
        options = {"seed": 2, "previous": latent.after(later * u.h)}
        less = detector.expose(sky, exposure, **options).data[0, -1] - plain
        level = plain.mean()
        assert less[:, 100:].mean() == pytest.approx(-lost * level, rel=0.02)
        assert not less[:, :100].any()
    refuses("'saturated' must be of shape", Latent, latent.rate, 1 * u.s, "SUB128", np.ones(3))


def test_the_mean_rate_after_saturation_is_that_of_the_groups(make_block):
    block = make_block(n_groups=20)
    saturated = np.zeros(block.exposure.shape, bool)
    saturated[:, 40:] = True
    rate = np.zeros(block.exposure.shape) * u.electron / u.s
    latent = Latent(rate, 10 * u.s, block.exposure.subarray, saturated)
    block = dataclasses.replace(block, previous=(latent,))
    effect = Persistence((0,), (1,), deficit=0.0184)
    # charge of each group before it is summed up
    charge = np.full((1, 20, *block.exposure.shape), 5.0 * block.group_time, np.float32)
    mean = effect.apply(charge, block).mean(axis=(0, 1)) / block.group_time
    expected = effect.expected(np.full(block.exposure.shape, 5.0), block)
    assert_allclose(expected, mean, rtol=1e-5)
    assert (expected[:, 40:] < 5.0 * (1 - 0.018)).all()


def test_flight_is_a_set_that_others_replace():
    effects = Detector.miri_imager("flight", BrighterFatter(0.05)).effects
    place = effects.index(BrighterFatter(0.05))
    assert isinstance(effects[place + 1], InterpixelCapacitance)
    assert len(effects) == len(Detector.miri_imager().effects) + 6
    wanted = "no set of effects 'orbit'; known: flight"
    refuses(wanted, Detector.miri_imager, "orbit", error=KeyError)


def test_flight_has_what_a_ground_test_shows(data_file):
    with fits.open(
        data_file("real/ramps/MIRI_5582_89_S_20180308-010230_SCE1_pipe.fits.gz")
    ) as hdus:
        level = hdus["SCI"].data[:, :, 2:-2, 5:-5].mean(axis=(2, 3), dtype=float)
    effects = {type(e): e for e in Detector.miri_imager("flight").effects}
    group = np.arange(49)

    def settling(g, amplitude, groups, start, slope):
        return start + slope * g + amplitude * np.exp(-g / groups)

    fits_of = [curve_fit(settling, group, row[:-1], p0=(-20, 5, row[-2], 0.2))[0] for row in level]
    amplitudes = effects[ResetAnomaly].amplitudes
    for number in (0, 1):
        assert fits_of[number][0] == pytest.approx(amplitudes[number], abs=1)
    assert np.mean([row[0] for row in fits_of[2:]]) == pytest.approx(amplitudes[2], abs=1)
    last = [row[-1] - fit[2] - 49 * fit[3] for row, fit in zip(level, fits_of, strict=True)]
    assert np.mean(last) == pytest.approx(effects[LastFrame].offset, abs=1)
