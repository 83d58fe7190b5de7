"""Files as they were distributed: in folders and archives."""

import tarfile
import zipfile
import zlib
from pathlib import PurePosixPath

from miricigale.utils.exceptions import file_errors
from miricigale.utils.files import check_unpacked, unpacked_size


def is_archive(path):
    """Tell whether a file is a zip or tar archive."""
    return zipfile.is_zipfile(path) or tarfile.is_tarfile(path)


def members(path, accept):
    """
    Yield the files of a folder, or of a zip or tar archive, whose names ``accept`` takes.

    Yields
    ------
    place : `pathlib.PurePosixPath`
        Where it is, in the folder or the archive.
    data : bytes
        Its content.
    source : str
        Its place with that of the archive, for messages.
    """
    if path.is_dir():
        for file in sorted(path.rglob("*")):
            if accept(file.name) and file.is_file():
                yield PurePosixPath(file.as_posix()), file.read_bytes(), str(file)
        return
    n_bytes = 0
    with file_errors(
        path,
        "is a truncated or damaged archive",
        zipfile.BadZipFile,
        tarfile.TarError,
        EOFError,
        zlib.error,
    ):
        for place, size, read in _zipped(path) if zipfile.is_zipfile(path) else _tarred(path):
            if accept(place.name):
                n_bytes += size
                check_unpacked(path, n_bytes)
                yield place, read(), f"{path}:{place}"


def _zipped(path):
    with zipfile.ZipFile(path) as archive:
        for member in sorted(archive.infolist(), key=lambda member: member.filename):
            place = PurePosixPath(member.filename)
            yield place, member.file_size, lambda member=member: archive.read(member)


def _tarred(path):
    unpacked_size(path)
    with tarfile.open(path) as archive:
        for member in archive:
            if member.isfile():
                place = PurePosixPath(member.name)
                yield place, member.size, lambda member=member: archive.extractfile(member).read()
