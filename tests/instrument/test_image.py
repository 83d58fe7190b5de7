"""Images as astropy writes them, whatever their meta hold."""

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.wcs import WCS

from miricigale.instrument import Image
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
