"""
Holds the photometry of Yang et al. 2021 against the package's own, on one simulated scene.

    python benchmarks/yang2021.py                         F770W and F1500W
    python benchmarks/yang2021.py --bands miri.f2100w
    python benchmarks/yang2021.py --seeds 3               with three times as many noise realisations
    python benchmarks/yang2021.py --dilation              bare segments as found and grown by rule

The sources of the bundled catalog (their positions and Sersic shapes), exposed as by CEERS: each dither
is rendered on the distorted detector and given white noise of the sky, then drizzled onto 0.11 and onto
0.06 arcsec. The prior is F160W of 27.6 AB (5 sigma), on which sources are detected. Fluxes are those of
F160W times a random color. Detector effects and the subtraction of a background are left out: what is off
is the photometry's. f_scaling is measured on a grid of bright point sources that are drizzled likewise.
"""

import argparse
import time

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale.depth import scaled_limit
from miricigale.instrument import ceers_exposures, mosaic_wcs, pixel_area_map
from miricigale.photometry import (
    ErrorSettings,
    ForcedPhotometer,
    Yang2021Photometer,
    detect_sources,
    flux_scaling,
)
from miricigale.psf import MatchingKernel, encircled_energy, hst_psf, miri_psf, psf_mosaic
from miricigale.reduction import MosaicSettings, Reducer
from miricigale.scene import Scene, highres_image, read_catalog
from miricigale.utils.tables import match_sky

CENTER = SkyCoord(53.13440, -27.83444, unit="deg")
PRIOR = "wfc3.f160w"
WHITE = ErrorSettings(correlated_noise=False)
FINE, COARSE = 0.06 * u.arcsec, 0.11 * u.arcsec


def sources(band, rng):
    """The catalog with a flux in the band, within 1.5 arcmin of the pointing."""
    catalog = read_catalog("catalog.goodss")
    catalog = catalog[catalog["sky"].separation(CENTER) < 1.5 * u.arcmin]
    catalog = catalog[np.isfinite(catalog[PRIOR].value) & (catalog[PRIOR].value > 0)]
    catalog[band] = catalog[PRIOR] * 10 ** rng.normal(0.1, 0.3, len(catalog))
    return catalog


def bright_points(band, exposure):
    """Point sources of 100 uJy on a grid of 15 arcsec."""
    steps = np.arange(-50, 50.1, 15.0)
    dx, dy = (a.ravel() for a in np.meshgrid(steps, steps))
    n = len(dx)
    catalog = QTable({"id": np.arange(n)})
    catalog["sky"] = exposure.pointing.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec)
    catalog["redshift"] = np.zeros(n)
    catalog["profile"] = np.full(n, "point")
    catalog["half_light_radius"] = np.zeros(n) * u.arcsec
    catalog["sersic_index"] = catalog["axis_ratio"] = np.ones(n)
    catalog["position_angle"] = np.zeros(n) * u.deg
    catalog[band] = np.full(n, 100.0) * u.uJy
    return catalog


def expose(catalog, band, exposures, sigma, rng):
    """Dithers with white noise (uJy in a pixel), drizzled onto both grids."""
    images = []
    for exposure in exposures:
        image = Scene(catalog, filter=band, wcs=exposure.wcs, psf=miri_psf(band)).render()
        area = pixel_area_map(exposure.wcs, image.shape) * 1e12
        noise = sigma / area
        data = image.data + rng.normal(0, 1, image.shape) * noise
        images.append(CCDData(
            data, unit="MJy/sr", wcs=exposure.wcs, uncertainty=StdDevUncertainty(noise),
            meta={"filter": band},
        ))  # fmt: skip
    reducer = Reducer(mosaics=MosaicSettings(outlier_threshold=None))
    return [
        reducer.drizzle(images, mosaic_wcs(exposures, scale))[0].image for scale in (COARSE, FINE)
    ]


def table(rows):
    """Offset, scatter and pulls by signal-to-noise."""
    cases = [(3, 5), (5, 10), (10, 30), (30, 100), (100, 1e9)]
    print(
        f"{'':30s} {'S/N':>8s} {'n':>5s} {'median':>8s} {'scatter':>8s} {'pull':>6s} {'width':>6s}"
    )
    for name, (flux, error, true, expected) in rows.items():
        for low, high in cases:
            # by the signal-to-noise that an isolated point of this flux has: the same for all
            use = np.isfinite(flux) & (true > low * expected) & (true < high * expected)
            if use.sum() < 5:
                continue
            ratio = flux[use] / true[use] - 1
            pull = (flux[use] - true[use]) / error[use]
            middle = np.median(ratio)
            scatter = 1.4826 * np.median(np.abs(ratio - middle))
            width = 1.4826 * np.median(np.abs(pull - np.median(pull)))
            label = f"{low:.0f}-{high:.0f}" if high < 1e6 else f"> {low:.0f}"
            print(f"{name:30s} {label:>8s} {use.sum():5d} {100 * middle:+7.1f}% {100 * scatter:7.1f}% "
                  f"{np.median(pull):+6.2f} {width:6.2f}")  # fmt: skip


def compare(band, seeds):
    """One band: both methods on the same images."""
    exposures = ceers_exposures(CENTER, 0 * u.deg, filters=[band])
    total = sum(e.exposure_time for e in exposures)
    angles = u.Quantity([e.pa_aper for e in exposures])
    target = {scale: psf_mosaic(miri_psf(band), scale, angles) for scale in (COARSE, FINE)}
    hst = hst_psf(PRIOR, pixel_scale=FINE)
    # white noise that gives a point source its 1-sigma limit in the optimal extraction
    limit = scaled_limit(band, total, n_sigma=1.0).to_value(u.uJy)
    stamp = MatchingKernel.from_psfs(hst, target[COARSE], pixel_scale=COARSE).target
    sigma = limit * np.sqrt(np.sum(stamp**2)) * np.sqrt(len(exposures))
    rng = np.random.default_rng(2021)
    points = bright_points(band, exposures[0])
    _, image = expose(points, band, exposures, 1e-3, rng)
    x, y = (np.rint(v).astype(int) for v in image.wcs.world_to_pixel(points["sky"]))
    ny, nx = image.shape
    rim = 60
    inside = (x > rim) & (x < nx - rim) & (y > rim) & (y < ny - rim)
    mask = np.asarray(image.mask)
    inside[inside] = [not mask[b - rim : b + rim, a - rim : a + rim].any()
                      for a, b in zip(x[inside], y[inside], strict=True)]  # fmt: skip
    found = points[inside]
    scaling, error = flux_scaling(image, found["sky"], found[band], target[FINE])
    paper = Yang2021Photometer(hst, target[FINE], scaling=scaling)
    ours = ForcedPhotometer(MatchingKernel.from_psfs(hst, target[COARSE], pixel_scale=FINE))
    print(f"\n{band}: {len(exposures)} dithers, {total:.0f}; f_scaling {scaling:.4f} +- {error:.4f} "
          f"({len(found)} points), f_aper {paper.aperture:.3f}, light within 3 x 3 arcsec "
          f"{float(encircled_energy(target[FINE], 1.5 * u.arcsec)):.3f} (circle)")  # fmt: skip
    rows, spent = {}, {}
    for seed in range(1, seeds + 1):
        rng = np.random.default_rng(seed)
        catalog = sources(band, rng)
        coarse, fine = expose(catalog, band, exposures, sigma, rng)
        highres = highres_image(catalog, filter=PRIOR, wcs=fine.wcs, psf=hst, seed=seed)
        runs = {
            "Yang et al. 2021, 0.06": (paper, fine, None),
            "the same, segments dilated": (paper, fine, "area"),
            "ours, 0.11": (ours, coarse, None),
            "ours, bare segments, white": (
                ForcedPhotometer(ours.kernel, template="cutout", wings=False, errors=WHITE),
                coarse, None),
        }  # fmt: skip
        for name, (photometer, image, dilation) in runs.items():
            segmentation, detected = detect_sources(highres, dilation=dilation)
            start = time.process_time()
            result = photometer.measure(image, highres, segmentation, detected)
            spent[name] = spent.get(name, 0.0) + time.process_time() - start
            index, _ = match_sky(detected["sky"], catalog["sky"], radius=0.3 * u.arcsec)
            good = index >= 0
            index = index[good]
            usable = (result.flags[index] & 5) == 0
            true = catalog[band][good].to_value(u.uJy)
            part = (result.flux.value[index], result.flux_err.value[index], true,
                    np.full(len(true), limit))  # fmt: skip
            rows.setdefault(name, []).append([values[usable] for values in part])
    table({name: [np.concatenate(v) for v in zip(*parts, strict=True)]
           for name, parts in rows.items()})  # fmt: skip
    print("processor seconds: " + ", ".join(f"{name} {t:.1f}" for name, t in spent.items()))


def dilation(band):
    """Bare segments at three thresholds, as found and grown, on a mosaic with little noise."""
    exposures = ceers_exposures(CENTER, 0 * u.deg, filters=[band])
    angles = u.Quantity([e.pa_aper for e in exposures])
    hst = hst_psf(PRIOR, pixel_scale=FINE)
    kernel = MatchingKernel.from_psfs(
        hst, psf_mosaic(miri_psf(band), COARSE, angles), pixel_scale=FINE
    )
    rng = np.random.default_rng(1)
    catalog = sources(band, rng)
    image, fine = expose(catalog, band, exposures, 2e-3, rng)
    highres = highres_image(catalog, filter=PRIOR, wcs=fine.wcs, psf=hst, seed=1)
    photometer = ForcedPhotometer(kernel, template="cutout", wings=False, errors=WHITE)
    # 1 sigma of a point source at 27.6 AB (5 sigma)
    limit = 10 ** (0.4 * (23.9 - 27.6)) / 5
    print(f"{band}: measured over true flux minus one by the signal-to-noise in F160W")
    for preset, threshold in (("yang2021", 0.25), ("default", 1.0), ("default", 2.0)):
        for rule in (None, "area"):
            segmentation, detected = detect_sources(
                highres, preset=preset, threshold=threshold, dilation=rule
            )
            result = photometer.measure(image, highres, segmentation, detected)
            index, _ = match_sky(detected["sky"], catalog["sky"], radius=0.3 * u.arcsec)
            good = index >= 0
            ratio = result.flux.value[index] / catalog[band].to_value(u.uJy) - 1
            good[good] = (result.flags[index[good]] & 5) == 0
            snr = catalog[PRIOR].to_value(u.uJy) / limit
            cells = []
            for low, high in ((10, 30), (30, 100), (100, 1e9)):
                values = ratio[good & (snr >= low) & (snr < high)]
                middle = np.median(values)
                scatter = 1.4826 * np.median(np.abs(values - middle))
                cells.append(f"{len(values):4d} {100 * middle:+6.1f} +- {100 * scatter:4.1f} %")
            kind = "as found" if rule is None else "dilated"
            print(f"{preset:9s} {threshold:5.2f} sigma {kind:9s}", " | ".join(cells), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--bands", nargs="+", default=["miri.f770w", "miri.f1500w"])
    parser.add_argument("--seeds", type=int, default=1, help="noise realisations")
    parser.add_argument("--dilation", action="store_true", help="bare segments by dilation")
    args = parser.parse_args()
    if args.dilation:
        dilation(args.bands[0])
        return
    for band in args.bands:
        compare(band, args.seeds)


if __name__ == "__main__":
    main()
