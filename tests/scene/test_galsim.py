"""Sersic light and scenes against GalSim (extra ``galsim``)."""

import astropy.units as u
import numpy as np
import pytest

from helpers import scenes

galsim = pytest.importorskip("galsim", reason="needs galsim: pip install miricigale[galsim]")

# GalSim's defaults are good to some 1e-3: ask for more than is tested
ACCURACY = {"folding_threshold": 1e-4, "maxk_threshold": 1e-4, "maximum_fft_size": 32768}
ACCURACY |= {"kvalue_accuracy": 1e-6, "xvalue_accuracy": 1e-6}
SHARP = galsim.GSParams(integration_relerr=1e-8, integration_abserr=1e-10, **ACCURACY)


def galaxy(n, radius, ratio, angle):
    """Half-light radius along the major axis; ``angle`` in deg from +x toward +y."""
    round_one = galsim.Sersic(n=n, half_light_radius=radius * ratio**0.5, gsparams=SHARP)
    return round_one.shear(q=ratio, beta=angle * galsim.degrees)


GALAXIES = [(0.5, 0.3, 0.5), (1.0, 0.05, 0.5), (1.0, 0.5, 0.2), (2.5, 0.3, 0.7)]
GALAXIES += [(4.0, 0.2, 0.8), (4.0, 0.6, 0.4), (6.0, 0.3, 0.6)]


@pytest.mark.parametrize(("n", "radius", "ratio"), GALAXIES)
def test_galaxies_through_a_psf(n, radius, ratio):
    """The cusp through PSF and pixel, on a turned WCS: every pixel to 0.1 % of the brightest."""
    rng = np.random.default_rng(int(100 * n + 1000 * radius))
    dx, dy = rng.uniform(-0.5, 0.5, 2)
    pa = 25.0
    wcs = scenes.tan_wcs(pa=pa)
    shape = {"profile": "sersic", "radius": radius, "index": n, "ratio": ratio, "angle": 70.0}
    catalog = scenes.make_catalog(wcs, 49.5 + dx, 44.5 + dy, **shape)
    options = {"enclosed": 0.9999, "max_radius": 30 * u.arcsec}
    scene = scenes.make_scene(catalog, wcs, scenes.gaussian_psf(1.0), **options)
    image = scenes.light(scene)
    # with +y at 25 deg and east to the left, position angle 70 is 45 deg beyond +y
    gaussian = galsim.Gaussian(sigma=1.0, gsparams=SHARP)
    model = galsim.Convolve(galaxy(n, radius / 0.11, ratio, 90 + 70 - pa), gaussian)
    drawn = 10 * model.shift(dx, dy).drawImage(nx=100, ny=90, scale=1.0, dtype=float).array
    np.testing.assert_allclose(image, drawn, atol=1e-3 * drawn.max())
    assert image.sum() == pytest.approx(drawn.sum(), rel=2e-3)
