"""What stands in the cells of a page: numbers with their errors, links, and why a value is missing."""

import dataclasses

import numpy as np
from markupsafe import Markup

__all__ = ["Link", "Missing", "number", "percent"]


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


def number(value, spec, reason, *, error=None, scale=1):
    """
    Return the text of a number, or `Missing` where it is none.

    Parameters
    ----------
    value : float or None
        The number; None or not finite is missing.
    spec : str
        Format, such as ``"+.2f"``, or one with braces and text around them (``"{:.1f} %"``).
    reason : str
        Why it is missing.
    error : float, optional
        Error of a number with a plain format, written after ``±`` where it is finite.
    scale : float, optional
        Factor applied before writing.

    Returns
    -------
    text : str or `Missing`

    Examples
    --------
    >>> from miricigale.pages import number
    >>> number(0.0123, "{:+.1f} %", "no source", scale=100)
    '+1.2 %'
    >>> number(0.0123, "+.3f", "no source", error=0.002)
    '+0.012 ± 0.002'
    >>> number(float("nan"), ".2f", "no source")
    Missing(reason='no source')
    """
    if value is None or not np.isfinite(value):
        return Missing(reason)
    text = (spec if "{" in spec else f"{{:{spec}}}").format(scale * value)
    if error is not None and np.isfinite(error):
        text += f" ± {scale * error:{spec.lstrip('+')}}"
    return text


def percent(value, reason, spec=".1f"):
    """Return a share as text in percent, or why it is missing."""
    return number(value, f"{{:{spec}}} %", reason, scale=100)
