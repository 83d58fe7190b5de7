"""
Showers and afterglow that only the comparison of dithers finds.

    python benchmarks/faint_light.py [SEED...]

Five dithers of SUB256 with three bright stars are simulated with showers and persistence, and with plain cosmic
rays alone, and reduced with and without the smoothed comparison. Printed are the scatter of the sky of the mosaic
in boxes of 11 pixels (in errors of a pixel), the significance of what is left where the brightest star was in the
dither before, and the number of masked pixels.
"""

import sys
import time
from unittest import mock

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from scipy.ndimage import uniform_filter

from miricigale import Detector, Exposure, Reducer
from miricigale.detector import CosmicRays, Latent, Persistence
from miricigale.reduction.mosaic import outliers

CENTER = SkyCoord(53.13, -27.83, unit="deg")
DITHERS = ((0.0, 0.0), (1.9, 0.9), (-1.2, 2.3), (0.8, -2.1), (-2.0, -1.3))
STARS = CENTER.spherical_offsets_by([3.0, -6.0, 1.0] * u.arcsec, [2.0, 4.0, -7.0] * u.arcsec)
PEAKS = (3000.0, 1000.0, 300.0)
BOX = 11


def simulate(detector, seed, *, afterglow):
    """Ramps of the dithers, each with what the two before it leave behind."""
    ramps = []
    previous = []
    for number, (east, north) in enumerate(DITHERS):
        pointing = CENTER.spherical_offsets_by(east * u.arcsec, north * u.arcsec)
        exposure = Exposure(
            "F770W", n_groups=30, subarray="SUB256", pointing=pointing, roll=0 * u.deg
        )
        y, x = np.indices(exposure.shape)
        sky = np.full(exposure.shape, 5.0)
        for x_star, y_star, peak in zip(*exposure.wcs.world_to_pixel(STARS), PEAKS, strict=True):
            sky += peak * np.exp(-((x - x_star) ** 2 + (y - y_star) ** 2) / (2 * 1.1**2))
        latents = [latent.after(60 * u.s) for latent in previous] if afterglow else []
        ramp = detector.expose(
            sky * u.MJy / u.sr, exposure, seed=10 * seed + number, previous=latents or None
        )
        ramps.append(ramp)
        previous = [Latent.from_ramp(ramp, gap=60 * u.s), *previous[:1]]
    return ramps


def sky_scatter(mosaic):
    """Scatter of the mean of boxes away from stars, in errors of a pixel."""
    error = mosaic.uncertainty.array
    good = ~mosaic.mask & (error > 0)
    pull = np.where(good, mosaic.data / error, 0.0)
    y, x = np.indices(mosaic.shape)
    far = uniform_filter(good.astype(float), 25) > 0.999
    for x_star, y_star in zip(*mosaic.wcs.world_to_pixel(STARS), strict=True):
        far &= np.hypot(x - x_star, y - y_star) > 60
    return uniform_filter(pull, BOX)[far].std()


def afterglow_left(image, place):
    """Significance of the light of an image within 4 pixels of a place; NaN if most of it is masked."""
    y, x = np.indices(image.shape)
    used = (np.hypot(x - place[0], y - place[1]) < 4) & ~image.mask
    if np.count_nonzero(used) < 10:
        return np.nan
    return image.data[used].sum() / np.sqrt(np.sum(image.uncertainty.array[used] ** 2))


def nothing(excess, good, threshold):
    """No comparison of smoothed images."""
    return np.zeros(good.shape, bool)


def main():
    """Print a line for each seed, kind of simulation and kind of reduction."""
    seeds = [int(text) for text in sys.argv[1:]] or [1, 2]
    showers = CosmicRays(shower_fraction=1.0, shower_above=5e4)
    kinds = {
        "showers": Detector.miri_imager(showers, Persistence()),
        "plain rays": Detector.miri_imager(CosmicRays()),
    }
    for seed in seeds:
        for kind, detector in kinds.items():
            ramps = simulate(detector, seed, afterglow=kind == "showers")
            place = [float(v[0]) for v in ramps[0].exposure.wcs.world_to_pixel(STARS)]
            for name, search in (("pixels", nothing), ("smoothed", outliers.extended_outliers)):
                start = time.process_time()
                with mock.patch.object(outliers, "extended_outliers", search):
                    result = Reducer().run(ramps, progress_bar=False)
                seconds = time.process_time() - start
                masked = sum(image.meta["n_outliers"] for image in result.images)
                print(
                    f"seed {seed}  {kind:10}  {name:8}  scatter {sky_scatter(result.mosaic):.3f}"
                    f"  afterglow {afterglow_left(result.images[1], place):5.1f} sigma"
                    f"  masked {masked:6}  {seconds:.1f} CPU-s"
                )


if __name__ == "__main__":
    main()
