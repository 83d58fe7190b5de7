import astropy.units as u
import astroscrappy
import numpy as np
import pytest
from astropy.nddata import CCDData, StdDevUncertainty

from helpers.errors import refuses
from miricigale.instrument import DQ, field_mask, flat_field, photmjsr, psf_fwhm
from miricigale.psf import miri_psf
from miricigale.reduction import calibrate, calibration, find_cosmic_rays
from miricigale.reduction.images import image

SHAPE = (1024, 1032)


@pytest.fixture(scope="module")
def rate():
    filt = "miri.f1000w"
    data = 20.0 * flat_field(filt) + 0.05
    meta = {"filter": filt, "subarray": "FULL"}
    flags = np.zeros(SHAPE, np.int64)
    flags[:, :4] = DQ.REFERENCE_PIXEL | DQ.DO_NOT_USE
    return image(data, "adu / s", error=np.full(SHAPE, 0.1), flags=flags, wcs=None, meta=meta)


def test_uniform_sky_comes_out_uniform(rate):
    cal = calibrate(rate, filter="miri.f1000w", subarray="FULL", dark=0.05, gain=4.0)
    good = ~cal.mask
    factor = photmjsr("miri.f1000w", gain=4.0)
    np.testing.assert_allclose(cal.data[good], 20 * factor, rtol=1e-5)
    expected = 0.1 * factor / flat_field("miri.f1000w")[good]
    np.testing.assert_allclose(cal.uncertainty.array[good], expected, rtol=1e-5)
    assert cal.unit == "MJy/sr"
    assert cal.meta["photmjsr"] == pytest.approx(factor)


def test_pixels_off_the_field_are_masked_with_the_reason(rate):
    cal = calibrate(rate, filter="miri.f1000w", subarray="FULL", dark=0.05, gain=4.0)
    outside = (cal.flags & DQ.NON_SCIENCE) != 0
    reference = (cal.flags & DQ.REFERENCE_PIXEL) != 0
    np.testing.assert_array_equal(outside, ~field_mask() & ~reference)
    np.testing.assert_array_equal(cal.mask, ~field_mask() | reference)


def test_refuses_what_is_no_rate(rate):
    wrong = CCDData(rate.data, unit="Jy")
    with pytest.raises(ValueError, match="'rate' must be in adu / s"):
        calibrate(wrong, filter="miri.f1000w", subarray="FULL", dark=0.0, gain=4.0)
    with pytest.raises(ValueError, match=r"'rate' must be of shape \(256, 256\) for 'SUB256'"):
        calibrate(rate, filter="miri.f1000w", subarray="SUB256", dark=0.0, gain=4.0)


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
    ccd = CCDData(
        data + hits, unit="MJy/sr", uncertainty=StdDevUncertainty(np.sqrt(variance + hits / 300))
    )
    fwhm = psf_fwhm(filt).value / 0.1109
    found = find_cosmic_rays(ccd, fwhm=fwhm)
    assert found[ys, xs].mean() > 0.95
    near = np.zeros(x.shape, bool)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            near[ys + dy, xs + dx] = True
    # of the stars' 10^4 pixels at most one or two
    assert np.count_nonzero(found & ~near & (stars > 3)) <= 2
    assert np.count_nonzero(found & ~near) <= 4


@pytest.mark.parametrize("n_hits", [0, 3, 200])
def test_hits_are_those_of_lacosmic_on_the_whole_frame(n_hits):
    rng = np.random.default_rng(n_hits)
    y, x = np.mgrid[:300, :320]
    data = rng.normal(size=x.shape)
    for _ in range(40):
        r2 = (x - rng.uniform(0, 320)) ** 2 + (y - rng.uniform(0, 300)) ** 2
        data += 10 ** rng.uniform(0.5, 3.5) * np.exp(-0.5 * r2 / rng.uniform(0.8, 3) ** 2)
    # tracks of up to four pixels, also at the edges
    rows, columns = rng.integers(0, 300, n_hits), rng.integers(0, 320, n_hits)
    for step in range(4):
        some = rng.random(n_hits) < 0.7**step
        data[rows[some], np.minimum(columns[some] + step, 319)] += 10 ** rng.uniform(1, 3)
    data = data.astype(np.float32)
    variance = (1 + np.maximum(data, 0) / 300).astype(np.float32)
    mask = rng.random(x.shape) < 0.01
    mask[:, :20] = True
    expected, _ = astroscrappy.detect_cosmics(
        data, inmask=mask, invar=variance, sigclip=5.0, sigfrac=0.3, objlim=3.0, gain=1.0,
        readnoise=0.0, satlevel=np.inf, niter=3,
    )  # fmt: skip
    found = calibration._lacosmic(data, variance, mask)
    np.testing.assert_array_equal(found & ~mask, expected & ~mask)
    assert np.count_nonzero(found & ~mask) >= n_hits


def test_a_masked_image_has_no_cosmic_rays():
    data = np.ones((20, 20))
    ccd = CCDData(
        data, unit="MJy/sr", uncertainty=StdDevUncertainty(data), mask=np.ones((20, 20), bool)
    )
    assert not find_cosmic_rays(ccd, fwhm=2.0).any()
    refuses("'fwhm' must be positive", find_cosmic_rays, ccd, fwhm=0.0)
