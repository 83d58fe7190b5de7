"""Rows of a catalogue by id."""

import numpy as np

__all__ = ["find_row", "rows_by_id"]


def rows_by_id(ids):
    """Dict of id to its row, the first if it occurs twice."""
    rows = {}
    for row, key in enumerate(ids.tolist()):
        rows.setdefault(key, row)
    return rows


def find_row(rows, key, n):
    """
    Row of an id.

    Parameters
    ----------
    rows : dict
        From `rows_by_id`.
    key : object
        The id.
    n : int
        Number of objects, for the message.

    Raises
    ------
    KeyError
        If there is none.
    """
    key = key.item() if isinstance(key, np.generic) else key
    try:
        known = key in rows
    except TypeError:
        # slices and lists are no ids
        known = False
    if not known:
        some = ", ".join(map(repr, list(rows)[:5]))
        msg = f"no object with the id {key!r} among {n}; the first are {some}"
        raise KeyError(msg)
    return rows[key]
