"""PSFs from stars: a known PSF comes back from simulated, dithered, noisy images."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, NDData, StdDevUncertainty
from astropy.table import Table
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import map_coordinates, spline_filter

from helpers.errors import refuses
from helpers.scenes import tan_wcs
from miricigale.psf import encircled_energy, fwhm, miri_psf, psf_from_stars
from miricigale.psf._core import cubic_splines, interpolate

SIZE, SCALE = 260, 0.1109
# far enough apart for the wings of the neighbors to matter little
SPACING = 78
DITHERS = [(0, 0), (6.5, 3.25), (-5.75, 4.5), (5.25, -6.75), (-3, -6.5), (1.5, 7.25), (-7, 0.75)]
RADII = [0.2, 0.3, 0.5, 1.0, 1.5] * u.arcsec


def test_splines_are_those_of_scipy_also_at_the_edges():
    rng = np.random.default_rng(2)
    images, at = rng.normal(size=(3, 8, 11)), rng.uniform(-1.5, [[8.5], [11.5]], (2, 500))
    coefficients = np.stack([spline_filter(one) for one in images], axis=-1)
    expected = [map_coordinates(one, at, mode="constant") for one in images]
    assert_allclose(cubic_splines(coefficients, *at), expected, atol=1e-12)


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
def model(truth):
    """A model that is 6 % too narrow and has too little light in its wings."""
    y, x = (np.indices(truth.data.shape) - len(truth.data) // 2) / 1.0
    narrow = interpolate(truth.data, x * 1.06 + len(x) // 2, y * 1.06 + len(x) // 2) * 1.06**2
    return truth.replace(narrow * truth.data.sum() / narrow.sum())


@pytest.fixture(scope="module")
def measured(model, field):
    images, tables, _ = field
    return psf_from_stars(images, tables, model)


@pytest.mark.slow
def test_width_and_energy_come_back(truth, model, measured):
    assert fwhm(model) < 0.96 * fwhm(truth)
    assert fwhm(measured).value == pytest.approx(fwhm(truth).value, rel=0.01)
    gauss = fwhm(truth, method="gaussian").value
    assert fwhm(measured, method="gaussian").value == pytest.approx(gauss, rel=0.01)
    found, true = (np.asarray(encircled_energy(one, RADII)) for one in (measured, truth))
    # within the stamps, and of all light
    assert_allclose(found / found[-1] * true[-1], true, atol=0.005)
    assert_allclose(found, true, atol=0.01)
    # what point sources are wrong by is in the error
    flux = [np.sum(one.data * truth.data) / np.sum(one.data**2) - 1 for one in (model, measured)]
    assert abs(flux[0]) > 0.05
    assert abs(flux[1]) < min(0.01, 2.5 * measured.meta["flux_err"])


@pytest.mark.slow
def test_meta_says_where_it_comes_from(measured):
    meta = measured.meta
    assert (meta["n_images"], meta["n_stamps"], meta["n_left_out"]) == (7, 63, 0)
    assert meta["correction"] in ("terms", "effective")
    assert 0.03 < meta["width"] < 0.12
    assert measured.includes == ("jitter", "cruciform", "pixel", "ipc")


def test_stars_that_confirm_the_model_leave_it(truth, field):
    images, tables, _ = field
    psf = psf_from_stars(images[:1], tables[:1], truth)
    assert psf.meta["correction"] == "model"
    assert_array_equal(psf.data, truth.data)


@pytest.mark.slow
def test_sky_positions_serve_all_images_and_bad_pixels_are_left_out(model, field, measured):
    images, _, sky = field
    spoilt = []
    for image in images:
        data, mask = image.data.copy(), np.zeros(image.shape, bool)
        data[40:190:37, 45:190:31] = np.nan
        mask[52:190:41, 47:190:29] = True
        data[mask] = 1e6
        spoilt.append(
            CCDData(data, unit="DN/s", mask=mask, wcs=image.wcs, uncertainty=image.uncertainty)
        )
    psf = psf_from_stars(spoilt, sky, model)
    assert psf.meta["n_stamps"] == 63
    assert_allclose(encircled_energy(psf, RADII), encircled_energy(measured, RADII), atol=0.01)


def test_stars_near_edges_are_counted(truth, field):
    images, tables, _ = field
    table = tables[0].copy()
    table.add_row((3.0, 100.0))
    table.add_row((np.nan, 100.0))
    psf = psf_from_stars(images[0], table, truth)
    assert (psf.meta["n_stamps"], psf.meta["n_left_out"]) == (9, 2)


def test_refuses(truth, field):
    images, tables, sky = field
    bare = NDData(images[0].data)
    for given, match in (
        ((bare, sky), "'stars' must be 'x' and 'y' for images without a WCS"),
        ((images, tables[:2]), "'stars' must be positions on the sky, or a table for each"),
        ((bare, Table({"a": [1]})), "'stars' must be tables with 'x' and 'y', 'sky', or"),
        ((bare, tables[0][:0]), "'stars' must be at least one with its stamp on an image"),
    ):
        refuses(match, psf_from_stars, *given, truth)
    even = truth.replace(truth.data[:-1, :-1])
    refuses("'psf' must be square and odd", psf_from_stars, bare, tables[0], even)
