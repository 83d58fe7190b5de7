"""Sentences for names that a subpackage does not have: what to write instead, or which names are near."""

import difflib
import importlib
import types

from miricigale.utils.attribute_hints import names_sharing_words
from miricigale.utils.package_tables import declared, hint_sentences

_PACKAGE = "miricigale"
#: Most names that a message suggests.
_MAX_NAMES = 3


def module_hint(module, name):
    """
    Say what to write in place of a name that a subpackage does not have.

    Parameters
    ----------
    module : str
        Name of the package or subpackage.
    name : str
        What was asked for.

    Returns
    -------
    hint : str
        The sentence that ``module_hints.toml`` has for the name; else where another subpackage has it, or the
        names here that are spelled alike or share words with it; else what the subpackage has in general. Empty
        without any of these, and for private names.

    Examples
    --------
    >>> from miricigale.utils.module_hints import module_hint
    >>> module_hint("miricigale.psf", "detect_sources")
    "did you mean 'miricigale.photometry.detect_sources'?"
    """
    if name.startswith("_"):
        return ""
    hints = declared("miricigale.utils", "module_hints.toml")
    sentences = hint_sentences(hints["sentences"])
    if name in sentences:
        return sentences[name]
    public_names = importlib.import_module(module).__all__
    suggestions = difflib.get_close_matches(name, public_names, n=1, cutoff=0.82)
    if not suggestions:
        suggestions = _names_elsewhere(name)
    subject = module.rpartition(".")[2]
    if not suggestions:
        # the subject of the subpackage stands in most of its names
        words = [word for word in name.split("_") if word.lower() != subject]
        suggestions = names_sharing_words("_".join(words), public_names)
    if not suggestions:
        return hints["subpackages"].get(subject, "")
    return f"did you mean {' or '.join(map(repr, suggestions[:_MAX_NAMES]))}?"


def _names_elsewhere(name):
    """Return full names of what other subpackages have by this name, in any case or spelled nearly so."""
    full_names = {}
    package = importlib.import_module(_PACKAGE)
    for subpackage in package.__all__:
        module = getattr(package, subpackage)
        if not isinstance(module, types.ModuleType):
            continue
        # the modules of plotting are not listed
        for public in getattr(module, "__all__", ()):
            full_names[public.lower()] = f"{_PACKAGE}.{subpackage}.{public}"
    for public in package.__all__:
        full_names.setdefault(public.lower(), f"{_PACKAGE}.{public}")
    close = difflib.get_close_matches(name.lower(), full_names, n=1, cutoff=0.85)
    return [full_names[public] for public in close]
