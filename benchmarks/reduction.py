"""
Time and memory of the reduction on full frames: python benchmarks/reduction.py [--quick] [--jwst].

Prints a table. Ramps come from the package's own detector with a uniform low background,
cosmic rays on. With ``--jwst`` the steps of the official pipeline fit the same ramps (extra jwst).
"""

import argparse
import resource
import time

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData

from miricigale.detector import Detector
from miricigale.instrument import Exposure, background_level, mosaic_wcs
from miricigale.reduction import Reducer, reject_outliers


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


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="40 groups only")
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--jwst", action="store_true", help="the official pipeline too")
    args = parser.parse_args()
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
