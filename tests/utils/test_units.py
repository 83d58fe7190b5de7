"""Conversions of units."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.utils.units import frozen_array, frozen_quantity, to_array


def test_converts():
    assert_allclose(to_array([1, 2] * u.m, u.um, "x"), [1e6, 2e6])
    assert_allclose(to_array([1, 2], u.one, "x"), [1, 2])
    assert to_array(3 * u.s, u.s, "x").dtype == float


def test_uses_equivalencies():
    wave = to_array(299792.458 * u.GHz, u.um, "x", equivalencies=u.spectral())
    assert_allclose(wave, 1)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (3, "'x' must be a quantity convertible to s, got a bare number"),
        ([1, 2], "'x' must be a quantity convertible to s, got a bare number"),
        (3 * u.m, "'x' must be convertible to s, got m"),
    ],
)
def test_refuses_wrong_units(value, message):
    refuses(message, to_array, value, u.s, "x", error=u.UnitsError)


def test_refuses_wrong_shape_and_nan():
    with pytest.raises(ValueError, match=r"'x' must be an array of 1 dimension\(s\), got shape"):
        to_array(np.ones((2, 2)) * u.s, u.s, "x", ndim=1)
    with pytest.raises(ValueError, match="'x' must be finite values, got 1 that are NaN"):
        to_array([1, np.nan] * u.s, u.s, "x", finite=True)


def test_frozen_copies():
    source = np.arange(3.0)
    array = frozen_array(source)
    source[0] = 9
    assert array[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1
    values = np.arange(3.0) * u.km
    quantity = frozen_quantity(values, u.m, "x")
    assert quantity.unit == u.m
    assert_allclose(quantity.value, [0, 1000, 2000])
    with pytest.raises(ValueError, match="read-only"):
        quantity.value[0] = 1


def test_frozen_quantity_in_the_same_unit_is_a_copy():
    values = np.arange(3.0) * u.m
    quantity = frozen_quantity(values, u.m, "x")
    values[0] = 7 * u.m
    assert quantity[0] == 0 * u.m


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        (23 * u.ABmag, u.UnitsError, r"'x' must be convertible to uJy, got mag\(AB\)"),
        (None, ValueError, "'x' must be convertible to uJy, got NoneType"),
        (["a", "b"], ValueError, r"'x' must be convertible to uJy, got \['a', 'b'\]"),
    ],
)
def test_refuses_what_is_no_linear_quantity(value, error, message):
    refuses(message, to_array, value, u.uJy, "x", error=error)
