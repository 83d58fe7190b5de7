"""Catalogs of other people: magnitudes, ids, missing values, and the names of surveys."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table
from numpy.testing import assert_allclose, assert_array_equal

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.filters import SURVEYS, CatalogMap, Filter, read_catalog_photometry
from miricigale.filters.catalog_files import MappedRows, codes_of
from miricigale.utils.exceptions import CatalogWarning, DataError, MiricigaleWarning
from miricigale.utils.missing_values import without_codes
from miricigale.utils.row_files import open_rows

BAND = "wfc3.f160w"
FORMATS = {"csv": "ascii.csv", "ecsv": "ascii.ecsv", "fits": "fits", "xml": "votable"}
FORMATS["txt"] = "ascii"


def write(table, path):
    table.write(path, format=FORMATS[path.suffix[1:]])
    return path


def convert(columns, **options):
    return CatalogMap(**options).convert(Table(columns))


@pytest.mark.parametrize("suffix", FORMATS)
def test_magnitudes_of_any_format_are_fluxes(tmp_path, suffix):
    magnitude = np.array([23.9, 21.4, 26.4])
    table = Table({"name": ["a1", "b2", "c3"], "H": magnitude, "dH": [0.01, 0.02, 0.3]})
    path = write(table, tmp_path / f"mine.{suffix}")
    columns = {"id": "name", BAND: "H", f"{BAND}_err": "dH"}
    out = read_catalog_photometry(path, columns=columns, units={"flux": "ABmag"})
    assert out["id"].tolist() == ["a1", "b2", "c3"]
    assert_allclose(out[BAND].to_value(u.uJy), [1, 10, 0.1])
    assert_allclose(out[BAND].to(u.ABmag).value, magnitude)
    # d ln f = ln(10) / 2.5 dm
    relative = np.log(10) / 2.5 * np.array([0.01, 0.02, 0.3])
    assert_allclose((out[f"{BAND}_err"] / out[BAND]).value, relative)


def test_units_differ_by_column():
    columns = {"id": [1], BAND: [23.9], f"{BAND}_err": [0.1]}
    columns |= {"irac.ch1": [2.0], "irac.ch1_err": [0.5]}
    out, _ = convert(columns, units={"flux": "mJy", BAND: "mag(AB)"})
    assert out[BAND][0].to_value(u.uJy) == pytest.approx(1)
    assert out[f"{BAND}_err"][0].to_value(u.uJy) == pytest.approx(0.1 * np.log(10) / 2.5)
    assert out["irac.ch1"][0].to_value(u.uJy) == pytest.approx(2000)
    assert out["irac.ch1_err"][0].to_value(u.uJy) == pytest.approx(500)
    # errors of magnitudes may be fluxes
    out, _ = convert(columns, units={"flux": "mJy", BAND: "ABmag", f"{BAND}_err": "nJy"})
    assert out[f"{BAND}_err"][0].to_value(u.uJy) == pytest.approx(1e-4)


def test_units_of_the_file_are_taken(tmp_path):
    table = QTable({"id": [1], BAND: [23.9] * u.ABmag, f"{BAND}_err": [0.1] * u.mag})
    out = read_catalog_photometry(write(table, tmp_path / "c.ecsv"))
    assert out[BAND][0].to_value(u.uJy) == pytest.approx(1)
    table[BAND] = [23.9] * u.mag
    path = write(table, tmp_path / "d.ecsv")
    match = "got mag: AB magnitudes are units="
    refuses(match, read_catalog_photometry, path, error=u.UnitsError)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = read_catalog_photometry(path, units={"flux": "ABmag"})
    assert out[BAND][0].to_value(u.uJy) == pytest.approx(1)
    match = "got no unit: give one, such as units="
    refuses(match, convert, {"id": [1], BAND: [1.0]}, error=u.UnitsError)


def test_numbers_that_stand_for_nothing_in_magnitudes():
    values = np.array([24.0, 99.0, -99.0, 0.0, 0.0, 24.0, 999.0, np.nan, 24.0])
    errors = np.array([0.1, 28.1, -99.0, 0.0, 0.1, 99.0, 0.1, 0.1, -1.0])
    missing, no_error = without_codes(values, errors, magnitudes=True)
    assert missing.tolist() == [False, True, True, True, False, False, True, False, False]
    assert no_error.tolist()[5] is True
    columns = {"id": np.arange(9), BAND: values, f"{BAND}_err": errors}
    table, coded = convert(columns, units={"flux": "ABmag"})
    flux, error = (table[name].value for name in (BAND, f"{BAND}_err"))
    assert np.isnan(flux).tolist() == [False, True, True, True, False, False, True, True, False]
    # an error that is none leaves the flux; one that is not positive is for the fit to flag
    assert np.isnan(error[5])
    assert error[8] < 0
    assert coded[BAND][[1, 2, 3, 5, 6]].tolist() == [99, -99, 0, 99, 999]
    assert np.isnan(coded[BAND][[0, 4, 7, 8]]).all()


def test_numbers_that_stand_for_nothing_in_fluxes():
    values = np.array([1.0, -99.0, 99.0, 99.0, 0.0, 0.0, -98.7, 1.0, -1.0])
    errors = np.array([0.1, 5.0, 5.0, 99.0, 0.0, 0.3, 50.0, -99.9, 1.0])
    missing, no_error = without_codes(values, errors)
    # 99 is a flux unless the error is the same number; 0 is one unless its error is 0
    assert missing.tolist() == [False, True, False, True, True, False, False, False, False]
    assert no_error.tolist()[7] is True
    assert without_codes(values, errors, further=[-1.0])[0].tolist()[8] is True
    # single precision
    assert without_codes(np.float32([-99.9, -999.9]).astype(float))[0].all()


def test_negative_errors_stand_for_nothing_unless_they_may_be_limits():
    """Those of CEERS: -0.099 (-99 in other units), -1 beside a flux; a flux of 3 sigma may be a limit."""
    values, errors = (
        np.array([0.0, 1.2e-4, -0.0999, 3.0, 3.0]),
        np.array([-0.099, -1, -0.0999, -1, 1]),
    )
    columns = {"id": np.arange(5), BAND: values, f"{BAND}_err": errors}
    table, coded = convert(columns, units={"flux": "mJy"})
    assert np.isnan(table[f"{BAND}_err"].value).tolist() == [True, True, True, False, False]
    assert table[f"{BAND}_err"][3].value == -1000
    # the same code twice is no flux either
    assert np.isnan(table[BAND].value).tolist() == [False, False, True, False, False]
    assert coded[BAND][:3].tolist() == [-0.099, -1, -0.0999]
    assert np.isnan(coded[BAND][3:]).all()
    limits, _ = convert(columns, units={"flux": "mJy"}, limits=True)
    assert limits[f"{BAND}_limit"].tolist() == [False, True, False, True, False]
    # in magnitudes an error of -1 marks a limit, which the fit flags
    table, _ = convert(columns, units={"flux": "ABmag"})
    assert table[f"{BAND}_err"][3] < 0


def test_what_is_missing_is_counted(tmp_path):
    table = Table({"id": [1, 2, 3], BAND: [1.0, -99.0, -99.9], f"{BAND}_err": [0.1, -99.0, 0.1]})
    path = write(table, tmp_path / "c.csv")
    with pytest.warns(MiricigaleWarning, match=rf"{BAND} 2 of 3 \(-99.9, -99\)$"):
        read_catalog_photometry(path, units={"flux": "uJy"})


@pytest.mark.parametrize(
    ("ids", "wanted"),
    [
        ([3.0, 7.0], [3, 7]),
        ([1.5, 2.25], ["1.5", "2.25"]),
        (["x", "10"], ["x", "10"]),
        (np.array(["x", "y"], object), ["x", "y"]),
    ],
)
def test_ids(ids, wanted):
    out, _ = convert({"id": ids, BAND: [1.0, 2.0]}, units={"flux": "uJy"})
    assert out["id"].tolist() == wanted


def test_factors():
    columns = {"id": [1, 2], BAND: [1.0, 2.0], f"{BAND}_err": [0.1, 0.1], "total": [2.0, 3.0]}
    out, _ = convert(columns, units={"flux": "uJy"}, factor="total")
    assert out[BAND].value.tolist() == [2, 6]
    assert_allclose(out[f"{BAND}_err"].value, [0.2, 0.3])
    table = Table(columns)
    table["total"] = [-2.5, 0.0] * u.mag
    out, _ = CatalogMap(units={"flux": "uJy"}, factor="total").convert(table)
    assert_allclose(out[BAND].value, [10, 2])
    refuses("no column of catalog 'totl'", convert, columns, error=KeyError, factor="totl")


NAMES = cases_of(__file__, "surveys")


@pytest.mark.parametrize("survey", sorted({*SURVEYS} - {"cigale"}))
def test_columns_of_surveys(survey):
    places, in_ujy, error, bands = NAMES[survey].values()
    table = Table({name: [1.0] for name in places.split()})
    for k, name in enumerate(bands.values()):
        table[name], table[name.replace(*error)] = [k + 2.0], [0.5]
    out, _ = CatalogMap(survey=survey).convert(table)
    assert {"id", *bands} <= set(out.colnames)
    for k, band in enumerate(bands):
        assert out[band][0].to_value(u.uJy) == pytest.approx((k + 2) * in_ujy, rel=1e-5)
        assert out[f"{band}_err"][0].to_value(u.uJy) == pytest.approx(0.5 * in_ujy, rel=1e-5)
    if survey != "ceers":
        assert out["ra"].unit == u.deg


def test_bands_without_a_filter_are_named_and_ones_own_columns_come_first(tmp_path):
    names = ["ID", "ACS_F606W_FLUX", "ACS_F606W_FLUXERR", "HAWKI_KS_FLUX", "HAWKI_KS_FLUXERR"]
    path = write(Table({name: [1.0] for name in names}), tmp_path / "c.fits")
    with pytest.warns(MiricigaleWarning, match="left out, no filter here: HAWKI_KS_FLUX$"):
        out = read_catalog_photometry(path, "candels")
    assert "acs.f606w" in out.colnames
    columns = {"sedpy.vlt_isaac_Ks": "HAWKI_KS_FLUX", "sedpy.vlt_isaac_Ks_err": "HAWKI_KS_FLUXERR"}
    out = read_catalog_photometry(path, survey="candels", columns=columns)
    assert out["sedpy.vlt_isaac_Ks"].unit == u.uJy
    refuses("a table with columns of 'dja'", read_catalog_photometry, path, "dja")
    refuses(r"no survey 'cosmos2015'", read_catalog_photometry, path, "cosmos2015", error=KeyError)
    names = ["id", "f_F606W", "e_F606W", "f_ACS_F606W", "e_ACS_F606W"]
    match = r"f_F606W and f_ACS_F606W are both the filter acs\.f606w"
    columns = {name: [1.0] for name in names}
    refuses(match, convert, columns, error=DataError, survey="3dhst")


def test_a_map_in_a_file(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text(f'missing = [-1]\n[columns]\n"{BAND}" = "H"\n[units]\nflux = "ABmag"\n')
    mine = CatalogMap.read(path)
    assert mine.columns == {BAND: "H"}
    assert mine.settings()["missing"] == (-1.0,)
    out, _ = mine.convert(Table({"id": [1, 2], "H": [23.9, -1.0]}))
    assert_allclose(out[BAND].value, [1, np.nan])
    path.write_text("column = 1\n")
    match = r"it has \['column'\]; known: \['columns', 'units'"
    refuses(match, CatalogMap.read, path, error=DataError)
    path.write_text('[columns]\n"miri.f707w" = "f"\n')
    match = r"map\.toml is no map of columns: no filter 'miri\.f707w'; the nearest of"
    refuses(match, CatalogMap.read, path, error=DataError)
    match = "cannot be read as a map of columns"
    refuses(match, CatalogMap.read, tmp_path / "none.toml", error=DataError)


def test_negative_errors_are_upper_limits_where_the_map_says_so(tmp_path):
    """CIGALE's convention: minus the error is 1 sigma of the limit; none is below nothing, codes are none."""
    values, errors = [5.0, 2.0, -1.0, 3.0, -99.99, 4.0], [0.5, -0.2, -0.3, 0.0, -99.99, -99.9]
    table = Table({"id": range(6), BAND: values, f"{BAND}_err": errors})
    path = write(table, tmp_path / "c.csv")
    with pytest.warns(MiricigaleWarning, match=rf"{BAND} 3 of 6 \(-99.99, -99.9, -1\)"):
        out = read_catalog_photometry(path, limits=True, units={"flux": "mJy"})
    assert_allclose(out[BAND].value, [5e3, 2e3, np.nan, 3e3, np.nan, 4e3])
    assert_allclose(out[f"{BAND}_err"].value, [500, 200, np.nan, 0, np.nan, np.nan], rtol=1e-12)
    assert out[f"{BAND}_limit"].tolist() == [False, True, False, False, False, False]
    plain, _ = CatalogMap(units={"flux": "mJy"}).convert(table)
    assert f"{BAND}_limit" not in plain.colnames
    assert plain[f"{BAND}_err"][1].value == -200
    # a factor to the total is one of the limit too
    table["ap"] = np.full(6, 1.5)
    out, _ = CatalogMap(units={"flux": "mJy"}, limits=True, factor="ap").convert(table)
    assert_allclose([out[BAND][1].value, out[f"{BAND}_err"][1].value], [3e3, 300])
    match = r"must be fluxes in .* where negative errors mark limits"
    refuses(match, convert, table, units={"flux": "ABmag"}, limits=True)
    table[f"{BAND}_limit"] = np.zeros(6, bool)
    match = "where negative errors mark limits, got both"
    refuses(match, convert, table, units={"flux": "mJy"}, limits=True)
    refuses("'limits' must be True or False", CatalogMap, limits="yes")


@pytest.mark.parametrize("suffix", FORMATS)
def test_pieces_are_the_whole(tmp_path, suffix):
    table = Table({"name": [f"s{k}" for k in range(7)], "H": [20.0, 99, 22, 23, 24, 99, 26]})
    path = write(table, tmp_path / f"c.{suffix}")
    mine = CatalogMap(columns={"id": "name", BAND: "H"}, units={"flux": "ABmag"})
    with pytest.warns(MiricigaleWarning, match="2 of 7"):
        whole = read_catalog_photometry(path, mine)
    rows = MappedRows(open_rows(path, 3), mine)
    assert rows.colnames == ("id", BAND)
    assert [text.endswith(f"{BAND} 2 of 7 (99)") for text in rows.messages()] == [True]
    parts = [rows.chunk(i) for i in range(rows.n_chunks)]
    assert [len(part) for part in parts] == [3, 3, 1]
    for name in ("id", BAND):
        joined = np.concatenate([np.asarray(part[name]) for part in parts])
        assert_array_equal(joined, np.asarray(whole[name]))


def test_the_real_part_of_ceers(data_file):
    path = data_file("ceers/ceers_photometry_part.fits")
    with pytest.warns(MiricigaleWarning, match="taken as missing"):
        mine = read_catalog_photometry(path, "ceers")
    theirs = Table.read(path)
    assert len(mine) == 5229
    assert mine["id"].dtype.kind == "i"
    flux = np.asarray(theirs["jwst.miri.F770W"])
    # -99.99, and in one row -99.9
    there = flux > -99
    assert_array_equal(np.isfinite(mine["miri.f770w"].value), there)
    assert_allclose(mine["miri.f770w"].to_value(u.mJy)[there], flux[there])
    snr = mine["miri.f770w"] / mine["miri.f770w_err"]
    # of its README: 1053 of the whole table, of which this is a part
    assert np.count_nonzero(snr > 5) <= 1053


@pytest.mark.slow
def test_real_magnitudes_of_goodss(data_file):
    path = data_file("catalogs/goodss_3dhst.v4.1.jwst_galfit.cat.gz")
    columns = {"wfc3.f160w": "mag_wfc3_f160w", "nircam.f444w": "mag_nircam-f444w"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MiricigaleWarning)
        table = read_catalog_photometry(path, columns=columns, units={"flux": "ABmag"})
    theirs = Table.read(path, format="ascii.commented_header")
    flux = 0.363078 * np.asarray(theirs["f_F160W"])
    same = np.isfinite(table["wfc3.f160w"].value) & (flux > 0.1)
    # the magnitude is the measured flux, with zero point 25
    ratio = table["wfc3.f160w"].value[same] / flux[same]
    assert np.median(ratio) == pytest.approx(1, abs=0.02)


EAZY = cases_of(__file__, "eazy")


@pytest.mark.parametrize("number", EAZY)
def test_translate_files_of_eazy(tmp_path, number):
    name, wavelength = EAZY[number]
    lines = f"nr id\nzs z_spec\nflux_a F{number} # total\ndf_a E{number}\n"
    (tmp_path / "z.translate").write_text(lines)
    (tmp_path / "cat.txt").write_text("# nr zs flux_a df_a\n7 1.5 2.0 0.1\n8 -1 -99 -99\n")
    units = {"flux": "0.3631 uJy"}  # zero point 25
    with pytest.warns(MiricigaleWarning, match="-99"):
        out = read_catalog_photometry(tmp_path / "cat.txt", tmp_path / "z.translate", units=units)
    assert_allclose(Filter.from_name(name).pivot.to_value(u.AA), wavelength, rtol=0.02)
    assert out.colnames == ["id", "redshift", name, f"{name}_err"]
    assert_allclose(out[name].to_value(u.uJy), [0.7262, np.nan])
    assert_allclose(out[f"{name}_err"].to_value(u.uJy), [0.03631, np.nan])


def test_translate_files_that_cannot_be_used(tmp_path):
    path = tmp_path / "z.translate"
    for line, said in (
        ("flux G205", "got 'G205'"),
        ("f_wide F236\nf_narrow F236", r"two columns for acs\.f606w \(F236\): f_wide and f_narrow"),
    ):
        path.write_text(f"{line}\n")
        refuses(said, CatalogMap.read, path, error=DataError)


def test_totals_of_a_translate_file_are_not_applied_and_said(tmp_path):
    (tmp_path / "z.translate").write_text("id id\nf_160 F205\ne_160 E205\nf_tot TOT205\n")
    (tmp_path / "c.cat").write_text("# id f_160 e_160 f_tot\n1 2.0 0.1 3.0\n")
    with pytest.warns(CatalogWarning, match=r"TOT205 .f_tot. is not applied: masses"):
        table = read_catalog_photometry(
            tmp_path / "c.cat", tmp_path / "z.translate", units={"flux": "uJy"}
        )
    assert table["wfc3.f160w"].to_value(u.uJy) == [2.0]


def test_translate_files_name_the_bands_that_have_no_filter_here(tmp_path):
    """WFPC2's F300W (F22) as in EAZY's own catalog of the HDF-N."""
    (tmp_path / "z.translate").write_text("id id\nf_300 F22\ne_300 E22\nf_160 F205\ne_160 E205\n")
    (tmp_path / "c.cat").write_text("# id f_300 e_300 f_160 e_160\n1 1.0 0.1 2.0 0.1\n")
    with pytest.warns(MiricigaleWarning, match="no filter here: f_300"):
        out = read_catalog_photometry(
            tmp_path / "c.cat", tmp_path / "z.translate", units={"flux": "uJy"}
        )
    assert out["wfc3.f160w"].value.tolist() == [2.0]


@pytest.mark.parametrize("form", ["translate", "csv", "text", "object"])
def test_the_third_column_of_a_translate_file_multiplies_errors(tmp_path, form):
    text = "id id\nf_814 F239\ne_814 E239 1.e8\nf_160 F205\ne_160 E205 2.0\n"
    commas = "column,trans,error\nid,id,1.0\nf_814,F239,1.0\ne_814,E239,1e8\nf_160,F205,1.0\ne_160,E205,2.0\n"

    class TranslateFile:
        trans = {"id": "id", "f_814": "F239", "e_814": "E239", "f_160": "F205", "e_160": "E205"}
        error = {"id": 1.0, "f_814": 1.0, "e_814": 1e8, "f_160": 1.0, "e_160": 2.0}

    (tmp_path / "z.translate").write_text(text)
    (tmp_path / "z.csv").write_text(commas)
    (tmp_path / "c.cat").write_text("# id f_814 e_814 f_160 e_160\n0007 3.0 0.3 2.0 0.1\n")
    forms = {"translate": tmp_path / "z.translate", "csv": str(tmp_path / "z.csv")}
    forms |= {"text": commas, "object": TranslateFile()}
    out = read_catalog_photometry(tmp_path / "c.cat", forms[form], units={"flux": "uJy"})
    assert_allclose(out["wfc3.f160w_err"].value, 0.2)
    assert_allclose(out["acs.f814w_err"].value, 0.3e8)
    assert out["id"].tolist() == ["0007"]


@pytest.mark.parametrize("survey", ["dja", "jades"])
def test_bands_beyond_the_usual_ones_of_a_survey_are_read_or_named(tmp_path, survey):
    names = {
        "dja": {"f850lp_tot_1": "acs.f850lp", "f814wu_tot_1": "sedpy.wfc3_uvis_f814w",
                "f115wn-clear_tot_1": "sedpy.jwst_niriss_f115w", "f115w-clear_tot_1": "nircam.f115w",
                "f600lpu_tot_1": None},
        "jades": {"F850LP_KRON_CONV": "acs.f850lp", "F090W_KRON_CONV": "nircam.f090w", "F600LP_KRON_CONV": None},
    }[survey]  # fmt: skip
    table = Table({"id": [1]})
    for name in names:
        error = name.replace("_tot_1", "_etot_1") if survey == "dja" else f"{name}_e"
        table[name] = [1.0]
        table[error] = [0.1]
    table.write(tmp_path / "c.fits")
    lost = [name for name, band in names.items() if band is None]
    with pytest.warns(MiricigaleWarning, match=f"no filter here: {lost[0]}"):
        out = read_catalog_photometry(tmp_path / "c.fits", survey)
    assert {band for band in names.values() if band} <= set(out.colnames)


def test_a_factor_that_stands_for_no_value_makes_fluxes_missing():
    table = Table({"wfc3.f160w": [1.0, 2.0, 3.0], "wfc3.f160w_err": [0.1, 0.2, 0.3]})
    table["apcor"] = [0.0, 99.0, -2.5] * u.mag
    out, coded = CatalogMap(units={"flux": "uJy"}, factor="apcor").convert(table)
    assert_allclose(out["wfc3.f160w"].value, [1.0, np.nan, 30.0])
    assert_allclose(out["wfc3.f160w_err"].value, [0.1, np.nan, 3.0])
    assert_allclose(coded["apcor"], [np.nan, 99.0, np.nan])
    table["apcor"] = [1.5, -99.0, 0.0]
    out, _ = CatalogMap(units={"flux": "uJy"}, factor="apcor").convert(table)
    assert_allclose(out["wfc3.f160w"].value, [1.5, np.nan, np.nan])


@pytest.mark.parametrize("unit", ["nanomaggies", "nmgy", u.nmgy])
def test_nanomaggies_are_a_unit_of_flux(unit):
    """One nanomaggy is AB 22.5 (SDSS): 3.631 uJy."""
    table = Table({"wfc3.f160w": [2.0], "wfc3.f160w_err": [0.1]})
    out, _ = CatalogMap(units={"flux": unit}).convert(table)
    assert_allclose(out["wfc3.f160w"].to_value(u.ABmag), 22.5 - 2.5 * np.log10(2.0), atol=1e-9)
    for name in table.colnames:
        table[name].unit = unit
    assert_allclose(CatalogMap().convert(table)[0]["wfc3.f160w_err"].to_value(u.uJy), 0.36307805477)


def test_codes_are_told_from_noise_and_from_limits():
    """In nJy a flux of -99 is within the noise of 50, and 99 may be the 1 sigma of a limit of 300."""
    flux = [-99.0, -99.0, -99.0, -99.0, -99.9, 300.0, 5.0, -0.3]
    error = [50.0, 0.0099, -99.99, 1e10, -99.0, -99.0, -99.0, 0.0099]
    table = Table({"wfc3.f160w": flux, "wfc3.f160w_err": error})
    out, coded = CatalogMap(units={"flux": "nJy"}, limits=True).convert(table)
    kept = np.isfinite(out["wfc3.f160w"]) & np.isfinite(out["wfc3.f160w_err"])
    assert kept.tolist() == [True, False, False, False, False, True, False, True]
    assert np.flatnonzero(out["wfc3.f160w_limit"]).tolist() == [5]
    assert np.isnan(coded["wfc3.f160w"]).tolist() == kept.tolist()
    assert np.isnan(codes_of(table, ["wfc3.f160w"])["wfc3.f160w"]).tolist() == kept.tolist()


def test_a_unit_in_the_name_of_a_column_counts():
    table = Table({"id": [1], "H [nJy]": [2500.0], "dH [nJy]": [500.0]})
    out, _ = CatalogMap({BAND: "H [nJy]", f"{BAND}_err": "dH [nJy]"}).convert(table)
    assert out[BAND].to_value(u.uJy).tolist() == [2.5]
    assert out[f"{BAND}_err"].to_value(u.uJy).tolist() == [0.5]


@pytest.mark.parametrize("column", [np.ones((2, 3)), np.ones((2, 1))])
def test_several_numbers_in_a_row_are_refused(column):
    for columns in ({BAND: column}, {BAND: [1.0, 2.0], f"{BAND}_err": column}):
        message = f"one number in a row of '{list(columns)[-1]}', got shape"
        refuses(message, convert, {"id": [1, 2]} | columns, units={"flux": "uJy"})
    columns = {"id": [1, 2], BAND: [1.0, 2.0], "total": column}
    message = "one number in a row of 'total', got shape"
    refuses(message, convert, columns, units={"flux": "uJy"}, factor="total")


@pytest.mark.parametrize("column", [[True, False], [1j, 2j], np.array(["2024-01-01"] * 2, "M8[D]")])
def test_truth_values_dates_and_complex_numbers_are_no_fluxes(column):
    message = f"numbers in '{BAND}', got values of the type"
    refuses(message, convert, {"id": [1, 2], BAND: column}, units={"flux": "uJy"})


@pytest.mark.parametrize("number", [1e20, 1e30, -1e31, 1e37, 3.4e38])
@pytest.mark.parametrize("unit", ["nJy", "uJy", "ABmag"])
def test_numbers_beyond_all_fluxes_stand_for_no_value(number, unit):
    table = Table({"F770W": [number, 21.4, 23.9], "F770W_err": [0.1, number, 0.2]})
    columns = {"miri.f770w": "F770W", "miri.f770w_err": "F770W_err"}
    out, coded = CatalogMap(columns, units={"flux": unit}).convert(table)
    assert np.isnan(out["miri.f770w"].value).tolist() == [True, False, False]
    assert np.isnan(out["miri.f770w_err"].value).tolist() == [True, True, False]
    assert coded["miri.f770w"][:2].tolist() == [number, number]


def test_magnitudes_that_no_source_has_stand_for_no_value():
    table = Table({"m": [100.0, 50.0, 31.0], "e": [100.0, 0.1, 0.1]})
    columns = {"miri.f770w": "m", "miri.f770w_err": "e"}
    out, _ = CatalogMap(columns, units={"flux": "ABmag"}).convert(table)
    assert np.isnan(out["miri.f770w"].value).tolist() == [True, True, False]
