"""
Tells how near to the truth fluxes come with templates of a noisy high-resolution image.

    python benchmarks/templates.py             tables for one band (F770W)
    python benchmarks/templates.py --seeds 3   with three times as many sources

Isolated Sersic galaxies (index 0.5 to 4, half-light radius 0.1 to 0.6 arcsec) and points, detected on a noisy
image like F160W (0.06 arcsec) and measured on a mosaic of 0.11 arcsec with little noise: what is off is the
template's fault. Both images are made on a grid of 0.02 arcsec and sampled from there by splines, not by the
package's own templates.
"""

import argparse
import time

import astropy.units as u
import numpy as np
import scipy.fft
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from scipy.ndimage import map_coordinates

from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import ForcedPhotometer, detect_sources
from miricigale.profiles import sersic_image, sersic_radius
from miricigale.psf import MatchingKernel, hst_psf, miri_psf, psf_mosaic
from miricigale.utils.tables import match_sky

CENTER = SkyCoord(53.1, -27.8, unit="deg")
FINE, COARSE, STEP = 0.06, 0.11, 0.02
SIZE = 600  # pixels of STEP: 12 arcsec


def mosaic(data, wcs, sigma):
    """Flux per pixel (uJy) as CCDData in MJy/sr."""
    area = pixel_area_map(wcs, data.shape) * 1e12
    noise = StdDevUncertainty((sigma / area).astype(np.float32))
    return CCDData((data / area).astype(np.float32), unit="MJy/sr", wcs=wcs, uncertainty=noise)


def fine_psf(array):
    """Transform of a PSF of FINE pixels, sampled at STEP, its center on the first pixel."""
    half = SIZE // 2
    at = (np.arange(SIZE) - half) * STEP / FINE + array.shape[0] // 2
    yy, xx = np.meshgrid(at, at, indexing="ij")
    stamp = map_coordinates(array, [yy, xx], order=5, mode="constant") * (STEP / FINE) ** 2
    return scipy.fft.rfft2(scipy.fft.ifftshift(stamp))


def scene(n_side, spacing, rng, share):
    """Sources on a jittered grid: offsets (arcsec), shapes (points have a radius of 0)."""
    grid = (np.arange(n_side) - (n_side - 1) / 2) * spacing
    dx, dy = (a.ravel() + rng.uniform(-0.2, 0.2, n_side**2) for a in np.meshgrid(grid, grid))
    n = len(dx)
    point = rng.random(n) < share
    return {
        "dx": dx, "dy": dy, "point": point,
        "n": np.where(point, 0.0, rng.uniform(0.5, 4.0, n)),
        "radius": np.where(point, 0.0, 10 ** rng.uniform(-1, np.log10(0.6), n)),
        "q": rng.uniform(0.25, 1, n), "theta": rng.uniform(0, np.pi, n),
    }  # fmt: skip


def paint(catalog, flux, psf, wcs, shape, xy, scale):
    image = np.zeros(shape)
    half = SIZE // 2
    reach = int(5.4 / scale)
    for k, total in enumerate(flux):
        stamp = np.zeros((SIZE, SIZE))
        if catalog["point"][k]:
            stamp[half, half] = 1.0
        else:
            stamp = sersic_image(
                (SIZE, SIZE), x=half, y=half, r_eff=catalog["radius"][k] / STEP,
                n=catalog["n"][k], axis_ratio=catalog["q"][k], theta=catalog["theta"][k],
            )  # fmt: skip
        stamp = scipy.fft.irfft2(scipy.fft.rfft2(stamp) * psf, s=(SIZE, SIZE))
        x, y = xy[k]
        x0, y0 = round(float(x)) - reach, round(float(y)) - reach
        i, j = np.arange(2 * reach + 1) + y0, np.arange(2 * reach + 1) + x0
        i, j = i[(i >= 0) & (i < shape[0])], j[(j >= 0) & (j < shape[1])]
        at = np.meshgrid(
            (i - y) * scale / STEP + half, (j - x) * scale / STEP + half, indexing="ij"
        )
        value = map_coordinates(stamp, at, order=3, mode="constant") * (scale / STEP) ** 2
        image[i[0] : i[-1] + 1, j[0] : j[-1] + 1] += total * value
    return image


def make(seed, band="miri.f770w", n_side=12, spacing=6.5, share=0.25):
    """A pair of images with their truth."""
    rng = np.random.default_rng(seed)
    hst = hst_psf("wfc3.f160w", pixel_scale=FINE * u.arcsec)
    target = psf_mosaic(miri_psf(band), FINE * u.arcsec, 40 * u.deg)
    kernel = MatchingKernel.from_psfs(hst, target, pixel_scale=FINE * u.arcsec, extent=9 * u.arcsec)
    catalog = scene(n_side, spacing, rng, share)
    side = (n_side + 1) * spacing
    sky = CENTER.spherical_offsets_by(catalog["dx"] * u.arcsec, catalog["dy"] * u.arcsec)
    noise = 0.004
    # flux for a wanted signal-to-noise (5 to 80) in the circle that holds 70 % of the light
    wanted = 10 ** rng.uniform(np.log10(5), np.log10(80), len(sky))
    outer = catalog["radius"] * np.sqrt(catalog["q"])
    outer[~catalog["point"]] *= sersic_radius(0.7, catalog["n"][~catalog["point"]])
    area = np.pi * (np.hypot(outer, 0.17) / FINE) ** 2
    high = wanted * noise * np.sqrt(area) / 0.7
    flux = high * 10 ** rng.uniform(-0.2, 0.6, len(sky))
    images = []
    for total, psf, scale, sigma in (
        (high, kernel.source, FINE, noise), (flux, kernel.target, COARSE, 2e-3),
    ):  # fmt: skip
        shape = (int(side / scale),) * 2
        wcs = north_up_wcs(CENTER, scale * u.arcsec, shape)
        xy = np.stack(wcs.world_to_pixel(sky), axis=-1)
        image = paint(catalog, total, fine_psf(psf), wcs, shape, xy, scale)
        images.append(mosaic(image + rng.normal(0, sigma, shape), wcs, sigma))
    segmentation, detected = detect_sources(images[0])
    catalog |= {"sky": sky, "flux": flux, "high": high}
    return catalog, kernel, *images, segmentation, detected


def measure(fields, **options):
    """Ratio to the truth and what it is recognized by, for the sources of all fields."""
    rows, seconds = [], 0.0
    for catalog, kernel, high, low, segmentation, detected in fields:
        index, _ = match_sky(detected["sky"], catalog["sky"], radius=0.3 * u.arcsec)
        start = time.process_time()
        result = ForcedPhotometer(kernel, **options).measure(low, high, segmentation, detected)
        seconds += time.process_time() - start
        good = index >= 0
        index = index[good]
        kind = getattr(result, "template", np.full(len(result), "?"))[index]
        ratio = result.flux.value[index] / catalog["flux"][good] - 1
        rows.append(
            [ratio, result.template_snr[index], catalog["n"][good], kind, catalog["radius"][good],
             catalog["q"][good],
             (result.flux.value[index] - catalog["flux"][good]) / result.flux_err.value[index]]
        )  # fmt: skip
    return [np.concatenate(column) for column in zip(*rows, strict=True)], seconds


def table(columns):
    ratio, snr, index, kind = columns[:4]
    print(f"{'':22s} {'n':>4s} {'median':>8s} {'scatter':>8s} {'p16':>7s} {'p84':>7s}"
          f" {'pulls: median, MAD, std':>20s}  templates")  # fmt: skip
    galaxy = index > 0
    radius, pull = columns[4], columns[6]
    cases = [(f"galaxies S/N {a}-{b}", galaxy & (snr >= a) & (snr < b))
             for a, b in ((5, 10), (10, 20), (20, 40), (40, 80), (80, 999))]  # fmt: skip
    cases += [(f"galaxies n {a}-{b}", galaxy & (snr >= 5) & (index >= a) & (index < b))
              for a, b in ((0.5, 1), (1, 2), (2, 3), (3, 4))]  # fmt: skip
    cases += [(f"galaxies R_e {a}-{b}", galaxy & (snr >= 5) & (radius >= a) & (radius < b))
              for a, b in ((0.1, 0.2), (0.2, 0.35), (0.35, 0.6))]  # fmt: skip
    cases += [(f"points S/N {a}-{b}", ~galaxy & (snr >= a) & (snr < b))
              for a, b in ((5, 10), (10, 20), (20, 40), (40, 999))]  # fmt: skip
    for name, use in cases:
        r = ratio[use & np.isfinite(ratio)]
        if len(r) < 4:
            continue
        middle = np.median(r)
        scatter = 1.4826 * np.median(np.abs(r - middle))
        low, high = np.percentile(r, [16, 84])
        p = pull[use & np.isfinite(ratio)]
        width = 1.4826 * np.median(np.abs(p - np.median(p)))
        pulls = f"{np.median(p):+6.2f} {width:6.2f} {p.std():6.2f}"
        kinds = ", ".join(
            f"{k} {c}" for k, c in zip(*np.unique(kind[use], return_counts=True), strict=True)
        )
        print(f"{name:22s} {len(r):4d} {100 * middle:+7.1f}% {100 * scatter:7.1f}% "
              f"{100 * low:+6.1f}% {100 * high:+6.1f}% {pulls}  {kinds}")  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=2, help="number of fields")
    parser.add_argument("--first", type=int, default=1, help="seed of the first field")
    parser.add_argument("--band", default="miri.f770w")
    args = parser.parse_args()
    fields = [make(seed, args.band) for seed in range(args.first, args.first + args.seeds)]
    columns, seconds = measure(fields)
    n = sum(len(field[-1]) for field in fields)
    print(f"{args.band}: {n} detections, measure() took {seconds:.1f} s of processor time")
    table(columns)


if __name__ == "__main__":
    main()
