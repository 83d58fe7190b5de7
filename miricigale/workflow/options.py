"""Sections of options as frozen dataclasses: read from TOML, checked, written again."""

import contextlib
import dataclasses
import inspect
import json
import math
import operator
import re
import tomllib
import types
import typing
from pathlib import Path

from miricigale.utils.exceptions import ConfigError, config_error
from miricigale.utils.outputs import FILE_NAME, is_file_name
from miricigale.workflow.earlier import keys_of_today

#: What the name of a folder must be, for messages.
_FOLDER_NAME = f"must be the name of a folder in the current one: {FILE_NAME}"


@dataclasses.dataclass(frozen=True)
class Limits:
    """
    What values a key of a configuration may have.

    Parameters
    ----------
    low, high : float, optional
        Least and largest number.
    choices : tuple of str, optional
        All that text may be.
    single : bool, optional
        Whether one value may stand for a list of one.
    unique : bool, optional
        Whether a list may not have a value twice.
    folder : bool, optional
        Whether text is the name of a folder, which is made in the current one.
    """

    low: float | None = None
    high: float = math.inf
    choices: tuple = ()
    single: bool = False
    unique: bool = False
    folder: bool = False

    def __str__(self):
        names = ", ".join(self.choices)
        if self.low is None:
            return f" One of {names}." if names else ""
        span = f"{self.low} to {self.high}" if self.high < math.inf else f"at least {self.low}"
        return f" ({span} or {names})" if names else f" ({span})"


def option(default, **limits):
    """A field of a section with `Limits`; one without needs its default only."""
    return dataclasses.field(default=default, metadata={"limits": Limits(**limits)})


@typing.dataclass_transform(frozen_default=True, field_specifiers=(option,))
class Section:
    """Base of the sections of a configuration: each is a frozen dataclass, whose docstring explains its keys."""

    def __init_subclass__(cls):
        dataclasses.dataclass(frozen=True)(cls)

    @classmethod
    def docs(cls):
        """What the docstring, and those of the sections that it inherits from, say of each key."""
        text = "".join(
            f"{inspect.cleandoc(base.__doc__ or '')}\n" for base in reversed(cls.__mro__)
        )
        entries = re.findall(r"^(\w+)\n((?: +.*\n)+)", text, flags=re.MULTILINE)
        return {name: " ".join(doc.split()) for name, doc in entries}


def require(good, section, key, wanted, got):
    """Refuse a value that does not go with others: what was wanted, and what came."""
    if not good:
        msg = f"[{section}] {key} {wanted}, got {got}"
        raise ConfigError(msg)


@contextlib.contextmanager
def of_option(label, *errors):
    """Name the option whose value a class refuses by one of some errors: a `ConfigError`."""
    try:
        yield
    except ConfigError:
        raise
    except errors as err:
        raise config_error(label, f"{err.args[0]}") from err


def read_text(path):
    """Text of a configuration file, or a `ConfigError` that names it."""
    path = Path(path).expanduser()
    if not path.is_file():
        raise config_error("no configuration file", path)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as err:
        what = f"is not a text file in UTF-8: {err.reason} at byte {err.start}"
        raise config_error(path, what) from None


def read_setting(text):
    """
    Section, key and value of a text ``section.key=value``.

    The value is as in TOML; what is no TOML is text, so that quotes may be left out.
    """
    name, found, value = text.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (found and dot and section and key):
        raise config_error("a setting", f"must be section.key=value, got {text!r}")
    try:
        return section, key, tomllib.loads(f"value = {value}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return section, key, value.strip()


class Configuration:
    """
    Base of a configuration: a frozen dataclass whose fields are sections (`Section`).

    Attributes
    ----------
    heading : str
        First line of its file, a comment.
    earlier : dict of str to `~miricigale.workflow.earlier.EarlierKey`
        Keys ``section.key`` of earlier versions, and what became of them.
    """

    heading: typing.ClassVar[str]
    earlier: typing.ClassVar[dict] = {}

    def check(self, good, name, wanted, got=None):
        """Refuse a key ``section.key`` that does not agree with others; its value came, if not ``got``."""
        section, _, key = name.partition(".")
        value = operator.attrgetter(name)(self)
        require(good, section, key, wanted, _shown(value) if got is None else got)

    def check_length(self, name, lengths, wanted):
        """Refuse a list whose length is none of ``lengths``; the message has the length."""
        n = len(operator.attrgetter(name)(self))
        self.check(n in lengths, name, wanted, n)

    def values(self, *names):
        """Plain values of sections (``"scene"``) and keys (``"run.name"``), for hashing."""
        values = {name: operator.attrgetter(name)(self) for name in names}
        return {
            name: value if "." in name else dataclasses.asdict(value)
            for name, value in values.items()
        }

    @classmethod
    def from_dict(cls, values, *, base=None):
        """
        Make a configuration from nested dictionaries.

        Parameters
        ----------
        values : dict of dict
            Sections and their keys; what is absent keeps the value of ``base``.
        base : `Configuration`, optional
            Where absent keys come from; the defaults if not given.

        Raises
        ------
        `~miricigale.utils.exceptions.ConfigError`
            For an unknown section or key (the message lists the known ones), a wrong
            type, or a value outside its limits.

        Warns
        -----
        `~miricigale.utils.exceptions.MiricigaleWarning`
            Of keys that earlier versions called otherwise, which are read, and of those that are gone.
        """
        base = base or cls()
        values = keys_of_today(values, cls.earlier)
        known = [field.name for field in dataclasses.fields(base)]
        if unknown := sorted(set(values).difference(known)):
            raise config_error("unknown section", f"{unknown}; known: {sorted(known)}")
        sections = {
            name: _replace_section(name, getattr(base, name), entries)
            for name, entries in values.items()
        }
        return dataclasses.replace(base, **sections)

    @classmethod
    def from_texts(cls, texts, overrides=None):
        """Of pairs of a label for errors and a text in TOML, and of values in their place, in this order."""
        config = cls()
        for label, text in texts:
            try:
                config = cls.from_dict(tomllib.loads(text), base=config)
            except (tomllib.TOMLDecodeError, RecursionError, ConfigError) as err:
                label += ":" if isinstance(err, ConfigError) else " is not valid TOML:"
                raise config_error(label, err) from None
        return cls.from_dict(overrides, base=config) if overrides else config

    def to_toml(self):
        """The whole configuration as TOML, each key with its documentation."""
        lines = [self.heading]
        for field in dataclasses.fields(self):
            section = getattr(self, field.name)
            summary, docs = type(section).__doc__.split("\n\n")[0], section.docs()
            lines += ["", f"[{field.name}]  # {summary.strip()}"]
            for entry in dataclasses.fields(section):
                lines.append(f"# {docs[entry.name]}{_limits_of(entry)}")
                lines.append(f"{entry.name} = {toml_value(getattr(section, entry.name))}")
        return "\n".join(lines) + "\n"


def _shown(value):
    """A value as error messages have it."""
    if isinstance(value, bool):
        return toml_value(value)
    if isinstance(value, tuple):
        return list(value) or "none"
    return repr(value)


def _replace_section(name, section, entries):
    label = f"[{name}]"
    if not isinstance(entries, dict):
        raise config_error(label, f"must be a section, got {entries!r}")
    fields = {field.name: field for field in dataclasses.fields(section)}
    if unknown := sorted(set(entries) - set(fields)):
        raise config_error(label, f"does not know {unknown}; known: {sorted(fields)}")
    hints = typing.get_type_hints(type(section))
    changes = {
        key: _checked((name, key), value, hints[key], _limits_of(fields[key]))
        for key, value in entries.items()
    }
    return dataclasses.replace(section, **changes)


def _checked(name, value, hint, limits):
    if typing.get_origin(hint) is tuple:
        if limits.single and isinstance(value, (int, float, str)):
            value = (value,)
        require(isinstance(value, (list, tuple)), *name, "must be a list", repr(value))
        item = typing.get_args(hint)[0]
        value = tuple(_checked(name, entry, item, limits) for entry in value)
        repeats = limits.unique and len(set(value)) != len(value)
        require(not repeats, *name, "must not repeat", list(value))
        return value
    if isinstance(hint, types.UnionType):
        # a number within the limits, or one of the names
        hint = str if isinstance(value, str) else float
    if hint is float and type(value) is int:
        value = float(value)
    require(type(value) is hint, *name, f"must be of type {hint.__name__}", repr(value))
    low, high, choices = limits.low, limits.high, limits.choices
    if hint is str:
        good = not choices or value in choices
        require(good, *name, f"must be one of {list(choices)}", repr(value))
        require(not limits.folder or is_file_name(value), *name, _FOLDER_NAME, repr(value))
        return value
    good = hint is not float or math.isfinite(value)
    require(good, *name, "must be a finite number", repr(value))
    wanted = f"between {low} and {high}" if high < math.inf else f"at least {low}"
    require(low is None or low <= value <= high, *name, f"must be {wanted}", repr(value))
    return value


def _limits_of(field):
    return field.metadata.get("limits", Limits())


def toml_value(value):
    """Text of a value (text, a number, a truth value or a tuple of these) as TOML has it."""
    if isinstance(value, tuple):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    if isinstance(value, float):
        # nan, inf and -inf as TOML has them, and a point or an exponent in all others
        return float.__repr__(value)
    # JSON's booleans, integers and strings are valid TOML, but for its pairs of escapes beyond
    # U+FFFF and the delete character, which TOML wants escaped
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
