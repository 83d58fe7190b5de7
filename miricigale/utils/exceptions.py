"""Errors and warnings of the package, and the one way to word them."""

from astropy.utils.exceptions import AstropyUserWarning

__all__ = [
    "ConfigError",
    "DataError",
    "MiricigaleWarning",
    "argument_error",
    "unknown_name",
]


class ConfigError(ValueError):
    """A run configuration that cannot be used; the message names section and key."""


class DataError(OSError):
    """A data file that is missing, foreign, truncated or has the wrong checksum."""


class MiricigaleWarning(AstropyUserWarning):
    """Something that the user can mend or should know of."""


def argument_error(name, wanted, got):
    """Make the `ValueError` that names an argument, what was wanted and what came."""
    return ValueError(f"'{name}' must be {wanted}, got {got}")


def unknown_name(kind, name, known):
    """Make the `KeyError` for an unknown name that lists the right ones."""
    return KeyError(f"no {kind} {name!r}; known: {', '.join(sorted(map(str, known)))}")
