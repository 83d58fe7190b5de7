"""Errors of models by rest wavelength, and what residuals at known redshifts say of them and of zero points."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.grids import draw_photometry, make_grid, node_fitter, photometry_table
from miricigale import ErrorModel, SEDModel
from miricigale.filters import FilterSet
from miricigale.fitting import (
    BayesFitter,
    GridSettings,
    TemplateError,
    apply_zero_points,
    calibrate_zero_points,
    leave_out,
    magnitude_prior,
    measure_band_errors,
    measure_priors,
    measure_template_error,
)
from miricigale.fitting.survey.band_errors import BandErrorPrior

BANDS = ("acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "miri.f770w", "miri.f1500w")
#: A prior that says next to nothing of the errors.
WIDE_PRIOR = BandErrorPrior(1.0, 3.0, 0.05, 3.0, 0.0, 1.0, 19.0)
PIVOTS = np.array([one.pivot.to_value(u.um) for one in FilterSet.from_names(BANDS)])


@pytest.fixture(scope="module")
def grid():
    return replace(make_grid(7, n_z=5, n_tau=3, n_age=3), filters=BANDS)


def test_posterior_is_the_sum_over_models_with_the_errors_of_their_redshifts(grid):
    """With 1 / sigma of every band in the likelihood, which is that of normal deviates."""
    error = TemplateError([0.1, 0.3, 1.0, 3.0, 10.0] * u.um, [0.5, 0.1, 0.02, 0.3, 1.0])
    table, _ = draw_photometry(grid, 6, seed=3, noise=0.3)
    options = {"model_error": 0.0, "settings": GridSettings(rtol=0.0)}
    results = node_fitter(grid, template_error=error, **options).fit(table)
    index = np.meshgrid(*(np.arange(n) for n in (5, 9, grid.n_agn, 4)), indexing="ij")
    model = grid.flux(*index)
    rest = PIVOTS / (1 + grid.redshift[:, None])
    part = np.interp(np.log(rest), np.log(error.wave.value), error.error)
    count = np.where(grid.allowed[:, :, None, None], grid.agn_multiplicity[:, None], 0)
    for i in range(6):
        flux, own = results.flux[i], results.flux_err[i]
        sigma = np.hypot(own, part * flux)[:, None, None, None]
        scale = np.maximum(np.sum(model * flux / sigma**2, -1), 0)
        scale /= np.sum((model / sigma) ** 2, -1)
        chi2 = np.sum(((flux - scale[..., None] * model) / sigma) ** 2, -1)
        log_like = -0.5 * chi2 - np.log(sigma).sum(-1)
        weight = count * np.exp(log_like - log_like.max())
        assert_allclose(results.pdf_2d[i], weight.sum((1, 2)) / weight.sum(), rtol=1e-5, atol=1e-12)
        best = np.unravel_index(np.argmax(np.where(count > 0, log_like, -np.inf)), chi2.shape)
        assert results.chi2[i] == pytest.approx(chi2[best], rel=1e-9)
        assert results.best_index[i][0] == best[0]
        assert_allclose(results.sigma[i], sigma[best[0], 0, 0, 0])
        # the prior counts the models that the age of the universe excludes
        every = 5 * 9 * 4 * grid.agn_multiplicity.sum()
        total = np.log(weight.sum() / every) + log_like.max() - 3 * np.log(2 * np.pi)
        assert results.log_evidence[i] == pytest.approx(total, abs=1e-3)


@pytest.fixture(scope="module")
def residuals():
    """One galaxy at three redshifts, whose fluxes scatter by 30 % beyond 2 um at rest and 5 % below."""
    grid = replace(make_grid(5, n_z=3, n_tau=1, n_age=1, frac=[0.0]), filters=BANDS)
    rng = np.random.default_rng(2)
    z = rng.integers(3, size=900)
    rest = PIVOTS / (1 + grid.redshift[z][:, None])
    part = np.where(rest > 2.0, 0.3, 0.05)
    model = 1e10 * grid.galaxy[z, 0]
    flux = model * (1 + part * rng.normal(size=model.shape))
    err = 0.02 * model
    flux += err * rng.normal(size=model.shape)
    return grid, photometry_table(BANDS, flux, err), grid.redshift[z]


def test_errors_of_models_and_of_bands_are_each_counted_once():
    """One band has errors of its own, and is alone to see rest wavelengths of 1.1 to 1.4 um."""
    grid = replace(make_grid(5, n_z=2, n_tau=1, n_age=1, frac=[0.0]), filters=BANDS)
    rng, n = np.random.default_rng(8), 1500
    z = rng.integers(2, size=n)
    rest = PIVOTS / (1 + grid.redshift[z][:, None])
    band = np.array(BANDS) == "wfc3.f160w"
    models, own = np.where(rest < 0.75, 0.04, 0.12), np.where(band, 0.08, 0.0)
    model = 1e10 * grid.galaxy[z, 0]
    err = np.where(band, rng.choice([0.001, 0.06], (n, 1)), 0.01) * model
    # errors are parts of the flux as measured: (flux - model)^2 = x^2 variance(flux) of a normal deviate x
    x = rng.normal(size=model.shape)
    a = 1 - x**2 * (models**2 + own**2)
    b = model**2 - np.square(x * np.where(band, 3.0, 1.0) * err)
    flux = (model + np.sign(x) * np.sqrt(model**2 - a * b)) / a
    table = photometry_table(BANDS, flux, err)
    known = {"redshift": grid.redshift[z]}
    error = TemplateError([1.0] * u.um, [0.1])
    for _ in range(6):
        fitter = node_fitter(grid, model_error=0.0, template_error=error)
        left = leave_out(fitter, table, ["wfc3.f160w"], **known)
        factor, part = measure_band_errors(left, error, longest=0.75 * u.um, prior=WIDE_PRIOR)
        right, parts = QTable(table, copy=True), {"wfc3.f160w": part}
        right["wfc3.f160w_err"] *= factor
        fit = node_fitter(grid, model_error=parts, template_error=error).fit(right, **known)
        edges = [0.15, 0.3, 0.6, 0.75, 1.1, 1.4, 20.0] * u.um
        error = measure_template_error(fit, model_error=parts, edges=edges)
    # some 5 and 4 % of the values are their own errors
    assert_allclose([factor, part], [3.0, 0.08], rtol=0.15)
    assert_allclose(error.error, [0.04, 0.04, 0.04, 0.12, 0.12, 0.12], rtol=0.12)
    # five degrees of freedom an object, each with a variance of 2
    assert fit.chi2.sum() / (5 * n) == pytest.approx(1.0, abs=5 * np.sqrt(2 / (5 * n)))
    text, other = "'model_error' must be a dict with keys among", {"nircam.f444w": 0.1}
    refuses(text, measure_template_error, fit, model_error=other)


def test_zero_points_multiply_fluxes_and_errors_once_more_each_time():
    table = QTable({"id": [1], "miri.f770w": [2.0] * u.uJy, "miri.f770w_err": [0.1] * u.uJy})
    points = QTable({"band": ["miri.f770w"], "factor": [1.25]})
    twice = apply_zero_points(apply_zero_points(table, points), points)
    assert_allclose(twice["miri.f770w"].value, [2.0 * 1.25**2])
    assert_allclose(twice["miri.f770w_err"].value, [0.1 * 1.25**2])
    assert_allclose(twice.meta["zero_points"]["miri.f770w"], 1.25**2)
    assert table["miri.f770w"].value == [2.0]


@pytest.mark.parametrize("interpolate", [0, 600])
def test_errors_of_zero_points_know_what_models_take_up(interpolate):
    """Factors of photometry without any are 1 within their errors, though models follow the fluxes."""
    bands = ["acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1", "irac.ch2", "miri.f770w"]
    model = SEDModel.yang2021(agn=False)
    n = 40
    truth = {"redshift": np.full(n, 0.5), "age": np.linspace(1, 5, n), "mass": np.full(n, 1e10)}
    errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0), fractional=0.05)
    axes = {"redshift": [0.5], "age": [1.0, 2.0, 3.0, 4.0, 5.0], "ebv": [0.1, 0.3, 0.5]}
    settings = GridSettings(interpolate=interpolate)
    fitter = BayesFitter(model, bands, axes=axes, model_error=0.0, settings=settings)
    pulls = []
    for seed in range(3):
        photometry = errors.perturb(model.fluxes(truth, bands), seed=seed)
        points = calibrate_zero_points(fitter.fit(photometry, redshift=np.full(n, 0.5)))
        pulls.append(np.log(points["factor"]) / points["factor_err"])
    assert np.sqrt(np.mean(np.square(pulls))) < 1.3
    assert np.abs(pulls).max() < 3


def test_zero_points_are_found_and_applied(residuals):
    grid, table, z = residuals
    factors = dict(zip(BANDS, (1.0, 1.0, 1.0, 0.9, 1.0, 1.0), strict=True))
    wrong = apply_zero_points(table, QTable({"band": BANDS, "factor": [*factors.values()]}))
    error = TemplateError([1.99, 2.01] * u.um, [0.05, 0.3])
    fitter = node_fitter(grid, model_error=0.0, template_error=error)
    for _ in range(4):
        points = calibrate_zero_points(fitter.fit(wrong, redshift=z), reference="acs.f606w")
        wrong = apply_zero_points(wrong, points)
    assert points["factor"][0] == 1
    assert_allclose(points["factor"], 1, atol=0.01)
    colors = [(t["wfc3.f160w"] / t["acs.f606w"]).value for t in (wrong, table)]
    ratio = np.median(colors[0] / colors[1])
    assert ratio == pytest.approx(1, abs=0.01)
    assert wrong.meta["zero_points"].keys() == factors.keys()
    # what was applied is the product of all steps
    for name, factor in wrong.meta["zero_points"].items():
        assert_allclose(wrong[name], table[name] * factor, rtol=1e-12)


def test_free_redshifts_and_bad_errors_are_refused(grid):
    results = node_fitter(grid).fit(draw_photometry(grid, 2)[0])
    refuses("known redshifts", calibrate_zero_points, results)
    refuses("known redshifts", measure_template_error, results)
    refuses("'wave' must be ascending", TemplateError, [2.0, 1.0] * u.um, [0.1, 0.1])
    refuses("'error' must be 2 finite", TemplateError, [1.0, 2.0] * u.um, [0.1, -0.1])
    refuses("a TemplateError", BayesFitter, grid, template_error=0.1)


def test_errors_of_bands_are_distinguished_from_those_of_models(residuals):
    """Two bands with errors three times too small, and 10 % more scatter than the models."""
    grid, table, z = residuals
    rng = np.random.default_rng(4)
    bands = ["wfc3.f125w", "wfc3.f160w"]
    scattered = QTable(table, copy=True)
    for name in bands:
        noise, part = rng.normal(size=(2, len(table)))
        err = rng.uniform(0.005, 0.06, len(table)) * table[name]
        scattered[name] = table[name] + 3 * err * noise + 0.1 * table[name] * part
        scattered[f"{name}_err"] = err
        # one flux in thirty is something else's
        scattered[name][::30] *= 1.7
    error = TemplateError([1.99, 2.01] * u.um, [0.05, 0.3])
    fitter = node_fitter(grid, model_error=0.0, template_error=error)
    left = leave_out(fitter, scattered, bands, redshift=z)
    assert_allclose(measure_band_errors(left, error, prior=WIDE_PRIOR), [3, 0.1], rtol=0.12)
    # redshifts may be free: each has colors of its own
    left = leave_out(fitter, scattered, bands)
    assert_allclose(measure_band_errors(left, error, prior=WIDE_PRIOR), [3, 0.1], rtol=0.15)
    # no starlight there: the prior of MIRI
    left = leave_out(fitter, scattered, ["miri.f1500w"], redshift=z)
    assert_allclose(measure_band_errors(left, error), [3.3, 0.15], rtol=1e-3)
    left = leave_out(fitter, scattered, ["wfc3.f160w", "miri.f1500w"], redshift=z)
    refuses("of bands of MIRI, or of others", measure_band_errors, left, error)


@pytest.mark.slow
def test_how_often_values_occur_is_measured():
    """Three in four galaxies are of the first kind: steps of the measured priors come to their share."""
    grid = make_grid(6, n_z=2, n_tau=2, n_age=1, frac=[0.0])
    rng = np.random.default_rng(3)
    kind, z = (rng.random(1000) < 0.25).astype(int), rng.integers(2, size=1000)
    model = grid.galaxy[z, kind] / np.linalg.norm(grid.galaxy[z, kind], axis=1)[:, None]
    # of a total S/N of 3, which distinguishes galaxies, but not well
    err = np.full(model.shape, 1.0)
    flux = 3.0 * model + err * rng.normal(size=model.shape)
    table = photometry_table(grid.filters, flux, err)
    priors, shares = None, []
    for _ in range(30):
        fitter = node_fitter(grid, model_error=0.0, priors=priors)
        priors = measure_priors(fitter.fit(table, redshift=grid.redshift[z]))
        shares.append(priors["tau"][0])
    assert abs(shares[0] - np.mean(kind == 0)) > 0.05
    assert shares[-1] == pytest.approx(np.mean(kind == 0), abs=0.04)
    refuses("known redshifts", measure_priors, fitter.fit(table[:3]))


def test_prior_of_redshift_given_magnitude():
    """z^a exp(-(z / z_m)^a) has its peak at z_m, and fluxes their magnitudes."""
    z, density = magnitude_prior([22.0, 24.0, 26.0] * u.ABmag)
    assert_allclose(z[np.argmax(density, axis=1)], 0.62 + 0.066 * np.array([-2, 0, 2]), atol=0.02)
    assert_allclose(np.trapezoid(density, z, axis=1), 1)
    flux = [22.0, 24.0, 26.0] * u.ABmag
    assert_allclose(magnitude_prior(flux.to(u.uJy))[1], density)
    # no flux says nothing
    assert_allclose(magnitude_prior([0.0, -1.0] * u.uJy)[1], density[[1, 1]])


def test_prior_of_star_formation_given_mass_and_redshift():
    """Two galaxies of the same light: the odds are those of the prior at the mass that the flux gives."""
    grid = make_grid(3, n_z=2, n_tau=2, n_age=1, frac=[0.0, 0.3])
    galaxy, rate = np.repeat(grid.galaxy[:, :1], 2, axis=1), np.array([1e-9, 4e-10])
    properties = QTable({"stellar_mass": [0.5, 0.8], "sfr_100myr": rate / u.yr})
    grid = replace(grid, galaxy=galaxy, galaxy_properties=properties)
    grid = replace(grid, dust_luminosity=np.full(2, 1e29))
    flux = 1e10 * galaxy[1, 0]
    table = photometry_table(grid.filters, flux, 0.5 * flux)

    def relation(mass, redshift):
        return 10 ** (0.8 * np.log10(mass / u.Msun) - 7.0 + redshift) * u.Msun / u.yr

    def fitted_with(prior):
        settings = GridSettings(sfr_prior=prior, rtol=0.0)
        return node_fitter(grid, model_error=0.0, settings=settings)

    fitter = fitted_with((relation, 0.3))
    fits = fitter.fit(table), fitted_with(None).fit(table)
    # which redshift it is stays with the fluxes
    assert_allclose(fits[0].pdf["redshift"], fits[1].pdf["redshift"], rtol=1e-6)
    known = fitter.fit(table, redshift=grid.redshift[1])
    expected = 0.8 * np.log10(1e10 * np.array([0.5, 0.8])) - 7.0 + grid.redshift[1]
    prior = np.exp(-0.5 * ((np.log10(1e10 * rate) - expected) / 0.3) ** 2)
    assert_allclose(known.pdf["tau"][0], prior / prior.sum(), rtol=1e-9)
    draws = fitter.sample(table, 4000, seed=1, redshift=grid.redshift[1])
    part = np.mean(draws.to_table()["tau"] == grid.galaxy_parameters["tau"][0])
    assert part == pytest.approx(prior[0] / prior.sum(), abs=5 * np.sqrt(0.25 / 4000))
    with pytest.raises(ValueError, match="'sfr_prior' must be a function"):
        node_fitter(grid, settings=GridSettings(sfr_prior=relation))
    bare = fitted_with((lambda mass, z: relation(mass, z).value, 0.3))
    refuses("'sfr_prior' must be a quantity", bare.fit, table, error=u.UnitsError)
    for factor, got in ((np.nan, "nan"), (0.0, "0"), (-1.0, "-"), (np.inf, "inf")):
        nothing = fitted_with((lambda m, z, x=factor: x * relation(m, z), 0.3))
        refuses(f"'sfr_prior' must be .* above 0 and finite, got {got}", nothing.fit, table)
    wanted = "'settings' must be SamplerSettings with engine='nautilus'"
    options = {"engine": "nautilus", "settings": GridSettings()}
    refuses(wanted, BayesFitter, None, ["acs.f606w"], **options)
