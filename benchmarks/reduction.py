"""
Time and memory of the reduction on full frames: python benchmarks/reduction.py [--quick] [--jwst] [--deep].

Prints a table. Ramps come from the package's own detector with a uniform low background,
cosmic rays on. With ``--jwst`` the steps of the official pipeline fit the same ramps (extra jwst). ``--deep``
prints what stripes and a change of the response cost in a deep field, and what is left without them.
"""

import argparse
import resource
import time

import astropy.units as u
import numpy as np
import sep
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from scipy.ndimage import distance_transform_edt, gaussian_filter

from miricigale.detector import Detector
from miricigale.instrument import Exposure, background_level, mosaic_wcs
from miricigale.reduction import Reducer, reject_outliers, remove_stripes, sky_flats
from miricigale.scene import Scene


def peak():
    """Peak memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def clock(name, function, *args, **options):
    """Call, print wall and processor time and the growth of the peak memory."""
    before, wall, cpu = peak(), time.perf_counter(), time.process_time()
    out = function(*args, **options)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{name:44s} {wall:8.2f} {cpu:8.2f} {peak() - before:10.0f}", flush=True)
    return out


class Field:
    """Deep F770W exposures of 400 sources, and what is measured in them."""

    def __init__(self, n_dithers):
        first = Exposure("F770W", n_groups=100, pointing=SkyCoord(53.1344, -27.8344, unit="deg"))
        rng = np.random.default_rng(3)
        x, y = rng.uniform(365, 1010, 400), rng.uniform(10, 1014, 400)
        fluxes = np.minimum(0.5 * rng.random(400) ** (-1 / 1.2), 300)
        fluxes[:8] = 1000, 200, 3000, 50, 100, 500, 300, 20
        sky, galaxy = first.wcs.pixel_to_world(x, y), np.arange(400) % 5 > 1
        table = {
            "id": np.arange(400),
            "ra": sky.ra.deg,
            "dec": sky.dec.deg,
            "F770W": fluxes * u.uJy,
        }
        table["profile"] = np.where(galaxy, "sersic", "point")
        table |= {
            "half_light_radius": rng.uniform(0.1, 0.8, 400) * u.arcsec,
            "sersic_index": np.ones(400),
        }
        table |= {"axis_ratio": rng.uniform(0.4, 1, 400), "position_angle": np.zeros(400) * u.deg}
        self.sky, self.bright, self.reducer = sky, fluxes >= 100, Reducer()
        detector, self.images = Detector.miri_imager(), []
        for e in first.dithered("cycling-large", n_dithers):
            charge = detector.collect(Scene(table, e, background="low"), seed=1)
            self.images.append(self.reducer.calibrate(self.reducer.fit_ramp(charge)))
        plain, background = self.reducer.subtract_background(self.images[0])
        free = distance_transform_edt(~(background.source_mask | plain.mask))
        places = rng.uniform(20, 1000, (2, 8000))
        self.empty = places[:, free[tuple(places[::-1].astype(int))] > 4.5]
        self.plain = [self.measured(im) for im in self.images]

    def measured(self, image):
        """Scatter of empty apertures of 3 pixels, and fluxes of bright sources in 5 and 10 pixels."""
        image, _ = self.reducer.subtract_background(image)
        data = np.where(image.mask, 0, image.data).astype(float)
        x, y = image.wcs.world_to_pixel(self.sky[self.bright])
        inside = (x > 380) & (x < 1000) & (y > 20) & (y < 1000)
        fluxes = [np.where(inside, sep.sum_circle(data, x, y, r)[0], np.nan) for r in (5.0, 10.0)]
        sums, *_ = sep.sum_circle(data, *self.empty, 3.0)
        return 1.4826 * np.median(np.abs(sums - np.median(sums))), np.array(fluxes)

    def report(self, label, images):
        """Print depth (of the first) and fluxes compared with those of the plain images."""
        found = [self.measured(im) for im in images]
        depth = 2.5 * np.log10(found[0][0] / self.plain[0][0])
        pairs = zip(found, self.plain[: len(found)], strict=True)
        off = np.stack([100 * (one[1] / plain[1] - 1) for one, plain in pairs])
        rms, most = (
            np.nanstd(off, axis=(0, 2)).round(3),
            np.nanmax(np.abs(off), axis=(0, 2)).round(2),
        )
        text = f"flux (5, 10 pixels): rms {rms} % most {most} %"
        print(f"{label:32s} depth {depth:+.3f} mag  {text}")


def deep():
    """Print what stripes and a change of the response cost."""
    field = Field(6)
    first = field.images[0]
    sigma = float(np.median(first.uncertainty.array[~first.mask]))
    rng = np.random.default_rng(5)
    for width in (1, 5):
        rows, columns = (
            np.convolve(rng.normal(size=n + 40), np.ones(width) / width**0.5, "same")[20:-20]
            for n in first.shape
        )
        striped = first.copy()
        striped.data = first.data + np.float32(0.3 * sigma) * np.float32(rows[:, None] + columns)
        field.report(f"stripes of {width} pixels", [striped])
        field.report("  removed", [clock("", remove_stripes, striped)])
    field.report("no stripes, removed", [remove_stripes(first)])
    pattern = gaussian_filter(rng.normal(size=first.shape), 60)
    pattern *= 0.01 / pattern.std()
    changed = []
    for im in field.images:
        changed.append(im.copy())
        changed[-1].data = (im.data * (1 + pattern)).astype(np.float32)
    field.report("response off by 1 %", changed)
    flats = clock("sky flats", sky_flats, changed)
    error = np.median(flats[0].uncertainty.array)
    off = flats[0].data / (1 + pattern)
    print(f"flats: error {error:.5f}, off by {np.std((off / np.median(off))[~first.mask]):.5f}")
    field.report("  over the sky flat", divided(changed, flats))
    field.report("no change, over the sky flat", divided(field.images, sky_flats(field.images)))


def divided(images, flats):
    """Images over their flats."""
    out = [im.copy() for im in images]
    for im, flat in zip(out, flats, strict=True):
        im.data = (im.data / flat.data).astype(np.float32)
    return out


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="40 groups only")
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--jwst", action="store_true", help="the official pipeline too")
    parser.add_argument("--deep", action="store_true", help="stripes and sky flats alone")
    args = parser.parse_args()
    if args.deep:
        deep()
        return
    cases = (
        [("miri.f1000w", 40, 1)]
        if args.quick
        else [("miri.f1000w", 200, 1), ("miri.f2100w", 10, 28)]
    )
    detector, reducer = Detector.miri_imager(), Reducer(n_threads=args.threads)
    print(f"{'':44s} {'wall s':>8s} {'cpu s':>8s} {'+peak MB':>10s}")
    for filt, n_groups, n_integrations in cases:
        exposures = [
            Exposure(
                filt,
                n_groups=n_groups,
                n_integrations=n_integrations,
                pointing=SkyCoord(53.1344 + d * 1e-3, -27.8344 + d * 6e-4, unit="deg"),
                roll=30 * u.deg,
                dither=d,
            )
            for d in range(3)
        ]
        label = f"{filt} {n_groups} x {n_integrations}"
        sky = CCDData(np.full(exposures[0].shape, background_level(filt).value), unit="MJy/sr")
        ramp = clock(f"{label}: expose (detector)", detector.expose, sky, exposures[0], seed=1)
        reducer.fit_ramp(ramp)  # compile
        rate = clock(f"{label}: slopes", reducer.fit_ramp, ramp)
        no_jumps = reducer.replace(jump_threshold=None)
        clock(f"{label}: slopes without jumps", no_jumps.fit_ramp, ramp)
        if args.jwst:
            clock(f"{label}: slopes, jwst", reducer.replace(backend="jwst").fit_ramp, ramp)
        del ramp

        def draw(exposure=exposures[0], sky=sky):
            return reducer.fit_ramp(detector.collect(sky, exposure, seed=1))

        draw()
        clock(f"{label}: rates without groups", draw)
        cal = clock(f"{label}: calibrate", reducer.calibrate, rate)
        cal, _ = clock(f"{label}: background", reducer.subtract_background, cal)
    cals = []
    for d, exposure in enumerate(exposures):
        copy = cal.copy()
        copy.wcs, copy.meta = exposure.wcs, {**cal.meta, "dither": d}
        cals.append(copy)
    native, fine = (mosaic_wcs(exposures, scale * u.arcsec) for scale in (0.11, 0.06))

    def mosaics(images):
        _, masked = reducer.drizzle(images, native)
        return reducer.drizzle(masked, fine)

    clock('outliers of 3 dithers, 0.11"', reject_outliers, cals, native)
    clock('3 dithers to mosaics of 0.11" and 0.06"', mosaics, cals)

    def whole():
        reduced = [reducer.subtract_background(reducer.calibrate(rate))[0] for _ in range(3)]
        for new, old in zip(reduced, cals, strict=True):
            new.wcs, new.meta = old.wcs, {**new.meta, "dither": old.meta["dither"]}
        return mosaics(reduced)

    clock("the same from three rates", whole)


if __name__ == "__main__":
    main()
