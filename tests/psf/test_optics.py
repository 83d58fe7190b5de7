import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.psf import _core, hst_pupil, jwst_pupil, optics


@pytest.fixture(scope="module")
def disk():
    """A clear circular pupil of 1 m on 256 cells."""
    n, diameter = 256, 1.0
    # a polygon that lacks one part in a million of the circle
    angle = 2 * np.pi * np.arange(3600) / 3600
    circle = 0.5 * diameter * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    amplitude = _core.polygon_coverage(circle, n, diameter / n, 8)
    return optics.Pupil(amplitude, (amplitude > 0).astype(int), diameter)


def test_rectangle_covers_cells_by_exact_fractions():
    box = np.array([[-1.25, -2.0], [1.5, -2.0], [1.5, 1.0], [-1.25, 1.0]])
    coverage = _core.polygon_coverage(box, 8, 1.0, 4)
    row = np.array([0, 0, 0.25, 1, 1, 0.5, 0, 0])
    expected = np.zeros((8, 8))
    expected[2:5] = row
    assert_allclose(coverage, expected, atol=1e-12)


def test_airy_pattern_of_a_circular_aperture(disk):
    """FWHM 1.029, first zero 1.220, 83.8 % within it, in units of wavelength / diameter."""
    wavelength = 2.0e-6
    unit = wavelength / disk.diameter
    axis = np.linspace(-4, 4, 801) * unit
    form = {"theta_x": axis, "theta_y": axis, "power": disk.amplitude.sum()}
    image = _core.matrix_dft_intensity(disk.amplitude, disk.step, wavelength, **form)
    profile = image[400, 400:] / image[400, 400]
    x = axis[400:] / unit
    half = np.interp(-0.5, -profile[:80], x[:80])
    assert 2 * half == pytest.approx(1.029, rel=1e-3)
    assert x[90 + np.argmin(profile[90:160])] == pytest.approx(1.220, abs=0.006)
    within = _core.radial_sums(image, 400.0, 400.0, np.array([1.220 * 100]))[0]
    assert within == pytest.approx(0.838, abs=1e-3)
    # central intensity per solid angle: area / wavelength^2
    density = image[400, 400] / (axis[1] - axis[0]) ** 2
    assert density == pytest.approx(np.pi / 4 / wavelength**2, rel=1e-3)


def test_width_of_a_circular_aperture_in_arcsec(disk):
    image = optics.polychromatic_psf(disk, 0.0, [2.0], step=0.02, n=101)
    width = 0.02 * _core.half_maximum_width(image, 50.0, 50.0)
    assert width == pytest.approx(1.029 * np.degrees(2.0e-6 / 1.0) * 3600, rel=2e-3)


def test_transform_equals_the_fourier_sum_and_keeps_the_light():
    rng = np.random.default_rng(4)
    pupil = rng.normal(size=(16, 16)) + 1j * rng.normal(size=(16, 16))
    axis = np.arange(16) * 1e-5 / 3.2
    image = _core.matrix_dft_intensity(pupil, 0.2, 1e-5, axis, axis, dtype=complex)
    expected = np.abs(np.fft.fft2(pupil)) ** 2 / np.sum(np.abs(pupil) ** 2) / 16**2
    assert_allclose(image, expected, atol=1e-15)
    assert image.sum() == pytest.approx(1.0, rel=1e-12)


def test_radial_sums_of_a_flat_image_are_areas():
    radii = np.array([0.0, 0.3, 0.5, 1.0, 1.7, 3.3, 8.0, 12.0, 17.7, 40.0])
    sums = _core.radial_sums(np.ones((101, 101)), 50.0, 50.0, radii)
    assert_allclose(sums, np.pi * radii**2, rtol=1e-3, atol=0.01)


def test_collecting_areas():
    # 25.4 m^2: JWST, jwst-docs; HST's 4.0 m^2 of the handbooks are of an obscuration of 0.33, not 0.40
    hst = 4.0 - np.pi * 1.2**2 * (0.40**2 - 0.33**2)
    for pupil, area in ((jwst_pupil(256), 25.4), (hst_pupil(), hst)):
        assert pupil.amplitude.sum() * pupil.step**2 == pytest.approx(area, rel=0.03)


def test_jwst_has_18_segments_and_a_strut_along_v3():
    pupil = jwst_pupil(256, angle=0.0)
    assert set(np.unique(pupil.segments)) == set(range(19))
    column = pupil.amplitude[:, 127]
    assert column[230] < 0.1  # the upper strut blocks the B1 segment
    # symmetric about V3
    assert_allclose(pupil.amplitude, pupil.amplitude[:, ::-1], atol=0.13)


def test_v3_lies_clockwise_of_the_image_axis():
    pupil = jwst_pupil(256, angle=10.0)
    # cells of segments that are behind the struts
    y, x = np.nonzero((pupil.segments > 0) & (pupil.amplitude < 0.1))
    upper = y > 200
    assert x[upper].mean() > 127.5 + 10


@pytest.mark.parametrize("rms", [75.0, 150.0])
def test_wavefront_has_its_rms_and_no_tilt(rms):
    pupil = jwst_pupil(256)
    opd = pupil.wavefront_error(rms, seed=5)
    w = pupil.amplitude
    inside = w > 0
    assert np.average(opd[inside], weights=w[inside]) == pytest.approx(0, abs=1e-9 * rms)
    assert np.sqrt(np.average(opd[inside] ** 2, weights=w[inside])) == pytest.approx(rms)
    x = np.broadcast_to(np.arange(256.0), w.shape)
    tilt = np.average((opd * (x - np.average(x, weights=w)))[inside], weights=w[inside])
    assert tilt == pytest.approx(0, abs=1e-7 * rms)


def test_segment_terms_are_piston_tilt_and_focus_of_every_segment():
    pupil = jwst_pupil(128)
    y, x = np.mgrid[-1:1:128j, -1:1:128j]
    rng = np.random.default_rng(7)
    opd = _core.wavefront(pupil.amplitude, pupil.segments, x, y, 75.0, 1.0, rng)
    for k in range(1, 19):
        here = (pupil.segments == k) & (pupil.amplitude > 0)
        design = np.stack([np.ones(here.sum()), x[here], y[here], (x**2 + y**2)[here]], axis=1)
        terms = np.linalg.lstsq(design, opd[here], rcond=None)[0]
        assert_allclose(design @ terms, opd[here], atol=1e-9 * 75)
        # nanometers of focus across the pupil
        assert abs(terms[3]) > 1


def test_wavefront_does_not_depend_on_the_grid():
    coarse, fine = (jwst_pupil(n).wavefront_error(75.0, seed=3) for n in (128, 256))
    binned = fine.reshape(128, 2, 128, 2).mean((1, 3))
    clear = jwst_pupil(128).amplitude > 0.999
    assert np.std((binned - coarse)[clear]) < 0.05 * 75


def test_strehl_ratio_follows_marechal():
    """exp(-(2 pi rms / wavelength)^2), exact for small errors."""
    pupil = jwst_pupil(256)
    peaks = []
    for rms in (0.0, 100.0):
        opd = pupil.wavefront_error(rms, seed=2)
        image = optics.polychromatic_psf(pupil, opd, [5.6], step=0.02, n=51)
        peaks.append(image.max())
    assert peaks[1] / peaks[0] == pytest.approx(np.exp(-((2 * np.pi * 0.1 / 5.6) ** 2)), rel=2e-3)


def test_image_stands_on_the_middle_cell_whatever_the_wavefront():
    pupil = jwst_pupil(256)
    opd = pupil.wavefront_error(300.0, seed=8)
    tilt = 2000.0 * np.linspace(-1, 1, 256)  # nm across the pupil
    still = optics.polychromatic_psf(pupil, opd, [7.7], step=0.03, n=61)
    tilted = optics.polychromatic_psf(pupil, opd + tilt, [7.7], step=0.03, n=61)
    assert np.unravel_index(still.argmax(), still.shape) == (30, 30)
    assert_allclose(tilted, still, atol=1e-4 * still.max())


def test_bad_arguments_are_named():
    pupil = jwst_pupil(128)
    refuses("'n' must be odd, got 50", optics.polychromatic_psf, pupil, 0.0, [5.6], step=0.1, n=50)
    refuses("an image below", optics.polychromatic_psf, pupil, 0.0, [5.6], step=0.1, n=501)


@pytest.mark.parametrize("angle", [45.0, 30.0, 0.0])
def test_open_area_of_hst(angle):
    """Krist, Hook & Stoehr 2011: four vanes of 0.022 of the radius, three pads of 0.065."""
    pupil = hst_pupil(256, angle=angle)
    # of the cold mask of WFC3/IR, by the first ring of STScI's empirical PSFs
    inner = 0.40
    area = np.pi * (1 - inner**2) - 4 * (1 - inner) * 0.022 - 3 * np.pi * 0.065**2
    got = pupil.amplitude.sum() * pupil.step**2 / 1.2**2
    assert got == pytest.approx(area, rel=3e-4)


def test_the_wavefront_turns_with_the_telescope():
    upright, turned = (jwst_pupil(128, angle=angle) for angle in (0.0, 90.0))
    errors = [
        np.rot90(upright.wavefront_error(100.0, seed=3)),
        turned.wavefront_error(100.0, seed=3),
    ]
    both = (np.rot90(upright.amplitude) > 0.99) & (turned.amplitude > 0.99)
    assert both.mean() > 0.5
    assert_allclose(*(one[both] for one in errors), atol=2.0)
