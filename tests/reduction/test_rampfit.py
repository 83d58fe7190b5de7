import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from helpers.errors import refuses
from miricigale.instrument import DQ, miri_detector
from miricigale.reduction import DetectorMaps, fit_groups, reference_channels, reference_drift
from miricigale.reduction._core.pixel import LEAK, own_charge

DT, GAIN, READ, BIAS = 2.775, 4.0, 6.0, 11000.0
OPTIONS = {"group_time": DT, "gain": GAIN, "read_noise": READ, "bias": BIAS}
MAPS = {field.name for field in dataclasses.fields(DetectorMaps)}


def fitted(data, **options):
    """Fit to a ramp; what the detector is taken for is among the options."""
    maps = {name: options.pop(name) for name in MAPS & set(options)}
    return fit_groups(data, DetectorMaps(**maps), **options)


def simulate(rate, n_int, n_group, *, seed=0, read=READ, gain=GAIN, dtype=np.uint16, jumps=()):
    """Poisson charge, Gaussian read noise; jumps are (integration, group, amplitude)."""
    rng = np.random.default_rng(seed)
    rate = np.asarray(rate, float)
    data = np.empty((n_int, n_group, *rate.shape))
    for k in range(n_int):
        charge = np.zeros(rate.shape)
        for g in range(n_group):
            charge += rng.poisson(rate * DT * gain) / gain
            for where, start, amplitude in jumps:
                if where == k and start == g:
                    charge += amplitude
            data[k, g] = charge + BIAS + read * rng.normal(size=rate.shape)
    if dtype == np.uint16:
        data = np.clip(np.rint(data), 0, 65535)
    return data.astype(dtype)


def covariance(n, v, s):
    """Covariance of n differences of consecutive reads."""
    return (v + 2 * s) * np.eye(n) - s * (np.eye(n, k=1) + np.eye(n, k=-1))


def gls(segments, v, s):
    """Slope and variance by dense linear algebra."""
    info = sum(np.sum(np.linalg.inv(covariance(len(d), v, s))) for d in segments)
    num = sum(np.sum(np.linalg.inv(covariance(len(d), v, s)) @ d) for d in segments)
    return num / info, 1 / info


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3, 10, 100])
def test_pure_read_noise_has_the_variance_of_least_squares(n):
    data = simulate(np.full((4, 70), 3.0), 1, n, dtype=np.float32, seed=n)
    # no photon noise: each DN stands for a great many electrons
    fit = fitted(data, **{**OPTIONS, "gain": 1e15}, jump_threshold=None)
    expected = 12 * READ**2 / (n * (n**2 - 1) * DT**2)
    assert_allclose(fit.var_read, expected, rtol=1e-4)
    assert np.all(fit.var_poisson < 1e-4 * expected)
    # and the slope is that of an unweighted line
    lines = np.polyfit(np.arange(n) * DT, data.reshape(n, -1).astype(float), 1)[0]
    assert_allclose(fit.rate.ravel(), lines, atol=2e-4)


@pytest.mark.parametrize("n_sigma", [4.0, 5.0, 6.0, 8.0])
def test_jump_efficiency_follows_from_the_noise(n_sigma):
    n, rate, at = 40, 20.0, 17
    s, v = READ**2 + 1 / 12, rate * DT / GAIN
    inverse = np.linalg.inv(covariance(n - 1, v, s))
    w = inverse.sum(axis=0)
    precision = inverse[at - 1, at - 1] - w[at - 1] ** 2 / w.sum()
    amplitude = n_sigma / np.sqrt(precision)
    data = simulate(np.full((60, 64), rate), 1, n, seed=7, jumps=[(0, at, amplitude)])
    fit = fitted(data, **OPTIONS, neighbor_threshold=None)
    found = fit.jumps[np.abs(fit.jumps["group"] - at) <= 1]
    assert len(found) / 3840 == pytest.approx(norm.sf(5 - n_sigma), abs=0.03)
    # better than two reads alone could do
    assert amplitude < n_sigma * np.sqrt(v + 2 * s)


def test_neighbors_of_a_large_jump_are_cut_at_the_same_group():
    data = simulate(np.full((7, 9), 10.0), 1, 30, seed=1)
    data[0, 20:, 3, 4] += 3000
    fit = fitted(data, **OPTIONS)
    expected = np.zeros((7, 9), np.int64)
    expected[3, 4] = DQ.JUMP_DET
    for y, x in ((2, 4), (4, 4), (3, 3), (3, 5)):
        expected[y, x] = DQ.JUMP_DET | DQ.JUMP_NEIGHBOR
    assert_array_equal(fit.flags, expected)
    assert np.all(fit.n_used[expected > 0] == 28)
    alone = fitted(data, **OPTIONS, neighbor_threshold=None)
    assert_array_equal(alone.flags == DQ.JUMP_DET, expected == DQ.JUMP_DET)


def ray_tracks(n_rays, n_group, n, *, seed):
    """Charge in DN of straight tracks that fade towards their end, by the group in which they come."""
    rng = np.random.default_rng(seed)
    charge = np.zeros((n_group, n, n))
    for _ in range(n_rays):
        length = rng.exponential(2.5)
        angle = rng.uniform(0, 2 * np.pi)
        n_steps = max(int(20 * length), 1)
        steps = np.linspace(0, length, n_steps)
        # charge diffuses by a third of a pixel, and a particle that stops releases less and less
        x, y = rng.uniform(3, n - 3, (2, 1)) + rng.normal(0, 0.35, (2, n_steps))
        x += steps * np.cos(angle)
        y += steps * np.sin(angle)
        weight = np.linspace(1, 0.03, n_steps) * rng.gamma(2, 0.5, n_steps)
        inside = (x > 0) & (x < n) & (y > 0) & (y < n)
        total = 10 ** rng.normal(3.2, 0.5) * max(length, 0.3) / GAIN
        place = (rng.integers(1, n_group), y[inside].astype(int), x[inside].astype(int))
        np.add.at(charge, place, (total * weight / weight.sum())[inside])
    return charge


def test_faint_ends_of_tracks_are_cut_with_their_neighbors():
    """Pulls of the pixels that rays hit, of rays that are not those of the simulated detector."""
    charge = ray_tracks(700, 40, 160, seed=3)
    data = simulate(np.full((160, 160), 10.0), 1, 40, seed=2, dtype=np.float32)
    data[0] += np.cumsum(charge, axis=0)
    hit = charge.sum(axis=0) * GAIN > 30
    scatter = {}
    for threshold in (5.0, None):
        fit = fitted(data, **OPTIONS, neighbor_threshold=threshold)
        pull = (fit.rate - 10.0) / np.sqrt(fit.var_poisson + fit.var_read)
        scatter[threshold] = pull[hit].std()
        assert pull[~hit].std() == pytest.approx(1, abs=0.02)
    assert scatter[5.0] < 1.05
    assert scatter[None] > 1.1


def test_what_leaked_into_a_pixel_does_not_cut_its_neighbors():
    data = simulate(np.full((9, 11), 10.0), 1, 30, seed=1)
    # a hit of some 300 sigma whose leak of 3 % stands above 10 sigma, and beside it a hit of its own
    data[0, 20:, 4, 5] += 6000
    for y, x in ((3, 5), (5, 5), (4, 4), (4, 6)):
        data[0, 20:, y, x] += 180
    fit = fitted(data, **OPTIONS)
    assert np.all(np.abs(fit.jumps["significance"]) > 10)
    assert len(fit.jumps) == 5
    assert np.count_nonzero(fit.flags) == 5
    data[0, 20:, 4, 6] += 600
    fit = fitted(data, **OPTIONS)
    beside = {(int(y), int(x)) for y, x in np.argwhere(fit.flags & DQ.JUMP_NEIGHBOR)}
    assert beside == {(3, 5), (5, 5), (4, 4), (4, 6), (4, 5), (3, 6), (5, 6), (4, 7)}


def test_what_saturates_at_once_is_masked_with_the_reason():
    data = simulate(np.full((3, 5), 10.0), 2, 6)
    data[:, 1:, 0, 0] = 65535
    data[:, :, 0, 1] = 65535
    data[0, :, 0, 2] = 65535
    data[:, 2:, 0, 3] = 65535
    # the limit itself is saturated, as in the pipeline
    data[0, 5:, 0, 4] = 63000
    fit = fitted(data, **OPTIONS, saturation=63000.0)
    gone = DQ.SATURATED | DQ.NO_SLOPE | DQ.DO_NOT_USE
    assert fit.flags[0, 0] == fit.flags[0, 1] == gone
    assert np.all(np.isnan(fit.rate[0, :2]))
    # one integration, or one difference in each, is enough
    assert fit.flags[0, 2] == fit.flags[0, 3] == fit.flags[0, 4] == DQ.SATURATED
    assert fit.n_used[0, 2] == 5
    assert fit.n_used[0, 3] == 2
    assert np.all(np.abs(fit.rate[0, 2:4] - 10) < 5 * fit.error[0, 2:4])


def test_linearity_polynomial_is_undone():
    detector = miri_detector()
    rate = np.linspace(100, 900, 32 * 64).reshape(32, 64)
    measured = BIAS + detector.delinearize(rate * DT * np.arange(1, 21)[:, None, None])
    data = measured[None].astype(np.float32)
    fit = fitted(data, **OPTIONS, linearity=detector.nonlinearity)
    assert_allclose(fit.rate, rate, rtol=1e-5)


def test_result_does_not_depend_on_threads_or_on_the_rest_of_the_frame():
    rng = np.random.default_rng(3)
    rate = rng.gamma(2, 20, (100, 130))
    data = simulate(rate, 2, 12, seed=8)
    # hits at random
    for _ in range(300):
        k, g, y, x = (rng.integers(n) for n in data.shape)
        data[k, g:, y, x] += np.uint16(rng.uniform(50, 5000))
    one = fitted(data, **OPTIONS, n_threads=1)
    three = fitted(data, **OPTIONS, n_threads=3)
    part = fitted(data[:, :, 20:70], **OPTIONS, neighbor_threshold=None)
    whole = fitted(data, **OPTIONS, neighbor_threshold=None)
    for name in ("rate", "var_poisson", "var_read", "n_used", "n_jump", "flags"):
        assert_array_equal(getattr(one, name), getattr(three, name))
        assert_array_equal(getattr(part, name), getattr(whole, name)[20:70])
    assert_array_equal(one.jumps, three.jumps)


def test_reference_columns_follow_the_drift():
    data = simulate(np.zeros((64, 40)), 2, 5, seed=1, dtype=np.float32)
    drift = np.array([[0, 3, -2, 5, 1], [10, 2, 2, -8, 4.0]])
    data += drift[:, :, None, None].astype(np.float32)
    mask = np.zeros((64, 40), bool)
    mask[:, :4] = mask[:, -4:] = True
    found = reference_drift(data, mask)
    assert_allclose(found, drift - drift.mean(), atol=5 * READ / np.sqrt(512))
    assert np.all(reference_drift(data, np.zeros_like(mask)) == 0)


def test_maps_give_each_pixel_what_its_own_constants_give():
    rng = np.random.default_rng(5)
    shape = (6, 70)
    data = simulate(rng.gamma(2, 30, shape), 2, 15, seed=2)
    data[1, 6:, 2, 5] += 900
    options = {**OPTIONS, "neighbor_threshold": None, "saturation": 14000.0}
    linear = np.array([0, 1, 2e-6, 1e-11])
    maps = {
        "gain": rng.choice([3.0, 5.5], shape),
        "read_noise": rng.choice([4.0, 9.0], shape),
        "bias": rng.choice([10900.0, 11050.0], shape),
        "saturation": rng.choice([12500.0, 15000.0], shape),
        "linearity": linear[:, None, None] * rng.choice([0.5, 1.0], shape),
    }
    maps["linearity"][1] = 1
    fit = fitted(data, **{**options, **maps})
    for y, x in [(0, 0), (2, 5), (3, 33), (5, 63), (5, 64), (4, 69)]:
        one = {name: values[..., y, x] for name, values in maps.items()}
        alone = fitted(data[:, :, y : y + 1, x : x + 1], **{**options, **one})
        for name in ("rate", "var_poisson", "var_read", "n_used", "flags"):
            assert getattr(fit, name)[y, x] == getattr(alone, name)[0, 0]
    # values of pixels that are not used do not matter
    usable = np.ones(shape, bool)
    usable[1, 1] = False
    maps["gain"][1, 1] = np.nan
    again = fitted(data, usable=usable, **{**options, **maps})
    assert_array_equal(again.rate[usable], fit.rate[usable])
    refuses("'gain' must be positive, got 1 pixels", fitted, data, **{**options, **maps})


def test_reset_anomaly_and_dark_are_taken_off_by_group_and_integration():
    rng = np.random.default_rng(6)
    truth = rng.gamma(2, 30, (6, 70))
    plain = np.stack([truth * DT * np.arange(1, 11)[:, None, None]] * 3) + BIAS
    reset = rng.normal(0, 30, (2, 4, 6, 70)).astype(np.float32)
    dark = np.cumsum(rng.gamma(2, 2, (1, 12, 6, 70)), axis=1).astype(np.float32)
    spoilt = (plain + dark[:, :10]).astype(np.float32)
    spoilt[:, :4] += reset[[0, 1, 1]]
    options = {**OPTIONS, "jump_threshold": None}
    fit = fitted(spoilt, reset=reset, dark=dark, **options)
    assert_allclose(fit.rate, truth, rtol=2e-4, atol=2e-4)
    refuses("'dark' must be of shape", fitted, data=spoilt, dark=dark[:, :9], **options)


def test_flags_of_groups_are_cuts():
    data = simulate(np.full((3, 50), 30.0), 2, 20, seed=11)
    flags = np.zeros(data.shape, np.uint8)
    spoilt = data.copy()
    # a hit, a bad group, the end of an integration, and the first group of all
    flags[0, 7, 1, 10] = DQ.JUMP_DET
    spoilt[0, 7:, 1, 10] += 700
    flags[1, 5, 1, 20] = DQ.DO_NOT_USE
    spoilt[1, 5, 1, 20] += 500
    flags[0, 12:, 2, 49] = DQ.SATURATED
    spoilt[0, 12:, 2, 49] = 13000
    flags[:, 0] |= np.uint8(DQ.DO_NOT_USE)
    spoilt[:, 0] += 99
    options = {**OPTIONS, "jump_threshold": None}
    fit = fitted(spoilt, group_dq=flags, **options)
    # the same cuts by dense linear algebra
    differences = np.diff(data.astype(float), axis=1)[:, 1:]
    kept = {
        (0, 0): [(0, 0, 18), (1, 0, 18)],
        (1, 10): [(0, 0, 5), (0, 6, 18), (1, 0, 18)],
        (1, 20): [(0, 0, 18), (1, 0, 3), (1, 5, 18)],
        (2, 49): [(0, 0, 10), (1, 0, 18)],
    }
    for (y, x), runs in kept.items():
        segments = [differences[k, a:b, y, x] for k, a, b in runs]
        slope = np.concatenate(segments).mean()
        for _ in range(2):
            slope, variance = gls(segments, slope / GAIN, READ**2 + 1 / 12)
        assert fit.rate[y, x] * DT == pytest.approx(slope, rel=1e-5)
        assert fit.error[y, x] * DT == pytest.approx(np.sqrt(variance), rel=1e-4)
        assert fit.n_used[y, x] == sum(b - a for _, a, b in runs)
    assert fit.flags[1, 10] == DQ.JUMP_DET
    assert fit.flags[2, 49] == DQ.SATURATED


def test_drift_of_channels_and_rows_is_taken_off_as_in_the_official_pipeline():
    # what jwst.refpix (MIRIDataset.do_fullframe_corrections) subtracts, written out
    rng = np.random.default_rng(3)
    data = rng.normal(11000, 5, (2, 4, 40, 24))
    data[0, 2, 7, 1] += 300
    expected = data.copy()
    for k, g in np.ndindex(2, 4):
        for channel in range(4) if g else ():
            for start in (0, 1):
                means = []
                for column in (channel, 20 + channel):
                    values = (data[k, g] - data[k, 0])[start::2, column]
                    while True:
                        inside = np.abs(values - values.mean()) <= 3 * values.std()
                        if inside.all():
                            break
                        values = values[inside]
                    means.append(values.mean())
                expected[k, g, start::2, channel::4] -= np.mean(means)
    mask = np.zeros((40, 24), bool)
    mask[:, :4] = mask[:, -4:] = True
    drift = reference_channels(data, mask)
    assert_allclose(data - np.tile(drift, 6), expected, atol=1e-9)
    # a part of the frame, with the first row odd and columns on one side
    half = reference_channels(data[:, :, 1:, :12], mask[1:, :12], origin=(0, 1))
    assert half.shape == (2, 4, 39, 4)
    wanted = "'reference' must be reference pixels of every channel"
    refuses(wanted, reference_channels, data, np.zeros_like(mask))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"first_group": 3, "last_group": 4}, "'first_group, last_group' must be a range of"),
        ({"gain": 0.0}, "'gain' must be positive"),
        ({"read_noise": -1.0}, "'read_noise' must be at least 0"),
        ({"jump_threshold": -5.0}, "'jump_threshold' must be positive or None"),
        ({"usable": np.ones((2, 2), bool)}, "'usable' must be of shape"),
        ({"data": np.zeros((5, 3, 4), np.uint16)}, "'data' must be of four dimensions"),
    ],
)
def test_bad_options_are_named(options, match):
    refuses(match, fitted, **{"data": np.zeros((1, 5, 3, 4), np.uint16), **OPTIONS, **options})


def plain_fit(integrations, s, threshold):
    """
    Slope, variance, its photon part and jumps of a pixel by dense linear algebra, jump by jump.

    Jumps are significances by integration and group: roots of the drop of chi squared, if the
    difference is free.
    """
    cut, jumps = [np.zeros(len(d), bool) for d in integrations], {}
    while True:
        # blocks of the covariance between cuts, one after the other
        parts = [
            (k, part[~c[part]])
            for k, c in enumerate(cut)
            for part in np.split(np.arange(c.size), np.flatnonzero(c))
            if not c[part].all()
        ]
        used = [integrations[k][part] for k, part in parts]
        n_used = sum(len(d) for d in used)
        if n_used == 0:
            return np.nan, np.nan, np.nan, jumps
        slope = np.mean(np.concatenate(used))
        for _ in range(2):
            v = max(slope / GAIN, 1e-8 * s)
            slope, variance = gls(used, v, s)
        # the photon part: w^T (v I) w
        weights = [np.linalg.inv(covariance(len(d), v, s)).sum(axis=0) for d in used]
        photon = v * np.sum(np.concatenate(weights) ** 2) * variance**2
        if n_used == 1:
            return slope, variance, photon, jumps
        found = []
        for (k, part), d in zip(parts, used, strict=True):
            inverse = np.linalg.inv(covariance(len(d), v, s))
            z, weight = inverse @ (d - slope), inverse.sum(axis=1)
            share = np.diag(inverse) - weight**2 * variance
            for j, z_j, p_j, c_j, d_j in zip(part, z, share, np.diag(inverse), d, strict=True):
                if p_j > 1e-9 * c_j:
                    found.append((round(z_j**2 / p_j, 6), d_j, k, j))
        # of two differences that cannot be told apart the higher one
        best = max(found)
        if best[0] <= threshold**2:
            return slope, variance, photon, jumps
        cut[best[2]][best[3]] = True
        jumps[best[2], int(best[3]) + 1] = np.sqrt(best[0])


@pytest.mark.parametrize(("n_int", "n_group"), [(1, 40), (3, 12), (2, 3)])
def test_jumps_and_slopes_are_those_of_the_plain_form(n_int, n_group):
    rng = np.random.default_rng(n_group)
    shape = (4, 131)
    data = simulate(rng.uniform(0, 60, shape), n_int, n_group, dtype=np.float32, seed=n_int)
    # many lanes at once, with up to five jumps each, up and down
    for _ in range(5):
        hit = np.argwhere(rng.uniform(size=shape) < 0.4)
        k, g = rng.integers(0, n_int, len(hit)), rng.integers(1, n_group, len(hit))
        size = 10 ** rng.uniform(1.3, 3.5, len(hit)) * rng.choice([1, 1, -1], len(hit))
        for (y, x), one, start, dn in zip(hit, k, g, size, strict=True):
            data[one, start:, y, x] += dn
    limit = np.where(rng.uniform(size=shape) < 0.1, BIAS + 2000.0, np.inf)
    fit = fitted(data, **OPTIONS, saturation=limit, neighbor_threshold=None)
    places = fit.jumps[["y", "x", "integration", "group"]].tolist()
    assert sorted(places) == places
    significance = dict(zip(places, np.abs(fit.jumps["significance"]), strict=True))
    n_found = 0
    for y, x in np.ndindex(*shape):
        ramps = data[:, :, y, x].astype(float)
        lengths = [np.argmax(np.append(r >= limit[y, x], True)) for r in ramps]
        differences = [np.diff(r[:n]) for r, n in zip(ramps, lengths, strict=True)]
        slope, variance, photon, found = plain_fit(differences, READ**2, 5.0)
        seen = {place[2:]: value for place, value in significance.items() if place[:2] == (y, x)}
        assert seen == pytest.approx(found, rel=0.02)
        n_found += len(found)
        assert_allclose(fit.rate[y, x] * DT, slope, rtol=2e-6, atol=1e-5)
        assert_allclose(fit.error[y, x] ** 2 * DT**2, variance, rtol=2e-6)
        assert_allclose(fit.var_poisson[y, x] * DT**2, photon, rtol=1e-5, atol=1e-9)
        flags = int(fit.flags[y, x])
        assert bool(flags & DQ.JUMP_DET) == bool(found)
        assert bool(flags & DQ.SATURATED) == (min(lengths) < n_group)
        assert fit.n_jump[y, x] == len(found)
    assert n_found > 100


def test_charge_leaks_from_the_same_difference_alone():
    # row, column, integration, difference and size of jumps of two neighbors
    jumps = np.array(
        [
            [0, 0, 0, 3, 100.0],
            [0, 0, 1, 4, 80.0],
            [0, 1, 0, 3, 10.0],
            [0, 1, 1, 3, 20.0],
            [0, 1, 1, 5, 30.0],
        ]
    )
    own = own_charge(jumps, nx=8, n_diff=6)
    assert_allclose(own, [100.0 - LEAK * 10.0, 80.0, 10.0 - LEAK * 100.0, 20.0, 30.0])
