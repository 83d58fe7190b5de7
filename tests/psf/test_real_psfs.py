"""PSFs of users: truncated, off-center, even-sized, oversampled, unnormalized."""

import functools

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import ImagePSF
from scipy.signal import fftconvolve

from helpers.errors import refuses, warned
from helpers.light import gaussian_image
from helpers.scenes import tan_wcs
from miricigale.psf import (
    MatchingKernel,
    from_photutils,
    gaussian_psf,
    make_psf,
    psf_at,
    psf_grid,
    read_psf,
)
from miricigale.utils.exceptions import DataError, MiricigaleWarning

SCALE = 0.04 * u.arcsec
SKY = {"pixel_scale": SCALE, "frame": "sky"}
kernel_of = functools.partial(MatchingKernel.from_psfs, pixel_scale=SCALE)
HI, LO = 1.7, 3.0  # rms of the two PSFs in pixels


def offsets(n, x, y):
    """Distances in pixels from a point x, y off the middle of an n x n image."""
    axis = np.arange(n) - (n - 1) / 2
    return axis - x, (axis - y)[:, None]


def moffat(n, core, beta, x=0.0, y=0.0):
    dx, dy = offsets(n, x, y)
    return (beta - 1) / (np.pi * core**2) * (1 + (dx**2 + dy**2) / core**2) ** -beta


def expected_kernel(n):
    """Gaussians: the kernel is that of the difference of the variances, and centered."""
    return gaussian_image(n, np.sqrt(LO**2 - HI**2))


def assert_is_the_gaussian_kernel(kernel):
    n = kernel.array.shape[0]
    expected = expected_kernel(n)
    # the automatic regularization keeps the error of the encircled energy below 0.001
    assert_allclose(kernel.array, expected, rtol=0, atol=0.03 * expected.max())
    assert kernel.array.sum() == pytest.approx(1, abs=1e-6)
    # and what comes out of it is the wide PSF where it should stand
    image = kernel.apply(gaussian_image(n, HI))
    assert_allclose(image, gaussian_image(n, LO), rtol=0, atol=5e-3 * image.max())
    # a point of unit flux keeps it
    point = np.zeros((2 * n + 1, 2 * n + 1))
    point[n, n] = 1.0
    assert kernel.apply(point).sum() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("n", [51, 52])
@pytest.mark.parametrize("off", [(0.0, 0.0), (1.3, -0.8), (-0.46, 1.77)])
def test_off_center_and_even_arrays_give_the_centered_kernel(n, off):
    kernel = kernel_of(gaussian_image(n, HI, -off[1], off[0]), gaussian_image(n, LO, *off))
    assert_is_the_gaussian_kernel(kernel)
    assert kernel.array.shape[0] % 2 == 1
    # the moving itself costs less than the regularization
    m = kernel.array.shape[0]
    straight = kernel_of(gaussian_image(m, HI), gaussian_image(m, LO))
    assert_allclose(kernel.array, straight.array, atol=5e-4 * kernel.array.max())
    found = np.array(kernel.meta["centering"]["lo"]) / SCALE.value
    assert_allclose(found, off, atol=2e-3)


def test_off_center_psfs_keep_their_angles():
    """The core is put on the axis before the PSF is turned about it."""
    kind = {"pixel_scale": SCALE, "frame": "detector"}
    psfs = [make_psf(gaussian_image(61, s, 1.2, -0.9), **kind) for s in (HI, LO)]
    angles = {"hi_angle": 20 * u.deg, "lo_angle": [20, 140] * u.deg}
    kernel = kernel_of(*psfs, **angles)
    assert_is_the_gaussian_kernel(kernel)


def test_oversampled_psf_of_unit_sum_is_scaled_and_said():
    n, over = 121, 4
    for make in (
        lambda d: make_psf(d, pixel_scale=SCALE, oversampling=over, frame="sky"),
        lambda d: from_photutils(ImagePSF(d, oversampling=over), pixel_scale=SCALE, frame="sky"),
    ):
        with pytest.warns(MiricigaleWarning, match="'data' sums to 1 with 4 x 4 cells per pixel"):
            psf = make(gaussian_image(n, over * HI))
        assert psf.data.sum() == pytest.approx(over**2, rel=1e-6)
    lo = make_psf(gaussian_image(51, LO), pixel_scale=SCALE, frame="sky")
    kernel = kernel_of(psf, lo)
    assert_is_the_gaussian_kernel(kernel)


@pytest.mark.parametrize("factor", [0.5, 0.02, 7.0])
def test_sums_that_are_no_fraction_are_refused_unless_scaled(factor):
    data = factor * gaussian_image(51, HI)
    refuses(r"'data' must be .*'enclosed' given", make_psf, data, **SKY)
    lo = gaussian_image(51, LO)
    refuses("'hi' must be a PSF whose sum is the fraction of light", kernel_of, data, lo)
    kernel = kernel_of(data, lo, normalize=True)
    assert_is_the_gaussian_kernel(kernel)
    psf = make_psf(data, **SKY, enclosed=0.97)
    assert psf.enclosed == pytest.approx(0.97)
    refuses("'enclosed' must be above 0 and at most 1", make_psf, data, **SKY, enclosed=1.5)


def test_truncated_wings_are_said_and_the_kernel_has_unit_sum():
    """Wings as r**-3, of which a circle of R leaves (1 + R^2 / c^2)^-1/2 outside."""
    hi, lo = moffat(101, 2.0, 1.5), moffat(101, 4.0, 1.5)
    with pytest.warns(MiricigaleWarning, match="light beyond the PSFs' grids") as caught:
        kernel = kernel_of(hi, lo)
    assert f"{1 - lo.sum():.3f} of 'lo'" in str(caught[0].message)
    assert kernel.array.sum() == pytest.approx(1, abs=1e-9)
    assert kernel.meta["held"] == pytest.approx([hi.sum(), lo.sum()])
    absolute = kernel_of(hi, lo, normalize=False)
    assert absolute.array.sum() == pytest.approx(lo.sum(), abs=1e-9)
    # known fractions stay as they are, without a warning
    known = make_psf(hi, **SKY, enclosed=0.96), make_psf(lo, **SKY, enclosed=0.93)
    assert kernel_of(*known).array.sum() == pytest.approx(0.93)
    # scaled to 1 on their own grids, the wings alone show it: the light beyond the circle
    with pytest.warns(MiricigaleWarning, match="light beyond the PSFs' grids") as caught:
        kernel_of(hi / hi.sum(), lo / lo.sum())
    words = str(caught[0].message).split("wings: ")[1].split()
    truth = [1 / np.sqrt(1 + (50.5 / core) ** 2) for core in (2.0, 4.0)]
    assert_allclose([float(words[0]), float(words[3])], truth, rtol=0.15)


def test_exchanged_psfs_are_refused():
    sharp, wide = gaussian_image(51, HI), gaussian_image(51, LO)
    for psfs, match in (
        ((wide, sharp), "'hi, lo' must be the sharp and the wide PSF"),
        ((sharp, gaussian_image(51, LO, 15.0, 0.0)), "'lo' must be a PSF whose core stands near"),
    ):
        refuses(match, kernel_of, *psfs)
    # MIRI's bluest bands and the longest of a smaller telescope are alike: that is no exchange
    kernel = kernel_of(gaussian_image(51, 3.1), wide)
    assert kernel.array.sum() == pytest.approx(1, abs=1e-6)


def test_gridded_models_need_a_position():
    """By position: a kernel for each place."""
    kind, widths = {"pixel_scale": SCALE, "fov": 2 * u.arcsec}, (0.1, 0.28, 0.28, 0.36, 0.36)
    hi, *wide = (gaussian_psf(width * u.arcsec, **kind) for width in widths)
    grid = psf_grid(wide, [(0, 0), (0, 100), (100, 0), (100, 100)])
    match = r"'lo' must be an ImagePSF or an array \(psf_at .*, got PSFGrid"
    refuses(match, kernel_of, hi, grid)
    gains = [kernel_of(hi, psf_at(grid, x, 30)).noise_gain for x in (0, 100)]
    variances = np.array([(w**2 - 0.1**2) / (8 * np.log(2)) for w in (0.28, 0.36)]) / 0.04**2
    assert_allclose(gains, 1 / np.sqrt(4 * np.pi * variances), rtol=0.01)


def test_artefacts_of_resampling_make_no_stripes(tmp_path):
    """A wide PSF of coarser, replicated pixels: its steps, which the sharp one lacks, ask for stripes."""
    n = 69
    hi, coarse = gaussian_image(n, HI), gaussian_image(n, LO).reshape(23, 3, 23, 3).mean((1, 3))
    lo = np.kron(coarse, np.ones((3, 3)))
    kernel = kernel_of(hi, lo)
    truth = 1 / np.sqrt(4 * np.pi * (LO**2 - HI**2))
    assert kernel.meta["within_limits"]
    assert kernel.meta["noise_gain"] == pytest.approx(kernel.noise_gain)
    assert kernel.noise_gain < 1.25 * truth * 1.01
    negative = kernel.array[kernel.array < 0].sum()
    assert kernel.meta["negative_sum"] == pytest.approx(negative)
    assert kernel.meta["negative_sum"] > -0.5
    deviation = np.abs(kernel.matched - kernel.target).max() / kernel.target.max()
    assert kernel.meta["residual"] == pytest.approx(deviation)
    # and the file says so too
    kernel.write(tmp_path / "kernel.fits")
    again = MatchingKernel.read(tmp_path / "kernel.fits").meta
    for name in ("noise_gain", "negative_sum", "held", "within_limits"):
        assert again[name] == kernel.meta[name]
    # what the error alone would have taken
    sharp = kernel_of(hi, lo, regularization=3e-7)
    assert sharp.meta["max_error"] < kernel.meta["max_error"] - 2e-3
    assert sharp.noise_gain > 10 * kernel.noise_gain


def test_scale_and_angle_come_from_the_header(tmp_path):
    path = tmp_path / "psf.fits"
    fits.writeto(path, gaussian_image(51, HI), tan_wcs((1, 1), 0.04, pa=30.0).to_header())
    psf = read_psf(path, frame="sky")
    assert psf.pixel_scale.value == pytest.approx(0.04)
    assert psf.angle.value == pytest.approx(30)
    with pytest.raises(ValueError, match=r"'pixel_scale' must be 0\.04 arcsec, as the header"):
        read_psf(path, frame="sky", pixel_scale=0.06 * u.arcsec)
    refuses(r"'angle' must be 30 deg, as the header", read_psf, path, frame="sky", angle=0 * u.deg)
    mirrored = tan_wcs((1, 1), 0.04, pa=30.0, parity=1).to_header()
    fits.writeto(path, gaussian_image(51, HI), mirrored, overwrite=True)
    refuses("'path' must be a file with east to the left", read_psf, path, frame="sky")
    # stpsf's, arcsec per cell
    stated = fits.Header({"PIXELSCL": 0.0275, "OVERSAMP": 4})
    fits.writeto(path, gaussian_image(51, 4 * HI), stated, overwrite=True)
    psf = warned("sums to", read_psf, path)
    assert (psf.frame, psf.oversampling[0]) == ("detector", 4)
    assert make_psf(gaussian_image(51, HI), pixel_scale=SCALE).frame == "sky"
    assert psf.pixel_scale.value == pytest.approx(0.11)
    fits.writeto(path, gaussian_image(51, HI), overwrite=True)
    refuses(
        "'pixel_scale' must be given, for the header does not",
        read_psf,
        path,
        frame="sky",
    )


def test_roll_of_the_header_turns_the_psf(tmp_path):
    path = tmp_path / "psf.fits"
    dx, dy = offsets(61, 0.0, 0.0)
    data = np.exp(-0.5 * ((dx / 4) ** 2 + (dy / 2.5) ** 2)) / (2 * np.pi * 10)
    fits.writeto(path, data, fits.Header({"PA_APER": 35.0}))
    psf = read_psf(path, pixel_scale=SCALE, frame="detector")
    hi = gaussian_psf(0.16 * u.arcsec, pixel_scale=SCALE, fov=2.4 * u.arcsec)
    kernel = kernel_of(hi, psf)
    # +y turned counter-clockwise by 35 deg: so is the long axis, which was x
    x, y = offsets(kernel.target.shape[0], 0.0, 0.0)
    total = kernel.target.sum()
    xx, yy, xy = ((kernel.target * p).sum() / total for p in (x**2, y**2, x * y))
    assert np.degrees(0.5 * np.arctan2(2 * xy, xx - yy)) == pytest.approx(35, abs=0.2)
    given = kernel_of(hi, psf, lo_angle=35 * u.deg)
    assert_array_equal(given.array, kernel.array)


def test_ready_kernels_are_taken(tmp_path):
    array = expected_kernel(41)
    kernel = MatchingKernel.from_array(array, pixel_scale=SCALE, source=gaussian_image(41, HI))
    assert_allclose(kernel.target, gaussian_image(41, LO), atol=1e-4 * kernel.target.max())
    bare = MatchingKernel.from_array(array, pixel_scale=SCALE)
    assert bare.source is None
    with pytest.warns(MiricigaleWarning, match=r"summed to 0\.9430 and was brought to 1"):
        mended = MatchingKernel.from_array(0.943 * array / array.sum(), pixel_scale=SCALE)
    assert_allclose(mended.array, array / array.sum(), rtol=1e-12)
    assert mended.meta["sum"] == pytest.approx(0.943)
    psfs = {"source": gaussian_image(41, LO), "target": gaussian_image(41, HI)}
    for data, options, match in (
        (2 * array / array.sum(), {}, "'array' must be a kernel whose sum is 1, got a sum of 2"),
        (expected_kernel(40), {}, "'array' must be square with an odd number"),
        (array, {"source": gaussian_image(51, HI)}, "'source' must be a PSF of the kernel's shape"),
        (array, psfs, "'source, target' must be the sharp and the wide PSF"),
    ):
        refuses(match, MatchingKernel.from_array, data, pixel_scale=SCALE, **options)
    with pytest.warns(MiricigaleWarning, match=r"stands \(1\.00, 0\.00\) pixels off the center"):
        MatchingKernel.from_array(np.roll(array, 1, axis=1), pixel_scale=SCALE)
    path = tmp_path / "kernels.fits"
    fits.writeto(path, np.stack([np.zeros_like(array), array]), fits.Header({"PIXSCALE": 0.04}))
    read = MatchingKernel.read(path, ext=0, plane=1)
    assert_allclose(read.array, array / array.sum())
    assert read.pixel_scale.value == 0.04
    other = {"ext": 0, "plane": 1, "pixel_scale": 0.06 * u.arcsec}
    match = r"kernel for pixels of 0\.04 arcsec, .* 0\.06 arcsec \('pixel_scale'\)"
    refuses(match, MatchingKernel.read, path, error=DataError, **other)
    # the plane alone is enough, and brackets name both
    for kernel in (MatchingKernel.read(path, plane=1), MatchingKernel.read(f"{path}[0,1]")):
        assert_allclose(kernel.array, read.array)
    # the pixel of our own files must agree, too
    read.write(tmp_path / "own.fits")
    own = tmp_path / "own.fits"
    other = {"pixel_scale": 0.06 * u.arcsec}
    refuses(match, MatchingKernel.read, own, error=DataError, **other)
    sharp = gaussian_image(41, HI)
    completed = MatchingKernel.read(own, source=sharp)
    assert_allclose(completed.source, sharp / sharp.sum())
    assert_allclose(completed.array, read.array)
    assert_allclose(completed.target, fftconvolve(completed.source, read.array, mode="same"))
    # a file without a pixel asks for it
    fits.writeto(path, array, overwrite=True)
    refuses("'pixel_scale' must be given: the header of", MatchingKernel.read, path)


def test_kernels_of_regions_blend():
    """One sharp PSF, several wide ones: the mean kernel is that of the mean wide PSF."""
    hi = gaussian_image(51, HI)
    wide = [gaussian_image(51, s) for s in (3.0, 3.4)]
    kernels = [kernel_of(hi, lo, regularization=1e-4) for lo in wide]
    mean = MatchingKernel.blend(kernels, [3, 1])
    direct = kernel_of(hi, 0.75 * wide[0] + 0.25 * wide[1], regularization=1e-4)
    assert_allclose(mean.array, direct.array, atol=1e-7)
    assert_allclose(mean.target, direct.target, atol=1e-7)
    assert mean.meta["weights"] == [0.75, 0.25]
    other = kernels[0].cropped(1 * u.arcsec)
    refuses("'kernels' must be alike", MatchingKernel.blend, [kernels[0], other])
    refuses("'weights' must be 2 non-negative numbers", MatchingKernel.blend, kernels, [0, 0])


@pytest.mark.filterwarnings("ignore:light beyond the PSFs' grids")
@pytest.mark.parametrize("region", range(26))
def test_real_drizzled_psfs(data_file, region):
    """PRIMER-UDS, F444W to F770W, against the kernels that another program made of them."""
    names = ("f444w_psf", "f770w_psf", "f444w_kernel_f770w")
    *paths, path = (data_file(f"uds/psf/uds-test-{name}.fits.gz") for name in names)
    theirs = fits.getdata(path)[region]
    hi, lo = (read_psf(p, plane=region, pixel_scale=SCALE, frame="sky") for p in paths)
    kernel = kernel_of(hi, lo)
    assert kernel.noise_gain < 1.1 * np.sqrt(np.sum(theirs.astype(float) ** 2))
    assert kernel.meta["negative_sum"] > -0.2
    assert kernel.meta["within_limits"]
    error = kernel.encircled_energy_error(np.arange(0.15, 1.9, 0.02) * u.arcsec)
    assert np.abs(error).max() < 0.005
    assert kernel.array.sum() == pytest.approx(1, abs=1e-6)
    # what was measured off the center is gone: moments of the cores, no window
    for image in (kernel.source, kernel.target):
        c = image.shape[0] // 2
        core = image[c - 4 : c + 5, c - 4 : c + 5]
        middle = np.array([core.sum(0), core.sum(1)]) @ np.arange(-4, 5) / core.sum()
        assert np.abs(middle).max() < 0.06
    # light of the PSF after the convolution, as far as it stays on the grid
    matched = fftconvolve(kernel.source, kernel.array, mode="full").sum()
    assert matched == pytest.approx(1, abs=1e-6)
