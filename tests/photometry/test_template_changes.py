"""Templates that may change: what is open, the fit with it, and the errors of fluxes by it and by the PSF."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import fftconvolve

from helpers.light import gaussian, gaussian_image
from helpers.mosaics import stamps_of
from helpers.scenes import catalog_at
from miricigale.photometry import (
    ErrorSettings,
    ForcedPhotometer,
    SourceTemplates,
    detect_sources,
)
from miricigale.photometry.detection.cutouts import Cutout
from miricigale.photometry.shapes.shapes import not_fitted
from miricigale.photometry.templates.template_changes import TemplateChanges
from miricigale.psf import MatchingKernel

# a Gaussian profile has n = 0.5 and R_e = 1.1774 sigma
HALF = np.sqrt(2 * np.log(2))


#: A profile as template; its pixels are not looked at.
PROFILE = Cutout(np.ones((1, 1)), (0, 0), convolved=False)


def record(sigma, widths, *, point=0.0):
    """A Gaussian profile of rms ``sigma`` pixels whose parameters are known to ``widths``."""
    found = not_fitted(1)
    found["parameters"] = [120.2, 69.7, np.log(HALF * sigma), np.log(0.5), 0.0, 0.0]
    found["covariance"] = np.diag(np.square([0.0, *widths]))
    found["point"], found["light"] = point, 1.0
    return found[0]


@pytest.fixture(scope="module")
def changes():
    """PSFs of rms 1.5 and 4 pixels."""
    return TemplateChanges(gaussian_image(41, 1.5), gaussian_image(61, 4.0), 0.0)


def below(cutout, sigma):
    """The source, as a Gaussian of rms ``sigma`` at the image's resolution, on the pixels of a cutout."""
    y, x = np.indices(cutout.data.shape)
    return gaussian(x + cutout.origin[1] - 120.2, y + cutout.origin[0] - 69.7, sigma)


def own(change, sigma):
    """Change of ln flux of an isolated source of rms ``sigma`` at the image's resolution."""
    cut = below(change.cutout, sigma)
    return np.sum(cut * change.cutout.data) / np.sum(cut**2) - change.light


def test_an_unknown_size_costs_what_the_closed_form_says(changes):
    # T of width w fits data of the width w0 with 2 w^2 / (w^2 + w0^2) of the flux, so that
    # d ln flux / d ln s = s^2 / (s^2 + psf^2) at w = w0
    for sigma in (2.0, 5.0):
        found, noise = changes.of(PROFILE, record(sigma, [0, 0, 0.02, 0, 0, 0]), 1e-3)
        # the second is what the mean of all sizes has more than the middle one
        assert [one.fixed for one in found] == [False, True][: len(found)]
        assert noise == 0
        expected = 0.02 * sigma**2 / (sigma**2 + 16)
        assert abs(own(found[0], np.hypot(sigma, 4))) == pytest.approx(expected, rel=0.01)
    # a shift costs nothing to first order
    assert changes.of(PROFILE, record(3.0, [0.1, 0, 0, 0, 0, 0]), 3e-3)[0] == []


def test_changes_that_do_not_matter_are_left_out(changes):
    one = record(3.0, [0.01, 0.02, 0.05, 0, 0.01, 0.02])
    # position, of which there are two, moves no flux
    for least, n in ((1e-3, 3), (0.01, 1)):
        found, _ = changes.of(PROFILE, one, least)
        assert sum(not change.fixed for change in found) == n
    assert changes.of(PROFILE, one, 1.0)[0] == []


def test_between_point_and_profile_the_other_counts_by_its_probability(changes):
    (chosen, mean), _ = changes.of(PROFILE, record(4.0, np.zeros(6), point=0.1), 1e-6)
    (point, mean_of_point), _ = changes.of(None, record(4.0, np.zeros(6), point=0.9), 1e-6)
    # a choice of probability 0.1: mean 0.1 and variance 0.1 * 0.9 of the difference
    assert [one.fixed for one in (chosen, mean, mean_of_point)] == [False, True, True]
    expected = 0.3 * (below(chosen.cutout, 4.0) - below(chosen.cutout, np.sqrt(32.0)))
    for one in (chosen, point):
        # of either sign
        found = one.cutout.data * np.sign(np.sum(one.cutout.data * expected))
        assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())
    assert_allclose(mean.cutout.data, expected * 0.1 / 0.3, atol=1e-3 * np.abs(expected).max())
    assert_allclose(mean_of_point.cutout.data, -mean.cutout.data, atol=1e-8)


def test_the_mean_of_possible_sizes_is_another_template(changes):
    """ln sigma of normal distribution: the mean template is that of all draws."""
    width = 0.25
    found, _ = changes.of(PROFILE, record(4.0, [0, 0, width, 0, 0, 0]), 1e-3)
    assert [one.fixed for one in found] == [False] * (len(found) - 1) + [True]
    mean = found[-1].cutout
    # by Gauss-Hermite quadrature
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    drawn = [below(mean, np.hypot(4.0 * np.exp(width * one), 4.0)) for one in nodes]
    expected = np.tensordot(weights / weights.sum(), drawn, axes=1) - below(mean, np.sqrt(32.0))
    assert_allclose(mean.data, expected, atol=0.1 * np.abs(expected).max())
    assert_allclose(mean.data.sum(), 0, atol=1e-3)


def test_noise_of_the_image_in_the_core(changes):
    """A template that is the image all over: the noise of its light and of its fit."""
    image = gaussian_image(51, 3.0)
    rest = Cutout(image, (45, 95))
    # a profile of no light, all of the image being the rest
    template = Cutout(
        np.zeros((3, 3)), (69, 119), 1e-8 * image.size, convolved=False, correction=rest
    )
    one = record(3.0, np.zeros(6))
    found, noise = changes.of(template, one, 1e-6)
    assert found == []
    # drawn: unit light from noisy pixels, blurred to the resolution, fitted to the true template
    blur = gaussian_image(51, np.sqrt(16 - 1.5**2))
    true = fftconvolve(image, blur, "same")
    rng = np.random.default_rng(3)
    ratio = []
    for _ in range(1500):
        drawn = image + rng.normal(0, 1e-4, image.shape)
        fitted = fftconvolve(drawn / drawn.sum(), blur, "same")
        ratio.append(np.sum(fitted * true) / np.sum(fitted**2))
    assert np.sqrt(noise) == pytest.approx(np.std(ratio), rel=0.06)


def test_sizes_differ_between_bands():
    free = TemplateChanges(gaussian_image(41, 1.5), gaussian_image(61, 4.0), 0.05)
    (change,), _ = free.of(PROFILE, record(3.0, np.zeros(6)), 1e-6)
    assert abs(own(change, 5.0)) == pytest.approx(0.05 * 9 / 25, rel=0.01)
    # a point has no size
    assert free.of(None, record(3.0, np.zeros(6), point=1.0), 1e-6)[0] == []


def test_a_nucleus_that_the_other_band_lacks_does_not_bias_an_image(tools):
    """A galaxy with a fifth of its light in a point that the high-resolution image does not show."""
    rng, sky, wide = np.random.default_rng(4), tools.places([0.02], [0.03]), 0.4
    high, low = tools.pair(sky, np.array([80.0]), np.array([wide]), (150, 83), (0.02, 0.01), rng)
    point = tools.picture(sky, np.array([20.0]), (83, 83))
    low.data = low.data + point.data
    prior = high, *detect_sources(high, threshold=3.0)
    ratio = []
    for scatter in (None, 0.1):
        photometer = ForcedPhotometer(
            tools.kernel, template="cutout", errors=settings(size_scatter=scatter)
        )
        result = photometer.measure(low, *prior)
        ratio.append(result.flux[np.argmax(result.flux)].value / 100)
    # a Gaussian of variance a fitted to one of variance b: 2 a / (a + b) of its flux
    a, b = wide**2 + tools.LO**2, tools.LO**2
    assert_allclose(ratio[0], 0.8 + 0.2 * 2 * a / (a + b), rtol=0.01)
    assert_allclose(ratio[1], 1.0, rtol=0.01)


@pytest.fixture(scope="module")
def blend(tools):
    """Three galaxies, two of them blended, on a noisy prior and a noisy image."""
    rng = np.random.default_rng(2)
    sky = tools.places([-4.0, 3.0, 3.55], [0.0, -0.3, 0.3])
    widths, flux = np.array([0.25, 0.3, 0.2]), np.array([20.0, 40.0, 10.0])
    high, low = tools.pair(sky, flux, widths, (260, 150), (0.15, 0.05), rng)
    return low, high, *detect_sources(high)


def settings(**options):
    return ErrorSettings(**{"psf_error": 0.0, "correlated_noise": False, **options})


def test_terms_add_in_quadrature_and_are_columns(tools, blend):
    plain = ForcedPhotometer(tools.kernel, errors=settings()).measure(*blend)
    result = ForcedPhotometer(tools.kernel, errors=settings(psf_error=0.024)).measure(*blend)
    terms = [result.flux_err_noise, result.flux_err_template, result.flux_err_psf]
    # peaks of the noise have no flux of which a part could be wrong
    assert all(np.all(term[result.flux > 1 * u.uJy] > 0) for term in terms)
    assert_allclose(result.flux_err, np.sqrt(sum(term**2 for term in terms)), rtol=1e-12)
    assert_allclose(np.sqrt(result.covariance.diagonal()), result.flux_err.value, rtol=1e-9)
    assert_allclose(plain.flux_err_noise, result.flux_err_noise, rtol=1e-12)
    assert_allclose(plain.flux_err_template, result.flux_err_template, rtol=1e-12)
    assert np.all(plain.flux_err_psf == 0)
    table = result.to_table("miri.f770w")
    for name, term in zip(("noise", "template", "psf"), terms, strict=True):
        assert np.all(table[f"miri.f770w_err_{name}"] == term)
    # the errors of the PSF go together
    more = (result.covariance - plain.covariance).toarray()
    psf = result.flux_err_psf.value
    pair = plain.covariance.toarray() != 0
    assert_allclose(more[pair], np.outer(psf, psf)[pair], rtol=1e-6)


def test_a_blend_is_solved_as_by_dense_algebra(tools, blend, monkeypatch):
    """Least squares with the changes as columns and their priors as rows, all pixels written out."""
    from miricigale.photometry.fit import forced

    kept = []
    original = forced.package

    def keep(fit, *args, **kwargs):
        # its images become the result's
        kept.extend([fit, fit.arrays.flux * fit.inverse_sigma, fit.inverse_sigma.copy()])
        return original(fit, *args, **kwargs)

    monkeypatch.setattr(forced, "package", keep)
    result = ForcedPhotometer(tools.kernel, errors=settings(size_scatter=0.1)).measure(*blend)
    exact = ForcedPhotometer(tools.kernel, errors=settings(size_scatter=None)).measure(*blend)
    fit, white_data, inverse = kept[:3]
    templates, changes = (
        stamps_of(one, blend[0].shape).reshape(len(one.order), -1)
        for one in (fit.bank, fit.free.bank)
    )
    templates = templates[fit.rows]
    member = fit.bank.order[fit.rows]
    assert len(fit.free.owner) >= 4
    columns = fit.free.basis.T @ np.concatenate([templates, changes])
    inverse = inverse.ravel()
    prior = np.sqrt(fit.free.prior)
    # the prior of each change is the flux of the fit with exact templates
    known = np.unique(1 / prior[len(member) :])
    assert np.all(np.min(np.abs(known[:, None] / exact.flux.value - 1), axis=1) < 1e-6)
    white = np.concatenate([(columns * inverse).T, np.diag(prior)])
    data = np.concatenate([white_data.ravel(), np.zeros(len(columns))])
    solution = np.linalg.lstsq(white, data)[0]
    # of a template that is an image the power of its noise is taken off besides
    assert_allclose(result.flux.value[member], solution[: len(member)], rtol=5e-4)
    covariance = np.linalg.inv(white.T @ white)
    noise = covariance @ (columns * inverse) @ (columns * inverse).T @ covariance
    # noise of a template that is an image changes its light, and all that the fit makes of it
    scaled = templates * inverse
    core = result.flux.value[member] * np.sqrt(fit.free.noise)
    core = covariance[:, : len(member)] @ scaled @ scaled.T @ np.diag(core)
    assert np.count_nonzero(fit.free.noise) == 1
    template = covariance @ np.diag(prior**2) @ covariance + core @ core.T
    for found, expected in ((result.flux_err_noise, noise), (result.flux_err_template, template)):
        error = np.sqrt(expected.diagonal()[: len(member)])
        assert_allclose(found.value[member], error, rtol=1e-3)
    # what is not known of one galaxy is an error of its neighbor too
    assert np.all(result.flux_err >= result.flux_err_noise)


@pytest.mark.parametrize("width", [0.0, 0.25])
def test_psf_error_is_what_a_wide_psf_does(tools, width):
    """Fluxes with a PSF that is too wide, against the stated error for that width."""
    sky = tools.places([0.0])
    image = tools.picture(sky, [100.0], (150, 150), width=np.hypot(tools.LO, width))
    psfs = (gaussian_image(101, one / tools.FINE) for one in (tools.HI, 1.03 * tools.LO))
    kernel = MatchingKernel.from_psfs(*psfs, pixel_scale=tools.FINE * u.arcsec)
    form = {"half_light_radius": HALF * width * u.arcsec, "sersic_index": 0.5}
    catalog = catalog_at(sky, profile="sersic" if width else "point", **form)
    template = "sersic" if width else "psf"
    photometer = ForcedPhotometer(kernel, template=template, errors=settings(psf_error=0.03))
    result = photometer.measure(image, catalog=catalog)
    # Gaussians: d ln flux / d ln width is 1 for points
    assert result.flux.value[0] - 100 == pytest.approx(result.flux_err_psf.value[0], rel=0.05)


@pytest.mark.slow
def test_pulls_of_galaxies_on_a_noisy_prior(tools):
    """Gaussian galaxies and points of template signal-to-noise 8 to 40, bright on the image."""
    rng = np.random.default_rng(12)
    sky = tools.places(*tools.lattice(rng, 7, 5.0, 0.3))
    size = np.where(rng.random(49) < 0.25, 0.0, rng.uniform(0.1, 0.35, 49))
    flux = 10 ** rng.uniform(0.7, 1.4, 49) * (0.4 + size) / 0.5
    pulls, exact = [], []
    photometer = ForcedPhotometer(tools.kernel, errors=tools.WHITE)
    errors = ErrorSettings(correlated_noise=False, size_scatter=None)
    plain = photometer.replace(errors=errors)
    for _ in range(3):
        high, low = tools.pair(sky, flux, size, (660, 360), (2.5, 0.1), rng)
        segments, found = detect_sources(high)
        templates = SourceTemplates.from_images(high, segments, found, psf=tools.kernel.source)
        index, distance, _ = sky.match_to_catalog_sky(found["sky"])
        near = distance < 0.3 * u.arcsec
        for kept, how in ((pulls, photometer), (exact, plain)):
            result = how.measure(low, templates=templates)
            off = result.flux.value[index] - flux
            kept.append((off / result.flux_err.value[index])[near])
    pulls, exact = np.concatenate(pulls), np.concatenate(exact)
    assert len(pulls) > 100
    assert np.std(exact) > 3
    assert 0.8 < np.std(pulls) < 1.25
