import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.evaluation import match_truth
from miricigale.utils.tables import match_sky


@pytest.fixture
def truth():
    sky = SkyCoord([10.0, 10.001, 10.002] * u.deg, [0, 0, 0] * u.deg)
    return QTable({"id": [1, 2, 3], "sky": sky, "miri.f770w": [1.0, 2.0, 3.0] * u.uJy})


def test_every_truth_row_stays_and_pairs_are_one_to_one(truth):
    # one detection between sources 1 and 2, nearer to 2; one far from everything
    sky = SkyCoord([10.0009, 10.5] * u.deg, [0, 0] * u.deg)
    measured = QTable(
        {
            "id": [70, 71],
            "sky": sky,
            "miri.f770w": [2.5, 9.0] * u.uJy,
            "miri.f770w_err": [0.1, 0.1] * u.uJy,
            "miri.f770w_flags": [4, 0],
        }
    )
    table = match_truth(truth, measured, ["miri.f770w"], radius=5 * u.arcsec)
    assert table["id"].tolist() == [1, 2, 3]
    assert table["measured_id"].tolist() == [-1, 70, -1]
    assert table["matched"].tolist() == [False, True, False]
    assert table["miri.f770w"][1] == 2.5 * u.uJy
    assert np.isnan(table["miri.f770w"][[0, 2]]).all()
    assert table["miri.f770w_flags"].tolist() == [0, 4, 0]
    assert table["separation"][1].to_value(u.arcsec) == pytest.approx(0.36, rel=1e-3)


def test_a_row_goes_to_the_nearest_reference_only():
    reference = SkyCoord([0.0, 0.4] * u.arcsec, [0, 0] * u.arcsec)
    index, separation = match_sky(
        SkyCoord([0.3] * u.arcsec, [0] * u.arcsec), reference, radius=1 * u.arcsec
    )
    assert index.tolist() == [-1, 0]
    assert separation[1].to_value(u.arcsec) == pytest.approx(0.1)


def test_missing_columns_are_named(truth):
    with pytest.raises(
        ValueError, match=r"'truth' must be a table with the columns \['miri.f560w'\]"
    ):
        match_truth(truth, truth, ["miri.f560w"])


def test_wrong_units_are_named(truth):
    measured = truth.copy()
    measured["miri.f770w_err"] = 0.1 * u.uJy
    with pytest.raises(u.UnitsError, match="'radius' must be a quantity convertible to arcsec"):
        match_truth(truth, measured, ["miri.f770w"], radius=1)
    with pytest.raises(ValueError, match="'radius' must be at least 0, got -1"):
        match_truth(truth, measured, ["miri.f770w"], radius=-1 * u.arcsec)
    measured["miri.f770w"] = measured["miri.f770w"].to(u.ABmag)
    message = r"'measured' column 'miri\.f770w' must be convertible to uJy, got mag\(AB\)"
    with pytest.raises(u.UnitsError, match=message):
        match_truth(truth, measured, ["miri.f770w"])
    with pytest.raises(ValueError, match="'truth' must be a table, got NoneType"):
        match_truth(None, measured, ["miri.f770w"])
    with pytest.raises(ValueError, match="'bands' must be a list of filter names"):
        match_truth(truth, measured, "miri.f770w")
