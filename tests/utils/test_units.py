"""Conversions of units."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.utils.units import (
    are_not_negative,
    flux_unit,
    frozen_array,
    frozen_quantity,
    is_ascending,
    scalar,
    to_array,
)


def test_converts():
    assert_allclose(to_array([1, 2] * u.m, u.um, "x"), [1e6, 2e6])
    assert_allclose(to_array([1, 2], u.one, "x"), [1, 2])
    assert to_array(3 * u.s, u.s, "x").dtype == float


def test_uses_equivalencies():
    wave = to_array(299792.458 * u.GHz, u.um, "x", equivalencies=u.spectral())
    assert_allclose(wave, 1)


def test_a_nanomaggy_is_of_magnitude_22_5():
    """In any unit of flux density; of the zero point of AB magnitudes (Oke & Gunn 1983) 3631 Jy."""
    want = (22.5 * u.ABmag).to_value(u.uJy)
    assert_allclose(to_array(1 * u.nmgy, u.uJy, "x"), want, rtol=1e-12)
    assert_allclose(to_array([1e9] * u.nmgy, u.Jy, "x"), 1e3 * want, rtol=1e-12)


def test_refuses_wrong_shape_and_nan():
    match = r"'x' must be an array of 1 dimension\(s\), got shape"
    refuses(match, to_array, np.ones((2, 2)) * u.s, u.s, "x", ndim=1)
    match = "'x' must be finite values, got 1 that are NaN"
    refuses(match, to_array, [1, np.nan] * u.s, u.s, "x", finite=True)


def test_a_number_is_one_that_is_finite():
    assert scalar(2 * u.arcmin, u.arcsec, "x") == 120.0
    assert type(scalar(np.float32(2) * u.s, u.s, "x")) is float
    refuses("'x' must be", scalar, [1, 2] * u.s, u.s, "x")
    refuses("'x' must be finite", scalar, np.inf * u.s, u.s, "x")


def test_frozen_copies():
    source = np.arange(3.0) * u.m
    array = frozen_array(source.value)
    same, other = (frozen_quantity(source, unit, "x") for unit in (u.m, u.mm))
    source[0] = 9 * u.m
    assert other.unit == u.mm
    assert_allclose(array, [0, 1, 2])
    assert_allclose([same.value, other.value], [[0, 1, 2], [0, 1000, 2000]])
    for values in (array, same.value, other.value):
        refuses("read-only", values.fill, 1)


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        (3, u.UnitsError, "'x' must be a quantity convertible to uJy, got a bare number"),
        ([1, 2], u.UnitsError, "'x' must be a quantity convertible to uJy, got a bare number"),
        (3 * u.m, u.UnitsError, "'x' must be convertible to uJy, got m"),
        (23 * u.ABmag, u.UnitsError, r"'x' must be convertible to uJy, got mag\(AB\)"),
        (None, ValueError, "'x' must be convertible to uJy, got NoneType"),
        (["a", "b"], ValueError, r"'x' must be convertible to uJy, got \['a', 'b'\]"),
    ],
)
def test_refuses_what_is_no_linear_quantity(value, error, message):
    refuses(message, to_array, value, u.uJy, "x", error=error)


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("UJY", 1),
        ("microjansky", 1),
        ("(uJy)", 1),
        ("1e-29 erg/s/cm2/Hz", 1),
        ("10 nJy", 0.01),
        ("10**-3 Jy", 1e3),
        ("JY", 1e6),
        ("njy", 1e-3),
        ("millijansky", 1e3),
    ],
)
def test_spellings_of_jansky_that_leave_no_choice(name, factor):
    assert flux_unit(name).to(u.uJy) == pytest.approx(factor)


@pytest.mark.parametrize("name", ["mjy", "[Jy]", "[uJy]", "10 mag", "3 Jy/beam", "dex"])
def test_units_that_may_be_two_or_are_no_flux_have_none(name):
    """Square brackets stand for logarithms in tables of CDS."""
    assert flux_unit(name) is None


def test_complex_numbers_and_units_of_numbers_without_one_are_refused():
    refuses("'redshift' must be real numbers, got complex", to_array, [1j], u.one, "redshift")
    message = "'redshift' must be convertible to a number without a unit, got km / s"
    refuses(message, to_array, [1] * u.km / u.s, u.one, "redshift", error=u.UnitsError)


@pytest.mark.parametrize("values", [[1.0, 2.0], [-1.0, 0.0, np.inf]])
def test_ascending(values):
    assert is_ascending(np.array(values), min_size=2)
    assert not is_ascending(np.array(values), min_size=4)


@pytest.mark.parametrize("values", [[], [1.0, 1.0], [2.0, 1.0], [1.0, np.nan], [[1.0, 2.0]]])
def test_not_ascending(values):
    assert not is_ascending(np.array(values))


def test_not_negative():
    assert are_not_negative(np.array([[0.0, 1.0], [2.0, 3.0]]))
    for value in (-1.0, np.nan, np.inf):
        assert not are_not_negative(np.array([1.0, value]))
