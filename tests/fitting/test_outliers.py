"""A likelihood of bands that may be wrong: against plain evaluations of the mixture, and where its columns go."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from helpers.errors import refuses
from helpers.grids import draw_photometry, make_grid, node_fitter
from miricigale.fitting import BayesFitter, FitResults, GridSettings
from miricigale.fitting._core.workspace import make_limits
from miricigale.fitting.grid.mixture import BandMixture

BANDS = ("acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "miri.f770w", "miri.f1500w")
PART = dict.fromkeys(BANDS[:4], 0.02) | {"miri.f770w": 0.2}


@pytest.fixture(scope="module")
def grid():
    return replace(make_grid(7, n_z=8, n_tau=3, n_age=3), filters=BANDS)


@pytest.fixture(scope="module")
def table(grid):
    """Objects of which every other has a band that is wrong by a factor, and some a wrong limit."""
    table, _ = draw_photometry(grid, 12, seed=5, noise=0.05)
    rng = np.random.default_rng(2)
    for i in range(0, 12, 2):
        table[BANDS[rng.integers(6)]][i] *= rng.choice([0.1, 0.3, 3.0, 10.0])
    limit = np.zeros(12, bool)
    limit[[1, 3, 5, 8]] = True
    table["wfc3.f160w"][[1, 5]] *= 1.5
    table["wfc3.f160w"][3] *= 0.1
    table["wfc3.f160w_limit"] = limit
    return table


def broad(flux, err, measured):
    """Widths of the broad part, band by band; the bands are in order of wavelength."""
    out = np.full(6, np.nan)
    used = np.flatnonzero(measured)
    for n, b in enumerate(used):
        near = used[max(n - 1, 0) : n + 2]
        out[b] = np.hypot(10 * err[b], np.abs(flux[near]).max())
    return out


def by_hand(grid, results, i):
    """Ln of the mixture of every model at the best of many scales, and how likely each band is wrong."""
    index = np.meshgrid(*(np.arange(n) for n in (8, 9, grid.n_agn, 4)), indexing="ij")
    model = grid.flux(*index).reshape(-1, 6)
    flux, sigma, limit = results.flux[i], results.sigma[i], results.limit[i]
    wide, part = broad(flux, sigma, ~limit), np.array([PART.get(name, 0.0) for name in BANDS])
    with np.errstate(divide="ignore"):
        each = np.log(np.where(model > 0, flux / model, 1.0))
    low, high = each.min(axis=1) - 0.3, each.max(axis=1) + 0.3
    best, wrong = np.full(len(model), -np.inf), np.zeros((len(model), 6))
    for x in np.linspace(0, 1, 500):
        m = np.exp(low + x * (high - low))[:, None] * model
        good = np.where(limit, norm.cdf((flux - m) / sigma), norm.pdf(flux, m, sigma)) * (1 - part)
        bad = np.where(limit, 1.0, norm.pdf(flux, m, np.nan_to_num(wide, nan=1.0))) * part
        log = np.log(np.maximum(good + bad, 1e-300)).sum(axis=1)
        better = log > best
        best[better] = log[better]
        wrong[better] = (bad / np.maximum(good + bad, 1e-300))[better]
    shape = index[0].shape
    return best.reshape(shape), wrong.reshape(*shape, 6)


@pytest.mark.slow
def test_posterior_is_that_of_the_mixture(grid, table):
    """Evidence to 0.1, redshifts and fractions to 0.04 in weight, probabilities to 0.02 (rms)."""
    options = {"model_error": 0.02, "settings": GridSettings(rtol=0.0)}
    results = node_fitter(grid, outliers=PART, **options).fit(table)
    plain = node_fitter(grid, **options).fit(table)
    count = np.where(grid.allowed[:, :, None, None], grid.agn_multiplicity[:, None], 0)
    every = 8 * 9 * 4 * grid.agn_multiplicity.sum()
    far, change, worse = [], [], []
    # with and without wrong bands and limits, both in 8
    for i in (0, 1, 2, 3, 5, 8):
        log, wrong = by_hand(grid, results, i)
        weight = count * np.exp(log - log.max())
        total = weight.sum()
        evidence = np.log(total / every) + log.max()
        assert -0.1 < results.log_evidence[i] - evidence < 0.02
        zf = weight.sum((1, 2)) / total
        far.append(0.5 * np.abs(results.pdf_2d[i] - zf).sum())
        worse.append(0.5 * np.abs(plain.pdf_2d[i] - zf).sum())
        share = np.tensordot(weight / total, wrong, 4)
        change.append(results.outlier[i] - share)
    assert max(far) < 0.04
    assert max(worse) > 0.9
    # pairs of little weight in single precision
    single = node_fitter(grid, outliers=PART, model_error=0.02).fit(table)
    assert_allclose(single.pdf_2d, results.pdf_2d, atol=2e-3)
    assert np.sqrt(np.mean(np.square(change))) < 0.02


def test_likelihood_is_a_sum_of_two_normal_distributions():
    """And the tangent, which the kernels take, touches it and is nowhere above."""
    bands = BandMixture.of_bands({"miri.f770w": 0.1, "acs.f606w": 0.3}, ("miri.f770w", "acs.f606w"))
    assert_array_equal(bands.order, [1, 0])
    flux, sigma = np.array([[0.0, 5.0]]), np.array([[0.1, 0.2]])
    wide = bands.broad(flux, sigma)
    assert_allclose(wide, [[np.hypot(1.0, 5.0), np.hypot(2.0, 5.0)]])
    model = np.linspace(-3, 8, 23)[:, None] * [1.0, 1.0]
    log, wrong = bands.log_likelihood(model, flux, sigma, wide)
    good = np.array([0.9, 0.7]) * norm.pdf(flux, model, sigma)
    bad = np.array([0.1, 0.3]) * norm.pdf(flux, model, wide)
    unit = np.log(sigma * np.sqrt(2 * np.pi)).sum()
    assert_allclose(log, np.log(good + bad).sum(axis=1) + unit)
    assert_allclose(wrong, bad / (good + bad), atol=1e-15)
    weight = (1 - wrong) / sigma**2 + wrong / wide**2
    square = np.square(flux - model)
    for at in range(len(model)):
        assert np.all(log - log[at] >= 0.5 * ((square[at] - square) @ weight[at]) - 1e-9)
    limits = {"limit": flux, "limit_sigma": sigma}
    log, wrong = bands.log_likelihood(model, flux, np.full((1, 2), np.inf), wide, **limits)
    good = np.array([0.9, 0.7]) * norm.cdf((flux - model) / sigma)
    assert_allclose(log, np.log(good + [0.1, 0.3]).sum(axis=1), atol=1e-12)
    assert_allclose(wrong, [0.1, 0.3] / (good + [0.1, 0.3]))


def test_shares_of_wrong_limits_are_those_of_the_mixture():
    """A flux and a limit whose errors are far from 1 uJy, over three models of given weights."""
    part = {"acs.f606w": 0.3, "miri.f770w": 0.1}
    bands = BandMixture.of_bands(part, tuple(part))
    sigma = np.array([0.2, 0.05])
    flux, limit = 5.0, 0.4
    model = np.array([[4.5, 0.3], [5.5, 0.45], [6.0, 0.5]])
    weight = np.array([0.5, 0.3, 0.2])
    wide = bands.broad(np.array([[flux, 0.0]]), np.array([[sigma[0], np.inf]]))[0]
    limits = make_limits(np.array([0.0, limit]), np.array([0.0, 1 / sigma[1]]), bands.part)
    target = SimpleNamespace(flux=np.array([flux, 0.0]), weight=np.array([[sigma[0] ** -2, 0.0]]))
    found = bands.shares(model, target, wide, limits, 0, weight)
    good = 0.7 * norm.pdf(flux, model[:, 0], sigma[0])
    bad = 0.3 * norm.pdf(flux, model[:, 0], wide[0])
    below = 0.9 * norm.cdf((limit - model[:, 1]) / sigma[1])
    wanted = weight @ (bad / (good + bad)), weight @ (0.1 / (below + 0.1))
    assert_allclose(found, wanted, rtol=1e-9)


def test_a_band_that_cannot_be_is_found_and_does_no_harm(grid):
    good, _ = draw_photometry(grid, 10, seed=9, noise=0.03)
    bad = good.copy()
    bad["wfc3.f125w"] *= 20.0
    without = good.copy()
    without["wfc3.f125w_err"][:] = np.nan
    fitter = node_fitter(grid, outliers=0.05, model_error=0.02)
    results, left = fitter.fit(bad), fitter.fit(without)
    assert np.all(results.outlier[:, 2] > 0.99)
    assert np.all(np.isnan(left.outlier[:, 2]))
    assert_allclose(results.pdf["redshift"], left.pdf["redshift"], atol=0.05)
    # chi2 is with the stated errors
    chi2 = np.square((results.flux - results.best_flux) / results.sigma).sum(axis=1)
    assert_allclose(results.chi2, chi2, rtol=1e-9)


def test_none_are_wrong_without_prior_fraction(grid, table):
    plain = node_fitter(grid).fit(table)
    for none in (0.0, dict.fromkeys(BANDS, 0.0)):
        results = node_fitter(grid, outliers=none).fit(table)
        assert results.outlier is None
        for name in ("chi2", "log_evidence", "pdf_2d", "moments", "quantiles"):
            assert_array_equal(getattr(results, name), getattr(plain, name))
    results = node_fitter(grid, outliers={"miri.f770w": 0.1}).fit(table)
    assert np.all(np.delete(results.outlier, 4, axis=1) == 0)


def test_columns_and_files(grid, table, tmp_path):
    fitter = node_fitter(grid, outliers=PART)
    results = fitter.fit(table)
    with ThreadPoolExecutor(3) as executor:
        parallel = fitter.fit(table, executor=executor, chunk_size=2)
    assert_array_equal(parallel.outlier, results.outlier)
    assert_array_equal(results.to_table()["miri.f770w_outlier"], results.outlier[:, 4])
    assert "miri.f770w_outlier" not in node_fitter(grid).fit(table).to_table().colnames
    results.write(tmp_path / "fits.fits")
    again = FitResults.read(tmp_path / "fits.fits")
    assert_array_equal(again.outlier, results.outlier)
    assert again.meta["fit"]["outliers"] == dict.fromkeys(BANDS, 0.0) | PART


def test_known_redshifts(grid):
    good, _ = draw_photometry(grid, 6, seed=9, noise=0.03)
    good["miri.f770w"] *= 0.05
    results = node_fitter(grid, outliers=0.05).fit(good, redshift="redshift")
    assert np.all(results.outlier[:, 4] > 0.9)


def test_what_makes_no_sense_is_refused(grid):
    for given, text in ((1.0, "below 1"), (-0.1, "not negative"), ({"band": 0.1}, "keys among")):
        refuses(f"outliers.*{text}", BayesFitter, grid, outliers=given)
    refuses("outliers.*compat", BayesFitter, grid, outliers=0.1, compat="cigale")
    given = {"settings": GridSettings(agn_error=0.3), "compat": "cigale"}
    refuses("agn_error.*compat", BayesFitter, grid, **given)
