import astropy.units as u
import numpy as np
import pytest
from dust_extinction.parameter_averages import O94
from dust_extinction.shapes import P92
from numpy.testing import assert_allclose

from helpers.components import values_of
from helpers.errors import refuses
from miricigale.sed import SEDModel
from miricigale.sed.components import DelayedSFH, DraineLi2007, Madau1995, Nebular
from miricigale.sed.components.attenuation import (
    SMC,
    CalzettiLeitherer,
    CharlotFall,
    ModifiedStarburst,
)
from miricigale.sed.components.stellar import BC03

WAVE = np.geomspace(0.01, 1000.0, 1500)


def magnitudes(component, wave, **changes):
    """A(lambda) in mag of young and old stars."""
    wave = np.atleast_1d(np.asarray(wave, float))
    return -2.5 * np.log10(component.factors(wave, values_of(component, **changes)))


def curve(wave, component=None, **changes):
    return magnitudes(component or CalzettiLeitherer(), wave, ebv=1.0, **changes)[0]


# ------------------------------------------------------------------- starburst attenuation


@pytest.mark.parametrize(
    ("wave", "k"),
    [
        # R'_V, Calzetti et al. 2000
        (0.55, 4.05),
        # Calzetti et al. 2000, section 5: A(0.16 um) = 4.39 E(B-V)_gas, 0.44 of which is the stars'
        (0.16, 4.39 / 0.44),
        # k(H alpha) and k(H beta) as quoted by Dominguez et al. 2013, ApJ 763, 145
        (0.6563, 3.33),
        (0.4861, 4.60),
        # Calzetti et al. 2000, equation 4, on both sides of 0.63 um
        (0.6299, 2.659 * (-2.156 + 1.509 / 0.6299 - 0.198 / 0.6299**2 + 0.011 / 0.6299**3) + 4.05),
        (0.6301, 2.659 * (-1.857 + 1.040 / 0.6301) + 4.05),
    ],
)
def test_starburst_curve_has_its_published_values(wave, k):
    assert curve(wave)[0] == pytest.approx(k, rel=2e-3)


@pytest.mark.parametrize("wave", [0.097, 0.10, 0.11, 0.1216, 0.14, 0.1499])
def test_far_ultraviolet_is_that_of_leitherer(wave):
    """Leitherer et al. 2002, equation 14, lambda in um; Calzetti et al. 2000, equation 4, from 0.15 um."""
    want = 5.472 + 0.671 / wave - 9.218e-3 / wave**2 + 2.620e-3 / wave**3
    assert curve(wave)[0] == pytest.approx(want, rel=1e-12)
    x = 1 / (wave + 0.053)
    want = 2.659 * (-2.156 + 1.509 * x - 0.198 * x**2 + 0.011 * x**3) + 4.05
    assert curve(1 / x)[0] == pytest.approx(want, rel=1e-12)


def test_nothing_is_dimmed_below_the_lyman_limit_nor_where_the_fit_turns_negative():
    # 2.659 (-1.857 + 1.040 / l) + 4.05 = 0
    zero = 1.040 / (1.857 - 4.05 / 2.659)
    assert zero == pytest.approx(3.115, abs=5e-4)
    k = curve([0.05, 0.0912, 0.0913, 2.2, zero * 0.999, zero * 1.001, 100.0])
    assert np.all(k[[0, 1, 5, 6]] == 0.0)
    assert np.all(k[[2, 3, 4]] > 0.0)


@pytest.mark.parametrize("slope", [-1.2, -0.3, 0.0, 0.6])
@pytest.mark.parametrize("bump", [0.0, 3.0, 10.0])
def test_color_excess_is_kept(slope, bump):
    b, v = curve([0.44, 0.55], slope=slope, uv_bump=bump)
    want = 2.659 * (1.509 * (1 / 0.44 - 1 / 0.55) - 0.198 * (0.44**-2 - 0.55**-2))
    want += 2.659 * 0.011 * (0.44**-3 - 0.55**-3)
    assert b - v == pytest.approx(want, rel=1e-12)


def test_slope_is_a_power_law():
    """Without a bump the ratio of two curves is a power law, whatever the scale."""
    wave = np.array([0.1, 0.2, 0.4, 0.8, 1.6])
    ratio = curve(wave, slope=-0.5) / curve(wave)
    assert_allclose(np.diff(np.log(ratio)), -0.5 * np.log(2.0))


def drude(wave, center=0.2175, width=0.035):
    """Noll et al. 2009, equation 2 of Kriek & Conroy 2013."""
    return (wave * width) ** 2 / ((wave**2 - center**2) ** 2 + (wave * width) ** 2)


def test_cigale_scaling_adds_the_bump_after_the_power_law():
    """Boquien et al. 2019, equation 8, with the E(B-V) of starburst curve and bump together."""
    part = CalzettiLeitherer(ebv_scaling="cigale")
    wave, band = np.array([0.12, 0.2175, 0.3, 0.55, 2.0]), np.array([0.44, 0.55])
    slope, bump = -0.4, 2.5
    base, extra = curve(band), bump * drude(band)
    new = base * (band / 0.55) ** slope + extra
    scale = np.diff(base + extra) / np.diff(new)
    want = scale * (curve(wave) * (wave / 0.55) ** slope + bump * drude(wave))
    assert_allclose(curve(wave, part, slope=slope, uv_bump=bump), want)
    # a bump alone is added as it is: its amplitude at 0.2175 um
    peak = curve(0.2175, part, uv_bump=3.0) - curve(0.2175, part)
    assert peak[0] == pytest.approx(3.0)


def test_scalings_agree_without_a_bump():
    other = curve(WAVE, CalzettiLeitherer(ebv_scaling="cigale"), slope=-0.7)
    assert_allclose(curve(WAVE, slope=-0.7), other, rtol=1e-12, atol=1e-13)


def test_bump_has_its_place_and_width():
    """A Drude profile is at half its height where |l^2 - l0^2| = l w, w apart."""
    part, center, width = CalzettiLeitherer(ebv_scaling="cigale"), 0.21, 0.05
    options = {"uv_bump": 4.0, "uv_bump_wavelength": center, "uv_bump_width": width}
    middle = np.sqrt(center**2 + width**2 / 4)
    wave = np.array([middle - width / 2, center, middle + width / 2])
    assert_allclose(curve(wave, part, **options) - curve(wave, part), [2.0, 4.0, 2.0])


# ------------------------------------------------------------------------------------- SMC


# Prevot et al. 1984, table 2: E(lambda - V) / E(B - V)
PREVOT = [0.1275, 0.1435, 0.1647, 0.1910, 0.2220, 0.2665, 0.3704, 0.4255]
EXCESS = np.array([13.54, 10.80, 8.49, 6.76, 5.30, 3.49, 1.67, 1.00])


def test_smc_laws_fit_prevot():
    """With the Milky Way's R_V; with 2.72 (Bouchet et al. 1985) it would be 1 to 9 % high (13 % at 0.31 um)."""
    assert_allclose(curve(PREVOT, SMC()), EXCESS + 3.1, rtol=0.06)
    assert_allclose(curve(PREVOT, SMC(law="pei1992")), EXCESS + 2.93, rtol=0.03)


def test_smc_power_law_has_its_constants():
    k = curve([1.0, 0.1, 0.0912, 0.05], SMC())
    assert_allclose(k, [1.39, 1.39 * 10**1.2, 0.0, 0.0], atol=1e-12)


# Pei 1992, table 4: R_V, and amplitudes, wavelengths in um, b and n of six terms
TERMS = ("BKG", "FUV", "NUV", "SIL1", "SIL2", "FIR")
PEI = {
    "mw_pei1992": (3.08, [165, 14, 0.045, 0.002, 0.002, 0.012], 0.047, 4.0, 6.5),
    "lmc": (3.16, [175, 19, 0.023, 0.005, 0.006, 0.020], 0.046, 5.5, 4.5),
    "smc": (2.93, [185, 27, 0.005, 0.010, 0.012, 0.030], 0.042, 5.5, 4.0),
}


def pei(wave, galaxy):
    """k(lambda) of the package dust_extinction, whose P92 divides by A_V."""
    r_v, amplitudes, background, b_fuv, n_fuv = PEI[galaxy]
    columns = {
        "amp": np.array(amplitudes) * (1.0 + 1.0 / r_v),
        "lambda": [background, 0.08, 0.22, 9.7, 18.0, 25.0],
        "b": [90.0, b_fuv, -1.95, -1.95, -1.80, 0.0],
        "n": [2.0, n_fuv, 2.0, 2.0, 2.0, 2.0],
    }
    keys = {f"{t}_{c}": v for c, row in columns.items() for t, v in zip(TERMS, row, strict=True)}
    return r_v * np.asarray(P92(**keys)(wave * u.um))


# ------------------------------------------------------------------------ Charlot and Fall


def test_two_screens_for_young_stars_and_one_for_old():
    """Charlot & Fall 2000: A_V of all over that of the interstellar medium is 1 / mu."""
    young, old = magnitudes(CharlotFall(), 0.55, av_ism=0.6, mu=0.3)
    assert old[0] == pytest.approx(0.6)
    assert young[0] == pytest.approx(0.6 / 0.3)


def test_slopes_of_the_screens():
    wave = np.array([0.11, 0.22, 0.55, 1.1, 11.0])
    young, old = magnitudes(CharlotFall(), wave, av_ism=1.0, mu=0.5, slope_ism=-0.7, slope_bc=-1.3)
    assert_allclose(old, (wave / 0.55) ** -0.7)
    assert_allclose(young - old, (wave / 0.55) ** -1.3)


def test_screens_leave_light_below_the_lyman_limit():
    young, old = CharlotFall().factors(np.array([0.05, 0.0912, 0.0913]), values_of(CharlotFall()))
    assert np.all(young[:2] == 1.0)
    assert np.all(old[:2] == 1.0)
    assert young[2] < old[2] < 1.0


# ----------------------------------------------------------------------- stars and gas apart


def gas_curve(wave, law="mw", **changes):
    """A(lambda) of the gas for one magnitude of color excess."""
    part, wave = ModifiedStarburst(gas_law=law), np.atleast_1d(np.asarray(wave, float))
    return -2.5 * np.log10(part.gas_factor(wave, values_of(part, ebv_lines=1.0, **changes)))


@pytest.mark.parametrize("r_v", [2.0, 3.1, 6.0])
def test_gas_law_of_the_milky_way_agrees_with_dust_extinction(r_v):
    wave = np.geomspace(0.1001, 3.3, 500)
    want = r_v * np.asarray(O94(Rv=r_v)(wave * u.um))
    assert_allclose(gas_curve(wave, r_v_gas=r_v), want, rtol=1e-10)


def test_gas_law_goes_on_as_its_formulae_do():
    """Cardelli et al. 1989, equations 2 and 5, beyond 3.3 and 0.1 um."""
    wave = np.array([5.0, 10.0, 1000.0])
    assert_allclose(gas_curve(wave), (3.1 * 0.574 - 0.527) * wave**-1.61, rtol=1e-9)
    y = 1.0 / 0.0913 - 8.0
    want = 3.1 * (-1.073 - 0.628 * y + 0.137 * y**2 - 0.070 * y**3)
    want += 13.670 + 4.257 * y - 0.420 * y**2 + 0.374 * y**3
    assert_allclose(gas_curve([0.0913, 0.0912, 0.05]), [want, 0.0, 0.0], rtol=1e-12)


@pytest.mark.parametrize("law", list(PEI))
def test_gas_laws_of_pei_agree_with_dust_extinction(law):
    wave = np.geomspace(0.095, 900.0, 300)
    assert_allclose(gas_curve(wave, law), pei(wave, law), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("changes", [{}, {"slope": -0.5, "uv_bump": 3.0}])
@pytest.mark.parametrize("scaling", ["exact", "cigale"])
def test_stars_have_the_starburst_curve_and_their_share(changes, scaling):
    """Calzetti et al. 2000, equation 3: E(B-V) of stars is 0.44 of that of the gas."""
    part, starburst = (cls(ebv_scaling=scaling) for cls in (ModifiedStarburst, CalzettiLeitherer))
    got = part.factors(WAVE, values_of(part, ebv_lines=0.7, **changes))
    want = starburst.factors(WAVE, values_of(starburst, ebv=0.44 * 0.7, **changes))
    for stars in got:
        assert_allclose(stars, want[0], rtol=1e-12)


def chain_of(part, nebular=True):
    gas = [Nebular()] if nebular else []
    return SEDModel([DelayedSFH(), BC03(), *gas, part, DraineLi2007(), Madau1995()])


def line_power(sed, name):
    """Power of a line above a straight line through the light on both sides."""
    nebular = Nebular()
    center = dict(zip(nebular.table.names, nebular.table.line_wave, strict=True))[name]
    wave = sed.wave.to_value(u.um)
    part = np.abs(wave / center - 1.0) < 500.0 / 299792.458
    x, y = wave[part], (sed.fnu.value / wave**2)[part]
    return np.trapezoid(y - np.interp(x, x[[0, -1]], y[[0, -1]]), x)


@pytest.mark.parametrize(
    ("part", "amount", "k"),
    [
        # Cardelli et al. 1989 as quoted, R_V = 3.1; O'Donnell's optical part raises H beta by 1.5 %
        (ModifiedStarburst(), "ebv_lines", (2.53, 3.61)),
        (ModifiedStarburst(gas_law="smc"), "ebv_lines", pei(np.array([0.6565, 0.4863]), "smc")),
        (ModifiedStarburst(gas_law="lmc"), "ebv_lines", pei(np.array([0.6565, 0.4863]), "lmc")),
        # gas behind the dust of the stars: Dominguez et al. 2013, ApJ 763, 145
        (CalzettiLeitherer(), "ebv", (3.33, 4.60)),
    ],
)
def test_dust_dims_balmer_lines(part, amount, k):
    """The Balmer decrement rises by 10^(0.4 E (k(H beta) - k(H alpha)))."""
    model, excess = chain_of(part), 0.6
    lines = [
        model.evaluate(age=0.1, redshift=0.0, **{amount: value}).components["nebular"]
        for value in (0.0, excess)
    ]
    clear, dusty = (np.array([line_power(s, n) for n in ("H-alpha", "H-beta")]) for s in lines)
    lost = -2.5 * np.log10(dusty / clear) / excess
    assert_allclose(lost, k, rtol=0.02)
    if part.name == "modified_starburst" and part.gas_law == "mw":
        k = 3.1 * np.asarray(O94(Rv=3.1)(np.array([0.656461, 0.486268]) * u.um))
        assert_allclose(lost, k, rtol=1e-3)


def test_dust_takes_of_gas_and_stars_what_each_loses():
    """Absorbed power from the light without dust, the two laws and nothing of the chain."""
    part, excess = ModifiedStarburst(slope=-0.3), 0.5
    model = chain_of(part)
    clear = model.evaluate(age=0.3, redshift=0.0, ebv_lines=0.0).components
    dusty = model.evaluate(age=0.3, redshift=0.0, ebv_lines=excess)
    wave = clear["stellar"].wave.to_value(u.um)
    starburst = CalzettiLeitherer(slope=-0.3)
    stars = starburst.factors(wave, values_of(starburst, ebv=0.44 * excess))[0]
    gas = 10 ** (-0.4 * excess * gas_curve(wave))

    def power(sed, share):
        return np.trapezoid(sed.fnu.value / wave**2 * share, wave)

    want = power(clear["stellar"], 1 - stars) + power(clear["nebular"], 1 - gas)
    dust = dusty.components["dust"]
    assert power(dust, 1.0) == pytest.approx(want, rel=1e-6)
    seen = sum(power(dusty.components[name], 1.0) for name in ("stellar", "nebular", "dust"))
    sent = power(clear["stellar"], 1.0) + power(clear["nebular"], 1.0)
    assert seen == pytest.approx(sent, rel=1e-6)


# ------------------------------------------------------------------------------ all of them

PARTS = [
    (CalzettiLeitherer(), "ebv"),
    (CalzettiLeitherer(uv_bump=3.0, slope=-0.4, ebv_factor=0.44), "ebv"),
    (SMC(), "ebv"),
    (SMC(law="pei1992", ebv_factor=0.3), "ebv"),
    (CharlotFall(), "av_ism"),
    (ModifiedStarburst(), "ebv_lines"),
    (ModifiedStarburst(gas_law="lmc", uv_bump=3.0, slope=-0.4), "ebv_lines"),
]


def transmissions(part, wave, values):
    """For young and old stars, and for gas where it has its own."""
    gas = part.gas_factor(wave, values)
    return (*part.factors(wave, values), *(() if gas is None else (gas,)))


@pytest.mark.parametrize(("part", "amount"), PARTS)
def test_transmissions_are_between_zero_and_one(part, amount):
    for value in (0.0, 0.5, 3.0):
        for factor in transmissions(part, WAVE, values_of(part, **{amount: value})):
            assert factor.shape == WAVE.shape
            assert np.all((factor >= 0) & (factor <= 1))
            assert np.all(factor == 1) == (value == 0)


@pytest.mark.parametrize(("part", "amount"), PARTS)
def test_screens_multiply(part, amount):
    """Two screens one behind the other transmit what one of the sum does."""
    one, two, both = (
        np.array(transmissions(part, WAVE, values_of(part, **{amount: value})))
        for value in (0.4, 0.9, 1.3)
    )
    assert_allclose(one * two, both, rtol=1e-12)


@pytest.mark.parametrize("part", [CalzettiLeitherer(), SMC()])
def test_old_stars_have_their_share(part):
    young, old = magnitudes(part, WAVE, ebv=0.8, ebv_factor=0.44)
    assert_allclose(old, 0.44 * young, atol=1e-12)


@pytest.mark.parametrize(("part", "amount"), PARTS)
def test_a_changed_grid_is_seen(part, amount):
    """What was worked out for one grid is not given for another, nor to the same array refilled."""
    wave = np.array([0.3, 0.5, 1.0])
    values = values_of(part, **{amount: 0.7})
    transmissions(part, wave, values)
    wave[:] = [0.2, 0.4, 2.0]
    alone = [transmissions(part, np.array([w]), values) for w in wave]
    assert_allclose(transmissions(part, wave, values), np.hstack(alone), rtol=1e-14)


def test_unknown_option_is_refused():
    refuses("'law' must be one of smc, pei1992, got 'lmc'", SMC, law="lmc")
