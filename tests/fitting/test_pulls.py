"""Pulls of bands as if left out: against least squares, and made-up catalogs of right and wrong errors."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.grids import make_grid, photometry_table
from miricigale.fitting import BayesFitter, fit_file, leave_out
from miricigale.fitting.results.pulls import left_out_pulls
from miricigale.utils.exceptions import FitWarning


def catalog(grid, n, wrong=None):
    """Galaxies of a grid with 5 % noise; the errors of one band are stated as a third of it."""
    rng = np.random.default_rng(4)
    z, galaxy = rng.permutation(np.argwhere(grid.allowed).repeat(n, axis=0))[:n].T
    true = grid.galaxy[z, galaxy] / grid.galaxy[z, galaxy].mean(axis=1, keepdims=True) * 10.0
    flux = true * rng.normal(1.0, 0.05, true.shape)
    error = 0.05 * true
    if wrong is not None:
        error[:, wrong] /= 3.0
    return flux, error, photometry_table(grid.filters, flux, error)


def test_pulls_are_those_of_least_squares_without_the_band():
    """A single model with a free scale has a normal posterior: the pull about the other bands' scale is exact."""
    grid = make_grid(n_z=1, n_tau=1, n_age=1, frac=[0.0])
    flux, error, table = catalog(grid, 8, wrong=2)
    table["band3_limit"] = np.arange(8) == 5
    table["band0"][1] = np.nan
    pull = left_out_pulls(BayesFitter(grid, model_error=0.0).fit(table))
    model, flux[1, 0] = grid.galaxy[0, 0], np.nan
    flux[5, 3] = np.nan
    for i in np.delete(np.arange(8), 5):
        for k in np.flatnonzero(np.isfinite(flux[i])):
            rest = np.isfinite(flux[i]) & (np.arange(6) != k)
            d, m, e = flux[i, rest], model[rest], error[i, rest]
            variance = 1.0 / np.sum(m**2 / e**2)
            scale = variance * np.sum(m * d / e**2)
            wanted = (flux[i, k] - scale * model[k]) / np.hypot(
                error[i, k], model[k] * variance**0.5
            )
            assert pull[i, k] == pytest.approx(wanted, rel=1e-5)
    assert np.isnan(pull[[1, 5], [0, 3]]).all()


@pytest.mark.slow
def test_bands_whose_errors_are_too_small_are_named(tmp_path):
    grid, x = make_grid(n_z=3, n_b=8, frac=[0.0]), np.linspace(-1, 1, 8)
    # power laws that are no farther from each other than errors leave them
    slope, bend = np.linspace(-0.3, 0.3, 20)[:, None], np.linspace(0, 0.1, 3)[:, None, None]
    grid = dataclasses.replace(grid, galaxy=1e-9 * np.exp(slope * x + bend * x**2))
    # not a word where errors are right, or the sources too few
    fitter = BayesFitter(grid, model_error=0.0)
    fitter.fit(catalog(grid, 80)[2])
    table = catalog(grid, 80, wrong=5)[2]
    fitter.fit(table[:25])
    with pytest.warns(
        FitWarning, match=r"errors allow: band5 [12]\.\d times \(\d+ fluxes\); 'calibrate'"
    ):
        found = fitter.fit(table)
    left = leave_out(fitter, table, ["band5"]).pull[:, 0]
    ours = left_out_pulls(found)[:, 5]
    assert_allclose(np.nanmedian(np.abs(ours)), np.nanmedian(np.abs(left)), rtol=0.1)
    table.write(tmp_path / "catalog.fits")
    with pytest.warns(FitWarning, match=r"errors allow: band5 "):
        fit_file(fitter, tmp_path / "catalog.fits", tmp_path / "fits")
