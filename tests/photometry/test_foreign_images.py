"""Images as other programs write them: coordinates, planes, units of the noise, bits of masks."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import (
    CCDData,
    InverseVariance,
    StdDevUncertainty,
    UnknownUncertainty,
    VarianceUncertainty,
)
from astropy.wcs import WCS

from helpers.errors import refuses
from miricigale.instrument import Image, imager_wcs, pixel_area_map, read_image, write_image
from miricigale.instrument.sky_axes import grid_angle, pixel_to_radec, radec_axes
from miricigale.photometry import MosaicFile, aperture_photometry, read_mosaic
from miricigale.photometry.commands.kernel_files import image_psf
from miricigale.photometry.images.arrays import image_arrays
from miricigale.psf import filter_psf, psf_image
from miricigale.reduction import pixel_map, read_images
from miricigale.reduction import write_image as write_jwst_image
from miricigale.reduction.images.images import sigma
from miricigale.scene.sky import local_jacobian, pixel_positions
from miricigale.utils.exceptions import DataError, PhotometryWarning

SHAPE = (60, 80)
SCALE = 0.1 / 3600
#: Solid angle of a square pixel, sr.
AREA = np.radians(SCALE) ** 2
CENTER = SkyCoord(53.1, -27.8, unit="deg")


def tan(angle=0.0, names=("RA---TAN", "DEC--TAN"), center=CENTER, swap=False):
    """Gnomonic coordinates whose +y stands at an angle (deg), with either axis first."""
    wcs = WCS(naxis=2)
    turn = np.radians(angle)
    lon = center.spherical.lon.deg
    lat = center.spherical.lat.deg
    cd = SCALE * np.array([[-np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    order = [1, 0] if swap else [0, 1]
    wcs.wcs.ctype = [names[k] for k in order]
    wcs.wcs.crval = [(lon, lat)[k] for k in order]
    wcs.wcs.crpix = (SHAPE[1] + 1) / 2, (SHAPE[0] + 1) / 2
    wcs.wcs.cd = cd[order]
    wcs.pixel_shape = SHAPE[::-1]
    wcs.wcs.set()
    return wcs


@pytest.fixture
def write(tmp_path):
    """Write an image with planes, (name, version, values), and keywords; returns the path."""

    def writer(data, planes=(), *, wcs=None, primary=None, name="image.fits", **keywords):
        header = (tan() if wcs is None else wcs).to_header(relax=True)
        header["BUNIT"] = "MJy/sr"
        header.update(keywords)
        hdus = [fits.PrimaryHDU(header=fits.Header(primary or {}))]
        hdus.append(fits.ImageHDU(data, header, name="SCI"))
        for label, version, values, *cards in planes:
            own = fits.Header(cards[0] if cards else {})
            hdus.append(fits.ImageHDU(values, own, name=label, ver=version))
        fits.HDUList(hdus).writeto(tmp_path / name, overwrite=True)
        return tmp_path / name

    return writer


def noise(sigma=0.1, seed=1):
    return np.random.default_rng(seed).normal(0, sigma, SHAPE).astype(np.float32)


def plane(value):
    return np.full(SHAPE, value, np.float32)


@pytest.mark.parametrize("angle", [0.0, 37.0, 180.0])
def test_declination_may_be_the_first_axis(angle, write):
    usual = tan(angle)
    swapped = tan(angle, swap=True)
    np.testing.assert_allclose(
        pixel_area_map(swapped, SHAPE), pixel_area_map(usual, SHAPE), rtol=1e-12
    )
    assert pixel_area_map(swapped, SHAPE).mean() == pytest.approx(AREA, rel=1e-6)
    x, y = np.array([[3.0, 70.0], [50.0, 10.0]])
    np.testing.assert_allclose(pixel_to_radec(swapped, x, y), pixel_to_radec(usual, x, y))
    np.testing.assert_allclose(local_jacobian(swapped, x, y), local_jacobian(usual, x, y))
    sky = swapped.pixel_to_world(x, y)
    np.testing.assert_allclose(pixel_positions(swapped, sky, SHAPE)[:2], (x, y), atol=1e-6)
    np.testing.assert_allclose(
        pixel_map(swapped, usual, SHAPE)[0][0], np.arange(SHAPE[1]), atol=1e-6
    )
    assert abs(grid_angle(swapped, SHAPE).value % 360 - angle) < 1e-3
    # a flux in a pixel is divided by its solid angle
    data = noise()
    image = read_mosaic(write(data, [("ERR", 1, plane(0.1))], wcs=swapped, BUNIT="uJy"))
    np.testing.assert_allclose(image.data, data * (1e-12 / AREA), rtol=1e-5)
    assert np.all(
        swapped.pixel_to_world(x, y).separation(usual.pixel_to_world(x, y)) < 1e-8 * u.arcsec
    )


def test_mirrored_images_are_refused_with_the_way_out():
    wcs = tan()
    wcs.wcs.cd = SCALE * np.eye(2)
    wcs.wcs.set()
    refuses("a mirrored one: flip the pixels and the coordinates", grid_angle, wcs, SHAPE)


def test_north_is_that_of_right_ascension_on_galactic_axes(write):
    place = SkyCoord(266.4, -28.9, unit="deg")
    wcs = tan(names=("GLON-TAN", "GLAT-TAN"), center=place.galactic)
    # the angle between the two norths by spherical trigonometry at this place
    pole = SkyCoord(0, 90, unit="deg", frame="galactic").icrs
    angle = place.position_angle(pole).to_value(u.deg)
    assert abs((grid_angle(wcs, SHAPE).value - angle + 180) % 360 - 180) < 0.01
    middle = (SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2
    np.testing.assert_allclose(pixel_to_radec(wcs, *middle), (266.4, -28.9), atol=1e-8)
    lon, lat = radec_axes(wcs, 266.4, -28.9)
    np.testing.assert_allclose((lon, lat), (place.galactic.l.deg, place.galactic.b.deg), atol=1e-8)
    # light to the equatorial east goes where the sky says
    east = place.directional_offset_by(90 * u.deg, 1 * u.arcsec)
    step = np.subtract(wcs.world_to_pixel(east), middle)
    np.testing.assert_allclose(local_jacobian(wcs, *middle) @ [1, 0], step, atol=1e-4)
    x, _ = pixel_map(wcs, tan(angle, center=place), SHAPE)
    np.testing.assert_allclose(x[30], np.arange(SHAPE[1]), atol=0.02)


def test_sip_without_its_ctype_is_no_distortion(write):
    left = {"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-3, "B_1_1": -2e-3}
    path = write(noise(), [("ERR", 1, plane(0.1))], **left)
    with pytest.warns(
        PhotometryWarning, match="CTYPE1 = 'RA---TAN' without -SIP states no distortion"
    ):
        image = read_mosaic(path)
    assert image.wcs.sip is None
    assert image.wcs.pixel_to_world(70, 5).separation(tan().pixel_to_world(70, 5)) < 1e-8 * u.arcsec
    stated = write(
        noise(), [("ERR", 1, plane(0.1))], **left, CTYPE1="RA---TAN-SIP", CTYPE2="DEC--TAN-SIP"
    )
    assert read_mosaic(stated).wcs.sip is not None


@pytest.mark.parametrize(
    ("kind", "value"),
    [(StdDevUncertainty, 0.01), (VarianceUncertainty, 1e-4), (InverseVariance, 1e4)],
)
def test_uncertainties_are_written_as_standard_deviations(kind, value, tmp_path):
    image = CCDData(noise(0.01), unit="MJy/sr", uncertainty=kind(plane(value)), wcs=tan())
    write_image(image, tmp_path / "a.fits")
    np.testing.assert_allclose(read_image(tmp_path / "a.fits").uncertainty.array, 0.01, rtol=1e-6)
    Image(image).write(tmp_path / "b.fits")
    # as astropy writes it, with UTYPE
    image.write(tmp_path / "c.fits")
    for name in ("a", "b", "c"):
        error = read_mosaic(tmp_path / f"{name}.fits").uncertainty.array
        np.testing.assert_allclose(error, 0.01, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "value"),
    [("VARIANCE", 0.01), ("VAR", 0.01), ("IVAR", 100), ("INVVAR", 100), ("RMS", 0.1)],
)
def test_maps_are_what_their_names_say(name, value, write):
    path = write(noise(), [(name, 1, plane(value))])
    np.testing.assert_allclose(read_mosaic(path).uncertainty.array, 0.1, rtol=1e-5)
    if name != "RMS":
        with pytest.raises(ValueError, match=f"whose extension is {name}: give it as"):
            read_mosaic(path, error=f"{path}[{name}]")


def test_variances_of_jwst_are_added(write):
    parts = [("VAR_POISSON", 1, plane(0.006)), ("VAR_RNOISE", 1, plane(0.004))]
    image = read_mosaic(write(noise(), parts))
    np.testing.assert_allclose(image.uncertainty.array, 0.1, rtol=1e-5)


def test_planes_have_the_version_of_their_image(write):
    marks = [np.zeros(SHAPE, np.int16) for _ in range(2)]
    marks[0][10:20] = 1
    marks[1][30:40] = 1
    planes = [("ERR", 1, plane(0.3)), ("DQ", 1, marks[0])]
    planes += [("SCI", 2, noise(), tan().to_header() + fits.Header({"BUNIT": "MJy/sr"}))]
    planes += [("ERR", 2, plane(0.1)), ("DQ", 2, marks[1])]
    path = write(noise(0.3), planes, primary={"TELESCOP": "JWST"})
    for place in (f"{path}[SCI,2]", f"{path}[4]"):
        image = read_mosaic(place)
        np.testing.assert_array_equal(image.mask, marks[1] == 1)
        np.testing.assert_allclose(image.uncertainty.array, 0.1)
    refuses(r"say which as .*\[SCI,2\]", read_mosaic, path, error=DataError)
    refuses("no such extension", read_mosaic, f"{path}[SCI,3]", error=DataError)


def bits(*values):
    """A plane in which row k has the k-th value."""
    plane = np.zeros(SHAPE, np.int32)
    for row, value in enumerate(values):
        plane[row] = value
    return plane


BITS = [
    ({"TELESCOP": "JWST"}, {}, (1, 4, 5), (True, False, True)),
    (
        {"TELESCOP": "HST", "INSTRUME": "WFC3", "DETECTOR": "IR"},
        {},
        (4, 64, 512, 8192, 32),
        (1, 0, 0, 1, 1),
    ),
    (
        {"TELESCOP": "HST", "INSTRUME": "ACS", "DETECTOR": "WFC"},
        {},
        (4, 32, 64, 4096),
        (1, 0, 0, 1),
    ),
    (
        {},
        {"MP_BAD": 0, "MP_SAT": 1, "HIERARCH MP_DETECTED": 5, "HIERARCH MP_NO_DATA": 8},
        (1, 32, 2, 256, 34),
        (1, 0, 1, 1, 1),
    ),
]


@pytest.mark.parametrize(("primary", "cards", "values", "bad"), BITS)
def test_bits_are_those_of_the_telescope(primary, cards, values, bad, write):
    name = "MASK" if cards else "DQ"
    path = write(
        noise(), [("ERR", 1, plane(0.1)), (name, 1, bits(*values), cards)], primary=primary
    )
    mask = read_mosaic(path).mask
    np.testing.assert_array_equal(mask[: len(values), 0], np.array(bad, bool))
    assert not mask[len(values) :].any()


def test_bits_of_unknown_tables_are_bad_and_said(write):
    path = write(noise(), [("ERR", 1, plane(0.1)), ("DQ", 1, bits(4, 8, 0))])
    with pytest.warns(
        PhotometryWarning, match=r"nothing says what they mean .* taken as bad, 3.33% of them"
    ):
        mask = read_mosaic(path).mask
    assert mask[:2].all()
    assert not mask[2:].any()


def test_axes_of_one_plane_are_no_cube(write):
    path = write(noise()[None], [("ERR", 1, plane(0.1)[None])])
    image = read_mosaic(path)
    np.testing.assert_array_equal(image.data, noise())
    part = MosaicFile(path, section=(slice(5, 45), slice(10, 60))).read()
    np.testing.assert_array_equal(part.data, noise()[5:45, 10:60])
    np.testing.assert_allclose(part.uncertainty.array, 0.1)


def test_an_image_without_data_is_refused(write):
    refuses("has no data in its extension SCI", read_mosaic, write(None), error=DataError)


def test_a_map_beside_a_cube_is_not_taken_for_the_image(write):
    header = fits.Header(tan().to_header())
    path = write(np.array([noise(), noise()]), [("ERR", 1, plane(0.1), header)])
    refuses(r"has the shape \(2, 60, 80\) in its extension SCI", read_mosaic, path, error=DataError)
    with fits.open(path, mode="update") as hdus:
        hdus["SCI"].name = "TIMES"
    refuses("has no two-dimensional image", read_mosaic, path, error=DataError)
    header["BUNIT"] = "MJy/sr"
    fits.ImageHDU(noise(), header, name="ERR").writeto(path, overwrite=True)
    with pytest.warns(PhotometryWarning, match="no map of the noise"):
        assert read_mosaic(f"{path}[ERR]").shape == SHAPE


def test_coordinates_without_a_solution_are_refused(write):
    wcs = tan()
    path = write(noise(), wcs=wcs, PC1_1=0.0, PC1_2=0.0, PC2_1=0.0, PC2_2=0.0)
    match = "has world coordinates that cannot be used: .*singular"
    refuses(match, read_mosaic, path, error=DataError)


@pytest.mark.parametrize("unit", ["nanomaggies", "nmgy", "UJY"])
def test_units_of_images_have_many_names(unit, write):
    image = read_mosaic(write(noise(), [("ERR", 1, plane(0.1))], BUNIT=unit))
    size = 1.0 if unit == "UJY" else 3.630780547701013
    # a flux in each pixel
    expected = 0.1 * size * 1e-12 / AREA
    assert np.median(image.uncertainty.array) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("empty", [plane(0.0), plane(np.nan), None])
def test_weights_stand_in_for_errors_that_hold_none(empty, write):
    path = write(noise(), [("ERR", 1, empty), ("WHT", 1, plane(4.0))])
    with pytest.warns(
        PhotometryWarning, match=r"ERR \(.*\) holds no noise; WHT \(weight\) is used"
    ):
        image = read_mosaic(path)
    assert np.median(image.uncertainty.array) == pytest.approx(0.1, rel=0.05)


def test_maps_without_noise_or_of_another_shape_are_refused(write):
    path = write(noise(), [("ERR", 1, plane(0.0))])
    refuses("holds no noise in ERR .* and no other map", read_mosaic, path, error=DataError)
    path = write(noise(), [("ERR", 1, plane(0.1)[:50])])
    refuses(
        r"ERR .* of the shape \(50, 80\), and its image \(60, 80\)",
        read_mosaic,
        path,
        error=DataError,
    )
    path = write(noise(), [("ERR", 1, plane(0.1)), ("DQ", 1, bits(0)[:50])])
    refuses(r"an extension DQ .* of the shape \(50, 80\)", read_mosaic, path, error=DataError)


def test_constant_planes_of_hst_are_filled(write):
    constant = {"NPIX1": SHAPE[1], "NPIX2": SHAPE[0], "PIXVALUE": 0.1}
    image = read_mosaic(write(noise(), [("ERR", 1, None, constant)]))
    np.testing.assert_allclose(image.uncertainty.array, 0.1, rtol=1e-6)


def test_errors_of_0_are_refused_by_the_reduction(write):
    keywords = {"TELESCOP": "JWST", "INSTRUME": "MIRI", "DETECTOR": "MIRIMAGE", "FILTER": "F770W"}
    path = write(noise(), [("ERR", 1, plane(0.0)), ("WHT", 1, plane(1.0))], primary=keywords)
    refuses(
        "no error in ERR, which is nowhere finite and above 0", read_images, path, error=DataError
    )


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("x_rate.fits", "adu/s"),
        ("x_cal.fits", "MJy/sr"),
        ("x_i2d.fits.gz", "MJy/sr"),
        ("X_CAL.fits", "MJy/sr"),
        ("x_median.fits", "adu/s"),
    ],
)
def test_images_named_as_products_of_jwst_have_their_layout(name, unit, tmp_path):
    flags = np.zeros(SHAPE, np.int64)
    flags[2, 3] = 1
    error = StdDevUncertainty(plane(0.1))
    wcs = imager_wcs(CENTER, 10 * u.deg)
    image = Image(
        noise(),
        unit=unit,
        uncertainty=error,
        flags=flags,
        wcs=wcs,
        filter="F770W",
        meta={"roll": 3},
    )
    image.write(tmp_path / name)
    (file,) = read_images(tmp_path / name)
    np.testing.assert_array_equal(file.image.data, noise().astype(np.float32))
    np.testing.assert_array_equal(file.image.uncertainty.array, plane(0.1).astype(np.float32))
    np.testing.assert_array_equal(file.image.mask, flags == 1)
    assert file.image.unit == u.Unit(unit)
    x, y = 3, 7
    np.testing.assert_allclose(
        file.image.wcs.pixel_to_world_values(x, y), wcs.pixel_to_world_values(x, y), atol=1e-9
    )
    header = file.header
    assert header["TELESCOP"] == "JWST"
    assert header["FILTER"] == "F770W"
    assert header["DATAMODL"] == "ImageModel"
    # one answer, whichever function is asked
    write_image(image, tmp_path / f"a_{name}")
    write_jwst_image(image, tmp_path / f"b_{name}")
    for other in "ab":
        np.testing.assert_array_equal(
            read_images(tmp_path / f"{other}_{name}")[0].image.data, file.image.data
        )
    with pytest.raises(OSError, match="exist"):
        image.write(tmp_path / name)
    image.write(tmp_path / name, overwrite=True)
    image.write(tmp_path / "calibrated.fits")
    np.testing.assert_array_equal(CCDData.read(tmp_path / "calibrated.fits").data, noise())


@pytest.mark.parametrize(
    ("name", "unit", "band", "wanted"),
    [
        ("x_uncal.fits", "adu/s", "F770W", "Ramp.write.path. writes ramps"),
        ("x_ramp.fits", "adu/s", "F770W", "Ramp.write.path. writes ramps"),
        ("x_rate.fits", "MJy/sr", "F770W", "image in DN/s alone, got .* for MJy / sr"),
        ("x_i2d.fits", "adu/s", "F770W", "image in MJy/sr alone, got .* for adu / s"),
        ("x_cal.fits", "MJy/sr", None, "meta.'filter'. states it, got filter None"),
        ("x_cal.fits", "MJy/sr", "nircam.f444w", "of a filter of the MIRI imager"),
    ],
)
def test_images_that_are_no_products_of_miri_get_no_name_of_theirs(
    name, unit, band, wanted, tmp_path
):
    image = Image(noise(), unit=unit)
    if band is not None:
        image = Image(noise(), unit=unit, filter=band)
    refuses(wanted, image.write, tmp_path / name)
    refuses(wanted, write_image, image, tmp_path / name)
    refuses(wanted, write_jwst_image, image, tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "unit", "factor"),
    [
        ("x_rate.fits", "DN/s", 1.0),
        ("x_rate.fits", "1000 adu/s", 1000.0),
        ("x_cal.fits", "MJy/sr", 1.0),
        # 1 mJy/arcsec2 in MJy/sr: (180 * 3600 / pi)**2 * 1e-9
        ("x_i2d.fits", "mJy/arcsec2", 42.545170),
    ],
)
def test_products_without_distortion_come_back_in_their_unit(name, unit, factor, tmp_path):
    mask = np.zeros(SHAPE, bool)
    mask[2, 3] = True
    image = Image(
        noise(),
        unit=unit,
        uncertainty=VarianceUncertainty(plane(0.01)),
        mask=mask,
        wcs=tan(),
        filter="F770W",
    )
    write_image(image, tmp_path / name, planes={"dq": 4 * mask})
    (file,) = read_images(tmp_path / name)
    read_images_of_it = [file.image, read_image(tmp_path / name)]
    if "rate" not in name:
        read_images_of_it.append(read_mosaic(tmp_path / name))
    for read in read_images_of_it:
        assert read.unit in (u.adu / u.s, u.MJy / u.sr)
        np.testing.assert_allclose(read.data, noise() * factor, rtol=1e-6)
        np.testing.assert_allclose(read.uncertainty.array, 0.1 * factor, rtol=1e-6)
        np.testing.assert_array_equal(read.mask, mask)
        np.testing.assert_allclose(
            read.wcs.pixel_to_world_values(3, 7), image.wcs.pixel_to_world_values(3, 7), atol=1e-9
        )
    np.testing.assert_array_equal(file.image.flags != 0, mask)
    assert file.image.flags[2, 3] == 5
    with fits.open(tmp_path / name) as hdus:
        assert (hdus[0].header.get("S_RESAMP") == "COMPLETE") == ("i2d" in name)
        if "i2d" in name:
            # of the mosaic's own pixels
            assert hdus["SCI"].header["PIXAR_SR"] == pytest.approx(AREA)
            assert "AREA" not in hdus


@pytest.mark.parametrize(
    ("name", "shape"), [("x_cal.fits", (2, *SHAPE)), ("x_calints.fits", SHAPE)]
)
def test_products_have_the_axes_of_their_name(name, shape, tmp_path):
    image = Image(np.ones(shape), unit="MJy/sr", filter="F770W")
    refuses("'image' must be of [23] axes to be written as", image.write, tmp_path / name)


@pytest.mark.parametrize("name", ["own.fits", "x_cal.fits"])
def test_an_uncertainty_has_a_unit_of_its_own(name, tmp_path):
    error = StdDevUncertainty(plane(100.0), unit="kJy/sr")
    image = Image(noise(), unit="MJy/sr", uncertainty=error, wcs=tan(), filter="F770W")
    image.write(tmp_path / name)
    np.testing.assert_allclose(read_mosaic(tmp_path / name).uncertainty.array, 0.1, rtol=1e-6)
    np.testing.assert_allclose(sigma(image), 0.1)


def test_images_without_coordinates_are_refused_for_that(tmp_path):
    Image(noise(), unit="MJy/sr", filter="F770W").write(tmp_path / "x_cal.fits")
    refuses("has no celestial coord", read_mosaic, tmp_path / "x_cal.fits", error=DataError)


def test_options_of_astropy_are_refused_for_products_of_jwst(tmp_path):
    image = Image(noise(), unit="MJy/sr", filter="F770W")
    refuses(
        "with options of CCDData.write, got hdu_mask",
        image.write,
        tmp_path / "x_cal.fits",
        hdu_mask="M",
    )
    refuses("'rounded' must be False", write_image, image, tmp_path / "x_cal.fits", rounded=True)


@pytest.mark.parametrize("kind", ["MIR_TACQ", "MIR_4QPM", "MIR_LYOT", "NRC_GRISM", "NIS_AMI"])
def test_exposures_that_are_no_images_of_the_sky_are_refused(write, kind):
    path = write(noise(), primary={"TELESCOP": "JWST", "EXP_TYPE": kind, "FILTER": "F770W"})
    wanted = f"must be an image of the sky .* got {kind}"
    refuses(wanted, read_mosaic, path, error=DataError)
    refuses(wanted, lambda: MosaicFile(path).header, error=DataError)


@pytest.mark.parametrize("kind", ["MIR_IMAGE", "NRC_IMAGE", "NRC_TSIMAGE", "ANY", None])
def test_images_of_the_sky_are_read_whatever_their_telescope(write, kind):
    primary = {"EXP_TYPE": kind} if kind else {"TELESCOP": "HST", "EXP_TYPE": "SPECTRUM"}
    path = write(noise(), primary=primary)
    with pytest.warns(PhotometryWarning, match="no map of the noise"):
        assert read_mosaic(path).shape == SHAPE


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [
        *((name, 0.1, "error") for name in ("NOISE", "STD", "UNC", "RMSMAP")),
        ("STAT", 0.01, "variance"),
        ("INVERSE_VARIANCE", 100.0, "inverse_variance"),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_maps_of_the_noise_by_the_names_of_others(tmp_path, name, value, kind, first):
    """A map of the noise is never taken for the image, though it may be the first of the file."""
    data = noise()
    header = tan().to_header(relax=True)
    header["BUNIT"] = "MJy/sr"
    planes = [
        fits.ImageHDU(data, header, name="IMAGE"),
        fits.ImageHDU(plane(value), header, name=name),
    ]
    if first:
        planes = planes[::-1]
    fits.HDUList([fits.PrimaryHDU(), *planes]).writeto(tmp_path / "i.fits")
    image = read_mosaic(tmp_path / "i.fits")
    np.testing.assert_array_equal(image.data, data)
    assert image.meta["noise"].startswith(kind)
    np.testing.assert_allclose(image.uncertainty.array, 0.1, rtol=1e-6)


@pytest.mark.parametrize("name", ["MASK", "BPM", "BADPIX", "FLAGS"])
def test_planes_of_bad_pixels_by_the_names_of_others(write, name):
    bad = np.zeros(SHAPE, np.uint8)
    bad[:, :5] = 1
    image = read_mosaic(write(noise(), [("ERR", 1, plane(0.1)), (name, 1, bad)]))
    np.testing.assert_array_equal(image.mask, bad == 1)


def test_a_mask_of_good_pixels_is_warned_of(write):
    good = np.ones(SHAPE, np.uint8)
    good[:, :5] = 0
    path = write(noise(), [("ERR", 1, plane(0.1)), ("MASK", 1, good)])
    with pytest.warns(PhotometryWarning, match="excludes 94% of the pixels with data"):
        read_mosaic(path)


@pytest.mark.parametrize("number", [-99.0, 0.0, 1e30, -1e31])
def test_areas_of_one_number_have_no_data(write, number):
    data = noise()
    data[:, :8] = number
    path = write(data, [("ERR", 1, plane(0.1))])
    with pytest.warns(PhotometryWarning, match=r"480 pixels in areas that are exactly [-\d]"):
        image = read_mosaic(path)
    np.testing.assert_array_equal(image.mask, data == np.float32(number))


def test_plateaus_of_stars_and_noise_of_few_counts_are_data(write):
    y, x = np.indices(SHAPE)
    star = 1e3 * np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 60) + noise()
    # a saturated core
    clipped = np.minimum(star, 500).astype(np.float32)
    assert np.count_nonzero(clipped == 500) > 100
    assert not read_mosaic(write(clipped, [("ERR", 1, plane(0.1))])).mask.any()
    # four of ten pixels are 0 by chance, as counts are whole
    counts = np.round(noise(1.0))
    assert 0.3 < np.mean(counts == 0) < 0.5
    assert not read_mosaic(write(counts, [("ERR", 1, plane(1.0))])).mask.any()


@pytest.mark.parametrize(
    ("text", "jansky"),
    [("JY/PIXEL", 1.0), ("UJY/pix", 1e-6), ("microJy/arcsec2", 1e-6 * SCALE**2 * 3600**2)],
)
def test_units_of_brightness_in_capitals_and_words(write, text, jansky):
    data = noise()
    image = read_mosaic(write(data, [("ERR", 1, plane(0.1))], BUNIT=text))
    np.testing.assert_allclose(image.data, data * (jansky * 1e-6 / AREA), rtol=1e-4)


def test_uncertainties_of_unknown_kind_are_refused():
    image = CCDData(noise(), unit="MJy/sr", wcs=tan(), uncertainty=UnknownUncertainty(plane(0.1)))
    refuses("a StdDevUncertainty, .* got UnknownUncertainty", image_arrays, image, "image")


@pytest.mark.parametrize(
    ("angles", "expected"),
    [
        ([10.0] * 4, 10.0),
        ([359.8, 0.2, 359.9, 0.1], 359.8),
        ([10.0, 10.0, 100.0, 100.0], [10.0, 100.0]),
        ([10.0, 10.0, 10.0, 100.0], [10.0, 10.0, 10.0, 100.0]),
    ],
)
def test_a_mosaic_of_visits_has_the_angles_of_all_of_them(write, angles, expected):
    """The header of an _i2d of jwst has the angle of its first exposure, its extension HDRTAB those of all."""
    keywords = {"TELESCOP": "JWST", "INSTRUME": "MIRI", "FILTER": "F770W", "PA_APER": angles[0]}
    noise = np.random.default_rng(1).normal(0.0, 1.0, SHAPE)
    path = write(noise, [("ERR", 1, np.ones(SHAPE))], primary=keywords)
    with fits.open(path, mode="append") as hdus:
        columns = [fits.Column("PA_APER", "D", array=angles)]
        hdus.append(fits.BinTableHDU.from_columns(columns, name="HDRTAB"))
    file = MosaicFile(path)
    np.testing.assert_array_equal(file.header.pa_aper.value, expected)
    assert file.read().meta["pa_aper"] == expected
    psf = image_psf(file)
    at = {"pixel_scale": 0.1 * u.arcsec, "shape": 41}
    of_all = filter_psf("F770W", pa=expected * u.deg, pixel_scale=0.1 * u.arcsec)
    np.testing.assert_allclose(psf_image(psf, **at), psf_image(of_all, **at), atol=1e-8)


def test_the_first_of_several_images_is_named(tmp_path):
    header = tan().to_header(relax=True)
    header["BUNIT"] = "MJy/sr"
    hdus = [fits.ImageHDU(k + noise(), header, name=f"BAND{k}") for k in (1, 2)]
    hdus.append(fits.ImageHDU(plane(0.1), name="ERR"))
    path = tmp_path / "c.fits"
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    with pytest.warns(PhotometryWarning, match=r"has 2 images \(BAND1, BAND2\): the first is used"):
        image = read_mosaic(path, error=f"{path}[ERR]")
    assert np.median(image.data) == pytest.approx(1.0, abs=0.02)
    image = read_mosaic(f"{path}[BAND2]", error=f"{path}[ERR]")
    assert np.median(image.data) == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize("positions", [[(53.1, -27.8)], {"ra": [53.1], "dec": [-27.8]}])
def test_positions_that_are_no_coordinates_are_refused(positions):
    error = StdDevUncertainty(plane(0.1))
    image = Image(noise(), unit="MJy/sr", uncertainty=error, wcs=tan(), filter="F770W")
    refuses(
        "'sky' must be a SkyCoord, such as",
        aperture_photometry,
        image,
        positions,
        1 * u.arcsec,
    )
