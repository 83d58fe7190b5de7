"""
Times forced photometry and tells how near to the truth it comes.

    python benchmarks/photometry.py            speed, up to 100k points and 20k cutouts
    python benchmarks/photometry.py --quick    up to 5k points and 2k cutouts
    python benchmarks/photometry.py --bands    accuracy with MIRI and HST PSFs
"""

import contextlib
import resource
import sys
import time
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable
from scipy.interpolate import RectBivariateSpline
from scipy.signal import fftconvolve, oaconvolve

from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import ErrorModel, ForcedPhotometer, SourceTemplates, detect_sources
from miricigale.profiles import sersic_image
from miricigale.psf import MatchingKernel, gaussian_psf, hst_psf, miri_psf, psf_mosaic
from miricigale.utils.tables import match_sky

CENTER = SkyCoord(53.1, -27.8, unit="deg")
FINE = 0.06 * u.arcsec


def mosaic(data, wcs, sigma):
    """Flux per pixel (uJy) as CCDData in MJy/sr."""
    area = pixel_area_map(wcs, data.shape) * 1e12
    noise = StdDevUncertainty((sigma / area).astype(np.float32))
    return CCDData((data / area).astype(np.float32), unit="MJy/sr", wcs=wcs, uncertainty=noise)


def point_scene(n, shape, scale, width, rng):
    """Point sources of a Gaussian PSF (rms ``width`` px) with white noise of 1 uJy a pixel."""
    wcs = north_up_wcs(CENTER, scale, shape)
    xy = rng.uniform(20, np.array(shape)[::-1] - 20, (n, 2))
    flux = 10 ** rng.uniform(1, 3.5, n)
    image = rng.standard_normal(shape, dtype=np.float32)
    half = int(6 * width) + 1
    g = np.arange(-half, half + 1)
    for (x, y), f in zip(xy, flux, strict=True):
        ix, iy = round(x), round(y)
        ey = np.exp(-0.5 * ((g + iy - y) / width) ** 2)
        ex = np.exp(-0.5 * ((g + ix - x) / width) ** 2)
        s = np.s_[max(iy - half, 0) : iy + half + 1, max(ix - half, 0) : ix + half + 1]
        stamp = f / (2 * np.pi * width**2) * ey[:, None] * ex
        stamp = stamp[max(half - iy, 0) :, max(half - ix, 0) :]
        image[s] += stamp[: image[s].shape[0], : image[s].shape[1]]
    return wcs, image, wcs.pixel_to_world(*xy.T), flux


def forget_peak():
    """Begin a new count of the largest memory, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory():
    """Largest memory of this process in GB since `forget_peak`, images and libraries included."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return next(int(one.split()[1]) for one in lines if one.startswith("VmHWM")) / 1e6


def measured(label, n, size, scale, truth, work, *args, **kwargs):
    """Do some work; print a line of its wall and processor seconds, pulls and largest memory."""
    forget_peak()
    wall, cpu = time.perf_counter(), time.process_time()
    result = work(*args, **kwargs)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    pull = ""
    if truth is not None:
        pull = (result.flux.value - truth) / result.flux_err.value
        pull = f"{1.4826 * np.nanmedian(np.abs(pull)):6.3f}"
    memory = peak_memory()
    print(
        f"{label:10s} {n:7d} {size:6d}^2 {scale:6.2f} {wall:7.2f}s {cpu:7.2f}s {pull:>6s} "
        f"{memory:7.2f}GB",
        flush=True,
    )
    return result


def points(quick):
    kind = {"pixel_scale": FINE, "fov": 3.1 * u.arcsec}
    fwhm = 0.5
    kernel = MatchingKernel.from_psfs(
        gaussian_psf(0.2 * u.arcsec, **kind),
        gaussian_psf(fwhm * u.arcsec, **kind),
        pixel_scale=FINE,
    )
    cases = [(20, 300, 0.11), (500, 1100, 0.11), (500, 2700, 0.06), (5000, 2700, 0.06)]
    if not quick:
        cases += [(20000, 4500, 0.11), (100_000, 10_000, 0.11)]
    for n, size, scale in cases:
        rng = np.random.default_rng(n)
        wcs, image, sky, flux = point_scene(
            n, (size, size), scale * u.arcsec, fwhm / 2.3548 / scale, rng
        )
        image = mosaic(image, wcs, 1.0)
        catalog = QTable({"sky": sky})
        photometer = ForcedPhotometer(kernel, template="psf")
        measured("points", n, size, scale, flux, photometer.measure, image, catalog=catalog)


def galaxy_field(n, side, kernel, rng):
    """
    Galaxies and points at random places: the prior, its segments, and the light through the wide PSF.

    ``side`` is in arcsec; positions keep 4 arcsec from the edge.
    """
    size = round(side / FINE.value)
    x, y = rng.uniform(4, side - 4, (2, n)) / FINE.value
    high, flux = 10 ** rng.uniform(-0.7, 1.3, n), 10 ** rng.uniform(-0.5, 1.5, n)
    shapes = [
        sersic_image((121, 121), x=60, y=60, r_eff=rng.uniform(2, 7), n=rng.choice([1.0, 1.5, 2.5]),
                     axis_ratio=rng.uniform(0.3, 1), theta=rng.uniform(0, np.pi))
        for _ in range(64)
    ]  # fmt: skip
    shapes.append(np.zeros((121, 121)))
    shapes[-1][60, 60] = 1.0
    kinds = np.where(rng.random(n) < 0.2, 64, rng.integers(0, 64, n))
    x, y = np.rint(x), np.rint(y)
    images = []
    for light, psf in ((high, kernel.source), (flux, kernel.target)):
        image = np.zeros((size, size))
        for k in range(n):
            i, j = int(y[k]), int(x[k])
            image[i - 60 : i + 61, j - 60 : j + 61] += light[k] * shapes[kinds[k]]
        images.append(oaconvolve(image, psf, mode="same"))
    wcs = north_up_wcs(CENTER, FINE, (size, size))
    noise = 0.004
    prior = images[0] + rng.normal(0, noise, (size, size))
    return mosaic(prior, wcs, noise), images[1], wcs.pixel_to_world(x, y), flux


def cutout_kernel():
    hst = hst_psf("wfc3.f160w", pixel_scale=FINE)
    target = psf_mosaic(miri_psf("miri.f770w"), FINE, 40 * u.deg)
    return MatchingKernel.from_psfs(hst, target, pixel_scale=FINE, extent=6 * u.arcsec)


def cutouts(quick):
    kernel = cutout_kernel()
    cases = [(610, 110, (0.11, 0.06)), (2000, 160, (0.11,))]
    if not quick:
        cases += [(6500, 240, (0.11,)), (26_000, 480, (0.11,))]
    for n, side, scales in cases:
        rng = np.random.default_rng(n)
        prior, light, sky, flux = galaxy_field(n, side, kernel, rng)
        segmentation, detected = detect_sources(prior, threshold=1.0, n_pixels=8)
        index, _ = match_sky(detected["sky"], sky, radius=0.3 * u.arcsec)
        truth = np.full(len(detected), np.nan)
        truth[index[index >= 0]] = flux[index >= 0]
        templates = measured(
            "prior", len(detected), prior.shape[0], FINE.value, None,
            SourceTemplates.from_images, prior, segmentation, detected, psf=kernel.source,
        )  # fmt: skip
        for scale in scales:
            size = round(side / scale)
            low = north_up_wcs(CENTER, scale * u.arcsec, (size, size))
            step = scale / FINE.value
            at = (np.arange(size) - (size - 1) / 2) * step + (light.shape[0] - 1) / 2
            image = light
            if step != 1:
                image = RectBivariateSpline(*(np.arange(k) for k in light.shape), light)(at, at)
                image *= step**2
            sigma = 0.02 * step
            image = mosaic(image + rng.normal(0, sigma, image.shape), low, sigma)
            photometer = ForcedPhotometer(kernel, background_order=0)
            measured(
                "band", len(detected), size, scale, truth,
                photometer.measure, image, templates=templates,
            )  # fmt: skip


def speed(quick):
    print(
        "points: templates of 3 arcsec; prior: what sources look like, once for all bands; band: one"
    )
    print(
        "band with those (6 arcsec and more). Errors with the measured noise correlation throughout."
    )
    names = f"{'':10s} {'sources':>7s} {'image':>8s} {'scale':>6s} {'wall':>8s} {'cpu':>8s}"
    print(f"{names} {'pull':>6s} {'memory':>9s}")
    points(quick)
    cutouts(quick)


def galaxies(n_side, spacing, rng):
    """Isolated Sersic galaxies and point sources on a grid of the fine image."""
    half = int((n_side + 1) * spacing / 2 / FINE.value)
    shape = (2 * half, 2 * half)
    grid = (np.arange(n_side) - (n_side - 1) / 2) * spacing / FINE.value + half
    x, y = (a.ravel() + rng.uniform(-3, 3, n_side**2) for a in np.meshgrid(grid, grid))
    n = len(x)
    point = rng.random(n) < 0.3
    light = np.zeros((n, 121, 121))
    for k in range(n):
        dx, dy = x[k] - int(x[k]), y[k] - int(y[k])
        if point[k]:
            dx = dy = 0.0
            x[k], y[k] = int(x[k]), int(y[k])
            light[k, 60, 60] = 1.0
            continue
        light[k] = sersic_image(
            (121, 121), x=60 + dx, y=60 + dy, r_eff=rng.uniform(2, 6), n=rng.choice([1.0, 1.5, 2.5]),
            axis_ratio=rng.uniform(0.3, 1), theta=rng.uniform(0, np.pi),
        )  # fmt: skip
    return shape, x, y, light, point


def paint(shape, x, y, light, flux):
    image = np.zeros(shape)
    for k in range(len(x)):
        iy, ix = int(y[k]) - 60, int(x[k]) - 60
        y0, x0 = max(iy, 0), max(ix, 0)
        part = light[k][y0 - iy :, x0 - ix :]
        target = image[y0 : iy + 121, x0 : ix + 121]
        target += flux[k] * part[: target.shape[0], : target.shape[1]]
    return image


def bands():
    rng = np.random.default_rng(1)
    shape, x, y, light, point = galaxies(12, 4.5, rng)
    wcs = north_up_wcs(CENTER, FINE, shape)
    sky = wcs.pixel_to_world(x, y)
    high = 10 ** rng.uniform(-0.3, 1.5, len(x))
    flux = high * 10 ** rng.uniform(-0.2, 0.6, len(x))
    noise = 0.004  # uJy per pixel of 0.06 arcsec: 5 sigma at 27.0 in 0.2 arcsec radius
    hst = hst_psf("wfc3.f160w", pixel_scale=FINE)
    print(f"{len(x)} isolated sources, 30 % of them points, PSFs of HST and MIRI (drizzled, 0.06)")
    print(
        f"{'band':12s} {'kind':9s} {'H S/N':>9s} {'n':>4s} {'median':>8s} {'scatter':>8s} {'time':>6s}"
    )
    for band in ("miri.f770w", "miri.f1500w", "miri.f2100w"):
        target = psf_mosaic(miri_psf(band), FINE, 40 * u.deg)
        kernel = MatchingKernel.from_psfs(hst, target, pixel_scale=FINE, extent=9 * u.arcsec)
        fine = fftconvolve(paint(shape, x, y, light, high), kernel.source, "same")
        fine = mosaic(fine + rng.normal(0, noise, shape), wcs, noise)
        low = fftconvolve(paint(shape, x, y, light, flux), kernel.target, "same")
        low = mosaic(low + rng.normal(0, 1e-3, shape), wcs, 1e-3)
        segmentation, detected = detect_sources(fine)
        index, _ = match_sky(detected["sky"], sky, radius=0.4 * u.arcsec)
        t = time.perf_counter()
        result = ForcedPhotometer(kernel).measure(low, fine, segmentation, detected)
        t = time.perf_counter() - t
        ratio = result.flux.value[index] / flux - 1
        snr = result.template_snr[index]
        for name, kind in (("points", point), ("galaxies", ~point)):
            for lo, hi in ((5, 20), (20, 60), (60, 1e9)):
                use = kind & (index >= 0) & (snr >= lo) & (snr < hi)
                if use.sum() > 3:
                    middle = np.median(ratio[use])
                    scatter = 1.4826 * np.median(np.abs(ratio[use] - middle))
                    print(
                        f"{band:12s} {name:9s} {lo:4.0f}-{min(hi, 999):4.0f} {use.sum():4d} "
                        f"{100 * middle:+7.2f}% {100 * scatter:7.2f}% {t:5.2f}s"
                    )
    print("\nphoton and read noise, optimal extraction, 5 sigma AB (exposures of CEERS)")
    for band, seconds, n in (
        ("miri.f770w", 1665, 3),
        ("miri.f1800w", 1665, 6),
        ("miri.f2100w", 4662, 60),
    ):
        model = ErrorModel.from_exposure(band, seconds * u.s, n_integrations=n, excess="ideal")
        print(f"{band:12s} {model.limiting_magnitude(band).value:.2f}")


if __name__ == "__main__":
    if "--bands" in sys.argv:
        bands()
    else:
        speed("--quick" in sys.argv)
