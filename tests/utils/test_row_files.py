"""Tables on disk in pieces of rows: the rows of the whole table, and the memory of one piece."""

import tracemalloc

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table

from miricigale.utils.exceptions import DataError
from miricigale.utils.row_files import open_rows
from miricigale.utils.table_files import read_table


@pytest.fixture
def table():
    rng = np.random.default_rng(1)
    n = 4000
    columns = {f"c{i}": rng.normal(size=n) * u.uJy for i in range(10)}
    return QTable({"id": [f'"n"\n{i}' for i in range(n)], **columns})


@pytest.mark.parametrize("suffix", ["fits", "fits.gz", "ecsv", "csv", "parquet"])
def test_pieces_are_the_rows_of_the_table(table, tmp_path, suffix):
    path = tmp_path / f"t.{suffix}"
    parquet = pytest.importorskip("pyarrow.parquet") if suffix == "parquet" else None
    Table(table).write(path)
    if parquet:
        # in groups that are no multiple of a piece
        parquet.write_table(parquet.read_table(path), path, row_group_size=700)
    rows = open_rows(path, 300)
    assert (rows.n_rows, rows.n_chunks, rows.colnames) == (4000, 14, tuple(table.colnames))
    for i in (13, 0, 6):
        piece = rows.chunk(i)
        for name in table.colnames:
            want = table[name][slice(*rows.span(i))]
            np.testing.assert_array_equal(np.asarray(piece[name]), np.asarray(want))
            if suffix != "csv":
                assert piece[name].unit == want.unit


def test_pieces_that_were_read_take_no_memory(table, tmp_path):
    path = tmp_path / "t.fits"
    Table(table).write(path)
    rows = open_rows(path, 500)
    rows.chunk(0)
    tracemalloc.start()
    try:
        for i in range(rows.n_chunks):
            rows.chunk(i)
        # a piece is some 60 kB; each that is kept would take as much at least
        assert tracemalloc.get_traced_memory()[0] < 200_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("suffix", ["fits", "ecsv"])
def test_what_a_reader_changes_is_not_there_for_the_next(table, tmp_path, suffix):
    path = tmp_path / f"t.{suffix}"
    Table(table).write(path)
    rows = open_rows(path, 300)
    name = rows.colnames[0]
    first = rows.chunk(2)
    value = first[name][0]
    first[name] = first[name][::-1]
    first.meta["note"] = "changed"
    first.remove_column(rows.colnames[1])
    again = rows.chunk(2)
    assert (again[name][0], again.colnames) == (value, list(rows.colnames))
    assert "note" not in again.meta


def test_a_column_of_csv_is_what_all_of_its_rows_can_be(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("id,a,b,c\n1,1,,2\nn2,2,,2.5\n")
    pieces = [open_rows(path, 1).chunk(i) for i in range(2)]
    assert [str(piece["id"][0]) for piece in pieces] == ["1", "n2"]
    kinds = [[piece[name].dtype.kind for name in piece.colnames] for piece in pieces]
    assert kinds == [list("Uiif"), list("Uiif")]
    assert all(np.ma.is_masked(piece["b"][0]) for piece in pieces)


def test_missing_values_of_parquet_are_missing(tmp_path):
    """Of a file of other programs: names by their length, categories, NaN for numbers, masks for the rest."""
    pyarrow, parquet = (pytest.importorskip(name) for name in ("pyarrow", "pyarrow.parquet"))
    columns = {
        "id": ["a", None, "much longer", "b"],
        "kind": pyarrow.array(["x", "y", "x", None]).dictionary_encode(),
        "n": [1, 2, None, 4],
        "flux": [1.5, None, 2.5, 3.5],
    }
    path = tmp_path / "t.parquet"
    parquet.write_table(pyarrow.table(columns), path)
    rows = open_rows(path, 3)
    for table in (rows.chunk(0), read_table(path, wanted="a table")[:3]):
        assert table["id"].tolist() == ["a", None, "much longer"]
        assert table["kind"].tolist() == ["x", "y", "x"]
        assert table["n"].tolist() == [1, 2, None]
        np.testing.assert_array_equal(table["flux"], [1.5, np.nan, 2.5])
    assert rows.chunk(1)["kind"].tolist() == [None]
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(DataError, match=r"t\.parquet cannot be read as a catalog"):
        open_rows(path, 3)
