"""Sentences for attributes that a class does not have: what to write instead, or which names are near."""

import difflib

from miricigale.utils.caching import cached
from miricigale.utils.package_tables import declared

#: Names of a message at most.
_MAX_NAMES = 4


def attribute_hint(cls, name, names):
    """
    Say what to write in place of an attribute that is not there.

    Parameters
    ----------
    cls : type
        Class that lacks it; hints of its bases count too.
    name : str
        The attribute that was asked for.
    names : iterable of str
        Names of the attributes that are there.

    Returns
    -------
    hint : str
        The sentence that ``hints.toml`` has for it, else the name that is spelled alike, or those that share most
        words with it; empty without any.

    Examples
    --------
    >>> from miricigale import Filter
    >>> from miricigale.utils.attribute_hints import attribute_hint
    >>> attribute_hint(Filter, "synthetic_fluxe", ["pivot", "synthetic_flux"])
    "did you mean 'synthetic_flux'?"
    """
    for base in cls.__mro__:
        sentence = declared("miricigale.utils", "hints.toml").get(base.__name__, {}).get(name)
        if sentence is not None:
            return sentence
    public = [candidate for candidate in names if not candidate.startswith("_")]
    close = difflib.get_close_matches(name, public, n=1, cutoff=0.75)
    if close:
        return f"did you mean {close[0]!r}?"
    wanted = _words(name)
    shared = {candidate: len(wanted & _words(candidate)) for candidate in public}
    most = max(shared.values(), default=0)
    if most == 0:
        return ""
    near = sorted((n for n in public if shared[n] == most), key=lambda n: (len(n), n))
    return f"did you mean {' or '.join(map(repr, near[:_MAX_NAMES]))}?"


def _words(name):
    """Words of a name, each as the first one of those of the same meaning."""
    same = _same_words()
    return {same.get(word, word) for word in name.lower().split("_") if len(word) > 1}


@cached
def _same_words():
    """First word of the same meaning by word."""
    same = {}
    for words in declared("miricigale.utils", "hints.toml")["words"]["same"]:
        for word in words:
            same[word] = words[0]
    return same
