"""Sections of options as frozen dataclasses: read from TOML, checked, written again."""

import contextlib
import dataclasses
import inspect
import json
import math
import operator
import tomllib
import types
import typing
from pathlib import Path

from miricigale.utils.exceptions import ConfigError, config_error
from miricigale.utils.named_values import field_names
from miricigale.utils.outputs import FILE_NAME, is_file_name
from miricigale.workflow.earlier import keys_of_today

#: What the name of a folder must be, for messages.
_FOLDER_NAME = f"must be the name of a folder in the current one: {FILE_NAME}"


@dataclasses.dataclass(frozen=True)
class Limits:
    """
    Values that a key of a configuration may have.

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

    @property
    def span(self):
        """Range of numbers in words, as ``to_toml`` has it."""
        if self.high < math.inf:
            return f"{self.low} to {self.high}"
        return f"at least {self.low}"

    def __str__(self):
        names = ", ".join(self.choices)
        if self.low is not None and names:
            return f" ({self.span} or {names})"
        if self.low is not None:
            return f" ({self.span})"
        if names:
            return f" One of {names}."
        return ""


def option(default, doc, **limits):
    """
    Declare a key of a section.

    Parameters
    ----------
    default : object
        Its default.
    doc : str
        A sentence on what it means: its comment in files of configurations, and its entry in the
        reference.
    **limits
        As for `Limits`.

    Returns
    -------
    field : `dataclasses.Field`
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "limits": Limits(**limits)})


@typing.dataclass_transform(frozen_default=True, field_specifiers=(option,))
class Section:
    """Base of the sections of a configuration: frozen dataclasses whose fields are made by `option`."""

    def __init_subclass__(cls):
        dataclasses.dataclass(frozen=True)(cls)
        entries = [f"{name}\n    {doc}" for name, doc in cls.docs().items()]
        cls.__doc__ = "\n".join(
            [inspect.cleandoc(cls.__doc__), "", "Parameters", "----------"] + entries
        )

    @classmethod
    def docs(cls):
        """Return the meaning of each key, a sentence, by name."""
        return {field.name: field.metadata["doc"] for field in dataclasses.fields(cls)}


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
    """Return the text of a configuration file; a `ConfigError` names one that cannot be read."""
    path = Path(path).expanduser()
    if path.is_dir():
        raise config_error(path, "is a folder, wanted is a configuration file (TOML)")
    if not path.is_file():
        raise config_error("no configuration file", path)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as err:
        raise config_error(
            path, f"is not a text file in UTF-8: {err.reason} at byte {err.start}"
        ) from None


def read_setting(text):
    """
    Split a text ``section.key=value`` into section, key and value.

    The value is as in TOML; what is no TOML is text, so that quotes may be left out.
    """
    name, equals_sign, value = text.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals_sign and dot and section and key):
        raise config_error("a setting", f"must be section.key=value, got {text!r}")
    try:
        return section, key, tomllib.loads(f"value = {value}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return section, key, value.strip()


class Configuration:
    """
    Base of a configuration: a frozen dataclass whose fields are sections (`Section`), by default as they are made.

    Attributes
    ----------
    heading : str
        First line of its file, a comment.
    earlier : dict of str to `~miricigale.workflow.earlier.EarlierKey`
        Keys ``section.key`` of earlier versions, and what became of them.
    """

    heading: typing.ClassVar[str]
    earlier: typing.ClassVar[dict] = {}

    def __init_subclass__(cls):
        for name, kind in inspect.get_annotations(cls).items():
            if isinstance(kind, type) and not hasattr(cls, name):
                setattr(cls, name, dataclasses.field(default_factory=kind))
        dataclasses.dataclass(frozen=True)(cls)

    def check(self, good, name, wanted, got=None):
        """Refuse a key ``section.key`` that does not agree with others; its value came, if not ``got``."""
        section, _, key = name.partition(".")
        if got is None:
            got = _shown(operator.attrgetter(name)(self))
        require(good, section, key, wanted, got)

    def check_length(self, name, lengths, wanted):
        """Refuse a list whose length is none of ``lengths``; the message has the length."""
        n = len(operator.attrgetter(name)(self))
        self.check(n in lengths, name, wanted, n)

    def values(self, *names):
        """Return plain values of sections (``"scene"``) and keys (``"run.name"``), for hashing."""
        values = {}
        for name in names:
            values[name] = operator.attrgetter(name)(self)
            if "." not in name:
                values[name] = dataclasses.asdict(values[name])
        return values

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
        names = field_names(base)
        if unknown := sorted(set(values).difference(names)):
            raise config_error("unknown section", f"{unknown}; known: {sorted(names)}")
        sections = {}
        for name, entries in values.items():
            sections[name] = _replace_section(name, getattr(base, name), entries)
        return dataclasses.replace(base, **sections)

    @classmethod
    def from_texts(cls, texts, overrides=None):
        """Read pairs of a label for errors and a text in TOML, in their order, and then ``overrides``."""
        config = cls()
        for label, text in texts:
            try:
                config = cls.from_dict(tomllib.loads(text), base=config)
            except ConfigError as err:
                label = f"{label}:"
                raise config_error(label, err) from None
            except (tomllib.TOMLDecodeError, RecursionError) as err:
                label = f"{label} is not valid TOML:"
                raise config_error(label, err) from None
        if overrides:
            config = cls.from_dict(overrides, base=config)
        return config

    def to_toml(self):
        """Return the whole configuration as TOML, each key with its documentation."""
        lines = [self.heading]
        for field in dataclasses.fields(self):
            section = getattr(self, field.name)
            summary = type(section).__doc__.split("\n\n")[0]
            lines += ["", f"[{field.name}]  # {summary}"]
            for entry in dataclasses.fields(section):
                lines.append(f"# {entry.metadata['doc']}{entry.metadata['limits']}")
                lines.append(f"{entry.name} = {toml_value(getattr(section, entry.name))}")
        return "\n".join(lines) + "\n"


def _shown(value):
    """Return a value as error messages have it."""
    if isinstance(value, bool):
        return toml_value(value)
    if isinstance(value, tuple):
        return list(value) or "none"
    return repr(value)


def _replace_section(name, section, entries):
    """Return a section with the values of a file in place of some of its own."""
    label = f"[{name}]"
    if not isinstance(entries, dict):
        raise config_error(label, f"must be a section, got {entries!r}")
    fields = {field.name: field for field in dataclasses.fields(section)}
    if unknown := sorted(set(entries) - set(fields)):
        raise config_error(label, f"does not know {unknown}; known: {sorted(fields)}")
    hints = typing.get_type_hints(type(section))
    changes = {}
    for key, value in entries.items():
        limits = fields[key].metadata["limits"]
        changes[key] = _checked(name, key, value, hints[key], limits)
    return dataclasses.replace(section, **changes)


def _checked(section, key, value, hint, limits):
    """Return a value, or a list of values, as its type and limits want it."""
    if typing.get_origin(hint) is not tuple:
        return _checked_scalar(section, key, value, hint, limits)
    if limits.single and isinstance(value, (int, float, str)):
        value = (value,)
    require(isinstance(value, (list, tuple)), section, key, "must be a list", repr(value))
    item = typing.get_args(hint)[0]
    values = tuple(_checked_scalar(section, key, entry, item, limits) for entry in value)
    repeats = limits.unique and len(set(values)) != len(values)
    require(not repeats, section, key, "must not repeat", list(values))
    return values


def _checked_scalar(section, key, value, hint, limits):
    if isinstance(hint, types.UnionType):
        # a number within the limits, or one of the names
        hint = float
        if isinstance(value, str):
            hint = str
    if hint is float and type(value) is int:
        value = float(value)
    shown = repr(value)
    require(type(value) is hint, section, key, f"must be of type {hint.__name__}", shown)
    if hint is str:
        good = not limits.choices or value in limits.choices
        require(good, section, key, f"must be one of {list(limits.choices)}", shown)
        require(not limits.folder or is_file_name(value), section, key, _FOLDER_NAME, shown)
        return value
    require(
        hint is not float or math.isfinite(value), section, key, "must be a finite number", shown
    )
    wanted = f"at least {limits.low}"
    if limits.high < math.inf:
        wanted = f"between {limits.low} and {limits.high}"
    good = limits.low is None or limits.low <= value <= limits.high
    require(good, section, key, f"must be {wanted}", shown)
    return value


def toml_value(value):
    """Return a value (text, a number, a truth value or a tuple of these) as TOML has it."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, float):
        # nan, inf and -inf as TOML has them, and a point or an exponent in all others
        return float.__repr__(value)
    # JSON's booleans, integers and strings are valid TOML, but for its pairs of escapes beyond
    # U+FFFF and the delete character, which TOML wants escaped
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
