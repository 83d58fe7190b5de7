"""
Point-source limits, 10 sigma in 10 ks, from simulated exposures, compared with the calculator's.

    python benchmarks/sensitivity.py [--filters miri.f770w ...] [--seed 1] [--full]

Each filter is exposed as for the published limits of the exposure time calculator
(`miricigale.depth.etc_setup`) to the low background, by our detector with cosmic rays and bad
pixels, and reduced; the limit is the flux at which the mean of injected point sources is ten
times the scatter of empty apertures. Aperture as the calculator's, sky known as there; the
columns "annulus" measure the sky in its annulus instead.

One exposure without sources and one with (20 times the limit, random places in the pixel) are
simulated. The others have independent noise: that of the one is divided by the root of
their number, and what does not average, the residual pattern of the detector, is added in full. With
--full every exposure is simulated, with the residual in the detector, and averaged (minutes
per filter). Exits with 1 if a limit with the residual is off the calculator's by 10 % or more.
"""

import argparse
import sys

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from astropy.stats import sigma_clip
from astropy.table import QTable
from photutils.aperture import ApertureStats, CircularAnnulus, CircularAperture

from miricigale.depth import etc_limit, etc_setup, proposal_limit, sensitivity
from miricigale.detector import Block, Detector, Residual
from miricigale.instrument import (
    CEERS_FILTERS,
    Exposure,
    background_level,
    ceers_exposures,
    imager_columns,
    imager_filters,
    miri_detector,
    pixel_area_map,
)
from miricigale.psf import MIRI_PIXEL_SCALE, miri_psf
from miricigale.reduction import Reducer
from miricigale.scene import Scene

FIELD = SkyCoord(53.1344, -27.83444, unit="deg")
BRIGHT = 20.0  # flux of the injected sources in limits


class Extraction:
    """The calculator's aperture on our pixels; images less the sky, in MJy/sr."""

    def __init__(self, setup, exposure, mask):
        scale = MIRI_PIXEL_SCALE.to_value(u.arcsec)
        self.radius = setup.radius.to_value(u.arcsec) / scale
        self.edges = setup.annulus.to_value(u.arcsec) / scale
        self.mask = mask
        self.area = pixel_area_map(exposure.wcs, exposure.shape) * 1e12  # uJy per MJy/sr

    def grid(self, spacing, rng):
        """Places, x and y, whose surroundings see the sky, anywhere within their pixels."""
        reach = self.edges[1] + 2
        left, right = imager_columns()
        x, y = np.meshgrid(
            np.arange(left + reach, right - reach, spacing),
            np.arange(reach, self.mask.shape[0] - reach, spacing),
        )
        xy = np.column_stack([x.ravel(), y.ravel()])
        xy = xy + rng.uniform(-0.5, 0.5, xy.shape)
        circle = CircularAperture(xy, self.edges[1])
        lost = ApertureStats(self.mask.astype(float), circle).sum / circle.area
        return xy[lost < 0.05]

    def fluxes(self, image, xy):
        """Sums in uJy with the sky known, and with that of the annulus taken off."""
        # a few masked pixels count as sky; dithers would fill them
        values = np.where(self.mask, 0.0, image) * self.area
        circle, ring = CircularAperture(xy, self.radius), CircularAnnulus(xy, *self.edges)
        inner, outer = (ApertureStats(values, a).sum for a in (circle, ring))
        return inner, inner - outer * circle.area / ring.area


def scatter(values):
    """Standard deviation without what lies beyond 4 sigma."""
    return np.ma.std(sigma_clip(values, sigma=4, maxiters=3))


def exposed(detector, scene, exposure, seed):
    """One exposure, reduced: surface brightness and mask."""
    reducer = Reducer()
    cal = reducer.calibrate(reducer.fit_ramp(detector.expose(scene, exposure, seed=seed)))
    mask = np.asarray(cal.mask) | ~np.isfinite(cal.data)
    return cal.data, mask


def flat_scene(exposure, level):
    """Sky alone."""
    data = np.full(exposure.shape, level)
    return CCDData(data, unit="MJy/sr", meta={"psf_includes": ["pixel", "ipc"]})


def pattern(exposure, level, seed):
    """What the detector's residual adds to a flat sky, MJy/sr."""
    light = np.full(exposure.shape, level)
    rows = slice(0, exposure.shape[0])
    block = Block(exposure, miri_detector(), rows, None, None, None)
    return Residual("etc", pattern=seed).apply(light, block) - light


def average(setup, exposure, level, seed):
    """The mean of all exposures, residual in the detector."""
    detector = Detector.miri_imager()
    detector = detector.replace(Residual("etc", pattern=seed))
    scene = flat_scene(exposure, level)
    total, number = 0.0, 0
    for k in range(setup.n_exposures):
        data, mask = exposed(detector, scene, exposure, seed * 1000 + k)
        total = total + np.where(mask, 0.0, data)
        number = number + ~mask
        print(f"  exposure {k + 1} of {setup.n_exposures}", file=sys.stderr, flush=True)
    return total / np.maximum(number, 1), number == 0


def limits(name, seed, full):
    """One filter: limits in uJy and what belongs to them."""
    setup = etc_setup(name)
    exposure = Exposure(
        name,
        n_groups=setup.n_groups,
        n_integrations=setup.n_integrations,
        pointing=FIELD,
        roll=0 * u.deg,
    )
    level = background_level(name).value
    rng = np.random.default_rng(seed)
    detector = Detector.miri_imager()
    data, mask = exposed(detector, flat_scene(exposure, level), exposure, seed)
    noise = (data - level) / np.sqrt(setup.n_exposures)
    extraction = Extraction(setup, exposure, mask)
    empty = extraction.grid(2 * extraction.radius + 5, rng)
    at = extraction.grid(6 * extraction.radius + 15, rng)
    flux = BRIGHT * etc_limit(name)
    catalog = QTable(
        {
            "id": np.arange(len(at)),
            "sky": exposure.wcs.pixel_to_world(at[:, 0], at[:, 1]),
            "profile": np.full(len(at), "point"),
            "redshift": np.full(len(at), np.nan),
            "half_light_radius": np.full(len(at), np.nan) * u.arcsec,
            "sersic_index": np.full(len(at), np.nan),
            "axis_ratio": np.full(len(at), np.nan),
            "position_angle": np.full(len(at), np.nan) * u.deg,
            name: np.full(len(at), flux.value) * u.uJy,
        }
    )
    scene = Scene(
        catalog,
        filter=name,
        wcs=exposure.wcs,
        psf=miri_psf(name),
        background=background_level(name),
    ).render()
    bright, bright_mask = exposed(detector, scene, exposure, seed + 500)
    light = [
        np.mean(v) / flux.value
        for v in Extraction(setup, exposure, bright_mask).fluxes(bright - level, at)
    ]

    off = [10 * scatter(v) / f for v, f in zip(extraction.fluxes(noise, empty), light, strict=True)]
    if full:
        mean, mask = average(setup, exposure, level, seed)
        extraction.mask = mask
        image = mean - level
    else:
        image = noise + pattern(exposure, level, seed)
    on = [10 * scatter(v) / f for v, f in zip(extraction.fluxes(image, empty), light, strict=True)]
    return {
        "n": len(empty),
        "light": light[0],
        "off": off[0],
        "on": on[0],
        "off_annulus": off[1],
        "on_annulus": on[1],
    }


def ceers(name):
    """Depths of the survey's exposures, 5 sigma AB: of the proposal, ours by the closed form."""
    exposures = ceers_exposures(FIELD, 0 * u.deg, filters=[name])
    time = sum(e.exposure_time for e in exposures)
    options = {"n_sigma": 5, "n_groups": exposures[0].n_groups, "n_dithers": len(exposures)}
    options["method"] = "aperture"
    limits = [sensitivity(name, time, residual=r, **options) for r in (None, "etc")]
    ours = [limit.to_value(u.ABmag) for limit in limits]
    return proposal_limit(name).value, *ours


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--filters", nargs="+", default=imager_filters())
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--full", action="store_true", help="simulate every exposure")
    args = parser.parse_args()
    print(
        f"{'':8s} {'radius':>6s} {'sky':>6s} {'aper-':>5s} {'light':>5s} | {'residual off':>12s} | "
        f"{'residual on':>12s} {'closed':>6s} | {'ETC':>6s} {'ETC':>6s} {'on /':>5s} | "
        f"{'annulus':>6s} {'annulus':>7s} | {'CEERS':>5s} {'ours,':>5s} {'ours,':>5s}\n"
        f"{'':8s} {'arcsec':>6s} {'MJy/sr':>6s} {'tures':>5s} {'':5s} | {'uJy':>6s} {'/4.0':>5s} | "
        f"{'uJy':>6s} {'/4.0':>5s} {'form':>6s} | {'4.0':>6s} {'2.0':>6s} {'2.0':>5s} | "
        f"{'off':>6s} {'on':>7s} | {'AB 5s':>5s} {'off':>5s} {'on':>5s}"
    )
    worst = 0.0
    for name in args.filters:
        setup, row = etc_setup(name), limits(name, args.seed, args.full)
        new, old = etc_limit(name).value, etc_limit(name, "2.0").value
        closed = sensitivity(name, setup.time, n_sigma=10, method="aperture", residual="etc").value
        depths = ceers(name) if name in CEERS_FILTERS else ("", "", "")
        cells = [f"{d:5.2f}" if d else f"{'':5s}" for d in depths]
        print(
            f"{name[5:].upper():8s} {setup.radius.value:6.3f} {background_level(name).value:6.1f} "
            f"{row['n']:5d} {row['light']:5.3f} | {row['off']:6.3f} {row['off'] / new:5.2f} | "
            f"{row['on']:6.3f} {row['on'] / new:5.2f} {closed:6.3f} | {new:6.3f} {old:6.3f} "
            f"{row['on'] / old:5.2f} | {row['off_annulus']:6.3f} {row['on_annulus']:7.3f} | "
            + " ".join(cells),
            flush=True,
        )
        worst = max(worst, abs(row["on"] / new - 1))
    print(f"largest deviation from ETC 4.0 with the residual on: {100 * worst:.1f} %")
    sys.exit(int(worst >= 0.10))


if __name__ == "__main__":
    main()
