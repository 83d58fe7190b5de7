import astropy.units as u
import numpy as np
import pytest
import sep
from astropy.convolution import Gaussian2DKernel
from astropy.nddata import CCDData, Cutout2D
from numpy.testing import assert_allclose
from photutils.aperture import (
    SkyCircularAperture,
    SkyEllipticalAnnulus,
    SkyEllipticalAperture,
    SkyRectangularAperture,
)
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from helpers.errors import refuses
from miricigale.instrument import north_up_wcs
from miricigale.photometry import (
    aperture_correction,
    aperture_photometry,
    encircled_flux,
    flux_scaling,
    source_extractor_photometry,
)
from miricigale.psf import encircled_energy, gaussian_psf


@pytest.fixture(scope="module")
def stars(tools):
    rng = np.random.default_rng(3)
    sky, flux = tools.places(*tools.lattice(rng, 5, 4.5, 0.02)), np.geomspace(50, 500, 25)
    form = {"scale": tools.FINE, "sigma": 0.02 / (tools.FINE**2 * tools.SR * 1e12), "rng": rng}
    return sky, flux, tools.picture(sky, flux, (400, 400), **form)


def test_circles_hold_the_light_of_a_gaussian(tools, stars):
    sky, flux, image = stars
    table = aperture_photometry(image, sky, 1.2 * u.arcsec)
    inside = 1 - np.exp(-0.5 * (0.6 / tools.LO) ** 2)
    pull = (table["flux"].value - inside * flux) / table["flux_err"].value
    assert np.abs(pull).max() < 4
    assert_allclose(table["flux_err"].value, 0.02 * np.sqrt(np.pi) * 0.6 / 0.06, rtol=1e-6)
    assert_allclose(table["coverage"], 1.0)
    # apertures of photutils, on the sky and in pixels, and on a cutout
    circles = SkyCircularAperture(sky, 0.6 * u.arcsec)
    for aperture in (circles, circles.to_pixel(image.wcs)):
        same = aperture_photometry(image, aperture)
        assert_allclose(same["flux"].value, table["flux"].value, rtol=1e-6)
    part = Cutout2D(image.data * image.unit, sky[12], 4 * u.arcsec, wcs=image.wcs)
    alone = aperture_photometry(part, circles)
    assert_allclose(alone["flux"].value[12], table["flux"].value[12], rtol=1e-6)
    refuses("'diameter' must be given with positions", aperture_photometry, image, sky)
    refuses("'diameter' must be left out", aperture_photometry, image, circles, 1 * u.arcsec)
    off = aperture_photometry(image, tools.places([3600.0]), 1 * u.arcsec)
    assert np.isnan(off["flux"][0])
    assert off["coverage"][0] == 0


def test_apertures_have_their_angle_where_east_is_on_the_right(tools):
    """A mirrored image of the same sky has the same light in an ellipse, a rectangle and a ring."""
    place = tools.places([0.0])
    n = 101
    axis = np.arange(n) - 50.0
    # position angle 60 deg, where east is left: columns fall, rows grow
    along = -axis * np.sin(np.pi / 3) + axis[:, None] * np.cos(np.pi / 3)
    across = axis * np.cos(np.pi / 3) + axis[:, None] * np.sin(np.pi / 3)
    data = np.exp(-0.5 * ((along / 12.0) ** 2 + (across / 3.0) ** 2))
    wcs = north_up_wcs(place[0], 0.1 * u.arcsec, (n, n))
    mirrored = wcs.deepcopy()
    mirrored.wcs.cdelt[0] *= -1.0
    size = {"w": 2.0 * u.arcsec, "h": 0.6 * u.arcsec}
    ellipse = {"a": 1.0 * u.arcsec, "b": 0.3 * u.arcsec, "theta": 60.0 * u.deg}
    ring = {"a_in": 0.5 * u.arcsec, "a_out": 1.5 * u.arcsec, "b_out": 0.5 * u.arcsec}
    apertures = [
        SkyEllipticalAperture(place, **ellipse),
        SkyRectangularAperture(place, **size, theta=60.0 * u.deg),
        SkyEllipticalAnnulus(place[0], **ring, theta=60.0 * u.deg),
    ]
    for aperture in apertures:
        straight = aperture_photometry(CCDData(data, unit="uJy", wcs=wcs), aperture)
        turned = aperture_photometry(CCDData(data[:, ::-1], unit="uJy", wcs=mirrored), aperture)
        assert_allclose(turned["flux"].value, straight["flux"].value, rtol=1e-6)
    # along the light: more than in an ellipse across it
    wrong = SkyEllipticalAperture(place, **(ellipse | {"theta": 150.0 * u.deg}))
    image = CCDData(data, unit="uJy", wcs=wcs)
    right = aperture_photometry(image, apertures[0])["flux"]
    assert np.all(right > aperture_photometry(image, wrong)["flux"])


def test_source_extractor_like_fluxes(tools, stars):
    sky, flux, image = stars
    # a background is taken off, and that of rings about each source
    image = image.add(3.0 * u.MJy / u.sr, handle_meta="first_found")
    table = source_extractor_photometry(image)
    index, separation, _ = sky.match_to_catalog_sky(table["sky"])
    assert separation.arcsec.max() < 0.05
    best = np.maximum(table["flux_auto"] / 0.94, table["flux_aper"] / 0.8)
    assert_allclose(table["flux_best"].value, best.value)
    # Kron's ellipse at 2.5 radii holds most of the light
    assert np.all(table["flux_auto"].value[index] > 0.9 * flux)
    inside = 1 - np.exp(-0.5 * (0.93 / tools.LO) ** 2)
    assert_allclose(table["flux_aper"].value[index] / flux, inside, rtol=0.05)


def test_without_weights_the_noisier_part_has_more_detections(tools, stars):
    """As another program has it: one threshold for all, and zeros for data where there are none."""
    _, _, image = stars
    noise = gaussian_filter(np.random.default_rng(1).normal(size=(400, 400)), 1.5)
    noise[:, 300:] *= 2
    empty = np.add.outer(np.arange(400), 2 * np.arange(400)) > 1000
    image = tools.as_ccd(np.where(empty, np.nan, noise), image.wcs, noise.std())
    data = np.where(empty, 0.0, noise)
    mesh = sep.Background(data, bw=64, bh=64, fw=6, fh=6)
    kernel = Gaussian2DKernel(5 / np.sqrt(8 * np.log(2)), x_size=9, y_size=9).array
    kind = {"err": mesh.globalrms, "minarea": 5, "filter_kernel": kernel, "filter_type": "conv"}
    found = sep.extract(data - mesh.back(), 1.5, **kind)
    table = source_extractor_photometry(image, weighted=False, stated_on=None)
    # those at the threshold may differ
    assert len(table) == pytest.approx(len(found), rel=0.1)
    x = table["x_centroid"].value
    assert np.count_nonzero(x > 300) > 2 * np.count_nonzero(x < 200)


def test_encircled_energy_and_scale_of_point_sources(tools, stars):
    sky, flux, image = stars
    radii = [0.2, 0.5, 1.0] * u.arcsec
    table = encircled_flux(image, sky, flux * u.uJy, radii)
    assert_allclose(table["median"], 1 - np.exp(-0.5 * (radii.value / tools.LO) ** 2), atol=0.003)
    fwhm = tools.LO * np.sqrt(8 * np.log(2)) * u.arcsec
    psf = gaussian_psf(fwhm, pixel_scale=0.06 * u.arcsec, fov=5 * u.arcsec)
    factor, error = flux_scaling(image, sky, flux * u.uJy, psf)
    assert abs(factor - 1) < 4 * error < 0.02
    factor, _ = flux_scaling(image, sky, flux / 0.9 * u.uJy, psf)
    assert_allclose(factor, 1 / 0.9, rtol=0.01)
    expected = 1 / (1 - np.exp(-0.5 * (0.5 / tools.LO) ** 2))
    assert_allclose(aperture_correction(psf, 0.5 * u.arcsec), expected, rtol=2e-3)
    refuses("'flux' must be positive", encircled_flux, image, sky, -flux * u.uJy, radii)


def extended(tools, scale, half=9.0):
    """Nine sources of two integrated Gaussians each, the same light on pixels of any size."""
    n = round(2 * half / scale)
    wcs = north_up_wcs(tools.CENTER, scale * u.arcsec, (n, n))
    edge = (np.arange(n + 1) - n / 2) * scale
    dx, dy = tools.lattice(np.random.default_rng(4), 3, 5.0, 0.2)
    flux = np.geomspace(20, 200, 9)
    light = np.zeros((n, n))
    for k, total in enumerate(flux):
        for share, wide in ((0.6, 0.25), (0.4, 0.3 + 0.05 * k)):
            column, row = (np.diff(ndtr((edge - at) / wide)) for at in (dx[k], dy[k]))
            light += share * total * row[:, None] * column
    sky = wcs.pixel_to_world(dx / scale + (n - 1) / 2, dy / scale + (n - 1) / 2)
    sigma = 0.01 * scale / 0.06
    area = scale**2 * tools.SR * 1e12
    return sky, flux, light, tools.as_ccd(light / area, wcs, sigma / area)


def test_a_source_has_one_flux_on_any_pixels(tools):
    tables = {}
    for scale in (0.03, 0.06, 0.11):
        sky, flux, light, image = extended(tools, scale)
        table = source_extractor_photometry(image)
        index, separation, _ = sky.match_to_catalog_sky(table["sky"])
        assert len(table) == 9
        assert separation.arcsec.max() < 0.02
        tables[scale] = table[index]
        # AUTO of another program on the same pixels
        kind = {"minarea": max(1, round(5 * (0.06 / scale) ** 2)), "deblend_cont": 1.0}
        found = sep.extract(light, 0.02 * scale / 0.06, **kind)
        x, y, a, b, theta = (found[name] for name in ("x", "y", "a", "b", "theta"))
        radius, _ = sep.kron_radius(light, x, y, a, b, theta, 6.0)
        auto, _, _ = sep.sum_ellipse(light, x, y, a, b, theta, np.maximum(2.5 * radius, 3.5))
        order = np.argsort(auto)
        assert_allclose(tables[scale]["flux_auto"].value, auto[order], rtol=0.02)
        assert np.array_equal(np.argsort(tables[scale]["flux_auto"].value), np.argsort(flux))
    for scale in (0.03, 0.11):
        # errors are those of the same noise
        for name in ("flux_auto", "flux_aper", "flux_best", "flux_aper_err"):
            assert_allclose(tables[scale][name].value, tables[0.06][name].value, rtol=0.01)
    # pixels of the image's own: another isophote and another ring
    _, _, _, image = extended(tools, 0.03)
    own = source_extractor_photometry(image, stated_on=None)
    index = tables[0.03]["sky"].match_to_catalog_sky(own["sky"])[0]
    off = own["flux_auto"].value[index] / tables[0.03]["flux_auto"].value - 1
    assert np.abs(off).max() > 0.01


@pytest.mark.parametrize("width", [0.12, 0.25])
def test_the_pixel_counts_once_in_the_scale(tools, width):
    """Points sharper than the pixels are wide, at all places on them: the scale of the image is 1."""
    sky = tools.places(*tools.lattice(np.random.default_rng(5), 8, 5.0, 0.5))
    flux = np.full(64, 1e3)
    image = tools.picture(sky, flux, (400, 400), width=width, sigma=1e-4)
    fwhm = width * np.sqrt(8 * np.log(2)) * u.arcsec
    psf = gaussian_psf(fwhm, pixel_scale=0.11 * u.arcsec, oversampling=4, fov=5 * u.arcsec)
    factor, error = flux_scaling(image, sky, flux * u.uJy, psf)
    assert abs(factor - 1) < 2 * error < 1.1e-3
    table = encircled_flux(image, sky, flux * u.uJy, [0.3] * u.arcsec)
    correction = aperture_correction(psf, 0.3 * u.arcsec, pixel_scale=0.11 * u.arcsec)
    assert_allclose(table["median"] * correction, 1, atol=0.003)
    # a square of side a is as wide as a Gaussian of a / sqrt(12)
    total = np.hypot(width, 0.11 / np.sqrt(12))
    energy = encircled_energy(psf, 0.4 * u.arcsec, pixel_scale=0.11 * u.arcsec)
    assert_allclose(energy, 1 - np.exp(-0.5 * (0.4 / total) ** 2), rtol=3e-3)
