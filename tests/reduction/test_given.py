"""What a `Reducer` takes and gives, in the forms that users have."""

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from miricigale.detector import Detector, Ramp
from miricigale.instrument import DQ, Exposure
from miricigale.reduction import RampSettings, Reducer, read_images
from miricigale.scene import Scene
from miricigale.utils.exceptions import DataError

CATALOG = {"ra": [150.1], "dec": [2.2], "F770W": [50.0] * u.uJy, "profile": "point"}


@pytest.fixture(scope="module")
def ramps():
    exposure = Exposure("F770W", n_groups=12, pointing="150.1 2.2", subarray="SUB128")
    detector = Detector()
    scenes = [Scene(CATALOG, one, background="low") for one in exposure.dithered(3)]
    return [detector.expose(scene, seed=1) for scene in scenes]


@pytest.fixture(scope="module")
def folder(ramps, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ramps")
    for number, ramp in enumerate(ramps):
        ramp.write(folder / f"d{number}_uncal.fits")
    return folder


def equal(first, second):
    return np.array_equal(first.data, second.data, equal_nan=True)


def test_files_patterns_and_ramps_are_one(ramps, folder):
    expected = Reducer().run(ramps)
    assert equal(Reducer().run(f"{folder}/d?_uncal.fits").mosaic, expected.mosaic)
    single = Reducer().run(ramps[0]).mosaic
    for given in (str(folder / "d0_uncal.fits"), folder / "d0_uncal.fits", [ramps[0]]):
        assert equal(Reducer().run(given).mosaic, single)


def test_what_is_no_file_is_said(folder):
    refuses(r"no file is called .*e\*", Reducer().run, f"{folder}/e*_uncal.fits", error=DataError)
    refuses("'ramps' must be files, such as .* got a folder", Reducer().run, folder)


def test_a_result_is_written_and_drawn(ramps, tmp_path):
    result = Reducer().run(ramps)
    path = result.write(tmp_path / "mosaic.fits")
    with fits.open(path) as hdus:
        assert {"SCI", "ERR", "DQ", "WHT", "CON", "BKG"} <= {hdu.name for hdu in hdus}
    back = read_images(path)[0].image
    assert equal(back, result.mosaic)
    assert_array_equal(back.flags & ~int(DQ.DO_NOT_USE), result.mosaic.flags & ~int(DQ.DO_NOT_USE))
    # which leaves the image as it is
    assert "notes" not in result.mosaic.meta
    assert read_images(path)[0].image.meta["notes"] == list(result.notes)
    refuses("exists", result.write, path, error=OSError)
    assert result.image is result.mosaic
    assert "dithers: 3" in result.summary()
    ax = result.plot()
    assert "(MJy / sr)" in ax.images[0].colorbar.ax.get_ylabel()


def test_a_method_stands_for_its_settings():
    assert Reducer(background="dithers").background.method == "dithers"
    refuses("'method' must be 'masked' or 'sep' or 'dithers'", Reducer, background="mesh")


def test_integrations_and_pixels_of_a_ramp(ramps):
    ramp = ramps[0]
    assert isinstance(ramp[-1], Ramp)
    assert_array_equal(ramp[0].data, ramp.data[:1])
    with pytest.raises(IndexError, match="integration 1 of 1"):
        ramp[1]
    assert ramp.filter == "miri.f770w"
    ax = ramp.plot((40, 50), ax=plt.figure().subplots())
    assert_array_equal(ax.lines[0].get_ydata(), ramp.data[0, :, 50, 40])
    assert_allclose(ax.lines[0].get_xdata()[-1], ramp.exposure.integration_time.value)
    refuses(r"'pixel' must be \(x, y\) below", ramp.plot, (500, 0))
    # without a pixel that of the source, whatever cosmic rays have hit
    place = ramp.plot(ax=plt.figure().subplots()).get_title().strip("pixel ()").split(", ")
    x, y = map(int, place)
    assert ramp.pixel_dq[y, x] & int(DQ.DO_NOT_USE) == 0
    assert np.abs(np.subtract(ramp.wcs.world_to_pixel_values(150.1, 2.2), (x, y))).max() < 1


def test_a_reducer_says_what_is_not_by_default():
    assert repr(Reducer()) == "<Reducer native>"
    changed = Reducer(skip_first=3, ramps=RampSettings(neighbor_threshold=7.0))
    assert repr(changed) == "<Reducer native, skip_first=3, own ramps>"


def test_groups_of_zero_counts_are_left_out(ramps):
    """Counts at the floor of the converter are no light: the slope is that of the other groups."""
    ramp = ramps[0]
    data = ramp.data.copy()
    data[:, -3:] = 0
    lost = Ramp(data, ramp.exposure, pixel_dq=ramp.pixel_dq, effects=ramp.effects, meta=ramp.meta)
    rate = warned("3 of 12 groups have 0 DN in most pixels", Reducer().fit_ramp, lost)
    shorter = Reducer(skip_last=3).fit_ramp(ramp)
    good = ~rate.mask & ~shorter.mask
    assert good.sum() > 0.9 * good.size
    assert_allclose(rate.data[good], shorter.data[good], rtol=1e-5, atol=1e-4)
