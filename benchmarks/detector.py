"""
Time and memory of one simulated exposure, 1024 x 1032 x 200 groups.

Peaks are those of the process so far: the exposure that is streamed comes first.

    python benchmarks/detector.py [n_groups] [n_threads]
    python benchmarks/detector.py flight

``flight``: width and flux of F560W stars against their brightness, with and without the brighter-fatter effect,
in four dithers and their mosaic.
"""

import resource
import sys
import tempfile
import time
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from scipy.optimize import curve_fit

from miricigale.detector import (
    BadPixels,
    Block,
    BrighterFatter,
    CosmicRays,
    Detector,
    FirstFrame,
    LastFrame,
    Ramp,
    ReadNoise,
    ResetAnomaly,
    Residual,
)
from miricigale.detector.effects.base import stream_key
from miricigale.instrument import Exposure, background_level, miri_detector
from miricigale.reduction import Reducer
from miricigale.scene import Scene

FLIGHT = sys.argv[1:] == ["flight"]
N_GROUPS = int(sys.argv[1]) if len(sys.argv) > 1 and not FLIGHT else 200
N_THREADS = int(sys.argv[2]) if len(sys.argv) > 2 else 2


def peak():
    """Peak memory of the process in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def timed(label, function):
    start, cpu = time.perf_counter(), time.process_time()
    value = function()
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    print(f"{label:44s} {wall:7.2f} s  cpu {cpu:7.2f} s  peak {peak():6.0f} MB")
    return value


def make(band, n_groups=N_GROUPS, n_integrations=1, includes=("pixel", "ipc")):
    exposure = Exposure(
        band,
        n_groups=n_groups,
        n_integrations=n_integrations,
        pointing=SkyCoord(53.1344, -27.83444, unit="deg"),
        roll=30 * u.deg,
    )
    level = background_level(band).to_value("MJy/sr")
    image = CCDData(np.full(exposure.shape, level), unit="MJy/sr")
    image.meta["psf_includes"] = list(includes)
    return image, exposure


def star(image, sky):
    """FWHM (arcsec) of a circular Gaussian fitted to 0.3 arcsec, and flux (uJy) in 1.1 arcsec, of a star."""
    x, y = image.wcs.world_to_pixel(sky)
    ys, xs = np.mgrid[: image.shape[0], : image.shape[1]]
    radius, data = np.hypot(ys - y, xs - x), image.data - np.nanmedian(image.data)
    near = (radius < 2.7) & np.isfinite(data)

    def gaussian(at, peak, x, y, sigma, level):
        return peak * np.exp(-((at[0] - x) ** 2 + (at[1] - y) ** 2) / (2 * sigma**2)) + level

    start = data[near].max(), x, y, 0.9, 0
    values, _ = curve_fit(gaussian, (xs[near], ys[near]), data[near], p0=start)
    # 1e12 uJy/MJy, 0.11 arcsec
    flux = 1e12 * np.nansum(data[radius < 10]) * (0.11 / 206264.8) ** 2
    return 2.35482 * abs(values[3]) * 0.11, flux


def flight():
    """Print widths and fluxes of stars against their brightness."""
    first = Exposure("F560W", n_groups=10, subarray="SUB256", pointing="53 -27")
    places = np.meshgrid([60.0, 110.3, 160.6], [60.2, 110.7, 160.4])
    sky = first.wcs.pixel_to_world(*(c.ravel() for c in places))
    reducer = Reducer(jump_threshold=None)
    print(
        "flux (mJy), filled, FWHM of dithers and mosaic (arcsec) and flux, plain and with the effect"
    )
    reference = None
    for flux in (0.3, 3, 10, 20, 30, 50, 100):
        table = {"id": np.arange(9), "ra": sky.ra.deg, "dec": sky.dec.deg, "profile": ["point"] * 9}
        table["F560W"] = np.full(9, flux) * u.mJy
        row = []
        for effects in ((), (BrighterFatter(),)):
            detector = Detector.miri_imager(*effects).without(CosmicRays, BadPixels)
            ramps = [
                detector.expose(Scene(table, e, background="low"), seed=1)
                for e in first.dithered("cycling-small", 4)
            ]
            peak = max(float(ramp.data[0, -1].max()) for ramp in ramps)
            result = reducer.run(ramps)
            single = np.array([[star(im, s) for s in sky] for im in result.images])
            whole = np.array([star(result.mosaic, s) for s in sky])
            row.append(
                (single[..., 0].mean(), whole[:, 0].mean(), single[..., 1].mean() / flux / 1e3)
            )
            filled = (peak - miri_detector().bias) / miri_detector().saturation_dn
            if not effects:
                before = filled
        reference = reference or row
        print(f"{flux:6.1f} {before:5.2f}", end="")
        for values, faint in zip(row, reference, strict=True):
            print(f"  {values[0]:.4f} {values[1]:.4f} {values[2] / faint[2]:.4f}", end="")
        print(f"  ratio {row[1][0] / row[0][0]:.3f} {row[1][1] / row[0][1]:.3f}", flush=True)


def main():
    detector = Detector.miri_imager()
    image, exposure = make("miri.f770w", n_groups=2)
    timed(
        "start, compile or load kernels (2 groups)",
        lambda: detector.expose(image, exposure, seed=0),
    )
    image, exposure = make("miri.f770w")
    options = {"seed": 0, "n_threads": N_THREADS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench_uncal.fits"
        timed(
            f"F770W x {N_GROUPS}, streamed to disk",
            lambda: detector.expose_to(path, image, exposure, **options),
        )
    timed("forecast", lambda: detector.forecast(image, exposure))
    ramp = timed(f"F770W x {N_GROUPS}", lambda: detector.expose(image, exposure, **options))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench_uncal.fits"
        timed("write level 1b", lambda: ramp.write(path))
        print(f"{'size of the file':44s} {path.stat().st_size / 1e6:8.0f} MB")
        timed("read it", lambda: Ramp.read(path))
    for label, band, extra in (
        ("F560W (fewest electrons a group)", "miri.f560w", {}),
        ("F2100W, 10 groups x 28", "miri.f2100w", {"n_groups": 10, "n_integrations": 28}),
        ("F770W with interpixel capacitance", "miri.f770w", {"includes": ()}),
    ):
        image, exposure = make(band, **extra)
        timed(label, lambda i=image, e=exposure: detector.expose(i, e, **options))
    everything = Detector.miri_imager(
        CosmicRays(shower_fraction=0.001),
        Residual(0.001),
        ReadNoise(pink=2.0),
        ResetAnomaly(),
        FirstFrame(),
        LastFrame(),
    )
    image, exposure = make("miri.f770w", includes=())
    timed("F770W with every option on", lambda: everything.expose(image, exposure, **options))

    print("\nEach effect on 10 rows, scaled to 1024, one thread (F770W):")
    rows = slice(500, 510)
    shape = (1, exposure.n_groups, 10, exposure.shape[1])
    array = image.data[rows]
    for effect in everything.effects:
        block = Block(
            exposure,
            miri_detector(),
            rows,
            np.zeros(shape[2:], np.uint32),
            np.zeros(shape, np.uint8),
            stream_key(0, exposure, type(effect).__name__),
        )
        start = time.process_time()
        array = effect.apply(array, block)
        print(f"  {type(effect).__name__:24s} {102.4 * (time.process_time() - start):6.2f} s cpu")


if __name__ == "__main__":
    flight() if FLIGHT else main()
