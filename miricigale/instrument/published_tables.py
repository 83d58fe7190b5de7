"""Tables of published figures."""

import tomllib

from miricigale.filters.band_names import known_filter
from miricigale.refdata import locate
from miricigale.utils.caching import cached


@cached
def table(name="imager"):
    """Return a table of the instrument (``imager``, ``siaf``, ``etc``) as a dict."""
    return tomllib.loads(locate(f"instrument.{name}").read_text(encoding="utf-8"))


def imager_filters():
    """
    Return the names of the nine imaging filters, blue to red.

    Examples
    --------
    >>> from miricigale.instrument import imager_filters
    >>> imager_filters()[:3]
    ('miri.f560w', 'miri.f770w', 'miri.f1000w')
    """
    return tuple(f"miri.{name}" for name in table()["filters"])


def imager_filter(filter):
    """
    Return our name of an imaging filter.

    Parameters
    ----------
    filter : str or `~miricigale.filters.Filter`
        Any usual name, such as ``"miri.f770w"``, ``"F770W"`` or ``"JWST/MIRI.F770W"``.

    Returns
    -------
    name : str
        Such as ``"miri.f770w"``.

    Raises
    ------
    KeyError
        If it is none of the nine imaging filters.
    """
    return known_filter(filter, imager_filters(), "imaging filter")


def filter_row(name):
    """Return the figures of one filter; errors as of `imager_filter`."""
    return table()["filters"][imager_filter(name).removeprefix("miri.")]
