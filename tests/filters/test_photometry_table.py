"""Catalogs as people write them: the same fluxes whatever their columns are called."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import MaskedColumn, Table
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.grids import photometry_table
from miricigale.filters import as_photometry
from miricigale.filters.photometry_table import band_columns
from miricigale.utils.exceptions import CatalogWarning

BANDS = ("miri.f770w", "wfc3.f160w")


@pytest.fixture
def catalog():
    flux, error = [[1.0, 3.0], [2.0, 4.0]], [[0.1, 0.3], [0.2, 0.1]]
    return photometry_table(BANDS, flux, error, ["a", "b"], F999X=[1, 2])


def renamed(catalog, flux, error):
    names = {"miri.f770w": "F770W", "wfc3.f160w": "F160W"}
    out = catalog.copy()
    for ours, theirs in names.items():
        out.rename_column(ours, flux.format(theirs))
        out.rename_column(f"{ours}_err", error.format(theirs))
    return out


def same(got, catalog):
    for name in BANDS:
        for column in (name, f"{name}_err"):
            np.testing.assert_allclose(got[column].to_value(u.uJy), catalog[column].value)


def test_a_table_by_our_names_is_itself(catalog):
    assert as_photometry(catalog, BANDS) is catalog


@pytest.mark.parametrize(
    ("flux", "error"),
    [
        *(("{}", error) for error in ("{}_err", "{}_error", "e_{}")),
        *(("f_{}", "e_{}"), ("flux_{}", "err_{}")),
        *(("{}_flux", "{}_flux_err"), ("FLUX_{}", "FLUX_{}_ERR")),
        *(("flux_{}", "fluxerr_{}"), ("f_{}", "flux_err_{}")),
    ],
)
def test_columns_are_called_in_many_ways(catalog, flux, error):
    same(as_photometry(renamed(catalog, flux, error), BANDS), catalog)


def test_any_kind_of_table_is_taken(catalog, tmp_path):
    catalog.write(tmp_path / "a.ecsv")
    plain = {name: catalog[name] for name in catalog.colnames if name != "id"}
    same(as_photometry(tmp_path / "a.ecsv", BANDS), catalog)
    got = as_photometry(plain, BANDS)
    same(got, catalog)
    assert got["id"].tolist() == [1, 2]
    assert len(as_photometry(catalog[1], BANDS)) == 1


def test_magnitudes_become_fluxes(catalog):
    """0.1 mag is 9.2 % of a flux (to first order); AB 23.9 is 1 uJy."""
    table = Table({"NUMBER": [7, 8], "mag_F770W": [23.9, 21.4], "e_mag_F770W": [0.1, 0.05]})
    got = as_photometry(table, BANDS)
    assert got["id"].tolist() == [7, 8]
    np.testing.assert_allclose(got["miri.f770w"].value, [1.0, 10.0])
    np.testing.assert_allclose(got["miri.f770w_err"].value, [0.0921034, 0.460517], rtol=1e-6)
    catalog["miri.f770w"] = catalog["miri.f770w"].to(u.ABmag)
    catalog["miri.f770w_err"] = [0.1, 0.1] * u.mag
    got = as_photometry(catalog, BANDS)
    np.testing.assert_allclose(got["miri.f770w"].value, [1.0, 2.0])
    np.testing.assert_allclose(got["miri.f770w_err"].value, [0.0921034, 0.1842068], rtol=1e-6)
    masked = Table({"mag_F770W": MaskedColumn([23.9, 1.0], mask=[False, True])})
    assert np.isnan(as_photometry(masked, BANDS)["miri.f770w"].value).tolist() == [False, True]


def test_a_unit_is_said_once_for_columns_without_any():
    plain = {"ID": [7, 8], "F770W": [1.0, 2.0], "F770W_err": [0.1, 0.2], "mag_F160W": [23.9, 21.4]}
    got = as_photometry(plain, BANDS, units="nJy")
    assert_allclose(got["miri.f770w"].to_value(u.uJy), [0.001, 0.002])
    assert_allclose(got["miri.f770w_err"].to_value(u.uJy), [0.0001, 0.0002])
    # magnitudes by their name are no fluxes in nJy
    assert_allclose(got["wfc3.f160w"].to_value(u.uJy), [1.0, 10.0])
    assert got["id"].tolist() == [7, 8]
    by_band = as_photometry(plain, BANDS, units={"F770W": "mJy"})
    assert_allclose(by_band["miri.f770w"].to_value(u.uJy), [1000.0, 2000.0])
    magnitudes = as_photometry({"F770W": [23.9], "F770W_err": [0.1]}, BANDS, units="ABmag")
    assert_allclose(magnitudes["miri.f770w"].to_value(u.uJy), [1.0])
    assert_allclose(magnitudes["miri.f770w_err"].to_value(u.uJy), [0.0921034], rtol=1e-6)


def test_a_column_keeps_its_own_unit(catalog):
    same(as_photometry(catalog, BANDS, units="Jy"), catalog)


@pytest.mark.parametrize(
    ("units", "error", "match"),
    [
        ("um", u.UnitsError, "'units' must be a unit of flux density, such as uJy, or 'ABmag'"),
        ("foo", u.UnitsError, "'units' must be a unit of flux density.*got 'foo'"),
        ({"F1000W": "uJy"}, ValueError, "'units' must be a dict with keys among"),
    ],
)
def test_units_of_something_else_are_refused(units, error, match):
    bare = {"F770W": [1.0], "F770W_err": [0.1]}
    refuses(match, as_photometry, bare, BANDS, units=units, error=error)


def test_a_flux_goes_before_a_magnitude_of_the_same_band():
    table = Table({"F770W": [3.0], "F770W_err": [0.3], "mag_F770W": [23.9], "magerr_F770W": [0.1]})
    got = as_photometry(table, BANDS, units="uJy")
    assert_allclose(got["miri.f770w"].value, [3.0])
    # a flux without error does not keep a magnitude with one away
    table.remove_column("F770W_err")
    got = as_photometry(table, BANDS, units="uJy")
    assert_allclose(got["miri.f770w"].value, [1.0])
    assert_allclose(got["miri.f770w_err"].value, [0.0921034], rtol=1e-6)


def test_limits_are_found_by_any_name_of_their_band(catalog):
    table = renamed(catalog, "{}", "{}_err")
    table["F770W_limit"] = [True, False]
    assert as_photometry(table, BANDS)["miri.f770w_limit"].tolist() == [True, False]
    named, _ = band_columns(table)
    assert named["F770W_limit"] == "miri.f770w_limit"


def test_magnitudes_that_stand_for_no_value_become_missing_bands():
    table = Table({"mag_F770W": [23.9, 99.0, 22.0], "e_mag_F770W": [0.1, 0.1, -99.0]})
    with pytest.warns(CatalogWarning, match=r"taken as missing, .*: miri.f770w 2 of 3 \(-99, 99\)"):
        got = as_photometry(table, BANDS)
    assert np.isnan(got["miri.f770w"].value).tolist() == [False, True, False]
    assert np.isnan(got["miri.f770w_err"].value).tolist() == [False, True, True]


def test_two_columns_for_one_band_are_refused(catalog):
    table = renamed(catalog, "{}", "{}_err")
    table["jwst_f770w"] = table["F770W"]
    refuses(r"one column for 'miri.f770w', got 'F770W' and 'jwst_f77", as_photometry, table, BANDS)
    refuses(r"'catalog' must be a table, .*, got int", as_photometry, 3, BANDS, "catalog")


@pytest.mark.parametrize("form", ["dict", "object"])
def test_the_photometry_of_prospector_is_a_catalog_of_one(form):
    """1e-9 maggies are AB 22.5 (3.631 uJy); a band that is masked there is missing."""

    class Curve:
        def __init__(self, name):
            self.name = name

    class Photometry:
        filters = [Curve("wfc3_ir_f160w"), Curve("jwst_f770w")]
        flux = np.array([1e-9, 2e-9])
        uncertainty = np.array([1e-10, 1e-10])
        mask = np.array([True, False])

    data = Photometry()
    if form == "dict":
        data = {"filters": data.filters, "maggies": data.flux, "maggies_unc": data.uncertainty}
        data |= {"phot_mask": Photometry.mask, "wavelength": None}
    table = as_photometry(data, ["wfc3.f160w", "miri.f770w"])
    assert len(table) == 1
    assert_allclose(table["wfc3.f160w"].to_value(u.ABmag), 22.5, atol=1e-6)
    assert_allclose(table["wfc3.f160w_err"].to_value(u.uJy), 0.363078054770)
    assert np.isnan(table["miri.f770w"][0])
    assert table["id"].tolist() == [1]


def test_text_and_nullable_ids_of_a_table_are_kept_by_the_rule_of_all_readers():
    table = Table(
        {"TARGETID": ["0007", "07"], "F770W": [1.0, 2.0] * u.uJy, "F770W_err": [0.1, 0.1] * u.uJy}
    )
    assert as_photometry(table, ["miri.f770w"])["id"].tolist() == ["0007", "07"]
    table["NUMBER"] = [1, 2]
    refuses("one column of ids.*'TARGETID' and 'NUMBER'", as_photometry, table, ["miri.f770w"])
    del table["NUMBER"]
    table.rename_column("TARGETID", "CATAID")
    with pytest.warns(CatalogWarning, match="'CATAID' looks like ids"):
        assert as_photometry(table, ["miri.f770w"])["id"].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("flux", "error", "factor"),
    [
        ("{}[uJy]", "{}_err[uJy]", 1.0),
        ("flux_{} (mJy)", "err_{} (mJy)", 1e3),
        ("f_{}_nJy", "e_{}_nJy", 1e-3),
        ("{} [10^-29 erg/s/cm2/Hz]", "{}_err [UJY]", 1.0),
    ],
)
def test_a_unit_may_end_the_name_of_a_column(catalog, flux, error, factor):
    table = Table({"id": catalog["id"]})
    for ours, theirs in {"miri.f770w": "F770W", "wfc3.f160w": "f160w"}.items():
        table[flux.format(theirs)] = catalog[ours].value / factor
        table[error.format(theirs)] = catalog[f"{ours}_err"].value / factor
    same(as_photometry(table, BANDS), catalog)
    # what the caller says is of columns without one
    same(as_photometry(table, BANDS, units="Jy"), catalog)


def test_a_magnitude_may_have_its_unit_in_its_name():
    table = {"id": [1], "mag_F770W [mag]": [23.9], "magerr_F770W [mag]": [0.1]}
    assert as_photometry(table, BANDS[:1])["miri.f770w"].to_value(u.uJy) == pytest.approx(1)
    table = {"id": [1], "F770W (AB)": [21.4], "F770W_err (mag)": [0.1]}
    assert as_photometry(table, BANDS[:1])["miri.f770w"].to_value(u.uJy) == pytest.approx(10)


def test_names_that_differ_in_case_alone_are_refused(catalog):
    catalog["MIRI.F770W"] = catalog["miri.f770w"]
    message = "one column for 'miri.f770w', got .*'MIRI.F770W'"
    refuses(f"'photometry' must be a table with {message}", as_photometry, catalog, BANDS)


def test_a_unit_that_is_said_is_that_of_errors_without_one(catalog):
    table = Table({name: catalog[name] for name in catalog.colnames})
    for name in BANDS:
        table[f"{name}_err"] = catalog[f"{name}_err"].value / 1e3
    same(as_photometry(table, BANDS, units="mJy"), catalog)


@pytest.mark.parametrize("unit", ["ABmag", "mag(AB)", "AB mag", u.ABmag])
def test_names_of_magnitudes_are_units_in_tables_in_memory_too(unit):
    # astropy keeps "ABmag" of a column as text
    table = Table({"id": [1], "F770W": [23.9], "F770W_err": [0.1]})
    table["F770W"].unit = unit
    table["F770W_err"].unit = "mag"
    table = as_photometry(table, ["miri.f770w"])
    assert table["miri.f770w"].to_value(u.uJy) == pytest.approx(1.0, rel=1e-3)
    assert table["miri.f770w_err"].to_value(u.uJy) == pytest.approx(0.0921, rel=1e-2)
