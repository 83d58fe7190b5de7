"""What the detector is."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.instrument import (
    DetectorProperties,
    aperture,
    bad_pixel_mask,
    field_mask,
    flat_field,
    imager_filters,
    miri_detector,
    reference_pixel_mask,
)


def test_published_figures():
    detector = miri_detector()
    assert detector.bias + detector.saturation_dn < 2**detector.adc_bits - 1
    # 4.9e-8 /um2/s at solar minimum times about 1.7, on 25 um pixels
    assert_allclose(detector.cosmic_ray_flux, 4.9e-8 * 1.7, rtol=0.01)


def test_linearity_there_and_back():
    detector = miri_detector()
    dn = np.linspace(-100, 1.9 * detector.full_well / detector.gain, 4001)
    assert_allclose(detector.linearize(detector.delinearize(dn)), dn, atol=1e-6)
    assert_allclose(detector.linearize(detector.saturation_dn) * detector.gain, 210e3, rtol=1e-9)
    measured = detector.delinearize(dn)
    assert np.all(np.diff(measured) > 0)
    # a few per cent at the full well, nothing for an empty one
    assert 0.02 < 1 - detector.saturation_dn * detector.gain / 210e3 < 0.08
    assert_allclose(detector.delinearize(10.0), 10, rtol=1e-4)


def test_linearity_against_a_square_root():
    # dn + c dn^2 has a closed inverse
    detector = DetectorProperties(nonlinearity=(0, 1, 1e-6))
    dn = np.linspace(0, 60_000, 50)
    assert_allclose(detector.delinearize(dn), (np.sqrt(1 + 4e-6 * dn) - 1) / 2e-6, atol=1e-6)


def test_figures_may_have_units():
    """Electrons are counts times the gain, and DN the counts of astropy's adu."""
    gain = 5.5 * u.electron / u.DN
    detector = DetectorProperties(gain=gain, read_noise=11 * u.electron, bias=9000 * u.DN)
    assert (detector.gain, detector.read_noise, detector.bias) == (5.5, 2.0, 9000.0)
    assert detector.replace(full_well=4e4 * u.adu).full_well == 22e4
    assert detector.replace(pixel_pitch=0.018 * u.mm).pixel_pitch == pytest.approx(18)
    refuses("'dark_current' must be convertible to electron / s", DetectorProperties,
            dark_current=1 * u.electron, error=u.UnitsError)  # fmt: skip


def test_interpixel_capacitance_moves_and_loses_nothing():
    kernel = miri_detector().ipc_kernel
    assert_allclose(kernel.sum(), 1)
    assert_allclose(kernel[1], [0.033, 1 - 2 * 0.033 - 2 * 0.024 - 4 * 0.013, 0.033])
    assert_array_equal(kernel, kernel[::-1, ::-1])


def test_flat_field():
    flat = flat_field("miri.f770w")
    assert flat.dtype == np.float32
    assert flat.shape == (1024, 1032)
    assert not flat.flags.writeable
    light = ~reference_pixel_mask()
    assert_allclose(flat[light].mean(), 1, rtol=1e-5)
    assert np.all(flat[~light] == 1)
    # differences of neighbors hold the pixels, without what is smooth
    pixels = np.diff(flat[:, 4:-4].astype(float), axis=1).std() / np.sqrt(2)
    assert_allclose(pixels, 0.01, rtol=0.02)
    assert flat[light].std() < 0.015


def test_flats_are_the_same_each_time_and_differ_smoothly_by_filter():
    flats = [flat_field(name).astype(float) for name in imager_filters()[:2]]
    assert_array_equal(flat_field(imager_filters()[0]), flats[0])
    ratio = flats[1] / flats[0]
    assert ratio.std() > 0.002
    assert np.diff(ratio[:, 4:-4], axis=1).std() < 2e-4


def test_bad_pixels_are_about_one_in_a_thousand():
    mask = bad_pixel_mask()
    assert mask.dtype == bool
    assert 0.0007 < mask.mean() < 0.0013
    assert not np.any(mask & reference_pixel_mask())
    # some stand together
    assert np.any(mask[:, 1:] & mask[:, :-1])


def test_reference_and_field_masks():
    assert reference_pixel_mask().sum() == 8 * 1024
    field = field_mask()
    # 74" x 113"
    assert_allclose(field.any(axis=0).sum() * 0.1105, 74, atol=0.5)
    assert not np.any(field & reference_pixel_mask())
    assert field_mask(subarray="BRIGHTSKY").all()


def test_subarrays_are_cut_from_the_same_detector():
    for name in ("BRIGHTSKY", "SUB256", "SUB64"):
        cut = flat_field("miri.f770w")[aperture(name).slices]
        assert_array_equal(flat_field("miri.f770w", subarray=name), cut)
    assert reference_pixel_mask(subarray="SUB64").sum() == 4 * 64
    assert not reference_pixel_mask(subarray="SUB256").any()
    refuses("no sub-array 'SUB3'", bad_pixel_mask, subarray="SUB3", error=KeyError)


@pytest.mark.parametrize(("options", "message"), cases_of(__file__, "refused"))
def test_rejects_impossible_detectors(options, message):
    refuses(message, DetectorProperties, **options)
    refuses(r"no imaging filter 'miri.f1w'", flat_field, "miri.f1w", error=KeyError)
