"""Putting reference data into the data folder, all or nothing, with a record beside the file."""

import contextlib
import json
import os
import secrets
import shutil
from pathlib import Path

from miricigale.refdata.locate import data_folder, file_sha256, record_path
from miricigale.refdata.registry import resource
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import unpacked_size, writing

try:
    import fcntl
except ImportError:  # no such locks on Windows
    fcntl = None

__all__ = ["add_resource", "install", "locked", "partial_path"]

_PARTIAL = ".partial"


def partial_path(target):
    """
    A new name beside a file, under which it is written before it gets its own.

    Parameters
    ----------
    target : `pathlib.Path`
        The file or folder that is to be.

    Returns
    -------
    path : `pathlib.Path`
        Hidden, and not the name of any resource.
    """
    token = f"{os.getpid()}-{secrets.token_hex(4)}"
    return target.with_name(f".{target.name.lstrip('.')}.{token}{_PARTIAL}")


@contextlib.contextmanager
def locked(target):
    """
    Keep other processes from writing the same file or folder; wait if one does.

    What an interrupted process left half written is removed. The lock is advisory
    (``flock``); where the system has none two processes that add the same resource at the
    same moment may leave a record that does not fit the file, which `check_resources` tells.

    Parameters
    ----------
    target : `pathlib.Path`
        The file or folder; its parent is made.
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
            # nobody else is writing: these are leftovers
            for path in target.parent.glob(f".{target.name}.*{_PARTIAL}"):
                _remove(path)
        yield


def _remove(path):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def install(partial, target, record=None):
    """
    Give what was written under a partial name its own, with a record beside it.

    To be called while `locked`. Whoever looks finds the old file or the new one whole; if
    the process dies in between, a file without record ("unchecked").

    Parameters
    ----------
    partial, target : `pathlib.Path`
        What was written, and where it is to be found.
    record : dict, optional
        Plain values, kept as JSON in ``<file>.json``; checksum, size and time of the file
        are added.
    """
    beside = record_path(target)
    new = partial_path(beside)
    try:
        if record is not None:
            status = partial.stat()
            known = {
                "sha256": file_sha256(partial),
                "size": status.st_size,
                "mtime_ns": status.st_mtime_ns,
            }
            with writing(beside):
                new.write_text(json.dumps(known | record, indent=1) + "\n", encoding="utf-8")
        beside.unlink(missing_ok=True)
        if target.is_dir():
            # a folder cannot be replaced in one step
            old = partial_path(target)
            os.replace(target, old)
            os.replace(partial, target)
            _remove(old)
        else:
            os.replace(partial, target)
        if record is not None:
            os.replace(new, beside)
    finally:
        _remove(new)


def add_resource(name, path):
    """
    Copy a file or folder that the user brings into the data folder.

    Libraries of spectra are converted, not copied: see
    `miricigale.sed.libraries.add_library`.

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
    record, path = resource(name), Path(path).expanduser()
    if not record.file:
        raise argument_error("name", "a resource that is a file", f"{name!r} ({record.source})")
    if not path.exists():
        msg = f"no file or folder {path}"
        raise DataError(msg)
    if record.sha256 and (not path.is_file() or file_sha256(path) != record.sha256):
        msg = f"{path} is not the file that the record of {name!r} describes (sha256 differs)"
        raise DataError(msg)
    # a copy has no holes
    unpacked_size(path)
    target = data_folder() / record.file
    with locked(target):
        partial = partial_path(target)
        try:
            if path.is_dir():
                shutil.copytree(path, partial)
            else:
                shutil.copyfile(path, partial)
            install(partial, target)
        finally:
            _remove(partial)
    return target
