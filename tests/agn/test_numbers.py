"""Tables of numbers of AGN against closed forms."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from miricigale.agn import ShareDraws
from miricigale.agn.numbers import SampleNumbers
from miricigale.fitting import AGNBins


@pytest.fixture
def numbers():
    """Thirty galaxies with an AGN and ten quasars in the second bin of luminosity, by every draw."""
    bins = AGNBins((0.5, 1.5), (43.0, 44.0), (0.0, 0.1, 0.4, 1.0))
    n_draws = 4000
    counts = {}
    shipped = {}
    for name, number in (("galaxy", 30), ("quasar", 10)):
        counts[name] = np.zeros((n_draws,) + tuple(bins.shape), int)
        counts[name][:, 0, -1, 2] = number
        # by the prior of the fits there are half as many, and one of three is a quasar
        shipped[name] = np.zeros(bins.shape)
    shipped["galaxy"][0, -1, 2] = 10.0
    shipped["quasar"][0, -1, 2] = 5.0
    shares = np.full((n_draws, 1, bins.shape[1]), 1.0 / bins.shape[1])
    by_bin = np.array([[0, 0, 20], [0, 0, 0]])
    injected = dict.fromkeys(("all", "above", "limit", "selected", "right"), 10 * by_bin)
    return SampleNumbers(
        bins=bins,
        limit=0.4,
        floor=0.1,
        draws=ShareDraws(shares, counts, {}),
        shipped=shipped,
        area=0.01,
        n_all=100,
        n_used=100,
        selected=by_bin,
        pure=0.9 * by_bin,
        pure_shipped=0.8 * by_bin,
        injected=injected,
        seed=1,
    )


def test_obscured_shares_are_of_both_priors(numbers):
    """With the measured prior a binomial share with Jeffreys's prior; by the fits what their posteriors say."""
    row = numbers.by_luminosity()[-1]
    ends = stats.beta(30.5, 10.5).ppf([0.5, 0.15865, 0.84135])
    measured = [row[name] for name in ("obscured", "obscured_low", "obscured_high")]
    np.testing.assert_allclose(measured, ends, atol=0.006)
    assert row["obscured_shipped"] == pytest.approx(2.0 / 3.0)
    other = numbers.by_luminosity()[0]
    assert np.isnan(other["obscured_shipped"])


def test_purity_of_both_priors(numbers):
    row = numbers.by_luminosity()[-1]
    assert row["purity"] == pytest.approx(0.9)
    assert row["purity_shipped"] == pytest.approx(0.8)
    assert np.isnan(numbers.by_luminosity()[0]["purity_shipped"])


@pytest.mark.parametrize(
    ("n_right", "constrained"), [(200, True), (20, True), (19, False), (0, False)]
)
def test_bins_in_which_no_agn_is_selected_are_not_constrained(numbers, n_right, constrained):
    """Of 200 injected AGN with a fraction of 0.4 or more, 10 % must be selected."""
    right = numbers.injected["right"].copy()
    right[0, 2] = n_right
    injected = numbers.injected | {"right": right}
    with_fewer = dataclasses.replace(numbers, injected=injected)
    row = with_fewer.by_luminosity()[-1]
    assert row["above"] == 1.0
    assert row["constrained"] == constrained
