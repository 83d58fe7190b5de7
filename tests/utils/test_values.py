"""Classes of values."""

import dataclasses
import pickle

import numpy as np
import pytest

from miricigale.utils.values import value_class


@value_class
class Curve:
    wave: np.ndarray
    name: str = "curve"


@value_class(kw_only=True)
class Named:
    name: str


def test_values_do_not_change():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Curve(np.zeros(2)).name = "other"


def test_values_equal_themselves_alone():
    curve = Curve(np.zeros(2))
    assert curve == curve
    assert curve != Curve(np.zeros(2))
    assert len({curve, Curve(np.zeros(2))}) == 2


def test_values_are_dataclasses():
    assert [field.name for field in dataclasses.fields(Curve)] == ["wave", "name"]
    assert dataclasses.replace(Curve(np.zeros(2)), name="other").name == "other"
    assert pickle.loads(pickle.dumps(Curve(np.ones(2)))).wave.tolist() == [1, 1]


def test_options_are_those_of_dataclasses():
    assert Named(name="band").name == "band"
    with pytest.raises(TypeError):
        Named("band")
