"""Checksums of values and files: the same for the same content, in any session."""

import hashlib
from dataclasses import fields, is_dataclass

import astropy.units as u
import numpy as np
from astropy.table import Table

from miricigale.utils.named_values import attributes, subset


def file_sha256(path):
    """The sha256 of a file as hexadecimal text."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def content_sha256(value):
    """
    Checksum of numbers, text, arrays, tables and what is made of them.

    Parameters
    ----------
    value : object
        None, numbers, text, units, quantities, arrays, tables, dicts, lists, tuples and
        dataclasses of these. Fields called ``meta`` do not count: they hold dates. Of a
        function, a class or any other object only the name (of its class) counts.

    Returns
    -------
    digest : str
        Hexadecimal sha256.
    """
    digest = hashlib.sha256()
    _feed(digest, value)
    return digest.hexdigest()


def _feed(digest, value):
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes)):
        _tag(digest, type(value).__name__, repr(value))
    elif isinstance(value, u.UnitBase):
        _tag(digest, "unit", value.to_string())
    elif isinstance(value, np.ma.MaskedArray):
        _tag(digest, "masked", "")
        _feed(digest, np.ma.getmaskarray(value))
        _feed(digest, np.asarray(value.filled()))
    elif isinstance(value, np.ndarray):
        _feed_array(digest, value)
    elif isinstance(value, Table):
        _feed(digest, subset(value, value.colnames))
    elif isinstance(value, dict):
        _tag(digest, "dict", str(len(value)))
        for key in sorted(value, key=str):
            _feed(digest, key)
            _feed(digest, value[key])
    elif isinstance(value, (list, tuple)):
        _tag(digest, "list", str(len(value)))
        for item in value:
            _feed(digest, item)
    elif is_dataclass(value) and not isinstance(value, type):
        _tag(digest, "dataclass", type(value).__qualname__)
        names = [item.name for item in fields(value) if item.name != "meta"]
        _feed(digest, attributes(value, names))
    else:
        named = value
        if not hasattr(value, "__qualname__"):
            named = type(value)
        _tag(digest, "name", f"{getattr(named, '__module__', '')}.{named.__qualname__}")


def _feed_array(digest, value):
    _feed(digest, getattr(value, "unit", None))
    array = np.asarray(getattr(value, "value", value))
    if array.dtype.kind == "O":
        _feed(digest, [array.shape] + array.ravel().tolist())
        return
    # one byte order, so that what came from a file counts as the same
    array = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    _tag(digest, array.dtype.str, str(np.shape(value)))
    digest.update(memoryview(array).cast("B") if array.size else b"")


def _tag(digest, kind, text):
    data = text.encode()
    digest.update(f"{kind}:{len(data)}:".encode() + data)
