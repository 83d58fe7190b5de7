"""Images of the pipeline's later stages, real and written as it writes them."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.wcs import WCS
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from helpers.exposures import exposure_of, sky_of
from helpers.references import imager_keywords
from miricigale.detector import CosmicRays, Detector, Ramp
from miricigale.instrument import DQ, ExposureHistory, ImageFacts, joined_header
from miricigale.reduction import Reducer, open_exposure, read_images, write_image
from miricigale.utils.exceptions import DataError

I2D = "real/i2d/jw01288015001_04101_00001_mirimage_i2d.fits"
RATEINTS = "real/ramps/MIRI_5582_89_S_20180308-010230_SCE1_pipe_rateints.fits.gz"


@pytest.fixture
def exposure():
    return exposure_of(n_groups=12, subarray="SUB64", dither=1)


def rate_file(path, exposure, *, unit="DN/s", steps=("S_LINEAR", "S_DARK", "S_RAMP"), **planes):
    """A ``_rate`` file with the keywords of JWST alone."""
    rng = np.random.default_rng(2)
    data = rng.normal(20, 0.5, exposure.shape).astype(np.float32)
    dq = np.zeros(exposure.shape, np.uint32)
    dq[10, 20], dq[11, 21] = DQ.DO_NOT_USE | DQ.OTHER_BAD_PIXEL, DQ.JUMP_DET
    primary = fits.PrimaryHDU()
    given = {"DETECTOR": "MIRIMAGE", "FILTER": "F1000W", "NGROUPS": 12, "TGROUP": 0.085}
    given |= {
        "EFFEXPTM": 1.02,
        "EXPMID": 60000.5,
        "PATT_NUM": 2,
        "PROGRAM": "01345",
        "TITLE": "a" * 67,
    }
    given |= {"R_FLAT": "crds://jwst_miri_flat_0786.fits", **dict.fromkeys(steps, "COMPLETE")}
    primary.header.update(imager_keywords(**given))
    pointed = {"RA_REF": 53.1344, "DEC_REF": -27.8344, "ROLL_REF": 30.0}
    science = fits.Header({"BUNIT": unit, **pointed})
    hdus = [primary, fits.ImageHDU(data, science, name="SCI")]
    planes = {"ERR": np.full(exposure.shape, 0.5), "DQ": dq, **planes}
    for name, plane in planes.items():
        if plane is not None:
            kind = np.uint32 if name == "DQ" else np.float32
            hdus.append(fits.ImageHDU(np.asarray(plane, kind), name=name))
    fits.HDUList(hdus).writeto(path)
    return data


@pytest.mark.parametrize("unit", ["DN/s", "adu/s", "DN / s"])
def test_a_rate_of_the_pipeline(tmp_path, exposure, unit):
    path = tmp_path / "jw_rate.fits"
    data = rate_file(path, exposure, unit=unit)
    (file,) = read_images(path)
    image = file.image
    assert image.unit == u.adu / u.s
    assert_array_equal(image.data, data)
    assert image.flags[10, 20] == DQ.DO_NOT_USE | DQ.OTHER_BAD_PIXEL
    assert image.flags[11, 21] == DQ.JUMP_DET
    assert_array_equal(np.argwhere(image.mask), [[10, 20]])
    facts, history = ImageFacts.of(image), ExposureHistory.of(image)
    assert (facts.filter, facts.subarray, history.day) == ("miri.f1000w", "SUB64", 60000.5)
    assert history.steps == {"linearity", "dark", "ramp_fit"}
    assert history.origin == "other"
    assert image.meta["reference_flat"] == "jwst_miri_flat_0786.fits"
    assert image.meta["dither"] == 1
    # a rate has the linear part of the coordinates; the distortion is the imager's
    for x, y in ((0, 0), (70, 60)):
        expected = exposure.wcs.pixel_to_world(x, y)
        assert image.wcs.pixel_to_world(x, y).separation(expected) < 1e-4 * u.arcsec


def test_errors_come_from_variances_where_there_are_no_others(tmp_path, exposure):
    plane = np.ones(exposure.shape)
    variances = {"VAR_POISSON": 0.09 * plane, "VAR_RNOISE": 0.16 * plane}
    rate_file(tmp_path / "a_rate.fits", exposure, ERR=None, **variances)
    (file,) = read_images(tmp_path / "a_rate.fits")
    assert_allclose(file.image.uncertainty.array, 0.5, rtol=1e-6)
    assert set(file.planes) == {"VAR_POISSON", "VAR_RNOISE"}
    for name, options, match in (
        ("b", {"VAR_FLAT": np.ones((3, 4))}, r"must have \(64, 72\) pixels in VAR_FLAT"),
        ("c", {"unit": "Jy"}, "must state in BUNIT that it is a rate"),
    ):
        path = tmp_path / f"{name}_rate.fits"
        rate_file(path, exposure, **options)
        refuses(match, read_images, path, error=DataError)


@pytest.mark.filterwarnings("ignore::astropy.wcs.FITSFixedWarning")
def test_a_real_image_of_the_pipeline(data_file, tmp_path):
    path = data_file(I2D)
    (file,) = read_images(path)
    with fits.open(path) as hdus:
        assert_array_equal(file.image.data, hdus["SCI"].data)
        assert_array_equal(file.image.uncertainty.array, hdus["ERR"].data)
        assert_array_equal(file.planes["WHT"], hdus["WHT"].data)
        wcs = WCS(hdus["SCI"].header)
    assert file.image.unit == "MJy / sr"
    assert_array_equal(file.image.mask, ~(file.planes["WHT"] > 0) | np.isnan(file.image.data))
    total = sum(file.planes[name] for name in ("VAR_POISSON", "VAR_RNOISE", "VAR_FLAT"))
    good = ~file.image.mask
    known = good & np.isfinite(total)
    assert known.sum() > 0.99 * good.sum()
    assert_allclose(file.image.uncertainty.array[known] ** 2, total[known], rtol=1e-4)
    assert file.image.wcs.pixel_to_world(3, 4).separation(wcs.pixel_to_world(3, 4)) < 1 * u.mas
    assert ImageFacts.of(file.image).filter == "miri.f1130w"
    assert file.image.meta["photmjsr"] == pytest.approx(1.188432)
    # a single one says what it lacks, and the light of the target fills the image
    result = warned("cannot be trusted to better than", Reducer().run, [path], wcs=file.image.wcs)
    assert result.rates == ()
    wanted = "a single dither: outliers", "1 of 1 backgrounds", "the background of the mosaic"
    assert tuple(note.split(" cannot")[0] for note in result.notes) == wanted
    # products keep the keywords of the observation
    words = {word: value for word, value in file.header.items() if word not in ("COMMENT", "")}
    assert len(words) > 230
    result.write(tmp_path / "mosaic_i2d.fits")
    write_image(file, tmp_path / "copy_i2d.fits")
    for name in ("copy", "mosaic"):
        with fits.open(tmp_path / f"{name}_i2d.fits") as hdus:
            kept = joined_header(hdus)
            assert hdus[0].header["S_RESAMP"] == "COMPLETE"
        assert np.mean([word in kept for word in words]) > 0.98
        # all but name, grid and world coordinates are the same
        assert np.mean([kept.get(word) == value for word, value in words.items()]) > 0.94


def test_real_rates_of_integrations_and_their_mean(data_file):
    path = data_file(RATEINTS)
    files = read_images(path)
    with fits.open(path) as hdus:
        data, dq = hdus["SCI"].data, hdus["DQ"].data.astype(np.int64)
        for number, file in enumerate(files):
            assert_array_equal(file.image.data, data[number])
            assert_array_equal(file.image.flags, dq[number])
            assert file.image.meta["integration"] == number
    assert files[0].image.wcs is None
    mean = open_exposure(path)
    good = ~mean.mask
    assert_allclose(mean.data[good], data.mean(axis=0)[good], rtol=1e-4, atol=1e-5)
    assert mean.mask.mean() < 0.02


def test_files_that_are_written_are_read_by_others(tmp_path, exposure):
    ramp = Detector.miri_imager().expose(sky_of(exposure, 30.0), exposure, seed=1)
    uncal = ramp.write(tmp_path / "a_uncal.fits")
    assert isinstance(open_exposure(uncal), Ramp)
    reducer = Reducer()
    rate, image, background = reducer.reduce(uncal)
    path = write_image(image, tmp_path / "a_cal.fits", planes={"BKG": background.level})
    # photutils, reproject and the like read extensions by these names
    with fits.open(path) as hdus:
        assert [hdu.name for hdu in hdus][:4] == ["PRIMARY", "SCI", "ERR", "DQ"]
        assert hdus[0].header["FILTER"] == "F1000W"
        assert hdus[0].header["INSTRUME"] == "MIRI"
        assert hdus["SCI"].header["BUNIT"] == "MJy/sr"
        assert hdus["DQ"].data.dtype == np.uint32
        wcs = WCS(hdus["SCI"].header)
    plain = CCDData.read(path, hdu="SCI", hdu_uncertainty="ERR", hdu_mask=None)
    assert plain.unit == "MJy / sr"
    expected = exposure.wcs.pixel_to_world(60, 5)
    assert wcs.pixel_to_world(60, 5).separation(expected) < 1e-3 * u.mas
    # nothing is lost on the way back
    (file,) = read_images(path)
    assert_array_equal(file.image.data, image.data)
    assert_array_equal(file.image.uncertainty.array, image.uncertainty.array)
    assert_array_equal(file.image.mask, image.mask)
    assert_array_equal(file.image.flags & ~1, image.flags & ~1)
    assert_array_equal(file.planes["BKG"], background.level)
    assert file.image.meta["reference_gain"] == "4 e-/DN of the simulated detector"
    assert ImageFacts.of(file.image) == ImageFacts.of(image)
    # and a rate is calibrated as the one in memory
    write_image(rate, tmp_path / "a_rate.fits")
    with fits.open(tmp_path / "a_rate.fits") as hdus:
        assert hdus["SCI"].header["BUNIT"] == "DN/s"
    again = reducer.calibrate(open_exposure(tmp_path / "a_rate.fits"))
    assert_array_equal(again.data, reducer.calibrate(rate).data)
    refuses("exists", write_image, image, path, error=OSError)
    other = {"SKY": background.level}
    refuses("named VAR_POISSON", write_image, image, tmp_path / "b.fits", planes=other)


def test_what_is_no_image_is_refused(tmp_path):
    fits.PrimaryHDU().writeto(tmp_path / "empty.fits")
    refuses("it has no image in SCI", read_images, tmp_path / "empty.fits", error=DataError)
    hdus = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.ones((3, 3)), name="SCI")])
    hdus[0].header["INSTRUME"] = "NIRCAM"
    hdus.writeto(tmp_path / "nircam.fits")
    wanted = "must be an exposure of the MIRI imager .* got NIRCAM MIRIMAGE"
    refuses(wanted, read_images, tmp_path / "nircam.fits", error=DataError)
    refuses("'exposure' must be a Ramp, a Charge, CCDData or a path", Reducer().reduce, 3)
    image = CCDData(np.ones((4, 4)), unit="Jy", uncertainty=StdDevUncertainty(np.ones((4, 4))))
    refuses("'exposure' must be in adu / s or MJy / sr, got Jy", Reducer().reduce, image)


def test_slopes_have_their_two_variances_and_those_of_each_integration(exposure, tmp_path):
    exposure = exposure.replace(n_integrations=3)
    detector = Detector.miri_imager().without(CosmicRays)
    ramp = detector.expose(sky_of(exposure, 12.0), exposure, seed=2)
    reducer = Reducer(jump_threshold=None)
    rate = reducer.fit_ramp(ramp, planes=True)
    assert_array_equal(rate.image.data, reducer.fit_ramp(ramp).data)
    back = read_images(write_image(rate, tmp_path / "a_rate.fits"))[0]
    good = ~back.image.mask
    total = back.planes["VAR_POISSON"] + back.planes["VAR_RNOISE"]
    assert_allclose(total[good], back.image.uncertainty.array[good] ** 2, rtol=1e-5)
    # without photons, the variance of a straight line through reads (a closed form)
    n, sigma = exposure.n_groups, np.hypot(ramp.properties.read_noise, np.sqrt(1 / 12))
    step = exposure.group_time.to_value("s")
    line = 12 * sigma**2 / (step**2 * n * (n**2 - 1)) / 3
    assert np.all(back.planes["VAR_RNOISE"][good] >= 0.999 * line)
    assert np.median(back.planes["VAR_RNOISE"][good]) == pytest.approx(line, rel=0.05)
    parts = reducer.fit_integrations(ramp, planes=True)
    path = write_image(parts, tmp_path / "a_rateints.fits")
    with fits.open(path) as hdus:
        for name in ("SCI", "ERR", "DQ", "VAR_POISSON", "VAR_RNOISE"):
            assert hdus[name].shape == (3, *exposure.shape)
        assert hdus[0].header["DATAMODL"] == "CubeModel"
    for number, (file, part) in enumerate(zip(read_images(path), parts, strict=True)):
        assert file.image.meta["integration"] == number
        assert_array_equal(file.image.data, part.image.data)
        assert_array_equal(file.planes["VAR_POISSON"], part.planes["VAR_POISSON"])
        seen = file.image.wcs.pixel_to_world(10, 20)
        assert seen.separation(exposure.wcs.pixel_to_world(10, 20)) < 1e-6 * u.arcsec
    # their mean is the slope of all, where nothing is cut
    mean = open_exposure(path)
    assert_allclose(mean.data[good], rate.image.data[good], rtol=0.02, atol=0.2)
    wanted, mixed = "'image' must be integrations of one shape", [parts[0], parts[1].image]
    refuses(wanted, write_image, mixed, tmp_path / "b.fits")


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("MIR_TACQ", "F770W"), ("MIR_TACONFIRM", "F560W"), ("MIR_4QPM", "F1550C"),
        ("MIR_LYOT", "F2300C"), ("MIR_LRS-SLITLESS", "P750L"), ("MIR_IMAGE", "P750L"),
    ],
)  # fmt: skip
def test_acquisitions_coronagraphs_and_prisms_are_no_images(tmp_path, kind, name):
    primary = fits.PrimaryHDU()
    known = {"INSTRUME": "MIRI", "DETECTOR": "MIRIMAGE", "EXP_TYPE": kind, "FILTER": name}
    primary.header.update(known)
    science = fits.ImageHDU(np.ones((8, 8), np.float32), name="SCI")
    science.header["BUNIT"] = "MJy/sr"
    path = tmp_path / "x_cal.fits"
    fits.HDUList([primary, science]).writeto(path)
    with pytest.raises(DataError, match=r"x_cal\.fits must be an exposure of the MIRI imager"):
        read_images(path)
