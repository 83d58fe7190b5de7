"""
Background of simulated exposures against the truth: python benchmarks/background.py [--parts ...] [--filters ...].

Levels of crowded fields, and of galaxies that fill the array, in all filters and three arrays: what they are off,
over the errors that are stated, and whether there is a warning. What a gradient of 5 %/arcmin leaves of itself.
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
from scipy.special import gamma, gammaincinv

from miricigale.depth.noise import ExposureNoise
from miricigale.detector import Detector
from miricigale.instrument import Exposure, background_level, field_mask, mosaic_wcs
from miricigale.psf import miri_psf
from miricigale.reduction import Reducer, estimate_background
from miricigale.scene import Background as Sky
from miricigale.scene import Scene
from miricigale.utils.exceptions import MiricigaleWarning

FIELD = SkyCoord(53.1344, -27.83444, unit="deg")
PIXEL = 0.11
#: Filters of the levels.
LEVELS = ["f560w", "f770w", "f1000w", "f1130w", "f1280w", "f1500w", "f1800w", "f2100w", "f2550w"]
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


def power_law(number, rng):
    """Fluxes from 3 to 300 uJy, as many of them in each interval as S to the power of -2."""
    return 1 / (1 / 3 + rng.uniform(size=number) * (1 / 300 - 1 / 3))


#: Points on each square arcminute; shapes, and half-light radii over the side of the array, of one galaxy.
DENSITIES = (300, 1000, 3000, 10000)
GALAXIES = ((1, 0.25), (1, 0.5), (4, 0.25), (1, 1.0))


def faint(number, _):
    """Fluxes below the noise at long wavelengths."""
    return np.full(number, 3.0)


def bright(number, _):
    """Fluxes of one size."""
    return np.full(number, 30.0)


def crowded_field(name, subarray, density, fluxes, seed):
    """Points all over an array and around it."""
    exp, rng = exposure(name, subarray), np.random.default_rng([seed, density])
    (ny, nx), edge = exp.shape, 100
    number = rng.poisson(density * (nx + 2 * edge) * (ny + 2 * edge) * (PIXEL / 60) ** 2)
    x, y = (rng.uniform(-edge, n + edge, number) for n in (nx, ny))
    return observe(exp, render(exp, catalog(exp.wcs, name, x, y, fluxes(number, rng))), seed=seed)


def filling_galaxy(name, subarray, index, share, seed):
    """A galaxy that fills an array, twenty times as bright at its half-light radius as the noise."""
    exp = exposure(name, subarray)
    ny, nx = exp.shape
    noise = observe(exp, render(exp), seed=seed).uncertainty.array
    radius = share * min(nx, ny) * PIXEL
    b = gammaincinv(2 * index, 0.5)
    area = 2 * np.pi * index * radius**2 * np.exp(b) * b ** (-2 * index) * gamma(2 * index)
    flux = 20 * np.median(noise) * area * (u.MJy / u.sr).to(u.uJy / u.arcsec**2)
    galaxy = catalog(exp.wcs, name, 0.55 * nx, 0.45 * ny, flux, radius=radius, index=index)
    return observe(exp, render(exp, galaxy), seed=seed)


def levels(filters, seed, only=""):
    """Levels of fields with ever less sky, in nine filters and three arrays, over their errors."""
    kinds = (("30 uJy", bright), ("3-300 uJy", power_law), ("3 uJy", faint))
    fields = [(f"{n} / arcmin2 of {t}", crowded_field, (n, f)) for t, f in kinds for n in DENSITIES]
    fields += [(f"galaxy n = {n}, re = {r} sides", filling_galaxy, (n, r)) for n, r in GALAXIES]
    print(
        f"\nLevels against the truth, seed {seed}: off, its error, and these over the noise of a pixel"
    )
    counted = []
    for label, make, options in (field for field in fields if only in field[0]):
        rows = []
        for name in filters:
            for subarray in ("FULL", "BRIGHTSKY", "SUB256"):
                image = make(name, subarray, *options, seed)
                found, _, warned = estimate(image)
                good = ~image.mask
                off = np.median(found.level[good]) - background_level(name).value
                error, noise = (
                    np.median(found.error[good]),
                    np.median(image.uncertainty.array[good]),
                )
                rows.append((off / error, off / noise, error / noise, warned))
                print(
                    f"{label:28s} {name[5:]:7s} {subarray:10s} {off:8.4f} +- {error:7.4f} MJy/sr "
                    f"({off / error:5.2f}) {off / noise:7.3f} +- {error / noise:6.3f}"
                    f"{' warned' if warned else ''}",
                    flush=True,
                )
        pull, off, error, warned = np.array(rows).T
        counted += [*pull]
        print(
            f"= {label:28s} within 2 errors {np.mean(np.abs(pull) <= 2):.2f}, pull median "
            f"{np.median(pull):.2f}, worst {pull[np.argmax(np.abs(pull))]:.2f}; median off {np.median(off):.3f} "
            f"+- {np.median(error):.3f} of the noise of a pixel, warned {np.mean(warned):.2f}",
            flush=True,
        )
    print(f"= all {len(counted)}: within 2 errors {np.mean(np.abs(counted) <= 2):.3f}")


def chain(seed):
    """Levels of crowded fields from ramps on: of single exposures, and of the mosaic of four dithers."""
    print("\nLevels through ramps, slopes and mosaics (four dithers, SUB256), MJy/sr")
    for name, density in (("f1280w", 1000), ("f1280w", 3000), ("f2100w", 3000), ("f2550w", 10000)):
        name, rng = f"miri.{name}", np.random.default_rng([seed, density])
        first = Exposure(name, subarray="SUB256", pointing=FIELD, roll=30 * u.deg, n_groups=30,
                         n_integrations=4)  # fmt: skip
        (ny, nx), edge = first.shape, 150
        number = rng.poisson(density * (nx + 2 * edge) * (ny + 2 * edge) * (PIXEL / 60) ** 2)
        x, y = (rng.uniform(-edge, n + edge, number) for n in (nx, ny))
        sources = catalog(first.wcs, name, x, y, power_law(number, rng))
        detector, ramps = Detector.miri_imager(), []
        for dither in first.dithered("4-point"):
            ramps.append(detector.expose(Scene(sources, dither, background="low"), seed=seed))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MiricigaleWarning)
            result = Reducer().run(ramps)
        true, seen = background_level(name).value, ~result.mosaic.mask
        one, last = result.backgrounds[0], result.mosaic_background
        off, off_all = np.median(one.level) - true, np.median(result.subtracted[seen]) - true
        print(
            f"{name[5:]:7s} {density:6d} / arcmin2 of 3-300 uJy: exposure {off:7.3f} +- "
            f"{np.median(one.error):6.3f}, mosaic {off_all:7.3f} +- {np.median(last.error[seen]):6.3f}; "
            f"{'; '.join(result.notes) or 'no notes'}",
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
    parser.add_argument(
        "--parts", nargs="+", default=["levels", "chain", "gradients", "times", "injected"]
    )
    parser.add_argument("--draws", type=int, default=4, help="draws of the noise for the fluxes")
    parser.add_argument("--seed", type=int, default=1, help="of the levels")
    parser.add_argument("--only", default="", help="levels whose label has this text")
    args = parser.parse_args()
    if "chain" in args.parts:
        chain(args.seed)
    if "levels" in args.parts:
        levels([f"miri.{name}" for name in LEVELS], args.seed, args.only)
    fluxes = {"miri.f770w": (1.0, 10.0, 100.0, 1000.0), "miri.f2100w": (30.0, 300.0, 3000.0)}
    for name in args.filters:
        if "gradients" in args.parts:
            gradients(name, {})
        if "times" in args.parts and name != "miri.f2100w":
            times(name)
        if "injected" in args.parts:
            injected(name, {}, fluxes.get(name, (10.0, 100.0, 1000.0)), args.draws)


if __name__ == "__main__":
    main()
