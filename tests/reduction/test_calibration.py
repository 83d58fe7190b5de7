import numpy as np
import pytest
from astropy.nddata import CCDData
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.instrument import DQ, field_mask, flat_field, photmjsr
from miricigale.reduction import calibrate
from miricigale.reduction.images.images import flagged_image

SHAPE = (1024, 1032)
FILTER = "miri.f1000w"
OPTIONS = {"subarray": "FULL", "flat": flat_field(FILTER)}
OPTIONS["conversion"] = photmjsr(FILTER, gain=4.0)


@pytest.fixture(scope="module")
def rate():
    data = 20.0 * flat_field(FILTER)
    flags = np.zeros(SHAPE, np.int64)
    flags[:, :4] = DQ.REFERENCE_PIXEL | DQ.DO_NOT_USE
    form = {"error": np.full(SHAPE, 0.1), "flags": flags, "wcs": None}
    return flagged_image(data, "adu / s", meta={"filter": FILTER, "subarray": "FULL"}, **form)


def test_uniform_sky_comes_out_uniform(rate):
    cal = calibrate(rate, **OPTIONS)
    good = ~cal.mask
    factor = photmjsr("miri.f1000w", gain=4.0)
    assert_allclose(cal.data[good], 20 * factor, rtol=1e-5)
    expected = 0.1 * factor / flat_field("miri.f1000w")[good]
    assert_allclose(cal.uncertainty.array[good], expected, rtol=1e-5)
    assert cal.unit == "MJy/sr"
    assert cal.meta["photmjsr"] == pytest.approx(factor)


def test_pixels_off_the_field_are_masked_with_the_reason(rate):
    cal = calibrate(rate, **OPTIONS)
    outside = (cal.flags & DQ.NON_SCIENCE) != 0
    reference = (cal.flags & DQ.REFERENCE_PIXEL) != 0
    assert_array_equal(outside, ~field_mask() & ~reference)
    assert_array_equal(cal.mask, ~field_mask() | reference)
    # and what the flat field says of the knife edge
    flags = np.zeros(SHAPE, np.int64)
    flags[480:500, 360:420] = DQ.NON_SCIENCE
    edge = calibrate(rate, **OPTIONS, flags=flags)
    assert_array_equal(edge.mask, cal.mask | (flags != 0))
    assert np.all(edge.flags[flags != 0] & int(DQ.DO_NOT_USE))


def test_refuses_what_is_no_rate(rate):
    wrong = CCDData(rate.data, unit="Jy")
    refuses("'rate' must be in adu / s", calibrate, wrong, **OPTIONS)
    wanted = r"'rate' must be of shape \(256, 256\) for 'SUB256'"
    refuses(wanted, calibrate, rate, **{**OPTIONS, "subarray": "SUB256"})
