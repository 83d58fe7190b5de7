"""Draws as the data of ArviZ."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.grids import node_fitter

REASON = "needs arviz: pip install miricigale[arviz]"


@pytest.fixture(scope="module")
def fitter(grid):
    return node_fitter(grid)


@pytest.fixture(scope="module")
def results(fitter, photometry):
    return fitter.fit(photometry[:3])


@pytest.fixture(scope="module")
def samples(fitter, photometry):
    return fitter.sample(photometry[:3], 40, seed=1)


def test_groups_hold_the_draws_and_the_photometry(samples, results):
    arviz = pytest.importorskip("arviz", reason=REASON)
    data = samples.to_arviz(["z", "stellar.m_star"], results=results)
    posterior = data["posterior"]
    assert list(posterior.data_vars) == ["redshift", "stellar_mass"]
    assert dict(posterior.sizes) == {"chain": 1, "draw": 40, "object": len(samples)}
    assert_array_equal(posterior["object"], samples.ids)
    mass = samples.values("stellar_mass")
    assert_array_equal(posterior["stellar_mass"][0].T, mass.value)
    assert posterior["stellar_mass"].attrs["units"] == mass.unit.to_string()
    assert_array_equal(data["observed_data"]["flux"], results.flux)
    assert list(data["observed_data"]["band"].values) == list(results.filters)
    assert_array_equal(data["constant_data"]["flux_err"], results.flux_err)
    # what ArviZ makes of it: its means are those of the draws
    mean = arviz.summary(data, var_names=["redshift"], kind="stats")["mean"]
    assert_allclose(np.asarray(mean, float), samples.mean("redshift").value, atol=6e-3)


def test_single_object_and_results_of_a_grid(samples, results):
    pytest.importorskip("arviz", reason=REASON)
    data = results[1].to_arviz(["redshift"], samples=samples[1])
    assert dict(data["posterior"].sizes) == {"chain": 1, "draw": 40}
    assert_array_equal(data["posterior"]["redshift"][0], samples[1].values("redshift").value)
    assert data["observed_data"]["flux"].shape == (len(results.filters),)
    assert set(samples.to_arviz()["posterior"].data_vars) == set(samples.parameters)


def test_draws_and_results_must_be_of_the_same_objects(samples, results):
    refuses(r"hold no draws: to_arviz\(samples=fitter.sample\(", results.to_arviz)
    of_others = "'results' must be of the objects of the draws, in their order"
    refuses(of_others, results[1].to_arviz, samples=samples)
    refuses("'results' must be FitResults", samples.to_arviz, results=samples)
