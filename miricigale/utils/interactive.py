"""What objects share in interactive sessions: other names of attributes, and a table in notebooks."""

import abc
import difflib
import functools
import html
import inspect
import operator

from miricigale.utils.declared import declared
from miricigale.utils.exceptions import unknown_name
from miricigale.utils.positions import sky_as_angles


def _no_attribute(owner, label, name, names):
    """The error of an attribute that is not there, with the nearest names or all of them."""
    known = [attribute for attribute in dir(owner) if not attribute.startswith("_")]
    near = difflib.get_close_matches(name, [*known, *names], n=3, cutoff=0.5)
    msg = f"{label} has no {name!r}; it has {', '.join(near or known)}"
    return AttributeError(msg, name=name, obj=owner)


class _Named(abc.ABCMeta):
    """Metaclass of `Interactive`: names that a class does not have end in the same sentence as an object's."""

    def __getattr__(cls, name):
        if name.startswith("_"):
            raise AttributeError(name)
        raise _no_attribute(cls, cls.__name__, name, ())


def checked_calls(cls):
    """
    Let calls of a class and its public methods with wrong arguments end in a sentence with the right ones.

    Python names one argument at a time, and not those that there are. A decorator of classes, above the one of
    dataclasses; errors from within a method stay as they are.
    """
    for name, member in list(vars(cls).items()):
        if name.startswith("_") and name not in ("__init__", "__call__"):
            continue
        if isinstance(member, classmethod):
            setattr(cls, name, classmethod(_checked(cls, member.__func__)))
        elif inspect.isfunction(member):
            setattr(cls, name, _checked(cls, member))
    return cls


def _checked(cls, method):
    @functools.wraps(method)
    def call(*args, **kwargs):
        try:
            return method(*args, **kwargs)
        except TypeError as err:
            # only this frame: the arguments did not fit, and the method was not entered
            if err.__traceback__.tb_next is not None:
                raise
            signature = inspect.signature(method)
            plain = [one.replace(annotation=one.empty) for one in signature.parameters.values()][1:]
            wanted = signature.replace(parameters=plain, return_annotation=signature.empty)
            kinds = (type(one).__name__ for one in args[1:])
            given = ", ".join([*kinds, *map("{}=".format, kwargs)])
            # functions of other modules are methods too
            name = f"{cls.__qualname__}.{method.__name__}"
            name = name.removesuffix(".__init__").removesuffix(".__call__")
            msg = f"{name} takes {wanted}, got ({given})"
            raise TypeError(msg) from None

    return call


class Interactive(metaclass=_Named):
    """
    Base of classes that are used in sessions.

    An attribute that a user of other packages knows by another name is found by it; any other name ends in a
    sentence that lists the nearest ones. In notebooks an object is shown as a table of what it holds.
    """

    @property
    def _other_names(self):
        """Names that are usual elsewhere, and the attribute of ours, or of one of its parts ("part.name")."""
        return declared("miricigale.utils", "other_names.toml").get(type(self).__name__, {})

    def __getattr__(self, name):
        # copies and notebooks ask for private names that need not be there
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._other_names:
            return operator.attrgetter(self._other_names[name])(self)
        if (value := self._value(name)) is not None:
            return value
        raise _no_attribute(self, type(self).__name__, name, self._other_names)

    def _value(self, name):
        """A quantity that the object holds by this name; None without one."""

    def _facts(self):
        """What a notebook shows: dict of label to value."""
        return {type(self).__name__: repr(self)}

    def summary(self):
        """Return what a notebook shows, as lines of text."""
        return "\n".join(f"{label}: {value}" for label, value in self._facts().items())

    def _repr_html_(self):
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(str(label))}</th>"
            f"<td style='text-align:left'>{html.escape(str(value))}</td></tr>"
            for label, value in self._facts().items()
        )
        return f"<table>{rows}</table>"


class Tabular(Interactive):
    """
    Base of results with a table, ``to_table()``, which they are indexed like.

    ``result["flux"]`` is a column, ``result[0]`` a row, ``result[rows]`` a table of these, ``result.loc[id]`` the
    row, or the table, of an id.
    """

    def __getitem__(self, key):
        table = self.to_table()
        if isinstance(key, str) and key not in table.colnames:
            raise unknown_name("column", key, table.colnames)
        return table[key]

    def _ipython_key_completions_(self):
        """What a session offers in brackets: names of the columns."""
        return self.to_table().colnames

    @property
    def columns(self):
        """Columns of the table by name."""
        return self.to_table().columns

    @property
    def loc(self):
        """Rows by id."""
        table = self.to_table()
        table.add_index("id")
        return table.loc

    def to_pandas(self):
        """Return the table as a `pandas.DataFrame`; positions are the columns ``ra`` and ``dec`` in deg."""
        return sky_as_angles(self.to_table()).to_pandas()
