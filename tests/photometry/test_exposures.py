"""Exposures fitted together, against dense least squares with sources known in closed form."""

import types

import astropy.units as u
import numpy as np
import pytest
import scipy.ndimage
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from helpers.light import gaussian_image
from miricigale.instrument import imager_wcs
from miricigale.photometry import (
    ErrorSettings,
    ForcedFlags,
    ForcedPhotometer,
    ForcedPhotometryResult,
    SourceTemplates,
    detect_sources,
)
from miricigale.photometry.templates.normal_equations import stated_correlation
from miricigale.psf import MatchingKernel

#: Two dithers, the second at another roll, with another PSF (rms, arcsec), noise and sky (MJy/sr).
WIDTHS = (0.25, 0.31)
SIGMAS = (0.02, 0.05)
SKIES = (0.7, -0.3)
SHAPE = (64, 72)


def kernel(tools, width):
    sharp, wide = (gaussian_image(67, rms / tools.FINE) for rms in (tools.HI, width))
    return MatchingKernel.from_psfs(sharp, wide, pixel_scale=tools.FINE * u.arcsec)


def exposure(light, wcs, sigma, **meta):
    noise = StdDevUncertainty(np.full(light.shape, sigma))
    return CCDData(light, unit="MJy/sr", wcs=wcs, uncertainty=noise, meta=meta)


@pytest.fixture(scope="module")
def dithers(tools):
    """Eight points, two of them blended, on two distorted exposures with noise, and their closed forms."""
    rng = np.random.default_rng(8)
    sky = tools.places(
        [-2.2, -1.9, -0.2, 0.3, 1.5, 2.0, -2.4, 1.2], [-1.8, -1.5, 0.4, 2.0, -0.6, 1.8, 1.2, -2.2]
    )
    flux = rng.uniform(2, 9, len(sky))
    images, stamps, wcss = [], [], []
    for east, roll, width, sigma, level in zip(
        (0.1, -0.3), (30, 75), WIDTHS, SIGMAS, SKIES, strict=True
    ):
        wcs = imager_wcs(tools.places(east), roll * u.deg, subarray="SUB64")
        own = [tools.render(one.reshape(1), [1.0], width, wcs, SHAPE) for one in sky]
        light = np.tensordot(flux, own, axes=1) + level + rng.normal(0, sigma, SHAPE)
        image = exposure(light, wcs, sigma)
        image.mask = rng.random(SHAPE) < 0.03
        image.data[image.mask] = 1e4
        images.append(image)
        stamps.append(own)
        wcss.append(wcs)
    kernels = [kernel(tools, width) for width in WIDTHS]
    templates = SourceTemplates.from_catalog(QTable({"id": np.arange(8), "sky": sky}))
    return types.SimpleNamespace(
        images=images, stamps=stamps, sky=sky, flux=flux, kernels=kernels, templates=templates, wcss=wcss
    )  # fmt: skip


def dense(dithers, factors=(1, 1)):
    """Fluxes and skies of all pixels by dense least squares, and their covariance; noise correlated as stated."""
    columns, data, middle = [], [], np.zeros((10, 10))
    for k, (image, sigma) in enumerate(zip(dithers.images, SIGMAS, strict=True)):
        weight = np.where(image.mask, 0.0, 1 / sigma)
        skies = [np.ones(SHAPE) * (j == k) for j in range(2)]
        white = [weight * one for one in (*dithers.stamps[k], *skies)]
        correlation = stated_correlation(factors[k]) if factors[k] > 1 else np.ones((1, 1))
        spread = [scipy.ndimage.convolve(one, correlation, mode="constant") for one in white]
        columns.append(np.reshape(white, (10, -1)))
        data.append((weight * np.where(image.mask, 0, image.data)).ravel())
        middle += columns[-1] @ np.reshape(spread, (10, -1)).T
    columns = np.concatenate(columns, axis=1)
    inverse = np.linalg.inv(columns @ columns.T)
    return inverse @ columns @ np.concatenate(data), inverse @ middle @ inverse


def test_the_fit_is_that_of_all_pixels(dithers):
    result = ForcedPhotometer(dithers.kernels).measure(dithers.images, templates=dithers.templates)
    values, covariance = dense(dithers)
    error = np.sqrt(np.diag(covariance))
    assert_allclose(result.flux.value, values[:8], atol=0.02 * error.min())
    assert_allclose(result.flux_err.value, error[:8], rtol=2e-3)
    assert_allclose(result.covariance.toarray()[0, 1], covariance[0, 1], rtol=0.01)
    table = result.exposures.table
    assert_allclose(table["sky"].value, values[8:], atol=1e-4)
    assert_allclose(table["sky_err"].value, error[8:], rtol=2e-3)
    assert np.abs((result.flux.value - dithers.flux) / error[:8]).max() < 3.5
    assert_allclose(table["noise"], 1, atol=0.06)
    assert abs(table["correlation"]).max() < 0.06
    assert not np.any(result.flags & ForcedFlags.POOR_FIT)
    # the sum of the light on each exposure is there, with its sky
    for k, image in enumerate(dithers.images):
        model = result.exposures.model_images[k].data
        light = np.tensordot(values[:8], dithers.stamps[k], axes=1) + values[8 + k]
        assert_allclose(model, light, atol=0.01 * light.max())
        residual = result.exposures.residual_images[k]
        assert_array_equal(residual.mask, image.mask)
        assert_allclose((residual.data + model)[~image.mask], image.data[~image.mask], atol=1e-6)


def test_noise_that_exposures_state_to_be_correlated_makes_errors_larger(dithers):
    factors = (1.2, 1.1)
    images = []
    for image, factor in zip(dithers.images, factors, strict=True):
        stated = image.copy()
        stated.meta["noise_correction"] = factor
        images.append(stated)
    result = ForcedPhotometer(dithers.kernels).measure(images, templates=dithers.templates)
    _, covariance = dense(dithers, factors)
    assert_allclose(result.flux_err.value, np.sqrt(np.diag(covariance))[:8], rtol=3e-3)


@pytest.fixture(scope="module")
def galaxies(tools):
    """A prior and one image of galaxies, as templates that may change."""
    rng = np.random.default_rng(3)
    sky = tools.places(*tools.lattice(rng, 3, 2.6, 0.2))
    flux = rng.uniform(15, 60, 9)
    size = np.where(np.arange(9) % 3 == 0, 0.0, rng.uniform(0.1, 0.2, 9))
    fine = 0.02 / (tools.FINE**2 * tools.SR * 1e12)
    high, image = tools.pair(sky, flux, size, (180, 100), (fine, 0.8), rng)
    segments, found = detect_sources(high, threshold=1.0, n_pixels=10)
    return high, image, segments, found


def test_one_exposure_is_one_image(galaxies, tools):
    high, image, *prior = galaxies
    options = {"background_order": 0, "errors": ErrorSettings(correlated_noise=False)}
    photometer = ForcedPhotometer(tools.kernel, **options)
    one = photometer.measure(image, high, *prior)
    joint = photometer.measure([image], high, *prior)
    assert np.any(joint.flux_err_template.value > 0.1 * joint.flux_err_noise.value)
    assert_allclose(joint.flux, one.flux, rtol=1e-4)
    for name in ("", "_noise", "_template", "_psf"):
        key = f"flux_err{name}"
        assert_allclose(getattr(joint, key).value, getattr(one, key).value, rtol=1e-4, atol=1e-6)
    for name in ("chi2", "coverage", "residual_fraction"):
        assert_allclose(getattr(joint, name), getattr(one, name), rtol=1e-3, atol=1e-4)
    assert_array_equal(joint.flags & ~ForcedFlags.UNEXPLAINED_NEIGHBOR, one.flags)
    assert_array_equal(joint.template, one.template)
    assert joint.to_table().colnames == one.to_table().colnames


def test_exposures_twice_have_errors_smaller_by_the_root_of_two(galaxies, tools):
    high, image, *prior = galaxies
    errors = ErrorSettings(size_scatter=None)
    photometer = ForcedPhotometer(tools.kernel, errors=errors)
    one, two = (photometer.measure([image] * n, high, *prior) for n in (1, 2))
    # more signal moves bright sources by more of their own offsets
    assert_allclose(two.flux, one.flux, rtol=0.01)
    assert_allclose(two.flux_err_noise, one.flux_err_noise / np.sqrt(2), rtol=3e-3)


def moved(image, east, north):
    """The same image whose coordinates say that it lies elsewhere: its sources are off by that."""
    wcs = image.wcs.deepcopy()
    dec = np.radians(wcs.wcs.crval[1])
    wcs.wcs.crval = wcs.wcs.crval + np.array([east / np.cos(dec), north]) / 3600
    return exposure(image.data, wcs, image.uncertainty.array)


def test_offsets_of_exposures_are_found_and_fitted(dithers):
    images = [moved(one, 0.03 * k, -0.05 * k) for k, one in enumerate(dithers.images)]
    for image, first in zip(images, dithers.images, strict=True):
        image.mask = first.mask
    photometer = ForcedPhotometer(dithers.kernels)
    plain = warned("max_shift", photometer.measure, images, templates=dithers.templates)
    photometer = photometer.replace(max_shift=0.2 * u.arcsec)
    fitted = photometer.measure(images, templates=dithers.templates)
    for result, tolerance in ((plain, 0.015), (fitted, 0.01)):
        table = result.exposures.table
        assert_allclose(table["offset_east"].value, [0, 0.03], atol=tolerance)
        assert_allclose(table["offset_north"].value, [0, -0.05], atol=tolerance)
    pulls = (fitted.flux.value - dithers.flux) / fitted.flux_err.value
    assert np.abs(pulls).max() < 3.5
    close = photometer.replace(max_shift=0.03 * u.arcsec)
    match = "exposure 1 by .* is beyond 'max_shift'"
    warned(match, close.measure, images, templates=dithers.templates)


def test_the_offset_that_is_warned_of_is_one_that_was_measured(dithers):
    """An exposure without light has none."""
    noise = np.random.default_rng(4).normal(0, 50.0, SHAPE)
    images = [moved(dithers.images[0], 0.0, -0.05), exposure(noise, dithers.wcss[1], 50.0)]
    images[0].mask = dithers.images[0].mask
    photometer = ForcedPhotometer(dithers.kernels)
    match = "1 exposures lie up to 0.05. arcsec from"
    result = warned(match, photometer.measure, images, templates=dithers.templates)
    assert_array_equal(np.isnan(result.exposures.table["offset_err"]), [False, True])


def test_fluxes_that_exposures_cannot_hold_are_flagged(dithers):
    images = []
    for image, stamps in zip(dithers.images, dithers.stamps, strict=True):
        hole = image.copy()
        hole.data -= 2 * dithers.flux[5] * stamps[5]
        images.append(hole)
    result = ForcedPhotometer(dithers.kernels).measure(images, templates=dithers.templates)
    assert result.flux.value[5] < -5 * result.flux_err.value[5]
    flagged = result.flags & ForcedFlags.CANCELING > 0
    assert_array_equal(flagged, np.arange(8) == 5)


def test_a_source_that_the_catalog_lacks_is_fitted_with_it(dithers):
    known = dithers.templates[np.arange(8) != 3]
    photometer = ForcedPhotometer(dithers.kernels, second_pass=True)
    result = photometer.measure(dithers.images, templates=known)
    new = result.new_sources
    assert len(new) == 1
    assert new["sky"][0].separation(dithers.sky[3]).arcsec < 0.03
    assert abs(new["flux"][0].value - dithers.flux[3]) < 4 * new["flux_err"][0].value
    assert new["flags"][0] & ForcedFlags.NOT_IN_CATALOG
    values, _ = dense(dithers)
    others = np.arange(8) != 3
    assert_allclose(result.flux.value, values[:8][others], atol=0.03)


def test_sources_that_one_exposure_shows_are_measured_on_it(dithers, tools):
    # far from the second one, and from both
    far = imager_wcs(tools.places(20.0), 0 * u.deg, subarray="SUB64")
    empty = exposure(np.random.default_rng(2).normal(0, 0.02, SHAPE), far, 0.02)
    catalog = QTable({"id": np.arange(9)})
    lon, lat = (
        np.append(getattr(dithers.sky, k).deg, v) for k, v in (("ra", 53.5), ("dec", -27.8))
    )
    catalog["sky"] = type(dithers.sky)(lon, lat, unit="deg")
    templates = SourceTemplates.from_catalog(catalog)
    photometer = ForcedPhotometer([dithers.kernels[0]] * 2)
    result = photometer.measure([dithers.images[0], empty], templates=templates)
    alone = ForcedPhotometer([dithers.kernels[0]]).measure(dithers.images[:1], templates=templates)
    assert_allclose(result.flux[:8], alone.flux[:8], rtol=1e-5)
    assert_allclose(result.flux_err[:8], alone.flux_err[:8], rtol=1e-5)
    assert np.isnan(result.flux[8])
    assert result.flags[8] & ForcedFlags.NO_DATA


def test_a_result_keeps_the_table_of_exposures_in_its_file(dithers, tmp_path):
    result = ForcedPhotometer(dithers.kernels).measure(dithers.images, templates=dithers.templates)
    result.write(tmp_path / "result.fits")
    back = ForcedPhotometryResult.read(tmp_path / "result.fits")
    assert_array_equal(back.flux, result.flux)
    assert_allclose(back.exposures.table["sky"], result.exposures.table["sky"])
    assert back.exposures.model_images == ()


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"components": 2}, "'components' must be 1 for exposures"),
        (
            {"offset_order": 1, "max_shift": 1 * u.arcsec},
            "'offset_order' must be None for exposures",
        ),
        ({"psf_stars": True}, "'psf_stars' must be False or None for exposures"),
    ],
)
def test_options_that_exposures_do_not_have_are_refused(dithers, options, match):
    photometer = ForcedPhotometer(dithers.kernels, **options)
    refuses(match, photometer.measure, dithers.images, templates=dithers.templates)


def test_what_does_not_fit_is_refused(dithers):
    photometer, templates = ForcedPhotometer(dithers.kernels), dithers.templates
    match = "'kernel' must be one for each of 1 exposures"
    refuses(match, photometer.measure, dithers.images[:1], templates=templates)
    match = "'image' must be 2 exposures, one for each kernel"
    refuses(match, photometer.measure, dithers.images[0], templates=templates)
    refuses("'image' must be at least one", photometer.measure, [], templates=templates)
    match = "'templates' must be SourceTemplates, got list"
    refuses(match, photometer.measure, dithers.images, templates=[1], error=TypeError)
    bare = MatchingKernel(np.ones((3, 3)) / 9, pixel_scale=0.06 * u.arcsec)
    refuses("'kernel' must be kernels with their PSFs", ForcedPhotometer, [bare])
    other = [one.copy() for one in dithers.images]
    for image, name in zip(other, ("miri.f770w", "miri.f560w"), strict=True):
        image.meta["filter"] = name
    refuses("'image' must be exposures of one", photometer.measure, other, templates=templates)
