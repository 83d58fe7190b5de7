"""Latent images: nothing from nothing, linear in what was, decaying as written."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.integrate import quad

from helpers.errors import refuses
from miricigale.detector import (
    ADConversion,
    BadPixels,
    CosmicRays,
    Detector,
    Latent,
    Nonlinearity,
    Persistence,
    Photons,
)
from miricigale.instrument import DQ, miri_detector

RATE = u.electron / u.s
GAIN = miri_detector().gain


def latent_of(exposure, rate, gap=10 * u.s):
    return Latent(np.full(exposure.shape, float(rate)) * RATE, gap, exposure.subarray)


def counts(exposure, sky, effect, previous, *, seed=3, **options):
    chain = (Photons(flat=False), effect, Nonlinearity(linear=True), ADConversion())
    # one electron per DN: nothing is rounded
    detector = Detector(chain, properties=miri_detector().replace(gain=1.0))
    ramp = detector.expose(sky, exposure, seed=seed, previous=previous, **options)
    return ramp.data.astype(float)


def test_nothing_before_leaves_nothing(make_exposure, make_sky):
    exposure = make_exposure(n_groups=3)
    sky = make_sky(exposure, 50.0)
    with_effect = Detector.miri_imager(Persistence())
    plain = Detector.miri_imager().expose(sky, exposure, seed=2)
    for previous in (None, [], latent_of(exposure, 0.0)):
        ramp = with_effect.expose(sky, exposure, seed=2, previous=previous)
        assert_array_equal(ramp.data, plain.data)
        assert_array_equal(ramp.group_dq, plain.group_dq)


def test_what_comes_free_is_the_integral_of_the_decay(make_exposure):
    exposure = make_exposure(n_groups=5, n_integrations=3)
    effect = Persistence(amplitudes=(0.02, 0.01), times=(3.0, 40.0))
    released = effect.released(exposure, 7 * u.s)
    step, frame = (t.to_value("s") for t in (exposure.group_time, exposure.frame_time))
    for i, g in np.ndindex(3, 5):
        # a reset frame stands between the integrations
        begin = 7 + i * (5 * step + frame) + g * step
        expected, _ = quad(
            lambda t: 0.02 * np.exp(-t / 3) + 0.01 * np.exp(-t / 40), begin, begin + step
        )
        assert released[i, g] == pytest.approx(expected, rel=1e-9)
    # all that ever comes free is the sum of amplitude times time
    long = make_exposure(n_groups=20_000)
    assert effect.released(long, 0 * u.s).sum() == pytest.approx(0.02 * 3 + 0.01 * 40, rel=1e-9)


def test_the_ramp_follows_the_decay(make_exposure, make_sky):
    exposure = make_exposure(n_groups=6, n_integrations=2, subarray="SUB256")
    effect = Persistence(amplitudes=(0.01,), times=(0.8,))
    rate = 1e6
    got = counts(exposure, make_sky(exposure, 0.0), effect, latent_of(exposure, rate, 1 * u.s))
    mean = got.mean(axis=(2, 3))
    step = exposure.group_time.to_value("s")
    start = 1 + np.arange(2)[:, None] * 7 * step
    end = start + step * np.arange(1, 7)
    expected = rate * 0.01 * 0.8 * (np.exp(-start / 0.8) - np.exp(-end / 0.8))
    error = np.sqrt(expected / got[0, 0].size)
    assert np.all(np.abs(mean - expected) < 5 * error)
    # Poisson, like all charge
    variance = got[0, -1].var()
    assert variance == pytest.approx(expected[0, -1], rel=5 * np.sqrt(2 / got[0, 0].size))


def test_several_exposures_add_up(make_exposure, make_sky):
    exposure = make_exposure(n_groups=4, subarray="SUB256")
    sky, effect = make_sky(exposure, 0.0), Persistence(amplitudes=(0.01,), times=(5.0,))
    unit = effect.released(exposure, 10 * u.s)[0].sum()
    for rates in ([5e4], [2e5], [1e5, 5e4]):
        previous = [latent_of(exposure, rate) for rate in rates]
        mean = counts(exposure, sky, effect, previous)[0, -1].mean()
        expected = sum(rates) * unit
        assert mean == pytest.approx(expected, abs=5 * np.sqrt(expected / 256**2))


def test_a_saturated_star_comes_back_in_the_next_exposure(make_exposure, make_sky):
    exposure = make_exposure(n_groups=40)
    image = make_sky(exposure, 5.0)
    image.data[30, 40] = 1e5
    detector = Detector.miri_imager(Persistence()).without(CosmicRays, BadPixels)
    first = detector.expose(image, exposure, seed=1)
    assert first.group_dq[0, -1, 30, 40] & DQ.SATURATED
    latent = Latent.from_ramp(first, 20 * u.s)
    # the well over the time of the integration, in that pixel alone
    well = miri_detector().full_well / exposure.integration_time.to_value("s")
    assert latent.rate[30, 40].to_value(RATE) == pytest.approx(well, rel=2e-3)
    assert np.count_nonzero(latent.rate) == 1
    blank = make_sky(exposure, 5.0)
    moved = exposure.replace(dither=1)
    without = detector.expose(blank, moved, seed=1)
    ghost = detector.expose(blank, moved, seed=1, previous=latent)
    more = ghost.data.astype(int) - without.data
    assert np.flatnonzero(more[0, -1]).tolist() == [30 * exposure.shape[1] + 40]
    charge = well * Persistence().released(exposure, 20 * u.s)[0].sum() / GAIN
    assert more[0, -1, 30, 40] == pytest.approx(charge, abs=5 * np.sqrt(charge / GAIN) + 1)
    assert "1 of 64 x 72 pixels, 20 s ago" in ghost.meta["previous"][0]


def test_reference_and_bad_pixels_are_not_remembered(make_exposure, make_sky):
    exposure = make_exposure(n_groups=3, subarray="SUB64")
    detector = Detector.miri_imager().without(CosmicRays)
    ramp = detector.expose(make_sky(exposure, 2e4), exposure, seed=0)
    latent = Latent.from_ramp(ramp, 1 * u.s, threshold=0)
    out = ramp.pixel_dq & np.uint32(DQ.REFERENCE_PIXEL | DQ.DO_NOT_USE) != 0
    assert out.any()
    assert not latent.rate[out].value.any()
    assert np.all(latent.rate[~out].value > 0)


def test_refuses_what_cannot_be_remembered(make_exposure, make_sky):
    exposure = make_exposure(n_groups=2)
    sky = make_sky(exposure, 1.0)
    latent = latent_of(exposure, 10.0)
    wanted = "'previous' must be given to a detector whose effects"
    refuses(wanted, Detector.miri_imager().expose, sky, exposure, previous=latent)
    expose = Detector.miri_imager(Persistence()).expose
    small = Latent(np.ones((3, 4)) * RATE, 1 * u.s)
    refuses("'previous' must be of SUB64", expose, sky, exposure, previous=small)
    for previous in ([3], 3):
        wanted = "'previous' must be a Latent or several"
        refuses(wanted, expose, sky, exposure, previous=previous)
    wanted = "no sub-array 'SUB65'; known: BRIGHTSKY"
    refuses(wanted, Latent, np.ones((2, 2)) * RATE, 1 * u.s, "SUB65", error=KeyError)
    refuses("'ramp' must be a Ramp", Latent.from_ramp, sky, 1 * u.s)
    refuses("'rate' must be nowhere negative", Latent, np.array([[-1.0]]) * RATE, 1 * u.s)
    refuses("'gap' must be at least 0 s", Latent, np.ones((2, 2)) * RATE, -1 * u.s)
    for amplitudes in ((0.1, 0.2, 0.3), ()):
        refuses("'amplitudes, times' must be", Persistence, amplitudes, amplitudes[:2])
