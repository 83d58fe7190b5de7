"""
Tells what second passes of forced photometry find: sources that the prior lacks, nuclei, a distortion.

    python benchmarks/passes.py             two fields of F770W
    python benchmarks/passes.py --seeds 4   with more sources

The fields are those of ``benchmarks/templates.py`` (galaxies and points, PSFs of HST and MIRI). To the image that
is measured are added points beside half of the sources; or points on top of half of the galaxies; or it is
drawn from positions that are distorted.
"""

import argparse

import astropy.units as u
import numpy as np
from templates import CENTER, COARSE, fine_psf, make, paint

from miricigale.instrument import pixel_area_map
from miricigale.photometry import ForcedFlags, ForcedPhotometer
from miricigale.utils.tables import match_sky


def add_points(field, sky, flux):
    """Add points to the image of a field."""
    _, kernel, _, low, _, _ = field
    xy = np.stack(low.wcs.world_to_pixel(sky), axis=-1)
    points = {"point": np.ones(len(flux), bool)}
    light = paint(points, flux, fine_psf(kernel.target), low.wcs, low.shape, xy, COARSE)
    low = low.copy()
    low.data = low.data + light / (pixel_area_map(low.wcs, low.shape) * 1e12)
    return low


def measured(field, low, **options):
    """The result, and for each true source its row (-1 without)."""
    catalog, kernel, high, _, segmentation, detected = field
    index, _ = match_sky(detected["sky"], catalog["sky"], radius=0.3 * u.arcsec)
    return ForcedPhotometer(kernel, **options).measure(low, high, segmentation, detected), index


def report(name, ratio):
    middle = np.nanmedian(ratio)
    scatter = 1.4826 * np.nanmedian(np.abs(ratio - middle))
    print(f"  {name:44s} {100 * (middle - 1):+6.1f} +- {100 * scatter:4.1f} %  ({len(ratio)})")


def hidden(fields, rng):
    print("points that the prior lacks, 0.3 to 1.2 arcsec from a source, 0.2 to 1 times its light")
    rows, others = [], 0
    for field in fields:
        catalog = field[0]
        n = len(catalog["flux"])
        host = rng.permutation(n)[: n // 2]
        distance, angle = rng.uniform(0.3, 1.2, len(host)), rng.uniform(0, 2 * np.pi, len(host))
        sky = catalog["sky"][host].spherical_offsets_by(
            distance * np.cos(angle) * u.arcsec, distance * np.sin(angle) * u.arcsec
        )
        flux = catalog["flux"][host] * rng.uniform(0.2, 1.0, len(host))
        low = add_points(field, sky, flux)
        once, index = measured(field, low)
        twice, _ = measured(field, low, second_pass=True)
        new = twice.new_sources
        row, away, _ = sky.match_to_catalog_sky(new["sky"])
        found = away < 0.15 * u.arcsec
        known = index[host] >= 0
        truth = catalog["flux"][host]
        others += len(new) - len(np.unique(row[found]))
        rows.append((
            found, once.flux.value[index[host]] / truth, twice.flux.value[index[host]] / truth,
            np.where(found, new["flux"].value[row] / flux, np.nan), known, distance,
        ))  # fmt: skip
    found, once, twice, light, known, distance = map(np.concatenate, zip(*rows, strict=True))
    for low, high in ((0.3, 0.5), (0.5, 1.2)):
        near = (distance >= low) & (distance < high)
        print(f"  {low}-{high} arcsec: {found[near].sum()} of {near.sum()} found")
    print(f"  {others} others beside {sum(len(f[0]['flux']) for f in fields)} sources")
    report("neighbors of those found, one pass", once[found & known])
    report("the same, two passes", twice[found & known])
    report("the points", light[found])


def nuclei(fields, rng):
    print("points on top of galaxies, 0.3 to 1 times their light")
    rows, others = [], []
    for field in fields:
        catalog = field[0]
        host = np.flatnonzero(~catalog["point"])
        host = rng.permutation(host)[: len(host) // 2]
        flux = catalog["flux"][host] * rng.uniform(0.3, 1.0, len(host))
        low = add_points(field, catalog["sky"][host], flux)
        once, index = measured(field, low)
        twice, _ = measured(field, low, components=2)
        known = index[host] >= 0
        galaxy, point = index[host[known]], flux[known]
        total = point + catalog["flux"][host[known]]
        other = np.setdiff1d(np.flatnonzero(index >= 0), host)
        split = np.isfinite(twice.flux_point.value[index[other]])
        flux_other = catalog["flux"][other[split]]
        others.append([r.flux.value[index[other[split]]] / flux_other for r in (once, twice)])
        print(f"  {split.sum()} of {len(other)} sources without were split too")
        rows.append((
            once.flux.value[galaxy] / total, twice.flux.value[galaxy] / total,
            twice.flux_point.value[galaxy] / point, once.template_snr[galaxy],
            (twice.flux.value[galaxy] - total) / twice.flux_err.value[galaxy],
            (twice.flux_point.value[galaxy] - point) / twice.flux_point_err.value[galaxy],
            once.flags[galaxy] & int(ForcedFlags.POOR_FIT) != 0, catalog["radius"][host[known]],
        ))  # fmt: skip
    report("these, one template", np.concatenate([one[0] for one in others]))
    report("these, two components", np.concatenate([one[1] for one in others]))
    once, twice, point, snr, pull, point_pull, poor, radius = map(
        np.concatenate, zip(*rows, strict=True)
    )
    for low, high in ((5, 20), (20, 999)):
        use = (snr >= low) & (snr < high)
        print(f"  template S/N {low}-{high}: {poor[use].sum()} of {use.sum()} are poor fits")
        report("total, one template", once[use])
        report("total, two components", twice[use])
        split = use & np.isfinite(point)
        print(f"  {split.sum()} of {use.sum()} are split")
        report("point", point[split])
        report("point, galaxies above 0.2 arcsec", point[split & (radius > 0.2)])
        for name, one in (("totals", pull[use]), ("points", point_pull[split])):
            spread = 1.4826 * np.nanmedian(np.abs(one))
            print(f"  scatter of the pulls of {name}: {spread:.2f}")


def distortion(fields):
    print("an image distorted by up to 0.1 arcsec (linear)")
    for field in fields:
        catalog, kernel, high, low, segmentation, detected = field
        moved = detected.copy()
        east, north = (a.arcsec for a in CENTER.spherical_offsets_to(detected["sky"]))
        offset = 0.05 * np.stack([east, north], axis=1) / np.abs([east, north]).max()
        # the positions are wrong, and with them the whole prior
        prior = high.copy()
        prior.wcs = high.wcs.deepcopy()
        scale = 1 - offset[:, 0] @ east / (east @ east)
        prior.wcs.wcs.cdelt = prior.wcs.wcs.cdelt * scale
        moved["sky"] = prior.wcs.pixel_to_world(*high.wcs.world_to_pixel(detected["sky"]))
        index, _ = match_sky(detected["sky"], catalog["sky"], radius=0.3 * u.arcsec)
        good = index >= 0
        truth = catalog["flux"][good]
        there = np.stack(detected["sky"].spherical_offsets_to(moved["sky"]), axis=1)
        for name, options in (
            ("without a map", {}),
            ("with a map", {"max_shift": 0.2 * u.arcsec, "offset_order": 1}),
        ):
            result = ForcedPhotometer(kernel, **options).measure(low, prior, segmentation, moved)
            report(name, result.flux.value[index[good]] / truth)
        found = result.offset_map.evaluate(moved["sky"])
        # +x is west
        left = (found * [-1, 1] + there).to_value(u.mas)
        print(f"  {result.offset_map}: rms of its error {np.sqrt(np.mean(left**2)):.1f} mas, "
              f"of the distortion {np.sqrt(np.mean(there.to_value(u.mas) ** 2)):.1f} mas")  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seeds", type=int, default=2, help="number of fields")
    parser.add_argument("--band", default="miri.f770w")
    args = parser.parse_args()
    fields = [make(seed, args.band) for seed in range(1, 1 + args.seeds)]
    rng = np.random.default_rng(0)
    hidden(fields, rng)
    nuclei(fields, rng)
    distortion(fields)


if __name__ == "__main__":
    main()
