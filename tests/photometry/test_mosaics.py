"""Images of known flux in every unit and noise map; what cannot be used is refused by name."""

import gzip

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from helpers.scenes import distorted_wcs
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import MosaicFile, read_mosaic, weight_scale
from miricigale.utils.exceptions import DataError, MiricigaleWarning

SHAPE, SCALE, FLUX = (120, 140), 0.06, 20.0


def micro_jansky():
    """A Gaussian of 20 uJy, uJy in each pixel."""
    y, x = np.indices(SHAPE)
    return FLUX * np.exp(-0.5 * ((x - 70) ** 2 + (y - 60) ** 2) / 9) / (2 * np.pi * 9)


@pytest.fixture
def write(tools, tmp_path):
    wcs = north_up_wcs(tools.CENTER, SCALE * u.arcsec, SHAPE)

    def written(data, name="image.fits", *, shift=0.0, planes=(), wcs=wcs, ext="SCI", **header):
        hdu = fits.ImageHDU(np.asarray(data, np.float32), name=ext)
        if wcs is not None:
            hdu.header.update(wcs.to_header(relax=True))
            hdu.header["CRPIX1"] += shift
        hdu.header.update({key: value for key, value in header.items() if value is not None})
        more = [fits.ImageHDU(plane, name=key) for key, plane in dict(planes).items()]
        path = tmp_path / name
        fits.HDUList([fits.PrimaryHDU(), hdu, *more]).writeto(path)
        return path

    return written


def total(image):
    """Flux in uJy of an image in MJy/sr: brightness times the pixels' solid angle."""
    area = pixel_area_map(image.wcs, image.shape)
    return float(np.sum(np.where(image.mask, 0, image.data) * area)) * 1e12


#: Keywords, options and counts of one uJy. The AB zero point of PHOTFLAM and PHOTPLAM is that of the
#: HST data handbooks; one count a second of PHOTMJSR is a brightness.
PIXEL_SR = (SCALE * np.pi / 648000) ** 2
HST = {"PHOTFLAM": 1.9275e-20, "PHOTPLAM": 15369.0}
HST_ZERO = -2.5 * np.log10(HST["PHOTFLAM"]) - 5 * np.log10(HST["PHOTPLAM"]) - 2.408
HST_RATE = 10 ** (0.4 * (HST_ZERO - 23.9))
UNITS = {
    "MJy/sr": ({"BUNIT": "MJy/sr"}, {}, 1e-12 / PIXEL_SR),
    "uJy": ({"BUNIT": "uJy"}, {}, 1.0),
    "nJy a pixel": ({"BUNIT": "nJy/pixel"}, {}, 1e3),
    "10 nJy": ({"BUNIT": "10.0*nanoJansky"}, {}, 1e2),
    "10 nJy, given": ({}, {"unit": "10 nJy"}, 1e2),
    "Jy": ({"BUNIT": "Jy"}, {}, 1e-6),
    "uJy/arcsec2": ({"BUNIT": "uJy/arcsec2"}, {}, 1 / SCALE**2),
    "counts": ({"BUNIT": "counts/s"}, {"zero_point": 25.0}, 10 ** (0.4 * (25.0 - 23.9))),
    "counts, in total": ({}, {"zero_point": 30 * u.ABmag}, 10 ** (0.4 * (30.0 - 23.9))),
    "HST": ({"BUNIT": "ELECTRONS/S", **HST}, {}, HST_RATE),
    "HST, in total": ({"BUNIT": "ELECTRONS", "EXPTIME": 1200.0, **HST}, {}, 1200 * HST_RATE),
    "JWST rate": ({"BUNIT": "DN/s", "PHOTMJSR": 0.25}, {}, 1e-12 / PIXEL_SR / 0.25),
}


@pytest.mark.parametrize("name", UNITS)
def test_a_source_has_its_flux_in_every_unit(write, name):
    header, options, per_micro = UNITS[name]
    path = write(micro_jansky() * per_micro, **header)
    error = write(np.full(SHAPE, 1e-3 * per_micro), "error.fits", wcs=None)
    with pytest.warns(MiricigaleWarning, match="times what the error map says"):
        image = read_mosaic(path, error=error, **options)
    assert image.unit == u.MJy / u.sr
    # the constants of AB magnitudes in the handbooks have three decimals
    assert total(image) == pytest.approx(FLUX, rel=1e-3)
    area = pixel_area_map(image.wcs, SHAPE)
    assert_allclose(image.uncertainty.array * area, 1e-15, rtol=1e-3)


@pytest.mark.parametrize(
    ("header", "options", "message"),
    [
        ({}, {}, "must state the unit of its pixels"),
        ({"BUNIT": "furlong x"}, {}, "what it states is 'furlong x'"),
        ({"BUNIT": "ELECTRONS"}, {}, "counts need 'zero_point'"),
        ({"BUNIT": "COUNTS", "EXPTIME": 0.0}, {}, "no rate, and its header no EXPTIME"),
        ({"BUNIT": "COUNTS", "EXPTIME": 10.0}, {}, "neither PHOTMJSR nor PHOTFLAM: give 'zero_point'"),
        ({"BUNIT": "mJy/beam"}, {}, "wanted is a surface brightness"),
        ({"BUNIT": "counts/s"}, {}, "neither PHOTMJSR nor PHOTFLAM: give 'zero_point'"),
        ({"BUNIT": "DN/s", "PHOTMJSR": 1.0, **HST}, {}, "both PHOTMJSR and PHOTFLAM"),
        ({"BUNIT": "uJy"}, {"zero_point": 23.9}, "'zero_point' must be left out"),
        ({"BUNIT": "uJy", "INSTRUME": "MIRI", "FILTER": "F770W"}, {"filter": "miri.f1000w"},
         "'filter' must be 'miri.f770w', the filter in .*image.fits"),
        ({"BUNIT": "uJy"}, {"background_box": 0}, "'background_box' must be at least 1"),
        ({"BUNIT": "uJy", "wcs": None}, {}, "no celestial coordinates"),
        ({"BUNIT": "uJy", "ext": "OTHER"}, {"error": "absent.fits"}, "absent.fits cannot be read"),
    ],
)  # fmt: skip
def test_what_cannot_be_calibrated_is_refused_by_name(write, header, options, message):
    with pytest.raises((DataError, ValueError), match=message):
        read_mosaic(write(micro_jansky(), **header), **options)


def test_maps_must_be_those_of_the_image(write, tmp_path):
    path = write(micro_jansky(), BUNIT="uJy")
    moved = write(np.ones(SHAPE), "moved.fits", shift=3.0)
    maps = {"variance": moved, "weight": moved}
    refuses("at most one of them, got variance and weight", MosaicFile, path, **maps)
    message = r"no such extension, only \['PRIMARY', 'SCI'\]"
    refuses(message, read_mosaic, f"{path}[ERR]", error=DataError)
    for weight, message in (
        (moved, r"moved.fits is not on the pixels .* up to 3 pixels apart"),
        (write(np.ones((5, 5)), "small.fits"), r"the weight of .*\) has the shape \(5, 5\)"),
        (write(np.zeros(SHAPE), "zero.fits"), "no usable pixel"),
    ):
        refuses(message, read_mosaic, path, weight=weight, error=DataError)
    flat = write(np.ones(SHAPE), "flat.fits", BUNIT="uJy")
    with (
        pytest.warns(MiricigaleWarning, match="noise on the sky is 0 times"),
        pytest.raises(DataError, match="weights of unknown scale, for its sky is constant"),
    ):
        read_mosaic(flat, weight=write(np.ones(SHAPE), "one.fits"))


def noise(rng, kind):
    if kind == "white":
        return rng.normal(size=(400, 400))
    # as in an image whose pixels were replicated
    return np.kron(rng.normal(size=(200, 200)), np.ones((2, 2)))


@pytest.mark.parametrize("kind", ["white", "replicated"])
@pytest.mark.parametrize("scale", [0.61, 1.0, 229.0])
def test_the_scale_of_weights_is_measured_between_sources(kind, scale):
    rng = np.random.default_rng(8)
    depth = np.geomspace(0.5, 2.0, 400)[None] * np.ones((400, 1))
    y, x = np.indices((400, 400))
    sources = np.zeros((400, 400))
    for _ in range(80):
        a, b = rng.uniform(0, 400, 2)
        sources += 10 ** rng.uniform(0, 3) * np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / 9)
    data = (noise(rng, kind) * depth + sources) * scale
    weight = 1 / depth**2
    weight[:, 300:] *= rng.random((400, 100)) > 0.1
    data[:20] = np.nan
    assert weight_scale(data, weight) == pytest.approx(scale, rel=0.02)


def test_weights_become_errors_and_other_maps_stay(write):
    rng = np.random.default_rng(5)
    sigma = np.where(np.indices(SHAPE)[1] < 70, 0.1, 0.3)
    data = rng.normal(size=SHAPE) * sigma
    path = write(data, BUNIT="MJy/sr")
    maps = {"error": sigma, "variance": sigma**2, "inverse_variance": sigma**-2}
    maps["weight"] = (0.5 / sigma) ** 2
    for kind, values in maps.items():
        image = read_mosaic(path, **{kind: write(values, f"{kind}.fits")})
        tolerance = 0.03 if kind == "weight" else 1e-5
        assert_allclose(image.uncertainty.array, sigma, rtol=tolerance)
        assert not image.mask.any()
        assert image.meta["noise_scale"] == pytest.approx(0.5 if kind == "weight" else 1, rel=0.03)
        assert ("weight_scale" in image.meta) == (kind == "weight")
    with pytest.warns(MiricigaleWarning, match="noise on the sky is .* times what the weight map"):
        read_mosaic(path, weight=write(sigma**-2 * 1e4, "other.fits"))
    with pytest.warns(MiricigaleWarning, match="no map of the noise"):
        assert read_mosaic(path).uncertainty is None


def test_pixels_without_data_are_masked(write):
    rng = np.random.default_rng(6)
    data, err, wht = rng.normal(size=SHAPE), np.ones(SHAPE), np.ones(SHAPE)
    dq = np.zeros(SHAPE, np.uint32)
    data[3, 4], err[5, 6], err[7, 8], wht[9, 10] = np.nan, np.nan, 0, 0
    # not to be used; a jump alone is no harm
    dq[11, 12], dq[13, 14] = 1 + 4, 4
    planes = {"ERR": err, "WHT": wht, "DQ": dq}
    path = write(data, BUNIT="MJy/sr", planes=planes, FILTER="F444W", PUPIL="CLEAR",
                 INSTRUME="NIRCAM", PA_APER=12.5)  # fmt: skip
    image = read_mosaic(path)
    bad = {tuple(map(int, one)) for one in np.argwhere(image.mask)}
    assert bad == {(3, 4), (5, 6), (7, 8), (9, 10), (11, 12)}
    assert image.meta["n_masked"] == 5
    header = MosaicFile(path).header
    assert header.filter == "nircam.f444w"
    assert header.pa_aper == 12.5 * u.deg
    # the pupil wheel holds the filter that counts
    narrow = write(data, "narrow.fits", FILTER="F444W", PUPIL="F470N", INSTRUME="NIRCAM")
    assert MosaicFile(narrow).header.filter == "nircam.f470n"


def test_a_background_is_subtracted_where_asked_for(write):
    rng = np.random.default_rng(2)
    y, _ = np.indices(SHAPE)
    data, error = 5 + 0.0005 * y + rng.normal(0, 0.1, SHAPE), np.full(SHAPE, 0.1)
    path = write(data, BUNIT="MJy/sr", planes={"ERR": error})
    assert read_mosaic(path).meta["sky_over_noise"] > 40
    image = read_mosaic(path, background_box=30)
    assert abs(image.meta["sky_over_noise"]) < 0.3
    assert abs(image.data.mean()) < 0.02


def test_a_real_i2d_file_of_the_jwst_pipeline(data_file):
    path = next(data_file("real/i2d").glob("*04101*_i2d.fits"))
    # a nebula has no empty sky
    image = warned("times what the error map says", read_mosaic, path)
    assert image.meta["filter"] == "miri.f1130w"
    assert image.meta["pa_aper"] == pytest.approx(273.2125, abs=1e-3)
    data = fits.getdata(path, "SCI")
    good = ~image.mask
    assert 0.8 < good.mean() < 1
    assert_array_equal(image.data[good], data[good])
    # the pipeline's nominal area of a pixel, which is constant, and the WCS's
    area = np.median(pixel_area_map(image.wcs, data.shape))
    assert area == pytest.approx(fits.getval(path, "PIXAR_SR", "SCI"), rel=0.005)


@pytest.mark.parametrize("kind", ["error", "variance", "inverse_variance"])
def test_maps_in_another_unit_than_the_image_are_converted(write, kind):
    rng, power = np.random.default_rng(7), {"error": 1, "variance": 2, "inverse_variance": -2}[kind]
    path = write(rng.normal(0, 0.1, SHAPE), BUNIT="MJy/sr")
    unit = "kJy/sr" if power == 1 else f"kJy{power} sr{-power}"
    map_ = write(np.full(SHAPE, 100.0) ** power, "map.fits", BUNIT=unit)
    image = read_mosaic(path, **{kind: map_})
    assert_allclose(image.uncertainty.array, 0.1, rtol=1e-5)
    # said to be in the unit of the image: the power goes without saying
    plain = write(np.full(SHAPE, 0.1) ** power, "plain.fits", BUNIT="MJy/sr")
    assert_allclose(read_mosaic(path, **{kind: plain}).uncertainty.array, 0.1, rtol=1e-5)
    other = write(np.full(SHAPE, 0.1) ** power, "other.fits", BUNIT="ELECTRONS/S")
    message = r"other.fits .* is in 'ELECTRONS/S', the image in 'MJy/"
    with pytest.raises(DataError, match=message):
        read_mosaic(path, **{kind: other})
    # what the caller states holds for both
    counts = write(rng.normal(0, 0.1, SHAPE), "counts.fits", BUNIT="ELECTRONS/S")
    image = read_mosaic(counts, unit="MJy/sr", **{kind: other})
    assert image.meta["noise_scale"] == pytest.approx(1, rel=0.03)


@pytest.mark.parametrize("kind", ["packed", "compressed", "integers", "big"])
def test_stored_forms_give_the_same_image(write, tmp_path, kind):
    sigma = np.full(SHAPE, 1e-3, np.float32)
    path = write(micro_jansky() + np.random.default_rng(1).normal(0, 1e-3, SHAPE), BUNIT="uJy",
                 planes={"ERR": sigma})  # fmt: skip
    with fits.open(path) as hdus:
        data, header = hdus["SCI"].data, hdus["SCI"].header
        if kind == "packed":
            (tmp_path / "other.fits").write_bytes(gzip.compress(path.read_bytes()))
        elif kind == "compressed":
            stored = fits.CompImageHDU(data, header, name="SCI", quantize_level=100)
        else:
            stored = fits.ImageHDU(data.astype(">f8"), header, name="SCI")
            if kind == "integers":
                stored.scale("int32", "minmax")
        if kind != "packed":
            fits.HDUList([hdus[0], stored, hdus["ERR"]]).writeto(tmp_path / "other.fits")
    one, other = read_mosaic(path), read_mosaic(tmp_path / "other.fits")
    assert one.data.dtype == np.dtype("=f4")
    assert other.data.dtype.isnative
    assert_allclose(other.data, one.data, atol=0.05 * one.uncertainty.array.max())
    # of each form a part, in the same units
    part = read_mosaic(tmp_path / "other.fits", section=np.s_[20:75, 11:90])
    assert_allclose(part.data, other.data[20:75, 11:90], rtol=1e-5)
    assert_allclose(part.uncertainty.array, other.uncertainty.array[20:75, 11:90], rtol=1e-5)


def test_a_part_of_a_distorted_image_is_where_it_was(write):
    wcs = distorted_wcs()
    mask = np.random.default_rng(1).random(SHAPE) < 0.1
    planes = {"DQ": mask.astype(np.int32), "ERR": np.full(SHAPE, 1.0)}
    path = write(np.random.default_rng(2).normal(0, 1, SHAPE), wcs=wcs, BUNIT="uJy", planes=planes)
    part = read_mosaic(path, section=np.s_[7:60, 33:90])
    assert_array_equal(part.mask, mask[7:60, 33:90])
    x, y = np.meshgrid(np.arange(0, 57, 8), np.arange(0, 53, 8))
    there = wcs.pixel_to_world(x + 33, y + 7)
    assert part.wcs.pixel_to_world(x, y).separation(there).max() < 1e-6 * u.arcsec


@pytest.fixture
def exposure(write, tools):
    """A single exposure whose distortion is in the ASDF extension alone, and its true coordinates."""
    pytest.importorskip("gwcs")
    asdf = pytest.importorskip("asdf")
    import io

    import gwcs
    from astropy.coordinates import ICRS
    from astropy.modeling import models
    from gwcs import coordinate_frames

    bend = models.Polynomial2D(2, c1_0=1, c2_0=3e-4), models.Polynomial2D(2, c0_1=1, c0_2=-2e-4)
    plane = models.Shift(-69.5) & models.Shift(-59.5) | models.Mapping((0, 1, 0, 1))
    plane = plane | bend[0] & bend[1] | models.Scale(-SCALE / 3600) & models.Scale(SCALE / 3600)
    center = tools.CENTER
    turn = models.RotateNative2Celestial(center.ra.deg, center.dec.deg, 180)
    sky = coordinate_frames.CelestialFrame(reference_frame=ICRS(), unit=(u.deg, u.deg))
    detector = coordinate_frames.Frame2D(name="detector", unit=(u.pix, u.pix))
    exact = gwcs.WCS([(detector, plane | models.Pix2Sky_TAN() | turn), (sky, None)])
    stream = io.BytesIO()
    asdf.AsdfFile({"meta": {"wcs": exact}}).write_to(stream)

    def made(name, **header):
        path = write(np.random.default_rng(1).normal(size=SHAPE), name, BUNIT="MJy/sr",
                     planes={"ERR": np.ones(SHAPE, np.float32)}, **header)  # fmt: skip
        with fits.open(path, mode="append") as hdus:
            content = np.frombuffer(stream.getvalue(), np.uint8)[None]
            column = fits.Column("ASDF_METADATA", f"{content.shape[1]}B", array=content)
            hdus.append(fits.BinTableHDU.from_columns([column], name="ASDF"))
        return path

    return made, exact


def test_coordinates_of_an_exposure_are_those_of_its_gwcs(exposure, monkeypatch):
    made, exact = exposure
    cal = made("cal.fits", S_WCS="COMPLETE")
    x, y = np.array([[3.0, 70, 130, 10], [5.0, 60, 110, 115]])
    truth = exact(x, y)

    def distance(path):
        image = read_mosaic(path)
        return np.max(np.hypot(*(np.subtract(image.wcs.world_to_pixel_values(*truth), (x, y)))))

    assert distance(cal) < 0.02
    # a mosaic has those of its header
    mosaic = made("i2d.fits", S_WCS="COMPLETE", S_RESAMP="COMPLETE")
    with pytest.warns(
        MiricigaleWarning, match=r"\(gwcs\) are up to .* those of the header are used"
    ):
        assert 0.5 < distance(mosaic) < 3
    nothing = made("none.fits", wcs=None)
    assert distance(nothing) < 0.02
    monkeypatch.setitem(__import__("sys").modules, "gwcs", None)
    message = r"lack the distortion.*pip install 'miricigale\[gwcs\]'"
    with pytest.warns(MiricigaleWarning, match=message):
        assert 0.5 < distance(cal) < 3
    with pytest.raises(ImportError, match=r"'gwcs' is needed for this: pip install"):
        MosaicFile(nothing).header  # noqa: B018
