"""The look at nodes that sampling between them begins with, against the sums over all of them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from miricigale.fitting import BayesFitter, GridSettings, MassFunction
from miricigale.fitting.grid.node_scan import NodeScan
from miricigale.fitting.grid.placed_models import thinned
from miricigale.sed import SEDModel

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
AXES = {
    "redshift": np.linspace(0.3, 1.5, 9),
    # at most redshifts the universe is younger than the last
    "age": [1.0, 3.0, 9.0],
    "ebv": [0.1, 0.3, 0.5],
    "tau97": [3.0, 7.0],
    "frac_agn": [0.0, 0.2, 0.5, 0.8],
}
N_DRAWS = 4000


@pytest.fixture(scope="module")
def engine():
    model = SEDModel.yang2021(libraries="bundled")
    grid = model.grid(AXES, BANDS)
    settings = GridSettings(interpolate=0, mass_function=MassFunction())
    return BayesFitter(grid, model_error=0.3, settings=settings).backend.engine


@pytest.fixture(scope="module")
def objects(engine):
    """Fluxes and errors of models with and without AGN, and priors of redshift."""
    grid = engine.grid
    galaxy = 3e10 * grid.galaxy[[2, 5, 7], [0, 1, 2]]
    power = 3e10 * grid.dust_luminosity[[1]] * 1.0
    flux = galaxy.copy()
    flux[1] += power * grid.agn[5, 1]
    sigma = 0.3 * flux
    # a band without a measurement
    sigma[2, 1] = np.inf
    return flux, sigma, np.zeros((3, grid.redshift.size))


def test_draws_follow_the_sums_over_nodes(engine, objects):
    sums = engine.fit(*objects)
    scanned = {}
    NodeScan(engine, N_DRAWS).fit(*objects, lambda known: scanned.update({known.row: known}))
    for i in range(3):
        start = scanned[i].start
        z = np.bincount(start.index[:, 0], minlength=9) / N_DRAWS
        assert_allclose(z, start.zf.sum(axis=1), atol=1.5 / N_DRAWS)
        # the scan takes each pair of models at its best fraction
        assert_allclose(z, sums.zf[i].sum(axis=1), atol=0.08)
        frac = np.bincount(start.index[:, 3], minlength=4) / N_DRAWS
        assert_allclose(frac, sums.zf[i].sum(axis=0), atol=0.1)
        galaxy = np.bincount(start.index[:, 1], minlength=engine.size["g"]) / N_DRAWS
        assert_allclose(galaxy, sums.galaxy[i], atol=0.1)
        assert_array_equal(start.index[:, 2] < 0, start.index[:, 3] == 0)


def test_sharp_peaks_are_at_their_node(engine, objects):
    """Errors of 1 % leave the true redshift alone, which a scan of every other one may pass over."""
    flux, _, log_prior = objects
    scanned = {}
    scan = NodeScan(engine, 64)
    scan.fit(flux, 0.01 * flux, log_prior, lambda known: scanned.update({known.row: known}))
    for i, node in enumerate((2, 5, 7)):
        assert_array_equal(scanned[i].start.index[:, 0], node)


def test_evidence_has_the_same_prior_of_mass(engine, objects):
    sums = []
    engine.fit(*objects, each=lambda known: sums.append((known.log_norm, known.zero)))
    scans = []
    scan = NodeScan(engine, 8)
    scan.fit(*objects, lambda known: scans.append((known.log_norm, known.zero)))
    assert_allclose(scans, sums, atol=1e-3)


def test_objects_do_not_depend_on_their_neighbors(engine, objects):
    together = {}
    alone = {}
    scan = NodeScan(engine, 64)
    scan.fit(*objects, lambda known: together.update({known.row: known.start.index}))
    for i in range(3):
        row = [array[i : i + 1] for array in objects]
        scan.fit(*row, lambda known, i=i: alone.update({i: known.start.index}))
        assert_array_equal(alone[i], together[i])


def test_known_redshifts_are_those_of_their_nodes(engine, objects):
    nodes = np.array([2, 5, 7])
    known = []
    NodeScan(engine, 64).fit(*objects, known.append, nodes=nodes)
    free = {}
    flux, sigma, log_prior = objects
    log_prior = np.full(log_prior.shape, -np.inf)
    log_prior[np.arange(3), nodes] = 0.0
    scan = NodeScan(engine, 64)
    scan.fit(flux, sigma, log_prior, lambda one: free.update({one.row: one.start.index}))
    for i, each in enumerate(known):
        assert_array_equal(each.start.index[:, 0], 0)
        assert_array_equal(each.start.index[:, 1:], free[i][:, 1:])


def test_thinned_weights_keep_their_sums():
    rng = np.random.default_rng(4)
    weight = rng.exponential(size=5000) ** 3
    always = np.zeros(5000, bool)
    always[17] = True
    index, new = thinned(np.arange(5000), weight, always, 1000)
    assert abs(len(index) - 1000) <= 2
    assert new[index == 17] == weight[17]
    level = new.min() if new.min() != weight[17] else np.sort(new)[1]
    large = weight > level
    assert_allclose(new[np.isin(index, np.flatnonzero(large))], weight[large])
    # every stretch has the weight that it had, to one place
    upto = np.cumsum(weight)
    upto_new = np.cumsum(np.bincount(index, new, minlength=5000))
    assert np.abs(upto - upto_new).max() <= level
