"""Finding reference data: environment, the user's folder, bundled files."""

import importlib.metadata
import json
import os
from importlib import resources as importlib_resources
from pathlib import Path

from astropy import config as _config

from miricigale.refdata.registry import resource
from miricigale.utils.configuration import conf
from miricigale.utils.content_hash import file_sha256
from miricigale.utils.exceptions import DataError, ReferenceWarning, data_error, warn
from miricigale.utils.files import cached_by_file
from miricigale.utils.options import check_that


def _folder(configured, default):
    if configured:
        return Path(configured).expanduser()
    return Path(_config.get_cache_dir()) / default


def data_folder():
    """Return the user's folder for reference data: ``conf.data_folder``, or one in astropy's cache folder."""
    return _folder(conf.data_folder, "miricigale")


def cache_folder():
    """
    Return the user's folder for what the package can make again, such as model grids.

    Returns
    -------
    folder : `pathlib.Path`
        ``conf.cache_folder``, or ``miricigale/cache`` in astropy's cache folder; it need not
        exist, and may be deleted at any time.

    Examples
    --------
    >>> from miricigale import conf
    >>> from miricigale.refdata import cache_folder
    >>> with conf.set_temp("cache_folder", "/scratch/miricigale"):
    ...     print(cache_folder().name)
    miricigale
    """
    return _folder(conf.cache_folder, "miricigale/cache")


_kept_sha256 = cached_by_file(256)(file_sha256)


def record_path(path):
    """Return the path of the record that is kept beside a file that was added: ``<file>.json``."""
    return path.with_name(path.name + ".json")


def stored_record(path):
    """
    Record that was written when a file was added: dict, or None if there is none.

    Checksum, size, source and what was found; a `DataError` if it is there and cannot be read.
    """
    record_file = record_path(path)
    try:
        return dict(_read_record(record_file))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as err:
        raise data_error(
            record_file, f"cannot be read as the record of {path.name}: {err}"
        ) from err


@cached_by_file(16)
def _read_record(path):
    # thousands of checksums: read once
    record = json.loads(Path(path).read_text(encoding="utf-8"))
    if not isinstance(record, dict) or not isinstance(record.get("sha256"), str):
        raise ValueError("it has no 'sha256'")
    return record


def _places(record):
    if os.environ.get("MIRICIGALE_DATA"):
        yield "MIRICIGALE_DATA", Path(os.environ["MIRICIGALE_DATA"]).expanduser()
    yield "the data folder", data_folder()
    if record.kind == "bundled":
        yield "the package", Path(str(importlib_resources.files("miricigale.refdata"))) / "files"


def find_place(record):
    """
    Tell where the file of a record is found first: label and path.

    The label is ``"MIRICIGALE_DATA"``, ``"the data folder"``, ``"the package"`` or, with no path, ``""``.
    """
    for label, folder in _places(record):
        path = folder / record.file
        if path.exists():
            return label, path
    return "", None


def file_record(name):
    """Record of a resource that is a file; others are refused."""
    record = resource(name)
    check_that(record.file, "name", "a resource that is a file", f"{name!r} ({record.source})")
    return record


def find_resource(name):
    """
    Find the file or folder of a resource, if it is anywhere.

    Parameters
    ----------
    name : str
        Such as ``"torus.skirtor2016"``; see `resources`.

    Returns
    -------
    path : `pathlib.Path` or None
        As `locate` finds it; None where that would raise for want of a file.

    Raises
    ------
    KeyError
        If there is no such resource.

    Examples
    --------
    >>> from miricigale.refdata import find_resource
    >>> find_resource("ssp.bc03").name
    'ssp_bc03.fits'
    """
    return find_place(file_record(name))[1]


def locate(name):
    """
    Find the file or folder of a resource.

    Looked for in ``$MIRICIGALE_DATA``, the configured data folder and, for bundled
    resources, the package; the first that has it wins. Nothing is downloaded.

    Parameters
    ----------
    name : str
        Such as ``"ssp.bc03"``; see `resources`.

    Returns
    -------
    path : `pathlib.Path`

    Raises
    ------
    KeyError
        If there is no such resource.
    `~miricigale.utils.exceptions.DataError`
        If it is in none of the places.

    Examples
    --------
    >>> from miricigale.refdata import locate
    >>> locate("igm.inoue2014").name
    'igm_inoue2014.toml'
    """
    record = file_record(name)
    label, path = find_place(record)
    if path is None:
        places = ", ".join(f"{label} ({folder})" for label, folder in _places(record))
        remedy = f"get it from {record.source} and run 'miricigale data add {name} PATH'"
        msg = f"resource {name!r} ({record.title}) is in none of {places}; {remedy}"
        raise DataError(msg)
    is_misplaced = record.kind == "bundled" and label != "the package"
    if is_misplaced and fingerprint_of(path) != record.sha256:
        msg = f"resource {record.name!r} is taken from {path}, which differs from the bundled file"
        warn(msg, ReferenceWarning)
    return path


def fingerprint(name):
    """
    Return what identifies the data that a resource stands for now.

    The sha256 of the file that `locate` finds, or the version of the package that it comes from.
    """
    record = resource(name)
    if not record.file:
        package = record.source.split(",")[0]
        return f"{package} {importlib.metadata.version(package)}"
    return fingerprint_of(locate(name))


def fingerprint_of(path):
    """
    Return the sha256 of a file.

    It is not read where its size and time are those of the record beside it, or of an earlier call.
    """
    status = path.stat()
    try:
        record = stored_record(path) or {}
    except DataError:
        # reported by 'miricigale data check'; the file itself is what counts
        record = {}
    if (record.get("size"), record.get("mtime_ns")) == (status.st_size, status.st_mtime_ns):
        return record["sha256"]
    return _kept_sha256(path)
