"""Sersic light and scenes against GalSim (extra ``galsim``)."""

import astropy.units as u
import numpy as np
import pytest

from helpers import scenes
from miricigale.instrument import pixel_area_map
from miricigale.scene import Scene

galsim = pytest.importorskip("galsim", reason="needs galsim: pip install miricigale[galsim]")

# GalSim's defaults are good to some 1e-3: ask for more than is tested
SHARP = galsim.GSParams(
    folding_threshold=1e-4,
    maxk_threshold=1e-4,
    kvalue_accuracy=1e-6,
    xvalue_accuracy=1e-6,
    maximum_fft_size=32768,
    integration_relerr=1e-8,
    integration_abserr=1e-10,
)


def galaxy(n, radius, ratio, angle):
    """Half-light radius along the major axis; ``angle`` in deg from +x toward +y."""
    round_one = galsim.Sersic(n=n, half_light_radius=radius * ratio**0.5, gsparams=SHARP)
    return round_one.shear(q=ratio, beta=angle * galsim.degrees)


@pytest.mark.parametrize(
    ("n", "radius", "ratio"),
    [
        (0.5, 0.3, 0.5),
        (1.0, 0.05, 0.5),
        (1.0, 0.5, 0.2),
        (2.5, 0.3, 0.7),
        (4.0, 0.2, 0.8),
        (4.0, 0.6, 0.4),
        (6.0, 0.3, 0.6),
    ],
)
def test_galaxies_through_a_psf(n, radius, ratio):
    """The cusp through PSF and pixel, on a turned WCS: every pixel to 0.1 % of the brightest."""
    rng = np.random.default_rng(int(100 * n + 1000 * radius))
    dx, dy = rng.uniform(-0.5, 0.5, 2)
    pa = 25.0
    wcs = scenes.tan_wcs(pa=pa)
    catalog = scenes.make_catalog(
        wcs,
        49.5 + dx,
        44.5 + dy,
        profile="sersic",
        radius=radius,
        index=n,
        ratio=ratio,
        angle=70.0,
    )
    psf = scenes.gaussian_psf(1.0)
    scene = Scene(
        catalog, filter="miri.f770w", wcs=wcs, psf=psf, enclosed=0.9999, max_radius=30 * u.arcsec
    )
    image = scene.render().data * pixel_area_map(wcs, (90, 100)) * 1e12
    # with +y at 25 deg and east to the left, position angle 70 is 45 deg beyond +y
    model = galsim.Convolve(
        galaxy(n, radius / 0.11, ratio, 90 + 70 - pa), galsim.Gaussian(sigma=1.0, gsparams=SHARP)
    )
    drawn = 10 * model.shift(dx, dy).drawImage(nx=100, ny=90, scale=1.0, dtype=float).array
    np.testing.assert_allclose(image, drawn, atol=1e-3 * drawn.max())
    assert image.sum() == pytest.approx(drawn.sum(), rel=2e-3)
