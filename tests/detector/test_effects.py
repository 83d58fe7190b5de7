import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale import detector
from miricigale.depth import residual_amplitude
from miricigale.detector import (
    BadPixels,
    Bias,
    Block,
    CosmicRays,
    Dark,
    Detector,
    InterpixelCapacitance,
    Nonlinearity,
    ReadNoise,
    ReferencePixels,
    Residual,
    Saturation,
)
from miricigale.instrument import DQ, aperture, bad_pixel_mask, miri_detector


def empty(block):
    return np.zeros(block.ramp_shape, np.float32)


def test_integrations_are_independent(make_block):
    block = make_block(n_groups=4, n_integrations=3, subarray="SUB256")
    last = Dark(current=100).apply(empty(block), block)[:, -1].reshape(3, -1)
    correlation = np.corrcoef(last) - np.eye(3)
    assert np.abs(correlation).max() < 5 / np.sqrt(last.shape[1])


def rows_of(block, rows):
    """Some rows of a block."""
    flags = {"pixel_dq": block.pixel_dq[rows], "group_dq": block.group_dq[:, :, rows]}
    return dataclasses.replace(block, rows=rows, **flags)


def test_number_of_cosmic_rays(make_block):
    # hits without track, scatter or leakage leave the same charge each
    effect = CosmicRays(track_max=0, yield_dex=0, leakage=0, thickness=35, yield_median=10)
    block = make_block(n_groups=200, n_integrations=2, subarray="FULL")
    block = rows_of(block, slice(100, 164))
    ramp = effect.apply(empty(block), block)
    hits = ramp[:, -1].sum(dtype=float) / 350
    assert hits == pytest.approx(round(hits), abs=1e-3)
    # 4.9e-8 hits / um2 / s at solar minimum, times 1.7
    expected = 4.9e-8 * 1.7 * (25**2 * 64 * 1032) * (2 * 200 * 2.775)
    assert abs(hits - expected) < 4 * np.sqrt(expected) + 0.01 * expected
    # they come at any time
    when = np.nonzero(np.diff(ramp, axis=1, prepend=0).sum(axis=(2, 3)).ravel())[0]
    assert stats.kstest(when / 400, "uniform").pvalue > 1e-3


def test_cosmic_rays_leak_to_their_neighbors(make_block):
    effect = CosmicRays(flux=3e-5, track_max=0, yield_dex=0, leakage=0.03)
    block = make_block(n_groups=2)
    image = effect.apply(empty(block), block)[0, -1]
    charge = 35 * 100
    # an isolated hit: no other one near
    isolated = [
        (y, x)
        for y in range(2, 62)
        for x in range(2, 70)
        if image[y, x] == pytest.approx(0.88 * charge, rel=1e-5)
        and image[y - 2 : y + 3, x - 2 : x + 3].sum() == pytest.approx(charge, rel=1e-5)
    ]
    assert isolated
    for y, x in isolated:
        for side in (image[y - 1, x], image[y + 1, x], image[y, x - 1], image[y, x + 1]):
            assert side == pytest.approx(0.03 * charge, rel=1e-5)
        assert image[y - 1, x - 1] == 0


def test_tracks_keep_the_charge_and_their_lengths(make_block):
    block = make_block(n_groups=60, subarray="SUB256")
    options = {"flux": 2e-5, "yield_dex": 0, "yield_median": 10, "leakage": 0}
    ramp = CosmicRays(track_max=16, **options).apply(empty(block), block)
    hits = 2e-5 * 25**2 * 256**2 * 60 * 0.3
    # the mean of thickness / cos is 2 thickness for p(cos) = 2 cos, less where tracks are cut
    cut = np.hypot(1, 16 * 25 / 35)
    mean_path = 35 * (2 - 1 / cut)
    assert ramp[0, -1].sum(dtype=float) == pytest.approx(hits * mean_path * 10, rel=0.05)


def test_showers_are_faint_and_wide(make_block):
    block = make_block(n_groups=10, subarray="SUB256")
    options = {"flux": 3e-7, "yield_median": 0.0}
    effect = CosmicRays(shower_fraction=1.0, shower_charge=1e5, yield_dex=0, **options)
    dull = CosmicRays(**options)
    image = effect.apply(empty(block), block)[0, -1]
    assert dull.apply(empty(block), block).max() == 0
    assert np.count_nonzero(image) > 1000
    # a Gaussian of 10^5 electrons, 15 pixels wide
    assert 0 < image.max() < 20 * 1e5 / (2 * np.pi * 15**2)


def test_bad_and_reference_pixels(make_block):
    block = make_block(n_groups=5, subarray="FULL")
    ramp = np.full(block.ramp_shape, 100, np.float32)
    ramp = ReferencePixels().apply(BadPixels(hot_current=1e4).apply(ramp, block), block)
    bad = bad_pixel_mask()
    assert_array_equal(block.pixel_dq & DQ.DO_NOT_USE != 0, bad)
    assert np.all(ramp[:, :, block.pixel_dq & DQ.DEAD != 0] == 0)
    assert np.all(ramp[:, -1][:, block.pixel_dq & DQ.HOT != 0] > 1e5)
    reference = block.pixel_dq & DQ.REFERENCE_PIXEL != 0
    assert np.flatnonzero(reference.any(axis=0)).tolist() == [0, 1, 2, 3, 1028, 1029, 1030, 1031]
    assert ramp[:, :, reference].max() == 0
    assert np.all(ramp[:, :, block.pixel_dq == 0] == 100)


def test_saturation_stops_and_flags(make_block):
    block = make_block(n_groups=4)
    ramp = empty(block)
    ramp[0, :, 5, 6] = [1e5, 2e5, 2.1e5, 3e5]
    ramp = Saturation().apply(ramp, block)
    assert ramp[0, :, 5, 6].tolist() == [1e5, 2e5, 2.1e5, 2.1e5]
    assert block.group_dq[0, :, 5, 6].tolist() == [0, 0, DQ.SATURATED, DQ.SATURATED]
    assert np.count_nonzero(block.group_dq) == 2


def test_linearize_undoes_the_nonlinearity(make_block):
    block = make_block(n_groups=2)
    electrons = np.linspace(0, 210e3, 2 * 64 * 72)
    charge = electrons.astype(np.float32).reshape(block.ramp_shape)
    ramp = Nonlinearity().apply(charge.copy(), block)
    assert np.all(ramp.ravel()[1:] <= electrons[1:] / 4)
    linear = miri_detector().linearize(ramp).ravel()
    assert_allclose(linear, electrons / 4, atol=0.02)
    ramp = Nonlinearity(linear=True).apply(charge.copy(), block)
    assert_allclose(ramp.ravel(), electrons / 4, atol=0.01)


def test_bias_and_reset_noise(make_block):
    block = make_block(n_groups=3, n_integrations=2, subarray="SUB256")
    assert np.all(Bias(level=500).apply(empty(block), block) == 500)
    ramp = Bias(reset_noise=5).apply(empty(block), block)
    n = ramp[0, 0].size
    assert np.all(ramp[:, 0] == ramp[:, 2])
    assert ramp.mean() == pytest.approx(11000, abs=5 * 5 / np.sqrt(2 * n))
    assert ramp[0, 0].std() == pytest.approx(5, rel=5 / np.sqrt(2 * n))
    assert abs(np.corrcoef(ramp[0, 0].ravel(), ramp[1, 0].ravel())[0, 1]) < 5 / np.sqrt(n)


def test_read_noise(make_block):
    block = make_block(n_groups=3, subarray="SUB256")
    ramp = ReadNoise().apply(empty(block), block)
    assert ramp.std() == pytest.approx(6, rel=5 / np.sqrt(2 * ramp.size))
    pink = ReadNoise(sigma=0, pink=3.0).apply(empty(block), block)
    assert_array_equal(pink[..., 0], pink[..., 4])


def test_pink_noise_has_as_much_power_in_every_octave(make_block):
    # 1/f: the variance between rows that are read 1, 2, 4 ... apart grows by equal amounts
    block = make_block(n_groups=2000, n_integrations=2)
    ramp = ReadNoise(sigma=0, pink=4.0, octaves=16).apply(empty(block), block)
    drift = ramp[..., :4].astype(float).reshape(-1, 4)
    lags = 2 ** np.arange(9)
    growth = np.diff([np.mean((drift[lag:] - drift[:-lag]) ** 2) for lag in lags])
    # two rows share what changes more slowly than they are apart: 2 sigma^2 / 16 an octave
    assert_allclose(growth, 2 * 4.0**2 / 16, rtol=0.15)
    # the slowest octaves, 32768 rows long, are drawn 8 times for each of 4 outputs
    assert drift.std() == pytest.approx(4.0, rel=0.1)


def test_coupling_keeps_a_flat_field_and_spreads_a_point(make_block):
    block = make_block(n_groups=2)
    flat = InterpixelCapacitance().apply(np.full(block.ramp_shape, 1000, np.float32), block)
    assert_allclose(flat, 1000, rtol=1e-6)
    ramp = empty(block)
    ramp[:, :, 30, 40] = 1000
    ramp = InterpixelCapacitance().apply(ramp, block)
    assert_allclose(ramp[0, 0, 29:32, 39:42] / 1000, miri_detector().ipc_kernel, rtol=1e-6)


@pytest.mark.parametrize("correlation", [0.0, 1.0, 3.0])
def test_residual_is_fixed_on_the_detector(make_block, correlation):
    effect = Residual(0.01, correlation=correlation)
    one, two = make_block(seed=1, subarray="SUB256"), make_block(seed=2, subarray="SUB256")
    light = np.full(one.exposure.shape, 100.0)
    pattern = effect.apply(light, one)
    assert_array_equal(pattern, effect.apply(light, two))
    n_independent = light.size / max(1, 4 * np.pi * correlation**2)
    assert pattern.std() == pytest.approx(1, rel=5 / np.sqrt(2 * n_independent))
    other = make_block("miri.f1000w", subarray="SUB256")
    assert np.abs(effect.apply(light, other) - pattern).max() > 1
    # and it does not know blocks
    part = Block(one.exposure, one.properties, slice(50, 60), None, None, one.key)
    assert_allclose(effect.apply(light[50:60], part), pattern[50:60], rtol=1e-12)


@pytest.mark.parametrize("correlation", [0.0, 1.3])
@pytest.mark.parametrize("subarray", ["SUB256", "SUB64", "BRIGHTSKY"])
def test_sub_arrays_see_their_part_of_the_residual(make_block, subarray, correlation):
    # the same pixels, whichever of them are read: as for the flat field
    effect = Residual(0.01, correlation=correlation)
    rows, columns = aperture(subarray).slices
    full, part = make_block(subarray="FULL", n_groups=2), make_block(subarray=subarray, n_groups=2)
    whole = effect.apply(np.ones(full.exposure.shape), full)
    own = effect.apply(np.ones(part.exposure.shape), part)
    assert_allclose(own - 1, whole[rows, columns] - 1, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("name", ["miri.f560w", "miri.f2550w"])
def test_residual_by_name_has_the_amplitude_of_the_filter(make_block, name):
    block = make_block(name, subarray="SUB256")
    light = np.full(block.exposure.shape, 100.0)
    pattern = Residual("etc").apply(light, block)
    # 65536 pixels, of which the correlation leaves one in 4 pi independent
    assert pattern.std() / 100 == pytest.approx(residual_amplitude(name), rel=0.05)
    assert Residual("etc") in Detector.miri_imager(Residual("etc")).effects
    refuses("no residual preset 'flat'; known: etc", Residual, "flat", error=KeyError)


def test_a_residual_keeps_the_mean_light(make_block):
    """Of 65536 pixels that scatter by 20 %; divided by the pattern they would be 4 % too bright."""
    block = make_block(subarray="SUB256")
    light = np.full(block.exposure.shape, 100.0)
    uneven = Residual(0.2, correlation=0).apply(light, block)
    assert np.mean(uneven) == pytest.approx(100.0, abs=5 * 20 / np.sqrt(light.size))


#: Values out of range, by effect and argument.
WRONG = cases_of(__file__)


@pytest.mark.parametrize("effect", WRONG)
def test_errors_name_the_argument(effect):
    needed = {"amplitude": 0.01} if effect == "Residual" else {}
    for name, values in WRONG[effect].items():
        for value in values:
            refuses(f"'{name}' must be", getattr(detector, effect), **{**needed, name: value})
