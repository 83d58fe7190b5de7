"""Fits to fluxes of nuclei beside total fluxes, against joint Gaussian likelihoods of all models."""

from dataclasses import replace
from functools import partial

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from helpers import grids
from helpers.errors import refuses
from miricigale.fitting import BayesFitter, FitFlags, GridSettings, compare_classes
from miricigale.fitting.grid.nuclei import _cholesky
from miricigale.fitting.posterior.posterior import randomized_ranks
from miricigale.fitting.results.pulls import without_warnings
from miricigale.utils.exceptions import FitWarning

N = 5
#: Correlation of the nucleus with the total, by band.
CORRELATION = {"band1": 0.5, "band3": -0.7, "band5": 0.0}
NAMES = tuple(CORRELATION)
#: Mixtures of good and wrong fluxes need bands of known wavelengths.
REAL_BANDS = ("acs.f606w", "acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w", "miri.f1500w")


@pytest.fixture(scope="module")
def catalog(grid):
    """Totals, nuclei and their correlated errors, of AGN fractions 0 to 0.9; all in uJy."""
    rng = np.random.default_rng(3)
    places = [grid.filters.index(name) for name in NAMES]
    table, truth = grids.draw_photometry(grid, N, seed=4)
    for name, place in zip(NAMES, places, strict=True):
        point = np.empty(N)
        for i, (z, g, k, f, scale) in enumerate(truth):
            frac = grid.frac_agn[f]
            power = scale * grid.dust_luminosity[g] * frac / (1.0 - frac)
            point[i] = power * grid.agn[z, k, place]
        error = 2.0 * table[f"{name}_err"].value
        table[f"{name}_flux_point"] = (point + error * rng.normal(size=N)) * u.uJy
        table[f"{name}_flux_point_err"] = error * u.uJy
        table[f"{name}_flux_point_corr"] = np.full(N, CORRELATION[name])
    return table


def without(table, *names):
    """The catalog without nuclei in some bands."""
    columns = [f"{name}_flux_point{end}" for name in names for end in ("", "_err", "_corr")]
    out = table.copy()
    out.remove_columns(columns)
    return out


def data_of(table, row, bands, names, stars):
    """Totals and then nuclei of an object, and their covariance."""
    flux = [table[name][row].value for name in bands]
    point = np.array([table[f"{name}_flux_point"][row].value for name in names])
    sigma = np.array([table[f"{name}_err"][row].value for name in bands])
    error = [table[f"{name}_flux_point_err"][row].value for name in names]
    covariance = np.diag(np.square([*sigma, *error]))
    n = len(bands)
    for j, name in enumerate(names):
        i = bands.index(name)
        covariance[n + j, i] = CORRELATION[name] * error[j] * sigma[i]
        covariance[i, n + j] = covariance[n + j, i]
    total = np.array([table[name][row].value for name in names])
    host = np.clip(total - point, 0.0, np.maximum(total, 0.0))
    covariance[n:, n:] += stars**2 * np.outer(host, host)
    return np.array([*flux, *point]), covariance


def best_chi2(data, covariance, model):
    """Chi2 of models (..., nd) at their best scales, which are not negative."""
    inverse = np.linalg.inv(covariance)
    cross = model @ inverse @ data
    norm = np.einsum("...i,ij,...j", model, inverse, model)
    return data @ inverse @ data - np.square(np.maximum(cross, 0.0)) / norm


def on_nodes(fitter, data, covariance, names):
    """Posterior of redshift and AGN fraction, best chi2 and ln of the evidence by all models."""
    grid = fitter.grid
    priors = fitter.priors
    places = [grid.filters.index(name) for name in names]
    ratio = grid.frac_agn / (1.0 - grid.frac_agn)
    power = grid.dust_luminosity[:, None, None] * ratio
    light = power[None, ..., None] * grid.agn[:, None, :, None, :]
    total = grid.galaxy[:, :, None, None, :] + light
    chi2 = best_chi2(data, covariance, np.concatenate([total, light[..., places]], axis=-1))
    prior = priors.redshift[:, None] * grid.allowed * priors.galaxy / priors.galaxy.sum()
    prior = prior[:, :, None] * priors.agn / priors.agn.sum()
    prior = prior[..., None] * priors.frac / priors.frac.sum()
    weight = prior * np.exp(-0.5 * chi2)
    log_evidence = np.log(weight.sum()) - 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
    posterior = weight.sum(axis=(1, 2)) / weight.sum()
    return posterior, chi2[prior > 0].min(), log_evidence


CASES = [(("band1",), 0.0), (("band1",), 0.3), (NAMES, 0.0), (("band3", "band5"), 0.2)]


@pytest.mark.parametrize(("names", "stars"), CASES)
def test_posterior_is_that_of_correlated_data(grid, catalog, names, stars):
    table = without(catalog, *(set(NAMES) - set(names)))
    # only one of two bands is correlated with its total, so that nothing is left out
    settings = GridSettings(interpolate=0, nuclear_stars=stars)
    if len(names) == 2:
        table["band3_flux_point_corr"] = 0.0
    fitter = BayesFitter(grid, model_error=0.0, nuclei=True, settings=settings)
    results = fitter.fit(table)
    assert results.meta["fit"]["nuclei"] == list(names)
    bands = list(grid.filters)
    for i in range(N):
        data, covariance = data_of(table, i, bands, names, stars)
        if len(names) == 2:
            n = len(bands) + names.index("band3")
            covariance[n, : len(bands)] = covariance[: len(bands), n] = 0.0
        posterior, chi2, log_evidence = on_nodes(fitter, data, covariance, names)
        assert_allclose(results.pdf_2d[i], posterior, atol=1e-6)
        assert_allclose(results.chi2[i], chi2, rtol=1e-8)
        assert_allclose(results.log_evidence[i], log_evidence, rtol=1e-6)
        assert results.n_bands[i] == len(bands) + len(names)


def test_likelihoods_between_nodes_are_those_of_correlated_data(grid, catalog, monkeypatch):
    names = ("band1", "band3")
    settings = GridSettings(interpolate=50, nuclear_stars=0.0)
    fitter = BayesFitter(grid, model_error=0.0, nuclei=True, settings=settings)
    between = fitter.backend.between
    describe = type(between)._describe
    kept = []

    def keep(self, models, *args):
        posterior = describe(self, models, *args)
        kept.append((models, posterior.values))
        return posterior

    monkeypatch.setattr(type(between), "_describe", keep)
    results = fitter.fit(without(catalog, "band5")[:2])
    bands = list(grid.filters)
    places = [bands.index(name) for name in names]
    for i, (sampled, values) in enumerate(kept):
        flux, power = between.models.fluxes(values, values["redshift"], values["frac_agn"])
        agn = between.models.agn_fluxes(values, values["redshift"])
        agn = np.where(power[:, None] > 0.0, power[:, None] * agn, 0.0)
        data, covariance = data_of(catalog, i, bands, names, 0.0)
        chi2 = best_chi2(data, covariance, np.concatenate([flux, agn[:, places]], axis=1))
        constant = sampled.log_likelihood + 0.5 * chi2
        assert_allclose(constant, constant[0], atol=1e-6)
        assert_allclose(results.chi2[i], chi2.min(), rtol=1e-6)
        # of fluxes in uJy: the mean likelihood of the models over the prior
        log_evidence = sampled.log_evidence - constant[0]
        log_evidence -= 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
        assert_allclose(results.log_evidence[i], log_evidence, rtol=1e-6)


def draw_from_prior(fitter, n, stars, rng):
    """Photometry with points of models drawn from the prior of a fitter, and the places of their AGN fractions."""
    grid = fitter.grid
    priors = fitter.priors
    weight = priors.redshift[:, None] * grid.allowed * priors.galaxy
    place = rng.choice(weight.size, n, p=weight.ravel() / weight.sum())
    z, galaxy = np.unravel_index(place, weight.shape)
    model = rng.choice(grid.n_agn, n, p=priors.agn / priors.agn.sum())
    fraction = rng.choice(grid.frac_agn.size, n, p=priors.frac / priors.frac.sum())
    ratio = (grid.frac_agn / (1.0 - grid.frac_agn))[fraction]
    light = (grid.dust_luminosity[galaxy] * ratio)[:, None] * grid.agn[z, model]
    host = grid.galaxy[z, galaxy]
    scale = 10.0 ** rng.uniform(10.0, 11.0, n)[:, None]
    flux = scale * (host + light)
    noise = rng.standard_normal(flux.shape)
    table = grids.photometry_table(grid.filters, flux + noise, 1.0)
    share = stars * rng.standard_normal(n)
    for name, correlation in CORRELATION.items():
        j = grid.filters.index(name)
        own = np.sqrt(1.0 - correlation**2) * rng.standard_normal(n)
        point = scale[:, 0] * (light[:, j] + share * host[:, j])
        point += 2.0 * (correlation * noise[:, j] + own)
        table[f"{name}_flux_point"] = point * u.uJy
        table[f"{name}_flux_point_err"] = np.full(n, 2.0) * u.uJy
        table[f"{name}_flux_point_corr"] = np.full(n, correlation)
    return table, fraction


@pytest.mark.parametrize("stars", [0.0, 0.2])
def test_intervals_hold_truths_drawn_from_the_prior(grid, stars):
    settings = GridSettings(interpolate=0, nuclear_stars=stars)
    fitter = BayesFitter(grid, model_error=0.0, nuclei=True, settings=settings)
    rng = np.random.default_rng(8)
    table, fraction = draw_from_prior(fitter, 400, stars, rng)
    results = fitter.fit(table)
    ranks = randomized_ranks(results.pdf["frac_agn"], fraction, rng.random(400))
    # 68 and 95 %, with binomial errors of 2.3 and 1.1 %
    assert np.mean(np.abs(ranks - 0.5) < 0.34) == pytest.approx(0.68, abs=0.06)
    assert np.mean(np.abs(ranks - 0.5) < 0.475) == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize("interpolate", [0, 300])
def test_without_nuclei_nothing_changes(grid, catalog, interpolate):
    settings = GridSettings(interpolate=interpolate)
    fitter = BayesFitter(grid, nuclei=True, settings=settings)
    table = catalog.copy()
    for name in NAMES:
        table[f"{name}_flux_point"][:] = np.nan
        table[f"{name}_flux_point_err"][:] = np.nan
    plain = fitter.replace(nuclei=False).fit(without(catalog, *NAMES))
    results = fitter.fit(table)
    for name in ("flags", "chi2", "log_evidence", "pdf_2d", "moments", "model_flux", "n_bands"):
        assert_array_equal(getattr(results, name), getattr(plain, name))
    # a nucleus of which next to nothing is known, in one object
    table["band5_flux_point"][1], table["band5_flux_point_err"][1] = 1.0 * u.uJy, 1e9 * u.uJy
    results = fitter.fit(table)
    assert_array_equal(results.chi2[2:], plain.chi2[2:])
    if interpolate:
        # enough draws for the two to be compared: they begin in other places
        settings = GridSettings(interpolate=1000)
        fitter = fitter.replace(settings=settings)
        results = fitter.fit(table[:2])
        plain = fitter.replace(nuclei=False).fit(without(catalog, *NAMES)[:2])
    assert_allclose(results.pdf_2d[1], plain.pdf_2d[1], atol=1e-5 if interpolate == 0 else 0.1)


def test_bands_that_cannot_be_wrong_change_nothing(grid, catalog):
    """Also of nuclei: a prior fraction of next to nothing is none."""
    bands = dict(zip(grid.filters, REAL_BANDS, strict=True))
    table = catalog.copy()
    for name in catalog.colnames:
        band = name.partition("_")[0]
        if band in bands:
            table.rename_column(name, name.replace(band, bands[band]))
    settings = GridSettings(interpolate=0)
    fitter = BayesFitter(replace(grid, filters=REAL_BANDS), nuclei=True, settings=settings)
    results = fitter.fit(table)
    mixed = fitter.replace(outliers=1e-12).fit(table)
    assert_allclose(mixed.pdf_2d, results.pdf_2d, atol=1e-3)
    assert_allclose(mixed.chi2, results.chi2, rtol=1e-6)


def test_redshifts_may_be_known(grid, catalog):
    fitter = BayesFitter(grid, nuclei=True, settings=GridSettings(interpolate=30))
    results = fitter.fit(catalog[:2], redshift="redshift")
    assert_allclose(results.best["redshift"], catalog["redshift"][:2])
    assert np.all(results.flags & FitFlags.UNFITTED == 0)


def test_points_tell_agn_from_galaxies(grid, catalog):
    fitter = BayesFitter(grid, nuclei=True, settings=GridSettings(interpolate=0))
    table = catalog.copy()
    for name in NAMES:
        table[f"{name}_flux_point"] = 0.9 * table[name]
        table[f"{name}_flux_point_err"] = 0.05 * table[name]
    bright = fitter.fit(table).mean("frac_agn")
    for name in NAMES:
        table[f"{name}_flux_point"] = 0.0 * table[name]
    faint = fitter.fit(table).mean("frac_agn")
    # limits say the same
    for name in NAMES:
        table[f"{name}_flux_point"] = 0.01 * table[name]
        table[f"{name}_flux_point_err"] = 0.005 * table[name]
        table[f"{name}_flux_point_limit"] = True
    limited = fitter.fit(table).mean("frac_agn")
    assert np.all(faint < 0.5 * bright)
    assert np.all(limited < 0.5 * bright)


@pytest.fixture(scope="module")
def points():
    """Models without AGN, as of stars, in bands of known wavelengths."""
    return replace(grids.make_grid(seed=7, frac=[0.0]), filters=REAL_BANDS)


def table_of_points(grid, n, rng, part, *, factor=20.0):
    """Models of a grid, of whose light the points have a part, (n,), with errors of 1 uJy."""
    weight = grid.allowed / grid.allowed.sum()
    place = rng.choice(weight.size, n, p=weight.ravel())
    z, galaxy = np.unravel_index(place, weight.shape)
    flux = grid.galaxy[z, galaxy]
    flux = factor * flux / np.median(flux, axis=1, keepdims=True)
    noise = rng.standard_normal(flux.shape)
    table = grids.photometry_table(grid.filters, flux + noise, 1.0)
    for band, correlation in zip(grid.filters[::2], CORRELATION.values(), strict=True):
        j = grid.filters.index(band)
        own = np.sqrt(1.0 - correlation**2) * rng.standard_normal(n)
        light = part * flux[:, j] + 2.0 * (correlation * noise[:, j] + own)
        table[f"{band}_nucleus"] = light * u.uJy
        table[f"{band}_nucleus_err"] = np.full(n, 2.0) * u.uJy
        table[f"{band}_nucleus_corr"] = np.full(n, correlation)
    return table


def test_posterior_of_points_alone_is_that_of_correlated_data(points):
    """All of the light is in the point: totals and points are the same model twice."""
    settings = GridSettings(interpolate=0)
    fitter = BayesFitter(points, model_error=0.0, nuclei="whole", settings=settings)
    table = table_of_points(points, N, np.random.default_rng(2), np.ones(N))
    results = fitter.fit(table)
    names = list(REAL_BANDS[::2])
    assert results.meta["fit"]["nuclei"] == names
    places = [REAL_BANDS.index(name) for name in names]
    model = np.concatenate([points.galaxy, points.galaxy[..., places]], axis=-1)
    priors = fitter.priors
    prior = priors.redshift[:, None] * points.allowed * priors.galaxy / priors.galaxy.sum()
    n = len(REAL_BANDS)
    covariance = np.diag([1.0] * n + [4.0] * len(names))
    for j, correlation in enumerate(CORRELATION.values()):
        covariance[n + j, places[j]] = covariance[places[j], n + j] = 2.0 * correlation
    for i in range(N):
        columns = [*REAL_BANDS, *(f"{name}_nucleus" for name in names)]
        data = np.array([table[name][i].value for name in columns])
        chi2 = best_chi2(data, covariance, model)
        weight = prior * np.exp(-0.5 * chi2)
        constant = 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
        assert_allclose(results.pdf["redshift"][i], weight.sum(axis=1) / weight.sum(), atol=1e-6)
        assert_allclose(results.chi2[i], chi2[prior > 0].min(), rtol=1e-8)
        assert_allclose(results.log_evidence[i], np.log(weight.sum()) - constant, rtol=1e-6)
        assert results.n_bands[i] == n + len(names)
        # what was measured is kept
        assert_allclose(results.flux[i], data[:n])
        assert_allclose(results.sigma[i], 1.0)


@pytest.mark.parametrize("outliers", [None, 0.02])
def test_classes_are_as_probable_as_they_say(points, outliers):
    """Half of the sources are points, the others galaxies without AGN of the same colors."""
    n = 600
    rng = np.random.default_rng(4)
    is_point = rng.permutation(n) < n // 2
    # faint, so that points are told from galaxies in part
    table = table_of_points(points, n, rng, np.where(is_point, 1.0, 0.0), factor=2.0)
    grid = replace(grids.make_grid(seed=7, frac=[0.0, 0.5]), filters=REAL_BANDS)
    settings = GridSettings(interpolate=0, nuclear_stars=0.0)
    options = {"model_error": 0.0, "settings": settings, "outliers": outliers}
    priors = {"frac_agn": [1.0, 0.0]}
    # many are too faint for any scale
    with without_warnings():
        galaxies = BayesFitter(grid, nuclei=True, priors=priors, **options).fit(table)
        stars = BayesFitter(points, nuclei="whole", **options).fit(table)
    probability = compare_classes({"galaxy": galaxies, "star": stars})["probability_star"]
    # the sum of probabilities is the number of points, of all sources and of doubtful ones
    for low, high in ((0.0, 1.0), (0.1, 0.5), (0.5, 0.9)):
        chosen = (probability >= low) & (probability <= high)
        p = probability[chosen]
        error = np.sqrt(np.sum(p * (1.0 - p)))
        assert chosen.sum() > 50
        assert abs(p.sum() - is_point[chosen].sum()) < 2.5 * error


def test_limits_beside_points_alone(points):
    settings = GridSettings(interpolate=0)
    fitter = BayesFitter(points, model_error=0.0, nuclei="whole", settings=settings)
    table = table_of_points(points, 4, np.random.default_rng(2), np.ones(4))
    band = REAL_BANDS[0]
    for name in (band, f"{band}_nucleus"):
        table[f"{name}_limit"] = np.zeros(4, bool)
    # far limits say nothing: a flux of the total or the point alone, or neither
    for name, rows in ((band, (1, 3)), (f"{band}_nucleus", (2, 3))):
        for row in rows:
            table[name][row] = 1e4 * u.uJy
            table[f"{name}_limit"][row] = True
    results = fitter.fit(table)
    other = table.copy()
    other[band][1] = table[f"{band}_nucleus"][1]
    other[f"{band}_err"][1] = table[f"{band}_nucleus_err"][1]
    other[band][3] = np.nan * u.uJy
    other[f"{band}_limit"] = False
    other[f"{band}_nucleus"][1:] = np.nan * u.uJy
    other[f"{band}_nucleus_err"][1:] = np.nan * u.uJy
    other[f"{band}_nucleus_limit"] = False
    expected = fitter.fit(other)
    assert_allclose(results.pdf_2d, expected.pdf_2d, atol=1e-6)
    assert_allclose(results.log_evidence, expected.log_evidence, rtol=1e-6)
    assert np.all(results.limit[:, 0] == [False, True, False, True])
    # a limit that lies one error below the point has the probability of that
    table[band][1] = table[f"{band}_nucleus"][1] - np.hypot(1.0, 2.0) * u.uJy
    lower = fitter.fit(table).log_evidence[1] - results.log_evidence[1]
    assert lower == pytest.approx(norm.logcdf(-1.0), abs=1e-6)


def test_unusable_fluxes_are_flagged(grid, catalog):
    fitter = BayesFitter(grid, nuclei=True, settings=GridSettings(interpolate=0))
    table = catalog.copy()
    table["band1_flux_point_err"][0] = 0.0 * u.uJy
    table["band3_flux_point_corr"][1] = 1.0
    table["band5"][2] = np.nan * u.uJy
    flags = fitter.fit(table).flags & FitFlags.NUCLEUS_LEFT_OUT
    assert_array_equal(flags > 0, [True, True, True, False, False])


def test_covariance_of_points_is_that_of_their_sum():
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.5, 2.0, 4)
    light = rng.uniform(0.0, 5.0, 4)
    lower = _cholesky(sigma, light)
    expected = np.linalg.cholesky(np.diag(sigma**2) + np.outer(light, light))
    assert_allclose(lower, expected, rtol=1e-12)
    # with errors of next to nothing, two points whose host's light is the same differ by their errors
    inverse = np.linalg.inv(_cholesky(np.full(2, 1e-10), np.ones(2)))
    apart = inverse @ [1e-10, -1e-10]
    assert_allclose(apart @ apart, 2.0, rtol=1e-6)


def test_correlations_have_no_unit_but_percent(grid, catalog):
    fitter = BayesFitter(grid, nuclei=True, settings=GridSettings(interpolate=0))
    table = catalog[:2]
    table["band3_flux_point_corr"] = 100.0 * table["band3_flux_point_corr"] * u.percent
    results = fitter.fit(table)
    assert np.all(results.flags & FitFlags.NUCLEUS_LEFT_OUT == 0)
    assert_allclose(results.chi2, fitter.fit(catalog[:2]).chi2)
    table["band3_flux_point_corr"] = [0.1, 0.1] * u.uJy**2
    match = "column 'band3_flux_point_corr' must be a number without a unit"
    refuses(match, fitter.fit, table, error=u.UnitsError)


def test_points_of_bands_without_totals_are_told(grid, catalog):
    table = catalog[:2]
    table.remove_columns(["band5", "band5_err"])
    fitter = BayesFitter(grid, nuclei=True, settings=GridSettings(interpolate=0))
    with pytest.warns(FitWarning, match="no total flux are not fitted: band5_flux_point"):
        results = fitter.fit(table)
    assert results.meta["fit"]["nuclei"] == ["band1", "band3"]


def test_refuses(grid, catalog):
    make = partial(BayesFitter, grid, settings=GridSettings(interpolate=0))
    refuses("'nuclei' must be True or False", make, nuclei="yes")
    fitter = make(nuclei=True)
    refuses("<filter>_flux_point_err for 'nuclei'", fitter.fit, without(catalog, *NAMES))
    table = catalog.copy()
    table.remove_column("band3_flux_point_err")
    refuses("the errors 'band3_flux_point_err' of 'band3_flux_point'", fitter.fit, table)
    refuses("draws are without nuclei", fitter.sample, catalog, 10, seed=1)
    table = catalog.copy()
    table["band1_nucleus"] = table["band1"]
    table["band1_nucleus_err"] = table["band1_err"]
    refuses("one flux of nuclei in 'band1'", fitter.fit, table)
    with pytest.warns(FitWarning, match="fluxes of nuclei are not fitted"):
        make().fit(catalog)
    galaxies = grids.make_grid(frac=[0.0])
    fitter = BayesFitter(galaxies, nuclei=True, settings=GridSettings(interpolate=0))
    refuses("False for models without AGN", fitter.fit, catalog)
    fits = {"galaxy": make(nuclei=True).fit(catalog)}
    with pytest.warns(FitWarning, match="fluxes of nuclei are not fitted"):
        fits["star"] = make().fit(catalog)
    refuses("'star' of the same data as 'galaxy', got fluxes of nuclei", compare_classes, fits)
