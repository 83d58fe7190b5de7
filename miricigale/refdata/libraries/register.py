"""Registration: distributed files read, checked, converted and put where models find them."""

import contextlib
import datetime
import json
import os
import pkgutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from filelock import FileLock

from miricigale.refdata.libraries.table import LibraryTable, verify_library, write_library
from miricigale.refdata.lookup import data_folder, file_sha256, record_path, stored_record
from miricigale.refdata.registry import resource
from miricigale.utils.exceptions import DataError, data_error
from miricigale.utils.files import PARTIAL, make_folder, replacing
from miricigale.utils.options import check_names
from miricigale.utils.progress import progress

#: What reads the distributed files of a library: a function, or ``"module:function"``,
#: imported on first use; called with a `~pathlib.Path`, it gives a `LibraryTable`.
READERS = {
    "torus.skirtor2016": "miricigale.refdata.libraries.skirtor:read_skirtor",
    "dust.dale2014": "miricigale.refdata.libraries.dale2014:read_dale2014",
    "ssp.bc03_user": "miricigale.refdata.libraries.bc03:read_bc03",
}


@dataclass(frozen=True)
class Report:
    """
    What was found in the files of a library, and where it is kept.

    ``str(report)`` is what ``miricigale data add`` prints.

    Parameters
    ----------
    library : `LibraryTable`
        As it was read back.
    path : `~pathlib.Path`
        The converted file; its record stands beside it, as ``<file>.json``.
    source : `~pathlib.Path`
        What was read.
    sha256 : str
        Of the converted file.
    """

    library: LibraryTable
    path: Path
    source: Path
    sha256: str

    def __str__(self):
        library = self.library
        files = self.library.meta["files"]
        units = library.units
        n = library.n_rows
        wave = library.wave
        axes = library.levels
        number = f"{len(files):,} file{'s' if len(files) != 1 else ''}"
        rows = [("source", f"{self.source} ({number} read)")]
        kinds = ", ".join(f"{kind} ({units.get(kind) or 'no unit'})" for kind in library.spectra)
        span = f"{wave.size} wavelengths, {wave[0]:g} to {wave[-1]:g} um"
        rows += [("spectra", f"{n} of each kind: {kinds}; {span}")]
        for name, values in axes.items():
            rows.append((name, f"{_listed(values)} {units.get(name, '')}".rstrip()))
        grid = " x ".join(str(values.size) for values in axes.values())
        total = int(np.prod([values.size for values in axes.values()]))
        missing = "complete"
        if not library.complete:
            missing = f"{total - n} of {total} not there"
        rows += [("grid", f"{grid}: {missing}")]
        rows += [("found", sentence) for sentence in library.summary]
        if len(files) <= 5:
            rows += [("sha256", f"{value}  {name}") for name, value in files.items()]
        rows += [("sha256", f"{self.sha256}  {self.path.name}")]
        rows += [("written", f"{self.path} ({self.path.stat().st_size / 1e6:.1f} MB)")]
        rows += [("record", f"{record_path(self.path)} (checksums of all files)")]
        column = max(len(key) for key, _ in rows) + 1
        return "\n".join([library.name] + [f"    {key:{column}}{text}" for key, text in rows])


def _listed(values):
    """Return the values of an axis, or their number and ends where there are more than twelve."""
    if values.size <= 12:
        return f"{values.size}: {' '.join(f'{v:g}' for v in values)}"
    first = " ".join(f"{v:g}" for v in values[:3])
    last = " ".join(f"{v:g}" for v in values[-2:])
    return f"{values.size}: {first} ... {last}"


def add_library(name, path, *, progress_bar=False):
    """
    Read the distributed files of a library and keep it where models find it.

    The library stands in the data folder (`miricigale.conf`) as one FITS file, read
    from disk as it is needed, with a record of what it was made from beside it. One that
    stands there already is replaced once the new one was read, checked, written and read
    back.

    Parameters
    ----------
    name : str
        The resource, such as ``"torus.skirtor2016"``.
    path : path-like
        The file, folder or archive as its authors distribute it; what a reader takes stands
        in its docstring.
    progress_bar : bool, optional
        Whether the steps are shown.

    Returns
    -------
    report : `Report`
        What was found.

    Raises
    ------
    KeyError
        If no library of that name can be read; the message lists those that can.
    `~miricigale.utils.exceptions.DataError`
        If the files are not there, not those of this library or not whole; the message
        names the file. Nothing was changed then.
    """
    reader = _reader(name)
    record = resource(name)
    path = Path(path).expanduser()
    # some readers take a pattern of names
    if not path.exists() and not any(mark in path.name for mark in "*?["):
        raise data_error(path, "is no file or folder")
    target = data_folder() / record.file
    with _steps(name, show=progress_bar) as step:
        step("reading")
        library = _read(reader, name, path)
        with _installing(target) as (partial, entry):
            step("writing")
            write_library(library, partial)
            step("checking")
            # what was written is what counts
            library = verify_library(partial, name)
            entry |= _entry(library, path)
    return Report(library, target, path, stored_record(target)["sha256"])


@contextlib.contextmanager
def _installing(target):
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
        of the file are added.
    """
    record_file = record_path(target)
    record = {}
    make_folder(target.parent)
    lock = FileLock(target.with_name(f".{target.name}.lock"))
    with lock, contextlib.ExitStack() as last, replacing(target) as partial:
        # no other process writes: these are left over from ones that were interrupted
        for path in target.parent.glob(f"{PARTIAL}*-{target.name}*"):
            path.unlink(missing_ok=True)
        yield partial, record
        # before anything of the old one goes
        with open(partial, "rb+") as handle:
            os.fsync(handle.fileno())
        status = partial.stat()
        record_now = {"sha256": file_sha256(partial), "size": status.st_size}
        record_now["mtime_ns"] = status.st_mtime_ns
        new = last.enter_context(replacing(record_file))
        new.write_text(json.dumps(record_now | record, indent=1) + "\n", encoding="utf-8")
        record_file.unlink(missing_ok=True)


def _reader(name):
    check_names([name], "library", READERS)
    reader = READERS[name]
    if isinstance(reader, str):
        return pkgutil.resolve_name(reader)
    return reader


def _read(reader, name, path):
    """Read the files; whatever is wrong with them is one sentence that names them."""
    try:
        return reader(path)
    except DataError:
        raise
    except Exception as err:  # readers of different formats raise different exceptions
        reason = err
        if isinstance(err, KeyError) and err.args:
            reason = err.args[0]
        raise data_error(
            path, f"cannot be read as {name!r}: {reason or type(err).__name__}"
        ) from err


def _entry(library, source):
    """Return what the record beside the file says, in plain values."""
    from miricigale import __version__

    return {
        "name": library.name,
        "source": str(source.resolve()),
        "files": dict(library.meta["files"]),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "version": __version__,
    }


@contextlib.contextmanager
def _steps(name, *, show):
    """Say what is being done: conversions take up to minutes."""
    with contextlib.closing(progress(show=show, total=3, desc=name, unit="step")) as bar:

        def step(text):
            bar.set_description(f"{name}: {text}")
            bar.update()

        yield step
