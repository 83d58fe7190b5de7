"""The one format in which libraries are kept: FITS, an image for each kind of spectrum."""

import threading
from dataclasses import field
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import Table

from miricigale.utils.arrays import middles
from miricigale.utils.caching import cached_property
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import cached_by_file, make_folder, open_fits
from miricigale.utils.named_values import convert_values, first_value, subset
from miricigale.utils.options import check_data, check_shape, check_that
from miricigale.utils.store import open_parts, write_parts
from miricigale.utils.units import WAVE, frozen_array, is_ascending, to_array
from miricigale.utils.values import value_class

#: Layout of files.
_LAYOUT = "miricigale-library-2"

#: Values of an axis that differ by less than this, relatively, are the same.
_SAME = 1e-6


@value_class
class LibraryTable:
    """
    A library of spectra: what a reader of distributed files gives.

    Parameters
    ----------
    name : str
        The resource, such as ``"torus.skirtor2016"``.
    wave : `~numpy.ndarray`, shape (n_wave,)
        Rest wavelengths in um (or a quantity), positive and ascending.
    axes : dict of str to `~numpy.ndarray`, shape (n_rows,)
        What distinguishes the spectra, in the units of the component's parameters. No two
        rows have the same values (to 1e-6, relatively) of all axes.
    spectra : dict of str to `~numpy.ndarray`, shape (n_rows, n_wave)
        The spectra, in ``units``, as float32 or float64. Those of `open_library` stay on
        disk, read-only and in the byte order of FITS; `spectrum` gives native float64.
    units : dict of str to str
        Units of axes, spectra and values that have one.
    values : dict of str to `~numpy.ndarray`, shape (n_rows,), optional
        Other numbers of each row.
    meta : dict, optional
        Plain values: what was read, checksums of the files (``"files"``), notes.
    summary : tuple of str, optional
        What was found, in sentences for the user who adds it.

    Raises
    ------
    ValueError
        If shapes or names do not fit together, wavelengths or axes are not finite or
        not in order, or two rows have the same values of all axes.
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
        if hasattr(self.wave, "unit"):
            wave = to_array(self.wave, WAVE, "wave")
        else:
            wave = self.wave
        wave = self.__dict__["wave"] = frozen_array(wave)
        good = is_ascending(wave, min_size=2) and wave[0] > 0 and np.isfinite(wave[-1])
        got = f"{wave.size} of shape {wave.shape}"
        check_that(good, "wave", "two or more positive, ascending wavelengths", got)
        self._check_names()
        n = self.n_rows
        shapes = {"axes": (n,), "values": (n,), "spectra": (n, wave.size)}
        for kind, shape in shapes.items():
            for name, column in getattr(self, kind).items():
                if kind != "spectra" and hasattr(column, "unit"):
                    raise argument_error(name, "plain numbers (units stand apart)", "a quantity")
                check_shape(column, shape, name)
                if kind == "axes" and not np.all(np.isfinite(column)):
                    raise argument_error(name, "finite in every row", "NaN or infinity")
        for kind in ("axes", "values"):
            arrays = {}
            for name, values in getattr(self, kind).items():
                arrays[name] = frozen_array(values)
            self.__dict__[kind] = arrays
        self.__dict__.update(summary=tuple(self.summary), _index=self._make_index())

    def _check_names(self):
        got = f"axes {list(self.axes)} and spectra {list(self.spectra)}"
        check_that(
            self.axes and self.spectra, "axes", "one axis and one kind of spectra at least", got
        )
        names = [*self.axes, *self.values, *self.spectra]
        # columns of a FITS table have names without case
        lower_names = set()
        for name in names:
            lower_names.add(name.lower())
        if len(lower_names) < len(names):
            raise argument_error("axes", "of other names than values and spectra", names)
        for name in names:
            wanted = "named by plain identifiers"
            check_that(name.isascii() and name.isidentifier(), "axes", wanted, repr(name))

    @property
    def n_rows(self):
        """Number of spectra of each kind."""
        return len(first_value(self.spectra))

    @cached_property
    def levels(self):
        """Different values of each axis, ascending: dict of name to `~numpy.ndarray`, read-only."""
        levels = {}
        for name, column in self.axes.items():
            nodes = np.unique(column)
            gap = _SAME * np.maximum(np.abs(nodes[1:]), np.abs(nodes[:-1]))
            levels[name] = frozen_array(nodes[np.append(True, np.diff(nodes) > gap)])
        return levels

    def _codes(self, axis, values):
        """Return for each value the number of the level that is the same, or -1."""
        levels = self.levels[axis]
        nearest = np.searchsorted(middles(levels), values)
        # zero has no relative neighborhood: there the extent of the axis is the measure
        tolerance = _SAME * np.maximum(np.abs(levels), 1e-3 * np.ptp(levels))
        return np.where(np.abs(values - levels[nearest]) <= tolerance[nearest], nearest, -1)

    def _place(self, codes):
        """Number of a combination of levels among all of them."""
        return np.ravel_multi_index(codes, [levels.size for levels in self.levels.values()])

    def _make_index(self):
        codes = {name: self._codes(name, column) for name, column in self.axes.items()}
        for name, numbers in codes.items():
            wanted = f"of values that differ by more than {_SAME:g}, relatively"
            check_that(not np.any(numbers < 0), name, wanted, "values closer together")
        places = self._place(tuple(codes.values()))
        index = dict(zip(places.tolist(), range(self.n_rows), strict=True))
        if len(index) < self.n_rows:
            row = next(i for i, place in enumerate(places.tolist()) if index[place] != i)
            values = ", ".join(f"{name} = {column[row]:g}" for name, column in self.axes.items())
            raise argument_error(
                "axes", "different in every row", f"{values} in rows {row} and {index[places[row]]}"
            )
        return index

    def missing(self, **values):
        """
        Return the axes on which the library has not these values.

        Parameters
        ----------
        **values : float or sequence of float
            In the units of the axes; the same to 1e-6, relatively. Other names are ignored.

        Returns
        -------
        missing : dict of str to tuple of float
            Name of the axis to the values that the library has; empty if it has them all.
        """
        out = {}
        for name, levels in self.levels.items():
            if np.any(self._codes(name, np.atleast_1d(values.get(name, []))) < 0):
                out[name] = tuple(levels.tolist())
        return out

    @property
    def complete(self):
        """Whether every combination of the values of the axes has a row."""
        return self.n_rows == np.prod([levels.size for levels in self.levels.values()])

    def row(self, **values):
        """
        Number of the row with these values of all axes, or None.

        Parameters
        ----------
        **values : float
            In the units of the axes; the same to 1e-6, relatively. Others than the axes
            are not looked at.

        Raises
        ------
        ValueError
            If an axis has no value.
        """
        missing = [name for name in self.axes if name not in values]
        got = f"only {', '.join(values) or 'none'}"
        check_that(not missing, ", ".join(missing), f"given to find a row of {self.name!r}", got)
        codes = [int(self._codes(name, float(values[name]))) for name in self.axes]
        if min(codes) >= 0:
            return self._index.get(int(self._place(codes)))
        return None

    def spectrum(self, kind, row):
        """
        Read spectra, as native float64.

        Parameters
        ----------
        kind : str
            Name of the kind of spectra.
        row : int or sequence of int
            Number(s) of rows.

        Returns
        -------
        spectrum : `~numpy.ndarray`, shape (n_wave,) or (n, n_wave)
            A copy.
        """
        return np.array(self.spectra[kind][row], dtype=float)


def write_library(library, path):
    """
    Write a library where `open_library` finds it, all or nothing.

    The same library gives the same bytes.

    Parameters
    ----------
    library : `LibraryTable`
        The library.
    path : path-like
        The file; one that is there is replaced.
    """
    text = {name: list(getattr(library, name)) for name in ("axes", "values", "spectra", "summary")}
    text["units"] = convert_values(str, library.units)
    rows = Table(library.axes | library.values)
    for name in rows.colnames:
        rows[name].unit = _fits_unit(library, name)
    arrays = {"WAVE": library.wave * WAVE}
    for name, spectra in library.spectra.items():
        array = np.asarray(spectra)
        if array.dtype.kind != "f" or array.dtype.itemsize not in (4, 8):
            array = array.astype(float)
        unit = _fits_unit(library, name)
        if unit is None:
            arrays[_extension(name)] = array
        else:
            arrays[_extension(name)] = u.Quantity(array, unit, copy=False)
    path = Path(path)
    make_folder(path.parent)
    text |= {"name": library.name, "meta": library.meta}
    write_parts(path, _LAYOUT, text=text, arrays=arrays, tables={"ROWS": rows}, overwrite=True)


def _extension(kind):
    return f"SPECTRA_{kind.upper()}"


def _fits_unit(library, name):
    """Return the unit for other readers, or None where there is none that FITS knows; ours is in the text."""
    unit = u.Unit(library.units.get(name, ""))
    try:
        if unit != u.one:
            return u.Unit(unit.to_string("fits"))
        return None
    except ValueError:
        return None


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
        The same object as long as the file does not change.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If it is something else, another library or truncated.
    """
    with _lock:
        return _open(path, name)


#: Threads that ask for the same library wait for one to open it.
_lock = threading.Lock()


@cached_by_file(maxsize=8)
def _open(path, name):
    wanted = f"library {name!r} (made by 'miricigale data add')"
    # the mapping lives as long as the arrays that use it
    with open_parts(path, (_LAYOUT,), wanted=wanted, memmap=True) as parts:
        text = parts.text
        check_data(text["name"] == name, path, f"holds {text['name']!r}, not {name!r}")
        rows = parts.table("ROWS")
        kinds = ("axes", "values")
        columns = {kind: {n: np.asarray(rows[n]) for n in text[kind]} for kind in kinds}
        spectra = {n: parts.mapped(_extension(n)) for n in text["spectra"]}
        facts = subset(text, ("name", "units", "meta", "summary"))
        return LibraryTable(wave=parts.array("WAVE"), spectra=spectra, **columns, **facts)


def verify_library(path, name):
    """
    Read all of a library and compare the checksums in it.

    Parameters and errors are those of `open_library`.

    Returns
    -------
    library : `LibraryTable`
        Opened anew.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If it is not whole, or a checksum or a number is not as it should be.
    """
    library = _open.__wrapped__(path, name)
    with open_fits(path, wanted=f"the library {name!r}") as hdus:
        for number, hdu in enumerate(hdus):
            # 1 is success, 2 no checksum
            problem = f"is damaged: wrong checksum in HDU {number} ({hdu.name})"
            check_data((hdu.verify_datasum(), hdu.verify_checksum()) == (1, 1), path, problem)
    for kind, spectra in library.spectra.items():
        for first in range(0, library.n_rows, 1000):
            good = np.all(np.isfinite(spectra[first : first + 1000]))
            check_data(good, path, f"has {kind!r} spectra with NaN or infinity")
    return library
