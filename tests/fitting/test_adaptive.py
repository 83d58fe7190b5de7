"""Adaptive importance sampling between nodes, against closed forms and sums over many models of the prior."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import chdtri, ndtri
from scipy.stats import multivariate_normal, multivariate_t, norm, qmc, t

from helpers.grids import photometry_table
from miricigale.fitting import BayesFitter, FitFlags, GridSettings, _core
from miricigale.fitting.grid.peaks import redshift_peaks
from miricigale.fitting.grid.place_sets import Collection, fitted_peaks
from miricigale.fitting.grid.points import quasi_random
from miricigale.fitting.grid.proposals import FittedParts
from miricigale.fitting.posterior.quantities import (
    DERIVED_LEVELS,
    draws_summary,
    percentile_error,
)
from miricigale.sed import ModelGrid
from miricigale.utils.exceptions import FitWarning

BANDS = tuple(f"band{i}" for i in range(6))
PLACE = np.linspace(-1.0, 1.0, len(BANDS))
REDSHIFT = np.linspace(0.2, 3.0, 29)
TAU = np.array([0.5, 1.0, 2.0])
EBV = np.array([0.0, 0.2, 0.6])
BURST = np.array([0.0, 0.1, 0.3])
METALLICITY = np.array([0.004, 0.02])
FRACTION = np.array([0.0, 0.2, 0.5, 0.8])
#: Prior weights of nodes of E(B-V) and AGN fractions.
WEIGHTS = {"ebv": [0.3, 0.5, 0.2], "frac_agn": [0.7, 0.2, 0.05, 0.05]}


def galaxy_flux(z, tau, ebv, burst, metallicity):
    """Fluxes of a solar mass: two redshifts look alike, but for the last band."""
    z, tau, ebv, burst, metallicity = (
        np.asarray(x, float)[..., None] for x in (z, tau, ebv, burst, metallicity)
    )
    log = 0.8 * PLACE * np.cos(2.4 * z) + 0.2 * np.sin(3 * PLACE) * tau - ebv * np.exp(-PLACE)
    log = log - burst * PLACE + 10 * (metallicity - 0.01) * np.cos(4 * PLACE) + 0.1 * z * PLACE**5
    return 1e-9 * np.exp(log)


def torus_flux(z):
    return 1e-36 * np.exp(2 * PLACE + 0.2 * np.asarray(z, float)[..., None])


@pytest.fixture(scope="module")
def grid():
    """54 galaxies with and without dust and burst, of two metallicities, and one torus."""
    axes = {"tau": TAU, "ebv": EBV, "f_burst": BURST, "metallicity": METALLICITY}
    values = [x.ravel() for x in np.meshgrid(*axes.values(), indexing="ij")]
    n = values[0].size
    units = (u.Gyr, u.mag, 1, 1)
    table = QTable({name: x * unit for name, x, unit in zip(axes, values, units, strict=True)})
    return ModelGrid(
        filters=BANDS,
        redshift=REDSHIFT,
        galaxy=galaxy_flux(REDSHIFT[:, None], *values),
        agn=torus_flux(REDSHIFT[:, None]),
        agn_multiplicity=np.ones(1, int),
        agn_parameters=QTable({"tau97": [5.0]}),
        agn_properties=QTable({"luminosity": [1.0]}),
        dust_luminosity=np.full(n, 1e27),
        frac_agn=FRACTION,
        allowed=np.ones((REDSHIFT.size, n), bool),
        galaxy_parameters=table,
        galaxy_properties=QTable({"sfr": np.full(n, 1e-10) / u.yr}),
        axes=axes | {"redshift": REDSHIFT, "frac_agn": FRACTION},
    )


@pytest.fixture(scope="module")
def fitter(grid):
    settings = GridSettings(interpolate=1000)
    return BayesFitter(grid, model_error=0.0, priors=WEIGHTS, settings=settings)


@pytest.fixture(scope="module")
def table():
    """Galaxies without anything else, with all of it, and with two redshifts."""
    rng = np.random.default_rng(2)
    z, tau = np.array([0.9, 0.9, 0.6]), np.array([1.0, 1.4, 0.8])
    ebv, burst, f = np.array([0.0, 0.4, 0.3]), np.array([0.0, 0.2, 0.05]), np.array([0.0, 0.6, 0.1])
    model = galaxy_flux(z, tau, ebv, burst, np.array([0.02, 0.004, 0.02]))
    model = 1e10 * (model + (f / (1 - f) * 1e27)[:, None] * torus_flux(z))
    error = np.array([0.05, 0.08, 0.12])[:, None] * model
    return photometry_table(BANDS, model + error * rng.normal(size=model.shape), error)


def cell_values(uniform, nodes, weights=None, *, absent=False, label=False):
    """Values of the prior between nodes: 0 or the value itself, or anywhere in the cell of a node."""
    weights = np.ones(nodes.size) if weights is None else np.asarray(weights)
    below = np.concatenate([[0.0], np.cumsum(weights / weights.sum())])
    node = np.minimum(np.searchsorted(below, uniform, side="right") - 1, nodes.size - 1)
    edges = np.concatenate([nodes[:1], 0.5 * (nodes[1:] + nodes[:-1]), nodes[-1:]])
    low, high = edges[:-1].copy(), edges[1:].copy()
    if absent:
        low[:2], high[0] = 0.0, 0.0
    if label:
        low = high = nodes
    part = (uniform - below[node]) / (below[node + 1] - below[node])
    return low[node] + part * (high - low)[node]


@pytest.fixture(scope="module")
def by_hand(table):
    """The same posteriors by sums over 262,144 models of the prior: values and weights of each object."""
    x = qmc.Sobol(6, seed=11).random_base2(18)
    z, tau = cell_values(x[:, 0], REDSHIFT), cell_values(x[:, 1], TAU)
    ebv = cell_values(x[:, 2], EBV, WEIGHTS["ebv"], absent=True)
    burst = cell_values(x[:, 3], BURST, absent=True)
    metallicity = cell_values(x[:, 4], METALLICITY, label=True)
    f = cell_values(x[:, 5], FRACTION, WEIGHTS["frac_agn"], absent=True)
    model = galaxy_flux(z, tau, ebv, burst, metallicity)
    model += (f / (1 - f) * 1e27)[:, None] * torus_flux(z)
    values = {"redshift": z, "tau": tau, "ebv": ebv, "f_burst": burst, "metallicity": metallicity}
    values["frac_agn"] = f
    weights = []
    for i in range(3):
        data, error = (
            np.array([table[name + end][i].value for name in BANDS]) for end in ("", "_err")
        )
        p, q = np.sum(model * data / error**2, 1), np.sum(model**2 / error**2, 1)
        log = 0.5 * p**2 / q
        weight = np.exp(log - log.max())
        weights.append(weight / weight.sum())
    return values, weights


@pytest.fixture(scope="module")
def results(fitter, table):
    return fitter.fit(table)


def test_parts_are_fitted_where_places_show_a_shape():
    assert_array_equal(fitted_peaks(np.array([100, 20, 100, 0])), [0, 1, 2])
    assert_array_equal(fitted_peaks(np.array([100, 19, 0])), [0])
    # few places with all of the weight, as of one in 5,229 sources of CEERS
    assert_array_equal(fitted_peaks(np.array([6, 0, 5])), [0, 2])


@pytest.mark.slow
def test_posteriors_are_sums_over_the_prior(results, by_hand):
    """Of a grid whose logarithms are nearly parabolas, so that models between its nodes are known."""
    values, weights = by_hand
    assert not np.any(results.flags & int(FitFlags.NOT_CONVERGED))
    for i, weight in enumerate(weights):
        for name, value in values.items():
            mean = weight @ value
            std = np.sqrt(weight @ (value - mean) ** 2)
            # the sum itself has an effective number of some thousand
            assert results.mean(name).value[i] == pytest.approx(mean, abs=0.1 * std + 2e-3), (
                i,
                name,
            )
            assert results.std(name).value[i] == pytest.approx(std, rel=0.12, abs=0.01), (i, name)


def test_what_may_be_absent_has_an_atom(results, by_hand):
    """How likely a component is absent, and percentiles that are 0 where that says so."""
    values, weights = by_hand
    for name in ("ebv", "f_burst", "frac_agn"):
        absent = np.array([weight[values[name] == 0].sum() for weight in weights])
        assert_allclose(results.pdf[name][:, 0], absent, atol=0.04)
        edges, _ = results[0].distribution(name)
        assert_array_equal(edges.value[:2], 0.0)
        for level in (0.16, 0.5, 0.84):
            is_zero = results.percentile(name, level).value == 0
            clear = np.abs(absent - level) > 0.04
            assert_array_equal(is_zero[clear], (absent > level)[clear])
    assert results.pdf["frac_agn"][0, 0] > 0.7
    assert results.pdf["frac_agn"][1, 0] < 0.01
    assert set(results.percentile("metallicity", [0.16, 0.84]).value.ravel()) <= set(METALLICITY)


def test_peaks_have_their_weights(fitter, results, by_hand):
    """Two redshifts of the third object, of which nodes say where they are."""
    (values, weights), z = by_hand, REDSHIFT
    share = weights[2][values["redshift"] > 1.3].sum()
    assert 0.02 < share < 0.98
    assert results.pdf["redshift"][2][z > 1.3].sum() == pytest.approx(share, abs=0.03)


def test_names_and_places_in_a_catalog_are_no_matter(fitter, table, results):
    """The same photometry under other names, in other rows and pieces: the same bytes."""
    other = table[[2, 0, 1, 0]]
    other["id"] = ["x", "y", "z", "w"]
    others = fitter.fit(other, chunk_size=1)
    for mine, theirs in ((2, 0), (0, 1), (1, 2), (0, 3)):
        for name in ("moments", "quantiles", "axis_moments", "axis_quantiles", "pdf_2d", "flags"):
            assert_array_equal(getattr(results, name)[mine], getattr(others, name)[theirs])
        for name in results.axes:
            assert_array_equal(results.pdf[name][mine], others.pdf[name][theirs])


def test_workers_do_not_matter(fitter, table, results):
    """Objects fitted by several threads, one at a time, have the same bytes."""
    with ThreadPoolExecutor(3) as executor:
        others = fitter.fit(table, chunk_size=1, executor=executor)
    for name in ("moments", "quantiles", "axis_moments", "axis_quantiles", "pdf_2d", "flags"):
        assert_array_equal(getattr(results, name), getattr(others, name))


def test_what_is_not_converged_is_flagged(grid, table, monkeypatch):
    monkeypatch.setattr("miricigale.fitting.grid.adaptive._MAX_PLACES_EACH", 1)
    monkeypatch.setattr("miricigale.fitting.grid.adaptive._MIN_MAX_PLACES", 512)
    monkeypatch.setattr("miricigale.fitting.grid.tempering.MIN_PLACES", 64)
    monkeypatch.setattr("miricigale.fitting.grid.tempering._PLACES_EACH", 0.0)
    fitter = BayesFitter(grid, model_error=0.0, settings=GridSettings(interpolate=1000))
    n = len(table)
    with pytest.warns(
        FitWarning, match=f"^{n} of {n} fits are not converged .*interpolate="
    ) as caught:
        flags = fitter.fit(table).flags
    assert np.all(flags & int(FitFlags.NOT_CONVERGED))
    # once, not by object
    assert len(caught) == 1


def _labels(n_axes):
    """One label, all of whose axes matter."""
    below = np.tile([0.0, 1.0], (n_axes, 1))
    ones = np.ones((1, n_axes), np.int64)
    axes = np.arange(n_axes)[None]
    return _core.Labels(0 * ones, ones, axes, np.array([n_axes]), below, np.zeros((n_axes, 1)))


@pytest.fixture(scope="module")
def mixture():
    """Labels and parts fitted to two clouds of normal points in three axes, and the points."""
    rng, n_axes, n = np.random.default_rng(3), 3, 4000
    cov = [[1.0, 0.6, 0.0], [0.6, 1.0, 0.3], [0.0, 0.3, 0.5]]
    points = rng.multivariate_normal([-4.0, 0.0, 1.0], cov, n // 2)
    points = np.concatenate(
        [points, rng.multivariate_normal([4.0, 1.0, 0.0], 0.2 * np.eye(3), n // 2)]
    )
    square = 2, n_axes, n_axes
    parts = _core.Parts(
        np.array([0, 2]), np.zeros(2, np.int64), np.ones(2), np.ones(2), np.zeros((2, n_axes)),
        np.zeros(square), np.zeros(square),
    )  # fmt: skip
    scratch = np.empty((n_axes + 2, n)), np.empty((3, n)), np.empty((n_axes, n_axes)), np.empty(2)
    given = 0, 0, 2, 10, 1.0, points, np.ones(n), np.zeros(n_axes), np.eye(n_axes)
    _core.fit_parts(_labels(n_axes), parts, *given, scratch)
    return _labels(n_axes), parts, points, cov


def test_parts_are_fitted_to_points(mixture):
    _, parts, _, cov = mixture
    assert_allclose(parts.share, 0.5, atol=0.01)
    order = np.argsort(parts.mean[:, 0])
    assert_allclose(parts.mean[order], [[-4, 0, 1], [4, 1, 0]], atol=0.1)
    roots = np.tril(parts.root[order])
    assert_allclose(roots[0] @ roots[0].T, cov, atol=0.12)
    assert_allclose(roots[1] @ roots[1].T, 0.2 * np.eye(3), atol=0.02)


def test_densities_are_those_of_t_distributions(mixture):
    """And weights of draws over them give the integral and moments of a normal distribution."""
    labels, parts, _, cov = mixture
    n, n_axes = 2048, 3
    choice, _, normal, spread = (x[:n] for x in quasi_random(n_axes, 11, 1))
    label, y = np.empty(n, np.int64), np.empty((n, n_axes))
    _core.propose(labels, parts, np.cumsum(parts.share), choice, normal, spread, label, y)
    # each part has its share of the draws
    assert np.mean(y[:, 0] > 0) == pytest.approx(parts.share[parts.mean[:, 0] > 0].sum(), abs=0.02)
    density = np.zeros((2, n))
    column = np.array([0, 1])
    places = (np.array([[0, n]]), y, np.empty((n_axes + 2, n)), density)
    _core.add_density(labels, parts, column, *places)
    density = density.sum(axis=0)
    want = 0.0
    for share, mean, root in zip(parts.share, parts.mean, np.tril(parts.root), strict=True):
        want = want + share * multivariate_t(mean, root @ root.T, df=_core.FREEDOM).pdf(y)
    assert_allclose(density, want, rtol=1e-9)
    assert 0.4 < np.mean(y[:, 0] > 0) < 0.6
    target = multivariate_normal([-4.2, 0.2, 1.0], cov)
    weight = target.pdf(y) / density / n
    assert weight.sum() == pytest.approx(1.0, abs=0.03)
    mean = weight @ y / weight.sum()
    assert_allclose(mean, [-4.2, 0.2, 1.0], atol=0.05)
    apart = y - mean
    assert_allclose((apart * weight[:, None]).T @ apart / weight.sum(), cov, atol=0.08)


def test_mixtures_add_up_in_each_label():
    """Of two mixtures each is good in one label: weights of labels come out, of more places than of one."""
    rng = np.random.default_rng(5)
    n = 2048
    evidence = np.array([0.7, 0.3])
    sampler = SimpleNamespace(n=0, n_groups=2, peaks=np.ones(1), label=np.zeros(2 * n, int))
    parts = FittedParts(None, np.array([0, 1]))
    collection = Collection(parts, np.ones(2), sampler)
    group = np.repeat([0, 1], n // 2)
    alone = []
    for k, middles in enumerate(([0.2, 2.0], [-2.5, 0.1])):
        if k:
            collection.begin(parts, n)
        middle = np.array(middles)[group]
        y = rng.standard_t(_core.FREEDOM, n) + middle
        # half of the places are drawn in each label
        density = 0.5 * t(_core.FREEDOM).pdf(y - middle)
        weight = evidence[group] * norm.pdf(y) / density
        alone.append(weight.sum() ** 2 / np.sum(weight**2))
        top = weight.max()
        together, log_unit = collection.weigh(weight / top, np.log(top), group)
        if k == 0:
            assert_allclose(together * np.exp(log_unit), weight / n, rtol=1e-12)
    together = together * np.exp(log_unit)
    sums = np.bincount(np.tile(group, 2), together)
    assert_allclose(sums, evidence, rtol=0.03)
    assert together.sum() ** 2 / np.sum(together**2) > 1.5 * max(alone)


def test_local_parts_go_where_weights_are_large():
    """A curved ridge (Rosenbrock's): its evidence is 1, and weights of draws become much more equal."""
    rng = np.random.default_rng(8)
    n_axes, n, n_local = 2, 4000, 16
    width = 0.15

    def log_ridge(y):
        across = (y[:, 1] - y[:, 0] ** 2 + 1.0) / width
        return -0.5 * (y[:, 0] ** 2 + across**2) - np.log(2.0 * np.pi * width)

    points = rng.standard_normal((n, n_axes))
    points[:, 1] = points[:, 0] ** 2 - 1.0 + width * points[:, 1]
    n_parts = 1 + n_local
    square = (n_parts, n_axes, n_axes)
    parts = _core.Parts(
        start=np.array([0, n_parts]),
        label=np.zeros(n_parts, np.int64),
        share=np.zeros(n_parts),
        top=np.zeros(n_parts),
        mean=np.zeros((n_parts, n_axes)),
        root=np.zeros(square),
        inverse=np.zeros(square),
    )
    scratch = (np.empty((n_axes + 2, n)), np.empty((2, n)), np.empty((2, 2)), np.empty(1))
    settings = (0, 0, 1, 1, 1.1)
    cloud = (points, np.ones(n), np.zeros(n_axes), np.eye(n_axes))
    _core.fit_parts(_labels(n_axes), parts, *settings, *cloud, scratch)

    def effective(parts):
        size = 1 << 15
        choice, _, normal, spread = quasi_random(n_axes, 15, 1)
        label = np.empty(size, np.int64)
        y = np.empty((size, n_axes))
        upto = np.cumsum(parts.share)
        _core.propose(_labels(n_axes), parts, upto, choice, normal, spread, label, y)
        density = np.zeros((1, size))
        places = (np.array([[0, size]]), y, np.empty((n_axes + 2, size)), density)
        _core.add_density(_labels(n_axes), parts, np.zeros(n_parts, np.int64), *places)
        weight = np.exp(log_ridge(y)) / density[0] / size
        return weight.sum(), weight.sum() ** 2 / np.sum(weight**2)

    evidence, before = effective(parts)
    assert evidence == pytest.approx(1.0, abs=0.05)
    scratch = (
        np.empty((n_axes + 2, n)),
        np.empty((4, n)),
        np.empty((n_axes, n)),
        np.empty((2, 2)),
        np.empty((2, 2)),
    )
    known = (points, np.full(n, 1.0 / n), np.exp(log_ridge(points)))
    _core.add_local_parts(_labels(n_axes), parts, 0, 1, n_local, 0.6, 160, 1.1, known, scratch)
    assert parts.share.sum() == pytest.approx(1.0)
    # along the ridge, each of them
    across = parts.mean[1:, 1] - parts.mean[1:, 0] ** 2 + 1.0
    assert np.all(np.abs(across) < 4 * width)
    evidence, after = effective(parts)
    assert evidence == pytest.approx(1.0, abs=0.03)
    assert after > 3.0 * before


def test_points_are_normal_and_chi2_numbers():
    choice, uniform, normal, spread = quasi_random(4, 12, 3)
    for values in (choice, uniform):
        assert_allclose(np.quantile(values, [0.1, 0.5, 0.9]), [0.1, 0.5, 0.9], atol=1e-3)
    assert_allclose(
        np.quantile(normal, [0.16, 0.84], axis=0).T, [ndtri([0.16, 0.84])] * 4, atol=0.01
    )
    chi2 = _core.FREEDOM / spread**2
    assert_allclose(np.quantile(chi2, 0.9), chdtri(_core.FREEDOM, 0.1), rtol=0.01)


def test_peaks_are_parted_by_nodes_without_weight():
    z = np.linspace(0.0, 3.0, 21)
    posterior = np.where(np.abs(z - 0.6) < 0.24, 0.2, 0.0) + np.where(
        np.abs(z - 2.4) < 0.24, 0.1, 0.0
    )
    borders, weights = redshift_peaks(z, posterior / posterior.sum())
    # in the middle of the gap
    assert_allclose(borders, [1.5])
    assert_allclose(weights, [2 / 3, 1 / 3])


def test_weighted_summaries_are_those_of_repeated_draws():
    rng = np.random.default_rng(1)
    value, times = rng.lognormal(size=400), rng.integers(1, 9, size=400)
    moments, quantiles = draws_summary(value, weight=times.astype(float))
    repeated = np.repeat(value, times)
    want = draws_summary(repeated)
    assert_allclose(moments, want[0])
    middle = slice(3, -3)
    place = np.interp(quantiles[middle], np.sort(value), np.arange(400))
    expected = np.interp(want[1][middle], np.sort(value), np.arange(400))
    assert_allclose(place, expected, atol=1.5)
    assert quantiles.size == DERIVED_LEVELS.size


def test_errors_of_percentiles_are_those_of_order_statistics():
    n = 1600
    normal = ndtri((np.arange(n) + 0.5) / n)
    equal = np.full(n, 1 / n)
    # asymptotic variance p (1 - p) / n f^2, largest at 16 and 84 %; half of the interval is 0.994
    density = np.exp(-0.5 * ndtri(0.84) ** 2) / np.sqrt(2 * np.pi)
    expected = np.sqrt(0.16 * 0.84 / n) / density / ndtri(0.84)
    assert percentile_error(normal, equal) == pytest.approx(expected, rel=0.02)
    # the same draws in pairs of weights 1 and 3 count as 0.8 of their number
    unequal = np.where(np.arange(n) % 2, 1.5, 0.5) / n
    assert percentile_error(normal, unequal) == pytest.approx(expected / np.sqrt(0.8), rel=0.02)
    # a peak that has the part of the weight at which a percentile stands: it is in one or the other
    two_peaks = np.where(np.arange(n) < 0.84 * n, 0.01 * normal, 10 + 0.01 * normal)
    assert percentile_error(two_peaks, equal) > 0.4
    assert percentile_error(np.where(np.arange(n) < 0.3 * n, 0.0, normal), equal) < 0.1
    assert percentile_error(np.ones(n), equal) == 0
    # nothing for most, and much for the others: no overflow
    dust = np.where(np.arange(n) < 0.84 * n, 1e-300 * np.exp(normal), 1e37)
    assert percentile_error(dust, equal) > 1


def test_percentiles_between_peaks_get_more_models(fitter, table):
    """The scatter over scrambles of percentiles that are converged is a small part of the interval."""
    between = fitter.backend.between
    percentiles = []
    converged = np.ones(len(table), bool)
    for scramble in range(1, 7):
        new = fitter.replace()
        new.backend = replace(fitter.backend, between=replace(between, scramble=scramble))
        results = new.fit(table)
        converged &= (results.flags & FitFlags.NOT_CONVERGED) == 0
        percentiles.append(results.percentile("redshift", (0.16, 0.5, 0.84)).value)
    percentiles = np.array(percentiles)
    half_width = 0.5 * np.median(percentiles[..., 2] - percentiles[..., 0], axis=0)
    scatter = percentiles.std(axis=0, ddof=1) / half_width[:, None]
    assert converged.any()
    assert scatter[converged].max() < 0.3
    assert np.mean(scatter[converged] < 0.15) > 0.9


def test_weights_are_posteriors_over_densities():
    """Of two peaks and three labels, over what they were proposed by; places without probability have none."""
    rng = np.random.default_rng(4)
    n, first = 1000, 7
    share = rng.random((3, 2))
    label = rng.integers(0, 3, n)
    of_peak = np.exp(rng.normal(0.0, 30.0, (2, first + n + 5)))
    density = np.empty(n)
    _core.mix_peaks(share, label, of_peak, first, density)
    want = np.sum(share[label].T * of_peak[:, first : first + n], axis=0)
    assert_allclose(density, want, rtol=1e-12)
    evaluated = rng.normal(-1e4, 30.0, (n, 5))
    evaluated[:50, 0] = _core.NEVER
    weight = np.empty(n)
    top, mean = _core.weigh_places(evaluated, density, weight)
    log = evaluated[:, 0] - np.log(density)
    assert top == pytest.approx(log.max(), rel=1e-12)
    assert_allclose(weight, np.exp(np.maximum(log - log.max(), -700.0)), rtol=1e-8)
    assert mean == pytest.approx(weight.mean())
    evaluated[:, 0] = _core.NEVER
    assert _core.weigh_places(evaluated, density, weight)[0] < 0.5 * _core.NEVER


def test_places_go_where_they_are_inefficient():
    """What lacks an effective number gets as many places as its efficiency asks for."""
    # of the second group one weight in 100 counts
    n = np.array([2000, 1000])
    weight = np.concatenate([np.ones(n[0]), np.zeros(n[1])])
    weight[n[0] :: 100] = 10.0
    group = np.repeat([0, 1], n)
    sets = _core.make_group_sets([[0], [1]])
    wanted = np.empty(2)
    limits = 600.0, 30.0, 1e-3
    effective, enough = _core.allocate_places(
        weight, group, sets, *limits, np.empty((3, 2)), wanted
    )
    assert effective == pytest.approx(weight.sum() ** 2 / np.sum(weight**2))
    # 10 effective places of 1000 are too few
    assert not enough
    assert wanted[1] == pytest.approx(30.0 / 0.01, rel=0.1)
    assert wanted[0] < n[0]
