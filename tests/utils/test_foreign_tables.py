"""Tables as other programs write them: missing values, packings, columns that no table holds."""

import bz2
import gzip
import lzma
import zipfile

import numpy as np
import pytest
from astropy.io import fits
from astropy.io.votable import from_table
from astropy.table import Table

from miricigale.utils.exceptions import CatalogWarning, DataError
from miricigale.utils.row_files import open_rows
from miricigale.utils.table_files import read_table


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
