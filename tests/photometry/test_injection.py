"""Calibration of errors by sources of known flux."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.photometry import (
    ErrorCalibration,
    ForcedPhotometer,
    SourceTemplates,
    calibrate_errors,
    detect_sources,
)
from miricigale.utils.exceptions import DataError


def known(factor, n=20000, seed=1):
    """Fluxes whose scatter is ``factor(snr)`` times the stated error, and empty places."""
    rng = np.random.default_rng(seed)
    true = np.append(10 ** rng.uniform(0, 2, n), np.zeros(n // 4))
    seen = true + rng.normal(size=len(true)) * factor(true)
    table = QTable({"flux_true": true, "flux": seen, "flux_err": np.ones(len(true))})
    table["flux_err_noise"] = np.ones(len(true))
    return QTable({name: table[name] * u.uJy for name in table.colnames})


def test_factors_are_those_of_the_scatter():
    calibration = ErrorCalibration.from_sources(known(lambda snr: 1.2 + 0.01 * snr))
    bins = calibration.bins
    assert np.sum(bins["n"]) == 25000
    expected = 1.2 + 0.01 * bins["snr"]
    assert_allclose(bins["factor"], expected, rtol=0.03)
    assert_allclose(bins["mad"], expected, rtol=0.03)
    # the deviations from the truth are as the standard errors say
    narrow = bins["snr"] < 10
    pull = (bins["factor"] - expected) / bins["factor_err"]
    assert np.all(np.abs(pull[narrow]) < 3.5)
    one = [1.0] * u.uJy
    assert_allclose(calibration.factor(0 * one, one), 1.2, rtol=0.03)
    assert_allclose(calibration.factor(-3 * one, one), calibration.factor(0 * one, one))
    assert_allclose(calibration.factor(1e4 * one, one), bins["factor"][-1])
    assert np.isnan(calibration.factor(np.nan * one, one))[0]


def test_few_sources_are_one_bin_and_fewer_none(tmp_path):
    sources = known(np.ones_like, n=40)
    calibration = ErrorCalibration.from_sources(sources)
    assert len(calibration.bins) == 1
    refuses("'sources' must be at least 30 sources", ErrorCalibration.from_sources, sources[:20])
    calibration.write(tmp_path / "c.ecsv")
    again = ErrorCalibration.read(tmp_path / "c.ecsv")
    assert_allclose(again.bins["factor"], calibration.bins["factor"], rtol=1e-12)
    QTable({"a": [1]}).write(tmp_path / "other.ecsv")
    message, path = "is not a calibration of errors", tmp_path / "other.ecsv"
    refuses(message, ErrorCalibration.read, path, error=DataError)


@pytest.fixture(scope="module")
def points(tools):
    """Forty points on white noise."""
    rng = np.random.default_rng(5)
    sky, flux = tools.positions(rng, 40, 14.0), 10 ** rng.uniform(0, 2, 40)
    return tools.picture(sky, flux, (300, 300), sigma=0.5, rng=rng), QTable({"sky": sky})


@pytest.fixture(scope="module")
def photometer(tools):
    return ForcedPhotometer(tools.kernel, template="psf", errors=tools.WHITE)


@pytest.mark.parametrize("stated", [0.5, 0.2])
def test_injected_points_tell_understated_errors(tools, points, photometer, stated):
    catalog = points[1]
    image = tools.as_ccd(points[0].data, points[0].wcs, stated)
    before = image.data.copy()
    calibration = calibrate_errors(photometer, image, catalog=catalog, n_trials=8, seed=3)
    assert_array_equal(image.data, before)
    assert {"point", "empty"} == set(calibration.sources["kind"])
    # errors of white noise are as wrong as the stated noise; some hundred sources know it to 6 %
    n = len(calibration.sources)
    assert n > 100
    factors = np.average(calibration.bins["factor"], weights=calibration.bins["n"])
    assert factors == pytest.approx(0.5 / stated, rel=3.5 * 0.97 / np.sqrt(n))
    result = photometer.measure(image, catalog=catalog)
    scaled = calibration.apply(result)
    factor = (scaled.flux_err / result.flux_err).value
    assert_allclose(factor, calibration.factor(result.flux, result.flux_err_noise), rtol=1e-12)
    assert_allclose(np.sqrt(scaled.covariance.diagonal()), scaled.flux_err.value, rtol=1e-9)
    assert_array_equal(scaled.flux, result.flux)
    refuses("'result' must be one with errors as they were measured", calibration.apply, scaled)


@pytest.mark.slow
def test_galaxies_are_injected_into_the_prior_too(tools):
    rng = np.random.default_rng(7)
    sky, size = tools.positions(rng, 25, 13.0), rng.uniform(0.05, 0.3, 25)
    high, low = tools.pair(sky, np.full(25, 20.0), size, (540, 300), (2.0, 0.2), rng)
    segments, found = detect_sources(high)
    # labels are then those at the positions
    found.remove_column("label")
    kept = segments.data.copy(), high.data.copy(), low.data.copy()
    options = {"n_trials": 3, "n_sources": 15, "seed": 2}
    runs = []
    for n in (1, 2):
        photometer = ForcedPhotometer(tools.kernel, n_threads=n)
        runs.append(calibrate_errors(photometer, low, high, segments, found, **options).sources)
    for array, before in zip((segments.data, high.data, low.data), kept, strict=True):
        assert_array_equal(array, before)
    sources, others = runs
    assert_array_equal(sources["flux"], others["flux"])
    assert {"galaxy", "empty"} <= set(sources["kind"])
    galaxies = sources["kind"] == "galaxy"
    # the prior shows them: they have templates of their own, not points
    assert np.mean(sources["template"][galaxies] != "point") > 0.8
    assert np.median(sources["template_snr"][galaxies]) > 5
    bright = galaxies & (sources["flux_true"] > 20 * sources["flux_err_noise"])
    ratio = (sources["flux"][bright] / sources["flux_true"][bright]).value
    assert abs(np.median(ratio) - 1) < 0.05
    pull = ((sources["flux"] - sources["flux_true"]) / sources["flux_err"]).value
    assert 0.6 < 1.4826 * np.median(np.abs(pull)) < 1.5


def test_rendered_sources_are_measured_as_they_are(tools, points, photometer):
    image, catalog = points
    templates, flux = SourceTemplates.from_catalog(catalog), np.arange(1.0, 41.0) * u.uJy
    light = photometer.render(image, templates, flux)
    drawn = tools.as_ccd(light.to_value("MJy/sr"), image.wcs, 0.1)
    assert_allclose(photometer.measure(drawn, catalog=catalog).flux, flux, rtol=1e-5)
    refuses("'flux' must be 40 fluxes", photometer.render, image, templates, flux[:3])


def test_options_out_of_range_are_named(points, photometer):
    image, catalog = points
    for name in ("n_trials", "n_sources"):
        options = {"catalog": catalog, name: 0}
        refuses(f"'{name}' must be", calibrate_errors, photometer, image, **options)
    message = "'photometer' must be a ForcedPhotometer"
    refuses(message, calibrate_errors, None, image, catalog=catalog)
