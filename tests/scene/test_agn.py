"""A point source at the center of a galaxy, as a share of its light or on top of it."""

import astropy.units as u
import numpy as np
import pytest

from helpers import scenes
from miricigale.scene import SceneFlags

GALAXY = {"profile": "sersic", "radius": 0.5, "index": 2.0, "ratio": 0.4, "angle": 40.0}


def light(catalog, wcs, psf, **options):
    scene = scenes.make_scene(catalog, wcs, psf, **options)
    return scenes.light(scene), scene.truth


def test_a_share_of_the_light_is_in_the_point(wcs, psf):
    galaxy = scenes.make_catalog(wcs, 50.3, 44.6, **GALAXY)
    point = scenes.make_catalog(wcs, 50.3, 44.6)
    host, _ = light(galaxy, wcs, psf)
    nucleus, _ = light(point, wcs, psf)
    galaxy["frac_agn"] = [0.3]
    image, truth = light(galaxy, wcs, psf, agn="frac_agn")
    np.testing.assert_allclose(image, 0.7 * host + 0.3 * nucleus, atol=1e-6 * image.max())
    assert truth["flux_total"].value.tolist() == [10.0]
    assert truth["flux_agn"].value.tolist() == [3.0]
    assert truth["flux_in_image"].value[0] == pytest.approx(image.sum(), rel=1e-6)
    assert truth["profile"].tolist() == ["sersic"]


def test_a_flux_comes_on_top(wcs, psf):
    galaxy = scenes.make_catalog(wcs, [30.0, 70.0, 60.0], [40.0, 50.0, 20.0], **GALAXY)
    host, alone = light(galaxy, wcs, psf)
    assert alone["flux_agn"].value.tolist() == [0, 0, 0]
    galaxy["agn"] = [0.004, np.nan, 0.0] * u.mJy
    image, truth = light(galaxy, wcs, psf, agn="agn")
    nucleus, _ = light(scenes.make_catalog(wcs, 30.0, 40.0, flux=4.0), wcs, psf)
    np.testing.assert_allclose(image, host + nucleus, atol=1e-6 * image.max())
    np.testing.assert_allclose(truth["flux_total"].value, [14, 10, 10])
    np.testing.assert_allclose(truth["flux_agn"].value, [4, 0, 0])


def test_what_is_cut_is_of_all_light(wcs, psf):
    """A profile of index 8 cut at 4 arcsec loses a few per cent, a bright point in it less."""
    steep = {**GALAXY, "index": 8.0, "radius": 1.0}
    galaxy = scenes.make_catalog(wcs, 50.0, 45.0, **steep)
    cut = int(SceneFlags.CUT_PROFILE)
    galaxy["frac_agn"] = [0.99]
    for agn, expected in ((None, cut), ("frac_agn", 0)):
        _, truth = light(galaxy, wcs, psf, max_radius=4 * u.arcsec, agn=agn)
        assert truth["flags"][0] & cut == expected
