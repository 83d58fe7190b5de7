"""The folder of a run: products written whole or not at all, and the record of what stands."""

import hashlib
import json
import logging
import operator
import os
from pathlib import Path, PurePosixPath, PureWindowsPath

from miricigale.refdata.locate import file_sha256
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import writing
from miricigale.utils.lock import FolderLock

__all__ = ["ProductFolder", "ProductStore"]

log = logging.getLogger(__name__)

MANIFEST = "manifest.json"
#: The same text once more: a run outlives the loss of either file.
SECOND_MANIFEST = ".manifest.copy.json"
CONFIG = "config.toml"
LOCK = "run.lock"
PARTIAL = ".partial-"


class ProductFolder:
    """
    Where products lie, and how they are written.

    Parameters
    ----------
    folder : path-like
        The folder of a run.
    """

    def __init__(self, folder):
        self.folder = Path(folder)

    def path(self, name):
        """
        Path of a product.

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
        windows = PureWindowsPath(name)
        if (
            not parts
            or ".." in windows.parts
            or windows.drive
            or windows.root
            or "/".join(parts) != name
            or "\0" in name
        ):
            msg = f"{name!r} is not the name of a product: products lie in {self.folder}"
            raise DataError(msg)
        path = self.folder
        for part in parts:
            path = path / part
            if path.is_symlink():
                msg = f"{path} is a symbolic link; products must lie in {self.folder} itself"
                raise DataError(msg)
        return path

    def save(self, name, writer):
        """
        Write a product under a temporary name, then rename it.

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
            If it cannot be written, for instance on a full disk; it names the product, and
            what stood there before stays.
        """
        path = self.path(name)
        # a process of a run that was killed may end a moment later than the next run begins
        partial = path.with_name(f"{PARTIAL}{os.getpid()}-{path.name}")
        try:
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                writer(partial)
                os.replace(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
        return path

    def describe(self, name):
        """Checksum and size of a product, as the manifest holds them."""
        path = self.path(name)
        return {"sha256": file_sha256(path), "bytes": path.stat().st_size}


class ProductStore(ProductFolder):
    """
    The folder of a run and the manifest of what stands in it.

    Used in a ``with`` statement it is locked for other processes.

    Parameters
    ----------
    folder : path-like
        Made when something is written, if it does not exist.

    Attributes
    ----------
    config : dict or None
        Plain values of the configuration that the products were made with, if known.
    records : dict of str to dict
        By stage, or stage and unit: ``hash``, ``seconds`` and ``products``.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the folder holds files but no manifest (it is not a run's folder), or a manifest
        names a product outside the folder.
    """

    def __init__(self, folder):
        super().__init__(folder)
        self._whole = {}
        self._lock = FolderLock(self.folder, name=LOCK, purpose="run")
        self._load()

    def _load(self):
        self.config, self.config_sha256, self.records = None, None, {}
        paths = [self.path(name) for name in (MANIFEST, SECOND_MANIFEST)]
        texts = [path.read_bytes() if path.is_file() else None for path in paths]
        #: Whether both manifests stand and say the same.
        self.is_sound = texts[0] is not None and texts[0] == texts[1]
        for path, text in zip(paths, texts, strict=True):
            if text is not None and self._read_manifest(path, text):
                break
        else:
            self._refuse_foreign(damaged=texts != [None, None])

    def _read_manifest(self, path, text):
        """Take over a manifest; False if it is damaged."""
        try:
            values = json.loads(text)
            records = values["stages"]
            for record in records.values():
                record["hash"], float(record["seconds"])
                for product in record["products"].values():
                    product["sha256"], operator.index(product["bytes"])
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
            log.warning("%s is damaged (%s: %s)", path, type(err).__name__, err)
            return False
        for record in records.values():
            for name in record["products"]:
                try:
                    self.path(name)
                except DataError as err:
                    msg = f"{path} cannot be used: {err}"
                    raise DataError(msg) from None
        # earlier versions wrote none
        if values.get("sha256", _checksum(values)) != _checksum(values):
            log.warning("%s is damaged (its checksum is wrong)", path)
            return False
        self.records = records
        self.config = values.get("config")
        self.config_sha256 = values.get("config_sha256")
        return True

    def _refuse_foreign(self, *, damaged):
        """Refuse a folder that is not a run's, or whose products cannot be told any more."""
        if damaged:
            msg = (
                f"neither {MANIFEST} nor {SECOND_MANIFEST} in {self.folder} can be read, so that "
                "none of its products can be used; remove the folder, or choose another with "
                "--output"
            )
            raise DataError(msg)
        # a run that was killed at its first moment leaves these
        if self.folder.exists() and (
            not self.folder.is_dir()
            or any(not e.name.startswith((LOCK, PARTIAL)) for e in self.folder.iterdir())
        ):
            if self.path(MANIFEST).is_file():
                # another run began between the two looks
                self._load()
                return
            msg = (
                f"{self.folder} exists, is not empty and is no run's folder; choose another "
                "with --output"
            )
            raise DataError(msg)

    def __enter__(self):
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock.__enter__()
        try:
            # another run may have changed it since it was looked at
            self._load()
            for path in self.folder.rglob(f"{PARTIAL}*"):
                # left over by a run that was killed
                path.unlink()
            if not self.is_sound:
                # also in a new folder: from the first moment on it is a run's
                self._write_manifest()
        except BaseException:
            self._lock.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *exc):
        self._lock.__exit__(*exc)

    def begin(self, values, text, *, write):
        """
        Note the configuration of the run that begins, and write it as ``config.toml``.

        Parameters
        ----------
        values : dict
            Plain values of all sections.
        text : str
            The file.
        write : bool
            Whether it is written; otherwise the one that stands says the same.
        """
        data = text.encode()
        if write:
            self.save(CONFIG, lambda path: path.write_bytes(data))
        self.config, self.config_sha256 = values, hashlib.sha256(data).hexdigest()
        self._write_manifest()

    def edited_config(self):
        """Path of ``config.toml`` if it is not what the last run is known to have written, or None."""
        path = self.path(CONFIG)
        # earlier versions noted none: it may have been edited
        if path.is_file() and file_sha256(path) != self.config_sha256:
            return path
        return None

    def is_whole(self, key):
        """Whether all products of a record stand with the right checksums."""
        return all(
            self._is_whole(name, product) for name, product in self.records[key]["products"].items()
        )

    def _is_whole(self, name, product):
        path = self.path(name)
        if not path.is_file() or path.stat().st_size != product["bytes"]:
            return False
        # a file of many megabytes is read once in a run
        state = (path.stat().st_mtime_ns, product["sha256"])
        if self._whole.get(name) != state:
            if file_sha256(path) != product["sha256"]:
                return False
            self._whole[name] = state
        return True

    def is_current(self, key, digest):
        """
        Whether a stage's products stand as its record says.

        Parameters
        ----------
        key : str
            Stage, or stage and unit.
        digest : str
            Hash of everything that the products depend on.
        """
        record = self.records.get(key)
        return record is not None and record["hash"] == digest and self.is_whole(key)

    def finish(self, key, digest, products, *, seconds):
        """
        Record that a stage is done.

        Parameters
        ----------
        key, digest : str
            As for `is_current`.
        products : dict of str to dict
            By name: what `ProductFolder.describe` says of it.
        seconds : float
            Time that it took.
        """
        self.records[key] = {"hash": digest, "seconds": round(seconds, 2), "products": products}
        self._write_manifest()

    def drop(self, key):
        """Forget a stage's record and remove the products that it names."""
        for name in self.records.pop(key, {}).get("products", {}):
            self.path(name).unlink(missing_ok=True)

    def standing_bytes(self):
        """Bytes that files in the folder take, also those of a stopped unit, which are replaced."""
        paths = [path for path in self.folder.rglob("*") if not path.is_symlink()]
        return sum(path.stat().st_size for path in paths if path.is_file())

    def checksums(self, stage):
        """Checksums of all products of a stage, over its units."""
        return {
            name: product["sha256"]
            for key, record in sorted(self.records.items())
            if key.split(":")[0] == stage
            for name, product in record["products"].items()
        }

    def _write_manifest(self):
        values = {
            "config": self.config,
            "config_sha256": self.config_sha256,
            "stages": dict(sorted(self.records.items())),
        }
        text = json.dumps({"sha256": _checksum(values), **values}, indent=1)
        for name in (MANIFEST, SECOND_MANIFEST):
            self.save(name, lambda path: path.write_text(text, encoding="utf-8"))


def _checksum(values):
    """Checksum of what a manifest says."""
    said = {key: value for key, value in values.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()
