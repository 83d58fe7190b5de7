"""Upper limits: everything against a plain evaluation, and what they mean at their extremes."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import MaskedColumn
from numba import njit
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import minimize_scalar
from scipy.special import log_ndtr, ndtr
from scipy.stats import norm

from helpers.errors import refuses
from helpers.grids import (
    brute_force,
    cell_integrals,
    cells,
    draw_photometry,
    free_parameters,
    make_grid,
    model_priors,
    node_fitter,
    other_fraction,
    photometry_table,
)
from miricigale.fitting import FitFlags, GridSettings, leave_out, mock_analysis
from miricigale.fitting._core.limits import limited_scale
from miricigale.fitting._core.workspace import make_limits
from miricigale.fitting.posterior.quantities import DERIVED_LEVELS

ERROR = {"band0": 0.1, "band1": 0.05, "band3": 0.2}
FLOOR = {"band2": 0.15, "band3": 0.02}
PRIORS = {
    "redshift": lambda z: z * np.exp(-z), "frac_agn": [4.0, 2.0, 1.0, 3.0], "age": "log",
    "tau": [1.0, 0.0, 2.0, 3.0, 0.5], "tau97": [0.3, 0.7], "ebv_polar": lambda x: np.exp(-3 * x),
    "temperature_polar": [1.0, 3.0],
}  # fmt: skip
EVERYTHING = {"model_error": ERROR, "error_floor": FLOOR, "priors": PRIORS}
EVERYTHING["settings"] = GridSettings(rtol=0)


def add_limits(table, grid, part=0.3, seed=0):
    """Make upper limits of some measured bands: near the flux, on both sides of it."""
    rng = np.random.default_rng(seed)
    for name in grid.filters:
        limit = (rng.random(len(table)) < part) & np.isfinite(table[name])
        factor = np.where(limit, rng.uniform(0.3, 2.0, len(table)), 1.0)
        table[name] = table[name] * factor
        table[f"{name}_limit"] = limit
    return table


def by_hand(table, grid):
    """Fluxes, errors as the fit should take them, and limits: arrays (n, nb)."""
    flux, err, limit = (
        np.transpose([np.asarray(table[f"{name}{end}"]) for name in grid.filters])
        for end in ("", "_err", "_limit")
    )
    extra, least = ([part.get(name, 0.0) for name in grid.filters] for part in (ERROR, FLOOR))
    total = np.hypot(np.maximum(err, np.multiply(least, abs(flux))), extra * abs(flux))
    sigma = np.where(limit, err, total)
    return flux, np.where(np.isfinite(flux), sigma, np.inf), limit & np.isfinite(flux)


def compare(results, fitter, i, want, sigma, limit, *, rtol=1e-9):
    """Every sum of one object."""
    assert results.chi2[i] == pytest.approx(want["chi2"], rel=rtol, abs=rtol)
    measured = np.isfinite(sigma) & ~limit
    constant = np.log(sigma[measured]).sum() + 0.5 * measured.sum() * np.log(2 * np.pi)
    assert results.log_evidence[i] == pytest.approx(want["log_sum"] - constant, abs=1e-8)
    assert_allclose(results.pdf_2d[i], want["zf"], rtol=rtol, atol=1e-13)
    for name, kind, _, share, _ in free_parameters(fitter.grid, PRIORS):
        expected = share @ want[kind]
        assert_allclose(results.pdf[name][i], expected, rtol=rtol, atol=1e-13)
    assert_allclose(results.moments[i, :, 0], want["mean"], rtol=rtol)
    assert_allclose(results.model_flux[i], want["band"], rtol=rtol)
    # variances are the difference of two sums: to rtol and rounding
    for got, mean, std in (
        (results.moments[i, :, 1], want["mean"], want["std"]),
        (results.model_flux_std[i], want["band"], want["band_std"]),
    ):
        assert np.all(np.abs(got**2 - std**2) <= 2 * rtol * std**2 + 1e-14 * mean**2)
    z, g, k, f = results.best_index[i]
    best = want["scale"][z, g, max(k, 0), f] * fitter.grid.flux(z, g, max(k, 0), f)
    assert_allclose(results.best_flux[i], best, rtol=rtol)


#: Options of grids, of fitters and data, and what is known of redshifts.
CASES = {
    "all": ({}, {}, ("free", "density", "known")),
    "no scale error": ({}, {"scale_error": False}, ("density",)),
    "no galaxy-only models": ({"frac": [0.1, 0.5, 0.8, 0.95]}, {}, ("known",)),
    "more galaxies than a block": ({"n_tau": 5, "n_age": 13}, {}, ("density",)),
    "faint": ({}, {"noise": 3.0}, ("free", "density")),
    "bright": ({}, {"noise": 0.01}, ("free", "known")),
}


@pytest.mark.parametrize(
    ("case", "redshift"), [(case, way) for case, (*_, ways) in CASES.items() for way in ways]
)
def test_all_options_at_once_equal_the_plain_sums(case, redshift):
    of_grid, options, _ = CASES[case]
    grid = make_grid(3, **of_grid)
    scale_error = options.get("scale_error", True)
    fitter = node_fitter(grid, **EVERYTHING, scale_error=scale_error)
    noise = options.get("noise", 0.15)
    table = draw_photometry(grid, 8, seed=5, noise=noise, missing=0.15)[0]
    table = add_limits(table, grid)
    flux, sigma, limit = by_hand(table, grid)
    assert limit.any(axis=1).sum() > 4
    known, log_prior = {}, [None] * 8
    if redshift == "known":
        known = {"redshift": "redshift"}
        node = np.array(table["redshift"])[:, None] == grid.redshift
        log_prior = np.log(node, where=node, out=np.full(node.shape, -np.inf))
    elif redshift == "density":
        nodes = np.array([0.0, 0.3, 1.1, 2.0, 4.0])
        density = np.random.default_rng(4).uniform(0.1, 2.0, (8, 5))
        known = {"redshift_prior": (nodes, density)}
        whole = np.trapezoid(density, nodes, axis=1)
        parts = np.array([cell_integrals(grid.redshift, nodes, row) for row in density])
        log_prior = np.log(parts / whole[:, None])
    results = fitter.fit(table, **known)
    assert_allclose(results.sigma, sigma, rtol=1e-15)
    assert_array_equal(results.limit, limit)
    _, galaxy, agn, _ = model_priors(grid, PRIORS)
    assert_allclose(fitter.priors.galaxy / fitter.priors.galaxy.sum(), galaxy)
    assert_allclose(fitter.priors.agn / fitter.priors.agn.sum(), agn)
    for i in np.flatnonzero(results.fitted):
        kind = {"priors": PRIORS, "scale_error": scale_error}
        want = brute_force(grid, flux[i], sigma[i], log_prior[i], limit[i], **kind)
        compare(results, fitter, i, want, sigma[i], limit[i])
        # the fraction in its second definition, from luminosities
        share = other_fraction(grid)[1]
        weights = want["weights"].sum(axis=0)
        mean = np.sum(weights * share)
        assert results.mean("frac_agn_ir")[i].value == pytest.approx(mean, rel=1e-9)
        std = np.sqrt(np.sum(weights * (share - mean) ** 2))
        assert results.std("frac_agn_ir")[i].value == pytest.approx(std, rel=1e-9, abs=1e-7)
        g, k, f = results.best_index[i, 1:]
        best = results.best["frac_agn_ir"][i].value
        assert best == pytest.approx(share[g, max(k, 0), f], rel=1e-12)
    unfitted = ~(np.isfinite(sigma) & ~limit).any(axis=1)
    assert_array_equal(results.fitted, ~unfitted)


@pytest.mark.parametrize("noise", [0.01, 0.1, 0.5, 5.0])
def test_pruning_loses_no_more_than_asked(noise):
    grid = make_grid(7, n_tau=12, n_age=9)
    table = draw_photometry(grid, 10, seed=3, noise=noise, missing=0.1)[0]
    table = add_limits(table, grid, part=0.4)
    fitters = [node_fitter(grid, settings=GridSettings(rtol=rtol)) for rtol in (0, 1e-6)]
    whole, pruned = (fitter.fit(table) for fitter in fitters)
    for name in ("pdf_2d", "log_evidence"):
        assert_allclose(getattr(pruned, name), getattr(whole, name), atol=1e-6)
    assert_allclose(pruned.chi2, whole.chi2, rtol=1e-12)
    assert_allclose(pruned.moments[..., 0], whole.moments[..., 0], rtol=1e-6)
    assert_allclose(pruned.moments[..., 1], whole.moments[..., 1], rtol=2e-6)


def test_one_model_has_the_posterior_of_the_text_book():
    """Detection 10 +- 1, limit 8 +- 0.5 on twice as bright a band: the minimum by scipy."""
    grid = make_grid(n_z=1, n_tau=1, n_age=1, frac=[0.0], n_b=2)
    one, two = grid.galaxy[0, 0]
    mass = 1e10
    flux, err = mass * np.array([[one, 0.8 * two], [0.1 * one, 0.05 * two]])
    table = photometry_table(grid.filters, flux, err, ["only"], band1_limit=[True])

    def chi2(s):
        terms = log_ndtr((0.8 - s) / 0.05)
        return ((1.0 - s) / 0.1) ** 2 - 2 * terms

    best = minimize_scalar(chi2, bounds=(0.5, 1.0), method="bounded", options={"xatol": 1e-10})
    results = node_fitter(grid, model_error=0.0).fit(table)
    assert results.chi2[0] == pytest.approx(best.fun, rel=1e-9)
    assert results.best_scale[0] == pytest.approx(best.x * mass, rel=1e-6)
    step = 1e-4
    second = (chi2(best.x + step) - 2 * best.fun + chi2(best.x - step)) / step**2
    assert results.std("mass")[0].value == pytest.approx(mass * np.sqrt(2 / second), rel=1e-5)
    norm_of_flux = norm(one * mass, 0.1 * one * mass).logpdf(one * mass)
    assert results.log_evidence[0] == pytest.approx(norm_of_flux - 0.5 * best.fun, rel=1e-9)
    assert (results.n_bands[0], results.n_limits[0]) == (2, 1)
    assert results.reduced_chi2[0] == results.chi2[0]


def test_quantities_of_one_galaxy_have_the_same_distribution():
    """One galaxy measured to 10 %: all that scales with its mass is normal in the logarithm, with that error."""
    grid = make_grid(n_z=1, n_tau=1, n_age=1, frac=[0.0], n_b=1)
    flux = 1e10 * grid.galaxy[0]
    results = node_fitter(grid, n_bands_min=1, model_error=0.0).fit(
        photometry_table(grid.filters, flux, 0.1 * flux, ["only"])
    )
    names = [name for name in results.quantities if results.extensive(name)]
    scale = {name: results.best[name][0].value for name in names}
    names = [name for name in names if scale[name] > 0]
    assert len(names) == 3
    expected = 10.0 ** (0.1 / np.log(10) * norm.ppf(DERIVED_LEVELS))
    found = np.array(
        [results.percentile(name, DERIVED_LEVELS)[0].value / scale[name] for name in names]
    )
    assert_allclose(found[0], expected, rtol=3e-3)
    assert_allclose(found, np.tile(found[0], (len(names), 1)), rtol=1e-9)


@njit
def _scale(p, q, limits):
    return limited_scale(p, q, limits)


@pytest.mark.parametrize("wrong", [0.0, 0.02, 0.3])
def test_one_model_has_the_scale_of_the_least_chi2(wrong):
    """Also where limits may be wrong, each with a prior probability: its likelihood is (1 - p) P + p."""
    slope, level, p, q = np.array([3.0, 0.7, 1.5]), np.array([2.0, 1.0, 3.0]), 90.0, 60.0
    limits = make_limits(level, np.ones(3), np.full(3, wrong) if wrong else None)
    limits.slope[:] = slope

    def terms(s):
        return -np.log((1.0 - wrong) * ndtr(level - s * slope) + wrong)

    def half(s):
        return 0.5 * q * s * s - p * s + terms(s).sum()

    best, step = minimize_scalar(half, bounds=(0.1, 3.0), options={"xatol": 1e-9}).x, 1e-3
    bend = (terms(best + step) - 2.0 * terms(best) + terms(best - step)) / step**2
    s, rise, variance = _scale(p, q, limits)
    assert s == pytest.approx(best, rel=1e-6)
    # limits pull: without them the scale is p / q
    assert s < p / q
    assert rise == pytest.approx(2.0 * (half(0.0) - half(best)), rel=1e-7)
    # a limit that is not convex has no part in the curvature
    assert variance == pytest.approx(1.0 / (q + np.maximum(bend, 0.0).sum()), rel=1e-4)


def test_percentiles_of_the_other_fraction():
    """The weight of every model is spread over its cell of the fraction."""
    grid = make_grid(3, n_tau=8, n_age=6)
    fitter = node_fitter(grid, settings=GridSettings(rtol=0))
    table = add_limits(draw_photometry(grid, 8, seed=7, noise=0.4)[0], grid, part=0.2)
    results = fitter.fit(table)
    edges = cells(grid.frac_agn, (0.0, 1.0))
    ends = np.minimum(edges, 1 - 1e-12)
    galaxy = grid.galaxy_properties["ir_luminosity"].value
    torus = grid.agn_properties["ir_luminosity"].value
    # where there is no AGN its torus is a mean one
    mean = np.average(torus, weights=grid.agn_multiplicity)
    y = np.divide(grid.dust_luminosity, galaxy, out=np.zeros(galaxy.size), where=galaxy > 0)
    y = (ends / (1 - ends)) * y[:, None, None] * torus[:, None]
    share = y / (1 + y)
    low, high = share[..., :-1].copy(), share[..., 1:].copy()
    alone = y[:, :, 1] / torus * mean
    high[..., 0] = alone / (1 + alone)
    levels = np.array([0.025, 0.16, 0.5, 0.84, 0.975])
    for i in np.flatnonzero(results.fitted):
        want = brute_force(grid, results.flux[i], results.sigma[i], limit=results.limit[i])
        weights = want["weights"].sum(axis=0)
        got = results.percentile("frac_agn_ir", levels)[i].value

        def below(x, weights=weights):
            width = np.maximum(high - low, 1e-12)
            return np.sum(weights * np.clip((x - low) / width, 0.0, 1.0))

        # bins of the distribution, 0.002 wide at most
        assert all(below(x - 2e-3) <= p + 1e-4 for x, p in zip(got, levels, strict=True))
        assert all(below(x + 2e-3) >= p - 1e-4 for x, p in zip(got, levels, strict=True))


# ------------------------------------------------------------------------- what limits mean


@pytest.mark.parametrize("error", [1e-9, 1e-12, 1e-30])
def test_a_limit_without_error_is_a_wall(error):
    """As sigma goes to 0 the best scale of every model is that of the detections or the wall's."""
    grid = make_grid(3)
    table = draw_photometry(grid, 8, seed=2)[0]
    wall = 0.5 * table["band4"].value
    table["band4"] = wall * u.uJy
    table["band4_err"] = error * wall * u.uJy
    table["band4_limit"] = True
    fitter = node_fitter(grid, model_error=0.0, settings=GridSettings(rtol=0))
    results = fitter.fit(table)
    assert np.all(results.best_flux[:, 4] <= wall * (1 + 1e-8))
    assert np.all(results.model_flux[:, 4] <= wall * (1 + 1e-8))
    index = np.ogrid[tuple(slice(n) for n in (4, 20, grid.n_agn, 4))]
    model = grid.flux(*index)
    used = np.arange(6) != 4
    for i in range(8):
        flux = results.flux[i, used]
        weight = results.sigma[i, used] ** -2
        p, q = (model[..., used] * flux * weight).sum(-1), (model[..., used] ** 2 * weight).sum(-1)
        scale = np.minimum(np.maximum(p, 0) / q, wall[i] / model[..., 4])
        chi2 = (weight * (flux - scale[..., None] * model[..., used]) ** 2).sum(-1)
        chi2[~np.broadcast_to(grid.allowed[:, :, None, None], chi2.shape)] = np.inf
        assert results.chi2[i] == pytest.approx(chi2.min(), rel=1e-4, abs=1e-4)


def test_how_limits_may_be_written():
    grid = make_grid(3)
    fitter, table = node_fitter(grid), draw_photometry(grid, 3, seed=2)[0]
    text, masked = ["True", "false", "T"], MaskedColumn([True] * 3, mask=[False, True, False])
    for column in (
        [True, False, True],
        [1, 0, 1],
        [1.0, 0.0, 1.0],
        text,
        ["1", "", "true"],
        masked,
    ):
        table["band1_limit"] = column
        assert fitter.fit(table).limit[:, 1].tolist() == [True, False, True]
    for column in ([0.5, 0.0, 1.0], ["yes", "no", "no"], [1, 0, 1] * u.uJy, [np.nan, 1.0, 0.0]):
        table["band1_limit"] = column
        refuses("whose column 'band1_limit' is boolean, got", fitter.fit, table)


def test_few_are_fewer_than_three_fluxes_above_two_sigma():
    """Two at a known redshift; how many of its parameters a grid varies does not matter."""
    grid = make_grid(3)
    table = draw_photometry(grid, 3, seed=4)[0]
    for j, name in enumerate(grid.filters):
        seen = np.array([j < 1, j < 2, j < 3])
        table[f"{name}_err"] = table[name] / np.where(seen, 2.1, 1.9)
    table["z"] = grid.redshift[[0, 0, 0]]
    for options, wanted in (({}, [1, 1, 0]), ({"redshift": "z"}, [1, 0, 0])):
        flags = node_fitter(grid).fit(table, **options).flags
        few = (flags & int(FitFlags.FEW_FOR_PARAMETERS)) > 0
        assert few.tolist() == [bool(value) for value in wanted]


FLAGS = ({"all_limits"}, {"few_for_parameters"}, {"bad_error"}, {"all_limits", "few_bands"})


def test_flags_and_counts():
    grid = make_grid(3)
    table = draw_photometry(grid, 6, seed=4)[0]
    limit = np.zeros((6, 6), bool)
    limit[0] = True
    limit[1, 1:] = True
    limit[2, :2] = True
    for j, name in enumerate(grid.filters):
        table[f"{name}_limit"] = limit[:, j]
    # a limit that is missing is none, and one without error is no band
    table["band0"][2] = np.nan
    table["band1_err"][2] = 0.0 * u.uJy
    for name in grid.filters[1:]:
        table[name][3] = np.nan
    table["band0_limit"][3] = True
    results = node_fitter(grid).fit(table)
    names = [FitFlags.names(flag) for flag in results.flags[:4]]
    for own, wanted in zip(names, FLAGS, strict=True):
        assert wanted <= set(own)
    assert names[0] == ["all_limits"]
    assert results.fitted.tolist() == [False, True, True, False, True, True]
    assert results.n_bands.tolist() == [6, 6, 4, 1, 6, 6]
    assert results.n_limits.tolist() == [6, 5, 0, 1, 0, 0]
    out = results.to_table()
    assert out["n_limits"].tolist() == results.n_limits.tolist()
    assert out["n_limits"].info.description
    assert results[1].n_limits == 5


def test_negative_models_have_no_limits():
    from dataclasses import replace

    grid = make_grid(3)
    galaxy = grid.galaxy.copy()
    galaxy[0, 0, 2] *= -1
    fitter = node_fitter(replace(grid, galaxy=galaxy))
    table = draw_photometry(grid, 3, seed=4)[0]
    table["band1_limit"] = True
    assert fitter.fit(table).fitted.all()
    table["band2_limit"] = True
    refuses("a model has negative flux, got some in band2", fitter.fit, table)


# --------------------------------------------------------------------- all that fits go through


@pytest.fixture(scope="module")
def catalog(grid):
    table = draw_photometry(grid, 60, seed=8, noise=0.15, missing=0.1)[0]
    return add_limits(table, grid, part=0.25)


def test_samples_follow_the_posterior(grid, catalog):
    fitter = node_fitter(grid)
    results = fitter.fit(catalog)
    n = 4000
    samples = fitter.sample(catalog, n, seed=1)
    assert_array_equal(samples.fitted, results.fitted)
    assert_array_equal(samples.flags & 4096, results.flags & 4096)
    ok = results.fitted
    for name in ("redshift", "frac_agn", "frac_agn_ir"):
        mean, std = results.mean(name).value[ok], results.std(name).value[ok]
        pull = (samples.mean(name).value[ok] - mean) / np.maximum(std, 1e-6) * np.sqrt(n)
        assert np.abs(pull).max() < 4.5, name
    # what scales is drawn with its error, cut at 0
    mean, std = (x.value[ok] for x in (results.mean("mass"), results.std("mass")))
    near = std < 0.3 * mean
    pull = (samples.mean("mass").value[ok] - mean) / std * np.sqrt(n)
    assert np.abs(pull[near]).max() < 4.5


def test_mocks_perturb_fluxes_and_keep_limits(grid, catalog):
    fitter = node_fitter(grid, model_error=0.0)
    results = fitter.fit(catalog)
    mock = mock_analysis(fitter, results, catalog, seed=5)
    pulls = []
    for j, name in enumerate(grid.filters):
        limit = results.limit[:, j]
        new, old = mock.photometry[name].value, catalog[name].value
        assert_array_equal(new[limit], old[limit])
        changed = results.fitted & np.isfinite(old) & ~limit
        pulls.append(((new - results.best_flux[:, j]) / catalog[f"{name}_err"].value)[changed])
    assert_array_equal(mock.recovered.limit, results.limit)
    assert_array_equal(mock.recovered.fitted, results.fitted)
    pull = np.concatenate(pulls)
    assert abs(pull.std() - 1) < 4 / np.sqrt(2 * pull.size)
    metrics = mock.metrics(["frac_agn_ir"])
    assert metrics["unit"][0] == ""
    assert metrics["n"][0] == results.fitted.sum()


def test_bands_left_out_have_predictions_but_no_pull_for_limits(grid, catalog):
    fitter = node_fitter(grid)
    out = leave_out(fitter, catalog, ["band2"])
    limit = np.array(catalog["band2_limit"])
    found = out.results["band2"]
    assert np.isnan(out.pull[limit]).all()
    assert np.isfinite(out.predicted[limit & found.fitted]).all()
    assert not found.limit[:, 2].any()
    assert found.limit[:, 3].any()
    assert np.isfinite(out.pull[~limit & found.fitted & np.isfinite(catalog["band2"])]).all()
