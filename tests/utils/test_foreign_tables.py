"""Tables as other programs write them: missing values, packings, columns that no table holds."""

import bz2
import gzip
import lzma
import warnings
import zipfile

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.io.votable import from_table
from astropy.table import MaskedColumn, QTable, Table

from helpers.errors import refuses, warned
from miricigale.utils.exceptions import CatalogWarning, DataError
from miricigale.utils.positions import as_positions
from miricigale.utils.row_files import open_rows, write_rows
from miricigale.utils.table_files import read_table, write_table


def scaled_table(path, *, ragged=True):
    """Integers with a scale, of which the second is missing, ids, and a column of variable length."""
    flux = np.array([100, -32768, 250], np.int16)
    columns = [
        fits.Column("id", "J", array=np.arange(1, 4)),
        fits.Column("flux", "I", array=flux, null=-32768),
        fits.Column("pdf", "PE()", array=np.array([[1.0, 2], [3.0], [1.0, 2, 3]], object)),
    ]
    hdu = fits.BinTableHDU.from_columns(columns if ragged else columns[:2])
    hdu.header["TSCAL2"] = 2e-4
    hdu.header["TUNIT2"] = "uJy"
    hdu.writeto(path)
    return path


def test_scaled_missing_values_of_fits_are_missing(tmp_path):
    path = scaled_table(tmp_path / "catalog.fits", ragged=False)
    whole = read_table(path, wanted="a catalog")["flux"]
    rows = open_rows(path, 2)
    for flux in (whole[:2], rows.chunk(0)["flux"]):
        assert flux.mask.tolist() == [False, True]
        assert float(flux[0].to_value("uJy")) == pytest.approx(0.02)
    assert float(rows.chunk(1)["flux"][0].to_value("uJy")) == pytest.approx(0.05)


def test_columns_of_variable_length_are_left_out_and_named(tmp_path):
    path = scaled_table(tmp_path / "catalog.fits")
    text = "catalog.fits: columns of variable length are left out: 'pdf'"
    with pytest.warns(CatalogWarning, match=text):
        whole = read_table(path, wanted="a catalog")
    rows = open_rows(path, 2)
    with pytest.warns(CatalogWarning, match=text):
        piece = rows.chunk(0)
    assert whole.colnames == piece.colnames == ["id", "flux"]
    assert piece["flux"].mask.tolist() == [False, True]


@pytest.mark.parametrize("packing", ["bz2", "xz", "zip", "gz"])
@pytest.mark.parametrize("name", ["t.fits", "t.csv", "t.ecsv"])
def test_packed_tables_are_read(name, packing, tmp_path):
    plain = tmp_path / name
    Table({"id": [7, 9], "flux": [1.5, 2.5]}).write(plain)
    data = plain.read_bytes()
    packed = tmp_path / f"{name}.{packing}"
    if packing == "zip":
        with zipfile.ZipFile(packed, "w") as archive:
            archive.writestr(name, data)
    else:
        module = {"bz2": bz2, "xz": lzma, "gz": gzip}[packing]
        packed.write_bytes(module.compress(data))
    for table in (read_table(packed, wanted="a catalog"), open_rows(packed, 5).chunk(0)):
        assert table["id"].tolist() == [7, 9]
        assert table["flux"].tolist() == [1.5, 2.5]


def test_archives_of_several_files_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        archive.writestr("a.csv", "id,flux\n1,2\n")
        archive.writestr("b.csv", "id,flux\n1,2\n")
    path = tmp_path / "two.zip"
    with pytest.raises(DataError, match="a zip archive of 2 files, wanted is one"):
        read_table(path, wanted="a catalog")


def test_columns_of_votables_have_the_names_that_users_see(tmp_path):
    table = Table({"id": [1, 2], "flux_f770w": [1.0, 2.0]})
    document = from_table(table)
    document.get_first_table().fields[1].ID = "col2"
    document.to_xml(str(tmp_path / "catalog.xml"))
    assert read_table(tmp_path / "catalog.xml", wanted="a catalog").colnames == table.colnames


def nullable():
    """Columns with missing values, each of which has the numbers that writers take for none."""
    here = [False, False, True]
    return Table(
        {
            "id": [1, 2, 3],
            "whole": MaskedColumn([999999, -(2**63), 5], mask=here),
            "byte": MaskedColumn(np.array([0, 255, 7], np.uint8), mask=here),
            "short": MaskedColumn(np.array([-(2**15), 2**15 - 1, 7], np.int16), mask=here),
            "unsigned": MaskedColumn(np.array([0, 2**16 - 1, 7], np.uint16), mask=here),
            "true": MaskedColumn([True, False, False], mask=here),
            "text": MaskedColumn(["a", "b", "c"], mask=here),
            "flux": MaskedColumn([1.0, 2.0, 3.0], mask=here),
        }
    )


@pytest.mark.parametrize("name", ["c.fits", "c.xml", "c.ecsv", "rows.fits"])
def test_missing_values_are_missing_after_writing_and_no_others(name, tmp_path):
    table = nullable()
    if name == "rows.fits":
        write_rows(tmp_path / name, [table], len(table))
    else:
        write_table(table, tmp_path / name)
    back = read_table(tmp_path / name, wanted="a catalog", cls=Table)
    for column in table.itercols():
        read = back[column.name]
        assert read[:2].tolist() == column[:2].tolist()
        if column.dtype.kind == "f":
            assert not np.isfinite(np.ma.filled(read, np.nan)[2])
        elif column.dtype.kind == "U":
            # FITS and VOTables have no missing text
            assert np.ma.filled(read, "")[2] == ""
        elif column.name != "id":
            assert np.ma.getmaskarray(read).tolist() == [False, False, True]
    # what is written is a copy
    assert table["true"].dtype == bool
    assert table["whole"][0] == 999999


def test_a_column_of_all_bytes_has_no_null_value(tmp_path):
    every = MaskedColumn(np.append(np.arange(256), 0).astype(np.uint8))
    every.mask[-1] = True
    refuses("'every' has all numbers of its type", write_table, Table({"every": every}),
            tmp_path / "c.fits")  # fmt: skip


@pytest.mark.parametrize("name", ["c.fits", "c.xml"])
def test_small_numbers_are_no_truth_values(name, tmp_path):
    table = Table({"i": np.array([-1, 1, 0], np.int8), "f": np.array([1.5, 2, 3], np.float16)})
    write_table(table, tmp_path / name)
    back = read_table(tmp_path / name, wanted="a catalog")
    assert back["i"].tolist() == [-1, 1, 0]
    assert back["f"].tolist() == [1.5, 2.0, 3.0]


def test_votables_have_no_integers_from_2_to_63_on(tmp_path):
    for number in (2**63, 2**63 + 1):
        table = Table({"TARGETID": np.array([number], np.uint64)})
        refuses("'path' must be a file of another format .* 'TARGETID'", write_table, table,
                tmp_path / "c.xml")  # fmt: skip
    write_table(Table({"TARGETID": np.array([2**63 - 1], np.uint64)}), tmp_path / "c.xml")
    assert read_table(tmp_path / "c.xml", wanted="a catalog")["TARGETID"].tolist() == [2**63 - 1]


def test_text_that_fits_cannot_hold_is_refused_by_column(tmp_path):
    table = Table({"id": [1, 2], "name": ["a", "\u00e9"]})
    refuses("'path' must be a file of another format, .* in 'name' .*\u00e9", write_table, table,
            tmp_path / "c.fits")  # fmt: skip
    assert not list(tmp_path.iterdir())
    write_table(table, tmp_path / "c.csv")
    assert read_table(tmp_path / "c.csv", wanted="a catalog")["name"].tolist() == ["a", "\u00e9"]


@pytest.mark.parametrize("name", ["c.csv", "c.ecsv", "c.fits", "c.xml"])
def test_positions_are_positions_after_writing(name, tmp_path):
    sky = SkyCoord([53.1, 359.99999999], [-27.8, 1e-9], unit="deg")
    write_table(QTable({"id": [1, 2], "sky": sky}), tmp_path / name)
    back = as_positions(read_table(tmp_path / name, wanted="a catalog"), name)
    assert np.all(back.separation(sky).arcsec < 1e-6)


STATUS = """<?xml version="1.0"?><VOTABLE version="1.3" xmlns="http://www.ivoa.net/xml/VOTable/v1.3">
<RESOURCE type="results"><INFO name="QUERY_STATUS" value="{}">of a service</INFO>
<TABLE><FIELD name="id" datatype="int"/><DATA><TABLEDATA><TR><TD>1</TD></TR></TABLEDATA></DATA></TABLE>
</RESOURCE></VOTABLE>"""


def test_votables_that_a_service_cut_off_or_failed_at(tmp_path):
    path = tmp_path / "v.xml"
    path.write_text(STATUS.format("OK"))
    assert read_table(path, wanted="a table")["id"].tolist() == [1]
    path.write_text(STATUS.format("OVERFLOW"))
    warned("v.xml: the service that wrote it cut it off", read_table, path, wanted="a table")
    path.write_text(STATUS.format("ERROR"))
    refuses("reports an error: of a service", read_table, path, wanted="a table", error=DataError)
    table = STATUS[STATUS.index("<TABLE>") : STATUS.index("</RESOURCE>")]
    path.write_text(STATUS.format("OK").replace(table, table + table))
    refuses("it has 2 tables .* file of its own", read_table, path, wanted="a", error=DataError)


def test_magnitudes_with_missing_values_are_read_without_a_word(tmp_path):
    magnitudes = fits.Column("m", "D", unit="mag(AB)", array=np.array([23.9, np.nan]))
    columns = [fits.Column("id", "J", array=np.array([1, 2])), magnitudes]
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "m.fits")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_table(tmp_path / "m.fits", wanted="a table")["m"].tolist() == [23.9, None]
