"""Files that others give us: opened, or refused in one sentence that names the file."""

import contextlib
import functools
import os
import warnings
from pathlib import Path

from astropy.io import fits
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning

from miricigale.utils.exceptions import DataError

__all__ = ["cached_by_file", "open_fits", "read_ecsv", "write_fits", "writing"]


def cached_by_file(maxsize):
    """
    Decorator: keep what a function of a file makes, as long as the file stays the same one.

    Parameters
    ----------
    maxsize : int
        How many results are kept; the least recently used go.

    Returns
    -------
    decorator : callable
        For functions whose first argument is a path and whose arguments are all hashable.
    """

    def decorate(function):
        @functools.lru_cache(maxsize=maxsize)
        def kept(path, state, *args):
            del state
            return function(path, *args)

        @functools.wraps(function)
        def call(path, *args):
            try:
                status = os.stat(path)
            except OSError:
                return function(path, *args)  # which says what is wrong
            state = (status.st_ino, status.st_size, status.st_mtime_ns)
            return kept(str(path), state, *args)

        return call

    return decorate


def open_fits(path, *, wanted, **options):
    """
    Open a FITS file, or say which file could not be read as what.

    Parameters
    ----------
    path : path-like
        The file.
    wanted : str
        What the file should be, for the message, such as ``"a matching kernel"``.
    **options
        Passed to `astropy.io.fits.open`.

    Returns
    -------
    hdus : `~astropy.io.fits.HDUList`
        To be closed (or used in a ``with`` statement).

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, no FITS or truncated.
    """
    hdus = None
    try:
        _refuse_stump(Path(path))
        with warnings.catch_warnings():
            warnings.filterwarnings("error", ".*truncated", AstropyUserWarning)
            hdus = fits.open(path, **options)
            # headers are read late: a truncated file shows only now
            len(hdus)
    except (OSError, TypeError, ValueError, AstropyUserWarning) as err:
        if hdus is not None:
            hdus.close()
        raise _unreadable(path, wanted, err) from err
    return hdus


def _refuse_stump(path):
    """Refuse what is shorter than one block of FITS; astropy would leave the file open."""
    if path.is_file() and path.stat().st_size < 2880:
        with open(path, "rb") as handle:
            if handle.read(2) != b"\x1f\x8b":  # compressed files may be that short
                msg = "it is no FITS file, or truncated"
                raise OSError(msg)


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


def read_ecsv(path, *, wanted):
    """
    Read an ECSV table, or say which file could not be read as what.

    Parameters are those of `open_fits`.

    Returns
    -------
    table : `~astropy.table.QTable`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or no ECSV table.
    """
    # astropy would take text for the table itself
    if not Path(path).is_file():
        raise _unreadable(path, wanted, "no such file")
    try:
        return QTable.read(path, format="ascii.ecsv")
    except (OSError, TypeError, ValueError) as err:
        raise _unreadable(path, wanted, err) from err


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
        if isinstance(err, DataError) or err.filename is not None or str(path) in str(err):
            raise
        if err.errno is not None:
            raise OSError(err.errno, err.strerror, str(path)) from err
        # numpy tells how much it wrote, but not why it was no more
        msg = f"{path} could not be written (is the disk full?): {err}"
        raise OSError(msg) from err


def _unreadable(path, wanted, err):
    if isinstance(err, FileNotFoundError):
        err = "no such file"
    lines = str(err).splitlines() or [type(err).__name__]
    return DataError(f"{path} cannot be read as {wanted}: {lines[0]}")
