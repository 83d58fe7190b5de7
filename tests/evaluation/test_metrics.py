import numpy as np
import pytest

from miricigale.evaluation import photoz_metrics, recovery_metrics, running_median


def test_photoz_outliers_are_counted_by_the_published_limit():
    z_true = np.array([1.0, 1.0, 1.0, 1.0, np.nan])
    z_fit = np.array([1.0, 1.29, 1.31, 3.0, 1.0])
    metrics = photoz_metrics(z_true, z_fit)
    assert (metrics.n, metrics.n_unusable, metrics.n_outliers) == (4, 1, 2)
    assert metrics.outlier_fraction == 0.5
    assert metrics.outlier_low < 0.5 < metrics.outlier_high
    assert metrics.bias == pytest.approx((0.145 + 0.155) / 2)


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
