import re

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from helpers.components import values_of
from helpers.errors import refuses
from miricigale.sed import _core
from miricigale.sed.components import BC03
from miricigale.sed.components.nebular import Nebular, load_nebular
from miricigale.utils.exceptions import DataError

PHOTON = 1.98644586e-19  # h c in J um
LIMIT = 0.0912  # um
METALLICITIES = (0.0001, 0.0004, 0.004, 0.008, 0.02)


def ionizing(wave, spectra):
    """Photons per second and power in W below the Lyman limit, by trapezoids."""
    part = wave <= LIMIT
    x, y = wave[part], spectra[:, part]
    return np.trapezoid(y * x, x, axis=1) / PHOTON, np.trapezoid(y, x, axis=1)


@pytest.fixture(scope="module")
def gas():
    return Nebular()


def stars(metallicity):
    """Ages in Myr, ionizing photons and power per solar mass formed."""
    component = BC03()
    age, spectra, _ = component.table(metallicity)
    return age, *ionizing(component.nodes(), spectra)


def constant_rate(age, duration):
    """Masses at the ages for 1 Msun/yr over a time in Myr."""
    x = (np.arange(20000) + 0.5) * duration / 20000
    cell = np.searchsorted(age, x, side="right") - 1
    t = (x - age[cell]) / (age[cell + 1] - age[cell])
    out = np.bincount(cell, 1 - t, age.size) + np.bincount(cell + 1, t, age.size)
    return out * duration * 1e6 / 20000


def full(gas, **values):
    return values_of(gas, **({"metallicity": 0.02} | values))


def one_photon(gas, method="lines", at=2.0, **values):
    """What the gas gives for one ionizing photon per second from stars of an age in Myr."""
    return getattr(gas, method)(np.array([at]), np.ones(1), np.ones(1), full(gas, **values))


# --------------------------------------------------------------- recombination theory


@pytest.mark.parametrize("metallicity", METALLICITIES)
@pytest.mark.parametrize("log_u", [-4.0, -3.0, -2.0, -1.0])
def test_hydrogen_lines_are_case_b(gas, metallicity, log_u):
    lines = one_photon(gas, metallicity=metallicity, log_u=log_u)
    # Osterbrock & Ferland 2006, table 4.4: 10^4 K, with the range from 5000 to 20000 K;
    # collisions add a few per cent to H-alpha in hot gas
    assert lines["H-alpha"] / lines["H-beta"] == pytest.approx(2.86, abs=0.12)
    assert lines["H-gamma"] / lines["H-beta"] == pytest.approx(0.468, abs=0.02)
    assert 0.090 < lines["Paschen-alpha"] / lines["H-alpha"] < 0.133
    assert lines["Brackett-gamma"] / lines["H-beta"] == pytest.approx(0.0275, rel=0.25)
    # Kennicutt 1998, ARA&A 36, 189: Q = 7.31e11 L(H-alpha) in erg/s
    assert lines["H-alpha"] * 1e7 == pytest.approx(1 / 7.31e11, rel=0.05, abs=0)
    # Osterbrock & Ferland 2006: 2.1e12 photons for one erg of H-beta
    assert lines["H-beta"] * 1e7 == pytest.approx(1 / 2.1e12, rel=0.03, abs=0)


@pytest.mark.parametrize(
    ("metallicity", "temperature"), [(0.0004, 1.6e4), (0.004, 1.2e4), (0.008, 1.0e4)]
)
def test_balmer_jump_is_that_of_recombination_to_the_second_level(gas, metallicity, temperature):
    # 4 pi j = 6.84e-38 T^-1/2 (2 Ry / 8 k T) g, g = 0.876 at the threshold (Brown & Mathews
    # 1970), over that of H-beta, 1.235e-25 erg cm3/s (T/10^4 K)^-0.9; the temperatures are
    # what such nebulae have, to 20 %
    jump = 6.84e-38 * temperature**-0.5 * 2 * (157890 / temperature) / 8 * 0.876
    jump *= 2.998e18 / 3646.0**2 / (1.235e-25 * (temperature / 1e4) ** -0.9)  # per angstrom
    table = gas.table
    model = table.models(metallicity)[4]
    spectrum = table.continuum[model, 0] / 1e4
    # past the blend of the high Balmer lines
    low, high = np.interp([0.3630, 0.3720], table.wave, spectrum)
    beta = table.lines[model, 0, table.names.index("H-beta")]
    assert (low - high) / beta == pytest.approx(jump, rel=0.2)


def test_free_free_light_at_one_centimeter_is_that_of_the_radio_relation(gas):
    # Murphy et al. 2011, ApJ 737, 67, eqs 2 and 11, for 10^4 K
    expected = 5.37e-42 / 4.6e-28 * 30.0**-0.1  # L_nu / L(H-alpha) at 30 GHz, 1/Hz
    table = gas.table
    model = table.models(0.008)[4]
    alpha = table.lines[model, 0, table.names.index("H-alpha")]
    lnu = table.continuum[model, 0, -1] * table.wave[-1] ** 2 / _core.LIGHT
    assert table.wave[-1] == pytest.approx(1e4)
    assert lnu / alpha == pytest.approx(expected, rel=0.15, abs=0)


def test_lyman_limit_is_sharp_and_two_photon_light_ends_at_lyman_alpha(gas):
    nodes = gas.nodes()
    spectrum = one_photon(gas, "spectra")
    assert nodes[0] >= 0.0911
    assert spectrum[0] == 0.0
    # two photons share the energy of Lyman-alpha: L_lambda peaks near 0.14 um (Spitzer &
    # Greenstein 1951) and there is nothing of it on the other side of the line
    table = gas.table
    light = table.continuum[table.models(0.02)[4], 0]
    peak = table.wave[np.argmax(np.where(table.wave < 0.3, light, 0.0))]
    assert 0.130 < peak < 0.155
    assert np.interp(0.119, table.wave, light) < 0.3 * light[table.wave == peak]


def test_metal_lines_have_the_ratios_of_their_atoms(gas):
    lines = one_photon(gas, metallicity=0.008, log_u=-2.5)
    # transition probabilities: Storey & Zeippen 2000; Osterbrock & Ferland 2006
    assert lines["OIII-5007"] / lines["OIII-4959"] == pytest.approx(2.98, rel=0.04)
    assert lines["NII-6583"] / lines["NII-6548"] == pytest.approx(2.98, rel=0.04)
    assert lines["OI-6300"] / lines["OI-6364"] == pytest.approx(3.1, rel=0.03)
    # low-density limit (100 cm-3 here)
    assert lines["OII-3729"] / lines["OII-3726"] == pytest.approx(1.4, rel=0.1)
    assert lines["SII-6716"] / lines["SII-6731"] == pytest.approx(1.35, rel=0.1)


def test_wavelengths_are_those_of_the_laboratory_in_vacuum(gas):
    wave = dict(zip(gas.table.names, gas.table.line_wave, strict=True))
    published = {
        "Lyman-alpha": 0.121567, "H-beta": 0.486268, "H-alpha": 0.656461, "OIII-5007": 0.500824,
        "OII-3726": 0.372709, "Paschen-alpha": 1.87561, "Brackett-gamma": 2.16612,
        "ArII-6.985um": 6.98527, "SIV-10.51um": 10.5105, "NeII-12.81um": 12.81355,
        "NeIII-15.56um": 15.5551, "SIII-18.71um": 18.7130, "CII-157.7um": 157.7409,
    }  # fmt: skip
    assert {name: wave[name] for name in published} == pytest.approx(published, rel=2e-5)


# ------------------------------------------------------------ stars, energy, calibration


def test_h_alpha_of_a_constant_rate_is_the_published_calibration(gas):
    # Murphy et al. 2011: SFR = 5.37e-42 L(H-alpha), Kroupa, solar, 100 Myr (Starburst99)
    age, photons, _ = stars(0.02)
    lines = gas.lines(age, constant_rate(age, 100.0), photons, full(gas))
    rate = 5.37e-42 * lines["H-alpha"] * 1e7
    # its photons: 1.372e53 for 1 Msun/yr; BC03 (2016, MILES) have more, which is the stars' affair
    more = constant_rate(age, 100.0) @ photons / 1.372e53
    assert rate / more == pytest.approx(1.0, rel=0.05)
    assert 0.9 < more < 1.6


@pytest.mark.parametrize("metallicity", METALLICITIES)
@pytest.mark.parametrize("log_u", [-4.0, -2.25, 0.0])
def test_gas_emits_nearly_all_of_the_power_that_it_takes(gas, metallicity, log_u):
    age, photons, power = stars(metallicity)
    weights = constant_rate(age, 100.0)
    values = full(gas, metallicity=metallicity, log_u=log_u)
    emitted = np.trapezoid(gas.spectra(age, weights, photons, values), gas.nodes())
    # no more than what was absorbed; what is missing is in lines too faint to be listed
    assert 0.88 < emitted / (weights @ power) < 1.0


def test_gas_follows_the_ionizing_photons(gas):
    age, photons, _ = stars(0.02)
    weights = constant_rate(age, 30.0)
    values = full(gas)
    one = gas.spectra(age, weights, photons, values)
    assert_allclose(gas.spectra(age, 3 * weights, photons, values), 3 * one)
    assert_allclose(gas.spectra(age, weights, 0.2 * photons, values), 0.2 * one)
    parts = [gas.spectra(age, weights * k, photons, values) for k in (age < 5, age >= 5)]
    assert_allclose(parts[0] + parts[1], one, rtol=1e-12)
    assert not gas.spectra(age, 0 * weights, photons, values).any()


def test_every_age_has_its_photons_counted_once(gas):
    # the same hydrogen line for each photon, whatever the age, younger and older than the table
    ages = np.array([0.0, 0.3, 1.1, 3.3, 7.0, 30.0, 9000.0])
    beta = [one_photon(gas, at=at)["H-beta"] for at in ages]
    assert_allclose(beta, 4.78e-20, rtol=0.01)  # Inoue 2011
    together = gas.lines(ages, np.ones(7), np.arange(7.0), full(gas))["H-beta"]
    assert together == pytest.approx(np.arange(7.0) @ beta, rel=1e-9, abs=0)


@pytest.mark.parametrize(
    ("f_esc", "f_dust", "share"),
    # Inoue 2011: (1 - f) / (1 + 0.597 f)
    [(0.5, 0.0, 0.5 / 1.29845), (0.2, 0.3, 0.5 / 1.29845), (0.0, 0.1, 0.9 / 1.05969)],
)
def test_escape_and_dust_take_photons(gas, f_esc, f_dust, share):
    whole = one_photon(gas, "spectra")
    part = one_photon(gas, "spectra", f_esc=f_esc, f_dust=f_dust)
    assert_allclose(part, share * whole, rtol=1e-4)


def test_nothing_shines_when_all_photons_escape(gas):
    values = full(gas, f_esc=0.7, f_dust=0.3)
    assert gas.invalid(values) is None
    assert not one_photon(gas, "spectra", f_esc=0.7, f_dust=0.3).any()


# ------------------------------------------------------------------- metallicity, log U


def test_oxygen_lines_follow_ionization_and_metallicity(gas):
    def o32(**values):
        lines = one_photon(gas, **values)
        return lines["OIII-5007"] / (lines["OII-3726"] + lines["OII-3729"])

    steps = [o32(metallicity=0.008, log_u=x) for x in (-4.0, -3.3, -2.6, -1.9)]
    assert np.all(np.diff(steps) > 0)
    # metal-rich gas is cool (Pagel et al. 1979)
    cool, warm = (one_photon(gas, metallicity=z) for z in (0.02, 0.004))
    assert cool["OIII-4363"] / cool["OIII-5007"] < 0.3 * warm["OIII-4363"] / warm["OIII-5007"]
    assert cool["NII-6583"] / cool["H-alpha"] > 3 * warm["NII-6583"] / warm["H-alpha"]


def test_log_u_between_nodes_is_the_geometric_mean(gas):
    low, middle, high = (one_photon(gas, at=gas.table.age[3], log_u=x) for x in (-3.0, -2.75, -2.5))
    for name in ("H-alpha", "OIII-5007", "NeII-12.81um", "SIV-10.51um"):
        assert middle[name] == pytest.approx(np.sqrt(low[name] * high[name]), rel=1e-9, abs=0)


def test_gas_may_have_its_own_metallicity(gas):
    free = Nebular(gas="free", metallicity_gas=0.004)
    assert one_photon(free, metallicity=0.1) == one_photon(gas, metallicity=0.004)


@pytest.mark.parametrize(
    ("options", "values", "text"),
    [
        ({}, {"f_esc": 0.6, "f_dust": 0.5}, "'f_esc' and 'f_dust' must not exceed 1"),
        ({}, {"metallicity": 0.1}, "'metallicity' must be one of .* got 0.1; .*gas='free'"),
        ({}, {"metallicity": 0.05}, "'log_u' must be from -4 to -3 where .* 0.05, got -2"),
        ({"gas": "free"}, {"metallicity_gas": 0.01}, "'metallicity_gas' must be one of .* 0.01"),
    ],
)
def test_says_why_values_cannot_be_evaluated(options, values, text):
    component = Nebular(**options)
    assert component.invalid(full(component)) is None
    assert re.search(text, component.invalid(full(component, **values)))


# ----------------------------------------------------------------------------- drawing


@pytest.mark.parametrize("width", [20.0, 300.0, 1000.0])
def test_line_power_is_kept_on_any_grid_that_holds_the_nodes(width):
    component = Nebular(line_width=width)
    nodes = component.nodes()
    table = component.table
    continuum = np.interp(nodes, table.wave, table.emission(0.02, -2.0)[3, : table.wave.size])
    at = table.age[3]
    spectrum = one_photon(component, "spectra", at=at)
    lines = one_photon(component, at=at)
    rng = np.random.default_rng(1)
    others = np.exp(rng.uniform(np.log(0.09), np.log(1e4), 3000))
    merged = _core.merge_nodes([BC03().nodes(), nodes, others])
    drawn = _core.hat_matrix(nodes, merged) @ (spectrum - continuum)
    assert np.trapezoid(drawn, merged) == pytest.approx(sum(lines.values()), rel=1e-6, abs=0)
    # a line that stands alone
    center = dict(zip(table.names, table.line_wave, strict=True))["SIV-10.51um"]
    part = np.abs(merged / center - 1.0) < 2.0 * width / 299792.458
    x, y = merged[part], drawn[part]
    assert np.trapezoid(y, x) == pytest.approx(lines["SIV-10.51um"], rel=1e-6, abs=0)
    fine = np.linspace(x[0], x[-1], 20001)
    y = np.interp(fine, x, y)
    mean = np.trapezoid(y * fine, fine) / np.trapezoid(y, fine)
    assert mean == pytest.approx(center, rel=1e-3 * width / 299792.458)
    # a Gaussian at its nodes
    x = np.array([-0.75, -0.35, 0.35, 0.75])
    y_node = np.interp(center * (1 + x * width / 299792.458), fine, y)
    assert_allclose(y_node / y.max(), 2.0 ** (-4 * x**2), rtol=0.005)
    high = fine[y > 0.5 * y.max()]
    assert (high[-1] - high[0]) / center * 299792.458 == pytest.approx(width, rel=0.06)


def test_line_width_is_a_setting_with_a_unit():
    assert Nebular(line_width=0.5 * u.Unit("1000 km / s")).line_width == pytest.approx(500.0)
    assert Nebular(line_width=150.0).settings == {"gas": "stellar", "line_width": 150.0}
    refuses(r"'line_width' must be from 1\.0 to 3000\.0 km / s, got 0", Nebular, line_width=0.0)
    match = "'line_width' must be convertible to km / s"
    refuses(match, Nebular, error=u.UnitsError, line_width=3.0 * u.um)


def test_refuses_a_foreign_file(tmp_path):
    path = tmp_path / "other.fits"
    fits.PrimaryHDU(np.ones(3)).writeto(path)
    match = r"other\.fits is not a table of nebular emission"
    refuses(match, load_nebular, str(path), error=DataError)
    match = r"none\.fits cannot be read as a table of nebular emission"
    refuses(match, load_nebular, str(tmp_path / "none.fits"), error=DataError)
