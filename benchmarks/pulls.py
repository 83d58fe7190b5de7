"""
Pulls (measured less true flux, over the error) on scenes that GalSim draws: how true the errors are.

    python benchmarks/pulls.py                          10 scenes of 30 draws of the noise each
    python benchmarks/pulls.py --scenes 2 --draws 5     a look
    python benchmarks/pulls.py --load A.npz B.npz       the table of runs that were saved

Each scene has galaxies (Sersic index 0.5 to 4, half-light radius 0.1 to 0.5 arcsec) and points (one in
four), alone or in pairs 0.5 to 1 arcsec apart, on a prior like F160W (0.06 arcsec) and an image like F770W, on
its own pixels of 0.11 arcsec and resampled to 0.06 arcsec. Noise of prior and image is drawn anew, and sources
are detected anew, each time. Bins are in true flux over the median error of the source by the image's noise.
"""

import argparse
import time

import astropy.units as u
import galsim
import numpy as np
import scipy.ndimage
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty

from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import ForcedFlags, ForcedPhotometer, detect_sources
from miricigale.psf import MatchingKernel, hst_psf, miri_psf, psf_mosaic

CENTER = SkyCoord(53.1, -27.8, unit="deg")
FINE, COARSE = 0.06, 0.11
PRIOR_NOISE, NOISE = 0.004, 0.012  # uJy in a pixel of FINE, COARSE
BINS = ((0, 3), (3, 5), (5, 10), (10, 20), (20, 50), (50, 1e9))
SHARP = galsim.GSParams(maximum_fft_size=16384)


def scene(seed, n_side=7, spacing=4.6):
    """Positions (arcsec, east and north), shapes and fluxes; ``pair`` is whether a source is blended."""
    rng = np.random.default_rng(seed)
    grid = (np.arange(n_side) - (n_side - 1) / 2) * spacing
    dx, dy = (a.ravel() + rng.uniform(-0.3, 0.3, n_side**2) for a in np.meshgrid(grid, grid))
    second = rng.random(n_side**2) < 0.35
    angle, apart = rng.uniform(0, 2 * np.pi, n_side**2), rng.uniform(0.5, 1.0, n_side**2)
    dx = np.append(dx, (dx + apart * np.cos(angle))[second])
    dy = np.append(dy, (dy + apart * np.sin(angle))[second])
    n = len(dx)
    point = rng.random(n) < 0.25
    radius = np.where(point, 0.0, 10 ** rng.uniform(-1, np.log10(0.5), n))
    # signal-to-noise of the prior 5 to 80 in about the area of the source
    wanted = 10 ** rng.uniform(np.log10(5), np.log10(80), n)
    high = wanted * PRIOR_NOISE * np.sqrt(np.pi) * np.hypot(1.2 * radius, 0.17) / FINE / 0.6
    return {
        "dx": dx, "dy": dy, "pair": np.append(second, np.ones(second.sum(), bool)), "point": point,
        "n": rng.uniform(0.5, 4.0, n), "radius": radius, "q": rng.uniform(0.3, 1, n),
        "theta": rng.uniform(0, 180, n), "high": high, "flux": high * 10 ** rng.normal(0.1, 0.5, n),
        "sky": CENTER.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec),
    }  # fmt: skip


def draw(catalog, flux, psf, wcs, shape, scale):
    """All sources by GalSim, uJy in each pixel; the PSF has the pixel's response."""
    image = galsim.ImageD(shape[1], shape[0], scale=scale, xmin=0, ymin=0)
    wide = galsim.InterpolatedImage(galsim.ImageD(psf, scale=FINE), gsparams=SHARP)
    x, y = wcs.world_to_pixel(catalog["sky"])
    for k, total in enumerate(flux):
        profile = wide * total
        if not catalog["point"][k]:
            one = galsim.Sersic(
                catalog["n"][k], half_light_radius=catalog["radius"][k], gsparams=SHARP
            )
            one = one.shear(q=catalog["q"][k], beta=catalog["theta"][k] * galsim.degrees)
            profile = galsim.Convolve(one, wide, gsparams=SHARP) * total
        i, j = round(float(x[k])), round(float(y[k]))
        half = int(6 / scale)
        box = galsim.BoundsI(i - half, i + half, j - half, j + half) & image.bounds
        profile.drawImage(
            image=image[box], method="no_pixel", add_to_image=True,
            center=galsim.PositionD(float(x[k]), float(y[k])),
        )  # fmt: skip
    return image.array


class Field:
    """A scene's images without noise, and draws of the noise; the scene is that of the seed, or given."""

    def __init__(self, seed, kernel, target, catalog=None):
        self.catalog = scene(seed) if catalog is None else catalog
        self.rng = np.random.default_rng([seed, 1])
        side = np.ptp(self.catalog["dx"]) + 9
        self.wcs, self.light = {}, {}
        for name, psf, scale, flux in (
            ("prior", kernel.source, FINE, "high"),
            ("own", target, COARSE, "flux"),
            ("resampled", target, FINE, "flux"),
        ):
            shape = (int(side / scale),) * 2
            wcs = north_up_wcs(CENTER, scale * u.arcsec, shape)
            self.wcs[name] = wcs
            self.light[name] = draw(self.catalog, self.catalog[flux], psf, wcs, shape, scale)

    def image(self, name):
        light, rng = self.light[name], self.rng
        if name == "resampled":
            # noise of the pixels of 0.11 arcsec, interpolated
            n = int(light.shape[0] * FINE / COARSE) + 8
            native = rng.normal(0, NOISE * (FINE / COARSE) ** 2, (n, n))
            at = np.indices(light.shape) * (FINE / COARSE) + rng.uniform(2, 3, 2)[:, None, None]
            noise = scipy.ndimage.map_coordinates(native, at, order=1)
        else:
            noise = rng.normal(0, PRIOR_NOISE if name == "prior" else NOISE, light.shape)
        area = pixel_area_map(self.wcs[name], light.shape) * 1e12
        sigma = StdDevUncertainty((noise.std() / area).astype(np.float32))
        return CCDData((light + noise) / area, unit="MJy/sr", wcs=self.wcs[name], uncertainty=sigma)


def measured(field, photometer, grids):
    """One draw: arrays of true flux, flux and error terms, blended or not, for each grid."""
    prior = field.image("prior")
    segments, found = detect_sources(prior)
    index, distance, _ = field.catalog["sky"].match_to_catalog_sky(found["sky"])
    back, _, _ = found["sky"].match_to_catalog_sky(field.catalog["sky"])
    # a detection belongs to one source; of a pair that was not separated there is no truth
    ok = (distance < 0.25 * u.arcsec) & (back[index] == np.arange(len(index)))
    taken = np.bincount(index[distance < 1.2 * u.arcsec], minlength=len(found)) == 1
    ok &= ~field.catalog["pair"] | taken[index]
    rows = {}
    for name in grids:
        result = photometer.measure(field.image(name), prior, segments, found)
        columns = [
            getattr(result, c).value[index]
            for c in ("flux", "flux_err", "flux_err_noise", "flux_err_template")
        ]
        columns += [result.template_snr[index], result.flags[index]]
        rows[name] = np.where(ok, np.array(columns, float), np.nan)
    return rows


def line(name, pull, bias):
    good = np.isfinite(pull)
    pull = pull[good]
    if len(pull) < 20:
        return
    middle = np.median(pull)
    print(
        f"{name:48s} {len(pull):6d} {np.std(pull):6.2f} {1.4826 * np.median(np.abs(pull - middle)):6.2f} "
        f"{np.mean(pull):+6.2f} {middle:+6.2f} {100 * np.nanmedian(bias[good]):+6.1f}% "
        f"{100 * np.mean(np.abs(pull) > 3):5.1f}%"
    )


def table(catalogs, rows, grids):
    print(
        f"{'':48s} {'n':>6s} {'std':>6s} {'MAD':>6s} {'mean':>6s} {'median':>6s} {'bias':>7s} {'> 3':>6s}"
    )
    truth, pair, point = (
        np.concatenate([one[name] for one in catalogs]) for name in ("flux", "pair", "point")
    )
    for grid in grids:
        # columns, draws, sources
        flux, err, noise, _, prior_snr, flags = np.concatenate(
            [np.moveaxis(np.array(one[grid]), 0, 1) for one in rows], axis=2
        )
        bins = truth / np.nanmedian(noise, axis=0)
        pull, old, ratio = (flux - truth) / err, (flux - truth) / noise, flux / truth - 1
        poor = int(ForcedFlags.POOR_FIT | ForcedFlags.UNEXPLAINED_NEIGHBOR)
        clear = np.where((np.nan_to_num(flags).astype(int) & poor) == 0, pull, np.nan)
        for kind, which in (("isolated", ~pair), ("blended", pair)):
            for low, high in BINS:
                use = which & (bins >= low) & (bins < high)
                label = f"{grid}, {kind}, S/N {low:g}-{high:g}".replace("-1e+09", "-")
                line(label, pull[:, use], ratio[:, use])
                line(f"{label}, without flagged", clear[:, use], ratio[:, use])
        for low, high in BINS:
            use = (bins >= low) & (bins < high)
            line(f"{grid}, noise only, S/N {low:g}-{high:g}", old[:, use], ratio[:, use])
        for low, high in ((0, 5), (5, 10), (10, 20), (20, 40), (40, 1e9)):
            for kind, which in (("points", point), ("galaxies", ~point)):
                use = (prior_snr >= low) & (prior_snr < high) & which & ~pair & (bins > 5)
                line(f"{grid}, {kind}, prior S/N {low:g}-{high:g}", pull[use], ratio[use])


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--band", default="miri.f770w")
    parser.add_argument("--grids", nargs="+", default=["own", "resampled"])
    parser.add_argument("--save", help="file for the numbers (npz)")
    parser.add_argument("--load", nargs="+", help="files of --save, of the same number of draws")
    args = parser.parse_args()
    if args.load:
        saved = [np.load(one) for one in args.load]
        return table(saved, saved, args.grids)
    hst = hst_psf("wfc3.f160w", pixel_scale=FINE * u.arcsec)
    target = psf_mosaic(miri_psf(args.band), FINE * u.arcsec, 40 * u.deg)
    kernel = MatchingKernel.from_psfs(hst, target, pixel_scale=FINE * u.arcsec, extent=9 * u.arcsec)
    photometer = ForcedPhotometer(kernel, background_order=0)
    fields, rows, start = [], [], time.process_time()
    for seed in range(args.first, args.first + args.scenes):
        field = Field(seed, kernel, kernel.target)
        draws = [measured(field, photometer, args.grids) for _ in range(args.draws)]
        fields.append(field)
        rows.append({grid: [one[grid] for one in draws] for grid in args.grids})
    print(f"{args.band}: {time.process_time() - start:.0f} s of processor time")
    catalogs = [field.catalog for field in fields]
    table(catalogs, rows, args.grids)
    if args.save:
        known = {
            key: np.concatenate([one[key] for one in catalogs])
            for key in ("flux", "high", "pair", "point", "n", "radius", "q")
        }
        # draws, columns, sources
        arrays = {grid: np.concatenate([one[grid] for one in rows], axis=2) for grid in args.grids}
        np.savez(args.save, **known, **arrays)


if __name__ == "__main__":
    main()
