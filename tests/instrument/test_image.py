"""Images as astropy writes them, whatever their meta hold."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty, VarianceUncertainty
from astropy.wcs import WCS
from numpy.testing import assert_array_equal

from helpers.errors import refuses
from miricigale.instrument import Image, as_wcs, north_up_wcs
from miricigale.utils.meta import full_meta


def test_an_image_is_written_and_read_by_astropy(tmp_path):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.cdelt = ["RA---TAN", "DEC--TAN"], [53, -28], [-1e-5, 1e-5]
    meta = {"citations": ["Yang et al. 2021, ApJ 908, 144", "Gordon et al. 2025"] * 5}
    meta |= {"exposure": {"filter": "miri.f770w", "time": 1.5}, "noise_gain": np.float32(0.25)}
    meta |= {"nothing": None, "a_long_keyword": 7, "filter": "miri.f770w", "text": "x" * 300}
    data = np.arange(12.0).reshape(3, 4)
    image = Image(data, unit="MJy/sr", wcs=wcs, meta=meta, mask=data > 10)
    image.uncertainty = StdDevUncertainty(data + 1)
    image.write(tmp_path / "a.fits")
    back = CCDData.read(tmp_path / "a.fits")
    np.testing.assert_array_equal(back.data, data)
    np.testing.assert_array_equal(back.mask, data > 10)
    np.testing.assert_array_equal(back.uncertainty.array, data + 1)
    assert back.unit == u.MJy / u.sr
    np.testing.assert_allclose(back.wcs.wcs.crval, [53, -28])
    assert back.header["filter"] == "miri.f770w"
    assert back.header["A_LONG_KEYWORD"] == 7
    assert full_meta(back.header) == meta | {"noise_gain": 0.25}
    # the image keeps its own
    assert image.meta["exposure"]["time"] == 1.5
    assert isinstance(image[:2], Image)
    assert fits.getheader(tmp_path / "a.fits")["BUNIT"] == "MJy / sr"


def test_an_image_of_a_header_and_a_filter_in_one_line():
    center = SkyCoord(53.1, -27.8, unit="deg")
    wcs = north_up_wcs(center, 0.1 * u.arcsec, (60, 80))
    error = StdDevUncertainty(np.full((60, 80), 0.1))
    options = {"unit": "MJy/sr", "uncertainty": error, "filter": "JWST/MIRI.F770W"}
    image = Image(np.arange(4800.0).reshape(60, 80), wcs=wcs.to_header(), **options)
    text = "<Image 60 x 80, MJy / sr, miri.f770w, 03h32m24.0s -27d48m00.0s>"
    assert repr(image) == text
    np.testing.assert_allclose(image.pixel_scale.to_value(u.arcsec), 0.1)
    part = image.cutout(center.directional_offset_by(0 * u.deg, 1 * u.arcsec), 1 * u.arcsec)
    # ten pixels further north, five to either side
    np.testing.assert_array_equal(part.data, image.data[35:45, 35:45])
    assert part.uncertainty.array.shape == (10, 10)
    assert part.wcs.pixel_to_world(4.5, 4.5).separation(center) < 1.01 * u.arcsec
    refuses("'position' must be one on the image", image.cutout, "10 10", 1 * u.arcsec)
    plain = Image(np.zeros((4, 4)), unit="MJy/sr", filter="own")
    assert repr(plain) == "<Image 4 x 4, MJy / sr, own>"
    refuses("'image' must be one with celestial", plain.cutout, center, 1 * u.arcsec)


def test_world_coordinates_of_a_header_or_an_image():
    wcs = north_up_wcs(SkyCoord(53.1, -27.8, unit="deg"), 0.1 * u.arcsec, (60, 80))
    header = fits.PrimaryHDU(np.zeros((60, 80)), wcs.to_header()).header
    image = CCDData(np.zeros((60, 80)), unit="MJy/sr", wcs=WCS(wcs.to_header()))
    for given in (wcs, header, image):
        found = as_wcs(given)
        assert found.pixel_shape == (80, 60)
        np.testing.assert_allclose(
            found.pixel_to_world(3, 4).ra.deg, wcs.pixel_to_world(3, 4).ra.deg
        )
    refuses("'wcs' must be an astropy WCS with celestial axes", as_wcs, fits.Header())


def test_errors_of_an_image_are_standard_deviations():
    image = Image(
        np.ones((2, 2)), unit="MJy/sr", uncertainty=VarianceUncertainty(np.full((2, 2), 9.0))
    )
    assert_array_equal(image.err, 3.0)
    plain = Image(np.ones((2, 2)), unit="MJy/sr", filter="F770W")
    assert plain.err is None
    assert plain.filter == "miri.f770w"
