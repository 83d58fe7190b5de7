"""Light that is added up several columns at a time, and shares of the normal distribution."""

import numpy as np
import pytest
from numba import njit
from numpy.testing import assert_allclose
from scipy.special import ndtr

from miricigale.fitting import _core
from miricigale.fitting._core.importance import _shares_below
from miricigale.fitting._core.interpolation import add_light, find_nodes
from miricigale.fitting._core.lanes import LANES
from miricigale.fitting.grid.part_tables import make_part


@njit
def light(part, values, log_z, factor, work, out):
    for i in range(len(values)):
        count = find_nodes(part, values[i], work)
        add_light(part, log_z[i], count, work, factor, out[i])


@njit
def shares_below(y, x):
    _shares_below(y, x)


@pytest.mark.parametrize("n_columns", [1, LANES - 1, LANES, LANES + 1, 2 * LANES, 21])
@pytest.mark.parametrize("n_redshifts", [1, 4])
def test_light_is_the_exponential_of_interpolated_logarithms(n_columns, n_redshifts):
    """Every column once, for any number of them, whatever its unit, and no column beyond them."""
    rng = np.random.default_rng(n_columns)
    axes = {
        "a": np.array([0.0, 1.0, 2.0, 4.0]),
        "b": np.array([1.0, 2.0, 5.0]),
        "c": np.array([3.0]),
    }
    z = np.linspace(0.5, 2.0, n_redshifts)
    table = rng.normal(0.0, 1.0, (12, n_redshifts, n_columns))
    # units from that of a luminosity to nothing
    table += np.linspace(60.0, -600.0, n_columns)
    place = {name: i for i, name in enumerate(axes)}
    part = make_part(tuple(axes), axes, dict.fromkeys(axes, 1.0), table, z, place)
    n = 50
    values = np.column_stack([rng.uniform(0, 4, n), rng.uniform(1, 5, n), np.full(n, 3.0)])
    redshift = rng.uniform(0.5, 2.0, n)
    work = _core.make_work(3, n_columns)
    log = np.empty((n, n_columns))
    _core.interpolate_columns(part, values, redshift, work, log)
    out = np.full((n, n_columns + 3), 1e-300)
    light(part, values, np.log1p(redshift), 2.5, work, out)
    assert_allclose(out[:, :n_columns], 2.5 * np.exp(log), rtol=5e-6)
    assert np.all(out[:, n_columns:] == 1e-300)


def test_light_follows_a_column_without_any():
    """Ln of 0 stands at -668 beside a bright model: far beyond what single precision holds."""
    axes = {"a": np.array([0.0, 1.0])}
    table = np.full((2, 1, LANES), np.log(1e-290))
    table[1] = 0.0
    part = make_part(("a",), axes, {"a": 1.0}, table, np.zeros(1), {"a": 0})
    out = np.zeros((2, LANES))
    work = _core.make_work(1, LANES)
    light(part, np.array([[0.0], [1.0]]), np.zeros(2), 1.0, work, out)
    assert_allclose(out[1], 1.0, rtol=1e-4)
    assert np.all((out[0] >= 0.0) & (out[0] < 1e-280))


def test_shares_of_the_normal_distribution():
    y = np.linspace(-9.0, 9.0, 4001).reshape(-1, 1)
    x = np.empty_like(y)
    shares_below(y, x)
    assert_allclose(x, ndtr(y), rtol=0, atol=6e-8)
    # the tail has its digits too
    assert_allclose(x[y < 0], ndtr(y[y < 0]), rtol=2e-7)
