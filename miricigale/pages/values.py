"""What stands in the cells of a page: numbers with their errors, links, and why a value is missing."""

import dataclasses

import numpy as np
from markupsafe import Markup


@dataclasses.dataclass(frozen=True)
class Missing:
    """
    A value that is missing: a dash on the page, with its reason beneath.

    Parameters
    ----------
    reason : str
        Why it is missing.
    """

    reason: str

    def __str__(self):
        return "\N{EN DASH}"


@dataclasses.dataclass(frozen=True)
class Link:
    """
    A link, as a cell of a table or within a caption (``Markup("Source {}.").format(link)``).

    Parameters
    ----------
    text : str
        What the reader sees.
    address : str
        Where it leads, relative to the page.
    """

    text: str
    address: str

    def __str__(self):
        return str(self.text)

    def __html__(self):
        return Markup("<a href='{}'>{}</a>").format(self.address, self.text)


def number(value, spec, reason, *, error=None):
    """
    Return the text of a number, or `Missing` where it is none.

    Parameters
    ----------
    value : float or None
        The number; None or not finite is missing.
    spec : str
        Format, such as ``"+.2f"``; one that ends in ``" %"`` writes a share in percent; or one with
        braces and text around them (``"{:.1f} mag"``).
    reason : str
        Why it is missing.
    error : float, optional
        Error of a number with a format without braces, written after ``±`` where it is finite.

    Returns
    -------
    text : str or `Missing`

    Examples
    --------
    >>> from miricigale.pages import number
    >>> number(0.0123, "+.1f %", "no source")
    '+1.2 %'
    >>> number(0.0123, "+.3f", "no source", error=0.002)
    '+0.012 ± 0.002'
    >>> number(float("nan"), ".2f", "no source")
    Missing(reason='no source')
    """
    if value is None or not np.isfinite(value):
        return Missing(reason)
    if "{" in spec:
        return spec.format(value)
    spec, percent, unit = spec.partition(" %")
    scale = 1
    if percent:
        scale = 100
    text = f"{scale * value:{spec}}"
    if error is not None and np.isfinite(error):
        text += f" ± {scale * error:{spec.lstrip('+')}}"
    return text + percent + unit


def cell_of(entry, column):
    """
    Return the cell of an entry in a declared column.

    Parameters
    ----------
    entry : mapping
        What the row is of.
    column : sequence of str
        Key of the entry, for numbers followed by format and reason (see `number`), and after these
        the key of the error where it has one.

    Returns
    -------
    cell : object
        Text, a number, `Link` or `Missing`.
    """
    key, *form = column
    if not form:
        return entry[key]
    spec, reason, *error_key = form
    error = None
    if error_key:
        error = entry[error_key[0]]
    return number(entry[key], spec, reason, error=error)
