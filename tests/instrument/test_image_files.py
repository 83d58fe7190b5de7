import time

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData

from helpers.errors import refuses
from helpers.exposures import image_of
from miricigale.instrument import north_up_wcs
from miricigale.instrument.image_files import read_image, write_image
from miricigale.utils.exceptions import DataError


def test_images_survive_the_file(tmp_path):
    wcs = north_up_wcs(SkyCoord(53.1, -27.8, unit="deg"), 0.11 * u.arcsec, (3, 4))
    data = np.arange(12.0, dtype=np.float32).reshape(3, 4)
    meta = {"filter": "F770W", "exposure time": 5.5, "a_long_name_of_a_list": [1, 2], "none": None}
    image = image_of(data, wcs, error=data + 1, mask=data > 10, **meta)
    write_image(image, tmp_path / "image.fits", planes={"weight": data * 2})
    back, weight = read_image(tmp_path / "image.fits", planes=["weight"])
    assert back.unit == u.MJy / u.sr
    assert dict(back.meta) == meta
    np.testing.assert_array_equal(back.data, data)
    np.testing.assert_array_equal(back.mask, data > 10)
    np.testing.assert_array_equal(back.uncertainty.array, data + 1)
    np.testing.assert_array_equal(weight, data * 2)
    assert back.wcs.pixel_to_world(1, 2).separation(wcs.pixel_to_world(1, 2)) < 1e-6 * u.arcsec


@pytest.mark.parametrize(
    ("unit", "text", "wanted"),
    [
        ("adu/s", "DN/s", u.adu / u.s),
        ("DN/s", "DN/s", u.adu / u.s),
        ("DN", "DN", u.adu),
        ("electron/s", "electron / s", u.electron / u.s),
        ("uJy/pix", None, u.uJy / u.pix),
        (0.01 * u.adu / u.s, None, 0.01 * u.adu / u.s),
        (u.Unit("3.5 DN/s"), None, 3.5 * u.adu / u.s),
    ],
)
def test_counts_have_the_name_of_jwst_and_any_unit_comes_back(tmp_path, unit, text, wanted):
    """DN is not of the standard of FITS, and astropy reads it all the same."""
    image = CCDData(np.ones((3, 4)), unit=u.Unit(unit))
    write_image(image, tmp_path / "image.fits")
    header = fits.getheader(tmp_path / "image.fits", "SCI")
    assert text is None or header["BUNIT"] == text
    assert u.Unit(header["BUNIT"]).is_equivalent(image.unit) or "DN" in header["BUNIT"]
    back = read_image(tmp_path / "image.fits")
    assert back.unit.to(u.Unit(wanted)) == pytest.approx(1.0)


def test_the_same_image_makes_the_same_bytes(tmp_path):
    image = CCDData(np.arange(12.0).reshape(3, 4), unit=u.MJy / u.sr, mask=np.zeros((3, 4), bool))
    write_image(image, tmp_path / "first.fits", planes={"dq": np.ones((3, 4), np.uint32)})
    # checksums of FITS are dated to the second
    time.sleep(1.1)
    write_image(image, tmp_path / "second.fits", planes={"dq": np.ones((3, 4), np.uint32)})
    assert (tmp_path / "first.fits").read_bytes() == (tmp_path / "second.fits").read_bytes()
    with fits.open(tmp_path / "first.fits", checksum=True) as hdus:
        # astropy warns, and so fails this test, if one is wrong
        assert all({"CHECKSUM", "DATASUM"} <= set(hdu.header) for hdu in hdus)
        np.testing.assert_array_equal(hdus["DQ"].data, 1)


@pytest.mark.parametrize(
    ("unit", "got"), [(None, "none"), ("  ", "none"), ("cows", "BUNIT = 'cows'")]
)
def test_images_without_a_unit_are_named(tmp_path, unit, got):
    path = tmp_path / "bare.fits"
    header = fits.Header() if unit is None else fits.Header({"BUNIT": unit})
    sci = fits.ImageHDU(np.zeros((3, 4)), header, name="SCI")
    fits.HDUList([fits.PrimaryHDU(), sci]).writeto(path)
    match = rf"bare\.fits must state the unit of its pixels, .*, got {got}"
    refuses(match, read_image, path, error=DataError)


def test_flags_have_the_bits_of_jwst_and_say_so(tmp_path):
    image = CCDData(np.zeros((2, 2)), unit=u.MJy / u.sr)
    write_image(image, tmp_path / "new.fits", planes={"dq": np.array([[0, 2], [2**33, 1]])})
    header = fits.getheader(tmp_path / "new.fits", "DQ")
    assert (header["DQSCHEME"], header["DQBIT1"]) == ("JWST", "SATURATED")
    _, flags = read_image(tmp_path / "new.fits", planes=["dq"])
    np.testing.assert_array_equal(flags, [[0, 2], [2**33, 1]])


def noise_image():
    """An image with sources, a ramp of errors, areas of 0 and pixels without data."""
    rng = np.random.default_rng(5)
    shape = (120, 90)
    error = np.linspace(0.5, 2.0, shape[0], dtype=np.float32)[:, None] * np.ones(shape, np.float32)
    data = rng.normal(0, error).astype(np.float32)
    data[40:44, 40:44] += 3000
    data[70:75] = 0
    data[3:8, 20:30] = error[5:9, 60:70] = np.nan
    return image_of(data, error=error, mask=~np.isfinite(data + error))


def test_rounding_is_far_below_the_errors_and_the_same_each_time(tmp_path):
    image = noise_image()
    flags = image.mask * np.int64(2**33 + 1)
    write_image(image, tmp_path / "whole.fits")
    for name in ("first.fits", "second.fits"):
        write_image(image, tmp_path / name, planes={"dq": flags}, rounded=True)
        # gzip would date its tiles to the second
        time.sleep(1.1)
    first = (tmp_path / "first.fits").read_bytes()
    assert first == (tmp_path / "second.fits").read_bytes()
    np.testing.assert_array_equal(read_image(tmp_path / "whole.fits").data, image.data)
    back, again = read_image(tmp_path / "first.fits", planes=["dq"])
    np.testing.assert_array_equal(again, flags)
    # 32 bits as JWST has them, our own beside
    with fits.open(tmp_path / "first.fits") as hdus:
        assert [hdu.name for hdu in hdus[1:]] == ["SCI", "ERR", "MASK", "DQ", "DQ_OWN"]
        assert hdus["DQ"].data.dtype.newbyteorder("=") == np.uint32
    np.testing.assert_array_equal(back.mask, image.mask)
    np.testing.assert_array_equal(np.isnan(back.data), np.isnan(image.data))
    assert np.all(back.data[70:75] == 0)
    error, good = image.uncertainty.array, ~image.mask
    change = (back.data - image.data)[good]
    assert np.max(np.abs(change)) <= 1.001 * np.median(error[good]) / 2048
    # an aperture of any size and place: below 1e-3 of its error
    sums = np.where(good, back.data - image.data, 0).reshape(12, 10, 9, 10).sum(axis=(1, 3))
    assert np.all(np.abs(sums) < 1e-3 * np.median(error[good]) * 10)
    np.testing.assert_allclose(back.uncertainty.array[good], error[good], rtol=7e-4)


@pytest.mark.parametrize("odd", [np.inf, 1e12, None])
def test_what_steps_cannot_hold_keeps_every_bit(tmp_path, odd):
    image = noise_image()
    if odd is None:
        image.uncertainty = None
    else:
        image.data[1, 1] = odd
    write_image(image, tmp_path / "image.fits", rounded=True)
    np.testing.assert_array_equal(read_image(tmp_path / "image.fits").data, image.data)


def test_compressed_images_are_read_by_astropy(tmp_path):
    image = noise_image()
    write_image(image, tmp_path / "image.fits", rounded=True)
    back = CCDData.read(tmp_path / "image.fits", hdu="SCI", hdu_uncertainty="ERR", hdu_mask="MASK")
    np.testing.assert_array_equal(back.mask, image.mask)
    np.testing.assert_array_equal(back.data, read_image(tmp_path / "image.fits").data)
    assert back.unit == image.unit
