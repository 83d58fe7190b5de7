"""Models between the nodes of a grid against the chain that made it."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from miricigale.fitting import BayesFitter
from miricigale.fitting.grid.interpolation import InterpolatedModels
from miricigale.fitting.posterior.priors import grid_priors
from miricigale.fitting.posterior.quantities import Quantities
from miricigale.sed import SEDModel, quasar_axes, survey_axes, yang2021_axes

BANDS = ["acs.f814w", "wfc3.f160w", "nircam.f444w", "miri.f770w", "miri.f1500w", "miri.f2100w"]
REDSHIFT = np.expm1(np.arange(np.log(1.9), np.log(2.4), 0.02))
#: Not in Gyr but in steps of 1 Myr is the age of the chain.
STEP = 1e-3
PRESETS = {
    "survey": (SEDModel.survey, survey_axes()),
    "far-infrared": (SEDModel.survey, survey_axes("far-infrared")),
    "yang2021": (SEDModel.yang2021, yang2021_axes()),
    "quick": (SEDModel.yang2021, yang2021_axes("quick")),
    "quasars": (SEDModel.survey, quasar_axes()),
}


def constants_of(grid, axes):
    constants = {}
    for table in (grid.galaxy_parameters, grid.agn_parameters):
        for name in table.colnames:
            if name not in axes:
                constants[name] = float(u.Quantity(table[name]).value[0])
    return constants


def interpolated(model, axes):
    """Interpolation of a model, its priors by axis, and the constants."""
    axes = dict(axes) | {"redshift": REDSHIFT}
    grid = model.grid(axes, BANDS)
    known = grid_priors(grid).axes
    constants = constants_of(grid, known)
    return InterpolatedModels.of_model(model, grid, BANDS, constants, known), known, constants


def exact(model, values, constants):
    """Fluxes (n, nb) and table of the chain for one solar mass formed."""
    n = len(values["redshift"])
    table = QTable({"mass": np.ones(n) * u.Msun})
    for name, value in constants.items():
        table[name] = np.full(n, value) * model.parameters[name].unit
    for name, value in values.items():
        table[name] = value * model.parameters[name].unit
    fluxes = model.fluxes(table, BANDS)
    return np.column_stack([fluxes[name].value for name in BANDS]), fluxes


def anywhere(axes, n, rng):
    """Values anywhere between the outermost nodes; metallicities are those of the library."""
    values = {}
    for name, axis in axes.items():
        nodes = axis.values
        if name == "metallicity" or nodes.size == 1:
            values[name] = rng.choice(nodes, n)
            continue
        cell = rng.integers(nodes.size - 1, size=n)
        values[name] = nodes[cell] + rng.random(n) * np.diff(nodes)[cell]
    values["age"] = np.round(values["age"] / STEP) * STEP
    values["frac_agn"] = np.where(rng.random(n) < 0.5, 0.0, rng.uniform(0.2, 0.95, n))
    return values


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_models_between_nodes_are_those_of_the_chain(preset):
    """Fluxes and quantities within 2 % of the chain's, at places that no table has."""
    make, axes = PRESETS[preset]
    model = make(libraries="bundled")
    models, known, constants = interpolated(model, axes)
    values = anywhere(known, 200, np.random.default_rng(11))
    oldest = model.cosmology.age(values["redshift"]).to_value("Gyr")
    values["age"] = np.minimum(values["age"], np.floor(oldest / STEP) * STEP)
    expected, table = exact(model, values, constants)
    flux, power = models.fluxes(values, values["redshift"], values["frac_agn"])
    bright = expected > 1e-3 * expected.max(axis=1, keepdims=True)
    error = np.abs(flux / expected - 1.0)[bright]
    assert np.mean(error < 0.02) > 0.95
    assert np.median(error) < 0.005
    derived = models.describe(values, values["redshift"], power, np.ones(len(power)))
    scaling = ("stellar_mass", "sfr", "sfr_100myr", "dust_luminosity", "ir_luminosity")
    for name in (*scaling, "age_mass", "age_light"):
        true = table[name].value
        error = np.abs(derived[name] - true)[true > 0] / true[true > 0]
        assert np.percentile(error, 95) < 0.02, name
    for name in ("a_v", "beta", "u_v", "frac_agn_ir"):
        error = np.abs(derived[name] - table[name].value)
        assert np.percentile(error, 95) < 0.02, name


@pytest.fixture(scope="module")
def survey():
    model = SEDModel.survey(libraries="bundled")
    return model, *interpolated(model, survey_axes())


def test_a_burst_leaves_the_dust_its_light(survey):
    """The power of dust along the burst's mass fraction, from none on, is that of the chain."""
    model, models, _, constants = survey
    fractions = np.array([0.0, 5e-4, 0.001, 0.004, 0.012, 0.02, 0.03, 0.06, 0.1, 0.3])
    n = fractions.size
    values = {"f_burst": fractions, "redshift": np.full(n, 1.0), "frac_agn": np.full(n, 0.5)}
    fixed = {"age": 1.5, "tau": 0.7, "metallicity": 0.02, "ebv": 0.3, "slope": -0.2, "q_pah": 2.5}
    fixed |= {"tau97": 7.0, "ebv_polar": 0.1}
    for name, value in fixed.items():
        values[name] = np.full(n, value)
    expected, table = exact(model, values, constants)
    flux, power = models.fluxes(values, values["redshift"], values["frac_agn"])
    derived = models.describe(values, values["redshift"], power, np.ones(n))
    assert_allclose(derived["dust_luminosity"], table["dust_luminosity"].value, rtol=0.01)
    assert_allclose(derived["agn_power"], table["agn_power"].value, rtol=0.01)
    assert_allclose(flux, expected, rtol=0.02)


def test_little_dust_has_little_light(survey):
    """Without dust there is no dust light, and with hardly any in proportion to its amount."""
    model, models, known, constants = survey
    amounts = np.array([0.0, 1e-3, 0.01, 0.03])
    n = amounts.size
    values = {"ebv": amounts, "redshift": np.full(n, 1.1), "frac_agn": np.zeros(n)}
    for name, axis in known.items():
        values.setdefault(name, np.full(n, axis.values[-1]))
    values["f_burst"] = np.zeros(n)
    values["age"] = np.full(n, 3.0)
    _, table = exact(model, values, constants)
    power = models.fluxes(values, values["redshift"], 0.0)[1]
    dust = models.describe(values, values["redshift"], power, np.ones(n))["dust_luminosity"]
    assert dust[0] == 0.0
    assert_allclose(dust, table["dust_luminosity"].value, rtol=0.01)


def test_no_galaxy_is_older_than_the_universe(survey):
    model, models, known, _ = survey
    limit = model.cosmology.age(1.3).to_value("Gyr")
    ages = np.array([0.99 * limit, 1.01 * limit])
    values = {name: np.full(2, axis.values[0]) for name, axis in known.items()}
    values["age"] = ages
    flux = models.fluxes(values, np.full(2, 1.3), 0.0)[0]
    assert np.isfinite(flux[0]).all()
    assert np.isnan(flux[1]).all()


def test_axes_are_refined_where_models_bend(survey):
    """The burst needs no nodes, and libraries no values between theirs."""
    _, models, known, _ = survey
    names = [models.parameters[axis] for axis in models.light.stars.axis]
    assert "f_burst" not in names
    sizes = dict(zip(names, models.light.stars.size, strict=True))
    assert sizes["metallicity"] == 2
    assert sizes["age"] > known["age"].values.size
    assert np.diff(models.light.stars.log_z).max() < 0.0101


def test_known_redshifts_between_nodes_leave_older_galaxies_out():
    """At a redshift above its node a galaxy may be older than the universe: it is no model there, and no NaN."""
    model = SEDModel.yang2021(libraries="bundled", agn=False)
    universe = model.cosmology.age([1.0, 1.05]).to_value("Gyr")
    axes = {"redshift": [1.0, 1.2], "age": [2.0, universe.mean()], "ebv": [0.1, 0.5]}
    fitter = BayesFitter(model, BANDS, axes=axes, model_error=0.05)
    truth = QTable({"redshift": [1.05], "age": [2.0] * u.Gyr, "ebv": [0.3] * u.mag})
    truth["mass"] = 1e10 * u.Msun
    fluxes = model.fluxes(truth, BANDS)
    table = QTable({"id": [1], "z": [1.05]})
    for name in BANDS:
        table[name] = fluxes[name]
        table[f"{name}_err"] = 0.05 * fluxes[name]
    results = fitter.fit(table, redshift="z")
    assert np.isfinite(results.chi2).all()
    assert results.percentile("age", 0.999).value.max() <= universe[1]
    assert 2.0 <= results.best["age"].value[0] <= universe[1]


@pytest.mark.parametrize("excess", [[2.0], [1.0, 3.0]])
def test_excess_of_dust_multiplies_its_light(excess):
    """Dust may shine by another power than it takes, the same for all models or an axis of its own."""
    model = SEDModel.yang2021(libraries="bundled")
    axes = {"age": [1.0, 3.0], "ebv": [0.1, 0.5], "frac_agn": [0.0, 0.5], "dust_excess": excess}
    models, known, constants = interpolated(model, axes)
    values = {name: np.full(2, axis.values.mean()) for name, axis in known.items()}
    values |= {"redshift": np.full(2, 1.1), "frac_agn": np.array([0.0, 0.4])}
    values["age"] = np.full(2, 2.0)
    expected, table = exact(model, values, constants)
    flux, power = models.fluxes(values, values["redshift"], values["frac_agn"])
    assert_allclose(flux, expected, rtol=0.02)
    derived = models.describe(values, values["redshift"], power, np.ones(2))
    assert_allclose(derived["dust_luminosity"], table["dust_luminosity"].value, rtol=0.01)
    assert_allclose(derived["agn_power"], table["agn_power"].value, rtol=0.01)


@pytest.mark.parametrize("definition", ["dust", "3-1000um"])
def test_quantities_without_agn_are_those_of_the_grid(definition):
    """At a node every derived quantity is that which the grid has for it."""
    model = SEDModel.yang2021(libraries="bundled", agn=False, frac_agn_definition=definition)
    axes = {"age": [1.0, 3.0], "ebv": [0.1, 0.5]}
    models, known, _ = interpolated(model, axes)
    grid = model.grid(axes | {"redshift": REDSHIFT}, BANDS)
    quantities = Quantities.of_grid(grid)
    values = {name: axis.values[[0]] for name, axis in known.items()}
    galaxy = int(np.flatnonzero(grid.galaxy_parameters["ebv"].value == 0.1)[0])
    derived = models.describe(values, REDSHIFT[[0]], np.zeros(1), np.ones(1))
    for name in quantities.names:
        wanted = quantities.evaluate(name, grid, galaxy, 0, 0.0, 1.0)
        assert_allclose(derived[name][0], wanted, rtol=1e-4, atol=1e-4, err_msg=name)
