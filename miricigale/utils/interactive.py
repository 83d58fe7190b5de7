"""What objects share in interactive sessions: other names of attributes, and a table in notebooks."""

import difflib
import html
import operator
from typing import ClassVar

from miricigale.utils.exceptions import unknown_name


class Interactive:
    """
    Base of classes that are used in sessions.

    An attribute that a user of other packages knows by another name is found by it; any other name ends in a
    sentence that lists the nearest ones. In notebooks an object is shown as a table of what it holds.
    """

    #: Names that are usual elsewhere, and the attribute of ours, or of one of its parts (``"part.name"``).
    _other_names: ClassVar[dict] = {}

    def __getattr__(self, name):
        # copies and notebooks ask for private names that need not be there
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._other_names:
            return operator.attrgetter(self._other_names[name])(self)
        if (value := self._value(name)) is not None:
            return value
        known = [one for one in dir(self) if not one.startswith("_")]
        near = difflib.get_close_matches(name, [*known, *self._other_names], n=3, cutoff=0.5)
        msg = f"{type(self).__name__} has no {name!r}; it has {', '.join(near or known)}"
        raise AttributeError(msg, name=name, obj=self)

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
        table = self.to_table()
        if "sky" in table.colnames:
            at = table.colnames.index("sky")
            angles = [table["sky"].ra.deg, table["sky"].dec.deg]
            table.add_columns(angles, indexes=[at, at], names=["ra", "dec"])
            table.remove_column("sky")
        return table.to_pandas()
