import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from photutils.psf import ImagePSF

from miricigale.instrument import imager_wcs, north_up_wcs, pixel_area_map, pixel_to_sky
from miricigale.psf import hst_psf, miri_psf
from miricigale.scene import Background, Scene, highres_image, read_catalog

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
    assert set(image.meta["psf_includes"]) == set(psf.meta["includes"])


def test_f160w_of_goodss():
    catalog = read_catalog("catalog.goodss")
    wcs = north_up_wcs(POINTING, 0.06 * u.arcsec, (300, 300))
    psf = hst_psf("wfc3.f160w")
    image = highres_image(catalog, wcs=wcs, psf=psf, seed=1)
    truth = Scene(catalog, filter="wfc3.f160w", wcs=wcs, psf=psf).truth
    signal = (image.data * pixel_area_map(wcs, (300, 300))).sum() * 1e12
    noise = (
        np.sqrt(300 * 300)
        * (image.uncertainty.array * pixel_area_map(wcs, (300, 300))).mean()
        * 1e12
    )
    assert abs(signal - truth["flux_in_image"].value.sum()) < 4 * noise
    with pytest.raises(ValueError, match="'psf' must be on the pixels of the WCS"):
        highres_image(catalog, wcs=imager_wcs(POINTING, ROLL), psf=psf, seed=1)
