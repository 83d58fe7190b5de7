import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.depth import sensitivity
from miricigale.instrument import Exposure, background_level
from miricigale.photometry import YANG2021_DEPTHS, ErrorModel
from miricigale.psf import gaussian_psf
from miricigale.utils.exceptions import DataError

BAND = "miri.f770w"


@pytest.fixture(scope="module")
def simulated():
    """Gaussian errors of 0.1 uJy and 5 % of the flux."""
    rng = np.random.default_rng(1)
    n = 30000
    true = 10 ** rng.uniform(-1, 2, n)
    sigma = np.hypot(0.1, 0.05 * true)
    truth = QTable({"id": np.arange(n), BAND: true * u.uJy})
    measured = QTable({"id": np.arange(n), BAND: (true + rng.normal(0, sigma)) * u.uJy})
    return truth, measured


def test_statistics_and_limits_of_gaussian_errors(simulated):
    flux = np.array([0.3, 2.0, 30.0])
    expected = np.hypot(0.1, 0.05 * flux)
    robust = ErrorModel.from_tables(*simulated, bin_size=600)
    assert_allclose(robust.sigma(flux * u.uJy, BAND).value, expected, rtol=0.08)
    paper = ErrorModel.from_tables(*simulated, bin_size=600, statistic="median_abs")
    # the median of |x| is 0.6745 sigma
    assert_allclose(paper.sigma(flux * u.uJy, BAND).value, 0.67449 * expected, rtol=0.08)
    # f = 5 sqrt(0.1^2 + (0.05 f)^2)
    exact = 5 * 0.1 / np.sqrt(1 - 25 * 0.05**2)
    assert_allclose(robust.limiting_flux(BAND).value, exact, rtol=0.06)
    assert robust.limiting_magnitude(BAND).unit == u.ABmag
    # a signal-to-noise above that of the fractional error is never reached
    assert np.isnan(robust.limiting_magnitude(BAND, 100).value)


def test_the_papers_error_function_is_the_median_of_each_bin():
    """Bins of 30 in order of true flux, no smoothing: errors here neither rise nor fall."""
    rng = np.random.default_rng(4)
    true = np.sort(10 ** rng.uniform(-1, 0.5, 240))
    seen = true + rng.normal(0, 1, 240) * rng.choice([0.1, 1.0], 8).repeat(30)
    truth, measured = (QTable({BAND: v * u.uJy}) for v in (true, seen))
    nodes = ErrorModel.from_tables(truth, measured, statistic="median_abs").curves[BAND]
    bins = true.reshape(8, 30)
    assert_allclose(nodes.flux, np.median(bins, axis=1), rtol=1e-12)
    median = np.median(np.abs(seen - true).reshape(8, 30), axis=1)
    bright = nodes.flux > 5 * median
    assert_allclose(nodes.error[~bright], median[~bright], rtol=1e-12)
    # bright ones as magnitudes have it: relative to each flux
    relative = np.median(np.abs(seen / true - 1).reshape(8, 30), axis=1) * nodes.flux
    assert_allclose(nodes.error[bright], relative[bright], rtol=1e-12)
    pooled = ErrorModel.from_tables(truth, measured).curves[BAND]
    assert np.all(np.diff(pooled.error) >= -1e-12)
    assert np.any(np.diff(nodes.error) < 0)


def test_outside_of_the_bins_errors_are_constant_and_flagged(simulated):
    model = ErrorModel.from_tables(*simulated)
    flux = [-5.0, 0.0, 0.01, 1.0, 500.0, np.nan] * u.uJy
    sigma = model.sigma(flux, BAND)
    assert sigma[0] == sigma[1] == sigma[2] > 0
    assert sigma[4] == model.sigma(1e4 * u.uJy, BAND)
    assert np.isnan(sigma[5])
    assert model.extrapolated(flux, BAND)[:5].tolist() == [True, True, True, False, True]


def test_rows_are_matched_by_id_and_nan_does_not_count(simulated):
    truth, measured = simulated
    shuffled = measured[np.random.default_rng(0).permutation(len(measured))][:20000]
    shuffled[BAND][::7] = np.nan
    model = ErrorModel.from_tables(truth, shuffled, filters=[BAND], bin_size=600)
    assert_allclose(model.sigma(30 * u.uJy, BAND).value, 1.5, rtol=0.1)


def test_few_sources_make_one_bin():
    rng = np.random.default_rng(0)
    truth = QTable({BAND: np.linspace(1, 2, 12) * u.uJy})
    measured = QTable({BAND: (truth[BAND].value + rng.normal(0, 0.1, 12)) * u.uJy})
    model = ErrorModel.from_tables(truth, measured)
    table = model.to_table()
    assert len(table) == 1
    for name in ("flux", "sigma", "low", "high", "photon"):
        assert table[name].unit == u.uJy
    assert 0.03 < model.sigma(1.5 * u.uJy, BAND).value < 0.3


def test_depths():
    model = ErrorModel.yang2021()
    assert set(model.filters) == set(YANG2021_DEPTHS)
    assert len(model.filters) == 15
    # AB 27.6 is 3631 Jy 10^(-0.4 27.6) = 0.03311 uJy
    assert_allclose(model.sigma(0 * u.uJy, "wfc3.f160w").value, 0.03311 / 5, rtol=1e-3)
    assert_allclose(model.sigma(1e3 * u.uJy, "wfc3.f160w").value, 30, rtol=1e-3)
    assert_allclose(model.sigma(1e6 * u.uJy, "irac.ch1").value, 1e5, rtol=1e-3)
    same = ErrorModel.from_depths({"a": 23.9 * u.ABmag, "b": 1 * u.uJy})
    assert_allclose(same.sigma(0 * u.uJy, "a").value, 0.2, rtol=1e-3)
    assert_allclose(same.sigma(0 * u.uJy, "b").value, 0.2, rtol=1e-12)
    assert_allclose(same.limiting_magnitude("a").value, 23.9, atol=1e-9)
    assert (model | same).filters == (*model.filters, "a", "b")


def test_exposure_scales_as_photon_noise_does():
    psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.11 * u.arcsec, fov=10 * u.arcsec)
    name = "miri.f1500w"

    def error(time=2000, flux=0.0, **options):
        options = {"psf": psf, "n_integrations": 1, **options}
        return ErrorModel.from_exposure(name, time * u.s, **options).sigma(flux * u.uJy, name)

    assert_allclose(error() / error(8000), 2, rtol=0.01)
    assert_allclose(error(background=4 * background_level(name)) / error(), 2, rtol=0.01)
    # extended sources: noise grows as the width, sqrt(4 pi sigma^2)
    ratio = error(size=0.8 * u.arcsec) / error()
    assert_allclose(ratio, np.hypot(0.4, 0.8) / 0.4, rtol=0.02)
    # far above the sky the source's own photons count: error grows as the root
    assert_allclose(error(flux=4e7) / error(flux=1e7), 2, rtol=0.01)
    refuses("at least two frames", error, 3)


def test_a_mosaic_costs_what_its_smearing_does():
    """Gaussian of rms w, smeared by squares of rms k in all: variance (w^2 + k)^2 / w^2 (w^2 + 2 k)."""
    width, pixel, zero = 0.1, 0.1109, 0 * u.uJy
    psf = gaussian_psf(width * 2.3548 * u.arcsec, pixel_scale=0.0277 * u.arcsec, fov=8 * u.arcsec)
    options = {"psf": psf, "n_integrations": 1}
    errors = [
        ErrorModel.from_exposure(BAND, 2000 * u.s, mosaic=mosaic, **options).sigma(zero, BAND)
        for mosaic in (None, 0.11 * u.arcsec, 0.03 * u.arcsec)
    ]
    for error, cell in zip(errors[1:], (0.11, 0.03), strict=True):
        k = (pixel**2 + cell**2) / 12
        expected = (width**2 + k) / (width * np.sqrt(width**2 + 2 * k))
        assert (error / errors[0]).value == pytest.approx(expected, abs=0.01)
    assert errors[1] > 1.01 * errors[0]


def test_a_residual_pattern_falls_with_dithers_and_not_with_time():
    zero, name = 0 * u.uJy, "miri.f1500w"

    def variance(time, **options):
        options = {"n_integrations": 10, "excess": "ideal", **options}
        model = ErrorModel.from_exposure(name, time * u.s, **options)
        return model.sigma(zero, name).value ** 2

    added = variance(1000, residual=0.01) - variance(1000)
    assert variance(9000, residual=0.01) - variance(9000) == pytest.approx(added, rel=1e-6)
    four = variance(1000, residual=0.01, n_dithers=4) - variance(1000, n_dithers=4)
    assert four == pytest.approx(added / 4, rel=1e-6)
    twice = variance(1000, residual=0.02) - variance(1000)
    assert twice == pytest.approx(4 * added, rel=1e-6)
    # a wide source sees the pattern as white noise of 4 pi times its variance (Gaussian of 1 pixel)
    psf = gaussian_psf(0.5 * u.arcsec, pixel_scale=0.11 * u.arcsec, fov=10 * u.arcsec)
    options = {"size": 1.5 * u.arcsec, "mosaic": None, "psf": psf}
    wide = variance(1000, residual=0.01, **options) - variance(1000, **options)
    width = np.hypot(1.5, 0.5) / 2.3548
    level = 0.01 * background_level(name).value * (1 * u.arcsec).to_value(u.rad) ** 2 * 1e12
    # sum W^2 is 4 pi w^2 / pixel
    expected = level**2 * 4 * np.pi * width**2 * 4 * np.pi * 0.1109**2
    assert wide == pytest.approx(expected, rel=0.08)
    assert variance(1000, residual="etc") > variance(1000)


def test_errors_of_an_exposure_are_those_of_surveys_in_flight():
    """COSMOS-Web: 25.51 in F770W (Harish et al. 2025), four dithers of 264 s; the ideal fit by its name."""
    form = {"n_integrations": 4, "n_dithers": 4}
    default, ideal = (
        ErrorModel.from_exposure(BAND, 1054 * u.s, **form, **more).limiting_magnitude(BAND).value
        for more in ({}, {"excess": "ideal"})
    )
    assert default == pytest.approx(25.51, abs=0.05)
    assert ideal - default == pytest.approx(2.5 * np.log10(1.4), abs=0.02)
    limit = sensitivity(BAND, 1054 * u.s, n_groups=95, n_dithers=4).to_value(u.ABmag)
    assert limit == pytest.approx(default, abs=0.005)


@pytest.mark.parametrize("name", ["F770W", "F2550W"])
def test_a_time_has_one_limit(name):
    """The time alone, its exposure and the sensitivity are the same question."""
    exposure = Exposure(name, time=1 * u.hour)
    limits = [
        ErrorModel.from_exposure(exposure).limiting_flux(name),
        ErrorModel.from_exposure(name, exposure.exposure_time).limiting_flux(name),
        sensitivity(name, exposure.exposure_time),
    ]
    assert_allclose(u.Quantity(limits), limits[0], rtol=1e-6)


def test_what_an_exposure_cannot_be_is_named():
    wrong = {"n_dithers": 0, "n_integrations": 1.5, "residual": 0.5}
    wrong |= {"mosaic": 0 * u.arcsec, "size": -1 * u.arcsec}
    for name, value in wrong.items():
        refuses(f"'{name}' must be", ErrorModel.from_exposure, BAND, 1000 * u.s, **{name: value})


def test_perturbed_fluxes_have_the_stated_scatter():
    model = ErrorModel.from_depths({BAND: 1 * u.uJy}, fractional=0.1)
    table = QTable({"id": np.arange(3000), BAND: np.full(3000, 4.0) * u.uJy, "z": np.ones(3000)})
    one = model.perturb(table, seed=3)
    sigma = np.hypot(0.2, 0.4)
    assert_allclose(one[f"{BAND}_err"].value, sigma)
    assert abs(np.std(one[BAND].value - 4) / sigma - 1) < 0.05
    assert abs(np.mean(one[BAND].value - 4)) < 4 * sigma / np.sqrt(3000)
    assert np.all(table[BAND].value == 4)
    # a cut in the table does not change the draws
    part = model.perturb(table[100:200][::-1], seed=3)
    assert np.array_equal(part[BAND][::-1], one[BAND][100:200])
    assert not np.array_equal(model.perturb(table, seed=4)[BAND], one[BAND])
    assert_allclose(model.assign(table)[f"{BAND}_err"].value, sigma)


def test_tables_come_back(tmp_path, simulated):
    model = ErrorModel.from_tables(*simulated) | ErrorModel.yang2021()
    path = tmp_path / "errors.ecsv"
    model.write(path)
    again = ErrorModel.read(path)
    flux = np.geomspace(0.01, 100, 20) * u.uJy
    for other in (again, pickle.loads(pickle.dumps(model))):
        assert other.filters == model.filters
        for name in model.filters:
            assert_allclose(other.sigma(flux, name), model.sigma(flux, name), rtol=1e-12)
    assert again.extrapolated(1e4 * u.uJy, BAND)
    refuses("no band of this error model", model.sigma, flux, "miri.f560w", error=KeyError)
    axes = model.plot(filters=[BAND])
    assert axes.get_xlabel()
    import matplotlib.pyplot as plt

    plt.close("all")


def test_tables_and_files_that_do_not_fit_are_named(simulated, tmp_path):
    truth, measured = simulated
    model, made = ErrorModel.from_depths({BAND: 25.0}), ErrorModel.from_tables
    plain = [QTable({"id": one["id"], BAND: one[BAND].value}) for one in simulated]
    magnitudes, other = QTable({BAND: [22.0] * u.ABmag}), QTable({"id": [1], "b": [1.0] * u.uJy})
    refuses(r"fluxes with a unit .*the common columns \['id', 'miri", made, *plain)
    refuses("'measured' must be a table of 30000 rows", made, truth[[BAND]], measured[[BAND]][:9])
    refuses("at least three measured sources in", made, truth[:2], measured[:2])
    refuses("'statistic' must be 'mad' or", made, truth, measured, statistic="rms")
    for tables, name in ((plain, "truth"), ((truth, magnitudes), "measured")):
        message = rf"'{name}' column 'miri\.f770w' must be convertible to uJy"
        refuses(message, made, *tables, filters=[BAND], error=u.UnitsError)
    for method, options in ((model.assign, {}), (model.perturb, {"seed": 1})):
        refuses(r"at least one of the columns \['miri\.f770w'\]", method, other, **options)
        refuses("at least one of the columns", method, {}, **options)
        refuses("'photometry' must be a table", method, 5.0, **options)
        message = r"column 'miri\.f770w' must be convertible to uJy"
        refuses(message, method, magnitudes, **options, error=u.UnitsError)
    message = r"'flux' must be convertible to uJy, got mag\(AB\)"
    refuses(message, model.sigma, 22 * u.ABmag, BAND, error=u.UnitsError)
    other.write(tmp_path / "other.ecsv")
    for name, message in (
        ("none", "cannot be read as an error model: no such"),
        ("other", "is not an error model: .* the columns"),
    ):
        message = rf"{name}\.ecsv {message}"
        refuses(message, ErrorModel.read, tmp_path / f"{name}.ecsv", error=DataError)


def test_wide_bins_follow_errors_of_known_form():
    """A floor and a tenth of the flux, over four decades in few bins; the S/N only rises."""
    limits = []
    for seed in range(8, 14):
        rng = np.random.default_rng(seed)
        true = 10 ** rng.uniform(-1, 3, 1200)
        seen = true + rng.normal(size=true.size) * np.hypot(0.3, 0.1 * true)
        tables = (QTable({BAND: values * u.uJy}) for values in (true, seen))
        model = ErrorModel.from_tables(*tables, bin_size=60)
        flux = np.geomspace(0.15, 500, 60)
        sigma = model.sigma(flux * u.uJy, BAND).value
        # 60 sources give the scatter to 15 %, the straight lines between bins add to that
        assert np.median(np.abs(sigma / np.hypot(0.3, 0.1 * flux) - 1)) < 0.15
        nodes = model.curves["miri.f770w"]
        assert np.all(np.diff(nodes.flux / nodes.error) >= -1e-9)
        limits.append(model.limiting_flux("miri.f770w").value)
    # 5 sigma where flux = 5 hypot(0.3, 0.1 flux), in closed form: one draw knows it to 20 %,
    # six to 8 %; chords between bins half an octave apart lie up to 15 % above the curve
    assert np.mean(limits) == pytest.approx(1.5 / np.sqrt(0.75), rel=0.25)


def test_errors_where_the_exposure_is_longer(simulated):
    """Half of the sources exposed four times as long: one curve, and half of it there."""
    truth, _ = simulated
    rng = np.random.default_rng(7)
    true = truth[BAND].value
    noise = np.where(np.arange(len(true)) % 2, 0.5, 1.0)
    seen = true + rng.normal(0, noise * np.hypot(0.1, 0.05 * true))
    measured = QTable({"id": truth["id"], BAND: seen * u.uJy})
    model = ErrorModel.from_tables(truth, measured, bin_size=600, noise={BAND: noise})
    flux = np.array([0.3, 2.0, 30.0])
    expected = np.hypot(0.1, 0.05 * flux)
    assert_allclose(model.sigma(flux * u.uJy, BAND).value, expected, rtol=0.08)
    # without it: the mean of both, which is right for neither
    mean = ErrorModel.from_tables(truth, measured, bin_size=600).sigma(flux * u.uJy, BAND).value
    assert np.all(mean < 0.85 * expected)
    table = QTable({BAND: np.repeat(2.0, 4) * u.uJy})
    factors = {BAND: np.array([1.0, 0.5, np.inf, 0.0])}
    errors = model.assign(table, noise=factors)[f"{BAND}_err"].value
    one = model.sigma(2.0 * u.uJy, BAND).value
    assert_allclose(errors, [one, 0.5 * one, np.nan, np.nan])
    # rows of no known noise do not count
    some = {BAND: np.where(np.arange(len(true)) < 3000, noise, np.nan)}
    first = ErrorModel.from_tables(truth, measured, bin_size=600, noise=some).curves[BAND]
    own = {"bin_size": 600, "noise": {BAND: noise[:3000]}}
    alone = ErrorModel.from_tables(truth[:3000], measured[:3000], **own).curves[BAND]
    assert_allclose(first.error, alone.error)
    with pytest.raises(ValueError, match="'noise' must be a factor for each of 4 rows"):
        model.assign(table, noise={BAND: np.ones(3)})


def test_limits_of_all_bands_and_fluxes_without_names():
    model = ErrorModel.from_depths({"F770W": 25.0, "F1500W": 24.0})
    limits = model.limiting_magnitude()
    assert_allclose(limits.value, [model.limiting_magnitude(band).value for band in model.filters])
    assert_allclose(model.limiting_magnitude(["F1500W", "F770W"], snr=5).value, [24.0, 25.0])
    # fluxes in any order could be taken for those of other bands
    refuses("that names the bands, such as QTable", model.perturb, np.ones((3, 2)) * u.uJy, seed=1)
