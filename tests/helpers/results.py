"""Comparison of results of fits."""

from dataclasses import fields

import numpy as np

from miricigale.fitting import FitResults


def assert_same(results, whole):
    """Two results are one, bit for bit."""
    assert_joined([results], whole)


def assert_joined(parts, whole):
    """Parts of a result, in their order, are the whole, bit for bit."""
    parts = list(parts)
    assert sum(map(len, parts)) == len(whole)
    for item in fields(FitResults):
        value, *split = (getattr(one, item.name) for one in (whole, *parts))
        if isinstance(value, np.ndarray):
            joined = np.concatenate(split)
            np.testing.assert_array_equal(joined, value, err_msg=item.name, strict=True)
        elif item.name in ("pdf", "best", "pairs"):
            for name, array in value.items():
                joined = np.concatenate([one[name] for one in split])
                np.testing.assert_array_equal(joined, array, err_msg=str(name), strict=True)
            assert all(list(one) == list(value) for one in split)


def assert_same_tables(one, two):
    """Two tables have the same columns, with the same units, descriptions and values."""
    assert one.colnames == two.colnames
    for name in one.colnames:
        assert one[name].info.description == two[name].info.description, name
        assert getattr(one[name], "unit", None) == getattr(two[name], "unit", None), name
        np.testing.assert_array_equal(np.asarray(one[name]), np.asarray(two[name]), name)
