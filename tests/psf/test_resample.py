import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import NDData
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import GriddedPSFModel, ImagePSF

from helpers.errors import refuses
from helpers.scenes import tan_wcs
from miricigale.psf import (
    average_psf,
    encircled_energy,
    from_photutils,
    gaussian_psf,
    make_psf,
    miri_psf,
    psf_image,
    psf_mosaic,
    read_psf,
    rotate_psf,
)
from miricigale.psf.resample import centered_psf
from miricigale.utils.exceptions import DataError


def psf_of(light, *, n, scale=0.11):
    """A PSF of the detector of unit light from a function of pixels off its middle."""
    axis = (np.arange(n) - n // 2) / 4
    data = light(*np.meshgrid(axis, axis))
    data *= 16 / data.sum()
    return make_psf(data, pixel_scale=scale * u.arcsec, oversampling=4, frame="detector")


def blob(x, y, *, n=121, scale=0.11):
    """A core and a fainter blob at an offset x, y in pixels."""

    def light(xx, yy):
        return np.exp(-0.5 * (xx**2 + yy**2)) + 0.5 * np.exp(-2 * ((xx - x) ** 2 + (yy - y) ** 2))

    return psf_of(light, n=n, scale=scale)


@pytest.mark.parametrize("pa", [0.0, 35.0, 110.0, -75.0, 250.0])
@pytest.mark.parametrize(("x", "y"), [(0.0, 9.0), (8.0, 0.0), (-6.0, 5.0)])
def test_feature_lands_at_its_place_on_the_sky(pa, x, y):
    """The blob's sky position through the detector's WCS, found again in a north-up mosaic."""
    psf = rotate_psf(blob(x, y), pa * u.deg)
    sky = tan_wcs((1, 1), pa=pa).pixel_to_world(x, y)
    mx, my = tan_wcs((1, 1)).world_to_pixel(sky)
    beside = np.linspace(-1, 1, 41)
    around = psf.evaluate(*np.meshgrid(mx + beside, my + beside), 1.0, 0.0, 0.0)
    j, i = np.unravel_index(around.argmax(), around.shape)
    assert abs(i - 20) * 0.05 < 0.15
    assert abs(j - 20) * 0.05 < 0.15
    assert psf.frame == "sky"


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_quarter_turns_move_pixels_and_agree_with_interpolation(quarter):
    psf = blob(3.0, 7.0)
    exact = rotate_psf(psf, 90.0 * quarter * u.deg)
    near = rotate_psf(psf, (90.0 * quarter + 1e-7) * u.deg)
    assert_allclose(np.sort(exact.data, axis=None), np.sort(psf.data, axis=None))
    assert_allclose(near.data, exact.data, atol=1e-6)


def test_turning_conserves_light_and_encircled_energy():
    psf = miri_psf("miri.f770w", fov=12 * u.arcsec)
    radii = [0.2, 0.5, 1.0, 3.0, 5.5] * u.arcsec
    turned = rotate_psf(psf, 33 * u.deg)
    assert_allclose(encircled_energy(turned, radii), encircled_energy(psf, radii), atol=1e-3)
    assert turned.enclosed == pytest.approx(psf.enclosed, abs=5e-3)
    assert turned.fwhm.value == pytest.approx(psf.fwhm.value, rel=1e-3)
    assert turned.includes == psf.includes


def long_gaussian(angle, major=2.2, minor=1.1):
    """Gaussian on the detector, long axis ``angle`` deg counter-clockwise of +x; in pixels."""
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))

    def light(x, y):
        along, across = x * cos + y * sin, y * cos - x * sin
        return np.exp(-0.5 * ((along / major) ** 2 + (across / minor) ** 2))

    return psf_of(light, n=161)


def sky_moments(psf):
    """Second moments in arcsec^2 along +x (west) and +y (north) of an image of the sky."""
    axis = (np.arange(psf.data.shape[0]) - psf.origin[0]) * psf.cell
    x, y = np.meshgrid(axis, axis)
    return np.array([[np.sum(psf.data * p * q) / psf.data.sum() for p in (x, y)] for q in (x, y)])


def turned(covariance, angle):
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    rotation = np.array([[cos, -sin], [sin, cos]])
    return rotation @ covariance @ rotation.T


def test_second_moments_of_a_mosaic_of_dithers():
    """
    Mean over rolls, and the boxes of the drop and of the pixel.

    Position angles grow counter-clockwise where north is up and east left.
    """
    own = 0.11**2 * turned(np.diag([2.2**2, 1.1**2]), 20.0)
    rolls, psf = [10.0, 70.0, 110.0], long_gaussian(20.0)
    # a square has the same second moments in every direction
    truth = np.mean([turned(own, r) for r in rolls], axis=0) + np.eye(2) * (0.11**2 + 0.06**2) / 12
    alike = psf_mosaic(psf, 0.06 * u.arcsec, rolls * u.deg)
    mean = average_psf([psf_mosaic(psf, 0.06 * u.arcsec, r * u.deg) for r in rolls])
    for one in (alike, mean):
        assert_allclose(sky_moments(one), truth, atol=5e-4 * truth.max())


def test_image_is_the_model_evaluated():
    psf = miri_psf("miri.f770w", fov=8 * u.arcsec)
    scale = psf.pixel_scale.value
    image = psf_image(psf, pixel_scale=0.06 * u.arcsec, shape=(41, 51), offset=(0.3, -0.2))
    y, x = np.indices(image.shape)
    x, y = (x - 25 - 0.3) * 0.06 / scale, (y - 20 + 0.2) * 0.06 / scale
    expected = psf.evaluate(x, y, 1.0, 0.0, 0.0) * (0.06 / scale) ** 2
    assert_allclose(image, expected, atol=1e-5 * image.max())


@pytest.mark.parametrize("n", [11, 25, 51])
def test_a_psf_on_finer_pixels_has_its_width(n):
    """The ratio of pixel scales counts, not that of the numbers of pixels (as in photutils' resize_psf)."""
    axis = np.arange(n) - n // 2
    data = np.exp(-0.5 * np.add.outer(axis**2, axis**2) / 1.5**2)
    psf = make_psf(data / data.sum(), pixel_scale=0.11 * u.arcsec, frame="sky")
    image = psf_image(psf, pixel_scale=0.055 * u.arcsec, shape=2 * n - 1)
    finer = np.arange(2 * n - 1) - (n - 1)
    variance = image.sum(axis=0) @ finer**2 / image.sum()
    # of the light on the array, which ends at 3.3 sigma of the smallest
    truth = np.exp(-0.5 * (finer / 3.0) ** 2)
    assert variance == pytest.approx(truth @ finer**2 / truth.sum(), rel=5e-3)


def test_drizzle_adds_the_drop_and_the_pixel():
    """Variances of boxes add: (native^2 + mosaic^2) / 12 per axis, at any angle."""
    psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.11 * u.arcsec, fov=6 * u.arcsec)
    kind = {"pixel_scale": 0.11 * u.arcsec, "oversampling": 4, "frame": "detector"}
    detector = make_psf(psf.data, **kind, includes=["pixel"])
    for pixfrac in (1.0, 0.6):
        mosaic = psf_mosaic(detector, 0.06 * u.arcsec, 30 * u.deg, pixfrac=pixfrac)
        expected = 0.4**2 / (8 * np.log(2)) + ((0.11 * pixfrac) ** 2 + 0.06**2) / 12
        assert sky_moments(mosaic)[0, 0] == pytest.approx(expected, rel=1e-3)
        assert mosaic.enclosed == pytest.approx(1, abs=1e-3)
        assert mosaic.includes == ("pixel", "drizzle")
        assert mosaic.pixel_scale.value == pytest.approx(0.06)


def test_mosaic_psf_is_what_dithered_pixels_average_to():
    """Spread the pixels of many dithers of a point source over a mosaic, by hand."""
    psf = gaussian_psf(0.35 * u.arcsec, pixel_scale=0.11 * u.arcsec, fov=5 * u.arcsec)
    fine = 11  # cells of 0.01 arcsec: 11 a native pixel, 6 a mosaic pixel
    total = np.zeros((330, 330))
    y, x = np.mgrid[:30, :30]
    for dy in range(fine):
        for dx in range(fine):
            # source in the middle of the field, the detector's grid shifted under it
            image = psf.evaluate(x, y, 1.0, 15 - 0.5 + (dx - 5) / fine, 15 - 0.5 + (dy - 5) / fine)
            spread = np.kron(image, np.ones((fine, fine))) / fine**2
            total += np.roll(spread, (5 - dy, 5 - dx), axis=(0, 1)) / fine**2
    # total is the mosaic before its own pixel; the source stands between cells 164 and 165
    mosaic = psf_mosaic(psf, 0.06 * u.arcsec)
    binned = total[3:327, 3:327].reshape(54, 6, 54, 6).sum((1, 3))
    expected = psf_image(mosaic, pixel_scale=0.06 * u.arcsec, shape=54)
    assert_allclose(binned, expected, atol=2e-3 * expected.max())


def test_takes_over_photutils_models():
    psf = blob(2.0, 3.0)
    bare = ImagePSF(psf.data, oversampling=4)
    kind = {"pixel_scale": 0.11 * u.arcsec, "frame": "detector", "includes": ("pixel",)}
    again = from_photutils(bare, **kind)
    assert_array_equal(again.data, psf.data)
    assert list(again.includes) == ["pixel"]
    positions = [(0, 0), (0, 100), (100, 0), (100, 100)]
    stack = np.stack([psf.data * f for f in (0.8, 0.9, 0.9, 1.0)])
    grid = GriddedPSFModel(NDData(stack, meta={"grid_xypos": positions, "oversampling": 4}))
    there = from_photutils(grid, x=50, y=50, **kind)
    assert_allclose(there.data, 0.9 * psf.data, rtol=1e-6, atol=1e-9)
    refuses("given for a GriddedPSFModel", from_photutils, grid, **kind)
    refuses("'model' must be a PSF or model of photutils", from_photutils, "psf", **kind)


def test_reads_any_fits_image(tmp_path):
    from astropy.io import fits

    psf = blob(2.0, 3.0)
    path = tmp_path / "psf.fits"
    stack = np.stack([psf.data, 7 * psf.data]).astype(">f4")
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(stack)]).writeto(path)
    kind = {"pixel_scale": 0.11 * u.arcsec, "oversampling": 4, "frame": "detector"}
    one = read_psf(path, ext=1, plane=1, enclosed=0.9, **kind)
    assert_allclose(one.data, 0.9 * psf.data, rtol=1e-5, atol=1e-7)
    assert one.enclosed == pytest.approx(0.9)
    refuses(
        r"an image with a PSF, .* say FILE\[EXTENSION,PLANE\]",
        read_psf,
        path,
        error=DataError,
        **kind,
    )
    refuses("'data' must be normalized to 16", read_psf, path, ext=1, plane=1, **kind)


BLOB, FINE = blob(1.0, 1.0), 0.06 * u.arcsec
ON_SKY = rotate_psf(BLOB, 30 * u.deg)
MANY = [
    (rotate_psf, (BLOB,), {}, "'angle' must be the position angle of the detector"),
    (rotate_psf, (ON_SKY, 30 * u.deg), {}, "left out for a PSF that stands on the sky"),
    (average_psf, ([BLOB, ON_SKY],), {}, "'psfs' must be alike in frame"),
    (average_psf, ([BLOB, blob(1.0, 0.0, scale=0.06)],), {}, "'psfs' must be alike in pixel_scale"),
    (average_psf, ([BLOB, blob(1.0, 0.0, n=101)],), {}, r"'psfs' must be alike in (shape|origin)"),
    (average_psf, ([],), {}, "'psfs' must be a list of PSFs, at least one"),
    (psf_mosaic, (BLOB, FINE), {}, "'pa' must be the position angle"),
    (psf_mosaic, (ON_SKY, FINE), {"resampling": "lanczos"}, "'resampling' must be 'drizzle' or N"),
    (psf_mosaic, (ON_SKY, 0 * FINE), {}, "'pixel_scale' must be positive"),
    (psf_image, (BLOB,), {"pixel_scale": FINE, "shape": 0}, "'shape' must be at least one row and"),
]


@pytest.mark.parametrize(("function", "args", "options", "match"), MANY)
def test_what_makes_no_psf_is_named(function, args, options, match):
    refuses(match, function, *args, **options)


@pytest.mark.parametrize("part", [0.4, 0.6])
def test_a_core_is_brought_to_the_origin_from_less_than_half_way_to_the_edge(part):
    # 60 cells of a quarter pixel to the edge, 1.65 arcsec
    shift = 60 * part / 4
    psf = psf_of(lambda x, y: np.exp(-0.5 * ((x - shift) ** 2 + y**2)), n=121)
    if part > 0.5:
        refuses("core stands near its center", centered_psf, psf, 0.01)
        return
    centered, offset = centered_psf(psf, 0.01)
    assert_allclose(offset, (shift * 0.11, 0.0), atol=1e-3)
    assert_allclose(centered.origin, (60 + 4 * shift, 60), atol=0.01)
