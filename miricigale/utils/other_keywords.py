"""Keywords of calls that are usual elsewhere, and what a call with any other keyword should have been."""

import dataclasses
import functools
import inspect

from miricigale.utils.attribute_hints import near_names
from miricigale.utils.exceptions import written_names
from miricigale.utils.named_values import field_names
from miricigale.utils.package_tables import declared, hint_sentences

#: Key of the sentence that shows the usual call.
_CALL = "_"
#: Key of the argument that a text is where the first argument is given by keyword.
_TEXT = "_text"
#: Key of the keywords of all calls that have the argument of ours.
_COMMON = "common"


def takes_other_keywords(target=None, *, options_of=()):
    """
    Let a function, a method or a class take keywords that are usual elsewhere.

    ``other_keywords.toml`` has them by the name of the class (for its constructor), ``Class.method`` or the
    function, and those that all share. Keywords of a part of a dataclass, such as ``pixfrac`` of
    ``Reducer(mosaics=MosaicSettings())``, are taken by the class too.

    Parameters
    ----------
    target : callable or type
        What is called. A class keeps its type; its ``__init__`` is replaced.
    options_of : tuple of callable, optional
        What further keywords of a function (its ``**options``) are handed to, and so may be. Without it those that
        are not known go there unchecked.

    Returns
    -------
    target : callable or type

    Raises
    ------
    TypeError
        In calls: for a keyword that is not known, with what to write instead; for a keyword under two names.

    Examples
    --------
    >>> from miricigale import Exposure
    >>> Exposure("F770W", ngroups=10, nints=2)
    <Exposure miri.f770w: FASTR1, 2 x 10 groups, 55.5 s, FULL>
    """
    if target is None:
        return functools.partial(takes_other_keywords, options_of=options_of)
    if isinstance(target, type):
        settings = _settings_of(target)
        target.__init__ = _renaming(target.__init__, target.__name__, settings)
        return target
    return _renaming(target, target.__qualname__.removesuffix(".__init__"), {}, options_of)


def _renaming(function, label, settings, options_of=()):
    """Return the function, which takes the other keywords of a label, those of settings and of what it calls."""
    parameters = dict(inspect.signature(function).parameters)
    owner = next((name for name in ("self", "cls") if name in parameters), None)
    parameters.pop(owner, None)
    options = [name for name, value in parameters.items() if value.kind is value.VAR_KEYWORD]
    names = [name for name in parameters if name not in options]
    for callee in options_of:
        names += [name for name in _keywords_of(callee) if name not in names]
    is_open = bool(options) and not options_of
    kinds = [parameter.kind for parameter in parameters.values()]
    n_owners = 0 if owner is None else 1
    n_most = kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD)
    takes_any_number = inspect.Parameter.VAR_POSITIONAL in kinds

    known = frozenset(names)
    required = [
        name
        for name, value in parameters.items()
        if value.default is value.empty and value.kind is not value.VAR_POSITIONAL and name in names
    ]

    @functools.wraps(function)
    def call(*args, **keywords):
        written = {}
        n_args = len(args) - n_owners
        if n_args > n_most and not takes_any_number:
            raise TypeError(_too_many(label, names[:n_most], n_args))
        if not keywords.keys() <= known:
            ours = _our_keywords(keywords, label, names, settings, is_open=is_open)
            written = _written_names(keywords, ours)
            keywords = ours
        twice = sorted(keywords.keys() & set(names[:n_args]))
        if _is_text_alone(args[n_owners:], twice, names):
            # such as the name of a filter whose wavelengths are given by keyword
            text_name = _other_names(label).get(_TEXT)
            if text_name is not None and text_name not in keywords:
                keywords = keywords | {text_name: args[-1]}
                return function(*args[:n_owners], **keywords)
        if twice:
            raise TypeError(_given_twice(twice[0], label))
        missing = [name for name in required if name not in (*names[:n_args], *keywords)]
        if missing:
            raise TypeError(_with_call(f"{label}() needs {', '.join(map(repr, missing))}", label))
        if not written:
            return function(*args, **keywords)
        with written_names(written):
            return function(*args, **keywords)

    call.keyword_names = tuple(names)
    return call


def _keywords_of(target):
    """Return the names of the arguments of a function or a class, and of what it hands options to."""
    names = getattr(target, "keyword_names", None)
    if names is None:
        kinds = inspect.signature(target).parameters
        names = tuple(name for name, value in kinds.items() if value.kind is not value.VAR_KEYWORD)
    return names


def _is_text_alone(values, twice, names):
    """Whether a text is all that is given by place, and the argument of this place is given by keyword too."""
    return twice == names[:1] and len(values) == 1 and isinstance(values[0], str)


def _other_names(label):
    """Our keywords of a label by those that are usual elsewhere."""
    return declared("miricigale.utils", "other_keywords.toml").get(label, {})


def _names_of_values(label):
    """Our keywords of a label whose values are a dict or a text, by those that are usual elsewhere."""
    return declared("miricigale.utils", "other_keywords.toml")["values"].get(label, {})


def _common_names(label, names):
    """Our keywords among some names by those that are usual elsewhere, but those with a sentence of the label."""
    sentences = _sentences(label)
    common = declared("miricigale.utils", "other_keywords.toml")[_COMMON]
    return {
        other: ours for other, ours in common.items() if ours in names and other not in sentences
    }


def _our_keywords(keywords, label, names, settings, *, is_open=False):
    """Keywords of a call by our names; an open one takes all others as they are."""
    other_names = _common_names(label, names) | _other_names(label)
    ours = {}
    values = {}
    for keyword, value in keywords.items():
        name = keyword if keyword in names else other_names.get(keyword, keyword)
        if isinstance(value, (dict, str)) and keyword in other_names:
            # such as the axes of a grid in place of the grid
            name = _names_of_values(label).get(keyword, name)
        owners = [part for part, kind in settings.items() if name in field_names(kind)]
        if name in names:
            if name in ours:
                msg = f"{label}() got {name!r} twice, once as {keyword!r}"
                raise TypeError(msg)
            ours[name] = value
        elif len(owners) == 1:
            values.setdefault(owners[0], {})[name] = value
        elif is_open and keyword not in _sentences(label):
            ours[keyword] = value
        else:
            raise TypeError(_unknown_keyword(keyword, label, names, settings))
    for part, fields in values.items():
        if part in ours:
            wanted = f"{settings[part].__name__}({', '.join(fields)}, ...)"
            names_given = ", ".join(map(repr, fields))
            msg = f"{label}() got {names_given} besides {part!r}: give {part}={wanted}"
            raise TypeError(msg)
        ours[part] = settings[part](**fields)
    return ours


def _written_names(keywords, ours):
    """Return the keywords of a call by our names for the same values, of those that are ours by another name."""
    written = {}
    for keyword, value in keywords.items():
        if keyword in ours:
            continue
        for name, our_value in ours.items():
            if our_value is value and name not in keywords:
                written[name] = keyword
    return written


def _settings_of(cls):
    """Classes of the parts of a dataclass that are dataclasses with values of their own, by name."""
    if not dataclasses.is_dataclass(cls):
        return {}
    factories = {field.name: field.default_factory for field in dataclasses.fields(cls)}
    return {name: kind for name, kind in factories.items() if dataclasses.is_dataclass(kind)}


def _sentences(label):
    """Sentences for calls of a label, by keyword."""
    hints = declared("miricigale.utils", "other_keywords.toml")["hints"]
    return hint_sentences(hints.get(label, {}))


def _with_call(message, label):
    """Return a message with the sentence on calls of a label, if there is one."""
    sentence = _sentences(label).get(_CALL)
    if sentence is None:
        return message
    return f"{message}; {sentence}"


def _given_twice(name, label):
    """Return what to say of an argument that is given by its place and by its name."""
    message = f"{label}() got {name!r} twice, by its place and by its name"
    sentence = _sentences(label).get(f"{name} twice")
    if sentence is not None:
        return f"{message}; {sentence}"
    return _with_call(message, label)


def _too_many(label, names, n_args):
    """Return what to say of a call with more arguments without a keyword than it has."""
    takes = "takes arguments by keyword alone"
    if names:
        takes = f"takes {', '.join(names)} without a keyword"
    return _with_call(f"{label}() {takes}, got {n_args} without", label)


def _unknown_keyword(keyword, label, names, settings):
    """Return what to say of a keyword that a call does not have."""
    message = f"{label}() has no argument {keyword!r}"
    sentences = _sentences(label)
    if keyword in sentences:
        return f"{message}; {sentences[keyword]}"
    every_name = list(names)
    for kind in settings.values():
        every_name += field_names(kind)
    close = near_names(keyword, every_name)
    if close:
        return f"{message}; did you mean {' or '.join(map(repr, close))}?"
    if _CALL in sentences:
        message = _with_call(message, label)
    return f"{message}; it has {', '.join(every_name)}"
