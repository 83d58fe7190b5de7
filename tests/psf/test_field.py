import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import GriddedPSFModel, ImagePSF

from helpers.errors import refuses
from miricigale.instrument import aperture, imager_wcs, pixel_area_map, pixel_to_sky
from miricigale.psf import (
    MIRI_PIXEL_SCALE,
    _core,
    effects,
    encircled_energy,
    gaussian_psf,
    grid_weights,
    miri_psf,
    miri_psf_grid,
    psf_at,
    psf_grid,
)
from miricigale.psf.miri import local_pixel
from miricigale.psf.optics import jwst_constants
from miricigale.psf.telescope import band_quantiles

CORNERS = [(359.0, 0.0), (1026.0, 0.0), (1026.0, 1023.0), (700.0, 300.0)]
SMALL = {"fov": 4 * u.arcsec, "oversampling": 3}


def test_the_usual_pixel_has_the_area_of_that_of_the_sky():
    wcs = imager_wcs(SkyCoord(53.1, -27.8, unit="deg"), 30 * u.deg)
    # by the distortion, at the reference position of the imager
    area = pixel_area_map(wcs, (1024, 1032))[512, 692] * u.sr
    assert (MIRI_PIXEL_SCALE**2 / area).to_value(u.one) == pytest.approx(1, abs=2e-4)


@pytest.mark.parametrize(("x", "y"), CORNERS)
def test_pixel_is_that_of_the_distortion(x, y):
    """Sides and angles of the pixel by the full spherical transformation to the sky."""
    field, roll = SkyCoord(53.1, -27.8, unit="deg"), 30 * u.deg
    here = pixel_to_sky(x, y, field, roll)
    along_x, along_y = pixel_to_sky(x + 1, y, field, roll), pixel_to_sky(x, y + 1, field, roll)
    jacobian = local_pixel(x, y)
    sides = np.hypot(*jacobian)
    assert here.separation(along_x).arcsec == pytest.approx(sides[0], rel=3e-4)
    assert here.separation(along_y).arcsec == pytest.approx(sides[1], rel=3e-4)
    # position angles: the ideal +y stands at roll + V3IdlYAngle, its +x 90 deg less
    ideal = 30 + aperture().v3_ideal_y_angle
    pa_x = ideal - 90 + np.degrees(np.arctan2(jacobian[1, 0], jacobian[0, 0]))
    pa_y = ideal + np.degrees(np.arctan2(-jacobian[0, 1], jacobian[1, 1]))
    for there, angle in ((along_x, pa_x), (along_y, pa_y)):
        turn = (here.position_angle(there).deg - angle + 180) % 360 - 180
        assert turn == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("oversampling", [2, 4])
@pytest.mark.parametrize("name", ["miri.f560w", "miri.f1500w"])
def test_optics_at_a_position_are_those_of_the_warped_pupil(name, oversampling):
    """|F(P)|^2 sampled at J p is |F(P(J^-T w))|^2 at p: no interpolation, no small angles."""
    x, y = 359.0, 0.0
    kind = {"fov": 6 * u.arcsec, "oversampling": oversampling, "wavefront_error": 0 * u.nm}
    got = miri_psf(name, position=(x, y), includes=(), **kind)
    map_ = local_pixel(x, y) / MIRI_PIXEL_SCALE.value
    n, constants = 384, jwst_constants()
    step = 1.03 * constants["diameter"] / n
    amplitude, blocked = np.zeros((n, n)), np.zeros((n, n))
    # V3 stands 4.84 deg clockwise of +y, V2 to its left
    sin, cos = np.sin(np.radians(4.83544897)), np.cos(np.radians(4.83544897))
    to_image = np.array([[-cos, sin], [sin, cos]])
    for vertices in constants["segments"].values():
        amplitude += _core.polygon_coverage(vertices @ to_image @ map_, n, step, 8)
    for vertices in constants["struts"].values():
        part = _core.polygon_coverage(vertices @ to_image @ map_, n, step, 8)
        blocked = np.maximum(blocked, part)
    amplitude = np.minimum(amplitude, 1) * (1 - blocked)
    cells = got.data.shape[0]
    axis = (np.arange(cells) - cells // 2) * MIRI_PIXEL_SCALE.to_value(u.rad) / oversampling
    grid = {"theta_x": axis, "theta_y": axis, "power": amplitude.sum()}
    images = [
        _core.matrix_dft_intensity(amplitude + 0j, step, wave * 1e-6, **grid)
        for wave in band_quantiles(name, 9)
    ]
    truth = np.mean(images, axis=0) * oversampling**2
    assert_allclose(got.data, truth, atol=2e-3 * truth.max())
    assert got.enclosed == pytest.approx(truth.sum() / oversampling**2, abs=1e-3)
    # the square pixel's image is no such thing
    square = miri_psf(name, includes=(), **kind)
    assert np.abs(square.data - truth).max() > 5 * np.abs(got.data - truth).max()


def test_widths_on_the_sky_are_the_same_all_over_the_field():
    radii = [0.2, 0.5, 1.0, 1.8] * u.arcsec
    kind = {**SMALL, "includes": ()}
    reference = encircled_energy(miri_psf("miri.f1000w", **kind), radii)
    for position in CORNERS:
        psf = miri_psf("miri.f1000w", position=position, **kind)
        side = np.sqrt(abs(np.linalg.det(local_pixel(*position))))
        assert psf.pixel_scale.value == pytest.approx(side)
        assert_allclose(encircled_energy(psf, radii), reference, atol=2e-3)


def test_cross_leans_to_the_middle_of_the_array():
    image = np.zeros((401, 401))
    image[200, 200] = 1.0
    for x, y in ((100.0, 100.0), (1000.0, 900.0)):
        shift = effects.cruciform_shift(x, y)
        assert np.sign(shift).tolist() == [np.sign(598 - x), np.sign(511 - y)]
        # without a halo
        form = {"oversampling": 4, "calibration": "stpsf"}
        out = effects.cruciform(image, "miri.f560w", shift=shift, **form)
        cells = np.arange(401) - 200
        # arms beyond the core, where the other arm is not
        up, right = out[300:].sum(0), out[:, 300:].sum(1)
        assert (up @ cells) / up.sum() == pytest.approx(4 * shift[0], abs=1e-9)
        assert (right @ cells) / right.sum() == pytest.approx(4 * shift[1], abs=1e-9)
        straight = effects.cruciform(image, "miri.f560w", **form)
        assert out.sum() == pytest.approx(straight.sum(), rel=1e-12)
    assert effects.cruciform_shift(597.7, 511.0) == pytest.approx((0, 0), abs=1e-3)


@pytest.fixture(scope="module")
def grid():
    return miri_psf_grid("miri.f770w", n_psfs=4, **SMALL)


def test_grid_is_photutils_model_and_says_what_it_is(grid):
    assert isinstance(grid, GriddedPSFModel)
    assert grid.frame == "detector"
    assert list(grid.includes) == ["jitter", "cruciform", "pixel", "ipc"]
    assert grid.filter == "miri.f770w"
    assert "fwhm" not in grid.meta
    for k, (x, y) in enumerate(grid.grid_xypos):
        alone = miri_psf("miri.f770w", position=(x, y), **SMALL)
        assert_array_equal(grid.data[k], alone.data)
        here = psf_at(grid, x, y)
        assert_allclose(here.data, alone.data, rtol=1e-12)
        assert here.pixel_scale.value == pytest.approx(alone.pixel_scale.value)
        assert here.fwhm.value == pytest.approx(alone.fwhm.value)
        assert here.position == (x, y)


@pytest.mark.parametrize(("x", "y"), [(600.0, 200.0), (359.0, 900.0), (100.0, 1500.0)])
def test_between_the_places_it_is_what_photutils_evaluates(grid, x, y):
    yy, xx = np.mgrid[-8:9, -8:9]
    expected = grid.evaluate(xx + x, yy + y, 1.0, x, y)
    here = psf_at(grid, x, y)
    assert_allclose(here.evaluate(xx, yy, 1.0, 0.0, 0.0), expected, atol=1e-5 * expected.max())
    assert grid_weights(grid, x, y).sum() == pytest.approx(1)


def test_grid_of_a_subarray_counts_its_pixels():
    corner = aperture("BRIGHTSKY").origin
    one = miri_psf("miri.f1000w", position=(20, 30), subarray="BRIGHTSKY", **SMALL)
    full = miri_psf("miri.f1000w", position=(20 + corner[0], 30 + corner[1]), **SMALL)
    assert_allclose(one.data, full.data, atol=1e-9)
    part = miri_psf_grid("miri.f1000w", n_psfs=4, subarray="BRIGHTSKY", **SMALL)
    assert np.ptp(part.grid_xypos, axis=0).tolist() == [511, 511]


PSF = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=2 * u.arcsec)
WIDE = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=3 * u.arcsec)
COARSE = miri_psf("miri.f770w", **SMALL)
SQUARE = [(0, 0), (9, 0), (0, 9), (9, 9)]


@pytest.mark.parametrize(
    ("psfs", "places", "match"),
    [
        ([PSF] * 4, SQUARE[:3], r"'positions' must be of shape \(4, 2\)"),
        ([PSF] * 4, [*SQUARE[:3], (8, 9)], "'positions' must be each point of a rectangular grid"),
        ([PSF] * 5, [*SQUARE, (9, 9)], "'positions' must be each point of a rectangular grid"),
        ([PSF, PSF, PSF, WIDE], SQUARE, "'psfs' must be alike in shape"),
        ([PSF] * 3 + [COARSE], SQUARE, "alike in oversampling, got 4 and 3"),
    ],
)
def test_refuses(psfs, places, match):
    refuses(match, psf_grid, psfs, places)


def test_refuses_places_off_the_array_and_other_models():
    refuses("'n_psfs' must be a square .* at least 4, got 6", miri_psf_grid, "F770W", n_psfs=6)
    off = {"position": (1032, 0), **SMALL}
    refuses("'position' must be on the 1032 x 1024 pixels of FULL", miri_psf, "miri.f770w", **off)
    meta = {"grid_xypos": SQUARE, "oversampling": 1}
    plain = GriddedPSFModel(NDData(np.ones((4, 5, 5)), meta=meta))
    for other in (ImagePSF(np.ones((5, 5))), plain):
        refuses("'grid' must be a PSFGrid", psf_at, other, 0, 0, error=TypeError)
