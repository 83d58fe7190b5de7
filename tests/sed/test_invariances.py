"""Fluxes of a table of galaxies do not depend on its order, and scale with mass in any unit."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

BANDS = ["wfc3.f160w", "miri.f770w", "mips.24"]


@pytest.fixture(scope="module")
def table():
    rng, n = np.random.default_rng(2), 6
    table = QTable({"id": np.arange(n), "redshift": rng.uniform(0.2, 3, n)})
    table["mass"] = 10 ** rng.uniform(9, 11, n) * u.Msun
    table["age"], table["tau"] = rng.uniform(0.5, 2, n) * u.Gyr, rng.uniform(0.3, 3, n) * u.Gyr
    table["ebv"], table["frac_agn"] = rng.uniform(0, 0.6, n) * u.mag, rng.choice([0, 0.4], n)
    return table


def test_the_order_and_the_names_of_rows(model, table):
    fluxes = model.fluxes(table, BANDS)
    order = [4, 1, 5, 0, 3, 2]
    other = table[order]
    other["id"] = [f"galaxy {k}" for k in range(len(other))]
    found = model.fluxes(other, BANDS)
    for name in BANDS:
        assert_allclose(found[name].value, fluxes[name].value[order], rtol=1e-12)


def test_light_scales_with_mass_in_any_unit(model, table):
    fluxes = model.fluxes(table, BANDS)
    heavy = table.copy()
    heavy["mass"] = (10.0 * table["mass"]).to(u.kg)
    heavy["age"], heavy["tau"] = table["age"].to(u.Myr), table["tau"].to(u.s)
    found = model.fluxes(heavy, BANDS)
    for name in BANDS:
        assert_allclose(found[name].value, 10.0 * fluxes[name].value, rtol=1e-9)


def test_spectra_of_every_format(model, tmp_path):
    from miricigale.sed import SED

    sed = model.evaluate(redshift=1.0, frac_agn=0.3)
    for name in ("sed.ecsv", "sed.fits"):
        sed.write(tmp_path / name)
        again = SED.read(tmp_path / name)
        assert_array_equal(again.wave, sed.wave)
        assert_array_equal(again.fnu, sed.fnu)
        assert again.redshift == sed.redshift
