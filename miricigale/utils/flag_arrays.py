"""Arrays of flags that show their names where one value is looked at."""

import numpy as np

__all__ = ["FlagArray", "FlagField"]


class FlagArray(np.ndarray):
    """
    An array of flags: integers whose single elements are members of their `~miricigale.utils.tables.Flags`.

    Results of arithmetic and comparisons are plain arrays.

    Parameters
    ----------
    values : array_like of int
        The flags.
    kind : type
        Class of the flags.

    Examples
    --------
    >>> from miricigale.fitting import FitFlags
    >>> from miricigale.utils.flag_arrays import FlagArray
    >>> flags = FlagArray([0, 258], FitFlags)
    >>> flags
    array([  0, 258])  # 2 few_bands, 256 redshift_edge
    >>> flags[1]
    <FitFlags.FEW_BANDS|REDSHIFT_EDGE: 258>
    >>> print(flags[1])
    few_bands, redshift_edge
    >>> flags & 2
    array([0, 2])
    """

    def __new__(cls, values, kind):
        array = np.asarray(values).view(cls)
        array.kind = kind
        return array

    def __array_finalize__(self, parent):
        self.kind = getattr(parent, "kind", None)

    def __array_wrap__(self, array, context=None, return_scalar=False):
        plain = np.asarray(array)
        if return_scalar:
            return plain[()]
        return plain

    def __getitem__(self, key):
        value = super().__getitem__(key)
        if self.kind is not None and isinstance(value, np.integer):
            return self.kind(int(value))
        return value

    def __repr__(self):
        text = repr(np.asarray(self))
        if self.kind is None or not self.size:
            return text
        members = self.kind(int(np.bitwise_or.reduce(np.asarray(self), axis=None)))
        legend = [f"{member.value} {member.name.lower()}" for member in members]
        if not legend:
            return text
        return f"{text}  # {', '.join(legend)}"


class FlagField:
    """
    Field of a frozen dataclass that is read as a `FlagArray`, or as one member where there is no axis.

    Parameters
    ----------
    kind : type
        Class of the flags.
    """

    def __init__(self, kind):
        self.kind = kind

    def __set_name__(self, owner, name):
        self.name = name

    @classmethod
    def add_to(cls, owner, name, kind):
        """Make the field of a dataclass that was defined such a field."""
        field = cls(kind)
        field.__set_name__(owner, name)
        setattr(owner, name, field)

    def __get__(self, instance, owner=None):
        if instance is None:
            return self
        if self.name not in instance.__dict__:
            raise AttributeError(self.name)
        value = instance.__dict__[self.name]
        if np.ndim(value):
            return FlagArray(value, self.kind)
        return self.kind(int(value))

    def __set__(self, instance, value):
        instance.__dict__[self.name] = value
