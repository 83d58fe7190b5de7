from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import Sip
from photutils.psf import ImagePSF

from helpers import scenes
from miricigale.instrument import pixel_area_map
from miricigale.scene import Background, Scene, SceneFlags
from miricigale.utils.exceptions import MiricigaleWarning

FILTER = "miri.f770w"


def light(scene):
    """Light in each pixel (uJy), background included."""
    image = scene.render()
    return image.data * pixel_area_map(scene.wcs, image.shape) * 1e12


def test_a_point_source_is_the_psf(wcs, psf):
    catalog = scenes.make_catalog(wcs, [40.37, 60.0], [30.81, 50.5], flux=[10.0, 3.0])
    image = light(Scene(catalog, filter=FILTER, wcs=wcs, psf=psf))
    y, x = np.mgrid[:90, :100]
    expected = 0
    for x0, y0, flux in ((40.37, 30.81, 10), (60.0, 50.5, 3)):
        expected = expected + ImagePSF(psf.data, oversampling=4, x_0=x0, y_0=y0, flux=flux)(x, y)
    np.testing.assert_allclose(image, expected, atol=2e-6 * expected.max())


@pytest.mark.parametrize("oversampling", [1, 3, 4])
def test_placement_to_a_thousandth_of_the_peak(wcs, oversampling):
    # against the closed form, not the sampled PSF
    psf = scenes.gaussian_psf(1.0, oversampling)
    catalog = scenes.make_catalog(wcs, 50.13, 44.62)
    image = light(Scene(catalog, filter=FILTER, wcs=wcs, psf=psf))
    truth = 10 * np.outer(
        scenes.pixel_gaussian(90, 44.62, 1.0), scenes.pixel_gaussian(100, 50.13, 1.0)
    )
    limit = 1e-3 if oversampling > 1 else 2e-2
    np.testing.assert_allclose(image, truth, atol=limit * truth.max())


@pytest.mark.parametrize("radius", [0.01, 0.05, 0.15, 0.5])
@pytest.mark.parametrize("ratio", [0.1, 0.4, 1.0])
def test_gaussian_galaxy_adds_its_variance(wcs, psf, radius, ratio):
    # position angle 90 deg is along x on a north-up image
    catalog = scenes.make_catalog(
        wcs, 50.3, 44.7, profile="sersic", radius=radius, index=0.5, ratio=ratio, angle=90.0
    )
    image = light(Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, enclosed=0.99999))
    own = radius / 0.11 / np.sqrt(2 * np.log(2))
    truth = 10 * np.outer(
        scenes.pixel_gaussian(90, 44.7, np.hypot(0.85, ratio * own)),
        scenes.pixel_gaussian(100, 50.3, np.hypot(0.85, own)),
    )
    np.testing.assert_allclose(image, truth, atol=1e-3 * truth.max())


def moments(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    x0, y0 = np.sum(image * x) / image.sum(), np.sum(image * y) / image.sum()
    x, y = x - x0, y - y0
    theta = 0.5 * np.arctan2(2 * np.sum(image * x * y), np.sum(image * (x**2 - y**2)))
    return x0, y0, theta


@pytest.mark.parametrize("parity", [-1, 1])
@pytest.mark.parametrize("pa", [0.0, 35.0, 200.0])
def test_position_angles_land_right(psf, pa, parity):
    wcs = scenes.tan_wcs(pa=pa, parity=parity)
    catalog = scenes.make_catalog(
        wcs, 50.0, 45.0, profile="sersic", radius=0.5, index=1.0, ratio=0.2, angle=70.0
    )
    scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, max_radius=3 * u.arcsec)
    x0, y0, theta = moments(light(scene))
    assert (x0, y0) == (pytest.approx(50, abs=2e-3), pytest.approx(45, abs=2e-3))
    # the sky position one arcsec along the major axis, through the WCS
    there = catalog["sky"][0].directional_offset_by(70 * u.deg, 1 * u.arcsec)
    dx, dy = np.array(wcs.world_to_pixel(there)) - [50, 45]
    turn = (np.degrees(theta - np.arctan2(dy, dx)) + 90) % 180 - 90
    assert turn == pytest.approx(0, abs=0.2)


def test_distorted_positions_shapes_and_fluxes(psf):
    wcs = scenes.tan_wcs(pa=20.0)
    a, b = np.zeros((3, 3)), np.zeros((3, 3))
    a[2, 0], b[1, 1] = 1.5e-3, -8e-4  # 0.15 px per px at 50 px from the center
    wcs.wcs.ctype = ["RA---TAN-SIP", "DEC--TAN-SIP"]
    wcs.sip = Sip(a, b, None, None, wcs.wcs.crpix)
    wcs.wcs.set()
    catalog = scenes.make_catalog(
        wcs, [15.0, 80.0], [20.0, 70.0], profile="sersic", radius=0.25, ratio=1.0, index=0.5
    )
    scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=psf)
    truth = scene.truth
    np.testing.assert_allclose(truth["x"], [15, 80], atol=1e-6)
    np.testing.assert_allclose(truth["y"], [20, 70], atol=1e-6)
    assert light(scene).sum() == pytest.approx(truth["flux_in_image"].value.sum(), rel=1e-6)
    # a round galaxy becomes the image of a circle: its second moments through the WCS
    image = light(scene)[:45, :45]
    y, x = np.mgrid[:45, :45]
    own = 0.25 / np.sqrt(2 * np.log(2))
    t = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    around = catalog["sky"][0].directional_offset_by(t * u.rad, own * u.arcsec)
    px, py = wcs.world_to_pixel(around)
    total = image.sum()
    assert np.sum(image * (x - 15) ** 2) / total - 0.85**2 - 1 / 12 == pytest.approx(
        2 * np.mean((px - 15) ** 2), rel=0.03
    )
    assert np.sum(image * (y - 20) ** 2) / total - 0.85**2 - 1 / 12 == pytest.approx(
        2 * np.mean((py - 20) ** 2), rel=0.03
    )


def test_light_is_conserved_with_background_and_edges(wcs, psf):
    rng = np.random.default_rng(3)
    n = 40
    catalog = scenes.make_catalog(
        wcs,
        rng.uniform(-8, 108, n),
        rng.uniform(-8, 98, n),
        flux=rng.uniform(0.1, 50, n),
        profile=rng.choice(["sersic", "point"], n),
        radius=rng.uniform(0.01, 1.0, n),
        index=rng.uniform(0.3, 8, n),
        ratio=rng.uniform(0.1, 1, n),
        angle=rng.uniform(0, 180, n),
    )
    background = Background(2 * u.MJy / u.sr, gradient=0.05 / u.arcmin)
    scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, background=background)
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
    truth = Scene(scenes.make_catalog(wcs, x, y, **kwargs), filter=FILTER, wcs=wcs, psf=psf).truth
    for k in range(3):
        alone = scenes.make_catalog(wcs, x[k], y[k], **kwargs)
        total = light(Scene(alone, filter=FILTER, wcs=wcs, psf=psf)).sum()
        assert truth["flux_in_image"].value[k] == pytest.approx(total, rel=1e-4)
    assert truth["flags"].tolist() == [
        SceneFlags.NEAR_EDGE,
        SceneFlags.NEAR_EDGE,
        SceneFlags.OUTSIDE_IMAGE,
    ]


def test_flags_say_what_happened(wcs, psf):
    catalog = scenes.make_catalog(
        wcs,
        [50.0, 20.0, 70.0, 30.0],
        [45.0, 30.0, 60.0, 60.0],
        flux=[10.0, np.nan, 10.0, -1.0],
        profile="sersic",
        index=[8.0, 1.0, 20.0, 1.0],
        radius=1.0,
    )
    told = f"2 of 4 sources are not painted: fluxes in '{FILTER}' are 1 NaN, 1 negative .*no_flux"
    with pytest.warns(MiricigaleWarning, match=told):
        scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, max_radius=4 * u.arcsec)
    truth = scene.truth
    f = SceneFlags
    assert truth["flags"].tolist() == [
        f.NEAR_EDGE | f.CUT_PROFILE,
        f.NO_FLUX,
        f.DRAWN_AS_POINT,
        f.NO_FLUX,
    ] or (truth["flags"].tolist() == [f.CUT_PROFILE, f.NO_FLUX, f.DRAWN_AS_POINT, f.NO_FLUX])
    assert truth["profile"].tolist() == ["sersic", "sersic", "point", "sersic"]
    assert truth["flux_in_image"][1] == 0
    assert truth["flux_in_image"][0] < 0.95 * truth["flux_total"][0]
    assert "cut profile" in truth["flags"].info.description


def test_sources_on_the_other_side_of_the_sky_do_no_harm(wcs, psf):
    catalog = scenes.make_catalog(wcs, [50.0, 20.0], [45.0, 30.0])
    catalog["sky"] = SkyCoord(
        [catalog["sky"].ra.deg[0], 233.0], [catalog["sky"].dec.deg[0], 27], unit="deg"
    )
    scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=psf)
    assert scene.truth["flags"].tolist() == [0, SceneFlags.OUTSIDE_IMAGE]
    assert np.all(np.isfinite(scene.render().data))


def test_points_alone_are_those_beside_a_galaxy(wcs, psf):
    # alone they are added one by one, beside a galaxy convolved with it
    x, y = [20.3, 47.9, -1.2, 60.0, 61.5], [31.2, 12.6, 40.4, 60.0, 60.5]
    points = scenes.make_catalog(wcs, x, y)
    galaxy = scenes.make_catalog(wcs, [35.0], [38.0], profile="sersic", radius=0.3, index=1.0)
    both = scenes.make_catalog(
        wcs,
        [*x, 35.0],
        [*y, 38.0],
        profile=["point"] * len(x) + ["sersic"],
        radius=[0.0] * len(x) + [0.3],
        index=1.0,
    )
    three = [Scene(one, filter=FILTER, wcs=wcs, psf=psf) for one in (points, galaxy, both)]
    alone, extended, together = (scene.render().data for scene in three)
    # the grid of the transforms is in single precision
    np.testing.assert_allclose(alone + extended, together, rtol=0, atol=3e-7 * alone.max())
    flux = [scene.truth["flux_in_image"].value for scene in three]
    np.testing.assert_allclose(np.append(flux[0], flux[1]), flux[2], rtol=1e-12)


def test_the_same_on_any_number_of_threads(wcs, psf):
    catalog = scenes.make_catalog(
        wcs, [30.0, 60.0], [40.0, 50.0], profile="sersic", radius=0.5, index=4.0, ratio=0.4
    )

    def light(n_threads):
        return Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, n_threads=n_threads).render().data

    alone = light(1)
    np.testing.assert_array_equal(light(3), alone)
    # and with other scenes beside it
    with ThreadPoolExecutor(2) as pool:
        for image in pool.map(light, (1, 2, 1, 2)):
            np.testing.assert_array_equal(image, alone)


def test_image_says_what_it_is(wcs):
    psf = scenes.gaussian_psf(includes=("pixel", "ipc"), frame="detector")
    catalog = scenes.make_catalog(wcs, 50, 45)
    image = Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, background=3 * u.MJy / u.sr).render()
    assert image.unit == u.MJy / u.sr
    assert image.shape == (90, 100)
    assert image.meta["filter"] == FILTER
    assert image.meta["psf_includes"] == ["pixel", "ipc"]
    assert image.meta["background"] == 3.0
    assert image.wcs is not None
    np.testing.assert_allclose(image.data[0, 0], 3.0)


def test_refuses(wcs, psf):
    catalog = scenes.make_catalog(wcs, 50, 45)
    with pytest.raises(ValueError, match="'catalog' must be a table with the columns"):
        Scene(catalog, filter="miri.f1000w", wcs=wcs, psf=psf)
    with pytest.raises(ValueError, match="'psf' must be a photutils ImagePSF, got ndarray"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=np.ones((3, 3)))
    with pytest.raises(ValueError, match=r"pixels of 0\.0600 arcsec where the WCS has 0\.1100"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=scenes.gaussian_psf(pixel_scale=0.06 * u.arcsec))
    turned = scenes.gaussian_psf(frame="sky", angle=40.0 * u.deg)
    with pytest.raises(ValueError, match=r"turned by 40\.0 deg"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=turned)
    Scene(catalog, filter=FILTER, wcs=scenes.tan_wcs(pa=40.0), psf=turned)
    with pytest.raises(ValueError, match="'background' must be a Background or a Quantity"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, background=3.0)
    with pytest.raises(ValueError, match=r"'background' must be at least 0, got -3\.0 MJy"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, background=-3 * u.MJy / u.sr)
    bare = scenes.tan_wcs()
    bare.pixel_shape = None
    with pytest.raises(ValueError, match="'wcs' must be a WCS with its pixel_shape"):
        Scene(catalog, filter=FILTER, wcs=bare, psf=psf)
    other = scenes.gaussian_psf(filter="miri.f2100w")
    with pytest.raises(ValueError, match=r"'psf' must be one of the filter miri\.f770w, got one"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=other)
    for name in (FILTER, "F770W"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=scenes.gaussian_psf(filter=name))
    catalog[FILTER] = [20.0] * u.ABmag
    with pytest.raises(u.UnitsError, match=r"'miri\.f770w' must be convertible to uJy, got mag"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=psf)
    catalog = scenes.make_catalog(wcs, 50, 45)
    with pytest.raises(ValueError, match="'n_threads' must be at least 1 and an integer, got 0"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, n_threads=0)
    with pytest.raises(
        ValueError, match=r"'n_threads' must be at least 1 and an integer, got 1\.5"
    ):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, n_threads=1.5)
    with pytest.raises(ValueError, match=r"'max_radius' must be positive, got -1\.0 arcsec"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, max_radius=-1 * u.arcsec)
    even = ImagePSF(np.ones((8, 8)), oversampling=4)
    with pytest.raises(ValueError, match="'psf' must be centered on a node"):
        Scene(catalog, filter=FILTER, wcs=wcs, psf=even)


def test_plot_draws_on_the_axes_given(wcs, psf):
    from matplotlib.figure import Figure

    catalog = scenes.make_catalog(wcs, [50, 70], [45, 20])
    scene = Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, background=1 * u.MJy / u.sr)
    ax = Figure().subplots()
    assert scene.plot(ax, sources=True) is ax
    assert len(ax.images) == 1
    assert len(ax.lines[0].get_xdata()) == 2
