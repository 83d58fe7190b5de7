"""PSFs from stars: a known PSF comes back from simulated, dithered, noisy images."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, NDData, StdDevUncertainty
from astropy.table import Table
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.scenes import tan_wcs
from miricigale.psf import encircled_energy, fwhm, miri_psf, psf_from_stars

SIZE, SCALE = 260, 0.1109
# far enough apart for the wings of the neighbors to matter little
SPACING = 78
DITHERS = [(0, 0), (6.5, 3.25), (-5.75, 4.5), (5.25, -6.75), (-3, -6.5), (1.5, 7.25), (-7, 0.75)]
RADII = [0.2, 0.3, 0.5, 1.0, 1.5] * u.arcsec


@pytest.fixture(scope="module")
def truth():
    return miri_psf("miri.f770w", fov=11 * u.arcsec)


@pytest.fixture(scope="module")
def field(truth):
    """Nine stars of peak signal-to-noise 50 to 170 at seven dithers; positions 0.2 pixel off."""
    rng = np.random.default_rng(5)
    grid = SIZE / 2 + SPACING * np.arange(-1, 2)
    base = np.array([(x, y) for x in grid for y in grid], float) + rng.uniform(-3, 3, (9, 2))
    flux = rng.uniform(2e4, 2e5, 9)
    images, tables = [], []
    y, x = np.mgrid[:SIZE, :SIZE]
    for dx, dy in DITHERS:
        data = np.zeros((SIZE, SIZE))
        for (x0, y0), f in zip(base + (dx, dy), flux, strict=True):
            part = np.s_[max(0, int(y0) - 50) : int(y0) + 51, max(0, int(x0) - 50) : int(x0) + 51]
            data[part] += truth.evaluate(x[part], y[part], f, x0, y0)
        sigma = np.sqrt(20**2 + data)
        data += rng.normal(0, sigma)
        wcs = tan_wcs((SIZE, SIZE), SCALE)
        wcs.wcs.crpix += dx, dy
        images.append(CCDData(data, unit="DN/s", uncertainty=StdDevUncertainty(sigma), wcs=wcs))
        places = base + (dx, dy) + rng.normal(0, 0.2, (9, 2))
        tables.append(Table({"x": places[:, 0], "y": places[:, 1]}))
    sky = SkyCoord(*images[0].wcs.all_pix2world(base, 0).T, unit="deg")
    return images, tables, Table({"sky": sky})


@pytest.fixture(scope="module")
def measured(truth, field):
    images, tables, _ = field
    return psf_from_stars(images, tables, pixel_scale=SCALE * u.arcsec, enclosed=truth)


def test_width_and_energy_come_back(truth, measured):
    assert fwhm(measured).value == pytest.approx(fwhm(truth).value, rel=0.01)
    gauss = fwhm(truth, method="gaussian").value
    assert fwhm(measured, method="gaussian").value == pytest.approx(gauss, rel=0.01)
    assert_allclose(encircled_energy(measured, RADII), encircled_energy(truth, RADII), atol=0.005)


def test_image_stands_as_the_truth_does(truth, measured):
    y, x = np.mgrid[-14:15, -14:15] * 0.5
    a, b = (p.evaluate(x, y, 1.0, 0.0, 0.0) for p in (truth, measured))
    assert np.abs(a - b).max() < 0.015 * a.max()
    # the hexagonal halo, not its mirror image
    halo = np.hypot(x, y) > 2.5
    likeness = np.corrcoef(a[halo], b[halo])[0, 1]
    assert likeness > 0.98
    assert likeness > np.corrcoef(a[halo], b[:, ::-1][halo])[0, 1]


def test_meta_says_where_it_comes_from(measured):
    meta = measured.meta
    assert (meta["n_images"], meta["n_stamps"], meta["n_left_out"]) == (7, 63, 0)
    assert measured.frame == "detector"
    assert measured.includes == ("jitter", "cruciform", "pixel", "ipc")
    assert measured.pixel_scale.value == pytest.approx(SCALE)
    assert measured.data.shape == (91, 91)
    # what the truth has within the stamp
    assert 0.9 < measured.enclosed < 0.97


def test_sky_positions_serve_all_images_and_bad_pixels_are_left_out(truth, field, measured):
    images, _, sky = field
    spoilt = []
    for image in images:
        data, mask = image.data.copy(), np.zeros(image.shape, bool)
        data[40:190:37, 45:190:31] = np.nan
        mask[52:190:41, 47:190:29] = True
        data[mask] = 1e6
        spoilt.append(CCDData(data, unit="DN/s", mask=mask, wcs=image.wcs))
    psf = psf_from_stars(spoilt, sky, enclosed=truth, frame="detector")
    assert psf.pixel_scale.value == pytest.approx(SCALE, rel=1e-6)
    assert psf.meta["n_stamps"] == 63
    assert_allclose(encircled_energy(psf, RADII), encircled_energy(measured, RADII), atol=0.01)


def test_stars_near_edges_are_counted(truth, field):
    images, tables, _ = field
    table = tables[0].copy()
    table.add_row((3.0, 100.0))
    table.add_row((np.nan, 100.0))
    psf = psf_from_stars(images[0], table, pixel_scale=SCALE * u.arcsec)
    assert (psf.meta["n_stamps"], psf.meta["n_left_out"]) == (9, 2)
    # relative to the stamp if nothing else is given
    assert psf.enclosed == pytest.approx(1, abs=1e-6)


def test_refuses(field):
    images, tables, sky = field
    scale, bare = {"pixel_scale": SCALE * u.arcsec}, NDData(images[0].data)
    for given, options, match in (
        (([], tables), {}, "'images' must be at least one image"),
        (([images[0].data], tables), scale, r"'images' must be NDData .* got ndarray"),
        ((bare, tables[0]), {}, "'pixel_scale' must be given for images without world"),
        ((bare, sky), scale, "'stars' must be 'x' and 'y' for images without a WCS"),
        ((images, tables[:2]), {}, "'stars' must be a table with 'sky', or one with"),
        ((bare, Table({"a": [1]})), scale, "'stars' must be tables with 'x' and 'y', or 'sky'"),
        ((bare, tables[0][:3]), scale, "'stars' must be at least 4 with stamps on the images"),
        ((bare, tables[0]), {"fov": 0.3 * u.arcsec, **scale}, "'fov' must be at least 7 pixels"),
        ((bare, tables[0]), {"enclosed": 1.2, **scale}, "'enclosed' must be above 0 and at most 1"),
    ):
        refuses(match, psf_from_stars, *given, **options)
