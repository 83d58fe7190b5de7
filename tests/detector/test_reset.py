"""Reset anomaly, first and last frame: their curves, and rates that do not know of them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from miricigale.detector import (
    ADConversion,
    BadPixels,
    Bias,
    CosmicRays,
    Detector,
    FirstFrame,
    LastFrame,
    Nonlinearity,
    Persistence,
    Photons,
    ResetAnomaly,
    ResetDecay,
)
from miricigale.instrument import background_level, miri_detector, reference_pixel_mask
from miricigale.reduction import Reducer

BIAS = miri_detector().bias


def noiseless(*effects):
    """A detector that adds nothing but these effects and the bias."""
    return Detector((Photons(flat=False), Nonlinearity(), *effects, Bias(), ADConversion()))


def test_the_anomaly_decays_exponentially(make_exposure, make_sky):
    exposure = make_exposure(n_groups=25, n_integrations=4)
    effect = ResetAnomaly(amplitudes=(-300.0, -200.0, -100.0), groups=4.0)
    ramp = noiseless(effect).expose(make_sky(exposure, 0.0), exposure, seed=0)
    sees = ~reference_pixel_mask(subarray="SUB64")
    counts = ramp.data[:, :, sees].astype(float) - BIAS
    # every pixel alike, to the rounding of the converter
    assert np.ptp(counts, axis=2).max() == 0
    group = np.arange(25)
    for i, amplitude in enumerate((-300.0, -200.0, -100.0, -100.0)):
        assert_allclose(counts[i, :, 0], amplitude * np.exp(-group / 4), atol=0.501)
    assert_array_equal(ramp.data[:, :, ~sees], BIAS)


def test_the_anomaly_is_gone_by_the_fifteenth_group():
    # as the pipeline's documentation has it for the full array: below the noise of one read
    offsets = ResetAnomaly().offsets(3, 40)
    assert np.all(np.abs(offsets[:, 14:]) < miri_detector().read_noise / 6)
    # and the first two groups are off the most
    assert np.all(np.diff(np.abs(offsets), axis=1) < 0)


def test_the_first_frame_is_the_first_group_alone(make_exposure, make_sky):
    exposure = make_exposure(n_groups=4, n_integrations=2)
    ramp = noiseless(FirstFrame(offset=-40.0)).expose(make_sky(exposure, 0.0), exposure, seed=0)
    sees = ~reference_pixel_mask(subarray="SUB64")
    assert np.all(ramp.data[:, 0][:, sees] == BIAS - 40)
    assert np.all(ramp.data[:, 1:] == BIAS)
    assert np.all(ramp.data[:, :, ~sees] == BIAS)


def test_the_last_frame_feels_the_row_pair_before(make_block):
    block = make_block(n_groups=3, n_integrations=2, seed=0)
    rng = np.random.default_rng(2)
    signal = rng.uniform(0, 5e4, block.ramp_shape).astype(np.float32)
    pulled = LastFrame(offset=-20.0, coupling=0.01).apply(signal.copy(), block)
    assert_array_equal(pulled[:, :-1], signal[:, :-1])
    change = (pulled - signal)[:, -1].astype(float)
    sees = ~reference_pixel_mask(subarray="SUB64")
    # rows are reset two by two: rows 2k and 2k + 1 feel the mean of rows 2k - 2 and 2k - 1
    pairs = signal[:, -1].astype(float).reshape(2, -1, 2, signal.shape[-1]).mean(axis=2)
    expected = -20.0 - 0.01 * np.repeat(pairs[:, :-1], 2, axis=1)
    assert_allclose(change[:, 2:][:, sees[2:]], expected[:, sees[2:]], atol=0.01)
    assert not change[:, :2].any()
    assert not change[:, ~sees].any()


def test_the_decay_goes_with_the_signal_of_the_integration_before(make_block):
    block = make_block(n_groups=6, n_integrations=3, seed=0)
    rng = np.random.default_rng(3)
    signal = rng.uniform(0, 5e4, block.ramp_shape).astype(np.float32)
    change = ResetDecay(share=-0.02, groups=1.5).apply(signal.copy(), block) - signal
    sees = ~reference_pixel_mask(subarray="SUB64")
    decay = -0.02 * np.exp(-np.arange(6) / 1.5)
    expected = decay[:, None] * signal[:-1, -1][:, None, sees].astype(float)
    assert_allclose(change[1:][:, :, sees], expected, atol=0.01)
    assert not change[0].any()
    assert not change[:, :, ~sees].any()


def test_the_decay_is_told_and_gone_with_the_first_groups(make_exposure, make_sky):
    exposure = make_exposure(n_groups=20, n_integrations=3)
    detector = Detector.miri_imager().without(CosmicRays, BadPixels)
    sky = make_sky(exposure, 4e3)
    plain = detector.expose(sky, exposure, seed=1)
    spoilt = detector.replace(ResetDecay(groups=1.0)).expose(sky, exposure, seed=1)
    left = warned("shows a decay after the resets", Reducer(jump_threshold=None).fit_groups, spoilt)
    reducer = Reducer(skip_first=8, jump_threshold=None)
    clean, fit = reducer.fit_groups(plain), reducer.fit_groups(spoilt)
    good = np.isfinite(clean.rate)
    assert np.nanmean(fit.rate) == pytest.approx(np.mean(clean.rate[good]), rel=1e-4)
    assert np.nanmean(left.rate) > 1.001 * np.mean(clean.rate[good])
    with pytest.raises(ValueError, match="brighter-fatter effect and decay after resets"):
        detector.replace(ResetDecay()).collect(sky, exposure, seed=1)


@pytest.mark.parametrize(
    ("band", "n_groups", "n_integrations"), [("miri.f770w", 20, 2), ("miri.f2100w", 10, 4)]
)
def test_the_rate_does_not_know_of_them(make_exposure, make_sky, band, n_groups, n_integrations):
    mode = {"n_groups": n_groups, "n_integrations": n_integrations}
    exposure = make_exposure(band, subarray="SUB256", **mode)
    sky = make_sky(exposure, background_level(band).value, includes=())
    plain = Detector.miri_imager().without(CosmicRays, BadPixels)
    spoilt = plain.replace(ResetAnomaly(), FirstFrame(), LastFrame())
    reducer = Reducer(reset_anomaly=ResetAnomaly())
    clean = Reducer(skip_first=1, skip_last=1).fit_groups(plain.expose(sky, exposure, seed=1))
    fit = reducer.fit_groups(spoilt.expose(sky, exposure, seed=1))
    # one group at each end is gone, as in the pipeline
    assert fit.n_used.max() == n_integrations * (n_groups - 3)
    # the same photons and noise: what differs is the rounding of counts, and jumps by chance
    good = np.isfinite(fit.rate) & (fit.n_jump == 0) & (clean.n_jump == 0)
    assert np.count_nonzero(good) > 0.99 * good.size - 256 * 8
    pull = (fit.rate - clean.rate)[good] / clean.error[good]
    assert np.abs(pull).max() < 0.5
    assert np.mean(fit.rate[good]) == pytest.approx(np.mean(clean.rate[good]), rel=2e-4)
    # left in, they would show
    left = Reducer(skip_first=0, skip_last=0).fit_groups(spoilt.expose(sky, exposure, seed=1))
    assert abs(np.nanmean(left.rate) / np.mean(clean.rate[good]) - 1) > 5e-3


def test_each_integration_has_its_own_anomaly(make_exposure, make_sky):
    exposure = make_exposure(n_groups=12, n_integrations=3)
    anomaly = ResetAnomaly(amplitudes=(-60.0, -20.0, 10.0))
    sky = make_sky(exposure, 300.0)
    clean = Reducer().fit_integrations(noiseless().expose(sky, exposure, seed=1))
    ramp = noiseless(anomaly).expose(sky, exposure, seed=1)
    for rate, wanted in zip(
        Reducer(reset_anomaly=anomaly).fit_integrations(ramp), clean, strict=True
    ):
        assert_allclose(np.nanmedian(rate.data), np.nanmedian(wanted.data), rtol=3e-3)


def test_an_anomaly_that_stays_is_told(make_exposure, make_sky):
    exposure = make_exposure(n_groups=5)
    detector = Detector.miri_imager(ResetAnomaly())
    ramp = detector.expose(make_sky(exposure, 300.0), exposure, seed=0)
    warned("shows a reset anomaly", Reducer().fit_groups, ramp)
    Reducer(skip_first=2).fit_groups(ramp)
    refuses("'reset_anomaly' must be a ResetAnomaly", Reducer, reset_anomaly=True)


def test_short_integrations_keep_two_groups(make_exposure, make_sky):
    detector = Detector.miri_imager(FirstFrame(), LastFrame()).without(CosmicRays)
    for n_groups, left in ((2, 2), (3, 2), (4, 2), (6, 4)):
        exposure = make_exposure(n_groups=n_groups)
        ramp = detector.expose(make_sky(exposure, 30.0), exposure, seed=0)
        assert Reducer().fit_groups(ramp).n_used.max() == left - 1


def test_they_stand_between_response_and_bias():
    resets = ResetAnomaly(), ResetDecay(), FirstFrame(), LastFrame()
    effects = Detector.miri_imager(*resets, Persistence()).effects
    start = effects.index(Nonlinearity())
    assert effects[start : start + 6] == (Nonlinearity(), *resets, Bias())
    # and none of them is there unless it is asked for
    assert len(Detector.miri_imager().effects) == len(effects) - 5
