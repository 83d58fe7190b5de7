"""
Errors of point sources on simulated and reduced exposures, compared with those of `ErrorModel.from_exposure`.

    python benchmarks/exposure_errors.py                         nine filters at three depths
    python benchmarks/exposure_errors.py --filters miri.f770w --residual off

Point sources as dense as galaxies of H < 26.6 on 28 by 28 arcsec (sub-array SUB256) are exposed at several
dithers, reduced to a mosaic of 0.11 arcsec, and measured with the mosaic's PSF at the sources and at empty
places, where all dithers overlap. The standard deviation of measured less true flux over the model's error,
without what is beyond 4 sigma, is to be 1. Exits with 1 if any is off by more than 15 % and twice its
standard error.
"""

import argparse
import sys
import time

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.detector import (
    CosmicRays,
    Detector,
    Residual,
)
from miricigale.instrument import (
    Exposure,
    background_level,
    imager_filters,
    miri_detector,
    photmjsr,
)
from miricigale.photometry import ErrorModel, ForcedPhotometer
from miricigale.psf import MatchingKernel, gaussian_psf, miri_psf
from miricigale.reduction import Reducer
from miricigale.scene import Scene

FIELD = SkyCoord(53.1344, -27.83444, unit="deg")
SCALE = 0.11 * u.arcsec
#: Dithers and groups of one dither; the groups are divided among ramps that the sky does not fill.
DEPTHS = {"shallow": (4, 60), "middle": (4, 240), "deep": (8, 600)}
DENSITY = 0.054  # sources per arcsec^2


def exposures(name, n_dithers, n_frames):
    """Dithered exposures of the sub-array, ramps filled to at most 60 % by the sky."""
    detector = miri_detector()
    rate = background_level(name).value / photmjsr(name, gain=detector.gain) * detector.gain
    most = 0.6 * detector.full_well / rate / 0.3
    n = max(1, int(np.ceil(n_frames / most)))
    one = Exposure(
        name, n_groups=max(2, n_frames // n), n_integrations=n, subarray="SUB256",
        pointing=FIELD, roll=30 * u.deg,
    )  # fmt: skip
    return one.dithered("cycling-small", n_dithers)


def catalog(name, limit, rng, side=24.0):
    """Sources at random places, and empty places on a grid of 2 arcsec that avoids none of them."""
    n = rng.poisson(DENSITY * side**2)
    dx, dy = rng.uniform(-side / 2, side / 2, (2, n))
    flux = limit * 10 ** rng.normal(-0.3, 0.7, n)
    at = np.arange(-side / 2 + 1, side / 2, 2.0)
    gx, gy = (a.ravel() + rng.uniform(-0.3, 0.3, at.size**2) for a in np.meshgrid(at, at))
    dx, dy = np.append(dx, gx), np.append(dy, gy)
    total = len(dx)
    nothing = np.full(total, np.nan)
    return QTable(
        {
            "id": np.arange(total), "sky": FIELD.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec),
            "profile": np.full(total, "point"), "redshift": nothing,
            "half_light_radius": nothing * u.arcsec, "sersic_index": nothing,
            "axis_ratio": nothing, "position_angle": nothing * u.deg,
            name: np.append(flux, np.zeros(gx.size)) * u.uJy,
        }
    )  # fmt: skip


def simulate(name, depth, residual, seed, limit, cosmic_rays=True):
    """Sources, measured fluxes and their errors of one draw."""
    rng = np.random.default_rng(seed)
    plan = exposures(name, *DEPTHS[depth])
    truth = catalog(name, limit, rng)
    psf = miri_psf(name)
    detector = Detector.miri_imager()
    if residual:
        detector = detector.replace(Residual(residual))
    if not cosmic_rays:
        detector = detector.without(CosmicRays)
    ramps = (
        detector.expose(
            Scene(
                truth[truth[name] > 0], filter=name, wcs=e.wcs, psf=psf,
                background=background_level(name),
            ).render(),
            e, seed=1000 * seed + e.dither,
        )
        for e in plan
    )  # fmt: skip
    mosaic = Reducer().run(ramps, pixel_scale=SCALE).mosaic
    angle = plan[0].pa_aper
    sharp = gaussian_psf(0.15 * u.arcsec, pixel_scale=SCALE / 2, fov=6 * u.arcsec)
    kernel = MatchingKernel.from_psfs(
        sharp, psf, lo_angle=angle, resampling="drizzle", pixel_scale=SCALE
    )
    photometer = ForcedPhotometer(kernel, template="psf", background_order=0)
    result = photometer.measure(mosaic, catalog=truth["id", "sky"])
    # where all dithers overlap the noise is the smallest
    sigma = np.where(mosaic.mask, np.inf, mosaic.uncertainty.array)
    x, y = (np.rint(np.nan_to_num(v)).astype(int) for v in (result.x, result.y))
    inside = (x >= 0) & (x < sigma.shape[1]) & (y >= 0) & (y < sigma.shape[0])
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    good = inside & (sigma[y, x] < 1.15 * np.percentile(sigma[np.isfinite(sigma)], 20))
    good &= np.isfinite(result.flux.value) & (result.coverage > 0.98)
    return truth[good], result.flux[good], result.flux_err[good]


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--filters", nargs="+", default=imager_filters())
    parser.add_argument("--depths", nargs="+", default=list(DEPTHS))
    parser.add_argument("--residual", default="etc", help="'etc' (default), 'off' or a fraction")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--no-cosmic-rays", action="store_true")
    args = parser.parse_args()
    residual = {"off": None, "etc": "etc"}.get(args.residual)
    if residual is None and args.residual != "off":
        residual = float(args.residual)
    worst = 0.0
    for name in args.filters:
        for depth in args.depths:
            start = time.process_time()
            n_dithers, n_frames = DEPTHS[depth]
            plan = exposures(name, n_dithers, n_frames)
            seconds = sum(e.exposure_time for e in plan)
            n_ramps = sum(e.n_integrations for e in plan)
            model = ErrorModel.from_exposure(
                name,
                seconds,
                n_integrations=n_ramps,
                frame_time=0.3 * u.s,
                n_dithers=n_dithers,
                residual=residual,
                excess="ideal",
            )
            limit = model.limiting_flux(name).value
            off, formal, expected = [], [], []
            for seed in range(args.seeds):
                truth, flux, error = simulate(
                    name, depth, residual, seed, limit, not args.no_cosmic_rays
                )
                off.append((flux - truth[name]).value)
                formal.append(error.value)
                expected.append(model.sigma(truth[name], name).value)
            off, formal, expected = (np.concatenate(v) for v in (off, formal, expected))
            pull = off / expected
            pull = pull[np.abs(pull) < 4 * np.median(np.abs(pull)) * 1.4826]
            ratio, error = np.std(pull), np.std(pull) / np.sqrt(2 * len(pull))
            worst = max(worst, abs(ratio - 1) - 2 * error)
            print(
                f"{name} {depth:8s} {seconds.value:7.1f} s {n_ramps:3d} ramps  n {len(off):4d}  model "
                f"{np.median(expected):.4f} uJy  simulated/model {ratio:.3f} +- {error:.3f}  formal/model "
                f"{np.median(formal / expected):.3f}  bias/model {np.median(off / expected):+.2f}"
                f"  {time.process_time() - start:.0f} s", flush=True,
            )  # fmt: skip
    return int(worst > 0.15)


if __name__ == "__main__":
    sys.exit(main())
