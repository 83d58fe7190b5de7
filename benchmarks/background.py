"""
Background of simulated exposures against the truth: python benchmarks/background.py [--filters ...] [--draws N].

Three tables. Levels of fields with ever less sky: true level, estimate, its error, the rest over the noise of a
pixel, and whether the result says that it cannot be trusted. What a gradient of 5 %/arcmin leaves of itself.
Fluxes of sources that are put on an empty field: the share that the estimate of the background takes of them,
with the same noise with and without the sources. And the processor time of three exposures.

Noise is that of 200 groups of 2.775 s (F2100W: 28 ramps of 10), drawn as Gaussian.
"""

import argparse
import time
import warnings

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale.depth.noise import ExposureNoise
from miricigale.instrument import Exposure, aperture, background_level, field_mask, mosaic_wcs
from miricigale.psf import miri_psf
from miricigale.reduction import Reducer, estimate_background
from miricigale.scene import Background as Sky
from miricigale.scene import Scene
from miricigale.utils.exceptions import MiricigaleWarning

FIELD = SkyCoord(53.1344, -27.83444, unit="deg")
PIXEL = 0.11
#: Sersic index (0: point) and half-light radius (arcsec) of what is injected.
PROFILES = (
    (0, np.nan), (1, 0.25), (1, 0.5), (1, 1.0), (1, 2.0), (1, 3.0), (4, 0.5), (4, 1.0), (4, 2.0)
)  # fmt: skip


def exposure(name, subarray, pointing=FIELD):
    """Exposure of about 560 s; F2100W in ramps that the sky does not fill."""
    groups = {"n_groups": 10, "n_integrations": 20} if name == "miri.f2100w" else {"n_groups": 200}
    return Exposure(name, subarray=subarray, pointing=pointing, roll=30 * u.deg, **groups)


def catalog(wcs, name, x, y, flux, *, radius=np.nan, index=np.nan):
    """Points, or round Sersic profiles, at pixels."""
    columns = (np.asarray(v, float) for v in np.broadcast_arrays(x, y, flux, radius, index))
    x, y, flux, radius, index = (np.atleast_1d(v) for v in columns)
    nothing = np.full(x.size, np.nan)
    round_ = np.where(np.isfinite(radius), 1.0, np.nan)
    return QTable(
        {
            "id": np.arange(x.size), "sky": wcs.pixel_to_world(x, y),
            "profile": np.where(np.isfinite(radius), "sersic", "point"), "redshift": nothing,
            "half_light_radius": radius * u.arcsec, "sersic_index": index,
            "axis_ratio": round_, "position_angle": 0 * round_ * u.deg, name: flux * u.uJy,
        }
    )  # fmt: skip


def render(exp, sources=None, *, background=None):
    """Light of sources on an exposure, MJy/sr."""
    level = background_level(exp.filter) if background is None else background
    if sources is None:
        sources = catalog(exp.wcs, exp.filter, 0, 0, 0.0)
    scene = Scene(
        sources, filter=exp.filter, wcs=exp.wcs, psf=miri_psf(exp.filter), background=level,
        max_radius=60 * u.arcsec,
    )  # fmt: skip
    return scene.render().data


def observe(exp, light, *, seed):
    """Noisy image of an exposure, masked where the imager sees no sky."""
    noise = ExposureNoise(
        filter=exp.filter, background=None, n_groups=exp.n_groups,
        group_time=exp.group_time.to_value("s"), n_ramps=exp.n_integrations,
    )  # fmt: skip
    unit = noise.sky / noise.background.value
    more = np.clip(light - noise.background.value, 0, None) * unit
    sigma = (np.sqrt(noise.variance() + noise.growth * more) / unit).astype(np.float32)
    inside = field_mask(subarray=exp.subarray)
    mask = ~inside if inside.any() else np.zeros_like(inside)
    data = light + np.random.default_rng(seed).normal(size=light.shape) * sigma
    return CCDData(
        data.astype(np.float32), unit="MJy/sr", uncertainty=StdDevUncertainty(sigma), mask=mask,
        wcs=exp.wcs, meta={"filter": exp.filter, "subarray": exp.subarray},
    )  # fmt: skip


def estimate(image, **options):
    """Background, processor time and whether there was a warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MiricigaleWarning)
        start = time.process_time()
        background = estimate_background(image, **options)
        seconds = time.process_time() - start
    return background, seconds, any(issubclass(w.category, MiricigaleWarning) for w in caught)


def crowded(name, options):
    """Levels of ever less sky."""
    rng = np.random.default_rng(1)
    print(f"\nLevels, {name}, MJy/sr")
    print(
        f"{'field':34s} {'true':>8s} {'median':>8s} {'error':>7s} {'off/sigma':>9s} {'worst':>7s} "
        f"{'rms/sigma':>9s} {'masked':>6s} {'warned':>6s} {'cpu s':>6s}"
    )
    sky = background_level(name).value
    for label, subarray, number, flux, radius, level in (
        ("empty", "FULL", 0, 0.0, np.nan, sky),
        ("1000 points of 3 uJy", "FULL", 1000, 3.0, np.nan, sky),
        ("1000 points of 30 uJy", "FULL", 1000, 30.0, np.nan, sky),
        ("10000 points of 3 uJy", "FULL", 10000, 3.0, np.nan, sky),
        ("10000 points of 30 uJy", "FULL", 10000, 30.0, np.nan, sky),
        ("empty", "SUB256", 0, 0.0, np.nan, sky),
        ("200 points of 30 uJy", "SUB256", 200, 30.0, np.nan, sky),
        ("2000 points of 3 uJy", "SUB256", 2000, 3.0, np.nan, sky),
        ("2000 points of 30 uJy", "SUB256", 2000, 30.0, np.nan, sky),
        ("empty", "SUB64", 0, 0.0, np.nan, 5.0),
        ("galaxy, n = 1, re 0.5 arcsec", "SUB64", 1, 2e3, 0.5, 5.0),
        ("galaxy, n = 1, re 1 arcsec", "SUB64", 1, 2e4, 1.0, 5.0),
        ("galaxy, n = 1, re 3 arcsec", "SUB64", 1, 2e4, 3.0, 5.0),
        ("galaxy, n = 1, re 6 arcsec", "SUB64", 1, 1e5, 6.0, 5.0),
        ("galaxy, n = 4, re 3 arcsec", "SUB64", 1, 4e4, 3.0, 5.0),
    ):
        ny, nx = aperture(subarray).shape
        exp = exposure(name, subarray)
        x, y = (rng.uniform(0, n, number) if np.isnan(radius) else [n / 2] for n in (nx, ny))
        sources = catalog(exp.wcs, name, x, y, flux, radius=radius, index=4.0 if "n = 4" in label else
                          1.0 if radius > 0 else np.nan) if number else None  # fmt: skip
        image = observe(exp, render(exp, sources, background=level * u.MJy / u.sr), seed=3)
        found, seconds, warned = estimate(image, **options)
        good = ~image.mask
        sigma = np.median(image.uncertainty.array[good])
        off = (found.level - level)[good]
        error = getattr(found, "error", np.full(image.shape, np.nan))
        print(
            f"{subarray + ' ' + label:34s} {level:8.3f} {np.median(found.level[good]):8.3f} "
            f"{np.median(error[good]):7.4f} {np.median(off) / sigma:9.3f} "
            f"{np.abs(off).max() / sigma:7.2f} {np.median(found.rms[good]) / sigma:9.3f} "
            f"{found.source_mask[good].mean():6.2f} {'yes' if warned else 'no':>6s} {seconds:6.2f}",
            flush=True,
        )


def gradients(name, options):
    """What is left of a gradient of 5 %/arcmin, full frame."""
    exp = exposure(name, "FULL")
    rng = np.random.default_rng(5)
    sources = catalog(exp.wcs, name, rng.uniform(0, 1032, 1000), rng.uniform(0, 1024, 1000),
                      10 ** rng.normal(0.0, 0.7, 1000) * background_level(name).value / 5)  # fmt: skip
    bare = Sky.low_zodi(name, center=FIELD).image(exp.wcs, exp.shape)
    light = render(exp, sources, background=Sky.low_zodi(name, center=FIELD))
    for label, lit in (("empty", bare), ("1000 sources", light)):
        image = observe(exp, lit, seed=6)
        found, _, _ = estimate(image, **options)
        good = ~image.mask
        sigma = np.median(image.uncertainty.array[good])
        off, span = (found.level - bare)[good] / sigma, np.ptp(bare[good]) / sigma
        left = ((lit - bare)[good & ~found.source_mask] / sigma).mean()
        median = np.median(off)
        print(
            f"{name} {label:14s} gradient {span:7.1f} sigma from end to end; left: median {median:6.3f} (light "
            f"of sources that are not masked {left:.3f}), about it rms {off.std():.3f}, "
            f"worst {np.abs(off - median).max():.3f} sigma",
            flush=True,
        )


def injected(name, options, fluxes, draws):
    """Share of the flux of sources that the background takes."""
    print(
        f"\nShare of the flux that the background takes, {name}, per cent "
        f"(mean of 9 in {draws} draws of the noise, within max(1.5, 2.5 re); *: with a warning)"
    )
    print(f"{'source':22s}" + "".join(f"{f'{flux:g} uJy':>17s}" for flux in fluxes))
    exp = exposure(name, "BRIGHTSKY")
    ny, nx = exp.shape
    at = np.array([0.2, 0.5, 0.8])
    x, y = (a.ravel() for a in np.meshgrid(at * nx, at * ny))
    empty = render(exp)
    seeds = range(8, 8 + draws)
    without = [estimate(observe(exp, empty, seed=seed), **options)[0].level for seed in seeds]
    area = (PIXEL * u.arcsec).to_value(u.rad) ** 2 * 1e12
    yy, xx = np.mgrid[:ny, :nx]
    for index, radius in PROFILES:
        row = "point" if not index else f"n = {index}, re {radius:g} arcsec"
        within = max(1.5, 2.5 * np.nan_to_num(radius)) / PIXEL
        near = [np.hypot(xx - a, yy - b) < within for a, b in zip(x, y, strict=True)]
        one = (
            render(exp, catalog(exp.wcs, name, x, y, 1.0, radius=radius, index=index or np.nan))
            - empty
        )
        cells = []
        for flux in fluxes:
            shares, doubt = [], " "
            for seed, level in zip(seeds, without, strict=True):
                found, _, warned = estimate(observe(exp, empty + flux * one, seed=seed), **options)
                taken = (found.level - level) * area / flux
                shares += [taken[place].sum() for place in near]
                doubt = "*" if warned else doubt
            error = np.std(shares) / np.sqrt(len(shares))
            cells.append(f"{100 * np.mean(shares):6.2f} +- {100 * error:4.2f}{doubt}")
        print(f"{row:22s}" + "".join(f"{cell:>17s}" for cell in cells), flush=True)


def times(name):
    """Processor time of three exposures of a field, from calibrated images to both mosaics."""
    images, rng = [], np.random.default_rng(5)
    for d in range(3):
        sky = SkyCoord(FIELD.ra + d * 3.6 * u.arcsec, FIELD.dec + d * 2.2 * u.arcsec)
        exp = exposure(name, "FULL", sky)
        if not d:
            places, flux = rng.uniform(0, 1024, (2, 1000)), 10 ** rng.normal(0, 0.7, 1000)
            sources = catalog(exp.wcs, name, *places, flux)
        images.append(observe(exp, render(exp, sources), seed=d))
    reducer = Reducer()
    native, fine = (mosaic_wcs([im.wcs for im in images], s * u.arcsec) for s in (0.11, 0.06))
    for _ in range(2):
        # the second time nothing is loaded any more
        seconds = [time.process_time()]
        subtracted = [reducer.subtract_background(im)[0] for im in images]
        seconds.append(time.process_time())
        for grid in (native, fine):
            drizzled, subtracted = reducer.drizzle(subtracted, grid)
            seconds.append(time.process_time())
            reducer.subtract_background(drizzled.image)
            seconds.append(time.process_time())
        steps = np.diff(seconds)
    print(
        f"\nProcessor time, {name}, three exposures: backgrounds {steps[0]:.1f} s, mosaic of 0.11 arcsec "
        f"{steps[1]:.1f} s and its background {steps[2]:.1f} s, of 0.06 arcsec {steps[3]:.1f} s and "
        f"{steps[4]:.1f} s, together {steps.sum():.1f} s"
    )


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--filters", nargs="+", default=["miri.f770w", "miri.f2100w"])
    parser.add_argument("--parts", nargs="+", default=["crowded", "gradients", "times", "injected"])
    parser.add_argument("--draws", type=int, default=4, help="draws of the noise for the fluxes")
    args = parser.parse_args()
    fluxes = {"miri.f770w": (1.0, 10.0, 100.0, 1000.0), "miri.f2100w": (30.0, 300.0, 3000.0)}
    for name in args.filters:
        if "crowded" in args.parts and name != "miri.f2100w":
            crowded(name, {})
        if "gradients" in args.parts:
            gradients(name, {})
        if "times" in args.parts and name != "miri.f2100w":
            times(name)
        if "injected" in args.parts:
            injected(name, {}, fluxes.get(name, (10.0, 100.0, 1000.0)), args.draws)


if __name__ == "__main__":
    main()
