"""Reference files of a local CRDS cache, chosen by the header of an exposure."""

import ast
import dataclasses
import fnmatch
import os
import re
from pathlib import Path

from miricigale.reduction.reference_maps import TYPES
from miricigale.reduction.references import ReferenceFiles
from miricigale.utils.exceptions import DataError, argument_error, data_error

#: Keywords of files by the parameters of rules.
_KEYWORDS = {
    "META.INSTRUMENT.NAME": "INSTRUME",
    "META.INSTRUMENT.DETECTOR": "DETECTOR",
    "META.INSTRUMENT.FILTER": "FILTER",
    "META.INSTRUMENT.BAND": "BAND",
    "META.INSTRUMENT.CHANNEL": "CHANNEL",
    "META.INSTRUMENT.CORONAGRAPH": "CORONMSK",
    "META.INSTRUMENT.LAMP_STATE": "LAMP",
    "META.EXPOSURE.READPATT": "READPATT",
    "META.EXPOSURE.TYPE": "EXP_TYPE",
    "META.EXPOSURE.NGROUPS": "NGROUPS",
    "META.EXPOSURE.NFRAMES": "NFRAMES",
    "META.SUBARRAY.NAME": "SUBARRAY",
    "META.VISIT.TSOVISIT": "TSOVISIT",
    "META.OBSERVATION.DATE": "DATE-OBS",
    "META.OBSERVATION.TIME": "TIME-OBS",
}

_NOT_APPLICABLE = "N/A"


@dataclasses.dataclass(frozen=True)
class ReferenceCache:
    """
    A CRDS cache on the disk.

    Parameters
    ----------
    folder : path-like, optional
        With ``mappings/jwst`` and ``references/jwst``; that of the variable CRDS_PATH if not given.
    context : str, optional
        Such as ``"jwst_1364.pmap"``; that of the variable CRDS_CONTEXT, or else the last one
        in the cache, if not given.

    Raises
    ------
    ValueError
        If no folder is given and CRDS_PATH is not set.
    `~miricigale.utils.exceptions.DataError`
        If the folder has no such context.

    Notes
    -----
    Nothing is downloaded: what the rules choose must be there. Rules (``.rmap``) of the kinds
    that MIRI has are understood, ``Match`` and ``UseAfter``; others are refused.

    References
    ----------
    CRDS user's guide, https://jwst-crds.stsci.edu/static/users_guide.

    Examples
    --------
    >>> from miricigale.reduction import ReferenceCache, Reducer
    >>> references = ReferenceCache("/data/crds", context="jwst_1364.pmap")  # doctest: +SKIP
    >>> reducer = Reducer(references=references)  # doctest: +SKIP
    """

    folder: object = None
    context: str | None = None

    def __post_init__(self):
        folder = self.folder if self.folder is not None else os.environ.get("CRDS_PATH")
        if not folder:
            raise argument_error("folder", "given, or the variable CRDS_PATH set", "neither")
        object.__setattr__(self, "folder", Path(folder))
        context = self.context or os.environ.get("CRDS_CONTEXT")
        if context is None:
            found = sorted(self._mappings.glob("jwst_*.pmap"))
            if not found:
                what = "is no CRDS cache of JWST: it has no mappings/jwst/jwst_*.pmap"
                raise data_error(self.folder, what)
            context = found[-1].name
        object.__setattr__(self, "context", str(context))
        self._mapping(self.context)

    @property
    def _mappings(self):
        return self.folder / "mappings" / "jwst"

    def find(self, header, *, incomplete=False):
        """
        Choose the reference files of an exposure.

        Parameters
        ----------
        header : mapping
            Keywords of the exposure, such as `~miricigale.detector.Ramp.header`.
        incomplete : bool, optional
            As for `ReferenceFiles`.

        Returns
        -------
        references : `ReferenceFiles`
            Those for which the rules have a file; others are None.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If a rule cannot be read, or a file that it chooses is not in the cache.
        """
        values = {
            key: str(header.get(word, "UNDEFINED")).strip() for key, word in _KEYWORDS.items()
        }
        values["META.INSTRUMENT.NAME"] = "MIRI"
        instruments = self._mapping(self.context)[1]
        name = instruments.get("MIRI", instruments.get("miri"))
        if name is None:
            raise data_error(self.context, "has no mapping for MIRI")
        rules = self._mapping(name)[1]
        chosen = {}
        for name in ReferenceFiles.names():
            kind = TYPES.get(name, name)
            rule = rules.get(kind, rules.get(kind.upper(), _NOT_APPLICABLE))
            if rule == _NOT_APPLICABLE:
                continue
            file = self._choose(rule, values)
            chosen[name] = None if file is None else self._file(file)
        return ReferenceFiles(**chosen, incomplete=incomplete, origin=self.context)

    def _choose(self, rule, values):
        """Name of the file that a rule chooses, or None."""
        header, selector = self._mapping(rule)
        parameters = header["parkey"]
        if isinstance(parameters[0], str):
            parameters = (parameters,)
        substitutions = header.get("substitutions", {})
        for names in parameters:
            if not isinstance(selector, _Selector):
                break
            selector = selector.choose(names, values, substitutions)
        if isinstance(selector, _Selector):
            raise data_error(rule, "has more selectors than parameters")
        return None if selector in (None, _NOT_APPLICABLE) else selector

    def _file(self, name):
        """Path of a file of the cache."""
        folder = self.folder / "references" / "jwst"
        for path in (folder / "miri" / name, folder / name):
            if path.is_file():
                return path
        what = f"lacks the reference file {name}, which {self.context} chooses"
        raise data_error(self.folder, what)

    def _mapping(self, name):
        """Header and selector of a mapping."""
        path = self._mappings / name
        try:
            tree = ast.parse(path.read_text())
            parts = {
                node.targets[0].id: _value(node.value)
                for node in tree.body
                if isinstance(node, ast.Assign)
            }
            return parts["header"], parts["selector"]
        except FileNotFoundError:
            what = f"is no CRDS cache with {name}: there is no {path}"
            raise data_error(self.folder, what) from None
        except (AttributeError, KeyError, SyntaxError, ValueError) as err:
            raise data_error(path, f"cannot be read as a CRDS mapping: {err}") from err


@dataclasses.dataclass(frozen=True)
class _Selector:
    """One level of a rule."""

    kind: str
    cases: dict

    def choose(self, names, values, substitutions):
        """What the parameters choose of the cases; None if nothing matches."""
        if self.kind == "UseAfter":
            # dates and times in one order of digits
            when = " ".join(values.get(name, "UNDEFINED") for name in names)
            before = [date for date in self.cases if date <= when.split(".")[0]]
            return self.cases[max(before)] if before else None
        best, chosen = 0, None
        for key, case in self.cases.items():
            patterns = key if isinstance(key, tuple) else (key,)
            found = []
            for name, pattern in zip(names, patterns, strict=True):
                pattern = substitutions.get(name, {}).get(pattern, pattern)
                found.append(_match(pattern, values.get(name, "UNDEFINED")))
            if min(found) < 0:
                continue
            if chosen is None or sum(found) > best:
                best, chosen = sum(found), case
            elif sum(found) == best and isinstance(chosen, _Selector):
                # equally good: the dates of both
                chosen = _Selector(chosen.kind, {**case.cases, **chosen.cases})
        return chosen


def _match(pattern, value):
    """Whether a value fits: 1 yes, 0 it does not matter, -1 no."""
    if isinstance(pattern, tuple):
        pattern = "|".join(pattern)
    if pattern == _NOT_APPLICABLE:
        return 0
    if value == pattern:
        return 1
    if value in ("*", _NOT_APPLICABLE):
        return 1 if value == "*" else 0
    if pattern.upper().startswith("NOT "):
        return -_match(pattern[4:].strip(), value)
    if pattern.startswith("{") and pattern.endswith("}"):
        return 1 if value == pattern[1:-1] else -1
    if pattern.startswith("(") and pattern.endswith(")"):
        return 1 if re.match(pattern[1:-1], value) else -1
    if pattern.startswith(("#", ">", "<", "=")) or pattern.upper().startswith("BETWEEN"):
        msg = f"relation {pattern!r} is not understood"
        raise DataError(msg)
    return 1 if any(fnmatch.fnmatchcase(value, one) for one in pattern.split("|")) else -1


def _value(node):
    """Value of a literal in which selectors stand as calls."""
    if isinstance(node, ast.Call):
        kind = node.func.id
        if kind not in ("Match", "UseAfter"):
            msg = f"selector {kind} is not understood"
            raise ValueError(msg)
        return _Selector(kind, _value(node.args[0]))
    if isinstance(node, ast.Dict):
        return {_value(k): _value(v) for k, v in zip(node.keys, node.values, strict=True)}
    return ast.literal_eval(node)
