"""Plain options, checked before anything is done with them."""

import numbers

import numpy as np

from miricigale.utils.exceptions import argument_error, data_error, unknown_name

#: Letters of what came that a message shows; of anything longer it has the class.
_LONGEST = 80
#: Files of a folder that a message names.
_MAX_FILES = 3


def check_that(good, name, wanted, got):
    """
    Refuse an argument unless ``good`` holds.

    Parameters
    ----------
    good : bool
        What must hold.
    name, wanted, got : str, str, object
        As for `~miricigale.utils.exceptions.argument_error`: ``got`` is only put into words if it is needed.

    Raises
    ------
    ValueError
        If ``good`` does not hold.

    Examples
    --------
    >>> from miricigale.utils.options import check_that, check_type
    >>> check_that(0 <= 2 <= 1, "share", "from 0 to 1", 2)
    Traceback (most recent call last):
    ...
    ValueError: 'share' must be from 0 to 1, got 2
    """
    if not good:
        raise argument_error(name, wanted, got)


def check_data(good, path, problem):
    """
    Refuse a file unless ``good`` holds.

    Parameters
    ----------
    good : bool
        What must hold.
    path, what : path, str
        As for `~miricigale.utils.exceptions.data_error`.

    Raises
    ------
    DataError
        If ``good`` does not hold.

    Examples
    --------
    >>> from miricigale.utils.options import check_data
    >>> check_data(False, "image.fits", "has no SCI extension")
    Traceback (most recent call last):
    ...
    miricigale.utils.exceptions.DataError: image.fits has no SCI extension
    """
    if not good:
        raise data_error(path, problem)


def check_is_file(path):
    """
    Refuse a path that is no file. The message says whether it is a folder, with some of its files.

    Parameters
    ----------
    path : `~pathlib.Path`
        The path.

    Raises
    ------
    DataError
        If there is no such file, or it is a folder.

    Examples
    --------
    >>> from pathlib import Path
    >>> from miricigale.utils.options import check_is_file
    >>> check_is_file(Path("absent.fits"))
    Traceback (most recent call last):
    ...
    miricigale.utils.exceptions.DataError: no file absent.fits
    """
    if path.is_dir():
        files = sorted(file.name for file in path.iterdir() if file.is_file())
        problem = "is a folder, wanted is a file"
        if files:
            problem += f": it has {', '.join(files[:_MAX_FILES])}"
        if len(files) > _MAX_FILES:
            problem += f" and {len(files) - _MAX_FILES} more"
        raise data_error(path, problem)
    check_data(path.is_file(), "no file", path)


def check_shape(value, shape, name):
    """Refuse an array of another shape (a `ValueError`)."""
    got = np.shape(value)
    check_that(got == shape, name, f"of shape {shape}", got)


def check_choice(value, name, choices):
    """Refuse a value that is none of those known (a `ValueError`)."""
    check_that(value in choices, name, " or ".join(map(repr, choices)), repr(value))


def check_names(names, kind, available):
    """Refuse the first of some names that is not known (a `KeyError` that lists those that are)."""
    for name in names:
        if name not in available:
            raise unknown_name(kind, name, available)


def check_kind(value, name, kind):
    """Refuse what is neither None nor of a class (a `ValueError`)."""
    if value is not None and not isinstance(value, kind):
        # of arrays and tables the values would fill the screen
        got = repr(value)
        if np.ndim(value) > 0 or len(got) > _LONGEST:
            got = type(value).__name__
        article = "a"
        if kind.__name__[0] in "AEIOU":
            article = "an"
        raise argument_error(name, f"{article} {kind.__name__}", got)


def check_type(value, name, kinds, wanted):
    """Refuse what is of none of some classes (a `ValueError` that says of which it is)."""
    check_that(isinstance(value, kinds), name, wanted, type(value).__name__)


def check_least(value, name, minimum, *, whole=False):
    """Refuse what is no number, below ``minimum`` or, with ``whole``, no integer (a `ValueError`)."""
    if not (isinstance(value, numbers.Integral if whole else numbers.Real) and value >= minimum):
        raise argument_error(name, f"at least {minimum}{', an integer' * whole}", value)


def check_positive(value, name, *, optional=False):
    """Refuse what is no number above 0 (a `ValueError`); with ``optional``, None passes."""
    good = (optional and value is None) or (isinstance(value, numbers.Real) and value > 0)
    check_that(good, name, "positive or None" if optional else "positive", value)
