import astropy.units as u
import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.mosaics import stamps_of
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import MemorySettings
from miricigale.photometry.errors.error_curves import measured_curve
from miricigale.photometry.templates.normal_equations import (
    LinearFit,
    noise_correlation,
    sandwich_matrix,
    stated_correlation,
)
from miricigale.reduction import drizzle_images


@pytest.mark.slow
def test_pulls_are_unity(tools):
    rng = np.random.default_rng(11)
    sky, flux = tools.positions(rng, 60, 9.5), 10 ** rng.uniform(-0.5, 1, 60)
    pulls, plain, chi2 = [], [], []
    for k in range(12):
        image = tools.picture(sky, flux, (200, 200), sigma=0.5e-12 / tools.SR, rng=rng)
        result = tools.measured(image, sky, background_order=0)
        pulls.append((result.flux.value - flux) / result.flux_err.value)
        chi2.append(result.chi2)
        if k < 4:
            result = tools.measured(image, sky, errors=tools.WHITE)
            plain.append((result.flux.value - flux) / result.flux_err.value)
    assert 0.95 < np.std(pulls) < 1.1
    assert abs(np.mean(pulls)) < 0.12
    assert 0.85 < np.median(chi2) < 1.05
    assert 0.9 < np.std(plain) < 1.1


def drizzled(tools, rng, scale, side):
    """A mosaic of ``side`` arcsec without sources, of four turned dithers of white noise."""
    shape = (int(side / 0.11) + 20,) * 2
    level = 0.5 * 1e-12 / tools.SR
    images = []
    for _ in range(4):
        wcs = north_up_wcs(tools.CENTER, 0.11 * u.arcsec, shape)
        wcs.wcs.crpix = wcs.wcs.crpix + rng.uniform(-3, 3, 2)
        angle = np.radians(10.0)
        wcs.wcs.pc = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        images.append(tools.as_ccd(level * rng.normal(size=shape), wcs, level))
    n = int(side / scale)
    return drizzle_images(images, north_up_wcs(tools.CENTER, scale * u.arcsec, (n, n))).image


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "white"), [(0.11, 1.4), (0.06, 2.1)])
def test_errors_on_mosaics_are_the_scatter_of_fits_of_nothing(tools, scale, white):
    """Drizzled dithers, whose neighboring pixels share what they see (Fruchter & Hook 2002, sec. 7)."""
    rng = np.random.default_rng(8)
    sky = tools.places(*tools.lattice(rng, 9, 2.7, 0.3))
    pulls, plain, chi2 = [], [], []
    for k in range(10):
        mosaic = drizzled(tools, rng, scale, 26.0)
        result = tools.measured(mosaic, sky)
        pulls.append(result.snr)
        chi2.append(result.chi2)
        if k < 3:
            plain.append(tools.measured(mosaic, sky, errors=tools.WHITE).snr)
    # 810 fits: 2.5 %
    assert np.std(pulls) == pytest.approx(1, abs=0.07)
    assert np.std(plain) > white
    assert 0.85 < np.median(chi2) < 1.05


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.11, 0.06])
def test_a_mosaic_without_room_for_sky_states_its_correlation(tools, scale):
    rng = np.random.default_rng(9)
    pulls = []
    for _ in range(100):
        mosaic = drizzled(tools, rng, scale, 19 * scale)
        pulls.append(tools.measured(mosaic, tools.places([0.0])).snr[0])
    # 7 % by the number of draws
    assert np.std(pulls) == pytest.approx(1, abs=0.2)
    total = stated_correlation(mosaic.meta["noise_correction"]).sum()
    assert total == pytest.approx(mosaic.meta["noise_correction"] ** 2)


def test_wrong_sigmas_do_not_matter(tools):
    rng = np.random.default_rng(1)
    sky = tools.positions(rng, 20, 7.0)
    image = tools.picture(sky, np.zeros(20), (150, 150), sigma=1.0, rng=rng)
    result = tools.measured(image, sky)
    image.uncertainty.array[:] = 0.2
    other = tools.measured(image, sky)
    assert_allclose(result.flux_err, other.flux_err, rtol=1e-3)
    # and without any the noise of the image is taken
    image.uncertainty = None
    other = tools.measured(image, sky)
    assert other.meta["measured_noise"]
    assert_allclose(other.flux_err, result.flux_err, rtol=0.01)


def test_blended_covariance_is_the_dense_inverse(tools):
    rng, shape = np.random.default_rng(8), (70, 70)
    sky = tools.positions(rng, 12, 1.2)
    image = tools.picture(sky, np.zeros(12), shape, sigma=1.0, rng=rng)
    sigma = image.uncertainty.array
    sigma[:] = rng.uniform(0.5, 2, shape)
    result = tools.measured(image, sky, errors=tools.WHITE)
    light = [tools.render(sky[k : k + 1], [1.0], tools.LO, image.wcs, shape) for k in range(12)]
    design = np.reshape(light / sigma, (12, -1))
    area = pixel_area_map(image.wcs, shape)
    assert area.std() / area.mean() < 1e-6
    covariance = np.linalg.inv(design @ design.T)
    scale = np.sqrt(np.diag(covariance))
    got = result.covariance.toarray() / scale[:, None] / scale
    assert_allclose(got, covariance / scale[:, None] / scale, atol=2e-3)
    assert_allclose(result.flux_err.value, scale, rtol=2e-3)
    # the fluxes are those of dense least squares
    flux = covariance @ design @ (image.data / sigma).ravel()
    assert_allclose(result.flux.value / scale, flux / scale, atol=0.01)


def direct_sandwich(bank, inverse_sigma, correlation):
    """A^T W C W A by the direct convolution of whole images, in double precision."""
    images = stamps_of(bank, inverse_sigma.shape) * inverse_sigma
    spread = [scipy.ndimage.convolve(image, correlation, mode="constant") for image in images]
    return scipy.sparse.csr_array(np.einsum("iyx,jyx->ij", images, np.stack(spread)))


@pytest.mark.parametrize("max_bytes", [1.5e9, 1e4])
def test_errors_are_those_of_the_direct_convolution(tools, monkeypatch, max_bytes):
    # blends, an edge, masked pixels, and noise that is correlated over several pixels; with
    # little memory in several blocks
    monkeypatch.setattr("miricigale.photometry.templates.templates._PART", 5000)
    rng = np.random.default_rng(21)
    shape = (150, 160)
    wcs = north_up_wcs(tools.CENTER, 0.06 * u.arcsec, shape)
    sky = tools.positions(rng, 50, 4.6)
    noise = scipy.ndimage.gaussian_filter(rng.normal(size=shape), 1.3)
    mask = rng.random(shape) < 0.1
    image = tools.as_ccd(noise, wcs, noise.std(), mask=mask)
    options = {"background_order": 0, "memory": MemorySettings(max_bytes=max_bytes)}
    found = tools.measured(image, sky, **options)
    assert found.noise_correlation.shape[0] >= 7
    seen = []

    def direct(*args, **options):
        expected = direct_sandwich(*args[:3])
        scale = np.sqrt(expected.diagonal())
        found, projection = sandwich_matrix(*args, **options)
        difference = (found - expected).toarray()
        seen.append(np.abs(difference / scale[:, None] / scale).max())
        return expected, projection

    monkeypatch.setattr("miricigale.photometry.fit.template_fit.sandwich_matrix", direct)
    truth = tools.measured(image, sky, **options)
    assert seen[0] < 1e-6
    assert_allclose(found.flux.value, truth.flux.value, rtol=1e-12)
    assert_allclose(found.flux_err.value, truth.flux_err.value, rtol=1e-6)


def test_common_parameters_like_dense_least_squares():
    rng = np.random.default_rng(2)
    design = rng.normal(size=(400, 8))
    data = rng.normal(size=400)
    noise = scipy.linalg.toeplitz(0.6 ** np.arange(400))
    a, g = design[:, :6], design[:, 6:]
    fit = LinearFit(scipy.sparse.csr_array(a.T @ a), a.T @ data, a.T @ g, g.T @ g, g.T @ data)
    inverse = np.linalg.inv(design.T @ design)
    solution = inverse @ design.T @ data
    assert_allclose(np.concatenate([fit.flux, fit.common]), solution, rtol=1e-10)
    full = scipy.sparse.csr_array(np.ones((6, 6)))
    options = {"core": 10.0, "halo": 10.0, "pattern": full}
    xy = rng.random((6, 2))
    [(covariance, common)], _ = fit.covariances(xy, [None], **options)
    assert_allclose(covariance.toarray(), inverse[:6, :6], atol=1e-12)
    assert_allclose(common, inverse[6:, 6:], atol=1e-12)
    filling = (scipy.sparse.csr_array(a.T @ noise @ a), a.T @ noise @ g, g.T @ noise @ g)
    [(covariance, common)], blending = fit.covariances(xy, [filling], **options)
    expected = inverse @ design.T @ noise @ design @ inverse
    assert_allclose(covariance.toarray(), expected[:6, :6], atol=1e-12)
    assert_allclose(common, expected[6:, 6:], atol=1e-12)
    assert_allclose(blending, np.sqrt(np.diag(inverse)[:6] * np.diag(a.T @ a)), rtol=1e-10)


def test_white_noise_has_no_correlation():
    rng = np.random.default_rng(0)
    image = 1.3 * rng.normal(size=(300, 300))
    ones, none = np.ones(image.shape), np.zeros(image.shape, bool)
    found = noise_correlation(image, ~none, ones)
    assert found.shape == (1, 1)
    assert_allclose(found, 1.3**2, rtol=0.02)
    refuses("'usable' must be 100 pixels or more", noise_correlation, image, none, ones)


def test_scatter_of_faint_sources_is_absolute_of_bright_ones_relative():
    faint = np.array([0.1, 0.2, 0.3])
    curve = measured_curve("miri.f770w", faint, faint + [1.0, -1.0, 1.0], 3, "median_abs")
    assert_allclose([curve.flux, curve.error], [[0.2], [1.0]])
    bright = np.array([1.0, 10.0, 100.0])
    curve = measured_curve("miri.f770w", bright, bright * [1.02, 1.02, 0.99], 3, "median_abs")
    assert_allclose([curve.flux, curve.error], [[10.0], [0.2]])
