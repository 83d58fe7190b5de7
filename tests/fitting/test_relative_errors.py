"""Errors of MIRI that are a part of the flux which all bands expect, against sums over all models."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from miricigale.fitting import BayesFitter, GridSettings, SurveyCalibration, TemplateError
from miricigale.sed import SEDModel

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "nircam.f277w", "nircam.f444w"]
MIRI = "miri.f770w"
AXES = {"redshift": np.linspace(0.5, 3.0, 11), "age": [0.5, 1.0, 2.0], "ebv": [0.1, 0.3]}
#: Errors of the bands and of MIRI, and errors of the models, as parts of the flux.
NOISE, PART, MODEL = 0.1, 0.2, 0.05
#: Measured over true flux in MIRI.
RATIOS = np.array([0.3, 0.5, 0.8, 1.0, 1.3, 2.0])


@pytest.fixture(scope="module")
def fitter():
    rows = {
        "band": [*BANDS, MIRI],
        "zero_point": np.ones(7),
        "error_factor": np.ones(7),
        "error_part": [0.0] * 6 + [PART],
        "outlier": np.zeros(7),
    }
    error = TemplateError([1.0] * u.um, [MODEL])
    calibration = SurveyCalibration("test", QTable(rows), error, {}, None)
    grid = SEDModel.yang2021(agn=False, libraries="bundled").grid(AXES, [*BANDS, MIRI])
    return BayesFitter(grid, calibration=calibration, settings=GridSettings(interpolate=0))


@pytest.fixture(scope="module")
def photometry(fitter):
    """One galaxy on a node with other fluxes in MIRI, whose own errors are 3 % of the true flux."""
    grid = fitter.grid
    fluxes = 3e10 * grid.galaxy[4, 3]
    n = RATIOS.size
    table = QTable({"id": np.arange(n)})
    noise = NOISE * np.random.default_rng(3).normal(size=len(BANDS))
    for band, off in zip(BANDS, noise, strict=True):
        flux = np.full(n, fluxes[grid.filters.index(band)])
        table[band] = flux * (1.0 + off) * u.uJy
        table[f"{band}_err"] = NOISE * flux * u.uJy
    true = fluxes[grid.filters.index(MIRI)]
    table[MIRI] = RATIOS * true * u.uJy
    table[f"{MIRI}_err"] = np.full(n, 0.03 * true) * u.uJy
    return table


def predictions_of_all_models(grid, flux, sigma):
    """Mean and standard deviation of the flux in MIRI over all models, as the other bands weigh them."""
    others = [grid.filters.index(band) for band in BANDS]
    models = grid.galaxy[grid.allowed]
    variance = np.square(sigma) + np.square(MODEL * flux)
    norm = np.sum(np.square(models[:, others]) / variance, axis=1)
    scale = np.sum(models[:, others] * flux / variance, axis=1) / norm
    square = np.square(flux - scale[:, None] * models[:, others]) / variance
    chi2 = np.sum(square, axis=1)
    weight = np.exp(-0.5 * (chi2 - chi2.min()))
    weight /= weight.sum()
    model = models[:, grid.filters.index(MIRI)]
    mean = np.sum(weight * scale * model)
    # each scale is normal about the best one
    spread = np.sum(weight * (np.square(scale * model - mean) + np.square(model) / norm))
    return mean, np.sqrt(spread)


def test_the_part_is_of_the_flux_that_all_bands_expect(fitter, photometry):
    """A flux that is 0.3 of the true one does not have 0.3 of its error."""
    flux = np.array([photometry[band][0].value for band in BANDS])
    sigma = np.array([photometry[f"{band}_err"][0].value for band in BANDS])
    mean, std = predictions_of_all_models(fitter.grid, flux, sigma)
    measured = photometry[MIRI].value
    error = photometry[f"{MIRI}_err"].value
    of_others = std**2 + (MODEL * mean) ** 2
    of_band = error**2 + (PART * mean) ** 2
    expected = (mean * of_band + measured * of_others) / (of_others + of_band)
    results = fitter.fit(photometry)
    # what a fit states has the errors of models, a part of the measured flux, too
    part = np.sqrt(results.sigma[:, -1] ** 2 - error**2 - (MODEL * measured) ** 2)
    # a hundred draws
    assert_allclose(part, PART * expected, rtol=0.03)


def test_where_no_other_bands_say_it_the_part_is_of_the_measured_flux(fitter, photometry):
    """Of objects with fewer than four other fluxes; limits and other bands have no such part."""
    table = photometry.copy()
    for band in BANDS[:3]:
        table[band][0] = np.nan * u.uJy
    table[f"{MIRI}_limit"] = np.arange(len(table)) == 1
    results = fitter.fit(table)
    error = table[f"{MIRI}_err"].value
    measured = table[MIRI].value
    wanted = np.sqrt(error[0] ** 2 + (PART**2 + MODEL**2) * measured[0] ** 2)
    assert_allclose(results.sigma[0, -1], wanted, rtol=1e-9)
    assert_allclose(results.sigma[1, -1], error[1], rtol=1e-9)
    without = fitter.replace(filters=BANDS).fit(table)
    assert_array_equal(results.sigma[2:, :-1], fitter.fit(photometry).sigma[2:, :-1])
    assert np.all(np.isinf(without.sigma[:, -1]))


def test_low_and_high_fluxes_move_a_fit_alike(fitter, photometry):
    """Pulls of fluxes 0.5 and 1.5 times the expected one are opposite; of the measured flux 0.5 has thrice."""
    table = photometry[[0, 1]]
    flux = np.array([photometry[band][0].value for band in BANDS])
    sigma = np.array([photometry[f"{band}_err"][0].value for band in BANDS])
    mean, _ = predictions_of_all_models(fitter.grid, flux, sigma)
    table[MIRI] = np.array([0.5, 1.5]) * mean * u.uJy
    results = fitter.fit(table)
    pulls = (table[MIRI].value - mean) / results.sigma[:, -1]
    assert pulls[0] < 0 < pulls[1]
    assert abs(pulls[0]) / pulls[1] < 1.6
    measured = fitter.replace(calibration=None, model_error={MIRI: PART}).fit(table)
    pulls = (table[MIRI].value - mean) / measured.sigma[:, -1]
    assert abs(pulls[0]) / pulls[1] > 2.5


def test_known_redshifts_draws_and_pieces_have_the_same_errors(fitter, photometry):
    """An object has its errors whatever it is fitted with; draws are of the same posterior as fits."""
    results = fitter.fit(photometry)
    for i in (1, 4):
        alone = fitter.fit(photometry[[i]])
        assert_array_equal(alone.sigma[0], results.sigma[i])
    z = np.full(len(photometry), fitter.grid.redshift[4])
    known = fitter.fit(photometry, redshift=z)
    assert np.all(known.sigma[:, -1] > results.sigma[:, -1] * 0.8)
    draws = fitter.sample(photometry, 4000, seed=1)
    mean = draws.values("redshift").value.mean(axis=1)
    off = (mean - results.mean("redshift").value) / results.std("redshift").value
    assert np.max(np.abs(off)) < 4.0 / np.sqrt(4000)


def test_settings_name_the_bands(fitter):
    assert fitter.settings()["errors_of_expected_flux"] == [MIRI]
    given = fitter.replace(model_error=0.1)
    assert "errors_of_expected_flux" not in given.settings()
