import numpy as np
import pytest

from miricigale.evaluation import (
    classify,
    fraction_interval,
    photoz_metrics,
    recovery_metrics,
    running_median,
    sigma_mad,
)


def test_sigma_mad_of_a_gaussian_is_its_sigma():
    values = np.random.default_rng(1).normal(3.0, 2.5, 200_000)
    # 1.48 is the paper's rounding of 1.4826; the estimate's own error is 0.26 %
    assert sigma_mad(values) == pytest.approx(2.5, rel=0.01)


def test_sigma_mad_by_hand():
    assert sigma_mad([1, 2, 3, 4, 100]) == pytest.approx(1.48 * 1.0)
    assert np.isnan(sigma_mad([]))


def test_photoz_outliers_are_counted_by_the_published_limit():
    z_true = np.array([1.0, 1.0, 1.0, 1.0, np.nan])
    z_fit = np.array([1.0, 1.29, 1.31, 3.0, 1.0])
    metrics = photoz_metrics(z_true, z_fit)
    assert (metrics.n, metrics.n_unusable, metrics.n_outliers) == (4, 1, 2)
    assert metrics.outlier_fraction == 0.5
    assert metrics.outlier_low < 0.5 < metrics.outlier_high
    assert metrics.bias == pytest.approx((0.145 + 0.155) / 2)


def test_photoz_rejects_other_lengths():
    with pytest.raises(ValueError, match="'z_fit' must be a 1-D array as long as 'z_true'"):
        photoz_metrics([1.0, 2.0], [1.0])


def test_wilson_interval_at_zero():
    # closed form of Wilson's interval for 0 of n: upper limit z^2 / (n + z^2), z = 1
    fraction, low, high = fraction_interval(0, 9)
    assert fraction == 0
    assert low == pytest.approx(0, abs=1e-12)
    assert high == pytest.approx(0.1, rel=1e-2)


def test_median_error_is_that_of_gaussian_samples():
    rng = np.random.default_rng(3)
    medians = [recovery_metrics(np.zeros(400), rng.normal(size=400)).median for _ in range(2000)]
    stated = recovery_metrics(np.zeros(400), rng.normal(size=400)).median_err
    assert np.std(medians) == pytest.approx(stated, rel=0.15)


def test_relative_recovery_leaves_out_zero_truth_and_says_so():
    metrics = recovery_metrics([0.0, 2.0, 4.0], [1.0, 2.2, 4.4], relative=True)
    assert (metrics.n, metrics.n_unusable) == (2, 1)
    assert metrics.median == pytest.approx(0.1)


def test_running_median_uses_every_point_once():
    x = np.arange(50.0)
    mid, median, _ = running_median(x[::-1], x[::-1] * 2, size=20)
    assert len(mid) == 2
    assert median[0] == pytest.approx(2 * np.median(x[:20]))
    assert median[1] == pytest.approx(2 * np.median(x[20:]))


def test_classes_have_the_papers_limits():
    assert classify([0.0, 0.0999, 0.1, 0.39, 0.4, 1.0, np.nan]).tolist() == [
        "galaxy",
        "galaxy",
        "composite",
        "composite",
        "agn",
        "agn",
        "unknown",
    ]
    with pytest.raises(ValueError, match="'frac_agn' must be between 0 and 1"):
        classify([1.2])
