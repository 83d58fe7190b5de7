import operator
import pickle

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pytest
from astropy.constants import c
from astropy.io import fits
from astropy.table import QTable
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.filters import Filter
from miricigale.sed import COSMOLOGY, SED, SEDModel
from miricigale.utils.exceptions import ModelWarning

WAVE = np.geomspace(0.3, 40.0, 300) * u.um


@pytest.fixture
def flat():
    return SED(WAVE, np.full(WAVE.size, 3.0) * u.uJy)


def test_synphot_round_trip():
    wave = np.geomspace(0.3, 30.0, 50) * u.um
    sed = SED(wave, np.linspace(1, 9, 50) * u.uJy, redshift=0.5)
    back = SED.from_synphot(sed.to_synphot(), redshift=0.5)
    assert_quantity_allclose(back.wave, sed.wave, rtol=1e-12)
    assert_quantity_allclose(back.fnu, sed.fnu, rtol=1e-10)
    assert back.redshift == 0.5


def test_flux_density_by_wavelength_is_converted():
    wave, flam = [1.0, 2.0] * u.um, [1.0, 1.0] * u.Unit("erg / (s cm2 AA)")
    assert_quantity_allclose(SED(wave, flam).fnu, flam.to(u.uJy, u.spectral_density(wave)))


def test_redshifting_keeps_the_luminosity(flat):
    far = flat.replace(redshift=0.5).redshifted(2.0)
    light = [np.trapezoid(s.fnu, s.wave.to(u.Hz, u.spectral())) for s in (flat, far)]
    near, away = COSMOLOGY.luminosity_distance([0.5, 2.0])
    assert_quantity_allclose(light[0] * near**2, light[1] * away**2, rtol=1e-10)
    assert_quantity_allclose(far.wave[0], WAVE[0] * 2.0)


def test_sed_never_changes(flat):
    with pytest.raises(ValueError, match="read-only"):
        flat.fnu.value[0] = 1.0
    with pytest.raises(AttributeError):
        flat.redshift = 2.0


@pytest.mark.parametrize(
    ("wave", "fnu", "error", "match"),
    [
        ([1, 2] * u.um, [1, 2] * u.K, u.UnitsError, "'fnu' must be convertible"),
        ([1, 2] * u.um, [1, 2], u.UnitsError, "'fnu' must be a quantity"),
        ([2, 1] * u.um, [1, 2] * u.uJy, ValueError, "'wave' must be positive and strictly"),
        ([1, 2] * u.um, [1, 2, 3] * u.uJy, ValueError, "'fnu' must be of the shape"),
        ([1, 2] * u.um, [1, np.nan] * u.uJy, ValueError, "'fnu' must be finite"),
    ],
)
def test_sed_refuses(wave, fnu, error, match):
    refuses(match, SED, wave, fnu, error=error)


def test_a_spectrum_of_a_model_has_its_parts_and_can_be_kept(tmp_path):
    sed = SEDModel.yang2021(libraries="bundled").evaluate(redshift=1.5, mass=5e10, frac_agn=0.3)
    names = ["stellar", "dust", "agn_disk", "agn_torus", "agn_polar"]
    total = sum(sed.components[name].fnu for name in names)
    assert_quantity_allclose(total, sed.flux, rtol=1e-9, atol=1e-20 * u.uJy)
    assert sed.parameters["mass"] == 5e10 * u.Msun
    assert_quantity_allclose(sed.flam * sed.wave, sed.fnu * sed.frequency, rtol=1e-12)
    for part in (2 * sed, sed * 2, sed / 0.5):
        assert_quantity_allclose(part.components["dust"].fnu, 2 * sed.components["dust"].fnu)
    assert_quantity_allclose((sed + sed).fnu, 2 * sed.fnu)
    far = sed.redshifted(2.0)
    total = sum(far.components[name].fnu for name in names)
    assert_quantity_allclose(total, far.fnu, rtol=1e-9, atol=1e-20 * u.uJy)
    for name in ("sed.ecsv", "sed.fits", "sed.vot"):
        sed.write(tmp_path / name)
        back = SED.read(tmp_path / name)
        assert back.redshift == 1.5
        assert_quantity_allclose(back.fnu, sed.fnu)
        assert set(back.components) == set(sed.components)
        assert_quantity_allclose(
            back.components["dust"].fnu, sed.components["dust"].fnu, rtol=1e-14
        )
        # readers take a second column in the unit of the flux for its uncertainty
        units = [column.unit for column in QTable.read(tmp_path / name).columns.values()]
        assert units.count(u.uJy) == 1
    assert sed.synthetic_flux("F770W") == Filter("F770W").synthetic_flux(sed)
    assert_quantity_allclose(sed.fluxes(["F770W"])[0].to(u.ABmag), sed.synthetic_magnitude("F770W"))
    assert "stellar_mass" in sed._repr_html_()


def test_spectra_at_other_wavelengths_are_not_added():
    one = SED([1, 2] * u.um, [1, 1] * u.uJy)
    match = "'other' must be an SED at the same redshift and wavele"
    refuses(match, operator.add, one, SED([1, 3] * u.um, [1, 1] * u.uJy))
    refuses(None, operator.mul, one, "two", error=TypeError)


def test_a_spectrum_goes_to_specutils():
    pytest.importorskip("specutils", reason="needs specutils: pip install miricigale[specutils]")
    sed = SED(WAVE, np.linspace(1, 9, WAVE.size) * u.uJy)
    other = sed.to_specutils()
    assert_quantity_allclose(other.flux, sed.fnu)
    got = Filter("F770W").synthetic_flux(other)
    assert_quantity_allclose(got, sed.synthetic_flux("F770W"), rtol=1e-12)


def test_a_spectrum_comes_from_specutils():
    """By frequency and F_lambda, with a redshift, and without a sample that is masked."""
    specutils = pytest.importorskip(
        "specutils", reason="needs specutils: pip install miricigale[specutils]"
    )
    fnu = np.linspace(1, 9, WAVE.size) * u.uJy
    flam = fnu.to(u.erg / u.s / u.cm**2 / u.AA, u.spectral_density(WAVE))
    axis = WAVE.to(u.THz, u.spectral())
    sed = SED.from_specutils(specutils.Spectrum(spectral_axis=axis, flux=flam, redshift=0.5))
    assert_quantity_allclose(sed.wave, WAVE, rtol=1e-12)
    assert_quantity_allclose(sed.fnu, fnu, rtol=1e-12)
    # specutils keeps it as a velocity
    assert_allclose(sed.redshift, 0.5, rtol=1e-12)
    masked = np.arange(WAVE.size) == 7
    spoiled = np.where(masked, 1e6, fnu.value) * u.uJy
    spectrum = specutils.Spectrum(spectral_axis=WAVE, flux=spoiled, mask=masked)
    with pytest.warns(ModelWarning, match="1 of 300 samples"):
        sed = SED.from_specutils(spectrum, redshift=1.0)
    assert_quantity_allclose(sed.fnu, fnu[~masked], rtol=1e-12)
    assert sed.redshift == 1.0
    several = specutils.Spectrum(spectral_axis=WAVE, flux=np.ones((2, WAVE.size)) * u.uJy)
    refuses("an array of 1 dimension", SED.from_specutils, several)


SAMPLED = np.array([1.0, 5.0, 9.0, 20.0])


@pytest.mark.parametrize(
    "columns",
    [
        {"wave": (SAMPLED, "um"), "error": (SAMPLED * 9, "uJy"), "flux": (SAMPLED, "uJy")},
        {"FLUX": (SAMPLED, "uJy"), "WAVELENGTH": (SAMPLED * 1e4, "ANGSTROMS"), "DQ": (SAMPLED * 0, None)},
        {"WAVELENGTH": (SAMPLED, "MICRONS"), "FLUX": (SAMPLED, "uJy"), "flux_err": (SAMPLED, "uJy")},
    ],
)  # fmt: skip
def test_columns_of_spectra_are_found_by_their_names(tmp_path, columns):
    """No error becomes the flux, or a part of it, whatever the order; units are those of STScI too."""
    table = [fits.Column(name, "D", unit=unit, array=a) for name, (a, unit) in columns.items()]
    fits.BinTableHDU.from_columns(table).writeto(tmp_path / "s.fits")
    sed = SED.read(tmp_path / "s.fits")
    assert_allclose(sed.wave.to_value(u.um), SAMPLED)
    assert_allclose(sed.fnu.to_value(u.uJy), SAMPLED)
    assert not sed.components


def test_fluxes_per_wavelength_of_stsci(tmp_path):
    """F_nu = F_lambda lambda^2 / c."""
    flam = [1e-15, 2e-15, 1e-15]
    columns = [
        fits.Column("WAVELENGTH", "D", unit="ANGSTROMS", array=[5e3, 1e4, 2e4]),
        fits.Column("FLUX", "D", unit="FLAM", array=flam),
    ]
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "star.fits")
    fnu = 2e-15 * 1e4**2 / 2.99792458e18 * u.erg / u.s / u.cm**2 / u.Hz
    assert_allclose(SED.read(tmp_path / "star.fits").fnu[1].to_value(u.uJy), fnu.to_value(u.uJy))


@pytest.mark.parametrize(
    ("name", "flags"), [("DQ", [0, 0, 5, 0]), ("mask", [False, True, False, False])]
)
def test_samples_that_a_file_flags_are_in_no_spectrum(tmp_path, name, flags):
    table = QTable({"wave": SAMPLED * u.um, "flux": SAMPLED * u.uJy, name: flags})
    table.write(tmp_path / "s.ecsv")
    with pytest.raises(ValueError, match="'fnu' must be finite values, got 1"):
        SED.read(tmp_path / "s.ecsv")


def test_luminosities_are_those_of_the_closed_form(flat):
    # nu L_nu of a flat spectrum of 3 uJy at redshift 1, and what a model says of its own dust
    far = COSMOLOGY.luminosity_distance(1.0)
    sed = flat.replace(redshift=1.0)
    expected = 4 * np.pi * far**2 * sed.fnu * sed.frequency
    assert_quantity_allclose(sed.luminosity(), expected.to(u.Lsun), rtol=1e-9)
    # whatever the redshift at which it is seen
    for redshift in (0.0, 3.0):
        assert_quantity_allclose(sed.redshifted(redshift).luminosity(), sed.luminosity(), rtol=1e-9)
    # between two wavelengths of the source, of a flat spectrum in closed form
    low = sed.rest_wavelength[0] * 1.5
    high = sed.rest_wavelength[-1] / 1.5
    span = c / low - c / high
    closed = 4 * np.pi * far**2 * sed.fnu[0] * span / (1 + sed.redshift)
    assert_quantity_allclose(sed.luminosity(low, high), closed.to(u.Lsun), rtol=1e-9)
    assert_quantity_allclose(sed(2 * u.um), sed.fnu_at(2 * u.um))
    refuses("'low, high' must be in order, and within", sed.luminosity, high, low)
    model = SEDModel.yang2021(libraries="bundled", agn=False)(redshift=2.0, mass=1e10, ebv=0.3)
    dust = model.components["dust"]
    # integral of nu L_nu over ln nu, the same for source and observer
    total = -np.trapezoid(dust.luminosity(), np.log(dust.frequency.value))
    assert_quantity_allclose(total, model.derived["dust_luminosity"].to(u.Lsun), rtol=0.01)
    ends = dust.rest_wavelength[[0, -1]] * [1 + 1e-9, 1 - 1e-9]
    assert_quantity_allclose(dust.luminosity(*ends), total, rtol=0.01)


def test_magnitudes_of_several_bands_are_those_of_each(flat):
    bands = ["F770W", "F1000W"]
    for magnitude, band in zip(flat.magnitudes(bands), bands, strict=True):
        assert_allclose(magnitude.value, flat.synthetic_magnitude(band).value)
    assert flat.magnitudes(bands).unit == u.ABmag
    dark = flat * 0
    assert np.isnan(dark.magnitudes(bands).value).all()


def test_the_flux_is_an_array_and_that_of_a_band(flat):
    assert_quantity_allclose(flat.flux, flat.fnu)
    assert flat.flux("F770W") == flat.synthetic_flux("F770W")


@pytest.mark.parametrize("flux", [10 * u.uJy, 1e-2 * u.mJy, (23.9 - 2.5) * u.ABmag])
def test_spectra_are_scaled_to_a_flux_in_a_band(flat, flux):
    scaled = flat.normalize(flux, "F770W")
    assert_quantity_allclose(scaled.fnu, np.full(WAVE.size, 10.0) * u.uJy, rtol=1e-3)
    assert_quantity_allclose(scaled.synthetic_flux("F770W"), u.Quantity(flux.to(u.uJy)))
    refuses("'band' must be one in which", (0 * flat).normalize, flux, "F770W")


def test_parts_of_a_spectrum_are_cut_and_subtracted(flat):
    part = flat[5 * u.um : 1e5 * u.AA]
    inside = np.abs(WAVE.value - 7.5) <= 2.5
    assert_quantity_allclose(part.wave, WAVE[inside])
    assert_quantity_allclose(flat[inside].fnu, part.fnu)
    assert flat[5 * u.um :].wave[-1] == flat.wave[-1]
    assert_allclose((3 * flat - flat).fnu.value, 6.0)
    assert_allclose(sum([flat, flat, -flat]).fnu.value, 3.0)
    refuses(
        "no component .all., for the spectrum has no parts", flat.__getitem__, "all", error=KeyError
    )
    assert flat[3] == flat.fnu[3]
    refuses("without unit|no unit|bare number", flat.__getitem__, slice(5, 9), error=u.UnitsError)


def test_agn_and_galaxy_are_sums_of_parts_and_make_up_the_whole():
    sed = SEDModel.yang2021(libraries="bundled")(redshift=1.0, mass=1e10, frac_agn=0.4)
    parts = pickle.loads(pickle.dumps(sed)).components
    whole = parts["agn"] + parts["galaxy"]
    assert_allclose(whole.fnu.value, sed.fnu.value, rtol=1e-9)
    agn = sum(parts[f"agn_{name}"].fnu for name in ("disk", "torus", "polar"))
    assert_quantity_allclose(parts["agn"].fnu, agn)
    assert "agn" not in list(parts)
    refuses("no component 'star'; known: agn", parts.__getitem__, "star", error=KeyError)
    # a galaxy without an AGN has none
    alone = SEDModel.yang2021(libraries="bundled", agn=False)(redshift=1.0, mass=1e10)
    refuses("no component 'agn'", alone.components.__getitem__, "agn", error=KeyError)


def test_tables_and_axes_of_a_spectrum(flat):
    moved = flat.redshifted(1.0)
    back = SED.from_table(moved.to_table())
    assert_quantity_allclose(back.fnu, moved.fnu)
    assert back.redshift == 1.0
    frame = moved.to_pandas()
    assert list(frame.columns) == ["wave", "fnu"]
    ax = moved.plot(rest_frame=True)
    assert_allclose(ax.lines[-1].get_xdata(), moved.rest_wavelength.value)
    assert ax.get_xlabel().startswith("rest wavelength")
    assert moved.rest_frame().redshift == 0
    assert_quantity_allclose(moved.rest_frame().wave, moved.rest_wavelength)
    assert_quantity_allclose(moved.rest_frame().luminosity(), moved.luminosity())


@pytest.mark.parametrize(
    ("unit", "symbol", "power"),
    [("mJy", "F_\\nu", 0), ("erg / (s cm2)", "\\nu F", -1), ("erg / (s cm2 AA)", "\\lambda", -2)],
)
def test_spectra_are_drawn_in_units_of_flux_densities(flat, unit, symbol, power):
    ax = plt.figure().add_subplot()
    flat.plot(ax, unit=unit)
    y = ax.lines[0].get_ydata()
    # of constant F_nu
    assert_allclose(y / y[0], (WAVE / WAVE[0]) ** power, rtol=1e-9)
    assert symbol in ax.get_ylabel()
    plt.close("all")
    values = flat.to(unit)
    assert values.unit == u.Unit(unit)
    assert_allclose(values.value, y)
    assert_quantity_allclose(flat.nu_fnu, flat.wave * flat.flam, rtol=1e-9)
    refuses("'unit' must be one of F_nu", flat.plot, unit="K", error=u.UnitsError)


def test_colors_and_absolute_magnitudes_are_those_of_the_closed_form():
    rising = SED(WAVE, WAVE.value * u.uJy, redshift=0.5)
    f770w = Filter("F770W")
    ratio = rising.synthetic_flux("F1500W") / rising.synthetic_flux("F770W")
    assert rising.color("F770W", "F1500W").value == pytest.approx(2.5 * np.log10(ratio.value))
    # F_nu as the wavelength: light moved to wavelengths (1 + z) shorter has the fluxes of before, but for distance
    far = COSMOLOGY.luminosity_distance(0.5).to_value(u.pc)
    expected = -2.5 * np.log10(
        ((far / 10) ** 2 * rising.synthetic_flux(f770w)).to_value(u.Jy) / 3630.780548
    )
    assert rising.absolute_magnitude(f770w).value == pytest.approx(expected, abs=1e-3)


def test_luminosities_at_wavelengths_are_between_those_of_the_points(flat):
    source = flat.redshifted(1.0)
    places = source.rest_wavelength[[3, 90]]
    assert_quantity_allclose(source.luminosity(places), source.luminosity()[[3, 90]], rtol=1e-9)
    assert source.luminosity(6 * u.um).shape == ()
    refuses("'low' must be given with 'high'", source.luminosity, None, 9 * u.um)
