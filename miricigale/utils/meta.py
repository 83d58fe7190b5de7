"""What a result says of where it came from."""

import datetime
import importlib.metadata
import json
import math
import re

import numpy as np

from miricigale.utils.caching import cached
from miricigale.utils.named_values import without_none

#: Names of keywords of FITS, but for those that mean something there.
_KEYWORD = re.compile(r"[A-Za-z0-9_-]{1,8}")
_RESERVED = {"META", "SIMPLE", "EXTEND", "BITPIX", "NAXIS", "TFIELDS", "EXTNAME", "COMMENT"}
#: Text short enough to stand on one card with its keyword
_TEXT = re.compile(r"[ -~]{0,40}")


@cached
def package_version():
    """Return the version of the package; ``"unknown"`` in a source tree that is not installed."""
    try:
        return importlib.metadata.version("miricigale")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def provenance(*, citations=(), **values):
    """
    Make the meta dictionary that results carry.

    Parameters
    ----------
    citations : iterable of str, optional
        What to cite for the data that went in.
    **values
        Anything else that fits in a FITS or ECSV header (numbers, text, short lists).

    Returns
    -------
    meta : dict
        Package name and version, UTC date, citations (sorted, unique) and the values.
    """
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    meta = {"package": "miricigale", "version": package_version(), "created": date}
    if citations:
        meta["citations"] = sorted(set(citations))
    meta.update(without_none(values))
    return meta


def undated(meta):
    """
    Copy of a meta dictionary without dates, at any depth, and without the keywords of a file.

    Parameters
    ----------
    meta : dict
        Such as `provenance` makes.

    Returns
    -------
    meta : dict
        For files that are to be the same bytes for the same content.
    """
    out = {}
    for key, value in meta.items():
        if isinstance(value, dict):
            value = undated(value)
        if key not in ("created", "keywords"):
            out[key] = value
    return out


def fits_meta(meta):
    """
    What a FITS header can hold of a meta dictionary.

    Parameters
    ----------
    meta : dict
        Anything by name.

    Returns
    -------
    cards : dict
        Numbers, truth values and short text by name (``HIERARCH`` before names that FITS does not have by
        itself), and all of it in ``META`` as JSON, for `full_meta`.
    """
    cards = {}
    for key, value in meta.items():
        key = str(key)
        if isinstance(value, np.generic):
            value = value.item()
        finite = isinstance(value, float) and math.isfinite(value)
        is_plain = finite or isinstance(value, (bool, int))
        if is_plain or (isinstance(value, str) and _TEXT.fullmatch(value)):
            if _KEYWORD.fullmatch(key) is None or key.upper() in _RESERVED:
                key = f"HIERARCH {key}"
            cards[key] = value
    return cards | {"META": json.dumps(meta, default=plain_value)}


def full_meta(meta):
    """The meta dictionary that `fits_meta` put into a header; of other headers what they hold."""
    text = meta.get("META")
    if not isinstance(text, str):
        return dict(meta)
    try:
        values = json.loads(text)
    except ValueError:
        # a keyword of another program
        return dict(meta)
    if isinstance(values, dict):
        return values
    return dict(meta)


def plain_value(value):
    """A value that JSON does not know as one that it does; a quantity keeps its unit as text."""
    if isinstance(value, (np.generic, np.ndarray)) and not hasattr(value, "unit"):
        return value.tolist()
    return str(value)


def json_meta(meta):
    """The meta dictionary of an image as JSON, without dates; a quantity keeps its unit as text."""
    return json.dumps(undated(meta), default=plain_value)
