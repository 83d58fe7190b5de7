"""Flags are integers that show their names where one value is looked at."""

import pickle
from dataclasses import dataclass

import numpy as np
import pytest
from astropy.table import Column, QTable
from numpy.testing import assert_array_equal

from miricigale.utils.flag_arrays import FlagArray, FlagField
from miricigale.utils.tables import Flags


class Faults(Flags):
    EDGE = 1, "At an edge."
    FAINT = 2, "Below the limit."
    LOST = 8, "Without data."


@dataclass(frozen=True)
class Result:
    flags: np.ndarray


FlagField.add_to(Result, "flags", Faults)

VALUES = np.array([0, 3, 8])


@pytest.fixture
def flags():
    return FlagArray(VALUES, Faults)


def test_an_element_has_names_and_is_an_integer(flags):
    assert flags[1] is not None
    assert repr(flags[1]) == "<Faults.EDGE|FAINT: 3>"
    assert str(flags[1]) == f"{flags[1]}" == "edge, faint"
    assert str(flags[0]) == "0"
    assert flags[1] == 3
    assert f"{flags[2]:04d}" == "0008"
    assert [str(value) for value in flags[1:]] == ["edge, faint", "lost"]
    assert repr(flags) == "array([0, 3, 8])  # 1 edge, 2 faint, 8 lost"
    assert repr(flags[:1]) == "array([0])"
    assert repr(flags[:0]) == "array([], dtype=int64)"


def test_arithmetic_and_tables_have_plain_integers(flags):
    assert_array_equal(flags & Faults.FAINT, [0, 2, 0])
    assert type(flags & Faults.FAINT) is np.ndarray
    assert type((flags == 0)[0]) is np.bool_
    assert type(np.bitwise_or.reduce(flags)) is np.int64
    assert flags.tolist() == [0, 3, 8]
    column = QTable({"flags": flags})["flags"]
    assert type(column) is Column
    assert type(column[1]) is np.int64
    assert column.dtype == VALUES.dtype


def test_names_of_an_array_are_those_of_each_value(flags):
    names = [[], ["edge", "faint"], ["lost"]]
    for values in (flags, VALUES, Column(VALUES), VALUES.tolist()):
        assert Faults.names(values) == names
    assert Faults.names(VALUES[None]) == [names]


def test_a_field_reads_as_flags_whatever_it_was_given(flags):
    for given in (VALUES, flags, pickle.loads(pickle.dumps(flags))):
        result = pickle.loads(pickle.dumps(Result(given)))
        assert result.flags[2] is Faults.LOST
        assert result.flags[[0, 2]][1] is Faults.LOST
    for single in (np.int64(8), np.array(8), Faults.LOST, 8):
        assert Result(single).flags is Faults.LOST
    # the array itself, not a copy
    assert np.shares_memory(Result(VALUES).flags, VALUES)
    with pytest.raises(AttributeError):
        Result(VALUES).flags = VALUES
