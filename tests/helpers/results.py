"""Comparison of results."""

from dataclasses import fields, is_dataclass

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from astropy.table import Table

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


def assert_equal_values(name, mine, theirs, skip=("wcs",)):
    """Two values are the same in every bit, whatever they are; fields of some names are left out."""
    assert (mine is None) == (theirs is None), name
    if isinstance(mine, SkyCoord):
        for one in ("ra", "dec"):
            np.testing.assert_array_equal(*(getattr(sky.icrs, one).deg for sky in (mine, theirs)))
    elif isinstance(mine, CCDData):
        assert (mine.unit, mine.meta) == (theirs.unit, theirs.meta)
        x = np.array([0.0, 100.0])
        places = (one.wcs.pixel_to_world_values(x, x) for one in (mine, theirs))
        np.testing.assert_array_equal(*places)
        for one in ("data", "mask"):
            assert_equal_values(name, getattr(mine, one), getattr(theirs, one))
        errors = (getattr(one.uncertainty, "array", None) for one in (mine, theirs))
        assert_equal_values(name, *errors)
    elif isinstance(mine, Table):
        assert mine.colnames == theirs.colnames
        for column in mine.colnames:
            assert_equal_values(column, mine[column], theirs[column])
    elif is_dataclass(mine):
        for one in (field.name for field in fields(mine) if field.name not in skip):
            assert_equal_values(one, getattr(mine, one), getattr(theirs, one))
    elif isinstance(mine, tuple):
        for one, other in zip(mine, theirs, strict=True):
            assert_equal_values(name, one, other)
    elif mine is None or isinstance(mine, (dict, int, str)):
        assert mine == theirs, name
    else:
        assert getattr(mine, "unit", None) == getattr(theirs, "unit", None)
        both = mine, theirs
        arrays = [one.toarray() if hasattr(one, "toarray") else np.asarray(one) for one in both]
        np.testing.assert_array_equal(*arrays, err_msg=name, strict=True)
