"""Tables on disk by pieces of rows: FITS binary tables are read and written so, others are read as a whole."""

import io
import json
import warnings
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable

from miricigale.utils.content import file_sha256
from miricigale.utils.exceptions import DataError, data_error
from miricigale.utils.files import open_fits
from miricigale.utils.store import plain_value, replacing
from miricigale.utils.table_files import read_table
from miricigale.utils.units import check_count


def open_rows(path, chunk_rows, *, hdu=None):
    """
    Open a table that is to be read in pieces.

    Parameters
    ----------
    path : path-like
        FITS with a binary table, of which one piece at a time is in memory; or any other file for
        `~miricigale.utils.table_files.read_table`, also a packed one, which is in memory as a whole.
    chunk_rows : int
        Rows in a piece.
    hdu : int or str, optional
        Extension of a FITS file; the only table by default.

    Returns
    -------
    rows : `RowFile`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, of another kind, or cannot be read by rows.
    """
    chunk_rows = check_count(chunk_rows, "chunk_rows")
    path = Path(path)
    if path.is_file():
        with open(path, "rb") as stream:
            if stream.read(6) == b"SIMPLE":
                return _FitsRows(path, chunk_rows, hdu)
    return RowFile(path, chunk_rows, hdu)


class RowFile:
    """A table on disk in pieces of rows; this class reads it as a whole when it is first used."""

    def __init__(self, path, chunk_rows, hdu):
        self.path, self.chunk_rows, self._hdu = path, chunk_rows, hdu

    @cached_property
    def _table(self):
        return read_table(self.path, wanted="a catalog", hdu=self._hdu)

    @cached_property
    def colnames(self):
        """Names of the columns."""
        return tuple(self._table.colnames)

    @cached_property
    def n_rows(self):
        """Number of rows."""
        return len(self._table)

    @cached_property
    def sha256(self):
        """Checksum of the file."""
        return file_sha256(self.path)

    @property
    def n_chunks(self):
        """Number of pieces; a table without rows is one."""
        return max(1, -(-self.n_rows // self.chunk_rows))

    def span(self, i):
        """First row of piece ``i`` and the row after its last."""
        start = i * self.chunk_rows
        return start, min(self.n_rows, start + self.chunk_rows)

    def rename(self, names):
        """Give columns other names in all pieces: a dict by the present ones."""
        self.colnames = tuple(names.get(name, name) for name in self.colnames)

    def chunk(self, i):
        """
        Read piece ``i``.

        Returns
        -------
        table : `~astropy.table.QTable`
            As `QTable.read` gives these rows of the whole file; text is text, not bytes.
        """
        table = self._read(slice(*self.span(i)))
        table.rename_columns(table.colnames, list(self.colnames))
        return table

    def _read(self, rows):
        return self._table[rows]


class _FitsRows(RowFile):
    """Rows of a FITS table."""

    def __init__(self, path, chunk_rows, hdu):
        super().__init__(path, chunk_rows, hdu)
        with open_fits(path, wanted="a catalog") as hdus:
            table = self._choose(hdus)
            self._header, self.n_rows = table.header.copy(), table.header["NAXIS2"]
            self.colnames = tuple(table.columns.names)
            ragged = [column.name for column in table.columns if set(column.format) & {"P", "Q"}]
        if ragged:
            what = f"has columns of variable length, {ragged}"
            raise data_error(path, f"{what}, which cannot be read in pieces of rows")
        # what belongs to the whole table
        for key in ("CHECKSUM", "DATASUM", "THEAP"):
            self._header.remove(key, ignore_missing=True)
        self._header["PCOUNT"] = 0

    def _choose(self, hdus):
        tables = [i for i, item in enumerate(hdus) if isinstance(item, fits.BinTableHDU)]
        wanted = self._hdu.upper() if isinstance(self._hdu, str) else self._hdu
        chosen = [i for i in tables if wanted in (None, i, hdus[i].name)]
        if len(chosen) != 1:
            what = f"no binary table in extension {wanted!r}"
            if wanted is None:
                what = f"{len(tables)} binary tables; 'hdu' says which is meant"
            raise data_error(self.path, f"has {what}")
        return hdus[chosen[0]]

    def _read(self, rows):
        with open_fits(self.path, wanted="a catalog", memmap=True) as hdus:
            part = fits.BinTableHDU(self._choose(hdus).data[rows], header=self._header)
            return QTable.read(part, character_as_bytes=False)


def write_rows(path, tables, n_rows, *, id_width=0, overwrite=False):
    """
    Write tables of the same columns as one FITS table, one at a time.

    Parameters
    ----------
    path : path-like
        The file.
    tables : iterable of `~astropy.table.Table`
        At least one.
    n_rows : int
        Rows of all.
    id_width : int, optional
        Bytes of the longest text in the columns ``id``, four a character.
    overwrite : bool, optional
        Whether a file that is there is replaced.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the columns of two tables differ.
    OSError
        If the file is there and ``overwrite`` is not set.
    """
    layout, n_bytes = None, 0
    with replacing(path, overwrite=overwrite) as partial, open(partial, "wb") as stream:
        for table in tables:
            header, rows = _fits_rows(table, id_width)
            columns = [*header["TFORM*"].values()]
            if layout is None:
                layout, header["NAXIS2"] = columns, n_rows
                for part in (fits.PrimaryHDU().header, header):
                    stream.write(part.tostring().encode("ascii"))
            elif columns != layout:
                raise DataError("the parts have different columns")
            n_bytes += stream.write(rows)
        stream.write(bytes(-n_bytes % 2880))


def _fits_rows(table, id_width):
    """Header and rows of a table as astropy writes it, ids that are text of the given width."""
    if "id" in table.colnames and table["id"].dtype.kind == "U":
        about = table["id"].info.description
        table["id"] = np.asarray(table["id"]).astype(f"U{max(1, id_width // 4)}")
        table["id"].info.description = about
    meta, table.meta = dict(table.meta), {}
    for key, value in meta.items():
        if key == "citations":
            key, value = "cite", "; ".join(value)
        # headers hold no dicts
        plain = isinstance(value, (str, int, float, bool))
        table.meta[key] = value if plain else json.dumps(value, default=plain_value)
    file = io.BytesIO()
    with warnings.catch_warnings():
        # FITS does not know dex; astropy does when it reads the table
        warnings.filterwarnings("ignore", "The unit 'dex' could not be saved in native FITS")
        table.write(file, format="fits")
    data = file.getvalue()
    with fits.open(io.BytesIO(data)) as hdus:
        header, start = hdus[1].header.copy(), hdus[1].fileinfo()["datLoc"]
    return header, data[start : start + header["NAXIS1"] * header["NAXIS2"]]
