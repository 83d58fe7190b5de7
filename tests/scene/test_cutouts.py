"""Images of galaxies as sources: light, place, orientation and shape."""

import copy
import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData

from helpers import scenes
from helpers.errors import refuses
from helpers.exposures import gaussians
from helpers.light import pixel_gaussian
from helpers.scenes import light, moments
from miricigale.profiles import sersic_image
from miricigale.scene import Cutout


def one(wcs, x, y, **columns):
    return scenes.make_catalog(wcs, x, y, profile="cutout", **columns)


def gaussian_stamp(sigma_x, sigma_y, scale, n=81, **options):
    """A Gaussian integrated over the pixels of a stamp; widths in arcsec."""
    rows, columns = (pixel_gaussian(n, (n - 1) / 2, s / scale) for s in (sigma_y, sigma_x))
    return Cutout(np.outer(rows, columns), pixel_scale=scale * u.arcsec, **options)


STAMP = gaussian_stamp(0.2, 0.2, 0.06)


@pytest.mark.parametrize("scale", [0.03, 0.06, 0.2])
@pytest.mark.parametrize(("x", "y"), [(50.0, 45.0), (50.37, 44.81), (49.5, 45.24)])
def test_light_is_kept_to_1e6_and_the_place_to_a_hundredth_of_a_pixel(psf, scale, x, y):
    wcs = scenes.tan_wcs(pa=25.0)
    stamp = gaussian_stamp(0.35, 0.35, scale, n=4 * round(1.5 / scale) + 1)
    # the catalog's flux, whatever the stamp's own unit
    stamp = Cutout(17.0 * stamp.data, pixel_scale=stamp.pixel_scale)
    scene = scenes.make_scene(one(wcs, x, y), wcs, psf, cutouts={1: stamp})
    image = light(scene)
    assert image.sum() == pytest.approx(10.0, rel=1e-6)
    assert scene.truth["flux_in_image"].value[0] == pytest.approx(image.sum(), rel=1e-6)
    x0, y0, _ = moments(image)
    assert (x0, y0) == (pytest.approx(x, abs=1e-3), pytest.approx(y, abs=1e-3))


@pytest.mark.parametrize("parity", [-1, 1])
@pytest.mark.parametrize(("pa", "angle"), [(0.0, 0.0), (35.0, 0.0), (20.0, 80.0), (200.0, -30.0)])
def test_second_moments_through_angle_and_parity(psf, pa, angle, parity):
    """Widths add in squares: profile, stamp pixel (twice: drawn and spread), PSF, pixel."""
    wcs = scenes.tan_wcs(pa=pa, parity=parity)
    scale = 0.05
    stamp = gaussian_stamp(0.2, 0.5, scale, angle=angle * u.deg)
    scene = scenes.make_scene(one(wcs, 50, 45), wcs, psf, cutouts={1: stamp})
    x0, y0, got = moments(light(scene))
    assert (x0, y0) == (pytest.approx(50, abs=1e-3), pytest.approx(45, abs=1e-3))
    # the stamp's +y at the position angle, +x west of it; east is to the left for parity -1
    t = np.radians(angle)
    sky = np.array([[-np.cos(t), np.sin(t)], [np.sin(t), np.cos(t)]])
    p = np.radians(pa)
    pixels = np.array([[parity * np.cos(p), -parity * np.sin(p)], [np.sin(p), np.cos(p)]]) / 0.11
    own = np.diag([0.2**2, 0.5**2]) + np.eye(2) * scale**2 / 6
    truth = (pixels @ sky) @ own @ (pixels @ sky).T + np.eye(2) * (0.85**2 + 1 / 12)
    np.testing.assert_allclose(got, truth, rtol=2e-3, atol=5e-3)


def test_a_drawn_galaxy_is_the_galaxy(wcs, psf):
    """A finely drawn Sersic stamp and the profile itself."""
    kwargs = {"radius": 0.4, "index": 1.5, "ratio": 0.5, "angle": 30.0}
    galaxy = scenes.make_catalog(wcs, 50.3, 44.8, profile="sersic", **kwargs)
    # position angle 30 deg on a north-up stamp: 120 deg from +x
    shape = {"r_eff": 40, "n": 1.5, "axis_ratio": 0.5, "theta": np.radians(120)}
    data = sersic_image((601, 601), x=300, y=300, **shape)
    stamp = Cutout(data, pixel_scale=0.01 * u.arcsec)
    image = light(scenes.make_scene(one(wcs, 50.3, 44.8), wcs, psf, cutouts={1: stamp}))
    truth = light(scenes.make_scene(galaxy, wcs, psf, max_radius=2.9 * u.arcsec))
    image, truth = image / image.sum(), truth / truth.sum()
    np.testing.assert_allclose(image, truth, atol=4e-3 * truth.max())


@pytest.mark.parametrize("parity", [-1, 1])
def test_stamp_of_an_image_stands_as_the_image_does(psf, parity):
    """A companion lands where the WCS of its own image says."""
    own = scenes.tan_wcs((61, 71), scale=0.05, pa=130.0, parity=parity)
    data = gaussians((61, 71), [35, 60], [30, 45], [1.0, 0.8], np.sqrt(2.0))
    sky = own.pixel_to_world(35, 30)
    stamp = Cutout.from_image(CCDData(data, unit="adu", wcs=own), sky)
    assert stamp.pixel_scale.to_value(u.arcsec) == pytest.approx(0.05, rel=1e-6)
    wcs = scenes.tan_wcs(pa=20.0)
    catalog = one(wcs, 50, 45)
    catalog["sky"] = sky.reshape((1,))
    scene = scenes.make_scene(catalog, wcs, psf, cutouts={1: stamp})
    cx, cy = (float(v) for v in wcs.world_to_pixel(own.pixel_to_world(60, 45)))
    drawn = light(scene)
    part = np.s_[round(cy) - 4 : round(cy) + 5, round(cx) - 4 : round(cx) + 5]
    yy, xx = np.mgrid[part]
    # in a window of its own: the principal source is 11 pixels away
    place = [np.average(axis, weights=drawn[part]) for axis in (xx, yy)]
    np.testing.assert_allclose(place, [cx, cy], atol=0.05)


def test_pixels_without_a_measurement_are_refused():
    data, mask = np.ones((7, 9)), np.zeros((7, 9), dtype=bool)
    data[2, 3], data[4, 4] = np.nan, -np.inf
    mask[2, 3] = mask[6, 0] = True
    image = CCDData(data, unit="adu", wcs=scenes.tan_wcs((7, 9), scale=0.1), mask=mask)
    refuses(r"'image' must be without masked .* got 3 of 63 pixels", Cutout.from_image, image)


def test_distortion_stretches_the_stamp(psf):
    wcs = scenes.distorted_wcs()
    catalog = one(wcs, 20.0, 25.0)
    stamp = gaussian_stamp(0.25, 0.25, 0.05)
    scene = scenes.make_scene(catalog, wcs, psf, cutouts={1: stamp})
    x0, y0, got = moments(light(scene))
    assert (x0, y0) == (pytest.approx(20, abs=0.01), pytest.approx(25, abs=0.01))
    t = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    width = np.sqrt(0.25**2 + 0.05**2 / 6)
    around = catalog["sky"][0].directional_offset_by(t * u.rad, width * u.arcsec)
    variance = 2 * np.mean(np.subtract(wcs.world_to_pixel(around), [[20], [25]]) ** 2, axis=1)
    np.testing.assert_allclose(np.diag(got), variance + 0.85**2 + 1 / 12, rtol=5e-3)


def test_light_beyond_the_edge_is_in_no_pixel(wcs, psf):
    stamp = gaussian_stamp(0.6, 0.6, 0.06)
    for x in (-3.0, 1.0, 98.6):
        scene = scenes.make_scene(one(wcs, x, 45.0), wcs, psf, cutouts={1: stamp})
        total = light(scene).sum()
        assert scene.truth["flux_in_image"].value[0] == pytest.approx(total, rel=1e-5)
        assert 0.1 < total < 9


@pytest.mark.parametrize(
    ("cutouts", "message"),
    [
        ({}, r"'cutouts' must be one for each .* got none for \[1\]"),
        ({1: STAMP, 7: STAMP}, r"'cutouts' must be for ids .* got some for \[7\]"),
        ({1: np.ones((5, 5))}, "'cutouts' must be a Cutout for 1, got ndarray"),
    ],
)
def test_a_stamp_for_each_cutout(wcs, psf, cutouts, message):
    refuses(message, scenes.make_scene, one(wcs, 50, 45), wcs, psf, cutouts=cutouts)


def test_images_without_light_or_a_usable_wcs_are_refused():
    image = CCDData(np.ones((5, 5)), unit="adu")
    refuses("'image' must be NDData with a WCS", Cutout.from_image, image)
    wanted = "'data' must be a finite 2D array with a positive sum"
    refuses(wanted, Cutout, np.zeros((5, 5)), pixel_scale=0.1 * u.arcsec)
    image.wcs = scenes.tan_wcs((5, 5))
    image.wcs.wcs.cd = image.wcs.wcs.cd * np.array([1.0, 1.2])
    refuses("'image' must be with square pixels", Cutout.from_image, image)
    assert repr(STAMP) == "<Cutout 81 x 81 pixels of 0.06 arcsec, angle 0 deg>"


def test_stamps_and_their_copies_cannot_be_changed():
    cutout = Cutout(np.ones((3, 5)), pixel_scale=0.1 * u.arcsec, angle=30 * u.deg)
    for other in (cutout, copy.deepcopy(cutout), pickle.loads(pickle.dumps(cutout))):
        assert repr(other) == repr(cutout)
        assert other.center == cutout.center
        assert not other.data.flags.writeable


def test_half_of_the_light_of_a_gaussian_is_within_1_18_sigma_in_arcsec():
    stamp = gaussian_stamp(0.3, 0.3, 0.05)
    wanted = np.sqrt(2 * np.log(2)) * 0.3
    assert stamp.half_light_radius.to_value(u.arcsec) == pytest.approx(wanted, rel=0.02)
