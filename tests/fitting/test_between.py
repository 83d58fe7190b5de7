"""Posteriors between the nodes of a coarse grid, whose models follow a closed form."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.grids import photometry_table
from miricigale.fitting import BayesFitter, FitFlags, GridSettings
from miricigale.sed import ModelGrid, SEDModel

BANDS = tuple(f"band{i}" for i in range(8))
PLACE = np.linspace(-1.0, 1.0, len(BANDS))
AXES = {"redshift": [0.5, 0.8, 1.16, 1.6], "tau": [1.0, 2.0, 3.0], "ebv": [0.1, 0.4, 0.7]}
AXES = {name: np.array(values) for name, values in AXES.items()}
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


def anywhere(values, n, rng):
    """Draws of any node, anywhere in its cell between the outermost nodes."""
    values = np.asarray(values)
    edges = np.concatenate([values[:1], 0.5 * (values[1:] + values[:-1]), values[-1:]])
    node = rng.integers(values.size, size=n)
    return edges[node] + np.diff(edges)[node] * rng.random(n)


@pytest.fixture(scope="module")
def drawn():
    """300 objects drawn from the prior."""
    rng, n = np.random.default_rng(8), 300
    true = {name: anywhere(values, n, rng) for name, values in AXES.items()}
    model, sfr = flux(**true)
    model, true["sfr"] = 1e10 * model, 1e10 * sfr
    true["mass"], true["beta"] = np.full(n, 1e10), 0.3 * true["tau"] - 2.0
    error = SIGMA * model
    noise = error * rng.normal(size=model.shape[::-1]).T
    return photometry_table(BANDS, model + noise, error, z=true["redshift"]), true


def interpolated(grid, n, finer=None, model_error=0.0):
    """A fit with n models between the nodes of each object."""
    settings = GridSettings(interpolate=n, finer=finer)
    return BayesFitter(grid, model_error=model_error, settings=settings)


def coverage(results, true, name):
    low, high = results.percentile(name, [0.16, 0.84]).value.T
    values = u.Quantity(true[name]).value
    return np.mean((values >= low) & (values <= high))


@pytest.fixture(scope="module")
def at_nodes(grid, drawn):
    return interpolated(grid, 0).fit(drawn[0])


@pytest.mark.slow
def test_intervals_hold_the_truth_between_nodes(grid, drawn, at_nodes):
    table, true = drawn
    results = interpolated(grid, 150).fit(table)
    for name in ("redshift", "tau", "ebv", "mass", "sfr", "beta"):
        # three times the binomial error of 300 objects
        assert abs(coverage(results, true, name) - 0.68) < 0.08, name
    assert coverage(at_nodes, true, "mass") < 0.4
    assert coverage(at_nodes, true, "sfr") < 0.4
    for name in results.axes:
        assert_allclose(results.pdf[name].sum(axis=1), 1)


def test_what_rests_on_one_node_is_flagged(grid, drawn, at_nodes):
    alone = (at_nodes.flags & int(FitFlags.ONE_NODE)) != 0
    top = np.minimum(at_nodes.pdf["redshift"].max(1), at_nodes.pdf["tau"].max(1))
    assert np.all(top[alone] > 0.95)
    assert alone.sum() > 50
    wide = interpolated(grid, 0, model_error=1.0).fit(drawn[0])
    assert not np.any(wide.flags & int(FitFlags.ONE_NODE))


@pytest.mark.slow
def test_known_redshifts_are_those_of_the_catalog(grid, drawn):
    """Also where they lie between nodes; the rest is then that of these redshifts."""
    table, true = drawn
    results = interpolated(grid, 150).fit(table, redshift="z")
    assert_allclose(results.percentile("redshift", 0.5).value, true["redshift"])
    for name in ("tau", "ebv", "mass", "sfr"):
        assert abs(coverage(results, true, name) - 0.68) < 0.08, name


def cell_middles(values, n_each):
    """Middles of parts of the cells of nodes: all nodes have the same number of parts, as the same prior."""
    values = np.asarray(values)
    edges = np.concatenate([values[:1], 0.5 * (values[1:] + values[:-1]), values[-1:]])
    part = (np.arange(n_each) + 0.5) / n_each
    return (edges[:-1, None] + np.diff(edges)[:, None] * part).ravel()


@pytest.mark.parametrize("known", [True, False])
def test_chi2_and_evidence_are_those_between_the_nodes(grid, known):
    """The evidence is the mean likelihood over the cells, and the best model fits as well as any place in them."""
    rng = np.random.default_rng(3)
    n = 12
    true = {name: anywhere(values, n, rng) for name, values in AXES.items()}
    model = 1e10 * flux(**true)[0]
    error = SIGMA * model
    observed = model + error * rng.normal(size=model.shape)
    fitter = interpolated(grid, 600)
    results = fitter.fit(
        photometry_table(BANDS, observed, error), redshift=true["redshift"] if known else None
    )
    places = fitter.backend.between.models
    middles = [cell_middles(AXES[name], 40 if known else 8) for name in AXES]
    for i in range(n):
        if known:
            middles[0] = true["redshift"][i : i + 1]
        z, tau, ebv = (x.ravel() for x in np.meshgrid(*middles, indexing="ij"))
        unit = places.galaxy_fluxes({"tau": tau, "ebv": ebv}, z) / error[i]
        data = observed[i] / error[i]
        scale = np.sum(unit * data, axis=1) / np.sum(unit**2, axis=1)
        chi2 = np.sum((data - scale[:, None] * unit) ** 2, axis=1)
        assert results.chi2[i] < chi2.min() + 0.1
        # the mesh is fine enough for a bound where the redshift is known
        assert not known or results.chi2[i] > chi2.min() - 0.1
        evidence = np.log(np.mean(np.exp(-0.5 * chi2)))
        evidence -= np.log(np.sqrt(2 * np.pi) * error[i]).sum()
        assert results.log_evidence[i] == pytest.approx(evidence, abs=0.1)
        weight = np.exp(-0.5 * (chi2 - chi2.min()))
        mean = (weight / weight.sum()) @ (scale[:, None] * unit * error[i])
        assert_allclose(results.model_flux[i], mean, rtol=5e-3)
    if known:
        assert_allclose(results.best["redshift"], true["redshift"])
    nodes = interpolated(grid, 0).fit(photometry_table(BANDS, observed, error))
    assert np.median(nodes.chi2) > 1.3 * np.median(results.chi2)


def test_masses_at_low_redshift_are_those_of_the_distance(grid):
    """Half way between redshift 0.01 and 0.04 the distance is not half way in ln(1 + z)."""
    z, tau = np.array([0.01, 0.04]), np.array([1.0, 3.0])
    parts = {"redshift": z, "galaxy": flux(z[:, None], tau, np.array([0.1, 0.1]))[0]}
    parts |= {"allowed": grid.allowed[:2, :2], "agn": grid.agn[:2]}
    for name in ("dust_luminosity", "galaxy_properties", "galaxy_shape", "galaxy_parameters"):
        parts[name] = getattr(grid, name)[[0, 6]]
    near = replace(grid, **parts, axes={"redshift": z, "tau": tau})
    model = 1e9 * flux(np.array([0.02]), np.array([1.0]), np.array([0.1]))[0]
    table = photometry_table(BANDS, model, 0.05 * model)
    results = interpolated(near, 50).fit(table, redshift=0.02)
    assert results.best_scale[0] == pytest.approx(1e9, rel=1e-3)


def test_the_same_objects_have_the_same_draws(grid, drawn):
    table, _ = drawn
    fitter = interpolated(grid, 50)
    some, turned = fitter.fit(table[:6]), fitter.fit(table[:6][::-1])
    levels = [0.16, 0.5]
    assert_array_equal(some.percentile("mass", levels), turned.percentile("mass", levels)[::-1])


OPTICAL = ["megacam.u", "acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1"]
INFRARED = ["miri.f770w", "miri.f1000w", "miri.f1280w", "miri.f1500w", "miri.f1800w", "miri.f2100w"]
CHAIN_BANDS = [*OPTICAL, *INFRARED]
CHAIN = {
    "redshift": np.expm1(np.linspace(np.log(1.2), np.log(4.0), 16)), "tau": [0.1, 1.0, 5.0],
    "age": [0.5, 1.0, 2.0], "ebv": [0.1, 0.4, 0.8], "alpha": [1.0, 2.5], "ebv_polar": [0.0, 0.3],
    "temperature_polar": [100.0, 300.0], "frac_agn": [0.0, 0.3, 0.6, 0.9],
}  # fmt: skip


@pytest.fixture(scope="module")
def chain():
    """A coarse grid of a chain of galaxy and AGN."""
    model = SEDModel.yang2021(libraries="bundled")
    return model, model.grid(CHAIN, CHAIN_BANDS)


@pytest.fixture(scope="module")
def finer(chain):
    """A fit between the nodes of a finer grid of the chain."""
    return interpolated(chain[1], 150, chain[0])


@pytest.fixture(scope="module")
def off_nodes(chain):
    """80 models of the chain, of any node, anywhere in its cell, with S/N 10."""
    model, rng, n, true = chain[0], np.random.default_rng(4), 80, QTable()
    for name, values in CHAIN.items():
        true[name] = anywhere(values, n, rng) * model.parameters[name].unit
    fluxes = model.fluxes(true, CHAIN_BANDS)
    table = QTable({"id": np.arange(n), "z": true["redshift"]})
    for name in CHAIN_BANDS:
        table[name] = fluxes[name] * (1.0 + 0.1 * rng.normal(size=n))
        table[f"{name}_err"] = 0.1 * fluxes[name]
    for name in ("stellar_mass", "sfr", "dust_luminosity"):
        true[name] = fluxes[name]
    return table, true, fluxes


def test_interpolated_models_are_those_of_the_chain(chain, off_nodes, finer):
    """Between the nodes of a finer grid; between those of the grid itself they are far off."""
    _, true, fluxes = off_nodes
    values = {name: true[name].value for name in CHAIN}
    want = np.column_stack([fluxes[name].value for name in CHAIN_BANDS])
    off = []
    for fitter in (interpolated(chain[1], 1), finer):
        models = fitter.backend.between.models
        flux, power = models.fluxes(values, values["redshift"], values["frac_agn"])
        ratio = np.log(flux * 1e10 / want)
        off.append(np.sqrt(np.mean(np.minimum(np.abs(ratio), 0.3) ** 2)))
        mass = np.full(len(want), 1e10)
        derived = models.describe(values, values["redshift"], power, mass)
    assert off[0] > 0.1
    assert off[1] < 0.02
    for name, within in (("stellar_mass", 0.005), ("sfr", 0.1), ("dust_luminosity", 0.05)):
        assert_allclose(derived[name], true[name].value, rtol=within)


@pytest.mark.slow
def test_intervals_of_galaxies_and_agn(chain, off_nodes, finer):
    """Of models of the chain, two-sided; ``benchmarks/intervals.py`` measures more of them."""
    table, true, _ = off_nodes
    results, nodes = finer.fit(table), interpolated(chain[1], 0).fit(table)
    names = ("redshift", "frac_agn", "stellar_mass", "sfr", "dust_luminosity")
    held = {}
    for name in names:
        held[name] = coverage(results, true, name)
        # three times the binomial error of 80 objects
        assert abs(held[name] - 0.68) < 0.157, name
        assert coverage(nodes, true, name) < held[name], name
    assert abs(np.mean(list(held.values())) - 0.68) < 0.1


def test_known_redshifts_between_nodes_are_those_of_the_chain(chain, finer):
    """Galaxies of the nodes at redshifts between: chi2 is that of no noise, whatever the cells' width."""
    model, grid = chain
    true = QTable({"redshift": [0.51, 0.87, 1.63, 2.71], "age": [1.0, 0.5, 2.0, 1.0] * u.Gyr})
    true["tau"], true["ebv"] = [0.1, 1.0, 5.0, 1.0] * u.Gyr, [0.4, 0.1, 0.8, 0.4] * u.mag
    true["alpha"], true["frac_agn"] = [1.0, 2.5, 2.5, 1.0], np.zeros(4)
    fluxes = model.fluxes(true, CHAIN_BANDS)
    table = QTable({"id": np.arange(4)})
    for name in CHAIN_BANDS:
        table[name], table[f"{name}_err"] = fluxes[name], 0.02 * fluxes[name]
    known = np.array(true["redshift"])
    results = finer.fit(table, redshift=known)
    # fluxes are good to half a percent, a quarter of their errors
    assert np.all(results.chi2 < len(CHAIN_BANDS) / 10)
    nodes = interpolated(grid, 0).fit(table, redshift=known)
    assert np.all(nodes.chi2 > 10 * results.chi2)
    for name in ("age", "tau", "ebv"):
        # of data without noise the best of the places is nearer than their scatter
        low, high = results.percentile(name, [0.16, 0.84]).value.T
        best = u.Quantity(results.best[name]).value
        assert np.all(np.abs(best - true[name].value) < high - low)


def test_a_finer_grid_is_of_the_model_that_made_the_grid(chain):
    model, grid = chain
    other = SEDModel.yang2021(libraries="bundled", frac_agn_definition="3-1000um")
    refuses("'finer' must be the model that made the grid", interpolated, grid, 10, other)
    refuses("'finer' must be an SEDModel", interpolated, grid, 10, grid)
    options = {"axes": CHAIN, "settings": GridSettings(interpolate=10, finer=other)}
    text = "'finer' must be left out when 'model' is an SEDModel"
    refuses(text, BayesFitter, model, CHAIN_BANDS, **options)
