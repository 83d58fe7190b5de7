import numpy as np
import pytest
from scipy.stats import norm

from miricigale.instrument import DQ, miri_detector
from miricigale.reduction import fit_groups, reference_drift

DT, GAIN, READ, BIAS = 2.775, 4.0, 6.0, 11000.0
OPTIONS = {"group_time": DT, "gain": GAIN, "read_noise": READ, "bias": BIAS}


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


def chi2(segments, slope, v, s):
    return sum((d - slope) @ np.linalg.solve(covariance(len(d), v, s), d - slope) for d in segments)


@pytest.mark.parametrize("n", [2, 3, 10, 100])
def test_pure_read_noise_has_the_variance_of_least_squares(n):
    data = simulate(np.full((4, 70), 3.0), 1, n, dtype=np.float32, seed=n)
    # no photon noise: each DN stands for a great many electrons
    fit = fit_groups(data, **{**OPTIONS, "gain": 1e15}, jump_threshold=None)
    expected = 12 * READ**2 / (n * (n**2 - 1) * DT**2)
    np.testing.assert_allclose(fit.var_read, expected, rtol=1e-4)
    assert np.all(fit.var_poisson < 1e-4 * expected)
    # and the slope is that of an unweighted line
    lines = np.polyfit(np.arange(n) * DT, data.reshape(n, -1).astype(float), 1)[0]
    np.testing.assert_allclose(fit.rate.ravel(), lines, atol=2e-4)


def test_pure_photon_noise_has_the_variance_of_the_count():
    n, rate = 20, 50.0
    data = simulate(np.full((4, 70), rate), 1, n, dtype=np.float32, read=0.0)
    fit = fit_groups(data, **{**OPTIONS, "read_noise": 0.0}, jump_threshold=None)
    time = (n - 1) * DT
    np.testing.assert_allclose(fit.rate, (data[0, -1] - data[0, 0]) / time, rtol=1e-5)
    np.testing.assert_allclose(fit.var_poisson, fit.rate / GAIN / time, rtol=1e-3)
    assert np.all(fit.var_read < 1e-4 * fit.var_poisson)


@pytest.mark.parametrize(("n_int", "n_group"), [(1, 2), (1, 9), (3, 5), (1, 60)])
@pytest.mark.parametrize("rate", [0.3, 20.0])
def test_agrees_with_dense_generalized_least_squares(n_int, n_group, rate):
    data = simulate(np.full((2, 67), rate), n_int, n_group, dtype=np.float32, seed=5)
    fit = fit_groups(data, **OPTIONS, jump_threshold=None)
    s = READ**2
    for y, x in [(0, 0), (1, 33), (1, 66)]:
        segments = list(np.diff(data[:, :, y, x].astype(float), axis=1))
        slope = np.mean(segments)
        for _ in range(2):
            v = max(slope / GAIN, 1e-8 * s)
            slope, variance = gls(segments, v, s)
        assert fit.rate[y, x] * DT == pytest.approx(slope, rel=1e-4, abs=1e-4)
        total = (fit.var_poisson + fit.var_read)[y, x] * DT**2
        assert total == pytest.approx(variance, rel=1e-3)
        # the photon part: w^T (v I) w
        info = 1 / variance
        w2 = sum(np.sum(np.linalg.inv(covariance(len(d), v, s)).sum(0) ** 2) for d in segments)
        assert fit.var_poisson[y, x] * DT**2 == pytest.approx(v * w2 / info**2, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize(
    ("rate", "n_int", "n_group"),
    [(0.3, 1, 20), (1.0, 1, 2), (1.0, 1, 100), (25.0, 1, 50), (400.0, 4, 10), (400.0, 1, 2)],
)
def test_pulls_are_standard_normal_and_there_is_no_bias(rate, n_int, n_group):
    data = simulate(np.full((200, 200), rate), n_int, n_group, seed=11)
    fit = fit_groups(data, **OPTIONS)
    good = np.isfinite(fit.rate)
    assert good.mean() > 0.9999
    pull = ((fit.rate - rate) / fit.error)[good]
    assert 0.97 < pull.std() < 1.03
    mean_error = fit.error[good].mean() / np.sqrt(good.sum())
    # 0.1 %, or what so many pixels can tell
    assert abs(fit.rate[good].mean() - rate) < max(1e-3 * rate, 4 * mean_error)
    if rate >= 25:
        assert abs(fit.rate[good].mean() / rate - 1) < 1e-3


def test_statistic_of_a_jump_is_the_drop_of_chi_squared():
    n_group = 12
    data = simulate(np.full((1, 1), 8.0), 2, n_group, dtype=np.float32, seed=3)
    data[1, 7:] += 120
    fit = fit_groups(data, **OPTIONS, neighbor_threshold=None)
    assert fit.jumps[["y", "x", "integration", "group"]].tolist() == [(0, 0, 1, 7)]
    segments = list(np.diff(data[:, :, 0, 0].astype(float), axis=1))
    s, slope = READ**2, np.mean(segments)
    for _ in range(2):
        v = slope / GAIN
        slope, _ = gls(segments, v, s)
    # the kernel looks with the variance of its last slope
    v = max(slope / GAIN, 1e-8)
    full = chi2(segments, gls(segments, v, s)[0], v, s)

    def freed(amplitude):
        changed = [d.copy() for d in segments]
        changed[1][6] -= amplitude
        return chi2(changed, gls(changed, v, s)[0], v, s)

    # chi squared is a parabola in the amplitude
    a, b, c = np.polyfit([0.0, 100.0, 200.0], [freed(x) for x in (0.0, 100.0, 200.0)], 2)
    drop = full - (c - b**2 / (4 * a))
    assert fit.jumps["significance"][0] == pytest.approx(np.sqrt(drop), rel=0.02)
    # what is left are the three pieces
    pieces = [segments[0], segments[1][:6], segments[1][7:]]
    slope = np.concatenate(pieces).mean()
    for _ in range(2):
        v = slope / GAIN
        slope, variance = gls(pieces, v, s)
    assert fit.rate[0, 0] * DT == pytest.approx(slope, rel=1e-4)
    assert fit.error[0, 0] * DT == pytest.approx(np.sqrt(variance), rel=1e-3)
    assert fit.n_used[0, 0] == 2 * (n_group - 1) - 1


@pytest.mark.parametrize("n_sigma", [4.0, 5.0, 6.0, 8.0])
def test_jump_efficiency_follows_from_the_noise(n_sigma):
    n, rate, at = 40, 20.0, 17
    s, v = READ**2 + 1 / 12, rate * DT / GAIN
    inverse = np.linalg.inv(covariance(n - 1, v, s))
    w = inverse.sum(axis=0)
    precision = inverse[at - 1, at - 1] - w[at - 1] ** 2 / w.sum()
    amplitude = n_sigma / np.sqrt(precision)
    data = simulate(np.full((60, 64), rate), 1, n, seed=7, jumps=[(0, at, amplitude)])
    fit = fit_groups(data, **OPTIONS, neighbor_threshold=None)
    found = fit.jumps[np.abs(fit.jumps["group"] - at) <= 1]
    assert len(found) / 3840 == pytest.approx(norm.sf(5 - n_sigma), abs=0.03)
    # better than two reads alone could do
    assert amplitude < n_sigma * np.sqrt(v + 2 * s)


def test_false_jumps_are_as_rare_as_five_sigma():
    data = simulate(np.full((200, 200), 30.0), 1, 50, seed=2)
    fit = fit_groups(data, **OPTIONS)
    expected = 2 * norm.sf(5.0) * 49 * 40000
    assert len(fit.jumps) <= expected + 5 * np.sqrt(expected) + 3


@pytest.mark.parametrize(("n_int", "n_group"), [(1, 3), (1, 30), (4, 8)])
@pytest.mark.parametrize("amplitude", [300.0, 2e4])
def test_large_jumps_leave_the_slope_alone(n_int, n_group, amplitude):
    rate = 10.0
    jumps = [(0, n_group - 1, amplitude)]
    data = simulate(np.full((40, 64), rate), n_int, n_group, seed=9, jumps=jumps)
    fit = fit_groups(data, **OPTIONS, neighbor_threshold=None)
    assert np.all(fit.flags == DQ.JUMP_DET)
    pull = (fit.rate - rate) / fit.error
    assert abs(pull.mean()) < 0.1
    assert 0.9 < pull.std() < 1.1


def test_negative_jumps_are_cut_too():
    data = simulate(np.full((1, 8), 10.0), 1, 30, seed=9, jumps=[(0, 12, -200.0)])
    fit = fit_groups(data, **OPTIONS)
    assert np.all(fit.jumps["group"] == 12)
    assert np.all(fit.jumps["significance"] < -5)
    assert np.all(np.abs(fit.rate - 10) < 5 * fit.error)


def test_neighbors_of_a_large_jump_are_cut_at_the_same_group():
    data = simulate(np.full((7, 9), 10.0), 1, 30, seed=1)
    data[0, 20:, 3, 4] += 3000
    fit = fit_groups(data, **OPTIONS)
    expected = np.zeros((7, 9), np.int64)
    expected[3, 4] = DQ.JUMP_DET
    for y, x in ((2, 4), (4, 4), (3, 3), (3, 5)):
        expected[y, x] = DQ.JUMP_DET | DQ.JUMP_NEIGHBOR
    np.testing.assert_array_equal(fit.flags, expected)
    assert np.all(fit.n_used[expected > 0] == 28)
    alone = fit_groups(data, **OPTIONS, neighbor_threshold=None)
    np.testing.assert_array_equal(alone.flags == DQ.JUMP_DET, expected == DQ.JUMP_DET)


def test_groups_from_the_first_saturated_one_on_are_left_out():
    rate = np.full((60, 64), 2000.0)
    limit = BIAS + 30000.0
    data = simulate(rate, 1, 20, seed=4)
    data = np.minimum(data, np.uint16(limit))
    fit = fit_groups(data, **OPTIONS, saturation=limit)
    assert np.all(fit.flags == DQ.SATURATED)
    assert np.all((fit.n_used >= 3) & (fit.n_used <= 5))
    pull = (fit.rate - rate) / fit.error
    assert 0.95 < pull.std() < 1.05
    assert abs(fit.rate.mean() / 2000.0 - 1) < 1e-3


def test_what_saturates_at_once_is_masked_with_the_reason():
    data = simulate(np.full((3, 5), 10.0), 2, 6)
    data[:, 1:, 0, 0] = 65535
    data[:, :, 0, 1] = 65535
    data[0, :, 0, 2] = 65535
    data[:, 2:, 0, 3] = 65535
    fit = fit_groups(data, **OPTIONS, saturation=63000.0)
    gone = DQ.SATURATED | DQ.NO_SLOPE | DQ.DO_NOT_USE
    assert fit.flags[0, 0] == fit.flags[0, 1] == gone
    assert np.all(np.isnan(fit.rate[0, :2]))
    # one integration, or one difference in each, is enough
    assert fit.flags[0, 2] == fit.flags[0, 3] == DQ.SATURATED
    assert fit.n_used[0, 2] == 5
    assert fit.n_used[0, 3] == 2
    assert np.all(np.abs(fit.rate[0, 2:4] - 10) < 5 * fit.error[0, 2:4])


def test_linearity_polynomial_is_undone():
    detector = miri_detector()
    rate = np.linspace(100, 900, 32 * 64).reshape(32, 64)
    time = DT * np.arange(1, 21)[:, None, None]
    measured = detector.bias + detector.delinearize(rate * time)
    fit = fit_groups(
        measured[None].astype(np.float32),
        group_time=DT,
        gain=detector.gain,
        read_noise=detector.read_noise,
        bias=detector.bias,
        linearity=detector.nonlinearity,
    )
    np.testing.assert_allclose(fit.rate, rate, rtol=1e-5)


def test_result_does_not_depend_on_threads_or_on_the_rest_of_the_frame():
    rng = np.random.default_rng(3)
    rate = rng.gamma(2, 20, (100, 130))
    data = simulate(rate, 2, 12, seed=8)
    # hits at random
    for _ in range(300):
        k, g, y, x = (rng.integers(n) for n in data.shape)
        data[k, g:, y, x] += np.uint16(rng.uniform(50, 5000))
    one = fit_groups(data, **OPTIONS, n_threads=1)
    three = fit_groups(data, **OPTIONS, n_threads=3)
    part = fit_groups(data[:, :, 20:70], **OPTIONS, neighbor_threshold=None)
    whole = fit_groups(data, **OPTIONS, neighbor_threshold=None)
    for name in ("rate", "var_poisson", "var_read", "n_used", "n_jump", "flags"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[20:70])
    np.testing.assert_array_equal(one.jumps, three.jumps)


def test_reference_columns_follow_the_drift():
    data = simulate(np.zeros((64, 40)), 2, 5, seed=1, dtype=np.float32)
    drift = np.array([[0, 3, -2, 5, 1], [10, 2, 2, -8, 4.0]])
    data += drift[:, :, None, None].astype(np.float32)
    mask = np.zeros((64, 40), bool)
    mask[:, :4] = mask[:, -4:] = True
    found = reference_drift(data, mask)
    np.testing.assert_allclose(found, drift - drift.mean(), atol=5 * READ / np.sqrt(512))
    assert np.all(reference_drift(data, np.zeros_like(mask)) == 0)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"first_group": 3, "last_group": 4}, "'first_group, last_group' must be a range of"),
        ({"gain": 0.0}, "'gain' must be positive"),
        ({"read_noise": -1.0}, "'read_noise' must be at least 0"),
        ({"jump_threshold": -5.0}, "'jump_threshold' must be positive or None"),
        ({"n_threads": 0}, "'n_threads' must be at least 1"),
        ({"usable": np.ones((2, 2), bool)}, "'usable' must be of shape"),
    ],
)
def test_bad_options_are_named(options, match):
    data = np.zeros((1, 5, 3, 4), np.uint16)
    with pytest.raises(ValueError, match=match):
        fit_groups(data, **{**OPTIONS, **options})


def test_refuses_another_number_of_dimensions():
    with pytest.raises(ValueError, match="'data' must be of four dimensions"):
        fit_groups(np.zeros((5, 3, 4), np.uint16), **OPTIONS)
