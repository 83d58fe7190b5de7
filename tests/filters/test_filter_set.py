"""Sets of filters."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose
from synphot import Box1D, SpectralElement

from helpers.errors import refuses
from miricigale.filters import Filter, FilterSet
from miricigale.sed import SED

NAMES = ["megacam.u", "wfc3.f160w", "irac.ch4", "miri.f770w", "miri.f2100w"]


@pytest.fixture(scope="module")
def filters():
    return FilterSet.from_names(NAMES)


def test_is_an_ordered_collection(filters):
    assert filters.names == tuple(NAMES)
    assert len(filters) == 5
    assert [f.name for f in filters] == NAMES
    assert filters["irac.ch4"].name == filters[2].name == "irac.ch4"
    assert filters[["miri.f770w", "megacam.u"]].names == ("miri.f770w", "megacam.u")
    assert filters[3:].names == tuple(NAMES[3:])
    assert "irac.ch4" in filters
    assert "irac.ch1" not in filters


def test_weights_are_those_of_the_single_filters(filters):
    wave = np.geomspace(0.1, 100, 700)
    weights = filters.weights(wave)
    assert weights.shape == (5, 700)
    assert_allclose(weights.sum(axis=1), 1, rtol=1e-12)
    for row, band in zip(weights, filters, strict=True):
        assert_allclose(row, band.weights(wave * u.um), rtol=1e-12)


def test_finer_sampling_of_the_same_line_changes_nothing(filters):
    # exact for piecewise-linear F_nu: nodes added on a straight piece carry no news
    coarse = np.geomspace(0.1, 100, 60)
    values = np.random.default_rng(2).uniform(1, 2, 60)
    fine = np.unique(np.concatenate([coarse, np.linspace(0.1, 100, 9000)]))
    got = filters.weights(fine) @ np.interp(fine, coarse, values)
    assert_allclose(got, filters.weights(coarse) @ values, rtol=1e-10)


def test_redshift_of_a_power_law(filters):
    # F_nu in proportion to lam^2: the mean is the square of the pivot wavelength
    # (int T lam dlam / int T dlam / lam), in whatever place the nodes stand
    for shift in (1.0, 1.037, 3.3):
        wave = np.geomspace(0.05, 60, 20_000) * shift
        means = filters.weights(wave) @ wave**2
        assert_allclose(means, filters.pivots.value**2, rtol=1e-6)


def test_synthetic_fluxes(filters):
    sed = SimpleNamespace(wave=np.array([1e3, 1e7]) * u.AA, fnu=np.full(2, 2.0) * u.mJy)
    assert_quantity_allclose(filters.synthetic_fluxes(sed), np.full(5, 2000.0) * u.uJy)


def test_uncovered_band_is_an_error_or_zero_on_request(filters):
    wave = np.geomspace(1, 100, 100)
    refuses(r"leaves 100.00% of filter 'megacam.u'", filters.weights, wave)
    weights = filters.weights(wave, tolerance=1)
    assert np.all(weights[0] == 0)
    assert_allclose(weights[1:].sum(axis=1), 1)


def test_rejects_bad_sets(filters):
    refuses("different names", FilterSet.from_names, ["miri.f770w", "miri.f770w"])
    refuses("one or more", FilterSet, [])
    match = r"no filter in this set 'nope'; known: irac.ch4"
    refuses(match, filters.__getitem__, "nope", error=KeyError)
    refuses("strictly ascending", filters.weights, [3.0, 2.0])


def test_sets_are_made_of_anything_and_joined():
    box = SpectralElement(Box1D, amplitude=1, x_0=50000, width=1000)
    filters = FilterSet(["F770W"]) + FilterSet([box]) + "F1000W"
    assert filters[[0, 2]] == FilterSet.from_names("F770W", "F1000W")
    assert_quantity_allclose(filters.pivot[1], 5 * u.um, rtol=1e-4)
    miri = FilterSet("miri.*")
    assert set(miri.names) == {name for name in Filter.names() if name.startswith("miri.")}
    # by wavelength: f560w comes before f1000w
    assert np.all(np.diff(miri.pivots.value) > 0)
    assert filters.to_table()["name"][0] == "miri.f770w"
    refuses(r"no filters like 'mire\.\*'", FilterSet, "mire.*", error=KeyError)


def test_names_are_forgiving():
    want = Filter.from_name("miri.f770w")
    for name in ("F770W", "f770w", "MIRI.F770W", "Miri.f770W"):
        assert Filter.from_name(name) is want
    filters = FilterSet(["F770W", "IRAC.CH1", "WFC3.F160W"])
    assert filters.names == ("miri.f770w", "irac.ch1", "wfc3.f160w")
    assert filters["F770W"] is want
    assert "CH1" in filters
    assert "F1000W" not in filters
    # a filter of one's own keeps its name
    own = Filter([1, 2] * u.um, [1, 1], name="F770W")
    assert FilterSet([own, "miri.f770w"])["F770W"] is own
    for name, match in (
        ("miri.f707w", r"no filter 'miri.f707w'; the nearest of 73 are miri.f770w, "),
        ("sedpy.jwst_f707w", r"no curve .* 'jwst_f707w'; the nearest .* jwst_f770w"),
        ("something else", r"^((?!did you mean).)*$"),
    ):
        refuses(match, Filter.from_name, name, error=KeyError)


def test_the_equivalent_width_is_that_of_synphot(filters):
    band = filters["miri.f770w"]
    assert_quantity_allclose(band.integrate(), band.to_synphot().equivwidth().to(u.um), rtol=1e-3)
    assert band.equivwidth() == band.equivalent_width


def test_filters_of_any_form_are_added(filters):
    for other in ("F1000W", ["F1000W"], Filter("F1000W"), FilterSet(["F1000W"])):
        assert (filters + other).names == (*NAMES, "miri.f1000w")


def test_masks_and_arrays_choose_filters(filters):
    assert filters[filters.pivots > 5 * u.um].names == tuple(NAMES[2:])
    assert filters[np.array([3, 0])].names == ("miri.f770w", "megacam.u")
    assert [filters.index(name) for name in ("F770W", "megacam.u")] == [3, 0]
    assert_quantity_allclose(filters.widths, [f.width for f in filters])
    refuses("'key' must be of one value for each of 5 filters", filters.__getitem__, [True, False])


def test_several_spectra_have_a_row_each(filters):
    wave = np.geomspace(0.1, 100, 700) * u.um
    flat = SED(wave, np.full(700, 3.0) * u.uJy)
    fluxes = filters.synthetic_fluxes([flat, 2 * flat, flat.to_specutils()])
    assert_quantity_allclose(fluxes, np.outer([3, 6, 3], np.ones(5)) * u.uJy, rtol=1e-6)
    one_band = filters["miri.f770w"].synthetic_flux((flat, 2 * flat))
    assert_quantity_allclose(one_band, [3, 6] * u.uJy, rtol=1e-6)
    assert_quantity_allclose(filters.synthetic_fluxes(wave, flat.fnu), 3 * u.uJy, rtol=1e-6)
    table = QTable({"lambda": wave[::-1].to(u.AA), "f_nu": np.full(700, 3e-3) * u.mJy})
    assert_quantity_allclose(filters.synthetic_fluxes(table), 3 * u.uJy, rtol=1e-6)
    # AB magnitude of 3 uJy
    expected = 23.9 - 2.5 * np.log10(3)
    magnitudes = filters.synthetic_magnitudes(flat)
    assert magnitudes.unit == u.ABmag
    assert_allclose(magnitudes.value, expected, atol=2e-4)
