import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.cigale import read_cigale_catalog
from miricigale.filters import Filter, cigale_band, filter_of_band
from miricigale.utils.exceptions import DataError, MiricigaleWarning

TEXT = cases_of(__file__, "text")


@pytest.fixture
def text_file(tmp_path):
    path = tmp_path / "galaxies.txt"
    path.write_text(TEXT)
    return path


def test_millijansky_become_microjansky(text_file):
    table = read_cigale_catalog(text_file)
    assert table["irac.ch1"].unit == u.uJy
    assert_allclose(table["irac.ch1"][0].value, 2.0, rtol=1e-14)
    assert_allclose(table["irac.ch1_err"][0].value, 0.1, rtol=1e-14)
    assert_allclose(table["miri.f770w"][0].value, 3.0, rtol=1e-14)
    assert table["id"].tolist() == ["one", "two", "three", "four"]
    assert table.meta["cigale"]["bands"]["miri.f770w"] == "jwst.miri.F770W"


def test_missing_values(text_file):
    table = read_cigale_catalog(text_file)
    # NaN, -9999 in flux, NaN in the error
    assert np.isnan(table["irac.ch1"].value).tolist() == [False, True, True, True]
    # -99, an error of 0, an error of -9999
    assert np.isnan(table["miri.f770w"].value).tolist() == [False, True, True, True]
    assert np.isnan(table["redshift"]).tolist() == [False, True, False, False]
    # a negative flux is a measurement
    assert_allclose(table["mips.24"][2].value, -10.0)
    assert_array_equal(np.isnan(table["irac.ch1"].value), np.isnan(table["irac.ch1_err"].value))


def test_negative_errors_are_upper_limits(text_file):
    table = read_cigale_catalog(text_file)
    assert table["mips.24_limit"].tolist() == [True, False, False, False]
    assert_allclose(table["mips.24"][0].value, 100.0)
    assert_allclose(table["mips.24_err"][0].value, 20.0)
    assert "irac.ch1_limit" not in table.colnames

    without = read_cigale_catalog(text_file, limits=False)
    assert "mips.24_limit" not in without.colnames
    assert np.isnan(without["mips.24"][0].value)
    assert np.isnan(without["mips.24_err"][0].value)


def test_units_of_the_file_are_kept(tmp_path):
    table = QTable({"id": [1, 2], "redshift": [0.1, 0.2]})
    table["FUV"] = [1.0, 2.0] * u.Jy
    table["FUV_err"] = [0.1, 0.2] * u.Jy
    table["distance"] = [3.0, np.nan] * u.kpc
    table.write(tmp_path / "c.fits")
    got = read_cigale_catalog(tmp_path / "c.fits")
    assert_allclose(got["sedpy.galex_FUV"].value, [1e6, 2e6])
    assert_allclose(got["sedpy.galex_FUV_err"].value, [1e5, 2e5])
    assert_allclose(got["distance"][0].to_value(u.Mpc), 3e-3)

    table["FUV"] = [1.0, 2.0] * u.m
    table.write(tmp_path / "d.fits")
    text = "'FUV' must be convertible to mJy"
    refuses(text, read_cigale_catalog, tmp_path / "d.fits", error=DataError)


def test_ten_per_cent_where_there_is_no_error(tmp_path):
    path = tmp_path / "c.txt"
    path.write_text("id redshift IRAC1 IRAC2 IRAC2_err\n1 1.0 -5e-3 1e-3 1e-4\n")
    with pytest.warns(MiricigaleWarning, match=r"10 % of the flux .*: IRAC1$"):
        table = read_cigale_catalog(path)
    assert_allclose(table["irac.ch1_err"].value, [0.5])
    assert_allclose(table["irac.ch2_err"].value, [0.1])
    # an error that is not among the bands is not used
    with pytest.warns(MiricigaleWarning, match="IRAC1, IRAC2"):
        table = read_cigale_catalog(path, bands=["IRAC1", "IRAC2"])
    assert_allclose(table["irac.ch2_err"].value, [0.1])


def test_what_is_left_out_is_named_once(tmp_path):
    path = tmp_path / "c.txt"
    path.write_text(
        "id redshift ra IRAC1 IRAC1_err xray_soft xray_soft_err line.H-alpha line.H-alpha_err\n"
        "1 1.0 150 5e-3 1e-3 1 1 2e-19 1e-19\n"
    )
    with pytest.warns(MiricigaleWarning) as record:
        table = read_cigale_catalog(path)
    assert len(record) == 1
    text = str(record[0].message)
    for name in ("xray_soft", "line.H-alpha (line)", "ra"):
        assert name in text
    assert table.colnames == ["id", "redshift", "irac.ch1", "irac.ch1_err"]
    assert table.meta["cigale"]["left_out"] == ["xray_soft", "line.H-alpha (line)", "ra"]
    refuses("xray_soft", read_cigale_catalog, path, error=DataError, strict=True)
    # a filter may be given for it
    with pytest.warns(MiricigaleWarning) as record:
        table = read_cigale_catalog(path, names={"xray_soft": "sedpy.uvot_m2"})
    assert "xray_soft" not in str(record[0].message)
    assert "sedpy.uvot_m2" in table.colnames


def test_only_the_bands_asked_for(text_file):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = read_cigale_catalog(text_file, bands=["MIPS1", "MIPS1_err"])
    assert table.colnames == ["id", "redshift", "mips.24", "mips.24_err", "mips.24_limit"]
    refuses("no column IRAC3", read_cigale_catalog, text_file, error=DataError, bands=["IRAC3"])


@pytest.mark.parametrize(("content", "wanted"), cases_of(__file__, "refused"))
def test_refused(tmp_path, content, wanted):
    path = tmp_path / "c.txt"
    path.write_text(content)
    refuses(wanted, read_cigale_catalog, path, error=DataError)
    refuses("no such file", read_cigale_catalog, tmp_path / "none.txt", error=DataError)


BANDS = cases_of(__file__, "bands")


@pytest.mark.parametrize(("band", "name", "pivot"), BANDS)
def test_bands(band, name, pivot):
    assert filter_of_band(band) == name
    assert_allclose(Filter.from_name(name).pivot.value, pivot, rtol=0.03)


def test_bands_without_a_curve():
    for band in ("xray_boxcar_2to12keV", "VLA_L", "IRAS1", "N60", "jwst.miri.F999W", "F814W"):
        assert filter_of_band(band) is None


def test_filters_find_their_way_back():
    for name in (*Filter.names(), "sedpy.sdss_r0", "sedpy.galex_NUV", "sedpy.wise_w4"):
        assert filter_of_band(cigale_band(name)) == name
    assert cigale_band("miri.f770w") == "jwst.miri.F770W"
    assert cigale_band("acs.f850lp") == "hst.wfc.F850LP"


def box(path, low, high):
    """A filter file of CIGALE, from ``low`` to ``high`` um."""
    rows = [(low, 0), (low * 1.001, 1), (high * 0.999, 1), (high, 0)]
    lines = [f"{wave * 1e4:.8g} {value}" for wave, value in rows]
    path.write_text("\n".join(["# IRAS 12", "# energy", "# a box", *lines]) + "\n")
    return path


def test_a_band_takes_the_filter_that_is_given(tmp_path):
    path = tmp_path / "galaxies.txt"
    path.write_text("# id redshift IRAS1 IRAS1_err IRAC1 IRAC1_err\na 0.5 3 0.1 2 0.1\n")
    with pytest.warns(MiricigaleWarning, match=r"IRAS1.*names=|names=.*IRAS1"):
        table = read_cigale_catalog(path)
    assert table.colnames == ["id", "redshift", "irac.ch1", "irac.ch1_err"]
    curve = box(tmp_path / "iras12.dat", 8.0, 15.0)
    mine = Filter.read(curve, name="iras.12")
    for given, name in ((str(curve), "IRAS1"), (curve, "IRAS1"), (mine, "iras.12")):
        table = read_cigale_catalog(path, names={"IRAS1": given})
        assert table[name].value.tolist() == [3000.0]
    table = read_cigale_catalog(path, names={"IRAS1": "sedpy.wise_w3"})
    assert "sedpy.wise_w3" in table.colnames


def test_a_wrong_filter_is_refused_when_it_is_read(tmp_path):
    path = tmp_path / "galaxies.txt"
    path.write_text("# id redshift IRAS1 IRAS1_err\na 0.5 3 0.1\n")
    for given, error, wanted in (
        ("none.dat", DataError, "none.dat cannot be read"),
        ("miri.f707w", KeyError, "miri.f770w"),
        (12.0, ValueError, r"'IRAS1' must be a Filter, .* got float"),
    ):
        refuses(wanted, read_cigale_catalog, path, error=error, names={"IRAS1": given})
