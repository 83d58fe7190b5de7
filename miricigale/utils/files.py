"""Files of users: opened, or refused in one sentence that names the file."""

import contextlib
import functools
import importlib
import io
import math
import os
import uuid
import warnings
import zipfile
from pathlib import Path

from astropy.io import fits
from astropy.units import UnitsError
from astropy.utils.exceptions import AstropyDeprecationWarning

from miricigale.utils.caching import cached
from miricigale.utils.configuration import conf
from miricigale.utils.exceptions import DataError, argument_error, warn

# how packed files begin, and the module of Python's that opens them
_PACKED = {b"\x1f\x8b": "gzip", b"BZh": "bz2", b"\xfd7zXZ\x00": "lzma"}
_ZIP = b"PK\x03\x04"
_COMPRESS = b"\x1f\x9d"
_CHUNK = 1 << 20
# a file may unpack to so many times its size, however large it is
_EXPANSION = 8
#: How the names of unfinished files begin.
PARTIAL = ".partial-"


def cached_by_file(maxsize, *, copies=False):
    """
    Decorator: keep what a function of a file makes, as long as the file stays the same one.

    Nobody who gets it can change it for others (`~miricigale.utils.caching.cached`).

    Parameters
    ----------
    maxsize : int
        How many results are kept; the least recently used go.
    copies : bool, optional
        Whether each caller gets a copy, as of `~miricigale.utils.caching.cached`.

    Returns
    -------
    decorator : callable
        For functions whose first argument is a path and whose arguments are all hashable.
    """

    def decorate(function):
        @cached(maxsize=maxsize, copies=copies)
        def read_again(path, state, *args):
            del state
            return function(path, *args)

        @functools.wraps(function)
        def call(path, *args):
            try:
                status = os.stat(path)
            except OSError:
                return function(path, *args)  # which says what is wrong
            state = (status.st_ino, status.st_size, status.st_mtime_ns)
            return read_again(str(path), state, *args)

        return call

    return decorate


@contextlib.contextmanager
def reading(path, wanted):
    """
    Name a file in what goes wrong while it is read.

    Parameters
    ----------
    path, wanted
        As for `open_fits`.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        In place of errors that are not of values or units, such as `AttributeError`; those get
        a note with the file if they do not name it.
    """
    try:
        yield
    except (OSError, ValueError, KeyError, MemoryError, ImportError, UnitsError) as err:
        if Path(path).name not in str(err):
            err.add_note(f"in {path}")
        raise
    except Exception as err:  # readers of different formats raise different exceptions
        raise unreadable(path, wanted, err) from err


@contextlib.contextmanager
def open_fits(path, *, wanted, **options):
    """
    Open a FITS file for a ``with`` statement, or say which file could not be read as what.

    Parameters
    ----------
    path : path-like
        The file.
    wanted : str
        What the file should be, for the message, such as ``"a matching kernel"``.
    **options
        Passed to `astropy.io.fits.open`.

    Yields
    ------
    hdus : `~astropy.io.fits.HDUList`
        The open file; what goes wrong within names it (`reading`).

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, no FITS or truncated, or would unpack to more than the bound of
        `check_unpacked`.
    """
    n_bytes = unpacked_size(path)
    # closes the file if something is wrong with it
    with contextlib.ExitStack() as opened:
        try:
            # astropy would leave what is shorter than one block open; packed files may be that short
            if os.path.isfile(path) and max(n_bytes, os.path.getsize(path)) < 2880:
                raise OSError("it is no FITS file, or truncated")
            with warnings.catch_warnings(record=True) as caught:
                # made errors at once they would leave the file open
                warnings.simplefilter("always")
                hdus = opened.enter_context(fits.open(path, **options))
                # headers are read late
                len(hdus)
            _check_declared(path, hdus, n_bytes)
            _judge(caught)
        except DataError:
            raise
        except (OSError, TypeError, ValueError, KeyError, AttributeError, fits.VerifyError) as err:
            raise unreadable(path, wanted, err) from err
        with reading(path, wanted):
            yield hdus


def is_path(value):
    """Whether a value is a path, or a text that may be one."""
    return isinstance(value, (str, os.PathLike))


def listed_images(images, argument="images", reader="miricigale.reduction.open_exposure"):
    """
    Return a list of one image or several, which files are not.

    Parameters
    ----------
    images : `~astropy.nddata.NDData` or iterable of them
        One, or several.
    argument : str, optional
        The argument's name, for the message.
    reader : str, optional
        Function that reads a file, for the message.

    Returns
    -------
    images : list of `~astropy.nddata.NDData`

    Raises
    ------
    ValueError
        If it is a path, or holds one.
    """
    # slow to import
    from astropy.nddata import NDData

    if isinstance(images, NDData):
        return [images]
    if not is_path(images):
        images = list(images)
        paths = [image for image in images if is_path(image)]
        if not paths:
            return images
        images = paths[0]
    msg = f"'{argument}' must be images, got a path: {reader}({str(images)!r}) reads one"
    raise ValueError(msg)


def make_folder(path):
    """Make a folder (`pathlib.Path`) and those that it is in, where they are not there yet."""
    path.mkdir(parents=True, exist_ok=True)


def split_extension(path):
    """
    Take ``file.fits[EXTENSION]`` apart.

    Parameters
    ----------
    path : path-like
        A file, with the name or number of an extension in brackets or without.

    Returns
    -------
    path : str
        The file.
    extension : str, int or None
        None without brackets, or if a file has this very name.

    Examples
    --------
    >>> from miricigale.utils.files import split_extension
    >>> split_extension("a.fits[SCI]"), split_extension("a.fits[1]"), split_extension("a.fits")
    (('a.fits', 'SCI'), ('a.fits', 1), ('a.fits', None))
    """
    path = os.fspath(path)
    name, bracket, selector = path.rpartition("[")
    if not (bracket and name and selector.endswith("]")) or os.path.exists(path):
        return path, None
    extension = selector[:-1].strip()
    return name, int(extension) if extension.isdigit() else extension


def file_place(path):
    """
    Take ``file.fits[EXTENSION,PLANE]`` apart.

    Parameters
    ----------
    path : path-like
        A file, with the extension in brackets or without.

    Returns
    -------
    name : str
        The file.
    extension : int, str or None
        None without brackets.
    plane : int, ``"mean"`` or None
        Of a cube; None of an image.

    Raises
    ------
    ValueError
        If the plane is something else.
    """
    name, extension = split_extension(path)
    if not isinstance(extension, str) or "," not in extension:
        return name, extension, None
    extension, _, plane = (part.strip() for part in extension.rpartition(","))
    if plane != "mean" and not plane.isdigit():
        raise argument_error("path", "FILE[EXTENSION,PLANE], the plane a number or mean", path)
    if extension.isdigit():
        extension = int(extension)
    return name, extension, plane if plane == "mean" else int(plane)


def _judge(caught):
    """Refuse what astropy only warns of, and pass its other warnings on."""
    for warning in caught:
        text = str(warning.message)
        if text.startswith("Error validating header"):
            msg = "truncated or damaged: " + " ".join(text.splitlines()[1].split())
            raise OSError(msg)
        # that data are missing is said by `_check_declared`, of packed files too
        # deprecations within astropy do not concern the user
        is_deprecation = issubclass(warning.category, AstropyDeprecationWarning)
        if not is_deprecation and not text.startswith("File may have been trunc"):
            warn(warning.message, warning.category)


def _check_declared(path, hdus, n_bytes):
    """Refuse headers that declare more data than there are, or than tiles may unpack to."""
    last = hdus[-1].fileinfo()
    wanted = 0
    if last is not None:
        wanted = last["datLoc"] + last["datSpan"]
    if bad := [i for i, hdu in enumerate(hdus) if not _is_sound(hdu)]:
        msg = f"damaged: the header of its extension {bad[0]}"
        raise OSError(msg)
    if wanted > n_bytes:
        msg = f"truncated: {n_bytes} bytes, and its headers declare {wanted}"
        raise OSError(msg)
    tiled = [hdu for hdu in hdus if isinstance(hdu, fits.CompImageHDU)]
    declared = sum(math.prod(hdu.shape) * abs(hdu.header["BITPIX"]) // 8 for hdu in tiled)
    check_unpacked(path, declared)


def _is_sound(hdu):
    """Whether a header declares an array, a table or nothing, of sizes that there are."""
    standard_kinds = (
        fits.PrimaryHDU,
        fits.ImageHDU,
        fits.CompImageHDU,
        fits.BinTableHDU,
        fits.TableHDU,
    )
    if not isinstance(hdu, (*standard_kinds, fits.GroupsHDU)):
        return False
    return all(value >= 0 for value in hdu.header["NAXIS*"].values())


def check_unpacked(path, n_bytes):
    """
    Refuse to unpack a file to more than the bound.

    The bound is ``miricigale.conf.unpacked_size`` (MB, 4000 by default), or eight
    times the size of the file if that is more.

    Parameters
    ----------
    path : path-like
        The file.
    n_bytes : int
        What it unpacks to, as a whole or in part.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If that is more than the bound.
    """
    bound = _bound(path)
    if n_bytes > bound:
        msg = (
            f"{path} ({os.stat(path).st_size / 1e6:.3g} MB on the disk) would unpack to "
            f"{'more than ' if n_bytes == bound + 1 else ''}{n_bytes / 1e9:.3g} GB, and the bound is "
            f"{bound / 1e9:.3g} GB; if it is to be trusted, raise miricigale.conf.unpacked_size (in MB)"
        )
        raise DataError(msg)


def _bound(path):
    """How many bytes a file may unpack to."""
    return max(conf.unpacked_size * 1_000_000, _EXPANSION * os.stat(path).st_size)


def unpacked_size(path):
    """
    Size of a file without the packing that astropy opens by itself (gzip, bzip2, xz, zip).

    Content is counted piece by piece and not kept. That takes as long as unpacking does, once for
    a file in a session.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    n_bytes : int
        0 if there is no such file.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If it would unpack to more than the bound of `check_unpacked`, or the packing is damaged
        or one that cannot be counted.
    """
    if not os.path.isfile(path):
        return 0
    try:
        n_bytes = _count(path, _bound(path))
    except Exception as err:  # each packing has its own
        if getattr(err, "errno", None):
            # the reader that opens it says what is wrong
            return 0
        raise unreadable(path, "a packed file", err) from err
    check_unpacked(path, n_bytes)
    return n_bytes


def _start(path):
    """First bytes of a file, which say how it is packed."""
    with open(path, "rb") as stream:
        return stream.read(6)


def is_zip(path):
    """Whether a file is a zip archive."""
    return _start(path).startswith(_ZIP)


def packed_open(path):
    """Open a file for reading bytes, unpacked if it is packed by gzip, bzip2 or xz, or alone in a zip archive."""
    start = _start(path)
    if start.startswith(_ZIP):
        # refuses what unpacks to too much, before it is in memory
        unpacked_size(path)
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if not name.endswith("/")]
            if len(names) != 1:
                msg = f"it is a zip archive of {len(names)} files, wanted is one"
                raise OSError(msg)
            return io.BytesIO(archive.read(names[0]))
    for begin, module in _PACKED.items():
        if start.startswith(begin):
            return importlib.import_module(module).open(path)
    return open(path, "rb")


def has_match(path, pattern, *, overlap):
    """
    Whether a file, packed or not, has a match of a pattern.

    Parameters
    ----------
    path : path-like
        The file.
    pattern : `re.Pattern`
        Of bytes.
    overlap : int
        Bytes of a piece that are looked at with the next one too.
    """
    before = b""
    with packed_open(path) as stream:
        while piece := stream.read(_CHUNK):
            if pattern.search(before + piece):
                return True
            before = piece[-overlap:]
    return False


@cached_by_file(256)
def _count(path, limit):
    """Bytes after unpacking; one more than the most if there are more."""
    start = _start(path)
    if start.startswith(_ZIP):
        with zipfile.ZipFile(path) as archive:
            return sum(member.file_size for member in archive.infolist())
    if start.startswith(_COMPRESS):
        raise OSError("it is packed by 'compress'; unpack it first")
    for begin, module in _PACKED.items():
        if start.startswith(begin):
            n_bytes = 0
            with importlib.import_module(module).open(path) as stream:
                while n_bytes <= limit and (piece := stream.read(_CHUNK)):
                    n_bytes += len(piece)
            return min(n_bytes, limit + 1)
    return os.stat(path).st_size


def write_fits(hdus, path, *, overwrite=False):
    """
    Write a FITS file whose checksums are not dated: the same content gives the same bytes.

    Parameters
    ----------
    hdus : list of HDUs
        The primary HDU first.
    path : path-like
        The file.
    overwrite : bool, optional
        Whether an existing file is replaced.
    """
    hdus = fits.HDUList(hdus)
    # writing would change the primary header after its sum
    hdus.update_extend()
    for hdu in hdus:
        hdu.add_checksum(when="of this HDU")
    with writing(path):
        hdus.writeto(path, overwrite=overwrite, output_verify="exception")


@contextlib.contextmanager
def writing(path):
    """
    Write a file, with its name in what goes wrong.

    Parameters
    ----------
    path : path-like
        The file, by the name that the user knows.

    Raises
    ------
    OSError
        What was raised within, with the name of the file if it had none: a full disk is found
        by ``write``, which does not know the name.
    """
    try:
        yield
    except OSError as err:
        # the name of a file that is not whole yet ends in its own
        named = err.filename is not None and not str(err.filename).endswith(f"-{Path(path).name}")
        if isinstance(err, DataError) or named or str(path) in str(err):
            raise
        if err.errno is not None:
            raise OSError(err.errno, err.strerror, str(path)) from err
        # numpy says how much it wrote, but not why it was no more; of temporary names within nothing is said
        failed = OSError()
        failed.reason = getattr(err, "reason", err)
        failed.args = (f"{path} could not be written (is the disk full?): {failed.reason}",)
        raise failed from err


def unreadable(path, wanted, err):
    """A `DataError` that says which file could not be read as what, and why."""
    if isinstance(err, OSError) and not Path(path).is_file():
        err = "no such file"
        if Path(path).is_dir():
            err = "it is a folder, wanted is a file"
    lines = str(err).strip().splitlines() or [type(err).__name__]
    return DataError(f"{path} cannot be read as {wanted}: {lines[0]}")


@contextlib.contextmanager
def replacing(path, *, overwrite=True):
    """
    Write a file under a temporary name, and give it its own when it is whole.

    Parameters
    ----------
    path : path-like
        The file. Its folder exists.
    overwrite : bool, optional
        Whether a file that is there is replaced.

    Yields
    ------
    partial : `pathlib.Path`
        What to write, in the same folder and with the same suffix.

    Raises
    ------
    OSError
        If the file is there and ``overwrite`` is not set, or it cannot be written: then what stood
        there before stays.
    """
    path = Path(path)
    if not overwrite and path.exists():
        msg = f"{path} already exists; overwrite=True replaces it"
        raise OSError(msg)
    partial = path.with_name(f"{PARTIAL}{os.getpid()}-{uuid.uuid4().hex[:8]}-{path.name}")
    try:
        with writing(path):
            yield partial
            os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
