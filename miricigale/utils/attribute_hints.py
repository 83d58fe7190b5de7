"""Sentences for attributes that a class does not have: what to write instead, or which names are near."""

import difflib

from miricigale.utils.caching import cached
from miricigale.utils.hinted_errors import HintedAttributeError
from miricigale.utils.package_tables import declared, hint_sentences

#: Most names that a message suggests, and most that it lists if none is near.
_MAX_NAMES = 4
_MAX_LISTED = 40
#: Likeness of two spellings of a name, from 0 to 1: slips of a letter or two, not other words beside a common one.
_ALIKE = 0.82
#: Key of the sentence of a class for any other name.
_OTHERWISE = "_"
#: Words of names that say nothing of what is meant.
_EMPTY_WORDS = {"to", "from", "get", "set", "is", "has", "by", "of", "at", "as", "my", "the", "all"}


class UnknownAttributeError(HintedAttributeError):
    """
    An attribute that an object does not have, with what to write instead.

    Parameters
    ----------
    owner : object or type
        What was asked.
    name : str
        The attribute.
    """

    def __init__(self, owner, name):
        if isinstance(owner, type):
            label = f"class {owner.__name__!r}"
        else:
            label = f"{type(owner).__name__!r} object"
        super().__init__(owner, name, label)

    def _hint(self):
        cls = self._owner
        if not isinstance(cls, type):
            cls = type(cls)
            hint = self._owner._hint_of(self.name)
            if hint:
                return hint
        return attribute_hint(cls, self.name, dir(self._owner))


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
        The sentence that ``hints.toml`` has for it, else the name that is spelled alike, those that share most
        words with it, what the class says in general, or all that a class with few has; empty without any.

    Examples
    --------
    >>> from miricigale import Filter
    >>> from miricigale.utils.attribute_hints import attribute_hint
    >>> attribute_hint(Filter, "synthetic_fluxe", ["pivot", "synthetic_flux"])
    "did you mean 'synthetic_flux'?"
    """
    sentences = {}
    for base in reversed(cls.__mro__):
        hints = declared("miricigale.utils", "hints.toml").get(base.__name__, {})
        sentences |= hint_sentences(hints)
    if name in sentences:
        return sentences[name]
    public = [candidate for candidate in names if not candidate.startswith("_")]
    suggestions = near_names(name, public)
    if suggestions:
        return f"did you mean {' or '.join(map(repr, suggestions))}?"
    suggestions = names_sharing_words(name, sentences)
    if suggestions:
        return sentences[suggestions[0]]
    if _OTHERWISE in sentences:
        return sentences[_OTHERWISE]
    if len(public) <= _MAX_LISTED:
        return f"it has {', '.join(public)}"
    return ""


def near_names(name, candidates):
    """Return the name that is spelled alike, else those that share most words; a few at most, or none."""
    close = difflib.get_close_matches(name, candidates, n=1, cutoff=_ALIKE)
    if close:
        return close
    return names_sharing_words(name, candidates)[:_MAX_NAMES]


def names_sharing_words(name, candidates):
    """Return the names that share most words with a name, the shortest first; none if no word is shared."""
    wanted = _words(name)
    shared = {candidate: len(wanted & _words(candidate)) for candidate in candidates}
    n_most = max(shared.values(), default=0)
    if n_most == 0:
        return []
    return sorted((n for n in shared if shared[n] == n_most), key=lambda n: (len(n), n))


def _words(name):
    """Words of a name, each as the first one of those of the same meaning."""
    synonyms = _same_words()
    words = [word for word in name.lower().split("_") if len(word) > 1 or word in synonyms]
    return {synonyms.get(word, word) for word in words if word not in _EMPTY_WORDS}


@cached
def _same_words():
    """First word of the same meaning by word."""
    synonyms = {}
    for words in declared("miricigale.utils", "hints.toml")["words"]["same"]:
        for word in words:
            synonyms[word] = words[0]
    return synonyms
