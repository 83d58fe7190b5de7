"""Positions with proper motions, brought to the time of an image."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table
from astropy.time import Time
from erfa import ErfaWarning
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.utils.exceptions import CatalogWarning
from miricigale.utils.positions import as_position, as_positions, at_epoch

THEN = Time(2016.0, format="jyear")
NOW = Time(2024.5, format="jyear")


def moving(**changes):
    """Four stars with the motions of Gaia, one at the pole and one at 0 hours."""
    values = {
        "ra": [53.1, 0.0, 200.0, 359.9999999] * u.deg,
        "dec": [-27.8, 89.99, 12.0, -60.0] * u.deg,
        "pm_ra_cosdec": [120.0, -900.0, 0.0, 3000.0] * u.mas / u.yr,
        "pm_dec": [-90.0, 400.0, 0.0, -2000.0] * u.mas / u.yr,
        "obstime": THEN,
    }
    return SkyCoord(**(values | changes))


@pytest.mark.parametrize("frame", ["icrs", "galactic", "fk5"])
def test_motions_are_those_of_astropy(frame):
    stars = moving()
    with warnings.catch_warnings():
        # erfa replaces the distances that are not there
        warnings.simplefilter("ignore", ErfaWarning)
        moved = stars.apply_space_motion(new_obstime=NOW)
    right = SkyCoord(moved.ra, moved.dec)
    ours = at_epoch(stars.transform_to(frame), NOW, "catalog")
    assert np.all(right.separation(ours).to_value(u.mas) < 0.01)
    # the first moves by 8.5 years of 150 mas
    assert_allclose(ours.separation(stars).arcsec[0], 8.5 * 0.15, rtol=1e-4)
    # the two ways give back what was put in
    back = at_epoch(stars, THEN, "catalog")
    assert np.all(back.separation(SkyCoord(stars.ra, stars.dec)).to_value(u.mas) < 1e-3)


def test_motions_without_a_time_are_refused():
    without = moving(obstime=None)
    refuses(
        "'stars' must be positions of a known time .*no obstime", at_epoch, without, NOW, "stars"
    )
    refuses("time of the image is not known, got 3 with", at_epoch, moving(), None, "stars")
    refuses("'pointing' .* without proper motions", as_position, moving()[0], "pointing")
    still = moving(pm_ra_cosdec=np.zeros(4) * u.mas / u.yr, pm_dec=np.zeros(4) * u.mas / u.yr)
    assert_array_equal(at_epoch(still, None, "stars").ra, moving().ra)


def test_stars_without_a_motion_stay_and_are_counted():
    motions = [120.0, np.nan, 0.0, 3000.0] * u.mas / u.yr
    with pytest.warns(CatalogWarning, match="stars: 1 of 4 positions have no proper motion"):
        moved = at_epoch(moving(pm_ra_cosdec=motions), NOW, "stars")
    assert moved.dec[1] == moving().dec[1]
    assert np.all(np.isfinite(moved.ra))
    assert_allclose(moved.separation(moving()).arcsec[0], 8.5 * 0.15, rtol=1e-4)


def test_a_column_of_a_table_is_moved_too():
    table = QTable({"id": [1, 2, 3, 4], "sky": moving()})
    refuses("time of the image is not known", as_positions, table, "catalog")
    moved = as_positions(table, "catalog", epoch=NOW)
    assert_allclose(moved.separation(moving()).arcsec[0], 8.5 * 0.15, rtol=1e-4)


def as_columns(**changes):
    """The stars with the columns of Gaia's archive."""
    stars = moving()
    columns = {
        "id": [1, 2, 3, 4],
        "ra": stars.ra,
        "dec": stars.dec,
        "pmra": stars.pm_ra_cosdec,
        "pmdec": stars.pm_dec,
        "ref_epoch": [2016.0] * 4,
    }
    return QTable(columns | changes)


def test_columns_of_motions_count_as_those_of_a_sky_column():
    right = at_epoch(moving(), NOW, "catalog")
    options = {"epoch": NOW, "motions": True}
    plain = {"pmra": [120.0, -900.0, 0.0, 3000.0], "pmdec": [-90.0, 400.0, 0.0, -2000.0]}
    for table in (
        as_columns(),
        as_columns(**plain),
        as_columns(pmra=moving().pm_ra_cosdec.to(u.deg / u.Myr)),
        as_columns(ref_epoch=THEN + np.zeros(4) * u.day),
    ):
        moved = as_positions(table, "catalog", **options)
        assert np.all(moved.separation(right).to_value(u.mas) < 0.01)
    table = as_columns()
    table.rename_columns(["pmra", "pmdec", "ref_epoch"], ["pmRA", "pmDE", "Epoch"])
    assert np.all(as_positions(table, "catalog", **options).separation(right).arcsec < 1e-5)
    # a scene has no time
    still = as_positions(as_columns(), "catalog")
    assert_allclose(still.ra.deg, moving().ra.deg, rtol=1e-12)


def test_columns_of_motions_that_cannot_be_used():
    options = {"epoch": NOW, "motions": True}
    table = as_columns()
    refuses("time of the image is not known, got 3 with", as_positions, table, "c", motions=True)
    table.remove_column("ref_epoch")
    refuses(
        "a table with 'ref_epoch', .*without pmra positions", as_positions, table, "c", **options
    )
    late = as_columns(ref_epoch=[2016.0, np.nan, np.nan, 2016.0])
    refuses(
        r"years such as 2016\.0 in 'ref_epoch' .*nan in row 1", as_positions, late, "c", **options
    )
    wrong = as_columns(pmra=[1.0, 2.0, 3.0, 4.0] * u.km / u.s)
    refuses("'pmra'", as_positions, wrong, "c", error=u.UnitsError, **options)
    # galaxies of a catalog have none
    motions = dict.fromkeys(("pmra", "pmdec"), [np.nan] * 4 * u.mas / u.yr)
    galaxies = as_columns(**motions, ref_epoch=[np.nan] * 4)
    assert_allclose(as_positions(galaxies, "c", **options).dec.deg, moving().dec.deg, rtol=1e-12)


@pytest.mark.parametrize(
    ("ra", "dec"),
    [
        (["03:32:30.6", "--"], ["-00:30:36", "--"]),
        (["3h32m30.6s", ""], ["-0d30m36s", ""]),
        (["03 32 30.6", "nan"], ["-00 30 36", "nan"]),
        (["53.1275", "NA"], ["-0.51", "NA"]),
        (["53.1275d", "NA"], ["-0.51d", "NA"]),
    ],
)
def test_text_is_hours_and_degrees(ra, dec):
    sky = as_positions(QTable({"RA": ra, "Dec": dec}), "catalog", missing=True)
    assert_allclose(sky.ra.deg, [53.1275, np.nan], rtol=1e-12)
    assert_allclose(sky.dec.deg, [-0.51, np.nan], rtol=1e-12)


@pytest.mark.parametrize(
    "names",
    [
        ("_RAJ2000", "_DEJ2000"),
        ("RA_ICRS", "DE_ICRS"),
        ("X_WORLD", "Y_WORLD"),
        ("ALPHA_J2000", "DELTA_J2000"),
        ("ra_deg", "dec_deg"),
    ],
)
def test_columns_of_vizier_and_source_extractor_are_positions(names):
    sky = as_positions(Table([[53.1], [-27.8]], names=names), "catalog")
    assert_allclose([sky.ra.deg[0], sky.dec.deg[0]], [53.1, -27.8], rtol=1e-12)


@pytest.mark.parametrize("unit", ["h", "hours", "hourangle", '"h:m:s"'])
def test_units_of_right_ascension_have_many_names(unit):
    table = Table({"ra": [3.5], "dec": [-27.8]})
    table["ra"].unit = unit
    table["dec"].unit = "Degrees"
    sky = as_positions(table, "catalog")
    assert_allclose([sky.ra.deg[0], sky.dec.deg[0]], [52.5, -27.8], rtol=1e-12)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"ra": [1.0, 2.0], "dec": [5.0, 95.0]}, "-90 to 90 deg in 'dec', got 95 in row 1"),
        ({"ra": [191160.0], "dec": [5.0]}, "-360 to 720 deg in 'ra', got 191160 in row 0"),
        ({"ra": [1.0], "RA": [2.0], "dec": [5.0]}, "one column 'ra', got"),
        ({"ra": ["03:61:00"], "dec": ["1:00:00"]}, "angles in 'ra', got 03:61:00 in row 0"),
        ({"ra": ["03:01:00"], "dec": ["a:b"]}, "numbers in 'dec', got a:b in row 0"),
    ],
)
def test_positions_that_are_none_are_refused_by_column_and_row(columns, message):
    refuses(
        f"'mine.csv' must be a table with .*{message}", as_positions, QTable(columns), "mine.csv"
    )


def test_right_ascensions_may_go_once_around():
    sky = as_positions(QTable({"ra": [-10.0, 360.5], "dec": [0.0, 0.0]}), "catalog")
    assert_allclose(sky.ra.deg, [350.0, 0.5])


def test_positions_in_single_precision_have_a_word():
    table = QTable({"ra": np.array([150.12345678], np.float32), "dec": [2.0]})
    with pytest.warns(CatalogWarning, match="'ra' has floats of 32 bits.* up to 0.027 arcsec"):
        as_positions(table, "catalog")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        as_positions(QTable({"ra": [150.12345678], "dec": np.array([2.0], np.float32)}), "catalog")


def test_positions_may_be_cartesian():
    sky = SkyCoord(x=[1.0], y=[1.0], z=[0.0], representation_type="cartesian")
    assert_allclose(as_positions(QTable({"sky": sky}), "catalog").ra.deg, [45.0])
