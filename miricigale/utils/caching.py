"""Results that are kept and shared: whoever gets one cannot change it for all others."""

import copy
import dataclasses
import functools

import numpy as np

from miricigale.utils.named_values import field_names

#: Types of values that nobody can change, the most common ones.
_PLAIN = frozenset([float, int, bool, str, bytes, type(None)])


class _Shared:
    """What shared dicts and lists have in common: they cannot be changed, and their copies are plain."""

    def _refuse(self, *args, **kwargs):
        name = self._kind.__name__
        msg = f"this {name} is shared and cannot be changed; change a copy, {name}(...) or copy.deepcopy"
        raise TypeError(msg)

    def copy(self):
        """A plain dict or list of the same values."""
        return self._kind(self)

    __copy__ = copy

    def __deepcopy__(self, memo):
        return copy.deepcopy(self._kind(self), memo)

    def __reduce__(self):
        return type(self), (self._kind(self),)


class FrozenDict(_Shared, dict):
    """
    A dict that cannot be changed, shared by all who read it.

    ``copy()``, ``dict(...)`` and ``|`` give a plain dict. A copy by `copy.deepcopy` is plain throughout.
    """

    _kind = dict
    __setitem__ = __delitem__ = __ior__ = _Shared._refuse
    clear = pop = popitem = setdefault = update = _Shared._refuse


class FrozenList(_Shared, list):
    """A list that cannot be changed, shared by all who read it; a slice and a copy are plain lists."""

    _kind = list
    __setitem__ = __delitem__ = __iadd__ = __imul__ = _Shared._refuse
    append = clear = extend = insert = pop = remove = reverse = sort = _Shared._refuse


def frozen(value):
    """
    Make a value one that cannot be changed.

    Parameters
    ----------
    value : object
        Arrays and quantities are marked read-only as they are; so are those of frozen dataclasses. Dicts, lists
        and sets are replaced by ones that refuse changes (`FrozenDict`, `FrozenList`, `frozenset`), with frozen
        values. Anything else is returned as it is.

    Returns
    -------
    value : object
    """
    # the most common types first: this is called for each of many small results
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is np.ndarray:
        value.flags.writeable = False
        return value
    if isinstance(value, np.ndarray):
        _freeze_array(value)
        return value
    if isinstance(value, dict):
        return FrozenDict({key: frozen(entry) for key, entry in value.items()})
    if isinstance(value, list):
        return FrozenList(map(frozen, value))
    if isinstance(value, tuple):
        entries = [frozen(entry) for entry in value]
        if hasattr(value, "_fields"):
            return type(value)(*entries)
        return tuple(entries)
    if isinstance(value, set):
        return frozenset(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        _freeze_fields(value)
    return value


def _freeze_array(array):
    """Mark an array read-only, and the data and mask of a masked one."""
    if isinstance(array, np.ma.MaskedArray):
        array.harden_mask()
        if array.mask is not np.ma.nomask:
            array.mask.flags.writeable = False
        array.data.flags.writeable = False
    array.flags.writeable = False


def _freeze_fields(value):
    """Freeze the fields of a frozen dataclass; those of others are theirs to change."""
    for name in _fields_to_freeze(type(value)):
        entry = getattr(value, name, None)
        changed = frozen(entry)
        if changed is not entry:
            object.__setattr__(value, name, changed)


@functools.cache
def _fields_to_freeze(cls):
    """Names of the fields of a frozen dataclass; none of another."""
    if not cls.__dataclass_params__.frozen:
        return ()
    return tuple(field_names(cls))


def cached(function=None, *, maxsize=None, copies=False):
    """
    Decorator: keep what a function returns, so that nobody who gets it can change it for others.

    Parameters
    ----------
    function : callable, optional
        Its arguments are hashable.
    maxsize : int, optional
        How many results are kept; the least recently used go. All by default.
    copies : bool, optional
        Whether each caller gets a copy: for tables and coordinate systems, which have no form that cannot be
        changed. Otherwise results are `frozen`.

    Returns
    -------
    function : callable
        With ``cache_info`` and ``cache_clear`` of `functools.lru_cache`.

    Examples
    --------
    >>> from miricigale.utils.caching import cached
    >>> @cached
    ... def squares(n):
    ...     return {"squares": [k**2 for k in range(n)]}
    >>> squares(3)["squares"].append(9)
    Traceback (most recent call last):
        ...
    TypeError: this list is shared and cannot be changed; change a copy, list(...) or copy.deepcopy
    """
    if function is None:
        return functools.partial(cached, maxsize=maxsize, copies=copies)
    if not copies:

        @functools.wraps(function)
        def make(*args, **kwargs):
            return frozen(function(*args, **kwargs))

        return functools.lru_cache(maxsize=maxsize)(make)
    cached_function = functools.lru_cache(maxsize=maxsize)(function)

    @functools.wraps(function)
    def call(*args, **kwargs):
        return copy.deepcopy(cached_function(*args, **kwargs))

    call.cache_info = cached_function.cache_info
    call.cache_clear = cached_function.cache_clear
    return call


class cached_property(functools.cached_property):
    """`functools.cached_property` of an object that is shared: the value is `frozen`."""

    def __init__(self, function):
        @functools.wraps(function)
        def make(instance):
            return frozen(function(instance))

        super().__init__(make)
