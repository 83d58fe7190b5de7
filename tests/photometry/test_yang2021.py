"""The paper's photometry: what each of its steps does, against closed forms."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose
from photutils.segmentation import SegmentationImage

from helpers.errors import refuses
from helpers.light import gaussian_image
from miricigale.photometry import Yang2021Photometer
from miricigale.psf import make_psf

SHAPE = (400, 400)


def psf_of(*parts):
    """Gaussians of some share of the light and width (arcsec) as a PSF of 0.06 arcsec that holds all light."""
    data = sum(share * gaussian_image(201, width / 0.06) for share, width in parts)
    return make_psf(data / data.sum(), pixel_scale=0.06 * u.arcsec, frame="sky", enclosed=1.0)


@pytest.fixture(scope="module")
def points(tools):
    """Bright points; a fifth of the wide PSF's light is in a halo of 0.9 arcsec."""
    rng = np.random.default_rng(1)
    sky, flux = tools.places(*tools.lattice(rng, 3, 8.0, 0.1)), np.geomspace(10, 100, 9)
    high = tools.picture(sky, flux, SHAPE, scale=0.06, width=tools.HI, sigma=1e-3)
    low = tools.picture(sky, 0.8 * flux, SHAPE, scale=0.06)
    low.data += tools.render(sky, 0.2 * flux, 0.9, low.wcs, SHAPE)
    # 1.8 arcsec wide: all of the sharp light
    labels = tools.disks(sky, low.wcs, SHAPE, 15)
    catalog = QTable({"id": np.arange(1, 10), "label": np.arange(1, 10), "sky": sky})
    psfs = psf_of((1.0, tools.HI)), psf_of((0.8, tools.LO), (0.2, 0.9))
    return psfs, low, high, SegmentationImage(labels), catalog, flux


def test_the_factors_are_those_of_closed_forms(points, tools):
    psfs, low, high, segments, catalog, flux = points
    photometer = Yang2021Photometer(*psfs)
    inside = 1 - 0.8 * np.exp(-0.5 * (1.5 / tools.LO) ** 2) - 0.2 * np.exp(-0.5 * (1.5 / 0.9) ** 2)
    assert_allclose(photometer.aperture, 1 / inside, rtol=1e-3)
    kernel = photometer.kernel
    assert kernel.array.shape == (51, 51)
    assert kernel.regularization == 0.03
    assert_allclose([kernel.array.sum(), kernel.target.sum()], 1, rtol=1e-3)
    result = photometer.measure(low, high, segments, catalog)
    # a template of a normalised stamp finds about the light within it: the factor brings back the rest
    assert_allclose(result.flux.value, flux, rtol=0.02)
    assert result.meta["method"] == "yang2021"
    assert result.meta["f_aper"] == photometer.aperture
    double = Yang2021Photometer(*psfs, scaling=2.0).measure(low, high, segments, catalog)
    assert_allclose(double.flux.value, 2 * result.flux.value, rtol=1e-6)
    assert_allclose(double.flux_err.value, 2 * result.flux_err.value, rtol=1e-6)


def test_errors_are_white_and_templates_as_they_are(points, tools):
    psfs, low, high, segments, catalog, _ = points
    photometer = Yang2021Photometer(*psfs)
    result = photometer.measure(low, high, segments, catalog)
    # the optimal weight of the target: sigma over the root of its sum of squares
    target = photometer.kernel.matched
    pixel = 0.01 * 0.06**2 * tools.SR * 1e12
    expected = photometer.aperture * pixel / np.sqrt(np.sum(target**2))
    assert_allclose(result.flux_err.value, expected, rtol=0.02)
    assert_allclose(np.sqrt(result.covariance.diagonal()), result.flux_err.value, rtol=1e-10)
    # noise in the prior's error plane changes nothing but the template's signal-to-noise
    noisy = high.copy()
    noisy.uncertainty = type(high.uncertainty)(100 * high.uncertainty.array)
    other = photometer.measure(low, noisy, segments, catalog)
    assert_allclose(other.flux.value, result.flux.value, rtol=1e-6)
    assert_allclose(other.template_snr, result.template_snr / 100, rtol=1e-6)
    # segments of two widths, with 86 % of the light: nothing is added to them
    small = tools.disks(catalog["sky"], low.wcs, SHAPE, 2 * tools.HI / 0.06)
    bare = photometer.measure(low, high, small, catalog)
    # templates are those segments of unit light: too sharp, and so too faint
    assert np.all(bare.flux.value < result.flux.value)


def test_the_image_must_be_on_the_prior_s_pixels(points, tools):
    psfs, low, high, segments, catalog, _ = points
    photometer = Yang2021Photometer(*psfs)
    part = low[20:-30, 40:]
    assert np.isfinite(photometer.measure(part, high, segments, catalog).flux.value).sum() >= 6
    coarse = tools.picture(tools.places([0.0]), [0.0], (200, 200))
    message = "'image' must be on the pixels of 'highres'"
    refuses(message, photometer.measure, coarse, high, segments, catalog)
    refuses("'scaling' must be positive", Yang2021Photometer, *psfs, scaling=0)
