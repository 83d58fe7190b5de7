"""Posteriors between the nodes of a coarse grid, whose models follow a closed form."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from miricigale.fitting import BayesFitter, FitFlags
from miricigale.sed import ModelGrid

BANDS = tuple(f"band{i}" for i in range(8))
PLACE = np.linspace(-1.0, 1.0, len(BANDS))
AXES = {
    "redshift": np.array([0.5, 0.8, 1.16, 1.6]),
    "tau": np.array([1.0, 2.0, 3.0]),
    "ebv": np.array([0.1, 0.4, 0.7]),
}
SIGMA = 0.05


def flux(redshift, tau, ebv):
    """Fluxes and star-formation rates of a solar mass at distance z: logarithms are parabolas."""
    z, t, e = (np.asarray(x, float)[..., None] for x in (redshift, tau, ebv))
    log = 1.5 * PLACE * np.log1p(z) - 2.0 * np.log(z)
    log = log + 0.3 * np.sin(3 * PLACE) * t - 2.0 * e * np.exp(-PLACE)
    log = log + 0.15 * np.cos(2 * PLACE) * (t - 2) ** 2
    return 1e-9 * np.exp(log), 1e-10 * np.exp(-0.8 * np.asarray(tau))


@pytest.fixture(scope="module")
def grid():
    """27 galaxies without AGN; cells are much wider than what eight bands of S/N 20 leave."""
    tau, ebv = (x.ravel() for x in np.meshgrid(AXES["tau"], AXES["ebv"], indexing="ij"))
    galaxy, sfr = flux(AXES["redshift"][:, None], tau, ebv)
    n = tau.size
    return ModelGrid(
        filters=BANDS,
        redshift=AXES["redshift"],
        galaxy=galaxy,
        agn=np.zeros((4, 0, len(BANDS))),
        dust_luminosity=np.full(n, 1e27),
        frac_agn=np.zeros(1),
        allowed=np.ones((4, n), bool),
        galaxy_parameters=QTable({"tau": tau * u.Gyr, "ebv": ebv * u.mag}),
        agn_parameters=QTable(),
        galaxy_properties=QTable({"sfr": sfr / u.yr}),
        galaxy_shape=QTable({"beta": 0.3 * tau - 2.0}),
        agn_properties=QTable(),
        agn_multiplicity=np.zeros(0, int),
        axes=AXES,
    )


@pytest.fixture(scope="module")
def drawn():
    """300 objects drawn from the prior: any node, anywhere in its cell between the outermost nodes."""
    rng, n, true = np.random.default_rng(8), 300, {}
    for name, values in AXES.items():
        edges = np.concatenate([values[:1], 0.5 * (values[1:] + values[:-1]), values[-1:]])
        node = rng.integers(values.size, size=n)
        true[name] = edges[node] + np.diff(edges)[node] * rng.random(n)
    model, sfr = flux(**true)
    model, true["sfr"] = 1e10 * model, 1e10 * sfr
    true["mass"], true["beta"] = np.full(n, 1e10), 0.3 * true["tau"] - 2.0
    table = QTable({"id": np.arange(n), "z": true["redshift"]})
    for i, name in enumerate(BANDS):
        error = SIGMA * model[:, i]
        table[name] = (model[:, i] + error * rng.normal(size=n)) * u.uJy
        table[f"{name}_err"] = error * u.uJy
    return table, true


def coverage(results, true, name):
    low, high = results.percentile(name, [0.16, 0.84]).value.T
    return np.mean((true[name] >= low) & (true[name] <= high))


def test_intervals_hold_the_truth_between_nodes(grid, drawn):
    table, true = drawn
    results = BayesFitter(grid, model_error=0.0, interpolate=300).fit(table)
    nodes = BayesFitter(grid, model_error=0.0).fit(table)
    for name in ("redshift", "tau", "ebv", "mass", "sfr", "beta"):
        # three times the binomial error of 300 objects
        assert abs(coverage(results, true, name) - 0.68) < 0.08, name
    assert coverage(nodes, true, "mass") < 0.4
    assert coverage(nodes, true, "sfr") < 0.4
    for name in results.axes:
        np.testing.assert_allclose(results.pdf[name].sum(axis=1), 1)


def test_what_rests_on_one_node_is_flagged(grid, drawn):
    table, _ = drawn
    nodes = BayesFitter(grid, model_error=0.0).fit(table)
    alone = (nodes.flags & int(FitFlags.ONE_NODE)) != 0
    top = np.minimum(nodes.pdf["redshift"].max(1), nodes.pdf["tau"].max(1))
    assert np.all(top[alone] > 0.95)
    assert alone.sum() > 50
    wide = BayesFitter(grid, model_error=1.0).fit(table)
    assert not np.any(wide.flags & int(FitFlags.ONE_NODE))


def test_known_redshifts_are_those_of_the_catalog(grid, drawn):
    """Also where they lie between nodes; the rest is then that of these redshifts."""
    table, true = drawn
    results = BayesFitter(grid, model_error=0.0, interpolate=300).fit(table, redshift="z")
    np.testing.assert_allclose(results.percentile("redshift", 0.5).value[:, 0], true["redshift"])
    for name in ("tau", "ebv", "mass", "sfr"):
        assert abs(coverage(results, true, name) - 0.68) < 0.08, name


def test_chi2_and_evidence_are_those_at_the_known_redshift(grid):
    """Models of the nodes in all else, in closed form."""
    rng = np.random.default_rng(3)
    z, n = rng.uniform(0.45, 1.7, 40), 40
    tau, ebv = (x.ravel() for x in np.meshgrid(AXES["tau"], AXES["ebv"], indexing="ij"))
    models = flux(z[:, None], tau, ebv)[0]
    true = 1e10 * models[np.arange(n), rng.integers(tau.size, size=n)]
    error = SIGMA * true
    table = QTable({"id": np.arange(n)})
    observed = true + error * rng.normal(size=true.shape)
    for i, name in enumerate(BANDS):
        table[name] = observed[:, i] * u.uJy
        table[f"{name}_err"] = error[:, i] * u.uJy
    results = BayesFitter(grid, model_error=0.0, interpolate=20).fit(table, redshift=z)
    unit, data = models / error[:, None], (observed / error)[:, None]
    scale = np.sum(unit * data, axis=2) / np.sum(unit**2, axis=2)
    chi2 = np.sum((data - scale[..., None] * unit) ** 2, axis=2)
    np.testing.assert_allclose(results.chi2, chi2.min(axis=1), rtol=1e-6)
    np.testing.assert_allclose(results.best_scale, scale[np.arange(n), chi2.argmin(axis=1)])
    np.testing.assert_allclose(results.best["redshift"], z)
    evidence = np.log(np.mean(np.exp(-0.5 * chi2), axis=1))
    evidence -= np.log(np.sqrt(2 * np.pi) * error).sum(axis=1)
    np.testing.assert_allclose(results.log_evidence, evidence, rtol=1e-6)
    nodes = BayesFitter(grid, model_error=0.0).fit(table, redshift=z)
    assert np.median(nodes.chi2) > 1.3 * np.median(results.chi2)


def test_masses_at_low_redshift_are_those_of_the_distance(grid):
    """Half way between redshift 0.01 and 0.04 the distance is not half way in ln(1 + z)."""
    galaxy = flux(np.array([0.01, 0.04])[:, None], np.array([1.0, 3.0]), np.array([0.1, 0.1]))[0]
    part = {
        "galaxy_parameters": grid.galaxy_parameters[[0, 6]],
        "agn": np.zeros((2, 0, len(BANDS))),
    }
    near = replace(
        grid,
        redshift=np.array([0.01, 0.04]),
        galaxy=galaxy,
        dust_luminosity=np.full(2, 1e27),
        allowed=np.ones((2, 2), bool),
        galaxy_properties=grid.galaxy_properties[[0, 6]],
        galaxy_shape=grid.galaxy_shape[[0, 6]],
        axes={"redshift": [0.01, 0.04], "tau": [1.0, 3.0]},
        **part,
    )
    model = 1e9 * flux(np.array([0.02]), np.array([1.0]), np.array([0.1]))[0]
    table = QTable({"id": [0]})
    for i, name in enumerate(BANDS):
        table[name] = model[:, i] * u.uJy
        table[f"{name}_err"] = 0.05 * model[:, i] * u.uJy
    results = BayesFitter(near, model_error=0.0, interpolate=50).fit(table, redshift=0.02)
    assert results.best_scale[0] == pytest.approx(1e9, rel=1e-3)


def test_the_same_objects_have_the_same_draws(grid, drawn):
    table, _ = drawn
    fitter = BayesFitter(grid, model_error=0.0, interpolate=50)
    some, turned = fitter.fit(table[:6]), fitter.fit(table[:6][::-1])
    np.testing.assert_array_equal(
        some.percentile("mass", [0.16, 0.5]), turned.percentile("mass", [0.16, 0.5])[::-1]
    )
    with pytest.raises(ValueError, match="'interpolate' must be an integer >= 0"):
        BayesFitter(grid, interpolate=-1)
