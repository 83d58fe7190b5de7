"""Reference files of a local CRDS cache, chosen by the header of an exposure."""

import dataclasses
import os
from pathlib import Path
from unittest import mock

from miricigale.instrument.history import TYPES
from miricigale.reduction.references.references import ReferenceFiles
from miricigale.utils.exceptions import data_error, file_errors
from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_data, check_that
from miricigale.utils.package_tables import declared


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
    incomplete : bool, optional
        As for `ReferenceFiles`, of what is found.

    Raises
    ------
    ValueError
        If no folder is given and CRDS_PATH is not set.
    `~miricigale.utils.exceptions.DataError`
        If the folder has no such context.

    Notes
    -----
    The rules are those of the package ``crds``, which fills such caches (and comes with the extra ``jwst``).
    Nothing is downloaded: what they choose must be there.

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
    incomplete: bool = False

    def __post_init__(self):
        if self.folder is not None:
            folder = self.folder
        else:
            folder = os.environ.get("CRDS_PATH")
        check_that(folder, "folder", "given, or the variable CRDS_PATH set", "neither")
        object.__setattr__(self, "folder", Path(folder).expanduser())
        contexts = [path.name for path in self._mappings.glob("jwst_*.pmap")]
        context = (
            self.context or os.environ.get("CRDS_CONTEXT") or max(contexts, default="a context")
        )
        object.__setattr__(self, "context", str(context))
        problem = f"is no CRDS cache of JWST with {self.context}"
        check_data((self._mappings / self.context).is_file(), self.folder, problem)

    @property
    def _mappings(self):
        return self.folder / "mappings" / "jwst"

    def find(self, header):
        """
        Choose the reference files of an exposure.

        Parameters
        ----------
        header : mapping
            Keywords of the exposure, such as `~miricigale.detector.Ramp.header`.

        Returns
        -------
        references : `ReferenceFiles`
            Those for which the rules have a file; others are None.

        Raises
        ------
        ImportError
            If ``crds`` is not installed.
        `~miricigale.utils.exceptions.DataError`
            If a rule cannot be read, or a file that it chooses is not in the cache.
        """
        keywords = declared("miricigale.reduction", "crds.toml")["keywords"].items()
        words = {key: str(header.get(word, "UNDEFINED")).strip() for key, word in keywords}
        words["META.INSTRUMENT.NAME"] = "MIRI"
        kinds = {name: TYPES.get(name, name) for name in ReferenceFiles.names()}
        rmap = require("crds.core.rmap", extra="jwst")
        # by which crds finds the mappings of a context
        environment = mock.patch.dict(
            os.environ, CRDS_PATH=str(self.folder), CRDS_OBSERVATORY="jwst"
        )
        with file_errors(self.folder, "cannot be read as a CRDS cache", Exception), environment:
            rules = rmap.load_mapping(str(self._mappings / self.context))
            chosen = rules.get_best_references(words, include=list(kinds.values()))
        files = {}
        for name, kind in kinds.items():
            if not chosen.get(kind, "NOT FOUND").startswith("NOT FOUND"):
                files[name] = self._file(chosen[kind])
        return ReferenceFiles(**files, incomplete=self.incomplete, origin=self.context)

    def _file(self, name):
        """Return the path of a file of the cache."""
        folder = self.folder / "references" / "jwst"
        for path in (folder / "miri" / name, folder / name):
            if path.is_file():
                return path
        raise data_error(
            self.folder, f"lacks the reference file {name}, which {self.context} chooses"
        )
