"""AGN populations against the luminosity functions that they are drawn from, and others."""

import itertools

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.evaluation import (
    AGNPopulation,
    agn_fraction,
    galaxy_mass_function,
    xray_luminosity_function,
    xray_obscured_fraction,
)
from miricigale.sed import COSMOLOGY, SEDModel, stern2015, xray_flux

ERG = u.erg / u.s
DENSITY = u.Mpc**-3 / u.dex


def lx(log_l):
    return 10.0 ** np.asarray(log_l, float) * ERG


# ------------------------------------------------------------------- published functions


def test_luminosity_function_by_hand():
    # Ueda et al. 2014, table 4
    for log_l, z, evolution in (
        (43.97, 0.0, 1.0),
        # before the cut-off at 1.86 x 10^(0.29 (44 - 44.61)) = 1.238
        (44.0, 1.0, 2**4.78),
        # cut-offs at 1.86 and 3
        (45.0, 4.0, 2.86 ** (4.78 + 0.84) * (4 / 2.86) ** -1.5 * (5 / 4) ** -6.2),
    ):
        x = 10 ** (log_l - 43.97)
        wanted = 2.91e-6 / (x**0.96 + x**2.71) * evolution
        assert xray_luminosity_function(lx(log_l), z).to_value(DENSITY) == pytest.approx(wanted)


@pytest.mark.parametrize("log_l", [42.0, 43.0, 44.2, 45.5])
def test_luminosity_function_has_no_step_in_redshift(log_l):
    z = np.linspace(0, 5, 5001)
    phi = xray_luminosity_function(lx(log_l), z).value
    assert np.max(np.abs(np.diff(np.log(phi)))) < 0.008


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("log_l", [43.0, 44.0, 45.0])
def test_luminosity_function_agrees_with_another(log_l, z):
    """The first model of Aird et al. 2015 (hard band), fitted to other data: within a factor 2.5."""
    x = log_l - 44.10
    cut = 2.02 * 10 ** (0.20 * min(log_l - 44.71, 0))
    evolution = (1 + min(z, cut)) ** 3.97 * ((1 + max(z, cut)) / (1 + cut)) ** -2.08
    other = 10**-5.63 / (10 ** (0.72 * x) + 10 ** (2.26 * x)) * evolution
    ratio = xray_luminosity_function(lx(log_l), z).to_value(DENSITY) / other
    assert 1 / 2.5 < ratio < 2.5


def test_counts_of_the_sky_are_those_of_deep_surveys():
    """AGN brighter than 1e-16 erg/s/cm2 at 0.5-7 keV: 4000 to 10000 a square degree."""
    z, log_l = np.linspace(0.05, 5, 100), np.arange(42, 46.5, 0.05)
    volume = COSMOLOGY.differential_comoving_volume(z).to_value(u.Mpc**3 / u.deg**2)
    density = xray_luminosity_function(lx(log_l), z[:, None]).to_value(DENSITY)
    bright = xray_flux(lx(log_l), z[:, None]).value > 1e-16
    number = np.trapezoid(np.sum(density * bright, axis=1) * 0.05 * volume, z)
    assert 4000 < number < 10000


def test_obscured_fraction_by_hand():
    # 0.43 (1 + z)^0.48 at 10^43.75, -0.24 for each dex, from 0.2 to (1 + 1.7) / (3 + 1.7)
    assert xray_obscured_fraction(lx(43.75), 0.0) == pytest.approx(0.43)
    assert xray_obscured_fraction(lx(44.25), 0.0) == pytest.approx(0.31)
    assert xray_obscured_fraction(lx([42, 46]), [0.0, 0.0]) == pytest.approx([2.7 / 4.7, 0.2])
    assert xray_obscured_fraction(lx(44.5), 2.0) == xray_obscured_fraction(lx(44.5), 4.0)


def test_mass_function_by_hand():
    # the bin 0.8 < z < 1.1 of Davidzon et al. 2017 at its characteristic mass, and 0.7 dex below it
    wanted = np.log(10) * (1.428e-3 + 2.19e-3) / np.e
    got = galaxy_mass_function(10**10.56 * u.Msun, [0.95, 0.96])
    assert got[0].to_value(DENSITY) == pytest.approx(wanted)
    assert got[1] < got[0]
    x = 10**-0.7
    wanted = np.log(10) * x * (1.428e-3 * x**-1.31 + 2.19e-3 * x**0.51) * np.exp(-x)
    low = galaxy_mass_function(10**9.86 * u.Msun, 0.95)
    assert low.to_value(DENSITY) == pytest.approx(wanted)
    # beyond the middle of the last bin, 4.5 < z < 5.5, that of the bin
    last, far = galaxy_mass_function(10**10.5 * u.Msun, [5.0, 9.0])
    assert far == last


def test_mass_function_agrees_with_another():
    """Tomczak et al. 2014 (ZFOURGE), 1 < z < 1.25: within 0.15 dex."""
    log_mass = np.array([9.5, 10.0, 10.5, 11.0])
    x = 10 ** (log_mass - 10.54)
    other = np.log(10) * x * np.exp(-x) * (10**-2.72 * x**0.30 + 10**-3.17 * x**-1.45)
    got = galaxy_mass_function(10**log_mass * u.Msun, 1.125).to_value(DENSITY)
    assert_allclose(np.log10(got), np.log10(other), atol=0.15)


# ------------------------------------------------------------------------- populations


@pytest.mark.parametrize("compton_thick", [0.0, 1.0])
@pytest.mark.parametrize("z", [0.4, 1.0, 2.3, 4.0])
def test_over_all_galaxies_the_agn_are_those_of_the_luminosity_function(z, compton_thick):
    log_l = np.array([42.0, 43.0, 44.0, 45.0])
    mass = 10 ** np.arange(9.0, 13.0, 0.003) * u.Msun
    chance = AGNPopulation(compton_thick=compton_thick).density(mass, z, lx(log_l))
    hosts = galaxy_mass_function(mass, z).to_value(DENSITY)
    number = np.trapezoid(hosts[:, None] * chance, dx=0.003, axis=0)
    wanted = xray_luminosity_function(lx(log_l), z).to_value(DENSITY)
    wanted *= 1 + compton_thick * xray_obscured_fraction(lx(log_l), z)
    assert_allclose(number, wanted, rtol=5e-3)


def test_rates_of_accretion_break_at_the_eddington_limit_and_black_holes_scatter():
    """Aird et al. 2013: slopes -0.65 and -2.1, 0.38 dex, by numerical convolution."""
    log_mass, y = np.array([9.5, 10.5, 11.5, 12.5]), np.linspace(-4.0, 4.0, 8001)
    rate = y + (44.0 - log_mass - np.log10(1.3e38 * 0.002 / 25.0))[:, None]
    law = 10 ** np.where(rate < 0, -0.65 * rate, -2.1 * rate)
    wanted = np.trapezoid(law * np.exp(-0.5 * (y / 0.38) ** 2), y)
    got = AGNPopulation().density(10**log_mass * u.Msun, 1.0, lx(44.0))[:, 0]
    assert_allclose(got / got[0], wanted / wanted[0], rtol=1e-4)


@pytest.fixture(scope="module")
def galaxies():
    """A volume of galaxies at z = 1, of the mass function above 10^9."""
    rng = np.random.default_rng(1)
    log_mass = np.linspace(9, 12.5, 3501)
    density = galaxy_mass_function(10**log_mass * u.Msun, 1.0).to_value(DENSITY)
    total = np.concatenate([[0], np.cumsum(0.5 * (density[1:] + density[:-1]) * 1e-3)])
    n = 40_000
    mass = 10 ** np.interp(rng.uniform(0, total[-1], n), total, log_mass) * u.Msun
    table = QTable({"id": np.arange(n), "redshift": np.full(n, 1.0), "stellar_mass": mass})
    return table, n / total[-1]


@pytest.fixture(scope="module")
def agn(galaxies):
    return AGNPopulation().draw(galaxies[0], seed=20210211)


def test_drawn_numbers_are_those_of_the_luminosity_function(galaxies, agn):
    _, volume = galaxies
    log_l = np.log10(agn["l_2_10kev"][agn["has_agn"]].to_value(ERG))
    assert log_l.min() >= 42
    edges = [42, 42.5, 43, 43.5, 44, 45]
    for low, high in itertools.pairwise(edges):
        x = np.linspace(low, high, 201)
        phi = xray_luminosity_function(lx(x), 1.0).to_value(DENSITY)
        wanted = volume * np.trapezoid(phi * (1 + xray_obscured_fraction(lx(x), 1.0)), x)
        got = np.sum((log_l >= low) & (log_l < high))
        assert got == pytest.approx(wanted, abs=4 * np.sqrt(wanted) + 0.01 * wanted)
    wanted = agn["probability"].sum()
    assert agn["has_agn"].sum() == pytest.approx(wanted, abs=4 * np.sqrt(wanted))


def test_drawn_absorption(agn):
    has = agn["has_agn"]
    psi = xray_obscured_fraction(agn["l_2_10kev"][has], 1.0)
    for name, wanted in {"compton_thick": psi / (1 + psi), "obscured": 2 * psi / (1 + psi)}.items():
        error = 0.5 / np.sqrt(has.sum())
        assert agn[name][has].mean() == pytest.approx(wanted.mean(), abs=4 * error)
        assert not np.any(agn[name][~has])
    assert np.all(agn["obscured"][agn["compton_thick"]])


def test_drawn_light_at_six_micron(agn):
    wanted = stern2015(agn["l_6um"]).to_value(ERG)
    assert_allclose(wanted, agn["l_2_10kev"].to_value(ERG), rtol=1e-9)
    assert np.all((agn["l_6um"] > 0) == agn["has_agn"])


def test_a_source_has_its_agn_whatever_else_there_is(galaxies, agn):
    table, _ = galaxies
    rows = np.flatnonzero(agn["has_agn"])[:40]
    again = AGNPopulation().draw(table[rows[::-1]], seed=20210211)[::-1]
    for name in ("id", "l_2_10kev", "compton_thick"):
        assert np.all(again[name] == agn[name][rows])
    # another limit leaves those above it
    bright = AGNPopulation(min_luminosity=lx(43)).draw(table[rows], seed=20210211)
    above = agn["l_2_10kev"][rows] > lx(43)
    assert_array_equal(bright["has_agn"], above)
    wanted = agn["l_2_10kev"][rows][above].value
    assert_allclose(bright["l_2_10kev"][above].value, wanted, rtol=0.05)
    other = AGNPopulation().draw(table[rows], seed=1)
    assert other["has_agn"].sum() < 20


def test_duty_cycle_of_massive_galaxies():
    """
    Galaxies at z of 2 or more with a specific accretion rate above 0.01: about 20 % (Aird et al. 2018).

    Their L_X above 0.01 x 1.3e38 erg/s x 0.002 M / 25.
    """
    for log_mass in (10.5, 11.0):
        limit = 0.01 * 1.3e38 * 0.002 * 10**log_mass / 25 * ERG
        chance = AGNPopulation(min_luminosity=limit).probability(10**log_mass * u.Msun, 2.25)
        assert 0.1 < chance[0] < 0.3


def test_what_is_no_galaxy_has_no_agn():
    table = QTable({"id": [1, 2, 3, 4, 5], "redshift": [np.nan, 0.0, 1.0, 1.0, 1.0]})
    table["stellar_mass"] = [1e11, 1e11, np.nan, -1, 1e8] * u.Msun
    for seed in range(20):
        agn = AGNPopulation().draw(table, seed=seed)
        assert not np.any(agn["has_agn"])
    assert np.all(agn["probability"] == 0)
    assert np.all(agn["l_6um"] == 0)
    assert len(AGNPopulation().draw(table[:0], seed=1)) == 0


def test_refuses():
    text = "'min_luminosity' must be from 1e41 to 1e46 erg/s"
    refuses(text, AGNPopulation, min_luminosity=1 * u.W)
    refuses("'compton_thick' must be >= 0, got -1", AGNPopulation, compton_thick=-1)
    chance, text = AGNPopulation().probability, "'stellar_mass' must be a quantity"
    refuses(text, chance, 1e10, 1.0, error=u.UnitsError)
    table = QTable({"id": [1, 1], "redshift": [1.0, 1.0], "stellar_mass": [1e10, 1e10] * u.Msun})
    refuses(r"ids are unique, got duplicates such as \[1\]", AGNPopulation().draw, table, seed=1)


# --------------------------------------------------------------------------- fractions


@pytest.mark.parametrize("definition", ["dust", "3-1000um"])
def test_fraction_gives_the_luminosity(definition):
    model = SEDModel.yang2021(libraries="bundled", frac_agn_definition=definition)
    table = QTable({"redshift": [1.0, 1.0, 2.0], "mass": [1e10, 1e11, 3e10] * u.Msun})
    table["inclination"] = [0.0, 70.0, 90.0]
    table["frac_agn"] = 0.5
    wanted = [1e35, 3e37, 0.0] * u.W
    half = model.fluxes(table, ["miri.f770w"])["l_6um"]
    table["frac_agn"] = agn_fraction(wanted, half)
    assert table["frac_agn"][2] == 0
    got = model.fluxes(table, ["miri.f770w"])["l_6um"]
    assert_allclose(got.to_value(u.W), wanted.value, rtol=1e-9)
    assert np.isnan(agn_fraction(1 * u.W, 0 * u.W))
