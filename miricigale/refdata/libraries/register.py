"""Registration: distributed files read, checked, converted and put where models find them."""

import contextlib
import datetime
import importlib
import inspect
import shutil
import struct
import tarfile
import textwrap
import threading
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from miricigale.refdata.libraries.table import LibraryTable, verify_library, write_library
from miricigale.refdata.locate import data_folder, record_path, stored_record
from miricigale.refdata.registry import resource
from miricigale.refdata.store import installing
from miricigale.utils.exceptions import DataError, argument_error, unknown_name
from miricigale.utils.progress import progress

__all__ = ["READERS", "Report", "add_library"]

#: What reads the distributed files of a library: a function, or ``"module:function"``,
#: imported on first use; called with a `~pathlib.Path`, it gives a `LibraryTable`.
READERS = {
    "torus.skirtor2016": "miricigale.refdata.libraries.skirtor:read_skirtor",
    "dust.dale2014": "miricigale.refdata.libraries.dale2014:read_dale2014",
    "ssp.bc03_user": "miricigale.refdata.libraries.bc03:read_bc03",
}

#: What a reader raises when a file is not what it should be.
_FOREIGN = (
    ArithmeticError,
    EOFError,
    LookupError,
    OSError,
    TypeError,
    ValueError,
    struct.error,
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True)
class Report:
    """
    What was found in the files of a library, and where it is kept.

    ``str(report)`` is what ``miricigale data add`` prints.

    Parameters
    ----------
    name : str
        The resource.
    path : `~pathlib.Path`
        The converted file; its record stands beside it, as ``<file>.json``.
    source : `~pathlib.Path`
        What was read.
    n_spectra : int
        Number of spectra of each kind.
    kinds : dict of str to str
        Unit of each kind of spectra.
    axes : dict of str to `~numpy.ndarray`
        Different values of each axis.
    units : dict of str to str
        Unit of each axis.
    complete : bool
        Whether every combination of these values is there.
    wave : tuple of float
        First and last wavelength in um.
    n_wave : int
        Number of wavelengths.
    files : dict of str to str
        sha256 of every source file.
    sha256 : str
        Of the converted file.
    size : int
        Of the converted file, in bytes.
    summary : tuple of str
        What the reader says.
    replaced : str
        Date and checksum of the library that stood there, or empty.
    """

    name: str
    path: Path
    source: Path
    n_spectra: int
    kinds: dict
    axes: dict
    units: dict
    complete: bool
    wave: tuple
    n_wave: int
    files: dict
    sha256: str
    size: int
    summary: tuple = ()
    replaced: str = ""

    def __str__(self):
        number = f"{len(self.files):,} file{'s' if len(self.files) != 1 else ''}"
        rows = [("source", f"{self.source} ({number} read)")]
        kinds = ", ".join(f"{kind} ({unit or 'no unit'})" for kind, unit in self.kinds.items())
        wave = f"{self.n_wave} wavelengths, {self.wave[0]:g} to {self.wave[1]:g} um"
        rows += [("spectra", f"{self.n_spectra} of each kind: {kinds}; {wave}")]
        for name, values in self.axes.items():
            unit = f" {self.units[name]}" if self.units.get(name) else ""
            rows.append((name, f"{_some(values)}{unit}"))
        grid = " x ".join(str(values.size) for values in self.axes.values())
        total = int(np.prod([values.size for values in self.axes.values()]))
        missing = "complete" if self.complete else f"{total - self.n_spectra} of {total} not there"
        rows += [("grid", f"{grid}: {missing}")]
        rows += [("found", sentence) for sentence in self.summary]
        if len(self.files) <= 5:
            rows += [("sha256", f"{value}  {name}") for name, value in self.files.items()]
        rows += [("sha256", f"{self.sha256}  {self.path.name}")]
        rows += [("written", f"{self.path} ({self.size / 1e6:.1f} MB)")]
        rows += [("record", f"{record_path(self.path)} (checksums of all files)")]
        if self.replaced:
            rows += [("replaces", self.replaced)]
        width = max(shutil.get_terminal_size((100, 24)).columns, 60)
        lines, column = [self.name], max(len(key) for key, _ in rows) + 5
        for key, text in rows:
            # checksums and paths stay whole, to be copied
            fill = key in ("found", "spectra", *self.axes)
            lines += textwrap.wrap(
                text,
                width=width if fill else 10**6,
                initial_indent=f"    {key}".ljust(column),
                subsequent_indent=" " * column,
                break_long_words=False,
                break_on_hyphens=False,
            )
        return "\n".join(lines)


def _some(values, most=12):
    """The values of an axis, or their number and ends where there are many."""
    if values.size <= most:
        return f"{values.size}: {' '.join(f'{v:g}' for v in values)}"
    first, last = (" ".join(f"{v:g}" for v in part) for part in (values[:3], values[-2:]))
    return f"{values.size}: {first} ... {last}"


def add_library(name, path, *, progress_bar=False):
    """
    Read the distributed files of a library and keep it where models find it.

    The library stands in the data folder (`miricigale.refdata.conf`) as one FITS file, read
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
    reader, record = _reader(name), resource(name)
    path = Path(path).expanduser()
    # some readers take a pattern of names
    if not path.exists() and not any(mark in path.name for mark in "*?["):
        msg = f"no file or folder {path}"
        raise DataError(msg)
    target = data_folder() / record.file
    with _steps(name, show=progress_bar) as step:
        step("reading")
        library = _read(reader, name, path, progress_bar)
        with installing(target) as (partial, entry):
            step("writing")
            write_library(library, partial)
            step("checking")
            # what was written is what counts
            library = verify_library(partial, name)
            replaced = _present(target)
            entry |= _entry(library, path)
    known = stored_record(target)
    return Report(
        name=name,
        path=target,
        source=path,
        n_spectra=library.n_rows,
        kinds={kind: library.units.get(kind, "") for kind in library.spectra},
        axes={axis: library.values_of(axis) for axis in library.axes},
        units={axis: library.units.get(axis, "") for axis in library.axes},
        complete=bool(library.complete),
        wave=(float(library.wave[0]), float(library.wave[-1])),
        n_wave=library.wave.size,
        files=dict(library.meta["files"]),
        sha256=known["sha256"],
        size=known["size"],
        summary=library.summary,
        replaced=replaced,
    )


def _reader(name):
    try:
        reader = READERS[name]
    except KeyError:
        raise unknown_name("library", name, READERS) from None
    if isinstance(reader, str):
        module, function = reader.split(":")
        reader = getattr(importlib.import_module(module), function)
    return reader


def _read(reader, name, path, progress_bar):
    """Read the files; whatever is wrong with them is one sentence that names them."""
    options = {}
    if "progress_bar" in inspect.signature(reader).parameters:
        options["progress_bar"] = progress_bar
    try:
        library = reader(path, **options)
    except DataError:
        raise
    except _FOREIGN as err:
        reason = err.args[0] if isinstance(err, KeyError) and err.args else err
        msg = f"{path} cannot be read as {name!r}: {reason or type(err).__name__}"
        raise DataError(msg) from err
    if not isinstance(library, LibraryTable) or library.name != name:
        got = repr(getattr(library, "name", type(library).__name__))
        raise argument_error("reader", f"one that gives the library {name!r}", got)
    if not library.meta.get("files"):
        raise argument_error("reader", "one that gives meta['files'], their checksums", "none")
    return library


def _entry(library, source):
    """What the record beside the file says, in plain values."""
    from miricigale import __version__

    return {
        "name": library.name,
        "source": str(source.resolve()),
        "files": dict(library.meta["files"]),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "version": __version__,
        "n_spectra": library.n_rows,
        "axes": {axis: library.values_of(axis).tolist() for axis in library.axes},
        "units": dict(library.units),
        "summary": list(library.summary),
    }


def _present(target):
    """Date and checksum of the library that stands there, or an empty text."""
    if not target.exists():
        return ""
    try:
        old = stored_record(target) or {}
    except DataError:
        old = {}
    return f"one of {old.get('date', 'unknown date')}, sha256 {old.get('sha256', 'unknown')}"


@contextlib.contextmanager
def _steps(name, *, show):
    """Say what is being done and for how long: conversions take up to minutes."""
    bar = progress(show=show, total=3, desc=name, unit="step")
    stop = threading.Event()

    def tick():
        # nothing moves while a reader works but the clock
        while not stop.wait(0.5):
            bar.refresh()

    def step(text):
        bar.set_description(f"{name}: {text}", refresh=False)
        bar.update()
        bar.refresh()

    thread = threading.Thread(target=tick, daemon=True)
    if show:
        thread.start()
    try:
        yield step
    finally:
        stop.set()
        if show:
            thread.join()
        bar.close()
