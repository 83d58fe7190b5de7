"""Scenes through a PSF that varies over the field."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel

from helpers import scenes
from helpers.errors import refuses
from helpers.scenes import FILTER, light, make_scene
from miricigale.instrument import aperture, imager_wcs
from miricigale.psf import miri_psf_grid
from miricigale.scene import Cutout, Scene

CORNERS = [(0, 0), (99, 0), (0, 89), (99, 89)]


def grid_of(psfs, places):
    data = np.stack([psf.data for psf in psfs])
    return GriddedPSFModel(NDData(data, meta={"grid_xypos": places, "oversampling": 4}))


@pytest.fixture(scope="module")
def grid():
    return grid_of([scenes.gaussian_psf(sigma) for sigma in (0.8, 1.0, 1.2, 1.6)], CORNERS)


def test_galaxies_widen_by_the_local_psf(wcs, grid):
    """Variances add: the galaxy's and the mixture's of the PSFs at its center."""
    catalog = scenes.make_catalog(wcs, 60.0, 30.0, profile="sersic", radius=0.4, index=0.5)
    image = light(make_scene(catalog, wcs, grid, enclosed=0.99999))
    assert image.sum() == pytest.approx(10, rel=1e-4)
    y, x = np.mgrid[:90, :100]
    variance = [np.average(d**2, weights=image) for d in (x - 60, y - 30)]
    a, b = 60 / 99, 30 / 89
    weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    own = (0.4 / 0.11) ** 2 / (2 * np.log(2))
    mixture = np.dot(weights, np.square([0.8, 1.0, 1.2, 1.6]))
    np.testing.assert_allclose(variance, own + mixture + 1 / 12, rtol=3e-3)


def test_many_places_and_the_lines_between_them(wcs):
    """On both sides of an inner row and column of PSFs, on them, and beyond the last ones."""
    places = [(x, y) for y in (10, 41.3, 80) for x in (15.2, 49.5, 70, 95)]
    grid = grid_of([scenes.gaussian_psf(0.9 + 0.05 * (k % 5)) for k in range(12)], places)
    x = [49.3, 49.5, 49.9, 30.0, 97.0, 5.0, 82.1]
    y = [41.1, 60.0, 41.3, 41.5, 5.0, 70.2, 84.9]
    flux = np.arange(10.0, 80.0, 10.0)
    scene = Scene(scenes.make_catalog(wcs, x, y, flux=flux), filter=FILTER, wcs=wcs, psf=grid)
    yy, xx = np.mgrid[:90, :100]
    expected = sum(grid.evaluate(xx, yy, f, a, b) for f, a, b in zip(flux, x, y, strict=True))
    image = light(scene)
    # on a line the splines' width of a node rounds off the bend of the weights
    np.testing.assert_allclose(image, expected, atol=6e-4 * expected.max())
    off = np.hypot(xx - 49.9, yy - 41.3) > 12
    off &= np.hypot(xx - 49.5, yy - 60.0) > 12
    np.testing.assert_allclose(image[off], expected[off], atol=5e-5 * expected.max())
    assert scene.truth["flux_in_image"].value.sum() == pytest.approx(image.sum(), rel=1e-6)


def test_alike_psfs_are_one_psf(wcs, psf):
    """Points, galaxies and stamps of images, some over the edge."""
    grid = grid_of([psf] * 4, CORNERS)
    x, y = [20.3, 99.2, 50.0, 3.0], [15.2, 44.5, 70.9, 88.0]
    shapes = {"radius": [0, 0.8, 0, 0.2], "index": 4.0}
    shapes["profile"] = ["point", "sersic", "cutout", "sersic"]
    catalog = scenes.make_catalog(wcs, x, y, **shapes)
    stamps = {3: Cutout(np.ones((7, 9)), pixel_scale=0.08 * u.arcsec)}
    kind = {"filter": FILTER, "wcs": wcs, "cutouts": stamps}
    one, many = Scene(catalog, psf=psf, **kind), Scene(catalog, psf=grid, **kind)
    np.testing.assert_allclose(light(many), light(one), atol=1e-9 * light(one).max())
    flux = [scene.truth["flux_in_image"].value for scene in (many, one)]
    np.testing.assert_allclose(*flux, rtol=1e-9)


def test_each_part_of_a_galaxy_has_the_psf_of_its_own_place(wcs, grid):
    """A stamp with three lit pixels, far apart, is three points."""
    stamp = np.zeros((301, 601))
    lit, shares = [(150, 20), (40, 300), (260, 590)], [0.5, 0.3, 0.2]
    for place, share in zip(lit, shares, strict=True):
        stamp[place] = share
    kind = {"filter": FILTER, "wcs": wcs, "psf": grid}
    catalog = scenes.make_catalog(wcs, 50.0, 45.0, profile="cutout")
    stamps = {1: Cutout(stamp, pixel_scale=0.01 * u.arcsec)}
    image = light(Scene(catalog, cutouts=stamps, **kind))
    yy, xx = np.mgrid[:90, :100]
    expected = 0
    for (row, column), share in zip(lit, shares, strict=True):
        place = 50 + (column - 300) / 11, 45 + (row - 150) / 11
        expected = expected + grid.evaluate(xx, yy, 10 * share, *place)
    np.testing.assert_allclose(image, expected, atol=1e-3 * expected.max())


def test_the_imagers_psfs_belong_to_their_subarray():
    field = SkyCoord(53.13440, -27.83444, unit="deg")
    kind = {"fov": 3 * u.arcsec, "oversampling": 2, "n_psfs": 4}
    grid = miri_psf_grid(FILTER, subarray="SUB64", **kind)
    wcs = imager_wcs(field, 30 * u.deg, subarray="SUB64")
    catalog = scenes.make_catalog(wcs, 30.2, 20.7)
    scene = make_scene(catalog, wcs, grid)
    image = light(scene)
    ny, nx = aperture("SUB64").shape
    yy, xx = np.mgrid[:ny, :nx]
    expected = grid.evaluate(xx, yy, 10.0, float(scene.truth["x"][0]), float(scene.truth["y"][0]))
    # but for the edge of the PSF's array
    inner = np.s_[10:32, 20:42]
    np.testing.assert_allclose(image[inner], expected[inner], atol=1e-4 * expected.max())
    assert scene.render().meta["psf_includes"] == ["jitter", "cruciform", "pixel", "ipc"]
    wcs = imager_wcs(field, 30 * u.deg, subarray="SUB128")
    match = "'psf' must be a grid of places on this image, got those"
    refuses(match, make_scene, scenes.make_catalog(wcs, 30.2, 20.7), wcs, grid)
