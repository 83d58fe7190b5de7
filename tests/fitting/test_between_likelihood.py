"""Posteriors between nodes, with each likelihood and prior, against plain sums over models in closed form."""

import functools

import astropy.units as u
import numpy as np
import pytest
from astropy.cosmology import FlatLambdaCDM
from astropy.table import QTable
from numpy.testing import assert_allclose
from scipy.special import log_ndtr

from fitting.test_between import AXES, flux
from helpers.grids import photometry_table
from miricigale.fitting import BayesFitter, GridSettings, TemplateError
from miricigale.sed import ModelGrid

BANDS = (
    "acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1", "irac.ch2", "miri.f770w",
    "miri.f1000w",
)  # fmt: skip
#: Objects, places in each cell, errors of fluxes over these, prior fraction of wrong bands.
N, FINE, NOISE, PART = 5, 8, 0.15, 0.1
ERROR = TemplateError([0.1, 0.3, 0.8, 2.0, 10.0] * u.um, [0.5, 0.02, 0.05, 0.3, 0.6])
SCATTER = 0.3
#: Of the logarithm of scales.
STEP = 0.04


def density(mass, z):
    return (mass / (1e10 * u.Msun)) ** (4.0 - 2.0 * z)


def relation(mass, z):
    return 0.06 * (1 + z) ** 2 * mass / (1e10 * u.yr)


@pytest.fixture(scope="module")
def grid():
    """The galaxies of `test_between`, with names of real bands."""
    tau, ebv = (x.ravel() for x in np.meshgrid(AXES["tau"], AXES["ebv"], indexing="ij"))
    galaxy, sfr = flux(AXES["redshift"][:, None], tau, ebv)
    properties = {"sfr": sfr / u.yr, "sfr_100myr": sfr / u.yr, "stellar_mass": 0.6 + 0.1 * tau}
    return ModelGrid(
        filters=BANDS,
        redshift=AXES["redshift"],
        galaxy=galaxy,
        dust_luminosity=np.full(9, 1e27),
        allowed=np.ones((4, 9), bool),
        galaxy_parameters=QTable({"tau": tau * u.Gyr, "ebv": ebv * u.mag}),
        galaxy_properties=QTable(properties),
        axes=AXES,
    )


@pytest.fixture(scope="module")
def objects():
    """Redshifts, fluxes with noise, and errors."""
    rng = np.random.default_rng(5)
    true = {name: rng.uniform(*values[[0, -1]], N) for name, values in AXES.items()}
    model = 1e10 * flux(**true)[0]
    return true["redshift"], model * (1 + NOISE * rng.normal(size=model.shape)), NOISE * model


def fine(values):
    """Places in the cells of an axis, equally many in each, and the nodes of these."""
    edges = np.concatenate([values[:1], 0.5 * (values[1:] + values[:-1]), values[-1:]])
    places = edges[:-1, None] + np.diff(edges)[:, None] * (np.arange(FINE) + 0.5) / FINE
    return places.ravel(), np.repeat(np.arange(values.size), FINE)


def likelihood(observed, sigma, model, limit, part, error):
    """Best scales of models, ln of the likelihoods there (on a grid of scales), and errors of the scales."""
    own = np.hypot(sigma, error * observed)
    # a broad error is that of a band and its neighbors
    measured, wide = np.flatnonzero(~limit), np.ones(len(BANDS))
    size = np.pad(observed[measured], 1)
    size = np.maximum(size[1:-1], np.maximum(size[:-2], size[2:]))
    wide[measured] = np.hypot(10 * sigma[measured], size)

    def log_likelihood(scale):
        apart = observed - scale[:, None] * model
        log = (1 - part) * np.exp(-0.5 * (apart / own) ** 2) / own
        if part:
            log = log + part * np.exp(-0.5 * (apart / wide) ** 2) / wide
        log = np.log(np.maximum(log, 1e-300))
        below = log_ndtr((apart / sigma)[:, limit])
        log[:, limit] = np.log(np.maximum((1 - part) * np.exp(below) + part, 1e-300))
        return log.sum(axis=1)

    weight = np.where(limit, 0.0, own**-2.0)
    plain = np.sum(weight * model * observed, axis=1) / np.sum(weight * model**2, axis=1)
    steps = np.exp(np.arange(-1.5, 1.0, STEP))
    every = np.array([log_likelihood(step * plain) for step in steps])
    best = np.clip(every.argmax(axis=0), 1, len(steps) - 2)
    low, top, high = (every[best + i, np.arange(len(model))] for i in (-1, 0, 1))
    bend = np.minimum(low + high - 2 * top, -1e-9)
    part = np.clip(-0.5 * (high - low) / bend, -1, 1)
    scale = plain * steps[best] * np.exp(part * STEP)
    return scale, top + 0.25 * (high - low) * part, scale * np.minimum(STEP / np.sqrt(-bend), 1)


@functools.cache
def plain_means(observed, sigma, known):
    """Means of `by_hand` without options, which cases have in common."""
    return by_hand(np.array(observed), np.array(sigma), known)[0]


def by_hand(observed, sigma, known, *, limit=None, part=0.0, error=None, prior=None, masses=None):
    """Means and standard deviations of redshift, tau, E(B-V) and mass of one object, and ln(evidence)."""
    places, nodes = zip(*(fine(values) for values in AXES.values()), strict=True)
    if known is not None:
        near = np.abs(AXES["redshift"] - known).argmin()
        places, nodes = ([known], *places[1:]), ([near], *nodes[1:])
    z, tau, ebv = (x.ravel() for x in np.meshgrid(*places, indexing="ij"))
    z_node, i, j = (x.ravel() for x in np.meshgrid(*nodes, indexing="ij"))
    limit = np.zeros(len(BANDS), bool) if limit is None else limit
    error = 0.0 if error is None else error[z_node]
    model = flux(z, tau, ebv)[0]
    scale, log, spread = likelihood(observed, sigma, model, limit, part, error)
    if prior is not None:
        # at the masses that nodes have
        z_of = AXES["redshift"] if known is None else np.full(4, known)
        t, e = (x.ravel() for x in np.meshgrid(AXES["tau"], AXES["ebv"], indexing="ij"))
        node, sfr = flux(z_of[:, None], t, e)
        formed = np.sum(node * observed / sigma**2, 2) / np.sum(node**2 / sigma**2, 2)
        log = log + prior(formed * (0.6 + 0.1 * t), formed * sfr)[z_node, 3 * i + j]
    if masses is not None:
        # stars for each solar mass formed, and volumes, are those of nodes
        log = log + masses(scale * (0.6 + 0.1 * AXES["tau"][i]), z_node)
    p = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    mean = np.array([p @ x for x in (z, tau, ebv, scale)])
    square = np.array([p @ x**2 for x in (z, tau, ebv, np.hypot(scale, spread))])
    evidence = log.max() + np.log(np.mean(np.exp(log - log.max())))
    return mean, np.sqrt(np.maximum(square - mean**2, 1e-20)), evidence


def of_density(stars, node):
    z = AXES["redshift"]
    edges = np.concatenate([[2 * z[0] - z[1], *z, 2 * z[-1] - z[-2]]])
    cells = 0.5 * (edges[2:] - edges[:-2])
    volume = FlatLambdaCDM(70.4, 0.272).differential_comoving_volume(z).value * cells
    return (4.0 - 2.0 * z[node]) * np.log(stars / 1e10) + np.log(volume)[node]


def of_relation(stars, sfr):
    expected = 0.06 * (1 + AXES["redshift"][:, None]) ** 2 * stars / 1e10
    log = -0.5 * (np.log10(sfr / expected) / SCATTER) ** 2
    return log - np.log(np.exp(log).sum(axis=1, keepdims=True))


LIMIT = np.isin(np.arange(len(BANDS)), (0, 5))
#: Options of the fitter and of its settings, of the sum by hand, and whether redshifts are known.
CASES = {
    "errors of templates": ({"template_error": ERROR}, {}, {"error": True}, False),
    "limits": ({}, {}, {"limit": LIMIT}, False),
    "outliers": ({"outliers": PART}, {}, {"part": PART}, False),
    "outliers, known": ({"outliers": PART}, {}, {"part": PART}, True),
    "outliers, limits, errors": (
        {"outliers": PART, "template_error": ERROR}, {},
        {"part": PART, "limit": LIMIT, "error": True}, False,
    ),
    "masses": ({}, {"mass_function": density}, {"masses": of_density}, False),
    "masses, known": ({}, {"mass_function": density}, {"masses": of_density}, True),
    "rates": ({}, {"sfr_prior": (relation, SCATTER)}, {"prior": of_relation}, False),
    "rates, known": ({}, {"sfr_prior": (relation, SCATTER)}, {"prior": of_relation}, True),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_posteriors_are_those_of_every_model(grid, objects, case):
    options, settings, given, fixed = CASES[case]
    z, observed, sigma = objects
    observed = observed.copy()
    if "part" in given:
        observed[:, 6] *= [0.2, 4.0, 1.0, 0.1, 3.0]
    table = photometry_table(BANDS, observed, sigma)
    for name in np.array(BANDS)[given.get("limit", np.zeros(len(BANDS), bool))]:
        table[f"{name}_limit"] = True
    settings = GridSettings(interpolate=800, rtol=0.0, **settings)
    fitter = BayesFitter(grid, model_error=0.0, settings=settings, **options)
    results = fitter.fit(table, redshift=z if fixed else None)
    error = fitter.backend.engine.template_error
    names = [*AXES, "mass"][fixed:]
    far, wide, without = [], [], []
    for i in range(N):
        known = z[i] if fixed else None
        mine = given | ({"error": error} if "error" in given else {})
        mean, std = (x[fixed:] for x in by_hand(observed[i], sigma[i], known, **mine)[:2])
        plain = plain_means(tuple(observed[i]), tuple(sigma[i]), known)[fixed:]
        found = [results.mean(name).value[i] for name in names]
        far.append((found - mean) / std)
        wide.append(np.array([results.std(name).value[i] for name in names]) / std - 1)
        without.append((plain - mean) / std)
    # an effective number of 800 leaves errors of some hundredths
    assert np.abs(far).max() < 0.1
    assert np.sqrt(np.mean(np.square(far))) < 0.04
    assert np.abs(wide).max() < 0.15
    assert np.abs(without).max() > 0.15


def test_galaxies_beyond_all_masses_have_the_last_density(grid, objects):
    """Densities end at 1e16 Msun: what is brighter has the prior of that mass, by redshift only."""
    _, observed, sigma = (1e9 * one[:2] for one in objects)
    settings = GridSettings(interpolate=800, rtol=0.0, mass_function=density)
    fitter = BayesFitter(grid, model_error=0.0, settings=settings)
    results = fitter.fit(photometry_table(BANDS, observed, sigma))
    for i in range(2):
        mean, std, _ = by_hand(
            observed[i],
            sigma[i],
            None,
            masses=lambda s, node: of_density(np.full_like(s, 1e16), node),
        )
        found = [results.mean(name).value[i] for name in AXES]
        assert np.abs((found - mean[:3]) / std[:3]).max() < 0.1


@pytest.mark.parametrize("part", [0.0, PART])
def test_evidence_knows_how_low_limits_are(grid, objects, part):
    """Of light far below the errors: what limits are unlikely to be counts in the evidence."""
    _, observed, sigma = (one[:3] for one in objects)
    sigma = np.where(LIMIT, 20 * sigma, sigma)
    settings = GridSettings(interpolate=800, rtol=0.0)
    options = {"outliers": part} if part else {}
    fitter = BayesFitter(grid, model_error=0.0, settings=settings, **options)
    found, expected = [], []
    for height in (0.1, 3.0):
        data = np.where(LIMIT, height * sigma, observed)
        table = photometry_table(BANDS, data, sigma)
        for name in np.array(BANDS)[LIMIT]:
            table[f"{name}_limit"] = True
        found.append(fitter.fit(table).log_evidence)
        pairs = zip(data, sigma, strict=True)
        expected.append([by_hand(*one, None, limit=LIMIT, part=part)[2] for one in pairs])
    assert_allclose(np.diff(found, axis=0), np.diff(expected, axis=0), atol=0.05)


@pytest.mark.parametrize("part", [0.0, PART])
def test_errors_of_agn_light_count_by_its_share(part):
    """Weights of bands follow from each model, with bands that may be wrong too: summed over every model."""
    agn_error, fractions, tau = 0.5, np.array([0.0, 0.3, 0.6, 0.9]), AXES["tau"]
    place = np.linspace(-1, 1, len(BANDS))
    galaxy, sfr = flux(AXES["redshift"][:, None], tau, np.full(3, 0.4))

    def torus(z):
        log = place * (1 + np.log1p(z)) - 2 * np.log(z)
        return 2e-36 * np.exp(log)

    grid = ModelGrid(
        filters=BANDS,
        redshift=AXES["redshift"],
        galaxy=galaxy,
        agn=torus(AXES["redshift"][:, None, None]),
        agn_multiplicity=np.ones(1, int),
        agn_parameters=QTable({"tau97": [5.0]}),
        agn_properties=QTable({"luminosity": [1.0]}),
        dust_luminosity=np.full(3, 1e27),
        frac_agn=fractions,
        allowed=np.ones((4, 3), bool),
        galaxy_parameters=QTable({"tau": tau * u.Gyr}),
        galaxy_properties=QTable({"sfr": sfr / u.yr}),
        axes={"redshift": AXES["redshift"], "tau": tau, "frac_agn": fractions},
    )
    rng, z = np.random.default_rng(3), np.array([0.7, 1.0, 1.3])
    true_f = np.array([0.1, 0.5, 0.8])
    light = flux(z, np.array([1.5, 2.0, 2.5]), 0.4)[0]
    shape = np.exp(0.15 * rng.normal(size=(3, 8)))
    observed = light + (true_f / (1 - true_f) * 1e27)[:, None] * torus(z[:, None]) * shape
    observed, sigma = 1e10 * observed, 0.1 * 1e10 * light
    settings = GridSettings(interpolate=800, rtol=0.0, agn_error=agn_error)
    options = {"outliers": part} if part else {}
    fitter = BayesFitter(grid, model_error=0.0, settings=settings, **options)
    results = fitter.fit(photometry_table(BANDS, observed, sigma), redshift=z)
    # a fourth of the prior has no AGN; the others begin at 0
    edges = np.array([0.0, 0.45, 0.75, 0.9])
    many = 8 * FINE
    present = edges[:-1, None] + np.diff(edges)[:, None] * (np.arange(many) + 0.5) / many
    f = np.concatenate([np.zeros(many), present.ravel()])
    t, f = (x.ravel() for x in np.meshgrid(fine(tau)[0], f, indexing="ij"))
    for i in range(3):
        one = flux(np.full(t.size, z[i]), t, np.full(t.size, 0.4))[0]
        own = (f / (1 - f) * 1e27)[:, None] * torus(z[i])
        model, share = one + own, own / (one + own)
        error = np.hypot(sigma[i], agn_error * share * observed[i])
        wide = np.pad(observed[i], 1)
        wide = np.maximum(wide[1:-1], np.maximum(wide[:-2], wide[2:]))
        wide = np.hypot(10 * sigma[i], wide)
        scale = np.sum(model * observed[i] / error**2, 1) / np.sum(model**2 / error**2, 1)
        every = []
        steps = np.exp(np.arange(-1.0, 1.0, 0.02))
        for step in steps:
            apart = observed[i] - (step * scale)[:, None] * model
            log = (1 - part) * np.exp(-0.5 * (apart / error) ** 2) / error
            log = log + part * np.exp(-0.5 * (apart / wide) ** 2) / wide
            every.append(np.log(np.maximum(log, 1e-300)).sum(1))
        p = np.exp(np.max(every, axis=0) - np.max(every))
        p /= p.sum()
        for name, x in (("tau", t), ("frac_agn", f)):
            mean = p @ x
            std = np.sqrt(p @ x**2 - mean**2)
            assert results.mean(name).value[i] == pytest.approx(mean, abs=0.1 * std)
            assert results.std(name).value[i] == pytest.approx(std, rel=0.1)


def test_masses_on_nodes_have_the_density(grid, objects):
    """Models of nodes only: their sum in closed form."""
    _, observed, sigma = (one[:3] for one in objects)
    settings = GridSettings(mass_function=density, interpolate=0)
    fitter = BayesFitter(grid, model_error=0.0, settings=settings)
    results = fitter.fit(photometry_table(BANDS, observed, sigma))
    t, e = (x.ravel() for x in np.meshgrid(AXES["tau"], AXES["ebv"], indexing="ij"))
    node, _ = flux(AXES["redshift"][:, None], t, e)
    data, weight = observed[:, None, None], sigma[:, None, None] ** -2.0
    formed = np.sum(weight * data * node, axis=3) / np.sum(weight * node**2, axis=3)
    chi2 = np.sum(weight * (data - formed[..., None] * node) ** 2, axis=3)
    of_mass = of_density(formed * (0.6 + 0.1 * t), np.arange(4)[:, None])
    p = np.exp(of_mass - chi2 / 2)
    p /= p.sum(axis=(1, 2), keepdims=True)
    for name, values in {"redshift": AXES["redshift"][:, None], "tau": t, "mass": formed}.items():
        assert_allclose(results.mean(name).value, np.sum(p * values, axis=(1, 2)), rtol=1e-6)
