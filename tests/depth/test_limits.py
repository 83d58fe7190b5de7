"""Closed-form limits against theory, simulated white noise and published numbers."""

import itertools

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose
from photutils.aperture import ApertureStats, CircularAnnulus, CircularAperture
from scipy.ndimage import gaussian_filter

from helpers.errors import refuses
from helpers.exposures import exposure_of
from miricigale.depth import (
    aperture_noise,
    etc_limit,
    etc_setup,
    fitted_noise,
    sensitivity,
    sensitivity_table,
)
from miricigale.depth.fitted import extraction_map
from miricigale.depth.limits import extraction_weights
from miricigale.depth.noise import ExposureNoise, noise_power, ramp_variance
from miricigale.detector import BadPixels, CosmicRays, Detector, Residual
from miricigale.instrument import (
    DetectorProperties,
    Exposure,
    background_level,
    imager_filters,
    photmjsr,
    pixel_area_map,
)
from miricigale.psf import MIRI_PIXEL_SCALE, encircled_energy, gaussian_psf, miri_psf
from miricigale.reduction import Reducer

NAME = "miri.f1000w"


@pytest.fixture(scope="module")
def psf():
    return miri_psf(NAME)


@pytest.mark.parametrize(
    ("rate", "n", "step", "read"),
    [(50.0, 20, 2.0, 0.0), (1e-9, 20, 2.0, 30.0), (20.0, 12, 3.0, 25.0)],
)
def test_slope_is_the_generalized_least_squares_line(rate, n, step, read):
    # straight line with free level through groups of covariance rate t_min + read noise
    time = step * np.arange(1, n + 1)
    inverse = np.linalg.inv(rate * np.minimum.outer(time, time) + read**2 * np.eye(n))
    design = np.column_stack([np.ones(n), time])
    expected = np.linalg.inv(design.T @ inverse @ design)[1, 1]
    variance = ramp_variance(rate, n_groups=n, group_time=step, read_noise=read)
    # with next to no photons the inverse of the matrix has fewer digits
    assert_allclose(variance, expected, rtol=1e-9 if rate > 1 else 1e-6)
    if read == 0:
        # the first group is lost as the zero, and nothing else
        assert_allclose(variance, rate / ((n - 1) * step))


@pytest.mark.parametrize(("read", "level"), [(0.0, 500.0), (6.0, 0.0)])
def test_ramps_apart_have_the_noise_of_the_closed_forms(read, level):
    # two hours as one ramp and as 27: of photons alone each loses its zero, (n - 1) of n; of reads alone the
    # error of a straight line is 12 / n (n^2 - 1) (Rieke 2007, Robberto 2014)
    kind = DetectorProperties(gain=4.0, read_noise=read, dark_current=0.0)
    form = {"filter": NAME, "background": level * u.MJy / u.sr, "detector": kind}
    for n_ramps, n in ((1, 2592), (27, 96)):
        noise = ExposureNoise(n_groups=n, group_time=2.775, n_ramps=n_ramps, **form)
        of_reads = 12 * 24.0**2 / (n * (n**2 - 1) * 2.775**2)
        expected = of_reads if read else noise.rate / ((n - 1) * 2.775)
        assert_allclose(noise.variance(), expected / n_ramps, rtol=1e-6)


@pytest.mark.parametrize("correlation", [None, 1.0])
def test_noise_power_is_the_scatter_of_empty_apertures(correlation):
    image = np.random.default_rng(3).normal(size=(900, 900))
    if correlation:
        image = gaussian_filter(image, correlation, mode="wrap")
        image /= np.std(image)
    at = np.arange(20, 880, 12)
    xy = np.column_stack([v.ravel() for v in np.meshgrid(at, at)])
    circle = CircularAperture(xy, 3.3)
    sums, annulus = ApertureStats(image, circle).sum, (6.0, 8.0)
    ring = CircularAnnulus(xy, *annulus)
    less = sums - ApertureStats(image, ring).sum * circle.area / ring.area
    for some, used in ((sums, None), (less, annulus)):
        weights = extraction_weights(3.3, used)
        assert_allclose(weights.sum(), 0 if used else np.pi * 3.3**2, atol=1e-9)
        power = noise_power(weights, correlation)
        # 5184 apertures: 1 % of the standard deviation, the annuli overlap a little
        assert_allclose(np.std(some), np.sqrt(power), rtol=0.05)


def test_extraction_lies_where_the_source_does():
    weights = extraction_weights(2.7, offset=(0.3, -0.4))
    y, x = np.indices(weights.shape) - len(weights) // 2
    center = [np.sum(weights * at) / weights.sum() for at in (x, y)]
    assert_allclose(center, [0.3, -0.4], atol=0.01)


def aperture_limit(name, time=1e4 * u.s, **options):
    """The limit in an aperture."""
    return sensitivity(name, time, method="aperture", **options)


def test_the_limit_of_a_fit_solves_its_equation():
    """Signal over noise is n where noise is that of the fit: sky and the source's own photons."""
    time = 4 * etc_setup(NAME).n_groups * 2.77504 * u.s
    sky, photon = fitted_noise(NAME, time, n_integrations=4, frame_time=2.77504 * u.s)
    for n in (1.0, 5.0, 50.0):
        limit = sensitivity(NAME, time, n_sigma=n, n_groups=etc_setup(NAME).n_groups)
        flux = limit.to_value(u.uJy)
        assert_allclose(flux / np.sqrt(sky**2 + photon * flux), n, rtol=1e-4)
    assert sensitivity(NAME, time) == sensitivity(NAME, time, n_sigma=5, excess="flight")
    # the ideal fit is asked for by name; read noise and sky alone are 1.4 times as large in flight
    faint = {"n_sigma": 1e-3}
    ratio = sensitivity(NAME, time, **faint) / sensitivity(NAME, time, excess="ideal", **faint)
    assert_allclose(ratio, 1.4, rtol=1e-3)
    assert_quantity_allclose(
        aperture_limit(NAME, time), aperture_noise(NAME, time, n_sigma=5)["flux"] * u.uJy
    )


@pytest.mark.parametrize("boxes", [(), (1.0,), (1.0, 1.3)])
def test_every_lattice_of_pixels_finds_unit_flux_in_the_mean(boxes):
    # a Gaussian of 1.5 pixels, sampled four times a side
    axis = (np.arange(121) - 60) / 4
    square = axis**2 + axis[:, None] ** 2
    share = np.exp(-square / (2 * 1.5**2)) / (2 * np.pi * 1.5**2)
    weight = extraction_map(share, boxes)
    fluxes = [
        np.sum(weight[y::4, x::4] * share[y::4, x::4])
        for y, x in itertools.product(range(4), repeat=2)
    ]
    assert_allclose(np.mean(fluxes), 1, rtol=1e-12)
    # the squared width of the weights: that of the PSF, and of each square twice
    width = np.sum(weight * square) / np.sum(weight) / 2
    assert_allclose(width, 1.5**2 + sum(2 * box**2 / 12 for box in boxes), rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "psf"}, "'method' must be 'fit' or 'aperture', got 'psf'"),
        ({"aperture": 0.3 * u.arcsec}, "'aperture' must be left out with method='fit'"),
        (
            {"method": "aperture", "excess": "ideal"},
            "'excess' must be left out with method='aperture'",
        ),
        (
            {"method": "aperture", "mosaic": None},
            "'mosaic' must be left out with method='aperture'",
        ),
        ({"excess": "survey"}, "'excess' must be 'flight' or 'ideal', got 'survey'"),
        ({"excess": 0.0}, "'excess' must be"),
        ({"n_sigma": 0.0}, "'n_sigma' must be"),
    ],
)
def test_options_of_the_other_method_are_refused(options, message):
    refuses(message, sensitivity, NAME, **options)


def test_limit_of_photons_alone_is_sky_over_light(psf):
    # Poisson sky in the aperture, no read noise, no dark; small source term left out by n_sigma
    quiet = DetectorProperties(gain=4.0, read_noise=0.0, dark_current=0.0, full_well=1e9)
    radius, seconds, level = 1.2 * u.arcsec, 1e4, 20.0
    kind = {"background": level * u.MJy / u.sr, "n_groups": 1000, "detector": quiet, "psf": psf}
    flux = aperture_limit(NAME, seconds * u.s, n_sigma=1e-3, aperture=radius, **kind)
    rate = level * 4.0 / photmjsr(NAME, gain=4.0)
    pixels = np.pi * (radius / MIRI_PIXEL_SCALE).to_value("") ** 2
    electrons = np.sqrt(rate / seconds * 1000 / 999 * pixels)
    area = MIRI_PIXEL_SCALE.to_value(u.rad) ** 2 * 1e12
    per_ujy = 4.0 / photmjsr(NAME, gain=4.0) / area
    expected = 1e-3 * electrons / per_ujy / encircled_energy(psf, radius)
    # fractional pixels of the rim: sum w^2 is 4 % below sum w
    assert_quantity_allclose(flux, expected * u.uJy, rtol=0.04)


def test_limits_fall_with_the_root_of_time_and_residuals_do_not(psf):
    options = {"psf": psf, "n_sigma": 1e-3}
    short, long = (aperture_limit(NAME, t * u.s, **options) for t in (1e4, 1e6))
    assert_quantity_allclose(long, short / 10, rtol=1e-3)
    short, long = (aperture_limit(NAME, t * u.s, residual=0.01, **options) for t in (1e6, 1e10))
    floor = aperture_limit(NAME, 1e12 * u.s, residual=0.01, **options)
    assert_quantity_allclose(long, floor, rtol=1e-3)
    assert short > 0.95 * floor
    # twice the pattern is twice the floor, and four positions halve it
    double = aperture_limit(NAME, 1e12 * u.s, residual=0.02, **options)
    assert_quantity_allclose(double, 2 * floor, rtol=1e-4)
    spread = aperture_limit(NAME, 1e12 * u.s, residual=0.01, n_dithers=4, **options)
    assert_quantity_allclose(spread, floor / 2, rtol=1e-4)
    kind = {"residual": 0.01, **options}
    columns = [
        sensitivity_table([NAME], 1e4 * u.s, n_dithers=n, **kind)["residual"] for n in (1, 4)
    ]
    assert_quantity_allclose(columns[1], columns[0] / 2, rtol=1e-9)


def test_faint_limits_are_linear_and_bright_ones_count_their_own_photons(psf):
    one, three = (aperture_limit(NAME, n_sigma=n, psf=psf) for n in (1, 3))
    assert_quantity_allclose(three, 3 * one, rtol=0.005)
    # no sky: 10^4 electrons for 100 sigma, in the light of the aperture
    quiet = DetectorProperties(gain=4.0, read_noise=0.0, dark_current=0.0, full_well=1e12)
    kind = {"background": 0 * u.MJy / u.sr, "n_groups": 1000, "detector": quiet, "psf": psf}
    dark = aperture_limit(NAME, n_sigma=100, **kind)
    radius = etc_setup(NAME).radius
    area = MIRI_PIXEL_SCALE.to_value(u.rad) ** 2 * 1e12
    collected = dark.value * 4 / photmjsr(NAME, gain=4.0) / area * 1e4
    assert_allclose(collected * encircled_energy(psf, radius), 1e4, rtol=0.05)


def test_annulus_adds_its_noise_and_takes_off_wings(psf):
    radius, inner, outer = 1.0, 4.0, np.sqrt(4.0**2 + 1.0**2 / 0.5)
    kind = {"n_sigma": 1e-3, "psf": psf, "aperture": radius * u.arcsec}
    known = aperture_limit(NAME, **kind)
    measured = aperture_limit(NAME, **kind, annulus=[inner, outer] * u.arcsec)
    light = encircled_energy(psf, radius * u.arcsec)
    wings = np.diff(encircled_energy(psf, [inner, outer] * u.arcsec))[0] / 2
    # half as noisy as the aperture: its area is twice as large
    assert_allclose(measured / known, np.sqrt(1.5) * light / (light - wings), rtol=0.03)


@pytest.mark.parametrize("name", imager_filters())
def test_residual_gives_the_published_limits(name):
    # ETC 4.0 (JWST user documentation, MIRI Sensitivity), digits cut off there
    digits = [0.13, 0.24, 0.46, 1.02, 0.83, 1.18, 2.42, 4.70, 15.3]
    published = dict(zip(imager_filters(), digits, strict=True))
    psf = miri_psf(name, oversampling=2, fov=9 * u.arcsec)
    form = {"n_sigma": 10, "psf": psf}
    limit = aperture_limit(name, etc_setup(name).time, residual="etc", **form).value
    assert_allclose(limit, published[name], rtol=0.10)
    # photons and read noise alone reach deeper: the calculator has excess noise
    bare = aperture_limit(name, etc_setup(name).time, **form).value
    assert 0.5 < bare / published[name] < 0.9


def test_table_scales_the_calculators_limits(psf):
    table = sensitivity_table([NAME], 2500 * u.s, n_sigma=5, residual=None)
    assert_quantity_allclose(table["etc_40"], etc_limit(NAME))
    assert_quantity_allclose(table["etc_20"], etc_limit(NAME, "2.0"))
    assert_quantity_allclose(table["limit"], table["limit_white"])
    assert_quantity_allclose(table["background"], background_level(NAME))
    assert table["residual"][0] == 0 * u.uJy
    assert table["background"].unit == u.MJy / u.sr
    # one name is a list of one, and the instrument's may be left out of it
    short = sensitivity_table("f1000w", 2500 * u.s, n_sigma=5, residual=None)
    assert short["filter"].tolist() == [NAME]
    assert_quantity_allclose(short["limit"], table["limit"])
    # n sigma times the noise in the aperture, over the light in it, and a little of the source
    assert_quantity_allclose(table["limit"], 5 * table["noise"] / table["light"], rtol=0.03)


@pytest.mark.parametrize(("residual", "n_exposures"), [(None, 1), (0.004, 1), (0.004, 8)])
def test_noise_is_that_of_simulated_and_reduced_exposures(residual, n_exposures):
    name, radius, n_groups = "miri.f2100w", 0.25 * u.arcsec, 12
    exposure = exposure_of(name, n_groups=n_groups)
    detector = Detector.miri_imager().without(CosmicRays, BadPixels)
    if residual:
        detector = detector.replace(Residual(residual))
    level = background_level(name).value
    meta = {"psf_includes": ["pixel", "ipc"]}
    sky = CCDData(np.full(exposure.shape, level), unit="MJy/sr", meta=meta)
    reducer = Reducer(jump_threshold=None)
    # the same pattern in each, other photons
    ramps = (detector.expose(sky, exposure, seed=k) for k in range(n_exposures))
    mean = np.mean([reducer.calibrate(reducer.fit_ramp(one)).data for one in ramps], axis=0)
    # the sky off first: its sum varies with the area of the pixels
    flux = (mean - level) * pixel_area_map(exposure.wcs, exposure.shape) * 1e12
    rng = np.random.default_rng(5)
    at = np.meshgrid(np.arange(16, 240, 8.0), np.arange(16, 240, 8.0))
    xy = np.column_stack([v.ravel() for v in at]) + rng.uniform(-0.5, 0.5, (at[0].size, 2))
    circle = CircularAperture(xy, (radius / MIRI_PIXEL_SCALE).to_value(""))
    sums, annulus = ApertureStats(flux, circle).sum, [0.6, 0.9] * u.arcsec
    ring = CircularAnnulus(xy, *(annulus / MIRI_PIXEL_SCALE).to_value(""))
    less = sums - ApertureStats(flux, ring).sum * circle.area / ring.area
    kind = {"n_groups": n_groups, "subarray": "SUB256", "aperture": radius, "residual": residual}
    time = n_exposures * exposure.exposure_time
    for some, used in ((sums, None), (less, annulus)):
        table = sensitivity_table([name], time, annulus=used, **kind)
        expected = np.hypot(table["noise"], table["residual"])[0].value
        # 784 places: 2.5 % of the standard deviation
        assert_allclose(np.std(some - np.median(some)), expected, rtol=0.09)


WIDE = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.11 * u.arcsec, fov=6 * u.arcsec)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"aperture": 0 * u.arcsec}, "aperture"),
        ({"annulus": [0.1, 1] * u.arcsec}, "annulus"),
        ({"annulus": [1, 2, 3] * u.arcsec}, "annulus"),
        ({"n_groups": 3000, "time": 1e5 * u.s}, "n_groups"),
        ({"residual": 0.5}, "residual"),
        ({"residual": True}, "residual"),
        ({"background": -1 * u.MJy / u.sr}, "background"),
        ({"psf": WIDE}, "psf"),
    ],
)
def test_errors_name_the_argument(options, name, psf):
    refuses(f"'{name}' must be", sensitivity, NAME, **{"psf": psf, **options})


def test_unknown_names_list_the_known():
    text = "no residual preset 'sky'; known: etc"
    refuses(text, sensitivity, NAME, error=KeyError, residual="sky")
    text = r"'psf' must be one of the filter miri\.f770w, got one"
    refuses(text, sensitivity, "miri.f770w", psf=miri_psf("miri.f560w"))
    refuses("no imaging filter", sensitivity, "miri.f600w", error=KeyError)
    refuses("'time' must be", sensitivity, NAME, 1e4, error=u.UnitsError)
    # frames of 2.775 s
    wanted = "'time' must be at least one integration of 10 groups, 27.75 s, got 10"
    refuses(wanted, sensitivity, NAME, 10 * u.s, n_groups=10)


@pytest.mark.parametrize("method", ["fit", "aperture"])
def test_an_exposure_has_the_limit_of_its_filter_time_and_groups(method):
    exposure = Exposure(NAME, n_groups=40, n_integrations=3, subarray="BRIGHTSKY")
    form = {"n_groups": 40, "subarray": "BRIGHTSKY", "method": method}
    limit = sensitivity(NAME, exposure.exposure_time, **form)
    assert_quantity_allclose(sensitivity(exposure, method=method), limit)
    refuses("'time' must be left out with an exposure", sensitivity, exposure, 1 * u.h)


def test_several_filters_have_a_limit_each():
    names = ["F770W", "F1500W"]
    alone = [sensitivity(name, 1000 * u.s).value for name in names]
    assert_allclose(sensitivity(names, 1000 * u.s).value, alone)


@pytest.mark.parametrize("name", ["miri.f770w", "miri.f2100w"])
def test_four_equal_exposures_halve_the_noise(name):
    """Each holds as many integrations as one alone, of which long bands take several; the source has no noise."""
    time = 2500 * u.s
    one = sensitivity(name, time, n_sigma=0.01)
    four = sensitivity(name, 4 * time, n_sigma=0.01, n_dithers=4)
    assert_quantity_allclose(four, one / 2, rtol=2e-3)


def test_noise_power_of_wide_correlations_is_that_of_the_sum_over_pairs():
    # rho of two pixels is that of white noise smoothed by a Gaussian: one of sqrt(2) times the width
    weights = np.ones((5, 5))
    y, x = np.indices(weights.shape).reshape(2, -1)
    square = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    for width in (0.8, 2.5):
        assert_allclose(
            noise_power(weights, width), np.exp(-square / (4 * width**2)).sum(), rtol=0.01
        )
