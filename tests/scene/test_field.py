"""Scenes through a PSF that varies over the field."""

import importlib.util
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel

from miricigale.instrument import aperture, imager_wcs, pixel_area_map
from miricigale.psf import miri_psf_grid
from miricigale.scene import Scene

_spec = importlib.util.spec_from_file_location("scene_tools", Path(__file__).parent / "conftest.py")
tools = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(tools)

FILTER = "miri.f770w"
CORNERS = [(0, 0), (99, 0), (0, 89), (99, 89)]


@pytest.fixture(scope="module")
def grid():
    data = np.stack([tools.gaussian_psf(sigma).data for sigma in (0.8, 1.0, 1.2, 1.6)])
    return GriddedPSFModel(NDData(data, meta={"grid_xypos": CORNERS, "oversampling": 4}))


def light(scene):
    return scene.render().data * pixel_area_map(scene.wcs, scene.render().shape) * 1e12


def test_points_are_what_photutils_evaluates(wcs, grid):
    x, y = [20.3, 49.5, 80.7, -2.0], [15.2, 44.5, 70.9, 50.0]
    catalog = tools.make_catalog(wcs, x, y, flux=[10.0, 20.0, 30.0, 40.0])
    scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=grid)
    yy, xx = np.mgrid[:90, :100]
    expected = sum(
        grid.evaluate(xx, yy, f, a, b)
        for f, a, b in zip((10.0, 20.0, 30.0, 40.0), x, y, strict=True)
    )
    image = light(scene)
    np.testing.assert_allclose(image, expected, atol=2e-5 * expected.max())
    assert scene.truth["flux_in_image"].value.sum() == pytest.approx(image.sum(), rel=1e-6)


def test_galaxies_widen_by_the_local_psf(wcs, grid):
    """Variances add: the galaxy's and the mixture's of the PSFs at its centre."""
    catalog = tools.make_catalog(
        wcs, 60.0, 30.0, profile="sersic", radius=0.4, index=0.5, ratio=1.0
    )
    scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=grid, enclosed=0.99999)
    image = light(scene)
    y, x = np.mgrid[:90, :100]
    total = image.sum()
    assert total == pytest.approx(10, rel=1e-4)
    variance = [np.sum(image * (x - 60) ** 2) / total, np.sum(image * (y - 30) ** 2) / total]
    a, b = 60 / 99, 30 / 89
    weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    own = (0.4 / 0.11) ** 2 / (2 * np.log(2))
    mixture = np.dot(weights, np.square([0.8, 1.0, 1.2, 1.6]))
    np.testing.assert_allclose(variance, own + mixture + 1 / 12, rtol=3e-3)


def test_the_imagers_psfs_belong_to_their_subarray():
    field = SkyCoord(53.13440, -27.83444, unit="deg")
    kind = {"fov": 3 * u.arcsec, "oversampling": 2, "n_psfs": 4}
    grid = miri_psf_grid(FILTER, subarray="SUB64", **kind)
    wcs = imager_wcs(field, 30 * u.deg, subarray="SUB64")
    catalog = tools.make_catalog(wcs, 30.2, 20.7)
    scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=grid)
    image = light(scene)
    ny, nx = aperture("SUB64").shape
    yy, xx = np.mgrid[:ny, :nx]
    expected = grid.evaluate(xx, yy, 10.0, float(scene.truth["x"][0]), float(scene.truth["y"][0]))
    # but for the edge of the PSF's array
    inner = np.s_[10:32, 20:42]
    np.testing.assert_allclose(image[inner], expected[inner], atol=1e-4 * expected.max())
    assert scene.render().meta["psf_includes"] == ["jitter", "cruciform", "pixel", "ipc"]
    wcs = imager_wcs(field, 30 * u.deg, subarray="SUB128")
    with pytest.raises(ValueError, match="'psf' must be a grid of places on this image, got those"):
        Scene(tools.make_catalog(wcs, 30.2, 20.7), filter=FILTER, wcs=wcs, psf=grid)
