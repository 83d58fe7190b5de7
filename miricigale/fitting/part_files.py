"""Results of fits in a folder of part files, for catalogues larger than memory."""

import functools
import io
import json
import os
import re
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import vstack

from miricigale.fitting.results import FitResults
from miricigale.utils.exceptions import DataError, unknown_name
from miricigale.utils.files import open_fits, writing

__all__ = ["FitResultsFiles", "open_results"]

LOCK = "fit.lock"
MANIFEST = "manifest.json"
PARTS_FORMAT = "miricigale-fitparts-1"


def part_name(i):
    """File name of part ``i``."""
    return f"part-{i:05d}.fits"


def read_manifest(folder):
    """Read the manifest of a folder, or say that it is none."""
    path = Path(folder) / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        if manifest["format"] != PARTS_FORMAT:
            msg = f"its format is {manifest['format']!r}, wanted {PARTS_FORMAT!r}"
            raise ValueError(msg)
        names = {key: manifest[key] for key in ("job", "parts")}
        names["job"]["catalogue"]["rows"], names["job"]["chunk_rows"]
        for name, record in names["parts"].items():
            # parts are removed by these names
            if not re.fullmatch(r"part-[0-9]{5,}\.fits", name):
                msg = f"it names {name!r}, which is no part"
                raise ValueError(msg)
            record["rows"], record["fitted"], record["bytes"], record["sha256"]
    except FileNotFoundError as err:
        msg = f"{folder} holds no results of fit_file (no {MANIFEST})"
        raise DataError(msg) from err
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
        msg = f"{path} is no manifest of fit_file: {err}"
        raise DataError(msg) from err
    return manifest


def write_manifest(folder, manifest):
    """Write the manifest under another name and rename it."""
    path = Path(folder) / MANIFEST
    temporary = path.with_name(MANIFEST + ".tmp")
    # somebody may have put a link there, which would be followed
    temporary.unlink(missing_ok=True)
    with writing(path):
        temporary.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    os.replace(temporary, path)


def part_ids(path):
    """Ids of a part, read without the rest."""
    with open_fits(path, wanted="fit results", memmap=True) as hdus:
        ids = np.array(hdus["RESULTS"].data["ids"])
    return ids.astype(ids.dtype.newbyteorder("=")) if ids.dtype.kind in "iuf" else ids


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
    the catalogue: iterating gives a `FitResult` for each, ``[id]`` that of an id.

    Parameters
    ----------
    path : path-like
        The folder.
    model : `~miricigale.sed.SEDModel`, optional
        The model the grid was made from.
    """

    def __init__(self, path, *, model=None):
        self.path = Path(path)
        self.manifest = read_manifest(path)
        self.model = model
        rows, size = self.manifest["job"]["catalogue"]["rows"], self.manifest["job"]["chunk_rows"]
        self.n_parts = max(1, -(-rows // size))
        parts = self.manifest["parts"]
        names = [part_name(i) for i in range(self.n_parts)]
        self.paths = tuple(self.path / name for name in names if name in parts)
        for item in self.paths:
            if not item.is_file():
                msg = f"{self.path} has lost {item.name}, which its {MANIFEST} names"
                raise DataError(msg)
        self._records = tuple(parts[item.name] for item in self.paths)
        self._read = functools.lru_cache(maxsize=1)(self._read_part)

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

    def _read_part(self, path):
        results = FitResults.read(path)
        return results if self.model is None else results.with_model(self.model)

    def parts(self):
        """Iterate over the parts: one `FitResults` at a time."""
        for path in self.paths:
            yield self._read_part(path)

    def __iter__(self):
        for part in self.parts():
            yield from part

    def __getitem__(self, key):
        """Return the result of the object with this id (the first, if it occurs twice)."""
        key = key.item() if isinstance(key, np.generic) else key
        for path in self.paths:
            # only the ids are read until the part is found
            if key in part_ids(path).tolist():
                return self._read(path)[key]
        msg = f"no object with the id {key!r} among {len(self)}"
        raise KeyError(msg)

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
            table.meta.clear()
        out = tables[0] if len(tables) == 1 else vstack(tables, join_type="exact")
        out.meta.update(meta)
        return out

    def _tables(self, columns):
        if not self.paths:
            msg = f"{self.path} holds no part yet"
            raise DataError(msg)
        for part in self.parts():
            table = part.to_table()
            if columns is not None:
                for name in columns:
                    if name not in table.colnames:
                        raise unknown_name("column", name, table.colnames)
                table = table[list(columns)]
            yield table

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
        path = Path(path)
        if path.exists() and not overwrite:
            msg = f"{path} exists; overwrite=True replaces it"
            raise OSError(msg)
        width = max((part_ids(item).dtype.itemsize for item in self.paths), default=0)
        temporary = path.with_name(path.name + ".tmp")
        temporary.unlink(missing_ok=True)
        try:
            with writing(path), open(temporary, "wb") as stream:
                n_bytes = _write_rows(stream, self._tables(columns), len(self), width)
                stream.write(bytes(-n_bytes % 2880))
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def _write_rows(stream, tables, n_rows, id_size):
    """Write header and rows of tables of the same columns; returns the bytes of the rows."""
    first, n_bytes = None, 0
    for table in tables:
        header, data = _fits_rows(table, id_size)
        layout = [header[f"TFORM{i + 1}"] for i in range(header["TFIELDS"])]
        if first is None:
            first = layout
            header["NAXIS2"] = n_rows
            stream.write(fits.PrimaryHDU().header.tostring().encode("ascii"))
            stream.write(header.tostring().encode("ascii"))
        elif layout != first:
            msg = "the parts have different columns"
            raise DataError(msg)
        stream.write(data)
        n_bytes += len(data)
    return n_bytes


def _fits_rows(table, id_size):
    """Header of a table as FITS, and its rows as bytes."""
    if "id" in table.colnames and table["id"].dtype.kind == "U":
        about = table["id"].info.description
        # parts may have ids of different lengths
        table["id"] = np.asarray(table["id"]).astype(f"U{max(1, id_size // 4)}")
        table["id"].info.description = about
    meta = dict(table.meta)
    table.meta.clear()
    for key, value in meta.items():
        if key == "citations":
            key, value = "cite", "; ".join(value)
        # headers hold no dicts
        plain = isinstance(value, (str, int, float, bool))
        table.meta[key] = value if plain else json.dumps(value, default=str)
    file = io.BytesIO()
    with warnings.catch_warnings():
        # FITS does not know dex; astropy does when it reads the table
        warnings.filterwarnings("ignore", "The unit 'dex' could not be saved in native FITS")
        table.write(file, format="fits")
    data = file.getvalue()
    with fits.open(io.BytesIO(data)) as hdus:
        header = hdus[1].header.copy()
        start = hdus[1].fileinfo()["datLoc"]
    return header, data[start : start + header["NAXIS1"] * header["NAXIS2"]]
