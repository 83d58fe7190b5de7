"""Checks and joins of tables."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import (
    Flags,
    ascii_ids,
    described_rows,
    described_table,
    match_sky,
    require_columns,
)


class Sample(Flags):
    """Flags of a sample."""

    GOOD = 0
    EDGE = 1
    NEAR_STAR = 4


def test_flags_explain_themselves():
    assert Sample.describe() == "bit flags (sum): 1 edge, 4 near star; 0 good"
    assert Sample.names(5) == ["edge", "near_star"]
    assert Sample.names(np.int64(0)) == []


def test_rows_make_a_table_whose_columns_say_what_they_are():
    rows = [{"id": 1, "name": "a"}, {"id": 2, "name": "b"}]
    # the order is that of the values, not of the texts
    table = described_rows(rows, {"name": "text", "id": "number"})
    assert table.colnames == ["id", "name"]
    assert table["id"].tolist() == [1, 2]
    refuses(
        r"'texts' must be .*others: \['name', 'title'\]",
        described_rows,
        rows,
        {"id": "", "title": ""},
    )
    assert table["name"].info.description == "text"
    empty = described_rows([], {"id": "number", "name": "text"})
    assert empty.colnames == ["id", "name"]
    assert len(empty) == 0


def test_require_columns():
    table = QTable({"id": [1, 2], "flux": [1, 2] * u.mJy})
    require_columns(table, ["id", "flux"], "photometry", units={"flux": u.uJy, "absent": u.m})
    match = r"'photometry' must be a table with the columns \['z'\]"
    refuses(match, require_columns, table, ["id", "z"], "photometry")
    for name, unit in (("flux", u.m), ("id", u.uJy)):
        args = (require_columns, table, [], "photometry")
        match = f"'photometry' column '{name}' must be convertible to {unit}"
        refuses(match, *args, error=u.UnitsError, units={name: unit})


def sky(x, y):
    return SkyCoord(np.array(x) / 3600, np.array(y) / 3600, unit="deg")


def test_match_is_one_to_one():
    # two references claim row 0: the nearer has it
    coords = sky([0.0, 10.0, 50.0], [0, 0, 0])
    reference = sky([0.3, 0.1, 10.2, 30.0], [0, 0, 0, 0])
    index, separation = match_sky(coords, reference, radius=1 * u.arcsec)
    assert_array_equal(index, [-1, 0, 1, -1])
    assert separation.unit == u.arcsec
    assert_allclose(separation.value, [np.nan, 0.1, 0.2, np.nan], atol=1e-9)


@pytest.mark.parametrize(("n", "m"), [(0, 3), (3, 0)])
def test_match_with_nothing(n, m):
    coords, reference = (sky(np.zeros(size), np.zeros(size)) for size in (n, m))
    index, separation = match_sky(coords, reference, radius=1 * u.arcsec)
    assert_array_equal(index, np.full(m, -1))
    assert np.all(np.isnan(separation))


@pytest.mark.parametrize("ids", [[3, 1], ["a", "b c"], ["", "~"], np.array(["x", 1], object)])
def test_ids_that_fits_holds(tmp_path, ids):
    assert_array_equal(ascii_ids(ids, "ids"), np.asarray(ids))


def test_ids_that_fits_does_not_hold_are_refused():
    ids = ["a", "Kümmel", "b ", "\N{GREEK SMALL LETTER ALPHA}", "c", "😀"]
    refuses(r"'catalog' must be ASCII.* got 'Kümmel', 'b ', 'α' and 1", ascii_ids, ids, "catalog")
    refuses(r"got 'b '$", ascii_ids, ["a", "b "], "ids")


def test_tables_of_results_keep_their_metadata_in_fits_without_warnings(tmp_path, recwarn):
    meta = {"pixel_scale": 0.06, "correlated_noise": True, "offset": [0.1, -0.2], "filter": "F770W"}
    table = described_table({"flux": ([1.0] * u.uJy, "Total flux")}, meta)
    path = tmp_path / "fluxes.fits"
    table.write(path)
    assert not recwarn.list
    again = read_table(path, wanted="a table")
    assert again.meta == meta
    assert again["flux"].info.description == "Total flux"
    # and any reader of FITS finds numbers and short texts on cards
    header = fits.getheader(path, 1)
    for name in ("pixel_scale", "correlated_noise", "filter"):
        assert header[name] == meta[name]
    assert isinstance(table[:1], type(table))
