"""Ramps of the pipeline at any stage, and of ground tests."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.references import POINTED, imager_keywords
from miricigale.detector import Detector, Ramp, ramp_reader
from miricigale.instrument import DQ
from miricigale.utils.exceptions import DataError

GROUND = "real/ramps/MIRI_5582_89_S_20180308-010230_SCE1_pipe.fits.gz"


def stage(path):
    """A file as a step of the pipeline would save it: floats, with flags."""
    rng, shape = np.random.default_rng(1), (2, 4, 64, 72)
    data = rng.normal(12000, 5, shape).astype(np.float32)
    pixel_dq = np.zeros(shape[2:], np.uint32)
    pixel_dq[5, 6] = DQ.HOT | DQ.DO_NOT_USE
    pixel_dq[7, 8] = DQ.OTHER_BAD_PIXEL
    group_dq = np.zeros(shape, np.uint8)
    group_dq[:, -1] = DQ.DO_NOT_USE
    hdus = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(data, name="SCI")])
    hdus += [fits.ImageHDU(pixel_dq, name="PIXELDQ"), fits.ImageHDU(group_dq, name="GROUPDQ")]
    steps = dict.fromkeys(("S_DQINIT", "S_SATURA", "S_LINEAR"), "COMPLETE") | {"S_DARK": "SKIPPED"}
    given = {"INTSTART": 5, "INTEND": 6, "TGROUP": 0.0851, "DATE-OBS": "2022-07-01", **steps}
    given |= {"FILTER": "F560W", "DETECTOR": "MIRIMAGE", "NINTS": 10}
    hdus[0].header.update(imager_keywords(**given))
    hdus[1].header.update(POINTED)
    hdus.writeto(path)
    return data, pixel_dq, group_dq


def test_reads_what_a_step_of_the_pipeline_saved(tmp_path):
    path = tmp_path / "jw_linearity.fits"
    data, pixel_dq, group_dq = stage(path)
    ramp = Ramp.read(path)
    assert_array_equal(ramp.data, data)
    assert_array_equal(ramp.group_dq, group_dq)
    assert_array_equal(ramp.pixel_dq[:, 4:], pixel_dq[:, 4:])
    assert np.all(ramp.pixel_dq[:, :4] & DQ.REFERENCE_PIXEL)
    assert ramp.steps == {"dq_init", "saturation", "linearity"}
    assert not ramp.simulated
    # the frame's own time, not the rounded one of the table
    assert ramp.group_time == 0.0851
    assert ramp.header["DATE-OBS"] == "2022-07-01"
    second = ramp.integration(1)
    assert_array_equal(second.data[0], data[1])
    assert second.exposure.n_integrations == 1
    assert second.steps == ramp.steps
    refuses("'number' must be from 0 to 1, got 2", ramp.integration, 2)


def test_ramps_larger_than_the_memory_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = tmp_path / "jw_ramp.fits"
    stage(path)

    def never(*args):
        raise AssertionError("read")

    monkeypatch.setattr(ramp_reader, "_counts", never)
    monkeypatch.setattr("miricigale.utils.parallel.available_memory", lambda: 150_000)
    wanted = r"the ramp of .*jw_ramp\.fits, shape \(2, 4, 64, 72\)"
    refuses(wanted, Ramp.read, path, error=MemoryError)


def test_exposures_larger_than_the_memory_are_refused_before_they_begin(
    make_exposure, make_sky, monkeypatch
):
    monkeypatch.setattr("miricigale.utils.parallel.available_memory", lambda: 2_000_000)
    exposure = make_exposure(n_groups=200)
    with pytest.raises(MemoryError, match=r"expose fewer groups, or write it by 'expose_to'"):
        Detector.miri_imager().expose(make_sky(exposure, 1.0), exposure, seed=1)


def test_a_ramp_of_a_ground_test(data_file, tmp_path):
    # 5 integrations of 50 groups, without filter, pointing, instrument and kind of exposure
    path = data_file(GROUND)
    ramp = Ramp.read(path)
    with fits.open(path) as hdus:
        assert_array_equal(ramp.data, hdus["SCI"].data)
    exposure = ramp.exposure
    assert (exposure.filter, exposure.pointing, exposure.wcs) == (None, None, None)
    assert (exposure.readout, exposure.subarray) == ("FASTR1", "SUB64")
    assert ramp.group_time == 0.085
    refuses("'exposure' must be one with a filter, got None", exposure.pointing_keywords)
    # its keywords stay
    path = ramp.write(tmp_path / "jpl_uncal.fits")
    with fits.open(path) as hdus:
        header = hdus[0].header
        assert (header["ORIGIN"], header["FILENAME"]) == ("JPL", "jpl_uncal.fits")
        assert "FILTER" not in header
        assert hdus[-1].name == "ASDF"
    back = Ramp.read(path)
    assert not ramp.simulated
    assert not back.simulated
    assert_array_equal(back.data, ramp.data)


def test_an_exposure_of_nothing_is_not_simulated(make_exposure, make_sky):
    exposure = make_exposure(n_groups=2)
    sky = make_sky(exposure, 1.0)
    for name, options in {
        "filter": {"filter": None},
        "pointing": {"pointing": None, "roll": None},
    }.items():
        with pytest.raises(ValueError, match=f"'exposure' must be one with a {name}"):
            Detector.miri_imager().expose(sky, exposure.replace(**options), seed=1)
    refuses("'pointing' must be given where 'roll' is", exposure.replace, pointing=None)


def test_keywords_of_a_ramp_that_was_not_read_are_those_of_its_file(
    make_exposure, make_sky, tmp_path
):
    exposure = make_exposure(n_groups=2)
    ramp = Detector.miri_imager().expose(make_sky(exposure, 1.0), exposure, seed=1)
    back = Ramp.read(ramp.write(tmp_path / "a_uncal.fits"))
    for key in ("FILTER", "READPATT", "DATE-OBS", "RA_REF", "SUBSTRT2", "TGROUP"):
        assert ramp.header[key] == back.header[key]
    assert back.simulated
    assert back.group_time == exposure.group_time / u.s


def test_flags_of_another_shape_are_refused(tmp_path):
    path = tmp_path / "jw_ramp.fits"
    stage(path)
    with fits.open(path, mode="update") as hdus:
        hdus["GROUPDQ"].data = hdus["GROUPDQ"].data[:, :3]
    refuses(r"flags of shape \(2, 4, 64, 72\) in GROUPDQ", Ramp.read, path, error=DataError)


def test_times_of_the_integrations(make_exposure, make_sky, tmp_path):
    exposure = make_exposure(n_groups=5, n_integrations=3)
    start = Time("2023-01-02T03:04:05", scale="utc")
    ramp = Detector.miri_imager().expose(make_sky(exposure, 1.0), exposure, seed=1)
    path = ramp.write(tmp_path / "a_uncal.fits", start=start)
    with fits.open(path) as hdus:
        table, header = hdus["INT_TIMES"].data, hdus[0].header
        assert_array_equal(table["integration_number"], [1, 2, 3])
        begin, end = table["int_start_MJD_UTC"], table["int_end_MJD_UTC"]
        # five frames, and one for the reset between integrations
        frame = exposure.frame_time.to_value("day")
        assert_allclose(end - begin, 5 * frame, rtol=1e-5)
        assert_allclose(np.diff(begin), 6 * frame, rtol=1e-5)
        assert begin[0] == pytest.approx(start.mjd, abs=1e-9)
        assert end[-1] == pytest.approx(header["EXPEND"], abs=1e-9)


@pytest.mark.parametrize("dtype", [np.int32, np.uint32, np.int16, np.uint8])
def test_flags_are_the_same_in_any_type_of_integers(tmp_path, dtype):
    """FITS keeps unsigned integers less 2^31, and signed ones as they are."""
    path = tmp_path / "jw_linearity.fits"
    _, pixel_dq, _ = stage(path)
    expected = Ramp.read(path).pixel_dq
    with fits.open(path, mode="update") as hdus:
        hdus["PIXELDQ"] = fits.ImageHDU((pixel_dq & 0x7F).astype(dtype), name="PIXELDQ")
    assert_array_equal(Ramp.read(path).pixel_dq & 0x7F, expected & 0x7F)
    # which are those of the reference pixels alone
    good = np.s_[:, 4:68]
    assert not np.any(Ramp.read(path).pixel_dq[good] & DQ.REFERENCE_PIXEL)


def test_flags_and_units_of_no_ramp_are_refused(tmp_path):
    path = tmp_path / "jw_linearity.fits"
    stage(path)
    fits.setval(path, "BUNIT", value="electron", extname="SCI")
    refuses("must hold a ramp in DN, got the unit 'electron'", Ramp.read, path, error=DataError)
    fits.setval(path, "BUNIT", value="DN", extname="SCI")
    with fits.open(path, mode="update") as hdus:
        hdus["PIXELDQ"] = fits.ImageHDU(np.zeros((64, 72), np.float32), name="PIXELDQ")
    refuses("flags that are integers in PIXELDQ", Ramp.read, path, error=DataError)
