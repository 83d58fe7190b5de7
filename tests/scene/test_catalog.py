import gzip

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import MaskedColumn, QTable, Table

from helpers.errors import refuses, warned
from helpers.scenes import catalog_at
from miricigale.scene import CatalogFlags, check_catalog, read_catalog
from miricigale.utils.exceptions import DataError


@pytest.fixture
def table():
    sky = SkyCoord([53.1, 53.2], [-27.8, -27.7], unit="deg")
    columns = {"id": [3, 7], "redshift": [0.5, 2.0], "profile": ["sersic", "point"]}
    columns |= {"half_light_radius": [0.3, 0.0] * u.arcsec, "sersic_index": [1.0, np.nan]}
    columns |= {"axis_ratio": [0.5, 1.0], "position_angle": [20.0, 0.0] * u.deg}
    return catalog_at(sky, **columns, **{"miri.f770w": [1.0, 2.0] * u.mJy})


def test_units_are_converted_and_the_input_is_left_alone(table):
    table["half_light_radius"] = table["half_light_radius"].to(u.deg)
    catalog = check_catalog(table, filters=["miri.f770w"])
    assert catalog["miri.f770w"].unit == u.uJy
    assert catalog["miri.f770w"][1].value == 2000
    assert catalog["half_light_radius"][0].value == pytest.approx(0.3)
    assert catalog["flags"].tolist() == [0, 0]
    assert table["miri.f770w"].unit == u.mJy
    assert "flags" not in table.colnames


@pytest.mark.parametrize("suffix", ["ecsv", "fits", "ecsv.gz"])
def test_round_trip(table, tmp_path, suffix):
    path = tmp_path / f"catalog.{suffix}"
    table.write(tmp_path / f"catalog.{suffix.removesuffix('.gz')}")
    if suffix.endswith("gz"):
        path.write_bytes(gzip.compress((tmp_path / "catalog.ecsv").read_bytes()))
    catalog = read_catalog(path)
    assert catalog["id"].tolist() == [3, 7]
    assert catalog["sky"].separation(table["sky"]).max() < 1 * u.mas
    assert catalog["profile"].tolist() == ["sersic", "point"]


def test_unusable_rows_are_flagged(table):
    table = table[[0] * 5]
    table["id"] = range(5)
    table["half_light_radius"][0] = -1 * u.arcsec
    table["sersic_index"][1] = 12
    table["axis_ratio"][2] = 0
    table["position_angle"][3] = np.nan
    table["redshift"][4] = np.nan
    f = CatalogFlags
    wanted = [f.BAD_RADIUS, f.BAD_INDEX, f.BAD_AXIS_RATIO, f.BAD_ANGLE, f.NO_REDSHIFT]
    text = (
        r"^catalog: 4 of 5 Sersic profiles are drawn as points: half_light_radius is missing or not "
        r"positive in 1, sersic_index is missing or outside 0.2 to 10 in 1, axis_ratio .* in 1, "
        r"position_angle .* in 1 \(flagged\)$"
    )
    assert warned(text, check_catalog, table)["flags"].tolist() == wanted


def test_sersic_profiles_are_round_without_an_axis_ratio_and_need_what_draws_them(table):
    """The points of the table need none of it."""
    table.remove_column("position_angle")
    refuses("columns .'position_angle'., for its Sersic profiles", check_catalog, table)
    table["axis_ratio"] = [1.0, np.nan]
    assert check_catalog(table)["flags"].tolist() == [0, 0]
    table.remove_column("axis_ratio")
    catalog = check_catalog(table)
    assert catalog["axis_ratio"][0] == 1
    assert catalog["flags"].tolist() == [0, 0]
    table.remove_column("sersic_index")
    refuses("columns .'sersic_index'., for its Sersic profiles", check_catalog, table)
    table["profile"] = "point"
    assert check_catalog(table)["flags"].tolist() == [0, 0]


NOWHERE = SkyCoord([53, np.nan], [-27, -27], unit="deg")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"half_light_radius": [0.1, 0.2]},
            "'half_light_radius' must be .* to arcsec, got no unit",
        ),
        ({"miri.f770w": [1, 2] * u.s}, r"'miri\.f770w' must be convertible to uJy, got s"),
        ({"id": [3, 3]}, r"ids are unique, got duplicates such as \[3\]"),
        ({"id": [1.5, 2.5]}, "integers or text in 'id'"),
        ({"id": ["a", "\xe4"]}, "ASCII"),
        ({"sky": NOWHERE}, "finite positions, got 1 that are not, first in row 1"),
        ({"profile": ["disk", "point"]}, r"'profile' among .*, got \['disk'\]"),
        ({"axis_ratio": ["x", "y"]}, "numbers in 'axis_ratio'"),
        ({"star": [0, 1]}, "True or False in 'star', got int64"),
    ],
)
def test_refuses_columns(table, columns, message):
    for name, value in columns.items():
        table[name] = value
    refuses(message, check_catalog, table, error=(ValueError, u.UnitsError), filters=["miri.f770w"])


def test_refuses(table):
    refuses(r"columns \['miri.f560w'\]", check_catalog, table, filters=["miri.f560w"])
    refuses("a table with rows, got none", check_catalog, table[:0])


def test_unreadable_files(tmp_path):
    match = r"no catalog 'catalog.cosmos': neither a file nor one of catalog.goodss"
    refuses(match, read_catalog, "catalog.cosmos", error=DataError)
    path = tmp_path / "broken.ecsv"
    path.write_text("# %ECSV 1.0\n# ---\nnonsense")
    refuses(r"broken\.ecsv cannot be read as a table", read_catalog, path, error=DataError)


def test_bundled_catalog():
    catalog = read_catalog("catalog.goodss")
    center = SkyCoord(53.13440, -27.83444, unit="deg")
    separation = catalog["sky"].separation(center)
    assert separation.max() < 95 * u.arcsec
    # the counts of the 3D-HST catalog in the bare field of view, 74 by 113 arcsec
    east = (catalog["sky"].ra - center.ra) * np.cos(center.dec)
    north = catalog["sky"].dec - center.dec
    field = (abs(east) < 37 * u.arcsec) & (abs(north) < 56.5 * u.arcsec)
    # one source lies within 2 mas of the edge
    assert field.sum() == pytest.approx(451, abs=1)
    flags = [int(np.sum(catalog["galfit_flag"][field] == k)) for k in range(4)]
    np.testing.assert_allclose(flags, [273, 67, 108, 3], atol=1)
    assert catalog["star"][field].sum() == 2
    galaxies = ~catalog["star"]
    assert np.all(catalog["redshift"][galaxies] > 0)
    assert np.all(catalog["flags"][galaxies] == 0)
    assert catalog["wfc3.f160w"].min() > 0.08 * u.uJy  # 26.6 AB
    fluxes = [name for name in catalog.colnames if name.startswith("nircam.")]
    assert len(fluxes) == 22
    for name in fluxes:
        color = -2.5 * np.log10(catalog[name] / catalog["wfc3.f160w"]).value
        good = np.isfinite(color)
        assert np.all(np.abs(color[good]) < 5)
        assert np.all((catalog["quality"][~good] & 3) != 0)
    sersic = catalog["profile"] == "sersic"
    assert np.all(catalog["mag_f160w"][sersic].value <= 24.5)
    assert np.all(catalog["galfit_flag"][sersic] <= 1)
    assert catalog["half_light_radius"][sersic].max() <= 3 * u.arcsec


@pytest.mark.parametrize("name", ["miri.f770w", "wfc3.f160w", "wfc3.f160w_err", "sedpy.jwst_f770w"])
def test_columns_called_by_a_filter_must_be_fluxes(table, tmp_path, name):
    table[name] = [1.0, 2.0]
    table.write(tmp_path / "c.ecsv")
    match = rf"column '{name}' must be convertible to uJy, got no unit"
    refuses(match, read_catalog, tmp_path / "c.ecsv", error=u.UnitsError)
    table[name] = [20.0, 21.0] * u.ABmag
    refuses(rf"column '{name}' must be .* got mag\(AB\)", check_catalog, table, error=u.UnitsError)
    table.remove_column(name)
    table["other.mag"], table["class.prob"] = [20.0, 21.0] * u.ABmag, [0.1, 0.9]
    assert {"other.mag", "class.prob"} <= set(check_catalog(table).colnames)


def test_stars_are_stated_or_none(table):
    assert check_catalog(table)["star"].tolist() == [False, False]
    table["star"] = [False, True]
    assert check_catalog(table)["star"].tolist() == [False, True]


@pytest.mark.parametrize("kind", [Table, QTable])
def test_masked_values_are_missing_in_either_of_astropys_ways(table, kind):
    table["profile"] = ["sersic", "sersic"]
    table["half_light_radius"], table["sersic_index"] = [0.3, 0.2] * u.arcsec, [1.0, 4.0]
    table = kind(table, masked=True)
    table["sersic_index"].mask = table["miri.f770w"].mask = [True, False]
    text = "1 of 2 Sersic profiles are drawn as points: sersic_index is missing"
    catalog = warned(text, check_catalog, table, filters=["miri.f770w"])
    assert catalog["flags"].tolist() == [CatalogFlags.BAD_INDEX | CatalogFlags.NO_FLUX, 0]
    assert np.isnan(catalog["miri.f770w"].value).tolist() == [True, False]
    assert catalog["sersic_index"][1] == 4
    assert not any(hasattr(catalog[name], "mask") for name in ("id", "profile", "axis_ratio"))
    table["id"] = MaskedColumn([1, 2], mask=[False, True])
    refuses("an id in every row, got 1 masked or empty", check_catalog, table)


@pytest.mark.parametrize("code", [-99.0, -99.99, -999.0, -9999.0])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_numbers_that_stand_for_no_value_are_missing(table, code, dtype):
    table["miri.f770w"] = np.array([code, 2.0], dtype=dtype) * u.mJy
    table["miri.f770w_err"] = np.array([code, 0.1], dtype=dtype) * u.mJy
    table["redshift"] = np.array([code, 2.0], dtype=dtype)
    table["half_light_radius"][0] = code * u.arcsec
    table["position_angle"] = [-99, -99.0] * u.deg
    catalog = warned("1 of 1 Sersic profiles are drawn as points", check_catalog, table)
    for name in ("miri.f770w", "miri.f770w_err", "half_light_radius"):
        assert np.isnan(catalog[name].value).tolist() == [True, False]
    assert np.isnan(catalog["redshift"]).tolist() == [True, False]
    f = CatalogFlags
    assert catalog["flags"].tolist() == [f.NO_FLUX | f.NO_REDSHIFT | f.BAD_RADIUS, 0]
    assert catalog["position_angle"].value.tolist() == [-99, -99]
    # what is no code stays, in whatever unit
    table["miri.f770w"] = [-0.099, -98.0] * u.mJy
    table["profile"] = "point"
    np.testing.assert_allclose(check_catalog(table)["miri.f770w"].value, [-99, -98000])


def test_a_source_without_a_usable_flux_is_flagged(table):
    table = table[[0] * 5]
    table["id"] = range(5)
    # a flux in one band is enough; a flux whose error is not positive is none
    table["miri.f770w"] = [1.0, np.nan, 0.0, np.nan, 2.0] * u.uJy
    table["miri.f770w_err"] = [0.1, np.nan, 0.1, np.nan, -1.0] * u.uJy
    table["wfc3.f160w"] = [np.nan, 3.0, np.nan, -1.0, np.nan] * u.uJy
    flags = check_catalog(table)["flags"]
    assert flags.tolist() == [0, 0, *[CatalogFlags.NO_FLUX] * 3]
    assert "32 no flux" in flags.info.description
    # without a band there is nothing to judge
    table.remove_columns(["miri.f770w", "miri.f770w_err", "wfc3.f160w"])
    assert not np.any(check_catalog(table)["flags"])
