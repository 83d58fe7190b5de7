"""Continuous parameters by samplers, against closed forms, integrals and the grid engine."""

import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from importlib.util import find_spec

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from scipy import integrate, optimize, special, stats

from helpers.errors import refuses
from helpers.grids import photometry_table
from helpers.results import assert_same
from miricigale.fitting import (
    BayesFitter,
    FitFlags,
    FitResults,
    SamplerSettings,
    fit_file,
    leave_out,
    samplers,
)
from miricigale.fitting.samplers import Lockstep, space
from miricigale.fitting.samplers.run import best_scale, chi2_at
from miricigale.sed import Parameter, SEDModel
from miricigale.utils.exceptions import CatalogWarning

BANDS = ("b0", "b1", "b2", "b3")
SLOPES = np.array([[1.0, 0.5, 0.0, -0.5], [0.0, 0.4, 0.8, 1.2]])
REAL = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w", "miri.f1500w", "miri.f2100w"]


def installed(name):
    """Parameter of a test that is skipped by name where a sampler is not installed."""
    # it is not imported where all tests are collected
    missing = find_spec(name) is None
    return pytest.param(name, marks=pytest.mark.skipif(missing, reason=f"needs {name}"))


ENGINES = [installed("nautilus"), installed("dynesty")]


@pytest.fixture(params=ENGINES[:1])
def engine(request):
    """The sampler of tests that do not ask for both."""
    return request.param


class Linear:
    """Fluxes mass * (1 + redshift + a v + b w) in uJy."""

    def __init__(self):
        self.parameters = {
            "a": Parameter(default=0.0, bounds=(-10.0, 10.0), doc="First."),
            "b": Parameter(default=0.0, bounds=(-10.0, 10.0), doc="Second."),
            "redshift": Parameter(default=1.0, bounds=(0.0, 20.0), doc="Redshift."),
            "mass": Parameter(default=1.0, bounds=(0.0, 1e16), unit="Msun", doc="Mass."),
        }
        self.meta = {}

    def derived_columns(self):
        return {}

    def fluxes(self, table, filters):
        a, b, z, mass = (np.asarray(table[name]) for name in ("a", "b", "redshift", "mass"))
        flux = 1.0 + z[:, None] + a[:, None] * SLOPES[0] + b[:, None] * SLOPES[1]
        return QTable(dict(zip(BANDS, (mass[:, None] * flux).T * u.uJy, strict=True)))


def photometry(flux, err, ids=None, names=BANDS):
    return photometry_table(names, flux, err, ids)


def model_fluxes(model, **truth):
    """Fluxes of a real model in real bands, in uJy: shape (n, nb)."""
    fluxes = model.fluxes(QTable(truth), REAL)
    return np.transpose([fluxes[name].value for name in REAL])


def linear_fitter(priors, engine="nautilus", **settings):
    settings = SamplerSettings(**{"n_live": 200, "n_effective": 1500} | settings)
    options = {"model_error": 0.0, "n_bands_min": 1, "settings": settings}
    return BayesFitter(Linear(), BANDS, priors=priors, engine=engine, **options)


# ------------------------------------------------------------------------ posteriors


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_linear_model_has_the_posterior_and_evidence_of_the_closed_form(engine):
    sigma = np.array([0.1, 0.2, 0.1, 0.1])
    flux = np.array([2.4, 2.2, 1.9, 1.7])
    fitter = linear_fitter({"a": (-5.0, 5.0), "b": (-5.0, 5.0), "mass": 1.0}, engine)
    results = fitter.fit(photometry(flux, sigma), redshift=[1.0], seed=4)
    design = SLOPES / sigma
    covariance = np.linalg.inv(design @ design.T)
    mean = covariance @ design @ ((flux - 2.0) / sigma)
    chi2 = np.sum(((flux - 2.0 - mean @ SLOPES) / sigma) ** 2)
    norm = -0.5 * chi2 - np.log(sigma).sum() - 2.0 * np.log(2.0 * np.pi)
    log_evidence = norm + 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1] - np.log(100.0)
    n = results.n_effective[0]
    assert results.converged[0]
    for i, name in enumerate("ab"):
        std = np.sqrt(covariance[i, i])
        assert_allclose(results.mean(name)[0], mean[i], atol=4.0 * std / np.sqrt(n))
        assert_allclose(results.std(name)[0], std, rtol=4.0 / np.sqrt(2.0 * n))
        want = stats.norm(mean[i], std).ppf([0.16, 0.5, 0.84])
        assert_allclose(results.percentile(name, [0.16, 0.5, 0.84])[0], want, atol=0.15 * std)
    within = 4.0 * results.log_evidence_err[0] + 0.02
    assert_allclose(results.log_evidence[0], log_evidence, atol=within)
    # the best of some thousand models comes near the minimum
    assert chi2 <= results.chi2[0] < chi2 + 0.1
    drawn = results.samples(0)
    assert_allclose(results[0].samples()["a"], drawn["a"])
    assert results[0].samples("b").colnames == results.samples(0, "b").colnames == ["b"]
    refuses("'key' must be the id of an object", results.samples)
    few = results[0].samples(n_draws=100, seed=3)
    assert_allclose(few["a"].value.mean(), mean[0], atol=0.4 * np.sqrt(covariance[0, 0]))
    assert set(few["a"].value) <= set(drawn["a"].value)
    assert_array_equal(few["a"], results[0].samples(n_draws=100, seed=3)["a"])
    refuses("'n_draws' must be at most", results.samples, 0, n_draws=10**6)
    both = np.cov(drawn["a"].value, drawn["b"].value)
    # 1000 draws of two variables that are correlated by 0.43
    assert_allclose(both, covariance, atol=0.15 * np.sqrt(np.prod(np.diag(covariance))))


def test_joint_posteriors_are_those_of_the_closed_form(engine, tmp_path):
    # two correlated Gaussians; see the test above
    sigma = np.array([0.1, 0.2, 0.1, 0.1])
    flux = np.array([[2.4, 2.2, 1.9, 1.7], [np.nan] * 4])
    priors = {"a": (-1.0, 2.0), "b": (-1.0, 1.0), "mass": 1.0}
    fitter = linear_fitter(priors, engine, n_cells=25, n_live=100, n_effective=600)
    results = fitter.fit(photometry(flux, sigma), redshift=1.0, seed=4, pairs=[("b", "a")])
    weights = results.joint_pdf("a", "b")
    assert weights.shape == (2, 25, 25)
    assert np.isnan(weights[1]).all()
    assert_allclose(weights[0].sum(axis=1), results.pdf["a"][0], atol=1e-12)
    assert_allclose(weights[0].sum(axis=0), results.pdf["b"][0], atol=1e-12)
    covariance = np.linalg.inv((SLOPES / sigma) @ (SLOPES / sigma).T)
    a, b = (results.axes[name].values - results.mean(name)[0].value for name in "ab")
    got = a @ weights[0] @ b
    # 0.43 sigma_a sigma_b, within the error of the sample; cells cost no covariance
    error = np.sqrt(np.prod(np.diag(covariance)) / results.n_effective[0])
    assert_allclose(got, covariance[0, 1], atol=5.0 * error)
    results.write(tmp_path / "r.fits")
    again = FitResults.read(tmp_path / "r.fits")
    assert_array_equal(again.joint_pdf("a", "b"), weights)
    for other, message in (
        ("mass", "'pairs' must be of free parameters but mass .*'mass'"),
        ("redshift", "of parameters with several values, got 'redshift'"),
    ):
        options = {"redshift": 1.0, "seed": 4, "pairs": [("a", other)]}
        refuses(message, fitter.fit, photometry(flux, sigma), **options)
    refuses(r"'levels' must be from 0.001 to 0.999 for 'a'", results.percentile, "a", 1e-5)


@pytest.mark.slow
def test_prior_of_redshift_is_multiplied_in(engine):
    # all bands see 1 + z with one sigma: a Gaussian of width sigma / 2 times p(z)
    table = photometry(np.full((3, 4), 2.0), 0.4)
    nodes = np.linspace(0.0, 4.0, 801)
    pdf = np.array([stats.norm(0.7, 0.1).pdf(nodes), np.ones(801), np.where(nodes > 3, 0.0, 0.0)])
    fitter = linear_fitter({"a": (-1e-9, 1e-9), "mass": 1.0}, engine)
    results = fitter.fit(table, redshift_prior=(nodes, pdf), seed=1)
    weight = 1.0 / 0.2**2 + 1.0 / 0.1**2
    mean, std = (1.0 / 0.2**2 + 0.7 / 0.1**2) / weight, weight**-0.5
    assert_allclose(results.mean("redshift")[0], mean, atol=0.1 * std)
    assert_allclose(results.std("redshift")[0], std, rtol=0.08)
    assert_allclose(results.mean("redshift")[1], 1.0, atol=0.02)
    assert_allclose(results.std("redshift")[1], 0.2, rtol=0.08)
    # nothing allowed
    assert results.flags[2] == FitFlags.NO_MODEL
    assert np.isnan(results.mean("redshift")[2])
    edges, weights = results[0].distribution("redshift")
    assert_allclose(weights.sum(), 1.0)
    inside = (edges.value[1:] > mean - 4 * std) & (edges.value[:-1] < mean + 4 * std)
    assert weights[inside].sum() > 0.99


def test_upper_limits_give_the_posterior_of_the_integral(engine):
    # one band measured, one a limit that cuts into what it allows
    flux = np.array([3.0, np.nan, 2.2, np.nan])
    table = photometry(flux, [1.0, 0.1, 0.3, 0.1])
    table["b2_limit"] = [True]
    fitter = linear_fitter({"redshift": (0.0, 10.0), "mass": 1.0}, engine)
    results = fitter.fit(table, seed=2)

    def density(z):
        limit = 0.5 * (1.0 + special.erf((2.2 - 1.0 - z) / (np.sqrt(2.0) * 0.3)))
        return stats.norm(3.0, 1.0).pdf(1.0 + z) * limit

    moments = [integrate.quad(lambda z, n=n: z**n * density(z), 0, 10)[0] for n in (0, 1, 2)]
    total, mean, square = moments[0], moments[1] / moments[0], moments[2] / moments[0]
    std = np.sqrt(square - mean**2)
    assert_allclose(results.mean("redshift")[0], mean, atol=0.1 * std)
    assert_allclose(results.std("redshift")[0], std, rtol=0.08)
    assert_allclose(results.log_evidence[0], np.log(total / 10.0), atol=0.1)


@pytest.mark.slow
def test_real_model_agrees_with_the_grid_engine(engine):
    limits = ("wfc3.f160w", "miri.f1500w")
    model = SEDModel.yang2021(libraries="bundled")
    ebv, frac = 0.6 * (np.arange(48) + 0.5) / 48, 0.9 * (np.arange(48) + 0.5) / 48
    axes = {"redshift": [1.0], "ebv": ebv, "frac_agn": frac, "tau": [1.0], "age": [2.0]}
    truth = {"redshift": [1.0], "tau": [1.0], "age": [2.0], "ebv": [0.25], "frac_agn": [0.4]}
    flux = model_fluxes(model, **truth, mass=[2e10])
    table = photometry(flux * [1.1, 0.93, 1.04, 1.1, 0.9, 1.05], 0.08 * flux, names=REAL)
    for name in limits:
        table[f"{name}_limit"] = [True]
    grid = BayesFitter(model, REAL, axes=axes).fit(table)
    priors = {"ebv": (0.0, 0.6), "frac_agn": (0.0, 0.9), "tau": 1.0, "age": 2.0}
    options = {"engine": engine, "settings": SamplerSettings(n_live=150)}
    results = BayesFitter(model, REAL, priors=priors, **options).fit(table, redshift=[1.0], seed=3)
    for name in ("ebv", "frac_agn", "frac_agn_ir", "mass", "accretion_power", "dust_luminosity"):
        mean, std = grid.mean(name)[0], grid.std(name)[0]
        # 2000 draws leave an error of 0.022 std
        assert abs(results.mean(name)[0] - mean) < 0.1 * std, name
        assert_allclose(results.std(name)[0], std, rtol=0.08, err_msg=name)
    assert_allclose(results.log_evidence[0], grid.log_evidence[0], atol=0.1)
    assert_allclose(results.model_flux, grid.model_flux, rtol=0.01)
    assert results.chi2[0] <= grid.chi2[0] + 0.1
    assert results.n_limits[0] == grid.n_limits[0] == len(limits)
    assert_allclose(results.mean("redshift")[0], 1.0, rtol=1e-12)
    derived = results[0].best_sed().meta["derived"]
    for name in ("accretion_power", "stellar_mass", "a_v", "frac_agn_ir"):
        best = results.best[name][0].value
        assert_allclose(derived[name].value, best, rtol=1e-6, err_msg=name)


def test_choices_share_the_posterior_by_their_evidence(engine):
    flux, sigma = np.array([2.0, 2.2, 2.4, 2.6]), 0.5
    values, prior = np.array([-1.0, 0.0, 0.5, 3.0]), np.array([0.1, 0.2, 0.3, 0.4])
    priors = {"a": stats.norm(0.0, 0.3), "b": (values, prior), "mass": 1.0}
    results = linear_fitter(priors, engine).fit(photometry(flux, sigma), redshift=1.0, seed=5)
    # with a normal prior of a, fluxes are normal too
    covariance = sigma**2 * np.eye(4) + 0.3**2 * np.outer(SLOPES[0], SLOPES[0])
    law = stats.multivariate_normal(flux, covariance)
    want = prior * law.pdf(2.0 + values[:, None] * SLOPES[1])
    assert_allclose(results.pdf["b"][0], want / want.sum(), atol=0.03)
    assert_allclose(results.log_evidence[0], np.log(want.sum()), atol=0.1)
    assert list(results.axes["b"].values) == list(values)


# -------------------------------------------------------------------------- catalogs


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_workers_order_and_company_change_nothing(engine):
    flux = np.array([[2.4, 2.2, 1.9, 1.5], [2.0, 2.1, 2.3, 2.2]])
    table = photometry(flux, 0.3, ids=["x", "y"])
    fitter = linear_fitter({"a": (-2.0, 2.0), "b": (-2.0, 2.0)}, engine, n_live=60, n_effective=60)
    serial = fitter.fit(table, redshift=1.0, seed=7)
    with ThreadPoolExecutor(2) as pool:
        turned = fitter.fit(table[::-1], redshift=1.0, seed=7, executor=pool)
    other = fitter.fit(table[:1], redshift=1.0, seed=8)
    rows = [serial.row(key) for key in turned.ids]
    assert rows == [1, 0]
    for name in ("draws", "moments", "log_evidence", "model_flux"):
        assert_array_equal(getattr(turned, name), getattr(serial, name)[rows])
    assert other.log_evidence[0] != serial.log_evidence[0]


@pytest.mark.slow
def test_processes_give_the_same_numbers(engine):
    model = SEDModel.yang2021(agn=False, libraries="bundled")
    flux = model_fluxes(model, redshift=[0.5, 1.0], age=[2.0, 3.0])
    table = photometry(flux, 0.3 * flux, names=REAL)
    settings = SamplerSettings(n_live=60, n_effective=60, n_draws=50)
    priors = {"ebv": (0.0, 1.0), "redshift": (0.1, 2.0)}
    fitter = BayesFitter(model, REAL, priors=priors, engine=engine, settings=settings)
    serial = fitter.fit(table, seed=1)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        again = fitter.fit(table, seed=1, executor=pool)
    assert_array_equal(serial.draws, again.draws)
    assert_array_equal(serial.model_flux, again.model_flux)


def test_what_cannot_be_fitted_stays_in_place_and_files_keep_everything(engine, tmp_path):
    flux = np.full((6, 4), 2.0)
    flux[1] = np.nan
    table = photometry(flux, 0.2, ids=["a", "none", "a", "no z", "far", "limits"])
    for name in BANDS:
        table[f"{name}_limit"] = [False] * 5 + [True]
    fitter = linear_fitter({"a": (-5.0, 5.0)}, engine, n_live=60, n_effective=99, n_draws=40)
    with pytest.warns(CatalogWarning, match="an id that occurred before"):
        results = fitter.fit(table, redshift=[1.0, 1.0, 1.0, np.nan, 25.0, 1.0], seed=1)
    assert list(results.fitted) == [True] + [False] * 5
    assert [FitFlags.NO_BAND & f for f in results.flags] == [0, 1, 0, 0, 0, 0]
    names = ("DUPLICATE_ID", "NO_REDSHIFT", "REDSHIFT_OUTSIDE", "ALL_LIMITS")
    assert results.flags[2:].tolist() == [FitFlags[name] for name in names]
    assert results.n_limits.tolist() == [0, 0, 0, 0, 0, 4]
    refuses("an object that was fitted", results.samples, "far")
    out = results.to_table()
    assert len(out) == 6
    assert np.isnan(out["a_mean"][1])
    results.write(tmp_path / "r.fits")
    again = FitResults.read(tmp_path / "r.fits")
    assert_same(again, results)
    assert_array_equal(again.mean("a"), results.mean("a"))
    assert_array_equal(again.percentile("a", [0.3])[:, 0], results.percentile("a", 0.3))
    assert again.samples("a").colnames == ["redshift", "a", "mass"]


def test_models_that_the_universe_has_no_time_for_have_no_weight(engine):
    model = SEDModel.yang2021(agn=False, libraries="bundled")
    flux = model_fluxes(model, redshift=[3.0, 3.0], age=[1.5, 1.5])
    table = photometry(flux, 0.5 * flux, names=REAL)
    settings = SamplerSettings(n_live=80, n_effective=200)
    priors = {"age": (1.0, 10.0)}
    fitter = BayesFitter(model, REAL, priors=priors, engine=engine, settings=settings)
    results = fitter.fit(table, redshift=[3.0, 15.0], seed=1)
    limit = model.cosmology.age(3.0).to_value("Gyr")
    assert results.samples(0)["age"].max().to_value("Gyr") <= limit
    assert results.flags[1] == FitFlags.NO_MODEL


def test_a_run_that_was_stopped_says_so(engine):
    fitter = linear_fitter({"a": (-5.0, 5.0), "b": (-5.0, 5.0)}, engine, max_calls=300)
    results = fitter.fit(photometry([[2.4, 2.2, 1.9, 1.5]], 0.1), redshift=1.0, seed=1)
    assert not results.to_table()["converged"][0]
    assert 300 <= results.n_calls[0] < 500


def test_the_best_model_counts_even_if_the_sampler_left_it_out():
    # a sampler of two points that gives all weight to the worse
    def sample(log_like, n_dim, rng, request):
        _, number = log_like(np.array([[0.5], [0.9]]))
        return samplers.Draws(number[1:], np.zeros(1), 0.0, 0.0, True)

    fitter = linear_fitter({"a": (-5.0, 5.0), "mass": 1.0}, sample)
    results = fitter.fit(photometry([[2.0, 2.0, 2.0, 2.0]], 0.2), redshift=1.0, seed=1)
    assert_allclose(results.chi2, 0.0, atol=1e-12)
    assert_allclose(results.best["a"], 0.0, atol=1e-12)
    assert_allclose(results.mean("a"), 4.0)
    assert_allclose(results.std("a"), 0.0)


# --------------------------------------------------------------------------- the scale


def test_scale_with_limits_is_the_minimum_of_chi2():
    rng = np.random.default_rng(1)
    model = np.exp(rng.normal(0.0, 1.0, (40, 6)))
    flux, sigma = np.exp(rng.normal(1.0, 1.0, 6)), np.array([0.1, 0.3, 0.2, 0.01, 0.5, 0.1])
    limit = np.array([False, True, False, True, False, True])

    def chi2(s, m):
        apart = (flux - s * m) / sigma
        term = special.log_ndtr(apart)
        return np.sum(np.where(limit, -2.0 * term, apart**2))

    scale, variance = best_scale(model, flux, sigma, limit)
    assert_allclose(chi2_at(scale, model, flux, sigma, limit), list(map(chi2, scale, model)))
    bounded = {"bounds": (0.0, 100.0), "method": "bounded", "options": {"xatol": 1e-10}}
    for s, v, m in zip(scale, variance, model, strict=True):
        found = optimize.minimize_scalar(chi2, args=(m,), **bounded)
        assert_allclose(chi2(s, m), found.fun, rtol=1e-9)
        step = 0.02 * np.sqrt(v)
        second = (chi2(s + step, m) - 2.0 * chi2(s, m) + chi2(s - step, m)) / step**2
        assert_allclose(2.0 / second, v, rtol=2e-3)


def test_scale_without_limits_is_the_closed_form_and_not_negative():
    model, sigma = np.array([[1.0, 2.0], [1.0, 0.0], [0.0, 0.0]]), np.array([0.5, 0.25])
    none = np.zeros(2, bool)
    scale, variance = best_scale(model, np.array([3.0, 1.0]), sigma, none)
    assert_allclose(scale, [(12 + 32) / (4 + 64), 3.0, 0.0])
    assert_allclose(variance, [1 / 68, 0.25, 0.0])
    assert best_scale(model, np.array([-3.0, -1.0]), sigma, none)[0].max() == 0.0


# ------------------------------------------------------------------------------ priors

Z = Parameter(default=1.0, bounds=(0.0, 20.0), doc="Redshift.")


@pytest.mark.parametrize(
    "given",
    [(0.5, 4.0), (0.1, 10.0, "log"), stats.norm(1.0, 2.0), stats.gamma(2.0, scale=0.7), "flat"],
)
def test_transform_inverts_the_cumulative_prior(given):
    prior = space.make_prior("redshift", given, Z)
    unit = np.linspace(0.0, 1.0, 101)
    values = prior.transform(unit)
    assert_allclose(prior.cdf(values), unit, atol=1e-10)
    assert values.min() >= 0.0
    nodes, weights, bounds = prior.cells(50)
    assert_allclose(weights.sum(), 1.0)
    assert np.all(np.diff(nodes) > 0)
    assert bounds[0] <= nodes[0] < nodes[-1] <= bounds[1]


def test_a_table_is_linear_between_its_nodes():
    nodes, density = np.array([0.0, 1.0, 2.0, 3.0, 5.0]), np.array([0.0, 2.0, 0.0, 0.0, 1.0])
    table = space.Table(nodes, density).cut(0.25, 4.5)
    unit = np.linspace(0.0, 1.0, 203)
    values = table.transform(unit)
    assert_allclose(table.cdf(values), unit, atol=1e-12)
    whole = integrate.quad(lambda z: np.interp(z, nodes, density), 0.25, 4.5, points=[1, 2, 3])[0]
    for value, at in zip(values[::40], unit[::40], strict=True):
        points = [p for p in (1.0, 2.0, 3.0) if p < value] or None
        part = integrate.quad(lambda z: np.interp(z, nodes, density), 0.25, value, points=points)
        assert_allclose(part[0] / whole, at, atol=1e-7)
    assert not np.any((values > 2.0 + 1e-9) & (values < 3.0))
    assert space.Table(nodes, density).cut(2.0, 3.0) is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((2.0, 1.0), "finite and ascending"),
        ((0.0, 1.0, "log"), "above 0"),
        ((0.0, 30.0), "from 0.0 to 20.0"),
        ("uniform", "'flat', 'log'"),
        ((1.0, 2.0, 3.0), "'flat', 'log'"),
        ([1.0, 1.0], "different values"),
        (([1.0, 2.0], [1.0, -1.0]), ">= 0"),
        (([1.0, 2.0], [1.0]), "a weight for each"),
        (stats.norm(-50.0, 0.1), "with weight from 0.0 to 20.0"),
    ],
)
def test_priors_of_no_use_are_refused(given, message):
    refuses(message, space.make_prior, "redshift", given, Z)


# - refused settings


@pytest.mark.parametrize("name", ["nautilus", "dynesty"])
def test_a_missing_sampler_is_named_with_the_pip_command(name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    text = r"pip install 'miricigale\[samplers\]'"
    refuses(text, linear_fitter, {"a": (0.0, 1.0)}, name, error=ImportError)


def never(log_like, n_dim, rng, request):
    """A sampler that must not be reached."""
    raise AssertionError


def test_unusable_settings_are_refused():
    one, text = {"a": (0.0, 1.0)}, "no engine 'emcee'; known: dynesty, nautilus"
    refuses(text, linear_fitter, one, "emcee", error=KeyError)
    refuses("no parameter 'c'", linear_fitter, {"c": (0.0, 1.0)}, never, error=KeyError)
    refuses("'n_live' must be an integer", linear_fitter, one, never, n_live=0)
    table, fitter = photometry([[1.0, 1.0, 1.0, 1.0]], 0.1), linear_fitter(one, never)
    refuses("'priors' must have 'redshift'", fitter.fit, table)
    both = {"redshift": 1.0, "redshift_prior": (np.ones(2), np.ones(2))}
    refuses("left out where .redshift. is given", fitter.fit, table, **both)
    for prior, text in (
        (([1.0, 0.5], [1.0, 1.0]), r"'redshift_prior\[0\]' must be >= 0 and ascending"),
        (([0.0, 0.5], [1.0, 1.0, 1.0]), r"shapes \(2,\) and \(3,\)"),
    ):
        refuses(text, fitter.fit, table, redshift_prior=prior)
    fixed = linear_fitter({"a": 1.0}, never)
    refuses("with a free parameter", fixed.fit, table, redshift=1.0)
    # a range of what the library has as a list
    model = SEDModel.yang2021(agn=False, libraries="bundled")
    options = {"priors": {"metallicity": (0.001, 0.04), "ebv": (0.0, 1.0)}, "engine": never}
    refuses(r"priors.*'metallicity'.*must be one of", BayesFitter, model, REAL, **options)


def test_lockstep_answers_every_task_with_its_own_value():
    batches = []

    def log_like(points):
        batches.append(len(points))
        return points.sum(axis=1), np.arange(len(points))

    lockstep = Lockstep(log_like, 8)

    def task(item):
        # tasks of different lengths
        return [lockstep.evaluate(np.array([item, step]))[0] for step in range(1 + item % 5)]

    got = lockstep.map(task, range(20))
    assert got == [[float(i + s) for s in range(1 + i % 5)] for i in range(20)]
    assert max(batches) == 8

    def broken(points):
        msg = "no such model"
        raise RuntimeError(msg)

    failing = Lockstep(broken, 4)
    with pytest.raises(RuntimeError, match="no such model"):
        failing.map(lambda item: failing.evaluate(np.array([item])), range(4))


@pytest.mark.slow
def test_fits_from_file_to_file_and_without_a_band(engine, tmp_path):
    priors = {"redshift": (0.5, 1.5), "a": (-0.5, 0.5)}
    fitter = linear_fitter(priors, engine, n_live=60, n_effective=60)
    model = 2.0 + 0.2 * SLOPES[0]
    table = photometry(np.array([5.0, 8.0, 3.0])[:, None] * model, 0.1)
    whole = fitter.fit(table, seed=3)
    table.write(tmp_path / "cat.fits")
    arguments = (fitter, tmp_path / "cat.fits", tmp_path / "out")
    refuses("'seed' must be given for a sampler", fit_file, *arguments)
    results = fit_file(*arguments, chunk_rows=2, seed=3)
    assert results.n_parts == 2
    joined = FitResults.concatenate(results.parts())
    for name in ("chi2", "log_evidence", "draws", "axis_quantiles", "model_flux"):
        assert_array_equal(getattr(joined, name), getattr(whole, name), err_msg=name)
    # nothing is left to do, and another seed is another fit
    assert len(fit_file(*arguments, chunk_rows=2, seed=3)) == 3
    refuses("results of another fit: seed differ", fit_file, *arguments, chunk_rows=2, seed=4)
    left = leave_out(fitter, table, ["b3"], seed=3)
    assert_allclose(left.predicted[:, 0], table["b3"].value, rtol=0.1)
