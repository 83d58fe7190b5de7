"""A folder of files that belong together: written whole or not at all, and recorded."""

import hashlib
import json
import logging
import operator
from pathlib import Path, PurePosixPath

from miricigale.utils.content_hash import file_sha256
from miricigale.utils.exceptions import DataError, data_error
from miricigale.utils.files import PARTIAL, make_folder, replacing, writing
from miricigale.utils.lock import FolderLock
from miricigale.utils.named_values import without
from miricigale.utils.options import check_that

log = logging.getLogger(__name__)

MANIFEST = "manifest.json"


def check_folder(folder):
    """Refuse a file in the place of a folder (a `ValueError`)."""
    is_file = folder.exists() and not folder.is_dir()
    check_that(not is_file, "folder", "a folder, or nothing yet", f"the file {folder}")


class FileFolder:
    """
    Where files lie, and how they are written.

    Parameters
    ----------
    folder : path-like
        The folder.
    """

    def __init__(self, folder):
        self.folder = Path(folder)

    def __repr__(self):
        return f"<{type(self).__name__} {self.folder}>"

    def path(self, name):
        """
        Path of a file.

        Parameters
        ----------
        name : str
            Its name in the folder, with ``/`` between sub-folders.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the name leads out of the folder, by itself or by a symbolic link.
        """
        parts = PurePosixPath(name).parts
        # also none that leads out of a folder of Windows
        if not parts or "/".join(parts) != name or ".." in parts or set(name) & set("\\:\0"):
            problem = f"is not the name of a product: products lie in {self.folder}"
            raise data_error(repr(name), problem)
        path = self.folder
        for part in parts:
            path = path / part
            if path.is_symlink():
                raise data_error(path, f"is a symbolic link; products must lie in {self.folder}")
        return path

    def save(self, name, writer):
        """
        Write a file under a temporary name, then rename it.

        Parameters
        ----------
        name : str
            Name in the folder; sub-folders are made.
        writer : callable
            Called with the temporary path, whose suffix is that of ``name``.

        Returns
        -------
        path : `pathlib.Path`

        Raises
        ------
        OSError
            If it cannot be written, for instance on a full disk; it names the file, and what stood
            there before stays.
        """
        path = self.path(name)
        with writing(path):
            make_folder(path.parent)
        with replacing(path) as partial:
            writer(partial)
        return path

    def describe(self, name):
        """Checksum and size of a file, as the manifest holds them."""
        path = self.path(name)
        return {"sha256": file_sha256(path), "bytes": path.stat().st_size}


class RecordFolder(FileFolder):
    """
    A folder of files and the manifest of what stands in it.

    The manifest is kept twice, each with a checksum. Records that are made while the folder is in use are
    appended to a journal, which goes into the manifests at the end. Used in a ``with`` statement the
    folder is locked for other processes. Subclasses say by class attributes what the folder is for.

    Parameters
    ----------
    folder : path-like
        Made when something is written, if it does not exist.

    Attributes
    ----------
    facts : dict
        Plain values that the manifest holds beside the records, such as a configuration.
    records : dict of str to dict
        By key (a stage, a piece): ``hash`` of all that its files depend on, ``products`` (name of
        each file to its ``sha256`` and ``bytes``), and what else was noted.
    is_sound : bool
        Whether both manifests stand and say the same, and no journal does.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the folder holds files but no manifest (it is another's), or a manifest names a file
        outside the folder.
    """

    #: Whose folder it is, for messages; the name of its lock; and the name of the records in it.
    purpose = "run"
    inputs = ()
    #: Name of the manifest without its ending.
    manifest_name = MANIFEST.removesuffix(".json")
    lock_name = "run.lock"
    records_name = "records"
    #: What to do about a folder that cannot be used.
    remedy = "choose another folder"

    def __init__(self, folder):
        super().__init__(folder)
        self._whole = {}
        self._lock = FolderLock(self.folder, name=self.lock_name, purpose=self.purpose)
        self._load()

    @property
    def _manifests(self):
        """Names of the two manifests, of the same text: the records outlive the loss of either file."""
        return f"{self.manifest_name}.json", f".{self.manifest_name}.copy.json"

    @property
    def _journal(self):
        """File of records since the manifests were written, a line each: checksum, key and record as JSON."""
        return self.path(f".{self.manifest_name}.journal")

    def _load(self):
        self.facts = {}
        self.records = {}
        paths = [self.path(name) for name in self._manifests]
        texts = []
        for path in paths:
            if path.is_file():
                texts.append(path.read_bytes())
            else:
                texts.append(None)
        journal = self._journal
        self.is_sound = texts[0] is not None and texts[0] == texts[1] and not journal.is_file()
        for path, text in zip(paths, texts, strict=True):
            if text is not None and self._read_manifest(path, text):
                break
        else:
            self._refuse_foreign(damaged=texts != [None, None])
            return
        if journal.is_file():
            self._read_journal(journal)

    def _read_manifest(self, path, text):
        """Take over a manifest; False if it is damaged."""
        try:
            values = json.loads(text)
            facts, records = self.parse(values)
            for record in records.values():
                self.check_record(record)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
            log.warning("%s is damaged (%s: %s)", path, type(err).__name__, err)
            return False
        # earlier versions wrote none
        if values.get("sha256", _checksum(values)) != _checksum(values):
            log.warning("%s is damaged (its checksum is wrong)", path)
            return False
        self.facts = facts
        self.records = records
        return True

    def _read_journal(self, path):
        """Add the records of a journal; a line that is not whole, as after a kill, is left out."""
        for line in path.read_bytes().splitlines():
            try:
                checksum, key, record = json.loads(line)
                if checksum != _checksum({key: record}):
                    continue
                if record is not None:
                    self.check_record(record)
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                continue
            if record is None:
                self.records.pop(key, None)
            else:
                self.records[key] = record

    def parse(self, values):
        """
        Facts and records of the values of a manifest.

        A subclass that reads manifests of earlier layouts brings them to the present one here.
        """
        facts = without(values, ("sha256", self.records_name))
        return facts, values[self.records_name]

    def check_record(self, record):
        """
        Raise an error (a `KeyError`, `TypeError` or `ValueError`) for a damaged record.

        A record of a file outside of the folder is refused by a `~miricigale.utils.exceptions.DataError`.
        """
        record["hash"]
        for name, product in record["products"].items():
            product["sha256"], operator.index(product["bytes"])
            self.path(name)

    def _refuse_foreign(self, *, damaged):
        """Refuse a folder that is another's, or whose files cannot be identified any more."""
        if damaged:
            msg = (
                f"neither {' nor '.join(self._manifests)} in {self.folder} can be read, so that "
                f"none of its products can be used; remove the folder, or {self.remedy}"
            )
            raise DataError(msg)
        # what was killed at its first moment leaves these
        ours = (self.lock_name, f".{self.lock_name}", PARTIAL, *self.inputs)
        if self.folder.exists() and (
            not self.folder.is_dir()
            or any(not entry.name.startswith(ours) for entry in self.folder.iterdir())
        ):
            if self.path(self._manifests[0]).is_file():
                # another process began between the two looks
                self._load()
                return
            raise data_error(
                self.folder, f"is not empty and is no {self.purpose}'s folder; {self.remedy}"
            )

    def __enter__(self):
        make_folder(self.folder)
        self._lock.__enter__()
        try:
            # another process may have changed it since it was looked at
            self._load()
            for path in self._unfinished():
                path.unlink()
            if not self.is_sound:
                # also in a new folder: from the first moment on it is taken
                self.write_manifest()
        except BaseException:
            self._lock.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *exc):
        try:
            if self._journal.is_file():
                self.write_manifest()
        finally:
            self._lock.__exit__(*exc)

    def _unfinished(self):
        """Paths of unfinished files that processes left over that were killed."""
        return list(self.folder.rglob(f"{PARTIAL}*"))

    def is_whole(self, key):
        """Whether all files of a record stand with the right checksums."""
        return not self.faults(key)

    def faults(self, key):
        """What is wrong with the files of a record: dict of name to ``"missing"`` or what else, in words."""
        products = self.records[key]["products"].items()
        faults = {name: self._fault(name, product) for name, product in products}
        return {name: fault for name, fault in faults.items() if fault}

    def _fault(self, name, product):
        """What is wrong with a file, in words; empty if nothing is."""
        path = self.path(name)
        size = product["bytes"]
        if not path.is_file():
            return "missing"
        status = path.stat()
        if status.st_size != size:
            return f"{status.st_size} bytes in place of {size}"
        # a file of many megabytes is read once
        state = (status.st_mtime_ns, product["sha256"])
        if self._whole.get(name) != state:
            if file_sha256(path) != product["sha256"]:
                return "another content than was written"
            self._whole[name] = state
        return ""

    def is_current(self, key, digest):
        """
        Whether files stand as their record says.

        Parameters
        ----------
        key : str
            Of the record.
        digest : str
            Hash of everything that the files depend on.
        """
        record = self.records.get(key)
        return record is not None and record["hash"] == digest and self.is_whole(key)

    def finish(self, key, digest, products, **notes):
        """
        Record that a piece of work is done.

        Parameters
        ----------
        key, digest : str
            As for `is_current`.
        products : dict of str to dict
            By name: what `FileFolder.describe` says of it.
        **notes
            Plain values that are kept with it.
        """
        record = {"hash": digest, **notes, "products": products}
        self.records[key] = record
        self._append(key, record)

    def drop(self, key):
        """Remove a record and the files that it names."""
        if key in self.records:
            self._append(key, None)
            for name in self.records.pop(key)["products"]:
                self.path(name).unlink(missing_ok=True)

    def _append(self, key, record):
        """Append a record to the journal, None for one that is removed."""
        path = self._journal
        with writing(path), path.open("ab") as file:
            # the first line end closes a line that could not be written wholly
            file.write(f"\n{json.dumps([_checksum({key: record}), key, record])}\n".encode())

    def standing_bytes(self):
        """Bytes that files in the folder take, also those of work that was stopped."""
        paths = [path for path in self.folder.rglob("*") if not path.is_symlink()]
        return sum(path.stat().st_size for path in paths if path.is_file())

    def write_manifest(self):
        """Write both manifests, with what stands in the journal."""
        values = {**self.facts, self.records_name: dict(sorted(self.records.items()))}
        text = json.dumps({"sha256": _checksum(values), **values}, indent=1)
        for name in self._manifests:
            self.save(name, lambda path: path.write_text(text, encoding="utf-8"))
        self._journal.unlink(missing_ok=True)


def _checksum(values):
    """Checksum of what a manifest says."""
    said = without(values, ["sha256"])
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()
