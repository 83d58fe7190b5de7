"""Errors and warnings of the package, and the one way to word them."""

import contextlib
import contextvars
import difflib
import sys
import types
import warnings

from astropy.units import UnitsError
from astropy.utils.exceptions import AstropyUserWarning


class ConfigError(ValueError):
    """A run configuration that cannot be used; the message names section and key."""


class DataError(OSError):
    """A data file that is missing, foreign, truncated or has the wrong checksum."""


class OtherResultsError(ValueError):
    """
    A folder holds results of other settings, which are not replaced unasked.

    Parameters
    ----------
    reason : str
        What the folder holds, and what differs.
    remedy : str
        What the caller can do to replace them.
    """

    def __init__(self, reason, remedy):
        self.reason = reason
        self.remedy = remedy
        super().__init__(f"{reason}; give another folder, or {remedy}")


class MiricigaleWarning(AstropyUserWarning):
    """Something that the user can mend or should know of; the base of all warnings of the package."""


class CatalogWarning(MiricigaleWarning):
    """Rows or columns of a catalog that are not used, or not as they stand."""


class ReferenceWarning(MiricigaleWarning):
    """Reference data that are assumed, of another instrument setting, or missing."""


class ModelWarning(MiricigaleWarning):
    """Spectra or templates that do not cover what is asked of them."""


class DetectorWarning(MiricigaleWarning):
    """Saturation and other limits of simulated exposures."""


class ReductionWarning(MiricigaleWarning):
    """Backgrounds and ramps that could not be determined as asked."""


class PSFWarning(MiricigaleWarning):
    """PSFs or kernels that are approximate, cut off or not normalized."""


class PhotometryWarning(MiricigaleWarning):
    """Images, errors or templates of photometry that limit what its fluxes mean."""


class FitWarning(MiricigaleWarning):
    """Bands or errors of a fit that are not used, or not as given."""


def argument_error(name, wanted, got):
    """Make the `ValueError` that names an argument, what was wanted and what came."""
    return ValueError(f"'{name}' must be {wanted}, got {got}")


def units_error(name, wanted, got, *, column=None):
    """Make the `~astropy.units.UnitsError` of an argument, or a column of it: what was wanted and what came."""
    if column is None:
        label = f"'{name}'"
    else:
        label = f"'{name}' column {column!r}"
    return UnitsError(f"{label} must be {wanted}, got {got}")


def config_error(key, problem):
    """Make the `ConfigError` that says where a configuration is wrong (section, key or file), and how."""
    return ConfigError(f"{key} {problem}")


def data_error(path, problem):
    """Make the `DataError` that names a file and says what is wrong with it."""
    return DataError(f"{path} {problem}")


@contextlib.contextmanager
def file_errors(path, problem, *kinds):
    """Raise what is wrong with the content of a file, or these kinds too, as a `DataError` that names it."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, *kinds) as err:
        # a name that is missing is quoted, a sentence is not
        said = err
        if isinstance(err, KeyError) and " " in f"{err}":
            said = err.args[0]
        raise data_error(path, f"{problem}: {said}") from err


#: Of more names than this an error lists the nearest ones only.
_LISTED = 40


def unknown_name(kind, name, names):
    """Make the `KeyError` for an unknown name that lists the right ones, or of many the nearest three."""
    names = sorted(map(str, names))
    # also by the last part of names with dots
    lower = {name_.lower().rpartition(".")[2]: name_ for name_ in names}
    lower |= {name_.lower(): name_ for name_ in names}
    if len(names) > _LISTED:
        close = difflib.get_close_matches(str(name).lower(), lower, n=6, cutoff=0.4)
        suggestions = list(dict.fromkeys(lower[name_] for name_ in close))[:3] or names[:3]
        return KeyError(
            f"no {kind} {name!r}; the nearest of {len(names)} are {', '.join(suggestions)}"
        )
    close = difflib.get_close_matches(str(name).lower(), lower, n=1, cutoff=0.7)
    hint = ""
    if close:
        hint = f"; did you mean {lower[close[0]]!r}?"
    return KeyError(f"no {kind} {name!r}; known: {', '.join(names)}{hint}")


#: What the caller of a function wrote for some of its arguments, by their names.
_WRITTEN = contextvars.ContextVar("written", default=types.MappingProxyType({}))


@contextlib.contextmanager
def written_names(names):
    """
    Name arguments in errors and warnings as the caller wrote them.

    Parameters
    ----------
    names : dict of str to str
        What was written, by the name of the argument, whose name stands in quotes in messages.
    """
    token = _WRITTEN.set(names)
    try:
        yield
    except Exception as err:
        if err.args and isinstance(err.args[0], str):
            err.args = (_as_written(err.args[0]), *err.args[1:])
        raise
    finally:
        _WRITTEN.reset(token)


def _as_written(message):
    """Return a message with the names of arguments that the caller wrote."""
    for name, written in _WRITTEN.get().items():
        message = message.replace(f"'{name}'", f"'{written}'")
    return message


#: Modules that are not the caller of a public function.
_INNER = ("miricigale.", "contextlib", "functools")


def warn(message, category):
    """Warn at the line outside of the package that led here, however deep the call is."""
    message = _as_written(message)
    frame = sys._getframe(1)
    level = 2
    while frame.f_back and frame.f_globals.get("__name__", "").startswith(_INNER):
        frame = frame.f_back
        level += 1
    warnings.warn(message, category, stacklevel=level)
