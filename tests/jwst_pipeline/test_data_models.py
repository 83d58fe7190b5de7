"""Data models of the official pipeline in place of files."""

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from numpy.testing import assert_array_equal

from miricigale.detector import Detector
from miricigale.instrument import Exposure
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.reduction import Reducer

datamodels = pytest.importorskip(
    "jwst.datamodels", reason="needs the official pipeline: pip install miricigale[jwst]"
)


def test_data_models_are_taken_as_their_files(tmp_path):
    pointing = SkyCoord(53.1344, -27.8344, unit="deg")
    exposure = Exposure("miri.f770w", n_groups=10, subarray="SUB64", pointing=pointing)
    light = CCDData(np.full(exposure.shape, 5.0), unit="MJy/sr")
    Detector().expose(light, exposure, seed=1).write(tmp_path / "a_uncal.fits")
    reducer = Reducer()
    rate = reducer.fit_ramp(tmp_path / "a_uncal.fits")
    with datamodels.open(tmp_path / "a_uncal.fits") as model:
        same = reducer.fit_ramp(model)
        run = reducer.run(model)
    assert_array_equal(same.data, rate.data)
    assert_array_equal(run.rates[0].data, rate.data)
    image = reducer.calibrate(rate)
    image.write(tmp_path / "a_cal.fits")
    with datamodels.open(tmp_path / "a_cal.fits") as model:
        read = as_mosaic(model)
    assert_array_equal(read.data, image.data.astype(np.float32))
    # the distortion is that of the file
    x, y = [5.0, 60.0], [7.0, 50.0]
    apart = read.wcs.pixel_to_world(x, y).separation(image.wcs.pixel_to_world(x, y))
    assert np.all(apart.mas < 1)
