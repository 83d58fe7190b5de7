"""The parts of a model's light against its whole."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from miricigale.filters import FilterSet
from miricigale.sed import SEDModel
from miricigale.sed.light_parts import LightParts, quantities_of_parts

BANDS = ["acs.f606w", "wfc3.f160w", "miri.f770w", "miri.f1500w", "mips.24"]
REDSHIFTS = [0.3, 1.7]
ROWS = [
    {"age": 0.06, "tau": 0.3, "f_burst": 0.2, "ebv": 0.8, "q_pah": 1.0, "metallicity": 0.004},
    {"age": 2.0, "tau": 0.7, "f_burst": 0.0, "ebv": 0.0, "q_pah": 4.0, "metallicity": 0.02},
    {"age": 2.5, "tau": 3.0, "f_burst": 0.05, "ebv": 0.2, "q_pah": 0.47, "metallicity": 0.02},
]


@pytest.fixture(scope="module")
def model():
    return SEDModel.survey(libraries="bundled")


@pytest.fixture(scope="module")
def parts(model):
    return LightParts(model, FilterSet(BANDS), REDSHIFTS)


def whole(model, rows, redshift, **values):
    """Fluxes, shape (n, nb), and the table of models of one solar mass."""
    table = QTable()
    for name in rows[0]:
        column = np.array([row[name] for row in rows])
        table[name] = column * model.parameters[name].unit
    table["redshift"] = redshift
    table["mass"] = 1.0 * u.Msun
    for name, value in values.items():
        table[name] = value
    out = model.fluxes(table, BANDS)
    return np.column_stack([out[name].value for name in BANDS]), out


def test_parts_add_up_to_the_whole(model, parts):
    """Starlight, and what dust takes of it in the dust's template: the energy balance of the chain."""
    starlight = parts.starlight(ROWS)
    dust = parts.dust(ROWS)
    total = starlight.flux + starlight.columns[:, -1][:, None, None] * dust.flux
    for i, z in enumerate(REDSHIFTS):
        assert_allclose(total[:, i], whole(model, ROWS, z)[0], rtol=1e-5)


def test_agn_of_one_watt(model, parts):
    row = ROWS[2] | {"ebv_polar": 0.1, "tau97": 5.0}
    power = parts.starlight([row]).columns[0, -1]
    agn = parts.agn([row]).flux[0]
    for i, z in enumerate(REDSHIFTS):
        with_agn = whole(model, [row], z, frac_agn=0.6)[0]
        without = whole(model, [row], z, frac_agn=0.0)[0]
        # f / (1 - f) of what the dust of the galaxy emits
        assert_allclose(with_agn[0] - without[0], 1.5 * power * agn[i], rtol=1e-5)


def test_quantities_are_those_of_the_whole(model, parts):
    starlight = parts.starlight(ROWS)
    age = np.array([row["age"] for row in ROWS])
    absorbed = starlight.columns[:, -1]
    row = model.chain.reference_row
    dust = parts.dust(ROWS).columns
    quantities = quantities_of_parts(starlight.columns, absorbed, dust, age, row)
    expected = whole(model, ROWS, 1.0)[1]
    names = "stellar_mass sfr sfr_10myr sfr_100myr dust_luminosity ir_luminosity age_mass age_light"
    for name in [*names.split(), "a_v", "beta", "nuv_r", "u_v", "v_j"]:
        assert_allclose(quantities[name], expected[name].value, rtol=1e-6, atol=1e-9, err_msg=name)


def test_light_is_linear_in_the_burst(parts):
    """The mass fraction of a burst mixes two histories of one solar mass each."""
    row = ROWS[2]
    fractions = [0.0, 0.3, 0.9]
    tables = parts.starlight([row | {"f_burst": f} for f in fractions])
    for numbers in (tables.flux, tables.columns):
        assert_allclose(numbers[1], numbers[0] * (2 / 3) + numbers[2] / 3, rtol=1e-9)
