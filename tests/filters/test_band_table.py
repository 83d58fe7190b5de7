"""Columns of tables by any name of their band."""

import pickle

import astropy.units as u
import pytest
from astropy.table import QTable, hstack

from helpers.errors import refuses
from miricigale.filters.band_table import BandTable
from miricigale.utils.table_files import read_table


@pytest.fixture
def table():
    columns = {"id": [1, 2], "miri.f770w": [3, 4] * u.uJy, "miri.f770w_err": [0.1, 0.2] * u.uJy}
    return BandTable(columns | {"my_band": [5, 6]})


def test_any_name_of_a_band_finds_its_column(table):
    for name in ("F770W", "JWST/MIRI.F770W", "jwst_f770w", "miri.f770w"):
        assert table[name].value.tolist() == [3, 4]
        assert table[f"{name}_err"][1] == 0.2 * u.uJy
    assert table["my_band"].tolist() == [5, 6]
    assert table[["id", "F770W"]].colnames == ["id", "miri.f770w"]
    assert isinstance(table[:1], BandTable)
    refuses("F1000W", table.__getitem__, "F1000W", error=KeyError)


def test_it_is_a_table_of_astropy_otherwise(table, tmp_path):
    table["F770W"] = [7, 8] * u.uJy
    # what is set is named as it is said
    assert table.colnames[-1] == "F770W"
    assert table["F770W"][0] == 7 * u.uJy
    assert pickle.loads(pickle.dumps(table))["F770W_err"][0] == 0.1 * u.uJy
    table.remove_column("F770W")
    table.write(tmp_path / "t.ecsv")
    assert QTable.read(tmp_path / "t.ecsv").colnames == table.colnames
    assert hstack([QTable({"x": [1, 2]}), table])["miri.f770w"][1] == 4 * u.uJy


def test_a_quantity_alone_is_its_posterior_median():
    fits = BandTable({"redshift_p16": [1.0], "redshift_p50": [2.0], "redshift_odds": [0.9]})
    assert fits["redshift"][0] == 2.0
    assert fits["redshift_odds"][0] == 0.9
    refuses("frac_agn", fits.__getitem__, "frac_agn", error=KeyError)


def test_a_fits_file_keeps_metadata_and_dex(table, tmp_path):
    table["mass_logmean"] = [9.0, 10.0] * u.dex(u.Msun)
    table.meta["fit"] = {"engine": "grid", "filters": ["miri.f770w"]}
    # without a warning, which would be an error here
    table.write(tmp_path / "t.fits")
    back = read_table(tmp_path / "t.fits", wanted="a table")
    assert back.meta == table.meta
    assert back["mass_logmean"].unit == table["mass_logmean"].unit
    refuses("exists", table.write, tmp_path / "t.fits", error=OSError)
    table.write(tmp_path / "t.fits", overwrite=True)
