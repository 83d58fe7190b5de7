import dataclasses

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import ImagePSF

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.filters import Filter
from miricigale.psf import (
    _core,
    encircled_energy,
    fwhm,
    gaussian_psf,
    hst_psf,
    make_psf,
    miri_psf,
    psf_table,
    radius_of_encircled_energy,
)
from miricigale.psf.telescope import Telescope, band_quantiles

# jwst-docs, MIRI Point Spread Functions, table 1 (commissioning, PID 1028)
BANDS = [f"miri.f{number}w" for number in (560, 770, 1000, 1130, 1280, 1500, 1800, 2100, 2550)]
WIDTHS = 0.207, 0.269, 0.328, 0.375, 0.420, 0.488, 0.591, 0.674, 0.803
IN_FLIGHT = dict(zip(BANDS, WIDTHS, strict=True))

# stpsf 2.2.0: MIRI().psf_grid(num_psfs=1, oversample=4, fov_pixels=91, nlambda=9) with no
# wavefront error (pupilopd=None, no instrument error) and no pupil shift
STPSF_RADII = [0.2, 0.3, 0.5, 1.0, 1.5, 2.5] * u.arcsec
STPSF = cases_of(__file__, "stpsf")


@pytest.mark.parametrize("name", IN_FLIGHT)
def test_width_agrees_with_the_telescope_in_flight(name):
    psf = miri_psf(name, fov=9 * u.arcsec)
    width = fwhm(psf, method="gaussian").to_value(u.arcsec)
    assert width == pytest.approx(IN_FLIGHT[name], rel=0.04)
    assert fwhm(psf).to_value(u.arcsec) == pytest.approx(IN_FLIGHT[name], rel=0.07)


@pytest.mark.parametrize("name", STPSF)
def test_agrees_with_stpsf(name):
    width, energies = STPSF[name]
    psf = miri_psf(name, wavefront_error=0 * u.nm, calibration="stpsf", fov=9 * u.arcsec)
    assert fwhm(psf).to_value(u.arcsec) == pytest.approx(width, rel=0.01)
    assert_allclose(encircled_energy(psf, STPSF_RADII), energies, atol=0.017)


def test_model_is_a_photutils_psf_of_unit_flux_per_pixel():
    psf = miri_psf("miri.f770w")
    assert isinstance(psf, ImagePSF)
    n = psf.data.shape[0]
    assert psf.data.shape == (n, n)
    assert n % 2 == 1
    assert np.unravel_index(psf.data.argmax(), psf.data.shape) == (n // 2, n // 2)
    # evaluated at the pixels of a detector, at any sub-pixel position: the enclosed light
    y, x = np.mgrid[:201, :201]
    for position in ((100.0, 100.0), (100.37, 99.81)):
        image = psf.evaluate(x, y, 1.0, *position)
        assert image.sum() == pytest.approx(psf.enclosed, abs=1e-3)


def test_meta_says_what_the_psf_is():
    psf = miri_psf("miri.f1000w", fov=8 * u.arcsec, includes=("ipc", "pixel"), seed=4)
    meta = psf.meta
    assert psf.filter == "miri.f1000w"
    assert psf.includes == ("pixel", "ipc")
    assert psf.frame == "detector"
    assert psf.pixel_scale.value == pytest.approx((0.110498 * 0.111336) ** 0.5)
    assert (psf.oversampling[0], meta["seed"], meta["wavefront_error"]) == (4, 4, 75.0)
    assert any("Perrin" in text for text in meta["citations"])


def test_effects_are_applied_once_and_only_if_asked():
    kind = {"fov": 4 * u.arcsec}
    bare = fwhm(miri_psf("miri.f770w", includes=(), **kind))
    pixel = fwhm(miri_psf("miri.f770w", includes=("pixel",), **kind))
    both = fwhm(miri_psf("miri.f770w", includes=("pixel", "ipc"), **kind))
    assert bare < pixel < both
    a = miri_psf("miri.f770w", includes=("ipc", "pixel", "cruciform", "jitter"), **kind)
    assert_array_equal(a.data, miri_psf("miri.f770w", **kind).data)


def test_seed_makes_the_telescope_and_cached_data_cannot_be_spoiled():
    kind = {"fov": 5 * u.arcsec}
    one, two = (miri_psf("miri.f560w", seed=s, **kind).data for s in (1, 2))
    before = one.copy()
    one[:] = 0
    # what is kept, and the same image made again: another request for as many cells
    for size in (5.0, 5.0 + 1e-9):
        again = miri_psf("miri.f560w", seed=1, fov=size * u.arcsec)
        assert_array_equal(again.data, before)
    assert np.abs(before - two).max() > 1e-3 * before.max()


def test_result_does_not_depend_on_the_sampling():
    radii = [0.3, 0.6, 1.0, 2.0] * u.arcsec
    kind = {"fov": 5 * u.arcsec}
    psfs = [miri_psf("miri.f770w", **kind, oversampling=n) for n in (4, 3)]
    reference, other = (encircled_energy(psf, radii) for psf in psfs)
    assert_allclose(other, reference, atol=1e-3)
    # nor on the numbers of cells of the pupil and of wavelengths
    telescope = Telescope("miri.f770w", 4.8, 75.0, 1)
    images = [
        dataclasses.replace(telescope, **change).image(0.0277, 181)
        for change in ({}, {"n_pupil": 512}, {"n_wavelengths": 15})
    ]
    radii = np.array([11.0, 22.0, 36.0, 72.0])
    reference, *others = (_core.radial_sums(image, 90.0, 90.0, radii) for image in images)
    for other in others:
        assert_allclose(other, reference, atol=1e-3)


def test_field_of_view_only_cuts():
    small, large = (miri_psf("miri.f1000w", fov=w * u.arcsec) for w in (6, 10))
    n, m = small.data.shape[0] // 2, large.data.shape[0] // 2
    inner = large.data[m - n : m + n + 1, m - n : m + n + 1]
    # but for light that the cruciform scatters from outside
    assert_allclose(small.data, inner, atol=1e-5 * inner.max())
    assert small.enclosed < large.enclosed < 1


def test_encircled_energy_rises_to_the_enclosed_light():
    psf = miri_psf("miri.f2100w")
    energy = encircled_energy(psf, np.linspace(0, 10.4, 60) * u.arcsec)
    assert energy[0] == 0
    assert np.all(np.diff(energy) > 0)
    assert 0.95 < energy[-1] < psf.enclosed < 1
    r80 = radius_of_encircled_energy(psf, 0.8)
    assert encircled_energy(psf, r80) == pytest.approx(0.8, abs=1e-4)


def test_table_of_all_filters():
    radii = [1, 2.5] * u.arcsec
    table = psf_table([miri_psf(name, fov=9 * u.arcsec) for name in IN_FLIGHT], radii=radii)
    assert np.all(np.diff(table["fwhm"]) > 0)
    assert table["r80"].unit == u.arcsec
    assert np.all(table["eef_2.5"] > table["eef_1"])
    assert_allclose(table["fwhm_flight"].value, list(IN_FLIGHT.values()))
    assert_allclose((table["fwhm_gaussian"] / table["fwhm_flight"]).value, 1, atol=0.04)
    assert set(table["frame"]) == {"detector"}
    assert np.all(np.isnan(table["angle"]))
    assert set(table["includes"]) == {"jitter cruciform pixel ipc"}
    assert all(table[name].info.description for name in table.colnames if name != "filter")


def test_table_of_a_mosaic_and_of_a_grid_that_holds_little():
    kind = {"fov": 0.45 * u.arcsec}
    table = psf_table([hst_psf(angle=20 * u.deg), hst_psf(**kind)], radii=[0.2] * u.arcsec)
    assert table["angle"].value.tolist() == [0, 0]
    assert np.isfinite(table["r80"].value).tolist() == [True, False]
    assert np.all(np.isnan(table["fwhm_flight"]))


def test_band_quantiles_have_the_mean_wavelength_of_the_photons():
    band = Filter.from_name("miri.f1500w")
    wave, rate = band.wave.value, band.throughput / band.wave.value
    mean = np.trapezoid(rate * wave, wave) / np.trapezoid(rate, wave)
    quantiles = band_quantiles("miri.f1500w", 51)
    assert np.all(np.diff(quantiles) > 0)
    assert quantiles.mean() == pytest.approx(mean, rel=1e-3)


def test_hst_has_the_width_of_the_mosaics():
    psf = hst_psf()
    assert fwhm(psf).to_value(u.arcsec) == pytest.approx(0.20, abs=5e-4)
    assert psf.frame == "sky"
    assert psf.pixel_scale.value == 0.06
    assert fwhm(hst_psf("wfc3.f105w")) < fwhm(psf)


def test_hst_spikes_turn_with_the_telescope():
    psf = hst_psf(angle=25 * u.deg)
    r = 3.0 / psf.cell
    angles = np.radians(np.arange(0, 180, 0.5))
    # position angle t: counter-clockwise from +y
    ring = psf.evaluate(-r * np.sin(angles) / 4, r * np.cos(angles) / 4, 1.0, 0.0, 0.0)
    peak = np.degrees(angles[np.argmax(ring)])
    assert min(abs(peak - 70), abs(peak - 160)) < 2


@pytest.mark.filterwarnings("ignore::astropy.io.fits.verify.VerifyWarning")
def test_hst_agrees_with_empirical_psfs(data_file):
    from miricigale.psf import read_psf

    radii = [0.1, 0.2, 0.3, 0.5, 1.0, 1.5] * u.arcsec
    # STScI's ePSF: no drizzle, so only beyond the core
    form = {"pixel_scale": 0.128 * u.arcsec, "oversampling": 4, "frame": "detector"}
    path = data_file("psf/PSFSTD_WFC3IR_F160W.fits")
    empirical = read_psf(path, plane=4, enclosed=1.0, **form)
    a, b = encircled_energy(empirical, radii), encircled_energy(hst_psf(), radii)
    assert_allclose((b / b[-1])[2:], (a / a[-1])[2:], atol=0.025)
    # CEERS mosaics, 0.04 arcsec pixels as the header says
    form = {"pixel_scale": 0.04 * u.arcsec, "frame": "sky"}
    ceers = read_psf(data_file("psf/psf-ceers-f160w.fits"), enclosed=1.0, **form)
    ours = hst_psf(pixel_scale=0.04 * u.arcsec)
    a, b = encircled_energy(ceers, radii), encircled_energy(ours, radii)
    assert_allclose(b / b[-1], a / a[-1], atol=0.05)


def test_a_gaussian_has_its_width_and_energy():
    psf = gaussian_psf(0.8 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=12 * u.arcsec)
    for width in (fwhm(psf), fwhm(psf, method="gaussian")):
        assert width.to_value(u.arcsec) == pytest.approx(0.8, rel=1e-3)
    assert psf.enclosed == pytest.approx(1)
    # within its width half of the light is
    assert encircled_energy(psf, 0.4 * u.arcsec) == pytest.approx(0.5, rel=3e-3)


@pytest.mark.parametrize("n_pixels", [80, 81])
def test_energy_of_a_narrow_gaussian_whatever_the_parity(n_pixels):
    # as narrow as F770W in the pixels of MIRI
    pixel = 0.11 * u.arcsec
    sigma = 1.04
    width = sigma * np.sqrt(8 * np.log(2)) * pixel
    psf = gaussian_psf(width, pixel_scale=pixel, fov=n_pixels * pixel)
    radii = np.array([1.0, 1.5, 2.0, 3.0, 5.0])
    # light is constant over cells of a quarter of a pixel, which adds their variance
    variance = sigma**2 + 0.25**2 / 12
    expected = 1 - np.exp(-0.5 * radii**2 / variance)
    assert_allclose(encircled_energy(psf, radii * pixel), expected, atol=5e-4)


WIDE = gaussian_psf(0.5 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
PIXEL, F770W = {"pixel_scale": 1 * u.arcsec, "frame": "sky"}, ["F770W"]


@pytest.mark.parametrize(
    ("function", "args", "options", "error", "match"),
    [
        (miri_psf, ["miri.f999w"], {}, KeyError, "no PSF for the filter 'miri.f999w'; known: miri"),
        (miri_psf, F770W, {"includes": ("smile",)}, ValueError, "'includes' must be out of"),
        (miri_psf, F770W, {"oversampling": 0}, ValueError, "'oversampling' must be an integer >="),
        (hst_psf, [], {"pixel_scale": 0.3 * u.arcsec}, ValueError, "'pixel_scale' must be so fine"),
        (encircled_energy, [WIDE, 3 * u.arcsec], {}, ValueError, "'radius' must be between 0 and"),
        (radius_of_encircled_energy, [WIDE, 1.5], {}, ValueError, "'fraction' must be positive"),
        (make_psf, [np.ones((9, 9))], {"oversampling": 2, **PIXEL}, ValueError, "normalized to 4"),
        (fwhm, [ImagePSF(np.ones((9, 9)) / 81)], {}, ValueError, "from_photutils"),
    ],
)
def test_wrong_arguments_are_named(function, args, options, error, match):
    refuses(match, function, *args, error=error, **options)
