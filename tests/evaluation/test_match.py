import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from helpers.errors import refuses
from miricigale.evaluation import AssociationFlags, associate, match_truth


@pytest.fixture
def truth():
    sky = SkyCoord([10.0, 10.001, 10.002] * u.deg, [0, 0, 0] * u.deg)
    return QTable({"id": [1, 2, 3], "sky": sky, "miri.f770w": [1.0, 2.0, 3.0] * u.uJy})


def test_every_truth_row_stays_and_pairs_are_one_to_one(truth):
    # one detection between sources 1 and 2, nearer to 2; one far from everything
    sky = SkyCoord([10.0009, 10.5] * u.deg, [0, 0] * u.deg)
    measured = QTable({"id": [70, 71], "sky": sky, "miri.f770w_flags": [4, 0]})
    measured["miri.f770w"], measured["miri.f770w_err"] = [2.5, 9.0] * u.uJy, [0.1, 0.1] * u.uJy
    table = match_truth(truth, measured, ["miri.f770w"], radius=5 * u.arcsec)
    assert table["id"].tolist() == [1, 2, 3]
    assert table["measured_id"].tolist() == [-1, 70, -1]
    assert table["matched"].tolist() == [False, True, False]
    assert table["miri.f770w"][1] == 2.5 * u.uJy
    assert np.isnan(table["miri.f770w"][[0, 2]]).all()
    assert table["miri.f770w_flags"].tolist() == [0, 4, 0]
    assert table["separation"][1].to_value(u.arcsec) == pytest.approx(0.36, rel=1e-3)


def test_what_cannot_be_matched_is_named(truth):
    measured = truth.copy()
    measured["miri.f770w_err"] = 0.1 * u.uJy
    bands, arcsec = ["miri.f770w"], 1 * u.arcsec
    for first, second, names, radius, message in (
        (truth, measured, bands, -arcsec, "'radius' must be at least 0, got -1"),
        (None, measured, bands, arcsec, "'truth' must be a table, got NoneType"),
        (truth, measured, "miri.f770w", arcsec, "'bands' must be a list of filter names"),
        (truth, truth, ["miri.f560w"], arcsec, r"'truth' .* the columns \['miri.f560w'\]"),
    ):
        with pytest.raises((ValueError, u.UnitsError), match=message):
            match_truth(first, second, names, radius=radius)


def brute_force(first, second, radius):
    """Status of every row of two lists of flat positions, by their distances alone."""
    distance = np.hypot(*(first[:, None] - second[None]).T).T
    near = distance < radius
    nearest = distance.argmin(axis=1), distance.argmin(axis=0)
    pairs = {(i, j) for i, j in np.argwhere(near) if nearest[0][i] == j and nearest[1][j] == i}
    return near, pairs


def test_association_agrees_with_all_distances():
    rng = np.random.default_rng(5)
    first, second = rng.uniform(0, 30, (120, 2)), rng.uniform(0, 30, (90, 2))
    first[:40] = second[:40] + rng.normal(0, 0.2, (40, 2))
    near, pairs = brute_force(first, second, 1.0)
    coords = [SkyCoord(*(xy.T * u.arcsec)) for xy in (first, second)]
    numbers = np.arange(120) + 1000, np.arange(90) + 2000
    tables = [QTable({"id": n, "sky": c}) for n, c in zip(numbers, coords, strict=True)]
    table = associate(*tables, radius=1 * u.arcsec)
    # each row of either catalog once
    assert sorted(table["first"][table["first"] >= 0]) == list(range(120))
    assert sorted(table["second"][table["second"] >= 0]) == list(range(90))
    both = (table["first"] >= 0) & (table["second"] >= 0)
    assert {*table[both].iterrows("first", "second")} == pairs
    alone = {(i, j) for i, j in pairs if near[i].sum() == near[:, j].sum() == 1}
    status = np.asarray(table["status"])
    assert {*table[status == "matched"].iterrows("first", "second")} == alone
    for row in table[~both]:
        k, name = (0, "first") if row["first"] >= 0 else (1, "second")
        some = near.any(axis=1 - k)[row[name]]
        assert row["status"] == ("ambiguous" if some else "unmatched")
        wanted = AssociationFlags.NOT_MUTUAL if some else AssociationFlags.NONE_NEAR
        assert row["reasons"] & wanted
    assert set(table.meta["counts"]) == set(status) == {"matched", "ambiguous", "unmatched"}
    assert sum(table.meta["counts"].values()) == len(table) == 210 - len(pairs)
    expected = np.hypot(*(first[table["first"][both]] - second[table["second"][both]]).T)
    assert table["separation"][both].to_value(u.arcsec) == pytest.approx(expected, abs=1e-6)
    assert table["second_id"][both].tolist() == (table["second"][both] + 2000).tolist()
    assert table["second_id"].mask.tolist() == (table["second"] < 0).tolist()
    # the other way round the pairs are the same
    back = associate(coords[1], coords[0], radius=1 * u.arcsec)
    both = (back["first"] >= 0) & (back["second"] >= 0)
    assert {*back[both].iterrows("second", "first")} == pairs


def test_association_of_what_cannot_be_placed():
    nan = SkyCoord([np.nan, 10.0] * u.deg, [0.0, 0.0] * u.deg)
    here = SkyCoord([10.0] * u.deg, [0.0] * u.deg)
    table = associate(nan, here, radius=1 * u.arcsec)
    assert table["second"].tolist() == [-1, 0]
    assert table["status"].tolist() == ["unmatched", "matched"]
    assert table["reasons"].tolist() == [AssociationFlags.NO_POSITION, 0]
    none = associate(here[:0], here, radius=1 * u.arcsec)
    assert none["status"].tolist() == ["unmatched"]
    assert none.meta["counts"] == {"matched": 0, "ambiguous": 0, "unmatched": 1}
    assert len(associate(here[:0], here[:0], radius=1 * u.arcsec)) == 0
    refuses("'radius' must be positive", associate, here, here, radius=0 * u.arcsec)
    text = r"'second' must be a table with the columns \['sky'\]"
    refuses(text, associate, here, QTable({"id": [1]}), radius=1 * u.arcsec)


def test_matches_to_the_truth_say_which_are_ambiguous(truth):
    sky = SkyCoord([10.0, 10.0021, 10.0022] * u.deg, [0, 0, 0] * u.deg)
    measured = QTable({"id": [7, 8, 9], "sky": sky})
    table = match_truth(truth, measured, [], radius=1 * u.arcsec)
    assert table["measured_id"].tolist() == [7, -1, 8]
    flags = AssociationFlags
    assert table["association"].tolist() == [0, flags.NONE_NEAR, flags.SEVERAL_SECOND]
