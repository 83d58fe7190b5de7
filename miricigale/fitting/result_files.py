"""Results of a fit in the files of a folder, of which one at a time is in memory."""

from pathlib import Path

import numpy as np
from astropy.table import vstack

from miricigale.fitting.io import read_results
from miricigale.fitting.results import FitResults
from miricigale.utils.exceptions import DataError, unknown_name
from miricigale.utils.files import open_fits
from miricigale.utils.folder import RecordFolder
from miricigale.utils.row_files import write_rows
from miricigale.utils.store import native

__all__ = ["FORMAT", "FitFolder", "FitResultsFiles", "open_results", "part_ids", "part_name"]

#: Layout of the folder.
FORMAT = "miricigale-fitparts-2"
_OLD_FORMAT = "miricigale-fitparts-1"


class FitFolder(RecordFolder):
    """Folder of the parts of a fit: each a record of one file, the fit itself in the facts."""

    purpose = "fit"
    lock_name = "fit.lock"
    records_name = "parts"
    remedy = "results of fit_file need a folder of their own"

    def parse(self, values):
        """Facts and records; those of the layout before say sizes and checksums by themselves."""
        facts, parts = super().parse(values)
        facts["job"]["catalogue"]["rows"], facts["job"]["chunk_rows"]
        if facts["format"] == _OLD_FORMAT:
            parts = {
                name: {
                    "hash": "",
                    "rows": part["rows"],
                    "fitted": part["fitted"],
                    "products": {name: {key: part[key] for key in ("sha256", "bytes")}},
                }
                for name, part in parts.items()
            }
        return facts | {"format": FORMAT}, parts


def part_name(i):
    """File name of part ``i``."""
    return f"part-{i:05d}.fits"


def part_ids(path):
    """Ids of a part, read without the rest."""
    with open_fits(path, wanted="fit results", memmap=True) as hdus:
        return native(np.array(hdus["RESULTS"].data["ids"]))


def open_results(path, *, partial=False, model=None):
    """
    Open the results that `fit_file` wrote.

    Parameters
    ----------
    path : path-like
        The folder.
    partial : bool, optional
        Whether a folder in which parts are missing is opened too.
    model : `~miricigale.sed.SEDModel`, optional
        The model the grid was made from, for spectra of the best fits.

    Returns
    -------
    results : `FitResultsFiles`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the folder holds no such results, or parts are missing.
    """
    results = FitResultsFiles(path, model=model)
    if not (partial or results.complete):
        msg = (
            f"{path} holds {len(results.paths)} of {results.n_parts} parts: fit_file with the "
            "same arguments goes on; partial=True opens what is there"
        )
        raise DataError(msg)
    return results


class FitResultsFiles:
    """
    Results of a fit in files, of which one part at a time is in memory.

    Made by `fit_file` and `open_results`. It has as many elements as objects, in the order of
    the catalog: iterating gives the `FitResults` of each object, ``[id]`` those of an id and
    ``[rows]``, a slice or array of row numbers or of truth values, those of some rows.

    Parameters
    ----------
    path : path-like
        The folder.
    model : `~miricigale.sed.SEDModel`, optional
        The model the grid was made from.
    """

    def __init__(self, path, *, model=None):
        self.path = Path(path)
        self.model = model
        folder = FitFolder(path)
        if not folder.facts:
            msg = f"{path} holds no results of fit_file (no manifest)"
            raise DataError(msg)
        #: What was fitted, and how.
        self.job = folder.facts["job"]
        self.n_parts = max(1, -(-self.job["catalogue"]["rows"] // self.job["chunk_rows"]))
        parts = folder.records
        names = [part_name(i) for i in range(self.n_parts)]
        self.paths = tuple(self.path / name for name in names if name in parts)
        for item in self.paths:
            if not item.is_file():
                msg = f"{self.path} has lost {item.name}, which its manifest names"
                raise DataError(msg)
        self._records = tuple(parts[item.name] for item in self.paths)

    def __repr__(self):
        n = sum(record["fitted"] for record in self._records)
        state = "" if self.complete else f" of {self.n_parts}"
        return (
            f"<FitResultsFiles of {len(self)} objects, {n} fitted, "
            f"{len(self.paths)}{state} parts in {self.path}>"
        )

    def __len__(self):
        return sum(record["rows"] for record in self._records)

    @property
    def complete(self):
        """Whether all parts are there."""
        return len(self.paths) == self.n_parts

    def _read(self, path, rows=None):
        return read_results(path, rows=rows)._changed(model=self.model)

    def parts(self):
        """Iterate over the parts: one `FitResults` at a time."""
        return map(self._read, self.paths)

    def __iter__(self):
        for part in self.parts():
            yield from part

    def __getitem__(self, key):
        """Return `FitResults`, as these have them by an id or by rows; others are not read."""
        if isinstance(key, (slice, list)) or np.ndim(key):
            return self._rows(np.arange(len(self))[key])
        key = key.item() if isinstance(key, np.generic) else key
        for path in self.paths:
            ids = part_ids(path).tolist()
            if key in ids:
                return self._read(path, [ids.index(key)])._take(0)
        msg = f"no object with the id {key!r} among {len(self)}"
        raise KeyError(msg)

    def _rows(self, rows):
        """Results of rows by number, in their order."""
        ends = np.cumsum([0, *(record["rows"] for record in self._records)])
        of_part = np.searchsorted(ends, rows, side="right") - 1
        found = [
            self._read(path, rows[of_part == i] - ends[i])
            for i, path in enumerate(self.paths)
            if i == 0 or np.any(of_part == i)
        ]
        order = np.argsort(of_part, kind="stable")
        return FitResults.concatenate(found)[np.argsort(order)]

    def to_table(self, columns=None):
        """
        Results as one table; see `FitResults.to_table`.

        Parameters
        ----------
        columns : list of str, optional
            Columns to keep, all by default; memory is needed for these only.

        Returns
        -------
        table : `~astropy.table.QTable`
        """
        tables = list(self._tables(columns))
        meta = tables[0].meta
        for table in tables:
            table.meta = {}
        out = tables[0] if len(tables) == 1 else vstack(tables, join_type="exact")
        out.meta.update(meta)
        return out

    def _tables(self, columns):
        if not self.paths:
            msg = f"{self.path} holds no part yet"
            raise DataError(msg)
        for part in self.parts():
            table = part.to_table()
            for name in columns or ():
                if name not in table.colnames:
                    raise unknown_name("column", name, table.colnames)
            yield table if columns is None else table[list(columns)]

    def write_table(self, path, *, columns=None, overwrite=False):
        """
        Write the table of all results to one FITS file, a part at a time.

        Parameters
        ----------
        path : path-like
            The file.
        columns : list of str, optional
            Columns to write, all by default.
        overwrite : bool, optional
            Whether a file that is there is replaced.

        Raises
        ------
        OSError
            If the file is there and ``overwrite`` is not set.
        """
        # parts may have ids of different lengths
        width = max((part_ids(item).dtype.itemsize for item in self.paths), default=0)
        write_rows(path, self._tables(columns), len(self), id_width=width, overwrite=overwrite)
