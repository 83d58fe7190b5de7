"""Ids: the column that holds them, and their values as they stand in a file."""

import sys

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import MaskedColumn, QTable, Table, vstack
from astropy.utils.masked import Masked
from numpy.testing import assert_array_equal

from helpers.errors import refuses, warned
from miricigale.evaluation import associate, match_truth
from miricigale.filters import as_photometry
from miricigale.photometry import ErrorModel
from miricigale.photometry.detection.prior_catalog import read_catalog
from miricigale.scene import check_catalog
from miricigale.utils.exceptions import CatalogWarning
from miricigale.utils.ids import counted_ids, id_column, ids_of_text, warn_of_duplicates
from miricigale.utils.region_files import circles, write_circles
from miricigale.utils.row_files import open_rows
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import as_table, read_ids, unique_ids

#: A double has 53 bits: the odd ones are no doubles.
LARGE = [2**53 + 1, 2**62 + 1, 2**62 + 3]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["ra", "id", "ID"], "id"),
        (["NUMBER", "ID"], "ID"),
        (["ra", "object_id"], "object_id"),
        (["TARGETID", "z"], "TARGETID"),
        (["objID", "specz"], "objID"),
        (["Source_Id"], "Source_Id"),
        (["\ufeffid", "ra"], "\ufeffid"),
        (["#id", "ra"], "#id"),
        (["label", "NUMBER"], "NUMBER"),
        (["label", "ra"], "label"),
        (["valid", "grid", "ra"], None),
    ],
)
def test_the_column_of_ids_is_found_by_one_rule(names, expected):
    assert id_column(names, "catalog") == expected


def test_several_columns_that_could_be_ids_are_refused_by_name():
    refuses("'catalog' must be a table with one column of ids.*'NUMBER' and 'objid'", id_column,
            ["NUMBER", "objid"], "catalog")  # fmt: skip


def test_rows_are_counted_with_a_word_where_a_column_looks_like_ids():
    table = Table({"CATAID": [7, 9], "valid": [True, True], "flux": [1.0, 2.0]})
    with pytest.warns(CatalogWarning, match="counted from 1, though 'CATAID' looks like ids"):
        assert counted_ids(table, "mine.csv").tolist() == [1, 2]
    assert counted_ids(Table({"flux": [1.0, 2.0]}), "mine.csv", 10).tolist() == [11, 12]


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (u.Quantity([3.0, 5.0], u.ct), [3, 5]),
        (np.array([2**63 + 5, 1], dtype=np.uint64), [2**63 + 5, 1]),
        (np.array([2**63 + 5, 2**63 + 7], dtype=object), [2**63 + 5, 2**63 + 7]),
        (np.array(["0007", "7"], dtype=object), ["0007", "7"]),
        (np.array([b"a", b"bc"]), ["a", "bc"]),
        ([1001.0, 1002.0], [1001, 1002]),
        ([1.5, 2.0], ["1.5", "2.0"]),
        (np.array([1, 2], dtype=">i4"), [1, 2]),
    ],
)
def test_ids_are_whole_numbers_or_text(column, expected):
    ids = read_ids(QTable({"id": column}))
    assert ids.tolist() == expected
    assert ids.dtype.kind in "iuU"


@pytest.mark.parametrize("column", [[True, False], [1j, 2j], np.array(["2024-01-01"], "M8[D]")])
def test_truth_values_dates_and_complex_numbers_are_no_ids(column):
    refuses("'photometry' must be a table with ids as integers or text, got the type", read_ids,
            Table({"id": column}))  # fmt: skip


@pytest.mark.parametrize(
    "column",
    [
        MaskedColumn([5, 7], mask=[False, True]),
        Masked(u.Quantity([5.0, 7.0], u.ct), mask=[False, True]),
        np.array([5, None], dtype=object),
        ["a", ""],
        [5.0, np.nan],
    ],
)
def test_a_missing_id_is_refused_by_its_row(column):
    for function in (read_ids, lambda table: unique_ids(table["id"], "photometry")):
        refuses(
            r"1 masked or empty, the first in row 1 \(from 0\)", function, QTable({"id": column})
        )


def test_floats_that_cannot_tell_ids_apart_are_refused():
    refuses(
        "floats of 64 bits are not exact, got .* in row 1", read_ids, Table({"id": [1.0, 2.0**62]})
    )
    single = np.array([1, 2**24 + 2], dtype=np.float32)
    refuses("floats of 32 bits are not exact", read_ids, Table({"id": single}))
    mixed = QTable({"id": np.array(["a", 7], dtype=object)})
    refuses(r"ids of one kind, got \['int', 'str'\]", read_ids, mixed)
    # which is what 2^24 + 1 becomes
    single = np.array([1, 2**24 + 1], dtype=np.float32)
    refuses("floats of 32 bits are not exact", read_ids, Table({"id": single}))


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["0007", "007", "7"], ["0007", "007", "7"]),
        (["1E2", "100"], ["1E2", "100"]),
        (["+7", "7"], ["+7", "7"]),
        (["7.0", "12."], [7, 12]),
        (["-3", "0"], [-3, 0]),
        (["9223372036854775809", "1"], [2**63 + 1, 1]),
        (["18446744073709551616", "1"], ["18446744073709551616", "1"]),
    ],
)
def test_text_of_digits_is_a_number_if_it_is_written_as_one(texts, expected):
    assert ids_of_text(texts).tolist() == expected


@pytest.mark.parametrize("unit", [None, "NA", "count", "whatever"])
@pytest.mark.parametrize("name", ["id", "K"])
def test_ids_of_fits_are_integers_whatever_their_unit(tmp_path, unit, name):
    path = tmp_path / "k.fits"
    columns = [
        fits.Column(name, "K", array=LARGE, unit=unit),
        fits.Column("f", "J", array=[1, 2, 3], unit="uJy"),
    ]
    fits.BinTableHDU.from_columns(columns).writeto(path)
    for table in (read_table(path, wanted="a table"), open_rows(path, 2).chunk(0)):
        assert table[name].tolist() == LARGE[: len(table)]
        assert table["f"].unit == u.uJy


def test_ids_of_votables_are_integers_whatever_their_unit(tmp_path):
    table = Table({"id": LARGE, "x": [1.0, 2.0, 3.0]})
    table["id"].unit = "count"
    table.write(tmp_path / "k.xml", format="votable")
    assert read_table(tmp_path / "k.xml", wanted="a table")["id"].tolist() == LARGE


def test_unsigned_ids_and_null_values_of_fits_are_exact(tmp_path):
    ids = np.array([2**63 + 5, 2**63 + 7, 1], dtype=np.uint64)
    Table({"id": ids, "x": [1.0, 2.0, 3.0]}).write(tmp_path / "u.fits")
    assert read_ids(read_table(tmp_path / "u.fits", wanted="a table")).tolist() == ids.tolist()
    column = fits.Column("id", "K", array=LARGE, null=LARGE[1], unit="count")
    fits.BinTableHDU.from_columns([column]).writeto(tmp_path / "n.fits")
    table = read_table(tmp_path / "n.fits", wanted="a table")
    assert table["id"][[0, 2]].tolist() == [LARGE[0], LARGE[2]]
    refuses("1 masked or empty, the first in row 1", read_ids, table)


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("form", ["z.csv", "z.txt", "z.dat"])
def test_ids_of_text_files_stay_as_they_are_written(tmp_path, mark, form):
    path = tmp_path / form
    text = {
        "z.csv": "id,f\n0007,1.5\n007,null\n1E2,3\n",
        "z.txt": "# id f\n0007 1.5\n007 null\n1E2 3\n",
        "z.dat": "id f\n0007 1.5\n007 null\n1E2 3\n",
    }[form]
    path.write_text(mark + text, encoding="utf-8")
    table = read_table(path, wanted="a table")
    assert table["id"].tolist() == ["0007", "007", "1E2"]
    assert_array_equal(np.ma.filled(table["f"], -1.0), [1.5, -1.0, 3.0])


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (["9223372036854775809", "9223372036854775811"], [2**63 + 1, 2**63 + 3]),
        (["1001.0", "1002.0"], [1001, 1002]),
        (["12", "7"], [12, 7]),
        (["12", "00.7"], ["12", "00.7"]),
        (["a1", "NA"], ["a1", "NA"]),
    ],
)
def test_numbers_of_text_files_are_exact(tmp_path, rows, expected):
    path = tmp_path / "n.csv"
    path.write_text("ID,f\n" + "".join(f"{row},1.0\n" for row in rows))
    assert read_table(path, wanted="a table")["ID"].tolist() == expected
    path.write_text("mine,f\n" + "".join(f"{row},1.0\n" for row in rows))
    assert read_table(path, wanted="a table", id_names=["mine"])["mine"].tolist() == expected


def test_text_in_utf_16_is_refused_in_a_sentence(tmp_path):
    path = tmp_path / "excel.csv"
    path.write_text("id,f\n1,1\n", encoding="utf-16")
    refuses("excel.csv .* text in UTF-16: save it in UTF-8", read_table, path, wanted="a table",
            error=OSError)  # fmt: skip


def test_a_blank_id_of_a_text_file_is_refused_and_the_others_stay_exact(tmp_path):
    path = tmp_path / "b.csv"
    path.write_text(f"id,f\n{LARGE[0]},1\n,2\n{LARGE[2]},3\n")
    table = read_table(path, wanted="a table")
    assert table["id"][[0, 2]].tolist() == [LARGE[0], LARGE[2]]
    refuses("first in row 1", read_ids, table)


def test_nullable_columns_and_the_index_of_pandas_are_kept():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"id": pandas.array([LARGE[1], None], dtype="Int64"), "f": [1.0, 2.0]})
    table = as_table(frame, "photometry")
    assert table["id"][0] == LARGE[1]
    refuses("1 masked or empty, the first in row 1", read_ids, table)
    unsigned = pandas.DataFrame({"id": pandas.array([2**63 + 5], dtype="UInt64")})
    assert read_ids(as_table(unsigned, "photometry")).tolist() == [2**63 + 5]
    frame = pandas.DataFrame({"f": [1.0, 2.0]}, index=pandas.Index([1001, 7], name="object_id"))
    assert as_table(frame, "photometry")["object_id"].tolist() == [1001, 7]
    frame.index.name = None
    assert as_table(frame, "photometry")["id"].tolist() == [1001, 7]
    frame = pandas.DataFrame({"id": [1, 2]}, index=pandas.Index([7, 8], name="id"))
    refuses("two of 'id' that differ", as_table, frame, "photometry")
    rows = pandas.DataFrame({"id": ["a", "b", "c"], "f": [1.0, 2.0, 3.0]})[lambda one: one.f > 1]
    assert as_table(rows, "photometry").colnames == ["id", "f"]
    assert as_table(pandas.DataFrame({"f": [1.0]}), "photometry").colnames == ["f"]


def test_frames_of_arrow_are_exact_and_name_what_they_lose():
    arrow = pytest.importorskip("pyarrow")
    rows = arrow.table(
        {"id": [LARGE[1], None], "f": [1.0, None], "lc": [[1.0], []], "none": arrow.nulls(2)}
    )
    with pytest.warns(CatalogWarning, match="left out: 'lc'"):
        table = as_table(rows, "photometry")
    assert table["id"][0] == LARGE[1]
    refuses("1 masked or empty, the first in row 1", read_ids, table)
    assert np.isnan(table["f"][1])
    assert np.isnan(table["none"]).all()


@pytest.mark.parametrize("form", ["file", "pieces", "arrow"])
def test_an_index_of_pandas_is_the_same_from_parquet_as_in_memory(tmp_path, form):
    """What counts from a start stands in the header alone: pandas 3 makes it of any ids with equal steps."""
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    indices = {
        "regular": pandas.RangeIndex(1001, 1005, name="object_id"),
        "regular without a name": pandas.RangeIndex(7, 15, 2),
        "regular of another name": pandas.RangeIndex(7, 11, name="gal"),
        "count of rows": pandas.RangeIndex(4),
        "numbers": pandas.Index([5, 9, 2, 7]),
        "text": pandas.Index(["0007", "07", "a", "b"], name="gal"),
        "repeated": pandas.Index([5, 5, 2, 7], name="field"),
        "exact": pandas.Index([LARGE[1], LARGE[2], 3, 4], name="TARGETID"),
        "levels": pandas.MultiIndex.from_arrays([[1, 1, 2, 2], [5, 6, 7, 8]], names=["t", "id"]),
    }
    for label, index in indices.items():
        frame = pandas.DataFrame({"f": [1.0, 2.0, 3.0, 4.0]}, index=index)
        path = tmp_path / "a.parquet"
        frame.to_parquet(path)
        if form == "arrow":
            table = as_table(pytest.importorskip("pyarrow").Table.from_pandas(frame), "x")
        elif form == "file":
            table = read_table(path, wanted="a table")
        else:
            rows = open_rows(path, 3)
            table = vstack([rows.chunk(0), rows.chunk(1)])
        expected = as_table(frame, "x")
        assert id_column(table.colnames, "x") == id_column(expected.colnames, "x"), label
        for name in expected.colnames:
            assert table[name].tolist() == expected[name].tolist(), label


@pytest.mark.parametrize("masked", [False, True])
def test_ids_with_a_unit_are_whole_in_tables_of_astropy_too(masked):
    """A QTable of a Table would make floats of them: three sources would be one."""
    table = Table({"NUMBER": LARGE, "redshift": [0.5, 0.6, 0.7]}, masked=masked)
    table["NUMBER"].unit = "count"
    table["miri.f770w"] = [1.0, 1.0, 1.0] * u.uJy
    sky = {"ra": [53.1, 53.2, 53.3], "dec": [-27.8] * 3, "profile": ["point"] * 3}
    errors = ErrorModel.from_depths({"miri.f770w": 26.0})
    noisy = errors.perturb(table, seed=1)
    placed = table.copy()
    for name, values in sky.items():
        placed[name] = values
    tables = [
        as_photometry(table, ["miri.f770w"]),
        noisy,
        read_catalog(placed),
        check_catalog(placed),
    ]
    for one in tables:
        assert read_ids(one).tolist() == LARGE
    assert len(set(noisy["miri.f770w"].value.tolist())) == 3
    assert table["NUMBER"].unit == u.ct


def test_tables_are_joined_by_ids_of_any_name():
    rng = np.random.default_rng(1)
    flux = np.linspace(1.0, 60.0, 60)
    truth = QTable({"NUMBER": np.arange(60), "miri.f770w": flux * u.uJy})
    measured = QTable({"object_id": np.arange(60)[::-1]})
    measured["miri.f770w"] = (flux + rng.normal(0.0, 0.1, 60))[::-1] * u.uJy
    model = ErrorModel.from_tables(truth, measured, bin_size=20)
    # by their rows the fluxes would differ by some 30 uJy
    assert 0.05 < model.sigma(30 * u.uJy, "miri.f770w").value < 0.2
    sky = SkyCoord(np.arange(60.0), 0.0, unit="deg")
    truth["sky"] = sky
    measured["sky"] = sky[::-1]
    table = match_truth(truth, measured, ["miri.f770w"])
    assert table["id"].tolist() == table["measured_id"].tolist() == list(range(60))
    table = associate(truth, measured, radius=1 * u.arcsec)
    assert table["first_id"].tolist() == table["second_id"].tolist()


def test_ids_that_occur_twice_are_warned_of_with_the_first_three():
    with pytest.warns(CatalogWarning, match=r"5 rows have an id .* \(4, 1, 9, \.\.\.\)"):
        warn_of_duplicates([4, 4, 1, 9, 1, 9, 8, 8, 4], "photometry")


def test_the_table_of_objects_of_fits_ldac_is_the_catalog(tmp_path):
    """SExtractor writes a table of keywords before each table of objects."""
    header = fits.BinTableHDU(Table({"Field Header Card": ["SIMPLE"]}), name="LDAC_IMHEAD")
    objects = fits.BinTableHDU(Table({"NUMBER": [3, 7], "f": [1.0, 2.0]}), name="LDAC_OBJECTS")
    path = tmp_path / "c.ldac"
    fits.HDUList([fits.PrimaryHDU(), header, objects]).writeto(path)
    for name in (path, f"{path}[2]", f"{path}[LDAC_OBJECTS]"):
        assert read_table(name, wanted="a table")["NUMBER"].tolist() == [3, 7]
        assert open_rows(name, 1).chunk(1)["NUMBER"].tolist() == [7]
    two = tmp_path / "two.ldac"
    fits.HDUList([fits.PrimaryHDU(), header, objects, header, objects]).writeto(two)
    refuses("2 tables of objects: name one", read_table, two, wanted="a table", error=OSError)


REGIONS = """# Region file format: DS9 version 4.1
global color=green
icrs
circle(53.1,-27.8,0.5") # text={7}
point(53.2,-27.8) # text={12}
-ellipse(53.3,-27.8,1",2",30)
"""


def test_regions_without_their_package_are_refused_in_a_sentence(tmp_path, monkeypatch):
    path = tmp_path / "a.reg"
    path.write_text(REGIONS)
    monkeypatch.setitem(sys.modules, "regions", None)
    message = "'regions' is needed for this: pip install 'miricigale.regions.'"
    refuses(message, read_table, path, wanted="a table", error=OSError)


def test_regions_are_positions(tmp_path):
    regions = pytest.importorskip(
        "regions", reason="needs regions: pip install miricigale[regions]"
    )
    path = tmp_path / "a.reg"
    path.write_text(REGIONS)
    table = read_table(path, wanted="a table")
    assert table["id"].tolist() == [7, 12]
    assert table["ra"].value.tolist() == [53.1, 53.2]
    np.testing.assert_allclose(table["radius"].to_value(u.arcsec), [0.5, np.nan])
    path.write_text("image\ncircle(3,4,2)\n")
    message = "has a region .number 1, CirclePixelRegion. without a center on the sky"
    refuses(message, read_table, path, wanted="a table", error=OSError)
    sky = SkyCoord([53.1, np.nan, 53.3], [-27.8, -27.8, 0.0], unit="deg")
    written = QTable({"id": [3, 4, 5], "sky": sky, "kind": ["good", "flagged", "missing"]})
    write_circles(written, path, radius=0.4 * u.arcsec, overwrite=True)
    back = read_table(path, wanted="a table")
    assert back["id"].tolist() == [3, 5]
    np.testing.assert_allclose(back["dec"].value, [-27.8, 0.0], atol=1e-8)
    assert "color=red" in path.read_text()
    # as they are, not of a file
    made = circles(written, 0.4 * u.arcsec)
    assert as_table(made, "catalog")["id"].tolist() == [3, 5]
    pixels = regions.Regions([regions.PointPixelRegion(regions.PixCoord(3, 4))])
    refuses(
        "the list of regions has a region .number 1", as_table, pixels, "catalog", error=OSError
    )
    refuses("already exists", write_circles, written, path, radius=1 * u.arcsec, error=OSError)


def test_a_table_with_positions_is_read_in_pieces(tmp_path):
    table = QTable({"id": [1, 2, 3], "f": [1.0, 2.0, 3.0] * u.uJy})
    table["sky"] = SkyCoord([53.1, 53.2, 53.3] * u.deg, [-27.8] * 3 * u.deg)
    table.write(tmp_path / "s.fits")
    rows = open_rows(tmp_path / "s.fits", 2)
    assert rows.colnames == ("id", "f", "sky")
    assert rows.chunk(1)["sky"].ra.deg.tolist() == [53.3]


def test_the_mark_of_a_comment_before_the_names_is_no_part_of_the_first(tmp_path):
    """As ``numpy.savetxt(header=...)`` and many scripts write the names of a CSV."""
    for first, name in (("#id", "id"), ("# ra", "ra")):
        path = tmp_path / f"{name}.csv"
        path.write_text(f"{first},f\n0007,1.0\n0012,2.0\n")
        assert read_table(path, wanted="a table").colnames == [name, "f"]
    assert read_table(tmp_path / "id.csv", wanted="a table")["id"].tolist() == ["0007", "0012"]


@pytest.mark.parametrize("name", ["source_name", "OBJNAME", "Target Name", "recno", "designation"])
def test_names_that_look_like_ids_are_named_where_rows_are_counted(name):
    table = Table({"f": [1.0, 1.0], name: [101, 102]})
    with pytest.warns(CatalogWarning, match=f"rows are counted from 1, though '{name}' looks like"):
        assert counted_ids(table, "catalog").tolist() == [1, 2]


def test_an_index_of_pandas_is_the_id_whatever_its_name():
    pandas = pytest.importorskip("pandas")
    index = pandas.Index([5, 7], name="cat_number")
    frame = pandas.DataFrame({"f": [1.0, 2.0]}, index=index)
    assert as_table(frame, "photometry")["id"].tolist() == [5, 7]
    assert as_table(frame, "photometry")["cat_number"].tolist() == [5, 7]
    # which a column of ids goes before
    frame["NUMBER"] = [1, 2]
    assert "id" not in as_table(frame, "photometry").colnames
    # redshifts are no ids
    frame = pandas.DataFrame({"f": [1.0, 2.0]}, index=pandas.Index([0.5, 0.7], name="z"))
    assert "id" not in as_table(frame, "photometry").colnames
    frame.index = pandas.MultiIndex.from_tuples([("A", 1), ("B", 1)])
    warned(r"levels of the index without a name are left out \(2 of 2\)", as_table, frame, "x")


def test_missing_ids_are_no_duplicates_and_numbers_in_messages_are_plain():
    ids = MaskedColumn([0, 5, 0, 5], mask=[True, False, True, False])
    warned(r"1 row has an id that occurred before \(5\)", warn_of_duplicates, ids, "x")
    wrong = Table({"id": np.array([2.0**60, 1.0])})
    refuses(r"got 1\.152921504606847e\+18 in row 0", read_ids, wrong)


@pytest.mark.parametrize("separator", [",", "\t"])
def test_an_index_that_pandas_wrote_into_text_is_the_ids(separator, tmp_path):
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"f": [1.0, 2.0]}, index=[901, 2**62 + 1])
    path = tmp_path / "c.csv"
    frame.to_csv(path, sep=separator)
    for data in (path, str(path), pd.read_csv(path, sep=separator), frame):
        assert read_ids(as_table(data, "catalog")).tolist() == [901, 2**62 + 1]
    # one that counts the rows says nothing
    frame.reset_index(drop=True).to_csv(path, sep=separator)
    assert "id" not in as_table(path, "catalog").colnames
