"""
Times forced photometry and tells how near to the truth it comes.

    python benchmarks/photometry.py            speed, up to 100k sources
    python benchmarks/photometry.py --quick    without the 100k
    python benchmarks/photometry.py --bands    accuracy with MIRI and HST PSFs
"""

import resource
import sys
import time

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable
from scipy.signal import fftconvolve

from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import ErrorModel, ForcedPhotometer, detect_sources
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


def speed(quick):
    kind = {"pixel_scale": FINE, "fov": 3.1 * u.arcsec}
    fwhm = 0.5
    kernel = MatchingKernel.from_psfs(
        gaussian_psf(0.2 * u.arcsec, **kind),
        gaussian_psf(fwhm * u.arcsec, **kind),
        pixel_scale=FINE,
    )
    print("point-source templates of 3 arcsec, errors with measured noise correlation")
    print(
        f"{'sources':>8s} {'image':>12s} {'scale':>6s} {'time':>7s} {'pull':>6s} {'peak memory':>11s}"
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
        t = time.perf_counter()
        result = ForcedPhotometer(kernel, template="psf").measure(image, catalog=catalog)
        t = time.perf_counter() - t
        pull = np.nanstd((result.flux.value - flux) / result.flux_err.value)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(f"{n:8d} {size:6d}^2 {'':3s} {scale:6.2f} {t:6.2f}s {pull:6.3f} {memory:9.2f}GB")


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
        model = ErrorModel.from_exposure(band, seconds * u.s, n_integrations=n)
        print(f"{band:12s} {model.limiting_magnitude(band).value:.2f}")


if __name__ == "__main__":
    if "--bands" in sys.argv:
        bands()
    else:
        speed("--quick" in sys.argv)
