import astropy.units as u
import numpy as np
import pytest
from dust_extinction.shapes import P92
from scipy.integrate import quad

from miricigale.sed import SEDModel, _core
from miricigale.sed.components import DelayedSFH, DraineLi2007, Madau1995
from miricigale.sed.components.attenuation import SMC, CalzettiLeitherer, CharlotFall
from miricigale.sed.components.stellar import BC03

WAVE = np.geomspace(0.01, 1000.0, 1500)


def values_of(component, **changes):
    return {name: par.default for name, par in component.parameters.items()} | changes


def magnitudes(component, wave, **changes):
    """A(lambda) in mag of young and old stars."""
    factors = component.factors(
        np.atleast_1d(np.asarray(wave, float)), values_of(component, **changes)
    )
    return tuple(-2.5 * np.log10(f) for f in factors)


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
    ],
)
def test_starburst_curve_has_its_published_values(wave, k):
    assert curve(wave)[0] == pytest.approx(k, rel=2e-3)


@pytest.mark.parametrize("wave", [0.097, 0.10, 0.11, 0.1216, 0.14])
def test_far_ultraviolet_is_that_of_leitherer(wave):
    """Leitherer et al. 2002, equation 14, lambda in um."""
    want = 5.472 + 0.671 / wave - 9.218e-3 / wave**2 + 2.620e-3 / wave**3
    assert curve(wave)[0] == pytest.approx(want, rel=1e-12)


def test_the_two_starburst_fits_meet():
    """At 0.15 um, where one follows the other, they differ by 0.2 %."""
    low, high = curve([0.15 - 1e-9, 0.15])
    assert low == pytest.approx(high, rel=3e-3)


def test_nothing_is_dimmed_below_the_lyman_limit_nor_where_the_fit_turns_negative():
    # 2.659 (-1.857 + 1.040 / l) + 4.05 = 0
    zero = 1.040 / (1.857 - 4.05 / 2.659)
    assert zero == pytest.approx(3.115, abs=5e-4)
    k = curve([0.05, 0.0912, 0.0913, 2.2, zero * 0.999, zero * 1.001, 100.0])
    assert np.all(k[[0, 1, 5, 6]] == 0.0)
    assert np.all(k[[2, 3, 4]] > 0.0)


@pytest.mark.parametrize("slope", [-1.2, -0.3, 0.0, 0.6])
@pytest.mark.parametrize("bump", [0.0, 3.0, 10.0])
def test_colour_excess_is_kept(slope, bump):
    b, v = curve([0.44, 0.55], slope=slope, uv_bump=bump)
    want = 2.659 * (1.509 * (1 / 0.44 - 1 / 0.55) - 0.198 * (0.44**-2 - 0.55**-2))
    want += 2.659 * 0.011 * (0.44**-3 - 0.55**-3)
    assert b - v == pytest.approx(want, rel=1e-12)


def test_slope_is_a_power_law():
    """Without a bump the ratio of two curves is a power law, whatever the scale."""
    wave = np.array([0.1, 0.2, 0.4, 0.8, 1.6])
    ratio = curve(wave, slope=-0.5) / curve(wave)
    np.testing.assert_allclose(np.diff(np.log(ratio)), -0.5 * np.log(2.0))


def drude(wave, centre=0.2175, width=0.035):
    """Noll et al. 2009, equation 2 of Kriek & Conroy 2013."""
    return (wave * width) ** 2 / ((wave**2 - centre**2) ** 2 + (wave * width) ** 2)


def test_cigale_scaling_adds_the_bump_after_the_power_law():
    """Boquien et al. 2019, equation 8, with the E(B-V) of starburst curve and bump together."""
    part = CalzettiLeitherer(ebv_scaling="cigale")
    wave, band, slope, bump = (
        np.array([0.12, 0.2175, 0.3, 0.55, 2.0]),
        np.array([0.44, 0.55]),
        -0.4,
        2.5,
    )
    base, extra = curve(band), bump * drude(band)
    new = base * (band / 0.55) ** slope + extra
    scale = np.diff(base + extra) / np.diff(new)
    want = scale * (curve(wave) * (wave / 0.55) ** slope + bump * drude(wave))
    np.testing.assert_allclose(curve(wave, part, slope=slope, uv_bump=bump), want)
    # a bump alone is added as it is: its amplitude at 0.2175 um
    peak = curve(0.2175, part, uv_bump=3.0) - curve(0.2175, part)
    assert peak[0] == pytest.approx(3.0)


def test_scalings_agree_without_a_bump():
    np.testing.assert_allclose(
        curve(WAVE, slope=-0.7),
        curve(WAVE, CalzettiLeitherer(ebv_scaling="cigale"), slope=-0.7),
        rtol=1e-12,
        atol=1e-13,
    )


def test_bump_has_its_place_and_width():
    """A Drude profile is at half its height where |l^2 - l0^2| = l w, w apart."""
    part, centre, width = CalzettiLeitherer(ebv_scaling="cigale"), 0.21, 0.05
    options = {"uv_bump": 4.0, "uv_bump_wavelength": centre, "uv_bump_width": width}
    middle = np.sqrt(centre**2 + width**2 / 4)
    wave = np.array([middle - width / 2, centre, middle + width / 2])
    np.testing.assert_allclose(curve(wave, part, **options) - curve(wave, part), [2.0, 4.0, 2.0])


# ------------------------------------------------------------------------------------- SMC


# Prevot et al. 1984, table 2: E(lambda - V) / E(B - V)
PREVOT = [
    (0.1275, 13.54),
    (0.1435, 10.80),
    (0.1647, 8.49),
    (0.1910, 6.76),
    (0.2220, 5.30),
    (0.2665, 3.49),
    (0.3704, 1.67),
    (0.4255, 1.00),
]


@pytest.mark.parametrize(("wave", "excess"), PREVOT)
def test_smc_power_law_fits_prevot(wave, excess):
    """With the Milky Way's R_V; with 2.72 (Bouchet et al. 1985) it would be 1 to 13 % high."""
    assert curve(wave, SMC())[0] == pytest.approx(excess + 3.1, rel=0.06)


def test_smc_power_law_has_its_constants():
    k = curve([1.0, 0.1, 0.0912, 0.05], SMC())
    np.testing.assert_allclose(k, [1.39, 1.39 * 10**1.2, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(("wave", "excess"), PREVOT)
def test_pei_fits_prevot(wave, excess):
    assert curve(wave, SMC(law="pei1992"))[0] == pytest.approx(excess + 2.93, rel=0.03)


def test_pei_has_r_v_and_colour_excess():
    """R_V = 2.93 in Pei 1992; his fit leaves 4 % at 0.44 um, where xi should be 1."""
    b, v = curve([0.44, 0.55], SMC(law="pei1992"))
    assert v == pytest.approx(2.93, rel=0.05)
    assert b == pytest.approx(3.93, rel=0.05)


def test_pei_agrees_with_dust_extinction():
    """The same six terms, Pei's table 4, in the package's P92 (which divides by A_V)."""
    scale = 1.0 + 1.0 / 2.93
    terms = {
        "BKG": (185.0, 0.042, 90.0, 2.0),
        "FUV": (27.0, 0.08, 5.5, 4.0),
        "NUV": (0.005, 0.22, -1.95, 2.0),
        "SIL1": (0.010, 9.7, -1.95, 2.0),
        "SIL2": (0.012, 18.0, -1.80, 2.0),
        "FIR": (0.030, 25.0, 0.0, 2.0),
    }
    keys = {}
    for name, (a, centre, b, n) in terms.items():
        keys |= {f"{name}_amp": a * scale, f"{name}_lambda": centre, f"{name}_b": b, f"{name}_n": n}
    wave = np.geomspace(0.095, 900.0, 300)
    want = 2.93 * np.asarray(P92(**keys)(wave * u.um))
    np.testing.assert_allclose(curve(wave, SMC(law="pei1992")), want, rtol=1e-6, atol=1e-9)


# ------------------------------------------------------------------------ Charlot and Fall


def test_two_screens_for_young_stars_and_one_for_old():
    """Charlot & Fall 2000: A_V of all over that of the interstellar medium is 1 / mu."""
    young, old = magnitudes(CharlotFall(), 0.55, av_ism=0.6, mu=0.3)
    assert old[0] == pytest.approx(0.6)
    assert young[0] == pytest.approx(0.6 / 0.3)


def test_slopes_of_the_screens():
    wave = np.array([0.11, 0.22, 0.55, 1.1, 11.0])
    young, old = magnitudes(CharlotFall(), wave, av_ism=1.0, mu=0.5, slope_ism=-0.7, slope_bc=-1.3)
    np.testing.assert_allclose(old, (wave / 0.55) ** -0.7)
    np.testing.assert_allclose(young - old, (wave / 0.55) ** -1.3)


def test_screens_leave_light_below_the_lyman_limit():
    young, old = CharlotFall().factors(np.array([0.05, 0.0912, 0.0913]), values_of(CharlotFall()))
    assert np.all(young[:2] == 1.0)
    assert np.all(old[:2] == 1.0)
    assert young[2] < old[2] < 1.0


# ------------------------------------------------------------------------------ all of them

PARTS = [
    (CalzettiLeitherer(), "ebv"),
    (CalzettiLeitherer(uv_bump=3.0, slope=-0.4, ebv_factor=0.44), "ebv"),
    (SMC(), "ebv"),
    (SMC(law="pei1992", ebv_factor=0.3), "ebv"),
    (CharlotFall(), "av_ism"),
]


@pytest.mark.parametrize(("part", "amount"), PARTS)
def test_transmissions_are_between_zero_and_one(part, amount):
    for value in (0.0, 0.5, 3.0):
        for factor in part.factors(WAVE, values_of(part, **{amount: value})):
            assert factor.shape == WAVE.shape
            assert np.all((factor >= 0) & (factor <= 1))
            assert np.all(factor == 1) == (value == 0)


@pytest.mark.parametrize(("part", "amount"), PARTS)
def test_screens_multiply(part, amount):
    """Two screens one behind the other transmit what one of the sum does."""
    one, two, both = (
        part.factors(WAVE, values_of(part, **{amount: value})) for value in (0.4, 0.9, 1.3)
    )
    for first, second, third in zip(one, two, both, strict=True):
        np.testing.assert_allclose(first * second, third, rtol=1e-12)


@pytest.mark.parametrize("part", [CalzettiLeitherer(), SMC()])
def test_old_stars_have_their_share(part):
    young, old = magnitudes(part, WAVE, ebv=0.8, ebv_factor=0.44)
    np.testing.assert_allclose(old, 0.44 * young, atol=1e-12)


@pytest.mark.parametrize(("part", "amount"), PARTS)
def test_inert_parameters_change_nothing(part, amount):
    for changes in ({amount: 0.0}, {"uv_bump": 0.0}, {"mu": 1.0}):
        values = values_of(part, **{k: v for k, v in changes.items() if k in part.parameters})
        want = part.factors(WAVE, values)
        for name in part.inert(values):
            for edge in part.parameters[name].bounds:
                for got, same in zip(part.factors(WAVE, values | {name: edge}), want, strict=True):
                    np.testing.assert_array_equal(got, same)


@pytest.mark.parametrize(("part", "amount"), PARTS)
def test_a_changed_grid_is_seen(part, amount):
    """What was worked out for one grid is not given for another, nor to the same array refilled."""
    wave = np.array([0.3, 0.5, 1.0])
    values = values_of(part, **{amount: 0.7})
    part.factors(wave, values)
    wave[:] = [0.2, 0.4, 2.0]
    for at_once, alone in zip(
        part.factors(wave, values),
        zip(*(part.factors(np.array([w]), values) for w in wave), strict=True),
        strict=True,
    ):
        np.testing.assert_allclose(at_once, np.concatenate(alone), rtol=1e-14)


def test_factors_cannot_be_written_to():
    young, _ = CalzettiLeitherer().factors(WAVE, values_of(CalzettiLeitherer()))
    with pytest.raises(ValueError, match="read-only"):
        young[0] = 2.0


def test_absorbed_power_of_a_flat_spectrum():
    """Integral of 1 - 10^(-0.4 k E) for lambda L_lambda = const, against adaptive quadrature."""
    wave = np.geomspace(0.0913, 3.1, 4000)
    young, _ = CalzettiLeitherer().factors(wave, values_of(CalzettiLeitherer(), ebv=0.4))
    got = np.trapezoid((1 - young) / wave, wave)

    def lost(wave):
        return (1 - 10 ** (-0.4 * 0.4 * _core.leitherer_calzetti(wave))) / wave

    want = quad(lost, 0.0913, 3.1, points=[0.15, 0.63])[0]
    assert got == pytest.approx(want, rel=1e-5)


@pytest.mark.parametrize("part", [SMC(), SMC(law="pei1992"), CharlotFall()])
def test_dust_shines_with_what_it_took(part):
    model = SEDModel([DelayedSFH(), BC03(), part, DraineLi2007(), Madau1995()])
    galaxy = model.chain.galaxy(model.values({"age": 2.0}))
    light, wave = galaxy.starlight, model.chain.wave
    lost = np.trapezoid(light.intrinsic, wave) - np.trapezoid(light.light, wave)
    assert lost > 0
    assert np.trapezoid(galaxy.dust, wave) == pytest.approx(lost, rel=1e-6)


def test_unknown_option_is_refused():
    with pytest.raises(ValueError, match="'law' must be one of smc, pei1992, got 'lmc'"):
        SMC(law="lmc")
