from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from photutils.psf import ImagePSF

from helpers import scenes
from helpers.errors import refuses
from helpers.light import pixel_gaussian
from helpers.scenes import FILTER, light, make_scene, moments
from miricigale.instrument import pixel_area_map
from miricigale.scene import Background, Scene, SceneFlags
from miricigale.utils.exceptions import MiricigaleWarning

TURNED = scenes.gaussian_psf(frame="sky", angle=40.0 * u.deg)
FINE = scenes.gaussian_psf(pixel_scale=0.06 * u.arcsec)
RED = scenes.gaussian_psf(filter="miri.f2100w")


def test_a_point_source_is_the_psf(wcs, psf):
    catalog = scenes.make_catalog(wcs, [40.37, 60.0], [30.81, 50.5], flux=[10.0, 3.0])
    image = light(make_scene(catalog, wcs, psf))
    y, x = np.mgrid[:90, :100]
    stars = ((40.37, 30.81, 10), (60.0, 50.5, 3))
    expected = sum(psf.evaluate(x, y, flux, x0, y0) for x0, y0, flux in stars)
    np.testing.assert_allclose(image, expected, atol=2e-6 * expected.max())


@pytest.mark.parametrize("oversampling", [1, 3, 4])
def test_placement_to_a_thousandth_of_the_peak(wcs, oversampling):
    # against the closed form, not the sampled PSF
    psf = scenes.gaussian_psf(1.0, oversampling)
    catalog = scenes.make_catalog(wcs, 50.13, 44.62)
    image = light(make_scene(catalog, wcs, psf))
    truth = 10 * np.outer(pixel_gaussian(90, 44.62, 1.0), pixel_gaussian(100, 50.13, 1.0))
    limit = 1e-3 if oversampling > 1 else 2e-2
    np.testing.assert_allclose(image, truth, atol=limit * truth.max())


@pytest.mark.parametrize("parity", [-1, 1])
@pytest.mark.parametrize("pa", [0.0, 35.0, 200.0])
def test_position_angles_land_right(psf, pa, parity):
    wcs = scenes.tan_wcs(pa=pa, parity=parity)
    shape = {"radius": 0.5, "index": 1.0, "ratio": 0.2, "angle": 70.0}
    catalog = scenes.make_catalog(wcs, 50.0, 45.0, profile="sersic", **shape)
    scene = make_scene(catalog, wcs, psf, max_radius=3 * u.arcsec)
    x0, y0, ((xx, xy), (_, yy)) = moments(light(scene))
    theta = 0.5 * np.arctan2(2 * xy, xx - yy)
    assert (x0, y0) == (pytest.approx(50, abs=2e-3), pytest.approx(45, abs=2e-3))
    # the sky position one arcsec along the major axis, through the WCS
    there = catalog["sky"][0].directional_offset_by(70 * u.deg, 1 * u.arcsec)
    dx, dy = np.array(wcs.world_to_pixel(there)) - [50, 45]
    turn = (np.degrees(theta - np.arctan2(dy, dx)) + 90) % 180 - 90
    assert turn == pytest.approx(0, abs=0.2)


def test_distorted_positions_shapes_and_fluxes(psf):
    wcs = scenes.distorted_wcs()
    shape = {"profile": "sersic", "radius": 0.25, "index": 0.5}
    catalog = scenes.make_catalog(wcs, [15.0, 80.0], [20.0, 70.0], **shape)
    scene = make_scene(catalog, wcs, psf)
    truth = scene.truth
    np.testing.assert_allclose(truth["x"], [15, 80], atol=1e-6)
    np.testing.assert_allclose(truth["y"], [20, 70], atol=1e-6)
    assert light(scene).sum() == pytest.approx(truth["flux_in_image"].value.sum(), rel=1e-6)
    # a round galaxy becomes the image of a circle: its second moments through the WCS
    _, _, got = moments(light(scene)[:45, :45])
    own = 0.25 / np.sqrt(2 * np.log(2))
    t = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    around = catalog["sky"][0].directional_offset_by(t * u.rad, own * u.arcsec)
    variance = 2 * np.mean(np.subtract(wcs.world_to_pixel(around), [[15], [20]]) ** 2, axis=1)
    np.testing.assert_allclose(np.diag(got) - 0.85**2 - 1 / 12, variance, rtol=0.03)


def test_light_is_conserved_with_background_and_edges(wcs, psf):
    rng = np.random.default_rng(3)
    ranges = {"x": (-8, 108), "y": (-8, 98), "flux": (0.1, 50), "radius": (0.01, 1.0)}
    ranges |= {"index": (0.3, 8), "ratio": (0.1, 1), "angle": (0, 180)}
    columns = {name: rng.uniform(*ends, 40) for name, ends in ranges.items()}
    catalog = scenes.make_catalog(wcs, profile=rng.choice(["sersic", "point"], 40), **columns)
    background = Background(2 * u.MJy / u.sr, gradient=0.05 / u.arcmin)
    scene = make_scene(catalog, wcs, psf, background=background)
    truth = scene.truth
    area = pixel_area_map(wcs, (90, 100))
    sky = np.sum(background.image(wcs, (90, 100)) * area) * 1e12
    # the background alone would hide an error
    assert light(scene).sum() - sky == pytest.approx(truth["flux_in_image"].value.sum(), rel=1e-5)
    assert np.all(truth["flux_in_image"] <= truth["flux_total"] * (1 + 1e-4))
    inside = (truth["x"] > -0.5) & (truth["x"] < 99.5) & (truth["y"] > -0.5) & (truth["y"] < 89.5)
    np.testing.assert_array_equal((truth["flags"] & SceneFlags.OUTSIDE_IMAGE) == 0, inside)


def test_in_image_flux_is_the_sum_of_each_source_alone(wcs, psf):
    kwargs = {"profile": "sersic", "radius": 0.6, "index": 3.0, "ratio": 0.5, "angle": 30.0}
    x, y = [2.0, 50.0, -3.0], [45.0, 88.0, 40.0]
    truth = make_scene(scenes.make_catalog(wcs, x, y, **kwargs), wcs, psf).truth
    for k in range(3):
        alone = scenes.make_catalog(wcs, x[k], y[k], **kwargs)
        total = light(make_scene(alone, wcs, psf)).sum()
        assert truth["flux_in_image"].value[k] == pytest.approx(total, rel=1e-4)
    edge = SceneFlags.NEAR_EDGE
    assert truth["flags"].tolist() == [edge, edge, SceneFlags.OUTSIDE_IMAGE]


def test_flags_say_what_happened(wcs, psf):
    x, y = [50.0, 20.0, 70.0, 30.0], [45.0, 30.0, 60.0, 60.0]
    columns = {"flux": [10.0, np.nan, 10.0, -1.0], "index": [8.0, 1.0, 20.0, 1.0], "radius": 1.0}
    catalog = scenes.make_catalog(wcs, x, y, profile="sersic", **columns)
    text = f"2 of 4 sources are not painted: fluxes in '{FILTER}' are 1 NaN, 1 negative .*no_flux"
    points = "1 of 4 Sersic profiles are drawn as points: sersic_index is missing or outside"
    with (
        pytest.warns(MiricigaleWarning, match=points),
        pytest.warns(MiricigaleWarning, match=text),
    ):
        scene = make_scene(catalog, wcs, psf, max_radius=4 * u.arcsec)
    truth = scene.truth
    f = SceneFlags
    assert truth["flags"][0] & f.CUT_PROFILE
    assert truth["flags"][1:].tolist() == [f.NO_FLUX, f.DRAWN_AS_POINT, f.NO_FLUX]
    assert truth["profile"].tolist() == ["sersic", "sersic", "point", "sersic"]
    assert truth["flux_in_image"][1] == 0
    assert truth["flux_in_image"][0] < 0.95 * truth["flux_total"][0]
    assert "cut profile" in truth["flags"].info.description


def test_sources_on_the_other_side_of_the_sky_do_no_harm(wcs, psf):
    catalog = scenes.make_catalog(wcs, [50.0, 20.0], [45.0, 30.0])
    catalog["sky"][1] = SkyCoord(233.0, 27.0, unit="deg")
    scene = make_scene(catalog, wcs, psf)
    assert scene.truth["flags"].tolist() == [0, SceneFlags.OUTSIDE_IMAGE]
    assert np.all(np.isfinite(scene.render().data))
    alone = make_scene(catalog[1:], wcs, psf)
    assert not np.any(alone.render().data)


def test_points_alone_are_those_with_a_galaxy(wcs, psf):
    # alone they are added one by one, with a galaxy convolved with it
    x, y = [20.3, 47.9, -1.2, 60.0, 61.5], [31.2, 12.6, 40.4, 60.0, 60.5]
    profiles = ["point"] * len(x) + ["sersic"]
    both = scenes.make_catalog(wcs, [*x, 35.0], [*y, 38.0], profile=profiles, radius=0.3)
    points, galaxy = both[:-1], both[-1:]
    three = [make_scene(one, wcs, psf) for one in (points, galaxy, both)]
    alone, extended, together = (scene.render().data for scene in three)
    # the grid of the transforms is in single precision
    np.testing.assert_allclose(alone + extended, together, rtol=0, atol=3e-7 * alone.max())
    flux = [scene.truth["flux_in_image"].value for scene in three]
    np.testing.assert_allclose(np.append(flux[0], flux[1]), flux[2], rtol=1e-12)


def test_the_same_on_any_number_of_threads(wcs, psf):
    shape = {"profile": "sersic", "radius": 0.5, "index": 4.0, "ratio": 0.4}
    catalog = scenes.make_catalog(wcs, [30.0, 60.0], [40.0, 50.0], **shape)

    def light(n_threads):
        return make_scene(catalog, wcs, psf, n_threads=n_threads).render().data

    alone = light(1)
    np.testing.assert_array_equal(light(3), alone)
    # and with other scenes at the same time
    with ThreadPoolExecutor(2) as pool:
        for image in pool.map(light, (1, 2, 1, 2)):
            np.testing.assert_array_equal(image, alone)


def bare_wcs():
    wcs = scenes.tan_wcs()
    wcs.pixel_shape = None
    return wcs


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"filter": "miri.f1000w"}, "'catalog' must be a table with the columns"),
        ({"psf": np.ones(3)}, "'psf' must be a PSF or model of photutils, .* kernel or a 2D"),
        ({"psf": np.zeros((5, 5))}, "'psf' must be finite, with a positive sum"),
        ({"psf": FINE}, r"pixels of 0\.0600 arcsec where the WCS has 0\.1100"),
        ({"psf": TURNED}, r"turned by 40\.0 deg"),
        ({"psf": RED}, r"'psf' must be one of the filter miri\.f770w, got one"),
        ({"psf": ImagePSF(np.ones((8, 8)), oversampling=4)}, "'psf' must be centered on a node"),
        ({"background": 3.0}, "'background' must be a Background, a Quantity in MJy/sr or a level"),
        ({"background": -3 * u.MJy / u.sr}, r"'level' must be .* not negative, got -3\.0 MJy"),
        ({"wcs": bare_wcs()}, "'wcs' must be a WCS with its pixel_shape"),
        ({"max_radius": -1 * u.arcsec}, r"'max_radius' must be positive, got -1\.0 arcsec"),
    ],
)
def test_refuses(wcs, psf, options, message):
    catalog = scenes.make_catalog(wcs, 50, 45)
    refuses(message, Scene, catalog, **{"filter": FILTER, "wcs": wcs, "psf": psf} | options)


def test_psfs_that_fit(wcs):
    catalog = scenes.make_catalog(wcs, 50, 45)
    make_scene(catalog, scenes.tan_wcs(pa=40.0), TURNED)
    for name in (FILTER, "F770W"):
        make_scene(catalog, wcs, scenes.gaussian_psf(filter=name))
