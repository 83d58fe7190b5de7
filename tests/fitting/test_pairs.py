"""Joint posteriors of two parameters, against plain sums over models."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.grids import (
    CASES,
    brute_force,
    draw_photometry,
    free_parameters,
    make_grid,
    node_fitter,
)
from helpers.results import assert_same
from miricigale.fitting import FitResults, GridSettings


def free_pairs(fitter):
    """All pairs of parameters that have several values."""
    free = [name for name, axis in fitter.priors.axes.items() if axis.values.size > 1]
    # in both orders
    return [pair if i % 2 else pair[::-1] for i, pair in enumerate(combinations(free, 2))]


def plain(grid, weights, x, y, priors=None):
    """Joint posterior from the weights of all models (z, g, k, f)."""
    shares = {"redshift": ("z", np.eye(grid.redshift.size))}
    shares["frac_agn"] = "f", np.eye(grid.frac_agn.size)
    for name, kind, _, share, _ in free_parameters(grid, priors):
        shares[name] = {"galaxy": "g", "agn": "k"}[kind], share
    (of_x, part_x), (of_y, part_y) = shares[x], shares[y]
    return np.einsum(f"zgkf,x{of_x},y{of_y}->xy", weights, part_x, part_y)


@pytest.mark.parametrize("case", [*CASES, "CIGALE"])
def test_every_pair_is_the_sum_over_all_models(case):
    of_grid, options = CASES.get(case, ({}, {}))
    of_fitter = options | ({"compat": "cigale"} if case == "CIGALE" else {})
    grid = make_grid(3, **of_grid)
    prior_f = "uniform" if case == "prior_f by width" else "grid"
    table, _ = draw_photometry(grid, 4, seed=5, missing=0.2, noise=0.3)
    fitters = [
        node_fitter(grid, settings=GridSettings(prior_f, rtol=rtol), **of_fitter)
        for rtol in (0.0, 1e-6)
    ]
    pairs = free_pairs(fitters[0])
    exact, pruned = (fitter.fit(table, pairs=pairs) for fitter in fitters)
    assert exact.fitted.all()
    for i in range(len(table)):
        data = exact.flux[i], exact.sigma[i]
        weights = brute_force(grid, *data, prior_f=prior_f, **options)["weights"]
        for x, y in pairs:
            want = plain(grid, weights, x, y, options.get("priors"))
            for results, atol in ((exact, 1e-9), (pruned, 1e-6)):
                got = results.joint_pdf(x, y)[i]
                assert_allclose(got, want, rtol=0, atol=atol, err_msg=f"{x}, {y}")


def test_with_upper_limits_and_known_redshifts():
    grid = make_grid(6)
    fitter = node_fitter(grid, settings=GridSettings(rtol=0), n_bands_min=2)
    table, truth = draw_photometry(grid, 4, seed=8, noise=0.3)
    table["band1_limit"] = [True, True, False, True]
    table["band4_limit"] = [False, True, True, False]
    pairs = free_pairs(fitter)
    free = fitter.fit(table, pairs=pairs)
    fixed = fitter.fit(table, pairs=pairs, redshift="redshift")
    for i in range(len(table)):
        known = np.where(np.arange(grid.redshift.size) == truth[i][0], 0.0, -np.inf)
        for results, log_prior in ((free, None), (fixed, known)):
            data = results.flux[i], results.sigma[i], log_prior, results.limit[i]
            weights = brute_force(grid, *data)["weights"]
            for x, y in pairs:
                want = plain(grid, weights, x, y)
                assert_allclose(results.joint_pdf(x, y)[i], want, rtol=0, atol=1e-9)


def test_merged_models_are_as_all_of_them_apart():
    """A torus that stands for two temperatures times two laws, against the four one by one."""
    rng = np.random.default_rng(4)
    some = make_grid(4)
    rows = [(e, t, law) for e in (0.0, 0.3) for t in (100.0, 200.0) for law in (1.0, 2.0)]
    ebv, temperature, law = np.array(rows).T
    agn = 1e-36 * np.exp(rng.normal(0, 0.8, (some.redshift.size, 8, len(some.filters))))
    agn[:, :4] = agn[:, :1]
    power = rng.uniform(1.0, 3.0, 8)
    power[:4] = power[0]
    names = {"ebv_polar": [0.0, 0.3], "temperature_polar": [100.0, 200.0], "law": [1.0, 2.0]}
    parameters = QTable({"ebv_polar": ebv, "temperature_polar": temperature, "law": law})
    properties = QTable({"accretion_power": power, "ir_luminosity": power})

    def grid_of(rows, parameters, counts, inert):
        parts = {"agn": agn[:, rows], "agn_properties": properties[rows], "axes": names}
        parts |= {"agn_parameters": parameters, "agn_multiplicity": np.array(counts)}
        return replace(some, **parts, inert=inert)

    apart, keep = grid_of(slice(None), parameters, [1] * 8, ()), np.array([0, 4, 5, 6, 7])
    few = parameters[keep]
    few["temperature_polar"][0], few["law"][0] = 150.0, 1.5
    inert = [("temperature_polar", "law"), (), (), (), ()]
    merged = grid_of(keep, few, [4, 1, 1, 1, 1], inert)
    table, _ = draw_photometry(apart, 5, noise=0.3)
    priors = {"temperature_polar": [1.0, 3.0], "law": [2.0, 1.0]}
    options = {"settings": GridSettings(rtol=0), "priors": priors}
    one, two = (node_fitter(grid, **options) for grid in (merged, apart))
    pairs = free_pairs(two)
    one, two = one.fit(table, pairs=pairs), two.fit(table, pairs=pairs)
    assert {"ebv_polar", "temperature_polar", "law"} < set(one.axes)
    for x, y in pairs:
        assert_allclose(one.joint_pdf(x, y), two.joint_pdf(x, y), rtol=0, atol=1e-10)


@pytest.fixture(scope="module")
def fitter(grid):
    return node_fitter(grid)


@pytest.fixture(scope="module")
def results(fitter, photometry):
    table = QTable(photometry, copy=True)
    for name in fitter.grid.filters:
        # nothing to fit
        table[name][3] = np.nan
    return fitter.fit(table, pairs=free_pairs(fitter))


def test_marginals_are_the_posteriors_of_each(results):
    assert len(results.pairs) == 20  # of 7 parameters 21, one of which is always there
    for x, y in results.pairs:
        table = results.pairs[x, y]
        size = (results.axes[name].values.size for name in (x, y))
        assert table.shape == (len(results), *size)
        assert_allclose(table.sum(axis=2), results.pdf[x], rtol=0, atol=1e-6)
        assert_allclose(table.sum(axis=1), results.pdf[y], rtol=0, atol=1e-6)
        assert np.isnan(table[3]).all()
        assert not results.fitted[3]


def test_either_order_and_the_view_of_one_object(results):
    for x, y in [*results.pairs, ("redshift", "frac_agn")]:
        table = results.joint_pdf(x, y)
        assert_array_equal(results.joint_pdf(y, x), table.swapaxes(1, 2))
        assert_array_equal(results[5].joint_pdf(x, y), table[5])
        assert_array_equal(results[5].joint_pdf(y, x), table[5].T)
        with pytest.raises(ValueError, match="read-only"):
            table[0] = 0.0
    assert_array_equal(results.joint_pdf("redshift", "frac_agn"), results.pdf_2d)
    assert list(results[5].pairs) == list(results.pairs)


def test_nothing_else_changes_nor_does_the_cut(fitter, results, photometry, monkeypatch):
    pairs = list(results.pairs)
    whole = fitter.fit(photometry, pairs=pairs)
    without = fitter.fit(photometry)
    assert without.pairs == {}
    assert_same(replace(whole, pairs={}), without)
    assert_same(fitter.fit(photometry, pairs=pairs, chunk_size=5), whole)
    with ThreadPoolExecutor(2) as executor:
        assert_same(fitter.fit(photometry, pairs=pairs, chunk_size=3, executor=executor), whole)
    # one object at a time, as on large grids
    monkeypatch.setattr("miricigale.fitting.grid.grid_fit._JOINT_SIZE", 1)
    assert_same(fitter.fit(photometry, pairs=pairs), whole)
    empty = fitter.fit(photometry[:0], pairs=pairs)
    assert empty.joint_pdf("age", "tau").shape == (0, 4, 5)


def test_files_keep_them(results, tmp_path):
    results.write(tmp_path / "new.fits")
    assert_same(FitResults.read(tmp_path / "new.fits"), results)
    assert_same(results.with_model(None), results)


def test_cigale_forgets_them_where_its_weights_vanish(grid, photometry):
    table = QTable(photometry[:2], copy=True)
    for name in grid.filters:
        table[f"{name}_err"][0] = 1e-9 * table[name][0]
    fitter = node_fitter(grid, compat="cigale", model_error=0.0)
    results = fitter.fit(table, pairs=[("age", "redshift")])
    assert np.isnan(results.joint_pdf("age", "redshift")[0]).all()
    assert results.joint_pdf("age", "redshift")[1].sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("pairs", "error", "message"),
    [
        ([("mood", "age")], KeyError, "no parameter for 'pairs' 'mood'; known: age, ebv_polar"),
        ([("age", "age")], ValueError, "'pairs' must be of two different parameters"),
        ([("age", "mass")], ValueError, "'pairs' must be of parameters of the grid .*'mass'"),
        ([("frac_agn_ir", "age")], ValueError, "of the grid .*'frac_agn_ir'"),
        (("age", "tau"), ValueError, "'pairs' must be a list of pairs .*'age' in it"),
        ([3], ValueError, "'pairs' must be a list of pairs .*3 in it"),
    ],
)
def test_errors_name_the_argument(fitter, photometry, pairs, error, message):
    refuses(message, fitter.fit, photometry, error=error, pairs=pairs)
    for none in ([("age", "tau", "tau97")], ["ab"], "age", 3):
        refuses("'pairs' must be a list of pairs", fitter.fit, photometry, pairs=none)


def test_one_value_has_no_joint_posterior():
    grid = make_grid(n_z=1, n_tau=1)
    fitter = node_fitter(grid, priors={"tau": [1.0]})
    table, _ = draw_photometry(grid, 1)
    for own, pair, name in (
        (fitter, ("redshift", "age"), "redshift"),
        (fitter, ("tau", "age"), "tau"),
        (node_fitter(grid), ("age", "tau"), "tau"),
    ):
        refuses(f"several values, got '{name}', which has one", own.fit, table, pairs=[pair])


def test_the_same_pair_is_kept_once_and_no_other(fitter, photometry):
    pairs = [("age", "tau"), ("tau", "age"), ("frac_agn", "redshift"), ("age", "tau")]
    results = fitter.fit(photometry[:1], pairs=pairs)
    assert list(results.pairs) == [("age", "tau")]
    assert fitter.fit(photometry[:1], pairs=[]).pairs == {}
    text = "no joint posterior of tau97 and tau; known: age and tau, "
    refuses(text, results.joint_pdf, "tau97", "tau", error=KeyError)
    refuses("no parameter 'mood'", results[0].joint_pdf, "mood", "tau", error=KeyError)


def test_any_pair_is_drawn(results):
    from miricigale.plotting.axes import new_figure

    for x, y in [("age", "tau"), ("tau", "age"), ("redshift", "frac_agn"), ("tau97", "redshift")]:
        ax = new_figure()[1][0, 0]
        assert results[2].plot_pdf2d(x, y, ax=ax) is ax
        assert ax.get_xlabel().split()[0] == x
        assert ax.get_ylabel().split()[0] == y
        drawn = ax.collections[0].get_array()
        assert drawn.size == results.joint_pdf(x, y)[2].size
    assert ax.get_xlabel() == "tau97"
    ax = new_figure()[1][0, 0]
    assert results[2].plot_pdf2d("age", "tau", ax=ax).get_xlabel() == "age (Gyr)"
