"""Passbands against closed forms, published pivots and synphot."""

import pickle
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.physical_models import BlackBody
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.filters import Filter, FilterSet, filter_table, find_filter
from miricigale.utils.exceptions import DataError

PIVOTS = cases_of(__file__, "pivots")


def box(low=8.0, high=12.0, name="box"):
    return Filter([low, high] * u.um, [1, 1], name=name)


def spectrum(wave, fnu):
    return SimpleNamespace(wave=wave * u.um, fnu=fnu * u.uJy)


@pytest.mark.parametrize("name", PIVOTS)
def test_pivots_are_the_published_ones(name):
    assert_quantity_allclose(Filter.from_name(name).pivot, PIVOTS[name] * u.um, rtol=6e-4)
    if name.startswith("miri"):
        assert abs(Filter.from_name(name).pivot.value - PIVOTS[name]) < 0.005


def test_box_has_the_closed_form_wavelengths():
    band = box()
    # int lam dlam / int dlam / lam, and int dlam / int dlam / lam
    assert_quantity_allclose(band.pivot, np.sqrt(40 / np.log(1.5)) * u.um, rtol=1e-6)
    assert_quantity_allclose(band.effective_wavelength, 4 / np.log(1.5) * u.um, rtol=1e-6)
    assert_quantity_allclose(band.width, 4 * u.um, rtol=1e-5)


def test_flat_spectrum_has_its_flux_in_every_band():
    sed = spectrum(np.geomspace(0.05, 400, 37), np.full(37, 3.0))
    for name in Filter.names():
        assert_quantity_allclose(Filter.from_name(name).synthetic_flux(sed), 3 * u.uJy, rtol=1e-12)


def test_weights_equal_dense_integration():
    rng = np.random.default_rng(1)
    wave = np.sort(rng.uniform(6, 24, 60))
    fnu = rng.uniform(0, 10, 60)
    band = Filter(np.sort(rng.uniform(8, 20, 25)) * u.um, rng.uniform(0, 1, 25), name="random")
    edges = band.wave.value
    lam = np.linspace(edges[0], edges[-1], 2_000_001)
    photons = np.interp(lam, edges, band.throughput) / lam
    dense = np.trapezoid(photons * np.interp(lam, wave, fnu), lam) / np.trapezoid(photons, lam)
    assert_allclose(band.weights(wave) @ fnu, dense, rtol=1e-7)


def test_there_and_back_through_synphot():
    band = Filter.from_name("miri.f1000w")
    back = Filter.from_synphot(band.to_synphot(), name="miri.f1000w")
    assert_quantity_allclose(back.pivot, band.pivot, rtol=1e-9)
    assert_allclose(back.throughput, band.throughput, atol=1e-12)


def test_products_of_filters():
    band = Filter.from_name("miri.f1000w")
    half = 0.5 * band
    assert_allclose(half.throughput, band.throughput / 2)
    assert_quantity_allclose(half.pivot, band.pivot)
    # a box of 8 to 12 um times one of 10 to 14 um is one of 10 to 12 um
    both = box() * box(10.0, 14.0)
    assert_quantity_allclose(both.pivot, box(10.0, 12.0).pivot, rtol=1e-5)
    assert_quantity_allclose(both.width, 2 * u.um, rtol=1e-5)
    # a ramp from 0 to 1 squared: the integral over 2 um is 2/3 um
    ramp = Filter(np.linspace(8, 10, 41) * u.um, np.linspace(0, 1, 41), "ramp")
    assert_quantity_allclose((ramp * ramp).width, 2 / 3 * u.um, rtol=1e-3)
    with pytest.raises(TypeError, match="unsupported operand"):
        band * None


def test_filters_of_sedpy():
    from sedpy.observate import Filter as Curve

    theirs = Curve("jwst_f1000w")
    band = Filter.from_sedpy(theirs)
    assert band.name == "miri.f1000w"
    assert_quantity_allclose(band.pivot, theirs.wave_pivot * u.AA, rtol=1e-3)


def test_curves_end_in_zero_and_carry_no_more_zeros():
    for name in Filter.names():
        throughput = Filter.from_name(name).throughput
        assert throughput[0] == 0 == throughput[-1]
        assert throughput[1] > 0
        assert throughput[-2] > 0


def test_edge_of_a_cut_curve_is_a_step():
    # F2550W stops at 3 % of its peak at 29.99 um: padding must not add light beyond
    band = Filter.from_name("miri.f2550w")
    assert_allclose(band.throughput[-2] / band.throughput.max(), 0.03, atol=0.005)
    assert band.wave.value[-1] < 29.9941


def test_a_filter_cites_its_source():
    meta = Filter.from_name("miri.f770w").meta
    assert "astro-sedpy" in meta["source"]
    assert any("sedpy" in text for text in meta["citations"])


def test_catalog_convention_gives_the_true_flux_of_its_reference_spectrum():
    def blackbody(lam):
        return BlackBody(1e4 * u.K)(lam * u.um).value * 1e6

    def proportional(lam):
        return 1.0 * lam

    # nu F_nu constant for IRAC
    references = {"irac.ch1": proportional, "irac.ch4": proportional, "mips.24": blackbody}
    for name, reference in references.items():
        band = Filter.from_name(name)
        nominal = band.reference_wavelength.value
        wave = np.geomspace(band.wave.value[0] / 1.01, band.wave.value[-1] * 1.01, 5000)
        flux = band.synthetic_flux(spectrum(wave, reference(wave))) * band.catalog_factor
        assert_quantity_allclose(flux, reference(nominal) * u.uJy, rtol=5e-5)
    assert Filter.from_name("miri.f770w").catalog_factor == 1


@pytest.mark.parametrize(
    ("wave", "throughput", "message"),
    [
        ([2, 1] * u.um, [1, 1], "'wave' must be positive and strictly ascending"),
        ([1, 2] * u.um, [1, -1], "'throughput' must be not negative"),
        ([1, 2] * u.um, [0, 0], "'throughput' must be not negative, and somewhere positive"),
        ([1, 2, 3] * u.um, [1, 1], "'throughput' must be as many values as 'wave'"),
        ([1, 2] * u.um, [1, np.nan], "'throughput' must be finite"),
    ],
)
def test_rejects_what_is_no_curve(wave, throughput, message):
    refuses(message, Filter, wave, throughput, name="bad")


def test_any_curve_of_sedpy_by_its_name():
    assert_quantity_allclose(Filter.from_name("sedpy.sdss_r0").pivot, 0.6176 * u.um, rtol=2e-3)


def test_reads_the_files_of_cigale(tmp_path):
    path = tmp_path / "some.dat"
    path.write_text("# my.band\n# energy\n# a box that counts energy\n80000 8\n120000 12\n")
    band = Filter.read(path)
    assert band.name == "my.band"
    # an energy response in proportion to lam is a flat photon response
    assert_quantity_allclose(band.pivot, box().pivot, rtol=1e-9)
    path.write_text("# wavelength (micron), photons\n8 1\n12 1\n")
    assert Filter.read(path).name == "some"
    assert_quantity_allclose(Filter.read(path).pivot, box().pivot, rtol=1e-9)
    # micrometers would be taken for Angstrom
    path.write_text("8 1\n12 1\n")
    refuses("does not state the unit of its wavelengths", Filter.read, path, error=DataError)
    refuses("none.dat cannot be read", Filter.read, tmp_path / "none.dat", error=DataError)
    (tmp_path / "text.dat").write_text("one two\n")
    refuses("has not two columns of num", Filter.read, tmp_path / "text.dat", error=DataError)
    band = Filter.read(path, name="a", unit=u.um)
    assert_quantity_allclose(band.pivot, box().pivot, rtol=1e-9)
    for name in ("a.ecsv", "a.fits", "a.xml"):
        band.write(tmp_path / name)
        assert Filter.read(tmp_path / name, name="a") == band


def test_spectra_of_other_packages():
    """A spectrum of constant F_nu has this flux in any band, whatever it comes as."""
    from astropy.modeling.models import Const1D
    from synphot import ConstFlux1D, SourceSpectrum

    band, wave = box(), np.linspace(5, 15, 300) * u.um
    flam = (3 * u.uJy).to(u.erg / u.s / u.cm**2 / u.AA, u.spectral_density(wave))
    model = SourceSpectrum(ConstFlux1D, amplitude=3 * u.uJy)
    one_d = SimpleNamespace(spectral_axis=wave[::-1], flux=np.full(300, 3e-6) * u.Jy)
    pairs = [(wave, np.full(300, 3.0) * u.uJy), (wave[::-1], flam[::-1])]
    for sed in (*pairs, one_d, model, Const1D(amplitude=3 * u.uJy)):
        rtol = 1e-9 if sed is model else 1e-12
        assert_quantity_allclose(band.synthetic_flux(sed), 3 * u.uJy, rtol=rtol)
        assert_quantity_allclose(FilterSet([band]).synthetic_fluxes(sed), [3] * u.uJy, rtol=rtol)
    assert_quantity_allclose(band.synthetic_flux(wave, flam), 3 * u.uJy)
    assert_quantity_allclose(band.synthetic_magnitude(model).value, 23.9 - 2.5 * np.log10(3))
    refuses("wavelengths with a unit", band.synthetic_flux, (wave.value, flam), error=u.UnitsError)


def test_points_of_synphot_are_joined_in_their_flux_density():
    """A flat source in two points is flat; synphot joins points in photons, and has 0.3 mag more."""
    from synphot import Empirical1D, SourceSpectrum

    ends = SourceSpectrum(Empirical1D, points=[4, 12] * u.um, lookup_table=[3, 3] * u.uJy)
    assert_quantity_allclose(Filter("miri.f770w").synthetic_flux(ends), 3 * u.uJy, rtol=1e-12)


def test_a_filter_says_what_it_has():
    band = Filter("F770W")
    assert band == Filter.from_name("miri.f770w") == pickle.loads(pickle.dumps(band))
    assert hash(band) == hash(Filter("f770w"))
    assert band.wavelength is band.wave
    assert band.transmission is band.throughput
    # half power points of the JWST documentation: 6.581 and 8.687 um
    assert_quantity_allclose(band.fwhm, 2.106 * u.um, atol=0.05 * u.um)
    assert band(100 * u.um) == 0
    assert_quantity_allclose(band(band.wave), band.throughput)
    assert "pivot" in band._repr_html_()
    assert (band.min_wavelength, band.max_wavelength) == tuple(band.bounds)
    with pytest.raises(
        AttributeError, match="no attribute 'min_wave'; did you mean 'min_wavelength'"
    ):
        band.min_wave  # noqa: B018
    assert Filter([1, 2] * u.um, [1, 1], "own") == Filter("own", [1, 2] * u.um, [1, 1])
    for wave in ([1, 2], [1, 2] * u.K):
        refuses("'wave' must be", Filter, wave, [1, 1], error=u.UnitsError, name="own")


#: Names in other packages and papers, of filters here; None is one of many, or no filter.
OTHERS = cases_of(__file__, "names") | {None: ["f_F160W", "r", "Ks"]}


@pytest.mark.parametrize("name", OTHERS)
def test_names_of_others(name):
    assert {find_filter(text) for text in OTHERS[name]} == {name}


def test_what_is_no_spectrum_is_named():
    for sed, match in (
        (None, r"'sed' must be a spectrum: .*, got NoneType"),
        (spectrum([7, 9, 13], [1, 1]), r"'sed\.fnu' must be as many values as sed\.wave, got 2"),
        (spectrum(np.array([5.0, 11.0]), np.ones(2)), r"leaves .*% of filter 'box'"),
        (spectrum(np.array([50.0, 110.0]), np.ones(2)), r"leaves 100.00% of filter 'box'"),
    ):
        refuses(match, box().synthetic_flux, sed)
    # less than 1e-4 of the weight is missing
    sed = spectrum(np.array([8.0001, 20.0]), np.full(2, 7.0))
    assert_quantity_allclose(box().synthetic_flux(sed), 7 * u.uJy)


def test_bundled_curves_are_where_they_are_published():
    # CFHT, MegaPrime's filters of 2015: center and width of the glass in um
    for band, center, width in (("g", 0.475, 0.154), ("r", 0.640, 0.148), ("i", 0.776, 0.155)):
        curve = Filter.from_name(f"megacam2015.{band}")
        inside = curve.wave.value[curve.throughput > 0.5 * curve.throughput.max()]
        assert_allclose(inside[[0, -1]], [center - width / 2, center + width / 2], atol=0.004)
    # Hewett et al. 2006, MNRAS 367, 454, table 1: effective wavelengths, with atmosphere and detector
    published = {"z": 0.8817, "y": 1.0305, "j": 1.2483, "h": 1.6313, "k": 2.2010}
    for band, wave in published.items():
        assert_allclose(Filter.from_name(f"wfcam.{band}").pivot.value, wave, rtol=6e-3)


def test_filters_are_searched_by_wavelength_and_name():
    names = Filter.search("1.6 um")
    assert "wfc3.f160w" in names
    for name in names:
        band = Filter(name)
        assert band(1.6 * u.um) >= 0.5 * band.throughput.max()
    pivots = [abs(Filter(name).pivot.to_value(u.um) - 1.6) for name in names]
    assert pivots == sorted(pivots)
    assert Filter.search(16000 * u.AA) == Filter.search("16000 A") == names
    assert filter_table("1.6 um")["name"].tolist() == list(names)
    assert Filter.search("f770w") == ("miri.f770w",)
    assert Filter.search("nothing") == ()
    with pytest.raises(u.UnitsError, match="'text' must be convertible to um"):
        Filter.search("3 s")


def test_a_file_of_the_svo_is_a_filter(tmp_path):
    band = Filter("F770W")
    band.to_table().write(tmp_path / "a.vot", format="votable")
    assert Filter.from_svo(tmp_path / "a.vot", name="mine").pivot.to_value(u.um) == pytest.approx(
        band.pivot.value
    )
    # its ASCII tables do not say that wavelengths are in Angstrom
    rows = np.c_[band.wave.to_value(u.AA), band.throughput]
    np.savetxt(tmp_path / "JWST_MIRI.F770W.dat", rows)
    of_text = Filter.from_svo(tmp_path / "JWST_MIRI.F770W.dat")
    assert of_text.pivot.to_value(u.um) == pytest.approx(band.pivot.value)
    with pytest.raises(DataError, match=r"is no file; nothing is downloaded"):
        Filter.from_svo("JWST/MIRI.F770W")
