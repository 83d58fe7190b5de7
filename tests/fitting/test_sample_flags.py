"""Poor fits by their sample, and the single band that is off."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.grids import draw_photometry, make_grid, node_fitter
from miricigale.fitting import FitFlags, fit_file, open_results
from miricigale.fitting.results.sample_flags import chi2_limit, chi2_step


def test_limit_of_a_sample_is_three_standard_deviations_of_its_logarithm():
    """Of a log-normal sample; outliers and what was not fitted do not move it, a bad sample reaches 100."""
    chi2 = np.exp(np.log(0.7) + 0.5 * np.random.default_rng(1).normal(size=20000))
    # the 84th percentile is 0.9945 standard deviations above the median
    wanted = 0.7 * np.exp(3 * 0.9945 * 0.5)
    assert chi2_limit(chi2) == pytest.approx(wanted, rel=0.03)
    assert chi2_limit(np.concatenate([chi2, np.full(100, 1e4), np.full(9, np.nan)])) == (
        pytest.approx(wanted, rel=0.05)
    )
    assert chi2_limit(500 * chi2) == 100.0
    assert chi2_limit(chi2[:49]) == 10.0
    assert [chi2_step(n) for n in (0, 1_000_000, 1_000_001, 3_000_000)] == [1, 1, 2, 3]


@pytest.fixture(scope="module")
def sample():
    """120 objects of a grid of ten bands; a flux is three times too bright in 10, all fluxes of one are noise."""
    grid = make_grid(n_tau=3, n_age=3, polar=(0.0,), frac=[0.0], n_b=10)
    table, _ = draw_photometry(grid, 120, noise=0.05)
    bands = {i: grid.filters[i % 10] for i in range(10)}
    for i, name in bands.items():
        table[name][i] *= 3.0
    rng = np.random.default_rng(5)
    for name in grid.filters:
        table[name][50] *= np.exp(rng.normal())
    return grid, table, bands


def test_one_wrong_flux_is_flagged_with_its_band(sample):
    grid, table, bands = sample
    results = node_fitter(grid, model_error=0.0).fit(table)
    off = (results.flags & FitFlags.BAND_OFF) != 0
    assert_array_equal(off, results.band_off != "")
    right = [results.band_off[i] == name for i, name in bands.items()]
    assert sum(right) >= 8
    assert not off[51:].any()
    high = (results.flags & FitFlags.HIGH_CHI2) != 0
    assert high[50]
    # of what errors allow besides, the flux of one is 3 times a small one
    assert high[:10].sum() >= 9
    assert not high[51:].any()
    column = results.to_table()["band_off"]
    assert_array_equal(column, results.band_off)
    assert results[0].band_off == results.band_off[0]
    # a limit is no flux that is off
    limited = table.copy()
    for i, name in bands.items():
        limited[f"{name}_limit"] = np.arange(120) == i
    assert not (node_fitter(grid, model_error=0.0).fit(limited)[:10].band_off != "").any()


def test_flags_of_files_are_those_of_the_whole_sample(sample, tmp_path):
    """In pieces of 30, whose own samples are too small; a part is flagged as it is read."""
    grid, table, _ = sample
    table.write(tmp_path / "cat.fits")
    fitter = node_fitter(grid, model_error=0.0)
    wanted = fitter.fit(table)
    fit_file(fitter, tmp_path / "cat.fits", tmp_path / "out", chunk_rows=30)
    found = open_results(tmp_path / "out")
    assert_array_equal(np.concatenate([part.flags for part in found.parts()]), wanted.flags)
    assert_array_equal(found.to_table(["flags"])["flags"], wanted.flags)
    # from 10 of a small sample
    few = fitter.fit(table[:40])
    poor = few.reduced_chi2 > 10
    assert_array_equal((few.flags & FitFlags.HIGH_CHI2) != 0, poor)
    assert_allclose(few.reduced_chi2, wanted.reduced_chi2[:40])
