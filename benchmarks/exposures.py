"""
Photometry on exposures compared with that on their mosaic, on simulated MIRI dithers.

    python benchmarks/exposures.py pulls --seeds 2 3 4          ramps of four dithers, reduced and measured
    python benchmarks/exposures.py pulls --spacing 1.3 --side 14 a crowded field
    python benchmarks/exposures.py errors F560W F770W F1500W    errors of isolated points, on noise
    python benchmarks/exposures.py stars F770W                  a star at 48 places of the array

``pulls`` simulates four dithers (SUB256, 40 groups, low zodiacal light, cosmic rays) of points and Sersic profiles
on a jittered lattice, adds a hundred empty places to the catalog, and measures all with their true shapes on the
exposures and on the mosaic: pulls (measured less true flux, over the error) and the ratio of the errors. ``stars``
renders with PSFs at 25 places and measures with those of 9.
"""

import argparse

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale import Detector, Exposure, Reducer
from miricigale.instrument import mosaic_wcs, north_up_wcs, tangent_offset
from miricigale.photometry import ExposureKernels, ForcedPhotometer, SourceTemplates
from miricigale.psf import (
    MatchingKernel,
    filter_psf,
    miri_psf,
    miri_psf_grid,
    psf_mosaic,
    undistorted_psf,
)
from miricigale.scene import Scene

CENTER = SkyCoord(53.1, -27.8, unit="deg")
ROLL = 35 * u.deg
FINE = 0.06 * u.arcsec
DITHERS = [(0, 0), (1.93, -1.27), (-2.36, -1.61), (1.11, 2.45)]  # arcsec
N_EMPTY = 100


def dithers(name, subarray="SUB256"):
    first = Exposure(name, n_groups=40, subarray=subarray, pointing=CENTER, roll=ROLL)
    found = []
    for number, (x, y) in enumerate(DITHERS):
        pointing = tangent_offset(CENTER, x * u.arcsec, y * u.arcsec, first.pa_aper)
        found.append(first.replace(pointing=pointing, dither=number))
    return found


def field(seed, band, side, spacing):
    """A catalog of points (a third) and galaxies on a lattice, and empty places after them."""
    rng = np.random.default_rng(seed)
    n = side**2
    grid = (np.arange(side) - (side - 1) / 2) * spacing
    dx, dy = (a.ravel() + rng.uniform(-0.3, 0.3, n) * spacing for a in np.meshgrid(grid, grid))
    reach = side * spacing / 2
    dx = np.append(dx, rng.uniform(-reach, reach, N_EMPTY))
    dy = np.append(dy, rng.uniform(-reach, reach, N_EMPTY))
    total = n + N_EMPTY
    point = rng.random(total) < 0.35
    point[n:] = True
    catalog = QTable({"id": np.arange(1, total + 1)})
    catalog["sky"] = CENTER.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec)
    catalog["profile"] = np.where(point, "point", "sersic")
    catalog["half_light_radius"] = (
        np.where(point, 0, 10 ** rng.uniform(-1, -0.35, total)) * u.arcsec
    )
    catalog["sersic_index"] = rng.uniform(0.8, 3, total)
    catalog["axis_ratio"] = rng.uniform(0.4, 1, total)
    catalog["position_angle"] = rng.uniform(0, 180, total) * u.deg
    flux = 10 ** rng.uniform(0.0, 1.3, total)
    flux[n:] = 0
    catalog[band] = flux * u.uJy
    return catalog, n


def prior_grid():
    """An image whose grid and filter stand for the prior."""
    meta = {"filter": "nircam.f444w", "pa_aper": 35.0}
    wcs = north_up_wcs(CENTER, FINE, (560, 560))
    return CCDData(np.zeros((560, 560)), unit="MJy/sr", wcs=wcs, meta=meta)


def mosaic_kernel(name, scale, pa):
    """From the prior to a mosaic, by the PSF in the middle of the sub-array."""
    middle = undistorted_psf(miri_psf(name, position=(128, 128), subarray="SUB256"))
    sharp = filter_psf("F444W", pixel_scale=FINE, pa=35 * u.deg)
    return MatchingKernel.from_psfs(sharp, psf_mosaic(middle, scale, pa), pixel_scale=FINE)


def spread(values):
    values = values[np.isfinite(values)]
    error = values.std() / np.sqrt(2 * len(values))
    return f"{len(values)} pulls, mean {values.mean():+.3f}, std {values.std():.3f} +- {error:.3f}"


def pulls(args):
    name, band = args.filter, f"miri.{args.filter.lower()}"
    prior = prior_grid()
    psf = miri_psf_grid(name, n_psfs=4, subarray="SUB256")
    kernels = None
    found = {"exposures": [], "mosaic": []}
    ratios = []
    for seed in args.seeds:
        catalog, n = field(seed, band, args.side, args.spacing)
        ramps = []
        for k, exposure in enumerate(dithers(name)):
            image = Scene(catalog[:n], exposure, psf=psf, background="low").render()
            ramps.append(Detector.miri_imager().expose(image, exposure, seed=10 * seed + k))
        reduced = Reducer().run(ramps)
        images = list(reduced.images)
        if kernels is None:
            kernels = ExposureKernels.from_images(images, prior, n_psfs=4)
            one = mosaic_kernel(name, 0.11 * u.arcsec, dithers(name)[0].pa_aper)
        templates = SourceTemplates.from_catalog(catalog, template="sersic", wcs=prior.wcs)
        joint = ForcedPhotometer(kernels).measure(images, templates=templates)
        photometer = ForcedPhotometer(one, background_order=0)
        single = photometer.measure(reduced.mosaic, templates=templates)
        truth = catalog[band].value
        for key, result in (("exposures", joint), ("mosaic", single)):
            found[key].append((result.flux.value - truth) / result.flux_err.value)
        ratios.append((joint.flux_err / single.flux_err).value)
        print(
            f"seed {seed}: errors over those of the mosaic {np.nanmedian(ratios[-1]):.3f}",
            flush=True,
        )
    for key, values in found.items():
        values = np.array(values)
        print(f"{key}, sources: {spread(values[:, :n])}")
        print(f"{key}, empty places: {spread(values[:, n:])}")
        print(f"{key}, all: {spread(values)}")
    ratios = np.array(ratios)
    print(f"errors over those of the mosaic: sources {np.nanmedian(ratios[:, :n]):.3f}, ", end="")
    print(f"empty places {np.nanmedian(ratios[:, n:]):.3f}")


def errors(args):
    for name in args.filters:
        rng = np.random.default_rng(3)
        images = []
        for exposure in dithers(name):
            noise = StdDevUncertainty(np.full(exposure.shape, 0.05))
            meta = {"filter": f"miri.{name.lower()}", "subarray": "SUB256", "n_outliers": 0}
            data = rng.normal(0, 0.05, exposure.shape)
            images.append(
                CCDData(data, unit="MJy/sr", wcs=exposure.wcs, uncertainty=noise, meta=meta)
            )
        grid = (np.arange(6) - 2.5) * 3.5
        dx, dy = (a.ravel() + rng.uniform(-0.3, 0.3, 36) for a in np.meshgrid(grid, grid))
        sky = CENTER.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec)
        templates = SourceTemplates.from_catalog(QTable({"sky": sky}))
        psf = undistorted_psf(miri_psf(name, position=(128, 128), subarray="SUB256"))
        pa = dithers(name)[0].pa_aper
        kernel = MatchingKernel.identity(psf, angle=pa)
        joint = ForcedPhotometer(kernel).measure(images, templates=templates)
        for scale in (0.11, 0.06):
            wcs = mosaic_wcs([one.wcs for one in images], scale * u.arcsec)
            mosaic = Reducer().mosaic(images, wcs=wcs)
            kernel = MatchingKernel.identity(psf_mosaic(psf, scale * u.arcsec, pa))
            photometer = ForcedPhotometer(kernel, background_order=0)
            single = photometer.measure(mosaic, templates=templates)
            ratio = np.median(joint.flux_err / single.flux_err)
            print(f"{name}, mosaic of {scale} arcsec: errors over its errors {ratio:.3f}")


def stars(args):
    for name in args.filters:
        exposure = Exposure(name, n_groups=40, pointing=CENTER, roll=ROLL)
        rng = np.random.default_rng(3)
        x, y = np.meshgrid(np.linspace(420, 980, 6), np.linspace(60, 960, 8))
        x, y = (a.ravel() + rng.uniform(-0.5, 0.5, a.size) for a in (x, y))
        catalog = QTable({"id": np.arange(x.size), "sky": exposure.wcs.pixel_to_world(x, y)})
        catalog["profile"] = "point"
        catalog[f"miri.{name.lower()}"] = 100 * u.uJy
        image = Scene(catalog, exposure, psf=miri_psf_grid(name, n_psfs=25)).render()
        noise = StdDevUncertainty(np.full(image.shape, 0.05))
        meta = {"filter": f"miri.{name.lower()}", "pa_aper": exposure.pa_aper.value}
        image = CCDData(image.data, unit=image.unit, wcs=image.wcs, uncertainty=noise, meta=meta)
        prior = prior_grid()
        templates = SourceTemplates.from_catalog(catalog["id", "sky"], wcs=prior.wcs)
        kernels = ExposureKernels.from_images([image], prior)
        flux = ForcedPhotometer(kernels).measure([image], templates=templates).flux.value
        print(f"{name}: flux {flux.min():.2f} to {flux.max():.2f} of 100, rms {flux.std():.3f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("pulls")
    command.add_argument("--seeds", type=int, nargs="+", default=[2])
    command.add_argument("--filter", default="F770W")
    command.add_argument("--side", type=int, default=8)
    command.add_argument("--spacing", type=float, default=2.6)
    command.set_defaults(run=pulls)
    for name, run in (("errors", errors), ("stars", stars)):
        command = commands.add_parser(name)
        command.add_argument("filters", nargs="+")
        command.set_defaults(run=run)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
