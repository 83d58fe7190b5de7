"""Tables of published figures."""

import functools
import tomllib

from miricigale.refdata import locate
from miricigale.utils.exceptions import unknown_name


@functools.cache
def table(name="imager"):
    """A table of the instrument (``imager``, ``siaf``, ``etc``) as a dict."""
    return tomllib.loads(locate(f"instrument.{name}").read_text())


def imager_filters():
    """Names of the nine imaging filters, blue to red."""
    return tuple(f"miri.{name}" for name in table()["filters"])


def filter_row(name):
    """The figures of one filter; `KeyError` with the known names for any other."""
    try:
        return table()["filters"][str(name).removeprefix("miri.")]
    except KeyError:
        raise unknown_name("imaging filter", name, imager_filters()) from None
