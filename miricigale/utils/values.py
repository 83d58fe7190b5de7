"""Classes of values: objects that do not change."""

import dataclasses
import functools
import typing


@typing.dataclass_transform(
    eq_default=False, frozen_default=True, field_specifiers=(dataclasses.field,)
)
def value_class(cls=None, **options):
    """
    Make a frozen dataclass whose objects are equal to themselves alone.

    Fields that are arrays or tables have no truth of their own when they are compared: an equality by fields, as
    dataclasses have it, would fail.

    Parameters
    ----------
    cls : type, optional
        The class, where the decorator stands without options.
    **options
        Further ones of `dataclasses.dataclass`, such as ``kw_only=True``.

    Returns
    -------
    cls : type

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.utils.values import value_class
    >>> @value_class
    ... class Curve:
    ...     wave: np.ndarray
    >>> Curve(np.zeros(3)) == Curve(np.zeros(3))
    False
    """
    if cls is None:
        return functools.partial(value_class, **options)
    return dataclasses.dataclass(cls, frozen=True, eq=False, **options)
