"""Errors by their text."""

import pytest

__all__ = ["refuses"]


def refuses(match, function, *args, error=ValueError, **options):
    """Check that a call raises an error whose text matches."""
    with pytest.raises(error, match=match):
        function(*args, **options)
