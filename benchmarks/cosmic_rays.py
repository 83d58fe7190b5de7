"""
Purity of the search for cosmic rays on single images: python benchmarks/cosmic_rays.py [--filters ...].

Full frames with few and many stars are exposed twice with one seed, with hits and without, and reduced. Hits
that ramps kept are pixels that are hit, or have a neighbor that is, and whose brightness is higher with hits by
more than five of its errors. For each field: such pixels, pixels that the search flagged, how many of those are
kept hits or lie beside one (purity), and how many of the kept hits it found (recall).
"""

import argparse
import time

import numpy as np
from astropy.nddata import CCDData
from background import catalog, exposure, render
from scipy.ndimage import binary_dilation

from miricigale.detector import CosmicRays, Detector
from miricigale.instrument import background_level, psf_fwhm
from miricigale.reduction import Reducer, find_cosmic_rays
from miricigale.reduction.calibration import _PIXEL_SCALE


def measure(name, number, seed, groups):
    """Flagged pixels, kept hits, and those that are both, of one frame."""
    rng = np.random.default_rng(seed)
    exp = exposure(name, "FULL").replace(n_groups=groups, n_integrations=1)
    ny, nx = exp.shape
    stars = None
    if number:
        # as many of each decade, from the limit to saturation
        flux = 10 ** rng.uniform(0, 4, number) * background_level(name).value / 10
        stars = catalog(exp.wcs, name, rng.uniform(0, nx, number), rng.uniform(0, ny, number), flux)
    light = render(exp, stars)
    detector, reducer = Detector.miri_imager(), Reducer(cosmic_rays=False)
    image = CCDData(light, unit="MJy/sr")
    cals = [
        reducer.calibrate(reducer.fit_ramp(one.expose(image, exp, seed=seed)))
        for one in (detector, detector.without(CosmicRays))
    ]
    charge = detector.collect(image, exp, seed=seed)
    hit = np.zeros(exp.shape, bool)
    hit[tuple(charge.hits[1:])] = True
    hit = binary_dilation(hit, np.ones((3, 3)))
    with_hits, without = cals
    good = ~(with_hits.mask | without.mask)
    off = (with_hits.data - without.data) / with_hits.uncertainty.array
    kept = hit & good & (off > 5)
    found = find_cosmic_rays(with_hits, fwhm=psf_fwhm(name).value / _PIXEL_SCALE) & good
    return found, kept, light


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument(
        "--filters", nargs="+", default=["miri.f560w", "miri.f1000w", "miri.f2100w"]
    )
    parser.add_argument("--stars", nargs="+", type=int, default=[0, 300, 3000])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--groups", type=int, default=30)
    args = parser.parse_args()
    names = ("stars", "kept", "flagged", "true", "beside", "purity", "recall", "cpu s")
    print(f"{'filter':12s}" + "".join(f"{name:>8s}" for name in names))
    for name in args.filters:
        for number in args.stars:
            start = time.process_time()
            sums = np.zeros(4, int)
            for seed in range(args.seeds):
                found, kept, _ = measure(name, number, 100 + seed, args.groups)
                near = binary_dilation(kept, np.ones((3, 3))) & ~kept
                sums += [kept.sum(), found.sum(), (found & kept).sum(), (found & near).sum()]
            n, flagged, true, beside = sums
            print(
                f"{name:12s}{number:8d}{n:8d}{flagged:8d}{true:8d}{beside:8d}"
                f"{(true + beside) / max(flagged, 1):8.2f}{true / max(n, 1):8.2f}"
                f"{time.process_time() - start:8.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
