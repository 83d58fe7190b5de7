import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from photutils.psf import ImagePSF

from miricigale.instrument import Exposure, imager_wcs, pixel_area_map, pixel_to_sky
from miricigale.psf import miri_psf
from miricigale.scene import Background, Scene, read_catalog

POINTING = SkyCoord(53.13440 * u.deg, -27.83444 * u.deg)
ROLL = 107 * u.deg


def test_goodss_through_the_imager():
    catalog = read_catalog("catalog.goodss")
    catalog["miri.f1500w"] = np.nan_to_num(catalog["nircam.f444w"])
    # one bright star where the full spherical transformation puts pixel (150.3, 99.6)
    catalog = catalog[:60]
    x, y = np.full(60, -300.0), np.linspace(0, 250, 60)
    x[0], y[0] = 150.3, 99.6
    x[1:] = np.linspace(-20, 260, 59)
    catalog["sky"] = pixel_to_sky(x, y, POINTING, ROLL, subarray="SUB256")
    catalog["profile"][0] = "point"
    catalog["miri.f1500w"][0] = 1e4 * u.uJy
    wcs = imager_wcs(POINTING, ROLL, subarray="SUB256")
    psf = miri_psf("miri.f1500w", fov=10 * u.arcsec)
    background = Background.low_zodi("miri.f1500w")
    scene = Scene(catalog, filter="miri.f1500w", wcs=wcs, psf=psf, background=background)
    image, truth = scene.render(), scene.truth
    assert (truth["x"][0], truth["y"][0]) == (
        pytest.approx(150.3, abs=1e-3),
        pytest.approx(99.6, abs=1e-3),
    )
    area = pixel_area_map(wcs, image.shape)
    light = (image.data - background.image(wcs, image.shape)) * area * 1e12
    assert light.sum() == pytest.approx(truth["flux_in_image"].value.sum(), rel=1e-5)
    y, x = np.mgrid[80:120, 130:170]
    star = ImagePSF(psf.data, oversampling=psf.oversampling, x_0=150.3, y_0=99.6, flux=1e4)(x, y)
    np.testing.assert_allclose(light[80:120, 130:170], star, atol=1e-3 * star.max())
    assert set(image.meta["psf_includes"]) == set(psf.includes)


@pytest.mark.parametrize("subarray", ["FULL", "BRIGHTSKY", "SUB256"])
@pytest.mark.parametrize("pattern", ["ceers", "4-point", "cycling-medium"])
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
