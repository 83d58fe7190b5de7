"""Finding reference data: environment, the user's folder, bundled files."""

import functools
import hashlib
import importlib.metadata
import os
import shutil
import warnings
from importlib import resources as importlib_resources
from pathlib import Path

from astropy import config as _config
from astropy.config import ConfigItem, ConfigNamespace

from miricigale.refdata.registry import resource, resources
from miricigale.utils.exceptions import DataError, MiricigaleWarning, argument_error

__all__ = [
    "add_resource",
    "check_resources",
    "conf",
    "data_folder",
    "file_sha256",
    "fingerprint",
    "locate",
]


class Conf(ConfigNamespace):
    """Settings of the package, kept in astropy's configuration folder."""

    data_folder = ConfigItem(
        "", "Folder for reference data that the user brings; empty: astropy's cache folder."
    )


conf = Conf()


def data_folder():
    """
    The user's folder for reference data.

    Returns
    -------
    folder : `pathlib.Path`
        ``conf.data_folder``, or ``miricigale`` in astropy's cache folder; it need not
        exist.
    """
    if conf.data_folder:
        return Path(conf.data_folder).expanduser()
    return Path(_config.get_cache_dir()) / "miricigale"


def file_sha256(path):
    """The sha256 of a file as hexadecimal text."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _places(record):
    if "MIRICIGALE_DATA" in os.environ:
        yield "MIRICIGALE_DATA", Path(os.environ["MIRICIGALE_DATA"]).expanduser()
    yield "the data folder", data_folder()
    if record.kind == "bundled":
        yield "the package", Path(str(importlib_resources.files("miricigale.refdata"))) / "files"


def _warn_of_override(record, label, path):
    """Say so if a bundled file gives way to another one of different content."""
    if label == "the package" or record.kind != "bundled" or not path.is_file():
        return
    if _sha256_of(path, path.stat().st_mtime_ns) != record.sha256:
        msg = f"resource {record.name!r} is taken from {path}, which differs from the bundled file"
        warnings.warn(msg, MiricigaleWarning, stacklevel=3)


def locate(name, *, check=False):
    """
    Find the file or folder of a resource.

    Looked for in ``$MIRICIGALE_DATA``, the configured data folder and, for bundled
    resources, the package; the first that has it wins. Nothing is downloaded.

    Parameters
    ----------
    name : str
        Such as ``"ssp.bc03"``; see `resources`.
    check : bool, optional
        Whether the checksum is compared with the record.

    Returns
    -------
    path : `pathlib.Path`

    Raises
    ------
    KeyError
        If there is no such resource.
    `~miricigale.utils.exceptions.DataError`
        If it is in none of the places, or its checksum differs.
    """
    record = resource(name)
    if not record.file:
        raise argument_error("name", "a resource that is a file", f"{name!r} ({record.source})")
    tried = []
    for label, folder in _places(record):
        path = folder / record.file
        if path.exists():
            if check and record.sha256 and path.is_file() and file_sha256(path) != record.sha256:
                msg = (
                    f"{path} is not the file that the record of {name!r} describes (sha256 differs)"
                )
                raise DataError(msg)
            _warn_of_override(record, label, path)
            return path
        tried.append(f"{label} ({folder})")
    msg = (
        f"resource {name!r} ({record.title}) is in none of {', '.join(tried)}; "
        f"get it from {record.source} and run 'miricigale data add {name} PATH'"
    )
    raise DataError(msg)


def fingerprint(name):
    """
    What identifies the data that a resource stands for now.

    Parameters
    ----------
    name : str
        The resource.

    Returns
    -------
    text : str
        sha256 of the file that `locate` finds (over names and contents for a folder), or the
        version of the package that it comes from.
    """
    record = resource(name)
    if not record.file:
        package = record.source.split(",")[0]
        return f"{package} {importlib.metadata.version(package)}"
    path = locate(name)
    if path.is_file():
        return _sha256_of(path, path.stat().st_mtime_ns)
    parts = [
        f"{p.relative_to(path)} {file_sha256(p)}" for p in sorted(path.rglob("*")) if p.is_file()
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@functools.lru_cache(maxsize=256)
def _sha256_of(path, modified):
    """Checksum of a file, kept as long as it does not change."""
    del modified
    return file_sha256(path)


def add_resource(name, path):
    """
    Copy a file or folder that the user brings into the data folder.

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
    target = data_folder() / record.file
    target.parent.mkdir(parents=True, exist_ok=True)
    # a copy that is interrupted must not be found later
    partial = target.with_name(target.name + ".partial")
    if path.is_dir():
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(path, partial)
        shutil.rmtree(target, ignore_errors=True)
    else:
        shutil.copyfile(path, partial)
    os.replace(partial, target)
    return target


def check_resources():
    """
    State of every resource.

    Returns
    -------
    rows : list of tuple
        Name, state (``"ok"``, ``"absent"``, ``"wrong checksum"``, ``"unchecked"``,
        ``"from package"``) and path or source, one for each record.
    """
    rows = []
    for name, record in resources().items():
        if not record.file:
            rows.append((name, "from package", record.source))
            continue
        try:
            path = locate(name, check=True)
        except DataError as err:
            state = "wrong checksum" if "sha256" in str(err) else "absent"
            rows.append((name, state, record.source))
        else:
            rows.append(
                (name, "ok" if record.sha256 and path.is_file() else "unchecked", str(path))
            )
    return rows
