"""Tables on disk by pieces of rows: FITS binary tables, ECSV and CSV are read, FITS is written."""

import abc
import gc
import io
import json
import warnings
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable, Table

from miricigale.utils.content import file_sha256
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import open_fits, read_table, unpacked_size
from miricigale.utils.store import plain_value, replacing
from miricigale.utils.units import check_count

__all__ = ["RowFile", "open_rows", "write_rows"]


def open_rows(path, chunk_rows, *, hdu=None):
    """
    Open a table that is to be read in pieces.

    Parameters
    ----------
    path : path-like
        FITS with a binary table, ECSV, or CSV with a line of column names (``.csv``); VOTable and plain text,
        which are in memory as a whole.
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
    if not path.is_file():
        msg = f"no table {path}"
        raise DataError(msg)
    with open(path, "rb") as stream:
        start = stream.read(9)
    if start.startswith(b"SIMPLE"):
        return _FitsRows(path, chunk_rows, hdu)
    if hdu is not None:
        raise argument_error("hdu", f"None, for {path} is no FITS file", repr(hdu))
    packed = start.startswith((b"\x1f\x8b", b"BZh", b"\xfd7zXZ"))
    if not packed:
        unpacked_size(path)
    if start.startswith(b"# %ECSV"):
        return _ECSVRows(path, chunk_rows)
    if path.suffix.lower() == ".csv" and not packed:
        return _CSVRows(path, chunk_rows)
    if not packed and path.suffix.lower() in _WHOLE:
        return _WholeRows(path, chunk_rows)
    why = "unpack it first" if packed else "write it as FITS (a binary table) or ECSV"
    msg = f"{path} cannot be read as a table in pieces of rows: {why}"
    raise DataError(msg)


class RowFile(abc.ABC):
    """A table on disk of which one piece at a time is in memory."""

    def __init__(self, path, chunk_rows):
        self.path = path
        self.chunk_rows = chunk_rows

    @property
    @abc.abstractmethod
    def colnames(self):
        """Names of the columns."""

    @property
    @abc.abstractmethod
    def n_rows(self):
        """Number of rows."""

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

    def chunk(self, i):
        """
        Read piece ``i``.

        Returns
        -------
        table : `~astropy.table.QTable`
            As `QTable.read` gives these rows of the whole file; text is text, not bytes.
        """
        start, stop = self.span(i)
        try:
            table = self._read(start, stop)
        except (OSError, ValueError, TypeError) as err:
            first = (str(err).splitlines() or [type(err).__name__])[0]
            msg = f"{self.path} rows {start} to {stop} cannot be read: {first}"
            raise DataError(msg) from err
        if len(table) != stop - start:
            msg = f"{self.path} has {len(table)} rows where {stop - start} were counted"
            raise DataError(msg)
        return table

    def foreign_chunks(self, name):
        """
        Pieces that may have text that is not ASCII, found without making tables of them.

        Parameters
        ----------
        name : str
            The column that is asked for.

        Yields
        ------
        i : int
            Each piece of which this column is all ASCII or no text is left out.
        """
        for i in range(self.n_chunks):
            if self._is_foreign(name, *self.span(i)):
                yield i

    @abc.abstractmethod
    def _is_foreign(self, name, start, stop):
        """Whether these rows may have text that is not ASCII in a column."""

    @abc.abstractmethod
    def _read(self, start, stop):
        """Read rows; ``start`` is the first of a piece."""


#: Suffixes of files that are read as a whole: VOTable and plain text.
_WHOLE = (".xml", ".vot", ".votable", ".txt", ".cat", ".dat")


class _WholeRows(RowFile):
    """Rows of a table that can be read as a whole only."""

    @cached_property
    def _table(self):
        return read_table(self.path, wanted="a catalog")

    @property
    def colnames(self):
        return tuple(self._table.colnames)

    @property
    def n_rows(self):
        return len(self._table)

    def _is_foreign(self, name, start, stop):
        return self._table[name].dtype.kind in "OUS"

    def _read(self, start, stop):
        return self._table[start:stop]


class _FitsRows(RowFile):
    def __init__(self, path, chunk_rows, hdu):
        super().__init__(path, chunk_rows)
        self._hdu = hdu
        with open_fits(path, wanted="a catalog") as hdus:
            table = self._choose(hdus, hdu)
            self._header = table.header.copy()
            self._start = table.fileinfo()["datLoc"]
            self._colnames = tuple(table.columns.names)
            self._dtype = table.columns.dtype
            formats = dict(zip(table.columns.names, table.columns.formats, strict=True))
        self._width = self._header["NAXIS1"]
        ragged = [name for name, text in formats.items() if "P" in text or "Q" in text]
        if ragged:
            msg = (
                f"{path} has columns of variable length, {ragged}, "
                "which cannot be read in pieces of rows"
            )
            raise DataError(msg)
        wanted = self._start + self._width * self.n_rows
        if path.stat().st_size < wanted:
            msg = f"{path} is truncated: {path.stat().st_size} bytes, wanted at least {wanted}"
            raise DataError(msg)
        # what belongs to the whole table
        for key in ("CHECKSUM", "DATASUM", "THEAP"):
            self._header.remove(key, ignore_missing=True)
        self._header["PCOUNT"] = 0

    def _choose(self, hdus, hdu):
        tables = [i for i, item in enumerate(hdus) if isinstance(item, fits.BinTableHDU)]
        if hdu is None:
            if len(tables) != 1:
                msg = f"{self.path} has {len(tables)} binary tables; 'hdu' says which is meant"
                raise DataError(msg)
            return hdus[tables[0]]
        try:
            chosen = hdus[hdu]
        except (KeyError, IndexError) as err:
            msg = f"{self.path} has no extension {hdu!r}"
            raise DataError(msg) from err
        if not isinstance(chosen, fits.BinTableHDU):
            msg = f"{self.path} extension {hdu!r} is no binary table"
            raise DataError(msg)
        return chosen

    @property
    def colnames(self):
        return self._colnames

    @property
    def n_rows(self):
        return self._header["NAXIS2"]

    def _is_foreign(self, name, start, stop):
        if start == stop or self._dtype[name].base.kind != "S":
            return False
        rows = np.memmap(
            self.path,
            self._dtype,
            mode="r",
            offset=self._start + start * self._width,
            shape=stop - start,
        )
        return bool(np.any(np.ascontiguousarray(rows[name]).view(np.uint8) > 127))

    def _read(self, start, stop):
        with open_fits(self.path, wanted="a catalog", memmap=True) as hdus:
            table = self._choose(hdus, self._hdu)
            part = fits.BinTableHDU(table.data[start:stop], header=self._header)
            return QTable.read(part, character_as_bytes=False)


class _ECSVRows(RowFile):
    """
    Rows of ECSV; a row may go over several lines within quotes.

    `astropy.io.ascii` reads in pieces of its own (``fast_reader={"chunk_size": ...}``), but these are of a number
    of characters, not of rows, may end within quotes, and are not there for ECSV, whose header has the types.
    """

    @cached_property
    def _index(self):
        """Header, where each piece starts (bytes), number of rows."""
        header, starts, n_rows, here = [], [], 0, 0
        n_open, names_read = 0, False
        with open(self.path, "rb") as stream:
            for line in stream:
                begin, here = here, here + len(line)
                if n_open == 0 and (not line.strip() or line.startswith(b"#")):
                    if not names_read:
                        header.append(line)
                elif not names_read:
                    header.append(line)
                    names_read = True
                else:
                    if n_open == 0:
                        if n_rows % self.chunk_rows == 0:
                            starts.append(begin)
                        n_rows += 1
                    n_open = (n_open + line.count(b'"')) % 2
        if not names_read:
            msg = f"{self.path} has no line of column names"
            raise DataError(msg)
        return b"".join(header), [*starts, here], n_rows

    @property
    def n_rows(self):
        return self._index[2]

    @property
    def _header(self):
        return self._index[0]

    @cached_property
    def colnames(self):
        return tuple(self._parse(b"").colnames)

    def _piece(self, start):
        """The text of a piece, in bytes."""
        starts = self._index[1]
        i = start // self.chunk_rows
        if i + 1 >= len(starts):
            return b""
        with open(self.path, "rb") as stream:
            stream.seek(starts[i])
            return stream.read(starts[i + 1] - starts[i])

    def _is_foreign(self, name, start, stop):
        del name, stop
        return not self._piece(start).isascii()

    def _parse(self, rows):
        # a file, for astropy asks of text whether it is a URL, and urllib keeps what it was asked
        table = QTable.read(io.BytesIO(self._header + rows), format="ascii.ecsv")
        # what astropy read with is a cycle that holds the text of every field
        gc.collect()
        return table

    def _read(self, start, stop):
        del stop
        return self._parse(self._piece(start))


class _CSVRows(_ECSVRows):
    """CSV, whose columns are what all of their rows can be read as."""

    @cached_property
    def _header(self):
        """Header of ECSV."""
        names, kinds = self._index[0], {}
        for i in range(self.n_chunks):
            text = io.BytesIO(names + self._piece(self.span(i)[0]))
            for column in Table.read(text, format="ascii.csv").itercols():
                kinds[column.name] = min(kinds.get(column.name, "i"), column.dtype.kind)
        lines = ["# %ECSV 1.0", "# ---", "# delimiter: ','", "# datatype:"]
        for name, kind in kinds.items():
            lines.append(f"# - {json.dumps({'name': name, 'datatype': _KINDS[kind]})}")
        return "\n".join([*lines, ""]).encode() + names


#: Types of columns, any text first, in the order of the letters.
_KINDS = {"U": "string", "f": "float64", "i": "int64"}


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
                msg = "the parts have different columns"
                raise DataError(msg)
            n_bytes += stream.write(rows)
        stream.write(bytes(-n_bytes % 2880))


def _fits_rows(table, id_width):
    """Header and rows of a table as astropy writes it, text ids as wide as ``id_width``."""
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
