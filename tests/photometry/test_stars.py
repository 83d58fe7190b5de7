"""Stars of the images correct the PSFs: Gaussian light in closed form, with a kernel that is wrong."""

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.light import gaussian_image
from helpers.scenes import tan_wcs
from miricigale.photometry import ForcedFlags, ForcedPhotometer, SourceTemplates
from miricigale.photometry.commands.page import star_texts
from miricigale.psf import MatchingKernel

SIGMA = 0.004


def wrong_kernel(tools, factor):
    """The kernel to a PSF that is ``factor`` times as wide as that of the images."""
    psfs = (gaussian_image(67, width / tools.FINE) for width in (tools.HI, factor * tools.LO))
    return MatchingKernel.from_psfs(*psfs, pixel_scale=tools.FINE * u.arcsec)


@pytest.fixture(scope="module")
def stars(tools):
    """Isolated stars on an image with white noise."""
    rng = np.random.default_rng(8)
    dx, dy = tools.lattice(rng, 5, 5.5, 0.05)
    sky, flux = tools.places(dx, dy), 10 ** rng.uniform(0.8, 1.6, 25)
    sigma = SIGMA / (0.11**2 * tools.SR * 1e12)
    image = tools.picture(sky, flux, (300, 300), sigma=sigma, rng=rng)
    return image, QTable({"id": np.arange(25) + 500, "sky": sky}), flux


def test_two_stars_do_not_decide_by_themselves(tools, stars):
    image, catalog, _ = stars
    kernel = wrong_kernel(tools, 1.06)
    for n, kind in ((2, "model"), (5, "terms")):
        photometer = ForcedPhotometer(kernel, template="psf", psf_stars=None)
        result = photometer.measure(image, catalog=catalog[:n])
        assert (result.meta["image_psf"], result.meta["image_stars"]) == (kind, n)
        # the page does not say that no correction fits where none was tried
        assert star_texts(result.psf_stars.fits["image"])[0] == {2: "untried", 5: "terms"}[n]
    asked = photometer.replace(psf_stars=True).measure(image, catalog=catalog[:2])
    assert asked.meta["image_psf"] == "terms"
    none = photometer.measure(image, catalog=tools.places([9.0], [0.2]))
    assert (none.meta["image_psf"], none.meta["image_stars"]) == ("model", 0)


def test_stars_that_no_psf_describes_are_said_to_be_so(tools, stars):
    """Two stars on an image whose errors are stated thirty times too small."""
    image, catalog, _ = stars
    small = CCDData(image, uncertainty=type(image.uncertainty)(image.uncertainty.array / 30))
    photometer = ForcedPhotometer(wrong_kernel(tools, 1.06), template="psf", psf_stars=None)
    fit = photometer.measure(small, catalog=catalog[:2]).psf_stars.fits["image"]
    assert star_texts(fit) == ["untried", "unlike"]


@pytest.mark.parametrize("factor", [0.95, 1.06])
def test_a_width_that_is_wrong_is_found_and_mended(tools, stars, factor):
    image, catalog, flux = stars
    kernel = wrong_kernel(tools, factor)
    before = ForcedPhotometer(kernel, template="psf").measure(image, catalog=catalog)
    after = ForcedPhotometer(kernel, template="psf", psf_stars=True).measure(image, catalog=catalog)
    # a Gaussian that is fitted with one a times as wide: 2 a^2 / (1 + a^2) of its flux
    assert_allclose(np.median(before.flux.value / flux), 2 * factor**2 / (1 + factor**2), rtol=5e-3)
    assert_allclose(np.median(after.flux.value / flux), 1, atol=0.01)
    meta = after.meta
    assert meta["image_psf"] != "model"
    assert meta["image_stars"] == 20
    assert meta["image_psf_chi2"][1] < meta["image_psf_chi2"][0] - 100
    assert meta["image_psf_width"][0] == pytest.approx(1 / factor - 1, abs=0.02)
    # what remains is stated, and goes into the errors of all alike
    assert abs(np.median(after.flux.value / flux) - 1) < 3 * meta["image_psf_err"] < 0.1
    expected = meta["image_psf_err"] * after.flux.value
    assert_allclose(after.flux_err_psf.value, expected, rtol=0.05)
    assert np.median(after.chi2) < 1.3 < np.median(before.chi2)
    made = SourceTemplates.from_catalog(catalog)
    same = ForcedPhotometer(kernel, psf_stars=True).measure(image, templates=made)
    assert_allclose(same.flux.value, after.flux.value, rtol=1e-6)


def test_a_psf_that_is_right_stays_as_it_is(tools, stars):
    image, catalog, flux = stars
    plain = tools.measured(image, catalog)
    asked = tools.measured(image, catalog, psf_stars=True)
    assert asked.meta["image_psf"] == "model"
    fit = asked.psf_stars.fits["image"]
    assert star_texts(fit) == ["model"]
    # a Gaussian on white noise, in closed form: the flux over sigma sqrt(4 pi) width / pixel
    table = asked.psf_stars.table
    table = table[np.asarray(table["on"]) == "image"]
    true = flux[np.asarray(table["id"]) - 500] / (SIGMA * np.sqrt(4 * np.pi) * tools.LO / 0.11)
    assert len(table) > 10
    assert_allclose(table["snr"], true, rtol=0.03)
    # 2 percent of the light are allowed for on top of the noise
    assert 0.7 < fit.chi2["model"] / fit.dof < 1.1
    assert asked.psf_stars.kernel is tools.kernel
    assert_allclose(asked.flux.value, plain.flux.value, rtol=1e-12)
    assert_allclose(asked.flux_err.value, plain.flux_err.value, rtol=1e-12)


def test_galaxies_and_crowded_stars_are_no_stars(tools):
    rng = np.random.default_rng(3)
    dx, dy = tools.lattice(rng, 5, 5.5, 0.05)
    sky, flux = tools.places(dx, dy), np.full(25, 20.0)
    # ten are wider, five have a neighbor
    width = np.where(np.arange(25) < 10, 1.3 * tools.LO, tools.LO)
    near = tools.places(dx[10:15] + 0.5, dy[10:15])
    sigma = SIGMA / (0.11**2 * tools.SR * 1e12)
    image = tools.picture(sky, flux, (300, 300), width=width, sigma=sigma, rng=rng)
    more = tools.picture(near, flux[:5] / 2, (300, 300))
    image = image.add(more.data * image.unit, handle_meta="first_found")
    image.wcs = more.wcs
    both = tools.places(np.append(dx, dx[10:15] + 0.5), np.append(dy, dy[10:15]))
    catalog = QTable({"id": np.arange(30), "sky": both})
    found = tools.measured(image, catalog, psf_stars=True).psf_stars.table
    assert sorted(found["id"]) == list(range(15, 25))


def test_a_psf_that_changes_over_the_field(tools):
    """Stars from 0.94 to 1.06 of the width from one side to the other."""
    rng = np.random.default_rng(5)
    dx, dy = tools.lattice(rng, 6, 5.0, 0.05)
    sky, flux = tools.places(dx, dy), np.full(36, 30.0)
    width = tools.LO * (1 + 0.06 * dx / 15)
    sigma = SIGMA / (0.11**2 * tools.SR * 1e12)
    image = tools.picture(sky, flux, (320, 320), width=width, sigma=sigma, rng=rng)
    catalog = QTable({"id": np.arange(36), "sky": sky})
    options = {"template": "psf", "psf_stars": True}
    result = ForcedPhotometer(tools.kernel, **options).measure(image, catalog=catalog)
    assert len(result.psf_stars.kernel) == 4
    one = ForcedPhotometer(tools.kernel, template="psf").measure(image, catalog=catalog)
    slopes = [np.polyfit(dx / 15, r.flux.value / flux, 1)[0] for r in (one, result)]
    # sources that are wider than the PSF are fitted too faint
    assert slopes[0] == pytest.approx(-0.06, abs=0.01)
    assert abs(slopes[1]) < 0.01


def test_repeated_pixels_are_measured_once(tools, stars):
    image, catalog, _ = stars
    plain = tools.measured(image, catalog)
    for unit, share in ((image.unit, 1.0), (u.Jy, 1e-9)):
        data = np.kron(image.data, np.ones((2, 2))) * share
        noise = type(image.uncertainty)(np.full(data.shape, image.uncertainty.array[0, 0] * share))
        wcs = tan_wcs(data.shape, 0.055)
        wcs = image.wcs.deepcopy()
        wcs.wcs.crpix, wcs.wcs.cdelt = 2 * image.wcs.wcs.crpix - 0.5, image.wcs.wcs.cdelt / 2
        # cut in the middle of a pixel
        large = CCDData(data, unit=unit, wcs=wcs, uncertainty=noise)[1:, 3:]
        with pytest.warns(UserWarning, match="has each of its pixels 2 x 2 times"):
            result = tools.measured(large, catalog)
        assert result.meta["repeated_pixels"] == 2
        inner = np.isfinite(plain.flux.value) & (plain.coverage > 0.999) & (result.coverage > 0.999)
        if unit == image.unit:
            assert_allclose(result.flux[inner], plain.flux[inner], rtol=1e-4)
            assert_allclose(result.flux_err[inner], plain.flux_err[inner], rtol=0.02)


def test_saturated_cores_are_masked_and_said(tools):
    sky, flux = tools.places([-4.0, 0.0, 4.0]), np.array([30.0, 30.0, 30.0])
    prior = tools.picture(sky, flux, (260, 260), scale=tools.FINE, width=tools.HI, sigma=1e-3)
    image = tools.picture(sky, flux, (200, 200), sigma=1e-3)
    y, x = np.indices(prior.shape)
    xy = np.stack(prior.wcs.world_to_pixel(sky), axis=1)
    distance = [np.hypot(x - a, y - b) for a, b in xy]
    segments = sum((k + 1) * (one < 8) for k, one in enumerate(distance))
    whole = prior.data.copy()
    # a hole, a flat top, and one that is as it should be
    prior.mask = distance[0] < 1.6
    prior.data[distance[1] < 2.5] = whole[distance[1] < 2.5].min()
    catalog = QTable({"id": [1, 2, 3], "sky": sky})
    result = ForcedPhotometer(tools.kernel).measure(image, prior, segments, catalog)
    flagged = result.flags & int(ForcedFlags.SATURATED) > 0
    assert flagged.tolist() == [True, True, False]
    assert_allclose(result.flux.value, flux, rtol=0.01)
