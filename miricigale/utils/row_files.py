"""Tables on disk by pieces of rows: FITS and parquet are read and written so, others are read as a whole."""

import contextlib
import io
import json
import warnings
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable, Table

from miricigale.utils.arrow_tables import arrow_table, index_of_ids
from miricigale.utils.column_units import in_units, silent_units
from miricigale.utils.content_hash import file_sha256
from miricigale.utils.exceptions import DataError, data_error
from miricigale.utils.files import open_fits, reading, replacing, split_extension, unreadable
from miricigale.utils.fits_tables import (
    LDAC_HEADER,
    check_names_differ,
    fits_ready,
    mask_scaled_nulls,
    names_in_header,
    ragged_columns,
)
from miricigale.utils.meta import plain_value
from miricigale.utils.optional_packages import require
from miricigale.utils.table_files import read_table
from miricigale.utils.units import check_count


def open_rows(path, chunk_rows, *, hdu=None, id_names=()):
    """
    Open a table that is to be read in pieces.

    Parameters
    ----------
    path : path-like
        FITS with a binary table, or parquet, of which one piece at a time is in memory; or any other file for
        `~miricigale.utils.table_files.read_table`, also a packed one, which is in memory as a whole.
        ``file.fits[2]`` names an extension.
    chunk_rows : int
        Rows in a piece.
    hdu : int or str, optional
        Extension of a FITS file; the only table by default, without that of keywords in FITS_LDAC.
    id_names : iterable of str, optional
        Columns of ids, besides those known by their names.

    Returns
    -------
    rows : `RowFile`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, of another kind, or cannot be read by rows.
    """
    chunk_rows = check_count(chunk_rows, "chunk_rows")
    path, extension = split_extension(path)
    if hdu is None:
        hdu = extension
    path = Path(path)
    start = b""
    if path.is_file():
        with open(path, "rb") as stream:
            start = stream.read(6)
    kinds = {b"SIMPLE": _FitsRows, b"PAR1": _ParquetRows}
    kind = next((kind for begin, kind in kinds.items() if start.startswith(begin)), RowFile)
    if kind is _FitsRows and _is_read_whole(path, hdu):
        kind = RowFile
    return kind(path, chunk_rows, hdu, tuple(id_names))


def _is_read_whole(path, hdu):
    """Whether astropy reads no pieces of a FITS table: one in ASCII, or with columns of variable length."""
    with open_fits(path, wanted="a catalog") as hdus:
        tables = [item for i, item in enumerate(hdus) if hdu in (None, i, item.name)]
        kinds = []
        for item in tables:
            if isinstance(item, (fits.TableHDU, fits.BinTableHDU)):
                kinds.append(type(item))
        return kinds == [fits.TableHDU] or any(map(ragged_columns, tables))


class RowFile:
    """A table on disk in pieces of rows; this class reads it as a whole when it is first used."""

    def __init__(self, path, chunk_rows, hdu, id_names=()):
        self.path = path
        self.chunk_rows = chunk_rows
        self._hdu = hdu
        self._id_names = id_names
        # the piece that was read last, by its number: fits read each one several times, and most catalogs are one
        self._pieces = {}

    @cached_property
    def _table(self):
        return read_table(self.path, wanted="a catalog", hdu=self._hdu, id_names=self._id_names)

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
        # what one reader changes is not there for the next
        table = self._piece(i).copy()
        table.rename_columns(table.colnames, list(self.colnames))
        return table

    def _piece(self, i):
        """Read piece ``i``, unless it was the last that was read."""
        if i not in self._pieces:
            # not two at the same time
            self._pieces.clear()
            # rows of a mapped file would keep it open
            self._pieces[i] = self._read(slice(*self.span(i))).copy()
        return self._pieces[i]

    def _read(self, rows):
        return self._table[rows]


class _FitsRows(RowFile):
    """Rows of a FITS table."""

    def __init__(self, path, chunk_rows, hdu, id_names=()):
        super().__init__(path, chunk_rows, hdu, id_names)
        with open_fits(path, wanted="a catalog") as hdus:
            table = self._choose(hdus)
            self._header = table.header.copy()
            self.n_rows = table.header["NAXIS2"]
            try:
                check_names_differ(names_in_header(table))
            except ValueError as err:
                raise unreadable(path, "a catalog", err) from None
        # what belongs to the whole table
        for key in ("CHECKSUM", "DATASUM", "THEAP"):
            self._header.remove(key, ignore_missing=True)
        self._header["PCOUNT"] = 0
        # two columns of the file may be one of the table, as those of a SkyCoord are
        self.colnames = tuple(self._piece(0).colnames)

    def _choose(self, hdus):
        tables = [i for i, item in enumerate(hdus) if isinstance(item, fits.BinTableHDU)]
        wanted = self._hdu
        if isinstance(wanted, str):
            wanted = wanted.upper()
        chosen = [i for i in tables if wanted in (None, i, hdus[i].name)]
        if wanted is None and len(chosen) > 1:
            chosen = [i for i in chosen if hdus[i].name != LDAC_HEADER]
        if len(chosen) != 1:
            problem = f"no binary table in extension {wanted!r}"
            if wanted is None:
                problem = f"{len(tables)} binary tables; 'hdu' says which is meant"
            raise data_error(self.path, f"has {problem}")
        return hdus[chosen[0]]

    def _read(self, rows):
        with open_fits(self.path, wanted="a catalog", memmap=True) as hdus:
            part = fits.BinTableHDU(self._choose(hdus).data[rows], header=self._header)
            with silent_units():
                table = Table.read(part, character_as_bytes=False)
            mask_scaled_nulls(table, part)
            return in_units(table, QTable, self._id_names)


class _ParquetRows(RowFile):
    """Rows of a parquet file, read in their order; going back begins anew."""

    def __init__(self, path, chunk_rows, hdu, id_names=()):
        super().__init__(path, chunk_rows, hdu, id_names)
        if hdu is not None:
            raise unreadable(path, "a catalog", f"'hdu' is {hdu!r}, and it is no FITS file")
        parquet = require("pyarrow.parquet", extra="parquet")
        try:
            # without a buffer a group of rows is read as a whole
            self._file = parquet.ParquetFile(path, buffer_size=1 << 20)
            self.n_rows = self._file.metadata.num_rows
            check_names_differ(self._file.schema_arrow.names)
            # of all rows, for a piece does not know whether its ids are distinct
            self._index_id = index_of_ids(self._file.schema_arrow, self._whole_column)
            self._begin()
            table = arrow_table(self._take(0), where=path.name, index_id=self._index_id)
            self.colnames = tuple(table.colnames)
        except (OSError, ValueError, NotImplementedError) as err:
            raise unreadable(path, "a catalog", err) from err

    def _whole_column(self, name):
        return self._file.read(columns=[name]).column(name)

    def _begin(self):
        self._batches = self._file.iter_batches(self.chunk_rows)
        self._at = 0
        self._kept = self._file.schema_arrow.empty_table()

    def _take(self, n):
        """Return the next rows, a `pyarrow.Table`."""
        batches = [self._kept]
        while sum(map(len, batches)) < n:
            batches.append(type(self._kept).from_batches([next(self._batches)]))
        rows = require("pyarrow", extra="parquet").concat_tables(batches)
        self._kept = rows.slice(n)
        self._at += n
        return rows.slice(0, n)

    def _read(self, rows):
        with reading(self.path, "a catalog"):
            if rows.start < self._at:
                self._begin()
            while self._at < rows.start:
                self._take(min(self.chunk_rows, rows.start - self._at))
            piece = self._take(rows.stop - rows.start)
            table = arrow_table(piece, Table, start=rows.start, index_id=self._index_id)
            return in_units(table, QTable, self._id_names)


def write_rows(path, tables, n_rows, *, id_width=0, overwrite=False):
    """
    Write tables of the same columns as one table, one at a time.

    Parameters
    ----------
    path : path-like
        The file: parquet if its name ends so, else FITS.
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
    write = _write_fits
    if Path(path).suffix.lower() == ".parquet":
        write = _write_parquet
    with replacing(path, overwrite=overwrite) as partial:
        write(partial, (_same_ids(table, id_width) for table in tables), n_rows)


def _same_ids(table, width):
    """A table whose ids, if they are text, have the given width."""
    if "id" in table.colnames and table["id"].dtype.kind == "U":
        description = table["id"].info.description
        table["id"] = np.asarray(table["id"]).astype(f"U{max(1, width // 4)}")
        table["id"].info.description = description
    return table


def _write_parquet(path, tables, _):
    parquet = require("pyarrow.parquet", extra="parquet")
    writer = None
    piece = path.with_suffix(".piece")
    with contextlib.ExitStack() as opened:
        opened.callback(piece.unlink, missing_ok=True)
        for table in tables:
            # as astropy writes it, with units and descriptions
            table.write(piece, format="parquet", overwrite=True)
            rows = parquet.read_table(piece)
            if writer is None:
                writer = opened.enter_context(parquet.ParquetWriter(path, rows.schema))
            _check_same(writer.schema.types, rows.schema.types)
            writer.write_table(rows)


def _write_fits(path, tables, n_rows):
    layout = None
    n_bytes = 0
    with open(path, "wb") as stream:
        for table in tables:
            header, rows = _fits_rows(table)
            columns = list(header["TFORM*"].values())
            if layout is None:
                layout = columns
                header["NAXIS2"] = n_rows
                headers = fits.PrimaryHDU().header.tostring() + header.tostring()
                stream.write(headers.encode("ascii"))
            _check_same(layout, columns)
            n_bytes += stream.write(rows)
        stream.write(bytes(-n_bytes % 2880))


def _check_same(layout, columns):
    if columns != layout:
        raise DataError("the parts have different columns")


def _fits_rows(table):
    """Header and rows of a table as astropy writes it."""
    meta = dict(table.meta)
    table.meta = {}
    for key, value in meta.items():
        if key == "citations":
            key = "cite"
            value = "; ".join(value)
        if not isinstance(value, (str, int, float, bool)):
            # headers hold no dicts
            value = json.dumps(value, default=plain_value)
        table.meta[key] = value
    file = io.BytesIO()
    table = fits_ready(table)
    with warnings.catch_warnings():
        # FITS does not know dex; astropy does when it reads the table
        warnings.filterwarnings("ignore", "The unit 'dex' could not be saved in native FITS")
        table.write(file, format="fits")
    data = file.getvalue()
    with fits.open(io.BytesIO(data)) as hdus:
        header = hdus[1].header.copy()
        start = hdus[1].fileinfo()["datLoc"]
    return header, data[start : start + header["NAXIS1"] * header["NAXIS2"]]
