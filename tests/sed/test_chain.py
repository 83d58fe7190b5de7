import itertools

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.filters import FilterSet
from miricigale.refdata import find_resource
from miricigale.sed import COMPONENTS, DERIVED, ModelFlags, SEDModel, components
from miricigale.sed.chain import UV_WINDOWS


def available(role):
    """Components of a role whose data are there."""
    names = [n for n in COMPONENTS.names() if COMPONENTS.metadata(n)["role"] == role]
    wanted = {n: COMPONENTS.get(n).resource for n in names if n != "sfh_table"}
    return [n for n, data in wanted.items() if data is None or find_resource(data)]


def make(*names, **options):
    return SEDModel([COMPONENTS.get(name)(**options.get(name, {})) for name in names])


SFH, *ROLES = (available(role) for role in ("sfh", "attenuation", "dust"))
#: Every attenuation with every dust, with and without gas; histories take turns.
CHAINS = list(zip(itertools.cycle(SFH), itertools.product(*ROLES, (False, True))))


@pytest.mark.parametrize(("sfh", "others"), CHAINS)
def test_energy_balance_of_every_chain(sfh, others):
    """
    Light of stars and gas in = light out + dust light, to 1e-6 of what dust took.

    With gas, dust also takes the share f_dust of the ionizing light.
    """
    *others, gas = others
    parts = [sfh, "bc03", *others, *(["nebular"] if gas else [])]
    options = {"nebular": {"f_dust": 0.3, "f_esc": 0.1}} if gas else {}
    model = make(*parts, **options)
    got = model.evaluate(age=0.6, redshift=0.5)

    def power(sed):
        rest = sed.wave.to_value(u.um) / 1.5
        return np.trapezoid(sed.fnu.value / rest**2, rest)

    lost = power(got.components["stellar_intrinsic"]) - power(got.components["stellar"])
    dust_light = power(got.components["dust"])
    if gas:
        lost -= power(got.components["nebular"])
        # with f_esc = 1 there is no gas: the stars alone, on the same nodes
        clear = make(*parts).evaluate(age=0.6, redshift=0.5, f_esc=1.0)
        stars = clear.components["stellar_intrinsic"]
        rest = stars.wave.to_value(u.um) / 1.5
        lost += 0.3 * np.trapezoid(np.where(rest < 0.0912, stars.fnu.value, 0.0) / rest**2, rest)
    assert dust_light == pytest.approx(lost, rel=1e-6)
    scale = got.derived["dust_luminosity"].to_value(u.W)
    assert scale > 0.0


@pytest.fixture(scope="module")
def full():
    """A chain with a component of every role."""
    parts = ("delayed", "bc03", "nebular", "calzetti", "dl07", "parametric_torus", "xray")
    return make(*parts, "inoue2014", "galactic_extinction")


BANDS = ["megacam.u", "wfc3.f160w", "irac.ch1", "miri.f770w", "miri.f2100w", "mips.24"]


def test_tables_and_single_models_agree_in_every_number(full):
    """Rows are worked out together by other code than a single spectrum."""
    rng = np.random.default_rng(3)
    n = 150  # more than one block
    steps = {"age": [0.02, 0.3, 2.0], "frac_agn": [0.0, 0.3, 0.9], "ebv_polar": [0.0, 0.1]}
    steps |= {"f_dust": [0.0, 0.2], "ebv_galactic": [0.0, 0.05]}
    ranges = {"redshift": (0.0, 3.0), "mass": (1e8, 1e11), "ebv": (0.0, 0.8)}
    ranges |= {"temperature_polar": (100.0, 300.0), "photon_index": (1.7, 2.0)}
    table = QTable({name: rng.choice(values, n) for name, values in steps.items()})
    for name, ends in ranges.items():
        table[name] = rng.uniform(*ends, n)
    filters = FilterSet.from_names(BANDS)
    got = full.fluxes(table, filters)
    assert np.all(got["flags"] == 0)
    for i in rng.choice(n, 12, replace=False):
        one = full.evaluate(**{name: table[name][i] for name in table.colnames})
        fluxes = filters.synthetic_fluxes(one)
        assert_quantity_allclose(u.Quantity([got[b][i] for b in BANDS]), fluxes, rtol=1e-6)
        for name, value in one.derived.items():
            assert_quantity_allclose(got[name][i], value, rtol=1e-9, atol=1e-12 * value.unit)


def test_every_derived_quantity_comes_with_unit_and_description(full):
    got = full.fluxes(QTable({"redshift": [1.0]}), BANDS)
    for name, entry in full.derived_columns().items():
        assert got[name].unit == entry.unit
        assert got[name].info.description == entry.text
    assert set(DERIVED) < set(full.derived_columns())


# ------------------------------------------------------------------- derived values


def test_a_v_of_a_screen_is_its_curve_at_the_visual():
    """Calzetti et al. 2000: k(0.55 um) = 4.05, R_V, to the rounding of its coefficients."""
    model = make("delayed", "bc03", "calzetti", "dl07")
    got = model.derived(ebv=0.4, age=1.0)["a_v"]
    k = 2.659 * (-2.156 + 1.509 / 0.55 - 0.198 / 0.55**2 + 0.011 / 0.55**3) + 4.05
    assert got.to_value(u.mag) == pytest.approx(0.4 * k, rel=1e-9)
    assert k == pytest.approx(4.05, rel=0.02)
    assert model.derived(ebv=0.0, age=1.0)["a_v"].value == 0.0


def test_ages_of_a_constant_history_and_of_a_burst():
    model = make("constant", "bc03")
    got = model.derived(age=2.0, redshift=0.1)
    assert got["age_mass"].to_value(u.Gyr) == pytest.approx(1.0, rel=1e-3)
    # young stars outshine: the age by light is below that by mass
    assert 0.1 < got["age_light"].to_value(u.Gyr) < 1.0
    burst = make("delayed", "bc03").derived(age=5.0, tau=0.001, redshift=0.1)
    for name in ("age_mass", "age_light"):
        assert burst[name].to_value(u.Gyr) == pytest.approx(5.0, rel=2e-3)
    # of Kroupa's (2001) m^-1.3 from 0.1 and m^-2.3 from 0.5 to 100 Msun, those that live 10 m^-2.5 Gyr
    low = (0.5**0.7 - 0.1**0.7) / 0.7
    alive, every = (low + 0.5 / 0.3 * (0.5**-0.3 - m**-0.3) for m in (2**0.4, 100.0))
    living = burst["stellar_mass"] / burst["stellar_mass_formed"]
    assert living.value == pytest.approx(alive / every, abs=0.02)


def test_beta_against_a_fit_of_the_spectrum(full):
    """The slope in the windows of Calzetti et al. 1994, from the SED without AGN and sky."""
    model = make("delayed", "bc03", "calzetti", "dl07")
    sed = model.evaluate(age=0.3, ebv=0.25, redshift=0.0)
    logs = []
    for low, high in UV_WINDOWS:
        wave = np.linspace(low, high, 400)
        f_lambda = sed.fnu_at(wave * u.um).value / wave**2
        logs.append(np.log10(np.trapezoid(f_lambda, wave) / (high - low)))
    slope = np.polyfit(np.log10(np.mean(UV_WINDOWS, axis=1)), logs, 1)[0]
    got = model.derived(age=0.3, ebv=0.25, redshift=0.0)["beta"].value
    assert got == pytest.approx(slope, abs=5e-3)


def test_beta_of_young_stars_without_dust_is_the_published_one():
    """Constant star formation for 100 Myr has beta of -2.1 to -2.4 (Leitherer et al. 1999)."""
    got = make("constant", "bc03").derived(age=0.1, redshift=0.1)["beta"].value
    assert -2.5 < got < -2.0
    # Meurer et al. 1999: A_1600 = 4.43 + 1.99 beta; Calzetti's curve has k(0.16 um) = 9.97
    model = make("constant", "bc03", "calzetti", "dl07")
    betas = [model.derived(age=0.1, ebv=e, redshift=0.1)["beta"].value for e in (0.1, 0.4)]
    assert 9.97 * 0.3 / (betas[1] - betas[0]) == pytest.approx(1.99, rel=0.15)


def test_rest_frame_colors_against_synphot(full):
    """The galaxy at 10 pc through the same curves, by synphot's own integration."""
    synphot = pytest.importorskip("synphot")
    model = make("delayed", "bc03", "nebular", "calzetti", "dl07")
    got = model.derived(age=1.0, ebv=0.2, redshift=1.5)
    source = model.evaluate(age=1.0, ebv=0.2, redshift=0.0).to_synphot()

    def magnitude(curve):
        band = FilterSet.from_names([f"sedpy.{curve}"])[0].to_synphot()
        waves = np.union1d(source.waveset.value, band.waveset.value) * u.AA
        seen = synphot.Observation(source, band, binset=waves)
        return seen.effstim("abmag", wavelengths=waves).value

    bands = {"nuv_r": ("galex_NUV", "sdss_r0"), "u_v": ("bessell_U", "bessell_V")}
    for name, pair in (bands | {"v_j": ("bessell_V", "twomass_J")}).items():
        color = np.subtract(*(magnitude(curve) for curve in pair))
        assert got[name].to_value(u.mag) == pytest.approx(color, abs=2e-3)


def test_passive_and_star_forming_galaxies_fall_on_their_sides_of_uvj():
    """Williams et al. 2009: passive where U - V > 0.88 (V - J) + 0.69 (Vega 0.69 in AB there)."""
    old = make("delayed", "bc03").derived(age=6.0, tau=0.1, redshift=0.1)
    young = make("constant", "bc03").derived(age=1.0, redshift=0.1)
    side = lambda q: (q["u_v"] - 0.88 * q["v_j"]).value  # noqa: E731
    assert side(old) > 0.59 > side(young)


# ---------------------------------------------------------------- gas, X-rays, the sky


def test_gas_takes_ionizing_light_and_lets_the_rest_pass():
    with_gas = make("constant", "bc03", "nebular")
    got = with_gas.evaluate(age=0.05, redshift=0.0)
    leak = with_gas.evaluate(age=0.05, redshift=0.0, f_esc=1.0)
    wave = got.wave.to_value(u.um)
    stars, gas = (got.components[name].fnu.value for name in ("stellar", "nebular"))
    assert np.all(stars[wave < 0.0912] == 0.0)
    soft = (wave > 0.0913) & (wave < 1.0)
    assert_allclose(stars[soft], leak.fnu.value[soft], rtol=1e-12)
    assert_allclose(stars + gas, got.fnu.value, rtol=1e-7)
    assert np.all(leak.components["nebular"].fnu.value == 0.0)
    bare = make("constant", "bc03").evaluate(age=0.05, redshift=0.0)
    _, ours, theirs = np.intersect1d(got.wave.value, bare.wave.value, return_indices=True)
    assert_quantity_allclose(leak.fnu[ours], bare.fnu[theirs], rtol=1e-9)


def test_gas_that_the_table_lacks_is_flagged():
    model = make("constant", "bc03", "nebular")
    table = QTable({"redshift": [0.1, 0.1], "metallicity": [0.02, 0.05], "age": [0.1, 0.1]})
    got = model.fluxes(table, ["wfc3.f160w"])
    assert [ModelFlags.names(f) for f in got["flags"]] == [[], ["not_in_library"]]
    refuses("'log_u' must be from -4 to -3 where the gas", model.evaluate, metallicity=0.05)


def test_xrays_follow_the_mass_by_their_own_relation(full):
    """Stern 2015 is a parabola in log L(6 um): ten times the mass is not ten times the X-rays."""
    table = QTable({"redshift": [1.0, 1.0], "mass": [1e10, 1e11] * u.Msun, "frac_agn": [0.5, 0.5]})
    got = full.fluxes(table, ["miri.f770w"])
    x = np.log10(got["l_6um"].to_value("erg/s") / 1e41)
    want = 40.981 + 1.024 * x - 0.047 * x**2
    assert_allclose(np.log10(got["l_2_10kev"].to_value("erg/s")), want, rtol=1e-9)
    none = full.fluxes(QTable({"redshift": [1.0]}), ["miri.f770w"])
    assert none["l_2_10kev"].value == 0.0
    refuses("with 'agn' if there is 'xray'", make, "delayed", "bc03", "xray")


def test_foreground_dims_each_source_by_its_own_extinction():
    model = make("delayed", "bc03", "galactic_extinction")
    table = QTable({"redshift": [0.5, 0.5], "ebv_galactic": [0.0, 0.1] * u.mag})
    got = model.fluxes(table, ["acs.f606w", "miri.f770w"])
    dimming = [-2.5 * np.log10(got[b][1] / got[b][0]) for b in ("acs.f606w", "miri.f770w")]
    # A(F606W) about 2.5-2.9 E(B-V) for R_V = 3.1, A(7.7 um) some per cent of A_V
    assert 0.24 < dimming[0] < 0.31
    assert 0.0 < dimming[1] < 0.03
    f99 = make("delayed", "bc03", "galactic_extinction", galactic_extinction={"law": "F99"})
    refuses(r"F99.*miri\.f770w", f99.fluxes, table, ["miri.f770w"])
    # in a grid it is the default's, and no axis
    with pytest.raises(KeyError, match="ebv_galactic"):
        model.grid({"redshift": [0.5], "ebv_galactic": [0.0, 0.1]}, ["acs.f606w"])


def test_separation_age_decides_who_is_young():
    model = make("constant", "bc03", "calzetti", "dl07", calzetti={"ebv_factor": 0.0})
    lost = [
        model.derived(age=0.1, separation_age=s, redshift=0.1)["dust_luminosity"].value
        for s in (0.0, 10.0, 100.0)
    ]
    assert lost[0] == pytest.approx(0.0, abs=1e-9 * lost[1])
    assert lost[0] < lost[1] < lost[2]
    assert isinstance(model.component("attenuation"), components.CalzettiLeitherer)
