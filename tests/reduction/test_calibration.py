import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import binary_dilation

from helpers.errors import refuses
from helpers.exposures import image_of
from miricigale.instrument import DQ, field_mask, flat_field, photmjsr, psf_fwhm
from miricigale.psf import miri_psf
from miricigale.reduction import calibrate, find_cosmic_rays
from miricigale.reduction.images import flagged_image

SHAPE = (1024, 1032)
FILTER = "miri.f1000w"
OPTIONS = {"filter": FILTER, "subarray": "FULL", "dark": 0.05, "flat": flat_field(FILTER)}
OPTIONS["conversion"] = photmjsr(FILTER, gain=4.0)


@pytest.fixture(scope="module")
def rate():
    data = 20.0 * flat_field(FILTER) + 0.05
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


def test_refuses_what_is_no_rate(rate):
    wrong = CCDData(rate.data, unit="Jy")
    refuses("'rate' must be in adu / s", calibrate, wrong, **OPTIONS)
    wanted = r"'rate' must be of shape \(256, 256\) for 'SUB256'"
    refuses(wanted, calibrate, rate, **{**OPTIONS, "subarray": "SUB256"})


@pytest.mark.parametrize("filt", ["miri.f560w", "miri.f770w", "miri.f1500w"])
def test_cosmic_rays_are_found_and_stars_are_left_alone(filt):
    rng = np.random.default_rng(1)
    cell, n = 48, 8
    psf = miri_psf(filt, fov=5 * u.arcsec)
    y, x = np.mgrid[: cell * n, : cell * n]
    stars = np.zeros(x.shape)
    for i in range(n * n):
        part = np.s_[i // n * cell : (i // n + 1) * cell, i % n * cell : (i % n + 1) * cell]
        x0, y0 = (cell * (k + 0.5) + rng.uniform(-0.5, 0.5) for k in (i % n, i // n))
        stamp = psf.evaluate(x[part], y[part], 1.0, x0, y0)
        # brightest pixel between 3 and 30000 sigma of the sky
        stars[part] += 10 ** rng.uniform(0.5, 4.5) * stamp / stamp.max()
    variance = 1 + stars / 300
    data = stars + rng.normal(size=x.shape) * np.sqrt(variance)
    ys, xs = rng.integers(2, cell * n - 2, (2, 60))
    free = stars[ys, xs] < 0.5
    ys, xs = ys[free], xs[free]
    hits = np.zeros(x.shape)
    hits[ys, xs] = 10 ** rng.uniform(1.5, 3, ys.size)
    ccd = image_of(data + hits, error=np.sqrt(variance + hits / 300))
    fwhm = psf_fwhm(filt).value / 0.1109
    found = find_cosmic_rays(ccd, fwhm=fwhm)
    assert found[ys, xs].mean() > 0.95
    near = binary_dilation(hits > 0, np.ones((3, 3)))
    # of the stars' 10^4 pixels at most one or two
    assert np.count_nonzero(found & ~near & (stars > 3)) <= 2
    assert np.count_nonzero(found & ~near) <= 4


def test_a_masked_image_has_no_cosmic_rays():
    ccd = image_of(np.ones((20, 20)), mask=np.ones((20, 20), bool))
    assert not find_cosmic_rays(ccd, fwhm=2.0).any()
    refuses("'fwhm' must be positive", find_cosmic_rays, ccd, fwhm=0.0)
