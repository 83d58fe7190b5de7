"""Posteriors do not depend on how objects are called, and bands without information are no bands."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.grids import draw_photometry, node_fitter
from helpers.results import assert_same_tables
from miricigale.fitting import FitFlags, FitResults
from miricigale.utils.table_files import read_table, write_table


@pytest.fixture(scope="module")
def results(grid, photometry):
    return node_fitter(grid).fit(photometry)


@pytest.mark.parametrize("names", ["text", "large", "reversed"])
def test_names_of_objects(grid, photometry, results, names):
    table, n = photometry.copy(), len(photometry)
    table["id"] = {
        "text": [f"J{1000 - k} b" for k in range(n)],
        "large": 2**60 + 7 * np.arange(n),
        "reversed": np.arange(n)[::-1],
    }[names]
    found = node_fitter(grid).fit(table)
    assert_array_equal(found.pdf_2d, results.pdf_2d)
    assert_array_equal(found.moments, results.moments)
    assert_array_equal(found.flags, results.flags)


def test_a_band_of_infinite_error_is_no_band(grid):
    """As one without a flux, but that the flag says why; the other bands are fitted."""
    table = draw_photometry(grid, 12)[0]
    band = grid.filters[2]
    infinite, absent = table.copy(), table.copy()
    infinite[f"{band}_err"] = np.inf * infinite[f"{band}_err"].unit
    absent[band] = np.nan * absent[band].unit
    found, wanted = (node_fitter(grid).fit(one) for one in (infinite, absent))
    assert_array_equal(found.pdf_2d, wanted.pdf_2d)
    assert_array_equal(found.chi2, wanted.chi2)
    assert_array_equal(found.n_bands, wanted.n_bands)
    assert np.all(found.flags != wanted.flags)


def test_an_object_that_is_given_twice(grid, photometry, results):
    """The first row has the posterior of the object; the second is flagged and not fitted."""
    rows = [*range(len(photometry)), 3]
    with pytest.warns(UserWarning, match="an id that occurred before"):
        found = node_fitter(grid).fit(photometry[rows])
    assert_array_equal(found.pdf_2d[:-1], results.pdf_2d)
    assert not found.fitted[-1]
    assert (found.flags & int(FitFlags.DUPLICATE_ID) > 0).tolist() == [False] * (len(rows) - 1) + [
        True
    ]


def test_results_of_every_format(results, tmp_path):
    results.write(tmp_path / "r.fits")
    table = FitResults.read(tmp_path / "r.fits").to_table()
    assert_same_tables(table, results.to_table())
    for name in ("t.fits", "t.ecsv"):
        write_table(table, tmp_path / name)
        again = read_table(tmp_path / name, wanted="a table")
        for column in ("id", "redshift_mean", "mass_p50", "chi2_best", "flags"):
            mine, theirs = (np.asarray(one[column]) for one in (again, table))
            assert_allclose(mine, theirs, rtol=1e-15)
            assert again[column].unit == table[column].unit, name
