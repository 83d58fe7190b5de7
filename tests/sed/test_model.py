import astropy.units as u
import numpy as np
import pytest
from astropy.cosmology import FlatLambdaCDM
from astropy.table import QTable, hstack
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.cigale.modules import _MODULES
from miricigale.filters import Filter, FilterSet
from miricigale.sed import COSMOLOGY, SED, ModelFlags, Parameter, SEDModel, yang2021_axes
from miricigale.sed.component import _NEAREST_TO_CIGALE, CIGALE_MODULES, COMPONENTS, register
from miricigale.sed.components import (
    BC03,
    IGM,
    CalzettiLeitherer,
    DelayedSFH,
    DraineLi2007,
    ParametricTorus,
)
from miricigale.sed.grid_spectra import ListedModels, model_fluxes, observed_spectra
from miricigale.utils.exceptions import ConfigError, MiricigaleWarning

AXES = {"tau": [0.1, 1.0], "age": [0.5, 5.0], "ebv": [0.1, 0.7], "alpha": [1.0, 2.0]}
AXES |= {"tau97": [3.0, 7.0], "ebv_polar": [0.0, 0.2], "temperature_polar": [100.0, 300.0]}
AXES |= {"frac_agn": [0.0, 0.4, 0.9], "redshift": [0.01, 0.5, 2.0, 4.0]}
MASKED = np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False])


@pytest.fixture(scope="module")
def grid(model, filters):
    return model.grid(AXES, filters)


# ------------------------------------------------------------------------ one model


def test_dust_excess_changes_the_dust_and_leaves_the_stars(model, filters):
    values = {"age": 3.0, "ebv": 0.4, "redshift": 0.7, "frac_agn": 0.5}
    plain, more = model.evaluate(**values), model.evaluate(**values, dust_excess=3.0)
    for name, factor in {"stellar": 1, "dust": 3, "agn_torus": 3}.items():
        wanted = factor * plain.components[name].fnu
        assert_quantity_allclose(more.components[name].fnu, wanted, atol=1e-300 * u.uJy)
    assert_quantity_allclose(more.derived["dust_luminosity"], 3 * plain.derived["dust_luminosity"])
    # many rows: those at 1 keep their bits, the others are those of one model
    rows = QTable({name: np.full(3, value) for name, value in values.items()})
    balanced = model.fluxes(rows, filters)
    rows["dust_excess"] = [1.0, 3.0, 0.0]
    table = model.fluxes(rows, filters)
    for name in (*filters.names, "dust_luminosity", "ir_luminosity", "l_6um", "accretion_power"):
        assert table[name][0] == balanced[name][0]
    got = u.Quantity([table[name][1] for name in filters.names])
    assert_quantity_allclose(got, filters.synthetic_fluxes(more), rtol=1e-6)
    assert_quantity_allclose(table["ir_luminosity"][1], more.derived["ir_luminosity"])
    assert table["dust_luminosity"][2] == 0
    assert table["flags"].tolist() == [0, 0, ModelFlags.NO_AGN_POWER]


def test_a_grid_has_dust_free_of_energy_balance(model, filters):
    axes = AXES | {"tau": [1.0], "age": [0.5], "dust_excess": [0.2, 1.0, 4.0]}
    free, balanced = model.grid(axes, filters), model.grid(axes | {"dust_excess": [1.0]}, filters)
    rows = [i for i, x in enumerate(free.galaxy_parameters["dust_excess"]) if x == 1.0]
    assert_allclose(free.galaxy[:, rows], balanced.galaxy, rtol=1e-12)
    rng, n = np.random.default_rng(1), 20
    index = np.array([rng.integers(k, size=n) for k in (4, free.galaxy.shape[1], free.n_agn, 3)]).T
    # far from the nodes of other bands: one model at a time
    other = FilterSet.from_names(["mips.24"])
    got = model_fluxes(model, free, index, other)[:, 0]
    wave, light = observed_spectra(model, free, index, np.ones(n))
    for row, (z, g, k, f) in enumerate(index):
        values = {"redshift": free.redshift[z], "frac_agn": free.frac_agn[f], "mass": 1.0}
        values |= {
            name: free.galaxy_parameters[name][g] for name in free.galaxy_parameters.colnames
        }
        values |= {name: free.agn_parameters[name][k] for name in free.agn_parameters.colnames}
        one = model.evaluate(**values)
        wanted = [flux.to_value(u.uJy) for flux in filters.synthetic_fluxes(one)]
        assert_allclose(free.flux(z, g, k, f), wanted, rtol=1e-5)
        assert got[row] == pytest.approx(
            other.synthetic_fluxes(one)[0].to_value(u.uJy), rel=1e-5, abs=0
        )
        at = np.interp(wave, one.wave.to_value(u.um), one.fnu.to_value(u.uJy))
        some = slice(2000, 4000, 50)
        assert_allclose(light[row][some], at[some], rtol=1e-3)


def test_dust_excess_needs_dust():
    model = SEDModel([DelayedSFH(), BC03(), CalzettiLeitherer()])
    refuses("no parameter 'dust_excess'", model.evaluate, error=KeyError, dust_excess=2.0)


def test_flux_scales_with_mass_and_inverse_square_of_distance(filters):
    cosmology = FlatLambdaCDM(H0=35.2, Om0=0.272)  # twice as far
    near, far = SEDModel.yang2021(), SEDModel.yang2021(cosmology=cosmology)
    one = near.evaluate(redshift=1.0, age=1.0, mass=1e10)
    two = near.evaluate(redshift=1.0, age=1.0, mass=2e10)
    away = far.evaluate(redshift=1.0, age=1.0, mass=1e10)
    assert_quantity_allclose(two.fnu, 2 * one.fnu)
    assert_quantity_allclose(away.fnu * 4, one.fnu)


def test_six_micron_luminosity_from_the_spectrum(model):
    parts = model.evaluate(frac_agn=0.7, age=3.0, redshift=1.0)
    agn = sum(parts.components[f"agn_{n}"].fnu_at(12 * u.um) for n in ("disk", "torus", "polar"))
    nu = (12 * u.um).to(u.Hz, u.spectral())
    want = (nu * agn * 4 * np.pi * COSMOLOGY.luminosity_distance(1.0) ** 2).to(u.W)
    assert_quantity_allclose(parts.derived["l_6um"], want, rtol=1e-6)


def test_star_formation_rates_of_a_nearly_constant_history(model):
    """tau = 100 Gyr: SFR grows linearly, the mean over the last 100 Myr is that of 50 Myr ago."""
    got = model.derived(tau=100.0, age=1.0, mass=1e9, redshift=0.1)
    assert_quantity_allclose(got["stellar_mass_formed"], 1e9 * u.Msun)
    assert_quantity_allclose(got["sfr"], 2.0 * u.Msun / u.yr, rtol=0.01)
    assert_quantity_allclose(got["sfr_100myr"], 1.9 * u.Msun / u.yr, rtol=0.01)


def test_infrared_luminosity_follows_the_star_formation_rate():
    """Kennicutt 1998: SFR = 4.5e-44 L_IR (Salpeter, 8-1000 um); a Kroupa IMF has 0.67 of it."""
    model = SEDModel.yang2021(agn=False)
    got = model.derived(tau=100.0, age=0.1, ebv=0.9, redshift=0.1)
    rate = 4.5e-44 * 0.67 * got["ir_luminosity"].to_value("erg / s")
    assert got["sfr_100myr"].value == pytest.approx(rate, rel=0.35)


def test_model_without_agn_has_no_agn_numbers():
    model = SEDModel.yang2021(agn=False)
    assert "accretion_power" not in model.derived(age=1.0)
    assert "frac_agn" not in model.parameters
    # components of users come after those of the package
    owners = "it is of parametric_torus and skirtor2016.*; the model has no such component"
    refuses(f"'frac_agn' in this model: {owners}", model.evaluate, error=KeyError, frac_agn=0.2)


def test_meta_says_which_libraries(model):
    meta = model.evaluate(age=1.0).meta
    assert any("ssp.bc03" in part for part in meta["components"])
    assert any("dust.dl07" in part for part in meta["components"])
    assert "Kroupa" in meta["imf"]
    assert any("Meiksin" in c for c in meta["citations"])
    assert any("Bruzual" in c for c in meta["citations"])


@pytest.mark.parametrize(
    ("parameters", "error", "match"),
    [
        ({"taus": 1.0}, KeyError, "no parameter 'taus'; known: .*tau97"),
        ({"tau": -1.0}, ValueError, "'tau' must be from 0.001 to 100.0 Gyr, got -1.0"),
        ({"age": 7.0, "redshift": 2.0}, ValueError, "'age' must be at most the age of the"),
        ({"redshift": 1 * u.um}, u.UnitsError, "'redshift' must be convertible"),
        ({"age": [[1.0, 2.0]]}, ValueError, r"'age' must be one number .fluxes.. takes several"),
        ({"age": None}, ValueError, "'age' must be one number, got None"),
        ({"age": "1.0"}, ValueError, "'age' must be one number, got '1.0'"),
        ({"age": 1j}, ValueError, "'age' must be one number"),
        ({"age": True}, ValueError, "'age' must be one number"),
    ],
)
def test_bad_parameters_are_refused(model, parameters, error, match):
    refuses(match, model.evaluate, error=error, **parameters)


@pytest.mark.parametrize(
    ("components", "match"),
    [
        ([DelayedSFH()], "with a component of role 'stellar'"),
        ([DelayedSFH(), DelayedSFH(), BC03()], "at most one of each role"),
        ([DelayedSFH(), BC03(), DraineLi2007()], "with 'attenuation' if there is 'dust'"),
        ([DelayedSFH(), 3], "Component instances or names"),
    ],
)
def test_bad_chains_are_refused(components, match):
    refuses(match, SEDModel, components)


def test_order_of_the_list_does_not_matter():
    parts = [CalzettiLeitherer(), BC03(), DraineLi2007(), DelayedSFH()]
    assert [c.role for c in SEDModel(parts).components] == ["sfh", "stellar", "attenuation", "dust"]


def test_components_by_their_names_and_those_of_cigale():
    own = SEDModel(["delayed", "bc03", "calzetti", DraineLi2007()])
    theirs = SEDModel(["sfhdelayed", "bc03", "dustatt_calzleit", "dl2007"])
    assert [c.name for c in own.components] == [c.name for c in theirs.components]
    # as the files of CIGALE are read
    assert theirs.component("attenuation").ebv_scaling == "cigale"
    assert own.component("attenuation").ebv_scaling == "exact"
    assert set(CIGALE_MODULES.values()) <= set(COMPONENTS.names())
    # the setup of CIGALE's files knows them all
    assert set(CIGALE_MODULES) <= set(_MODULES)
    refuses("no component 'sfhdelay'", SEDModel, ["sfhdelay", "bc03"], error=KeyError)


@pytest.mark.parametrize("name", sorted(_NEAREST_TO_CIGALE))
def test_a_module_of_cigale_without_a_component_names_the_closest(name):
    nearest = _NEAREST_TO_CIGALE[name]
    assert nearest in COMPONENTS.names()
    message = f"no component '{name}': the component closest .* is '{nearest}'"
    refuses(message, SEDModel, [name, "bc03"], error=KeyError)


def test_logarithms_of_masses_by_name_and_unit(model, filters):
    wanted = model.fluxes({"redshift": [1.0, 1.0], "mass": [3e10, 1e9]}, filters)
    logs = np.log10([3e10, 1e9])
    for column in (logs, logs * u.dex(u.Msun), np.ma.array(logs)):
        found = model.fluxes({"redshift": [1.0, 1.0], "log_mass": column}, filters)
        for name in filters.names:
            assert_allclose(found[name].value, wanted[name].value, rtol=1e-9)
    sed = model.evaluate(redshift=1.0, logmass=logs[0])
    assert_allclose(sed.parameters["mass"].value, 3e10)
    assert_allclose(
        model.evaluate(redshift=1.0, mass=9 * u.dex(u.Msun)).parameters["mass"].value, 1e9
    )
    refuses("'log_mass' must be in dex", model.evaluate, log_mass=10 * u.Msun, error=u.UnitsError)


def test_parameters_stand_in_a_dict_too(model):
    wanted = model.evaluate(redshift=1.0, age=2.0)
    for sed in (model.evaluate({"z": 1.0, "age": 2.0}), model({"redshift": 1.0}, age=2.0)):
        assert sed.parameters == wanted.parameters
        assert_allclose(sed.fnu.value, wanted.fnu.value)
    refuses("'values' must be a dict of parameters by name, got 1.0", model.evaluate, 1.0)
    refuses("'values' must be without those given by k", model.evaluate, {"age": 1.0}, age=2.0)


def test_components_are_a_list():
    for components in ("delayed", {"redshift": 1.0}):
        refuses("'components' must be a list of components or names", SEDModel, components)


def test_parameters_have_their_names_of_cigale_too(model, filters):
    """Numbers without a unit are in CIGALE's, ages in Myr; columns of a table need the name with its module."""
    wanted = model.evaluate(redshift=1.0, tau=2.0, age=3.0, frac_agn=0.2)
    names = {"sfh.tau_main": 2000.0, "sfh.age_main": 3.0 * u.Gyr, "agn.fracAGN": 0.2}
    for parameters in (names, {"tau_main": 2000.0, "age_main": 3000.0, "fracAGN": 0.2}):
        assert model.evaluate(redshift=1.0, **parameters).parameters == wanted.parameters
    message = (
        r"'E_BV_lines' in this model: .* modified_starburst \(here 'ebv_lines'\).* calzetti \(ebv,"
    )
    refuses(message, model.evaluate, E_BV_lines=0.3, error=KeyError)
    refuses(message, model.fluxes, filters, redshift=[1.0], E_BV_lines=0.3, error=KeyError)
    starburst = SEDModel(["sfhdelayed", "bc03", "dustatt_modified_starburst"])
    assert starburst.evaluate(redshift=1.0, E_BV_lines=0.3).parameters["ebv_lines"].value == 0.3
    for name in ("Av", "AV", "A_V"):
        message = f"no parameter '{name}'; .* ebv"
        refuses(message, model.evaluate, **{name: 1.0}, error=KeyError)
    refuses("no parameter 'spin'; known: age, ", model.evaluate, spin=1.0, error=KeyError)
    zred = model.evaluate(zred=1.0, massformed=10.0, E_BVs_young=0.2)
    assert zred.parameters == model.evaluate(redshift=1.0, mass=1e10, ebv=0.2).parameters
    rows = {"redshift": [1.0, 1.0], "tau": [1.0, 2.0]}
    flux = model.fluxes(rows, filters)
    theirs = {"redshift": [1.0, 1.0], "sfh.tau_main": [1000.0, 2000.0]}
    by_keyword = model.fluxes(filters, redshift=[1.0, 1.0], tau_main=[1000.0, 2000.0])
    for name in filters.names:
        assert_allclose(model.fluxes(theirs, filters)[name].value, flux[name].value)
        assert_allclose(by_keyword[name].value, flux[name].value)
    # a magnitude in the band i is no inclination
    rows["i"] = [22.0, 23.0]
    assert_allclose(model.fluxes(rows, filters)[filters.names[0]], flux[filters.names[0]])


def test_from_dict():
    parts = [{"name": "delayed", "tau": 0.3}, {"name": "bc03"}, {"name": "calzetti"}]
    model = SEDModel.from_dict({"components": [*parts, {"name": "dl07", "q_pah": 1.12}]})
    assert model.parameters["tau"].default == 0.3
    assert model.parameters["q_pah"].default == 1.12


@pytest.mark.parametrize(
    ("config", "match"),
    [
        (None, "must be a table of keys"),
        ({"part": 1}, r"\[sed\] does not know \['part'\]"),
        ({"components": ["delayed"]}, "must be a list of tables"),
        ({"components": {"name": "delayed"}}, "must be a list of tables"),
        ({"components": [{"name": "old"}]}, r"\[sed\] component .* no component 'old'"),
        ({"components": [{"name": "delayed", "taus": 0.3}]}, "no parameter 'taus'"),
        ({"components": [{"name": "delayed", "age": [1, 2]}]}, "'age' must be one number"),
        ({"components": [{"name": "smc", "law": "nonsense"}]}, "'law' must be one of"),
    ],
)
def test_from_dict_says_what_is_wrong(config, match):
    refuses(match, SEDModel.from_dict, config, error=ConfigError)


# --------------------------------------------------------------------- many models


def test_three_ways_to_a_flux_agree(model, filters, grid):
    """grid() == fluxes() == evaluate() + FilterSet."""
    rng = np.random.default_rng(3)
    z, g = rng.permutation(np.argwhere(grid.allowed))[:12].T
    a, f = rng.integers(grid.n_agn, size=12), rng.integers(len(grid.frac_agn), size=12)
    table = hstack([grid.galaxy_parameters[g], grid.agn_parameters[a]])
    table["redshift"], table["frac_agn"] = grid.redshift[z], grid.frac_agn[f]
    table["mass"] = 1e10 * u.Msun
    got = model.fluxes(table, filters)
    for i, row in enumerate(table):
        want = 1e10 * grid.flux(z[i], g[i], a[i], f[i])
        assert_allclose([got[name][i].value for name in filters.names], want, rtol=1e-6)
        assert_allclose(filters.synthetic_fluxes(model.evaluate(**row)).value, want, rtol=1e-6)
    dust = 1e10 * grid.dust_luminosity[g] * u.W
    assert_quantity_allclose(got["dust_luminosity"], dust, rtol=1e-10)
    assert np.all(got["flags"] == 0)


def test_grid_counts_identical_models(grid):
    assert grid.n_agn == 6  # (3, 7) x [no polar dust, two temperatures]
    assert sorted(grid.agn_multiplicity) == [1, 1, 1, 1, 2, 2]
    assert grid.agn_multiplicity.sum() == 8
    assert grid.n_models == 4 * 16 * 3 * 8
    none = np.asarray(grid.agn_parameters["ebv_polar"].value == 0)
    assert_quantity_allclose(grid.agn_parameters["temperature_polar"][none], 200 * u.K)


def test_grid_marks_galaxies_older_than_the_universe(grid):
    age = grid.galaxy_parameters["age"]
    universe = COSMOLOGY.age(grid.redshift)
    assert_array_equal(grid.allowed, age[None, :] <= universe[:, None])
    assert not grid.allowed.all()


def test_grid_without_agn(model, filters):
    grid = model.grid({"age": [1.0], "redshift": [0.5]}, filters)
    assert grid.n_agn == 0
    assert grid.n_models == 1
    assert grid.frac_agn.tolist() == [0.0]


def test_rows_that_cannot_be_evaluated_are_flagged(model, filters):
    table = QTable({"id": [11, 12, 13, 14, 15], "age": [1.0, 7.0, 1.0, 1.0, 1.0] * u.Gyr})
    table["redshift"] = [1.0, 2.0, np.nan, 1.0, 1.0]
    table["ebv"] = [0.1, 0.1, 0.1, 9.0, 0.1] * u.mag
    table["metallicity"] = [0.02, 0.02, 0.02, 0.02, 0.03]
    got = model.fluxes(table, filters)
    assert got["id"].tolist() == [11, 12, 13, 14, 15]
    f = ModelFlags
    wanted = [0, f.OLDER_THAN_UNIVERSE, f.NOT_FINITE, f.OUT_OF_BOUNDS, f.NOT_IN_LIBRARY]
    assert got["flags"].tolist() == wanted
    assert np.isfinite(got["irac.ch1"][0])
    assert np.all(np.isnan(got["irac.ch1"][1:]))
    assert np.all(np.isnan(got["sfr"][1:]))
    assert "older than universe" in got["flags"].info.description


def test_redshift_is_needed(model, filters):
    with pytest.raises(ValueError, match="'table' must be a table with a column 'redshift'"):
        model.fluxes(QTable({"age": [1.0]}), filters)
    refuses("'axes' must be with 'redshift'", model.grid, {"age": [1.0]}, filters)


@pytest.mark.parametrize(
    ("axes", "error", "match"),
    [
        ({"taus": [1.0], "redshift": [1.0]}, KeyError, "no axis 'taus'"),
        ({"mass": [1.0], "redshift": [1.0]}, KeyError, "no axis 'mass'"),
        ({"tau": [1.0, 0.5], "redshift": [1.0]}, ValueError, "'tau' must be ascending values"),
        ({"tau": [1e4], "redshift": [1.0]}, ValueError, "'tau' must be from"),
        ({"age": MASKED, "redshift": [1.0]}, ValueError, "'age' must be values without a mask"),
        ({"age": ["a"], "redshift": [1.0]}, ValueError, "'age' must be numbers"),
        ([("redshift", 1.0)], ValueError, "'axes' must be a dict"),
    ],
)
def test_bad_axes_are_refused(model, filters, axes, error, match):
    refuses(match, model.grid, axes, filters, error=error)


def test_values_of_an_axis_may_have_units(model, filters):
    grid = model.grid({"redshift": [1.0], "age": [500 * u.Myr, 1 * u.Gyr]}, filters)
    assert_allclose(grid.galaxy_parameters["age"].to_value(u.Gyr), [0.5, 1.0])


def test_axes_of_the_paper_make_24_million_models():
    axes = yang2021_axes("fit")
    sizes = {name: len(values) for name, values in axes.items()}
    assert np.prod(list(sizes.values())) == 24_024_000
    step = np.diff(np.log(1 + axes["redshift"]))
    assert_allclose(step, 0.03)
    assert axes["redshift"][0] == pytest.approx(0.01)
    assert axes["redshift"][-1] < 6.0
    assert "frac_agn" not in yang2021_axes("galaxy")
    refuses("'kind' must be 'fit'", yang2021_axes, "small")


def test_tables_of_parameters_are_checked(model, filters):
    refuses(r"'table' must be a table, a dict of columns, .*, got list", model.fluxes, [1], filters)
    table = QTable({"redshift": [0.5], "ebvv": [0.3], "stellar_mass": [1.0], "seen": [True]})
    with pytest.warns(MiricigaleWarning, match="'ebvv' is no parameter .* is it 'ebv'") as caught:
        model.fluxes(table, filters)
    assert len(caught) == 1


# ------------------------------------------------------------------- input that cannot be


def box(low, high, name="box"):
    """A top hat."""
    return Filter([low, high] * u.um, [1.0, 1.0], name=name)


def test_a_band_beyond_the_spectrum_is_flagged_and_alone_not_a_number():
    model = SEDModel([DelayedSFH(), BC03()])
    table = QTable({"redshift": [0.1, 12.0], "age": [0.1, 0.1]})
    high = model.wave[-1]
    far = box(5.0 * high.value, 6.0 * high.value)
    got = model.fluxes(table, FilterSet([far, Filter.from_name("miri.f770w")]))
    assert np.isnan(got["box"][0])
    assert got["miri.f770w"][0] > 0
    assert got["box"][1] > 0  # redshift has brought light there
    assert [ModelFlags.names(f) for f in got["flags"]] == [["not_covered"], []]
    # a grid, which has no flags, refuses
    with pytest.raises(ValueError, match=r"leaves 100\.00% of filter 'box'"):
        model.grid({"redshift": [0.1], "age": [0.1]}, FilterSet([far]))


def test_logarithms_of_masses_are_refused(model, filters):
    """In one model, a table and a prior; a quantity is what it says, and a mass of 1 a unit."""
    text = r"'mass' must be in solMass, not its logarithm: 10\*\*10\.7"
    refuses(text, model.evaluate, redshift=1.0, mass=10.7)
    refuses(text, model.fluxes, {"redshift": [1.0, 1.0], "mass": [1e10, 10.7]}, filters)
    one = model.evaluate(redshift=1.0, mass=1.0).fnu.value
    assert_allclose(model.evaluate(redshift=1.0, mass=10 * u.Msun).fnu.value, 10 * one)


def test_an_agn_without_dust_to_refer_to_is_said(model, filters):
    table = QTable({"redshift": [1.0, 1.0], "ebv": [0.0, 0.1], "frac_agn": [0.5, 0.5]})
    got = model.fluxes(table, filters)
    assert [ModelFlags.names(f) for f in got["flags"]] == [["no_agn_power"], []]
    with pytest.warns(MiricigaleWarning, match="frac_agn has no effect"):
        model.evaluate(ebv=0.0, frac_agn=0.5)
    refuses("where nothing attenuates", SEDModel, [DelayedSFH(), BC03(), ParametricTorus()])


def test_a_band_with_the_name_of_another_column_is_refused(model):
    for name in ("sfr", "id", "flags"):
        bands = FilterSet([box(1.0, 2.0, name)])
        refuses("without names of other columns", model.fluxes, QTable({"redshift": [1.0]}), bands)


def test_columns_come_in_any_kind_of_table(model, filters, tmp_path):
    table = QTable({"redshift": [1.0, 2.0], "mass": [1e10, 1e11] * u.Msun})
    want = model.fluxes(table, filters)["miri.f770w"]
    table.write(tmp_path / "a.ecsv")
    plain = {"redshift": np.array([1.0, 2.0]), "mass": np.array([1e10, 1e11])}
    for given in (plain, table.as_array(), tmp_path / "a.ecsv", str(tmp_path / "a.ecsv")):
        assert np.array_equal(model.fluxes(given, filters)["miri.f770w"], want)
    assert model.fluxes({"redshift": 1.0}, filters)["miri.f770w"] == want[0]
    assert model.fluxes(table[1], filters)["miri.f770w"] == want[1]
    several = model.fluxes({"redshift": 1.0, "mass": [1e10, 1e11]}, filters)
    assert_quantity_allclose(several["miri.f770w"][1], 10 * want[0])
    with pytest.raises(ValueError, match="'table' must be a table with columns of one length"):
        model.fluxes({"redshift": [1.0, 2.0], "mass": [1e10] * 3}, filters)


@pytest.mark.parametrize(
    ("column", "match"),
    [
        (["a", "b"], "'age' must be numbers"),
        ([[1.0, 2.0], [1.0, 2.0]], "'age' must be of one dimension"),
        ([1j, 1.0], "'age' must be numbers"),
    ],
)
def test_columns_that_are_no_numbers_are_refused_by_name(model, filters, column, match):
    refuses(match, model.fluxes, QTable({"redshift": [1.0, 1.0], "age": column}), filters)


def test_a_default_agn_fraction_is_in_the_grid_too(filters):
    model = SEDModel([*SEDModel.yang2021(agn=False).components, ParametricTorus(frac_agn=0.5)])
    grid = model.grid({"redshift": [1.0], "age": [1.0]}, filters)
    row = model.fluxes(QTable({"redshift": [1.0], "age": [1.0]}), filters)
    want = [row[name][0].value / 1e10 for name in filters.names]
    assert_allclose(grid.flux(0, 0, 0, 0), want, rtol=1e-6)


def test_igm_components_may_have_parameters(filters):
    class Screen(IGM):
        name = "screen"
        depth = Parameter(default=0.0, bounds=(0.0, 9.0), doc="Optical depth.")

        def transmission(self, wave, redshift, *, depth):
            return np.full(wave.size, np.exp(-depth))

    model = SEDModel([DelayedSFH(), BC03(), Screen()])
    got = model.fluxes(QTable({"redshift": [1.0, 1.0], "depth": [0.0, 2.0]}), filters)
    for name in filters.names:
        assert (got[name][1] / got[name][0]).value == pytest.approx(np.exp(-2.0), rel=1e-9)
    refuses("depth", model.grid, {"redshift": [1.0], "depth": [0.0, 2.0]}, filters, error=KeyError)


def test_options_are_fixed_when_a_component_is_made():
    torus = ParametricTorus(polar_law="gaskell")
    with pytest.raises(AttributeError, match="'polar_law' is set when the component is made"):
        torus.polar_law = "smc"
    assert torus.polar_law == "gaskell"


def test_registration_needs_a_name_and_a_role():
    class Nameless(IGM):
        pass

    class Roleless(IGM):
        name, role = "roleless", "salt"

    refuses("'name' must be", register, Nameless)
    refuses("'role' must be one of sfh", register, Roleless)
    taken = type("Other", (IGM,), {"name": "delayed"})
    refuses("'delayed' is registered already", register, taken)
    assert register(DelayedSFH) is DelayedSFH  # the same again, as from a notebook's cell


@pytest.mark.parametrize("span", [(3.0, 1000.0), (5.0, 20.0), (0.5, 2.0)])
def test_a_fraction_of_the_light_in_any_range(span):
    """Integrals of the parts over the range; models, tables of models and grids agree."""
    model = SEDModel.yang2021(frac_agn_definition=f"{span[0]:g}-{span[1]:g}um")
    values = {"redshift": 0.5, "age": 3.0, "frac_agn": 0.3, "mass": 1e10}
    spectra = model.evaluate(**values)
    wave = spectra.wave.value / 1.5
    inside = (wave >= span[0] * (1 - 1e-9)) & (wave <= span[1] * (1 + 1e-9))
    parts = [spectra, *(spectra.components[f"agn_{n}"] for n in ("disk", "torus", "polar"))]
    fnu = np.array([part.fnu.value[inside] for part in parts])
    total, *agn = np.trapezoid(fnu / wave[inside] ** 2, wave[inside])
    assert sum(agn) / total == pytest.approx(0.3, rel=1e-6)
    bands = ["wfc3.f160w", "miri.f1500w"]
    table = model.fluxes(QTable({name: [value] for name, value in values.items()}), bands)
    axes = {"redshift": [0.5], "age": [1.0, 3.0], "frac_agn": [0.0, 0.3]}
    grid = model.grid(axes, bands, cache=False)
    one = grid.flux(0, 1, 0, 1) * 1e10
    assert_allclose([table[b][0].value for b in bands], one, rtol=1e-5)
    derived = spectra.derived
    assert_quantity_allclose(derived["agn_power"], table["agn_power"][0], rtol=1e-6)
    accretion = grid.agn_properties["accretion_power"][0].value * 3 / 7 * grid.dust_luminosity[1]
    assert 1e10 * accretion == pytest.approx(derived["accretion_power"].value, rel=1e-5)
    for wrong in ("20-5um", "0.01-20um", "ir"):
        match = "'frac_agn_definition' must be one of 'dust' and ranges"
        refuses(match, SEDModel.yang2021, frac_agn_definition=wrong)


def test_rows_that_share_nothing_are_those_of_single_models(filters):
    """Two metallicities, gas of all kinds, dust and redshifts of their own, more rows than a block has."""
    rng, n = np.random.default_rng(8), 70
    model = SEDModel.survey(libraries="bundled")
    table = {"redshift": rng.uniform(0.05, 6.0, n), "age": rng.uniform(0.01, 0.9, n)}
    table |= {"tau": rng.uniform(0.05, 5.0, n), "metallicity": rng.choice([0.004, 0.02], n)}
    table |= {"f_esc": rng.uniform(0, 0.5, n), "f_dust": rng.uniform(0, 0.5, n)}
    table |= {"log_u": rng.uniform(-3, -1, n), "ebv": rng.uniform(0, 1, n)}
    table |= {"u_min": rng.uniform(0.1, 25, n), "gamma": rng.uniform(0, 1, n)}
    table |= {"q_pah": rng.uniform(0.5, 4.5, n), "frac_agn": rng.choice([0.0, 0.3], n)}
    got = model.fluxes(table, filters)
    for i in range(0, n, 3):
        sed = model.evaluate(**{name: values[i] for name, values in table.items()})
        wanted = filters.synthetic_fluxes(sed).value
        mine = [got[name][i].value for name in filters.names]
        assert_allclose(mine, wanted, rtol=1e-6)
        alone = model.fluxes({name: values[i : i + 1] for name, values in table.items()}, filters)
        assert_allclose([alone[name][0].value for name in filters.names], mine, rtol=1e-13)
        for name, value in sed.derived.items():
            assert_allclose(got[name][i].value, value.value, rtol=1e-9, atol=1e-12)


def test_bands_keep_the_lines_of_spectra_at_other_redshifts():
    """Spectra of draws are on common wavelengths; a band with Halpha and [OIII] has the flux of each draw."""
    model = SEDModel.survey(agn=False, libraries="bundled")
    filters = FilterSet.from_names(["nircam.f410m", "nircam.f335m", "nircam.f444w"])
    redshift = np.array([5.2, 5.203, 5.211, 5.225, 5.237, 5.25, 5.27])
    n = redshift.size
    galaxies = QTable({"age": np.full(n, 0.05) * u.Gyr, "tau": np.full(n, 1.0) * u.Gyr})
    drawn = ListedModels(redshift, np.zeros(n), galaxies, QTable(), 0)
    wave, light = observed_spectra(model, drawn, drawn.index, np.full(n, 1e10))
    for row in range(n):
        values = {"redshift": redshift[row], "age": 0.05, "tau": 1.0, "mass": 1e10}
        wanted = filters.synthetic_fluxes(model.evaluate(**values)).to_value(u.uJy)
        seen = filters.synthetic_fluxes(SED(wave * u.um, light[row] * u.uJy)).to_value(u.uJy)
        assert_allclose(seen, wanted, rtol=5e-3)


def test_a_stellar_mass_is_that_of_living_stars():
    """As results and catalogs of other codes have it: the mass formed is larger by what stars lost."""
    model = SEDModel.yang2021(libraries="bundled")
    options = {"redshift": 1.0, "age": 3.0, "tau": 0.5, "frac_agn": 0.3}
    sed = model.evaluate(**options, stellar_mass=3e10)
    assert_quantity_allclose(sed.derived["stellar_mass"], 3e10 * u.Msun, rtol=1e-9)
    assert sed.parameters["mass"] > 4e10 * u.Msun
    rows = QTable({name: np.full(2, value) for name, value in options.items()})
    rows["stellar_mass"] = [3e10, 6e10] * u.Msun
    # the second is older than the universe
    rows["age"][1] = 9.0
    table = model.fluxes(rows, ["miri.f770w"])
    assert_quantity_allclose(table["miri.f770w"][0], sed.synthetic_flux("miri.f770w"), rtol=1e-4)
    assert_quantity_allclose(table["stellar_mass"][0], 3e10 * u.Msun, rtol=1e-9)
    assert table["flags"][1] == ModelFlags.OLDER_THAN_UNIVERSE
    # numbers by keyword are in the units of the parameters, as those of one model are
    named = model.fluxes(["miri.f770w"], **options, stellar_mass=3e10)
    assert_quantity_allclose(named["miri.f770w"], table["miri.f770w"][:1], rtol=1e-12)
    by_cigale = model.evaluate(**options, **{"stellar.m_star": 3e10 * u.Msun})
    assert_quantity_allclose(by_cigale.fnu, sed.fnu, rtol=1e-12)
    refuses("'stellar_mass' must be left out beside 'mass'", model, mass=3e10, stellar_mass=3e10)
    refuses("not its logarithm", model, stellar_mass=10.5)


def test_what_a_session_completes_are_components():
    model = SEDModel.yang2021()
    names = model._ipython_key_completions_()
    assert {one.role for one in model.components} <= set(names)
    assert {model[name].name for name in names} == {one.name for one in model.components}


def test_components_take_the_place_of_those_of_their_role():
    model = SEDModel.yang2021(libraries="bundled", cosmology=FlatLambdaCDM(70, 0.3))
    other = model.replace("smc", DelayedSFH(tau=3.0))
    assert other["attenuation"].name == "smc"
    assert other.defaults["tau"] == 3.0
    assert other["agn"] is model["agn"]
    assert other.cosmology is model.cosmology
    assert other.preset is None
    without = SEDModel(["delayed", "bc03"])
    assert without.replace("calzetti").component("attenuation").name == "calzetti"
    refuses("'components' must be", model.replace, 3, error=(TypeError, ValueError))
    refuses("no .*'smmc'", model.replace, "smmc", error=KeyError)


def test_parameters_and_fluxes_are_tables():
    model = SEDModel.yang2021(libraries="bundled")
    table = model.to_table()
    assert table["name"].tolist() == list(model.parameters)
    age = table[table["name"] == "age"][0]
    assert (age["default"], age["high"], age["unit"]) == (
        1.0,
        model.parameters["age"].bounds[1],
        "Gyr",
    )
    assert age["description"] == model.parameters["age"].doc
    records = [{"redshift": 1.0, "mass": 1e10}, {"redshift": 2.0, "mass": 3e10}]
    columns = {"redshift": [1.0, 2.0], "mass": [1e10, 3e10]}
    of_records = model.fluxes(records, ["F770W"])
    assert_quantity_allclose(of_records["F770W"], model.fluxes(columns, ["F770W"])["F770W"])
    assert model(redshift=1.0, age="300 Myr").parameters["age"] == 0.3 * u.Gyr
    refuses("'age' must be one number, got 'old'", model, redshift=1.0, age="old")
    fluxes = model.fluxes(redshift=[1.0], filters=["F770W"])
    assert fluxes["F770W"] == fluxes["miri.f770w"]
    sed = model(redshift=1.0, mass=1e10, frac_agn=0.2)
    assert sed.agn_fraction == 0.2
    assert sed.uv_slope == sed.derived["beta"]
    assert_quantity_allclose(sed.ssfr * sed.stellar_mass, sed.sfr)


def test_components_are_indexed_by_name_role_and_number():
    model = SEDModel.yang2021(libraries="bundled")
    assert model[0] is model["sfh"] is model.components[0]
    assert model[-1] is model.components[-1]
    refuses("no component 'skirtor'", model.__getitem__, "skirtor", error=KeyError)


def test_arrays_of_parameters_are_several_models():
    model = SEDModel.yang2021(libraries="bundled")
    redshifts = [0.5, 2.0]
    masses = [1e10, 3e10] * u.Msun
    several = model.evaluate(redshift=redshifts, mass=masses, age=1.0)
    for sed, redshift, mass in zip(several, redshifts, masses, strict=True):
        assert_array_equal(sed.fnu, model.evaluate(redshift=redshift, mass=mass, age=1.0).fnu)
    refuses("arrays of one length, got 2 of 'redshift', 3 of 'age'", model.evaluate,
            redshift=redshifts, age=[1.0, 2.0, 3.0])  # fmt: skip
