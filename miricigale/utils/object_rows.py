"""Frozen classes that hold a row for each object of a catalog: slices, rows by id, joins."""

import functools
import inspect
import numbers
from dataclasses import fields
from functools import cached_property
from typing import Annotated

import numpy as np
from astropy.table import QTable

from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.interactive import Interactive
from miricigale.utils.named_values import convert_values
from miricigale.utils.options import check_that

#: Types of fields: an array whose first axis is the objects, and a dict of such.
PerObject = Annotated[np.ndarray, "per object"]
PerObjectDict = Annotated[dict, "per object"]


def of_id(method):
    """
    Let a method of a single object take an id first where there are several: ``results.plot_sed(id)``.

    Parameters
    ----------
    method : callable
        Of a subclass of `ObjectRows`.

    Returns
    -------
    method : callable
        The same for a single object. For several its first argument is the id, without which, or with one that is
        not there, it raises `TypeError` or `KeyError`.
    """
    name = method.__name__
    usage = f"{name} is of a single object: results.{name}(id), or results[0].{name}() by row"

    @functools.wraps(method)
    def method_of_id(rows, *args, **kwargs):
        if rows.isscalar:
            return _call_of_object(method, usage, rows, *args, **kwargs)
        if "id" in kwargs and not args:
            args = (kwargs.pop("id"),)
        if not args or np.ndim(args[0]) > 0:
            raise TypeError(usage)
        try:
            result = rows.loc[args[0]]
        except KeyError as err:
            msg = f"{err.args[0]}; {usage}"
            raise KeyError(msg) from None
        return _call_of_object(method, usage, result, *args[1:], **kwargs)

    # calls are checked here
    method_of_id.keyword_names = tuple(inspect.signature(method).parameters)
    return method_of_id


def _call_of_object(method, usage, result, *args, **kwargs):
    """Call a method of a single object, after a check of its arguments."""
    signature = inspect.signature(method)
    try:
        signature.bind(result, *args, **kwargs)
    except TypeError as err:
        names = ", ".join(list(signature.parameters)[1:]) or "nothing"
        msg = f"{usage}; besides it takes {names}: {err}"
        raise TypeError(msg) from None
    return method(result, *args, **kwargs)


def _frozen(array, copy):
    array = np.array(array, order="C", subok=True, copy=copy or None)
    array.flags.writeable = False
    return array


class ArraysByName(dict):
    """
    Arrays by name, which a call gives too: ``results.best("redshift")``.

    ``other_name`` is a function of a name and those that there are, which returns the one that is meant.
    """

    def __init__(self, values, other_name):
        super().__init__(values)
        self.other_name = other_name

    def __missing__(self, name):
        ours = self.other_name(name, self)
        if ours in self:
            return self[ours]
        if isinstance(name, str):
            raise unknown_name("parameter", name, self)
        raise KeyError(name)

    def __call__(self, name=None, *others):
        if name is None:
            msg = (
                f"a name gives the arrays of all objects, such as {next(iter(self), 'redshift')!r}"
            )
            raise TypeError(msg)
        if others:
            msg = f"{name!r} alone gives the arrays of all objects; results.loc[id] is one object"
            raise TypeError(msg)
        return self[name]


def _same_name(name, known):
    """Return the name, where there are no others."""
    return name


class ObjectRows(Interactive):
    """
    Base of frozen dataclasses with a row for each object of a catalog, and its ``ids``.

    Fields of the types `PerObject` and `PerObjectDict` are read-only arrays, dicts of such, or None.
    Indexing gives the same class:

    - ``results[0]``, a row number: a single object, whose arrays have no first axis, as an element of a
      `~astropy.coordinates.SkyCoord` has none;
    - ``results[rows]``, a slice, a list or an array of row numbers or of truth values: these rows;
    - ``results.loc[id]``: the object of this id (the first, if it occurs twice), a list of ids: several.

    ``results["redshift_p50"]`` is a column of the table, ``results[["redshift", "mass"]]`` a table of several,
    ``results["some id"]`` also an object whose id is text.
    """

    _other_name = staticmethod(_same_name)

    def __post_init__(self):
        self._freeze(copy=True)

    def _freeze(self, copy):
        self.__dict__.update(self._mapped(lambda array: _frozen(array, copy)))

    def __setstate__(self, state):
        # arrays come back from pickles as ones that can be written to
        self.__dict__.update(state)
        self._freeze(copy=False)

    def _per_object(self):
        for item in fields(self):
            if item.type in (PerObject, PerObjectDict):
                yield item.name, getattr(self, item.name)

    def _by_name(self, field, arrays):
        """Make the dict that a field of arrays by name holds."""
        return ArraysByName(arrays, self._other_name)

    def _mapped(self, function):
        """Fields of arrays by name, after a function on each array."""
        mapped = {}
        for name, value in self._per_object():
            if isinstance(value, dict):
                value = self._by_name(name, convert_values(function, value))
            elif value is not None:
                value = function(value)
            mapped[name] = value
        return mapped

    @property
    def isscalar(self):
        """Whether this is a single object, whose arrays have no axis of objects."""
        return np.ndim(self.ids) == 0

    def __len__(self):
        if self.isscalar:
            msg = f"a {type(self).__name__} of a single object has no len()"
            raise TypeError(msg)
        return len(self.ids)

    def __bool__(self):
        return self.isscalar or len(self) > 0

    def __iter__(self):
        return map(self._take, range(len(self)))

    def __getitem__(self, key):
        if self.isscalar:
            msg = f"a {type(self).__name__} of a single object cannot be indexed"
            raise TypeError(msg)
        if isinstance(key, slice):
            return self._take(key)
        is_text = isinstance(key, (list, tuple)) and all(isinstance(name, str) for name in key)
        if is_text and key and not any(name in self._row_of_id for name in key):
            return QTable({name: self._column(name) for name in key})
        if isinstance(key, list) or (isinstance(key, np.ndarray) and key.ndim):
            return self._take(key if len(key) else slice(0))
        if isinstance(key, numbers.Integral) and not isinstance(key, (bool, np.bool_)):
            if not -len(self) <= key < len(self):
                msg = f"no row {key} among {len(self)}; results.loc[id] is the object of an id"
                raise IndexError(msg)
            return self._take(int(key))
        if isinstance(key, str) and key not in self._row_of_id:
            return self._column(key)
        return self._take(self.row(key))

    def _ipython_key_completions_(self):
        """What a session offers in brackets: names of parameters, and ids that are text."""
        ids = []
        if not self.isscalar:
            ids = [key for key in self.ids.tolist() if isinstance(key, str)]
        return [*getattr(self, "parameters", ()), *ids]

    @property
    def loc(self):
        """Objects by id: ``results.loc[id]`` and, for several, ``results.loc[[id, ...]]``."""
        return ByID(self)

    def _column(self, name):
        """A column of the table, by name."""
        table = {}
        if hasattr(self, "to_table"):
            table = self.to_table()
        if name not in getattr(table, "colnames", ()):
            # such as chi2, which the table has by another name
            values = None
            if not name.startswith("_"):
                values = getattr(self, name, None)
            if isinstance(values, np.ndarray) and values.shape[:1] == (len(self),):
                return values
            available = [*getattr(table, "colnames", ()), *map(str, self._row_of_id)]
            raise unknown_name("column or id", name, available)
        return table[name]

    def _take(self, rows):
        """Copy with these rows of every array; with a row number, a single object."""
        new = object.__new__(type(self))
        # without what was computed from all rows
        values = {name: v for name, v in self.__dict__.items() if name in self.__dataclass_fields__}
        new.__dict__.update(values | self._mapped(lambda array: _rows(array, rows)))
        return new

    def _changed(self, **changes):
        """Copy with other values of some fields, which are not checked; arrays are made read-only."""
        new = self._take(())
        for name, value in changes.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            new.__dict__[name] = value
        return new

    def _several(self):
        """This, with an axis of objects where it is a single one."""
        if self.isscalar:
            return self._take(None)
        return self

    @cached_property
    def _row_of_id(self):
        rows = {}
        for row, key in enumerate(self.ids.tolist()):
            rows.setdefault(key, row)
        return rows

    def row(self, key):
        """
        Row of an id (the first, if it occurs twice).

        Raises
        ------
        KeyError
            If there is none.
        """
        if isinstance(key, np.generic):
            key = key.item()
        try:
            return self._row_of_id[key]
        except (KeyError, TypeError):
            examples = ", ".join(map(repr, list(self._row_of_id)[:5]))
            msg = f"no object with the id {key!r} among {len(self)}; the first are {examples}"
            raise KeyError(msg) from None

    @classmethod
    def concatenate(cls, parts):
        """
        Join the rows of several; all else is that of the first.

        Parameters
        ----------
        parts : iterable
            Of this class, with the same fields of arrays, at least one.

        Returns
        -------
        joined : object
            Of this class.

        Raises
        ------
        ValueError
            If there is none, or their arrays differ in names or shapes.
        """
        parts = [part._several() for part in parts]
        check_that(parts, "parts", f"at least one {cls.__name__}", "none")
        new = parts[0]._take(slice(0))
        for name, value in parts[0]._per_object():
            values = [getattr(part, name) for part in parts]
            if isinstance(value, dict):
                if any(mapping.keys() != value.keys() for mapping in values):
                    raise argument_error("parts", f"with the same {name!r}", "others")
                joined = {k: _joined([mapping[k] for mapping in values], name) for k in value}
            elif any((mapping is None) != (value is None) for mapping in values):
                raise argument_error("parts", f"all with {name!r} or all without", "some")
            else:
                joined = None
                if value is not None:
                    joined = _joined(values, name)
            new.__dict__[name] = joined
        return new


class ByID:
    """Rows of a catalog by id."""

    def __init__(self, rows):
        self._rows = rows

    def __repr__(self):
        return f"<objects by id: results.loc[id] of {self._rows!r}>"

    def __getitem__(self, key):
        if isinstance(key, (list, np.ndarray)) and np.ndim(key):
            return self._rows[[self._rows.row(id_) for id_ in key]]
        return self._rows._take(self._rows.row(key))

    #: ``loc(id)`` is ``loc[id]``.
    __call__ = __getitem__

    def _ipython_key_completions_(self):
        """Return what a session offers in brackets: the ids."""
        return np.atleast_1d(self._rows.ids).tolist()


def _rows(array, rows):
    """Rows of an array, read-only."""
    array = np.asanyarray(array)[rows]
    if isinstance(array, np.ndarray) and array.ndim:
        array.flags.writeable = False
    return array


def _joined(arrays, name):
    if len({array.shape[1:] for array in arrays}) > 1:
        raise argument_error("parts", f"with arrays {name!r} of one shape", "several")
    return _frozen(np.concatenate(arrays), copy=False)
