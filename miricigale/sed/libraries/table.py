"""The one format in which libraries are kept: a FITS table with a row for each spectrum."""

import functools
import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable

from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import open_fits
from miricigale.utils.units import WAVE, to_array

__all__ = ["LibraryTable", "open_library", "write_library"]

_FORMAT = "miricigale-library-1"


@dataclass(frozen=True, eq=False)
class LibraryTable:
    """
    A library of spectra: what a reader of distributed files gives.

    Parameters
    ----------
    name : str
        The resource, such as ``"torus.skirtor2016"``.
    wave : `~numpy.ndarray`, shape (n_wave,)
        Rest wavelengths in um, ascending.
    axes : dict of str to `~numpy.ndarray`, shape (n_rows,)
        What distinguishes the spectra, in the units of the component's parameters.
    spectra : dict of str to `~numpy.ndarray`, shape (n_rows, n_wave)
        The spectra, in ``units``.
    units : dict of str to str
        Units of axes, spectra and values that have one.
    values : dict of str to `~numpy.ndarray`, shape (n_rows,), optional
        Other numbers of each row.
    meta : dict, optional
        Plain values: what was read, checksums of the files, notes.
    summary : tuple of str, optional
        What was found, in sentences for whoever registers it.
    """

    name: str
    wave: np.ndarray
    axes: dict
    spectra: dict
    units: dict = field(default_factory=dict)
    values: dict = field(default_factory=dict)
    meta: dict = field(default_factory=dict)
    summary: tuple = ()

    def __post_init__(self):
        wave = (
            to_array(self.wave, WAVE, "wave", ndim=1, finite=True)
            if hasattr(self.wave, "unit")
            else np.asarray(self.wave, dtype=float)
        )
        object.__setattr__(self, "wave", wave)
        if wave.size < 2 or not np.all(np.diff(wave) > 0):
            raise argument_error("wave", "two or more ascending wavelengths", f"{wave.size}")
        n = self.n_rows
        for kind in ("axes", "values"):
            for name, column in getattr(self, kind).items():
                if np.shape(column) != (n,):
                    raise argument_error(name, f"of shape ({n},)", np.shape(column))
        for name, column in self.spectra.items():
            if np.shape(column) != (n, wave.size):
                raise argument_error(name, f"of shape {(n, wave.size)}", np.shape(column))

    @property
    def n_rows(self):
        """Number of spectra of each kind."""
        return len(next(iter(self.spectra.values())))

    def values_of(self, axis):
        """Different values of an axis, ascending."""
        return np.unique(np.asarray(self.axes[axis], dtype=float))

    @functools.cached_property
    def _index(self):
        rows = np.column_stack([np.asarray(a, dtype=float) for a in self.axes.values()])
        return {tuple(np.round(row, 9)): i for i, row in enumerate(rows)}

    def row(self, **values):
        """
        Number of the row with these values of all axes, or None.

        Parameters
        ----------
        **values : float
            In the units of the axes.
        """
        return self._index.get(tuple(round(float(values[name]), 9) for name in self.axes))


def write_library(library, path):
    """
    Write a library where `open_library` finds it, all or nothing.

    Parameters
    ----------
    library : `LibraryTable`
        The library.
    path : path-like
        The file; one that is there is replaced.
    """
    path = Path(path)
    table = QTable()
    for kind in ("axes", "values", "spectra"):
        for name, column in getattr(library, kind).items():
            table[name] = np.asarray(column) * u.Unit(library.units.get(name, ""))
    hdu = fits.table_to_hdu(table)
    hdu.name = "SPECTRA"
    text = {
        "name": library.name,
        "axes": list(library.axes),
        "values": list(library.values),
        "spectra": list(library.spectra),
        "units": library.units,
        "meta": library.meta,
        "summary": list(library.summary),
    }
    data = np.frombuffer(json.dumps(text).encode(), dtype=np.uint8)
    wave = fits.ImageHDU(library.wave, name="WAVE")
    wave.header["BUNIT"] = "um"
    primary = fits.PrimaryHDU(header=fits.Header({"FORMAT": _FORMAT}))
    partial = path.with_name(path.name + ".partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    hdus = fits.HDUList([primary, wave, hdu, fits.ImageHDU(data, name="TEXT")])
    hdus.writeto(partial, overwrite=True, checksum=True)
    os.replace(partial, path)


def open_library(path, name):
    """
    Open a library that `write_library` wrote; the spectra stay on disk until they are used.

    Parameters
    ----------
    path : path-like
        The file.
    name : str
        The resource that it should be.

    Returns
    -------
    library : `LibraryTable`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If it is something else, another library or truncated.
    """
    path = Path(path)
    try:
        return _open(str(path), path.stat().st_mtime_ns, name)
    except OSError as err:
        if isinstance(err, DataError):
            raise
        msg = f"{path} cannot be read as the library {name!r}: {err}"
        raise DataError(msg) from err


@functools.lru_cache(maxsize=8)
def _open(path, modified, name):
    del modified
    try:
        with open_fits(path, wanted=f"the library {name!r}", memmap=True) as hdus:
            if hdus[0].header.get("FORMAT") != _FORMAT:
                msg = f"{path} is not a library in this package's format; see 'miricigale data add'"
                raise DataError(msg)
            text = json.loads(bytes(np.asarray(hdus["TEXT"].data)).decode())
            if text["name"] != name:
                msg = f"{path} holds {text['name']!r}, not {name!r}"
                raise DataError(msg)
            data = hdus["SPECTRA"].data
            return LibraryTable(
                name=name,
                wave=np.array(hdus["WAVE"].data, dtype=float),
                axes={n: np.array(data[n], dtype=float) for n in text["axes"]},
                values={n: np.array(data[n], dtype=float) for n in text["values"]},
                spectra={n: data[n] for n in text["spectra"]},
                units=text["units"],
                meta=text["meta"],
                summary=tuple(text["summary"]),
            )
    except (KeyError, ValueError, TypeError) as err:
        msg = f"{path} is not a whole library: {err}"
        raise DataError(msg) from err
