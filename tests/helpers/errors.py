"""Errors and warnings by their text."""

import pytest

from miricigale.utils.exceptions import MiricigaleWarning

__all__ = ["refuses", "warned"]


def refuses(match, function, *args, error=ValueError, **options):
    """Check that a call raises an error whose text matches."""
    with pytest.raises(error, match=match):
        function(*args, **options)


def warned(match, function, *args, **options):
    """What a call returns that has to warn with a text that matches."""
    with pytest.warns(MiricigaleWarning, match=match):
        return function(*args, **options)
