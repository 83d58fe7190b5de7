import json
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from astropy.wcs import WCS
from numpy.testing import assert_array_equal

from helpers.cases import cases_of
from helpers.errors import refuses
from helpers.references import POINTED, imager_keywords
from miricigale.detector import Detector, LastFrame, OtherEffect, Photons, Ramp, ResetAnomaly
from miricigale.instrument import DQ
from miricigale.utils.exceptions import DataError


@pytest.fixture
def ramp(make_exposure, make_sky):
    exposure = make_exposure("miri.f1500w", n_groups=3, n_integrations=2, dither=2)
    return Detector.miri_imager().expose(make_sky(exposure, 40.0), exposure, seed=9)


def test_round_trip(ramp, tmp_path):
    path = ramp.write(tmp_path / "a_uncal.fits")
    back = Ramp.read(path)
    assert back.data.dtype == np.uint16
    assert_array_equal(back.data, ramp.data)
    assert_array_equal(back.pixel_dq, ramp.pixel_dq)
    assert back.group_dq is None
    assert back.meta == ramp.meta
    for name in ("filter", "readout", "n_groups", "n_integrations", "subarray", "dither"):
        assert getattr(back.exposure, name) == getattr(ramp.exposure, name)
    assert back.exposure.pointing.separation(ramp.exposure.pointing) < 1e-6 * u.arcsec
    assert abs(back.exposure.roll - ramp.exposure.roll) < 1e-9 * u.deg
    corner = back.wcs.pixel_to_world(0, 63)
    assert corner.separation(ramp.wcs.pixel_to_world(0, 63)) < 1e-5 * u.arcsec


def test_header_is_what_the_pipeline_asks_for(ramp, tmp_path):
    path = ramp.write(tmp_path / "a_uncal.fits", start=Time("2023-01-02T03:04:05"))
    with warnings.catch_warnings(), fits.open(path) as hdus:
        warnings.simplefilter("error")
        hdus.verify("exception")
        primary, science = hdus[0].header, hdus["SCI"].header
        assert hdus["SCI"].data.dtype == np.uint16
        assert_array_equal(hdus["SCI"].data, ramp.data)
        assert hdus["ASDF"].data["ASDF_METADATA"][0].tobytes().startswith(b"#ASDF 1.0.0\n")
        assert hdus["SIM_PIXELDQ"].data.dtype == np.uint32
    # what Detector1 and Image2 fail without (measured by removing keywords)
    needed = {"DATE-OBS", "TIME-OBS", "TFRAME", "NFRAMES", "SUBARRAY", "SUBSTRT1", "SUBSTRT2"}
    needed |= {"SUBSIZE1", "SUBSIZE2", "DATAMODL", "EXP_TYPE", "INSTRUME", "DETECTOR", "FILTER"}
    assert needed <= set(primary)
    assert {*POINTED, "V2_REF", "V3_REF", "VPARITY", "V3I_YANG"} <= set(science)
    assert primary["DATE-OBS"] == "2023-01-02"
    assert primary["TIME-OBS"].startswith("03:04:05")
    assert (primary["NINTS"], primary["NGROUPS"], primary["FILTER"]) == (2, 3, "F1500W")
    duration = ramp.exposure.duration.to_value("d")
    assert primary["EXPEND"] - primary["EXPSTART"] == pytest.approx(duration, abs=1e-10)
    # the linear WCS of the header finds the reference pixel and its neighbors
    linear = WCS(science, naxis=2)
    x, y = ramp.exposure.aperture.reference
    for dx in (0, 5):
        offset = linear.pixel_to_world(x + dx, y).separation(ramp.wcs.pixel_to_world(x + dx, y))
        assert offset < 0.01 * u.arcsec


def test_a_file_that_is_renamed_later_has_its_later_name(ramp, tmp_path):
    for options, name in (({}, "a_uncal.fits"), ({"filename": "b_uncal.fits"}, "b_uncal.fits")):
        path = ramp.write(tmp_path / "a_uncal.fits", overwrite=True, **options)
        assert fits.getheader(path)["FILENAME"] == name


@pytest.mark.parametrize("name", ["x_rate.fits", "x_cal.fits", "x_ramp.fits"])
def test_names_of_other_products_are_refused(ramp, tmp_path, name):
    refuses(
        "'path' must be a name that is not of another product of JWST", ramp.write, tmp_path / name
    )


def test_only_counts_are_written(make_exposure, tmp_path):
    exposure = make_exposure(n_groups=2)
    floats = Ramp(np.zeros((1, 2, 64, 72), np.float32), exposure)
    refuses("'data' must be counts", floats.write, tmp_path / "a_uncal.fits")
    assert not list(tmp_path.iterdir())


def foreign(path, *, drop=(), primary=None, data=None):
    """A level-1b file as another program would write it, with standard keywords only."""
    head = imager_keywords(**(primary or {}))
    data = np.arange(4 * 64 * 72, dtype=np.uint16).reshape(1, 4, 64, 72) if data is None else data
    hdus = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(data, name="SCI")])
    hdus[0].header.update({k: v for k, v in head.items() if k not in drop})
    hdus[1].header.update({k: v for k, v in POINTED.items() if k not in drop})
    hdus.writeto(path)
    return path


def test_reads_files_of_others(tmp_path):
    ramp = Ramp.read(foreign(tmp_path / "b_uncal.fits"))
    assert_array_equal(ramp.data.ravel(), np.arange(4 * 64 * 72))
    assert ramp.exposure.filter == "miri.f770w"
    assert ramp.exposure.dither == 0
    assert ramp.shows(LastFrame) is None
    assert ramp.exposure.roll == 120 * u.deg
    assert np.count_nonzero(ramp.pixel_dq & DQ.REFERENCE_PIXEL) == 64 * 4
    sky = ramp.wcs.pixel_to_world(*ramp.exposure.aperture.reference)
    assert sky.separation(ramp.exposure.pointing) < 1e-3 * u.arcsec


@pytest.mark.parametrize(("options", "message"), cases_of(__file__, "refused"))
def test_refuses_other_files(tmp_path, options, message):
    refuses(message, Ramp.read, foreign(tmp_path / "c_uncal.fits", **options), error=DataError)


def test_refuses_what_is_no_ramp(tmp_path):
    fits.PrimaryHDU().writeto(tmp_path / "empty.fits")
    refuses("no SCI extension", Ramp.read, tmp_path / "empty.fits", error=DataError)
    path = foreign(tmp_path / "axes_uncal.fits", data=np.zeros((4, 64, 72), np.float32))
    refuses("must hold a ramp in SCI: four axes", Ramp.read, path, error=DataError)


@pytest.mark.parametrize("start", ["2023-01-02", Time(["2023-01-02", "2023-01-03"])])
def test_a_start_that_is_no_time_is_named(make_exposure, make_sky, tmp_path, start):
    exposure = make_exposure(n_groups=2)
    path, sky = tmp_path / "a_uncal.fits", make_sky(exposure, 1.0)
    expose_to, wanted = Detector.miri_imager().expose_to, "'start' must be one astropy Time"
    refuses(wanted, expose_to, path, sky, exposure, start=start)
    assert not list(tmp_path.iterdir())


def with_meta(path, new, meta):
    """Copy of a file with another SIM_META."""
    with fits.open(path) as hdus:
        array = np.frombuffer(json.dumps(meta).encode(), np.uint8)[None]
        column = fits.Column(name="JSON", format=f"{array.size}B", array=array)
        hdus["SIM_META"] = fits.BinTableHDU.from_columns([column], name="SIM_META")
        hdus.writeto(new)
    return new


def test_effects_of_other_packages_are_read(ramp, tmp_path):
    first = ramp.write(tmp_path / "a_uncal.fits")
    reset = {"effect": "ResetAnomaly", "amplitudes": [-3.0], "groups": 4.0}
    records = [{"effect": "Photons", "flat": True}, reset, {"effect": "Glow", "rate": -2.5}]
    old = Ramp.read(with_meta(first, tmp_path / "old.fits", {"seed": 9, "effects": records}))
    other = OtherEffect("Glow", (("rate", -2.5),))
    assert old.effects == (Photons(), ResetAnomaly((-3.0,)), other)
    assert old.meta == {"seed": 9}
    assert Ramp.read(old.write(tmp_path / "new.fits")).effects == old.effects
    for record in ("Dark()", {"effect": "Dark", "x": 1}):
        broken = with_meta(first, tmp_path / "broken.fits", {"effects": [record]})
        wanted = r"broken\.fits cannot be read as a ramp of the MIRI imager"
        refuses(wanted, Ramp.read, broken, error=DataError)
        broken.unlink()
