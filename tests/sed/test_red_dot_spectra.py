"""Little red dots: the parts of their spectra in closed form, their grids, and models between the nodes."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.models import BlackBody
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.fitting.grid.interpolation import InterpolatedModels
from miricigale.sed import (
    SED,
    ModelGrid,
    SEDModel,
    read_spectra,
    red_dot,
    red_dot_axes,
    red_dots,
    template_grid,
)

#: A red dot of one part and no lines.
ENVELOPE = {"uv_to_optical": 0.0, "halpha_width": 0.0 * u.AA, "balmer_depth": 0.0}
#: One whose envelope is dark below the Balmer limit.
GALAXY = {"uv_to_optical": 1.0, "halpha_width": 0.0 * u.AA, "balmer_depth": 100.0}
BANDS = ["acs.f814w", "nircam.f150w", "nircam.f277w", "nircam.f444w", "miri.f770w"]


def flux_of_line(sed, center, half_width):
    """Integral of F_lambda over a line above straight lines between its ends, F_nu wave^-2 um."""
    wave, flam = sed.wave.value, sed.fnu.value / sed.wave.value**2
    inside = np.abs(wave / center - 1.0) < half_width
    wave, flam = wave[inside], flam[inside]
    under = np.interp(wave, wave[[0, -1]], flam[[0, -1]])
    return np.trapezoid(flam - under, wave)


@pytest.mark.parametrize("temperature", [3500.0, 5000.0])
def test_the_envelope_is_a_black_body(temperature):
    """Ratios of F_nu to that at 0.51 um are astropy's of Planck's law, and F_lambda peaks where Wien says."""
    sed = red_dot(temperature=temperature * u.K, **ENVELOPE)
    wave = np.array([0.2, 0.4, 0.7, 1.0, 2.0, 5.0]) * u.um
    planck = BlackBody(temperature * u.K)
    wanted = (planck(wave) / planck(0.51 * u.um)).value
    # the spectrum is linear between its points
    assert_allclose(sed.fnu_at(wave).value, wanted, rtol=2e-3)
    flam = sed.fnu.value / sed.wave.value**2
    assert sed.wave.value[flam.argmax()] * temperature == pytest.approx(2897.77, rel=3e-3)


def test_hydrogen_absorbs_below_the_balmer_limit():
    """Bound-free absorption grows as wave^3 to the limit at 3646 A, and ends there."""
    plain = red_dot(**ENVELOPE)
    sed = red_dot(**ENVELOPE | {"balmer_depth": 2.0})
    wave = np.array([0.1823, 0.36455, 0.36465, 0.5]) * u.um
    ratio = sed.fnu_at(wave) / plain.fnu_at(wave)
    assert_allclose(ratio, [np.exp(-0.25), np.exp(-2.0), 1.0, 1.0], rtol=2e-3)


def test_the_lines_have_their_equivalent_widths():
    """H alpha of 1000 A over the envelope, H beta of a ninth of its flux, [O III] of 800 A over the galaxy."""
    sed = red_dot(**ENVELOPE | {"halpha_width": 1000.0 * u.AA})
    under = red_dot(**ENVELOPE).fnu_at(0.65646 * u.um).value / 0.65646**2
    alpha = flux_of_line(sed, 0.65646, 0.015)
    assert alpha / under == pytest.approx(0.1, rel=0.01)
    assert alpha / flux_of_line(sed, 0.48627, 0.015) == pytest.approx(9.0, rel=0.01)
    # what two galaxies differ by is one of them
    one, three = (red_dot(**GALAXY | {"uv_to_optical": share}) for share in (1.0, 3.0))
    galaxy = SED(one.wave, 0.5 * (three.fnu - one.fnu))
    center = 0.4984
    level = np.interp(center, [0.485, 0.512], galaxy.fnu_at([0.485, 0.512] * u.um).value)
    width = flux_of_line(galaxy, center, 0.02) / (level / center**2)
    assert width == pytest.approx(0.08, rel=0.02)
    nearer = flux_of_line(galaxy, 0.50082, 0.003) / flux_of_line(galaxy, 0.49603, 0.003)
    assert nearer == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize("slope", [-2.3, -1.1])
def test_the_galaxy_has_its_slope_and_share(slope):
    """F_lambda ~ wave^slope in the ultraviolet; F_nu at 0.25 um over that of the envelope at 0.51 um."""
    sed = red_dot(**GALAXY | {"uv_slope": slope, "uv_to_optical": 0.3})
    wave = np.array([0.13, 0.25]) * u.um
    fnu = sed.fnu_at(wave).value
    found = np.log(fnu[1] / fnu[0]) / np.log(0.25 / 0.13) - 2.0
    assert found == pytest.approx(slope, abs=0.01)
    envelope = red_dot(**ENVELOPE)
    assert fnu[1] / envelope.fnu_at(0.51 * u.um).value == pytest.approx(0.3, rel=2e-3)
    # it does not rise in the infrared, and nothing is seen beyond the Lyman limit
    rest = (sed.fnu - envelope.fnu)[sed.wave > 0.6 * u.um]
    assert np.all(np.diff(rest.value) <= 1e-9)
    assert np.all(sed.fnu[sed.wave <= 0.0912 * u.um] == 0)


def test_gas_absorbs_the_part_that_it_covers():
    """Of optically very thick gas the light that it does not cover is left."""
    plain = red_dot(**ENVELOPE)
    sed = red_dot(**ENVELOPE | {"balmer_depth": 50.0, "covering": 0.7})
    ratio = sed.fnu_at([0.3, 0.36, 0.4] * u.um) / plain.fnu_at([0.3, 0.36, 0.4] * u.um)
    assert_allclose(ratio, [0.3, 0.3, 1.0], rtol=2e-3)


def test_lines_have_the_ratios_that_are_asked_for():
    sed = red_dot(**ENVELOPE | {"halpha_width": 1000.0 * u.AA, "balmer_decrement": 3.0})
    ratio = flux_of_line(sed, 0.65646, 0.015) / flux_of_line(sed, 0.48627, 0.015)
    assert ratio == pytest.approx(3.0, rel=0.01)
    wide, none = (red_dot(**GALAXY | {"oiii_width": width * u.AA}) for width in (1600.0, 0.0))
    galaxy = red_dot(**GALAXY)
    lines = [
        flux_of_line(SED(sed.wave, sed.fnu - none.fnu), 0.4984, 0.02) for sed in (wide, galaxy)
    ]
    assert lines[0] / lines[1] == pytest.approx(2.0, rel=1e-6)


def test_an_atmosphere_takes_the_place_of_the_black_body(tmp_path):
    """A library's file of Planck's law (Angstrom, F_lambda, 0.2 to 4 um) gives what the black body gives."""
    wave = np.arange(2000.0, 40000.0, 2.0)
    planck = BlackBody(4500 * u.K)(wave * u.AA).value / wave**2
    # an absorption line that is finer than the spectrum, of 10 A
    line = 1.0 - (np.abs(wave - 8500.0) < 5.0)
    np.savetxt(tmp_path / "t4500g-300z-1v02.spec", np.column_stack([wave, planck * line]))
    atmospheres = read_spectra(tmp_path)
    assert list(atmospheres) == ["t4500g-300z-1v02"]
    sed = red_dot(atmosphere=atmospheres["t4500g-300z-1v02"], uv_to_optical=0.0)
    black = red_dot(temperature=4500 * u.K, balmer_depth=0.0, uv_to_optical=0.0)
    at = [0.3, 0.5, 0.7, 1.0, 3.0] * u.um
    assert_allclose(sed.fnu_at(at).value, black.fnu_at(at).value, rtol=3e-3)
    # Rayleigh-Jeans beyond its end
    far = sed.fnu_at([10, 20] * u.um).value
    assert far[1] / far[0] == pytest.approx(0.25, rel=0.02)
    near = np.abs(sed.wave.value - 0.85) < 0.02
    missing = np.trapezoid((black.fnu - sed.fnu).value[near], sed.wave.value[near])
    assert missing == pytest.approx(0.001 * black.fnu_at(0.85 * u.um).value, rel=0.1)
    refuses("'temperature' must be left out", red_dot, atmosphere=sed, temperature=4000 * u.K)
    refuses("'atmosphere' must be an SED", red_dot, atmosphere="t4500")


def test_atmospheres_are_an_axis():
    wave = np.geomspace(0.1, 40.0, 2000) * u.um
    both = {f"{t}": SED(wave, BlackBody(t * u.K)(wave) * u.sr) for t in (4000, 5000)}
    spectra = red_dots({"uv_to_optical": [0.1, 0.4]}, atmospheres=both)
    grid = template_grid(spectra, BANDS, redshift=[4.0, 5.0])
    assert grid.axes["atmosphere"].tolist() == [0.0, 1.0]
    assert grid.axes["uv_to_optical"].tolist() == [0.1, 0.4]
    axes = {"temperature": [5000.0], "uv_to_optical": [0.4], "balmer_depth": [0.0]}
    black = template_grid(red_dots(axes), BANDS, redshift=[4.0, 5.0])
    row = grid.meta["templates"].index("5000, uv_to_optical 0.4")
    assert_allclose(grid.galaxy[:, row], black.galaxy[:, 0], rtol=5e-3)
    refuses("'atmospheres' must be one or more spectra", red_dots, atmospheres={})
    refuses("'temperature' must be left out", red_dots, {"temperature": [4e3]}, atmospheres=both)


def test_hot_dust_adds_to_the_infrared():
    """F_nu at 3 um is a share of that of the envelope at 1 um; the optical is as without dust."""
    plain, dusty = (red_dot(**ENVELOPE, hot_dust=share) for share in (0.0, 0.5))
    more = (dusty.fnu_at(3 * u.um) - plain.fnu_at(3 * u.um)) / plain.fnu_at(1 * u.um)
    assert more.value == pytest.approx(0.5, rel=2e-3)
    assert_allclose(dusty.fnu_at(0.7 * u.um), plain.fnu_at(0.7 * u.um), rtol=1e-3)


def test_parameters_that_cannot_be_are_refused():
    refuses("'temperature' must be at least 1000 K, got 10", red_dot, temperature=10 * u.K)
    refuses("'hot_dust' must be at least 0, got -1", red_dot, hot_dust=-1)
    refuses("'covering' must be 0 to 1, got 1.2", red_dot, covering=1.2)
    refuses("uv_slope", red_dot, uv_slope=np.nan)
    refuses("temperature", red_dot, temperature=4000, error=u.UnitsError)
    refuses("parameter of a red dot", red_dot, age=1, error=KeyError)
    refuses("parameter of a red dot", red_dots, {"age": [1]}, error=KeyError)


def test_spectra_are_a_grid_of_their_parameters(tmp_path):
    """Templates that are a full grid have their parameters as axes, others their numbers; files keep them."""
    axes = {"temperature": [4000.0, 5000.0, 6000.0], "uv_to_optical": [0.1, 0.4]}
    spectra = red_dots(axes)
    grid = template_grid(spectra, BANDS, redshift=[4.0, 5.0, 6.0])
    grid.write(tmp_path / "dots.fits")
    for one in (grid, ModelGrid.read(tmp_path / "dots.fits")):
        assert one.axes["temperature"].tolist() == axes["temperature"]
        assert one.galaxy_parameters["temperature"].unit == u.K
        assert "template" not in one.galaxy_parameters.colnames
    row = np.argmax(grid.galaxy_parameters["temperature"] == 5000 * u.K)
    alone = template_grid(
        {"one": red_dot(temperature=5000 * u.K, uv_to_optical=0.1)}, BANDS, redshift=[5.0]
    )
    assert_allclose(grid.galaxy[1, row], alone.galaxy[0, 0], rtol=1e-12)
    name = next(iter(spectra))
    rest = {key: sed for key, sed in spectra.items() if key != name}
    grid = template_grid(rest, BANDS, redshift=[4.0, 5.0])
    assert grid.galaxy_parameters.colnames == ["template"]
    # spectra of a chain, whose redshift is none of a grid of templates, stay numbered too
    model = SEDModel.yang2021(libraries="bundled", agn=False)
    chain = {str(age): model.evaluate(age=age, redshift=0.5) for age in (1.0, 3.0)}
    assert template_grid(chain, BANDS).galaxy_parameters.colnames == ["template"]
    plain = SED(spectra[name].wave, spectra[name].fnu)
    grid = template_grid(rest | {name: plain}, BANDS)
    assert grid.galaxy_parameters.colnames == ["template"]


def test_axes_are_those_of_published_spectra():
    """What de Graaff et al. 2025 find at 16 and 84 % lies within, and slopes at 16 and 50 %; redshifts to 10."""
    axes = red_dot_axes()
    for name, low, high in (
        ("temperature", 3500, 5500),
        ("halpha_width", 433, 1180),
        ("uv_slope", -1.91, -1.43),
        ("redshift", 2.3, 9.3),
    ):
        assert axes[name][0] <= low
        assert axes[name][-1] >= high
    assert axes["redshift"][-1] >= 10


def test_models_between_the_nodes_are_right():
    """Of axes with the values of the presets, interpolated fluxes are within 2 % at any values between them."""
    z = np.expm1(np.arange(np.log(6.0), np.log(6.6), 0.02))
    axes = red_dot_axes() | {"redshift": z, "uv_to_optical": np.array([0.1, 0.2, 0.4])}
    models = InterpolatedModels.of_grid(template_grid(red_dots(axes), BANDS, redshift=z))
    rng, n = np.random.default_rng(4), 40
    values = {name: rng.uniform(axis[0], axis[-1], n) for name, axis in axes.items()}
    values["redshift"] = rng.choice(z, n)
    units = {"temperature": u.K, "halpha_width": u.AA}
    fluxes = models.fluxes(values, values["redshift"], np.zeros(n))[0]
    apart = []
    for i in range(n):
        own = {name: x[i] * units.get(name, u.one) for name, x in values.items()}
        redshift = [float(own.pop("redshift"))]
        true = template_grid({"one": red_dot(**own)}, BANDS, redshift=redshift).galaxy[0, 0]
        apart.append(fluxes[i] / fluxes[i].mean() / true - 1.0)
    assert np.percentile(np.abs(apart), 95) < 0.03
    assert np.median(np.abs(apart)) < 0.01
