"""X-ray bands of grids against closed forms and published luminosities."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad

from helpers.errors import refuses
from helpers.grids import node_fitter, photometry_table
from miricigale.fitting import BayesFitter
from miricigale.sed import COSMOLOGY, SEDModel, with_xray_bands
from miricigale.sed.xray_bands import disk_2500, xray_filter

BANDS = {"soft": [0.5, 2] * u.keV, "hard": [2, 10] * u.keV}
H_KEV = 4.135667696e-18  # h in keV s


@pytest.fixture(scope="module")
def model():
    return SEDModel.yang2021(libraries="bundled")


@pytest.fixture(scope="module")
def grid(model):
    axes = {"redshift": [0.5, 1.5], "age": [1.0, 3.0], "inclination": [30.0, 70.0]}
    axes["frac_agn"] = [0.0, 0.3, 0.9]
    return model.grid(axes, ["wfc3.f160w", "miri.f770w", "miri.f1500w"])


def flux_of(power_of_energy, low, high, z):
    """Mean F_nu in uJy over observed energies of a source of L_E in W/keV."""
    far = COSMOLOGY.luminosity_distance(z).to_value(u.m)
    power = quad(power_of_energy, low * (1 + z), high * (1 + z))[0]
    return power / (4 * np.pi * far**2) / ((high - low) / H_KEV) * 1e32


@pytest.mark.parametrize(
    ("law", "a1", "a2"), [({}, 0.5, 0.0), ({"angle_coefficients": (0.3, 0.6)}, 0.3, 0.6)]
)
def test_the_corona_hangs_on_the_disk_by_alpha_ox(model, grid, law, a1, a2):
    """L_nu(2 keV) = 10^(alpha_ox / 0.3838) L_nu(2500 A); the band is the integral over the cut power law."""
    options = {"alpha_ox": [-1.8, -1.4], "photon_index": 1.9, "cutoff": 200 * u.keV} | law
    x = with_xray_bands(grid, model, BANDS, **options)
    assert x.filters == (*grid.filters, "soft", "hard")
    assert x.n_agn == 2 * grid.n_agn
    assert_array_equal(x.agn[:, ::2, :3], grid.agn)
    assert_array_equal(x.galaxy[..., :3], grid.galaxy)
    slopes = x.agn_parameters["alpha_ox"].value
    assert slopes.tolist() == [-1.8, -1.4] * grid.n_agn
    angle = x.agn_parameters["inclination"].to_value(u.deg)
    for k in range(x.n_agn):
        two = 10 ** (slopes[k] / 0.3838) * x.agn_properties["l_2500"][k].value / H_KEV
        mu = np.cos(np.radians([angle[k], 30.0]))
        seen = np.divide(*(a1 * mu + a2 * mu**2 + 1 - a1 - a2))

        def corona(e, at_two=two * seen):
            return at_two * (e / 2) ** -0.9 * np.exp(-(e - 2) / 200)

        for i, z in enumerate(grid.redshift):
            for j, (low, high) in enumerate(((0.5, 2), (2, 10))):
                wanted = flux_of(corona, low, high, z)
                assert x.agn[i, k, 3 + j] == pytest.approx(wanted, rel=1e-8, abs=0)
        hard = quad(corona, 2, 10)[0]
        assert x.agn_properties["l_2_10kev"][k].value == pytest.approx(hard, rel=1e-8)


def test_the_disk_at_2500_a_is_that_of_quasars(model, grid):
    """nu L_nu(2500 A) is a third of the power or so: bolometric corrections of 3 to 5 (Runnoe et al. 2012)."""
    x = with_xray_bands(grid, model, BANDS, alpha_ox=[-1.5])
    blue = (x.agn_properties["l_2500"] / x.agn_properties["accretion_power"]).value
    nu = 299792458.0 / 0.25e-6
    # 30 deg is brighter than the mean over the sphere, 7/18 of that at 0 deg, by 1.58 / (7/6)
    assert np.all((nu * blue > 0.15) & (nu * blue < 0.5))


def test_the_disk_at_30_deg_is_brighter_than_in_the_mean_by_its_law():
    """L_lambda of a disk flat from 0.2 to 0.4 um that shines as cos i (1 + 2 cos i), by quadrature."""

    def law(cosine):
        return cosine * (1 + 2 * cosine)

    wave = np.linspace(0.2, 0.4, 2001)
    flat = SimpleNamespace(face_on=np.ones(wave.size))
    agn = SimpleNamespace(torus_spectra=lambda wave, values: flat)
    chain = SimpleNamespace(wave=wave, weights=np.gradient(wave))
    chain.weights[[0, -1]] /= 2
    brighter = law(np.cos(np.radians(30))) / quad(law, 0, 1)[0]
    # a watt over 0.2 um
    wanted = (5 * brighter * u.W / u.um).to(u.W / u.Hz, u.spectral_density(0.25 * u.um))
    assert disk_2500(chain, agn, {}) == pytest.approx(wanted.value, rel=1e-9)


def test_galaxies_shine_by_binaries_and_gas(model, grid):
    """Mezcua et al. 2018 (Fragos et al. 2013) by hand for solar stars, Mineo et al. 2012 for the gas."""
    x = with_xray_bands(grid, model, {"hard": [2, 10] * u.keV, "soft": [0.5, 2] * u.keV}, lmxb=0.3)
    for g in range(grid.n_galaxies):
        rate = grid.galaxy_properties["sfr_100myr"][g].to_value(1 / u.yr)
        mass = grid.galaxy_properties["stellar_mass"][g].value
        t = np.log10(grid.galaxy_shape["age_mass"][g].to_value(u.Gyr))
        log_low = 33.276 - 1.503 * t - 0.423 * t**2 + 0.425 * t**3 + 0.136 * t**4 + 0.3
        # 33.28 - 62.12 x 0.02 + 569.44 x 0.0004 - 1833.80 x 8e-6 + 1968.33 x 1.6e-7
        parts = ((mass * 1e-10 * 10**log_low, 1.56, 100.0, 2, 10), (rate * 10**32.2510, 2.0, 100.0, 2, 10),
                 (rate * 8.3e31, 1.0, 1.0, 0.5, 2))  # fmt: skip
        for j, (low, high) in enumerate(((2, 10), (0.5, 2))):
            wanted = 0.0
            for norm, index, cut, a, b in parts:
                shape = lambda e, i=index, c=cut: e ** (1 - i) * np.exp(-e / c)  # noqa: E731
                wanted += norm * flux_of(shape, low, high, 0.5) / quad(shape, a, b)[0]
            assert x.galaxy[0, g, 3 + j] == pytest.approx(wanted, rel=1e-4, abs=0)


def test_a_fit_takes_alpha_ox_from_the_x_rays(model, grid):
    """With 5 % errors the slope of the model comes back, in flux and posterior; without X-rays it is the prior."""
    slopes = np.round(np.arange(-1.9, -1.05, 0.1), 1)
    x = with_xray_bands(grid, model, BANDS, alpha_ox=slopes)
    chosen = x.agn_parameters["alpha_ox"] == -1.4
    k = np.flatnonzero(chosen & (x.agn_parameters["inclination"] == 30 * u.deg))[0]
    flux = 1e10 * x.flux(0, 1, k, 2)
    table = photometry_table(x.filters, flux, 0.05 * flux)
    on_nodes = node_fitter(x, model_error=0.05).fit(table, redshift=[0.5])
    assert on_nodes.best["alpha_ox"][0].value == pytest.approx(-1.4)
    assert on_nodes.chi2[0] < 1e-6
    found = BayesFitter(x, model_error=0.05).fit(table, redshift=[0.5])
    # the best of the places lies well within the error of 0.05
    assert found.best["alpha_ox"][0].value == pytest.approx(-1.4, abs=0.03)
    assert found.chi2[0] < 0.05
    assert found.std("alpha_ox")[0].value < 0.06
    truth = x.agn_properties["l_2_10kev"][k].value * 9 * x.dust_luminosity[1] * 1e10
    assert on_nodes.best["l_2_10kev"][0].to_value(u.W) == pytest.approx(truth, rel=1e-6)
    assert str(found.best["l_2500"].unit) == "W / Hz"
    without = node_fitter(x, list(grid.filters), model_error=0.05).fit(table, redshift=[0.5])
    assert_allclose(without.pdf["alpha_ox"][0], 1 / 9, rtol=1e-6)
    # upper limits in X-rays exclude bright coronae
    for name in BANDS:
        table[f"{name}_limit"] = [True]
    faint = BayesFitter(x, model_error=0.05).fit(table, redshift=[0.5])
    assert faint.percentile("alpha_ox", [0.975])[0, 0].value < -1.3


def test_what_is_refused_and_how_bands_are_drawn(model, grid):
    for bands, text in (({}, "new ones"), ({"miri.f770w": [1, 2] * u.keV}, "new ones"),
                        ({"x": [2, 1] * u.keV}, "two ascending positive energies")):  # fmt: skip
        refuses(text, with_xray_bands, grid, model, bands)
    for options, text in (
        ({"alpha_ox": [-1.4, -1.4]}, "'alpha_ox' must be ascending"),
        ({"cutoff": -3 * u.keV}, "'cutoff' must be positive, got -3"),
    ):
        refuses(text, with_xray_bands, grid, model, BANDS, **options)
    # all bands at once: the slopes of one call are not those of another
    once = with_xray_bands(grid, model, {"soft": BANDS["soft"]})
    match = "'grid' must be one of a model with ages, and without X"
    refuses(match, with_xray_bands, once, model, {"hard": BANDS["hard"]})
    # 12.398 Angstrom keV
    band = xray_filter("x", [2, 12] * u.keV)
    assert_allclose(band.wave[[1, -2]].to_value(u.AA), [12.39842 / 12, 12.39842 / 2], rtol=1e-5)
