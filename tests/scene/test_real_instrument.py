import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from photutils.psf import ImagePSF

from miricigale.instrument import Exposure, pixel_area_map, pixel_to_sky
from miricigale.psf import miri_psf
from miricigale.scene import Scene, read_catalog

POINTING = SkyCoord(53.13440 * u.deg, -27.83444 * u.deg)


@pytest.mark.parametrize(
    ("subarray", "pattern"),
    [("FULL", "cycling-medium"), ("BRIGHTSKY", "4-point"), ("SUB256", "ceers")],
)
def test_stars_through_subarrays_dithers_and_angles(subarray, pattern):
    """Where the full spherical transformation puts them, at each dither of its own position angle."""
    roll = {"ceers": 0.0, "4-point": 107.0, "cycling-medium": 251.3}[pattern] * u.deg
    base = Exposure("miri.f1500w", n_groups=10, subarray=subarray, pointing=POINTING, roll=roll)
    one = base.dithered(pattern, 2)[1]
    ny, nx = one.shape
    x, y = np.array([0.4 * nx, 0.9 * nx]) + 0.3, np.array([0.8 * ny, 0.2 * ny]) + 0.2
    catalog = read_catalog("catalog.goodss")[:2]
    catalog["sky"] = pixel_to_sky(x, y, one.pointing, roll, subarray=subarray)
    catalog["profile"] = "point"
    catalog["miri.f1500w"] = [100.0, 300.0] * u.uJy
    psf = miri_psf("miri.f1500w", fov=5 * u.arcsec)
    scene = Scene(catalog, filter="miri.f1500w", wcs=one.wcs, psf=psf)
    truth, image = scene.truth, scene.render()
    assert image.shape == (ny, nx)
    np.testing.assert_allclose(truth["x"], x, atol=1e-3)
    np.testing.assert_allclose(truth["y"], y, atol=1e-3)
    light = image.data * pixel_area_map(one.wcs, image.shape) * 1e12
    for x0, y0, flux in zip(x, y, (100.0, 300.0), strict=True):
        yy, xx = np.mgrid[round(y0) - 6 : round(y0) + 7, round(x0) - 6 : round(x0) + 7]
        star = ImagePSF(psf.data, oversampling=psf.oversampling, x_0=x0, y_0=y0, flux=flux)(xx, yy)
        np.testing.assert_allclose(light[yy, xx], star, atol=2e-3 * star.max())
