"""Time the PSFs and kernels and print how they compare with the telescope in flight.

python benchmarks/psf.py
python benchmarks/psf.py stars [SEED ...]    a PSF that is wrong by a known amount, corrected by stars
python benchmarks/psf.py field FOLDER        real images: the folder uds of the test data
"""

import dataclasses
import sys
import time
import warnings

import astropy.units as u
import numpy as np
import scipy.ndimage
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale.depth import sky_background
from miricigale.instrument import north_up_wcs
from miricigale.photometry import (
    ErrorSettings,
    ForcedPhotometer,
    MosaicFile,
    SourceTemplates,
    detect_sources,
    read_prior,
)
from miricigale.photometry.commands.kernel_files import matching_kernel
from miricigale.photometry.commands.page import empty_positions
from miricigale.psf import (
    MatchingKernel,
    encircled_energy,
    filter_psf,
    fwhm,
    hst_psf,
    jwst_pupil,
    miri_psf,
    miri_psf_grid,
    psf_mosaic,
    radius_of_encircled_energy,
    rotate_psf,
)
from miricigale.psf._core import interpolate
from miricigale.psf.miri import _miri_data
from miricigale.psf.telescope import Telescope

# arcsec; jwst-docs, MIRI Point Spread Functions, table 1 (commissioning, PID 1028)
IN_FLIGHT = dict(
    zip(
        (560, 770, 1000, 1130, 1280, 1500, 1800, 2100, 2550),
        (0.207, 0.269, 0.328, 0.375, 0.420, 0.488, 0.591, 0.674, 0.803),
        strict=True,
    )
)
SCALE = 0.06 * u.arcsec


def timed(function, *args, repeat=3, clock=time.perf_counter, **kwargs):
    """Result and shortest time in s."""
    best = float("inf")
    for _ in range(repeat):
        start = clock()
        result = function(*args, **kwargs)
        best = min(best, clock() - start)
    return result, best


def make(name):
    """One PSF without the cache."""
    _miri_data.cache_clear()
    Telescope.image.cache_clear()
    return miri_psf(name)


def main():
    """Print the tables."""
    _, first = timed(jwst_pupil.__wrapped__, 384)
    print(f"pupil (once a process) {first:.2f} s")
    print("filter    s CPU   FWHM  Gauss  flight ratio   r80  EE 0.5  1.0   1.5   2.5   5.0  grid")
    psfs = {}
    for number, flight in IN_FLIGHT.items():
        psf, seconds = timed(make, f"miri.f{number}w", clock=time.process_time)
        psfs[number] = psf
        gauss = fwhm(psf, method="gaussian").value
        energies = encircled_energy(psf, [0.5, 1.0, 1.5, 2.5, 5.0] * u.arcsec)
        print(
            f"F{number}W".ljust(8),
            f"{seconds:6.2f} {fwhm(psf).value:6.3f} {gauss:6.3f} {flight:6.3f}",
            f"{gauss / flight:6.3f} {radius_of_encircled_energy(psf, 0.8).value:5.2f} ",
            " ".join(f"{e:.3f}" for e in (*energies, psf.enclosed)),
        )
    _miri_data.cache_clear()
    Telescope.image.cache_clear()
    grid, seconds = timed(miri_psf_grid, "miri.f770w", repeat=1, clock=time.process_time)
    print(f"miri_psf_grid, {len(grid.data)} places {seconds:.2f} s CPU")
    hst, seconds = timed(hst_psf)
    print(f"hst_psf (cached optics) {seconds:.2f} s, FWHM {hst.fwhm:.4f}")
    print(f"rotate_psf {timed(rotate_psf, psfs[770], 33 * u.deg)[1]:.2f} s")
    print(f"psf_mosaic {timed(psf_mosaic, psfs[770], SCALE, 33 * u.deg)[1]:.2f} s")
    print(
        "kernel from F160W at 0.06 arcsec: largest error of the encircled energy in %, noise gain"
    )
    print("filter     mu 0.03         mu 1e-3         auto                     s")
    for number, psf in psfs.items():
        cells = []
        for mu in ("yang2021", 1e-3, "auto"):
            kernel, seconds = timed(
                MatchingKernel.from_psfs,
                hst,
                psf,
                pixel_scale=SCALE,
                lo_angle=0 * u.deg,
                regularization=mu,
                repeat=1,
            )
            text = f"{100 * kernel.meta['max_error']:5.2f} {kernel.noise_gain:7.4f}"
            cells.append(text + (f"  mu {kernel.regularization:.1e}" if mu == "auto" else ""))
        print(f"F{number}W".ljust(8), "   ".join(cells), f"  {seconds:.2f}")


def wrong(psf, scale, *, core=0.05, wings=0.2, edge=1.0):
    """A PSF on pixels whose core is wider within ``edge`` arcsec and whose wings are brighter beyond."""
    half = len(psf) // 2
    y, x = np.indices(psf.shape) - half
    wide = interpolate(psf, x / (1 + core) + half, y / (1 + core) + half) / (1 + core) ** 2
    # from one to the other over a fifth of the edge
    part = np.clip((np.hypot(x, y) * scale / edge - 0.9) / 0.2, 0, 1)
    changed = wide * (1 - part) + psf * part * (1 + wings)
    return changed / (changed.sum() + (1 - psf.sum()) * (1 + wings))


def simulated(seed, n_stars=12, n_galaxies=60, shape=(900, 900)):
    """Image in F770W with another PSF than its kernel's, prior in F444W, catalog with true fluxes, kernels."""
    rng, form = np.random.default_rng(seed), {"pixel_scale": SCALE, "pa": 35 * u.deg}
    sharp, wide = (filter_psf(name, **form) for name in ("F444W", "F770W"))
    kernel = MatchingKernel.from_psfs(sharp, wide, pixel_scale=SCALE)
    true = kernel.with_psfs(kernel.source, wrong(kernel.target, SCALE.value))
    center = SkyCoord(53.1, -27.8, unit="deg")
    wcs = north_up_wcs(center, SCALE, shape)
    n = n_stars + n_galaxies
    grid = (
        np.stack(np.meshgrid(np.arange(9), np.arange(9))).reshape(2, -1).T[rng.permutation(81)[:n]]
    )
    xy = (grid + 0.5) * np.array(shape) / 9 + rng.uniform(-15, 15, (n, 2))
    star = np.arange(n) < n_stars
    catalog = QTable({"id": np.arange(1, n + 1), "sky": wcs.pixel_to_world(*xy.T)})
    catalog["profile"] = np.where(star, "point", "sersic")
    catalog["half_light_radius"] = np.where(star, 0, rng.uniform(0.1, 0.5, n)) * u.arcsec
    catalog["sersic_index"], catalog["axis_ratio"] = rng.uniform(0.8, 3, n), rng.uniform(0.4, 1, n)
    catalog["position_angle"] = rng.uniform(0, 180, n) * u.deg
    catalog["flux"] = 10 ** np.where(star, rng.uniform(0.8, 2, n), rng.uniform(0, 1.5, n)) * u.uJy
    templates = SourceTemplates.from_catalog(catalog, template="sersic", wcs=wcs)
    point = np.zeros(kernel.source.shape)
    point[len(point) // 2, len(point) // 2] = 1.0
    same = dataclasses.replace(kernel, array=point, target=kernel.source)
    images = []
    some = StdDevUncertainty(np.ones(shape))
    none = CCDData(np.ones(shape), unit="MJy/sr", wcs=wcs, uncertainty=some)
    for one, factor, sigma in (
        (same, np.where(star, 3, 0.5), 0.01),
        (true, np.ones(n), 0.05),
    ):
        light = ForcedPhotometer(one).render(none, templates, factor * catalog["flux"]).value
        noise = StdDevUncertainty(np.full(shape, sigma))
        images.append(
            CCDData(light + rng.normal(0, sigma, shape), unit="MJy/sr", wcs=wcs, uncertainty=noise)
        )
    for image, name in zip(images, ("nircam.f444w", "miri.f770w"), strict=True):
        image.meta["filter"] = name
    return images[1], images[0], catalog, star, kernel, true


def stars(seeds):
    """Print fluxes with the wrong, the corrected and the true PSF."""
    print("seed psf        stars: flux - 1   galaxies: flux - 1   stated   chi2 of stars")
    for seed in seeds:
        image, prior, catalog, star, kernel, true = simulated(seed)
        segments, _ = detect_sources(prior)
        for name, one, asked in (
            ("model", kernel, False), ("corrected", kernel, True), ("true", true, False),
        ):  # fmt: skip
            result = ForcedPhotometer(one, psf_stars=asked).measure(
                image, prior, segments, catalog["id", "sky"]
            )
            ratio = (result.flux / catalog["flux"]).value - 1
            bright = result.snr > 20
            parts = [ratio[star], ratio[~star & bright]]
            spread = [(np.median(p), 1.2533 * np.std(p) / np.sqrt(len(p))) for p in parts]
            texts = [f"{100 * a:+6.2f} +- {100 * b:.2f} %" for a, b in spread]
            error = result.meta.get("image_psf_err", 0.0)
            kind = result.meta.get("image_psf", name)
            print(
                f"{seed:4d} {kind:10s} {texts[0]:>18s} {texts[1]:>20s} {100 * error:7.2f} %",
                f"  {np.median(result.chi2[star]):.2f}",
            )


def loose_chi2(result, row, radius=0.8, scatter=0.02, sky=np.inf):
    """
    Chi-square below the light within a radius (arcsec) if pixels deviate by a part of the light too.

    With a ``sky`` (MJy/sr), that the image's weights state the noise of alone, the source's photons count besides.
    """
    residual, model = result.residual_image, result.model_image.data
    if result.background is not None:
        model = model - result.background.to_value(residual.unit)
    reach = radius / result.meta["pixel_scale"]
    y, x = np.indices(model.shape)
    near = (np.hypot(x - result.x[row], y - result.y[row]) < reach) & ~residual.mask & (model > 0)
    noise = residual.uncertainty.array * np.sqrt(1 + np.maximum(model, 0) / sky)
    noise = np.hypot(noise, scatter * model)[near]
    return np.average((residual.data[near] / noise) ** 2, weights=model[near])


def light_ratio(result, row, radius=0.5):
    """Light of the image over that of the model within a radius (arcsec)."""
    residual, model = result.residual_image, result.model_image.data
    y, x = np.indices(model.shape)
    reach = radius / result.meta["pixel_scale"]
    near = (np.hypot(x - result.x[row], y - result.y[row]) < reach) & ~residual.mask
    background = 0.0 if result.background is None else result.background.to_value(residual.unit)
    return float(1 + residual.data[near].sum() / (model - background)[near].sum())


def residual_powers(result, rows, cutoff=5.0, half=10, n_blank=300):
    """
    Power of the residual over that of empty sky, at spatial frequencies that the telescope passes, and above.

    The mirror (6.6 m) passes nothing above 5 cycles per arcsec at the blue end of F770W (6.6 um): what is there
    comes from the detector and the resampling of the mosaic, not from light. Of squares of 2 ``half`` + 1 pixels
    under a Hann window.

    Returns
    -------
    ratio : `~numpy.ndarray`, shape (n, 2)
        Passed, and above the ``cutoff``; NaN at the edge.
    deviation : float
        Standard deviation of the second for single squares of empty sky.
    """
    residual = result.residual_image
    white = np.where(residual.mask, 0.0, residual.data / residual.uncertainty.array)
    model = np.where(residual.mask, np.inf, result.model_image.data / residual.uncertainty.array)
    size = 2 * half + 1
    window = np.hanning(size + 2)[1:-1]
    window = window[:, None] * window
    frequency = np.fft.fftfreq(size, result.meta["pixel_scale"])
    frequency = np.hypot(frequency[:, None], frequency)
    bands = (frequency > 0.3) & (frequency < cutoff), frequency > cutoff

    def powers(y, x):
        square = white[y - half : y + half + 1, x - half : x + half + 1]
        if square.shape != (size, size):
            return np.nan, np.nan
        power = np.abs(np.fft.fft2(square * window)) ** 2
        return power[bands[0]].mean(), power[bands[1]].mean()

    busy = scipy.ndimage.maximum_filter(np.abs(model), size, mode="constant", cval=np.inf)
    empty = np.argwhere(busy < 1)
    rng = np.random.default_rng(1)
    blank = np.array([powers(y, x) for y, x in empty[rng.choice(len(empty), n_blank)]])
    sources = [powers(round(result.y[k]), round(result.x[k])) for k in rows]
    mean = blank.mean(axis=0)
    return np.array(sources) / mean, blank[:, 1].std() / mean[1]


def field(folder):
    """Print how bright sources of real images are fitted, without and with the stars."""
    start, psfs = f"{folder}/uds-test-", f"{folder}/psf/uds-test-"
    files = [
        MosaicFile(f"{start}{name}_sci.fits.gz", weight=f"{start}{name}_wht.fits.gz", filter=name,
                   psf=f"{psfs}{name}_psf.fits.gz[0,mean]")
        for name in ("f770w", "f444w")
    ]  # fmt: skip
    kernel = matching_kernel(*files)
    image, prior = (one.read() for one in files)
    segments, catalog = read_prior(prior, segmentation=f"{start}LW_seg.fits.gz")
    # signal-to-noise by the noise alone, of templates that cannot change
    exact = ForcedPhotometer(
        kernel, background_order=0, errors=ErrorSettings(size_scatter=None)
    ).measure(image, prior, segments, catalog)
    snr = (exact.flux / exact.flux_err_noise).value
    bright = np.flatnonzero(np.nan_to_num(snr) > 20)
    for options in ({}, {"psf_stars": None}, {"psf_stars": True}, {"components": 2}):
        result = ForcedPhotometer(kernel, background_order=0, **options).measure(
            image, prior, segments, catalog
        )
        chi2 = result.chi2[bright]
        used = kernel if result.psf_stars is None else result.psf_stars.kernel
        empty = empty_positions(result, 1)
        blank = ForcedPhotometer(used, template="psf").measure(result.residual_image, catalog=empty)
        pulls, depth = np.std(blank.snr), 5 * np.median(blank.flux_err.value) * 1e3
        print(
            f"{options}: {len(bright)} sources above 20 sigma, {np.sum(chi2 < 2)} with chi2 below 2,"
        )
        sky = sky_background("F770W", "medium").value
        for what, form in (
            ("within 0.8 arcsec", {"scatter": 0}),
            (f"with the sources' photons on a sky of {sky:.1f} MJy/sr", {"scatter": 0, "sky": sky}),
            ("with 2 % of the light in each pixel as an error", {}),
            ("with both", {"sky": sky}),
        ):
            loose = np.array([loose_chi2(result, k, **form) for k in bright])
            print(f"  {np.sum(loose < 2)} {what}: {np.round(np.sort(loose), 2)}")
        print(
            f"  scatter of pixels in chi2: {100 * result.meta['pixel_scatter']:.1f} % of the light"
        )
        print(f"  chi2 {np.round(np.sort(chi2), 2)}; pulls {pulls:.3f}, 5 sigma {depth:.1f} nJy")
        ratio = [round(light_ratio(result, k), 3) for k in bright[np.argsort(-snr[bright])]]
        print(f"  light over the model's within 0.5 arcsec, brightest first: {ratio}")
        ratio, deviation = residual_powers(result, bright[np.argsort(-snr[bright])])
        print(f"  power of residuals over that of the sky, passed by the telescope: {ratio[:, 0]}")
        print(f"  and above (one square of sky +- {deviation:.2f}): {ratio[:, 1]}")
        if result.psf_stars is not None:
            print(f"  {result.psf_stars.meta}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    np.set_printoptions(precision=1, suppress=True)
    if sys.argv[1:2] == ["stars"]:
        stars([int(one) for one in sys.argv[2:]] or [1, 2, 3])
    elif sys.argv[1:2] == ["field"]:
        field(sys.argv[2])
    else:
        main()
