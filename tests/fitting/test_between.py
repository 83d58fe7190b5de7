"""Posteriors between the nodes of a coarse grid, whose models follow a closed form."""

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
    """Fluxes and star-formation rates of one solar mass; logarithms are parabolas of the parameters."""
    z, t, e = (np.asarray(x, float)[..., None] for x in (redshift, tau, ebv))
    log = 1.5 * PLACE * np.log1p(z) + 0.3 * np.sin(3 * PLACE) * t - 2.0 * e * np.exp(-PLACE)
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
        agn_properties=QTable(),
        agn_multiplicity=np.zeros(0, int),
        axes=AXES,
    )


@pytest.fixture(scope="module")
def drawn():
    """200 objects drawn from the prior, which the cells around the nodes fill evenly."""
    rng = np.random.default_rng(8)
    ends = {"redshift": (0.35, 1.82), "tau": (0.5, 3.5), "ebv": (0.0, 0.85)}
    true = {name: rng.uniform(*pair, 200) for name, pair in ends.items()}
    model, sfr = flux(**true)
    model, true["sfr"] = 1e10 * model, 1e10 * sfr
    true["mass"] = np.full(200, 1e10)
    table = QTable({"id": np.arange(200), "z": true["redshift"]})
    for i, name in enumerate(BANDS):
        error = SIGMA * model[:, i]
        table[name] = (model[:, i] + error * rng.normal(size=200)) * u.uJy
        table[f"{name}_err"] = error * u.uJy
    return table, true


def coverage(results, true, name):
    low, high = results.percentile(name, [0.16, 0.84]).value.T
    return np.mean((true[name] >= low) & (true[name] <= high))


def test_intervals_hold_the_truth_between_nodes(grid, drawn):
    table, true = drawn
    results = BayesFitter(grid, model_error=0.0, interpolate=300).fit(table)
    nodes = BayesFitter(grid, model_error=0.0).fit(table)
    for name in ("redshift", "tau", "ebv", "mass", "sfr"):
        # three times the binomial error of 200 objects
        assert abs(coverage(results, true, name) - 0.68) < 0.1, name
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
    inside = (true["redshift"] > 0.5) & (true["redshift"] < 1.6)
    table, true = table[inside], {name: value[inside] for name, value in true.items()}
    results = BayesFitter(grid, model_error=0.0, interpolate=300).fit(table, redshift="z")
    np.testing.assert_allclose(results.percentile("redshift", 0.5).value[:, 0], true["redshift"])
    # intervals allow for errors of interpolation, of which there are hardly any here
    for name in ("ebv", "mass", "sfr"):
        assert coverage(results, true, name) > 0.6, name


def test_the_same_objects_have_the_same_draws(grid, drawn):
    table, _ = drawn
    fitter = BayesFitter(grid, model_error=0.0, interpolate=50)
    some, turned = fitter.fit(table[:6]), fitter.fit(table[:6][::-1])
    np.testing.assert_array_equal(
        some.percentile("mass", [0.16, 0.5]), turned.percentile("mass", [0.16, 0.5])[::-1]
    )
    with pytest.raises(ValueError, match="'interpolate' must be an integer >= 0"):
        BayesFitter(grid, interpolate=-1)
