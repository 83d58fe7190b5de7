"""Shares of weights, and their intervals."""

import numpy as np
import pytest

from miricigale.evaluation.estimates import weighted_share


def wilson(k, n):
    """Interval of one sigma of k in n (Wilson 1927, JASA 22, 209)."""
    share = k / n
    middle = (share + 0.5 / n) / (1 + 1 / n)
    half = np.sqrt(share * (1 - share) / n + 0.25 / n**2) / (1 + 1 / n)
    return middle - half, middle + half


@pytest.mark.parametrize("weight", [1.0, 0.025, 3.0])
def test_a_share_of_equal_weights_is_that_of_as_many_sources(weight):
    among = np.full(8, weight)
    found = np.where(np.arange(8) < 2, weight, 0.0)
    share = weighted_share(found, among)
    assert share.value == pytest.approx(0.25)
    assert (share.low, share.high) == pytest.approx(wilson(2, 8), rel=1e-3)


def test_few_heavy_sources_count_as_few():
    """Four sources of weight 10 beside forty of 0.1: 2 / 4 of the weight, with the error of four."""
    among = np.append(np.full(4, 10.0), np.full(40, 0.1))
    found = among * np.append([1, 1, 0, 0], np.arange(40) % 2)
    share = weighted_share(found, among)
    assert share.value == pytest.approx(0.5)
    # (sum of weights)^2 / sum of squares is 4.8
    assert (share.low, share.high) == pytest.approx(wilson(2, 5), abs=0.1)
    assert share.high - share.low > 0.35


def test_nothing_found_has_an_upper_limit():
    share = weighted_share(np.zeros(8), np.full(8, 0.5))
    assert share.value == 0
    assert (share.low, share.high) == pytest.approx(wilson(0, 8), abs=1e-3)
