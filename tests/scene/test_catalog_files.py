"""Catalogs of users: formats, names, units, and warnings about them."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table

from helpers.errors import refuses
from miricigale.scene import CatalogFlags, read_catalog
from miricigale.utils.exceptions import MiricigaleWarning

COLUMNS = {"id": "NUMBER", "ra": "ALPHA", "dec": "DELTA", "redshift": "zbest"}
COLUMNS |= {"wfc3.f160w": "FLUX_H", "wfc3.f160w_err": "FLUXERR_H", "irac.ch1": "f36"}
SHAPE = {"half_light_radius": "re", "sersic_index": "n", "axis_ratio": "q", "position_angle": "pa"}
UNITS = {"flux": "mJy", "half_light_radius": "arcsec"}


@pytest.fixture
def plain():
    """A table without units by names of its own."""
    names = [*COLUMNS.values(), *SHAPE.values(), "note"]
    rows = [(3.0, 53.1, -27.8, 0.5, 1e-3, 1e-4, 4e-3, 0.3, 1.0, 0.5, 20.0, "a")]
    rows += [(7.0, 53.2, -27.7, 2.0, 2e-3, 2e-4, -99.0, 0.0, 2.0, 0.6, 30.0, "b")]
    return Table(rows=rows, names=names)


def write(table, path):
    formats = {"csv": "ascii.csv", "txt": "ascii.commented_header", "cat": "ascii.basic"}
    formats |= {"ecsv": "ascii.ecsv", "fits": "fits", "xml": "votable"}
    table.write(path, format=formats[path.suffix[1:]])
    return path


def read_silently(*args, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_catalog(*args, **options)


@pytest.mark.parametrize("suffix", ["csv", "cat", "ecsv", "fits", "xml"])
def test_any_format_with_names_and_units_of_its_own(plain, tmp_path, suffix):
    path = write(plain, tmp_path / f"mine.{suffix}")
    with (
        pytest.warns(MiricigaleWarning, match=r"1 of 2 sources are points \(incomplete"),
        pytest.warns(MiricigaleWarning, match=r"missing, by .*: irac\.ch1 1 of 2 \(-99\)$"),
    ):
        catalog = read_catalog(path, columns=COLUMNS | SHAPE, units=UNITS)
    assert catalog["id"].tolist() == [3, 7]
    assert catalog["sky"].dec.deg.tolist() == [-27.8, -27.7]
    np.testing.assert_allclose(catalog["wfc3.f160w"].to_value(u.uJy), [1, 2])
    np.testing.assert_allclose(catalog["wfc3.f160w_err"].to_value(u.uJy), [0.1, 0.2])
    assert np.isnan(catalog["irac.ch1"].value).tolist() == [False, True]
    assert catalog["profile"].tolist() == ["sersic", "point"]
    assert catalog["half_light_radius"][0] == 0.3 * u.arcsec
    assert catalog["position_angle"][0] == 20 * u.deg
    assert catalog["note"].tolist() == ["a", "b"]
    assert catalog["flags"].tolist() == [0, CatalogFlags.MISSING_CODE]


def test_wrong_names_are_refused_with_the_right_ones(plain, tmp_path):
    path = write(plain, tmp_path / "c.csv")
    match = r"no filter 'wfc3\.f161w'; the nearest of 73 are wfc3\.f160w"
    refuses(match, read_catalog, path, error=KeyError, columns={"wfc3.f161w": "FLUX_H"})
    for columns, units, message in (
        ({"wfc3.f160w": "FLUX_h"}, {}, r"no column of c\.csv .*'FLUX_h'.*did you mean 'FLUX_H'"),
        (COLUMNS, {"irac.ch2": "uJy"}, r"no column of c\.csv 'irac\.ch2'"),
        ({"ra": "ALPHA", "dec": "ALPHA"}, {}, "'columns' must be a dict whose values differ"),
        (["ra"], {}, "'columns' must be a dict by our names of columns, got"),
        (COLUMNS, {"flux": "micro"}, "'units' must be a dict of units, also for 'wfc3"),
    ):
        options = {"columns": columns, "units": units}
        refuses(message, read_catalog, path, error=(KeyError, ValueError), **options)


def test_ids_are_found_by_their_usual_names_or_the_likely_column_is_named(plain, tmp_path):
    plain.rename_column("NUMBER", "objid")
    path = write(plain, tmp_path / "c.csv")
    options = {"columns": {k: v for k, v in (COLUMNS | SHAPE).items() if k != "id"}, "units": UNITS}
    with pytest.warns(MiricigaleWarning):
        assert read_catalog(path, **options)["id"].tolist() == plain["objid"].tolist()
    plain.rename_column("objid", "CATAID")
    path = write(plain, tmp_path / "d.csv")
    refuses(
        r"columns \['id'\], got columns .*'CATAID' looks like ids", read_catalog, path, **options
    )


def test_units_must_be_said_where_the_file_has_none(plain, tmp_path):
    path = write(plain, tmp_path / "c.csv")
    match = r"'wfc3\.f160w' must be .* uJy, got no unit: give one, such as units="
    refuses(match, read_catalog, path, error=u.UnitsError, columns=COLUMNS)
    with pytest.raises(u.UnitsError, match="'half_light_radius' must be convertible to arcsec"):
        read_catalog(path, columns=COLUMNS | SHAPE, units={"flux": "mJy"})
    plain["FLUX_H"].unit = "uJy"
    path = write(plain, tmp_path / "c.fits")
    with pytest.warns(MiricigaleWarning) as caught:
        catalog = read_catalog(path, columns=COLUMNS | SHAPE, units=UNITS)
    assert "'wfc3.f160w' taken in mJy, the file says uJy" in str(caught[0].message)
    assert catalog["wfc3.f160w"][0].to_value(u.uJy) == pytest.approx(1)


def test_blanks_are_missing(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text(
        "id,ra,dec,redshift,wfc3.f160w,irac.ch1,irac.ch2,half_light_radius,sersic_index,"
        "axis_ratio,position_angle,star\n"
        "1,53.1,-27.8,0.5,1.0,,,0.3,1,0.5,10,False\n"
        "2,53.1,-27.8,,,,,,,,,True\n"
        "3,53.2,-27.8,1.0,,2.5,,0.2,2,0.4,,False\n"
    )
    with pytest.warns(MiricigaleWarning) as caught:
        catalog = read_catalog(path, units={"flux": "uJy", "half_light_radius": "arcsec"})
    assert len(caught) == 2
    assert np.isnan(catalog["wfc3.f160w"].value).tolist() == [False, True, True]
    assert np.all(np.isnan(catalog["irac.ch2"].value))
    assert catalog["profile"].tolist() == ["sersic", "point", "point"]
    f = CatalogFlags
    assert catalog["flags"].tolist() == [0, f.NO_FLUX | f.NO_REDSHIFT, 0]
    assert catalog["star"].tolist() == [False, True, False]
    path.write_text("id,ra,dec,redshift,wfc3.f160w\n1,53.1,-27.8,0.5,faint\n")
    refuses(r"numbers in 'wfc3\.f160w', got .*faint", read_catalog, path, units={"flux": "uJy"})


def test_positions_in_hours(plain, tmp_path):
    plain["ALPHA"] = ["3:32:24.0", "3:32:48.0"]
    path = write(plain, tmp_path / "c.csv")
    with (
        pytest.warns(MiricigaleWarning, match="points"),
        pytest.warns(MiricigaleWarning, match="taken as missing"),
    ):
        catalog = read_catalog(path, columns=COLUMNS, units={"flux": "mJy", "ra": "hourangle"})
    np.testing.assert_allclose(catalog["sky"].ra.deg, [53.1, 53.2])
    # colons alone say hours, too
    with (
        pytest.warns(MiricigaleWarning, match="points"),
        pytest.warns(MiricigaleWarning, match="taken as missing"),
    ):
        unsaid = read_catalog(path, columns=COLUMNS, units={"flux": "mJy"})
    np.testing.assert_allclose(unsaid["sky"].ra.deg, [53.1, 53.2])
    plain["ALPHA"] = ["x", "y"]
    path, units = write(plain, tmp_path / "d.csv"), {"flux": "mJy", "ra": "hourangle"}
    refuses("angles in 'ra', got 'x'", read_catalog, path, columns=COLUMNS, units=units)


def test_empty_files(plain, tmp_path):
    path = write(plain[:0], tmp_path / "empty.fits")
    with pytest.raises(ValueError, match=r"'empty\.fits' must be a table with rows, got none"):
        read_catalog(path, columns=COLUMNS | SHAPE, units=UNITS)


# ------------------------------------------------------------------------- warnings


@pytest.fixture(scope="module")
def bundled():
    catalog = read_catalog("catalog.goodss")
    catalog["ra"], catalog["dec"] = catalog["sky"].ra, catalog["sky"].dec
    catalog.remove_columns(["sky", "flags"])
    return catalog


def assert_warns(match, table, folder):
    table.write(folder / "c.ecsv")
    with pytest.warns(MiricigaleWarning, match=match) as caught:
        read_catalog(folder / "c.ecsv")
    return caught


def test_a_sound_catalog_is_read_without_a_warning(bundled, tmp_path):
    read_silently("catalog.goodss")
    # a twentieth of it, the brightest or any, is no other unit
    for rows in (slice(None), slice(None, None, 20), np.argsort(bundled["mag_f160w"])[:65]):
        bundled[rows].write(tmp_path / "c.ecsv", overwrite=True)
        read_silently(tmp_path / "c.ecsv")


@pytest.mark.parametrize("limit", [22.0, 24.0, 26.6])
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_counts_reveal_fluxes_of_another_unit(bundled, tmp_path, factor, limit):
    table = bundled[bundled["mag_f160w"].value < limit]
    for name in [n for n in table.colnames if "." in n]:
        table[name] = factor * table[name]
    assert_warns(r"brighter than .* AB in .* in the unit that is said", table, tmp_path)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_colors_reveal_one_band_of_another_unit(bundled, tmp_path, factor):
    table = bundled.copy()
    table["nircam.f444w"] = factor * table["nircam.f444w"]
    caught = assert_warns(r"median of nircam\.f444w over .* in one unit", table, tmp_path)
    assert len(caught) == 1


def test_hours_without_a_unit_are_noticed(bundled, tmp_path):
    table = bundled.copy()
    table["ra"] = table["ra"].to_value(u.hourangle) * u.deg
    assert_warns("if they are in hours, say units=", table, tmp_path)
