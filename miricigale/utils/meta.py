"""What a result says of where it came from."""

import datetime
import functools
import importlib.metadata


@functools.cache
def _version():
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
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    meta = {"package": "miricigale", "version": _version(), "created": now}
    if citations:
        meta["citations"] = sorted(set(citations))
    meta.update({key: value for key, value in values.items() if value is not None})
    return meta


def undated(meta):
    """
    Copy of a meta dictionary without dates, at any depth.

    Parameters
    ----------
    meta : dict
        Such as `provenance` makes.

    Returns
    -------
    meta : dict
        For files that are to be the same bytes for the same content.
    """
    return {
        key: undated(value) if isinstance(value, dict) else value
        for key, value in meta.items()
        if key != "created"
    }
