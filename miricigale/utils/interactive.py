"""What objects share in interactive sessions: other names of attributes, completion, a table in notebooks."""

import abc
import html
import operator

from miricigale.utils.attribute_hints import UnknownAttributeError
from miricigale.utils.exceptions import unknown_name
from miricigale.utils.package_tables import declared
from miricigale.utils.positions import sky_as_angles


class _Hinted(abc.ABCMeta):
    """
    Type of classes that say what to write instead of an attribute that they do not have.

    Names that are usual elsewhere for constructors, such as ``from_catalog``, stand for the class itself. It is an
    `abc.ABCMeta` as the type of `~astropy.nddata.NDData` is, from which some classes are derived too.
    """

    def __getattr__(cls, name):
        # copies and notebooks ask for private names that need not be there
        if name.startswith("_"):
            raise AttributeError(name)
        if name in declared("miricigale.utils", "other_names.toml")["constructors"].get(
            cls.__name__, ()
        ):
            return cls
        raise UnknownAttributeError(cls, name)


class Interactive(metaclass=_Hinted):
    """
    Base of classes that are used in sessions.

    An attribute that a user of other packages knows by another name is found by it. The quantities that an object
    holds are attributes, which sessions complete. In notebooks an object is shown as a table of what it holds.
    """

    #: Attributes, such as the exposure of a ramp, whose own values are found through the object too.
    _parts = ()

    @property
    def _other_names(self):
        """Names that are usual elsewhere, and ours: an attribute, one of a part ("part.name"), or "method()"."""
        return declared("miricigale.utils", "other_names.toml").get(type(self).__name__, {})

    def __getattr__(self, name):
        # copies and notebooks ask for private names that need not be there
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._other_names:
            ours = self._other_names[name]
            value = operator.attrgetter(ours.removesuffix("()"))(self)
            if ours.endswith("()"):
                return value()
            return value
        if (value := self._value(name)) is not None:
            return value
        if name.startswith("plot_"):
            # plot_residual_image for residual_image.plot
            drawn = getattr(self, name.removeprefix("plot_"), None)
            if hasattr(drawn, "plot"):
                return drawn.plot
        for part in self._parts:
            # half-made copies have no parts yet
            value = getattr(vars(self).get(part), name, None)
            # methods of a part would return another object than users expect
            if value is not None and not callable(value):
                return value
        raise UnknownAttributeError(self, name)

    def __dir__(self):
        return sorted({*super().__dir__(), *self._value_names()})

    def _value(self, name):
        """Return a quantity that the object holds by this name; None without one."""

    def _value_names(self):
        """Return the names that `_value` knows."""
        return ()

    def _hint_of(self, name):
        """Return what to write in place of an attribute, where that depends on the object; empty otherwise."""
        return ""

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


class WithTable(Interactive):
    """Base of what can be written as a table by its method ``to_table()``, and by ``QTable(...)`` of astropy."""

    def __astropy_table__(self, cls, copy, **kwargs):
        return cls(self.to_table(), copy=copy, **kwargs)

    def to_pandas(self):
        """Return the table as a `pandas.DataFrame`; positions are the columns ``ra`` and ``dec`` in deg."""
        return sky_as_angles(self.to_table()).to_pandas()


class Tabular(WithTable):
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
        """Return what a session offers in brackets: names of the columns."""
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


class ValuesByName(dict):
    """
    Values by name, which a call gives too: ``sed.derived("sfr")``; errors say which names there are.

    Each is printed on a line of its own.
    """

    def __missing__(self, name):
        raise unknown_name("value", name, self)

    def __call__(self, name=None):
        if name is None:
            return self
        return self[name]

    def __str__(self):
        return "\n".join(f"{name}: {value}" for name, value in self.items())
