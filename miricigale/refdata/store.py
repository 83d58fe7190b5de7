"""Putting reference data into the data folder, all or nothing, with a record beside the file."""

import contextlib
import json
import os
import shutil
from pathlib import Path

from miricigale.refdata.locate import data_folder, file_record, file_sha256, other_file, record_path
from miricigale.utils.exceptions import data_error
from miricigale.utils.files import unpacked_size
from miricigale.utils.store import PARTIAL, replacing

try:
    import fcntl
except ImportError:  # no such locks on Windows
    fcntl = None


@contextlib.contextmanager
def _locked(target):
    """
    Keep other processes from writing the same file or folder; wait if one does.

    What an interrupted process left half written is removed. The lock is advisory
    (``flock``); where the system has none two processes that add the same resource at the
    same moment may leave a record that does not fit the file, which `check_resources` reports.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with open(target.with_name(f".{target.name}.lock"), "ab") as handle:
        held = fcntl is not None
        try:
            if held:
                fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError:
            # some network file systems have no locks
            held = False
        if held:
            # no other process writes: these are left over from ones that ended
            for path in target.parent.glob(f"{PARTIAL}*-{target.name}*"):
                _remove(path)
        yield


def _remove(path):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def installing(target):
    """
    Write a file of the data folder and a record beside it; other processes wait.

    Other processes find the old file or the new one whole; if the process dies in between, a
    file without record ("unchecked").

    Parameters
    ----------
    target : `pathlib.Path`
        Where it is to be found; its folder is made.

    Yields
    ------
    partial : `pathlib.Path`
        What to write.
    record : dict
        To be filled with plain values, kept as JSON in ``<file>.json``; checksum, size and time
        of the file are added. Left empty there is no record.
    """
    beside, record = record_path(target), {}
    with _locked(target), contextlib.ExitStack() as last, replacing(target) as partial:
        yield partial, record
        # before anything of the old one goes
        with open(partial, "rb+") as handle:
            os.fsync(handle.fileno())
        if record:
            status = partial.stat()
            known = {
                "sha256": file_sha256(partial),
                "size": status.st_size,
                "mtime_ns": status.st_mtime_ns,
            }
            new = last.enter_context(replacing(beside))
            new.write_text(json.dumps(known | record, indent=1) + "\n", encoding="utf-8")
        beside.unlink(missing_ok=True)


def _replace_folder(path, target):
    """Copy a folder to the place of another, which cannot be replaced in one step."""
    new, old = (target.with_name(f"{PARTIAL}{word}-{target.name}") for word in ("new", "old"))
    with _locked(target):
        try:
            shutil.copytree(path, new)
            if target.is_dir():
                os.replace(target, old)
            os.replace(new, target)
            _remove(old)
        finally:
            _remove(new)


def add_resource(name, path):
    """
    Copy a file or folder that the user brings into the data folder.

    Libraries of spectra are converted, not copied: see
    `miricigale.refdata.libraries.add_library`.

    Parameters
    ----------
    name : str
        The resource that it is.
    path : path-like
        The file or folder.

    Returns
    -------
    path : `pathlib.Path`
        Where it stands now.

    Raises
    ------
    KeyError
        If there is no such resource.
    ValueError
        If the resource is not a file.
    `~miricigale.utils.exceptions.DataError`
        If there is no such path, or its checksum is not the record's.
    """
    record, path = file_record(name), Path(path).expanduser()
    if not path.exists():
        raise data_error(path, "is no file or folder")
    if record.sha256 and (not path.is_file() or file_sha256(path) != record.sha256):
        raise other_file(name, path)
    # a copy has no holes
    unpacked_size(path)
    target = data_folder() / record.file
    if path.is_dir():
        _replace_folder(path, target)
    else:
        with installing(target) as (partial, _):
            shutil.copyfile(path, partial)
    return target
