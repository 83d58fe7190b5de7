"""Tables in text, as programs and people lay them out, and names of columns that stand twice."""

import gzip
import zipfile

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table

from helpers.errors import refuses
from miricigale.utils.exceptions import CatalogWarning, DataError
from miricigale.utils.row_files import open_rows
from miricigale.utils.table_files import read_table, write_table
from miricigale.utils.tables import as_table

SEXTRACTOR = """#   1 NUMBER       Running object number
#   2 ALPHA_J2000  Right ascension of barycenter (J2000)  [deg]
#   3 FLUX_AUTO    Flux within a Kron-like aperture       [uJy]
#   4 FLUX_APER    Fluxes within circular apertures       [uJy]
#   6 FLAGS        Extraction flags
  7 53.1 2.5 1.0 2.0 0
  9 53.2 3.5 1.5 3.0 0
"""

ECSV = """# %ECSV 1.0
# ---
# datatype:
# - {name: id, datatype: int64}
# - {name: f, datatype: float64}
# - {name: f, datatype: float64}
id f f
1 5 6
"""


@pytest.mark.parametrize(
    "text",
    [
        "id,f\n7,2.5\n9,3.5\n",
        "id;f\n7;2.5\n9;3.5\n",
        "id\tf\n7\t2.5\n9\t3.5\n",
        "id f\n7 2.5\n9 3.5\n",
        "# made by a program, of one field\n# id: its number\nid,f\n7,2.5\n9,3.5\n",
        "# made by a program\n#id,f\n7,2.5\n9,3.5\n",
        "#id,f\n7,2.5\n9,3.5\n",
        "id,f\n7,2.5\n# half\n9,3.5\n# end, of, all\n",
        "\ufeff# made by a program\nid,f\r\n7,2.5\r\n9,3.5\r\n",
    ],
)
@pytest.mark.parametrize("name", ["c.csv", "c.csv.zip"])
def test_csv_is_read_however_it_is_laid_out(text, name, tmp_path):
    path = tmp_path / name
    if name.endswith(".zip"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("c.csv", text)
    else:
        path.write_text(text, encoding="utf-8")
    table = read_table(path, wanted="a catalog")
    assert table.colnames == ["id", "f"]
    assert table["id"].tolist() == [7, 9]
    assert table["f"].tolist() == [2.5, 3.5]


def test_semicolons_are_no_part_of_names_in_other_text(tmp_path):
    path = tmp_path / "c.txt"
    path.write_text("id;f\n0007;2.5\n9;3.5\n")
    table = read_table(path, wanted="a catalog")
    assert table["id"].tolist() == ["0007", "9"]
    assert table["f"].tolist() == [2.5, 3.5]


def test_a_catalog_of_sextractor_is_read(tmp_path):
    path = tmp_path / "c.cat"
    path.write_text(SEXTRACTOR)
    table = read_table(path, wanted="a catalog")
    assert table["NUMBER"].tolist() == [7, 9]
    assert table["FLUX_AUTO"].to_value("uJy").tolist() == [2.5, 3.5]
    # two apertures, in two columns
    assert table["FLUX_APER_1"].to_value("uJy").tolist() == [2, 3]


def test_text_without_a_layout_is_refused_in_a_sentence(tmp_path):
    path = tmp_path / "c.dat"
    path.write_text("just one\n1 2 3\n\n4\n")
    with pytest.raises(DataError, match=r"c\.dat cannot be read as a catalog: no usual layout"):
        read_table(path, wanted="a catalog")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("c.csv", "id,f,f\n1,5,6\n"),
        ("c.txt", "id f f\n1 5 6\n"),
        ("c.ecsv", ECSV),
    ],
)
def test_two_columns_of_one_name_are_refused_unless_they_are_the_same(name, text, tmp_path):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(DataError, match=rf"{name} .* two columns 'f' that differ: give each"):
        read_table(path, wanted="a catalog")
    path.write_text(text.replace("5", "6"))
    with pytest.warns(CatalogWarning, match="twice are read once: 'f'"):
        table = read_table(path, wanted="a catalog")
    assert table.colnames == ["id", "f"]
    # names that stand in the file are none of astropy's making
    path.write_text("id,f,f_1\n1,5,6\n" if name == "c.csv" else "id f f_1\n1 5 6\n")
    assert read_table(path, wanted="a catalog", form="ascii").colnames == ["id", "f", "f_1"]


def test_two_columns_of_one_name_are_refused_in_fits_and_votable(tmp_path):
    path = tmp_path / "c.fits"
    columns = [fits.Column(name, "E", array=np.ones(2)) for name in ("id", "flux", "longname")]
    fits.BinTableHDU.from_columns(columns).writeto(path)
    path.write_bytes(path.read_bytes().replace(b"'longname'", b"'flux    '"))
    for read in (lambda: read_table(path, wanted="a catalog"), lambda: open_rows(path, 10)):
        with pytest.raises(
            DataError, match=r"c\.fits .* two columns 'flux': give each its own name"
        ):
            read()
    path = tmp_path / "c.xml"
    Table({"id": [1.0], "flux": [2.0], "other": [3.0]}).write(path, format="votable")
    path.write_text(path.read_text().replace('name="other"', 'name="flux"'))
    with pytest.raises(DataError, match=r"c\.xml .* two columns 'flux'"):
        read_table(path, wanted="a catalog")


def test_two_columns_of_one_name_are_refused_in_frames():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame([[1, 5.0, 6.0]], columns=["id", "f", "f"])
    refuses("'photometry' must be a frame whose columns have different names, got .*'f'", as_table,
            frame, "photometry")  # fmt: skip


def test_ids_may_begin_with_the_mark_of_a_comment(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("id,f\n#7,2.5\n# end\n#9,3.5\n")
    assert read_table(path, wanted="a catalog")["id"].tolist() == ["#7", "#9"]


def test_what_is_no_table_is_refused_in_a_sentence(tmp_path):
    image = tmp_path / "i.fits"
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(image)
    table = tmp_path / "t.fits"
    Table({"id": [1]}).write(table)
    text = tmp_path / "c.json"
    text.write_text('{"id": [1, 2]}')
    for path, message in (
        (image, r"i\.fits .* it has no table"),
        (f"{table}[7]", r"t\.fits .* it has no extension 7, only \['PRIMARY', "),
        (text, r"c\.json .* it is JSON"),
    ):
        with pytest.raises(DataError, match=message):
            read_table(path, wanted="a catalog")


@pytest.mark.parametrize(
    "head",
    [
        "# made by me\n# on a day\n# id f\n",
        "# id f\n# of F770W, in uJy\n",
        "## id f\n",
        "#id f\n",
        "# made by me\n\n#\n# id  f\n#\n",
    ],
)
def test_names_of_plain_text_stand_in_any_line_of_comment(head, tmp_path):
    path = tmp_path / "c.cat"
    path.write_text(head + "0007 2.5\n9 --\n")
    table = read_table(path, wanted="a catalog")
    assert table.colnames == ["id", "f"]
    assert table["id"].tolist() == ["0007", "9"]
    assert table["f"].tolist() == [2.5, None]


@pytest.mark.parametrize("word", ["INDEF", "\\N", "NA"])
def test_words_of_iraf_and_of_databases_are_missing(word, tmp_path):
    path = tmp_path / "c.csv"
    path.write_text(f"id,f\n1,{word}\n2,3.5\n")
    assert read_table(path, wanted="a catalog")["f"].tolist() == [None, 3.5]


@pytest.mark.parametrize("blank", ["", "   "])
@pytest.mark.parametrize("name", ["c.csv", "c.tsv", "c.tsv.gz", "c.txt"])
def test_an_empty_cell_between_tabs_moves_no_value(name, blank, tmp_path):
    # the fast reader of astropy makes one of two tabs: 0.5 was the flux
    text = f"id\tf\te\n7\t2.5\t0.1\n9\t{blank}\t0.5\n".encode()
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
    table = read_table(tmp_path / name, wanted="a catalog")
    assert table["id"].tolist() == [7, 9]
    assert table["e"].tolist() == [0.1, 0.5]
    assert np.ma.asarray(table["f"]).mask.tolist() == [False, True]


@pytest.mark.parametrize("separator", ["\t", ";"])
def test_units_and_rules_of_vizier_are_no_rows(separator, tmp_path):
    rows = [["ID", "RAJ2000", "f_F770W"], ["", "deg", "uJy"], ["----", "---", "-----"]]
    rows += [["0012", "150.1", "1.5"], ["0013", "150.2", "  "]]
    text = "#RESOURCE=yCat\n#Column ID (A4)\n\n"
    text += "\n".join(separator.join(cells) for cells in rows) + "\n\n"
    (tmp_path / "c.tsv").write_text(text)
    table = read_table(tmp_path / "c.tsv", wanted="a catalog")
    assert table["ID"].tolist() == ["0012", "0013"]
    assert table["RAJ2000"].unit == "deg"
    assert table["f_F770W"][0] == 1.5 * u.uJy
    assert np.all(table["f_F770W"].mask == [False, True])


@pytest.mark.parametrize("rule", ["", "|---:|:---|\n"])
def test_tables_between_bars_are_read(rule, tmp_path):
    # of Markdown, and of astropy's fixed width
    (tmp_path / "c.md").write_text(f"| id | f   |\n{rule}| 7  | 2.5 |\n| 9  | 3.5 |\n")
    table = read_table(tmp_path / "c.md", wanted="a catalog")
    assert table["id"].tolist() == [7, 9]
    assert table["f"].tolist() == [2.5, 3.5]


@pytest.mark.parametrize("name", ["t.txt", "t.dat"])
def test_tables_in_plain_text_keep_their_units(tmp_path, name):
    table = QTable({"id": [1, 2], "flux": [1.5, 2.5] * u.uJy}, meta={"seed": 3})
    write_table(table, tmp_path / name)
    back = read_table(tmp_path / name, wanted="a table")
    assert back["flux"].unit == u.uJy
    assert back["flux"].value.tolist() == [1.5, 2.5]
    assert back.meta["seed"] == 3
