import time

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.wcs import WCS

from miricigale.utils.exceptions import DataError
from miricigale.workflow.products import read_image, write_image


def test_images_survive_the_file(tmp_path):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [53.1, -27.8]
    wcs.wcs.crpix = [3, 2]
    wcs.wcs.cdelt = [-3e-5, 3e-5]
    data = np.arange(12.0, dtype=np.float32).reshape(3, 4)
    meta = {
        "filter": "miri.f770w",
        "exposure time": 5.5,
        "a_long_name_of_a_list": [1, 2],
        "none": None,
    }
    image = CCDData(
        data,
        unit=u.MJy / u.sr,
        wcs=wcs,
        mask=data > 10,
        uncertainty=StdDevUncertainty(data + 1),
        meta=meta,
    )
    write_image(image, tmp_path / "image.fits", planes={"weight": data * 2})
    back, weight = read_image(tmp_path / "image.fits", planes=["weight"])
    assert back.unit == u.MJy / u.sr
    assert dict(back.meta) == meta
    np.testing.assert_array_equal(back.data, data)
    np.testing.assert_array_equal(back.mask, data > 10)
    np.testing.assert_array_equal(back.uncertainty.array, data + 1)
    np.testing.assert_array_equal(weight, data * 2)
    assert back.wcs.pixel_to_world(1, 2).separation(wcs.pixel_to_world(1, 2)) < 1e-6 * u.arcsec


def test_missing_and_foreign_images_are_named(tmp_path):
    with pytest.raises(DataError, match=r"absent\.fits cannot be read as an image"):
        read_image(tmp_path / "absent.fits")
    (tmp_path / "text.fits").write_text("no image")
    with pytest.raises(DataError, match=r"text\.fits cannot be read as an image"):
        read_image(tmp_path / "text.fits")


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


@pytest.mark.parametrize("header", [{}, {"BUNIT": "cows"}])
def test_images_without_a_unit_are_named(tmp_path, header):
    path = tmp_path / "bare.fits"
    sci = fits.ImageHDU(np.zeros((3, 4)), fits.Header(header), name="SCI")
    fits.HDUList([fits.PrimaryHDU(), sci]).writeto(path)
    with pytest.raises(DataError, match=r"bare\.fits must state the unit of its pixels"):
        read_image(path)


def test_flags_have_the_bits_of_jwst_and_say_so(tmp_path):
    image = CCDData(np.zeros((2, 2)), unit=u.MJy / u.sr)
    write_image(image, tmp_path / "new.fits", planes={"dq": np.array([[0, 2], [2**33, 1]])})
    header = fits.getheader(tmp_path / "new.fits", "DQ")
    assert (header["DQSCHEME"], header["DQBIT1"]) == ("JWST", "SATURATED")
    _, flags = read_image(tmp_path / "new.fits", planes=["dq"])
    np.testing.assert_array_equal(flags, [[0, 2], [2**33, 1]])
    # bits of earlier versions: 4 was what 2 is now
    old = fits.ImageHDU(np.array([[0, 4], [0, 0]], np.uint32), name="DQ")
    science = fits.ImageHDU(
        np.zeros((2, 2), np.float32), fits.Header({"BUNIT": "MJy/sr"}), name="SCI"
    )
    fits.HDUList([fits.PrimaryHDU(), science, old]).writeto(tmp_path / "old.fits")
    _, flags = read_image(tmp_path / "old.fits", planes=["dq"])
    np.testing.assert_array_equal(flags, [[0, 2], [0, 0]])
